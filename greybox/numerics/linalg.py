"""Inverses, roots and forms of symmetric matrices whose rows have units of their own."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# relative singular value of a scaled matrix below which a direction is rounding
ROUNDING = 1e-15
# relative eigenvalue of scaled normal equations below which a direction is not known
UNKNOWN = 1e-10
_TINY = 1e-300


def sizes(matrix: Array) -> Array:
    """Return the roots of the diagonal (..., n), a tiny number where that is nothing."""
    diagonal = np.diagonal(matrix, axis1=-2, axis2=-1)
    return np.asarray(np.sqrt(np.maximum(np.abs(diagonal), _TINY)))


def scaled(matrix: Array) -> tuple[Array, Array]:
    """Return the matrix with a diagonal of one (..., n, n), and what it was divided by."""
    size = sizes(matrix)
    outer = size[..., :, None] * size[..., None, :]
    return matrix / outer, outer


def scaled_inverse(matrix: Array, least: float = ROUNDING) -> Array:
    """Return the pseudo-inverse of a square matrix, its rows and columns scaled to one before.

    Parameters
    ----------
    matrix : ndarray
        (..., n, n) with a diagonal that tells the size of its rows.
    least : float
        Directions with less than this share of the largest singular value are left out.
    """
    unit, outer = scaled(matrix)
    return np.asarray(np.linalg.pinv(unit, rcond=least) / outer)


def bounded_step(
    normal: Array,
    gradient: Array,
    low: Array,
    high: Array,
    damping: float = 0.0,
    least: float = UNKNOWN,
) -> Array:
    """Minimise ½ δᵀNδ − gᵀδ within bounds, in the directions that are known.

    Parameters
    ----------
    normal : ndarray
        (q, q) positive semidefinite.
    gradient : ndarray
        (q,)
    low, high : ndarray
        (q,) bounds on δ.
    damping : float
        Levenberg-Marquardt share added to the diagonal.
    least : float
        Directions with less than this share of the largest eigenvalue are not known.

    References
    ----------
    Stark and Parker (1995), bounded-variable least squares.
    """
    from scipy.optimize import lsq_linear

    if not (np.isfinite(normal).all() and np.isfinite(gradient).all()):
        # where squares overflow there is no step
        return np.asarray(np.clip(0.0, low, high))
    scale, values, vectors = _directions(normal)
    values = np.where(values > least * values[-1], values, np.inf) + damping
    root = vectors / np.sqrt(values)
    step = (root @ (root.T @ (gradient / scale))) / scale
    if (step >= low).all() and (step <= high).all():
        return np.asarray(step)
    known = np.isfinite(values)
    factor = np.sqrt(values[known])[:, None] * vectors[:, known].T
    target = (vectors[:, known].T @ (gradient / scale)) / np.sqrt(values[known])
    # a direction that nothing determines stays where it is
    factor = np.vstack([factor, 1e-6 * np.eye(len(gradient))])
    target = np.concatenate([target, np.zeros(len(gradient))])
    free = low < high
    found = np.where(free, 0.0, low * scale)
    limits = (low[free] * scale[free], high[free] * scale[free])
    with np.errstate(over="ignore", invalid="ignore"):
        target = target - factor[:, ~free] @ found[~free]
        found[free] = lsq_linear(factor[:, free], target, limits, method="bvls").x
    return np.asarray(np.clip(np.where(np.isfinite(found), found, 0.0) / scale, low, high))


def known_and_unknown_inverse(normal: Array, least: float) -> tuple[Array, Array]:
    """Return the inverse (q, q) in two parts that add up: of what is known, and of what is not.

    What nothing determines gets a spread beyond every other.

    Parameters
    ----------
    normal : ndarray
        (q, q) positive semidefinite.
    least : float
        Directions with less than this share of the largest eigenvalue are not known.
    """
    scale, values, vectors = _directions(normal)
    floor = least * max(values[-1], _TINY)
    known = values > floor
    one, two = (
        (vectors[:, mine] / np.maximum(values[mine], floor)) @ vectors[:, mine].T
        for mine in (known, ~known)
    )
    outer = np.outer(scale, scale)
    return one / outer, two / outer


def _directions(normal: Array) -> tuple[Array, Array, Array]:
    """Return scales (q,), and eigenvalues and eigenvectors of a matrix in these scales."""
    scale = np.sqrt(np.maximum(np.diag(normal), 0.0))
    scale[scale == 0] = 1.0
    unit = normal / np.outer(scale, scale)
    values, vectors = np.linalg.eigh((unit + unit.T) / 2)
    return scale, values, vectors


def scaled_root(covariance: Array) -> Array:
    """Return L (n, n) with L Lᵀ = C, what rounding made negative cut at zero."""
    values, vectors = np.linalg.eigh(scaled(covariance)[0])
    return np.asarray(sizes(covariance)[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


def scaled_logdet(covariance: Array) -> Array:
    """Return log det C (...), infinite where C is not positive definite."""
    sign, found = np.linalg.slogdet(scaled(covariance)[0])
    return np.where(sign > 0, found + 2 * np.log(sizes(covariance)).sum(axis=-1), np.inf)


def trace_with_inverse(weight: Array, matrix: Array) -> float:
    """Return tr W A⁻¹ of a symmetric W (n, n) and A (n, n), infinite where A is not positive."""
    from scipy.linalg.lapack import dpotrf, dpotri

    # of a symmetric matrix the transpose is the same in the order that LAPACK reads
    factor, failed = dpotrf(matrix.T, lower=True)
    if failed:
        return np.inf
    # nothing stands above its diagonal
    inverse = dpotri(factor, lower=True)[0]
    return float(2 * np.vdot(weight, inverse.T) - np.diagonal(weight) @ np.diagonal(inverse))


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
    unit, _ = scaled(covariance[np.ix_(used, used)])
    values, vectors = np.linalg.eigh((unit + unit.T) / 2)
    good = values > least * values[-1]
    whitening = np.zeros((int(good.sum()), len(moments)))
    whitening[:, used] = (vectors[:, good] / np.sqrt(values[good])).T / size[used]
    return float(((whitening @ moments) ** 2).sum()), int(good.sum()), whitening


def tall_svd(rows: Array, unknown: float) -> tuple[Array, Array, Array]:
    """Return the singular value decomposition of many rows in few columns, by QR first.

    Parameters
    ----------
    rows : ndarray
        (n, q), n much larger than q.
    unknown : float
        Singular values below this share of the largest are left out.

    Returns
    -------
    left, values, right : ndarray
        (n, k), (k,) and (k, q).
    """
    orthogonal, triangle = np.linalg.qr(rows)
    left, values, right = np.linalg.svd(triangle)
    kept = values > unknown * values[0]
    return orthogonal @ left[:, kept], values[kept], right[kept]
