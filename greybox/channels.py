"""The vocabulary: symbol, unit and sign convention of each signal.

Past the readers everything is SI and radians. The frame is that of SNAME and
Fossen: x forward, y to starboard, z down; heading clockwise from north.
"""

from __future__ import annotations

from dataclasses import dataclass


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
# what a model predicts: a run needs none of them past its start
MOTIONS = frozenset({"x_n", "y_n", "psi", "u", "v", "r"})

# how sentences, axes and tables name motions (SNAME, 1950)
MOTION_WORDS = {"u": "surge", "v": "sway", "r": "yaw rate", "psi": "heading"}
