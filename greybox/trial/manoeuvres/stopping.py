"""The stopping trial: track reach, head reach, lateral deviation, time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from greybox.notebook import DisplayMixin
from greybox.rotation import ned_to_body
from greybox.trial.manoeuvres.approach import first_notes, measure_approach
from greybox.trial.manoeuvres.local import crossing, fit_at
from greybox.trial.manoeuvres.quantity import Quantity
from greybox.trial.manoeuvres.standards import (
    TRACK_REACH_AT_MOST,
    TRACK_REACH_LENGTHS,
    Criterion,
    as_text,
    check_limit,
    not_applicable,
)
from greybox.trial.manoeuvres.track import make_track, path_length
from greybox.trial.raw_log import Array


@dataclass(frozen=True, repr=False)
class Stopping(DisplayMixin):
    """A stop as it was measured; None where the ship still moves when the log ends.

    Parameters
    ----------
    start, stop : float
        When the stop was ordered, and when it ended [s].
    length : float
        Of the ship [m].
    reversed : bool
        Whether the thrust was reversed, else it was only taken off.
    approach_heading, approach_speed : Quantity
        [rad], [m/s]
    time : Quantity or None
        From the order until the surge velocity is zero, or that asked for [s].
    track_reach : Quantity or None
        Distance along the track [m].
    head_reach, lateral_deviation : Quantity or None
        Distance along the original heading, and across it, to starboard positive [m].
    heading_change : Quantity or None
        Clockwise positive [rad].
    criteria : tuple of Criterion
    notes : tuple of str
    last_speed : float or None
        Surge velocity with which the ship still moves ahead when the log ends [m/s].

    References
    ----------
    IMO MSC.137(76), sections 4.2.10, 4.2.11 and 5.4.
    """

    start: float
    stop: float
    length: float
    reversed: bool
    approach_heading: Quantity
    approach_speed: Quantity
    time: Quantity | None
    track_reach: Quantity | None
    head_reach: Quantity | None
    lateral_deviation: Quantity | None
    heading_change: Quantity | None
    criteria: tuple[Criterion, ...]
    notes: tuple[str, ...]
    last_speed: float | None = None

    @property
    def unfinished(self) -> str:
        """What is to be said of a ship that has not stopped; empty of one that has."""
        return _unfinished(self.last_speed)

    @property
    def label(self) -> str:
        """What it is, in a few words."""
        return "stop with reversed thrust" if self.reversed else "stop without thrust"

    def summary(self) -> str:
        """Return the measured values, verdicts and notes as text."""
        rows = (
            ("approach speed", self.approach_speed),
            ("track reach", self.track_reach),
            ("head reach", self.head_reach),
            ("lateral deviation", self.lateral_deviation),
            ("time", self.time),
            ("heading change", self.heading_change),
        )
        head = f"{self.label}, from {self.start:.1f} to {self.stop:.1f} s"
        return as_text(head, rows, self.length, self.criteria, self.notes)


def _unfinished(speed: float | None) -> str:
    if speed is None:
        return ""
    return f"the ship still moves ahead with {speed:.2g} m/s when the log ends"


def measure_stopping(
    t: Array,
    x_n: Array | None,
    y_n: Array | None,
    psi: Array,
    u: Array,
    v: Array,
    *,
    start: float,
    length: float,
    stop: float | None = None,
    reversed_thrust: bool = True,
    end_speed: float = 0.0,
    heading_std: float | None = None,
    position_std: float | None = None,
    start_std: float = 0.0,
) -> Stopping:
    """Measure a stop that was ordered at a known time.

    Parameters
    ----------
    t, x_n, y_n, psi, u, v, length, heading_std, position_std
        As `measure_turning_circle`.
    start : float
        When the stop was ordered [s].
    stop : float, optional
        Until when the ship may come to rest [s]; the end of the log by default.
    reversed_thrust : bool
        Whether the thrust was reversed: the limit is for full astern.
    end_speed : float
        Surge velocity at which the ship counts as stopped [m/s].
    start_std : float
        Standard error of `start` [s].

    Raises
    ------
    LogError
        `start` is outside the log.
    """
    approach = measure_approach(t, psi, u, v, start, length, heading_std=heading_std)
    track = make_track(t, x_n, y_n, psi, u, v, position_std=position_std, heading_std=heading_std)
    stop = float(t[-1]) if stop is None else stop
    notes = first_notes("stop", approach, track)
    psi0 = approach.heading
    time = reach = head = lateral = turned = last = None
    run = approach.duration(length)
    rest = crossing(t, -u, -end_speed, start, stop, run)
    if rest is not None:
        scale = max((rest[0] - start) / 4, 1e-9)
        rest = crossing(t, -u, -end_speed, start, stop, scale)
    if rest is None:
        last = float(np.mean(u[(t <= stop)][-5:]))
        notes.append(_unfinished(last))
    else:
        when, fit = rest
        slow = fit.std(when) / fit.value(when, 1)
        time = Quantity(when - start, math.hypot(slow, start_std), "s", fit.dof)
        lost = approach.speed.value * start_std
        way = path_length(track, start, when, scale)
        reach = Quantity(way.value, math.hypot(way.std, lost), "m", way.dof)
        along, across = ned_to_body(track.x_n, track.y_n, psi0.value)
        ends = []
        walk = track.walk * (when - start)
        for y in (along, across):
            one, two = (fit_at(t, y, at, scale, std=track.std) for at in (start, when))
            variance = (
                one.std(start) ** 2
                + two.std(when) ** 2
                + (two.value(when, 1) * slow) ** 2
                + (one.value(start, 1) * start_std) ** 2
                + walk
            )
            ends.append((two.value(when) - one.value(start), variance, min(one.dof, two.dof)))
        (a, var_a, dof_a), (b, var_b, dof_b) = ends
        head = Quantity(a, math.sqrt(var_a + (b * psi0.std) ** 2), "m", min(dof_a, psi0.dof))
        lateral = Quantity(b, math.sqrt(var_b + (a * psi0.std) ** 2), "m", min(dof_b, psi0.dof))
        own = fit_at(t, psi, when, scale, std=heading_std)
        error = math.sqrt(own.std(when) ** 2 + psi0.std**2 + (own.value(when, 1) * slow) ** 2)
        turned = Quantity(own.value(when) - psi0.value, error, "rad", min(own.dof, psi0.dof))
        stop = when
    if reversed_thrust:
        lengths = None if reach is None else reach.scaled(1 / length, "1")
        why = f"up to {TRACK_REACH_AT_MOST:g} L where the administration allows it"
        criteria = (check_limit("track reach", lengths, TRACK_REACH_LENGTHS, why),)
    else:
        criteria = (not_applicable("track reach", "the thrust was not reversed"),)
    return Stopping(
        start,
        stop,
        length,
        reversed_thrust,
        psi0,
        approach.speed,
        time,
        reach,
        head,
        lateral,
        turned,
        criteria,
        tuple(notes),
        last,
    )
