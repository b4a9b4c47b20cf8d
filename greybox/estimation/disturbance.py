"""The current that the bias-capturing terms reveal (5.30), (5.31).

The asymptotic coefficient of a bias-capturing regressor is a known parameter
times a disturbance mean, (5.63), (5.72): −Xu ν_c for cos ψ in surge, Xvr ν_c
for r sin ψ, and so on. The thesis takes the ratio of one pair. All pairs that
involve estimated parameters only are used here together, weighted by their
covariance; those that hold an unknown wind are left out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from greybox.model.disturbances import CURRENT
from greybox.model.predictor import Predictor
from greybox.numerics.linalg import scaled_inverse

Array = NDArray[np.float64]


def current_equations(predictor: Predictor, theta: Array) -> tuple[list[int], Array, Array]:
    """Return the first-order bias coefficients as linear functions of the current.

    Parameters
    ----------
    predictor : Predictor
    theta : ndarray
        (p,) coefficients of all columns.

    Returns
    -------
    tuple
        Positions of the bias columns (m,); A (m, 2) with b = A·current; and its
        derivative dA (m, 2, p) in the coefficients.
    """
    p = len(predictor.columns)
    wanted = [predictor.structure.disturbances.index(n) for n in CURRENT]
    coefficient: dict[tuple[int, int], Array] = {}
    spoilt: set[int] = set()
    for share in predictor.biases:
        columns = predictor.equation(share.state)
        owner = next(i for i in columns if share.term in predictor.columns[i].terms)
        merged = len(predictor.columns[owner].terms) > 1
        for column, value in zip(columns, share.shares, strict=True):
            if abs(value) < 1e-9:
                continue
            if len(share.monomial) > 1 or share.monomial[0] not in wanted or merged:
                # second moments, the unknown wind, or half of a sum
                spoilt.add(column)
                continue
            key = (column, wanted.index(share.monomial[0]))
            row = coefficient.setdefault(key, np.zeros(p))
            row[owner] += share.weight * value
    usable = sorted({c for c, _ in coefficient} - spoilt)
    usable = [c for c in usable if predictor.columns[c].is_bias]
    derivative = np.zeros((len(usable), 2, p))
    for (column, component), row in coefficient.items():
        if column in usable:
            derivative[usable.index(column), component] = row
    return usable, derivative @ theta, derivative


def estimate_current(
    predictor: Predictor,
    theta: Array,
    covariance: Array,
    *,
    heading_std: float = 0.0,
    heading_measured: bool = True,
) -> tuple[tuple[str, float, float], ...]:
    """Estimate the mean current, north and east.

    Parameters
    ----------
    predictor : Predictor
        ``augmented`` or ``wind``; empty is returned for the others.
    theta, covariance : ndarray
        (p,) and (p, p) of all columns.
    heading_std : float
        Noise of the measured heading [rad], whose ρ_ψ = exp(−λ/2) is divided out.
    heading_measured : bool
        Whether the instruments hold the measured heading. Their own noise then
        shrinks the estimate by ρ_ψ; with a simulated heading it grows by 1/ρ_ψ (5.30).

    Returns
    -------
    tuple of (name, value, standard error)
        [m/s]

    References
    ----------
    Ljungberg (2020), eqs. 5.30, 5.31, 5.63, 5.72; generalised least squares.
    """
    if not predictor.structure.marine or not predictor.biases:
        return ()
    rows, a, derivative = current_equations(predictor, theta)
    if len(rows) < 2 or np.linalg.matrix_rank(a) < 2:
        return ()
    b = theta[rows]
    current = np.asarray(np.linalg.lstsq(a, b, rcond=None)[0], float)
    spread = np.zeros((2, 2))
    for _ in range(3):
        # errors of b − A(θ)·current, to first order in the errors of all coefficients
        sensitivity = -np.einsum("mcp,c->mp", derivative, current)
        sensitivity[np.arange(len(rows)), rows] += 1.0
        noise = sensitivity @ covariance @ sensitivity.T
        weights = scaled_inverse(noise, 1e-10)
        spread = np.asarray(np.linalg.pinv(a.T @ weights @ a), float)
        current = np.asarray(spread @ a.T @ weights @ b, float)
    std = np.sqrt(np.maximum(np.diag(spread), 0.0))
    rho = float(np.exp(-(heading_std**2) / 2))
    stretch = 1 / rho if heading_measured else rho
    return tuple(
        (name, float(v) * stretch, float(s) * stretch)
        for name, v, s in zip(CURRENT, current, std, strict=True)
    )
