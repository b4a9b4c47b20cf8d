"""The vocabulary: symbol, unit and sign convention of each signal.

Past the readers everything is SI and radians. The frame is that of SNAME and
Fossen: x forward, y to starboard, z down; heading clockwise from north.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from greybox.errors import LogError, suggestion


@dataclass(frozen=True)
class Channel:
    """One canonical signal of a log."""

    name: str
    unit: str
    meaning: str


CHANNELS: dict[str, Channel] = {
    c.name: c
    for c in (
        Channel("t", "s", "time"),
        Channel("x_n", "m", "position north"),
        Channel("y_n", "m", "position east"),
        Channel("psi", "rad", "heading, clockwise from north, unwrapped"),
        Channel("u", "m/s", "surge velocity over ground, forward positive"),
        Channel("v", "m/s", "sway velocity over ground, starboard positive"),
        Channel("r", "rad/s", "yaw rate, clockwise positive"),
        Channel("u_q", "m/s", "velocity of the ship through the air, forward"),
        Channel("v_q", "m/s", "velocity of the ship through the air, starboard"),
        Channel("V_q", "m/s", "apparent wind speed"),
        Channel("gamma_q", "rad", "minus the direction the apparent wind comes from (5.40)"),
        Channel("lat", "deg", "latitude, north positive"),
        Channel("lon", "deg", "longitude, east positive"),
        Channel("v_n", "m/s", "velocity over ground, north"),
        Channel("v_e", "m/s", "velocity over ground, east"),
        Channel("sog", "m/s", "speed over ground"),
        Channel("cog", "rad", "course over ground, clockwise from north"),
        Channel("dir_q", "rad", "direction the apparent wind comes from, clockwise from the bow"),
        Channel("dir_t", "rad", "direction the true wind comes from, clockwise from the bow"),
        Channel("V_w", "m/s", "true wind speed"),
        Channel("dir_w", "rad", "direction the true wind comes from, clockwise from north"),
    )
}

ANGLES = frozenset({"psi", "gamma_q", "cog", "dir_q", "dir_t", "dir_w"})
# what a log keeps; the rest only serves to derive these
LOGGED = ("t", "x_n", "y_n", "psi", "u", "v", "r", "u_q", "v_q")

# factor to the SI unit of the same dimension
_UNITS: dict[str, tuple[str, float]] = {
    "s": ("s", 1.0),
    "ms": ("s", 1e-3),
    "us": ("s", 1e-6),
    "ns": ("s", 1e-9),
    "min": ("s", 60.0),
    "h": ("s", 3600.0),
    "m": ("m", 1.0),
    "cm": ("m", 1e-2),
    "mm": ("m", 1e-3),
    "km": ("m", 1e3),
    "ft": ("m", 0.3048),
    "nmi": ("m", 1852.0),
    "rad": ("rad", 1.0),
    "deg": ("rad", math.pi / 180.0),
    "arcmin": ("rad", math.pi / 10800.0),
    "m/s": ("m/s", 1.0),
    "km/h": ("m/s", 1 / 3.6),
    "kn": ("m/s", 1852.0 / 3600.0),
    "knots": ("m/s", 1852.0 / 3600.0),
    "rad/s": ("rad/s", 1.0),
    "deg/s": ("rad/s", math.pi / 180.0),
    "deg/min": ("rad/s", math.pi / 180.0 / 60.0),
    "rpm": ("rpm", 1.0),
    "rps": ("rps", 1.0),
    "1": ("1", 1.0),
    "N": ("N", 1.0),
    "kN": ("N", 1e3),
}


def unit_factor(unit: str, target: str | None, name: str) -> float:
    """Return the factor that takes `unit` to the SI unit `target`.

    Parameters
    ----------
    unit : str
        Unit as written in the vessel file.
    target : str or None
        SI unit of the channel; None where any unit is kept as it is (propeller speeds).
    name : str
        Column or channel, for the message.

    Raises
    ------
    LogError
        The unit is unknown, or of another dimension than the channel.
    """
    if unit not in _UNITS:
        raise LogError(
            f"column '{name}' has the unknown unit '{unit}'.{suggestion(unit, _UNITS)} "
            f"Known units: {', '.join(sorted(_UNITS))}."
        )
    dimension, factor = _UNITS[unit]
    if target == "deg" and dimension == "rad":
        # geographic angles stay in degrees, the unit of every geodesy library
        return factor * 180.0 / math.pi
    if target is None:
        return factor if dimension in ("rad", "s", "m", "m/s", "rad/s", "N") else 1.0
    if dimension != target:
        raise LogError(
            f"column '{name}' is in '{unit}' but its channel is in '{target}': "
            f"give a unit of the same dimension in [columns]."
        )
    return factor


def unit_dimension(unit: str) -> str:
    """Return the unit that values read in `unit` have afterwards, such as ``m/s`` for ``kn``."""
    return _UNITS[unit][0]
