"""The motion that a predictor itself predicts, bias-capturing terms included.

Still-water instruments (4.61) need no more than a model. Once the coefficients
of a predictor are estimated, its own one-step prediction, fed back, follows the
disturbed ship without its noise: regressors there are the noise-free ones, and
derivatives there say how each measurement's noise enters the equation error.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from greybox.model.predictor import Predictor
from greybox.model.run.inputs import LogInputs
from greybox.model.run.kernels import FreeRunKernel
from greybox.model.run.simulation import beyond
from greybox.model.run.step import Heading, StepModel, integrated
from greybox.numerics.vectorised import Vectorised
from greybox.regression.instruments import initial_state, smoothed_wind, state_bound
from greybox.rotation import ned_to_body
from greybox.trial.log import TrialLog

Array = NDArray[np.float64]

# samples over which a drift is seen beside a heading's noise, and the least that a sample
# adds to its variance, in that of the noise
_DRIFT, _LEAST_WALK = 20, 1e-4


@dataclass(frozen=True)
class Motion:
    """One log's predicted motion.

    Parameters
    ----------
    x : ndarray
        (N, nx) states [m/s, rad/s].
    z : ndarray
        (p, N) regressors at those states, not centred.
    slopes : ndarray
        (N, nx, nx + m) derivative of the next state in the states and in the m
        further measured channels: the heading, then the velocity through the air.
    diverged : int
        First sample outside the bound, −1 where there is none.
    """

    x: Array
    z: Array
    slopes: Array
    diverged: int


def further_channels(predictor: Predictor) -> tuple[str, ...]:
    """Return what a predictor reads beside states and inputs: ``psi``, ``u_q``, ``v_q``."""
    if not predictor.structure.marine:
        return ()
    return ("psi", "u_q", "v_q") if predictor.air_measured else ("psi",)


@lru_cache(maxsize=32)
def _step(predictor: Predictor, heading: Heading, relative: bool) -> ca.Function:
    """Return the step ``(state, w, coefficients and constants and dt) -> state``.

    ``w`` holds heading, inputs and air: the velocity through the air, or, where
    `relative`, the wind along the body axes, from which the state is taken.
    """
    step = StepModel.of_predictor(predictor, heading)
    s = step.symbolic
    nx = s.x.numel()
    constants, psi, air = ca.SX.sym("k", nx), ca.SX.sym("psi"), ca.SX.sym("air", 2)
    # the last state is the heading of a simulated one; a measured one comes with w
    state = ca.vertcat(s.x, ca.SX.sym("own"))
    turns = heading == "simulated"
    after = step(
        s.x,
        state[nx] if turns else psi,
        s.tau,
        ca.SX(s.d.numel(), 1),
        s.x[:2] - air if relative else air,
        s.theta,
        s.dt,
    )
    return ca.Function(
        "step",
        [state, ca.vertcat(psi, s.tau, air), ca.vertcat(s.theta, constants, s.dt)],
        [ca.vertcat(after[:nx] + constants, after[nx] if turns else state[nx])],
        {"cse": True},
    )


@lru_cache(maxsize=32)
def _slopes(predictor: Predictor) -> Vectorised:
    step = StepModel.of_predictor(predictor)
    s = step.symbolic
    given = (s.x, s.psi, s.tau, s.air, s.theta)
    after = step(s.x, s.psi, s.tau, ca.SX(s.d.numel(), 1), s.air, s.theta, 1.0)
    further = {"psi": s.psi, "u_q": s.air[0], "v_q": s.air[1]}
    symbols = ca.vertcat(s.x, *[further[n] for n in further_channels(predictor)])
    jacobian = ca.densify(ca.jacobian(after, symbols))
    return Vectorised(ca.vertsplit(ca.vec(jacobian.T)), ca.vertsplit(ca.vertcat(*given)))


def smoothed_heading(measured: Array, yaw_rate: Array, sample_time: float) -> Array:
    """Free a measured heading of its sensor's noise by a predicted yaw rate.

    The integral of the rate drifts from the truth slowly; the smoother of a local level takes
    the drift from the measurement, so hardly any of a sample's noise is left in it.

    Parameters
    ----------
    measured : ndarray
        (N,) [rad]
    yaw_rate : ndarray
        (N,) [rad/s]
    sample_time : float
        [s]

    Returns
    -------
    ndarray
        (N,) [rad]; `measured` itself where it is too short to tell noise from drift, or
        has no noise.

    References
    ----------
    Durbin and Koopman (2012), section 2.4, with a diffuse start; Hodrick and Prescott (1997)
    for the smoother as penalised least squares.
    """
    from scipy.linalg import solveh_banded

    turned = integrated(yaw_rate, sample_time, "euler")
    drift = measured - turned
    change = np.diff(drift)
    if len(change) <= _DRIFT or not np.isfinite(drift).all():
        return measured
    # differences of white noise are opposed to their neighbours; what grows with time drifts
    noise = -float(np.mean(change[1:] * change[:-1]))
    if noise <= 0:
        return measured
    grown = drift[_DRIFT:] - drift[:-_DRIFT]
    walk = max((float(np.mean(grown**2)) - 2 * noise) / _DRIFT, _LEAST_WALK * noise)
    # the least Σ (drift − level)² / noise + Σ (steps of the level)² / walk
    stiff = noise / walk
    band = np.full((2, len(drift)), -stiff)
    band[1] = 1.0 + 2.0 * stiff
    band[1, [0, -1]] -= stiff
    return np.asarray(turned + solveh_banded(band, drift))


def predicted_motion(
    predictor: Predictor,
    log: TrialLog,
    theta: Array,
    constants: Array,
    *,
    heading: Literal["measured", "simulated"] = "measured",
    wind: Literal["smoothed", "measured"] = "smoothed",
    course: Array | None = None,
    states_only: bool = False,
) -> Motion:
    """Feed a predictor's own prediction back along a log's inputs.

    Parameters
    ----------
    predictor : Predictor
    log : TrialLog
    theta : ndarray
        (p,) coefficients of all columns.
    constants : ndarray
        (nx,) what zero-mean instruments leave to each equation of this log.
    heading, wind : str
        As in `build_instruments`.
    course : ndarray, optional
        (N−1,) heading [rad] in place of the measured one.
    states_only : bool
        Whether regressors and slopes are left out, which only a settled heading needs.

    Returns
    -------
    Motion
        Of N−1 samples of the log, as its regression has.
    """
    structure = predictor.structure
    samples, nx = len(log) - 1, len(structure.states)
    given = LogInputs.of(structure, log)
    psi, tau = given.psi[:-1] if course is None else course, given.tau[:-1]
    air = np.zeros((samples, 2))
    blow = smoothed_wind(log) if wind == "smoothed" and predictor.air_measured and nx > 1 else None
    if blow is not None:
        air = np.column_stack(ned_to_body(blow[0][:-1], blow[1][:-1], psi))
    elif predictor.air_measured:
        air = np.column_stack([log["u_q"][:-1], log["v_q"][:-1]])
    start = np.append(initial_state(log, structure.states), psi[0])
    run = FreeRunKernel(_step(predictor, heading, blow is not None), samples)
    run.start[:] = start
    run.read[:] = np.column_stack([psi, tau, air])
    run.constants[0][:] = np.concatenate([theta, constants, [log.sample_time]])
    whole = np.vstack([start, run()[:-1]])
    x = whole[:, :nx]
    outside = beyond(x, state_bound(log, structure.states))
    if outside.any() or states_only:
        diverged = int(outside.argmax()) if outside.any() else -1
        return Motion(x, np.empty((0, 0)), np.empty((0, 0, 0)), diverged)
    angle = whole[:, nx] if heading == "simulated" else psi
    through = x[:, :2] - air if blow is not None else air
    z, slopes = regressors_along(predictor, x, angle, tau, through, theta)
    return Motion(x, z, slopes, -1)


def regressors_along(
    predictor: Predictor, x: Array, psi: Array, tau: Array, air: Array, theta: Array
) -> tuple[Array, Array]:
    """Return regressors (p, N) and slopes (N, nx, nx + m) along a motion.

    Parameters
    ----------
    x, psi, tau, air : ndarray
        (N, nx), (N,), (N, nu), (N, 2).
    theta : ndarray
        (p,) coefficients of all columns, which the slopes depend on.
    """
    states = [np.ascontiguousarray(v) for v in x.T]
    inputs = [np.ascontiguousarray(v) for v in tau.T]
    pair = (np.ascontiguousarray(air[:, 0]), np.ascontiguousarray(air[:, 1]))
    z = predictor.evaluate(states, psi, inputs, pair)
    nx = x.shape[1]
    channels = nx + len(further_channels(predictor))
    slopes = np.empty((nx * channels, len(x)))
    _slopes(predictor)([*states, psi, *inputs, *pair, *map(float, theta)], slopes)
    return z, np.ascontiguousarray(slopes.T).reshape(len(x), nx, channels)


def measured_slopes(predictor: Predictor, log: TrialLog, theta: Array) -> Array:
    """Return the slopes (N−1, nx, nx + m) of a `Motion` at the measured states of a log.

    Parameters
    ----------
    theta : ndarray
        (p,) coefficients of all columns, which the slopes depend on.
    """
    structure = predictor.structure
    samples = len(log) - 1
    given = LogInputs.of(structure, log)
    air = np.zeros((samples, 2))
    if predictor.air_measured:
        air = np.column_stack([log["u_q"], log["v_q"]])[:-1]
    x = log.states(structure.states)[:-1]
    return regressors_along(predictor, x, given.psi[:-1], given.tau[:-1], air, theta)[1]
