"""The normal equations: sums over samples, added over experiments.

Static functions of arrays, without names or logs. Experiments keep their own
instruments; the stacked equations (4.5) are solved in the metric of the
instruments' second moments, so that rescaling or mixing instruments changes
nothing, and for instruments equal to the regressors it is least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# instruments beyond this relative singular value are copies of one another
_RANK = 1e-12


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
    p = phi[0].shape[0]
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
    stacked = np.vstack(rows)
    u, values, vt = np.linalg.svd(stacked, full_matrices=False)
    theta = np.full(p, np.nan)
    if len(values) == p and values[-1] > 0:
        theta = vt.T @ ((u.T @ np.concatenate(targets)) / values) / size
    if len(values) < p:
        values = np.concatenate([values, np.zeros(p - len(values))])
    projected = tuple(
        (row.T @ basis) * size[:, None] for row, basis in zip(rows, bases, strict=True)
    )
    information = (stacked.T @ stacked) * np.outer(size, size)
    # where every row was cut no direction is the weakest
    weakest = vt[-1] if len(vt) else np.zeros(p)
    return Solution(theta, information, projected, values, weakest)
