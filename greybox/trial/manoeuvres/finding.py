"""Finding the standard manoeuvres in a log."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from greybox.errors import LogError
from greybox.trial.gaps import runs
from greybox.trial.log import TrialLog
from greybox.trial.manoeuvres.local import noise_std
from greybox.trial.manoeuvres.steering import (
    Held,
    held_angles,
    propelling,
    sideways,
    speed_difference,
    steering_angle,
)
from greybox.trial.manoeuvres.stopping import Stopping, measure_stopping
from greybox.trial.manoeuvres.track import without_antenna
from greybox.trial.manoeuvres.turning_circle import TurningCircle, measure_turning_circle
from greybox.trial.manoeuvres.zig_zag import ZigZag, measure_zigzag, without_angle
from greybox.trial.raw_log import Array

Manoeuvre = TurningCircle | ZigZag | Stopping

# least steering angle of a manoeuvre [rad]
_SMALLEST = math.radians(3)
# ship lengths sailed within which an angle must be held to count
_HELD_LENGTHS = 0.3
# shares of the manoeuvre's own rudder angle and yaw rate that an approach may have
_APPROACH_RUDDER, _APPROACH_RATE = 0.35, 0.25
# ship lengths of the approach, where the log holds them, and the heading swept in them [rad]
_APPROACH_LENGTHS, _APPROACH_SWEEP = 2.0, math.radians(10)
# how much rudder angles, and headings at executes, may differ within one zig-zag
_RUDDER_SPREAD, _HEADING_SPREAD = 0.12, 0.3
_RUDDER_SLACK, _HEADING_SLACK = math.radians(1.0), math.radians(1.5)
# heading change of a turning circle, and of one without a logged order or approach [rad]
_TURN, _TURN_UNSEEN = math.pi, 1.9 * math.pi
# share of the approach thrust that a stop leaves, and by which thrust may vary otherwise
_THRUST_OFF, _THRUST_VARIES = 0.1, 0.3
_WRONG_WAY = (
    "the rudder turns the ship against its sign: positive must be to starboard (vessel file)"
)


@dataclass(frozen=True)
class _Signals:
    """The arrays of a log that manoeuvres are measured from."""

    t: Array
    x_n: Array | None
    y_n: Array | None
    psi: Array
    u: Array
    v: Array
    length: float
    ship_time: float
    heading_std: float
    position_std: float | None
    start_std: float

    @property
    def arrays(self) -> tuple[Array, Array | None, Array | None, Array, Array, Array]:
        return self.t, self.x_n, self.y_n, self.psi, self.u, self.v

    @property
    def known(self) -> dict[str, Any]:
        """What is known of ship and sensors: arguments of every measurement."""
        return {
            "length": self.length,
            "heading_std": self.heading_std,
            "position_std": self.position_std,
        }

    def rate(self, start: float, stop: float) -> float:
        """Return the mean yaw rate between two times [rad/s]."""
        first = int(np.searchsorted(self.t, start))
        end = int(np.searchsorted(self.t, stop, side="right"))
        if end - first < 3:
            first, end = max(0, first - 3), end + 3
        x = self.t[first:end] - self.t[first:end].mean()
        return float(x @ self.psi[first:end] / (x @ x))

    def heading(self, time: float) -> float:
        """Return the heading, averaged over a tenth of the time for one ship length [rad]."""
        half = self.ship_time / 20
        k = np.flatnonzero(np.abs(self.t - time) <= half)
        if len(k) < 3:
            return float(np.interp(time, self.t, self.psi))
        return float(np.polyfit(self.t[k] - time, self.psi[k], 1)[1])


def find_manoeuvres(log: TrialLog, *, scale: float = 1.0) -> tuple[Manoeuvre, ...]:
    """Find turning circles, zig-zags and stops in a log, and measure them.

    A turning circle is one steering angle held from a straight approach through
    180 degrees of heading or more; a zig-zag is alternate equal angles with the
    rudder reversed at equal headings to both sides; a stop is thrust taken off or
    reversed on a straight approach until the ship stands. A vessel without
    rudder or azimuth thrusters is searched for turning circles by its yaw rate,
    for zig-zags by the difference of speeds on either side, and for stops.

    Parameters
    ----------
    log : TrialLog
        With psi, u and v; the vessel's thruster columns and positions where there
        are any. Positions are those of the vessel file's antenna.
    scale : float
        Length of the full-scale ship over that of the vessel, for the limits of a model.

    Returns
    -------
    tuple of TurningCircle, ZigZag or Stopping
        In the order in which they start; they do not overlap.

    Raises
    ------
    LogError
        psi, u or v is missing.
    """
    for name in ("psi", "u", "v"):
        if name not in log:
            raise LogError(
                f"log '{log.name}' has no '{name}', which manoeuvres are measured from: "
                f"map its column in the vessel file."
            )
    signals = _signals(log)
    if signals is None:
        return ()
    found: list[Manoeuvre] = []
    steering = steering_angle(log)
    if steering is None:
        zigzags = list(_zigzags_by_speeds(log, signals, scale))
        found += zigzags
        found += _beside(_turns_by_yaw_rate(log, signals), zigzags)
    else:
        angle, greatest = steering
        opposed = sideways(log)
        held = tuple(
            h
            for h in held_angles(log.t, angle, _HELD_LENGTHS * signals.ship_time)
            if not opposed[h.first : h.last + 1].any()
        )
        # thrusters that oppose one another are not amidships, whatever their mean
        angle = np.where(opposed, math.pi / 2, angle)
        rudder = any(t.rudder is not None for t in log.vessel.thrusters)
        zigzags = list(_zigzags(signals, angle, held, scale, rudder))
        found += zigzags
        found += _beside(_turns(log, signals, angle, held, greatest, rudder), zigzags)
    found += _beside(_stops(log, signals), found)
    told = (_with_propellers(m, log) for m in _of_antenna(found, log))
    return tuple(sorted(told, key=lambda m: m.start))


def _beside(found: Iterable[Manoeuvre], others: Sequence[Manoeuvre]) -> list[Manoeuvre]:
    """Return the manoeuvres that overlap with none of others."""
    return [m for m in found if not any(o.start < m.stop and m.start < o.stop for o in others)]


def _of_antenna(found: Sequence[Manoeuvre], log: TrialLog) -> Iterator[Manoeuvre]:
    """Note where turns are those of an antenna that the vessel file does not place."""
    unplaced = log.provenance.velocities_derived and "antenna" not in log.vessel.sensors
    for m in found:
        if unplaced and isinstance(m, TurningCircle):
            note = (
                "u and v were made of what the antenna measures, and the vessel file does not say "
                "where it is: track, speed and drift angle are those of the antenna"
            )
            if m.yaw_rate is not None and m.speed is not None:
                turned = math.degrees(abs(m.yaw_rate.value) / m.speed.value)
                note += f", whose drift angle is {turned:.2g} deg larger for each metre abaft"
            m = replace(m, notes=(*m.notes, f"{note} (add antenna = [x, y] to [sensors])"))
        yield m


def _with_propellers(found: Manoeuvre, log: TrialLog) -> Manoeuvre:
    """Return a turn with the speeds of the propellers before and in it, others as they are."""
    driving = {n: sign for n, sign in propelling(log.vessel).items() if n in log}
    if not isinstance(found, TurningCircle) or not driving:
        return found
    run = found.length / max(found.approach_speed.value, 1e-9)
    before = (log.t >= found.start - run) & (log.t < found.start)
    late = (log.t >= (found.start + found.stop) / 2) & (log.t <= found.stop)
    if not before.any():
        return found
    first, last = (
        float(np.mean([sign * np.median(log[n][part]) for n, sign in driving.items()]))
        for part in (before, late)
    )
    found = replace(found, propellers=(first, last))
    return replace(found, notes=(*found.notes, found.slowed)) if found.slowed else found


def _signals(log: TrialLog) -> _Signals | None:
    t, psi, u, v = log.t, log["psi"], log["u"], log["v"]
    if len(t) < 20:
        return None
    speed = float(np.quantile(np.hypot(u, v), 0.8))
    if speed <= 0:
        return None
    x_n = y_n = None
    if "x_n" in log and "y_n" in log:
        antenna = log.vessel.sensors.get("antenna", (0.0, 0.0))
        x_n, y_n = without_antenna(log["x_n"], log["y_n"], psi, antenna)
    heading_std = log.vessel.std("psi")
    step = float(np.median(np.diff(t)))
    return _Signals(
        t,
        x_n,
        y_n,
        psi,
        u,
        v,
        log.vessel.length,
        log.vessel.length / speed,
        noise_std(t, psi) if heading_std is None else heading_std,
        log.vessel.std("position"),
        step / math.sqrt(12),
    )


def _approach_is_straight(
    signals: _Signals, angle: Array, execute: float, level: float, rate: float
) -> bool:
    """Whether the helm was about amidships and the ship went straight before the order."""
    before = np.flatnonzero(
        (signals.t >= execute - signals.ship_time) & (signals.t < execute - signals.start_std)
    )
    if len(before) < 3:
        ahead = execute + signals.ship_time / 10
        return abs(signals.rate(execute, ahead)) <= 2 * _APPROACH_RATE * abs(rate)
    amidships = abs(float(angle[before].mean())) <= _APPROACH_RUDDER * abs(level)
    straight = abs(signals.rate(execute - signals.ship_time, execute)) <= _APPROACH_RATE * abs(rate)
    # among random orders the ship goes straight for a moment, but not for ship lengths
    run = (signals.t >= execute - _APPROACH_LENGTHS * signals.ship_time) & (signals.t < execute)
    sweep = float(np.ptp(signals.psi[run])) <= _APPROACH_SWEEP + 6 * signals.heading_std
    return amidships and straight and sweep


def _zigzags(
    signals: _Signals, angle: Array, held: Sequence[Held], scale: float, rudder: bool
) -> Iterator[ZigZag]:
    i = 0
    while i < len(held):
        run = _alternate(signals, angle, held, i)
        zigzag = _zigzag(signals, angle, run, scale, rudder) if len(run) > 2 else None
        if zigzag is None:
            i += 1
            continue
        yield zigzag
        i += len(run)


def _zigzags_by_speeds(log: TrialLog, signals: _Signals, scale: float) -> Iterator[ZigZag]:
    """Find zig-zags of a vessel that speeds on either side steer."""
    share = speed_difference(log)
    if share is not None:
        held = held_angles(log.t, share, _HELD_LENGTHS * signals.ship_time)
        for found in _zigzags(signals, share, held, scale, rudder=False):
            yield without_angle(found)


def _alternate(signals: _Signals, angle: Array, held: Sequence[Held], i: int) -> list[Held]:
    """Return the held angles from `i` on that are equal, to alternate sides."""
    run = [held[i]]
    if abs(run[0].level) < _SMALLEST:
        return run
    for following in held[i + 1 :]:
        last = run[-1]
        mean = float(np.mean([abs(h.level) for h in run]))
        near = abs(abs(following.level) - mean) <= max(_RUDDER_SLACK, _RUDDER_SPREAD * mean)
        way = angle[last.last : following.first + 1]
        direct = float(np.abs(way).max()) <= 1.3 * mean + _RUDDER_SLACK
        # the helm does not stop on its way: it would be another order
        quick = signals.t[following.first] - following.execute <= 2 * signals.ship_time
        prompt = following.execute - signals.t[last.last] <= signals.ship_time
        if following.level * last.level >= 0 or not (near and direct and quick and prompt):
            break
        run.append(following)
    return run


def _zigzag(
    signals: _Signals, angle: Array, run: Sequence[Held], scale: float, rudder: bool
) -> ZigZag | None:
    executes = [h.execute for h in run]
    if np.any(np.diff(executes) <= 0):
        return None
    headings = np.array([signals.heading(e) for e in executes])
    stop = float(signals.t[run[-1].last])
    rates = [abs(signals.rate(a, b)) for a, b in zip(executes, [*executes[1:], stop], strict=True)]
    if not _approach_is_straight(signals, angle, executes[0], run[0].level, max(rates)):
        return None
    # original heading: midway between the two sides at which the rudder is reversed
    odd, even = headings[1::2], headings[2::2]
    base = (odd.mean() + even.mean()) / 2
    sense = math.copysign(1.0, headings[1] - headings[0])
    sides = sense * (-1.0) ** np.arange(len(run) - 1)
    away = sides * (headings[1:] - base)
    mean = float(away.mean())
    slack = max(_HEADING_SLACK, _HEADING_SPREAD * mean)
    own = np.concatenate([away[0::2] - away[0::2].mean(), away[1::2] - away[1::2].mean()])
    begun_straight = abs(headings[0] - base) <= max(_HEADING_SLACK, 0.35 * mean)
    if mean < math.radians(2) or not begun_straight or np.abs(own).max() > slack:
        return None
    seen = int((signals.t < executes[0] - signals.start_std).sum()) >= 3
    # two equal headings may be chance; less so where a helm amidships came before
    if len(run) < (3 if seen else 4):
        return None
    level = float(np.median([abs(h.level) for h in run]))
    made = measure_zigzag(
        *signals.arrays,
        executes=executes,
        rudder=level,
        stop=stop,
        scale=scale,
        start_std=signals.start_std,
        **signals.known,
    )
    if rudder and made.direction * run[0].level < 0:
        made = replace(made, notes=(*made.notes, _WRONG_WAY))
    return made


def _speeds(log: TrialLog) -> list[str]:
    """Return the columns of propeller speeds that a log has, each once."""
    return [n for n in dict.fromkeys(t.speed for t in log.vessel.thrusters) if n in log]


def _thrust_kept(log: TrialLog, signals: _Signals, start: float) -> float:
    """Return until when the propeller speeds stay near those at a time [s]."""
    after = signals.t > start
    near = np.abs(signals.t - start) <= max(signals.ship_time / 2, 3 * signals.start_std)
    stop = float(signals.t[-1])
    for name in _speeds(log):
        usual = float(np.median(log[name][near]))
        off = np.flatnonzero(
            after & (np.abs(log[name] - usual) > _THRUST_VARIES * max(abs(usual), 1e-9))
        )
        # single samples off are faults of the sensor
        lasting = off[: len(off) - 2][(off[2:] - off[:-2]) == 2] if len(off) > 2 else off[:0]
        if len(lasting):
            stop = min(stop, float(signals.t[lasting[0]]))
    return stop


def _turns(
    log: TrialLog,
    signals: _Signals,
    angle: Array,
    held: Sequence[Held],
    greatest: float | None,
    rudder: bool,
) -> Iterator[TurningCircle]:
    for order in held:
        if abs(order.level) < _SMALLEST:
            continue
        start = order.execute
        stop = min(float(signals.t[order.last]), _thrust_kept(log, signals, start))
        if stop <= start + signals.ship_time:
            continue
        change = signals.heading(stop) - signals.heading(start)
        if abs(change) < _TURN + math.radians(5):
            continue
        # without an approach in the log a held angle proves less, at its first sample nothing
        if int((signals.t < start - signals.start_std).sum()) < 3:
            continue
        seen = float(signals.t[0]) <= start - signals.ship_time
        if not seen and abs(change) < _TURN_UNSEEN:
            continue
        rate = change / (stop - start)
        if not _approach_is_straight(signals, angle, start, order.level, rate):
            continue
        made = measure_turning_circle(
            *signals.arrays,
            start=start,
            stop=stop,
            rudder=order.level,
            full_rudder=greatest,
            start_std=signals.start_std,
            **signals.known,
        )
        if rudder and made.direction * order.level < 0:
            made = replace(made, notes=(*made.notes, _WRONG_WAY))
        yield made


def _turns_by_yaw_rate(log: TrialLog, signals: _Signals) -> Iterator[TurningCircle]:
    """Find turns of about a full circle at a steady yaw rate, after a straight approach."""
    t = signals.t
    half = signals.ship_time / 2
    left, right = np.searchsorted(t, t - half), np.searchsorted(t, t + half, "right") - 1
    wide = np.maximum(t[right] - t[left], 1e-9)
    # ends of the windows averaged over a few samples, since one sample is noisy
    psi = np.convolve(np.pad(signals.psi, 2, mode="edge"), np.ones(5) / 5, "valid")
    rate = (psi[right] - psi[left]) / wide
    for sign in (1, -1):
        for first, after in runs(sign * rate > 0):
            made = _one_turn(log, signals, sign * rate, first, after - 1)
            if made is not None:
                yield made


def _one_turn(
    log: TrialLog, signals: _Signals, rate: Array, first: int, last: int
) -> TurningCircle | None:
    t = signals.t
    usual = float(np.quantile(rate[first : last + 1], 0.75))
    strong = first + np.flatnonzero(rate[first : last + 1] > 0.5 * usual)
    if len(strong) < 10:
        return None
    first, last = int(strong[0]), int(strong[-1])
    steady = rate[first : last + 1]
    full = abs(signals.psi[last] - signals.psi[first]) >= _TURN_UNSEEN
    if not full or float(steady.min()) < 0.4 * usual or float(steady.max()) > 2.0 * usual:
        return None
    before = np.flatnonzero((t < t[first]) & (rate < 0.1 * usual))
    if len(before) == 0:
        return None
    onset = int(before[-1])
    straight = np.flatnonzero((t >= t[onset] - signals.ship_time) & (t <= t[onset]))
    if len(straight) < 5 or np.abs(rate[straight]).max() > _APPROACH_RATE * usual:
        return None
    # the running mean sees the turn half its length early
    start = float(t[onset]) + signals.ship_time / 4
    start_std = max(float(t[first] - t[onset]) / 4, signals.start_std)
    ordered = _thrust_ordered(log, signals, start, 2 * signals.ship_time)
    if ordered is not None:
        start, start_std = ordered, signals.start_std
    made = measure_turning_circle(
        *signals.arrays,
        start=start,
        stop=float(t[last]),
        start_std=start_std,
        **signals.known,
    )
    if ordered is None:
        note = "no order is logged: the turn is taken to start where the yaw rate does"
        made = replace(made, notes=(*made.notes, note))
    return made


def _thrust_ordered(log: TrialLog, signals: _Signals, near: float, span: float) -> float | None:
    """Return when the last large change of a thruster command before a turn began [s]."""
    times = []
    for name in _speeds(log):
        value = log[name]
        reach = float(np.ptp(value))
        if reach <= 0:
            continue
        held = held_angles(
            signals.t, value, _HELD_LENGTHS * signals.ship_time, tolerance=0.05 * reach
        )
        times += [h.execute for h in held if h.first > 0 and abs(h.execute - near) <= span]
    return max(times, default=None)


def _thrust(log: TrialLog) -> Array | None:
    """Return the thrust along the ship, positive forward, in the unit of its law."""
    if not all(c in log for c in log.vessel.commands):
        return None
    if not any(
        isinstance(t.angle, str) or abs(math.cos(t.angle)) > 1e-9 for t in log.vessel.thrusters
    ):
        return None
    return log.forces(("taux",))[:, 0]


def _stops(log: TrialLog, signals: _Signals) -> Iterator[Stopping]:
    thrust = _thrust(log)
    if thrust is None:
        return
    t, u = signals.t, signals.u
    largest = float(np.quantile(np.abs(thrust), 0.95))
    if largest <= 0:
        return
    shortest = _HELD_LENGTHS * signals.ship_time
    tolerance = max(0.05 * largest, 4 * noise_std(t, thrust))
    held = held_angles(t, thrust, shortest, tolerance=tolerance)
    for ahead, astern in pairwise(held):
        usual = ahead.level
        if usual < 0.2 * largest or astern.level > _THRUST_OFF * usual:
            continue
        start = astern.execute
        run = np.flatnonzero((t >= start - signals.ship_time) & (t <= start))
        if len(run) < 5 or t[run[-1]] - t[run[0]] < 0.8 * signals.ship_time:
            continue
        speed = float(u[run].mean())
        trend = abs(float(np.polyfit(t[run] - start, u[run], 1)[0])) * signals.ship_time
        # an approach is at speed, steady and straight
        straight = abs(signals.heading(float(t[run[-1]])) - signals.heading(float(t[run[0]])))
        if speed < 0.3 * signals.length / signals.ship_time or trend > 0.15 * speed:
            continue
        if straight > math.radians(10) or t[ahead.last] - t[ahead.first] < signals.ship_time:
            continue
        # one order until the ship stands: whoever manoeuvres gives several
        end = float(t[astern.last])
        after = np.flatnonzero((t >= start) & (t <= end))
        if len(after) < 10:
            continue
        smooth = np.convolve(np.pad(u[after], 2, mode="edge"), np.ones(5) / 5, "valid")
        if float(smooth.min()) > 0:
            continue
        yield measure_stopping(
            *signals.arrays,
            start=start,
            stop=end,
            reversed_thrust=astern.level < -_THRUST_OFF * usual,
            start_std=signals.start_std,
            **signals.known,
        )
