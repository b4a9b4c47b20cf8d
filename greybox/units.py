"""The units that are read: how they are spelled, of what dimension they are, their factor to SI."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.errors import LogError, suggestion


@dataclass(frozen=True)
class Unit:
    """One unit of measured quantities.

    Parameters
    ----------
    symbol : str
        As messages, vessel files and logs write it.
    si : str
        SI unit of the same dimension; the unit itself where it has none (``rpm``).
    factor : float
        Value in `si` of one unit.
    spellings : tuple of str
        Other ways to write it, in lower case.
    suffixes : tuple of str
        How the name of a column carries it behind an underscore, as in ``r_radps``.
    """

    symbol: str
    si: str
    factor: float
    spellings: tuple[str, ...] = ()
    suffixes: tuple[str, ...] = ()


_DEGREE = math.pi / 180.0
UNITS: dict[str, Unit] = {
    u.symbol: u
    for u in (
        Unit("s", "s", 1.0, ("sec", "secs", "second", "seconds"), ("s", "sec", "seconds")),
        Unit("ms", "s", 1e-3, ("msec", "millisecond", "milliseconds"), ("ms",)),
        Unit("us", "s", 1e-6, ("usec", "µs", "μs", "microsecond", "microseconds"), ("us",)),
        Unit("ns", "s", 1e-9, ("nsec", "nanosecond", "nanoseconds"), ("ns",)),
        Unit("min", "s", 60.0, ("minute", "minutes")),
        Unit("h", "s", 3600.0, ("hour", "hours")),
        Unit("d", "s", 86400.0, ("day", "days")),
        Unit("m", "m", 1.0, ("meter", "metre", "meters", "metres"), ("m",)),
        Unit("cm", "m", 1e-2),
        Unit("mm", "m", 1e-3),
        Unit("km", "m", 1e3),
        Unit("ft", "m", 0.3048),
        Unit("nmi", "m", 1852.0),
        Unit("rad", "rad", 1.0, ("radian", "radians"), ("rad",)),
        Unit("deg", "rad", _DEGREE, ("°", "degree", "degrees"), ("deg",)),
        Unit("arcmin", "rad", _DEGREE / 60.0),
        Unit("m/s", "m/s", 1.0, ("m s-1", "ms-1", "m*s^-1", "m.s-1", "m/sec", "mps"),
             ("mps", "m_s")),
        Unit("km/h", "m/s", 1 / 3.6, ("kmh", "kph"), ("kmh", "kph")),
        Unit("kn", "m/s", 1852.0 / 3600.0, ("kt", "kts", "knot", "knots", "kn/h"),
             ("knots", "kts", "kn")),
        Unit("mph", "m/s", 1609.344 / 3600.0),
        Unit("rad/s", "rad/s", 1.0, ("rad s-1", "rad/sec", "radps"), ("radps", "rad_s", "rads")),
        Unit("deg/s", "rad/s", _DEGREE, ("°/s", "deg/sec", "dps", "degps"),
             ("degps", "deg_s", "degs", "dps")),
        Unit("deg/min", "rad/s", _DEGREE / 60.0, ("°/min",), ("deg_min", "degpm")),
        Unit("rpm", "rpm", 1.0, ("1/min",), ("rpm",)),
        Unit("rps", "rps", 1.0, ("1/s", "hz"), ("rps",)),
        # of full thrust or speed: kept as it is, like any speed of a propeller
        Unit("%", "%", 1.0, ("percent", "per cent", "pct")),
        Unit("N", "N", 1.0, ("n", "newton", "newtons")),
        Unit("kN", "N", 1e3),
        Unit("1", "1", 1.0),
    )
}  # fmt: skip
# what the speed of a propeller is never counted in; thrust, shares and rad/s may stand for it
_NO_SPEED_OF_A_PROPELLER = frozenset({"rad", "m", "s"})
_SPELLED = {word: u.symbol for u in UNITS.values() for word in u.spellings}
# the longest suffix decides: '_rad_s' must not be read as '_s'
_SUFFIXES = sorted(
    ((suffix, u.symbol) for u in UNITS.values() for suffix in u.suffixes),
    key=lambda pair: -len(pair[0]),
)

# seconds since 1970 that a date of a log exceeds (1973); a clock that starts with the log does not
EARLIEST_UNIX = 1e8
# larger numbers cannot be UNIX time in the unit before them: in s this is the year 5138
_UNIX_LIMITS = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"))
# seconds in 2001, milliseconds after eleven days: only below it does the step decide
_LARGEST_UPTIME = 1e9
# nobody logs a manoeuvre every ten seconds, milliseconds are common
_LARGEST_STEP = 10.0


def spelled_unit(text: str) -> str | None:
    """Return the symbol of the unit that a text spells, None where it spells none.

    The ``1`` of a quantity without dimension is not taken from a text: there it is a number.
    """
    bare = text.strip()
    low = bare.lower()
    if bare == "1":
        return None
    if bare in UNITS:
        return bare
    return _SPELLED.get(low, low if low in UNITS else None)


def suffix_unit(stem: str) -> tuple[str, str | None]:
    """Part a name such as ``r_radps`` into ``r`` and the symbol of its unit, None without one."""
    for suffix, symbol in _SUFFIXES:
        if stem.endswith(f"_{suffix}"):
            return stem[: -len(suffix) - 1], symbol
    return stem, None


def find_unit(text: str) -> Unit | None:
    """Return the unit with a symbol or spelling, None where none is known."""
    symbol = text if text in UNITS else spelled_unit(text)
    return None if symbol is None else UNITS[symbol]


def unit_factor(unit: str, target: str | None, name: str) -> float:
    """Return the factor that takes values in `unit` to the SI unit `target`.

    Parameters
    ----------
    unit : str
        Symbol or spelling.
    target : str or None
        SI unit of the channel, or ``deg`` of geographic angles; None where any unit is
        kept as it is (propeller speeds).
    name : str
        Column or channel, for the message.

    Raises
    ------
    LogError
        The unit is unknown, or of another dimension than the channel.
    """
    found = find_unit(unit)
    if found is None:
        wanted = "rad" if target == "deg" else target
        words = {**dict.fromkeys(UNITS), **_SPELLED}
        fit = [w for w in words if wanted in (None, unit_dimension(w))]
        near = suggestion(unit, [w for w in fit if sorted(w) == sorted(unit.lower())] or fit)
        raise LogError(
            f"column '{name}' has the unknown unit '{unit}'.{near} "
            f"Known units: {', '.join(sorted(UNITS))}."
        )
    if target == "deg" and found.si == "rad":
        # geographic angles stay in degrees, the unit of every geodesy library
        return found.factor / _DEGREE
    if target is None and found.si in _NO_SPEED_OF_A_PROPELLER:
        raise LogError(
            f"column '{name}' is in '{unit}', which no propeller speed has: map the column of the "
            f"propeller's speed, or correct its unit in [columns]."
        )
    if target is not None and found.si != target:
        raise LogError(
            f"column '{name}' is in '{unit}' but its channel is in '{target}': "
            f"give a unit of the same dimension in [columns]."
        )
    return found.factor


def unit_dimension(unit: str) -> str:
    """Return the SI unit of the dimension of a known unit, such as ``m/s`` for ``kn``."""
    found = find_unit(unit)
    if found is None:
        raise KeyError(unit)
    return found.si


# times, whose unit is often not stated but can be told from the numbers


def unix_unit(size: float) -> str | None:
    """Return the unit finer than a second in which UNIX times are as large as `size`, else None."""
    return next((unit for limit, unit in _UNIX_LIMITS if size > limit), None)


def unix_seconds(times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return UNIX times in seconds, from the unit that their size tells.

    Parameters
    ----------
    times : ndarray
        (N,) since 1970, all in s, ms, us or ns; NaN where missing.
    """
    known = np.abs(times[np.isfinite(times)])
    unit = unix_unit(float(np.median(known))) if len(known) else None
    return times * UNITS[unit].factor if unit else times


def time_unit(times: NDArray[np.floating | np.integer]) -> str:
    """Guess in what unit the times of a log are, from their size and their step.

    Parameters
    ----------
    times : ndarray
        (N,), at least one, all finite, in the order of the log.

    Returns
    -------
    {"s", "ms", "us", "ns"}
    """
    # one damaged value must not decide
    size = float(np.median(np.abs(times)))
    if (fine := unix_unit(size)) is not None:
        return fine
    steps = np.abs(np.diff(times.astype(float)))
    long = len(steps) > 0 and float(np.median(steps)) >= _LARGEST_STEP
    return "ms" if long and size < _LARGEST_UPTIME else "s"


def is_unix_time(seconds: float) -> bool:
    """Whether a time [s] counts from 1970, and not from a moment of the recorder's own."""
    return seconds >= EARLIEST_UNIX
