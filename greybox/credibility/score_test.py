"""One score test of one equation: what it asks, and how its answer is told."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from greybox.credibility.evidence import Equation
from greybox.credibility.score_statistic import Array, ScoreStatistic, score_test
from greybox.estimation.verdict import TestResult, not_applicable

LEVEL = 0.05


def equation_score(equation: Equation, xi: Sequence[Array]) -> ScoreStatistic:
    """Test E ξ e = 0 in one equation, with the memory of its noise model."""
    return score_test(
        xi,
        equation.phi,
        equation.pooled.projected,
        equation.pooled_residuals,
        noise_model=equation.noise_model,
    )


@dataclass(frozen=True)
class Conclusion:
    """What a score says.

    Parameters
    ----------
    sentence : str
        Without statistic and p-value.
    passed : bool, optional
        None where the test only informs.
    detail : mapping
    """

    sentence: str
    passed: bool | None
    detail: Mapping[str, Any]


@dataclass(frozen=True)
class ScoreTest:
    """A score test: what it asks of an equation, and how its answer is told.

    Parameters
    ----------
    kind : str
        The test's name without its equation.
    null : str
    untested : str
        Why it does not apply where no moment is left to test.
    """

    kind: str
    null: str
    untested: str

    def apply(
        self,
        equation: Equation,
        score: Callable[[], ScoreStatistic],
        conclude: Callable[[ScoreStatistic, bool], Conclusion],
    ) -> TestResult:
        """Return the test of an equation, or why it does not apply.

        Parameters
        ----------
        equation : Equation
        score : callable
            Called only where the equation can be tested.
        conclude : callable
            Of the score, and whether it is accepted at the 5 % level.
        """
        if equation.obstacle:
            return not_applicable(self.kind, self.null, equation.obstacle, equation.state)
        found = score()
        if not found.freedom:
            return not_applicable(self.kind, self.null, self.untested, equation.state)
        told = conclude(found, found.p_value >= LEVEL)
        return TestResult(
            self.kind,
            self.null,
            found.statistic,
            found.p_value,
            f"χ²({found.freedom}) = {found.statistic:.1f} (p = {found.p_value:.2g}): "
            f"{told.sentence}",
            LEVEL,
            told.passed,
            (),
            {"degrees_of_freedom": found.freedom, **told.detail},
            state=equation.state,
            distribution=found.null,
        )
