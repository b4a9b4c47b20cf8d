"""Velocity through the air: signs by hand, round trips, lever arm, height."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.errors import LogError
from greybox.trial.wind import (
    direction_from,
    move_anemometer,
    relative_wind,
    true_wind,
    wind_at_height,
)

NORTH, EAST, SOUTH, WEST = np.radians([0.0, 90.0, 180.0, 270.0])
STILL = np.zeros(1)


def one(value):
    return np.array([float(value)])


@pytest.mark.parametrize(
    ("from_bow", "u_q", "v_q"),
    [(0, 4, 0), (90, 0, 4), (180, -4, 0), (270, 0, -4), (-30, 4 * np.cos(np.pi / 6), -2)],
)
def test_apparent_wind_from_ahead_is_forward_and_from_starboard_is_starboard(from_bow, u_q, v_q):
    got = relative_wind(one(4), np.radians(one(from_bow)))
    np.testing.assert_allclose(np.ravel(got), [u_q, v_q], atol=1e-12)


def through_the_air(speed, origin, psi, u, v):
    """(5.3) by complex numbers, north + i east: the ship's velocity less the wind's."""
    bow = np.exp(1j * psi)
    air = (u + 1j * v) - -speed * np.exp(1j * origin) / bow
    return air.real, air.imag


@pytest.mark.parametrize(
    ("wind_from", "heading", "u_q", "v_q"),
    [
        (NORTH, NORTH, 6, 0),  # head wind
        (SOUTH, NORTH, -6, 0),  # from astern
        (EAST, NORTH, 0, 6),  # from starboard
        (WEST, NORTH, 0, -6),  # from port
        (NORTH, EAST, 0, -6),  # heading east, north is to port
        (NORTH, WEST, 0, 6),
        (EAST, EAST, 6, 0),
    ],
)
def test_true_wind_on_a_ship_at_rest(wind_from, heading, u_q, v_q):
    speed, origin = direction_from(*true_wind(one(u_q), one(v_q), one(heading), STILL, STILL))
    np.testing.assert_allclose(speed, 6)
    np.testing.assert_allclose(np.exp(1j * origin), np.exp(1j * one(wind_from)), atol=1e-12)


def test_true_wind_of_a_moving_ship():
    rng = np.random.default_rng(2)
    speed, origin = rng.uniform(0.1, 20, 200), rng.uniform(0, 2 * np.pi, 200)
    psi, u, v = rng.uniform(-20, 20, 200), rng.normal(3, 4, 200), rng.normal(0, 1, 200)
    north, east = true_wind(*through_the_air(speed, origin, psi, u, v), psi, u, v)
    np.testing.assert_allclose(north, -speed * np.cos(origin), atol=1e-12)
    np.testing.assert_allclose(east, -speed * np.sin(origin), atol=1e-12)
    again, origin_again = direction_from(north, east)
    np.testing.assert_allclose(again, speed)
    np.testing.assert_allclose(origin_again, origin)


def test_wind_of_the_virtual_ship(noisy_log):
    """The body-frame wind of the simulated thesis ship, 1 m/s towards north and east."""
    psi, u, v = noisy_log["psi"], noisy_log["u"], noisy_log["v"]
    wind = np.array(true_wind(noisy_log["u_q"], noisy_log["v_q"], psi, u, v))
    np.testing.assert_allclose(wind.mean(axis=1), 1.0, atol=0.02)


def test_lever_arm_against_finite_differences_of_the_anemometer():
    h = 1e-4
    t = np.arange(0, 10, h)
    psi = 0.8 * np.sin(0.5 * t)
    north, east = 3 * t + np.sin(0.4 * t), 2 * np.cos(0.3 * t)
    x, y = 4.0, -1.5
    mast_north = north + np.cos(psi) * x - np.sin(psi) * y
    mast_east = east + np.sin(psi) * x + np.cos(psi) * y
    air = 5.0, -2.0

    def through_air(n, e):
        n, e = np.gradient(n, h) - air[0], np.gradient(e, h) - air[1]
        return np.cos(psi) * n + np.sin(psi) * e, -np.sin(psi) * n + np.cos(psi) * e

    moved = move_anemometer(*through_air(mast_north, mast_east), np.gradient(psi, h), x, y)
    for got, expected in zip(moved, through_air(north, east), strict=True):
        np.testing.assert_allclose(got[1:-1], expected[1:-1], atol=1e-6)


def test_an_anemometer_on_the_bow_of_a_ship_that_turns_in_calm_air():
    # turning to starboard the bow moves to starboard: it feels wind from starboard
    r, x = one(0.1), 20.0
    got = move_anemometer(one(0), r * x, r, x, 0.0)
    np.testing.assert_allclose(np.ravel(got), [0, 0], atol=1e-15)


def test_the_profile_scales_the_true_wind_only():
    psi, u, v = one(0.6), one(4), one(-0.5)
    low = through_the_air(one(7), one(2.0), psi, u, v)
    k = (10 / 3) ** (1 / 7)
    np.testing.assert_allclose(
        wind_at_height(*low, u, v, 3.0, 10.0), through_the_air(one(7 * k), one(2.0), psi, u, v)
    )
    # still air has no profile, however fast the ship
    np.testing.assert_allclose(wind_at_height(u, v, u, v, 30.0, 10.0), [u, v])
    # there and back
    there = wind_at_height(*low, u, v, 7.0, 12.0)
    np.testing.assert_allclose(wind_at_height(*there, u, v, 12.0, 7.0), low)


@pytest.mark.parametrize(
    ("height", "reference", "message"),
    [
        (0.0, 10.0, "an anemometer at 0 m and a reference height of 10 m: both must be above"),
        (5.0, -1.0, "reference height of -1 m"),
        (np.nan, 10.0, "an anemometer at nan m"),
    ],
)
def test_impossible_heights(height, reference, message):
    with pytest.raises(LogError, match=message):
        wind_at_height(one(1), one(0), one(1), one(0), height, reference)


def test_true_wind_of_a_measured_turn(data_folder):
    """The pond's own file gives both winds: an oracle from outside."""
    import pandas as pd

    table = pd.read_csv(data_folder / "esso_osaka/turn_14-Oct-2020_14_08_51.csv")
    relative = table["wind_velo_relative_mid [m/s]"], table["wind_dir_relative_mid [rad]"]
    u_q, v_q = relative_wind(*(c.to_numpy() for c in relative))
    motion = (table[c].to_numpy() for c in ("psi_hat [rad]", "u_velo [m/s]", "vm_velo [m/s]"))
    speed, origin = direction_from(*true_wind(u_q, v_q, *motion))
    np.testing.assert_allclose(speed, table["wind_velo_true [m/s]"], atol=0.005)
    off = np.exp(1j * (origin - table["wind_dir_true [rad]"].to_numpy()))
    assert np.abs(np.angle(off)).max() < 0.01
