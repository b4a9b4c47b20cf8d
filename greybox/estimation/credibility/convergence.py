"""Whether the iteration that an estimate comes from ended at one."""

from __future__ import annotations

from greybox.estimation.registry import ESTIMATORS
from greybox.estimation.result import Estimate
from greybox.estimation.verdict import TestResult

_NULL = "the iteration ended at an estimate that it no longer moves"


def convergence(estimate: Estimate) -> tuple[TestResult, ...]:
    """Return what is to be said of the iteration, nothing where there was none.

    Parameters
    ----------
    estimate : Estimate
        Its ``iteration`` is read.
    """
    if not estimate.iterations:
        return ()
    means = "" if estimate.converged else f", {ESTIMATORS[estimate.method].unconverged}"
    sentence = f"the iteration {estimate.iteration.ended}{means}."
    return (
        TestResult(
            "convergence", _NULL, float(estimate.iterations), None, sentence,
            passed=estimate.converged,
        ),
    )  # fmt: skip
