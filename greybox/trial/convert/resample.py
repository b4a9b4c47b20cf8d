"""From signals on their own clocks to one sample time; holes stay holes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.trial.gaps import HOLE, pieces, runs, usual_step
from greybox.trial.raw_log import Array, Mask

# low-pass of the signals that are faster than the log: cut-off as a share of its Nyquist rate
_CUT_OFF = 0.8
_TAPS_PER_RATIO = 8
# how a signal of another rate is brought to that of the log
HELD, FILTERED, AVERAGED = "held", "low-pass filtered", "averaged"


@dataclass(frozen=True)
class Clock:
    """Times of one signal, in order, and where they have holes.

    Parameters
    ----------
    t : ndarray
        (N,) [s], increasing.
    period : float
        Usual step [s].
    starts, stops : ndarray
        (S,) first and one-past-last index of each stretch without a hole.
    """

    t: Array
    period: float
    starts: NDArray[np.int64]
    stops: NDArray[np.int64]

    @property
    def covered(self) -> float:
        """Time within stretches [s]."""
        return float(np.sum(self.t[self.stops - 1] - self.t[self.starts]))

    @property
    def mean(self) -> float:
        """Mean step within the stretch of most samples [s]: it does not depend on jitter."""
        k = int(np.argmax(self.stops - self.starts))
        start, stop = self.starts[k], self.stops[k] - 1
        return float((self.t[stop] - self.t[start]) / (stop - start)) if stop > start else 0.0

    @property
    def irregular(self) -> int:
        """How many steps within stretches differ by more than a third from the usual one."""
        steps = np.diff(self.t)
        within = np.ones(len(steps), bool)
        within[self.starts[1:] - 1] = False
        return int(np.sum(within & (np.abs(steps - self.period) > 0.33 * self.period)))


def clock(
    t: Array,
    max_gap: float | None = None,
    period: float | None = None,
    cuts: Sequence[float] = (),
) -> Clock:
    """Return the usual step of times and the stretches without a hole.

    Parameters
    ----------
    t : ndarray
        (N,) [s], increasing, N >= 1.
    max_gap : float, optional
        Longest step that is no hole [s]; `HOLE` usual steps by default.
    period : float, optional
        Usual step [s], where it is known from more than these times.
    cuts : sequence of float
        Times at which a stretch begins although there is no hole [s].
    """
    steps = np.diff(t)
    period = usual_step(t) if period is None else period
    limit = HOLE * period
    if max_gap is not None:
        # what the user calls a hole is one, but not every step
        limit = max(max_gap, 1.01 * min(period, float(np.median(steps)) if len(steps) else period))
    starts, stops = np.array(pieces(t, limit), np.int64).T
    if cuts:
        inner = np.searchsorted(t, cuts)
        starts = np.union1d(starts, inner[inner < len(t)])
        stops = np.union1d(stops, inner[inner > 0])
    return Clock(t, period, starts, stops)


def covered(grid: Array, of: Clock) -> Mask:
    """Whether each time of a grid lies within a stretch of the clock, (M,) bool."""
    slack = 1e-6 * max(of.period, 1e-9) + 1e-9
    first, last = of.t[of.starts], of.t[of.stops - 1]
    k = np.searchsorted(first, grid + slack, side="right") - 1
    inside = (k >= 0) & (grid <= last[np.clip(k, 0, None)] + slack)
    return np.asarray(inside)


def stretches(
    grid: Array, clocks: Iterable[Clock], cuts: Sequence[float] = ()
) -> list[tuple[int, int]]:
    """Return the runs (start, stop) of an even grid in which all clocks have values.

    Around a cut as many samples are left out as make a hole, so that whoever reads the
    samples again finds them apart.
    """
    keep = np.ones(len(grid), bool)
    for c in {id(c): c for c in clocks}.values():
        keep &= covered(grid, c)
    for k in np.searchsorted(grid, cuts):
        if 0 < k < len(grid):
            keep[k - 1 : k - 1 + int(HOLE)] = False
    return runs(keep)


def resampled_by(period: float, sample_time: float, *, held: bool) -> str | None:
    """Return how a signal is brought to a sample time, None where its own rate is kept.

    Parameters
    ----------
    period, sample_time : float
        Usual step of the signal, and that of the log [s].
    held : bool
        Whether it is an input, which keeps its value until the next.
    """
    if held:
        return AVERAGED if 0 < period <= 0.75 * sample_time else None
    if period > 1.5 * sample_time:
        return HELD
    return FILTERED if period > 0 and sample_time >= 1.5 * period else None


def interpolate(of: Clock, value: Array, grid: Array, sample_time: float) -> Array:
    """Bring a continuous signal to a grid.

    Signals slower than the grid are held, as their sensor held them; signals
    faster than it are low-pass filtered first, so that what the grid cannot
    show does not fold back; between equal rates the interpolation is linear.

    Parameters
    ----------
    of : Clock
    value : ndarray
        (N,), angles unwrapped.
    grid : ndarray
        (M,) [s], spaced by `sample_time`.
    sample_time : float
        [s]

    Returns
    -------
    ndarray
        (M,); values outside the clock's stretches are those of their ends.
    """
    how = resampled_by(of.period, sample_time, held=False)
    if how == HELD:
        return hold(of, value, grid)
    out = np.interp(grid, of.t, value)
    for start, stop in zip(of.starts, of.stops, strict=True) if how == FILTERED else ():
        t, part = of.t[start:stop], value[start:stop]
        inside = (grid >= t[0]) & (grid <= t[-1])
        if inside.any() and len(t) > 2:
            out[inside] = _low_pass(t, part, grid[inside], of.period, sample_time)
    return out


def _low_pass(t: Array, value: Array, grid: Array, period: float, sample_time: float) -> Array:
    from scipy.signal import firwin, oaconvolve

    ratio = sample_time / period
    # an odd number of taps keeps the filter without delay
    taps = 2 * int(np.ceil(_TAPS_PER_RATIO * ratio / 2 - 1e-6)) + 1
    # the mean step of this stretch: that of all of them would drift away from its times
    count = max(round((t[-1] - t[0]) / period) + 1, 2)
    fine = np.linspace(t[0], t[-1], count)
    even = np.interp(fine, t, value)
    kernel = firwin(taps, _CUT_OFF / ratio)
    half = taps // 2
    # mirrored about its ends through the end value: a ramp stays a ramp
    half = min(half, len(even) - 1)
    kernel = kernel[taps // 2 - half : taps // 2 + half + 1]
    kernel = kernel / kernel.sum()
    before = 2 * even[0] - even[half:0:-1]
    after = 2 * even[-1] - even[-2 : -half - 2 : -1]
    smooth = oaconvolve(np.concatenate([before, even, after]), kernel, mode="valid")
    return np.asarray(np.interp(grid, fine, smooth))


def hold(of: Clock, value: Array, grid: Array) -> Array:
    """Return the last value at or before each time of a grid, (M,)."""
    slack = 1e-6 * max(of.period, 1e-9) + 1e-9
    k = np.searchsorted(of.t, grid + slack, side="right") - 1
    return np.asarray(value[np.clip(k, 0, len(value) - 1)])


def hold_mean(of: Clock, value: Array, grid: Array, sample_time: float) -> Array:
    """Return the mean of a held signal over the sample that follows each time, (M,).

    An input that changes within a sample acts on the ship by its mean; one that
    changes at samples only is held as it is.
    """
    if len(of.t) < 2 or resampled_by(of.period, sample_time, held=True) is None:
        return hold(of, value, grid)
    area = np.concatenate([[0.0], np.cumsum(value[:-1] * np.diff(of.t))])

    def integral(at: Array) -> Array:
        k = np.clip(np.searchsorted(of.t, at, side="right") - 1, 0, len(of.t) - 1)
        return np.asarray(area[k] + value[k] * (at - of.t[k]))

    return (integral(grid + sample_time) - integral(grid)) / sample_time


def held_rows(of: Clock, grid: Array, sample_time: float, *, averaged: bool) -> Mask:
    """Return the times of a grid to which a held signal brings no value since the time before.

    Parameters
    ----------
    of : Clock
    grid : ndarray
        (M,) [s], spaced by `sample_time`.
    sample_time : float
        [s]
    averaged : bool
        Whether each time stands for the mean over the sample that follows it (`hold_mean`).
    """
    slack = 1e-6 * max(of.period, 1e-9) + 1e-9
    if averaged:
        low, high = grid - slack, grid + sample_time - slack
    else:
        low, high = grid - sample_time + slack, grid + slack
    before, now = (np.searchsorted(of.t, x, side="right") for x in (low, high))
    return np.asarray(before == now)


def nice_period(period: float) -> float:
    """Return a sample time that people would write for a measured period [s].

    The clock of a logger is known to a few parts in a thousand: 0.0998 is 0.1.
    """
    if period <= 0:
        return 0.0
    scale = 10.0 ** np.floor(np.log10(period))
    for digits in (1.0, 2.0, 2.5, 4.0, 5.0, 8.0, 10.0):
        if abs(period / scale - digits) < 0.02 * digits:
            return float(f"{digits * scale:.6g}")
    return float(f"{period:.3g}")
