"""What the helm did: one steering angle, the angles at which it was held, and when it moved."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from greybox.trial.log import TrialLog
from greybox.trial.manoeuvres.local import noise_std
from greybox.trial.raw_log import Array, Mask
from greybox.vessel.vessel import Thruster, Vessel

_TOLERANCE = math.radians(1.0)
# angle between azimuth thrusters above which they push against one another [rad]
_OPPOSED = math.radians(20)
# least share of its thrust that a propeller gives along the ship, and of their greatest speed
# with which propellers steer
_ALONG, _RUNNING = 0.5, 0.1
# share of a step within which its ramp is fitted
_RAMP_LOW, _RAMP_HIGH = 0.2, 0.8


@dataclass(frozen=True)
class Held:
    """A steering angle that was held.

    Parameters
    ----------
    level : float
        [rad], or the unit of the signal.
    first, last : int
        Its first and last sample.
    execute : float
        When the helm began to move to it [s].
    """

    level: float
    first: int
    last: int
    execute: float


def steering_angle(log: TrialLog) -> tuple[Array, float | None] | None:
    """Return the common steering angle of a log.

    The mean of all rudders; else the mean deviation of the azimuth thrusters
    from thrust straight ahead or astern, those ahead of the origin with the
    opposite sign, as they turn the ship the other way.

    Returns
    -------
    tuple or None
        (N,) angle [rad], positive to starboard, and the greatest angle that the
        vessel allows [rad] where its file states it; None for a vessel that
        steers by other means, or a log without those columns.
    """
    vessel = log.vessel
    rudders = dict.fromkeys(t.rudder for t in vessel.thrusters if t.rudder is not None)
    if rudders and all(name in log for name in rudders):
        ends = [(vessel.limits[n].lower, vessel.limits[n].upper) for n in rudders]
        greatest = [min(abs(a), abs(b)) for a, b in ends if a is not None and b is not None]
        return np.mean([log[n] for n in rudders], axis=0), min(greatest, default=None)
    azimuths = _azimuths(vessel)
    if azimuths and all(name in log for name in azimuths):
        return np.mean(_deviations(log, azimuths), axis=0), None
    return None


def propelling(vessel: Vessel) -> dict[str, float]:
    """Return the speed columns of the propellers that drive a vessel, with the sign ahead."""

    def along(t: Thruster) -> float:
        return math.cos(t.angle) if not isinstance(t.angle, str) else 1.0

    return {
        t.speed: math.copysign(1.0, along(t)) for t in vessel.thrusters if abs(along(t)) > _ALONG
    }


def speed_difference(log: TrialLog) -> Array | None:
    """Return by which share of their speed fixed propellers on either side differ.

    Returns
    -------
    ndarray or None
        (N,) in [−1, 1], positive where those to port run faster, which turns to starboard;
        zero where they hardly run. None for a vessel with rudders, azimuth thrusters or
        propellers on one side only.
    """
    sides: dict[str, float] = {}
    for t in log.vessel.thrusters:
        if t.rudder is not None or isinstance(t.angle, str):
            return None
        if abs(math.cos(t.angle)) > _ALONG and t.y != 0 and t.speed in log:
            sides[t.speed] = math.copysign(1.0, t.y) * math.copysign(1.0, math.cos(t.angle))
    if len(set(np.sign(list(sides.values())))) < 2:
        return None
    apart = -np.sum([side * log[n] for n, side in sides.items()], axis=0)
    total = np.sum([np.abs(log[n]) for n in sides], axis=0)
    running = total > _RUNNING * float(total.max())
    return np.asarray(np.where(running, apart / np.where(running, total, 1.0), 0.0))


def sideways(log: TrialLog) -> Mask:
    """Return where azimuth thrusters push against one another.

    Their mean then is no steering angle: two at 45 degrees, one ahead and one
    aft, have a mean of zero and move the ship sideways.

    Returns
    -------
    ndarray of bool
        (N,); never for a vessel with rudders, or with one azimuth thruster.
    """
    azimuths = _azimuths(log.vessel)
    if any(t.rudder is not None for t in log.vessel.thrusters) or len(azimuths) < 2:
        return np.zeros(len(log), bool)
    parts = _deviations(log, azimuths)
    apart = np.max(parts, axis=0) - np.min(parts, axis=0)
    largest = np.abs(parts).max(axis=0)
    # some stay straight while others steer: these do not oppose one another
    opposed = np.min(parts, axis=0) * np.max(parts, axis=0) < 0
    return np.asarray(opposed & (apart > _OPPOSED) & (apart > largest))


def _azimuths(vessel: Vessel) -> dict[str, float]:
    """Return the columns of azimuth angles, with the sign by which they turn the ship."""
    return {
        t.angle: (-1.0 if t.x <= 0 else 1.0) for t in vessel.thrusters if isinstance(t.angle, str)
    }


def _deviations(log: TrialLog, azimuths: Mapping[str, float]) -> list[Array]:
    """Return how far each azimuth (N,) is off straight, as a rudder would be [rad]."""
    # modulo half a turn: thrust straight astern is straight as well
    return [sign * ((log[n] + math.pi / 2) % math.pi - math.pi / 2) for n, sign in azimuths.items()]


def held_angles(
    t: Array, angle: Array, shortest: float, *, tolerance: float | None = None
) -> tuple[Held, ...]:
    """Find where a signal was held, and when it was moved there.

    Parameters
    ----------
    t, angle : ndarray
        (N,) [s], [rad]
    shortest : float
        Least time that counts as held [s].
    tolerance : float, optional
        Greatest deviation of a held signal; one degree, four times the noise,
        or 3 % of its greatest value by default, whichever is more.
    """
    if len(t) < 5:
        return ()
    smooth = ndimage.median_filter(angle, 3, mode="nearest")
    if tolerance is None:
        largest = float(np.abs(smooth).max())
        tolerance = max(_TOLERANCE, 4 * noise_std(t, angle), 0.03 * largest)
    made: list[Held] = []
    i, n = 0, len(t)
    while i < n:
        j = _reach(smooth, i, 2 * tolerance)
        if t[j] - t[i] < shortest:
            i += 1
            continue
        level = float(np.median(smooth[i : j + 1]))
        close = np.flatnonzero(np.abs(smooth[i : j + 1] - level) <= tolerance)
        first, last = i + int(close[0]), i + int(close[-1])
        before = made[-1] if made else None
        if (
            before is not None
            and abs(before.level - level) <= 2 * tolerance
            and np.all(np.abs(smooth[before.last : first + 1] - level) <= 3 * tolerance)
        ):
            made[-1] = Held(before.level, before.first, last, before.execute)
        else:
            made.append(Held(level, first, last, execute_time(t, smooth, first, level, tolerance)))
        i = j + 1
    return tuple(made)


def _reach(y: Array, i: int, span: float) -> int:
    """Return the last sample up to which a signal stays within a span from sample `i` on."""
    size = 32
    while True:
        part = y[i : i + size]
        wide = np.maximum.accumulate(part) - np.minimum.accumulate(part) > span
        if wide.any():
            return i + int(np.argmax(wide)) - 1
        if i + size >= len(y):
            return len(y) - 1
        size *= 2


def execute_time(t: Array, y: Array, first: int, level: float, tolerance: float) -> float:
    """Return when a signal began to move to the level that it holds from sample `first` on.

    The ramp is followed back to the last turn or rest of the signal; a line
    through its middle is then drawn back to where it rested.

    Parameters
    ----------
    t, y : ndarray
        (N,)
    first : int
        First sample at the level.
    level, tolerance : float

    Returns
    -------
    float
        [s]; the first sample of the log where it starts at the level.
    """
    if first == 0:
        return float(t[0])
    back = max(0, first - 1)
    sign = 1.0 if level >= y[back] else -1.0
    z = sign * y
    lowest, low = z[first], first
    i = first
    rest = 0
    while i > 0:
        i -= 1
        if z[i] < lowest - tolerance / 4:
            lowest, low, rest = z[i], i, 0
        elif z[i] > lowest + tolerance:
            break
        else:
            rest += 1
            if rest >= 5 and sign * level - lowest > 2 * tolerance:
                break
    before = z[i : low + 1]
    lowest = float(np.median(before[before <= lowest + tolerance / 4]))
    step = sign * level - lowest
    if step <= 2 * tolerance:
        return float(t[first])
    inside = np.arange(low, first + 1)
    share = (z[inside] - lowest) / step
    ramp = inside[(share > _RAMP_LOW) & (share < _RAMP_HIGH)]
    if len(ramp) >= 2:
        slope, offset = np.polyfit(t[ramp] - t[ramp[0]], z[ramp], 1)
        if slope > 0:
            time = t[ramp[0]] + (lowest - offset) / slope
            return float(np.clip(time, t[i], t[ramp[0]]))
    if len(ramp) == 1:
        return float(t[max(0, ramp[0] - 1)])
    there = inside[share >= _RAMP_HIGH]
    k = int(there[0]) if len(there) else first
    gone, come = (z[k - 1] - lowest) / step, (z[k] - lowest) / step
    if k > i and step * max(gone, 1 - come) > tolerance:
        # a helm that had left, or was not there yet, moved all the time between
        left = float(t[k] - (t[k] - t[k - 1]) * come / (come - gone))
        return max(left, float(t[max(i, k - 2)]))
    # no sample on the way: a command that is held between samples took effect at this one
    return float(t[k])
