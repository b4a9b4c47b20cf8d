"""Sensitivities are derivatives of simulations, and the gradient one of the information."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

import numpy as np
import pytest
from designs import thesis_model

from experiment_design import DesignRequest, predict_precision, prepare_request
from experiment_design.constraints.limit_program import LimitProgram
from experiment_design.constraints.limits import TrialLimits
from experiment_design.criteria.covariance import Criterion
from experiment_design.excitation.rollout import Rollout
from experiment_design.excitation.schedule import make_schedule
from experiment_design.information.sensitivities import SensitivityProgram
from experiment_design.optimise.search import ascend
from experiment_design.request.problem import Scenario, TrialProblem
from greybox.errors import UsageError
from greybox.model.noise import NoiseLevels
from greybox.model.predictor import build_predictor
from greybox.model.run.simulation import simulate
from greybox.vessel.force import generalised_force

REGIME = (("u", (1,)), ("v", (1,)), ("r", (1, -1)))
START = np.array([1.5, 1.2, 0.0, 0.3])
MEANS = ("current_north", "current_east")


def noise_of(structure, heading=0.002):
    return NoiseLevels(
        structure.states, np.array([0.014, 0.02, 0.01]), np.zeros(3), heading=heading
    )


def rollout_of(ship, structure, theta, d, start=START, integrator="euler"):
    return Rollout(ship, structure, theta, d, start, 1.0, integrator)


def random_commands(ship, schedule, seed=0):
    unit = np.random.default_rng(seed).random((1, schedule.holds, len(schedule.commands)))
    return schedule.expand(schedule.lower + (schedule.upper - schedule.lower) * unit)


@pytest.mark.parametrize("heading", [0.0, 0.002])
@pytest.mark.parametrize("d", [np.zeros(4), np.array([0.3, -0.2, 2.0, -1.0])])
@pytest.mark.parametrize("integrator", ["euler", "rk4"])
def test_sensitivities_of_simulations(ship, thesis, true_theta, d, heading, integrator):
    schedule = make_schedule(ship, 60, 10, 1.0)
    predictor = build_predictor(thesis, "basic", REGIME)
    program = SensitivityProgram(
        predictor, true_theta, d, noise_of(thesis, heading), 1.0, means=MEANS,
        integrator=integrator,
    )  # fmt: skip
    commands = random_commands(ship, schedule)

    def states(theta, d, start):
        rollout = rollout_of(ship, thesis, theta, d, start, integrator)
        return rollout.run(commands).state[0, :, : program.size]

    motion = rollout_of(ship, thesis, true_theta, d, integrator=integrator).run(commands)
    s = program.sensitivities(motion.state[:, :-1, :3], motion.state[:, :-1, 3], motion.tau)[0]
    assert s.shape == (61, 3 + (heading > 0 or d.any()), len(program.names))
    for j, name in enumerate(program.names):
        step = 1e-6
        ends = []
        for sign in (1, -1):
            theta, mean, start = true_theta.copy(), d.copy(), START.copy()
            if name in MEANS:
                mean[MEANS.index(name)] += sign * step
            elif name.endswith("(0)"):
                start[["u(0)", "v(0)", "r(0)", "psi(0)"].index(name)] += sign * step
            else:
                column = predictor.columns[predictor.parameter_columns[j]]
                places = [thesis.index(t) for t in column.terms]
                theta[places] *= 1 + sign * step / theta[places].sum()
            ends.append(states(theta, mean, start))
        expected = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(s[:, :, j], expected, atol=1e-5 * np.abs(expected).max() + 1e-8)


def test_information_is_the_sum(ship, thesis, true_theta):
    schedule = make_schedule(ship, 40, 10, 1.0)
    predictor = build_predictor(thesis, "basic", REGIME)
    noise = noise_of(thesis, 0.0)
    program = SensitivityProgram(predictor, true_theta, np.zeros(4), noise, 1.0, initial=False)
    commands = np.concatenate([random_commands(ship, schedule, i) for i in range(3)])
    motion = rollout_of(ship, thesis, true_theta, np.zeros(4)).run(commands)
    signals = motion.state[:, :-1, :3], motion.state[:, :-1, 3], motion.tau
    s = program.sensitivities(*signals)
    assert (s[:, 0] == 0).all()
    found = program(*signals)
    expected = np.einsum("rkip,i,rkiq->rpq", s, noise.measurement**-2.0, s)
    np.testing.assert_allclose(found.gram, expected, rtol=1e-10)
    assert found.score_covariance is found.gram


@pytest.mark.parametrize("kind", ["D", "A", "E", "c"])
def test_gradient_of_the_information(ship, thesis, true_theta, kind):
    schedule = make_schedule(ship, 60, 10, 1.0)
    predictor = build_predictor(thesis, "basic", REGIME)
    d = np.array([0.3, -0.2, 2.0, -1.0])
    rollout = rollout_of(ship, thesis, true_theta, d)
    program = SensitivityProgram(predictor, true_theta, d, noise_of(thesis), 1.0, means=MEANS)
    p = len(program.wanted)
    criterion = Criterion(kind, program.wanted, np.linspace(0.5, 1, p), np.linspace(-1, 1, p))
    limits = LimitProgram(rollout, schedule, TrialLimits())
    problem = TrialProblem(schedule, (Scenario(rollout, program, limits),), criterion)
    unit = np.random.default_rng(4).random(problem.shape)
    _, _, slope, _ = problem.gradient(unit)
    for k, c in ((0, 0), (2, 1), (5, 2)):
        step = np.zeros_like(unit)
        step[k, c] = 1e-5
        ends = [problem.gradient(unit + sign * step)[1] for sign in (1, -1)]
        assert slope[k, c] == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-4, abs=1e-6)


def test_ascent_climbs_it(ship, thesis, true_theta):
    vessel = dataclasses.replace(ship)
    schedule = make_schedule(vessel, 80, 10, 1.0)
    predictor = build_predictor(thesis, "basic", REGIME)
    rollout = rollout_of(ship, thesis, true_theta, np.zeros(4))
    program = SensitivityProgram(
        predictor, true_theta, np.zeros(4), noise_of(thesis, 0.0), 1.0, initial=False
    )
    criterion = Criterion("D", program.wanted, np.ones(15), np.ones(15))
    limits = LimitProgram(rollout, schedule, TrialLimits({"u": 1}, {"u": 0.3}))
    problem = TrialProblem(schedule, (Scenario(rollout, program, limits),), criterion)
    unit = np.random.default_rng(5).random(problem.shape)
    found = ascend(problem, unit, 200)
    assert found.feasible
    assert found.value > problem.evaluate(unit[None]).value[0] + 3


def test_a_measured_wind_needs_no_heading(ship, thesis, true_theta):
    """It is an input: without a current the heading at the start moves no state."""
    predictor = build_predictor(thesis, "wind", REGIME)
    schedule = make_schedule(ship, 60, 10, 1.0)
    for current, named in (((0.0, 0.0), False), ((0.3, -0.2), True)):
        d = np.array([*current, 5.0, 2.0])
        program = SensitivityProgram(predictor, true_theta, d, noise_of(thesis, 0.0), 1.0)
        motion = rollout_of(ship, thesis, true_theta, d).run(random_commands(ship, schedule))
        gram = program(motion.state[:, :-1, :3], motion.state[:, :-1, 3], motion.tau).gram[0]
        assert (np.diag(gram) > 0).all()
        assert ("psi(0)" in program.names) == named


def test_misuse(ship, thesis, true_theta):
    predictor = build_predictor(thesis, "basic", REGIME)
    exact = NoiseLevels(thesis.states, np.array([0.1, 0.0, 0.1]), np.full(3, 0.1))
    with pytest.raises(UsageError, match="measurement of v has no noise"):
        SensitivityProgram(predictor, true_theta, np.zeros(4), exact, 1.0)
    with pytest.raises(UsageError, match="no disturbance mean 'tide'"):
        SensitivityProgram(
            predictor, true_theta, np.zeros(4), noise_of(thesis), 1.0, means=("tide",)
        )


@pytest.mark.parametrize("estimator", ["iv", "oe"])
def test_predicted_precision_knows_the_integrator(ship, thesis, true_theta, estimator):
    """Of an RK4 prior it is that of the RK4 motion, here by differences of its simulation."""
    precise = replace(thesis_model(), integrator="rk4", noise=noise_of(thesis, 0.0))
    asked = DesignRequest(
        120.0, regime="u+v+", start=START, predictor="basic", estimator=estimator,
        limits=TrialLimits(margins={"u": 0.0, "v": 0.0}),
    )  # fmt: skip
    requests = [prepare_request(m, asked) for m in (precise, replace(precise, integrator="euler"))]
    schedule = requests[0].schedule
    commands = random_commands(ship, schedule)[0]
    plan = dict(zip(schedule.commands, commands.T, strict=True))
    found, euler = (predict_precision(r, [plan]) for r in requests)
    assert np.abs(found.std / euler.std - 1).max() > 1e-3
    if estimator == "iv":
        return
    made = generalised_force(ship, plan)
    tau = np.column_stack([made[n] for n in thesis.inputs])

    def measured(theta, start):
        run = simulate(thesis, theta, start[:3], tau, 1.0, psi0=start[3], integrator="rk4")
        return np.column_stack([run.x[0], run.psi[0]]).ravel()

    predictor = requests[0].build_predictor()
    moves = [(np.zeros(18), start) for start in np.eye(4)]
    for i in reversed(predictor.parameter_columns):
        places = [thesis.index(t) for t in predictor.columns[i].terms]
        move = np.zeros(18)
        move[places] = true_theta[places] / true_theta[places].sum()
        moves.insert(0, (move, np.zeros(4)))
    noise = requests[0].noise
    rows = []
    for theta, start in moves:
        ends = [measured(true_theta + s * theta, START + s * start) for s in (1e-6, -1e-6)]
        rows.append((ends[0] - ends[1]) / 2e-6 / np.tile([*noise.measurement, noise.heading], 121))
    expected = np.linalg.inv(np.array(rows) @ np.transpose(rows))
    std = np.sqrt(np.diag(expected))[: len(found.names)]
    np.testing.assert_allclose(found.std, std, rtol=1e-4)
