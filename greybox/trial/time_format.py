"""Fractions of a second written without their leading zeros, so that time seems to go back.

A program that writes seconds and nanoseconds as two whole numbers with a point between them
turns 45.081 s into 45.81: the first tenth of every second is spread over all of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.numerics.robust import robust_deviation

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

# zeros that a fraction down to a nanosecond may have lost
_MOST_ZEROS = 8
# what is left of an uneven step by the better reading, as a share
_BETTER = 0.7
# the same where neither digits nor order tell
_PLAIN = 0.1
# by how many steps the better reading must be more even than rows put in order
_EVENER = 0.5
# without time going back, a stamp must be that much farther from even than any elsewhere
_OUTLYING = 1.25
_FITTING = 3.0
# steps from which on one second may have but one wrong time, behind which nothing goes back [s]
_SLOW = 0.09
# seconds that make it the habit of a file
_ESTABLISHED = 5
# decimals that seconds since 1970 still have as doubles
_MOST_DECIMALS = 6


@dataclass(frozen=True)
class Unpadded:
    """Times whose fractions lack their leading zeros.

    Parameters
    ----------
    rows : ndarray
        (m,) which they are.
    times : ndarray
        (m,) what they mean [s].
    """

    rows: Rows
    times: Array

    def __len__(self) -> int:
        return len(self.rows)


_NOTHING = Unpadded(np.empty(0, np.int64), np.empty(0))


def unpadded_text(
    t: Array, digits: Array, length: Rows, zero_ends: NDArray[np.bool_], width: int
) -> Unpadded:
    """Find stamps whose text has fewer digits behind the point than the others, for that reason.

    A program that leaves zeros out at the end writes short fractions too. The digits tell the
    two apart where full fractions end in zero; else time must go back as written and not as
    meant.

    Parameters
    ----------
    t : ndarray
        (N,) times as written [s].
    digits : ndarray
        (N,) the fraction as a whole number.
    length : ndarray
        (N,) how many digits it is written with; 0 where there is none.
    zero_ends : ndarray
        (N,) whether its last digit is a zero.
    width : int
        Digits of a full fraction.
    """
    finite = np.flatnonzero(np.isfinite(t))
    t, digits, length, zero_ends = t[finite], digits[finite], length[finite], zero_ends[finite]
    # the first digit of a fraction that lost its zeros is none
    short = (length > 0) & (length < width) & (digits * 10.0 ** (1 - length) >= 1)
    if not short.any() or len(t) < 2:
        return _NOTHING
    full = length == width
    keeps_zeros = bool((full & zero_ends).any() or (short & zero_ends).any())
    means = np.where(short, t - digits * 10.0**-length + digits * 10.0**-width, t)
    # each step at a short fraction belongs to one run of them
    run = np.cumsum(short & ~np.concatenate([[False], short[:-1]]))
    of_step = np.where(short[1:], run[1:], np.where(short[:-1], run[:-1], 0))
    count = int(run[-1]) + 1
    usual = float(np.median(np.abs(np.diff(means))))

    def per_run(value: Array) -> Array:
        return np.asarray(np.bincount(of_step, value, count), float)

    written, meant = np.diff(t), np.diff(means)
    back = per_run((written < 0).astype(float)), per_run((meant < 0).astype(float))
    uneven = per_run(np.abs(written - usual)), per_run(np.abs(meant - usual))
    if keeps_zeros:
        good = (back[1] < back[0]) | ((back[1] == back[0]) & (uneven[1] < _BETTER * uneven[0]))
    else:
        good = (back[1] == 0) & (uneven[1] < np.where(back[0] > 0, 1.0, _PLAIN) * uneven[0])
    good[0] = False
    lost = short & good[run]
    if not keeps_zeros and lost.sum() < 0.5 * short.sum():
        # the other short fractions are as they should be: zeros at the end are left out
        return _NOTHING
    rows = np.flatnonzero(lost)
    return Unpadded(finite[rows], means[rows])


def unpadded_numbers(t: Array) -> Unpadded:
    """Find times whose fraction, with one to eight zeros put before it, lies where it should.

    Within a second the first tenth is looked at: there the wrong times stand, and behind them
    time goes back (at few samples a second, it is at least out of step).

    Parameters
    ----------
    t : ndarray
        (N,) [s], of which whole numbers are whole seconds of the clock.
    """
    finite = np.flatnonzero(np.isfinite(t))
    x = t[finite]
    if len(x) < 4:
        return _NOTHING
    second = np.floor(x + 1e-7)
    edges = np.flatnonzero(np.diff(second) != 0) + 1
    starts, stops = np.concatenate([[0], edges]), np.concatenate([edges, [len(x)]])
    steps = np.diff(x)
    usual = float(np.median(np.abs(steps)))
    if not 0 < usual < 10:
        return _NOTHING
    falls = np.flatnonzero((steps < 0) & (second[1:] == second[:-1]))
    group = np.searchsorted(starts, falls, side="right") - 1
    # the last fall of each second
    last = dict(zip(group.tolist(), falls.tolist(), strict=True))
    grid = _decimals(x)
    scatter = robust_deviation(steps - usual)
    for k in _out_of_step(x, starts, stops, usual, grid):
        last.setdefault(k, int(starts[k]))
    # no nearer than stamps are rounded
    near = max(_FITTING * scatter, 0.05 * usual, 0.0 if grid is None else 2 * 10.0**-grid)
    found = _search(x, last, starts, stops, grid, usual, near)
    if len(found) >= _ESTABLISHED and len(found) > 0.5 * len(last):
        # the whole file is so: a late sample may then lie anywhere between its neighbours
        found |= _search(x, last, starts, stops, grid, usual, np.inf)
    rows: list[int] = []
    means: list[float] = []
    for k, meant in sorted(found.items()):
        start = int(starts[k])
        changed = np.flatnonzero(np.abs(meant - x[start : start + len(meant)]) > 1e-9)
        rows += (start + changed).tolist()
        means += meant[changed].tolist()
    back = len(falls)
    repaired = x.copy()
    repaired[rows] = means
    if back and int((np.diff(repaired) < 0).sum()) > 0.5 * back:
        # rows out of order explain what this does not
        return _NOTHING
    return Unpadded(finite[rows], np.array(means, float))


def _search(
    x: Array,
    last: dict[int, int],
    starts: Rows,
    stops: Rows,
    grid: int | None,
    usual: float,
    near: float,
) -> dict[int, Array]:
    """Return by second what its first times mean, where zeros put them in order.

    `last` gives by second the row behind which time goes back for the last time.
    """
    found: dict[int, Array] = {}
    for k, fall in sorted(last.items()):
        start = int(starts[k])
        if fall + 1 >= stops[k] or not start:
            continue
        before = float(x[start - 1])
        if k - 1 in found and starts[k - 1] + len(found[k - 1]) == start:
            before = float(found[k - 1][-1])
        meant = _chain(x, start, fall + 1, before, grid, usual, near)
        if meant is not None and _even(x, start, meant, usual):
            found[k] = meant
    return found


def _out_of_step(x: Array, starts: Rows, stops: Rows, usual: float, grid: int | None) -> list[int]:
    """Return the seconds whose first time alone is far from the middle of its neighbours."""
    if usual < _SLOW:
        return []
    off = np.zeros(len(x))
    off[1:-1] = x[1:-1] - 0.5 * (x[:-2] + x[2:])
    around = np.zeros(len(x))
    around[1:-1] = x[2:] - x[:-2]
    # no step is missing there: what lies beside a hole is out of step too
    whole = np.abs(around - 2 * usual) < 0.5 * usual
    # beside a wrong time the right ones are out of step too
    beside = np.unique(np.clip(starts[:, None] + np.arange(-1, 2), 0, len(x) - 1))
    elsewhere = np.delete(np.where(whole, np.abs(off), 0.0), beside)
    most = float(elsewhere.max(initial=0.0))
    short = np.zeros(len(x), bool)
    if grid is not None:
        short = _whole(x * 10.0 ** (grid - 1))
    # what lost a zero has a digit less than the others
    times = 2 * _OUTLYING if grid is None else _OUTLYING
    far = whole & (off > max(times * most, 0.25 * usual)) & (short | (grid is None))
    which = np.flatnonzero((starts > 0) & (stops - starts > 1) & far[starts])
    return [int(k) for k in which]


def _decimals(x: Array) -> int | None:
    """Return with how many decimals times are written, None where there are too many to tell."""
    for count in range(_MOST_DECIMALS + 1):
        if np.mean(_whole(x * 10.0**count)) > 0.95:
            return count
    return None


def _whole(x: Array) -> NDArray[np.bool_]:
    """Whether numbers are whole, but for the rounding of doubles."""
    return np.asarray(np.abs(x - np.round(x)) < 1e-6 + np.abs(x) * 1e-15)


def _chain(
    x: Array,
    start: int,
    stop: int,
    before: float,
    grid: int | None,
    usual: float,
    near: float,
) -> Array | None:
    """Return what the times of rows start to stop mean, None where no zeros put them in order."""
    low, high = before, float(x[stop])
    count = stop - start
    whole = np.floor(x[start] + 1e-7)
    if count > 0.1 / usual + 3:
        return None
    places = 10.0 ** -np.arange(_MOST_ZEROS + 1.0)
    meant = []
    for i in range(count):
        part = float(x[start + i]) - whole
        options = whole + part * places
        fits = (options > low + 1e-9) & (options < high - 1e-9) & (options < whole + 0.1 + 1e-9)
        if grid is not None:
            fits &= _whole(options * 10.0**grid)
            fits &= part * places * 10.0**grid >= 0.5 * (part > 1e-9)
        if not fits.any():
            return None
        expected = low + (high - low) / (count - i + 1)
        options = np.where(fits, options, np.inf)
        best = float(options[np.argmin(np.abs(options - expected))])
        if abs(best - expected) > near:
            return None
        meant.append(best)
        low = best
    return np.array(meant)


def _even(x: Array, start: int, meant: Array, usual: float) -> bool:
    """Whether times are more even as meant than put in order as they are."""
    a, b = max(start - 3, 0), start + len(meant)
    until = np.searchsorted(x[b:], np.floor(x[start]) + 1.5) + b
    around = x[a : min(int(until), len(x))]
    as_meant = around.copy()
    as_meant[start - a : b - a] = meant

    def cost(t: Array) -> float:
        return float(np.sum(np.abs(np.diff(np.sort(t)) - usual)))

    return cost(around) - cost(as_meant) > _EVENER * usual
