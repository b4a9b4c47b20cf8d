"""The whole ship as one CasADi function is the free run, sample by sample."""

import re
import warnings
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from virtual import virtual_log

from greybox.errors import StructureError, UsageError
from greybox.model.catalogue import get_structure
from greybox.model.model import ManoeuvringModel
from greybox.model.run.kernels import accumulate
from greybox.model.run.simulation import positions
from greybox.validation.fit import run_model
from greybox.vessel.force import generalised_force
from greybox.vessel.vessel import Actuation

WIND = (1.0, -0.5)


@pytest.fixture(scope="module")
def log():
    return virtual_log(3, 120, wind=0.0, current=(0.0, 0.0), noise=0.0, spread=0.0)


def a_model(ship, theta, *, actuation=None, current=(0.2, -0.1), names=None, **more):
    structure = get_structure("thesis")
    if actuation is not None:
        ship = replace(ship, actuation=actuation)
    if names is not None:
        theta = np.array([theta[structure.index(n)] for n in names])
        structure = replace(
            structure, terms=tuple(structure.terms[structure.index(n)] for n in names)
        )
    return ManoeuvringModel(
        structure, theta, np.zeros((theta.size,) * 2), 1.0, ship,
        disturbances={"current_north": (current[0], 0.01), "current_east": (current[1], 0.01)},
        **more,
    )  # fmt: skip


def rolled(model, log, **inputs):
    """Step through a log from the start of its free run."""
    step, names = model.step_function(), model.step_states
    commands = np.column_stack([log[c] for c in model.vessel.commands])
    start = dict(zip("uvr", log.states(("u", "v", "r"))[:5].mean(axis=0), strict=True))
    start["psi"] = log["psi"][0]
    at_rest = dict(zip(model.vessel.commands, commands[0], strict=True))
    forces = log.forces(model.structure.inputs)[0]
    at_rest |= dict(zip(model.structure.inputs, forces, strict=True))
    start |= {"x_n": 0.0, "y_n": 0.0}
    suffixes = re.compile("(_lagged|_limited|_before_[0-9]+)$")
    before = [suffixes.sub("", n) for n in names]
    states = [np.array([(start | at_rest)[n] for n in before])]
    for command in commands[:-1]:
        states.append(np.array(step(x=states[-1], command=command, **inputs)["x_next"]).ravel())
    return np.array(states)


LATE = [
    None,
    Actuation(lag=3.0),
    Actuation(lag=3.0, lag_held="mean"),
    Actuation(lag=2.5, lag_on="speed", lag_held="end"),
    Actuation(lag=2.5, lag_on="command", delay=1.3),
    Actuation(lag=2.5, lag_on="angle", delay=1.3, delay_on="speed"),
    Actuation(delay=2.0),
    Actuation(delay=0.7, delay_on="angle"),
    Actuation(delay=0.4),
    Actuation(lag=2.5, lag_on="alpha1", lag_held="mean"),
    Actuation(delay=1.3, delay_on="alpha2"),
    Actuation(rate_limit=0.01, rate_on="alpha1"),
    Actuation(lag=3.0, lag_on="n", delay=0.7, delay_on="n", rate_limit=0.2, rate_on="n"),
    Actuation(lag=3.0, lag_on="force", delay=2.0, rate_limit=0.01, rate_on="alpha2"),
]


@pytest.mark.parametrize("late", LATE, ids=lambda a: "prompt" if a is None else a.sentence)
@pytest.mark.parametrize("integrator", ["euler", "rk4"])
def test_steps_are_the_free_run(ship, true_theta, log, late, integrator):
    model = a_model(ship, true_theta, actuation=late, integrator=integrator)
    own = replace(log, vessel=model.vessel)
    # still air, felt by the ship as she moves, as in the step
    calm = {k: v for k, v in own.channels.items() if k not in ("u_q", "v_q")}
    run = run_model(model, replace(own, channels=calm), heading="simulated")
    found = rolled(model, own)
    np.testing.assert_allclose(found[:, :3], run.x, atol=1e-12)
    np.testing.assert_allclose(found[:, 3], run.psi, atol=1e-12)
    np.testing.assert_allclose(found[:, 4:6], positions(run.x, run.psi, 1.0), atol=1e-9)


def test_wind_is_an_input_where_there_are_wind_terms(ship, true_theta, log):
    model = a_model(ship, true_theta)
    known = replace(
        model,
        disturbances=dict(model.disturbances)
        | {"wind_north": (WIND[0], 0.1), "wind_east": (WIND[1], 0.1)},
    )
    assert model.step_function().name_in() == ["x", "command", "wind"]
    assert known.step_function().name_in() == ["x", "command"]
    np.testing.assert_allclose(rolled(model, log, wind=WIND), rolled(known, log), atol=1e-12)
    few = [n for n in model.names if not n.startswith("W")]
    assert a_model(ship, true_theta, names=few).step_function().name_in() == ["x", "command"]


@pytest.mark.parametrize("lag_on", ["force", "command", "speed", "angle", "n"])
def test_rate_is_the_step_over_the_sample_time(ship, true_theta, lag_on):
    model = a_model(ship, true_theta)
    x, command = [1.4, 0.3, 0.02, 0.7, 5.0, -3.0], [15.0, 0.8, 0.9]
    rate = model.rhs_function()(x=x, command=command, wind=WIND)["x_dot"]
    step = model.step_function()(x=x, command=command, wind=WIND)["x_next"]
    np.testing.assert_allclose(np.array(x) + np.array(rate).ravel(), np.array(step).ravel())

    late = a_model(ship, true_theta, actuation=Actuation(lag=2.0, lag_on=lag_on))
    memory = len(late.step_states) - 6
    rate = np.array(late.rhs_function()(x=[*x, *[0.5] * memory], command=command)["x_dot"])
    goal = {
        "force": np.array(
            [*generalised_force(ship, dict(zip(ship.commands, command, strict=True))).values()]
        ),
        "command": np.array(command),
        "speed": np.array(command[:1]),
        "angle": np.array(command[1:]),
        "n": np.array(command[:1]),
    }[lag_on]
    np.testing.assert_allclose(rate[6:].ravel(), (goal - 0.5) / 2.0)


def test_what_has_no_step_is_refused(ship, true_theta):
    surge = get_structure("surge")
    model = ManoeuvringModel(surge, np.zeros(4), np.zeros((4, 4)), 1.0, ship)
    with pytest.raises(StructureError, match=r"has the states u, a ship .* needs u, v, r"):
        model.step_function()
    late = a_model(ship, true_theta, actuation=Actuation(delay=1.5))
    with pytest.raises(UsageError, match=r"act 1\.5 s late, .*: use step_function"):
        late.rhs_function()
    limited = a_model(ship, true_theta, actuation=Actuation(rate_limit=0.1, rate_on="alpha1"))
    with pytest.raises(UsageError, match=r"the rate of alpha1 .* no continuous-time form: use"):
        limited.rhs_function()


def test_function_takes_symbols_and_is_differentiable(ship, true_theta):
    model = a_model(ship, true_theta)
    step = model.step_function()
    x, command = ca.MX.sym("x", 6), ca.MX.sym("command", 3)
    moved = step(x=x, command=command)["x_next"]
    slope = ca.Function("slope", [x, command], [ca.jacobian(moved, command)])
    at = ([1.4, 0.3, 0.02, 0.7, 0.0, 0.0], [15.0, 0.8, 0.9])
    exact = np.array(slope(*at))
    for k in range(3):
        ahead, back = np.array(at[1]), np.array(at[1])
        ahead[k] += 1e-5
        back[k] -= 1e-5
        pair = [np.array(step(x=at[0], command=c)["x_next"]).ravel() for c in (ahead, back)]
        np.testing.assert_allclose(exact[:, k], (pair[0] - pair[1]) / 2e-5, atol=1e-8)
    again = ca.Function.deserialize(step.serialize())
    np.testing.assert_array_equal(np.array(again(*at, [0, 0])), np.array(step(*at, [0, 0])))


def test_step_drops_into_do_mpc(ship, true_theta):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what it lacks itself
        do_mpc = pytest.importorskip("do_mpc")
    identified = a_model(ship, true_theta)
    model = do_mpc.model.Model("discrete")
    x = model.set_variable("_x", "x", (6, 1))
    command = model.set_variable("_u", "command", (3, 1))
    model.set_rhs("x", identified.step_function()(x, command, [0, 0]))
    model.setup()
    mpc = do_mpc.controller.MPC(model)
    quiet = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": 0}
    mpc.set_param(n_horizon=8, t_step=1.0, store_full_solution=False, nlpsol_opts=quiet)
    wanted = (x[0] - 2.0) ** 2
    mpc.set_objective(mterm=wanted, lterm=wanted)
    mpc.set_rterm(command=1e-4)
    limits = [identified.vessel.limits[c] for c in identified.vessel.commands]
    mpc.bounds["lower", "_u", "command"] = np.array([b.lower for b in limits])
    mpc.bounds["upper", "_u", "command"] = np.array([b.upper for b in limits])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mpc.setup()
        mpc.x0 = np.array([1.5, 1.2, 0.0, 0.0, 0.0, 0.0])
        mpc.u0 = np.array([12.0, 0.8, 0.8])
        mpc.set_initial_guess()
        first = mpc.make_step(mpc.x0).ravel()
    assert mpc.solver_stats["success"]
    assert all(b.lower - 1e-6 <= c <= b.upper + 1e-6 for b, c in zip(limits, first, strict=True))


def test_step_drops_into_rockit(ship, true_theta):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what it needs itself
        rockit = pytest.importorskip("rockit")
        identified = a_model(ship, true_theta)
        ocp = rockit.Ocp(T=8.0)
        x, command = ocp.state(6), ocp.control(3)
        ocp.set_next(x, identified.step_function()(x, command, [0, 0]))
        start = np.array([1.5, 1.2, 0.0, 0.0, 0.0, 0.0])
        ocp.subject_to(ocp.at_t0(x) == start)
        limits = [identified.vessel.limits[c] for c in identified.vessel.commands]
        for k, b in enumerate(limits):
            ocp.subject_to(b.lower <= (command[k] <= b.upper))
        ocp.set_initial(x, start)
        ocp.set_initial(command, [12.0, 0.8, 0.8])
        ocp.add_objective(ocp.sum((x[0] - 2.0) ** 2 + 1e-6 * ca.sumsqr(command)))
        ocp.solver("ipopt", {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"})
        ocp.method(rockit.MultipleShooting(N=8))
        found = ocp.solve()
        _, states = found.sample(x, grid="control")
        _, commands = found.sample(command, grid="control")
    moved = identified.step_function()(x=states[0], command=commands[0])["x_next"]
    np.testing.assert_allclose(states[1], np.array(moved).ravel(), atol=1e-6)


@pytest.mark.parametrize("count", [1, 2, 10, 11, 97, 120, 1000])
def test_accumulated_steps_are_those_of_a_loop(count):
    x, w = ca.SX.sym("x", 2), ca.SX.sym("w")
    step = ca.Function("step", [x, w], [ca.vertcat(0.9 * x[0] + w, ca.sin(x[0]) + x[1]), x[0] * w])
    rng = np.random.default_rng(count)
    given = rng.standard_normal(count)
    states, seen = accumulate(step, count)(np.ones(2), given[None])
    now = np.ones(2)
    for k in range(count):
        after, out = step(now, given[k])
        now = np.array(after).ravel()
        np.testing.assert_allclose(np.array(states)[:, k], now, rtol=1e-13)
        assert float(seen[k]) == pytest.approx(float(out), rel=1e-13)
