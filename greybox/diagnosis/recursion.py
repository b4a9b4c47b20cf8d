"""Linear recursions over a log, all columns at once.

S(k+1) = A(k) S(k) + B(k) is one banded triangular system in all samples, so that a
library's solver takes the place of a loop.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_banded

Array = NDArray[np.float64]


def propagate(a: Array, b: Array, start: Array) -> Array:
    """Return S with S(0) = start and S(k+1) = A(k) S(k) + B(k).

    Parameters
    ----------
    a : ndarray
        (N−1, n, n)
    b : ndarray
        (N−1, n, m)
    start : ndarray
        (n, m)

    Returns
    -------
    ndarray
        (N, n, m)
    """
    steps, n, _ = a.shape
    columns = b.shape[2]
    out = np.empty((steps + 1, n, columns))
    out[0] = start
    if steps == 0 or columns == 0:
        return out
    driven = b.copy()
    driven[0] += a[0] @ start
    band = np.zeros((2 * n, steps * n))
    band[0] = 1.0
    # row (k, i) and column (k−1, j) lie n + i − j below the diagonal
    for i in range(n):
        for j in range(n):
            band[n + i - j, j : (steps - 1) * n : n] = -a[1:, i, j]
    try:
        solved = solve_banded(
            (2 * n - 1, 0), band, driven.reshape(steps * n, columns), check_finite=False
        )
    except np.linalg.LinAlgError:
        # of a run at the edge of stability the derivatives leave every number's range
        out[1:] = np.inf
        return out
    out[1:] = solved.reshape(steps, n, columns)
    return out
