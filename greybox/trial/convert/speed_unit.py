"""The unit of a speed over ground that states none, from the way that the positions make."""

from __future__ import annotations

import numpy as np

from greybox.trial.raw_log import Array, Signal
from greybox.units import UNITS

# over so long the way made is nearly straight, and beyond the noise of positions [s]
_SPAN = 10.0
_LEAST_WAYS = 10
_UNITS = ("m/s", "kn", "km/h")
# neighbouring units differ by factors of 1.9: what is farther from each than this fits none
_NEAR = 1.3


def unit_of_speed(speed: Signal, north: Signal, east: Signal) -> str | None:
    """Return the unit by which a speed goes as far as positions do, None where none fits.

    Parameters
    ----------
    speed : Signal
        Speed over ground, in an unknown unit.
    north, east : Signal
        Positions [m], at the same times.
    """
    t, x, y = _orderly(north.t, north.value, east.value)
    at, rate = _orderly(speed.t, speed.value)
    if len(t) < 2 or len(at) < 2:
        return None
    made = np.interp(t, at, np.concatenate([[0.0], np.cumsum(np.diff(at) * _middles(rate))]))
    after = np.searchsorted(t, t + _SPAN)
    first = np.flatnonzero(after < len(t))
    last = after[first]
    # spans with a hole in them, or beside the speeds, say nothing
    whole = (t[last] - t[first] < 2 * _SPAN) & (t[first] >= at[0]) & (t[last] <= at[-1])
    first, last = first[whole], last[whole]
    way, gone = np.hypot(x[last] - x[first], y[last] - y[first]), made[last] - made[first]
    if len(way) < _LEAST_WAYS or not (way > 0).any():
        return None
    # where the ship makes most way, noise and turns count least
    quick = (way >= np.median(way)) & (way > 0)
    ratio = float(np.median(gone[quick] / way[quick]))
    return next((u for u in _UNITS if 1 / _NEAR < ratio * UNITS[u].factor < _NEAR), None)


def _orderly(t: Array, *values: Array) -> tuple[Array, ...]:
    """Return the samples at which all is known, in order of time, each time once."""
    known = np.isfinite(t) & np.all([np.isfinite(v) for v in values], axis=0)
    t, rows = np.unique(t[known], return_index=True)
    return (t, *(v[known][rows] for v in values))


def _middles(values: Array) -> Array:
    return 0.5 * (values[1:] + values[:-1])
