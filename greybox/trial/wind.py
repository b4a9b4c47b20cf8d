"""Velocity of the ship through the air, from whatever measured the wind.

What models use is ν_q = (u_q, v_q) = ν − ν_w: the ship's velocity over ground
less the wind's, body axes (x forward, y to starboard). The apparent wind that
an anemometer feels is its opposite, so ν_q points to where that wind comes from.
"""

from __future__ import annotations

import math

import numpy as np

from greybox.errors import LogError
from greybox.rotation import body_to_ned
from greybox.trial.raw_log import Array

# of the power law over water in a neutral atmosphere
_EXPONENT = 1 / 7


def relative_wind(speed: Array, direction_from: Array) -> tuple[Array, Array]:
    """Return the velocity through the air from the apparent wind's speed and direction.

    Parameters
    ----------
    speed : ndarray
        (N,) V_q, apparent wind speed [m/s].
    direction_from : ndarray
        (N,) direction that the apparent wind comes from, clockwise from the bow
        [rad], as NMEA 0183 MWV gives it with reference R: −γ_q.

    Returns
    -------
    tuple of ndarray
        u_q, v_q (N,) [m/s], body axes: wind from ahead gives u_q > 0, from
        starboard v_q > 0.

    References
    ----------
    Ljungberg (2020), eq. 5.40-5.43.
    """
    return speed * np.cos(direction_from), speed * np.sin(direction_from)


def true_wind(u_q: Array, v_q: Array, psi: Array, u: Array, v: Array) -> tuple[Array, Array]:
    """Return the velocity of the air over ground.

    Parameters
    ----------
    u_q, v_q : ndarray
        (N,) velocity of the ship through the air, body axes [m/s].
    psi : ndarray
        (N,) heading [rad].
    u, v : ndarray
        (N,) velocity of the ship over ground, body axes [m/s].

    Returns
    -------
    tuple of ndarray
        Velocity of the air towards north and towards east (N,) [m/s].

    References
    ----------
    Ljungberg (2020), eq. 5.3: ν_w,n = R(ψ) (ν − ν_q).
    """
    return body_to_ned(u - u_q, v - v_q, psi)


def direction_from(north: Array, east: Array) -> tuple[Array, Array]:
    """Return a wind as weather services give it.

    Parameters
    ----------
    north, east : ndarray
        (N,) velocity of the air [m/s].

    Returns
    -------
    tuple of ndarray
        Speed [m/s] and direction that it comes from, clockwise from north, in
        [0, 2π) [rad], (N,) each.
    """
    return np.hypot(north, east), np.mod(np.arctan2(-east, -north), 2 * np.pi)


def move_anemometer(u_q: Array, v_q: Array, r: Array, x: float, y: float) -> tuple[Array, Array]:
    """Return the velocity through the air of the body origin from that of an anemometer.

    An anemometer at (x, y) moves with (u − r y, v + r x) when the ship turns.
    Roll and pitch, which swing a mast too, are not in a log and stay in the
    measurement; the wind is taken as the same at both places.

    Parameters
    ----------
    u_q, v_q : ndarray
        (N,) velocity of the anemometer through the air, body axes [m/s].
    r : ndarray
        (N,) yaw rate [rad/s].
    x, y : float
        Place of the anemometer from the body origin, forward and starboard [m].

    Returns
    -------
    tuple of ndarray
        u_q, v_q (N,) [m/s] at the body origin.
    """
    return u_q + r * y, v_q - r * x


def wind_at_height(
    u_q: Array, v_q: Array, u: Array, v: Array, height: float, reference: float
) -> tuple[Array, Array]:
    """Return the velocity through the air for the wind at a reference height.

    The profile acts on the true wind; the ship's own motion is the same at every height:
    ν_q ← ν + k (ν_q − ν) with k = (reference / height)^(1/7), the power law that is usual
    over water in a neutral atmosphere. A scaled vector keeps its direction in any frame, so
    the heading is not needed.

    It matters only where sensors at several heights meet, or coefficients of another source:
    wind terms that are estimated from one anemometer contain k already.

    Parameters
    ----------
    u_q, v_q : ndarray
        (N,) velocity through the air at the anemometer's height, body axes [m/s].
    u, v : ndarray
        (N,) velocity of the ship over ground, body axes [m/s].
    height, reference : float
        Of the anemometer, and where the wind is wanted, above the water [m].

    Returns
    -------
    tuple of ndarray
        u_q, v_q (N,) [m/s], body axes.

    Raises
    ------
    LogError
        A height is not above zero.
    """
    if not (min(height, reference) > 0 and math.isfinite(height + reference)):
        raise LogError(
            f"an anemometer at {height:g} m and a reference height of {reference:g} m: both must "
            f"be above the water. Correct the heights, in m above the water."
        )
    k = (reference / height) ** _EXPONENT
    return u + k * (u_q - u), v + k * (v_q - v)
