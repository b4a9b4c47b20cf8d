"""A-optimality: the mean relative variance."""

from __future__ import annotations

from typing import TYPE_CHECKING

from experiment_design.criteria.optimality import Optimality

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


class _Trace(Optimality):
    """−log of the mean relative variance."""

    def of_covariance(self, c: Array, scale: Array, combination: Array) -> Array:
        import numpy as np

        relative = c / np.outer(scale, scale)
        return np.asarray(-np.log(np.trace(relative, axis1=1, axis2=2) / len(scale)))

    def slope(self, c: Array, scale: Array, combination: Array) -> Array:
        import numpy as np

        return np.asarray(-np.diag(1 / scale**2) / float(np.trace(c / np.outer(scale, scale))))


ENTRY = _Trace("A", "relative trace", 1)
