"""What the tests look at: the linear regression of each equation, and an estimate.

Whatever estimator gave ``theta``, the regression y = φᵀθ + e with the simulated
instruments z stands beside it: relevance, exogeneity and identification are
properties of that regression.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from greybox.estimation.arma_noise import ARMANoise
from greybox.estimation.error_variance_profile import (
    ErrorVarianceProfile,
    error_variance_profiles,
    fit_scaled_arma_noise,
)
from greybox.estimation.gls_regression import WhiteEquations
from greybox.estimation.normal_equations import Solution, solve_stacked
from greybox.estimation.registry import ESTIMATORS, Estimator
from greybox.model.predictor import Predictor
from greybox.model.run.step import Integrator
from greybox.numerics.linalg import scaled_inverse
from greybox.regression.instruments import Instruments
from greybox.regression.regression import Regression
from greybox.trial.log import TrialLog

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Equation:
    """The regression of one equation, experiment by experiment.

    Rows that do not take part are zero, so that lags keep their distance.
    Constants that zero-mean instruments leave free are removed from y and φ.

    Parameters
    ----------
    state : str
    columns : tuple of int
        Positions among the predictor's columns, (p,).
    labels : tuple of str
    y : tuple of ndarray
        (N,) an experiment.
    phi, z : tuple of ndarray
        (p, N) an experiment, constants left out where the means were removed.
    keep : tuple of ndarray of bool
        (N,) rows that take part.
    centred : bool
        Whether the mean of each experiment was removed.
    shapes : tuple of ErrorVarianceProfile
        How measurement noise changes along each log; empty where it is alike everywhere.
    states : tuple of ndarray
        (nx, N) simulated states an experiment, in every row; empty where there are none.
    whole : ndarray, optional
        (p, p) Σ ẑ φᵀ of all samples, where the experiments are only a part of them.
    """

    state: str
    columns: tuple[int, ...]
    labels: tuple[str, ...]
    y: tuple[Array, ...]
    phi: tuple[Array, ...]
    z: tuple[Array, ...]
    keep: tuple[NDArray[np.bool_], ...]
    centred: bool
    shapes: tuple[ErrorVarianceProfile, ...] = ()
    states: tuple[Array, ...] = ()
    whole: Array | None = None

    @property
    def rows(self) -> int:
        """Rows that take part."""
        return sum(int(k.sum()) for k in self.keep)

    @property
    def freedom(self) -> int:
        """Rows less the means that were removed."""
        return self.rows - (len(self.y) if self.centred else 0)

    @cached_property
    def solution(self) -> Solution:
        """The plain instrumental-variable estimate of this equation (4.5)."""
        return solve_stacked(self.z, self.phi, self.y)

    @cached_property
    def pooled(self) -> Solution:
        """The estimate whose instruments are summed over the experiments, as many as parameters.

        Nothing is left over that could fit the noise, so its moments have no bias.
        """
        if len(self.z) == 1:
            return self.solution
        whole = [np.hstack(x) for x in (self.z, self.phi)]
        found = solve_stacked([whole[0]], [whole[1]], [np.concatenate(self.y)])
        ends = np.cumsum([len(y) for y in self.y])[:-1]
        return replace(found, projected=tuple(np.split(found.projected[0], ends, axis=1)))

    def residuals_of(self, theta: Array) -> tuple[Array, ...]:
        """Return the residuals of coefficients (p,), (N,) an experiment."""
        return tuple(y - theta @ f for y, f in zip(self.y, self.phi, strict=True))

    @cached_property
    def pooled_residuals(self) -> tuple[Array, ...]:
        """Residuals of that estimate."""
        return self.residuals_of(self.pooled.theta)

    @cached_property
    def residuals(self) -> tuple[Array, ...]:
        """Residuals of the plain instrumental-variable estimate."""
        return self.residuals_of(self.solution.theta)

    @cached_property
    def noise_model(self) -> ARMANoise:
        """Noise model of those residuals."""
        return fit_scaled_arma_noise(
            self.residuals, self.keep, self.shapes, self.solution.projected
        )

    @cached_property
    def std(self) -> Array:
        """Standard errors of that estimate, (p,)."""
        weights = [self.noise_model.adjoint(h, k) for k, h in enumerate(self.solution.projected)]
        innovations = [self.noise_model.innovations(e, k) for k, e in enumerate(self.residuals)]
        scores = [w * i for w, i in zip(weights, innovations, strict=True)]
        middle = sum(s @ s.T for s in scores) * self.rows / max(self.freedom - len(self.labels), 1)
        inverse = scaled_inverse(self.solution.information)
        return np.asarray(np.sqrt(np.maximum(np.diag(inverse @ middle @ inverse.T), 0.0)))

    @cached_property
    def gain(self) -> Array:
        """How many times as much all samples tell of each parameter alone, (p,)."""
        if self.whole is None:
            return np.ones(len(self.labels))
        here, there = scaled_inverse(self.solution.information), scaled_inverse(self.whole)
        return np.asarray(np.diag(here) / np.diag(there))

    @cached_property
    def obstacle(self) -> str:
        """Why this regression cannot be tested; empty where it can."""
        p = len(self.columns)
        if self.freedom <= 2 * p:
            return f"{self.freedom} rows are too few for {p} coefficients"
        values = self.solution.singular_values
        if not values[-1] > 1e-9 * values[0]:
            return "the instruments leave a direction free"
        left = sum(float(r @ r) for r in self.residuals)
        if left <= 1e-18 * sum(float(y @ y) for y in self.y):
            return "there are no residuals to judge by"
        return ""

    @cached_property
    def stacked(self) -> tuple[Array, ...]:
        """Instruments with a block for each experiment, (E·p, N) an experiment."""
        if len(self.z) == 1:
            return self.z
        width = len(self.columns)
        out = []
        for i, z in enumerate(self.z):
            block = np.zeros((width * len(self.z), z.shape[1]))
            block[i * width : (i + 1) * width] = z
            out.append(block)
        return tuple(out)


@dataclass(frozen=True)
class Evidence:
    """An estimate of a predictor's coefficients with all that its tests need.

    Parameters
    ----------
    predictor : Predictor
    regression : Regression
    logs : tuple of TrialLog
    instruments : Instruments
        Simulated ones, also where the estimator did without; where their
        simulation diverged, ``diverged`` says so and they are empty.
    theta, covariance : ndarray
        (p,) and (p, p) of every column, by whatever estimator.
    residuals : tuple over equations of tuple of ndarray
        (N,) an experiment, of that estimator; rows cut out are zero.
    keep : tuple of ndarray of bool
        (N,) rows on which it rests.
    method : str
        Name of the estimator.
    zero_mean : bool
        Whether the instruments are zero-mean, which leaves constants free.
    margins : dict of str to float, optional
    solved : bool
        Whether the estimate solves the normal equations of its residuals, as least squares
        and plain instrumental variables do.
    white : WhiteEquations, optional
        The equations of a refined estimate, with their error made white.
    information : tuple of ndarray, optional
        (p, p) Σ ẑ φᵀ of each equation, where the estimate rests on more samples than the logs.
    integrator : {"euler", "rk4"}
        Of the model's steps.
    """

    predictor: Predictor
    regression: Regression
    logs: tuple[TrialLog, ...]
    instruments: Instruments
    theta: Array
    covariance: Array
    residuals: tuple[tuple[Array, ...], ...]
    keep: tuple[NDArray[np.bool_], ...]
    method: str
    zero_mean: bool = True
    margins: Mapping[str, float] | None = None
    solved: bool = True
    white: WhiteEquations | None = None
    information: tuple[Array, ...] | None = None
    integrator: Integrator = "euler"

    @property
    def estimator(self) -> Estimator:
        """The estimator's entry."""
        return ESTIMATORS[self.method]

    @property
    def std(self) -> Array:
        """Standard errors, (p,)."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @cached_property
    def equations(self) -> tuple[Equation, ...]:
        """One regression a state; empty where there are no instruments."""
        if self.instruments.diverged or not self.instruments.z:
            return ()
        states = self.predictor.structure.states
        plain = [_equation(self, row, state) for row, state in enumerate(states)]
        # of that regression's own estimate, as all that is asked of it
        theta = np.zeros(len(self.predictor.columns))
        for equation in plain:
            theta[list(equation.columns)] = equation.solution.theta
        residuals = [e.residuals for e in plain]
        shapes = error_variance_profiles(
            self.predictor, self.logs, theta, residuals, self.instruments.keep
        )
        return tuple(replace(e, shapes=s) for e, s in zip(plain, shapes, strict=True))


def _equation(evidence: Evidence, row: int, state: str) -> Equation:
    predictor = evidence.predictor
    mine = predictor.equation(state)
    constants = set(predictor.constants)
    experiments = evidence.regression.experiments
    # one constant shared by several experiments is overidentified: it stays a regressor
    centred = evidence.zero_mean and (len(experiments) == 1 or not constants & set(mine))
    if centred:
        mine = [i for i in mine if i not in constants]
    y, phi, z = [], [], []
    for e, ze, keep in zip(
        experiments, evidence.instruments.z, evidence.instruments.keep, strict=True
    ):
        y.append(_prepare(e.y[row][None], keep, centred)[0])
        phi.append(_prepare(e.phi[mine], keep, centred))
        z.append(_prepare(ze[mine], keep, centred))
    whole = None
    if evidence.information is not None:
        own = [predictor.equation(state).index(i) for i in mine]
        whole = evidence.information[row][np.ix_(own, own)]
    return Equation(
        state,
        tuple(mine),
        tuple(predictor.columns[i].label for i in mine),
        tuple(y),
        tuple(phi),
        tuple(z),
        evidence.instruments.keep,
        centred,
        states=tuple(x.T for x in evidence.instruments.x),
        whole=whole,
    )


def _prepare(rows: Array, keep: NDArray[np.bool_], centred: bool) -> Array:
    """Return the rows (k, N) with zeros where cut out, their mean removed where asked."""
    if centred and keep.any():
        rows = rows - rows[:, keep].mean(axis=1, keepdims=True)
    return np.where(keep, rows, 0.0)
