"""Sums over samples with memory: the static algebra under every test.

Arrays only, one entry an experiment; lags never reach across experiments.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from greybox.estimation.covariance import flat_top

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


def robust_covariance(scores: Sequence[Array], lags: int) -> Array:
    """Return the covariance of Σ s by a flat-top kernel of 2·lags samples.

    References
    ----------
    Newey and West (1987); Politis (2003).
    """
    total = np.zeros((scores[0].shape[0],) * 2)
    for lag in range(2 * lags + 1):
        block = lagged_products(scores, scores, lag) * flat_top(lag, lags)
        total += block if lag == 0 else block + block.T
    return total


def quadratic_form(moments: Array, covariance: Array) -> tuple[float, int]:
    """Return mᵀ C⁺ m and the rank, in correlation units.

    Directions that carry less than 1e-9 of the largest variance are copies of others.
    """
    size = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    used = size > 1e-150
    if not used.any():
        return 0.0, 0
    scaled = covariance[np.ix_(used, used)] / np.outer(size[used], size[used])
    values, vectors = np.linalg.eigh((scaled + scaled.T) / 2)
    good = values > 1e-9 * values[-1]
    along = vectors[:, good].T @ (moments[used] / size[used])
    return float((along**2 / values[good]).sum()), int(good.sum())


def projection(z: Array, rows: Array) -> Array:
    """Return what instruments (q, N) explain of rows (k, N), by an orthonormal basis."""
    basis = orthonormal(z)
    return np.asarray((rows @ basis.T) @ basis)


def orthonormal(z: Array) -> Array:
    """Return an orthonormal basis of the rows of z, copies of one another left out."""
    size = np.linalg.norm(z, axis=1)
    z = z[size > 0] / size[size > 0, None]
    if not len(z):
        return z
    values, vectors = np.linalg.eigh(z @ z.T)
    good = values > 1e-12 * values[-1]
    basis = (vectors[:, good] / np.sqrt(values[good])).T @ z
    # a second pass: the squared moments lose half the digits
    return np.asarray(np.linalg.qr(basis.T)[0].T)
