"""Which clocks the channels share, and whether a lever arm or a heading bias is beside them.

Every way to put the sensors on common clocks is compared, each with and without lever arm and
heading bias, by the quadratic likelihood of all offsets: rivals stand side by side, and what
cannot be separated is seen.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from greybox.trial.checks.sensor_offsets.model import (
    ARM,
    BIAS,
    CLOCKS,
    LEAST_CLOCK,
    LEAST_HEADING,
    MOST_LATE,
    SIGMAS,
    SIZE,
    least_arm,
    most_arm,
)
from greybox.trial.raw_log import Array
from greybox.vessel.vessel import Vessel

Clock = tuple[str, ...]

# all positions stand for one sensor
POSITIONS = ("x_n", "y_n")
# in log-likelihood: what one more offset must explain (3.3 standard errors)
_LEAST_GAIN = 5.5
# velocities of one sensor on two clocks, several sensors on a clock beside that of the others, a
# yaw rate alone (a gyro is noisy against what a slow ship turns), a sensor that is early, a clock
# or an antenna far off, a second component of the arm
_APART, _COMPANY, _RATE, _EARLY, _FAR, _SECOND = 3.0, 6.0, 2.5, 3.0, 12.0, 3.0
_FAR_CLOCK = 2.0
# a rival that explains as much but for this cannot be ruled out: odds of 20 to 1
SEPARATED = 3.0
# which clock the others are compared with: that of the most sensors
_WEIGHT = {"x_n": 1.0, "psi": 1.0, "u": 0.55, "v": 0.55, "r": 0.8}


@dataclass(frozen=True)
class Defect:
    """One offset that a hypothesis holds.

    Parameters
    ----------
    id : {"clock_offset", "lever_arm", "heading_bias"}
    channels : tuple of str
        Late channels, or those that the offset moves.
    against : tuple of str
        Channels on the clock that a late one is compared with.
    value : ndarray
        (k,) [s], [m] or [rad].
    covariance : ndarray
        (k, k)
    """

    id: str
    channels: tuple[str, ...]
    against: tuple[str, ...]
    value: Array
    covariance: Array


@dataclass(frozen=True)
class Hypothesis:
    """Clocks, lever arm and heading bias that may be.

    Parameters
    ----------
    clocks : tuple of tuple of str
        Channels by the clock that they share; the first is the one that most sensors share.
    arm, bias : bool
    """

    clocks: tuple[Clock, ...]
    arm: bool
    bias: bool

    @property
    def basis(self) -> Array:
        """Columns (`SIZE`, k) of the offsets that are free."""
        columns = []
        for clock in self.clocks:
            if "x_n" not in clock and not (self.apart and clock == self.clocks[0]):
                column = np.zeros(SIZE)
                column[[CLOCKS.index(n) for n in clock]] = 1.0
                columns.append(column)
        if self.arm:
            columns += list(np.eye(SIZE)[ARM])
        if self.bias:
            columns.append(np.eye(SIZE)[BIAS])
        return np.column_stack(columns) if columns else np.zeros((SIZE, 0))

    @property
    def apart(self) -> bool:
        """Whether there are no positions that the clocks could be compared with."""
        return not any("x_n" in c for c in self.clocks)


@dataclass(frozen=True)
class Judged:
    """A hypothesis with its estimate.

    Parameters
    ----------
    hypothesis : Hypothesis
    score : float
        Log-likelihood less the cost of its offsets.
    cost : float
    offsets : ndarray
        (`SIZE`,)
    covariance : ndarray
        (`SIZE`, `SIZE`)
    defects : tuple of Defect
        Its offsets, large or small.
    """

    hypothesis: Hypothesis
    score: float
    cost: float
    offsets: Array
    covariance: Array
    defects: tuple[Defect, ...]


def hypotheses(channels: tuple[str, ...], *, turned: bool) -> Iterator[Hypothesis]:
    """Yield every way to put the sensors of a log on clocks, with and without arm and bias.

    Parameters
    ----------
    channels : tuple of str
        Motion channels of the log.
    turned : bool
        Whether the yaw rate is compared with the heading.
    """
    positioned = "x_n" in channels
    names = [n for n in ("x_n", "psi", "u", "v") if positioned or n == "psi"]
    names += ["r"] if turned else []
    flags = (False, True) if positioned else (False,)
    for parts in _partitions(names):
        clocks = tuple(sorted((tuple(p) for p in parts), key=_weight, reverse=True))
        for arm, bias in product(flags, repeat=2):
            yield Hypothesis(clocks, arm, bias)


def score_hypotheses(
    channels: tuple[str, ...], *, turned: bool, offsets: Array, covariance: Array,
    scatter: Array, vessel: Vessel, antenna: Array,
) -> list[Judged]:  # fmt: skip
    """Return all hypotheses with their estimates, best first.

    Parameters
    ----------
    channels : tuple of str
    turned : bool
    offsets : ndarray
        (`SIZE`,) estimate of all offsets together.
    covariance : ndarray
        (`SIZE`, `SIZE`) of it.
    scatter : ndarray
        (`SIZE`,) standard deviation that offsets may have without mattering, from log to log and
        between channels of one clock.
    vessel : Vessel
    antenna : ndarray
        (2,) where the vessel file has the antenna [m].
    """
    information = np.linalg.inv(covariance + np.diag(scatter**2))
    null = np.zeros(SIZE)
    null[ARM] = antenna
    from_null = offsets - null
    whole = float(from_null @ information @ from_null)
    found = []
    for h in hypotheses(channels, turned=turned):
        basis = h.basis
        estimate, spread = np.zeros(SIZE), np.zeros((SIZE, SIZE))
        explained = 0.0
        if basis.shape[1]:
            inner = np.linalg.inv(basis.T @ information @ basis)
            pull = basis.T @ information @ from_null
            estimate = basis @ inner @ pull
            taken = basis @ inner @ basis.T @ information
            spread = taken @ covariance @ taken.T
            explained = float(pull @ inner @ pull)
        defects = tuple(_defects(h, estimate + null, spread))
        cost = _cost(h, defects, vessel)
        score = 0.5 * (explained - whole) - cost
        found.append(Judged(h, score, cost, estimate + null, spread, defects))
    return sorted(found, key=lambda judged: judged.score, reverse=True)


def matters(defect: Defect, vessel: Vessel, antenna: Array) -> bool:
    """Whether a defect is large enough to matter, and proven."""
    if defect.id == "lever_arm":
        off = defect.value - antenna
        wald = float(off @ np.linalg.solve(defect.covariance + 1e-12 * np.eye(2), off))
        return bool(np.hypot(*off) >= least_arm(vessel) and wald >= SIGMAS**2 + 4)
    value, std = abs(float(defect.value[0])), float(np.sqrt(defect.covariance[0, 0]))
    least = LEAST_CLOCK if defect.id == "clock_offset" else LEAST_HEADING
    return value >= least and value >= SIGMAS * std


def separation(judged: list[Judged], defect: Defect) -> tuple[float, Judged | None]:
    """Return by how much all hypotheses without a defect explain less, and the best of them."""
    best = judged[0]
    for other in judged:
        if (defect.id, defect.channels) not in ((d.id, d.channels) for d in other.defects):
            return best.score - other.score, other
    return np.inf, None


def possible(defect: Defect, vessel: Vessel) -> bool:
    """Whether a ship can have it."""
    if defect.id == "lever_arm":
        return bool(np.hypot(*defect.value) <= most_arm(vessel))
    return defect.id != "clock_offset" or abs(float(defect.value[0])) <= MOST_LATE


def _defects(h: Hypothesis, offsets: Array, covariance: Array) -> Iterator[Defect]:
    for clock in h.clocks[1:]:
        column = _lateness(clock) - _lateness(h.clocks[0])
        yield Defect(
            "clock_offset", _channels(clock), _channels(h.clocks[0]),
            np.array([column @ offsets]), np.array([[column @ covariance @ column]]),
        )  # fmt: skip
    if h.arm:
        yield Defect("lever_arm", POSITIONS, (), offsets[ARM], covariance[ARM, ARM])
    if h.bias:
        bias = np.array([np.angle(np.exp(1j * offsets[BIAS]))])
        variance = covariance[BIAS : BIAS + 1, BIAS : BIAS + 1]
        yield Defect("heading_bias", ("psi",), (), bias, variance)


def _lateness(clock: Clock) -> Array:
    column = np.zeros(SIZE)
    known = [n for n in clock if n in CLOCKS]
    if "x_n" not in clock:
        column[CLOCKS.index(known[0])] = 1.0
    return column


def _channels(clock: Clock) -> tuple[str, ...]:
    return tuple(c for n in clock for c in (POSITIONS if n == "x_n" else (n,)))


def _cost(h: Hypothesis, defects: tuple[Defect, ...], vessel: Vessel) -> float:
    total = _LEAST_GAIN * len(defects)
    total += _SECOND * h.arm
    for clock in h.clocks:
        total += 0.5 * _APART * (("u" in clock) != ("v" in clock))
    for d in defects:
        value = float(d.value[0])
        if d.id == "clock_offset":
            sensors = {{"v": "u", "y_n": "x_n"}.get(c, c) for c in d.channels}
            total += _COMPANY * (len(sensors) > 1) + _RATE * (d.channels == ("r",))
            total += _EARLY * (value < 0 and "x_n" not in d.channels)
            total += _FAR * (abs(value) > _FAR_CLOCK)
        elif not possible(d, vessel):
            total += _FAR
    return float(total)


def _weight(clock: Clock) -> float:
    return sum(_WEIGHT[n] for n in clock)


def _partitions(names: list[str]) -> Iterator[list[list[str]]]:
    if not names:
        yield []
        return
    first, rest = names[0], names[1:]
    for smaller in _partitions(rest):
        yield [[first], *smaller]
        for k in range(len(smaller)):
            yield [*smaller[:k], [first, *smaller[k]], *smaller[k + 1 :]]
