"""Which of several units differs from the others, and in what: each against all the others.

The estimate of unit i is compared with what the others predict of it,

    y_i ~ N(β₋ᵢ, V),    V = C_i + Ω₋ᵢ + Cov(β₋ᵢ),

by its squared Mahalanobis distance T. Were Ω₋ᵢ known, T would be χ² with one degree a coefficient;
it rests on few units, and taking it as known names units that are like the others. So the tail of
T is averaged over what Ω₋ᵢ may be: each variance ω + c, where c is what the estimates' own errors
add to the spread between them, is ν s²/χ²_ν with the ν degrees of freedom of the other units, and ω
at least 0. For one coefficient and small errors of the estimates this is Student's t, as in the
prediction intervals of Higgins, Thompson and Spiegelhalter (2009).

A sum over many coefficients hides a difference in one of them, whose own deviation is compared too,
with its tail averaged alike. The p-value of a unit is the smaller of both: that of T, and that of
its most deviating coefficient times their number; times two, since either may name it (Bonferroni).

The unit that differs most is tested first. Where it differs, it takes no part when the rest is
tested, so that one odd unit does not hide another; p-values are adjusted for the number of units by
Holm's (1979) step-down rule.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr
from scipy.stats import chi2, qmc, t

from greybox.errors import UsageError
from greybox.fleet.pooling import Pooled, pool

Array = NDArray[np.float64]

# probability with which any unit of a fleet that is alike is said to differ
SIGNIFICANCE = 0.05
# units without which no spread between the others of one can be estimated
FEWEST = 3
# points of a fixed sequence over which a tail is averaged: Sobol's sequence needs a power of two
_POINTS = 512


@dataclass(frozen=True)
class Difference:
    """A coefficient in which a unit differs from the others.

    Parameters
    ----------
    coefficient : int
        Its place.
    value, std : float
        By how much, where nothing but what is named differs, and the standard error.
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
        Squared Mahalanobis distance T.
    df : int
        Number of coefficients.
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


def compare_units(estimates: Array, covariances: Array) -> tuple[Comparison, ...]:
    """Test each unit against all others that do not differ themselves.

    Parameters
    ----------
    estimates : ndarray
        (k, p) of at least `FEWEST` units.
    covariances : ndarray
        (k, p, p)

    Returns
    -------
    tuple of Comparison
        One a unit, in their order.

    Raises
    ------
    UsageError
        There are too few units.

    References
    ----------
    Holm (1979), A simple sequentially rejective multiple test procedure, Scand. J. Statist. 6;
    Higgins, Thompson and Spiegelhalter (2009), A re-evaluation of random-effects meta-analysis,
    J. R. Statist. Soc. A 172.
    """
    if len(estimates) < FEWEST:
        raise UsageError(
            f"{len(estimates)} units cannot show how much units differ: give at least {FEWEST}."
        )
    left = list(range(len(estimates)))
    done: dict[int, Comparison] = {}
    adjusted = 0.0
    while len(left) >= FEWEST:
        found = [_against_others(unit, left, estimates, covariances) for unit in left]
        worst = min(found, key=lambda c: c.p_value)
        if worst.p_value * len(left) >= SIGNIFICANCE:
            break
        adjusted = max(adjusted, worst.p_value * len(left))
        done[worst.unit] = replace(worst, p_adjusted=adjusted)
        left.remove(worst.unit)
    # Holm's rule for those that remain, none of which can be told from the others any more
    remaining = sorted((c for c in found if c.unit in left), key=lambda c: c.p_value)
    adjusted = max(adjusted, SIGNIFICANCE)
    for place, one in enumerate(remaining):
        adjusted = min(1.0, max(adjusted, one.p_value * (len(remaining) - place)))
        done[one.unit] = replace(one, p_adjusted=adjusted, differences=())
    return tuple(done[unit] for unit in range(len(estimates)))


def least_deviation(units: int, size: int) -> float:
    """Return by how much one coefficient must deviate to be named.

    In standard deviations of what the other units predict, by Student's t.

    Parameters
    ----------
    units, size : int
        Units that are compared, and coefficients of each; the errors of the estimates are small.
    """
    alone = SIGNIFICANCE / (2 * size * units)
    return float(t.isf(alone / 2, units - 2))


def _against_others(
    unit: int, units: list[int], estimates: Array, covariances: Array
) -> Comparison:
    others = [i for i in units if i != unit]
    pooled = pool(estimates[others], covariances[others])
    deviation = _Deviation(estimates[unit], covariances[unit], pooled)
    p_value = deviation.p_value(())
    # what explains it is looked for only where it may be told
    named = deviation.explaining() if p_value * len(units) < SIGNIFICANCE else ()
    return Comparison(
        unit,
        deviation.distance(()),
        estimates.shape[1],
        p_value,
        1.0,
        tuple(Difference(j, value, std, float(pooled.beta[j])) for j, value, std in named),
    )


def possible_variances(pooled: Pooled) -> Array:
    """Return what the variances between units may be, (n, p), from what is known of them.

    Parameters
    ----------
    pooled : Pooled
    """
    units, size = pooled.estimates.shape
    df = units - pooled.design.shape[2] / size
    total = np.sqrt(df / 2 * np.diag(pooled.omega_covariance))
    own = np.maximum(total - pooled.omega, 0.0)
    total = pooled.omega + own
    # not below what the estimates' own errors add
    highest = chi2.cdf(df * total / np.maximum(own, np.finfo(float).tiny), df)
    places = (qmc.Sobol(size, scramble=False).random(_POINTS) + 0.5 / _POINTS) * highest
    return np.asarray(np.maximum(total * df / chi2.ppf(places, df) - own, 0.0))


class _Deviation:
    """The deviation of an estimate from the mean of others, whose spread is not wholly known."""

    def __init__(self, estimate: Array, covariance: Array, others: Pooled) -> None:
        total = covariance + others.beta_covariance + np.diag(others.omega)
        # coefficients of unit size
        scale = np.sqrt(np.diag(total))
        size = len(scale)
        outer = np.outer(scale, scale)
        self._scale, self._deviation = scale, (estimate - others.beta) / scale
        self._inverse = np.linalg.inv(total / outer)
        self._certain = total / outer
        # the variance is linear in what each ω may be more or less
        self._change = (possible_variances(others) - others.omega) / scale**2
        own = np.zeros((size, size, size))
        own[np.arange(size), np.arange(size), np.arange(size)] = 1.0
        unit = scale[:, None, None] ** 2 / outer
        self._slopes = own + others.beta_slopes * unit
        single = 1 + self._change @ np.diagonal(self._slopes, axis1=1, axis2=2)
        # of each coefficient alone
        self._alone = 2 * ndtr(-np.abs(self._deviation) / np.sqrt(single)).mean(axis=0)

    def _form(self, free: tuple[int, ...]) -> Array:
        """Return the matrix of the squared distance when some coefficients may differ, (p, p)."""
        if not free:
            return self._inverse
        columns = self._inverse[:, free]
        return self._inverse - columns @ np.linalg.inv(columns[list(free)]) @ columns.T

    def distance(self, free: tuple[int, ...]) -> float:
        """Return the squared distance when some coefficients may differ."""
        return float(self._deviation @ self._form(free) @ self._deviation)

    def p_value(self, free: tuple[int, ...]) -> float:
        """Return how probable as large deviations are, where no other coefficient differs."""
        rest = self._rest(free)
        if not rest:
            return 1.0
        alone = len(rest) * float(self._alone[rest].min())
        # one coefficient is all of them
        if len(self._deviation) == 1:
            return alone
        return min(1.0, 2 * min(self._together(free), alone))

    def _rest(self, free: tuple[int, ...]) -> list[int]:
        return [j for j in range(len(self._deviation)) if j not in free]

    def _together(self, free: tuple[int, ...]) -> float:
        """Return how probable as large a distance is, where no other coefficient differs.

        The tail of each quadratic form is that of a multiple of χ² with its mean and variance
        (Satterthwaite, 1946).
        """
        form = self._form(free)
        fixed, slopes = form @ self._certain, form @ self._slopes
        mean = np.trace(fixed) + self._change @ np.trace(slopes, axis1=1, axis2=2)
        square = (
            np.sum(fixed * fixed.T)
            + 2 * self._change @ np.einsum("jab,ba->j", slopes, fixed)
            + np.einsum(
                "nj,nj->n", self._change @ np.einsum("jab,lba->jl", slopes, slopes), self._change
            )
        )
        half = square / mean
        return float(chi2.sf(self.distance(free) / half, mean / half).mean())

    def explaining(self) -> list[tuple[int, float, float]]:
        """Return the coefficients that explain the deviation: place, difference, standard error.

        Each time the most deviating one is taken, or the one that leaves the least distance where
        only the distance tells, until what is left is what chance does.
        """
        taken: tuple[int, ...] = ()
        while self.p_value(taken) < SIGNIFICANCE:
            rest = self._rest(taken)
            alone = min(rest, key=lambda j: self._alone[j])
            if 2 * len(rest) * self._alone[alone] < SIGNIFICANCE:
                taken = (*taken, alone)
            else:
                taken = (*taken, min(rest, key=lambda j: self.distance((*taken, j))))
        chosen = list(taken)
        columns = self._inverse[:, chosen]
        moves = np.linalg.inv(columns[chosen]) @ columns.T
        value = moves @ self._deviation
        average = self._certain + np.tensordot(self._change.mean(axis=0), self._slopes, 1)
        spread = np.diag(moves @ average @ moves.T)
        scale = self._scale[chosen]
        return list(
            zip(chosen, map(float, value * scale), map(float, np.sqrt(spread) * scale), strict=True)
        )
