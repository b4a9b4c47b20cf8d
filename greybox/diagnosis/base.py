"""The model before any cause, fitted to the logs: where every diagnosis begins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.fitting import Fit, Point, Problem
from greybox.diagnosis.noise import fit_noise
from greybox.diagnosis.ship import LogRun, Ship
from greybox.errors import ExcitationError, GreyboxError
from greybox.estimation.estimate import estimate_ls
from greybox.estimation.output_error import OutputErrorOptions, estimate_oe
from greybox.estimation.output_setup import output_predictor
from greybox.model.functions import Integrator
from greybox.model.predictor import Regime, build_predictor
from greybox.model.structure import Structure
from greybox.trial.log import TrialLog

Array = NDArray[np.float64]

_BOTH: tuple[Integrator, ...] = ("euler", "rk4")


def rough_coefficients(
    structure: Structure, logs: Sequence[TrialLog], kind: str, regime: Regime
) -> dict[str, float]:
    """Return the coefficients of least squares, biased by noise but near enough.

    Raises
    ------
    ExcitationError
        The logs do not determine them.
    """
    fitted = estimate_ls(build_predictor(structure, kind, regime), logs, judged=False)
    return dict(zip(structure.parameters, map(float, fitted.structure_theta()), strict=True))


def careful_coefficients(
    structure: Structure, logs: Sequence[TrialLog], kind: str, regime: Regime
) -> dict[str, float]:
    """Return coefficients by output error, which finds a way from far off.

    Raises
    ------
    ExcitationError
        The logs do not determine them.
    """
    fitted = estimate_oe(
        output_predictor(structure, kind, regime), logs,
        options=OutputErrorOptions(heading="input", covariance="white"),
    )  # fmt: skip
    return dict(zip(structure.parameters, map(float, fitted.structure_theta()), strict=True))


def make_problem(
    universe: Structure,
    logs: Sequence[TrialLog],
    integrator: Integrator,
    origins: Sequence[float] | None = None,
) -> Problem:
    """Return logs ready to be run with every term that a cause may add."""
    return Problem(
        [
            LogRun(universe, log, integrator, None if origins is None else origins[i])
            for i, log in enumerate(logs)
        ]
    )


def fit_base(
    problem: Problem, structure: Structure, coefficients: Mapping[str, float], current: Array
) -> Fit:
    """Fit the coefficients of the model that is diagnosed, then the colour of its errors."""
    theta = np.array([coefficients.get(n, 0.0) for n in problem.structure.parameters])
    places = tuple(problem.place(n) for n in structure.parameters)
    starts = tuple(run.start() for run in problem.runs)
    point = Point(Ship(theta, current, problem.runs[0].log.vessel), starts, places)
    errors = problem.errors(point)
    if not all(np.isfinite(e).all() for e in errors):
        raise ExcitationError(
            f"the free run of '{structure.name}' leaves every bound from its first coefficients: "
            f"give a model that follows the logs with --model."
        )
    # errors of a model far off look like a force with a memory, and weigh little as that
    noise = fit_noise(errors, problem.poles(point), problem.sample_time, problem.groups)
    return problem.settle(problem.fit(point, noise), 3)


def base_fit(
    universe: Structure,
    structure: Structure,
    logs: Sequence[TrialLog],
    coefficients: Mapping[str, float],
    current: Array,
) -> tuple[Problem, Fit]:
    """Return the problem and fit with the integrator that the logs ask for.

    A log from a simulation in steps of its sample time wants Euler's rule, a ship
    whose commands are held between samples the classical Runge-Kutta rule.
    """
    found: list[tuple[Problem, Fit]] = []
    failed: GreyboxError | None = None
    for integrator in _BOTH:
        problem = make_problem(universe, logs, integrator)
        try:
            found.append((problem, fit_base(problem, structure, coefficients, current)))
        except ExcitationError as error:
            failed = error
    finite = [pair for pair in found if not pair[1].escaped]
    if not finite:
        raise failed or ExcitationError(
            f"no free run of '{structure.name}' stays bounded on these logs: give a model that "
            f"follows them with --model."
        )
    return min(finite, key=lambda pair: pair[1].cost)
