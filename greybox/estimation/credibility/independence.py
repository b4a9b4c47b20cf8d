"""Do the residuals depend on the inputs? The test of a model that IV estimated.

Residuals of a correct model are coloured, so whiteness says nothing; but no
input, at whatever delay, may explain them.
"""

from __future__ import annotations

import numpy as np

from greybox.estimation.credibility.evidence import Equation, Evidence
from greybox.estimation.credibility.overidentification import delayed
from greybox.estimation.credibility.scores import score_test
from greybox.estimation.result import TestResult, not_applicable

LEVEL = 0.05
# delays of the joint statistic: dense where a lag or a delay shows, sparse behind
LAGS = (0, 1, 2, 4, 8, 16)


def input_independence(evidence: Evidence, equation: Equation) -> TestResult:
    """Test jointly that residuals are uncorrelated with the inputs at all delays.

    Each ξ is a generalised input at one delay, corrected for the estimate; the
    covariance Σ ξ̃ R ξ̃ᵀ holds a noise model of the residuals.

    References
    ----------
    Ljung (1999), section 16.6; Söderström and Stoica (1989), section 11.
    """
    state = equation.state
    name = f"input_independence_{state}"
    null = "the residuals do not depend on the inputs, at any delay"
    if equation.obstacle:
        return not_applicable(name, null, equation.obstacle)
    structure = evidence.predictor.structure
    xi = []
    for log, keep in zip(evidence.logs, equation.keep, strict=True):
        inputs = (
            log.forces(structure.inputs)
            if structure.disturbance == "marine"
            else np.column_stack([log[n] for n in structure.inputs])
        )[: len(keep)].T
        xi.append(np.vstack([delayed(inputs, keep, lag) for lag in LAGS]))
    names = [(n, lag) for lag in LAGS for n in structure.inputs]
    score = score_test(
        xi,
        equation.phi,
        equation.solution.projected,
        equation.residuals,
        colour=equation.colour,
    )
    if not score.freedom:
        return not_applicable(name, null, "no input varies beyond what the estimate used")
    size = np.sqrt(
        sum((x**2).sum(axis=1) for x in xi) * sum(float(e @ e) for e in equation.residuals)
    )
    size = np.where(size > 0, size, 1.0)
    std = np.sqrt(np.maximum(np.diag(score.covariance), 0.0))
    ratio = np.divide(np.abs(score.moments), std, out=np.zeros_like(std), where=std > 0)
    worst = int(np.argmax(ratio))
    fine = score.p_value >= LEVEL
    detail = {
        n: {
            "lags": list(LAGS),
            "correlation": [float(score.moments[i] / size[i]) for i in _of(names, n)],
            "band": [float(1.96 * std[i] / size[i]) for i in _of(names, n)],
        }
        for n in structure.inputs
    }
    return TestResult(
        name,
        null,
        score.statistic,
        score.p_value,
        f"χ²({score.freedom}) = {score.statistic:.1f} (p = {score.p_value:.2g}): "
        + (
            "no input explains the residuals."
            if fine
            else f"the inputs still explain the residuals, most {names[worst][0]} "
            f"{names[worst][1]} samples earlier ({ratio[worst]:.1f} standard errors): "
            f"the model lacks something."
        ),
        LEVEL,
        fine,
        (),
        {"degrees_of_freedom": score.freedom, "inputs": detail},
    )


def _of(names: list[tuple[str, int]], wanted: str) -> list[int]:
    return [i for i, (n, _) in enumerate(names) if n == wanted]
