"""Normal equations: a bounded step, and an inverse that unknown directions do not break."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# eigenvalue of the scaled matrix below which a direction stays as it is
_UNKNOWN = 1e-9


def bounded_step(normal: Array, gradient: Array, low: Array, high: Array, damping: float) -> Array:
    """Minimise ½ δᵀNδ − gᵀδ; numbers that would leave their bounds stop there.

    Parameters
    ----------
    normal : ndarray
        (q, q)
    gradient : ndarray
        (q,)
    low, high : ndarray
        (q,) of δ.
    damping : float
        Levenberg-Marquardt share.
    """
    step = np.zeros(len(gradient))
    free = np.ones(len(gradient), bool)
    for _ in range(len(gradient)):
        part = np.ix_(free, free)
        right = gradient[free] - normal[np.ix_(free, ~free)] @ step[~free]
        step[free] = _solve(normal[part], right, damping)
        outside = free & ((step < low) | (step > high))
        if not outside.any():
            break
        step[outside] = np.clip(step, low, high)[outside]
        free &= ~outside
    return step


def inverses(normal: Array) -> tuple[Array, Array]:
    """Return the inverse (q, q) in two parts that add up: of what is known, and of what is not.

    What nothing determines gets a spread beyond every other.
    """
    scale = np.sqrt(np.maximum(np.diag(normal), 0.0))
    scale[scale == 0] = 1.0
    values, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
    least = _UNKNOWN * max(values[-1], 1e-300)
    known = values > least
    parts = (
        (vectors[:, mine] / np.maximum(values[mine], least)) @ vectors[:, mine].T
        for mine in (known, ~known)
    )
    one, two = (part / np.outer(scale, scale) for part in parts)
    return one, two


def _solve(normal: Array, right: Array, damping: float) -> Array:
    scale = np.sqrt(np.maximum(np.diag(normal), 0.0))
    scale[scale == 0] = 1.0
    values, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
    inverse = np.where(values > _UNKNOWN, 1 / (np.maximum(values, _UNKNOWN) + damping), 0.0)
    return np.asarray(vectors @ (inverse * (vectors.T @ (right / scale))) / scale)
