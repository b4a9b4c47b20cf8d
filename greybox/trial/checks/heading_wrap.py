"""Headings that were interpolated across the wrap of the compass before they were unwrapped."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from greybox.errors import so_many
from greybox.numerics.robust import robust_deviation
from greybox.trial.checks.finding import Finding, exact_finding
from greybox.trial.checks.signal_quality import quantum
from greybox.trial.convert.derived_signals import usual_reach
from greybox.trial.raw_log import Array, Recording
from greybox.trial.steps import mend

# a sample between the two sides does harm from here on [rad]
_LEAST = np.radians(1.0)
# standard deviations of the heading's noise by which it must leave the way between its neighbours
_CLEAR = 5.0
# turns that go the long way round: so many times faster than the log's fast turns
_FASTER = 4.0
# a hull does not turn faster than this [rad/s]; below it only equal steps are an interpolation
_FASTEST = np.radians(200.0)
_EQUAL = 0.2
# a rate of turn lasts at least this long [s]
_STEADY = 1.0
# what is larger is in degrees under a radian name: no log turns eight times one way and wraps
_DEGREES = 50.0


def wrap_findings(recording: Recording) -> list[Finding]:
    """Find samples of a wrapped heading between the two sides of its wrap.

    Whoever resamples 359 and 1 deg by linear interpolation makes 180 deg of them. The
    heading then seems to turn the long way round within a few samples, far faster than
    anywhere else in the log, and to go on as if nothing had been.

    Parameters
    ----------
    recording : Recording
        With ``psi`` as it was recorded, in order of time.

    Returns
    -------
    list of Finding
        At most one.
    """
    if "psi" not in recording:
        return []
    s = recording["psi"]
    keep = s.known
    t, value = s.t[keep], s.value[keep]
    if len(value) < 10:
        return []
    whole = 360.0 if usual_reach(value) > _DEGREES else 2 * np.pi
    between = _between(t, value * (2 * np.pi / whole))
    if not len(between):
        return []
    k = int(between[0])
    before = k - 1
    after = int(np.setdiff1d(np.arange(k, len(t)), between)[0])
    a, b, c = np.degrees(value[[before, k, after]] * (2 * np.pi / whole))
    count = float(len(between))
    return [
        exact_finding(
            "heading_wrap",
            ("psi",),
            count,
            "1",
            f"{so_many(len(between), 'sample')} of psi "
            f"lie{'' if len(between) > 1 else 's'} between the two sides of the compass's wrap, "
            f"the first at t = {t[k]:.6g} s: {b:.4g} deg on the way from {a:.4g} to {c:.4g} deg, "
            f"as when a heading is interpolated before it is unwrapped",
            "leave those samples out (import --fix does; what is missing is bridged where one "
            "sample is, else a gap), or resample the heading again after unwrapping it",
            (mend("drop", ("psi",), times=tuple(float(x) for x in t[between])),),
            True,
            {"t": t, "value": value, "between": between, "turn": whole},
        )
    ]


def _between(t: Array, psi: Array) -> NDArray[np.int64]:
    """Return the rows that lie between the two sides; `psi` [rad] as recorded."""
    # a slow compass in a fast table holds what was interpolated, too
    first = np.flatnonzero(np.concatenate([[True], np.diff(psi) != 0]))
    if len(first) < 10:
        return np.empty(0, np.int64)
    t_new, new = t[first], psi[first]
    step = np.diff(new)
    turned = np.abs(_wrapped(step))
    tolerance = max(_LEAST, _CLEAR * np.sqrt(1.5) * _noise(t_new, new) + 2 * quantum(psi))
    # the long way round goes one way only
    edges = np.concatenate([[0], np.flatnonzero(np.diff(np.sign(step)) != 0) + 1])
    ends = np.concatenate([edges[1:], [len(step)]])
    total = new[ends] - new[edges]
    likely = (
        (ends - edges >= 2)
        & (np.abs(total) > 1.5 * np.pi)
        & (np.abs(total) < 2.5 * np.pi)
        & (np.maximum.reduceat(turned, edges) > tolerance)
    )
    flips = np.flatnonzero((np.abs(step) > np.pi) & (turned <= tolerance))
    if not likely.any() and not len(flips):
        return np.empty(0, np.int64)
    apart = np.ones(len(step), bool)
    for a, b in zip(edges[likely], ends[likely], strict=True):
        apart[a:b] = False
    usual = float(np.quantile((turned / np.diff(t_new))[apart], 0.99)) if apart.any() else 0.0
    found: list[int] = []
    longest = 0
    for a, b in zip(edges[likely], ends[likely], strict=True):
        # noise may lengthen the way by good samples: what counts is its long steps
        long = a + np.flatnonzero(np.abs(step[a:b]) > 0.5 * np.abs(step[a:b]).max())
        c, d = int(long[0]), int(long[-1]) + 1
        # beside the way there may be the next sample between the sides
        low = c - 1 if c > a or (c > 0 and turned[c - 1] <= tolerance) else c
        high = d + 1 if d < b or (d < len(step) and turned[d] <= tolerance) else d
        rows = np.arange(c, d + 1)
        share = (t_new[rows] - t_new[low]) / (t_new[high] - t_new[low])
        short = new[low] + share * _wrapped(new[high] - new[low])
        clear = tolerance + _bow(t_new, new, low, high)
        off = np.abs(_wrapped(new[rows] - short))
        # on the long way, and not a heading that jumped from one side to the other
        way = np.sign(new[d] - new[c])
        gone = way * (new[rows] - new[c] - _wrapped(new[low] - new[c]))
        left = way * (new[d] + _wrapped(new[high] - new[d]) - new[rows])
        rows = rows[(off > clear) & (gone > _LEAST) & (left > _LEAST)]
        if not len(rows) or rows[0] == 0 or rows[-1] == len(new) - 1:
            continue
        c, d = rows[0] - 1, rows[-1] + 1
        rate = abs(new[d] - new[c]) / (t_new[d] - t_new[c])
        inner = np.abs(step[rows[0] : rows[-1]])
        even = len(inner) < 2 or np.ptp(inner) < _EQUAL * inner.mean()
        if rate > _FASTER * usual and (rate > _FASTEST or even):
            found += rows.tolist()
            longest = max(longest, len(rows))
    # what lies beside the wrap on either side of it
    beside = np.setdiff1d(
        [*flips, *(k - 1 for k in found[:1]), *(k + 1 for k in found[-1:])], found
    )
    if len(beside):
        reach = np.maximum(tolerance, _FASTER * usual * np.diff(t_new))
        edge = 0.0 if np.mean(np.cos(new[beside.astype(int)])) > 0 else np.pi
        found = sorted({*found, *_returning(new, edge, 2 * longest + 2, reach)})
    last = np.concatenate([first[1:], [len(psi)]])
    rows_of = [np.arange(first[k], last[k]) for k in found]
    return np.concatenate(rows_of) if rows_of else np.empty(0, np.int64)


def _noise(t: Array, psi: Array) -> float:
    """Return the standard deviation of what does not go on from sample to sample [rad]."""
    usual = float(np.median(np.diff(t)))
    found = 0.0
    for lag in (1, 2, 4, 8, 16):
        # between samples that were interpolated the noise shows at a longer lag only
        if lag == 1 or lag * usual <= _STEADY:
            bend = _wrapped(psi[2 * lag :] - psi[lag:-lag]) - _wrapped(
                psi[lag:-lag] - psi[: -2 * lag]
            )
            found = max(found, robust_deviation(bend) / np.sqrt(6))
    return found


def _bow(t: Array, psi: Array, low: int, high: int) -> float:
    """Return by how much a steady change of the rate of turn leaves the chord between two rows."""
    a, b = max(low - 3, 0), min(high + 3, len(psi) - 1)
    if a == low or b == high:
        return 0.0
    before = _wrapped(psi[low] - psi[a]) / (t[low] - t[a])
    after = _wrapped(psi[b] - psi[high]) / (t[b] - t[high])
    apart = 0.5 * (t[b] + t[high] - t[low] - t[a])
    return float(np.abs(after - before) / apart * (t[high] - t[low]) ** 2 / 8)


def _returning(psi: Array, edge: float, most: int, least: Array) -> list[int]:
    """Return samples that leave the wrap and come back to the side where they began.

    A heading that wavers about the wrap, at `edge`, crosses it twice between two samples; at
    either end of a log one side is missing.
    """
    step = np.abs(_wrapped(np.diff(psi)))
    # before the log begins and after it ends it may have been anywhere
    near = np.concatenate([[True], np.abs(_wrapped(psi - edge)) < np.median(least), [True]])
    leap = np.concatenate([[True], step > least, [True]])
    rows: list[int] = []
    for k in np.flatnonzero(near[:-1] & ~near[1:] & leap) + 1:
        back = np.flatnonzero(near[k : k + most + 1])
        if len(back) and leap[k + back[0] - 1]:
            rows += range(int(k) - 1, int(k + back[0]) - 1)
    return rows


def _wrapped(angle: Array) -> Array:
    return (angle + np.pi) % (2 * np.pi) - np.pi
