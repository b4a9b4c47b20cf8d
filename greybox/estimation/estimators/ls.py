"""Least squares, as ``--method ls``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from greybox.estimation.registry import Estimator

if TYPE_CHECKING:
    from greybox.estimation.problem import EstimationProblem
    from greybox.estimation.result import Estimate


def _fit(problem: EstimationProblem) -> Estimate:
    from greybox.estimation.estimate import estimate_ls

    return problem.fit_regression(
        "ls",
        problem.predictor(intercept=True),
        lambda predictor: estimate_ls(
            predictor, problem.logs, judged=problem.judged, **problem.common
        ),
    )


ENTRY = Estimator(
    "ls",
    "least squares",
    _fit,
    biased_by_noise=True,
    closed_loop="and least squares has nothing against it: its bias is not known. ",
    order=0,
)
