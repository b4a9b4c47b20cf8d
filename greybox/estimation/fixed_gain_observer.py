"""Runs that an observer of one gain corrects towards the log, nearly linear in the parameters."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from greybox.estimation.shooting import Linearised, Segments, by_sample
from greybox.model.output import OutputModel
from greybox.model.run.output_runs import Observer

Array = NDArray[np.float64]


class ObservedRuns:
    """Errors of runs whose measured states are corrected at every step.

    Parameters
    ----------
    model : OutputModel
    segments : Segments
        One per log, none joined.
    variance : ndarray
        (ny,) of the measurements.
    ratio : float
        Variance of what moves a state each step over that of its measurement. The gain
        is that of the steady Kalman filter of a random walk so moved; the errors are in
        the deviations that it expects.
    """

    def __init__(
        self, model: OutputModel, segments: Segments, variance: Array, ratio: float
    ) -> None:
        self.segments = segments
        before = (ratio + np.sqrt(ratio**2 + 4 * ratio)) / 2
        self.gain = before / (1 + before)
        self.sigma = np.sqrt(variance * (1 + before))
        self._observer = Observer(model, segments.w, segments.y, segments.use)

    def linearise(self, p: Array, nodes: Array) -> Linearised:
        """Return errors and their derivatives at parameters (q,) and starts (M, nz)."""
        error, rows = self._observer(nodes, p, self.gain)
        none = np.zeros((*nodes.shape, rows.shape[3]))
        with np.errstate(over="ignore", invalid="ignore"):
            weighted = by_sample(rows / self.sigma[:, None])
            return Linearised(error / self.sigma, weighted, np.zeros_like(nodes), none)

    def by_parameters(self, p: Array, nodes: Array, only: Sequence[int]) -> Array:
        """Return derivatives of what is expected in some parameters, (M, m, ny, len(only))."""
        return self._observer.by_parameters(nodes, p, self.gain, only)

    def value(self, p: Array, nodes: Array) -> tuple[Array, Array, float]:
        """Return errors, without ends and level."""
        error, _ = self._observer(nodes, p, self.gain, sensitivities=False)
        with np.errstate(over="ignore", invalid="ignore"):
            return error / self.sigma, np.zeros_like(nodes), 0.0
