"""Which samples of a long log a line on a page needs."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from greybox.trial.gaps import split_at_gaps

Array = NDArray[np.float64]
Index = NDArray[np.intp]


def points_for(curves: int, *, most: int = 2000, room: int = 60_000) -> int:
    """Return how many points each of a page's curves may have so that the page stays light.

    Parameters
    ----------
    curves : int
        Of all pictures of the page together; both edges of a band count.
    most : int
        For a page of few curves.
    room : int
        Points of all of them together; every curve has at least 150.
    """
    return int(np.clip(room // max(curves, 1), 150, most))


def find_gaps(t: Array, sample_time: float) -> Index:
    """Return the samples after which one is missing.

    Parameters
    ----------
    t : ndarray
        (N,) time, increasing [s].
    sample_time : float
        Ts [s].

    Returns
    -------
    ndarray of int
        (G,) k with a gap from ``t[k]`` to ``t[k + 1]``.
    """
    return np.array([stop - 1 for _, stop in split_at_gaps(t, sample_time)[:-1]], np.intp)


def longest(gaps: Index, t: Array, most: int) -> Index:
    """Return the `most` longest of some gaps, in order of time.

    Parameters
    ----------
    gaps : ndarray of int
        (G,), as `find_gaps` returns them.
    t : ndarray
        (N,) [s]
    most : int
    """
    if len(gaps) <= most:
        return gaps
    kept = np.argsort(t[gaps + 1] - t[gaps])[len(gaps) - most :]
    return np.sort(gaps[kept])


def thin(gaps: Index, *values: Array, points: int = 2000) -> Index:
    """Return the samples that draw some signals without losing a peak.

    Each of `points` / 2 stretches (shared by several signals) keeps the samples
    with its least and its greatest value, so the drawn line has the envelope of
    the whole one; every gap ends one stretch and begins another.

    Parameters
    ----------
    gaps : ndarray of int
        (G,) samples after which the line is interrupted.
    *values : ndarray
        (N,) each; several where one line needs them together, as a track does.
    points : int
        About how many samples to keep; all are kept where the log has no more.

    Returns
    -------
    ndarray of int
        Samples in order of time, −1 at each gap: see `pick`.
    """
    size = len(values[0])
    kept = np.arange(size)
    if size > points:
        count = max(points // (2 * len(values)), 1)
        edges = np.unique(np.r_[np.linspace(0, size, count + 1).astype(np.intp), gaps + 1])
        # the ends of each unbroken piece, so that lines reach the gaps
        found = [np.r_[0, gaps, gaps + 1, size - 1]]
        for value in values:
            bins = [value[a:b] for a, b in pairwise(edges)]
            found.append(edges[:-1] + np.array([b.argmin() for b in bins]))
            found.append(edges[:-1] + np.array([b.argmax() for b in bins]))
        kept = np.unique(np.concatenate(found))
    return np.insert(kept, np.searchsorted(kept, gaps, side="right"), -1)


def pick(value: Array, index: Index) -> Array:
    """Return the samples that `thin` chose, NaN (which breaks a line) at the gaps."""
    return np.where(index < 0, np.nan, value[index])
