"""Memory of the one-step residuals."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from greybox.credibility.evidence import Equation, Evidence
from greybox.credibility.score_statistic import score_test
from greybox.estimation.verdict import TestResult, not_applicable

Array = NDArray[np.float64]

LEVEL = 0.05
_LAGS = 10


def whiteness(evidence: Evidence, row: int) -> TestResult:
    """Test the one-step residuals of an equation for memory, 10 lags together.

    The autocovariances are scaled by Σ e²(t) e²(t−k), which noise of changing
    size needs, and corrected for the estimated parameters. Residuals of a
    regression on noisy measurements are a moving average by construction, so a
    rejection asks for robust standard errors, not for another model. The
    autocorrelation by lag and its 95 % band are in ``detail``.

    References
    ----------
    Breusch (1978); Godfrey (1978); Lobato, Nankervis and Savin (2002).
    """
    state = evidence.predictor.structure.states[row]
    null = "the one-step residuals are white"
    residuals = _centred(evidence, row)
    total = sum(int(k.sum()) for k in evidence.keep)
    variance = sum(float(e @ e) for e in residuals)
    columns = evidence.predictor.equation(state)
    if variance < 1e-30 or total <= _LAGS + 2 * len(columns):
        reason = f"{total} residuals, or none that differ from zero"
        return not_applicable("whiteness", null, reason, state)
    xi = [np.array([_later(e, lag) for lag in range(1, _LAGS + 1)]) for e in residuals]
    phi, zhat = _normal_equations(evidence, row, residuals)
    score = score_test(xi, phi, zhat, residuals, memory="white")
    white = score.p_value >= LEVEL
    found = (
        "not told from white."
        if white
        else "coloured, as noisy regressors make them; the standard errors allow for it."
    )
    return TestResult(
        "whiteness", null, score.statistic, score.p_value, f"residuals are {found}", LEVEL,
        state=state, distribution=score.null,
        detail={
            "degrees_of_freedom": score.freedom,
            "lags": list(range(1, _LAGS + 1)),
            "correlation": (score.moments / variance).tolist(),
            "band": (1.96 * np.sqrt(np.diag(score.covariance)) / variance).tolist(),
        },
    )  # fmt: skip


def _later(e: Array, lag: int) -> Array:
    out = np.zeros_like(e)
    if lag < len(e):
        out[lag:] = e[: len(e) - lag]
    return out


def _centred(evidence: Evidence, row: int) -> list[Array]:
    out = []
    for e, keep in zip(evidence.residuals[row], evidence.keep, strict=True):
        mean = e[keep].mean() if keep.any() else 0.0
        out.append(np.where(keep, e - mean, 0.0))
    return out


def _normal_equations(
    evidence: Evidence, row: int, residuals: list[Array]
) -> tuple[list[Array], list[Array]]:
    """Return φ and ẑ of the equations that these residuals solve, or empty ones.

    Residuals of another estimator than least squares and instrumental variables
    are taken as they are.
    """
    empty = [np.zeros((0, len(e))) for e in residuals]
    if not evidence.equations or not evidence.solved:
        return empty, empty
    equation: Equation = evidence.equations[row]
    same = all(np.array_equal(a, b) for a, b in zip(equation.keep, evidence.keep, strict=True))
    if equation.obstacle or not same:
        return empty, empty
    zhat = equation.solution.projected if evidence.estimator.instruments else equation.phi
    return list(equation.phi), list(zhat)
