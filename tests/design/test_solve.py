"""IPOPT climbs the criterion that the moments state, keeps the limits, and never returns less."""

from __future__ import annotations

import dataclasses

import casadi as ca
import numpy as np
import pytest
from scipy.sparse import csc_matrix

from experiment_design.constraints.limit_program import LimitProgram
from experiment_design.constraints.limits import Circle, TrialLimits
from experiment_design.criteria.covariance import Criterion
from experiment_design.excitation.rollout import Rollout
from experiment_design.excitation.schedule import make_schedule
from experiment_design.information.moments import MomentProgram
from experiment_design.information.sensitivities import SensitivityProgram
from experiment_design.optimise.search import assess, draw_two_level
from experiment_design.optimise.solve import Outcome, make_shooting, run_ipopt, solve_ipopt
from experiment_design.request.problem import Scenario, TrialProblem
from greybox.errors import UsageError
from greybox.model.catalogue import get_structure
from greybox.model.noise import NoiseLevels
from greybox.model.predictor import build_predictor
from greybox.vessel.vessel import Limits, Thruster, Vessel

REGIME = (("u", (1,)), ("v", (1,)), ("r", (1, -1)))
KEPT = TrialLimits({"u": 1, "v": 1}, {"u": 0.5, "v": 0.4})


def problem(
    ship, thesis, theta, *, predictor="basic", duration=80.0, hold=10.0, limits=KEPT,
    rates=(None, None), white=False, kind="D", current=0.0,
):  # fmt: skip
    vessel = dataclasses.replace(
        ship,
        thrusters=tuple(
            dataclasses.replace(
                t, speed_limits=Limits(10, 20, rates[0]), angle_limits=Limits(0.6, 1.1, rates[1])
            )
            for t in ship.thrusters
        ),
    )
    noise = NoiseLevels(
        thesis.states, np.full(3, 0.014), np.array([2e-3, 2e-3, 4e-4]), heading=0.002
    )
    columns = build_predictor(thesis, predictor, REGIME)
    schedule = make_schedule(vessel, duration, hold, 1.0)
    d = np.array([current, -current / 2, 0.0, 0.0])
    rollout = Rollout(vessel, thesis, theta, d, np.array([1.5, 1.2, 0.0, 0.0]), 1.0)
    information = MomentProgram(columns, theta, d, noise, 1.0, white=white)
    wanted = tuple(columns.parameter_columns)
    weights = np.linspace(-1, 1, len(wanted))
    criterion = Criterion(kind, wanted, np.abs(theta[list(range(len(wanted)))]), weights)
    program = LimitProgram(rollout, schedule, limits)
    return TrialProblem(schedule, (Scenario(rollout, information, program),), criterion)


@pytest.mark.parametrize("kind", ["D", "A", "c"])
@pytest.mark.parametrize("white", [True, False])
def test_objective_is_the_criterion(ship, thesis, true_theta, kind, white):
    p = problem(ship, thesis, true_theta, white=white, kind=kind)
    rng = np.random.default_rng(0)
    unit = rng.random((2, *p.shape))
    shooting = make_shooting(p, unit[0])
    assert shooting.exact is not white
    expected = p.evaluate(unit).value
    for u, value in zip(unit, expected, strict=True):
        assert shooting.value(u) == pytest.approx(value, rel=1e-8, abs=1e-8)


@pytest.mark.parametrize("white", [True, False])
def test_objective_with_ramps_cut_holds_nuisance_and_earlier_trials(
    ship, thesis, true_theta, white
):
    p = problem(
        ship, thesis, true_theta, duration=130.0, hold=20.0, rates=(2.0, 0.02), white=white,
        current=0.2,
    )  # fmt: skip
    # one parameter not wanted is nuisance
    wanted = p.criterion.wanted[1:]
    p = dataclasses.replace(p, criterion=Criterion("D", wanted, np.ones(14), np.ones(14)))
    rng = np.random.default_rng(1)
    unit = rng.random((2, *p.shape))
    if not white:
        motion = p.scenarios[0].rollout.run(p.commands(unit[:1]))
        p = p.with_known((p.moments(motion, 0),))
    value = make_shooting(p, unit[0]).value(unit[1])
    assert value == pytest.approx(p.evaluate(unit[1:]).value[0], abs=1e-8)


def _dense(matrix):
    s = matrix.sparsity()
    return csc_matrix((matrix.nonzeros(), s.row(), s.colind()), shape=matrix.shape).toarray()


@pytest.mark.parametrize(("kind", "exact"), [("D", False), ("D", True), ("A", False), ("c", True)])
def test_derivatives(ship, thesis, true_theta, kind, exact):
    limits = dataclasses.replace(
        KEPT, area=Circle(0, 0, 150), speed_cap=2.5, yaw_cap=0.1, end={"x_n": (0, 20)},
        energy=0.5, headings=3.0,
    )  # fmt: skip
    p = problem(
        ship, thesis, true_theta, duration=45.0, hold=10.0, rates=(2.0, 0.03), kind=kind,
        limits=limits,
    )  # fmt: skip
    rng = np.random.default_rng(2)
    unit = rng.random(p.shape)
    s = make_shooting(p, unit, exact)
    x, empty = s.begin(unit), ca.DM(0, 1)
    multipliers = rng.normal(size=s.rows)

    def first(x):
        f, slope = s.functions["grad_f"](x, empty)
        g, jac = s.functions["jac_g"](x, empty)
        return float(f), np.array(slope).ravel(), np.array(g).ravel(), _dense(jac)

    half = _dense(s.functions["hess_lag"](x, empty, 1.7, multipliers))
    hessian = half + np.triu(half, 1).T
    _, slope, _, jac = first(x)
    for _ in range(3):
        d = rng.normal(size=len(x))
        step = 1e-6
        up, down = first(x + step * d), first(x - step * d)
        assert slope @ d == pytest.approx((up[0] - down[0]) / (2 * step), rel=1e-3, abs=1e-3)
        np.testing.assert_allclose(
            jac @ d, (up[2] - down[2]) / (2 * step), atol=1e-6 * np.abs(jac @ d).max()
        )
        change = 1.7 * (up[1] - down[1]) + (up[3] - down[3]).T @ multipliers
        np.testing.assert_allclose(
            hessian @ d, change / (2 * step), atol=5e-3 * np.abs(hessian @ d).max()
        )


def surge_problem(kind="D", initial=False, duration=24.0):
    structure = get_structure("surge-Wuu")
    theta = np.array([{"Xu": -0.05, "Xuu": -0.05, "Xmu": 0.1}[n] for n in structure.parameters])
    engine = Thruster("fixed", 0.0, 0.0, "n", speed_limits=Limits(0.1, 2.25))
    vessel = Vessel("surge", 10.0, (engine,))
    noise = NoiseLevels(structure.states, np.array([0.014]), np.zeros(1))
    schedule = make_schedule(vessel, duration, 2.0, 1.0)
    d = np.zeros(len(structure.disturbances))
    rollout = Rollout(vessel, structure, theta, d, np.array([0.5, 0.0]), 1.0)
    columns = build_predictor(structure, "basic", (("u", (1,)),))
    program = SensitivityProgram(columns, theta, d, noise, 1.0, initial=initial)
    criterion = Criterion(kind, program.wanted, np.abs(theta), np.array([1.0, -2.0, 0.5]))
    limits = LimitProgram(rollout, schedule, TrialLimits(speed_cap=1.5))
    return TrialProblem(schedule, (Scenario(rollout, program, limits),), criterion)


@pytest.mark.parametrize("kind", ["D", "A", "c"])
@pytest.mark.parametrize("initial", [False, True])
def test_output_error_objective_and_derivatives(kind, initial):
    p = surge_problem(kind, initial)
    rng = np.random.default_rng(0)
    unit = rng.random((2, *p.shape))
    s = make_shooting(p, unit[0])
    assert s.value(unit[1]) == pytest.approx(p.evaluate(unit[1:]).value[0], abs=1e-8)
    x, empty, multipliers = s.begin(unit[1]), ca.DM(0, 1), rng.normal(size=s.rows)
    half = _dense(s.functions["hess_lag"](x, empty, 1.0, multipliers))
    hessian = half + np.triu(half, 1).T

    def slope(x):
        _, f = s.functions["grad_f"](x, empty)
        _, jac = s.functions["jac_g"](x, empty)
        return np.array(f).ravel() + _dense(jac).T @ multipliers

    d = rng.normal(size=len(x))
    change = (slope(x + 1e-6 * d) - slope(x - 1e-6 * d)) / 2e-6
    np.testing.assert_allclose(hessian @ d, change, atol=1e-4 * np.abs(change).max())


def test_output_error_polish():
    p = surge_problem()
    unit = np.random.default_rng(1).random(p.shape)
    found = solve_ipopt(p, unit, barrier=0.1)
    assert found.outcome is Outcome.CONVERGED
    assert found.feasible
    # no single level can be moved for the better
    moved = np.repeat(found.unit[None], 2 * unit.size, axis=0)
    for i in range(unit.size):
        moved[2 * i, i], moved[2 * i + 1, i] = 0.0, 1.0
    others = p.evaluate(moved)
    kept = others.feasible(1e-4)
    assert others.value[kept].max() <= found.value + 1e-6
    assert found.value > assess(p, unit[None])[0].value + 0.5


def test_output_error_of_many_unknowns_is_refused(ship, thesis, true_theta):
    p = problem(ship, thesis, true_theta)
    y = p.scenarios[0].information
    noise = NoiseLevels(thesis.states, np.full(3, 0.014), np.zeros(3))
    program = SensitivityProgram(y.predictor, true_theta, np.zeros(4), noise, 1.0)
    other = dataclasses.replace(p.scenarios[0], information=program)
    with pytest.raises(UsageError, match="at most 8 unknowns, and this one has 18"):
        make_shooting(dataclasses.replace(p, scenarios=(other,)), np.full(p.shape, 0.5))


def test_infeasible_start_ends_within_all_limits(ship, thesis, true_theta):
    corners = np.array([[-60, -60], [90, -60], [90, 90], [-60, 90]])
    limits = dataclasses.replace(
        KEPT, area=corners, speed_cap=2.3, yaw_cap=0.1, end={"u": (1.0, 0.1), "x_n": (0, 30)},
        energy=0.6, headings=2.0,
    )  # fmt: skip
    p = problem(
        ship, thesis, true_theta, duration=160.0, rates=(0.8, 0.04), limits=limits
    )  # fmt: skip
    unit = draw_two_level(p, np.random.default_rng(0), 1)[0]
    assert not assess(p, unit[None])[0].feasible
    found = run_ipopt(make_shooting(p, unit, exact=False), unit, iterations=150)
    assert found.feasible, (found.status, found.missed)
    assert found.iterations > 3
    levels = p.levels(found.unit)
    assert (np.abs(np.diff(levels, axis=0)) <= p.schedule.reach + 1e-6).all()


@pytest.mark.long
def test_polish_gains_and_says_how_it_ended(ship, thesis, true_theta):
    p = problem(ship, thesis, true_theta)
    unit = draw_two_level(p, np.random.default_rng(3), 1)[0]
    found = solve_ipopt(p, unit)
    assert found.outcome is Outcome.CONVERGED
    assert found.value > assess(p, unit[None])[0].value + 1
    assert found.value == assess(p, found.unit[None])[0].value
    again = solve_ipopt(p, found.unit, iterations=0)
    assert again.outcome is Outcome.ITERATIONS
    assert again.value == found.value
    assert "was better and was kept" in again.status


def test_refusals_are_values(ship, thesis, true_theta):
    p = problem(ship, thesis, true_theta, kind="E")
    unit = draw_two_level(p, np.random.default_rng(3), 1)[0]
    found = solve_ipopt(p, unit)
    assert found.outcome is Outcome.REFUSED
    assert "not smooth" in found.status
    assert found.value == assess(p, unit[None])[0].value
    p = problem(ship, thesis, true_theta)
    other = dataclasses.replace(p.scenarios[0], information=lambda *a: None)
    with pytest.raises(UsageError, match="zero-mean IV"):
        make_shooting(dataclasses.replace(p, scenarios=(other,)), unit)


def test_interrupt_keeps_the_best_iterate(ship, thesis, true_theta, monkeypatch):
    p = problem(ship, thesis, true_theta)
    unit = draw_two_level(p, np.random.default_rng(3), 1)[0]
    shooting = make_shooting(p, unit, exact=False)
    full = run_ipopt(shooting, unit)
    shooting.solvers.clear()

    class Interrupted:
        """Runs a few iterations, then is stopped as Ctrl-C would."""

        def __init__(self, *args):
            args[3]["ipopt.max_iter"] = 25
            self.solver = original(*args)

        def __call__(self, **inputs):
            self.solver(**inputs)
            raise KeyboardInterrupt

    original = ca.nlpsol
    monkeypatch.setattr(ca, "nlpsol", Interrupted)
    found = run_ipopt(shooting, unit)
    assert found.outcome is Outcome.INTERRUPTED
    assert assess(p, unit[None])[0].value < found.value <= full.value
