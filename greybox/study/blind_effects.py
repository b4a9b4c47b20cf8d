"""Everything that may be wrong in a blind trial: causes with a name, and effects without one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from greybox.errors import UsageError, suggestion
from greybox.study.blind_causes import (
    CAUSES,
    OF_ONE,
    Effect,
    Kind,
    Typical,
    Value,
    setting,
    uniform,
    with_terms,
)
from greybox.study.blind_ship import Ship


def _dead_band(rng: np.random.Generator, size: float, typical: Typical) -> dict[str, Value]:
    # a share of the time in it, whatever the speeds of the trial
    speed = np.abs(typical.commands[:, :2])
    return {"dead_band": float(np.quantile(speed, size * rng.uniform(0.2, 0.4)))}


def _interaction(rng: np.random.Generator, size: float, typical: Typical) -> dict[str, Value]:
    return {
        "loss": size * rng.uniform(0.4, 0.8),
        "centre": float(np.quantile(typical.commands[:, 2], rng.uniform(0.3, 0.7))),
        "width": rng.uniform(0.1, 0.2),
    }


def _backlash(rng: np.random.Generator, size: float, typical: Typical) -> dict[str, Value]:
    return {"half_play": size * np.radians(rng.uniform(10, 15)) / 2}


def _slow_force(rng: np.random.Generator, size: float, typical: Typical) -> dict[str, Value]:
    return {
        "amplitude": size * rng.uniform(0.02, 0.04),
        "period": rng.uniform(200, 400),
        "towards": rng.uniform(0, 2 * np.pi),
        "phase": rng.uniform(0, 2 * np.pi),
    }


def _shallow(rng: np.random.Generator, size: float, typical: Typical) -> dict[str, Value]:
    low, high = np.quantile(np.abs(typical.surge), [0.6, 0.95])
    ratio = size * rng.uniform(1.0, 2.0)
    return {
        "coefficient": ratio * typical.value("Xu") * high / max(high - low, 0.1) ** 2,
        "threshold": float(low),
    }


# none of these is a cause that has a name: they are to be found, not to be named
UNKNOWN: dict[str, Kind] = {
    "dead_band": Kind(_dead_band, setting(dead_band="dead_band")),
    "interaction": Kind(_interaction, setting(interaction=("loss", "centre", "width"))),
    "backlash": Kind(_backlash, setting(backlash="half_play")),
    "slow_force": Kind(_slow_force, setting(swell=("amplitude", "period", "towards", "phase"))),
    "uneven_damping": Kind(uniform("unevenness", 0.5, 1.5), setting(unevenness="unevenness")),
    "shallow": Kind(_shallow, setting(shallow=("coefficient", "threshold"))),
}
EFFECTS = CAUSES | OF_ONE | UNKNOWN
# those that add terms to the equations, so that several may stand together
_TERMS = tuple(name for name, kind in CAUSES.items() if kind.act is with_terms)


def shows(name: str, kind: str) -> bool:
    """Return whether an effect can show in trials of a kind of inputs."""
    # pulses push to starboard only: sway never changes its sign
    return not (name == "uneven_damping" and kind == "pulses")


def check_effects(ids: tuple[str, ...], kind: str) -> None:
    """Refuse effects that do not exist, or that cannot show in trials of a kind.

    Raises
    ------
    UsageError
        Names the effect and the nearest known one.
    """
    for name in ids:
        if name not in EFFECTS:
            raise UsageError(
                f"there is no effect '{name}'.{suggestion(name, EFFECTS)} "
                f"Effects: {', '.join(EFFECTS)}."
            )
    if not all(shows(name, kind) for name in ids):
        raise UsageError(
            "uneven_damping needs sway to both sides, and pulses push to starboard only: draw "
            "manoeuvres or zigzag."
        )
    if len(set(ids)) < len(ids):
        raise UsageError(f"an effect stands twice in {', '.join(ids)}: name each once.")


def draw_effect(name: str, rng: np.random.Generator, size: float, typical: Typical) -> Effect:
    """Draw the parameters of an effect; `size` 1 is its stated range, 0 no effect."""
    drawn = EFFECTS[name].draw(rng, size, typical)
    return Effect(name, {k: v if isinstance(v, str) else float(v) for k, v in drawn.items()})


def act(ship: Ship, effects: tuple[Effect, ...], *, later: bool) -> Ship:
    """Return the ship under the effects; `later` on a trial after they came to stay."""
    for effect in effects:
        changed = EFFECTS[effect.id].act(ship, effect, later)
        if effect.id in _TERMS:
            both = tuple(a + b for a, b in zip(ship.extra, changed.extra, strict=True))
            changed = replace(changed, extra=both)
        ship = changed
    return ship
