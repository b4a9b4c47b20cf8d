"""The input of an estimator: logs, structure, predictor and options."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from greybox.estimation.closed_loop import Loop, assess_loop
from greybox.estimation.covariance import Covariance
from greybox.estimation.gls_regression import WhiteEquations
from greybox.estimation.informative import regime_of
from greybox.estimation.output_error import OutputErrorOptions
from greybox.estimation.result import Estimate
from greybox.estimation.solve import Solved, UnexcitedBiasError
from greybox.estimation.verdict import TestResult
from greybox.model.model import ManoeuvringModel
from greybox.model.predictor import Predictor, Regime, build_predictor
from greybox.model.predictor_kinds import PredictorKind
from greybox.model.structure import Structure
from greybox.regression.instruments import simulate_log
from greybox.regression.problem import RegressionProblem
from greybox.trial.log import TrialLog

Array = NDArray[np.float64]
Found = TypeVar("Found")


@dataclass(frozen=True)
class Fitted:
    """An estimate, and the regression that its tests look at.

    Parameters
    ----------
    estimate : Estimate
    regression : RegressionProblem
        Its own, or that which stands beside a free run.
    solved : Solved, optional
        The equations that the estimate solves as they stand, as least squares and plain
        instrumental variables do.
    white : WhiteEquations, optional
        The equations that a refined estimate solves.
    """

    estimate: Estimate
    regression: RegressionProblem
    solved: Solved | None = None
    white: WhiteEquations | None = None

    def with_more(self, test: TestResult, notes: Sequence[str]) -> Fitted:
        """Return it with a test and notes behind those of the estimate."""
        estimate = self.estimate
        more = replace(estimate, tests=(*estimate.tests, test), notes=(*estimate.notes, *notes))
        return replace(self, estimate=more)


@dataclass(frozen=True, kw_only=True)
class EstimationOptions:
    """What can be asked of an estimate beside its method; an estimator heeds what concerns it.

    Fields are the keywords of `estimate_model`.
    """

    margins: dict[str, float] | None = None
    covariance: Covariance | None = None
    heading: Literal["measured", "simulated"] = "measured"
    loop: Loop = "auto"
    zero_mean: bool = True
    refine: bool | int = True
    nominal: ManoeuvringModel | None = None
    output_error: OutputErrorOptions = field(default_factory=OutputErrorOptions)
    seed: int = 0
    prefilter: Literal["auto", "noise", "none"] = "auto"
    judged: bool = True
    without: tuple[str, ...] = ()


@dataclass(frozen=True)
class EstimationProblem(EstimationOptions):
    """An estimate that is asked for, all choices made but the estimator's own.

    Parameters
    ----------
    logs : tuple of TrialLog
        One experiment each.
    structure : Structure
    kind : PredictorKind
    start : Estimate, optional
        Where a free-run fit starts.
    options
        As `EstimationOptions`.
    """

    logs: tuple[TrialLog, ...]
    structure: Structure
    kind: PredictorKind
    start: Estimate | None = None

    @cached_property
    def regime(self) -> Regime:
        """Signs that the states take in the logs."""
        return regime_of(self.logs, self.structure)

    @property
    def instrument_wind(self) -> Literal["smoothed", "measured"]:
        """The wind in the instruments: averaged where its sensor is noisy."""
        noisy = float(self.logs[0].vessel.sensors.get("wind_std", 0.0)) > 0
        return "smoothed" if noisy else "measured"

    @cached_property
    def nominal_theta(self) -> Array | None:
        """The nominal model's parameters in the order of the structure, absent ones zero.

        Of one whose parameters change, those after the last change.
        """
        if self.nominal is None:
            return None
        nominal = self.nominal.at_final_parameters()
        known = dict(zip(nominal.names, nominal.theta, strict=True))
        return np.array([known.get(name, 0.0) for name in self.structure.parameters])

    def predictor(self, *, intercept: bool) -> Predictor:
        """Return the predictor, with a constant where it captures biases and one is asked for."""
        return self.less(
            build_predictor(
                self.structure,
                self.kind.name,
                self.regime,
                intercept=intercept and self.kind.captures,
            )
        )

    def less(self, predictor: Predictor) -> Predictor:
        """Return a predictor without the columns that are to be left out, where it has them."""
        for name in self.without:
            for i, c in enumerate(predictor.columns):
                if c.is_bias and f"{c.state}:{c.name}" == name:
                    predictor = predictor.without_bias(i)
                    break
        return predictor

    def drop_unexcited(
        self, predictor: Predictor, fit: Callable[[Predictor], Found]
    ) -> tuple[Found, list[str]]:
        """Estimate without the bias-capturing columns that do not vary, and note which."""
        notes: list[str] = []
        while True:
            try:
                return fit(predictor), notes
            except UnexcitedBiasError as error:
                label = predictor.columns[error.column].label
                notes.append(
                    f"the bias-capturing regressor {label} does not vary and was left out."
                )
                predictor = predictor.without_bias(error.column)

    def loop_test(self, method: str) -> tuple[bool, TestResult]:
        """Return whether the logs count as closed loop, and what that means for a method."""
        return assess_loop(self.logs, self.loop, method)

    def stays_bounded(self, estimate: Estimate) -> bool:
        """Whether the free runs of an estimate stay within their bounds on the logs."""
        model = estimate.model()
        runs = [
            simulate_log(
                model.structure,
                model.theta,
                log,
                d=model.d if model.disturbances else None,
                use_wind=log.has_wind,
                integrator=model.integrator,
            )
            for log in self.logs
        ]
        return all(int(run.diverged[0]) < 0 for run in runs)

    def fit_regression(
        self,
        method: str,
        predictor: Predictor,
        fit: Callable[[Predictor], Found],
        finish: Callable[[Found, list[str]], Fitted],
    ) -> Fitted:
        """Estimate from one-step equations, and say what these rest on.

        Parameters
        ----------
        method : str
        predictor : Predictor
        fit : callable
            Solves the equations of a predictor.
        finish : callable
            Estimates once the predictor is settled; may note more.

        Returns
        -------
        Fitted
            Not tested yet but for the loop.
        """
        _, loop_test = self.loop_test(method)
        found, notes = self.drop_unexcited(predictor, fit)
        fitted = finish(found, notes)
        return fitted.with_more(loop_test, [*notes, *_coarse(self.logs)])


def _coarse(logs: Sequence[TrialLog]) -> list[str]:
    """Note that a log was conditioned, so that Euler's step may be too long for it."""
    found = [
        s for log in logs for s in log.provenance.steps if s.operation in ("difference", "decimate")
    ]
    if not found:
        return []
    return [
        f"the logs were conditioned ({found[0].sentence}) and the model steps by Euler: "
        f"damping and current carry a bias of the order of the damping over one sample, which "
        f"the standard errors leave out. Compare with a shorter sample time."
    ]
