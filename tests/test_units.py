"""One table of units: spellings, factors, and the unit of times that nobody stated."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.errors import LogError
from greybox.units import (
    UNITS,
    find_unit,
    is_unix_time,
    spelled_unit,
    suffix_unit,
    time_unit,
    unit_dimension,
    unit_factor,
    unix_seconds,
)


def test_no_spelling_or_suffix_stands_for_two_units():
    words = [w for u in UNITS.values() for w in u.spellings]
    suffixes = [s for u in UNITS.values() for s in u.suffixes]
    assert len(set(words)) == len(words)
    assert len(set(suffixes)) == len(suffixes)
    assert all(w == w.lower() for w in words)
    # a spelling that is also a symbol would never be asked for
    assert not set(words) & UNITS.keys()
    assert all(u.si in UNITS and UNITS[u.si].factor == 1.0 for u in UNITS.values())


@pytest.mark.parametrize(
    ("text", "symbol"),
    [
        ("°", "deg"), ("Degrees", "deg"), (" kts ", "kn"), ("KNOTS", "kn"), ("m s-1", "m/s"),
        ("M/S", "m/s"), ("°/s", "deg/s"), ("n", "N"), ("kN", "kN"), ("KN", "kn"), ("µs", "us"),
        ("minutes", "min"), ("Percent", "%"), ("furlong", None), ("", None), ("1", None),
    ],
)  # fmt: skip
def test_spellings(text, symbol):
    assert spelled_unit(text) == symbol


@pytest.mark.parametrize(
    ("stem", "parted"),
    [
        ("r_radps", ("r", "rad/s")), ("r_rad_s", ("r", "rad/s")), ("psi_rad", ("psi", "rad")),
        ("u_m_s", ("u", "m/s")), ("t_ms", ("t", "ms")), ("speed_kts", ("speed", "kn")),
        ("rad", ("rad", None)), ("heading", ("heading", None)), ("r_deg_min", ("r", "deg/min")),
    ],
)  # fmt: skip
def test_suffixes(stem, parted):
    assert suffix_unit(stem) == parted


def test_factors_and_dimensions():
    assert unit_factor("kts", "m/s", "u") == 1852 / 3600
    assert unit_factor("°", "rad", "psi") == np.pi / 180
    assert unit_factor("rad", "deg", "lat") == pytest.approx(180 / np.pi)
    assert unit_factor("deg", "deg", "lat") == 1.0
    assert unit_factor("rpm", None, "n") == 1.0
    assert unit_dimension("knots") == "m/s"
    assert find_unit("1").si == "1"
    with pytest.raises(LogError, match=r"'u' has the unknown unit 'knot/s'.*Did you mean"):
        unit_factor("knot/s", "m/s", "u")
    # the nearest of its own dimension
    for channel, unit, near in (
        ("psi", "rad", "deg"),
        ("lat", "deg", "deg"),
        ("r", "rad/s", "degps"),
    ):
        with pytest.raises(LogError, match=rf"Did you mean '{near}'\?"):
            unit_factor("degs", unit, channel)
    with pytest.raises(LogError, match=r"'u' is in 'deg' but its channel is in 'm/s'"):
        unit_factor("deg", "m/s", "u")


NOW = 1_714_550_400.0


@pytest.mark.parametrize(
    ("times", "unit", "absolute"),
    [
        (np.arange(9) * 0.1, "s", False),
        (np.arange(9) * 100.0, "ms", False),
        (2e8 + np.arange(9) * 100.0, "ms", False),
        (NOW + np.arange(9) * 0.1, "s", True),
        # a position every ten seconds, as AIS has it: still seconds
        (NOW + np.arange(9) * 10.0, "s", True),
        ((NOW + np.arange(9)) * 1e3, "ms", True),
        ((NOW + np.arange(9)) * 1e6, "us", True),
        (np.arange(9) * 10**9 + np.int64(NOW * 1e9), "ns", True),
        (np.array([5.0]), "s", False),
        (np.array([0.0, 0.1, 1e18, 0.3, 0.4, 0.5, 0.6]), "s", False),
    ],
)
def test_the_unit_of_times_that_nobody_stated(times, unit, absolute):
    assert time_unit(times) == unit
    assert is_unix_time(float(np.median(times)) * UNITS[unit].factor) == absolute


def test_unix_times_in_seconds_from_their_size():
    seconds = np.array([NOW, np.nan, NOW + 0.5])
    for factor in (1.0, 1e3, 1e6, 1e9):
        np.testing.assert_allclose(unix_seconds(seconds * factor), seconds, rtol=1e-12)
    nothing = np.full(2, np.nan)
    np.testing.assert_array_equal(unix_seconds(nothing), nothing)


def test_letters_in_another_order_are_told_first():
    with pytest.raises(LogError, match=r"unknown unit 'rmp'\. Did you mean 'rpm'"):
        unit_factor("rmp", None, "n")


@pytest.mark.parametrize("unit", ["deg", "rad", "m", "s"])
def test_no_propeller_speed_is_an_angle(unit):
    with pytest.raises(LogError, match="which no propeller speed has"):
        unit_factor(unit, None, "n")


@pytest.mark.parametrize("unit", ["rpm", "rps", "rad/s", "kN", "%", "1"])
def test_what_stands_for_a_propeller_speed(unit):
    assert unit_factor(unit, None, "n") > 0


def test_percents_of_a_motor_stay_percents():
    assert unit_factor("%", None, "n") == unit_factor("percent", None, "n") == 1.0
    with pytest.raises(LogError, match="in '%' but its channel is in 'rad'"):
        unit_factor("%", "rad", "delta")
