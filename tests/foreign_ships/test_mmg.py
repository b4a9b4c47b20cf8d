"""The MMG ships against shipmmg, against the paper's figures and against closed forms."""

from __future__ import annotations

import importlib.util
import json
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from foreign_ships import manoeuvres, mmg
from foreign_ships.ship import SILENT
from foreign_ships.simulate import simulate

FOLDER = Path(__file__).parent / "reference"
REFERENCE = json.loads((FOLDER / "shipmmg_kvlcc2.json").read_text())


@pytest.mark.parametrize("name", REFERENCE)
def test_agrees_with_shipmmg(name):
    """To a thousandth with the centre of gravity midship; aboard, shipmmg's drift angle differs."""
    kind, degrees, place = name.split()
    run = {column: np.array(x) for column, x in REFERENCE[name].items()}
    ship = mmg.kvlcc2(
        wake="exponential",
        x_P=-0.65,
        x_G=0.0 if place == "midship" else 0.25,
        service_speed=1.179,
    ).without("propeller_walk", "actuator_dynamics")
    if kind == "turn":
        commands = manoeuvres.table([0.0], [(11.8, math.radians(float(degrees)))])
    else:
        times = np.arange(0, 90, 0.05)
        rudder = np.interp(times + 0.025, run["t"], run["rudder"])
        commands = manoeuvres.table(times, [(11.8, x) for x in rudder])
    trial = simulate(
        ship, commands, run["t"][-1], 0.05, start_speed=1.179, start_heading=0.0, noise=SILENT
    )
    at = np.round(run["t"] / 0.05).astype(int)
    tolerance = (
        {"turn": 1e-4, "zigzag": 2e-3} if place == "midship" else {"turn": 4e-3, "zigzag": 0.03}
    )
    for column in run.keys() - {"t", "rudder"}:
        error = trial.true[column][at] - run[column]
        assert np.abs(error).max() <= tolerance[kind] * np.abs(run[column]).max(), column


@pytest.mark.filterwarnings("ignore")  # shipmmg is as old as the packages that it asks for
@pytest.mark.skipif(importlib.util.find_spec("shipmmg") is None, reason="shipmmg is not installed")
def test_the_reference_is_that_of_shipmmg():
    pytest.importorskip("scipy.misc", exc_type=ImportError)
    spec = importlib.util.spec_from_file_location("make_shipmmg", FOLDER / "make_shipmmg.py")
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    for name, run in made.trajectories().items():
        for column, values in run.items():
            np.testing.assert_allclose(REFERENCE[name][column], values, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("turn", [1.0, -1.0])
def test_turning_circle_of_the_tanker_is_that_of_the_paper(turn):
    """Advance and tactical diameter near 3.1 to 3.3 lengths, speed loss to four tenths."""
    ship = mmg.kvlcc2()
    trial = simulate(ship, manoeuvres.turning_circle(turn, approach=0), 150, 0.1, start_heading=0.0)
    psi, u, v = (trial.true[n] for n in ("psi", "u", "v"))
    assert math.copysign(1, psi[-1]) == turn  # starboard rudder turns to starboard
    quarter, half = (np.argmax(abs(psi) > a) for a in (math.pi / 2, math.pi))
    assert 2.8 < trial.true["x_n"][quarter] / ship.length < 3.5
    assert 2.8 < turn * trial.true["y_n"][half] / ship.length < 3.5
    assert 0.3 < math.hypot(u[-1], v[-1]) / ship.service_speed < 0.5
    assert turn * v[-1] < 0  # midship drifts outwards


def test_zigzag_overshoots_as_a_tanker_does():
    ship = mmg.kvlcc2()
    psi = np.degrees(
        simulate(ship, manoeuvres.zigzag(10, 10), 150, 0.1, start_heading=0.0).true["psi"]
    )
    first = psi[: np.argmax(psi < 0)].max() - 10
    second = -10 - psi.min()
    assert 4 < first < 10
    assert first < second < 20


@pytest.mark.parametrize("make", [mmg.kvlcc2, mmg.training_ship, mmg.esso_osaka])
def test_service_speed_is_where_thrust_balances_resistance(make):
    """A brute-force search over speeds finds the speed that the simulation keeps."""
    ship = make().without("propeller_walk")
    speeds = np.linspace(0.2, 1.6, 1401) * ship.service_speed
    n = ship.service_revolutions
    balance = [ship.forces((u, 0.0, 0.0), (n, 0.0))[0] for u in speeds]
    root = speeds[np.argmin(np.abs(balance))]
    assert root == pytest.approx(ship.service_speed, rel=2e-3)
    trial = simulate(
        ship,
        manoeuvres.steady(),
        100 * ship.time_scale,
        ship.time_scale / 10,
        step=ship.time_scale / 10,
        start_speed=0.5 * root,
        noise=SILENT,
    )
    assert trial.true["u_r"][-1] == pytest.approx(root, rel=2e-3)


@pytest.mark.parametrize("make", [mmg.kvlcc2, mmg.training_ship, mmg.esso_osaka])
def test_with_the_propeller_stopped_the_ship_slows_and_turns_no_more(make):
    ship = make()
    dt = ship.time_scale / 10
    trial = simulate(ship, manoeuvres.steady(0.0), 60 * ship.time_scale, dt, step=dt, noise=SILENT)
    u, v = trial.true["u_r"], trial.true["v_r"]
    assert (np.diff(np.hypot(u, v)[10:]) < 0).all()
    assert u[-1] < 0.4 * ship.service_speed
    assert abs(v[-1]) < 0.3 * u[-1]


def test_with_everything_off_the_ship_is_linear():
    """The response to a step of rudder and propeller is that of the matrix exponential."""
    ship = mmg.kvlcc2().only()
    n0, delta = ship.service_revolutions, 0.3
    U, L, unit = ship.service_speed, ship.length, 500 * 7.0 * 0.46
    hull = ship.hull
    mass, added = 3270.0, unit * L
    surge, sway = mass + 0.022 * added, mass + 0.223 * added
    yaw = mass * (L / 4) ** 2 + 0.011 * added * L**2
    damping = U * unit * np.array([[hull.Y_v, hull.Y_r * L], [hull.N_v * L, hull.N_r * L**2]])
    normal = 500 * ship.A_R * ship.f_alpha * (0.6 * 1.09 * U) ** 2 * delta
    force = -normal * np.array([1.312, (-0.5 - 0.312 * 0.464) * L])
    A = np.zeros((4, 4))
    A[:2, :2] = damping / np.array([[sway], [yaw]])
    A[:2, 2] = force / np.array([sway, yaw])
    # surge beside them: u' = -k (u - (0.9) U), since thrust and resistance balance at n0, U
    k = unit * ship.R_0 * U / surge
    A[3, 3] = -k
    expected = expm(A * 40.0) @ [0.0, 0.0, 1.0, 0.1 * U]
    trial = simulate(
        ship,
        manoeuvres.table([0.0], [(0.9 * n0, delta)]),
        40,
        0.1,
        noise=SILENT,
        start_heading=0.0,
    )
    assert trial.true["v"][-1] == pytest.approx(expected[0], rel=1e-6)
    assert trial.true["r"][-1] == pytest.approx(expected[1], rel=1e-6)
    assert trial.true["u_r"][-1] - 0.9 * U == pytest.approx(expected[3], rel=1e-6)


def test_port_mirrors_starboard_without_asymmetry():
    ship = mmg.kvlcc2().without("asymmetry", "propeller_walk")
    a, b = (
        simulate(ship, manoeuvres.turning_circle(t), 100, 0.1, start_heading=0.0, noise=SILENT).true
        for t in (1.0, -1.0)
    )
    for name, sign in {"u": 1, "v": -1, "r": -1, "psi": -1, "x_n": 1, "y_n": -1}.items():
        np.testing.assert_allclose(a[name], sign * b[name], atol=1e-9)


@pytest.mark.parametrize("flag", list(mmg.Mechanisms.__dataclass_fields__))
def test_every_mechanism_changes_the_motion(flag):
    with_it = mmg.kvlcc2()
    a, b = (
        simulate(s, manoeuvres.random_steps(), 40, 0.1, start_heading=0.0, noise=SILENT).true
        for s in (with_it, with_it.without(flag))
    )
    assert max(np.abs(a[n] - b[n]).max() / np.ptp(a[n]) for n in "uvr") > 1e-3
