"""What a sequence would tell: predicted standard errors of the zero-mean IV estimate.

The instruments of a refined estimator approach the noise-free regressors, so its
covariance follows from simulation alone: with Z the centred noise-free
regressors, C = σ² (Σ Z Zᵀ)⁻¹ for white equation errors. Bias-capturing
regressors count as nuisance and inflate it, as they do the estimate.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.errors import ExcitationError
from greybox.model.predictor import Predictor
from greybox.model.simulation import simulate
from greybox.trial.log import TrialLog

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PredictedPrecision:
    """Predicted precision of one sequence.

    Parameters
    ----------
    names : tuple of str
        Parameters, nuisance left out.
    std : ndarray
        (p,) predicted standard errors.
    logdet : float
        −log det of their covariance; larger is better.
    """

    names: tuple[str, ...]
    std: Array
    logdet: float

    def summary(self) -> str:
        """Return the predicted standard errors as text."""
        lines = [f"{n:<12}{s:>12.3g}" for n, s in zip(self.names, self.std, strict=True)]
        return "\n".join([*lines, f"{'−log det':<12}{self.logdet:>12.2f}"])


def predict_precision(
    predictor: Predictor,
    theta: Array,
    plan: TrialLog,
    start: Array,
    error_std: Mapping[str, float],
) -> PredictedPrecision:
    """Predict the standard errors that a sequence would give.

    Parameters
    ----------
    predictor : Predictor
        Without wind measurement.
    theta : ndarray
        (p_structure,) prior parameters.
    plan : TrialLog
        Commands of the sequence.
    start : ndarray
        (nx + 1,) initial states and heading [m/s, rad/s, rad].
    error_std : mapping of str to float
        Standard deviation of the one-step equation error of each state.

    Returns
    -------
    PredictedPrecision

    Raises
    ------
    ExcitationError
        The model diverges on the plan, or some direction is not excited.
    """
    structure = predictor.structure
    tau = plan.forces(structure.inputs)
    run = simulate(structure, theta, start[:-1], tau, plan.sample_time, psi0=float(start[-1]))
    if run.diverged[0] >= 0:
        raise ExcitationError(
            f"the model diverges at sample {int(run.diverged[0])} of {len(plan)} of the plan: "
            f"use a stable prior model."
        )
    z = predictor.evaluate(
        [np.ascontiguousarray(c) for c in run.x[0, :-1].T], run.psi[0, :-1], list(tau.T)
    )
    z = z - z.mean(axis=1, keepdims=True)
    std, names, logdet = [], [], 0.0
    for state in structure.states:
        mine = predictor.equation(state)
        scale = np.sqrt((z[mine] ** 2).sum(axis=1))
        if (scale == 0).any():
            name = predictor.columns[mine[int(np.argmin(scale))]].label
            raise ExcitationError(
                f"parameter {name} is not excited by this plan: its regressor varies by 0 over "
                f"{len(plan)} samples. Move what it multiplies."
            )
        unit = z[mine] / scale[:, None]
        covariance = error_std[state] ** 2 * np.linalg.inv(unit @ unit.T) / np.outer(scale, scale)
        wanted = [i for i, k in enumerate(mine) if not predictor.columns[k].is_bias]
        part = covariance[np.ix_(wanted, wanted)]
        std += list(np.sqrt(np.diag(part)))
        names += [predictor.columns[mine[i]].name for i in wanted]
        logdet -= float(np.linalg.slogdet(part)[1])
    return PredictedPrecision(tuple(names), np.array(std), logdet)
