"""Band of the inverse of a banded matrix, all its blocks at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def factor_band(band: Array) -> Array | None:
    """Return the Cholesky factor of a symmetric matrix, both as lower bands; None if not positive.

    Parameters
    ----------
    band : ndarray
        (b + 1, n), the diagonal first.
    """
    from scipy.linalg.lapack import dpbtrf

    factor, info = dpbtrf(band, lower=1)
    return np.asarray(factor) if info == 0 and np.isfinite(factor[0]).all() else None


def inverse_band(band: Array, size: int, factor: Array | None = None) -> Array:
    """Return the band of the inverse of a symmetric positive block-tridiagonal matrix.

    With D⁺ the pivots of block elimination from the first block on and D⁻ those from the last
    one back, the blocks of the inverse are (D⁺ + D⁻ − A)⁻¹ on the diagonal and, below it,
    minus those times A (D⁺)⁻¹. Both eliminations are LAPACK's, the rest has no recursion.

    Parameters
    ----------
    band : ndarray
        (b + 1, n) lower band, the diagonal first.
    size : int
        Rows of a block: none but neighbouring blocks are tied.
    factor : ndarray, optional
        Cholesky factor of the matrix, where it is known (b + 1, n).

    Returns
    -------
    ndarray
        (b + 1, n), alike. Not finite where the matrix is not positive.

    References
    ----------
    Meurant (1992).
    """
    width, n = band.shape
    count = -(-n // size)

    def padded(x: Array) -> Array:
        out = np.zeros((width, count * size))
        out[0] = 1.0
        out[:, :n] = x
        return out

    whole = padded(band)
    root = factor_band(whole) if factor is None else padded(factor)
    reverse = np.zeros_like(whole)
    for d, entries in enumerate(whole):
        entries = entries[: whole.shape[1] - d]
        reverse[d, : len(entries)] = entries[::-1]
    own = _blocks(whole, size)
    own += np.tril(np.ones((size, size)), -1).T[:, :, None] * own.transpose(1, 0, 2)
    tie = _blocks(whole, size, 1)[:, :, :-1]
    forth = _pivots(root, whole.shape, size)
    back = _pivots(factor_band(reverse), whole.shape, size)[::-1, ::-1, ::-1]
    same = _inverse(forth + back - own)
    below = -_times(_times(same[:, :, 1:], tie), _inverse(forth)[:, :, :-1])
    out = np.zeros((width, count, size))
    for d in range(width):
        for j in range(size):
            if d + j < size:
                out[d, :, j] = same[d + j, j]
            else:
                out[d, :-1, j] = below[d + j - size, j] if d + j < 2 * size else 0.0
    return out.reshape(width, -1)[:, :n]


def _blocks(band: Array, size: int, below: int = 0) -> Array:
    """Return the entries of a lower band block by block, (size, size, count)."""
    entries = band.reshape(len(band), -1, size)
    out = np.zeros((size, size, entries.shape[1]))
    for i in range(size):
        for j in range(size):
            d = below * size + i - j
            if 0 <= d < len(band):
                out[i, j] = entries[d, :, j]
    return out


def _pivots(factor: Array | None, shape: tuple[int, ...], size: int) -> Array:
    """Return the blocks that elimination from the first one on leaves on the diagonal."""
    root = _blocks(np.full(shape, np.nan) if factor is None else factor, size)
    return _times(root, root.transpose(1, 0, 2))


def _times(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum("ijk,jlk->ilk", a, b))


def _inverse(a: Array) -> Array:
    """Return the inverses of positive blocks (m, m, K) by Gauss-Jordan elimination."""
    out = a.copy()
    for k in range(len(out)):
        column, pivot = out[:, k].copy(), 1.0 / out[k, k]
        row = out[k] * pivot
        out -= column[:, None] * row
        out[k], out[:, k], out[k, k] = row, -column * pivot, pivot
    return out
