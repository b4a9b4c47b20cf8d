"""The covariance of the equation error, and what makes that error white.

To first order the error of (4.3) is

    ε(k) = e(k+1) − A(k) e(k) − S(k) n(k) + w(k)

with e the measurement noise of the states, A = ∂x⁺/∂x along the noise-free
motion, n that of heading and wind with slopes S, and w process noise. Each w may
remember: w(k+1) = ρ w(k) + innovation, and then η(k) = ε(k) − ρ ε(k−1) is a
moving average again. All equations stacked sample by sample, the covariance of
ε (or η) is a band of 2nx − 1 (or 3nx − 1) diagonals, factored in O(N).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ErrorNoise:
    """Levels of everything that an equation error consists of.

    Parameters
    ----------
    measurement : ndarray
        (nx,) standard deviation of the measured states.
    process : ndarray
        (nx,) stationary standard deviation of the process noise.
    memory : ndarray
        (nx,) its correlation ρ from sample to sample, in [0, 1).
    further : ndarray
        (m,) standard deviation of heading and wind.
    """

    measurement: Array
    process: Array
    memory: Array
    further: Array


class ErrorBand:
    """One log's equation errors: which noise enters where.

    Parameters
    ----------
    slopes : ndarray
        (N, nx, nx + m) of a `Motion`.
    keep : ndarray of bool
        (N,) rows that take part. Those left out part the log into stretches;
        memory of the process noise across a gap is neglected.
    """

    def __init__(self, slopes: Array, keep: NDArray[np.bool_]) -> None:
        self.keep = np.flatnonzero(keep)
        self.nx = slopes.shape[1]
        follows = np.zeros(len(self.keep), bool)
        follows[1:] = np.diff(self.keep) == 1
        # rows that have a neighbour, and a second one, before them
        self._one = follows.astype(float)
        self._two = self._one * _previous(self._one)
        entering = np.ascontiguousarray(slopes[self.keep].transpose(1, 2, 0))
        own = np.eye(self.nx, entering.shape[1])
        # what a unit variance of each channel adds to (k, k) and to (k, k − 1)
        self._same = entering.transpose(1, 0, 2)[:, :, None] * entering.transpose(1, 0, 2)[:, None]
        self._same += (own.T[:, :, None] * own.T[:, None])[..., None]
        self._next = -entering.transpose(1, 0, 2)[:, :, None] * own.T[:, None, :, None] * self._one

    @property
    def rows(self) -> int:
        """Rows that take part."""
        return len(self.keep)

    def covariance(self, noise: ErrorNoise) -> Array:
        """Return the lower band of the covariance, (diagonals, rows·nx)."""
        nx = self.nx
        variances = np.concatenate([noise.measurement, noise.further]) ** 2
        same = np.tensordot(variances, self._same, axes=1)
        near = np.tensordot(variances, self._next, axes=1)
        blocks = [same, near]
        if noise.memory.any():
            left, right = noise.memory[:, None, None], noise.memory[:, None]
            before = _previous(same) * self._one
            cross = near * right
            blocks = [
                same - cross - cross.transpose(1, 0, 2) + left * right * before,
                near - left * before + left * right * _previous(near) * self._one,
                -left * _previous(near) * self._two,
            ]
        drive = noise.process[:, None] ** 2 * (1.0 - self._one * noise.memory[:, None] ** 2)
        blocks[0][np.arange(nx), np.arange(nx)] += drive
        band = np.zeros((len(blocks) * nx, self.rows, nx))
        for i in range(nx):
            for j in range(nx):
                if i >= j:
                    band[i - j, :, j] = blocks[0][i, j]
                for far in range(1, len(blocks)):
                    # column of the earlier row, filled from the later one
                    band[far * nx + i - j, : self.rows - far, j] = blocks[far][i, j, far:]
        return band.reshape(len(band), -1)

    def factor(self, noise: ErrorNoise) -> Array | None:
        """Return the Cholesky factor of the band, None where it is not positive."""
        from scipy.linalg.lapack import dpbtrf

        factor, info = dpbtrf(self.covariance(noise), lower=1)
        return np.asarray(factor) if info == 0 and np.isfinite(factor[0]).all() else None

    def whiten(self, factor: Array, noise: ErrorNoise, values: Array) -> Array:
        """Return values of all equations with the error made white.

        Parameters
        ----------
        factor : ndarray
            Of `factor(noise)`.
        values : ndarray
            (q, N, nx)

        Returns
        -------
        ndarray
            (q, rows·nx)
        """
        from scipy.linalg.blas import dtbsv

        v = values[:, self.keep]
        if noise.memory.any():
            v[:, 1:] -= noise.memory * self._one[1:, None] * values[:, self.keep[:-1]]
        out = v.reshape(len(v), -1)
        for row in out:
            row[:] = dtbsv(len(factor) - 1, factor, row, lower=1)
        return out


def _previous(values: Array) -> Array:
    """Return the values of the row before, zero before the first."""
    out = np.zeros_like(values)
    out[..., 1:] = values[..., :-1]
    return out
