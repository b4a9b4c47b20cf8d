"""Free runs: both compiled forms against a slow loop, RK4 against scipy, divergence."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from greybox.errors import DivergenceError, StructureError, UsageError
from greybox.model.catalogue import get_structure
from greybox.model.disturbances import TURNING
from greybox.model.run.kernels import MANY_RUNS
from greybox.model.run.simulation import FreeRun, positions, simulate, stationary_disturbance
from greybox.model.run.step import StepModel
from greybox.rotation import ned_to_body
from greybox.study.chapter6 import TRUE


def slow_run(structure, theta, x0, psi0, tau, d):
    step = StepModel(structure, heading="simulated").function
    x, psi, out = np.array(x0, float), psi0, [np.array(x0, float)]
    for k in range(len(tau)):
        *x, psi = np.array(step(x, psi, tau[k], d[k], [0, 0], theta, 1.0)).ravel()
        out.append(x)
    return np.array(out), psi


@pytest.mark.parametrize("runs", [2, MANY_RUNS + 3])
def test_both_forms_equal_a_slow_loop(thesis, true_theta, runs):
    rng = np.random.default_rng(0)
    samples = 60
    tau = rng.uniform(0, 10, (runs, samples, 3)) * [1, 1, 0.1]
    d = stationary_disturbance(rng, np.array([0.2, -0.2, 1, 1]), 0.03, samples, runs=runs)
    theta = true_theta * rng.uniform(0.9, 1.1, (runs, len(true_theta)))
    x0 = np.column_stack([rng.uniform(0.5, 1.5, runs), rng.uniform(0.5, 1, runs), np.zeros(runs)])
    run = simulate(thesis, theta, x0, tau, 1.0, d=d, psi0=0.3)
    for i in (0, runs - 1):
        want, psi = slow_run(thesis, theta[i], x0[i], 0.3, tau[i], d[i])
        np.testing.assert_allclose(run.x[i], want, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(run.psi[i, -1], psi, rtol=1e-10)


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
@pytest.mark.parametrize("name", ["psi", "psi0", "air"])
def test_any_argument_may_be_of_several_runs(thesis, true_theta, name, integrator):
    rng = np.random.default_rng(1)
    shape = {"psi": (3, 13), "psi0": (3,), "air": (3, 12, 2)}[name]
    several = rng.standard_normal(shape)
    ship = (thesis, true_theta, np.array([1.5, 0.1, 0.0]), rng.uniform(0, 1, (12, 3)), 1.0)
    together = simulate(*ship, integrator=integrator, **{name: several})
    assert together.x.shape == (3, 13, 3)
    for i in range(3):
        alone = simulate(*ship, integrator=integrator, **{name: several[i]})
        np.testing.assert_array_equal(together.x[i], alone.x[0])
        np.testing.assert_array_equal(together.psi[i], alone.psi[0])


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        ({"psi": (3, 12)}, r"'psi' has the shape \(3, 12\), where \(13,\), or \(R, 13\) for R"),
        ({"psi0": (2,), "air": (3, 12, 2)}, "'psi0' is for 2 runs and 'air' for 3"),
        ({"air": (12, 3)}, r"'air' has the shape \(12, 3\)"),
        ({"tau": (12, 2)}, r"'tau' has the shape \(12, 2\)"),
    ],
)
def test_shapes_that_do_not_fit_are_refused(thesis, true_theta, shapes, message):
    given = {"x0": (3,), "tau": (12, 3)} | shapes
    arrays = {n: np.zeros(s) for n, s in given.items()}
    with pytest.raises(UsageError, match=message):
        simulate(thesis, true_theta, sample_time=1.0, **arrays)


def test_length_need_not_fill_the_unrolled_block(thesis, true_theta):
    tau = np.ones((7, 3))
    short = simulate(thesis, true_theta, np.array([1.0, 0.5, 0.0]), tau, 1.0)
    long = simulate(thesis, true_theta, np.array([1.0, 0.5, 0.0]), np.ones((90, 3)), 1.0)
    np.testing.assert_array_equal(short.x[0], long.x[0, :8])


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
@pytest.mark.parametrize("runs", [1, 64])
def test_a_run_of_no_steps_is_its_start(thesis, true_theta, integrator, runs):
    x0 = np.tile([1.5, 1.2, 0.1], (runs, 1))
    for psi in (None, np.array([0.3])):
        run = simulate(
            thesis, true_theta, x0, np.zeros((0, 3)), 1.0, psi=psi, psi0=0.3, integrator=integrator
        )
        np.testing.assert_array_equal(run.x, x0[:, None])
        np.testing.assert_array_equal(run.psi, np.full((runs, 1), 0.3))


def test_rk4_follows_the_differential_equation(thesis, true_theta):
    step = StepModel(thesis).function
    tau = np.array([10.0, 8.0, 3.0])

    def rate(_, z):
        x = z[:3]
        return np.append(
            np.array(step(x, z[3], tau, np.zeros(4), [0, 0], true_theta, 1)).ravel() - x, x[2]
        )

    exact = solve_ivp(rate, (0, 20), [1.0, 0.5, 0.0, 0.1], rtol=1e-10, atol=1e-12).y[:, -1]
    ship = simulate(
        thesis, true_theta, np.array([1.0, 0.5, 0.0]), np.tile(tau, (20, 1)), 1.0,
        psi0=0.1, integrator="rk4",
    )  # fmt: skip
    np.testing.assert_allclose(ship.x[0, -1], exact[:3], atol=2e-4)
    euler = simulate(
        thesis, true_theta, np.array([1.0, 0.5, 0.0]), np.tile(tau, (20, 1)), 1.0, psi0=0.1
    )
    assert abs(euler.x[0, -1, 0] - exact[0]) > abs(ship.x[0, -1, 0] - exact[0])


def test_divergence_is_reported_with_its_place(thesis, true_theta):
    bad = true_theta.copy()
    bad[2] = 0.5
    run = simulate(
        thesis, bad, np.array([1.0, 0.5, 0.0]), np.ones((100, 3)), 1.0, bound=np.full(3, 50.0)
    )
    assert run.diverged[0] > 0
    with pytest.raises(DivergenceError, match=r"passed 50 at sample \d+ of 100"):
        run.require_bounded(thesis.states, "the run")


def test_process_noise_adds_to_the_next_state():
    structure = get_structure("siso")
    w = np.array([[0.5], [0.0], [-1.0]])
    run = simulate(
        structure, np.array([0.0, 0.0]), np.zeros(1), np.zeros((3, 1)), 1.0, process_noise=w
    )
    np.testing.assert_allclose(run.x[0, :, 0], [0, 0.5, 0, -1])


def test_stationary_disturbances_have_their_moments():
    rng = np.random.default_rng(4)
    d = stationary_disturbance(
        rng, np.array([0.2, 5.0]), np.array([0.1, 2.0]), 4000, runs=50, correlation_time=20.0
    )
    effective = 50 * 4000 / 40
    np.testing.assert_allclose(d.mean((0, 1)), [0.2, 5.0], atol=4 * 2.0 / np.sqrt(effective))
    np.testing.assert_allclose(d.std((0, 1)), [0.1, 2.0], rtol=0.05)
    lag = ((d[:, 20:, 1] - 5) * (d[:, :-20, 1] - 5)).mean() / 4.0
    assert abs(lag - np.exp(-1)) < 0.06


def test_positions_turn_with_the_heading():
    track = positions(np.array([[1.0, 0.0]] * 3), np.full(3, np.pi / 2), 2.0)
    np.testing.assert_allclose(track, [[0, 0], [0, 2], [0, 4]], atol=1e-12)


def test_a_map_cannot_be_integrated_by_rk4():
    with pytest.raises(StructureError, match="is a map"):
        StepModel(get_structure("siso"), "rk4")
    with pytest.raises(StructureError, match="no yaw rate"):
        StepModel(get_structure("surge"), heading="simulated")


def test_a_ship_moves_through_a_current_as_through_still_water() -> None:
    """Forces change the velocity through the water, which turns in body axes with the ship."""
    structure = get_structure("thesis").without("Wuu", "Wvv", "Wuv").with_terms(*TURNING)
    rate = np.array([TRUE.get(n, 0.0) for n in structure.parameters])
    psi0, dt, d = 0.3, 0.05, np.array([0.3, -0.2, 0.0, 0.0])
    theta = rate * dt
    theta[structure.index("X_r*vc")], theta[structure.index("Y_r*uc")] = dt, -dt
    tau = np.column_stack([np.full(4000, 3.0), np.full(4000, 0.4), np.full(4000, 6.0)])
    x0 = np.array([0.6, 0.05, 0.02])

    def run(current: np.ndarray, first: np.ndarray) -> FreeRun:
        return simulate(structure, theta, first, tau, dt, d=current, psi0=psi0, integrator="rk4")

    still = run(np.zeros(4), x0)
    water = np.array(ned_to_body(d[0], d[1], np.array(psi0)))
    moved = run(d, x0 + np.array([*water, 0.0]))
    forward, starboard = ned_to_body(d[0], d[1], moved.psi)
    through = moved.x - np.stack([forward, starboard, np.zeros_like(forward)], axis=-1)
    assert np.ptp(still.psi) > 3.0
    np.testing.assert_allclose(through, still.x, atol=2e-3)
