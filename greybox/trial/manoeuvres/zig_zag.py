"""The zig-zag: overshoot angles, initial turning, reach, period, time to check yaw."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from greybox.errors import LogError, so_many
from greybox.notebook import DisplayMixin
from greybox.trial.manoeuvres.approach import first_notes, measure_approach
from greybox.trial.manoeuvres.local import crossing, fit_at, peak
from greybox.trial.manoeuvres.quantity import Quantity
from greybox.trial.manoeuvres.standards import (
    INITIAL_TURNING_LENGTHS,
    SHORTEST_SHIP,
    Criterion,
    as_text,
    check_limit,
    first_overshoot_limit,
    first_overshoot_limit_20,
    not_applicable,
    second_overshoot_limit,
)
from greybox.trial.manoeuvres.track import make_track, path_length
from greybox.trial.raw_log import Array

_TEN = math.radians(10)
_FIVE = math.radians(5)
# overshoots that the summary tells one by one, as the standard judges no others
_TOLD = 2
# how far rudder and heading may be from the nominal angles of a test [rad]
_RUDDER_NEAR, _HEADING_NEAR = math.radians(1.0), math.radians(1.6)


@dataclass(frozen=True, repr=False)
class ZigZag(DisplayMixin):
    """A zig-zag as it was measured; None where the log ends before it.

    Parameters
    ----------
    start, stop : float
        First execute, and end of the last rudder angle [s].
    direction : {1, -1}
        Of the first turn, 1 to starboard.
    length : float
        Of the ship [m].
    rudder : float or None
        Nominal angle [rad], None where no angle steers.
    heading : float
        Nominal heading at which it is reversed [rad].
    executes : tuple of float
        When the rudder was moved [s].
    approach_heading, approach_speed : Quantity
        [rad], [m/s]
    switch_headings : tuple of Quantity
        Heading from the original one, positive in the direction then turned,
        at each execute but the first [rad].
    overshoots : tuple of Quantity
        First, second, …: heading beyond that at the execute before [rad].
    check_times : tuple of Quantity
        From that execute to the greatest heading [s].
    initial_turning_time, initial_turning : Quantity or None
        Time [s] and distance along the track [m] from the first execute until the
        heading has changed by `initial_turning_angle`.
    initial_turning_angle : float
        10 degrees, or the heading at which the rudder is reversed where that is less [rad].
    reach : Quantity or None
        From the first execute until the heading is back at the original one [s].
    period : Quantity or None
        From the second execute to the fourth [s].
    criteria : tuple of Criterion
    notes : tuple of str

    References
    ----------
    IMO MSC.137(76), sections 4.2.5 to 4.2.9, 5.2 and 5.3; ITTC 7.5-04-02-01 (2017).
    """

    start: float
    stop: float
    direction: int
    length: float
    rudder: float | None
    heading: float
    executes: tuple[float, ...]
    approach_heading: Quantity
    approach_speed: Quantity
    switch_headings: tuple[Quantity, ...]
    overshoots: tuple[Quantity, ...]
    check_times: tuple[Quantity, ...]
    initial_turning_time: Quantity | None
    initial_turning: Quantity | None
    initial_turning_angle: float
    reach: Quantity | None
    period: Quantity | None
    criteria: tuple[Criterion, ...]
    notes: tuple[str, ...]

    @property
    def label(self) -> str:
        """What it is, in a few words."""
        side = "starboard" if self.direction > 0 else "port"
        if self.rudder is None:
            heading = f"{math.degrees(self.heading):.0f} deg of heading"
            return f"zig-zag by speeds, reversed at {heading}, first to {side}"
        angles = f"{math.degrees(self.rudder):.0f}/{math.degrees(self.heading):.0f}"
        return f"zig-zag {angles}, first to {side}"

    def summary(self) -> str:
        """Return the measured values, verdicts and notes as text."""
        where = (
            f"from {self.start:.1f} to {self.stop:.1f} s, {so_many(len(self.executes), 'execute')}"
        )
        rows: list[tuple[str, Quantity | None]] = [("approach speed", self.approach_speed)]
        checks = list(zip(self.overshoots, self.check_times, strict=True))
        # one more is told as they are, several by their range
        told = len(checks) if len(checks) == _TOLD + 1 else _TOLD
        for i, (angle, time) in enumerate(checks[:told]):
            rows += [(f"overshoot {i + 1}", angle), (f"  time to check {i + 1}", time)]
        change = f"{math.degrees(self.initial_turning_angle):.0f} deg"
        rows += [
            (f"time to {change}", self.initial_turning_time),
            (f"track to {change}", self.initial_turning),
            ("reach", self.reach),
            ("period", self.period),
        ]
        later = [math.degrees(angle.value) for angle, _ in checks[told:]]
        more = (
            [f"overshoots {told + 1} to {len(checks)}: {min(later):.1f} to {max(later):.1f} deg"]
            if later
            else []
        )
        notes = (*more, *self.notes)
        return as_text(f"{self.label}, {where}", rows, self.length, self.criteria, notes)


def measure_zigzag(
    t: Array,
    x_n: Array | None,
    y_n: Array | None,
    psi: Array,
    u: Array,
    v: Array,
    *,
    executes: Sequence[float],
    rudder: float,
    length: float,
    heading: float | None = None,
    stop: float | None = None,
    scale: float = 1.0,
    heading_std: float | None = None,
    position_std: float | None = None,
    start_std: float = 0.0,
) -> ZigZag:
    """Measure a zig-zag whose rudder was moved at known times.

    Parameters
    ----------
    t, x_n, y_n, psi, u, v, length, heading_std, position_std
        As `measure_turning_circle`.
    executes : sequence of float
        First, second, … execute [s], at least two.
    rudder : float
        Rudder angle [rad], any sign.
    heading : float, optional
        Change of heading at which the rudder was to be reversed [rad], any sign; that of the
        executes otherwise, which a quick ship may pass before the next sample.
    stop : float, optional
        When the last rudder angle ended [s]; the end of the log by default.
    scale : float
        Length of the full-scale ship over `length`: limits depend on L/V, which
        a model in Froude scale has smaller by its square root.
    start_std : float
        Standard error of each execute [s].

    Raises
    ------
    LogError
        Fewer than two executes, or one outside the log.
    """
    if len(executes) < 2:
        raise LogError(
            f"a zig-zag has at least 2 executes, {len(executes)} "
            f"{'was' if len(executes) == 1 else 'were'} given."
        )
    start = float(executes[0])
    stop = float(t[-1]) if stop is None else stop
    if not start < executes[-1] < stop <= t[-1]:
        raise LogError(
            f"the executes run from {start:g} to {executes[-1]:g} s and the zig-zag ends at "
            f"{stop:g} s, the log at {t[-1]:g} s: give times in this order."
        )
    approach = measure_approach(t, psi, u, v, start, length, heading_std=heading_std)
    track = make_track(t, x_n, y_n, psi, u, v, position_std=position_std, heading_std=heading_std)
    notes = first_notes("zig-zag", approach, track)
    ends = [*map(float, executes[1:]), stop]
    psi0 = approach.heading
    away = float(np.interp(executes[1], t, psi)) - psi0.value
    direction = 1 if away >= 0 else -1

    switch: list[Quantity] = []
    overshoots: list[Quantity] = []
    checks: list[Quantity] = []
    for i, time in enumerate(ends[:-1]):
        sign = direction if i % 2 == 0 else -direction
        before = time - executes[i]
        own = sign * (psi - psi0.value)
        here = fit_at(
            t, own, time, before, std=heading_std, side="before", bounds=(executes[i], time)
        )
        rate = here.value(time, 1)
        moved = rate * start_std
        switch.append(
            Quantity(
                here.value(time),
                math.sqrt(here.std(time) ** 2 + psi0.std**2 + moved**2),
                "rad",
                min(here.dof, psi0.dof),
            )
        )
        if len(overshoots) < i:
            continue
        # the last rudder angle may be held long after its peak
        swing = min(ends[i + 1] - time, 2 * before)
        top = peak(t, own, time, ends[i + 1], swing, std=heading_std)
        if top is None:
            continue
        when, fit = top
        error = math.sqrt(fit.std(when) ** 2 + here.std(time) ** 2 + moved**2)
        overshoots.append(
            Quantity(fit.value(when) - here.value(time), error, "rad", min(fit.dof, here.dof))
        )
        # the slope there is about zero, so the curvature's error enters in second order
        bend = fit.value(when, 2)
        share = math.sqrt(1 + 3 * (fit.std(when, 2) / bend) ** 2)
        slow = math.hypot(share * fit.std(when, 1) / abs(bend), start_std)
        checks.append(Quantity(when - time, slow, "s", fit.dof))

    # the angle that was meant: a multiple of 5 degrees where one is near
    nominal = _round(abs(rudder), _RUDDER_NEAR)
    reached = _nominal_heading([q.value for q in switch])
    heading = reached if heading is None else _round(abs(heading), _HEADING_NEAR)
    own = direction * (psi - psi0.value)
    quarter = ends[0] - start
    angle = min(_TEN, heading)
    limit_of_search = float(executes[2]) if len(executes) > 2 else stop
    turned = crossing(t, own, angle, start, limit_of_search, quarter, std=heading_std)
    turning_time = turning = None
    if turned is not None:
        when, fit = turned
        rate = fit.value(when, 1)
        std = math.hypot(fit.std(when), psi0.std) / rate
        turning_time = Quantity(when - start, math.hypot(std, start_std), "s", fit.dof)
        way = path_length(track, start, when, max(quarter, approach.duration(length)))
        along = approach.speed.value * math.hypot(std, start_std)
        turning = Quantity(way.value, math.hypot(way.std, along), "m", min(way.dof, fit.dof))
    back = crossing(t, -own, 0.0, ends[0], stop, quarter, std=heading_std)
    reach = None
    if back is not None:
        when, fit = back
        std = math.hypot(fit.std(when), psi0.std) / fit.value(when, 1)
        reach = Quantity(when - start, math.hypot(std, start_std), "s", fit.dof)
    period = None
    if len(executes) > 3:
        period = Quantity(float(executes[3] - executes[1]), math.sqrt(2) * start_std, "s")

    time_scale = length / approach.speed.value * math.sqrt(scale)
    criteria = _criteria(nominal, heading, overshoots, turning, length, time_scale)
    if length * scale < SHORTEST_SHIP and any(c.limit is not None for c in criteria):
        notes.append(
            f"the standard is for ships of {SHORTEST_SHIP:g} m and more, this one has "
            f"{length * scale:g} m; for a model give its scale, since the limits depend on L/V"
        )
    return ZigZag(
        start,
        stop,
        direction,
        length,
        nominal,
        heading,
        tuple(map(float, executes)),
        psi0,
        approach.speed,
        tuple(switch),
        tuple(overshoots),
        tuple(checks),
        turning_time,
        turning,
        angle,
        reach,
        period,
        criteria,
        tuple(notes),
    )


def without_angle(found: ZigZag) -> ZigZag:
    """Return a zig-zag that no angle steered: limits are for rudders."""
    told = (not_applicable("overshoot", "no angle steers"),)
    notes = tuple(n for n in found.notes if not n.startswith("the standard is for ships"))
    return replace(found, rudder=None, criteria=told, notes=notes)


def _nominal_heading(switch: Sequence[float]) -> float:
    """Return the heading at which the rudder is reversed, from those at all executes.

    The mean of the headings to both sides, so that an original heading that is
    a little off does not count.
    """
    sides = [np.mean(switch[0::2])] + ([np.mean(switch[1::2])] if len(switch) > 1 else [])
    return _round(float(np.mean(sides)), _HEADING_NEAR)


def _round(angle: float, near: float) -> float:
    multiple = max(1, round(angle / _FIVE)) * _FIVE
    return multiple if abs(angle - multiple) <= near else math.radians(round(math.degrees(angle)))


def _criteria(
    rudder: float,
    heading: float,
    overshoots: Sequence[Quantity],
    turning: Quantity | None,
    length: float,
    time_scale: float,
) -> tuple[Criterion, ...]:
    def is_near(angle: float, degrees: float) -> bool:
        return abs(math.degrees(angle) - degrees) < 0.5

    first, second = (overshoots[i] if len(overshoots) > i else None for i in (0, 1))
    made = []
    if is_near(rudder, 10) and math.degrees(heading) > 9.5:
        lengths = None if turning is None else turning.scaled(1 / length, "1")
        made.append(check_limit("initial turning", lengths, INITIAL_TURNING_LENGTHS))
    if is_near(rudder, 10) and is_near(heading, 10):
        why = f"L/V = {time_scale:.1f} s"
        made += [
            check_limit("first overshoot", first, first_overshoot_limit(time_scale), why),
            check_limit("second overshoot", second, second_overshoot_limit(time_scale), why),
        ]
    elif is_near(rudder, 20) and is_near(heading, 20):
        made.append(check_limit("first overshoot", first, first_overshoot_limit_20()))
    else:
        angles = f"{math.degrees(rudder):.0f}/{math.degrees(heading):.0f}"
        made.append(not_applicable("overshoot", f"there is no IMO limit for a {angles} zig-zag"))
    return tuple(made)
