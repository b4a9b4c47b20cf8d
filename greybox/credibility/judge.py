"""The tests of an estimate, by whatever estimator: the one place where they are run.

Least squares and plain instrumental variables are judged by the equations that they solve,
refined instruments and free runs by the plain regression beside them, with instruments
simulated by their own model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from greybox.credibility.assess import assess
from greybox.credibility.evidence import Evidence
from greybox.errors import ExcitationError
from greybox.estimation.output_error import one_step_errors
from greybox.estimation.output_setup import measured, output_model
from greybox.estimation.problem import Fitted
from greybox.estimation.registry import ESTIMATORS
from greybox.estimation.result import Estimate
from greybox.estimation.verdict import NoRegression, TestResult, refused
from greybox.model.predictor import Predictor
from greybox.regression.regression import Regression
from greybox.trial.log import TrialLog

Array = NDArray[np.float64]


def run_tests(fitted: Fitted) -> Estimate:
    """Return an estimate with its tests, by the regression beside it.

    Tests that it has already stay, in place of those of the same name. Without a regression
    there are none, and the verdict refuses the estimate.
    """
    estimate = fitted.estimate
    try:
        evidence = evidence_of(fitted)
    except ExcitationError as error:
        return replace(estimate, verdict=refused([NoRegression(str(error))], estimate.labels))
    own = {t.name: t for t in estimate.tests}
    tests: list[TestResult] = [own.pop(t.name, t) for t in assess(evidence)]
    tests += [t for t in convergence(estimate) if t.name not in own]
    tests += own.values()
    return replace(estimate, tests=tuple(tests))


def evidence_of(fitted: Fitted, information: Sequence[Array] | None = None) -> Evidence:
    """Return what the tests of an estimate look at.

    Parameters
    ----------
    fitted : Fitted
    information : sequence of ndarray, optional
        (p, p) Σ ẑ φᵀ of each equation, where the estimate rests on more samples than the logs
        of the regression hold.

    Raises
    ------
    ExcitationError
        The logs hold no regression.
    """
    estimate, problem, solved = fitted.estimate, fitted.regression, fitted.solved
    predictor, logs = problem.predictor, problem.logs
    regression = problem.regression
    if solved is None:
        instruments = problem.instruments(estimate.structure_theta(predictor.structure))
        keep = instruments.keep or tuple(e.keep for e in regression.experiments)
    else:
        instruments, keep = solved.simulated, tuple(solved.keep)
    theta, covariance = _coefficients(estimate, predictor)
    return Evidence(
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
        solved=solved is not None,
        white=fitted.white,
        information=None if information is None else tuple(information),
        integrator=estimate.integrator,
    )


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
            "convergence",
            "the iteration ended at an estimate that further steps do not change",
            float(estimate.iterations),
            None,
            sentence,
            passed=estimate.converged,
        ),
    )


def _coefficients(estimate: Estimate, predictor: Predictor) -> tuple[Array, Array]:
    """Return the estimate's parameters among the columns of `predictor`, biases 0."""
    p = len(predictor.columns)
    theta, covariance = np.zeros(p), np.zeros((p, p))
    place = {c.name: i for i, c in enumerate(predictor.columns) if not c.is_bias}
    own = estimate.predictor
    # a regression has no column of what only a free run in a current shows
    shared = [i for i in own.parameter_columns if own.columns[i].name in place]
    there = np.array([place[own.columns[i].name] for i in shared])
    theta[there] = estimate.theta[shared]
    covariance[np.ix_(there, there)] = estimate.covariance[np.ix_(shared, shared)]
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
    model = (
        output_model(predictor, estimate.sample_time, integrator=estimate.integrator)
        if free_run
        else None
    )
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
