"""The lower bound on the covariance of instrumental-variable estimates of a model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from greybox.estimation.banded_covariance import ErrorBand, ErrorNoise
from greybox.estimation.gls_regression import own_constants, solve_white, white_rows
from greybox.model.noise import NoiseLevels
from greybox.model.predictor import Predictor
from greybox.model.run.inputs import LogInputs
from greybox.regression.instruments import simulate_log
from greybox.regression.motion import further_channels, regressors_along
from greybox.trial.log import TrialLog

Array = NDArray[np.float64]


def iv_bound(
    predictor: Predictor,
    logs: Sequence[TrialLog],
    theta: Array,
    noise: NoiseLevels,
    *,
    d: Array | None = None,
    memory: Array | None = None,
) -> Array:
    """Return the bound (Φ₀ᵀ Ω⁻¹ Φ₀)⁻¹ on the covariance of an IV estimate.

    Φ₀ are the regressors of the noise-free motion on the inputs of the logs, Ω the
    covariance of all equations' errors there, each log's constants being free. It
    bounds estimates of this predictor's one-step equations with instruments that
    depend on the inputs only, not those of other methods.

    Parameters
    ----------
    predictor : Predictor
    logs : sequence of TrialLog
        Inputs, first samples, heading and, where the predictor measures it, wind.
    theta : ndarray
        (p_structure,) parameters of the structure that moves.
    noise : NoiseLevels
    d : ndarray, optional
        (nd,) disturbance means [m/s]; still water and air by default.
    memory : ndarray, optional
        (nx,) correlation of the process noise from sample to sample.

    Returns
    -------
    ndarray
        (p, p) of all columns, bias-capturing ones included.

    Raises
    ------
    DivergenceError
        The model cannot be simulated on the inputs of a log.

    References
    ----------
    Söderström and Stoica (1983).
    """
    structure = predictor.structure
    nx = len(structure.states)
    spread = [
        noise.heading if name == "psi" else noise.wind for name in further_channels(predictor)
    ]
    levels = ErrorNoise(
        np.asarray(noise.measurement, float),
        np.asarray(noise.process, float),
        np.zeros(nx) if memory is None else np.asarray(memory, float),
        np.array(spread, float),
    )
    rows = []
    for log in logs:
        run = simulate_log(structure, theta, log, d=d, use_wind=predictor.air_measured)
        run.require_bounded(structure.states, f"the model on the inputs of '{log.name}'")
        x = run.x[0]
        samples = len(x) - 1
        marine = structure.marine
        tau = LogInputs.of(structure, log).tau[:-1]
        psi = np.broadcast_to(run.psi[0][:samples], samples) if marine else np.zeros(samples)
        air = np.zeros((samples, 2)) if log.air is None else log.air[:samples]
        y = (np.diff(x, axis=0) if structure.increment else x[1:]).T
        z, _ = regressors_along(predictor, x[:-1], psi, tau, air, np.zeros(len(predictor.columns)))
        coefficients = _coefficients(predictor, z, y)
        z, slopes = regressors_along(predictor, x[:-1], psi, tau, air, coefficients)
        band = ErrorBand(slopes, np.ones(samples, bool))
        rows.append(white_rows(predictor, band, levels, z, z, y))
    return solve_white(rows)[1]


def _coefficients(predictor: Predictor, z: Array, y: Array) -> Array:
    """Return the coefficients that the noise-free motion itself has, biases included."""
    own = own_constants(predictor)
    out = np.zeros(len(z))
    for i, state in enumerate(predictor.structure.states):
        mine = predictor.equation(state)
        rows, target = z[mine], y[i]
        if own[i]:
            rows = rows - rows.mean(axis=1, keepdims=True)
            target = target - target.mean()
        out[mine] = np.linalg.lstsq(rows.T, target, rcond=None)[0]
    return out
