"""The values that an estimate consists of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.estimation.prediction_verdict import PredictionVerdict
from greybox.estimation.tried import Comparison
from greybox.estimation.verdict import UNJUDGED, TestResult, Verdict
from greybox.model.noise import BandCalibration, NoiseLevels
from greybox.model.predictor import Predictor
from greybox.model.run.step import Integrator
from greybox.trial.actuator_estimate import ActuatorEstimate, known_actuators
from greybox.trial.log import TrialLog
from greybox.trial.validity import PooledConditions, pooled_conditions, ranges, settings_of
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]

# what an alternative may differ in, in words
_CHOSEN = {
    "structure": "structure or terms",
    "predictor": "predictor",
    "method": "method",
    "thrust": "thrust law",
    "integrator": "integrator",
    "commands": "commands between samples",
}


@dataclass(frozen=True)
class EfficiencyBound:
    """A lower bound of the standard errors, beside those of an estimate.

    Parameters
    ----------
    std : dict of str to float
        The least standard error of each parameter.
    efficiency : dict of str to float
        (bound / reported variance) of each parameter, 1 at best.
    determinant : float
        (det C_bound / det C)^(1/p), 1 at best.
    """

    std: dict[str, float]
    efficiency: dict[str, float]
    determinant: float

    @property
    def sentence(self) -> str:
        """What is lost, overall and at worst."""
        worst = min(self.efficiency, key=lambda n: self.efficiency[n])
        most = np.sqrt(1 / self.efficiency[worst]) if self.efficiency[worst] > 0 else np.inf
        share = 100 * self.determinant
        reached = f"{share:.0f} %" if share >= 10 else f"{share:.2g} %"
        if share > 100:
            reached = "all of it, as far as estimated standard errors can tell"
        return (
            f"efficiency by determinant {reached}; the standard error of {worst} is {most:.2g} "
            f"times the least possible one, {self.std[worst]:.2g}."
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        return {
            "std": self.std,
            "efficiency": self.efficiency,
            "determinant_efficiency": self.determinant,
        }


@dataclass(frozen=True)
class EstimationData:
    """What an estimate rests on.

    Parameters
    ----------
    samples, kept : int
        Rows there were, and rows that took part.
    logs : tuple of dict
        Name, hash and length of each log.
    ranges : dict of str to (float, float)
        Least and greatest value of each state and command in the logs.
    settings : dict of str to list of float
        Of all commands together, those of the logs that are most unlike one another.
    conditions : PooledConditions
        Draught, depth and the like of the logs, and in what they differ.
    actuators : tuple of ActuatorEstimate
        Measured from command and feedback when the logs were imported.
    """

    samples: int
    kept: int
    logs: tuple[dict[str, Any], ...] = ()
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    settings: Mapping[str, Sequence[float]] = field(default_factory=dict)
    conditions: PooledConditions = field(default_factory=PooledConditions)
    actuators: tuple[ActuatorEstimate, ...] = ()


def estimation_data(
    logs: Sequence[TrialLog], states: Sequence[str], samples: int, kept: int
) -> EstimationData:
    """Return what an estimate from these logs rests on."""
    return EstimationData(
        samples,
        kept,
        tuple(
            {"name": log.name, "sha256": log.provenance.sha256, "samples": len(log)} for log in logs
        ),
        ranges(logs, tuple(states)),
        settings_of(logs),
        pooled_conditions(logs),
        known_actuators(log.provenance.actuators for log in logs),
    )


@dataclass(frozen=True)
class Iteration:
    """How the iteration of an estimator ended.

    Parameters
    ----------
    count : int
        Steps, or refinements of the instruments; 0 where there is no iteration.
    ended : str
        How it ended, in words that follow "the iteration".
    converged : bool
        Whether it ended where it no longer moves.
    before : str
        Words that stand before these in a status.
    """

    count: int = 0
    ended: str = "solved"
    converged: bool = True
    before: str = ""

    @property
    def status(self) -> str:
        """How the estimation ended, in words."""
        return f"{self.before}{self.ended}"


@dataclass(frozen=True, repr=False, eq=False)
class EstimateValues:
    """Fields of an `Estimate`, which tells what they are and what follows from them."""

    predictor: Predictor
    method: str
    theta: Array
    covariance: Array
    residual_std: Array
    vessel: Vessel
    sample_time: float
    data: EstimationData
    covariance_kind: str
    lags: int
    iteration: Iteration = field(default_factory=Iteration)
    current: tuple[tuple[str, float, float], ...] = ()
    current_covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    tests: tuple[TestResult, ...] = ()
    verdict: Verdict = UNJUDGED
    notes: tuple[str, ...] = ()
    fit: dict[str, float] = field(default_factory=dict)
    noise: NoiseLevels | None = None
    limits: Mapping[str, EfficiencyBound] = field(default_factory=dict)
    prefilter: str = "none"
    prediction: PredictionVerdict | None = None
    calibration: BandCalibration | None = None
    tried: tuple[Comparison, ...] = ()
    integrator: Integrator = "euler"
    coefficients: EstimateValues | None = None

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the parameters, sums spelled out, such as ``Xuu+Wuu``."""
        return tuple(self.predictor.columns[i].label for i in self.predictor.parameter_columns)

    @property
    def std(self) -> Array:
        """Standard errors of all columns, (p,)."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @property
    def meant(self) -> EstimateValues:
        """The estimate whose numbers mean what their names say, as far as any does."""
        return self if self.coefficients is None else self.coefficients

    @property
    def chosen_on_data(self) -> tuple[str, ...]:
        """What free runs over parts of the same logs chose: intervals do not allow for it."""
        found = {
            words: None
            for compared in self.tried
            for key, words in _CHOSEN.items()
            if len({getattr(r, key) for r in compared.rows if r.score is not None}) > 1
        }
        return tuple(found)

    @property
    def told_of_choice(self) -> str:
        """What is said beside the intervals, nothing where nothing was chosen on the data."""
        chosen = self.chosen_on_data
        if not chosen:
            return ""
        return (
            f"Chosen on the same logs: {', '.join(chosen)}. The intervals do not allow for that "
            f"choice: the true ones are wider."
        )
