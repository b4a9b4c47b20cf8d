"""Least squares, as ``--method ls``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from greybox.estimation.registry import Estimator

if TYPE_CHECKING:
    from greybox.estimation.problem import EstimationProblem, Fitted
    from greybox.estimation.solve import Solved
    from greybox.model.predictor import Predictor


def _fit(problem: EstimationProblem) -> Fitted:
    from greybox.estimation.problem import Fitted
    from greybox.estimation.solve import solve_ls
    from greybox.regression.problem import RegressionProblem

    def fit(predictor: Predictor) -> Solved:
        return solve_ls(
            RegressionProblem(predictor, problem.logs, margins=problem.margins, zero_mean=False)
        )

    def finish(solved: Solved, notes: list[str]) -> Fitted:
        estimate = solved.estimate(problem.covariance or "cluster", problem.seed)
        return Fitted(estimate, solved.problem, solved)

    return problem.fit_regression("ls", problem.predictor(intercept=True), fit, finish)


ENTRY = Estimator(
    "ls",
    "least squares",
    _fit,
    biased_by_noise=True,
    closed_loop="and least squares has nothing against it: its bias is not known. ",
    order=0,
)
