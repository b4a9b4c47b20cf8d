"""Ridge regression: an estimator as another distribution would bring it, in one file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from greybox.estimation.estimate import estimate_ls
from greybox.estimation.post_estimation import judge_estimate
from greybox.estimation.problem import EstimationProblem
from greybox.estimation.registry import Estimator
from greybox.estimation.result import Estimate
from greybox.model.predictor import Predictor
from greybox.regression.regression import build_regression

# share of the regressors' own squares that is added to them
PENALTY = 0.01


def fit(problem: EstimationProblem) -> Estimate:
    """Shrink the least-squares estimate towards zero, each coefficient by its information."""

    def shrunk(predictor: Predictor) -> Estimate:
        plain = estimate_ls(predictor, problem.logs, judged=False, **problem.common)
        regression = build_regression(predictor, problem.logs, margins=problem.margins)
        theta, turn = plain.theta.copy(), np.eye(len(plain.theta))
        for state in predictor.structure.states:
            mine = predictor.equation(state)
            gram = sum(e.phi[mine][:, e.keep] @ e.phi[mine][:, e.keep].T
                       for e in regression.experiments)  # fmt: skip
            less = np.linalg.solve(gram + PENALTY * np.diag(np.diag(gram)), gram)
            turn[np.ix_(mine, mine)] = less
        found = replace(
            plain,
            method=ENTRY.name,
            theta=turn @ theta,
            covariance=turn @ plain.covariance @ turn.T,
        )
        if not problem.judged:
            return found
        return judge_estimate(found, problem.logs, margins=problem.margins, zero_mean=False)

    return problem.fit_regression(
        ENTRY.name, problem.predictor(intercept=True), shrunk, lambda found, notes: found
    )


ENTRY = Estimator(
    "ridge", "ridge regression", fit, biased_by_noise=True, ended="it was shrunk; {status}."
)
