"""First tests of an estimate: excitation, memory of the residuals, sign margins."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from greybox.estimation.moments import Solution
from greybox.estimation.result import TestResult
from greybox.model.predictor import Predictor
from greybox.trial.log import TrialLog

Array = NDArray[np.float64]

# a direction with a smaller share of the largest singular value is called weak
_WEAK = 1e-3
_LAGS = 10


def excitation(predictor: Predictor, state: str, solution: Solution) -> TestResult:
    """Tell how well the instruments determine the weakest direction of one equation."""
    mine = predictor.equation(state)
    ratio = float(solution.singular_values[-1] / solution.singular_values[0])
    size = np.abs(solution.weakest)
    involved = [predictor.columns[mine[i]].label for i in np.argsort(-size) if size[i] > 0.3]
    verdict = (
        f"the combination of {', '.join(involved)} is weakly determined: "
        f"move what they multiply separately."
        if ratio < _WEAK
        else f"every direction is determined; the weakest combines {', '.join(involved)}."
    )
    return TestResult(
        f"excitation_{state}",
        "the regressors that the instruments explain are independent",
        ratio,
        None,
        f"smallest relative singular value {ratio:.1e} ({_WEAK:.0e} asked for): {verdict}",
    )


def whiteness(state: str, residuals: Sequence[Array], columns: int) -> TestResult:
    """Test the one-step residuals for memory (Ljung-Box, 10 lags).

    Residuals of a regression on noisy measurements are a moving average by
    construction, so a rejection asks for robust standard errors, not for
    another model.
    """
    from scipy.special import chdtrc

    total = sum(len(r) for r in residuals)
    variance = sum(float(r @ r) for r in residuals)
    null = "the one-step residuals are white"
    if variance == 0.0 or total <= _LAGS + columns:
        return TestResult(
            f"whiteness_{state}",
            null,
            None,
            None,
            f"not applicable: {total} residuals, or none that differ from zero.",
        )
    rho = np.array(
        [
            sum(float(r[k:] @ r[: len(r) - k]) for r in residuals if len(r) > k) / variance
            for k in range(1, _LAGS + 1)
        ]
    )
    statistic = total * (total + 2) * float((rho**2 / (total - np.arange(1, _LAGS + 1))).sum())
    p = float(chdtrc(_LAGS, statistic))
    found = (
        "coloured, as noisy regressors make them; the standard errors allow for it."
        if p < 0.05
        else "not told from white."
    )
    return TestResult(f"whiteness_{state}", null, statistic, p, f"residuals are {found}")


def sign_margins(
    logs: Sequence[TrialLog], states: tuple[str, ...], margins: dict[str, float] | None, cut: int
) -> list[TestResult]:
    """Report how many samples come closer to the origin than three noise deviations (A10)."""
    out = []
    for state in ("u", "v"):
        if state not in states:
            continue
        std = logs[0].vessel.std(state)
        null = f"|{state}| stays beyond its margin, so that |{state}| is differentiable there"
        margin = (margins or {}).get(state)
        if margin is None and std is not None:
            margin = 3 * std
        if margin is None:
            out.append(
                TestResult(
                    f"margin_{state}",
                    null,
                    None,
                    None,
                    f"not applicable: the vessel file gives no {state}_std and no margin was set.",
                )
            )
            continue
        value = np.concatenate([log[state] for log in logs])
        share = float((np.abs(value) <= margin).mean())
        advice = (
            f"; {cut} samples were cut out for their margins"
            if margins
            else ""
            if share < 0.01
            else f", which biases modulus terms: cut them with --margin-{state}"
        )
        out.append(
            TestResult(
                f"margin_{state}",
                null,
                share,
                None,
                f"{100 * share:.1f} % of the samples have |{state}| below {margin:.3g} m/s"
                f"{advice}.",
            )
        )
    return out
