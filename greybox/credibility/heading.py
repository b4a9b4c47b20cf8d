"""Do the residuals turn with the heading? The test of an estimate in still water."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from greybox.credibility.evidence import Equation, Evidence
from greybox.credibility.score_statistic import ScoreStatistic, score_test
from greybox.credibility.score_test import Conclusion, ScoreTest
from greybox.estimation.verdict import TestResult, not_applicable

Array = NDArray[np.float64]

_TEST = ScoreTest(
    "heading_independence",
    "the residuals do not depend on the heading: no current or wind that turns about the ship",
    "the heading does not vary beyond what the estimate used",
)
# spread of the heading below which a current is as good as a constant [rad]
_LEAST_SPREAD = 0.3


def heading_independence(evidence: Evidence, equation: Equation) -> TestResult:
    """Test that residuals are uncorrelated with the cosine and sine of the heading.

    A current, or a steady wind, that the predictor lacks enters every equation by its
    components along and across the ship. The heading is an integral: what it owes to
    past noise is uncorrelated with residuals to come.

    References
    ----------
    Ljungberg (2020), section 5.2: the disturbance in body axes (3.34).
    """
    if evidence.predictor.augmented:
        return not_applicable(
            _TEST.kind, _TEST.null, "the predictor captures the disturbance",
            equation.state,
        )  # fmt: skip
    spread = max((float(np.std(log["psi"])) for log in evidence.logs if "psi" in log), default=0.0)
    if spread < _LEAST_SPREAD:
        return not_applicable(
            _TEST.kind, _TEST.null,
            f"the heading spreads by {np.degrees(spread):.0f} deg, {np.degrees(_LEAST_SPREAD):.0f} "
            f"are needed",
            equation.state,
        )  # fmt: skip

    def score() -> ScoreStatistic:
        return score_test(
            _around(evidence, equation),
            equation.phi,
            equation.solution.projected,
            equation.residuals,
            noise_model=equation.noise_model,
        )

    return _TEST.apply(equation, score, _conclude)


def _around(evidence: Evidence, equation: Equation) -> list[Array]:
    """Return cosine and sine of the heading, (2, N) per log, zero-mean, zero where cut out."""
    out = []
    for log, keep in zip(evidence.logs, equation.keep, strict=True):
        psi = log["psi"][: len(keep)]
        both = np.vstack([np.cos(psi), np.sin(psi)])
        if keep.any():
            both = both - both[:, keep].mean(axis=1, keepdims=True)
        out.append(np.where(keep, both, 0.0))
    return out


def _conclude(score: ScoreStatistic, fine: bool) -> Conclusion:
    return Conclusion(
        "no disturbance turns with the heading."
        if fine
        else "the residuals turn with the heading, as in a current or wind that this predictor "
        "does not capture: use --predictor augmented, or find it with greybox diagnose.",
        fine,
        {},
    )
