"""How a vessel is steered and propelled: from one steering order to its thruster commands."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from greybox.errors import UsageError, suggestion
from greybox.trial.manoeuvres.steering import propelling
from greybox.vessel.vessel import Limits, Vessel

Array = NDArray[np.float64]
Steering = Literal["rudder", "azimuth", "difference", "tunnel", "none"]

# share of a limit by which a file may have rounded it, such as 35 degrees to 0.61 rad
ROUNDED = 2e-3
# least share of its thrust that a propelling thruster gives along the ship
_ALONG = 0.5


@dataclass(frozen=True)
class Helm:
    """Which commands steer the vessel and which propel it.

    Parameters
    ----------
    kind : {"rudder", "azimuth", "difference", "tunnel", "none"}
    columns : tuple of str
        All commands, in the order of `Vessel.commands`.
    steer : ndarray
        (nc,) change of each command with the steering order: angles [rad per rad],
        speeds of a differential by their own speed, of tunnel thrusters in their unit.
    drive : ndarray
        (nc,) propeller speed of each command at throttle 1; 0 for what does not propel.
    limits : tuple of Limits
        Of each command.
    angle_per_order : float
        The steering angle that `steering_angle` finds in a log, per steering order.
    """

    kind: Steering
    columns: tuple[str, ...]
    steer: Array
    drive: Array
    limits: tuple[Limits, ...]
    angle_per_order: float = 1.0

    @property
    def steering_columns(self) -> tuple[str, ...]:
        """Commands that move with the steering order."""
        return tuple(c for c, s in zip(self.columns, self.steer, strict=True) if s != 0)

    @property
    def sentence(self) -> str:
        """What steers, in words."""
        names = " and ".join(self.steering_columns)
        how = {
            "rudder": f"steered by the rudder angle {names}",
            "azimuth": f"steered by turning {names}, the other azimuths straight ahead",
            "difference": f"steered by a difference of the speeds {names}",
            "tunnel": f"steered by the speed of the tunnel thrusters {names}",
            "none": "not steered",
        }[self.kind]
        return f"{how}, {self.propulsion}"

    @property
    def propulsion(self) -> str:
        """What drives, in words."""
        driving = [c for c, s in zip(self.columns, self.drive, strict=True) if s != 0]
        return f"propelled by {' and '.join(driving)}" if driving else "without propulsion"

    @property
    def angular(self) -> bool:
        """Whether the steering order is an angle [rad]."""
        return self.kind in ("rudder", "azimuth")

    @property
    def greatest(self) -> float | None:
        """Greatest steering order that the limits allow to both sides, None without limits."""
        if self.kind == "difference":
            return 1.0
        reach = [
            min(-low.lower, low.upper) / abs(s)
            for s, low in zip(self.steer, self.limits, strict=True)
            if s != 0 and low.lower is not None and low.upper is not None
        ]
        return min(reach, default=None)

    def free(self) -> Helm:
        """Return the helm without limits and rates."""
        return replace(self, limits=(Limits(),) * len(self.limits))

    def commands(self, throttle: Array, order: Array | float) -> Array:
        """Return the commands (nc, R) at throttles (R,) and steering orders (R,)."""
        speed = self.drive[:, None] * throttle
        order = np.broadcast_to(np.asarray(order, float), throttle.shape)
        if self.kind == "difference":
            return np.asarray(speed * (1 + self.steer[:, None] * order))
        return np.asarray(speed + self.steer[:, None] * order)

    def outside(self, commands: Array, tolerance: float = 1e-9) -> NDArray[np.bool_]:
        """Return which commands (nc, ...) are outside their limits."""
        low, high = bounds(self.limits)
        shape = (-1,) + (1,) * (commands.ndim - 1)
        slack = tolerance * np.maximum(1.0, np.abs(commands))
        return np.asarray(
            (commands < low.reshape(shape) - slack) | (commands > high.reshape(shape) + slack)
        )

    def room(self, commands: Array) -> Array:
        """Return what each command (nc, R) may be multiplied with before it leaves its limits."""
        low, high = (b[:, None] for b in bounds(self.limits))
        with np.errstate(divide="ignore", invalid="ignore"):
            towards = np.where(commands > 0, high / commands, low / commands)
        return np.asarray(np.where(commands == 0, math.inf, towards))


def bounds(limits: Sequence[Limits]) -> tuple[Array, Array]:
    """Return lower and upper limits (nc,), infinite where none is stated."""
    low = np.array([-math.inf if x.lower is None else x.lower for x in limits])
    high = np.array([math.inf if x.upper is None else x.upper for x in limits])
    return low, high


def find_helm(vessel: Vessel, thrusters: Sequence[str] = (), *, limited: bool = True) -> Helm:
    """Tell how a vessel is steered and propelled.

    Rudders steer where there are any; else azimuth thrusters behind the origin (all, where
    none is), turned so that their thrust turns the bow; else the speeds of fixed thrusters
    on either side; else tunnel thrusters. All propellers that can push ahead propel, at one
    share of their greatest speed where that is stated for all, at one speed otherwise.

    Parameters
    ----------
    vessel : Vessel
    thrusters : sequence of str
        Columns that steer instead: rudders, azimuth angles, or speeds.
    limited : bool
        Whether commands keep the ranges of the vessel file; rates hold anyway.

    Raises
    ------
    UsageError
        A column is none of the vessel's, or those named steer in different ways.
    """
    columns = vessel.commands
    ways = _ways(vessel)
    for name in thrusters:
        if name not in columns:
            raise UsageError(
                f"--thrusters names '{name}', which is no command of {vessel.name}."
                f"{suggestion(name, columns)} It has: {', '.join(columns)}."
            )
    kind: Steering = "none"
    chosen: dict[str, float] = {}
    for way, signs in ways.items():
        if not signs or kind != "none":
            continue
        if thrusters:
            if not set(thrusters) & set(signs):
                continue
            wrong = [n for n in thrusters if n not in signs]
            if wrong:
                raise UsageError(
                    f"--thrusters names {thrusters[0]} and {wrong[0]}, which steer in different "
                    f"ways: name rudders, azimuth angles, or speeds, of one kind."
                )
            chosen = {n: signs[n] for n in thrusters}
        else:
            chosen = _usual(vessel, way, signs)
        kind = way
    if thrusters and kind == "none":
        raise UsageError(
            f"--thrusters names {', '.join(thrusters)}, which cannot steer {vessel.name}: it is "
            f"steered by {', '.join(n for s in ways.values() for n in s) or 'nothing'}."
        )
    stated = vessel.limits
    limits = tuple(stated[c] if limited else Limits(rate=stated[c].rate) for c in columns)
    steer = np.array([chosen.get(c, 0.0) for c in columns])
    angle_per_order = len(chosen) / max(len(ways["azimuth"]), 1) if kind == "azimuth" else 1.0
    return Helm(kind, columns, steer, _drive(vessel, columns), limits, angle_per_order)


def _ways(vessel: Vessel) -> dict[Steering, dict[str, float]]:
    """Return by kind which columns can steer, with the sign that turns to starboard."""
    rudders: dict[str, float] = {}
    azimuths: dict[str, float] = {}
    sides: dict[str, float] = {}
    tunnels: dict[str, float] = {}
    for t in vessel.thrusters:
        if t.rudder is not None:
            rudders[t.rudder] = 1.0
        elif isinstance(t.angle, str):
            _put(azimuths, t.angle, 1.0 if t.x > 0 else -1.0)
        elif t.type == "tunnel":
            _put(tunnels, t.speed, math.copysign(1.0, t.x * math.sin(t.angle)) if t.x else 0.0)
        elif abs(math.cos(t.angle)) > _ALONG and t.y != 0:
            _put(sides, t.speed, -math.copysign(1.0, t.y))
    balanced = {1.0, -1.0} <= set(sides.values())
    return {
        "rudder": rudders,
        "azimuth": {n: s for n, s in azimuths.items() if s},
        "difference": {n: s for n, s in sides.items() if s} if balanced else {},
        "tunnel": {n: s for n, s in tunnels.items() if s},
    }


def _put(signs: dict[str, float], name: str, sign: float) -> None:
    # one column that turns the ship both ways steers neither
    signs[name] = sign if signs.get(name, sign) == sign else 0.0


def _usual(vessel: Vessel, way: Steering, signs: Mapping[str, float]) -> dict[str, float]:
    if way != "azimuth":
        return dict(signs)
    aft = {t.angle for t in vessel.thrusters if isinstance(t.angle, str) and t.x < 0}
    return {n: s for n, s in signs.items() if n in aft} or dict(signs)


def _drive(vessel: Vessel, columns: Sequence[str]) -> Array:
    speeds = propelling(vessel)
    greatest = {n: vessel.limits[n].upper for n in speeds}
    stated = all(g is not None and g > 0 for g in greatest.values())
    return np.array(
        [speeds.get(c, 0.0) * ((greatest[c] or 1.0) if stated and c in speeds else 1.0)
         for c in columns]
    )  # fmt: skip
