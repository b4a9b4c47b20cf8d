"""E-optimality: the largest relative variance of any direction."""

from __future__ import annotations

from typing import TYPE_CHECKING

from experiment_design.criteria.optimality import Optimality

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

# exponent of the norm that stands for the largest eigenvalue while climbing
_SHARP = 8


class _Largest(Optimality):
    """−log of the largest relative variance, climbed as −log of a norm of the eigenvalues."""

    def of_covariance(self, c: Array, scale: Array, combination: Array) -> Array:
        import numpy as np

        relative = c / np.outer(scale, scale)
        return np.asarray(-np.log(np.linalg.eigvalsh(relative)[:, -1]))

    def slope(self, c: Array, scale: Array, combination: Array) -> Array:
        import numpy as np

        outer = np.outer(scale, scale)
        values, vectors = np.linalg.eigh(c / outer)
        share = values / values[-1]
        power = share ** (_SHARP - 1) / (share**_SHARP).sum() / values[-1]
        return np.asarray(-(vectors * power) @ vectors.T / outer)

    def climbed(self, c: Array, scale: Array, combination: Array) -> float:
        import numpy as np

        values = np.linalg.eigh(c / np.outer(scale, scale))[0]
        share = values / values[-1]
        return float(-np.log(values[-1]) - np.log((share**_SHARP).sum()) / _SHARP)

    def slack(self, size: int) -> float:
        import numpy as np

        return float(np.log(size) / _SHARP)


ENTRY = _Largest("E", "worst direction", 2)
