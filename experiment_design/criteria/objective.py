"""The objective of a design: a function of the motion to maximise, with its derivatives."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from experiment_design.excitation.rollout import Motion
from experiment_design.information.moments import InformationModel, Moments

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Slope:
    """An objective at one motion.

    Parameters
    ----------
    value : float
    pull : callable
        Returns its derivatives in states with heading (N, nx + 1), in the inputs (N, nu) and
        in the commands themselves (N, nc).
    """

    value: float
    pull: Callable[[], tuple[Array, Array, Array]]


class Objective(ABC):
    """The logarithm of the information of a trial, for some purpose."""

    @property
    @abstractmethod
    def size(self) -> int:
        """Number of parameters that it is about."""

    @abstractmethod
    def of_motion(
        self, motion: Motion, information: InformationModel, known: Moments | None
    ) -> Array:
        """Return it for R motions, (R,); −inf where one tells nothing.

        Parameters
        ----------
        motion : Motion
        information : InformationModel
            What the motion tells under the same prior model.
        known : Moments or None
            Sums of other trials.
        """

    @abstractmethod
    def slope(self, motion: Motion, information: InformationModel, known: Moments | None) -> Slope:
        """Return it for one motion, with its derivatives."""
