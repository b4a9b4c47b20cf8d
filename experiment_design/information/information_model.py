"""What a problem needs of an information model, whichever estimator it stands for."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from experiment_design.information.moments import Moments

Array = NDArray[np.float64]


class InformationModel(Protocol):
    """Sums over samples from which the covariance follows."""

    def __call__(self, x: Array, psi: Array, tau: Array) -> Moments:
        """Return the sums of R sequences."""
        ...

    def gradient(
        self, x: Array, psi: Array, tau: Array, d_gram: Array, d_score: Array
    ) -> tuple[Array, Array]:
        """Carry derivatives in the sums back to states with heading, and inputs."""
        ...
