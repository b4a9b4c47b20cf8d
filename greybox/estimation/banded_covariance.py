"""The covariance of the equation error, and its whitening.

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
    """Noise levels of all parts of an equation error.

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

    def slopes(self, noise: ErrorNoise, by_covariance: Array) -> tuple[Array, Array, Array]:
        """Return the derivatives of a function of the covariance in what `noise` consists of.

        Parameters
        ----------
        by_covariance : ndarray
            (diagonals, rows·nx) derivatives in the entries of the lower band, those on the
            diagonal once, the others counting for both triangles.

        Returns
        -------
        tuple of ndarray
            (nx + m,) in the variances of the measurements and of heading and wind, (nx,) in
            those of the process noise, (nx,) in its memory.
        """
        nx, rows = self.nx, self.rows
        band = by_covariance.reshape(-1, rows, nx)
        blocks = np.zeros((len(band) // nx, nx, nx, rows))
        for i in range(nx):
            for j in range(nx):
                # both triangles of the block on the diagonal
                blocks[0, i, j] = band[abs(i - j), :, min(i, j)] / (1 if i == j else 2)
                for far in range(1, len(blocks)):
                    blocks[far, i, j, far:] = band[far * nx + i - j, : rows - far, j]
        drive = np.einsum("iik->ik", blocks[0])
        process = (drive * (1.0 - self._one * noise.memory[:, None] ** 2)).sum(axis=1)
        same, near, memory = blocks[0], blocks[1], np.zeros(nx)
        if len(blocks) > 2:
            far, one = blocks[2], self._one
            left, right = noise.memory[:, None, None], noise.memory[:, None]
            variances = np.concatenate([noise.measurement, noise.further]) ** 2
            own = np.tensordot(variances, self._same, axes=1)
            tie = np.tensordot(variances, self._next, axes=1)
            before, earlier = _previous(own) * one, _previous(tie)
            memory -= 2 * noise.memory * noise.process**2 * (drive * one).sum(axis=1)
            memory -= 2 * (same * tie).sum(axis=(0, 2))
            memory += 2 * (same * right * before).sum(axis=(1, 2))
            memory -= (near * before).sum(axis=(1, 2)) + (far * earlier * self._two).sum((1, 2))
            both = near * earlier * one
            memory += (both * right).sum(axis=(1, 2)) + (both * left).sum(axis=(0, 2))
            same, near = (
                same + _following((left * right * same - left * near) * one),
                near - 2 * same * right + _following((left * right * near) * one
                                                     - left * far * self._two),
            )  # fmt: skip
        measured = np.tensordot(self._same, same, axes=3) + np.tensordot(self._next, near, axes=3)
        return measured, process, memory

    def whiten(
        self, factor: Array, noise: ErrorNoise, values: Array, *, overwrite: bool = False
    ) -> Array:
        """Return values of all equations with the error made white.

        Parameters
        ----------
        factor : ndarray
            Of `factor(noise)`.
        values : ndarray
            (q, N, nx)
        overwrite : bool
            Whether the values may be lost, which saves a copy where every row takes part.

        Returns
        -------
        ndarray
            (q, rows·nx)
        """
        from scipy.linalg.blas import dtbsv

        before = noise.memory * self.before(values) if noise.memory.any() else None
        whole = overwrite and self.rows == values.shape[1]
        v = values if whole else np.take(values, self.keep, axis=1)
        if before is not None:
            v -= before
        out = v.reshape(len(v), -1)
        for row in out if self.rows else ():
            dtbsv(len(factor) - 1, factor, row, lower=1, overwrite_x=1)
        return np.asarray(out)

    def unwhiten(self, factor: Array, white: Array) -> Array:
        """Return the transposed factor's inverse times white rows (q, rows·nx): Ω⁻¹ v."""
        from scipy.linalg.blas import dtbsv

        return np.array([dtbsv(len(factor) - 1, factor, row, lower=1, trans=1) for row in white])

    def adjoint(self, factor: Array, noise: ErrorNoise, white: Array) -> Array:
        """Return Wᵀ v (rows, nx) of white values (rows·nx,), where `whiten` gives W."""
        if not self.rows:
            return np.zeros((0, self.nx))
        out = self.unwhiten(factor, white[None])[0].reshape(self.rows, self.nx)
        out[:-1] -= self._one[1:, None] * noise.memory * out[1:].copy()
        return np.asarray(out)

    def before(self, values: Array) -> Array:
        """Return the values (q, N, nx) of the row before each, zero where none is."""
        out = np.zeros((len(values), self.rows, self.nx))
        np.multiply(self._one[1:, None], np.take(values, self.keep[:-1], axis=1), out=out[:, 1:])
        return np.asarray(out)


def _following(values: Array) -> Array:
    """Return the values of the row behind, zero behind the last: the adjoint of `_previous`."""
    out = np.zeros_like(values)
    out[..., :-1] = values[..., 1:]
    return out


def _previous(values: Array) -> Array:
    """Return the values of the row before, zero before the first."""
    out = np.zeros_like(values)
    out[..., 1:] = values[..., :-1]
    return out
