"""Causes that a blind trial may have: each with its range, and what it does to the ship.

Causes that lie in the sensors act in `greybox.study.blind_sensors`; here they are
only drawn. Sizes are drawn from a range; `size` scales them towards no effect.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.study.blind_inputs import RATES
from greybox.study.blind_ship import EXTRA, LEAD, NAMES, Ship
from greybox.vessel.thrust import typical_speed

Array = NDArray[np.float64]
Value = float | str
# the commands, in the order of a ship's programme
COLUMNS = ("n1", "n2", "alpha1", "alpha2")
# names of parameters that hold a place
_PLACED = re.compile(r"(?:gain|rate|offset|clock)_(.+)|(.+)_factor|([XYN]_.+)")


@dataclass(frozen=True)
class Effect:
    """One thing that is wrong: its id and parameters [SI, rad], those of the causes by name."""

    id: str
    parameters: Mapping[str, Value]

    def number(self, name: str) -> float:
        """Return a parameter that is a number."""
        return float(self.parameters[name])

    @property
    def places(self) -> frozenset[str]:
        """Its actuators, coefficients or channel; empty where the id tells all."""
        if "channel" in self.parameters:
            return frozenset({str(self.parameters["channel"])})
        found = [_PLACED.fullmatch(name) for name in self.parameters]
        return frozenset(m[m.lastindex or 0] for m in found if m)


@dataclass(frozen=True)
class Typical:
    """The undisturbed motion of the estimation trial that sizes are relative to.

    Parameters
    ----------
    theta : ndarray
        (18,) in the order of `NAMES`.
    u, v, r : float
        Root mean squares [m/s, rad/s].
    surge : ndarray
        (N,) [m/s]
    commands : ndarray
        (N, 4) n1, n2, alpha1, alpha2 [rad].
    """

    theta: Array
    u: float
    v: float
    r: float
    surge: Array
    commands: Array

    def value(self, name: str) -> float:
        """Return a parameter of the ship."""
        return float(self.theta[NAMES.index(name)])


Draw = Callable[[np.random.Generator, float, Typical], dict[str, Value]]
Act = Callable[[Ship, Effect, bool], Ship]


def keep(ship: Ship, effect: Effect, later: bool) -> Ship:
    """Leave the ship as it is."""
    return ship


@dataclass(frozen=True)
class Kind:
    """How an effect is drawn, and how it changes the ship."""

    draw: Draw
    act: Act = keep


def setting(**fields: str | tuple[str, ...]) -> Act:
    """Return what gives fields of the ship the effect's parameters, one or several, of a name."""

    def act(ship: Ship, effect: Effect, later: bool) -> Ship:
        given: dict[str, Any] = {
            field: effect.number(n) if isinstance(n, str) else tuple(map(effect.number, n))
            for field, n in fields.items()
        }
        return replace(ship, **given)

    return act


def _signed(rng: np.random.Generator, low: float, high: float) -> float:
    return float(rng.choice([-1.0, 1.0]) * rng.uniform(low, high))


def uniform(name: str, low: float, high: float) -> Draw:
    """Return how one parameter is drawn from a range."""
    return lambda rng, size, typical: {name: size * rng.uniform(low, high)}


def _current(rng: np.random.Generator, size: float, typical: Typical) -> dict[str, Value]:
    speed, towards = size * rng.uniform(0.2, 0.45), rng.uniform(0, 2 * np.pi)
    return {"current_north": speed * np.cos(towards), "current_east": speed * np.sin(towards)}


def _wind(rng: np.random.Generator, size: float, typical: Typical) -> dict[str, Value]:
    speed, towards = size * rng.uniform(6, 12), rng.uniform(0, 2 * np.pi)
    return {
        "wind_north": speed * np.cos(towards),
        "wind_east": speed * np.sin(towards),
        "turbulence": size * rng.uniform(0.5, 1.0),
        **{name: typical.value(name) for name in ("Wuu", "Wvv", "Wuv")},
    }


def _gain(rng: np.random.Generator, size: float, typical: Typical) -> dict[str, Value]:
    return {f"gain_n{rng.integers(1, 3)}": 1 - size * (1 - rng.uniform(0.6, 0.8))}


def _weak(ship: Ship, effect: Effect, later: bool) -> Ship:
    one, two = (float(effect.parameters.get(f"gain_n{i}", 1.0)) for i in (1, 2))
    return replace(ship, gain=(one, two))


def _lag(rng: np.random.Generator, size: float, typical: Typical) -> dict[str, Value]:
    return {"lag": size * rng.uniform(4, 9), "variant": str(rng.choice(["speed", "force"]))}


def _lagged(ship: Ship, effect: Effect, later: bool) -> Ship:
    lag = effect.number("lag")
    if effect.parameters["variant"] == "speed":
        return replace(ship, speed_lag=lag)
    return replace(ship, force_lag=lag)


def _delay(rng: np.random.Generator, size: float, typical: Typical) -> dict[str, Value]:
    # a multiple of the simulator's step
    return {"delay": round(size * rng.uniform(3, 7), 1)}


def _with_own(ship: Ship, field: str, column: str, value: float) -> Ship:
    """Return the ship with one command that acts otherwise than the others."""
    own = list(getattr(ship, field))
    own[COLUMNS.index(column)] = value
    changed: dict[str, Any] = {field: tuple(own)}
    return replace(ship, **changed)


def _rate(rng: np.random.Generator, size: float, typical: Typical) -> dict[str, Value]:
    column = int(rng.integers(2, 4))
    # so many times as slow as the command that is logged
    return {f"rate_{COLUMNS[column]}": float(RATES[column]) / (1 + size * rng.uniform(2, 5))}


def _rate_limited(ship: Ship, effect: Effect, later: bool) -> Ship:
    ((name, rate),) = effect.parameters.items()
    return _with_own(ship, "own_rate", name.removeprefix("rate_"), float(rate))


def _unheld(rng: np.random.Generator, size: float, typical: Typical) -> dict[str, Value]:
    return {"interpolated": float(size > 0)}


def _quadratic(rng: np.random.Generator, size: float, typical: Typical) -> dict[str, Value]:
    # the share is counted at the propellers' typical speed, as the cause counts it
    reference = float(np.mean([typical_speed([n]) for n in typical.commands[:, :2].T]))
    return {"quadratic_share": size, "reference": reference}


def _relative(*names: str) -> Draw:
    """Size one of several damping terms against the linear one at the typical motion."""

    def draw(rng: np.random.Generator, size: float, typical: Typical) -> dict[str, Value]:
        u, v, r = typical.u, typical.v, typical.r
        # linear force over the new term's regressor, at the typical motion
        scale = {
            "X_uuu": typical.value("Xu") / u**2,
            "Y_vvv": typical.value("Yv") / v**2,
            "N_rrr": typical.value("Nr") / r**2,
            "N_|r|r": typical.value("Nr") / r,
            "Y_|r|r": typical.value("Yv") * v / r**2,
            "Y_|r|v": typical.value("Yv") / r,
            # turning to starboard the ship drifts to port: this sign damps the turn
            "N_|r|v": -typical.value("Nr") / v,
        }
        name = str(rng.choice(names))
        return {name: size * rng.uniform(0.3, 1.0) * scale[name]}

    return draw


def _aside(rng: np.random.Generator, size: float, typical: Typical) -> dict[str, Value]:
    # shares of what damps the sway and the turn
    side, turn = (size * _signed(rng, 0.1, 0.3) for _ in range(2))
    return {
        "Y_0": side * typical.value("Yv") * typical.v,
        "N_0": turn * typical.value("Nr") * typical.r,
    }


def _coupled(rng: np.random.Generator, size: float, typical: Typical) -> dict[str, Value]:
    # shares of what damps the sway and the turn
    side, turn = (size * _signed(rng, 0.3, 0.6) for _ in range(2))
    return {
        "Y_r": side * typical.value("Yv") * typical.v / typical.r,
        "N_v": turn * typical.value("Nr") * typical.r / typical.v,
    }


def _uneven(rng: np.random.Generator, size: float, typical: Typical) -> dict[str, Value]:
    side, turn = (size * _signed(rng, 0.2, 0.5) for _ in range(2))
    # along the thrust that holds the typical speed, or along its square
    thrust = -typical.value("Xu") * typical.u / typical.value("Xmu")
    of, scale = [("taux", thrust), ("|u|u", typical.u**2)][int(rng.integers(2))]
    return {
        f"Y_{of}": side * typical.value("Yv") * typical.v / scale,
        f"N_{of}": turn * typical.value("Nr") * typical.r / scale,
    }


def with_terms(ship: Ship, effect: Effect, later: bool) -> Ship:
    """Add terms to the ship's equations."""
    return replace(ship, extra=tuple(float(effect.parameters.get(n, 0.0)) for n in EXTRA))


def _heading_bias(rng: np.random.Generator, size: float, typical: Typical) -> dict[str, Value]:
    bias = size * np.radians(_signed(rng, 4, 9))
    return {"heading_bias": bias, "variant": str(rng.choice(["body", "earth"]))}


def _lever_arm(rng: np.random.Generator, size: float, typical: Typical) -> dict[str, Value]:
    arm, towards = size * rng.uniform(4, 12), rng.uniform(0, 2 * np.pi)
    return {
        "lever_arm_x": arm * np.cos(towards),
        "lever_arm_y": arm * np.sin(towards),
        "variant": str(rng.choice(["positions", "antenna"])),
    }


def _angle_offset(rng: np.random.Generator, size: float, typical: Typical) -> dict[str, Value]:
    return {f"offset_alpha{rng.integers(1, 3)}": size * np.radians(_signed(rng, 5, 10))}


def _clock(rng: np.random.Generator, size: float, typical: Typical) -> dict[str, Value]:
    return {f"clock_{rng.choice(['u', 'v', 'r', 'psi'])}": size * rng.uniform(2, 5)}


def _change(rng: np.random.Generator, size: float, typical: Typical) -> dict[str, Value]:
    name = str(rng.choice(["Xu", "Yv", "Nr", "Xuu", "Yvv", "Yvr", "Nvr"]))
    return {
        f"{name}_factor": 1 + size * (rng.uniform(1.5, 3.0) - 1),
        f"{name}_time": float(np.round(rng.uniform(0.3, 0.7) * len(typical.commands))),
    }


def _changed(ship: Ship, effect: Effect, later: bool) -> Ship:
    (name,) = (n[:-7] for n in effect.parameters if n.endswith("_factor"))
    # a change that came to stay holds from the first step
    since = 0.0 if later else LEAD + effect.number(f"{name}_time")
    return replace(ship, change=(NAMES.index(name), effect.number(f"{name}_factor"), since))


def _waves(rng: np.random.Generator, size: float, typical: Typical) -> dict[str, Value]:
    return {"frequency": rng.uniform(0.06, 0.12), "ratio": 3 * size}


def _sign(rng: np.random.Generator, size: float, typical: Typical) -> dict[str, Value]:
    return {"channel": str(rng.choice(["alpha1", "alpha2", "r"]))}


CAUSES: dict[str, Kind] = {
    "current": Kind(_current, setting(current=("current_north", "current_east"))),
    "wind": Kind(_wind),
    "thruster_gain": Kind(_gain, _weak),
    "thruster_lag": Kind(_lag, _lagged),
    "input_delay": Kind(_delay, setting(delay="delay")),
    "rate_limit": Kind(_rate, _rate_limited),
    "feedback_sampling": Kind(_unheld, setting(moving="interpolated")),
    "quadratic_thrust": Kind(
        _quadratic, setting(quadratic="quadratic_share", reference="reference")
    ),
    "advance_speed": Kind(uniform("loss", 0.04, 0.12), setting(advance="loss")),
    "cubic_damping": Kind(_relative("X_uuu", "Y_vvv", "N_rrr"), with_terms),
    "quadratic_yaw_damping": Kind(_relative("N_|r|r"), with_terms),
    "crossflow": Kind(_relative("Y_|r|r", "Y_|r|v", "N_|r|v"), with_terms),
    "side_force": Kind(_aside, with_terms),
    "inertia_coupling": Kind(_coupled, with_terms),
    "asymmetry": Kind(_uneven, with_terms),
    "heading_bias": Kind(_heading_bias),
    "lever_arm": Kind(_lever_arm),
    "angle_offset": Kind(_angle_offset),
    "clock_offset": Kind(_clock),
    "parameter_change": Kind(_change, _changed),
    "waves": Kind(_waves),
    "sign": Kind(_sign),
}


def _of_one(draw: Draw, field: str, name: str, column: str) -> Kind:
    def act(ship: Ship, effect: Effect, later: bool) -> Ship:
        return _with_own(ship, field, column, effect.number(name))

    return Kind(draw, act)


# lag and delay of one command, by the id and place that a diagnosis tells
OF_ONE: dict[str, Kind] = {
    f"{cause}:{column}": _of_one(draw, field, name, column)
    for cause, draw, field, name in (
        ("thruster_lag", uniform("lag", 4, 9), "own_lag", "lag"),
        ("input_delay", _delay, "own_delay", "delay"),
    )
    for column in COLUMNS
}
