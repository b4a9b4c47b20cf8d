"""Velocity of the ship through the air, from whatever measured the wind.

What models use is ν_q = (u_q, v_q) = ν − ν_w: the ship's velocity over ground
less the wind's, body axes (x forward, y to starboard). The apparent wind that
an anemometer feels is its opposite, so ν_q points to where that wind comes from.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from greybox.errors import LogError

Array = NDArray[np.float64]

# where weather services report the wind [m]: WMO-No. 8, part I, chapter 5
REFERENCE_HEIGHT = 10.0


def relative_wind(speed: Array, angle: Array, angle_std: float = 0.0) -> tuple[Array, Array]:
    """Return the velocity through the air from a polar measurement.

    Parameters
    ----------
    speed : ndarray
        (N,) V_q, apparent wind speed [m/s].
    angle : ndarray
        (N,) γ_q, minus the direction that the apparent wind comes from,
        clockwise from the bow [rad].
    angle_std : float
        Noise of the angle [rad]; its shrinking by ρ_γ (5.46) is divided out.

    Returns
    -------
    tuple of ndarray
        u_q, v_q (N,) [m/s], body axes.

    References
    ----------
    Ljungberg (2020), eq. 5.40-5.46.
    """
    rho = np.exp(-(angle_std**2) / 2)
    return speed * np.cos(angle) / rho, -speed * np.sin(angle) / rho


def relative_wind_from_direction(
    speed: Array, direction_from: Array, angle_std: float = 0.0
) -> tuple[Array, Array]:
    """Return the velocity through the air from an anemometer that tells where from.

    Parameters
    ----------
    speed : ndarray
        (N,) apparent wind speed [m/s].
    direction_from : ndarray
        (N,) direction that the apparent wind comes from, clockwise from the bow
        [rad], as NMEA 0183 MWV gives it with reference R: γ_q with its sign turned.
    angle_std : float
        Noise of the direction [rad], divided out as in `relative_wind`.

    Returns
    -------
    tuple of ndarray
        u_q, v_q (N,) [m/s], body axes: wind from ahead gives u_q > 0, from
        starboard v_q > 0.

    References
    ----------
    Ljungberg (2020), eq. 5.40-5.46, with γ_q = −direction_from.
    """
    return relative_wind(speed, np.negative(direction_from), angle_std)


def relative_wind_from_true(
    speed: Array, direction_from_north: Array, psi: Array, u: Array, v: Array
) -> tuple[Array, Array]:
    """Return the velocity through the air from the wind that a station on land measures.

    Parameters
    ----------
    speed : ndarray
        (N,) true wind speed [m/s].
    direction_from_north : ndarray
        (N,) direction that the wind comes from, clockwise from north [rad].
    psi : ndarray
        (N,) heading [rad].
    u, v : ndarray
        (N,) velocity of the ship over ground, body axes [m/s].

    Returns
    -------
    tuple of ndarray
        u_q, v_q (N,) [m/s], body axes.

    References
    ----------
    Ljungberg (2020), eq. 5.3: ν_q = ν − Rᵀ(ψ) ν_w,n.
    """
    # ν_q = ν − ν_w, and ν_w points away from where the wind comes from: hence plus
    bearing = np.asarray(direction_from_north) - psi
    return u + speed * np.cos(bearing), v + speed * np.sin(bearing)


def true_wind(u_q: Array, v_q: Array, psi: Array, u: Array, v: Array) -> tuple[Array, Array]:
    """Return the velocity of the air over ground, the inverse of `relative_wind_from_true`.

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
    forward, starboard = u - u_q, v - v_q
    c, s = np.cos(psi), np.sin(psi)
    return c * forward - s * starboard, s * forward + c * starboard


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


def height_profile(
    height: float,
    reference: float = REFERENCE_HEIGHT,
    *,
    exponent: float = 1 / 7,
    roughness: float | None = None,
) -> float:
    """Return the true wind speed at a reference height per unit of that at another height.

    Parameters
    ----------
    height : float
        Where the wind was measured, above the water [m].
    reference : float
        Where it is wanted [m]; 10 m is where weather services report it.
    exponent : float
        Of the power law (reference / height)^exponent; 1/7 is usual over water
        in a neutral atmosphere.
    roughness : float, optional
        z₀ [m] of the logarithmic law ln(reference / z₀) / ln(height / z₀), used
        in place of the power law where given; about 2e-4 over open water.

    Raises
    ------
    LogError
        A height is not above zero, or not above the roughness.
    """
    floor = 0.0 if roughness is None else roughness
    lowest = min(height, reference)
    if not (floor >= 0 and lowest > floor and math.isfinite(height + reference)):
        above = "the water" if roughness is None else f"the roughness {roughness:g} m"
        raise LogError(
            f"an anemometer at {height:g} m and a reference height of {reference:g} m: both must "
            f"be above {above}. Correct the heights, in m above the water."
        )
    if roughness is None:
        return float((reference / height) ** exponent)
    if roughness == 0:
        raise LogError(
            "a roughness of 0 m has no logarithmic profile: give about 2e-4 m for open water, "
            "or leave it out for the power law."
        )
    return math.log(reference / roughness) / math.log(height / roughness)


def wind_at_height(
    u_q: Array,
    v_q: Array,
    u: Array,
    v: Array,
    height: float,
    *,
    reference_height: float | None = None,
    exponent: float = 1 / 7,
    roughness: float | None = None,
) -> tuple[Array, Array]:
    """Return the velocity through the air for the wind at a reference height.

    The profile acts on the true wind; the ship's own motion is the same at
    every height: ν_q ← ν + k (ν_q − ν), k from `height_profile`. A scaled vector
    keeps its direction in any frame, so the heading is not needed.

    Nothing is changed unless a reference height is asked for: wind terms that
    are estimated from one anemometer contain k already, and it matters only
    where sensors at several heights meet, or coefficients of another source.

    Parameters
    ----------
    u_q, v_q : ndarray
        (N,) velocity through the air at the anemometer's height, body axes [m/s].
    u, v : ndarray
        (N,) velocity of the ship over ground, body axes [m/s].
    height : float
        Of the anemometer above the water [m].
    reference_height : float, optional
        [m], usually ``REFERENCE_HEIGHT``, 10 m; None returns u_q, v_q as they are.
    exponent, roughness : float
        See `height_profile`.

    Returns
    -------
    tuple of ndarray
        u_q, v_q (N,) [m/s], body axes.

    Raises
    ------
    LogError
        As `height_profile`.
    """
    if reference_height is None:
        return u_q, v_q
    k = height_profile(height, reference_height, exponent=exponent, roughness=roughness)
    return u + k * (u_q - u), v + k * (v_q - v)
