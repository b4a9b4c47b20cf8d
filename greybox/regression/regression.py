"""From logs to y and Φ: the regression that least squares and IV solve."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.errors import ExcitationError, LogError
from greybox.model.predictor import Predictor
from greybox.model.run.inputs import LogInputs
from greybox.trial.log import TrialLog

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Experiment:
    """The rows of one log.

    Parameters
    ----------
    name : str
    y : ndarray
        (nx, N) one-step increments (or next states) [m/s, rad/s per sample].
    phi : ndarray
        (p, N) regressors, in the order of the predictor's columns.
    keep : ndarray of bool
        (N,) rows that take part; the others violate a sign margin (Remark 4.2), or lie in a
        gap of what was measured.
    """

    name: str
    y: Array
    phi: Array
    keep: NDArray[np.bool_]


@dataclass(frozen=True)
class Regression:
    """y = Φᵀθ + e for every equation of a predictor, experiment by experiment."""

    predictor: Predictor
    experiments: tuple[Experiment, ...]
    sample_time: float

    @property
    def samples(self) -> int:
        """Rows of all experiments."""
        return sum(e.phi.shape[1] for e in self.experiments)

    @property
    def kept(self) -> int:
        """Rows that take part."""
        return sum(int(e.keep.sum()) for e in self.experiments)


def common_sample_time(logs: Sequence[TrialLog]) -> float:
    """Return the sample time that all logs share.

    Raises
    ------
    LogError
        Two logs have different ones.
    """
    first = logs[0]
    for log in logs[1:]:
        if abs(log.sample_time - first.sample_time) > 1e-6 * first.sample_time:
            raise LogError(
                f"'{first.name}' is sampled at {first.sample_time:g} s and '{log.name}' at "
                f"{log.sample_time:g} s: give both one sample time (--sample-time)."
            )
    return first.sample_time


def build_regression(
    predictor: Predictor,
    logs: Sequence[TrialLog],
    *,
    margins: Mapping[str, float] | None = None,
) -> Regression:
    """Form y and Φ from measured logs.

    Parameters
    ----------
    predictor : Predictor
    logs : sequence of TrialLog
        One experiment each, of one sample time.
    margins : dict of str to float, optional
        Rows with a measured |state| below its margin are left out (Remark 4.2).

    Raises
    ------
    LogError
        A channel is missing, or sample times differ.
    ExcitationError
        An equation has no more than twice as many rows as coefficients.

    References
    ----------
    Ljungberg (2020), eqs. 4.3, 4.5.
    """
    sample_time = common_sample_time(logs)
    experiments = tuple(build_experiment(predictor, log, margins=margins) for log in logs)
    regression = Regression(predictor, experiments, sample_time)
    most = max(len(predictor.equation(s)) for s in predictor.structure.states)
    if regression.kept <= 2 * most:
        raise ExcitationError(
            f"{regression.kept} samples take part and one equation has {most} coefficients, "
            f"more than {2 * most} are needed: use a longer log, a smaller predictor, or "
            f"smaller margins."
        )
    return regression


def build_experiment(
    predictor: Predictor, log: TrialLog, *, margins: Mapping[str, float] | None = None
) -> Experiment:
    """Form the rows of one log; parameters and errors as `build_regression`."""
    structure = predictor.structure
    if predictor.air_measured and not log.has_wind:
        raise LogError(
            f"predictor '{predictor.kind}' needs the wind, and '{log.name}' has neither "
            f"u_q, v_q nor V_q, gamma_q: use the predictor 'augmented' or 'basic'."
        )
    x = log.states(structure.states)
    y = (np.diff(x, axis=0) if structure.increment else x[1:]).T
    given = LogInputs.of(structure, log)
    phi = predictor.evaluate(
        [np.ascontiguousarray(x[:-1, j]) for j in range(x.shape[1])],
        given.psi[:-1],
        list(given.tau[:-1].T),
        (log["u_q"][:-1], log["v_q"][:-1]) if predictor.air_measured else None,
    )
    keep = within_margins(x[:-1], structure.states, margins) & measured_rows(predictor, log)
    return Experiment(log.name, y, phi, keep)


def measured_rows(predictor: Predictor, log: TrialLog) -> NDArray[np.bool_]:
    """Return which rows of a regression were measured, at both ends of their step, (N−1,)."""
    known = log.known(predictor.structure.states)
    # only what captures a disturbance turns with the heading
    heading = ("psi",) if any(c.is_bias for c in predictor.columns) else ()
    return known[1:] & known[:-1] & log.known(heading)[:-1]


def within_margins(
    x: Array, states: tuple[str, ...], margins: Mapping[str, float] | None
) -> NDArray[np.bool_]:
    """Return which rows of x (N, nx) keep every state beyond its margin (A10)."""
    keep = np.ones(len(x), bool)
    for name, margin in (margins or {}).items():
        if name in states:
            keep &= np.abs(x[:, states.index(name)]) > margin
    return keep
