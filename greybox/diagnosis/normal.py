"""An inverse of normal equations that unknown directions do not break."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# eigenvalue of the scaled matrix below which a direction stays as it is
_UNKNOWN = 1e-9


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
