"""What changes in time in the coefficients of one ship: a straight line with its interval.

The estimates of T periods are pooled about a line in time instead of a mean,

    y_t ~ N(θ_t, C_t),    θ_t ~ N(a + b τ_t, Ω),

so that what differs from trial to trial without a trend, by weather, draught or what the model
lacks, widens the interval of the slope b and is not taken for fouling. Where a model does not fit,
estimates scatter by more than C says, and few periods hardly show by how much: the standard error
of b is never less than what the scatter about the line makes it, and has the degrees of freedom of
that scatter.

References
----------
Knapp and Hartung (2003), Improved tests for a random effects meta-regression with a single
covariate, Statist. Med. 22.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from greybox.fleet.pooling import LEVEL, pool

Array = NDArray[np.float64]

# periods that leave two degrees of freedom beside the two of a line
FEWEST_PERIODS = 4


@dataclass(frozen=True)
class Trend:
    """The coefficients of one ship over its periods, and the line through them.

    Parameters
    ----------
    times : ndarray
        (T,) of the periods.
    estimates, std : ndarray
        (T, p) of each period alone, and its standard errors.
    slope, slope_std : ndarray
        (p,) change in one unit of time, and its standard error.
    slope_df : int
        Degrees of freedom of that, T − 2.
    line, line_std : ndarray
        (T, p) the line at the periods, and its standard errors, of the same degrees of freedom.
    """

    times: Array
    estimates: Array
    std: Array
    slope: Array
    slope_std: Array
    slope_df: int
    line: Array
    line_std: Array

    @property
    def p_values(self) -> Array:
        """Of no change, for each coefficient alone, (p,)."""
        return np.asarray(2 * student.sf(np.abs(self.slope) / self.slope_std, self.slope_df))

    @property
    def reach(self) -> float:
        """Standard errors that the half of a 95 % interval is long."""
        return float(student.ppf((1 + LEVEL) / 2, self.slope_df))

    @property
    def slope_interval(self) -> Array:
        """95 % interval of each slope, (p, 2)."""
        half = self.reach * self.slope_std
        return np.column_stack([self.slope - half, self.slope + half])


def least_slope(freedom: int, lines: int, significance: float) -> float:
    """Return by how many standard errors one of several lines must climb to be named.

    Parameters
    ----------
    freedom : int
        Degrees of freedom of its standard error.
    lines : int
        Coefficients that are followed, of all ships.
    significance : float
        Of any of them.
    """
    return float(student.isf(significance / (2 * lines), freedom))


def fit_trend(times: Array, estimates: Array, covariances: Array) -> Trend:
    """Fit a line in time to the estimates of several periods of one ship.

    Parameters
    ----------
    times : ndarray
        (T,) of at least `FEWEST_PERIODS` periods, not all the same.
    estimates : ndarray
        (T, p)
    covariances : ndarray
        (T, p, p)

    Returns
    -------
    Trend

    Raises
    ------
    UsageError
        There are too few periods for a line.
    """
    size = estimates.shape[1]
    # about the middle, so that level and slope are told apart well in any unit of time
    middle, unit = float(np.mean(times)), float(np.ptp(times)) or 1.0
    far = (times - middle) / unit
    eye = np.broadcast_to(np.eye(size), covariances.shape)
    design = np.concatenate([eye, far[:, None, None] * eye], axis=2)
    pooled = pool(estimates, covariances, design)
    line = design @ pooled.beta
    line_covariance = design @ pooled.beta_covariance @ design.transpose(0, 2, 1)
    own = np.diagonal(covariances, axis1=1, axis2=2)
    freedom = len(times) - 2
    scatter = ((estimates - line) ** 2 / (own + pooled.omega)).sum(axis=0) / freedom
    wider = np.sqrt(np.maximum(scatter, 1.0))
    return Trend(
        times,
        estimates,
        np.sqrt(own),
        pooled.beta[size:] / unit,
        wider * pooled.beta_std[size:] / unit,
        freedom,
        line,
        wider * np.sqrt(np.diagonal(line_covariance, axis1=1, axis2=2)),
    )
