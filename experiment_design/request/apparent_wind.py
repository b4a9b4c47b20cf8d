"""Apparent wind: where a trial keeps it from zero, and how often a plan does not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from experiment_design.excitation.rollout import Motion
from experiment_design.request.request import PreparedRequest, draw_gusts
from greybox.model.predictor_kinds import PREDICTORS
from greybox.rotation import ned_to_body

Array = NDArray[np.float64]

# standard deviations of its sensor within which the sign of a velocity is not known
_SURE = 3.0


def air_velocity(velocity: Array, psi: Array, wind: Array) -> Array:
    """Return the velocity through the air, body axes (5.3).

    Parameters
    ----------
    velocity : ndarray
        (..., 2) surge and sway over ground [m/s].
    psi : ndarray
        (...) [rad]
    wind : ndarray
        (..., 2) north and east [m/s].

    Returns
    -------
    ndarray
        (..., 2) [m/s]
    """
    return velocity - np.stack(ned_to_body(wind[..., 0], wind[..., 1], psi), axis=-1)


def clear_heading(velocity: Array, wind: Array) -> float:
    """Return the heading at which both components through the air are furthest from zero [rad].

    Parameters
    ----------
    velocity : ndarray
        (1,) surge or (2,) surge and sway over ground [m/s].
    wind : ndarray
        (2,) north and east [m/s].
    """
    psi = np.deg2rad(np.arange(360.0))
    full = np.zeros((psi.size, 2))
    full[:, : velocity.size] = velocity
    through = air_velocity(full, psi, np.broadcast_to(wind, full.shape))[:, : velocity.size]
    return float(psi[int(np.abs(through).min(axis=1).argmax())])


def share_near_zero(request: PreparedRequest, motions: tuple[Motion, ...]) -> float:
    """Return the share of samples at which the measured velocity through the air may change sign.

    Those are the samples at which a component lies within three standard deviations
    of its sensor about zero, under the expected wind and its drawn gusts; an
    estimate can cut them (Remark 4.2).
    """
    states = request.structure.states
    axes = [i for i, s in enumerate(("u", "v")) if s in states]
    wind = np.asarray(request.d[2:], float) + draw_gusts(request)
    near = []
    for motion in motions:
        state = motion.state[0, :-1]
        velocity = np.zeros((len(state), 2))
        for i in axes:
            velocity[:, i] = state[:, states.index(("u", "v")[i])]
        through = air_velocity(velocity, state[:, len(states)], wind[: len(state)])[:, axes]
        near.append((np.abs(through) <= _SURE * request.noise.wind).any(axis=1))
    return float(np.concatenate(near).mean())


def air_notes(request: PreparedRequest, motions: tuple[Motion, ...]) -> list[str]:
    """Return what a plan that measures the wind has to say where no margin was asked for."""
    measured = PREDICTORS[request.predictor].air_measured
    if not measured or request.limits.margin_air is not None:
        return []
    names = "|u_q| or |v_q|" if "v" in request.structure.states else "|u_q|"
    if not request.noise.wind > 0:
        return [
            f"nothing tells how close to zero {names} may come: state wind_std under [sensors] in "
            f"the vessel file, or ask for a --margin-air"
        ]
    share = share_near_zero(request, motions)
    near = f"{names} within {_SURE * request.noise.wind:.2g} m/s of zero, {_SURE:g} standard "
    near += "deviations of the wind sensor"
    if share == 0:
        return [f"no planned sample has {near}"]
    return [
        f"{100 * share:.2g} % of the planned samples have {near}: an estimate can cut them "
        f"(Remark 4.2), --margin-air keeps the plan clear of them"
    ]
