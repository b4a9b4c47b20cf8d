"""Score tests: further moments Σ ξ e against what the estimate leaves of them.

An estimate that solves Σ ẑ e = 0 moves with the noise, so Σ ξ ê = Σ ξ̃ e with
ξ̃ = ξ − (Σ ξ φᵀ) G⁻¹ ẑ and G = Σ ẑ φᵀ. Overidentification (ξ further
instruments), endogeneity (ξ the instruments, ẑ the regressors of least squares)
and independence of the inputs (ξ their lags) are this one statistic.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from greybox.estimation.arma_noise import WHITE, ARMANoise
from greybox.estimation.verdict import Distribution
from greybox.numerics.lagged_moments import lagged_products
from greybox.numerics.linalg import quadratic_form, scaled_inverse

Array = NDArray[np.float64]
# directions with a smaller share of the largest variance rest on a few rows: left untested
_LEAST = 1e-2
Memory = Literal["iid", "white", "coloured"]


@dataclass(frozen=True)
class ScoreStatistic:
    """A score test.

    Parameters
    ----------
    statistic : float
    freedom : int
        Rank of the covariance: restrictions that are not copies of one another.
    null : Distribution
        χ², or with the variance that the statistic has when the signs of the
        scores are random; of F where the noise model leaves the variance uncertain.
    moments : ndarray
        (k,) Σ ξ ê, less its expectation.
    covariance : ndarray
        (k, k)
    """

    statistic: float
    freedom: int
    null: Distribution
    moments: Array
    covariance: Array

    @property
    def p_value(self) -> float:
        """Probability of a larger statistic under the null; 1 where nothing was tested."""
        return self.null.sf(self.statistic) if self.freedom else 1.0


def residualise(xi: Sequence[Array], phi: Sequence[Array], zhat: Sequence[Array]) -> list[Array]:
    """Return ξ̃ = ξ − (Σ ξ φᵀ) G⁻¹ ẑ, experiment by experiment."""
    if not phi[0].shape[0]:
        return list(xi)
    cross = lagged_products(xi, phi, 0)
    weights = cross @ scaled_inverse(lagged_products(zhat, phi, 0))
    return [x - weights @ z for x, z in zip(xi, zhat, strict=True)]


def _without_copies(xi: Sequence[Array], tilde: list[Array]) -> list[Array]:
    """Return ξ̃ with zeros where ξ lies in the span of ẑ, whose moments vanish by themselves."""
    before = np.asarray(sum((x**2).sum(axis=1) for x in xi))
    after = np.asarray(sum((x**2).sum(axis=1) for x in tilde))
    fresh = after > 1e-10 * before
    return [np.where(fresh[:, None], x, 0.0) for x in tilde]


def score_test(
    xi: Sequence[Array],
    phi: Sequence[Array],
    zhat: Sequence[Array],
    errors: Sequence[Array],
    *,
    memory: Memory = "coloured",
    noise_model: ARMANoise = WHITE,
    mean: Array | None = None,
) -> ScoreStatistic:
    """Test E ξ e = 0 where the estimate solves Σ ẑ ê = 0.

    Parameters
    ----------
    xi : sequence of ndarray
        (k, N) an experiment, zero in rows that do not take part.
    phi, zhat : sequence of ndarray
        (p, N) regressors, and instruments as the estimator combined them.
    errors : sequence of ndarray
        (N,) residuals.
    memory : {"iid", "white", "coloured"}
        Errors alike and independent (Sargan, Durbin); uncorrelated, their size
        changing (Wooldridge); e = H ε with ξ and ẑ independent of the errors,
        Σ (Hᵀξ̃)(Hᵀξ̃)ᵀ ε².
    noise_model : ARMANoise
        H, for ``coloured``.
    mean : ndarray, optional
        (k,) what Σ ξ ê is expected to be, where that is not zero.

    References
    ----------
    Sargan (1958); Hansen (1982); Wooldridge (1995); Durbin (1954); random
    signs: Davidson and Flachaire (2008), whose bootstrap moments are used.
    """
    tilde = _without_copies(xi, residualise(xi, phi, zhat))
    moments = np.asarray(sum(x @ e for x, e in zip(xi, errors, strict=True)))
    if mean is not None:
        moments = moments - mean
    taken, known = 0.0, 1e9
    if memory == "iid":
        square = sum(float(e @ e) for e in errors) / sum(len(e) for e in errors)
        covariance = lagged_products(tilde, tilde, 0) * square
        statistic, freedom, _ = quadratic_form(moments, covariance, _LEAST)
    else:
        h = noise_model if memory == "coloured" else WHITE
        scores = [
            h.adjoint(x, log) * h.innovations(e, log)
            for log, (x, e) in enumerate(zip(tilde, errors, strict=True))
        ]
        covariance = lagged_products(scores, scores, 0)
        statistic, freedom, whitening = quadratic_form(moments, covariance, _LEAST)
        # Σ h² of the leverages: what a few large scores take from the variance 2k of χ²
        if freedom:
            known = float(h.freedom_of([whitening @ x for x in tilde], together=True)[0])
        taken = sum(float((((whitening @ s) ** 2).sum(axis=0) ** 2).sum()) for s in scores)
    share = max(1.0 - taken / freedom, 0.05) if freedom else 1.0
    null = Distribution("F", (freedom / share, known), float(freedom))
    return ScoreStatistic(statistic, freedom, null, moments, covariance)
