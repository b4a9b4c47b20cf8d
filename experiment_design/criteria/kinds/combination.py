"""c-optimality: the variance of one function of the parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING

from experiment_design.criteria.optimality import SumOfVariances

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


class _Combination(SumOfVariances):
    """−log of the variance of one combination."""

    def directions(self, scale: Array, combination: Array) -> Array:
        return combination[None]

    @property
    def combined(self) -> bool:
        return True


ENTRY = _Combination("c", "one function --of them", 3)
