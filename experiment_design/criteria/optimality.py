"""Optimality criteria by name: the function of the wanted parameters' covariance to minimise.

Every criterion is a number that grows with the information, in logarithms, so that
they share one scale. A new one is a file of `kinds` with its entry, or an entry point.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING

from greybox.registry import Registry

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


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
    order : int
        Among those that are shown.
    """

    name: str
    words: str
    order: int = 9

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

    @property
    def determinant(self) -> bool:
        """Whether it is −log det: of one variance for each parameter together."""
        return False

    @property
    def combined(self) -> bool:
        """Whether it looks at one combination of the parameters."""
        return False


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


CRITERIA: Registry[Optimality] = Registry(
    "criterion",
    package="experiment_design.criteria.kinds",
    group="experiment_design.criteria",
)
