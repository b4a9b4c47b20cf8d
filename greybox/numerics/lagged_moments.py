"""Sums over samples with memory. Arrays only, one entry an experiment, which no lag leaves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def lagged_products(a: Sequence[Array], b: Sequence[Array], lag: int) -> Array:
    """Return Σ a(k+lag) b(k)ᵀ over all experiments, (ka, kb).

    Parameters
    ----------
    a, b : sequence of ndarray
        (ka, N) and (kb, N).
    lag : int
        Of either sign.
    """
    if lag < 0:
        return lagged_products(b, a, -lag).T
    total = np.zeros((a[0].shape[0], b[0].shape[0]))
    for x, y in zip(a, b, strict=True):
        if x.shape[1] > lag:
            total += x[:, lag:] @ y[:, : y.shape[1] - lag].T
    return total


def lagged_sums(a: Sequence[Array], b: Sequence[Array], reach: int) -> Array:
    """Return Σ a(k+j) b(k) over all experiments for j = 0 … reach, row by row, by FFT.

    Parameters
    ----------
    a, b : sequence of ndarray
        (..., N), of shapes that broadcast to each other.
    reach : int

    Returns
    -------
    ndarray
        (..., reach + 1)
    """
    from scipy.fft import irfft, next_fast_len, rfft

    total: Array | float = 0.0
    for x, y in zip(a, b, strict=True):
        # as many lags of an experiment without samples: all are 0
        size = next_fast_len(max(x.shape[-1], 1) + reach, real=True)
        left = rfft(x, size)
        right = left if y is x else rfft(y, size)
        total = total + irfft(left * right.conj(), size)[..., : reach + 1]
    return np.asarray(total)


def convolve(rows: Array, weights: Array) -> Array:
    """Return Σ_j weights(j) rows(k−j) for k within the rows, row by row, by FFT.

    Parameters
    ----------
    rows, weights : ndarray
        (..., N) and (..., J), of shapes that broadcast to each other.
    """
    from scipy.fft import irfft, next_fast_len, rfft

    samples = rows.shape[-1]
    size = next_fast_len(samples + weights.shape[-1] - 1, real=True)
    return np.asarray(irfft(rfft(rows, size) * rfft(weights, size), size)[..., :samples])


def pairs(keep: Sequence[NDArray[np.bool_]], lag: int) -> int:
    """Return how many samples take part together with the one `lag` before them."""
    return sum(int((k[lag:] & k[: len(k) - lag]).sum()) for k in keep if len(k) > lag)


def autocovariance(
    errors: Sequence[Array], keep: Sequence[NDArray[np.bool_]], lags: int, lost: float = 0.0
) -> list[Array]:
    """Return Γ(0) … Γ(lags) of vector errors, divided by the pairs that take part.

    Parameters
    ----------
    errors : sequence of ndarray
        (m, N) an experiment, zero in rows that do not take part.
    keep : sequence of ndarray of bool
    lags : int
    lost : float
        Degrees of freedom that estimated coefficients took.
    """
    total = sum(int(k.sum()) for k in keep)
    correction = total / max(total - lost, 1.0)
    return [
        lagged_products(errors, errors, lag) * correction / max(pairs(keep, lag), 1)
        for lag in range(lags + 1)
    ]


def bartlett(lags: int) -> list[float]:
    """Return the weights 1 − j/(lags + 1) of the lags j = 0 … lags (Newey and West, 1987)."""
    return [1 - lag / (lags + 1) for lag in range(lags + 1)]


def flat_top(lags: int) -> list[float]:
    """Return the weights of the lags j = 0 … 2·lags, 1 up to `lags` (Politis, 2003)."""
    return [min(1.0, (2 * lags + 1 - lag) / (lags + 1)) for lag in range(2 * lags + 1)]


def weighted_lags(rows: Sequence[Array], weights: Sequence[float | Array]) -> Array:
    """Return Σ_j w(j) Σ_k r(k) r(k−j)ᵀ over lags of both signs and all experiments, (m, m).

    With autocovariances of errors as weights it is the covariance of Σ r e for rows
    independent of the errors; with the weights of a kernel and scores as rows, a covariance
    that is robust to memory.

    Parameters
    ----------
    rows : sequence of ndarray
        (m, N) an experiment.
    weights : sequence of float or ndarray
        At the lags 0, 1, …, a number or element by element; w(−j) = w(j)ᵀ.

    References
    ----------
    Ljungberg (2020), eq. 2.21; Newey and West (1987).
    """
    total = np.zeros((rows[0].shape[0],) * 2)
    longest = max(r.shape[1] for r in rows)
    for lag, weight in enumerate(weights[:longest]):
        block = weight * lagged_products(rows, rows, lag)
        total += block if lag == 0 else block + block.T
    return total


def bartlett_sums(rows: Array, lags: int) -> Array:
    """Return `weighted_lags` of rows (N, m) with the weights of `bartlett`, in one product.

    The mean over all windows of ``lags + 1`` samples of the square of their sum.
    """
    width = min(lags, len(rows) - 1) + 1
    sums = np.cumsum(np.pad(rows, ((width, width - 1), (0, 0))), axis=0)
    windows = sums[width:] - sums[:-width]
    return np.asarray(windows.T @ windows / width)


def lag_one_correlation(series: Array) -> Array:
    """Return the lag-one correlation of each column of a series (N, m), (m,)."""
    square = (series**2).sum(axis=0)
    square[square == 0] = 1.0
    return np.asarray((series[1:] * series[:-1]).sum(axis=0) / square)


def correlation_factor(series: Array) -> float:
    """Return by how much memory raises the variance of a mean of a series (N, m); at least 1.

    That of a first-order autoregression with the lag-one correlation, averaged over columns.
    """
    rho = np.clip(lag_one_correlation(series), 0.0, 1 - 1 / max(len(series), 2))
    return float(np.mean((1 + rho) / (1 - rho)))


def automatic_lags(series: Array) -> int:
    """Return the lags of `bartlett` that suit the memory of a series (N, m).

    References
    ----------
    Andrews (1991), eq. 6.2 and 6.4, a first-order autoregression for each column.
    """
    rho = np.clip(lag_one_correlation(series), -0.99, 0.99)
    alpha = np.mean(4 * rho**2 / ((1 - rho) ** 2 * (1 + rho) ** 2))
    return int(min(np.ceil(1.1447 * (alpha * len(series)) ** (1 / 3)), len(series) // 4))
