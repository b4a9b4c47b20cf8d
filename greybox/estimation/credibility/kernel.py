"""Sums over samples with memory: the static algebra under every test.

Arrays only, one entry an experiment; lags never reach across experiments.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def lagged_products(a: Sequence[Array], b: Sequence[Array], lag: int) -> Array:
    """Return Σ a(k+lag) b(k)ᵀ over all experiments, (ka, kb)."""
    total = np.zeros((a[0].shape[0], b[0].shape[0]))
    for x, y in zip(a, b, strict=True):
        if x.shape[1] > lag:
            total += x[:, lag:] @ y[:, : y.shape[1] - lag].T
    return total


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
    out = []
    for lag in range(lags + 1):
        pairs = sum(int((k[lag:] & k[: len(k) - lag]).sum()) for k in keep if len(k) > lag)
        out.append(lagged_products(errors, errors, lag) * correction / max(pairs, 1))
    return out


def independent_covariance(z: Sequence[Array], gamma: Sequence[Array]) -> Array:
    """Return the covariance of Σ z e for instruments independent of scalar errors, Σ Z R Zᵀ.

    References
    ----------
    Ljungberg (2020), eq. 2.21.
    """
    total = np.zeros((z[0].shape[0],) * 2)
    for lag, value in enumerate(gamma):
        block = lagged_products(z, z, lag) * float(value.item())
        total += block if lag == 0 else block + block.T
    return total


def quadratic_form(
    moments: Array, covariance: Array, least: float = 1e-9
) -> tuple[float, int, Array]:
    """Return mᵀ C⁺ m, the rank, and the whitening W with W C Wᵀ = I, (rank, k).

    Works in correlation units; directions that carry less than `least` of the
    largest variance are left out.
    """
    size = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    used = np.flatnonzero(size > 1e-150)
    if not len(used):
        return 0.0, 0, np.zeros((0, len(moments)))
    scaled = covariance[np.ix_(used, used)] / np.outer(size[used], size[used])
    values, vectors = np.linalg.eigh((scaled + scaled.T) / 2)
    good = values > least * values[-1]
    whitening = np.zeros((int(good.sum()), len(moments)))
    whitening[:, used] = (vectors[:, good] / np.sqrt(values[good])).T / size[used]
    return float(((whitening @ moments) ** 2).sum()), int(good.sum()), whitening
