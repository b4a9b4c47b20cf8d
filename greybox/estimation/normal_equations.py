"""The normal equations: sums over samples, added over experiments.

Static functions of arrays, without names or logs. Experiments keep their own
instruments; the stacked equations (4.5) are solved in the metric of the
instruments' second moments, so that rescaling or mixing instruments changes
nothing, and for instruments equal to the regressors it is least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# instruments beyond this relative singular value are copies of one another
_RANK = 1e-12
# samples that are decomposed at once: what a processor keeps near
_AT_ONCE = 2048
# columns that are reflected together
_REFLECTIONS = 8


@dataclass(frozen=True)
class Solution:
    """The estimate of one equation.

    Parameters
    ----------
    theta : ndarray
        (p,)
    information : ndarray
        (p, p) Σ ẑ φᵀ, whose inverse maps scores to parameter errors.
    projected : tuple of ndarray
        (p, N) ẑ a experiment: the instruments as the estimator combines them.
    singular_values : ndarray
        (p,) of the regressors that the instruments explain, each regressor scaled to
        unit variance, largest first.
    weakest : ndarray
        (p,) right singular vector of the smallest, in scaled coordinates.
    """

    theta: Array
    information: Array
    projected: tuple[Array, ...]
    singular_values: Array
    weakest: Array


def _centred_squares(rows: Array) -> Array:
    if not rows.shape[1]:
        return np.zeros(len(rows))
    return np.asarray(((rows - rows.mean(axis=1, keepdims=True)) ** 2).sum(axis=1))


def solve_stacked(
    z: Sequence[Array], phi: Sequence[Array], y: Sequence[Array], *, metric: str = "moments"
) -> Solution:
    """Solve the stacked instrumental-variable equations of one equation.

    Parameters
    ----------
    z : sequence of ndarray
        (q, N) instruments a experiment.
    phi : sequence of ndarray
        (p, N) regressors a experiment.
    y : sequence of ndarray
        (N,) a experiment.
    metric : {"moments", "identity"}
        Metric of the least-squares solution of (4.5): the inverse second moments
        of the instruments (two-stage least squares), or the identity after
        scaling each instrument to unit mean square.

    References
    ----------
    Ljungberg (2020), eqs. 2.17, 2.21, 4.5.
    """
    size = np.sqrt(sum(_centred_squares(f) for f in phi))
    size[size == 0] = 1.0
    bases, rows, targets = [], [], []
    for ze, fe, ye in zip(z, phi, y, strict=True):
        scale = np.sqrt((ze**2).sum(axis=1) / max(ze.shape[1], 1))
        scale[scale == 0] = 1.0
        basis = ze / scale[:, None]
        if metric == "moments":
            # an orthonormal basis of the instruments, never their squared moments
            thin, triangle = np.linalg.qr(basis.T)
            left, values, _ = np.linalg.svd(triangle, full_matrices=False)
            # an experiment of which every row was cut has no singular values
            basis = (thin @ left[:, values > _RANK * values.max(initial=0.0)]).T
        else:
            basis = basis / np.sqrt(max(fe.shape[1], 1))
        bases.append(basis)
        rows.append(basis @ (fe / size[:, None]).T)
        targets.append(basis @ ye)
    found = _solved(np.vstack(rows), np.concatenate(targets), size)
    projected = tuple(
        (row.T @ basis) * size[:, None] for row, basis in zip(rows, bases, strict=True)
    )
    return replace(found, projected=projected)


def _solved(stacked: Array, target: Array, size: Array) -> Solution:
    """Solve for regressors of unit size, seen from orthonormal instruments, (q, p) and (q,)."""
    p = len(size)
    u, values, vt = np.linalg.svd(stacked, full_matrices=False)
    theta = np.full(p, np.nan)
    if len(values) == p and values[-1] > 0:
        theta = vt.T @ ((u.T @ target) / values) / size
    if len(values) < p:
        values = np.concatenate([values, np.zeros(p - len(values))])
    information = (stacked.T @ stacked) * np.outer(size, size)
    # where every row was cut no direction is the weakest
    weakest = vt[-1] if len(vt) else np.zeros(p)
    return Solution(theta, information, (), values, weakest)


@dataclass(frozen=True)
class Sums:
    """Sufficient statistics of one equation, of a size that does not grow with the samples.

    The triangle of a QR decomposition holds every sum of squares and products, and never
    squares what it adds, so that regressors which are nearly one lose no digits.

    Parameters
    ----------
    triangle : ndarray
        (k, k) of instruments, regressors and left-hand side [z | φ | y], k = 2p + 1.
    totals : ndarray
        (k,) their sums.
    rows : int
    """

    triangle: Array
    totals: Array
    rows: int

    @classmethod
    def of(cls, z: Array | None, phi: Array, y: Array) -> Sums:
        """Sum the samples of z (p, N), phi (p, N) and y (N,); without z, phi stands for it."""
        own = np.vstack([phi, y[None]] if z is None else [z, phi, y[None]])
        triangle, totals = _triangle(own), own.sum(axis=1)
        if z is None:
            p = len(phi)
            places = [*range(p), *range(p), p]
            totals, whole = totals[places], np.zeros((2 * p + 1, 2 * p + 1))
            whole[: p + 1] = triangle[:, places]
            triangle = whole
        return cls(triangle, totals, own.shape[1])

    @classmethod
    def together(cls, sums: Sequence[Sums]) -> Sums:
        """Add sums of samples that are apart."""
        return cls(
            _triangle(np.hstack([s.triangle.T for s in sums])),
            np.sum([s.totals for s in sums], axis=0),
            sum(s.rows for s in sums),
        )

    def solve(self) -> Solution:
        """Solve the equation with its instruments summed over all samples, as many as parameters.

        Nothing is left over that could fit the noise, however many logs there are. For
        instruments equal to the regressors it is least squares.

        References
        ----------
        Ljungberg (2020), eqs. 2.17, 2.21.
        """
        p = len(self.triangle) // 2
        own, phi = self.triangle[:p, :p], self.triangle[:, p : 2 * p]
        squares = (phi**2).sum(axis=0)
        centred = squares - self.totals[p : 2 * p] ** 2 / max(self.rows, 1)
        # a constant has no size but what rounding leaves
        size = np.sqrt(np.where(centred > _RANK * squares, centred, 0.0))
        size[size == 0] = 1.0
        scale = np.linalg.norm(own, axis=0)
        scale[scale == 0] = 1.0
        left, values, _ = np.linalg.svd(own / scale)
        basis = left[:, values > _RANK * values.max(initial=0.0)].T
        return _solved(basis @ (phi[:p] / size), basis @ self.triangle[:p, 2 * p], size)

    def combination(self, solution: Solution) -> Array:
        """Return Π (p, p) of the instruments ẑ = Π z that a solution combines."""
        p = len(solution.theta)
        own = self.triangle[:p, :p]
        scale = np.linalg.norm(own, axis=0)
        scale[scale == 0] = 1.0
        # ẑ is the projection of φ on z
        into = np.linalg.pinv(own / scale, rcond=_RANK) / scale[:, None]
        return np.asarray(into @ self.triangle[:p, p : 2 * p]).T

    def squares(self, theta: Array, *, centred: bool) -> float:
        """Return Σ (y − φᵀθ)², about the mean where `centred`."""
        p = len(theta)
        weights = np.append(-theta, 1.0)
        total = float(((self.triangle[:, p:] @ weights) ** 2).sum())
        if centred:
            total -= float(self.totals[p:] @ weights) ** 2 / max(self.rows, 1)
        return max(total, 0.0)

    def scores(self, weights: Array, theta: Array) -> tuple[Array, Array]:
        """Return Σ ẑ (y − φᵀθ) and Σ ẑ ẑᵀ of ẑ = `weights` z, (p,) and (p, p)."""
        p = len(theta)
        own = weights @ self.triangle[:p, :p].T
        return own @ (self.triangle[:p, p:] @ np.append(-theta, 1.0)), own @ own.T


def _triangle(rows: Array) -> Array:
    """Return R (k, k) of the QR decomposition of the samples of k rows (k, N)."""
    from scipy.linalg.lapack import dtpqrt

    k, n = rows.shape
    triangle = np.zeros((k, k), order="F")
    for start in range(0, n, _AT_ONCE):
        block = np.array(rows[:, start : start + _AT_ONCE].T, order="F")
        # no column is a block of reflections by itself where there are fewer
        triangle = dtpqrt(0, min(_REFLECTIONS, k), triangle, block, overwrite_a=1, overwrite_b=1)[0]
    return np.asarray(triangle)
