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
    from scipy.optimize import lsq_linear

    scale = np.sqrt(np.maximum(np.diag(normal), 0.0))
    scale[scale == 0] = 1.0
    values, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
    known = values > _UNKNOWN
    root, basis = np.sqrt(values[known] + damping), vectors[:, known]
    right = (basis.T @ (gradient / scale)) / root
    step = np.asarray(basis @ (right / root) / scale)
    if ((low <= step) & (step <= high)).all():
        return step
    # those that stop move what is best for the others, and some of them off their bounds again
    step = np.clip(np.zeros(len(gradient)), low, high)
    free = low < high
    rows = root[:, None] * basis.T
    limits = (low[free] * scale[free], high[free] * scale[free])
    away = right - rows[:, ~free] @ (step[~free] * scale[~free])
    step[free] = lsq_linear(rows[:, free], away, limits, method="bvls").x / scale[free]
    return np.clip(step, low, high)


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
