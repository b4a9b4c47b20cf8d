"""Optimality criteria by name: the function of the wanted parameters' covariance to minimise.

Every criterion is a number that grows with the information, in logarithms, so that
they share one scale. Another distribution adds its own by an entry point.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from greybox.registry import Registry

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


# exponent of the norm that stands for the largest eigenvalue while climbing
_SHARP = 8


@dataclass(frozen=True)
class Optimality(ABC):
    """A scalar of covariances, larger where they are smaller.

    ``scale`` (p,) is the unit of each parameter, ``combination`` (p,) the gradient of the
    function of the parameters that is looked at.

    Parameters
    ----------
    name : str
        As ``--criterion`` takes it.
    words : str
        What it looks at.
    """

    name: str
    words: str
    # whether it is −log det: of one variance for each parameter together
    determinant: ClassVar[bool] = False
    # whether it looks at one combination of the parameters
    combined: ClassVar[bool] = False

    @abstractmethod
    def of_covariance(self, c: Array, scale: Array, combination: Array) -> Array:
        """Return the criterion of covariances (R, p, p)."""

    @abstractmethod
    def slope(self, c: Array, scale: Array, combination: Array) -> Array:
        """Return the derivative of what is climbed in a covariance (p, p)."""

    def climbed(self, c: Array, scale: Array, combination: Array) -> float:
        """Return what is climbed at a covariance (p, p): the criterion, or a smooth stand-in."""
        return float(self.of_covariance(c[None], scale, combination)[0])

    def slack(self, size: int) -> float:
        """Return how much what is climbed may lie below the criterion, of so many parameters."""
        return 0.0

    def directions(self, scale: Array, combination: Array) -> Array | None:
        """Return directions (k, p) whose variances it adds up, None where it is no such sum."""
        return None

    def shared_by(self, size: int) -> int:
        """Return how many variances it counts together: a gain over that is one of time."""
        return size if self.determinant else 1


class SumOfVariances(Optimality):
    """−log of the sum of the variances along some directions."""

    @abstractmethod
    def directions(self, scale: Array, combination: Array) -> Array:
        """Return them, (k, p)."""

    def of_covariance(self, c: Array, scale: Array, combination: Array) -> Array:
        """Return the criterion of covariances (R, p, p)."""
        import numpy as np

        along = self.directions(scale, combination)
        return np.asarray(-np.log(np.einsum("ki,rij,kj->r", along, c, along)))

    def slope(self, c: Array, scale: Array, combination: Array) -> Array:
        """Return its derivative in a covariance (p, p)."""
        along = self.directions(scale, combination)
        return -(along.T @ along) / float((along @ c * along).sum())


class _Combination(SumOfVariances):
    """−log of the variance of one combination."""

    combined = True

    def directions(self, scale: Array, combination: Array) -> Array:
        return combination[None]


class _Trace(SumOfVariances):
    """−log of the mean relative variance."""

    def directions(self, scale: Array, combination: Array) -> Array:
        import numpy as np

        return np.diag(1 / (scale * np.sqrt(len(scale))))


class _Determinant(Optimality):
    """−log det C."""

    determinant = True

    def of_covariance(self, c: Array, scale: Array, combination: Array) -> Array:
        from greybox.numerics.linalg import scaled_logdet

        return -scaled_logdet(c)

    def slope(self, c: Array, scale: Array, combination: Array) -> Array:
        from greybox.numerics.linalg import scaled_inverse

        return -scaled_inverse(c)


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


CRITERIA: Registry[Optimality] = Registry(
    "criterion",
    _Determinant("D", "determinant"),
    _Trace("A", "relative trace"),
    _Largest("E", "worst direction"),
    _Combination("c", "one function --of them"),
    group="experiment_design.criteria",
)
