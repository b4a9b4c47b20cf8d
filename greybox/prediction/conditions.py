"""The request for a prediction, and the manoeuvres that follow from it for a vessel."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from greybox.errors import UsageError, so_many, suggestion
from greybox.model.model import ManoeuvringModel
from greybox.prediction.helm import ROUNDED, Helm, bounds
from greybox.prediction.result import Kind, Side

# steering angle of a turning circle where the limits allow it, and the two zig-zags [rad]
_TURN = math.radians(35)
_ZIGZAGS = (math.radians(10), math.radians(20))
# share by which speeds differ, and of a tunnel thruster's greatest speed, unless asked otherwise
_DIFFERENCE, _TUNNEL = 0.5, 1.0
# share of the approach speed at which a ship without thrust counts as stopped: it never stands
_UNTIL = 0.2
FEWEST_DRAWS = 40


@dataclass(frozen=True)
class Conditions:
    """Orders, approach and limits of the manoeuvres to predict, and how many draws.

    Parameters
    ----------
    angles : tuple of (float, float or None)
        Steering angle, and the heading of a zig-zag [rad].
    side : {"port", "starboard", ""}
        Both where empty.
    speed : float, optional
        Approach speed over ground [m/s].
    command : mapping of str to float
        Propeller speeds instead; the key ``""`` stands for all that propel.
    thrusters : tuple of str
        Columns that steer.
    share : float, optional
        By which speeds differ, or of a tunnel thruster's greatest speed.
    astern : float, optional
        Propeller speed of a crash stop, positive.
    until : float, optional
        Share of the approach speed at which a stop ends.
    limited : bool
        Whether commands keep the ranges of the vessel file.
    current : bool
        Whether the model's disturbance means act.
    course : float
        Heading of the approach [rad].
    disturbed : bool
        Whether draws hold the model's process noise too.
    scale : float
        Length of the full-scale ship over that of the vessel.
    draws, seed : int
    """

    angles: tuple[tuple[float, float | None], ...] = ()
    side: Side = ""
    speed: float | None = None
    command: Mapping[str, float] = field(default_factory=dict)
    thrusters: tuple[str, ...] = ()
    share: float | None = None
    astern: float | None = None
    until: float | None = None
    limited: bool = True
    current: bool = False
    course: float = 0.0
    disturbed: bool = False
    scale: float = 1.0
    draws: int = 256
    seed: int = 0


@dataclass(frozen=True)
class Task:
    """One manoeuvre to sail.

    Parameters
    ----------
    side : {"port", "starboard", ""}
    order : float or None
        Steering order, positive [rad, or as `Helm.steer` takes it].
    heading : float or None
        At which a zig-zag is reversed [rad].
    speed : float or None
        Approach speed, None for the propeller speeds of the helm [m/s].
    course : float
        [rad]
    """

    side: Side
    order: float | None
    heading: float | None
    speed: float | None
    course: float

    @property
    def sign(self) -> float:
        """1 to starboard, −1 to port."""
        return -1.0 if self.side == "port" else 1.0


def check(kind: Kind, model: ManoeuvringModel, asked: Conditions) -> None:
    """Refuse conditions that the model or its vessel cannot meet.

    Raises
    ------
    UsageError
        The sentence names both sides of the contradiction.
    """
    states = model.structure.states
    lacking = [s for s in (("u", "v", "r") if kind in ("turning", "zigzag") else ("u",))
               if s not in states]  # fmt: skip
    if lacking:
        raise UsageError(
            f"the structure '{model.structure.name}' has the states {', '.join(states)}, and a "
            f"{kind} manoeuvre needs {lacking[0]} too: estimate another structure."
        )
    if asked.draws < FEWEST_DRAWS:
        raise UsageError(
            f"{so_many(asked.draws, 'draw', 'is', 'are')} too few for limits of 95 %: ask for "
            f"{FEWEST_DRAWS} or more."
        )
    if asked.speed is not None and asked.command:
        raise UsageError(
            "--speed and --command are both given, and each determines the other: give one."
        )
    stops = kind in ("stopping", "crash")
    for name, given in (("--side", asked.side), ("--angle", asked.angles), ("--share", asked.share),
                        ("--thrusters", asked.thrusters)):  # fmt: skip
        if stops and given:
            raise UsageError(
                f"{name} belongs to turning and zigzag; '{kind}' is sailed straight: leave it out."
            )
    for name, value, where in (
        ("--until", asked.until, stops),
        ("--astern", asked.astern, kind == "crash"),
    ):
        if value is not None and not where:
            raise UsageError(
                f"{name} belongs to {'stopping and crash' if name == '--until' else 'crash'}, "
                f"not to {kind}: leave it out."
            )
    if asked.until is not None and not 0 <= asked.until < 1:
        raise UsageError(
            f"--until is {asked.until:g}, it is a share of the approach speed: give 0 to below 1."
        )
    if kind == "turning" and any(h is not None for _, h in asked.angles):
        raise UsageError(
            "a turning circle has one angle, such as --angle 35; two belong to zigzag."
        )


def driven(kind: Kind, helm: Helm, model: ManoeuvringModel, asked: Conditions) -> Helm:
    """Return the helm whose propeller speeds at throttle 1 are those asked for.

    By default they are the greatest of the logs that the model was estimated on, within the
    limits, and so much less that a difference which steers keeps the limits too.

    Raises
    ------
    UsageError
        A speed is none of the vessel's, or is out of its limits; or nothing tells one.
    """
    if asked.speed is not None:
        return helm
    given = dict(asked.command)
    moved = [n for n, d in zip(helm.columns, helm.drive, strict=True) if d != 0]
    if not given:
        given = _usual(helm, model, moved)
        if kind in ("turning", "zigzag") and helm.kind == "difference":
            less = _room_to_steer(helm, given, speed_order(helm, asked))
            given = {n: v * less for n, v in given.items()}
    if "" in given:
        common = given.pop("")
        ahead = {n: math.copysign(1.0, helm.drive[helm.columns.index(n)]) for n in moved}
        given = {n: common * way for n, way in ahead.items()} | given
    speeds = [n for n in helm.columns if n not in model.vessel.angle_commands]
    for name in given:
        if name not in speeds:
            raise UsageError(
                f"--command names '{name}', which is no propeller speed of {model.vessel.name}."
                f"{suggestion(name, speeds)} It has: {', '.join(speeds)}."
            )
    drive = np.array([given.get(n, 0.0) for n in helm.columns])
    outside = helm.outside(drive) & (drive != 0)
    for i in np.flatnonzero(outside):
        low, high = (b[i] for b in bounds(helm.limits))
        raise UsageError(
            f"--command asks {helm.columns[i]} = {drive[i]:g}, and the vessel file keeps it from "
            f"{low:g} to {high:g}: stay within, or give --no-limits."
        )
    return replace(helm, drive=drive)


def _usual(helm: Helm, model: ManoeuvringModel, moved: Sequence[str]) -> dict[str, float]:
    """Return the greatest speeds in common of the model's logs, or of the vessel file."""
    ranges = model.record.get("ranges", {})
    # also where limits are not kept: no ship is faster than her engines
    low, high = bounds([model.vessel.limits[c] for c in helm.columns])
    throttle = math.inf
    for name in moved:
        i = helm.columns.index(name)
        drive = helm.drive[i]
        most = max(e / drive for e in ranges[name]) if name in ranges else math.inf
        most = min(most, max(low[i] / drive, high[i] / drive))
        if not math.isfinite(most) or most <= 0:
            raise UsageError(
                f"neither the model's logs nor the vessel file tell a speed of {name} ahead: "
                f"give --speed in m/s, or --command in the unit of {name}."
            )
        throttle = min(throttle, most)
    return {n: throttle * float(helm.drive[helm.columns.index(n)]) for n in moved}


def _room_to_steer(helm: Helm, given: Mapping[str, float], order: float) -> float:
    """Return the share of the given speeds at which an order to either side keeps the limits."""
    driven = replace(helm, drive=np.array([given.get(n, 0.0) for n in helm.columns]))
    ordered = driven.commands(np.ones(2), np.array([order, -order]))
    return float(min(1.0, helm.room(ordered).min()))


def tasks(kind: Kind, helm: Helm, model: ManoeuvringModel, asked: Conditions) -> list[Task]:
    """Return the manoeuvres that were asked for.

    Raises
    ------
    UsageError
        The vessel cannot be steered so, or the angle is beyond its limits.
    """
    if kind in ("stopping", "crash"):
        return [Task("", None, None, asked.speed, asked.course)]
    sides: tuple[Side, ...] = (asked.side,) if asked.side else ("starboard", "port")
    return [
        Task(side, order, heading, asked.speed, asked.course)
        for order, heading in _orders(kind, helm, model, asked)
        for side in sides
    ]


def _orders(
    kind: Kind, helm: Helm, model: ManoeuvringModel, asked: Conditions
) -> list[tuple[float, float | None]]:
    if helm.kind == "none":
        raise UsageError(
            f"{model.vessel.name} has nothing to steer with: no rudder, no azimuth, no fixed "
            f"thrusters on both sides, no tunnel thruster. Add it to the vessel file."
        )
    headings: list[float | None] = [None]
    if kind == "zigzag":
        headings = [h if h is not None else a for a, h in asked.angles] or list(_ZIGZAGS)
    if not helm.angular:
        order = speed_order(helm, asked)
        if kind == "turning" and asked.angles:
            raise UsageError(
                f"--angle is {math.degrees(asked.angles[0][0]):g} deg, but {model.vessel.name} is "
                f"{helm.sentence.split(',')[0]}: give --share instead."
            )
        return [(order, h) for h in headings]
    if asked.share is not None:
        raise UsageError(
            f"--share is {asked.share:g}, but {model.vessel.name} is "
            f"{helm.sentence.split(',')[0]}: give --angle instead."
        )
    greatest = math.inf if helm.greatest is None else helm.greatest
    if kind == "turning":
        found: list[tuple[float, float | None]] = [(a, None) for a, _ in asked.angles]
        found = found or [(min(_TURN, greatest), None)]
    else:
        usual = [(a, None) for a in _ZIGZAGS if a <= greatest * (1 + ROUNDED)] or [
            (_ZIGZAGS[0], None)
        ]
        found = [(a, a if h is None else h) for a, h in asked.angles or usual]
    for order, _ in found:
        if order > greatest * (1 + ROUNDED):
            names = " and ".join(helm.steering_columns)
            raise UsageError(
                f"an angle of {math.degrees(order):g} deg is beyond the limits of {names}, which "
                f"allow {math.degrees(greatest):g} deg to both sides: give a smaller --angle, or "
                f"--no-limits."
            )
    return found


def speed_order(helm: Helm, asked: Conditions) -> float:
    """Return the steering order of a vessel that speeds steer.

    Raises
    ------
    UsageError
        The share is out of range, or a tunnel thruster has no limits to take it of.
    """
    share = asked.share
    if share is None:
        share = _DIFFERENCE if helm.kind == "difference" else _TUNNEL
    if not 0 < share <= 1:
        raise UsageError(f"--share is {share:g}, a number above 0 and up to 1 is needed.")
    if helm.kind == "difference":
        return share
    if helm.greatest is None:
        raise UsageError(
            f"--share is of the greatest speed of {' and '.join(helm.steering_columns)}, and the "
            f"vessel file states none: add speed_limits."
        )
    return share * helm.greatest


def stop_throttle(kind: Kind, helm: Helm, asked: Conditions) -> float:
    """Return the throttle of a stop: zero, or full astern.

    Raises
    ------
    UsageError
        The limits do not allow it, or state no speed astern.
    """
    low, high = bounds(helm.limits)
    moved = helm.drive != 0
    names = ", ".join(np.array(helm.columns)[moved])
    ends = np.sort([low[moved] / helm.drive[moved], high[moved] / helm.drive[moved]], axis=0)
    least = float(ends[0].max())
    if kind == "stopping":
        if least > 0:
            raise UsageError(
                f"a stop without thrust needs {names} at 0, and the vessel file keeps it at "
                f"{low[moved].max():g} or more: correct the limits, or give --no-limits."
            )
        return 0.0
    if asked.astern is not None:
        throttle = -asked.astern / float(np.abs(helm.drive[moved]).max())
        if throttle < least * (1 + 1e-9):
            raise UsageError(
                f"--astern is {asked.astern:g}, and the vessel file allows {names} down to "
                f"{low[moved].max():g}: give less, or --no-limits."
            )
        return throttle
    if math.isinf(least):
        raise UsageError(
            f"the vessel file states no least speed of {names}, so full astern is unknown: add "
            f"speed_limits and estimate again, or give --astern in the unit of {names}."
        )
    if least >= 0:
        raise UsageError(
            f"the vessel file keeps {names} at {low[moved].max():g} or more, so it cannot run "
            f"astern: correct the limits, or give --astern with --no-limits."
        )
    return least


def stop_speed(kind: Kind, asked: Conditions) -> float:
    """Return the share of the approach speed at which a stop ends."""
    return asked.until if asked.until is not None else _UNTIL if kind == "stopping" else 0.0
