"""The manoeuvres do what their names say."""

from __future__ import annotations

import math

import numpy as np
import pytest

from foreign_ships import SILENT, manoeuvres, presets

PRESET = presets()["research-catamaran-29m"]


def sail(manoeuvre, lengths, **where):
    where = {"noise": SILENT, "start_heading": 1.0} | where
    return PRESET.sail(manoeuvre, lengths * PRESET.ship.time_scale, **where).true


@pytest.mark.parametrize("rudder", [10.0, -20.0])
def test_a_zigzag_turns_back_at_its_heading(rudder):
    true = sail(manoeuvres.zigzag(rudder, abs(rudder), approach=0), 30)
    order = true["n_port_command"] - true["n_starboard_command"]
    switches = np.flatnonzero(np.diff(np.sign(order)))
    deviation = np.degrees(true["psi"][switches] - 1.0)
    assert len(switches) >= 3
    expected = rudder * (-1.0) ** np.arange(len(switches))
    np.testing.assert_allclose(deviation, expected, atol=1.5)


def test_a_turning_circle_ends_on_a_straight_course():
    true = sail(manoeuvres.turning_circle(0.8, lengths=10), 40)
    assert true["psi"].max() - 1.0 > math.pi / 2
    assert abs(true["r"][-1]) < 0.05 * abs(true["r"]).max()


def test_a_spiral_goes_from_side_to_side_and_back():
    true = sail(manoeuvres.spiral(0.7, 2, hold=8, ahead=0.6), 70)
    order = true["n_port_command"] - true["n_starboard_command"]
    levels = order[np.flatnonzero(np.diff(order, append=np.inf))] / (1.6 * 420)
    np.testing.assert_allclose(levels[:8], [0.7, 0.35, 0, -0.35, -0.7, -0.35, 0, 0.35], atol=1e-6)


def test_speed_steps_keep_their_course():
    true = sail(manoeuvres.speed_steps(), 60)
    assert np.ptp(true["psi"]) < math.radians(10)
    assert np.ptp(true["u"]) > 0.4 * PRESET.ship.service_speed


def test_stopping_ends_at_rest_before_it_starts_again():
    true = sail(manoeuvres.acceleration_and_stopping(), 40, start_speed=0.0)
    slow = true["u"] < 0.05 * PRESET.ship.service_speed
    astern = true["n_port_command"] < 0
    assert astern.any()
    assert slow[np.flatnonzero(np.diff(astern.astype(int)) < 0)].all()
    assert true["u"].max() > 0.9 * PRESET.ship.service_speed


def test_parts_follow_one_another():
    joined = manoeuvres.in_turn((manoeuvres.steady(1.0), 5), (manoeuvres.steady(0.4), 5))
    order = sail(joined, 9)["n_port_command"] / PRESET.ship.service_revolutions
    assert order[0] == pytest.approx(1.0)
    assert order[-1] == pytest.approx(0.4)


@pytest.mark.parametrize("name", manoeuvres.kinds())
def test_every_kind_moves_the_ship(name):
    true = sail(manoeuvres.kinds()[name], 20, seed=1)
    assert np.ptp(true["u"]) > 0.02 * PRESET.ship.service_speed
