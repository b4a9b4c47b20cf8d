"""Blind trials: drawn from a seed alone, with a known truth that the log does not tell.

A ship is drawn around Table 6.1, sailed in continuous time by a simulator of
its own, and logged once for the estimate and once for the validation, with
none, one or two effects that its model lacks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.errors import UsageError
from greybox.files import make_folder, write_json, write_text
from greybox.study.blind_causes import OF_ONE, Effect, Typical
from greybox.study.blind_conditions import Conditions, blind_vessel, vessel_text
from greybox.study.blind_effects import act, check_effects, draw_effect
from greybox.study.blind_inputs import KINDS, steer
from greybox.study.blind_sensors import gauss_markov, observe, wanted
from greybox.study.blind_ship import LEAD, NAMES, STEP, History, Ship, simulate_ships
from greybox.study.chapter6 import TRUE
from greybox.trial.log import TrialLog, make_log
from greybox.trial.store import write_log
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]

# per second: surge, sway [m/s], yaw rate [rad/s]
PROCESS = np.array([1e-3, 1e-3, 3e-4])
# undisturbed motion past these is no sensible trial, disturbed past the second row a runaway
_SANE, _RUNAWAY = np.array([5.0, 3.0, 0.15]), np.array([8.0, 5.0, 0.5])
_ATTEMPTS = 50


@dataclass(frozen=True)
class Trial:
    """Two logs of one ship, and what is wrong with them.

    Parameters
    ----------
    estimation, validation : TrialLog
    vessel : Vessel
    truth : tuple of Effect
        None, one or two.
    ship : mapping of str to float
        The true parameters per second.
    conditions : Conditions
    """

    estimation: TrialLog
    validation: TrialLog
    vessel: Vessel
    truth: tuple[Effect, ...]
    ship: dict[str, float]
    conditions: Conditions


@dataclass(frozen=True)
class Order:
    """What to draw: ids of effects, and the size that scales them (1: as stated)."""

    effects: tuple[str, ...] = ()
    size: float = 1.0


@dataclass
class _Draft:
    """A trial on its way: its seed, and both logs' ships."""

    seed: int
    ships: list[Ship]
    effects: tuple[Effect, ...] = ()
    # the air that the anemometer feels on each log
    felt: list[Array] = field(default_factory=list)

    def rng(self, log: int, use: int) -> np.random.Generator:
        """Return a stream of its own for each use, so that one effect moves no other draw."""
        return np.random.default_rng([self.seed, log, use])


def draw(
    rng: np.random.Generator,
    effects: Sequence[str] = (),
    *,
    size: float = 1.0,
    **conditions: Any,
) -> Trial:
    """Draw one blind trial.

    Parameters
    ----------
    rng : numpy.random.Generator
        All that is drawn follows from it: without effects, with small or with large
        ones the ship, its inputs and its noises are the same.
    effects : sequence of str
        Ids of what is wrong, at most a few: see `greybox.study.blind_effects.EFFECTS`.
    size : float
        Scales the effects: 1 as stated, 0 none.
    **conditions
        Fields of `Conditions`.

    Raises
    ------
    UsageError
        An effect, kind or colour does not exist, or cannot show in such a trial.
    """
    return draw_many([rng], [Order(tuple(effects), size)], Conditions(**conditions))[0]


def draw_many(
    rngs: Sequence[np.random.Generator], orders: Sequence[Order], conditions: Conditions
) -> list[Trial]:
    """Draw several trials of the same conditions, sailed side by side.

    Parameters
    ----------
    rngs : sequence of numpy.random.Generator
        One per trial.
    orders : sequence of Order
        One per trial.
    conditions : Conditions

    Raises
    ------
    UsageError
        As `draw`.
    """
    for order in orders:
        check_effects(order.effects, conditions.kind)
        own = {"thruster_gain", *(n for n in OF_ONE if n.endswith((":n1", ":n2")))}
        if conditions.single and own & set(order.effects):
            raise UsageError(
                "one thruster cannot be told where both have 1 speed column: draw with 2."
            )
    trials: dict[int, Trial] = {}
    for _ in range(_ATTEMPTS):
        left = [i for i in range(len(rngs)) if i not in trials]
        if not left:
            break
        drafts = [_drafted(rngs[i], conditions) for i in left]
        history = _sail(drafts, conditions, step=1.0)
        sane = _bounded(history, _SANE)
        kept = [j for j in range(len(left)) if sane[j]]
        if not kept:
            continue
        for j in kept:
            _disturb(drafts[j], orders[left[j]], history, 2 * j, conditions)
        chosen = [drafts[j] for j in kept]
        history = _sail(chosen, conditions)
        for place, (j, steady) in enumerate(zip(kept, _bounded(history, _RUNAWAY), strict=True)):
            if steady:
                trials[left[j]] = _logged(drafts[j], history, 2 * place, conditions)
    else:
        raise UsageError(
            f"{len(rngs) - len(trials)} of {len(rngs)} ships ran away in each of {_ATTEMPTS} "
            f"draws: draw smaller effects."
        )
    return [trials[i] for i in range(len(rngs))]


def sail(
    rng: np.random.Generator,
    effects: Sequence[str],
    plans: Sequence[Array],
    starts: Sequence[Array],
    *,
    size: float = 1.0,
    spread: float = 0.1,
    single: bool = False,
) -> Trial:
    """Sail planned commands twice with a ship that is drawn near Table 6.1.

    Parameters
    ----------
    rng : numpy.random.Generator
        All that is drawn follows from it.
    effects : sequence of str
        Ids of what is wrong, as in `draw`.
    plans : sequence of ndarray
        Of the estimation and of the validation log: (N, 4) n1, n2, alpha1, alpha2 [rad]
        wanted at each second. The actuators follow at their rates.
    starts : sequence of ndarray
        (4,) u, v [m/s], r [rad/s], ψ [rad] some seconds before each log begins.
    size : float
        Scales the effects.
    spread : float
        Largest relative distance of a parameter from Table 6.1.
    single : bool
        Both propellers run at one speed, in one column ``n``.

    Raises
    ------
    UsageError
        An effect does not exist, or the ship runs away.
    """
    conditions = Conditions(kind="pulses", single=single, samples=len(plans[0]))
    check_effects(tuple(effects), conditions.kind)
    draft = _Draft(int(rng.integers(2**62)), [])
    theta = _near_table(draft, spread)
    for plan, start in zip(plans, starts, strict=True):
        target = np.vstack([np.repeat(plan[:1], LEAD, axis=0), plan])
        seconds = len(target)
        still = np.zeros((seconds, 2))
        draft.ships.append(Ship(theta, steer(target), start, still, np.zeros((seconds, 3))))
    history = _sail([draft], conditions, step=1.0)
    if _bounded(history, _RUNAWAY)[0]:
        _disturb(draft, Order(tuple(effects), size), history, 0, conditions)
        history = _sail([draft], conditions)
        if _bounded(history, _RUNAWAY)[0]:
            return _logged(draft, history, 0, conditions)
    raise UsageError(
        f"the ship runs away on these commands with {', '.join(effects) or 'nothing wrong'}: "
        f"choose another seed or a smaller effect than {size:g}."
    )


def _near_table(draft: _Draft, spread: float) -> Array:
    factors = draft.rng(0, 0).uniform(1 - spread, 1 + spread, len(NAMES))
    return np.array([TRUE[n] for n in NAMES]) * factors


def _drafted(rng: np.random.Generator, conditions: Conditions) -> _Draft:
    draft = _Draft(int(rng.integers(2**62)), [])
    theta = _near_table(draft, 0.25)
    seconds = conditions.samples + LEAD
    for log in (1, 2):
        programme = KINDS[conditions.kind](draft.rng(log, 1), seconds, conditions.single)
        start = draft.rng(log, 2)
        surge = start.uniform(1.0, 2.0)
        # pulses never change the sign of sway: their ship drifts from the start
        sway = start.uniform(0.6, 1.2) if conditions.kind == "pulses" else 0.0
        state = np.array([surge, sway, 0.0, start.uniform(-np.pi, np.pi)])
        still = np.zeros((seconds, 2))
        draft.ships.append(Ship(theta, programme, state, still, np.zeros((seconds, 3))))
    return draft


def _disturb(
    draft: _Draft, order: Order, history: History, column: int, conditions: Conditions
) -> None:
    """Draw noises and effects, sized on the undisturbed motion of the estimation log."""
    motion = history.x[LEAD:, :3, column]
    u, v, r = np.sqrt((motion**2).mean(axis=0))
    typical = Typical(
        draft.ships[0].theta, u, v, r, motion[:, 0], history.commands[LEAD:, :, column]
    )
    own = draft.rng(0, 1)
    memory = own.uniform(10, 30) if conditions.colour == "memory" else 0.0
    gust, gust_memory = own.uniform(3, 5), own.uniform(10, 30)
    draft.effects = tuple(
        draw_effect(name, draft.rng(0, 2 + i), order.size, typical)
        for i, name in enumerate(order.effects)
    )
    for log, ship in enumerate(draft.ships, 1):
        seconds = len(ship.wind)
        process = gauss_markov(draft.rng(log, 3), seconds, 1.0, memory, 3)
        felt = np.zeros((seconds, 2))
        for effect in draft.effects:
            if effect.id == "wind":
                mean = np.array([effect.number("wind_north"), effect.number("wind_east")])
                felt += mean + gauss_markov(
                    draft.rng(log, 4), seconds, effect.number("turbulence"), 20.0
                )
        gusts = gauss_markov(draft.rng(log, 5), seconds, gust, gust_memory)
        ship = act(ship, draft.effects, later=log == 2 and not conditions.change_inside)
        draft.ships[log - 1] = replace(
            ship,
            wind=felt + conditions.gusts * (gusts - gusts.mean(axis=0)),
            process=conditions.process * PROCESS * process,
        )
        draft.felt.append(felt)


def _sail(drafts: Sequence[_Draft], conditions: Conditions, step: float = STEP) -> History:
    ships = [ship for draft in drafts for ship in draft.ships]
    return simulate_ships(ships, euler=conditions.euler, linear=conditions.linear, step=step)


def _bounded(history: History, bound: Array) -> list[bool]:
    """Return for each pair of ships whether both stayed inside."""
    inside = np.asarray((np.abs(history.x[:, :3]) <= bound[:, None]).all(axis=(0, 1)))
    return [bool(a and b) for a, b in zip(inside[::2], inside[1::2], strict=True)]


def _logged(draft: _Draft, history: History, column: int, conditions: Conditions) -> Trial:
    vessel = blind_vessel(conditions.single)
    anemometer = conditions.anemometer
    if anemometer is None:
        anemometer = any(e.id == "wind" for e in draft.effects)
    logs = []
    for log, name in ((1, "estimation"), (2, "validation")):
        channels = observe(
            history,
            column + log - 1,
            draft.felt[log - 1],
            draft.effects,
            LEAD,
            noise=conditions.noise,
            sensors=draft.rng(log, 6),
            sea=draft.rng(log, 7),
        )
        if conditions.single:
            channels["n"] = channels.pop("n1")
            channels.pop("n2")
        kept = wanted(channels, conditions.positions, anemometer)
        logs.append(make_log(vessel, kept, 1.0, name))
    ship = dict(zip(NAMES, map(float, draft.ships[0].theta), strict=True))
    return Trial(logs[0], logs[1], vessel, draft.effects, ship, conditions)


def write(trial: Trial, folder: str | Path) -> None:
    """Write vessel.toml, estimation.csv, validation.csv, and the truth apart in truth.json.

    Raises
    ------
    LogError
        The folder cannot be made.
    """
    folder = make_folder(folder)
    write_text(vessel_text(trial.conditions.single), folder / "vessel.toml")
    for log in (trial.estimation, trial.validation):
        write_log([log], folder / f"{log.name}.csv")
    truth = {
        "effects": [{"id": e.id, "parameters": dict(e.parameters)} for e in trial.truth],
        "ship": trial.ship,
        "conditions": asdict(trial.conditions),
    }
    write_json(truth, folder / "truth.json")
