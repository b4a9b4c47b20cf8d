"""The error of a free run against another quantity, with intervals that allow for its memory.

The error of a simulation is a long-memory series: a mean over n samples is worth far fewer
than n. Its samples are therefore grouped into blocks longer than that memory, and blocks
vary independently.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.numerics.lagged_moments import lagged_sums

Array = NDArray[np.float64]
Index = NDArray[np.intp]

LEVEL = 0.95
# blocks below which a mean has no interval that says anything
_FEWEST = 3
# autocorrelation from which on a series has forgotten
_FORGOTTEN = 0.1


@dataclass(frozen=True)
class Profile:
    """Mean of a signal by group.

    Parameters
    ----------
    mean : ndarray
        (G,) NaN for a group without samples.
    half : ndarray
        (G,) half of the 95 % interval, NaN where too few blocks saw the group.
    samples : ndarray of int
        (G,)
    """

    mean: Array
    half: Array
    samples: Index


def memory(error: Array) -> int:
    """Return after how many samples a series (N,) has forgotten its value, at least 1."""
    e = error - error.mean()
    covariance = lagged_sums([e], [e], len(e) - 1)
    if covariance[0] <= 0:
        return 1
    below = np.flatnonzero(covariance < _FORGOTTEN * covariance[0])
    return int(max(below[0], 1)) if len(below) else len(e)


def block_ids(errors: Sequence[Array]) -> Index:
    """Return the block of each sample (N,) of several series put end to end.

    Parameters
    ----------
    errors : sequence of ndarray
        One per log.
    """
    out, first = [], 0
    for error in errors:
        size = max(memory(error), round(len(error) ** 0.5))
        ids = np.arange(len(error)) // size
        out.append(ids + first)
        first += int(ids[-1]) + 1
    return np.concatenate(out)


def profile(value: Array, group: Index, blocks: Index, groups: int) -> Profile:
    """Return the mean of a signal by group.

    Parameters
    ----------
    value : ndarray
        (N,)
    group : ndarray of int
        (N,) group of each sample, negative for none.
    blocks : ndarray of int
        (N,) as `block_ids` returns them.
    groups : int

    References
    ----------
    Liang and Zeger (1986), the variance of a mean over clusters.
    """
    from scipy.stats import t

    mean, half = np.full(groups, np.nan), np.full(groups, np.nan)
    samples = np.zeros(groups, np.intp)
    for g in range(groups):
        inside = group == g
        samples[g] = inside.sum()
        if not samples[g]:
            continue
        mean[g] = value[inside].mean()
        _, own = np.unique(blocks[inside], return_inverse=True)
        sums = np.bincount(own, value[inside] - mean[g])
        count = len(sums)
        if count >= _FEWEST:
            variance = (sums**2).sum() / samples[g] ** 2 * count / (count - 1)
            half[g] = t.ppf(0.5 + LEVEL / 2, count - 1) * np.sqrt(variance)
    return Profile(mean, half, samples)
