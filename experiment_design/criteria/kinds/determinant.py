"""D-optimality: the determinant of the covariance."""

from __future__ import annotations

from typing import TYPE_CHECKING

from experiment_design.criteria.optimality import Optimality

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


class _Determinant(Optimality):
    """−log det C."""

    def of_covariance(self, c: Array, scale: Array, combination: Array) -> Array:
        from greybox.numerics.linalg import scaled_logdet

        return -scaled_logdet(c)

    def slope(self, c: Array, scale: Array, combination: Array) -> Array:
        from greybox.numerics.linalg import scaled_inverse

        return -scaled_inverse(c)

    @property
    def determinant(self) -> bool:
        return True


ENTRY = _Determinant("D", "determinant", 0)
