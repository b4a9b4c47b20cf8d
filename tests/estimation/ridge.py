"""Ridge regression: an estimator as another distribution would bring it, in one file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from greybox.estimation.problem import EstimationProblem, Fitted
from greybox.estimation.registry import Estimator
from greybox.estimation.solve import Solved, solve_ls
from greybox.model.predictor import Predictor
from greybox.regression.problem import RegressionProblem

# share of the regressors' own squares that is added to them
PENALTY = 0.01


def fit(problem: EstimationProblem) -> Fitted:
    """Shrink the least-squares estimate towards zero, each coefficient by its information."""

    def solve(predictor: Predictor) -> Solved:
        return solve_ls(
            RegressionProblem(predictor, problem.logs, margins=problem.margins, zero_mean=False)
        )

    def shrink(solved: Solved, notes: list[str]) -> Fitted:
        plain = solved.estimate(problem.covariance or "hac", problem.seed)
        turn = np.eye(len(plain.theta))
        for state in plain.predictor.structure.states:
            mine = plain.predictor.equation(state)
            rows = [e.phi[mine][:, e.keep] for e in solved.problem.regression.experiments]
            gram = sum(phi @ phi.T for phi in rows)
            turn[np.ix_(mine, mine)] = np.linalg.solve(
                gram + PENALTY * np.diag(np.diag(gram)), gram
            )
        covariance = turn @ plain.covariance @ turn.T
        found = replace(plain, method="ridge", theta=turn @ plain.theta, covariance=covariance)
        return Fitted(found, solved.problem)

    return problem.fit_regression("ridge", problem.predictor(intercept=True), solve, shrink)


ENTRY = Estimator(
    "ridge", "ridge regression", fit, biased_by_noise=True, ended="it was shrunk; {status}."
)
