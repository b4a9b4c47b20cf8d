"""How numbers are said to a crew: times, headings, sides."""

from __future__ import annotations

import re

import numpy as np

KNOT = 0.514444
SIDES = {
    ("u", 1): "ahead",
    ("u", -1): "astern",
    ("v", 1): "to starboard",
    ("v", -1): "to port",
    ("r", 1): "to starboard",
    ("r", -1): "to port",
}
WORDS = {"u": "Surge", "v": "Sway", "r": "Yaw rate"}


def clock(seconds: float) -> str:
    """Return a time as minutes and seconds, such as 4:05."""
    tenths = round(seconds * 10)
    minutes, rest = divmod(tenths, 600)
    return f"{minutes}:{rest // 10:02d}" + (f".{rest % 10}" if rest % 10 else "")


def compass(angle: float) -> str:
    """Return an angle [rad] as a compass direction in degrees, 000 to 359."""
    return f"{round(np.rad2deg(angle)) % 360:03d}"


def signed(value: float, decimals: int = 0) -> str:
    """Return a number with a true minus sign and no negative zero."""
    return f"{round(value, decimals) + 0.0:.{decimals}f}".replace("-", "−")


def tie(text: str) -> str:
    """Return text in which a line does not end between a number and its unit."""
    tied = re.sub(r"(?<=\d) (?=(?:m/s|rad/s|kn|m|s|%|min)(?:\W|$))", "\u00a0", text)
    return tied.replace("(N, E)", "(N,\u00a0E)")
