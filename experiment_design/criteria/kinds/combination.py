"""c-optimality: the variance of one function of the parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING

from experiment_design.criteria.optimality import Optimality

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


class _Combination(Optimality):
    """−log of the variance of one combination."""

    def of_covariance(self, c: Array, scale: Array, combination: Array) -> Array:
        import numpy as np

        return np.asarray(-np.log(np.einsum("i,rij,j->r", combination, c, combination)))

    def slope(self, c: Array, scale: Array, combination: Array) -> Array:
        import numpy as np

        h = combination
        return np.asarray(-np.outer(h, h) / float(h @ c @ h))

    @property
    def combined(self) -> bool:
        return True


ENTRY = _Combination("c", "one function --of them", 3)
