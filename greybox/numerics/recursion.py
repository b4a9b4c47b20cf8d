"""Linear recursions over samples, all columns and all runs at once.

S(k+1) = A(k) S(k) + B(k) is linear in S(0): stretches of samples are followed side by
side from nothing, and what each begins with is added afterwards. With few columns the
recursion is one banded triangular system in all samples, which a library solves sooner.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtbtrs

Array = NDArray[np.float64]

# up to this many columns, of fewer states, the banded system is the faster way
_FEW = 8
# from this many runs on a step of all of them together is work enough
_MANY = 16


def propagate(a: Array, b: Array, start: Array) -> Array:
    """Return S with S(0) = start and S(k+1) = A(k) S(k) + B(k).

    Parameters
    ----------
    a : ndarray
        (..., N−1, n, n)
    b : ndarray
        (..., N−1, n, m)
    start : ndarray
        (..., n, m)

    Returns
    -------
    ndarray
        (..., N, n, m), infinite where it leaves the numbers' range.
    """
    lead, (steps, n, columns) = b.shape[:-3], b.shape[-3:]
    runs = math.prod(lead)
    a, b = a.reshape(runs, steps, n, n), b.reshape(runs, steps, n, columns)
    out = np.empty((steps + 1, runs, n, columns)) if runs >= _MANY else None
    found = np.empty((runs, steps + 1, n, columns)) if out is None else out.swapaxes(0, 1)
    found[:, 0] = start.reshape(runs, n, columns)
    if found.size and steps:
        with np.errstate(over="ignore", invalid="ignore"):
            if out is not None:
                _stepped(a, b, out)
            elif columns <= _FEW and n < _FEW:
                for each in zip(a, b, found, strict=True):
                    _banded(*each)
            else:
                _stretched(a, b, found)
        # what has left the range does not come back
        if not np.isfinite(found[:, -1]).all():
            found[~np.isfinite(found)] = np.inf
    return found.reshape(*lead, steps + 1, n, columns)


def decay(share: float, b: Array) -> Array:
    """Return y with y(0) = b(0) and y(k+1) = share·y(k) + b(k+1), along axis 0 of b (N, …)."""
    columns = np.array(b.reshape(len(b), -1), order="F")
    band = np.vstack([np.ones(len(b)), np.full(len(b), -share)])
    solved, _ = dtbtrs(band, columns, uplo="L", diag="U", overwrite_b=True)
    return np.asarray(solved.reshape(b.shape))


def _stepped(a: Array, b: Array, out: Array) -> None:
    """Fill out (N, M, n, m) behind the first sample of all runs."""
    after, own = (np.ascontiguousarray(x.swapaxes(0, 1)) for x in (a, b))
    for k in range(len(after)):
        np.matmul(after[k], out[k], out=out[k + 1])
        out[k + 1] += own[k]


def _banded(a: Array, b: Array, out: Array) -> None:
    """Fill out (N, n, m) of one run behind its first sample."""
    steps, n, columns = b.shape
    out[1:] = b
    out[1] += a[0] @ out[0]
    band = np.zeros((2 * n, steps * n))
    # row (k, i) and column (k−1, j) lie n + i − j below the diagonal of ones
    for i in range(n):
        for j in range(n):
            band[n + i - j, j : (steps - 1) * n : n] = -a[1:, i, j]
    solved, _ = dtbtrs(band, out[1:].reshape(steps * n, columns), uplo="L", diag="U")
    out[1:] = solved.reshape(steps, n, columns)


def _stretched(a: Array, b: Array, out: Array) -> None:
    """Fill out (M, N, n, m) behind the first sample of each run."""
    runs, steps, n, columns = b.shape
    length = math.isqrt(steps)
    count = steps // length
    whole = count * length

    def cut(x: Array) -> Array:
        return x[:, :whole].reshape(runs, count, length, n, -1)

    after, own, filled = cut(a), cut(b), cut(out[:, 1:])
    # what the first state of a stretch becomes along it
    carried = np.empty((runs, count, length, n, n))
    carried[:, :, 0], filled[:, :, 0] = after[:, :, 0], own[:, :, 0]
    for k in range(1, length):
        np.matmul(after[:, :, k], filled[:, :, k - 1], out=filled[:, :, k])
        filled[:, :, k] += own[:, :, k]
        np.matmul(after[:, :, k], carried[:, :, k - 1], out=carried[:, :, k])
    first = out[:, 0]
    for c in range(count):
        begun = carried[:, c].reshape(runs, length * n, n) @ first
        filled[:, c] += begun.reshape(runs, length, n, columns)
        first = filled[:, c, -1]
    for k in range(whole, steps):
        out[:, k + 1] = a[:, k] @ out[:, k] + b[:, k]
