"""The definition of a gap in time, for sensors and for logs."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# a sensor that loses one value goes on as before, and one that loses two has a hole
HOLE = 2.5
# a log has every sample: halfway to the next but one, a sample is missing
GAP = 1.5
# share of steps past a hole's length that makes a clock bursty
_BURSTY = 0.15


def usual_step(t: Array) -> float:
    """Return the usual step of increasing times [s], 0 where there is none."""
    steps = np.diff(t)
    period = float(np.median(steps)) if len(steps) else 0.0
    # merged or bursty clocks have many short steps: the usual one carries half of the time;
    # holes are few, however long
    if len(steps) and float(np.mean(steps > HOLE * period)) > _BURSTY:
        order = np.sort(steps)
        share = np.cumsum(order)
        period = float(order[np.searchsorted(share, share[-1] / 2)])
    return period


def pieces(t: Array, longest: float) -> list[tuple[int, int]]:
    """Return the pieces between steps that are longer than `longest`.

    Parameters
    ----------
    t : ndarray
        (N,) increasing [s].
    longest : float
        [s]: `HOLE` usual steps of a sensor, `GAP` sample times of a log.

    Returns
    -------
    list of (int, int)
        First index of each piece, and the one after its last.
    """
    if len(t) == 0:
        return []
    breaks = np.flatnonzero(np.diff(t) > longest) + 1
    return list(pairwise([0, *breaks.tolist(), len(t)]))


def runs(keep: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return (start, stop) of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], keep, [False]])))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def split_at_gaps(t: Array, sample_time: float) -> list[tuple[int, int]]:
    """Return the pieces of a log's times (N,) [s] between its gaps, as `pieces` does."""
    return pieces(t, GAP * sample_time)


def bridge(value: Array, known: NDArray[np.bool_]) -> Array:
    """Return a signal (N,) with straight lines where it is not known, its ends as they are."""
    k = np.flatnonzero(known)
    if len(k) < 2 or len(k) == len(value):
        return value
    out = value.copy()
    inner = np.arange(k[0], k[-1] + 1)
    out[inner] = np.interp(inner, k, value[k])
    return out


def joined_spans(
    spans: Iterable[tuple[float, float, int]], sample_time: float
) -> list[tuple[float, float, int]]:
    """Join spans that follow each other without a gap.

    Parameters
    ----------
    spans : iterable of (float, float, int)
        First and last time [s] and count of samples, in order of time.
    sample_time : float
        [s]
    """
    joined: list[tuple[float, float, int]] = []
    for start, stop, count in spans:
        if joined and start - joined[-1][1] <= GAP * sample_time:
            first, _, before = joined.pop()
            joined.append((first, stop, before + count))
        else:
            joined.append((start, stop, count))
    return joined
