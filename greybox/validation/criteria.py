"""Information criteria of free runs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from greybox.numerics.lagged_moments import lagged_products

Array = NDArray[np.float64]


def information_criteria(
    residuals: Array, parameters: int, samples: Array | None = None
) -> tuple[float, float]:
    """Return the criteria of Akaike and Schwarz of Gaussian residuals, smaller is better.

    Parameters
    ----------
    residuals : ndarray
        (N, m) with a variance of each column's own.
    parameters : int
        Coefficients that were estimated.
    samples : ndarray, optional
        (m,) independent samples that the residuals are worth, N by default.

    Returns
    -------
    tuple of float
        −2 log L + 2k and −2 log L + k log n, as statsmodels counts them for one equation.

    References
    ----------
    Akaike (1974); Schwarz (1978).
    """
    n = np.full(residuals.shape[1], float(len(residuals))) if samples is None else samples
    variance = (residuals**2).mean(axis=0)
    with np.errstate(divide="ignore"):
        minus = float(n @ (np.log(2 * np.pi * variance) + 1))
    return minus + 2 * parameters, minus + parameters * float(np.log(n.mean()))


def independent_samples(residuals: Sequence[Array], about: Array | None = None) -> Array:
    """Return the effective number of independent samples of coloured residuals, (m,).

    Parameters
    ----------
    residuals : sequence of ndarray
        (N, m) per log.
    about : ndarray, optional
        (m,) what they vary about; by default the mean of each log.

    Notes
    -----
    N / (1 + 2 Σ ρ(k)), summed to the first lag whose correlation is not significant, and
    N at most.
    """
    total = sum(len(r) for r in residuals)
    centred = [r - (r.mean(axis=0) if about is None else about) for r in residuals]
    size = np.sum([(r**2).sum(axis=0) for r in centred], axis=0)
    out = np.full(residuals[0].shape[1], float(total))
    limit = 2 / np.sqrt(total)
    for i in np.flatnonzero(size > 0):
        memory = 1.0
        one = [r[:, i][None] for r in centred]
        for lag in range(1, max(len(r) for r in residuals)):
            rho = lagged_products(one, one, lag).item() / size[i]
            if rho < limit:
                break
            memory += 2 * rho
        out[i] = total / memory
    return out
