"""A-optimality: the mean relative variance."""

from __future__ import annotations

from typing import TYPE_CHECKING

from experiment_design.criteria.optimality import SumOfVariances

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


class _Trace(SumOfVariances):
    """−log of the mean relative variance."""

    def directions(self, scale: Array, combination: Array) -> Array:
        import numpy as np

        return np.diag(1 / (scale * np.sqrt(len(scale))))


ENTRY = _Trace("A", "relative trace", 1)
