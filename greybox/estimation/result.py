"""What an estimate is: named values with their covariance, tests and reasons."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from greybox.errors import UnknownParameterError, suggestion
from greybox.estimation.inference import Restrictions, confidence_intervals, wald_test
from greybox.estimation.prediction_verdict import NOT_JUDGED
from greybox.estimation.summary import estimated, summarise
from greybox.estimation.values import EstimateValues
from greybox.estimation.verdict import TestResult
from greybox.model.model import ManoeuvringModel
from greybox.model.structure import Structure
from greybox.notebook import DisplayMixin, items, parameters, text
from greybox.trial.actuator_estimate import ActuatorEstimate
from greybox.trial.validity import PooledConditions

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]


@dataclass(frozen=True, repr=False, eq=False)
class Estimate(EstimateValues, DisplayMixin):
    """Parameters of a predictor, estimated from logs.

    Parameters
    ----------
    predictor : Predictor
    method : str
        ``ls`` or ``iv``.
    theta : ndarray
        (p,) coefficients of every column, biases included.
    covariance : ndarray
        (p, p) all equations together.
    residual_std : ndarray
        (nx,) of the one-step residuals.
    vessel : Vessel
    sample_time : float
        [s]
    data : EstimationData
        What it rests on.
    covariance_kind : str
    lags : int
        Memory of the residuals that the covariance allows for, in samples.
    iteration : Iteration
        How it was found.
    current : tuple
        (name, value, standard error) of each current component; empty where the
        predictor cannot tell it.
    current_covariance : ndarray
        (p + m, m) covariance of the coefficients, then of the m components, with these;
        (0, 0) where only standard errors are known.
    tests : tuple of TestResult
    verdict : Verdict
        On the coefficients: whether they mean what their names say.
    notes : tuple of str
        Choices made and warnings.
    fit : dict
        Free-run fit (6.12) on the estimation logs [%].
    noise : NoiseLevels, optional
        What was found of measurement and process noise.
    limits : dict of str to EfficiencyBound
        ``cramer_rao`` and ``optimal_iv`` beside the standard errors.
    prefilter : {"none", "noise"}
        Whether all equations were solved jointly with their error made white.
    prediction : PredictionVerdict, optional
        What the free run is good for on logs that took no part; None where not asked for.
    calibration : BandCalibration, optional
        How far bands must reach, by logs that were left out in turn.
    tried : tuple of Comparison
        What was compared on the way to it, with every score.
    integrator : {"euler", "rk4"}
        Of the model's steps.
    coefficients : Estimate, optional
        The estimate that the coefficients' verdict speaks of, where another one predicts
        better: this one is then what simulates.
    """

    @property
    def samples(self) -> int:
        """Number of rows of the regression."""
        return self.data.samples

    @property
    def kept(self) -> int:
        """Number of rows that took part."""
        return self.data.kept

    @property
    def logs(self) -> tuple[dict[str, Any], ...]:
        """Name, hash and length of each log."""
        return self.data.logs

    @property
    def conditions(self) -> PooledConditions:
        """Draught, depth and other conditions of the logs, and where the logs differ in them."""
        return self.data.conditions

    @property
    def actuators(self) -> tuple[ActuatorEstimate, ...]:
        """Lags and delays of the actuators, as measured when the logs were imported."""
        return self.data.actuators

    @property
    def iterations(self) -> int:
        """Number of iterations of the estimator, 0 where it does not iterate."""
        return self.iteration.count

    @property
    def status(self) -> str:
        """How the estimation ended, in words."""
        return self.iteration.status

    @property
    def converged(self) -> bool:
        """Whether its iteration, if it has one, ended where it no longer moves."""
        return self.iteration.converged

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, biases left out."""
        return self.predictor.parameter_names

    def __getitem__(self, name: str) -> float:
        """Return the value of a parameter by name.

        Raises
        ------
        UnknownParameterError
            The estimate has no such parameter.
        """
        if name not in self.names:
            raise UnknownParameterError(
                f"the estimate has no parameter '{name}'.{suggestion(name, self.names)} "
                f"Parameters: {', '.join(self.names)}."
            )
        return float(self.theta[self.predictor.parameter_columns[self.names.index(name)]])

    @property
    def params(self) -> pd.Series[float]:
        """Values of the parameters by name, biases left out; discrete ones at `sample_time`."""
        import pandas as pd

        place = list(self.predictor.parameter_columns)
        return pd.Series(self.theta[place], index=list(self.names), name="parameter")

    @property
    def std_errors(self) -> pd.Series[float]:
        """Standard errors of the parameters by name."""
        import pandas as pd

        place = list(self.predictor.parameter_columns)
        return pd.Series(self.std[place], index=list(self.names), name="std_error")

    @property
    def cov(self) -> pd.DataFrame:
        """Covariance of the parameters, rows and columns by name."""
        import pandas as pd

        return pd.DataFrame(self._covariance, index=list(self.names), columns=list(self.names))

    @property
    def _covariance(self) -> Array:
        place = list(self.predictor.parameter_columns)
        return self.covariance[np.ix_(place, place)]

    def conf_int(self, level: float = 0.95) -> pd.DataFrame:
        """Return the confidence interval of each parameter, from the normal distribution.

        Parameters
        ----------
        level : float
            Probability with which the intervals hold the parameters.

        Returns
        -------
        DataFrame
            Index the names; columns ``lower`` and ``upper``.

        Raises
        ------
        UsageError
            The level is not between 0 and 1.
        """
        import pandas as pd

        place = list(self.predictor.parameter_columns)
        limits = confidence_intervals(self.theta[place], self.std[place], level)
        return pd.DataFrame(limits, index=list(self.names), columns=["lower", "upper"])

    def wald_test(self, restrictions: Restrictions | None = None) -> TestResult:
        """Test linear restrictions on the parameters by their covariance.

        Parameters
        ----------
        restrictions : str, sequence of str or mapping of str to float, optional
            ``"Xu = 2*Yv, Nr = -0.1"``, the same one by one, or the value of each parameter;
            by default that all parameters are zero.

        Returns
        -------
        TestResult
            With the null hypothesis in words, `statistic`, `df` and `p_value`.

        Raises
        ------
        UsageError
            A restriction cannot be read, names no parameter, or follows from the others.
        """
        place = list(self.predictor.parameter_columns)
        return wald_test(self.names, self.theta[place], self._covariance, restrictions)

    def structure_theta(self, structure: Structure | None = None) -> Array:
        """Return the parameters of a structure, (p,), by default the predictor's full one.

        A sum stands at its first term, the others of the sum at zero: that gives
        the same motion in still air.
        """
        structure = structure or self.predictor.structure
        theta = np.zeros(len(structure.terms))
        for i in self.predictor.parameter_columns:
            first = self.predictor.columns[i].terms[0]
            if first in structure.parameters:
                theta[structure.index(first)] = self.theta[i]
        return theta

    def model(self) -> ManoeuvringModel:
        """Return the identified model, without the bias-capturing terms.

        Its disturbance means hold the current that the estimate found.
        """
        keep = self.predictor.parameter_columns
        columns = [self.predictor.columns[i] for i in keep]
        shared = self.current_covariance
        full = self.predictor.structure
        terms = tuple(full.terms[full.index(c.terms[0])] for c in columns)
        return ManoeuvringModel(
            structure=replace(full, terms=terms),
            theta=self.theta[keep],
            covariance=self.covariance[np.ix_(keep, keep)],
            sample_time=self.sample_time,
            vessel=self.vessel,
            integrator=self.integrator,
            disturbances={n: (v, s) for n, v, s in self.current},
            disturbance_covariance=(
                shared[[*keep, *range(len(self.theta), len(shared))]] if len(shared) else shared
            ),
            residual_std=self.residual_std,
            noise=self.noise,
            calibration=self.calibration,
            sums={c.name: c.terms for c in columns if len(c.terms) > 1},
            conditions=self.conditions.values,
            record=self.record(),
        )

    def record(self) -> dict[str, Any]:
        """Return what a model file keeps beside the model itself."""
        biases = [i for i, c in enumerate(self.predictor.columns) if c.is_bias]
        return {
            "method": self.method,
            "prefilter": self.prefilter,
            "predictor": self.predictor.kind,
            "regime": {s: list(v) for s, v in self.predictor.regime},
            "fit": self.fit,
            "verdict": {
                "prediction": (self.prediction or NOT_JUDGED).to_dict(),
                "coefficients": self.meant.verdict.to_dict()
                | {"of": "theta" if self.coefficients is None else "coefficients"},
            },
            "tests": {t.name: t.to_dict() for t in self.tests},
            "notes": list(self.notes),
            "tried": [c.to_dict() for c in self.tried],
            "chosen_on_data": list(self.chosen_on_data),
            **(
                {"coefficients": self.coefficients.model().to_dict()}
                if isinstance(self.coefficients, Estimate)
                else {}
            ),
            "status": self.status,
            "covariance_kind": self.covariance_kind,
            "lags": self.lags,
            "iterations": self.iterations,
            "samples": self.samples,
            "samples_used": self.kept,
            "limits": {k: v.to_dict() for k, v in self.limits.items()},
            "nuisance": {
                "names": [
                    f"{self.predictor.columns[i].state}: {self.predictor.columns[i].name}"
                    for i in biases
                ],
                "theta": self.theta[biases],
                "std": self.std[biases],
            },
            "logs": list(self.logs),
            "ranges": dict(self.data.ranges),
            "settings": {n: list(v) for n, v in self.data.settings.items()},
            "actuators": [a.to_dict() for a in self.actuators],
            "condition_differences": [d.to_dict() for d in self.conditions.differences],
        }

    def summary(self) -> str:
        """Return the result as text: verdict, table, tests."""
        return summarise(self)

    def to_pandas(self) -> pd.DataFrame:
        """Return the parameters as a table.

        Returns
        -------
        DataFrame
            Index ``parameter`` (labels, sums spelled out, then the current's components);
            columns ``theta`` and ``std``, ``ci_low`` and ``ci_high`` of the 95 % interval,
            ``unit`` and ``per_second``. Both verdicts, method and sample time in ``attrs``.
        """
        import pandas as pd

        rows = [*estimated(self), *((n, v, s, "m/s") for n, v, s in self.current)]
        frame = pd.DataFrame(rows, columns=["parameter", "theta", "std", "unit"])
        frame = frame.set_index("parameter")
        frame.insert(2, "ci_low", frame["theta"] - 1.96 * frame["std"])
        frame.insert(3, "ci_high", frame["theta"] + 1.96 * frame["std"])
        per_second = frame["theta"] / self.sample_time
        # a current is no rate
        per_second.iloc[len(self.names) :] = np.nan
        frame["per_second"] = per_second
        frame.attrs = {
            "verdict": self.meant.verdict.text,
            "prediction": (self.prediction or NOT_JUDGED).text,
            "method": self.method,
            "sample_time": self.sample_time,
        }
        return frame

    def _line(self) -> str:
        told = self.meant.verdict.text
        if self.prediction is not None:
            told = f"prediction {self.prediction.text}; coefficients {told}"
        return f"estimate of {self.vessel.name} ({self.method}): {told}"

    def _parts(self) -> tuple[str, ...]:
        current = [(n, v, s, "m/s") for n, v, s in self.current]
        fit = ", ".join(f"{k} {v:.1f} %" for k, v in self.fit.items())
        return (
            parameters([*estimated(self), *current]),
            text(f"Free-run fit on the estimation logs: {fit}" if fit else ""),
            items("Tests that failed", [t.sentence for t in self.tests if t.passed is False]),
        )
