"""Memory of the one-step residuals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from greybox.estimation.result import TestResult, not_applicable

Array = NDArray[np.float64]

LEVEL = 0.05
_LAGS = 10


def whiteness(state: str, residuals: Sequence[Array], columns: int) -> TestResult:
    """Test the one-step residuals for memory (Ljung-Box, 10 lags).

    Residuals of a regression on noisy measurements are a moving average by
    construction, so a rejection asks for robust standard errors, not for
    another model.

    References
    ----------
    Ljung and Box (1978).
    """
    from scipy.special import chdtrc

    name, null = f"whiteness_{state}", "the one-step residuals are white"
    total = sum(len(r) for r in residuals)
    variance = sum(float(r @ r) for r in residuals)
    if variance == 0.0 or total <= _LAGS + columns:
        return not_applicable(name, null, f"{total} residuals, or none that differ from zero")
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
        if p < LEVEL
        else "not told from white."
    )
    return TestResult(name, null, statistic, p, f"residuals are {found}", LEVEL)
