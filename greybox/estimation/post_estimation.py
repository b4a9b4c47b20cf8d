"""The tests of an estimate that no regression of its own comes with.

Refined instruments and free runs are judged by the plain regression beside them,
with instruments simulated by their own model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from greybox.errors import ExcitationError
from greybox.estimation.credibility import Evidence, assess, convergence, weigh
from greybox.estimation.output_error import one_step_errors
from greybox.estimation.output_setup import measured, output_model
from greybox.estimation.registry import ESTIMATORS
from greybox.estimation.result import Estimate
from greybox.estimation.verdict import NoRegression, TestResult, refused
from greybox.model.predictor import Predictor, build_predictor
from greybox.one_thread import one_thread
from greybox.regression.problem import RegressionProblem
from greybox.regression.regression import Regression
from greybox.trial.log import TrialLog

Array = NDArray[np.float64]


@one_thread
def judge_estimate(
    estimate: Estimate,
    logs: Sequence[TrialLog],
    *,
    margins: dict[str, float] | None = None,
    zero_mean: bool = True,
    heading: Literal["measured", "simulated"] = "measured",
    wind: Literal["smoothed", "measured"] = "smoothed",
    lag: int = 0,
) -> Estimate:
    """Return an estimate with its tests and verdict.

    Parameters
    ----------
    estimate : Estimate
        By instruments or by free runs. Tests that it has already stay, in place of
        those of the same name.
    logs : sequence of TrialLog
        Those it was estimated on.
    margins, zero_mean, heading, wind, lag
        Of its instruments, as `build_instruments`.
    """
    problem = beside(
        estimate, logs, margins=margins, zero_mean=zero_mean, heading=heading, wind=wind, lag=lag
    )
    tested = with_tests(problem, estimate)
    if tested.verdict is not estimate.verdict:
        return tested
    return replace(tested, verdict=weigh(tested.tests, estimate.labels, estimate.method))


def beside(estimate: Estimate, logs: Sequence[TrialLog], **instruments: Any) -> RegressionProblem:
    """Return the regression that stands beside an estimate; `instruments` as `judge_estimate`."""
    return RegressionProblem(_regression_predictor(estimate), tuple(logs), **instruments)


def with_tests(problem: RegressionProblem, estimate: Estimate) -> Estimate:
    """Return an estimate with its tests, by the regression of a problem beside it.

    Without a regression there are none, and the verdict refuses the estimate.
    """
    predictor, logs = problem.predictor, problem.logs
    try:
        regression = problem.regression
    except ExcitationError as error:
        return replace(estimate, verdict=refused([NoRegression(str(error))], estimate.labels))
    instruments = problem.instruments(estimate.structure_theta())
    keep = instruments.keep or tuple(e.keep for e in regression.experiments)
    theta, covariance = _coefficients(estimate, predictor)
    evidence = Evidence(
        predictor,
        regression,
        logs,
        instruments,
        theta,
        covariance,
        _residuals(estimate, regression, logs, keep, problem.zero_mean),
        keep,
        estimate.method,
        problem.zero_mean,
        problem.margins,
        solved=False,
    )
    own = {t.name: t for t in estimate.tests}
    tests: list[TestResult] = [own.pop(t.name, t) for t in assess(evidence)]
    tests += [t for t in convergence(estimate) if t.name not in own]
    tests += own.values()
    return replace(estimate, tests=tuple(tests))


def _regression_predictor(estimate: Estimate) -> Predictor:
    """Return the predictor whose regression stands beside the estimate.

    A free run has the current in the model; a regression captures it by columns.
    """
    own = estimate.predictor
    if not ESTIMATORS[estimate.method].free_run:
        return own
    return build_predictor(own.structure, own.kind, own.regime)


def _coefficients(estimate: Estimate, predictor: Predictor) -> tuple[Array, Array]:
    """Return the estimate's parameters among the columns of `predictor`, biases 0."""
    p = len(predictor.columns)
    theta, covariance = np.zeros(p), np.zeros((p, p))
    place = {c.name: i for i, c in enumerate(predictor.columns) if not c.is_bias}
    own = estimate.predictor
    there = np.array([place[own.columns[i].name] for i in own.parameter_columns])
    theta[there] = estimate.theta[own.parameter_columns]
    covariance[np.ix_(there, there)] = estimate.covariance[
        np.ix_(own.parameter_columns, own.parameter_columns)
    ]
    if predictor is own:
        return estimate.theta, estimate.covariance
    return theta, covariance


def _residuals(
    estimate: Estimate,
    regression: Regression,
    logs: Sequence[TrialLog],
    keep: Sequence[NDArray[np.bool_]],
    zero_mean: bool,
) -> tuple[tuple[Array, ...], ...]:
    """Return the one-step errors of the estimate, equation by equation, zero where cut."""
    predictor = estimate.predictor
    states = predictor.structure.states
    found: list[list[Array]] = [[] for _ in states]
    free_run = ESTIMATORS[estimate.method].free_run
    model = output_model(predictor, estimate.sample_time) if free_run else None
    current = {n: v for n, v, _ in estimate.current}
    for e, log, rows in zip(regression.experiments, logs, keep, strict=True):
        if model is not None:
            p = np.append(estimate.theta, [current.get(n, 0.0) for n in model.means])
            errors = one_step_errors(model, measured(model, log), p).T
        else:
            errors = np.stack(
                [
                    e.y[i] - estimate.theta[mine] @ e.phi[mine]
                    for i, mine in enumerate(predictor.equation(s) for s in states)
                ]
            )
        for i, error in enumerate(errors[: len(states)]):
            centred = error - error[rows].mean() if zero_mean and rows.any() else error
            found[i].append(np.where(rows, centred, 0.0))
    return tuple(tuple(f) for f in found)
