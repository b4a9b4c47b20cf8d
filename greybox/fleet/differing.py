"""Which of several units differs from the others, and in what: each against all the others.

The estimate of unit i is compared with what the others predict of it,

    y_i ~ N(X_i β₋ᵢ, C_i + Ω₋ᵢ + Cov(X_i β₋ᵢ)),

by its squared Mahalanobis distance. Ω₋ᵢ rests on few units, so along each principal direction of
Ω₋ᵢ in units of the rest, the deviation is referred to Student's t with degrees of freedom after
Satterthwaite (1946), as prediction intervals of meta-analyses are (Higgins, Thompson and
Spiegelhalter, 2009), and its normal score takes its place in the sum, which is χ² with one degree
a coefficient where the unit is like the others.

The unit that differs most is tested first. Where it differs, it takes no part when the rest is
tested, so that one odd unit does not hide another; p-values are adjusted for the number of units by
Holm's (1979) step-down rule.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.stats import chi2, norm
from scipy.stats import t as student

from greybox.fleet.pooling import Pooled, degrees_of_freedom, pool

Array = NDArray[np.float64]

# probability with which any unit of a fleet that is alike is said to differ
SIGNIFICANCE = 0.05
# units without which no spread between them can be estimated
FEWEST = 3


@dataclass(frozen=True)
class Difference:
    """A coefficient in which a unit differs from the others.

    Parameters
    ----------
    coefficient : int
        Its place.
    value, std : float
        By how much, were it the only ones of those that are named, and the standard error.
    expected : float
        The value that the others predict.
    """

    coefficient: int
    value: float
    std: float
    expected: float


@dataclass(frozen=True)
class Comparison:
    """One unit against the others.

    Parameters
    ----------
    unit : int
        Its place.
    statistic : float
        Squared Mahalanobis distance of normal scores.
    df : int
        Its degrees of freedom: the number of coefficients.
    p_value, p_adjusted : float
        For this unit alone, and adjusted for all units.
    differences : tuple of Difference
        In which coefficients it differs, the first explaining most; empty where it does not.
    """

    unit: int
    statistic: float
    df: int
    p_value: float
    p_adjusted: float
    differences: tuple[Difference, ...]

    @property
    def differs(self) -> bool:
        """Whether the unit differs from the others."""
        return self.p_adjusted < SIGNIFICANCE


def compare_units(
    estimates: Array, covariances: Array, design: Array | None = None
) -> tuple[Comparison, ...]:
    """Test each unit against all others that do not differ themselves.

    Parameters
    ----------
    estimates : ndarray
        (k, p) of at least `FEWEST` units.
    covariances : ndarray
        (k, p, p)
    design : ndarray, optional
        (k, p, q) as for `pool`.

    Returns
    -------
    tuple of Comparison
        One a unit, in their order.

    References
    ----------
    Holm (1979), A simple sequentially rejective multiple test procedure, Scand. J. Statist. 6;
    Higgins, Thompson and Spiegelhalter (2009), J. R. Statist. Soc. A 172.
    """
    left = list(range(len(estimates)))
    adjusted = 0.0
    done: dict[int, Comparison] = {}

    def against_others(unit: int) -> Comparison:
        others = [i for i in left if i != unit]
        x = None if design is None else design[others]
        pooled = pool(estimates[others], covariances[others], x)
        own = np.eye(estimates.shape[1]) if design is None else design[unit]
        return _compared(unit, estimates[unit], covariances[unit], own, pooled)

    while True:
        found = {unit: against_others(unit) for unit in left}
        worst = min(left, key=lambda unit: found[unit].p_value)
        adjusted = max(adjusted, min(1.0, found[worst].p_value * len(left)))
        if adjusted >= SIGNIFICANCE:
            break
        done[worst] = _adjusted(found[worst], adjusted)
        left.remove(worst)
        if len(left) < FEWEST:
            found = {unit: c for unit, c in found.items() if unit in left}
            break
    # Holm's rule for those that remain
    for place, unit in enumerate(sorted(left, key=lambda unit: found[unit].p_value)):
        adjusted = max(adjusted, SIGNIFICANCE, found[unit].p_value * (len(left) - place))
        done[unit] = _adjusted(found[unit], min(1.0, adjusted))
    return tuple(done[unit] for unit in range(len(estimates)))


def _adjusted(found: Comparison, p_adjusted: float) -> Comparison:
    """Return a comparison with its adjusted p-value, and no differences where it is not odd."""
    named = found.differences if p_adjusted < SIGNIFICANCE else ()
    return Comparison(
        found.unit, found.statistic, found.df, found.p_value, p_adjusted, named
    )


def _compared(unit: int, estimate: Array, covariance: Array, x: Array, others: Pooled) -> Comparison:
    expected = x @ others.beta
    certain = covariance + x @ others.beta_covariance @ x.T
    scores, whitening = normal_scores(estimate - expected, certain, others)
    statistic = float(scores @ scores)
    named = _explaining(scores, whitening, expected)
    p_value = float(chi2.sf(statistic, len(scores)))
    return Comparison(unit, statistic, len(scores), p_value, 1.0, named)


def normal_scores(deviation: Array, certain: Array, pooled: Pooled) -> tuple[Array, Array]:
    """Return independent standard normal scores of a deviation with an estimated Ω in its variance.

    Parameters
    ----------
    deviation : ndarray
        (p,) with covariance `certain` + Ω.
    certain : ndarray
        (p, p)
    pooled : Pooled
        Has Ω, and what it is uncertain by.

    Returns
    -------
    scores, whitening : ndarray
        (p,), and (p, p) that gave them but for the Student's t in them.
    """
    spread, directions = eigh(np.diag(pooled.omega), certain)
    variance = 1 + np.maximum(spread, 0.0)
    squares = directions.T**2
    uncertain = np.einsum("mj,jl,ml->m", squares, pooled.omega_covariance, squares)
    whitening = directions.T / np.sqrt(variance)[:, None]
    ratio = whitening @ deviation
    tail = student.logsf(np.abs(ratio), degrees_of_freedom(variance, uncertain))
    return np.sign(ratio) * _normal_quantile(tail), whitening


def _normal_quantile(log_tail: Array) -> Array:
    """Return the normal quantile of a tail probability given by its logarithm."""
    # beyond 38 standard deviations nothing is told apart, and the tail is no number any more
    return np.asarray(norm.isf(np.exp(np.maximum(log_tail, -700.0))))


def _explaining(scores: Array, whitening: Array, expected: Array) -> tuple[Difference, ...]:
    """Return the fewest coefficients, one by one, whose change explains the deviation.

    Each time the one is taken that lowers the squared distance most, until what is left is what
    chance does.
    """
    taken: list[int] = []
    left, size = scores, len(scores)
    value = covariance = np.zeros(0)
    while len(taken) < size and float(left @ left) > chi2.isf(SIGNIFICANCE, size - len(taken)):
        gains = np.full(size, -np.inf)
        for j in set(range(size)) - set(taken):
            fitted = np.linalg.lstsq(whitening[:, [*taken, j]], scores, rcond=None)[0]
            rest = scores - whitening[:, [*taken, j]] @ fitted
            gains[j] = -float(rest @ rest)
        taken.append(int(np.argmax(gains)))
        columns = whitening[:, taken]
        covariance = np.linalg.inv(columns.T @ columns)
        value = covariance @ columns.T @ scores
        left = scores - columns @ value
    return tuple(
        Difference(j, float(value[n]), float(np.sqrt(covariance[n, n])), float(expected[j]))
        for n, j in enumerate(taken)
    )
