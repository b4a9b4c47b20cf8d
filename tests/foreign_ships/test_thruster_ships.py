"""The catamarans and the azimuth vessels: balance, energy, closed forms, symmetry, mechanisms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.linalg import expm
from scipy.optimize import root

from foreign_ships import SILENT, manoeuvres, simulate
from foreign_ships import azimuth_vessel as azimuth
from foreign_ships import catamaran as twin

CATAMARANS = (twin.survey_craft, twin.research_catamaran)
AZIMUTHS = (azimuth.research_vessel, azimuth.workboat, azimuth.ferry)


def sail(ship, commands, lengths, **where):
    where = {"start_heading": 0.0, "noise": SILENT} | where
    return simulate(ship, commands, round(lengths * ship.time_scale, 1), 0.1, **where).true


@pytest.mark.parametrize("make", CATAMARANS + AZIMUTHS)
def test_a_steady_turn_balances_every_force(make):
    """A root search from rest motion finds the turn in which the simulation settles."""
    ship = make()
    values = ship.helm(0.8, 0.4)
    end = sail(ship, manoeuvres.steady(0.8, 0.4), 40)
    names = ["u_r", "v_r", "r"] + (["phi", "p"] if ship.rolls else [])
    guess = np.zeros(len(names))
    guess[0] = 0.5 * ship.service_speed
    scale = np.array([ship.service_speed, ship.service_speed, 1 / ship.time_scale, 1.0, 1.0])

    def rates(x):
        return ship.accelerations(x * scale[: x.size], values, (0.0, 0.0, 0.0))

    found = root(rates, guess / scale[: guess.size], tol=1e-12)
    assert found.success
    settled = [end[n][-1] for n in names]
    np.testing.assert_allclose(
        settled, found.x * scale[: guess.size], rtol=1e-3, atol=1e-4 * ship.service_speed
    )
    assert settled[1] < 0 < settled[2]  # to starboard, and the stern swings out


@pytest.mark.parametrize("make", CATAMARANS)
def test_surge_settles_where_two_propellers_carry_two_hulls(make):
    """Straight ahead the balance is a quadratic equation: w = u/U at a pace of n."""
    ship = make().without("asymmetry", "actuator_dynamics")
    pace, loss, linear = 0.7, ship.loss, ship.linear_drag
    # (pace^2 - loss pace w) / (1 - loss) = linear w + (1 - linear) w^2
    a, b, c = 1 - linear, linear + loss * pace / (1 - loss), -(pace**2) / (1 - loss)
    expected = (-b + np.sqrt(b * b - 4 * a * c)) / (2 * a) * ship.service_speed
    assert sail(ship, manoeuvres.steady(pace), 40)["u_r"][-1] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("make", AZIMUTHS)
def test_strips_sum_to_the_integral_of_cross_flow(make):
    ship = make()
    flat = ship.without("crossflow")
    v, r = 0.3, -0.05
    difference = np.subtract(ship.hull(1.0, v, r), flat.hull(1.0, v, r))

    def density(s):
        depth = ship.draught * (1.0 if s < 0.15 else 1 - 0.5 * ((s - 0.15) / 0.35) ** 2)
        w = v + s * ship.length * r
        drag = ship.cross_drag * (0.7 + 1.2 * abs(2 * s) ** 3)
        return -ship.rho / 2 * drag * depth * w * abs(w) * ship.length

    side = quad(density, -0.5, 0.5, limit=200)[0]
    moment = quad(lambda s: s * ship.length * density(s), -0.5, 0.5, limit=200)[0]
    np.testing.assert_allclose(difference[1:], [side, moment], rtol=0.03)


@pytest.mark.parametrize("make", AZIMUTHS)
def test_without_thrust_energy_only_falls(make):
    ship = make()
    rng = np.random.default_rng(1)
    surge, matrix, _, _ = ship.masses
    stiffness = ship.mass * 9.81 * ship.metacentric
    stopped = [0.0] * len(ship.actuators)
    # without the forces of heel and of the uneven hull, which the passing water pays for
    ship = replace(ship.without("asymmetry"), heel_push=0.0)
    for _ in range(200):
        u, v, r, phi, p = rng.normal(size=5) * [3.0, 0.5, 0.1, 0.1, 0.1]
        rates = ship.accelerations((u, v, r, phi, p), stopped, (0.0, 0.0, 0.0))
        velocity = np.array([v, p, r])
        acceleration = np.array([rates[1], rates[4], rates[2]])
        power = surge * u * rates[0] + velocity @ np.array(matrix) @ acceleration
        power += stiffness * np.sin(phi) * p
        hull = ship.hull(u, v, r)
        lever = -ship.z_A * hull[1] * p
        drag = hull[0] * u + hull[1] * v + hull[2] * r + lever
        critical = np.sqrt(stiffness * matrix[1][1])
        roll = -2 * ship.roll_damping * critical * p**2 * (1 + 2 * abs(p))
        assert power == pytest.approx(drag + roll, rel=1e-9)  # Coriolis forces do no work


@pytest.mark.parametrize("make", CATAMARANS)
def test_without_thrust_the_catamaran_comes_to_rest(make):
    ship = make().without("asymmetry")
    surge, sway, yaw, coupling = ship.masses
    end = sail(ship, manoeuvres.steady(0.0), 40)
    u, v, r = end["u_r"], end["v_r"], end["r"]
    energy = surge * u**2 + sway * v**2 + yaw * r**2 + 2 * coupling * v * r
    assert energy[-1] < 0.05 * energy[0]
    later = energy[round(5 * ship.time_scale / 0.1) :]  # the propellers have run out
    assert (np.diff(later) <= 0).all()


@pytest.mark.parametrize("make", CATAMARANS + AZIMUTHS)
def test_with_everything_off_the_ship_is_linear(make):
    """A step of all propellers' speeds, azimuths ahead, gives the matrix exponential."""
    ship = make().only()
    m, L, U = ship.mass, ship.length, ship.service_speed
    spin = m * (ship.gyradius * L) ** 2
    surge, sway = m * (1 + ship.added[0]), m * (1 + ship.added[1])
    yaw = spin * (1 + ship.added[2])
    drag = ship.resistance * m * 9.81
    A = np.zeros((4, 4))
    A[0, 0] = -drag / U / surge
    A[1, 1] = -ship.sway_damping * U / L * m / sway
    A[1, 2] = m * U * ship.sway_by_yaw / sway
    A[2, 1] = m * U * ship.yaw_by_sway / yaw
    A[2, 2] = -ship.yaw_damping * spin * U / L / yaw
    values, force = [], np.zeros(3)
    n0 = ship.service_revolutions
    if make in CATAMARANS:
        _, y = ship.propeller
        values = [0.9 * n0, 0.6 * n0]
        force += drag / 2 * np.array([1.5, 0.0, 0.3 * y])
    else:
        for i, t in enumerate(ship.units):
            turns = 0.9 - 0.1 * i * i
            values += [turns * n0] if t.tunnel else [turns * n0, 0.0]
            if t.tunnel:
                full = drag / (1 - ship.loss) * t.share * turns
                force += full * np.array([0.0, 1.0, t.x])
            else:
                force += drag * t.share * turns * np.array([1.0, 0.0, -t.y])
    A[:3, 3] = force / [surge, sway, yaw]
    time = round(10 * ship.time_scale, 1)
    expected = expm(A * time) @ [U, 0.0, 0.0, 1.0]
    end = simulate(
        ship, manoeuvres.table([0.0], [values]), time, 0.1, start_heading=0.0, noise=SILENT
    ).true
    found = [end[n][-1] for n in ("u_r", "v_r", "r")]
    np.testing.assert_allclose(found, expected[:3], rtol=1e-4)


@pytest.mark.parametrize("make", CATAMARANS + AZIMUTHS)
def test_port_mirrors_starboard_without_asymmetry(make):
    ship = make().without("asymmetry")
    a, b = (sail(ship, manoeuvres.steady(0.9, t, t / 2), 10) for t in (0.7, -0.7))
    for name, sign in {"u": 1, "v": -1, "r": -1, "psi": -1, "x_n": 1, "y_n": -1}.items():
        np.testing.assert_allclose(a[name], sign * b[name], atol=1e-9 * ship.length)
    assert a["r"][-1] > 0


@pytest.mark.parametrize(
    ("make", "flag"),
    [(twin.survey_craft, f) for f in twin.Mechanisms.__dataclass_fields__]
    + [(azimuth.workboat, f) for f in azimuth.Mechanisms.__dataclass_fields__],
)
def test_every_mechanism_changes_the_motion(make, flag):
    ship = make()
    drive = manoeuvres.random_steps(side=0.8)
    a, b = (sail(s, drive, 5) for s in (ship, ship.without(flag)))
    assert max(np.abs(a[n] - b[n]).max() / np.ptp(a[n]) for n in "uvr") > 1e-3


def test_a_turn_heels_the_ship_outwards():
    """The hull's side force lies below the centre of gravity."""
    for turn in (1.0, -1.0):
        phi = sail(azimuth.research_vessel(), manoeuvres.steady(1.0, turn), 20)["phi"]
        assert -np.radians(12) < turn * phi[-1] < -np.radians(0.5)


def test_a_tunnel_pushes_the_bow_and_fails_with_speed():
    ship = azimuth.research_vessel()
    command = [0.0, 0.0, 0.0, 0.0, ship.service_revolutions]
    at_rest = ship.thrusters((0.0, 0.0, 0.0), command)
    at_speed = ship.thrusters((ship.service_speed, 0.0, 0.0), command)
    assert at_rest[1] > 0
    assert at_rest[3] > 0  # to starboard
    assert at_speed[1] < 0.4 * at_rest[1]
