"""Would least squares do? The Durbin-Wu-Hausman test in its robust score form."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from greybox.credibility.evidence import Equation
from greybox.credibility.predetermined import moments_mean, noise_after_error
from greybox.credibility.score_statistic import ScoreStatistic, score_test
from greybox.credibility.score_test import Conclusion, ScoreTest
from greybox.estimation.verdict import TestResult
from greybox.numerics.linalg import scaled_inverse

Array = NDArray[np.float64]

_TEST = ScoreTest(
    "endogeneity",
    "the regressors do not depend on the noise: least squares suffices",
    "no regressor of this equation is noisy",
)


def endogeneity(equation: Equation, *, decisive: bool = True) -> TestResult:
    """Test that least squares and instrumental variables estimate the same.

    The moments of the instruments are taken with the residuals of least
    squares. Regressors hold earlier states, so least squares can only suffice
    where the residuals have no memory: the covariance allows for noise of
    changing size, not for colour. Regressors that feel earlier noise give the
    moments a mean of up to half a standard deviation in logs of 1000 samples,
    which is taken off.

    A rejection speaks against a least-squares estimate and for an instrumental
    one, so only the former can fail (`passed`): there the test is `decisive`.

    References
    ----------
    Durbin (1954); Hausman (1978); Wooldridge (1995), score form.
    """

    def score() -> ScoreStatistic:
        errors = equation.residuals_of(_least_squares(equation))
        zhat = equation.solution.projected
        noise = [f - z for f, z in zip(equation.phi, zhat, strict=True)]
        after = noise_after_error(noise, errors)
        mean = moments_mean(zhat, equation.phi, after, centred=equation.centred)
        return score_test(zhat, equation.phi, equation.phi, errors, memory="white", mean=mean)

    def conclude(score: ScoreStatistic, suffices: bool) -> Conclusion:
        theta = _least_squares(equation)
        std = np.where(equation.std > 0, equation.std, np.inf)
        gap = np.abs(theta - equation.solution.theta) / std
        far = int(np.argmax(gap))
        return Conclusion(
            "least squares and instrumental variables do not differ beyond chance here."
            if suffices
            else f"least squares is biased here, most in {equation.labels[far]} "
            f"(by {gap[far]:.1f} standard errors of the instrumental estimate).",
            suffices if decisive else None,
            {"least_squares": dict(zip(equation.labels, theta.tolist(), strict=True))},
        )

    return _TEST.apply(equation, score, conclude)


def _least_squares(equation: Equation) -> Array:
    gram = np.asarray(sum(f @ f.T for f in equation.phi))
    right = np.asarray(sum(f @ y for f, y in zip(equation.phi, equation.y, strict=True)))
    return np.asarray(scaled_inverse(gram) @ right)
