"""Solutions of the regressions of a predictor: least squares and instrumental variables."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from greybox.errors import ExcitationError, UsageError, so_many
from greybox.estimation.covariance import (
    Covariance,
    CovarianceKind,
    allow_for_segments,
    block_bootstrap,
    score_covariance,
    segment_sums,
)
from greybox.estimation.disturbance import estimate_current
from greybox.estimation.error_variance_profile import ErrorVarianceProfile, error_variance_profiles
from greybox.estimation.informative import unexcited
from greybox.estimation.normal_equations import Solution, solve_stacked
from greybox.estimation.registry import ESTIMATORS
from greybox.estimation.result import Estimate
from greybox.estimation.values import EstimationData, Iteration, estimation_data
from greybox.model.predictor import Predictor
from greybox.numerics.linalg import scaled_inverse
from greybox.regression.instruments import Instruments
from greybox.regression.problem import RegressionProblem, RegressionSettings
from greybox.regression.regression import Regression
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]
# scaled singular value below which a direction counts as not excited
SINGULAR = 1e-8
# size below which a regressor is nothing
_STILL = 1e-13
_NO_ITERATION = Iteration()
_STRONGEST = "the estimate of the strongest instruments is given"
_REFINE_TOLERANCE = 1e-4
_MAX_REFINEMENTS = 30


class UnexcitedBiasError(ExcitationError):
    """A bias-capturing regressor, or its instrument, does not vary and can be left out."""

    def __init__(self, column: int, label: str) -> None:
        super().__init__(
            f"the bias-capturing regressor {label} or its instrument does not vary over the whole "
            f"log: leave it out of the predictor."
        )
        self.column = column


def solve_ls(problem: RegressionProblem) -> Solved:
    """Solve a problem by least squares; errors as `estimate_ls`."""
    instruments = _regressors_as_instruments(problem.regression)
    return Solved("ls", problem, instruments, _solve(problem.regression, instruments))


def solve_iv(
    problem: RegressionProblem,
    *,
    start: Array | Estimate | None = None,
    refine: bool | int = True,
    metric: str = "moments",
) -> Solved:
    """Solve a problem by instrumental variables; parameters and errors as `estimate_iv`."""
    predictor = problem.predictor
    if (
        not problem.zero_mean
        and predictor.augmented
        and "1" not in {c.name for c in predictor.columns}
    ):
        raise UsageError(
            "instruments that keep their mean do not remove the constants that the augmented "
            "predictor leaves out: build it with an intercept, or use zero-mean instruments."
        )
    regression = problem.regression
    instruments, solutions, iteration = iterate_instruments(
        predictor,
        _start(problem, start),
        # the first model may be far off: rows are first cut by the measured states
        problem.keep,
        problem.instruments,
        lambda made: _solve(regression, made, metric),
        refine,
    )
    return Solved("iv", problem, instruments, solutions, iteration)


class Made(Protocol):
    """Instruments of a model, or what is made of them."""

    @property
    def diverged(self) -> str:
        """Empty, or which simulation left its bound."""

    @property
    def keep(self) -> Any:
        """Rows that take part."""


Equations = TypeVar("Equations", bound=Made)


def _stays(moved: Array, previous: Array, made: Any, solutions: Sequence[Solution]) -> bool:
    """Whether coefficients moved by a small share of themselves."""
    return bool((moved < _REFINE_TOLERANCE * (np.abs(previous) + 1e-12)).all())


def iterate_instruments(
    predictor: Predictor,
    theta: Array,
    measured: Any,
    make: Callable[[Array, Any], Equations],
    solve: Callable[[Equations], Sequence[Solution]],
    refine: bool | int,
    stays: Callable[[Array, Array, Equations, Sequence[Solution]], bool] = _stays,
) -> tuple[Equations, Sequence[Solution], Iteration]:
    """Solve with simulated instruments, and simulate them again by each estimate.

    Parameters
    ----------
    predictor : Predictor
    theta : ndarray
        (p,) parameters of the structure that simulate the first instruments.
    measured
        Rows that are cut by the measured states.
    make : callable
        Simulates a model, on given rows or, where these are None, on its own.
    solve : callable
    refine : bool or int
        As `estimate_iv`.
    stays : callable
        Whether an estimate has settled, of its move, the estimate before, and its equations.

    Raises
    ------
    ExcitationError
        Even the first simulation diverges, or as `solve`.
    """
    instruments = make(theta, measured)
    if instruments.diverged:
        raise ExcitationError(
            f"{instruments.diverged} already with the first model, so there are no instruments: "
            f"give a nominal model that is stable, or use --method ls."
        )
    solutions = solve(instruments)
    iteration = Iteration(0, "one step, instruments not refined")
    strongest = (_strength(solutions), theta, instruments, solutions)
    if refine:
        most = _MAX_REFINEMENTS if refine is True else int(refine)
        iteration = Iteration(
            most, f"had not converged after {most} steps", False, "the refinement "
        )
        for count in range(1, most + 1):
            previous = _coefficients(solutions)
            target = _structure_theta(predictor, previous)
            # rows are cut once by a refined model and then kept, or the cut would chatter
            rows = None if count == 1 else instruments.keep
            candidate, fresh = target, make(target, rows)
            for _ in range(4):
                if not fresh.diverged:
                    break
                candidate = (candidate + theta) / 2
                fresh = make(candidate, rows)
            if fresh.diverged:
                ended = f"stopped after {count - 1} refinements: {fresh.diverged}; {_STRONGEST}"
                iteration = Iteration(count, ended, False)
                _, theta, instruments, solutions = strongest
                break
            theta, instruments = candidate, fresh
            solutions = solve(instruments)
            strength = _strength(solutions)
            if strength > strongest[0]:
                strongest = (strength, theta, instruments, solutions)
            moved = np.abs(_coefficients(solutions) - previous)
            # a halfway model settles too, but not at an estimate that can be simulated
            if candidate is target and stays(moved, previous, instruments, solutions):
                iteration = Iteration(count, f"converged after {so_many(count, 'refinement')}")
                break
        else:
            if refine is True:
                iteration = replace(iteration, ended=f"{iteration.ended}; {_STRONGEST}")
                _, theta, instruments, solutions = strongest
    return instruments, solutions, iteration


@dataclass(frozen=True)
class Solved:
    """Equations that are solved, before standard errors.

    Parameters
    ----------
    method : str
    problem : RegressionProblem
    instruments : Instruments
        Those of the solution.
    solutions : sequence of Solution
        One an equation.
    iteration : Iteration
    """

    method: str
    problem: RegressionProblem
    instruments: Instruments
    solutions: Sequence[Solution]
    iteration: Iteration = _NO_ITERATION

    @property
    def theta(self) -> Array:
        """Coefficients of all columns, (p,)."""
        return _coefficients(self.solutions)

    @property
    def keep(self) -> Sequence[NDArray[np.bool_]]:
        """Rows that take part."""
        return self.instruments.keep

    @property
    def simulated(self) -> Instruments:
        """Simulated instruments: those of the solution, or by the model that it gives."""
        if self.instruments.x:
            return self.instruments
        return self.problem.instruments(
            _structure_theta(self.problem.predictor, self.theta), self.problem.keep
        )

    @property
    def centred(self) -> bool:
        """Whether constants of the experiments were removed: by zero-mean instruments."""
        return self.problem.zero_mean

    def estimate(self, covariance: Covariance | None, seed: int = 0) -> Estimate:
        """Return the estimate.

        Parameters
        ----------
        covariance : {"cluster", "ma", "hac", "white", "bootstrap"}, optional
            None leaves standard errors out, where they will not be looked at.
        seed : int
        """
        problem, theta = self.problem, self.theta
        predictor, logs = problem.predictor, problem.logs
        projected, residuals = _masked(self)
        kept = sum(int(k.sum()) for k in self.keep)
        matrix, lags = np.full((len(theta), len(theta)), np.nan), 0
        if covariance is not None:
            shapes = (
                error_variance_profiles(predictor, logs, theta, residuals, self.keep)
                if _base(self.method, covariance) == "ma"
                else ()
            )
            matrix, lags = _covariance(self, projected, residuals, covariance, seed, shapes)
        return form_estimate(
            problem,
            self.method,
            self.solutions,
            matrix,
            [sum(float(e @ e) for e in each) for each in residuals],
            estimation_data(logs, predictor.structure.states, problem.regression.samples, kept),
            logs[0].vessel,
            problem.regression.sample_time,
            covariance_kind=covariance or "",
            lags=lags,
            iteration=self.iteration,
        )


def form_estimate(
    settings: RegressionSettings,
    method: str,
    solutions: Sequence[Solution],
    covariance: Array,
    squares: Sequence[float] | Array,
    data: EstimationData,
    vessel: Vessel,
    sample_time: float,
    *,
    covariance_kind: str,
    lags: int = 0,
    iteration: Iteration = _NO_ITERATION,
) -> Estimate:
    """Return the estimate of equations that are solved.

    Parameters
    ----------
    settings : RegressionSettings
    method : str
    solutions : sequence of Solution
        One an equation.
    covariance : ndarray
        (p, p), of any content where `covariance_kind` is empty.
    squares : sequence of float
        (nx,) sum of the squared residuals of each equation.
    data : EstimationData
    vessel : Vessel
    sample_time : float
        [s]
    covariance_kind, lags, iteration
        As `Estimate`.
    """
    theta = _coefficients(solutions)
    return Estimate(
        predictor=settings.predictor,
        method=method,
        theta=theta,
        covariance=covariance,
        residual_std=np.sqrt(np.asarray(squares) / max(data.kept, 1)),
        vessel=vessel,
        sample_time=sample_time,
        data=data,
        covariance_kind=covariance_kind,
        lags=lags,
        iteration=iteration,
        current=estimate_current(
            settings.predictor,
            theta,
            covariance,
            heading_std=vessel.std("psi") or 0.0,
            heading_measured=settings.heading == "measured",
        )
        if covariance_kind
        else (),
    )


def _regressors_as_instruments(regression: Regression) -> Instruments:
    return Instruments(
        tuple(e.phi for e in regression.experiments), tuple(e.keep for e in regression.experiments)
    )


def _start(problem: RegressionProblem, start: Array | Estimate | None) -> Array:
    if isinstance(start, Estimate):
        return start.structure_theta()
    if start is not None:
        return np.asarray(start, float)
    return _structure_theta(problem.predictor, solve_ls(problem).theta)


def _structure_theta(predictor: Predictor, coefficients: Array) -> Array:
    theta = np.zeros(len(predictor.structure.terms))
    for i in predictor.parameter_columns:
        theta[predictor.structure.index(predictor.columns[i].terms[0])] = coefficients[i]
    return theta


def _strength(solutions: Sequence[Solution]) -> float:
    """Return half the log determinant of what the instruments explain of the regressors."""
    with np.errstate(divide="ignore"):
        return float(sum(np.log(s.singular_values).sum() for s in solutions))


def _coefficients(solutions: Sequence[Solution]) -> Array:
    return np.concatenate([s.theta for s in solutions])


def _solve(
    regression: Regression, instruments: Instruments, metric: str = "moments"
) -> list[Solution]:
    predictor, keep = regression.predictor, instruments.keep

    def largest(rows: Sequence[Array]) -> Array:
        return np.asarray(np.max([largest_of(r, k) for r, k in zip(rows, keep, strict=True)], 0))

    def solved(row: int, mine: list[int]) -> Solution:
        logs = list(zip(regression.experiments, keep, strict=True))
        phi = [samples_kept(e.phi[mine], k) for e, k in logs]
        y = [e.y[row, k] for e, k in logs]
        z = [samples_kept(z[mine], k) for z, k in zip(instruments.z, keep, strict=True)]
        return solve_stacked(z, phi, y, metric=metric)

    return solve_equations(
        predictor,
        solved,
        (largest([e.phi for e in regression.experiments]), largest(instruments.z)),
        sum(int(k.sum()) for k in keep),
        regression.samples,
    )


def solve_equations(
    predictor: Predictor,
    solved: Callable[[int, list[int]], Solution],
    largest: tuple[Array, Array],
    kept: int,
    samples: int,
) -> list[Solution]:
    """Solve each equation, or say which of its parameters are not determined.

    Parameters
    ----------
    predictor : Predictor
    solved : callable
        Solves an equation, of its position and the positions of its columns.
    largest : tuple of ndarray
        (p,) the largest size of each regressor, and of each instrument.
    kept, samples : int
        Rows that take part, and rows there are.

    Raises
    ------
    ExcitationError
        Some direction is not excited; its parameters are named.
    """
    solutions = []
    _require_excited(predictor, largest)
    for row, state in enumerate(predictor.structure.states):
        mine = predictor.equation(state)
        if kept <= 2 * len(mine):
            raise ExcitationError(
                f"{kept} of {so_many(samples, 'sample')} {'keeps' if kept == 1 else 'keep'} the "
                f"margins "
                f"and the {state} equation has {so_many(len(mine), 'coefficient')}, more than "
                f"{2 * len(mine)} are needed: use smaller "
                f"margins or a longer log."
            )
        solution = solved(row, mine)
        if not solution.singular_values[-1] > SINGULAR * solution.singular_values[0]:
            raise ExcitationError(_singular(predictor, mine, solution, samples))
        solutions.append(solution)
    return solutions


def samples_kept(rows: Array, keep: NDArray[np.bool_]) -> Array:
    """Return the samples of rows (..., N) that take part."""
    return rows if keep.all() else rows[..., keep]


def _less_mean(rows: Array, keep: NDArray[np.bool_]) -> Array:
    """Return rows (..., N) less their mean over the samples that take part."""
    part = samples_kept(rows, keep)
    return np.asarray(rows - part.mean(axis=-1, keepdims=True)) if part.size else rows


def largest_of(rows: Array, keep: NDArray[np.bool_]) -> Array:
    """Return the largest size of each of the rows (p, N) at the samples that take part, (p,)."""
    return np.asarray(np.abs(samples_kept(rows, keep)).max(axis=1, initial=0.0))


def _require_excited(predictor: Predictor, largest: tuple[Array, Array]) -> None:
    """Name the parameters whose regressors, or else instruments, do not vary at all."""
    for size, what in zip(largest, ("regressor", "instrument"), strict=True):
        lost = np.flatnonzero(size[: len(predictor.columns)] < _STILL)
        bias = next((int(i) for i in lost if predictor.columns[i].is_bias), None)
        if bias is not None:
            raise UnexcitedBiasError(bias, predictor.columns[bias].label)
        if len(lost):
            many = len(lost) > 1
            raise ExcitationError(
                unexcited(
                    predictor.structure,
                    [predictor.columns[i].name for i in lost],
                    f"{'their' if many else 'its'} {what}{'s stay' if many else ' stays'} within "
                    f"{size[lost].max():.1g} over the whole log",
                )
            )


def _singular(predictor: Predictor, mine: list[int], solution: Solution, samples: int) -> str:
    size = np.abs(solution.weakest)
    involved = [predictor.columns[mine[i]].label for i in np.argsort(-size) if size[i] > 0.2]
    ratio = solution.singular_values[-1] / solution.singular_values[0]
    return (
        f"the instruments are singular: {', '.join(involved)} cannot be told apart in the "
        f"{predictor.columns[mine[0]].state} equation (relative singular value {ratio:.1e}, "
        f"needs {SINGULAR:.0e}) on {samples} samples. Excite them separately, or "
        f"leave one out."
    )


def _masked(solved: Solved) -> tuple[list[list[Array]], list[list[Array]]]:
    """Return projected instruments and residuals on all rows, zero where cut out.

    Zero-mean instruments leave the constant of each experiment undetermined; it
    belongs to the equation, not to the residual, so those are `centred`.
    """
    problem, centred = solved.problem, solved.centred
    predictor = problem.predictor
    projected, residuals = [], []
    for row, (state, solution) in enumerate(
        zip(predictor.structure.states, solved.solutions, strict=True)
    ):
        mine = predictor.equation(state)
        hats, errors = [], []
        for e, keep, hat in zip(
            problem.regression.experiments, solved.keep, solution.projected, strict=True
        ):
            full = np.zeros((len(mine), len(keep)))
            full[:, keep] = hat
            error = e.y[row] - solution.theta @ e.phi[mine]
            if centred and keep.any():
                error = error - error[keep].mean()
            error = np.where(keep, error, 0.0)
            hats.append(full)
            errors.append(error)
        projected.append(hats)
        residuals.append(errors)
    return projected, residuals


def _covariance(
    solved: Solved,
    projected: list[list[Array]],
    residuals: list[list[Array]],
    kind: Covariance,
    seed: int,
    shapes: Sequence[Sequence[ErrorVarianceProfile]],
) -> tuple[Array, int]:
    regression, predictor = solved.problem.regression, solved.problem.predictor
    p = len(predictor.columns)
    if kind == "bootstrap":
        equations = []
        for row, state in enumerate(predictor.structure.states):
            mine = predictor.equation(state)
            phi = [e.phi[mine] for e in regression.experiments]
            y = [e.y[row] for e in regression.experiments]
            if solved.centred:
                # the constant of each experiment belongs to the equation, not to a block
                phi, y = (
                    [_less_mean(rows, k) for rows, k in zip(every, solved.keep, strict=True)]
                    for every in (phi, y)
                )
            equations.append((projected[row], phi, y))
        draws = block_bootstrap(equations, np.random.default_rng(seed))
        order = np.argsort(
            np.concatenate([predictor.equation(s) for s in predictor.structure.states])
        )
        return np.cov(draws[:, order].T).reshape(p, p), 0
    base = _base(solved.method, kind)
    middle, lags = score_covariance(projected, residuals, base, shapes=shapes)
    inverse = np.zeros((p, p))
    own = [predictor.equation(s) for s in predictor.structure.states]
    for mine, solution in zip(own, solved.solutions, strict=True):
        inverse[np.ix_(mine, mine)] = scaled_inverse(solution.information)
    # degrees of freedom, as statsmodels counts them
    rows = regression.kept
    largest = max(map(len, own))
    found = inverse @ middle @ inverse.T * rows / max(rows - largest, 1)
    if kind == "cluster":
        sums = [segment_sums(z, e, lags) for z, e in zip(projected, residuals, strict=True)]
        found = allow_for_segments(found, sums, [inverse[np.ix_(m, m)] for m in own])
    return found, lags


def _base(method: str, kind: Covariance) -> CovarianceKind:
    """Return what the spread between segments is laid over: a noise model only where it holds."""
    if kind == "cluster" or kind == "bootstrap":
        return "hac" if ESTIMATORS[method].biased_by_noise else "ma"
    return kind
