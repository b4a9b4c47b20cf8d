"""No bound lies below what exhaustive search finds; derivatives and cases without a bound."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from designs import limited_ship, make_request

from experiment_design.certificate.certificate import (
    _FEW,
    Kind,
    _information,
    _Tangent,
    certify,
)
from experiment_design.certificate.surge_bound import _Programme, _Trial, why_not_surge
from experiment_design.constraints.limit_program import LimitProgram
from experiment_design.constraints.limits import TrialLimits
from experiment_design.criteria.covariance import Criterion
from experiment_design.design import design_trial
from experiment_design.excitation.rollout import Rollout
from experiment_design.excitation.schedule import make_schedule
from experiment_design.information.moments import MomentProgram, Moments
from experiment_design.optimise.search import ascend, assess, climb, draw_two_level, recombine
from experiment_design.request.problem import Scenario, TrialProblem
from greybox.model.catalogue import get_structure
from greybox.model.noise import NoiseLevels
from greybox.model.predictor import build_predictor
from greybox.study.chapter6 import TRUE

STILL = np.zeros(4)


def make_problem(ship, name, duration, kind="D", *, white=False, start=None, predictor="basic"):
    """Return a trial of the thesis's ship with the noises of (6.2), held 10 s."""
    structure = get_structure(name)
    theta = np.array([TRUE[n] for n in structure.parameters])
    nx = len(structure.states)
    noise = NoiseLevels(
        structure.states, np.full(nx, np.sqrt(2e-4)), np.array([2e-3, 2e-3, 4e-4])[:nx]
    )
    regime = (("u", (1,)), ("v", (1,)), ("r", (1, -1)))[:nx]
    model = build_predictor(structure, predictor, regime)
    schedule = make_schedule(ship, duration, 10.0, 1.0)
    first = start or ((1.5, 0.0) if nx == 1 else (1.5, 1.2, 0.0, 0.0))
    rollout = Rollout(ship, structure, theta, STILL, np.array(first), 1.0)
    information = MomentProgram(model, theta, STILL, noise, 1.0, white=white)
    wanted = tuple(model.parameter_columns)
    scale = np.array([abs(sum(TRUE[t] for t in model.columns[i].terms)) for i in wanted])
    signs = {"u": 1} if nx == 1 else {"u": 1, "v": 1}
    limits = TrialLimits(signs, {"u": 0.5} if nx == 1 else {"u": 0.5, "v": 0.4})
    return TrialProblem(
        schedule,
        (Scenario(rollout, information, LimitProgram(rollout, schedule, limits)),),
        Criterion(kind, wanted, scale, 1 / scale),
    )


def best_of(problem, units, polished):
    """Return the best value that keeps the limits, the most promising climbed from."""
    result = problem.evaluate(units)
    kept = np.where((result.missed <= 1e-4).all(axis=0), result.value, -np.inf)
    order = np.argsort(-kept)
    climbed = [ascend(problem, units[i], 200) for i in order[:polished]]
    return max([kept[order[0]], *[c.value for c in climbed if c.feasible]])


def surge_grid(holds, levels):
    """Return all sequences on a grid of the force, least to largest, (R, K, 3)."""
    x = np.array(list(itertools.product(np.linspace(0, 1, levels), repeat=holds)))
    return np.stack([x, 1 - x, 1 - x], axis=-1)


@pytest.mark.parametrize(("holds", "levels", "start"), [(4, 9, 1.5), (4, 9, 1.0), (5, 6, 2.5)])
@pytest.mark.parametrize("kind", ["D", "A", "E", "c"])
def test_no_short_surge_trial_beats_its_bound(ship, holds, levels, start, kind):
    problem = make_problem(ship, "surge", 10.0 * holds, kind, start=(start, 0.0))
    units = surge_grid(holds, levels)
    best = best_of(problem, units, 6)
    design = units[int(np.argmax(problem.evaluate(units[::7]).value)) * 7]
    found = certify([problem], [design])
    assert found.bound >= best
    assert found.efficiency_lower_bound <= np.exp((found.value - best) / (3 if kind == "D" else 1))


@pytest.mark.long
@pytest.mark.parametrize(("name", "holds"), [("thesis", 3), ("linear", 3)])
def test_no_short_trial_in_three_degrees_beats_its_bound(ship, name, holds):
    problem = make_problem(ship, name, 10.0 * holds)
    corners = itertools.product((0.0, 1.0), repeat=3 * holds)
    units = np.array(list(corners)).reshape(-1, holds, 3)
    best = best_of(problem, units, 10)
    found = certify([problem], [units[np.argmax(problem.evaluate(units).value)]], budget=600)
    assert found.kind is not Kind.NOT_AVAILABLE
    assert not found.rigorous
    assert found.bound >= best


def test_what_is_good_in_each_of_two_sequences_is_put_together(ship):
    problem = make_problem(ship, "surge", 120.0)
    whole = climb(problem, draw_two_level(problem, np.random.default_rng(0), 2), 0, 200)
    poor = draw_two_level(problem, np.random.default_rng(1), 1)[0]
    halves = whole.unit.copy(), whole.unit.copy()
    halves[0][:6], halves[1][6:] = poor[:6], poor[6:]
    found = assess(problem, np.array(halves))
    assert max(c.value for c in found) < whole.value - 0.05
    best = recombine(problem, found, np.random.default_rng(0), 200)
    assert best.feasible
    assert best.value >= whole.value - 1e-6


@pytest.mark.long
def test_surge_design_of_200_s_is_certified(ship):
    problem = make_problem(ship, "surge", 200.0)
    starts = draw_two_level(problem, np.random.default_rng(0), 6)
    design = climb(problem, starts, 0, 1500)
    found = certify([problem], [design.unit])
    assert found.efficiency_lower_bound >= 0.9
    assert found.bound >= design.value
    # seeds agree, and the same seed gives the same
    other = certify([problem], [design.unit], seed=5)
    assert abs(other.bound - found.bound) < 0.02
    again = certify([problem], [design.unit])
    assert again.bound == found.bound
    assert "at least 9" in found.sentence()
    assert found.to_dict()["rigorous"] is False


@pytest.mark.long
def test_information_of_few_wanted_parameters_is_mixed_whole(ship):
    problem = make_problem(ship, "thesis", 60.0)
    one = replace(problem.criterion, wanted=(0,), scale=np.ones(1), combination=np.ones(1))
    problem = replace(problem, criterion=one)
    assert len(one.wanted) <= _FEW
    units = draw_two_level(problem, np.random.default_rng(0), 400)
    best = best_of(problem, units, 8)
    assert certify([problem], [units[0]], budget=600).bound >= best


@pytest.mark.parametrize("whole", [False, True])
def test_tangent_has_the_right_derivative(ship, whole):
    problem = make_problem(ship, "thesis", 60.0)
    rng = np.random.default_rng(3)
    unit = rng.random(problem.shape)
    size = len(problem.criterion.wanted)
    draw = rng.normal(size=(size, size))
    c = problem.criterion
    motion = problem.scenarios[0].rollout.run(problem.commands(unit[None]))
    info = _information(c, problem.moments(motion, 0), whole)[0]
    scale = 1 / np.sqrt(np.diag(info))
    weights = (draw @ draw.T) * np.outer(scale, scale)
    tangent = _Tangent(c.kind, c.wanted, c.scale, c.combination, weights=weights, whole=whole)
    linear = replace(problem, criterion=tangent)
    slope = linear.gradient(unit)[2]
    for place in ((0, 0), (3, 1), (5, 2)):
        ends = []
        for step in (1e-5, -1e-5):
            moved = unit.copy()
            moved[place] += step
            ends.append(linear.gradient(moved)[1])
        assert abs((ends[0] - ends[1]) / 2e-5 - slope[place]) < 1e-4 * np.abs(slope).max()
    assert linear.evaluate(unit[None]).value[0] == pytest.approx(linear.gradient(unit)[0])


def test_dynamic_programme_equals_all_sequences(ship):
    """The value on the grid is the largest over all sequences of that grid's forces."""
    problem = make_problem(ship, "surge", 45.0)
    trial = _Trial(problem)
    forces = np.linspace(trial.lowest, trial.highest, 5)
    everything = np.array(list(itertools.product(forces, repeat=5)))
    sums = trial.sums(everything)
    programme = _Programme(trial, 400, 5)
    rng = np.random.default_rng(2)
    for i in (100, 2000):
        _, slope = trial.value(sums[i])
        noisy = slope.gram * (1 + 0.2 * rng.random((4, 4)))
        slope = Moments((noisy + noisy.T) / 2, slope.score_covariance)
        values = [
            (slope.gram * s.gram).sum() + (slope.score_covariance * s.score_covariance).sum()
            for s in sums
        ]
        best, found = programme.maximise(slope)
        assert best == pytest.approx(max(values), rel=2e-3)
        assert everything[int(np.argmax(values))] == pytest.approx(found)


def test_sums_and_derivatives_of_a_surge_trial(ship):
    problem = make_problem(ship, "surge", 65.0)
    trial = _Trial(problem)
    unit = np.random.default_rng(4).random(problem.shape)
    sums = trial.sums(trial.force(problem.levels(unit))[None])[0]
    value, slope = trial.value(sums)
    assert value == pytest.approx(problem.evaluate(unit[None]).value[0], abs=1e-8)
    draw = np.random.default_rng(5).normal(size=(4, 4))
    for which, step in (("gram", 1e-5), ("score_covariance", 1e-9)):
        ends = []
        for sign in (1, -1):
            moved = replace(sums, **{which: getattr(sums, which) + sign * step * (draw + draw.T)})
            ends.append(trial.value(moved)[0])
        if which == "gram":
            # the number of samples does not vary, so the last entry is left alone
            draw[-1, -1] = 0
            ends = []
            for sign in (1, -1):
                moved = replace(sums, gram=sums.gram + sign * step * (draw + draw.T))
                ends.append(trial.value(moved)[0])
        expected = float((getattr(slope, which) * (draw + draw.T)).sum())
        assert (ends[0] - ends[1]) / 2 / step == pytest.approx(expected, rel=1e-4)


@pytest.mark.long
def test_a_campaign_of_two_trials(ship):
    problem = make_problem(ship, "surge", 40.0)
    other = make_problem(ship, "surge", 40.0, start=(2.5, 0.0))
    units = surge_grid(4, 4)
    sums = [p.moments(p.scenarios[0].rollout.run(p.commands(units)), 0) for p in (problem, other)]
    best = -np.inf
    for i in range(len(units)):
        pair = replace(
            sums[1],
            gram=sums[0].gram[i] + sums[1].gram,
            score_covariance=sums[0].score_covariance[i] + sums[1].score_covariance,
        )
        best = max(best, float(problem.criterion.value(pair).max()))
    found = certify([problem, other], [units[85], units[90]], budget=1200)
    assert found.kind is not Kind.NOT_AVAILABLE
    assert found.bound >= best


@pytest.mark.long
def test_known_sums_and_scenarios(ship):
    problem = make_problem(ship, "surge", 40.0)
    units = surge_grid(4, 6)
    motion = problem.scenarios[0].rollout.run(problem.commands(units[400:401]))
    known = problem.with_known((problem.moments(motion, 0),))
    design = units[77]
    assert certify([known], [design]).bound >= best_of(known, units, 4)
    twice = replace(problem, scenarios=problem.scenarios * 2)
    one = certify([problem], [design])
    assert certify([twice], [design]).bound == pytest.approx(one.bound)
    many = replace(problem, scenarios=problem.scenarios * 9)
    assert "9 scenarios" in certify([many], [design]).reason


@pytest.mark.long
def test_white_errors_are_bounded_by_information(ship):
    problem = make_problem(ship, "surge", 40.0, white=True)
    assert "not a sum over samples" in why_not_surge(problem)
    units = surge_grid(4, 7)
    found = certify([problem], [units[50]], budget=1200)
    assert found.bound >= best_of(problem, units, 6)


def test_a_design_that_excites_nothing_has_no_certificate(ship):
    constant = certify([make_problem(ship, "thesis", 20.0)], [np.zeros((2, 3))])
    assert constant.efficiency_lower_bound is None
    assert "excitation" in constant.sentence()
    assert constant.to_dict()["bound"] is None


@pytest.mark.long
def test_tight_limits_do_not_tighten_the_bound_below_the_truth():
    """A search that must keep caps and rates finds little; the bound must not rest on that."""
    limits = TrialLimits(margins={"u": 0.5, "v": 0.4}, speed_cap=2.2, yaw_cap=0.06)
    request = make_request(
        duration=200.0, limits=limits, vessel=limited_ship(2.0, 0.02), effort=0.05
    )
    hasty = design_trial(request, workers=1, alternatives=False)
    other = design_trial(replace(request, seed=4, effort=0.5), workers=1, alternatives=False)
    best = max(hasty.logdet, other.logdet)
    for design in (hasty, other):
        certificate = design.certificate
        assert certificate.bound >= best
        assert (certificate.efficiency_lower_bound or 0.0) <= np.exp((design.logdet - best) / 15)
