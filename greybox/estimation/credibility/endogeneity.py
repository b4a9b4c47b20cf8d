"""Would least squares do? The Durbin-Wu-Hausman test in its robust score form."""

from __future__ import annotations

import numpy as np

from greybox.estimation.credibility.evidence import Equation
from greybox.estimation.credibility.scores import score_test
from greybox.estimation.result import TestResult, not_applicable

LEVEL = 0.05


def endogeneity(equation: Equation, method: str = "ls") -> TestResult:
    """Test that least squares and instrumental variables estimate the same.

    The moments of the instruments are taken with the residuals of least
    squares. Regressors hold earlier states, so least squares can only suffice
    where the residuals have no memory: the covariance allows for noise of
    changing size, not for colour.

    A rejection speaks against a least-squares estimate and for an instrumental
    one, so only the former can fail (`passed`).

    References
    ----------
    Durbin (1954); Hausman (1978); Wooldridge (1995), score form.
    """
    name = f"endogeneity_{equation.state}"
    null = "the regressors do not depend on the noise: least squares suffices"
    if equation.obstacle:
        return not_applicable(name, null, equation.obstacle)
    gram = np.asarray(sum(f @ f.T for f in equation.phi))
    right = np.asarray(sum(f @ y for f, y in zip(equation.phi, equation.y, strict=True)))
    size = np.sqrt(np.diag(gram))
    theta = np.linalg.lstsq(gram / np.outer(size, size), right / size, rcond=None)[0] / size
    errors = [y - theta @ f for y, f in zip(equation.y, equation.phi, strict=True)]
    score = score_test(
        equation.solution.projected,
        equation.phi,
        equation.phi,
        errors,
        memory="white",
    )
    if not score.freedom:
        return not_applicable(name, null, "no regressor of this equation is noisy")
    suffices = score.p_value >= LEVEL
    std = np.where(equation.std > 0, equation.std, np.inf)
    gap = np.abs(theta - equation.solution.theta) / std
    far = int(np.argmax(gap))
    return TestResult(
        name,
        null,
        score.statistic,
        score.p_value,
        f"χ²({score.freedom}) = {score.statistic:.1f} (p = {score.p_value:.2g}): "
        + (
            "least squares is not told from instrumental variables here."
            if suffices
            else f"least squares is biased here, most in {equation.labels[far]} "
            f"(by {gap[far]:.1f} standard errors of the instrumental estimate)."
        ),
        LEVEL,
        suffices if method == "ls" else None,
        (),
        {
            "degrees_of_freedom": score.freedom,
            "least_squares": dict(zip(equation.labels, theta.tolist(), strict=True)),
        },
    )
