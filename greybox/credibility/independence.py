"""Do the residuals depend on the inputs? The test of a model that IV estimated.

Residuals of a correct model are coloured, so whiteness says nothing; but no
input, at whatever delay, may explain them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from greybox.credibility.evidence import Equation, Evidence
from greybox.credibility.overidentification import delayed
from greybox.credibility.score_statistic import ScoreStatistic
from greybox.credibility.score_test import Conclusion, ScoreTest, equation_score
from greybox.estimation.verdict import TestResult
from greybox.model.run.inputs import LogInputs

Array = NDArray[np.float64]

# delays of the joint statistic: dense where a lag or a delay shows, sparse behind
LAGS = (0, 1, 2, 4, 8, 16)
_TEST = ScoreTest(
    "input_independence",
    "the residuals do not depend on the inputs, at any delay",
    "no input varies beyond what the estimate used",
)


def input_independence(evidence: Evidence, equation: Equation) -> TestResult:
    """Test jointly that residuals are uncorrelated with the inputs at all delays.

    Each ξ is a generalised input at one delay, corrected for the estimate; the
    covariance Σ ξ̃ R ξ̃ᵀ holds a noise model of the residuals.

    References
    ----------
    Ljung (1999), section 16.6; Söderström and Stoica (1989), section 11.
    """
    names = [(n, lag) for lag in LAGS for n in evidence.predictor.structure.inputs]
    xi = _delayed_inputs(evidence, equation)

    def score() -> ScoreStatistic:
        return equation_score(equation, xi)

    def conclude(score: ScoreStatistic, fine: bool) -> Conclusion:
        std = np.sqrt(np.maximum(np.diag(score.covariance), 0.0))
        ratio = np.divide(np.abs(score.moments), std, out=np.zeros_like(std), where=std > 0)
        worst = int(np.argmax(ratio))
        return Conclusion(
            "no input explains the residuals."
            if fine
            else f"the inputs still explain the residuals, most {names[worst][0]} "
            f"{names[worst][1]} samples earlier ({ratio[worst]:.1f} standard errors): "
            f"the model lacks something.",
            fine,
            {"inputs": _correlations(names, xi, equation, score.moments, std)},
        )

    return _TEST.apply(equation, score, conclude)


def _delayed_inputs(evidence: Evidence, equation: Equation) -> list[Array]:
    structure = evidence.predictor.structure
    xi = []
    for log, keep in zip(evidence.logs, equation.keep, strict=True):
        inputs = LogInputs.of(structure, log).tau[: len(keep)].T
        xi.append(np.vstack([delayed(inputs, keep, lag) for lag in LAGS]))
    return xi


def _correlations(
    names: list[tuple[str, int]], xi: list[Array], equation: Equation, moments: Array, std: Array
) -> dict[str, dict[str, list[float]]]:
    """Return each input's correlation with the residuals, and its 95 % band, by delay."""
    size = np.sqrt(
        sum((x**2).sum(axis=1) for x in xi) * sum(float(e @ e) for e in equation.pooled_residuals)
    )
    size = np.where(size > 0, size, 1.0)
    return {
        name: {
            "lags": list(LAGS),
            "correlation": [float(moments[i] / size[i]) for i in _of(names, name)],
            "band": [float(1.96 * std[i] / size[i]) for i in _of(names, name)],
        }
        for name, _ in names[: len(names) // len(LAGS)]
    }


def _of(names: list[tuple[str, int]], wanted: str) -> list[int]:
    return [i for i, (n, _) in enumerate(names) if n == wanted]
