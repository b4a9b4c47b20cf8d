"""How disturbance means enter the signals that terms are made of.

The velocity through the water and through the air differ from the measured
velocity over ground by the current and the wind, constant in the n-frame and
therefore turning with the heading in the body frame (5.2), (5.3). Keeping their
means symbolic is what lets the bias-capturing regressors be derived.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import casadi as ca

from greybox.rotation import ned_to_body

DisturbanceKind = Literal["marine", "additive", "none"]

CURRENT = ("current_north", "current_east")
WIND = ("wind_north", "wind_east")
# what a wind does in (3.51)
WIND_TERMS = ("Wuu", "Wvv", "Wuv")
# signals of a ship in a current and a wind -> how equations show them
SHOWN = {"u": "u_r", "v": "v_r", "uq": "u_q", "vq": "v_q", "uc": "u_c", "vc": "v_c"}
# what the velocity over ground gains in a sample because the water's turns in body axes, r v_c
# and -r u_c, where forces change the velocity through the water (Fossen, 2011, section 8.3)
TURNING = ("X_r*vc", "Y_r*uc")


def turn_of_water(sample_time: float) -> dict[str, float]:
    """Return the coefficients of `TURNING` that kinematics gives, for a sample time [s]."""
    return dict(zip(TURNING, (sample_time, -sample_time), strict=True))


def turn_bounds(sample_time: float) -> dict[str, tuple[float, float]]:
    """Return the least and the largest coefficient of each of `TURNING` for a sample time [s].

    From none, as (3.51) has it, to twice what kinematics gives. Without bounds a fit may end
    where a current of nothing turns with a coefficient beyond measure.
    """
    return {
        name: (min(0.0, 2 * value), max(0.0, 2 * value))
        for name, value in turn_of_water(sample_time).items()
    }


def disturbance_names(kind: DisturbanceKind, states: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the disturbance means, in the order of their symbol ``d``."""
    if kind == "marine":
        return CURRENT + WIND
    if kind == "additive":
        return tuple(f"{state}_disturbance" for state in states)
    return ()


def velocity_through(
    states: Mapping[str, ca.SX], psi: ca.SX, north: ca.SX, east: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """Return the velocity through what itself moves over ground, water or air (5.2), (5.3).

    Parameters
    ----------
    states : mapping of str to SX
        Of which u and v over ground count, as zero where there is none [m/s].
    psi : SX
        [rad]
    north, east : SX
        Velocity of the water or the air [m/s].

    Returns
    -------
    tuple of SX
        Forward and to starboard.
    """
    forward, starboard = ned_to_body(north, east, psi)
    none = ca.SX(0)
    return states.get("u", none) - forward, states.get("v", none) - starboard


def disturbed_signals(
    kind: DisturbanceKind,
    states: Mapping[str, ca.SX],
    psi: ca.SX,
    d: ca.SX,
    air: ca.SX | None,
) -> dict[str, ca.SX]:
    """Return the signals that terms see: relative velocities and states.

    Parameters
    ----------
    kind : {"marine", "additive", "none"}
        ``marine``: current and wind in the n-frame (5.2), (5.3);
        ``additive``: each state is seen as x + v (4.1).
    states : mapping of str to SX
        Symbols of the states over ground [m/s, rad/s].
    psi : SX
        Heading [rad].
    d : SX
        (nd, 1) disturbance means in the order of `disturbance_names` [m/s].
    air : SX or None
        (2, 1) measured velocity through the air, body axes [m/s]; None to form
        it from the wind mean in `d`.
    """
    signals = dict(states)
    if kind == "additive":
        return {name: x + d[i] for i, (name, x) in enumerate(states.items())}
    if kind == "none":
        return signals
    for name, through in zip(("u", "v"), velocity_through(states, psi, d[0], d[1]), strict=True):
        if name in states:
            signals[name] = through
            signals[f"{name}c"] = states[name] - through
    air = ca.vertcat(*velocity_through(states, psi, d[2], d[3])) if air is None else air
    signals |= {f"{name}q": air[i] for i, name in enumerate(("u", "v")) if name in states}
    return signals
