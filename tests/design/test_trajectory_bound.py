"""The bound of trials in several states against exhaustive search, and what has none."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from designs import make_request
from test_certificate import make_problem

from experiment_design.certificate import trajectory_bound
from experiment_design.certificate.certificate import INFORMATIVE, Certificate, Kind, certify
from experiment_design.certificate.trajectory_bound import (
    _Chord,
    _draw_forces,
    _Programme,
    _Trial,
    bound_trajectory,
    relaxed_value,
    why_not_trajectory,
)
from experiment_design.design import design_trial
from experiment_design.optimise.search import climb, draw_two_level
from experiment_design.request.request import build_problem
from greybox.model.noise import NoiseLevels


@pytest.fixture
def small(monkeypatch):
    """Grids that are built in a second."""
    monkeypatch.setattr(trajectory_bound, "_POINTS", (9, 12))
    monkeypatch.setattr(trajectory_bound, "_FORCES", (18, 27))


def make_trial(problem, *, limits=None, relaxed=False):
    """Return a trial whose sums are scaled by those of a random sequence."""
    unit = np.random.default_rng(1).random(problem.shape)
    return _Trial(problem, unit, np.random.default_rng(0), limits, relaxed)


def sums_of_all(trial, tau, holds):
    """Return the sums of all sequences of some forces."""
    order = np.array(list(itertools.product(range(len(tau)), repeat=holds)))
    point, total = np.tile(trial.start, (len(order), 1)), 0.0
    for k in range(holds):
        n = trial.hold if k < holds - 1 else trial.samples - (holds - 1) * trial.hold
        now = tau[order[:, k]]
        x, psi, good = trial.run(point, now, n)
        assert good.all()
        total = total + trial.sums(x, psi, np.repeat(now[:, None], n, axis=1))
        point = trial.place(x, psi)
    return total


@pytest.mark.parametrize(
    ("name", "duration"), [("thesis", 40.0), ("thesis", 35.0), ("linear", 40.0)]
)
def test_programme_finds_the_best_of_all_sequences(ship, name, duration):
    trial = make_trial(make_problem(ship, name, duration, white=True))
    tau = _draw_forces(trial.candidates, 6)
    total = sums_of_all(trial, tau, 4)
    own = total[:, -3:] / trial.samples
    chord = _Chord.between(own.min(axis=0), own.max(axis=0), trial)
    values = np.array([trial.value(s, chord)[0] for s in total])
    errors = []
    for points in (9, 18):
        programme = _Programme(trial, tau, (points,) * 3)
        programme.rich = tau
        gaps = []
        for i in np.argsort(-values)[[0, 40, 400]]:
            slope = trial.value(total[i], chord)[1]
            exact = float((total @ slope).max())
            best, sums = programme.maximise(slope)
            assert sums @ slope <= exact * (1 + 1e-6)
            assert sums @ slope >= 0.97 * exact
            gaps.append(best / exact - 1)
        errors.append(max(abs(g) for g in gaps))
        low, high = programme.variances()
        assert (low <= own.min(axis=0) * 1.03).all()
        assert (high >= own.max(axis=0) * 0.97).all()
    assert errors[1] < 0.03
    # interpolation errs by the square of a cell
    assert errors[1] < max(0.6 * errors[0], 0.01)


def test_value_and_derivative_of_sums(ship):
    problem = make_problem(ship, "thesis", 65.0, white=True)
    trial = make_trial(problem)
    unit = np.random.default_rng(1).random((1, *problem.shape))
    assert trial.true_value(trial.known[0]) == pytest.approx(
        problem.evaluate(unit).value[0], abs=1e-6
    )
    own = trial.known[:, -3:] / trial.samples
    chord = _Chord.between(own.min(axis=0), own.max(axis=0), trial)
    # a chord lies above what it replaces, and by no more than it says
    for sums in trial.known[:10]:
        over = trial.value(sums, chord)[0] - trial.true_value(sums)
        assert -1e-9 <= over <= chord.gap.sum() + 1e-9
    mixed = trial.known[:20].mean(axis=0)
    toward = trial.known[30] - mixed
    slope = trial.value(mixed, chord)[1]
    ends = [trial.value(mixed + h * toward, chord)[0] for h in (1e-5, -1e-5)]
    assert (ends[0] - ends[1]) / 2e-5 == pytest.approx(float(slope @ toward), rel=1e-4)
    low, high = chord.halves(trial)
    assert low.gap.sum() < chord.gap.sum()
    assert high.gap.sum() < chord.gap.sum()


@pytest.mark.parametrize(("name", "kind"), [("thesis", "D"), ("linear", "D"), ("linear", "A")])
def test_no_short_trial_beats_its_bound(ship, small, name, kind):
    problem = make_problem(ship, name, 30.0, kind, white=True)
    corners = np.array(list(itertools.product((0.0, 1.0), repeat=9))).reshape(-1, 3, 3)
    result = problem.evaluate(corners)
    kept = np.where((result.missed <= 1e-4).all(axis=0), result.value, -np.inf)
    best = corners[int(np.argmax(kept))]
    found = climb(problem, best[None], 0, 300)
    bound = bound_trajectory(problem, best, limits=problem.scenarios[0].limits)
    assert bound.bound >= max(kept.max(), found.value)
    assert bound.bound >= bound.mixture_value
    assert not bound.relaxed


@pytest.mark.long
def test_limits_on_the_speeds_lower_the_bound(ship, small):
    problem = make_problem(ship, "linear", 60.0, white=True)
    unit = climb(problem, draw_two_level(problem, np.random.default_rng(0), 3), 0, 200).unit
    free = bound_trajectory(problem, unit)
    kept = bound_trajectory(problem, unit, limits=problem.scenarios[0].limits)
    assert kept.bound < free.bound
    assert kept.bound >= problem.evaluate(unit[None]).value[0]
    assert bound_trajectory(problem, unit).bound == free.bound


def test_process_noise_is_the_floor_of_iv(ship, small):
    problem = make_problem(ship, "linear", 40.0)
    unit = climb(problem, draw_two_level(problem, np.random.default_rng(0), 4), 0, 200).unit
    assert "correlates" in why_not_trajectory(problem)
    assert not why_not_trajectory(problem, relaxed=True)
    value = float(problem.evaluate(unit[None]).value[0])
    assert relaxed_value(problem, unit) > value
    bound = bound_trajectory(problem, unit, relaxed=True)
    assert bound.relaxed
    assert bound.ranges == 1
    assert bound.chord < 1e-9
    assert bound.bound >= relaxed_value(problem, unit)


def test_a_current_puts_the_heading_on_the_grid(small):
    request = make_request(
        "linear", duration=40.0, estimator="iv-white", d=np.array([0.2, -0.2, 0.0, 0.0])
    )
    problem = build_problem(request)
    unit = climb(problem, draw_two_level(problem, np.random.default_rng(0), 4), 0, 100).unit
    bound = bound_trajectory(problem, unit, share=0.3)
    assert len(bound.finer) == 4
    assert bound.bound >= problem.evaluate(unit[None]).value[0]


def test_what_has_no_bound_of_this_kind(ship):
    problem = build_problem(make_request(duration=60.0, estimator="oe"))
    assert "sensitivities" in why_not_trajectory(problem)
    unit = np.random.default_rng(0).random(problem.shape)
    found = certify([problem], [unit])
    assert found.kind is Kind.NOT_AVAILABLE
    assert "sensitivities as states" in found.sentence()
    plain = make_problem(ship, "thesis", 60.0, white=True)
    motion = plain.scenarios[0].rollout.run(plain.commands(unit[None]))
    known = plain.with_known((plain.moments(motion, 0),))
    assert "earlier" in why_not_trajectory(known)
    ramped = replace(plain, schedule=replace(plain.schedule, ramp=(2, 1, 1)))
    assert "ramped" in why_not_trajectory(ramped)
    quiet = build_problem(
        make_request(noise=NoiseLevels(("u", "v", "r"), np.full(3, 0.01), np.zeros(3)))
    )
    assert "floor" in why_not_trajectory(quiet, relaxed=True)


def test_a_low_bound_is_not_informative_and_no_more():
    low = Certificate(None, 1.0, 9.0, 0.1, 2, 3, False, "how", "checked")
    assert low.kind is Kind.NOT_INFORMATIVE
    assert low.sentence() == low.summary()
    assert low.sentence().startswith("certificate: not informative (")
    assert low.to_dict() == {"kind": "not informative"}
    assert INFORMATIVE == 0.1
    proven = replace(low, efficiency_lower_bound=0.5, rigorous=True)
    assert proven.kind is Kind.PROVEN
    assert "proven" in proven.sentence()


@pytest.mark.long
def test_bound_of_300_s_in_three_degrees():
    """The figure that was asked for, and no seed beats another's bound."""
    request = make_request(duration=300.0, estimator="iv-white")
    designs = [
        design_trial(replace(request, seed=s), workers=1, alternatives=False) for s in (0, 3)
    ]
    best = max(d.logdet for d in designs)
    for design in designs:
        assert design.certificate.kind is Kind.NUMERICAL
        assert design.certificate.efficiency_lower_bound >= 0.7
        assert design.certificate.bound >= best
        assert "dynamic programming" in design.certificate.method
