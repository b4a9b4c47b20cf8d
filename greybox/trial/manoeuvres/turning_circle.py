"""The turning circle: advance, transfer, tactical diameter, and the steady turn."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from greybox.errors import LogError
from greybox.notebook import DisplayMixin
from greybox.rotation import ned_to_body
from greybox.trial.manoeuvres.approach import Approach, first_notes, measure_approach
from greybox.trial.manoeuvres.local import LocalFit, crossing, fit_at, noise_std, regress
from greybox.trial.manoeuvres.quantity import Quantity
from greybox.trial.manoeuvres.standards import (
    ADVANCE_LENGTHS,
    TACTICAL_LENGTHS,
    Criterion,
    as_text,
    check_limit,
    not_applicable,
)
from greybox.trial.manoeuvres.track import Track, make_track
from greybox.trial.raw_log import Array

# the standard's rudder angle, and how far an order may be from it
_STANDARD, _TOLERANCE = math.radians(35), math.radians(2.5)
# heading change after which a turn may be steady, and the least that is averaged
_STEADY_FROM, _STEADY_LEAST = math.pi, math.pi / 2
# heading range below which drift and circle cannot be told apart
_DRIFT_RANGE = math.radians(300)
# change of the yaw rate between the halves of a turn up to which it is steady, relative
_STEADY = 0.05
# change of the propellers' speed up to which they run on, relative
_SAME_SPEED = 0.01


@dataclass(frozen=True, repr=False)
class TurningCircle(DisplayMixin):
    """A turning circle as it was measured; None where the log ends before it.

    Parameters
    ----------
    start, stop : float
        When the turn was ordered, and ended [s].
    direction : {1, -1}
        1 to starboard.
    length : float
        Of the ship [m].
    rudder : float or None
        Steering angle in the direction of the turn, positive [rad].
    heading_change : float
        In the direction of the turn until `stop` [rad].
    approach_heading, approach_speed : Quantity
        [rad], [m/s]
    advance, transfer : Quantity or None
        When the heading has changed by 90 degrees, along and across the original heading,
        positive in the direction of the turn [m].
    tactical_diameter : Quantity or None
        Across, when it has changed by 180 degrees [m].
    time_90, time_180, time_360 : Quantity or None
        [s] from the order.
    final_diameter : Quantity or None
        Of the steady turn, drift of the whole circle taken off [m].
    yaw_rate, speed, drift_angle : Quantity or None
        Of the steady turn: clockwise positive [rad/s]; [m/s]; atan2(−v, u) [rad],
        positive where the bow points to starboard of the track.
    speed_loss : Quantity or None
        Share of the approach speed that is lost in the steady turn.
    set_north, set_east : Quantity or None
        Velocity with which the circle drifts over ground [m/s].
    criteria : tuple of Criterion
    notes : tuple of str
        What limits the measurement, one sentence each.
    yaw_rate_change : float or None
        Of the steady turn, from its first half to its second, relative.
    propellers : (float, float) or None
        Their mean speed over the ship length before the order and in the second half of the
        turn, in the unit of the log; None where none is logged.

    References
    ----------
    IMO MSC.137(76), sections 4.2.2 to 4.2.4 and 5.1; ITTC 7.5-04-02-01 (2017).
    """

    start: float
    stop: float
    direction: int
    length: float
    rudder: float | None
    heading_change: float
    approach_heading: Quantity
    approach_speed: Quantity
    advance: Quantity | None
    transfer: Quantity | None
    tactical_diameter: Quantity | None
    time_90: Quantity | None
    time_180: Quantity | None
    time_360: Quantity | None
    final_diameter: Quantity | None
    yaw_rate: Quantity | None
    speed: Quantity | None
    drift_angle: Quantity | None
    speed_loss: Quantity | None
    set_north: Quantity | None
    set_east: Quantity | None
    criteria: tuple[Criterion, ...]
    notes: tuple[str, ...]
    yaw_rate_change: float | None = None
    propellers: tuple[float, float] | None = None

    @property
    def slowed(self) -> str:
        """What is to be said of a speed loss that is not of the turn alone; empty of others."""
        if self.speed_loss is None or self.propellers is None:
            return ""
        before, after = self.propellers
        if abs(after - before) <= _SAME_SPEED * abs(before):
            return ""
        return (
            f"the propellers run at {before:.3g} before the order and at {after:.3g} in the turn: "
            f"the speed loss holds what that change does, not the turn alone"
        )

    @property
    def unsteady(self) -> str:
        """What is to be said of a turn that does not become steady; empty of one that does."""
        return _unsteady(self.yaw_rate_change)

    @property
    def label(self) -> str:
        """What it is, in a few words."""
        side = "starboard" if self.direction > 0 else "port"
        angle = "" if self.rudder is None else f" at {math.degrees(self.rudder):.0f} deg rudder"
        return f"turning circle to {side}{angle}"

    def summary(self) -> str:
        """Return the measured values, verdicts and notes as text."""
        rows = (
            ("approach speed", self.approach_speed),
            ("advance", self.advance),
            ("transfer", self.transfer),
            ("tactical diameter", self.tactical_diameter),
            ("time to 90 deg", self.time_90),
            ("time to 180 deg", self.time_180),
            ("time to 360 deg", self.time_360),
            ("final diameter", self.final_diameter),
            ("steady yaw rate", self.yaw_rate),
            ("steady speed", self.speed),
            ("steady drift angle", self.drift_angle),
            ("speed loss", self.speed_loss),
            ("set to north", self.set_north),
            ("set to east", self.set_east),
        )
        head = (
            f"{self.label}, from {self.start:.1f} to {self.stop:.1f} s, "
            f"{math.degrees(self.heading_change):.0f} deg of heading"
        )
        return as_text(head, rows, self.length, self.criteria, self.notes)


@dataclass(frozen=True)
class _SteadyTurn:
    yaw_rate: Quantity
    diameter: Quantity
    speed: Quantity
    drift_angle: Quantity
    set_north: Quantity | None
    set_east: Quantity | None
    notes: tuple[str, ...]
    yaw_rate_change: float


def _unsteady(change: float | None) -> str:
    if change is None or change <= _STEADY:
        return ""
    return (
        f"the yaw rate changes by {100 * change:.0f} % between the halves of the "
        f"steady turn: it is not steady, or wind or current moves it"
    )


def measure_turning_circle(
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
    rudder: float | None = None,
    full_rudder: float | None = None,
    heading_std: float | None = None,
    position_std: float | None = None,
    start_std: float = 0.0,
) -> TurningCircle:
    """Measure a turning circle that was ordered at a known time.

    Parameters
    ----------
    t : ndarray
        (N,) time, increasing, even or not [s].
    x_n, y_n : ndarray or None
        (N,) position of the body origin over ground [m]; integrated from the
        velocities where absent, which the notes then say.
    psi : ndarray
        (N,) heading, unwrapped [rad].
    u, v : ndarray
        (N,) velocity over ground, body axes [m/s].
    start : float
        When the turn was ordered [s].
    length : float
        Of the ship [m].
    stop : float, optional
        When the turn ended [s]; the end of the log by default.
    rudder : float, optional
        Steering angle [rad], any sign; None where the vessel has none.
    full_rudder : float, optional
        Greatest angle that the vessel allows [rad]: the standard takes it for 35 degrees.
    heading_std, position_std : float, optional
        Known noise of one sample [rad], [m]; taken from the log otherwise.
    start_std : float
        Standard error of `start` [s].

    Raises
    ------
    LogError
        `start` is outside the log, or the heading does not change.
    """
    approach = measure_approach(t, psi, u, v, start, length, heading_std=heading_std)
    track = make_track(t, x_n, y_n, psi, u, v, position_std=position_std, heading_std=heading_std)
    stop = float(t[-1]) if stop is None else stop
    inside = (t >= start) & (t <= stop)
    if inside.sum() < 2:
        raise LogError(f"the turn from {start:g} to {stop:g} s holds no samples: widen it.")
    turned = psi[inside] - approach.heading.value
    direction = 1 if turned[int(np.argmax(np.abs(turned)))] > 0 else -1
    turned = direction * turned
    notes = first_notes("turn", approach, track)
    own = direction * (psi - approach.heading.value)
    scale = approach.duration(length)
    quarter = crossing(t, own, math.pi / 2, start, stop, scale, std=heading_std)
    if quarter is not None:
        scale = max(quarter[0] - start, 1e-9)
    half = crossing(t, own, math.pi, start, stop, scale, std=heading_std)
    frame = _frame(track, approach, start, scale, direction, start_std)
    full = crossing(t, own, 2 * math.pi, start, stop, scale, std=heading_std)
    (advance, transfer, time_90), (_, tactical, time_180), (_, _, time_360) = (
        (None, None, None) if found is None else _at(frame, approach, found, scale, start_std)
        for found in (quarter, half, full)
    )
    steady = _steady(t, psi, own, u, v, track, start, stop, heading_std)
    loss = None
    if steady is not None:
        notes += steady.notes
        ratio = steady.speed.value / approach.speed.value
        error = math.hypot(steady.speed.std, ratio * approach.speed.std) / approach.speed.value
        loss = Quantity(1 - ratio, error, "1", min(steady.speed.dof, approach.speed.dof))
    return TurningCircle(
        start,
        stop,
        direction,
        length,
        None if rudder is None else abs(rudder),
        float(np.max(turned)),
        approach.heading,
        approach.speed,
        advance,
        transfer,
        tactical,
        time_90,
        time_180,
        time_360,
        steady.diameter if steady else None,
        steady.yaw_rate if steady else None,
        steady.speed if steady else None,
        steady.drift_angle if steady else None,
        loss,
        steady.set_north if steady else None,
        steady.set_east if steady else None,
        _criteria(advance, tactical, length, rudder, full_rudder),
        tuple(notes),
        steady.yaw_rate_change if steady else None,
    )


def _criteria(
    advance: Quantity | None,
    tactical: Quantity | None,
    length: float,
    rudder: float | None,
    full_rudder: float | None,
) -> tuple[Criterion, ...]:
    names = ("advance", "tactical diameter")
    if rudder is None:
        return tuple(not_applicable(n, "the log has no rudder angle") for n in names)
    wanted = _STANDARD if full_rudder is None else min(_STANDARD, full_rudder)
    if abs(rudder) < wanted - _TOLERANCE:
        reason = (
            f"the rudder was at {math.degrees(abs(rudder)):.0f} deg and the limit is "
            f"for {math.degrees(wanted):.0f} deg"
        )
        return tuple(not_applicable(n, reason) for n in names)
    limits = (ADVANCE_LENGTHS, TACTICAL_LENGTHS)
    return tuple(
        check_limit(n, None if q is None else q.scaled(1 / length, "1"), limit)
        for n, q, limit in zip(names, (advance, tactical), limits, strict=True)
    )


@dataclass(frozen=True)
class _Frame:
    """The track from where the turn was ordered, along and across the original heading."""

    track: Track
    along: Array
    across: Array
    start: float
    var_along: float
    var_across: float
    dof: float


def _frame(
    track: Track, approach: Approach, start: float, scale: float, direction: int, start_std: float
) -> _Frame:
    along, starboard = ned_to_body(track.x_n, track.y_n, approach.heading.value)
    across = direction * starboard
    # the origin is where the ship was at the order: an error of that time moves it along
    fits = [fit_at(track.t, y, start, scale, std=track.std) for y in (along, across)]
    variances = [f.std(start) ** 2 + (f.value(start, 1) * start_std) ** 2 for f in fits]
    a0, b0 = (f.value(start) for f in fits)
    dof = min(f.dof for f in fits)
    return _Frame(track, along - a0, across - b0, start, variances[0], variances[1], dof)


def _at(
    frame: _Frame,
    approach: Approach,
    found: tuple[float, LocalFit],
    scale: float,
    start_std: float,
) -> tuple[Quantity, Quantity, Quantity]:
    """Return along, across and time where the heading has changed by an angle."""
    time, heading = found
    rate = heading.value(time, 1)
    std_time = heading.std(time) / rate
    fits = [
        fit_at(frame.track.t, y, time, scale, std=frame.track.std)
        for y in (frame.along, frame.across)
    ]
    along, across = (f.value(time) for f in fits)
    # an error of the original heading turns the axes and moves the crossing at once
    turning = (across, -along)
    made = []
    dof = min(frame.dof, heading.dof, approach.heading.dof)
    walk = frame.track.walk * (time - frame.start)
    for fit, value, start_variance, turn in zip(
        fits, (along, across), (frame.var_along, frame.var_across), turning, strict=True
    ):
        slope = fit.value(time, 1)
        variance = (
            fit.std(time) ** 2
            + start_variance
            + walk
            + (slope * std_time) ** 2
            + ((turn + slope / rate) * approach.heading.std) ** 2
        )
        made.append(Quantity(value, math.sqrt(variance), "m", min(dof, fit.dof)))
    error = math.sqrt(std_time**2 + (approach.heading.std / rate) ** 2 + start_std**2)
    elapsed = Quantity(time - frame.start, error, "s", min(heading.dof, approach.heading.dof))
    return made[0], made[1], elapsed


def _steady(
    t: Array,
    psi: Array,
    own: Array,
    surge: Array,
    sway: Array,
    track: Track,
    start: float,
    stop: float,
    heading_std: float | None,
) -> _SteadyTurn | None:
    """Measure the last full circle, or what there is of it past 180 degrees."""
    inside = np.flatnonzero((t >= start) & (t <= stop))
    total = float(own[inside][-3:].mean())
    least = max(_STEADY_FROM, total - 2 * math.pi)
    if total - least < _STEADY_LEAST:
        return None
    late = own[inside] >= least
    # the last sample below the angle, since noise lets single ones pass earlier
    first = int(np.flatnonzero(~late)[-1]) + 1 if (~late).any() else 0
    k = inside[first:]
    if len(k) < 10:
        return None
    notes = []
    x = t[k] - t[k].mean()
    ones = np.ones_like(x)
    slope, covariance, dof, _ = regress(np.column_stack([ones, x]), psi[k], heading_std)
    rate = Quantity(float(slope[1]), math.sqrt(float(covariance[1, 1])), "rad/s", dof)
    halves = [
        np.polyfit(x[part], psi[k][part], 1)[0] for part in np.array_split(np.arange(len(x)), 2)
    ]
    change = abs(halves[1] - halves[0]) / abs(rate.value)
    spread = float(own[k[-1]] - own[k[0]])
    if spread < _DRIFT_RANGE:
        notes.append(
            f"the steady turn is measured over {math.degrees(spread):.0f} deg: "
            f"a drift of the circle cannot be told from it"
        )
    if _unsteady(change):
        notes.append(_unsteady(change))
    # position = p0 + d t + R(psi) w: with constant body velocity the origin stays at w from
    # the centre of the circle, which drifts with d
    c, s = np.cos(psi[k]), np.sin(psi[k])
    zero = np.zeros_like(x)
    north, east = [ones, zero, c, -s], [zero, ones, s, c]
    if spread >= _DRIFT_RANGE:
        north += [x, zero]
        east += [zero, x]
    # north after east, not sample by sample: neighbours in the residual are neighbours in time
    design = np.concatenate([np.column_stack(north), np.column_stack(east)])
    place = np.concatenate([track.x_n[k], track.y_n[k]])
    found, spread_of, free, _ = regress(design, place, track.std)
    # noise of the heading in cos and sin shrinks the arm by exp(−σ²/2)
    noise = noise_std(t[k], psi[k]) if heading_std is None else heading_std
    arm = found[2:4] * math.exp(noise**2 / 2)
    part = spread_of[2:4, 2:4]
    radius = math.hypot(*arm)
    toward = arm / max(radius, 1e-12)
    radius_std = math.sqrt(max(0.0, float(toward @ part @ toward)))
    diameter = Quantity(2 * radius, 2 * radius_std, "m", free)
    speed = abs(rate.value) * radius
    speed_std = math.hypot(rate.value * radius_std, radius * rate.std)
    # velocity of the body is r × w: u = −r w₂, v = r w₁
    u, v = -rate.value * arm[1], rate.value * arm[0]
    around = np.array([-toward[1], toward[0]])
    angle_std = math.sqrt(max(0.0, float(around @ part @ around))) / max(radius, 1e-12)
    angle_std = math.hypot(angle_std, math.sqrt(covariance[0, 0]))
    drift = Quantity(math.atan2(-v, u), angle_std, "rad", min(free, dof))
    way = Quantity(speed, speed_std, "m/s", min(free, dof))
    if track.integrated:
        # the track was made of the velocities, and its errors add up: their means do not
        way, drift = _mean_velocity(surge[k], sway[k])
        error = 2 * math.hypot(way.std, way.value * rate.std / abs(rate.value)) / abs(rate.value)
        diameter = Quantity(2 * way.value / abs(rate.value), error, "m", min(way.dof, dof))
    sets: list[Quantity | None] = [None, None]
    if spread >= _DRIFT_RANGE:
        walk = track.walk / float(t[k[-1]] - t[k[0]])
        sets = [
            Quantity(float(found[i]), math.sqrt(float(spread_of[i, i]) + walk), "m/s", free)
            for i in (4, 5)
        ]
    return _SteadyTurn(
        rate,
        diameter,
        way,
        drift,
        sets[0],
        sets[1],
        tuple(notes),
        float(change),
    )


def _mean_velocity(surge: Array, sway: Array) -> tuple[Quantity, Quantity]:
    """Return speed and drift angle of the mean velocity over a whole turn."""
    ones = np.ones((len(surge), 1))
    (u, var_u, dof_u, _), (v, var_v, dof_v, _) = (regress(ones, y) for y in (surge, sway))
    along, across = float(u[0]), float(v[0])
    speed, dof = math.hypot(along, across), min(dof_u, dof_v)
    a, b = float(var_u[0, 0]), float(var_v[0, 0])
    std = math.sqrt(along**2 * a + across**2 * b) / speed
    angle = math.sqrt(across**2 * a + along**2 * b) / speed**2
    return (
        Quantity(speed, std, "m/s", dof),
        Quantity(math.atan2(-across, along), angle, "rad", dof),
    )
