"""Whether the iteration that an estimate comes from ended at one."""

from __future__ import annotations

from greybox.estimation.result import Estimate
from greybox.estimation.verdict import TestResult

_NULL = "the iteration ended at an estimate that it no longer moves"
_MEANS = {
    "iv": "so the standard errors may be too small: 95 % intervals of such estimates held 91 % of "
    "the true values in simulated trials",
    "oe": "so a better fit may be near: start elsewhere (--nominal), or take a smaller structure",
}


def convergence(estimate: Estimate) -> tuple[TestResult, ...]:
    """Return what is to be said of the iteration, nothing where there was none.

    Parameters
    ----------
    estimate : Estimate
        Its ``converged`` and ``status`` are read.
    """
    if not estimate.iterations:
        return ()
    means = "" if estimate.converged else f", {_MEANS.get(estimate.method, 'so it may be off')}"
    sentence = f"the iteration {_after_the(estimate.status)}{means}."
    return (
        TestResult(
            "convergence", _NULL, float(estimate.iterations), None, sentence,
            passed=estimate.converged,
        ),
    )  # fmt: skip


def _after_the(status: str) -> str:
    return status.removeprefix("the refinement ").removeprefix("prefiltered by the noise, ")
