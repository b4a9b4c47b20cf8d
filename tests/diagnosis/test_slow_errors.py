"""Errors that a slow force imitates, and likelihoods with many hills."""

from __future__ import annotations

import zlib
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from greybox.diagnosis import search as searching
from greybox.diagnosis.atom import Atom
from greybox.diagnosis.causes import Context, known_causes
from greybox.diagnosis.diagnose import diagnose
from greybox.diagnosis.fitting import Problem
from greybox.diagnosis.held_out import OtherLogs, Pair, proof_of
from greybox.diagnosis.noise import fit_noise
from greybox.diagnosis.omnibus import disagreement, features, knots_of
from greybox.diagnosis.point import Fit, Point
from greybox.diagnosis.scores import MOMENTS
from greybox.diagnosis.search import Candidate, Step, _loosened, _sure, judge
from greybox.diagnosis.ship import LogRun, Ship
from greybox.diagnosis.verdict import _drifts
from greybox.model.catalogue import get_structure
from greybox.study.blind import draw
from greybox.study.chapter6 import TRUE
from greybox.trial.log import TrialLog

BASE = get_structure("thesis").without("Wuu", "Wvv", "Wuv")
MOMENT, FACTOR = 210.0, 1.8


@pytest.fixture(scope="module")
def changed() -> TrialLog:
    """A pulse trial whose sway damping grows at a moment, as the model itself would run it."""
    log = draw(np.random.default_rng([9, 1]), kind="pulses", samples=400).estimation
    run = LogRun(BASE, log, "rk4")
    theta = np.array([TRUE[n] for n in BASE.parameters])
    ship = _change(log).apply(
        Ship(theta, np.zeros(2), log.vessel), np.array([FACTOR, MOMENT])
    )  # fmt: skip
    shown = run.run(ship, run.start()).y
    noise = np.array([0.014, 0.014, 0.014, 0.01]) * np.random.default_rng(3).standard_normal(
        shown.shape
    )
    return replace(
        log, channels=log.channels | dict(zip(run.outputs, (shown + noise).T, strict=True))
    )


def _change(log: TrialLog) -> Atom:
    context = Context(
        BASE, log.vessel, ("u", "v", "r", "psi"), False, float(log.t[-1]), 1.0,
        dict.fromkeys(("n1", "n2"), 15.0),
    )  # fmt: skip
    atoms = known_causes()["parameter_change"].atoms(context)
    return next(a for a in atoms if a.key.endswith(":Yv"))


def _fitted(log: TrialLog, moment: float) -> tuple[Problem, Atom, Fit]:
    problem = Problem([LogRun(BASE, log, "rk4")])
    atom = _change(log)
    theta = np.array([TRUE[n] for n in BASE.parameters])
    point = Point(
        Ship(theta, np.zeros(2), log.vessel), (problem.runs[0].start(),), tuple(range(len(theta)))
    )
    point = problem.add(point, atom, np.array([1.4, moment]))
    noise = fit_noise(problem.errors(point), problem.poles(point), 1.0, problem.groups, longest=3.0)
    return problem, atom, problem.fit(point, noise, most=12)


def test_a_moment_far_off_is_found_by_scanning(changed: TrialLog) -> None:
    problem, atom, fit = _fitted(changed, MOMENT - 18.0)
    found = problem.settle(problem.scan(fit, atom), 2)
    factor, moment = problem.scan(found, atom).point.values[0]
    assert moment == pytest.approx(MOMENT, abs=2.0)
    assert factor == pytest.approx(FACTOR, rel=0.1)


def test_the_profile_is_the_least_squares_of_the_other_numbers(changed: TrialLog) -> None:
    problem, atom, fit = _fitted(changed, MOMENT)
    k = problem.numbers_of(fit.point, atom)[1]
    vector = fit.point.vector()
    rows = np.concatenate([r.reshape(-1, r.shape[2]) for r in problem.rows(fit.point, fit.noise)])
    others = np.delete(rows, k, axis=1)
    values = vector[k] + np.array([-20.0, 0.0, 7.0])
    expected = []
    for value in values:
        vector[k] = value
        nu, _ = problem.whitened(fit.noise, problem.errors(fit.point.at(vector)))
        stacked = np.concatenate([n.ravel() for n in nu])
        scale = np.sqrt((others**2).sum(axis=0))
        solved = np.linalg.lstsq(others / scale, stacked, rcond=None)[0]
        expected.append(float(((stacked - others / scale @ solved) ** 2).sum()))
    np.testing.assert_allclose(problem.profile(fit, k, values), expected, rtol=1e-6)


def test_the_interval_of_a_moment_holds_it_and_reaches_no_further_than_was_looked(
    changed: TrialLog,
) -> None:
    problem, atom, fit = _fitted(changed, MOMENT)
    found = problem.settle(problem.scan(fit, atom), 2)
    spread = problem.spread(found, atom)
    assert set(spread) == {"Yv_time"}
    reach = atom.parameters[1].reach
    assert 0 <= spread["Yv_time"] <= reach / 3
    assert abs(found.point.values[0][1] - MOMENT) <= 3 * spread["Yv_time"] + 1.5


def test_a_colour_that_forgets_remembers_no_longer_than_asked(changed: TrialLog) -> None:
    problem, _, fit = _fitted(changed, MOMENT)
    slow = 0.3 * np.sin(np.arange(len(changed)) / 60)
    errors = [np.asarray(fit.errors[0]) + slow[:, None]]
    poles = problem.poles(fit.point)
    free = fit_noise(errors, poles, 1.0, problem.groups)
    short = fit_noise(errors, poles, 1.0, problem.groups, longest=3.0)
    assert max(g.remembered for g in free.groups) > 30
    assert max(g.remembered for g in short.groups) <= 3.0 + 1e-6
    # no colour under a bound is likelier than the likeliest of all
    assert problem.whitened(free, errors)[1] <= problem.whitened(short, errors)[1] + 1e-6


def test_a_change_counts_for_as_many_causes_as_moments_were_tried(changed: TrialLog) -> None:
    class Nowhere:
        def prove(self, before, after):
            return None

    _, atom, fit = _fitted(changed, MOMENT)
    worse = replace(fit, cost=fit.cost + 20.0)
    found = judge(Nowhere(), worse, fit, atom, 10)
    assert found.p_adjusted == pytest.approx(found.p_value * 10 * MOMENTS)
    plain = replace(atom, parameters=tuple(replace(p, reach=0.0) for p in atom.parameters))
    assert judge(Nowhere(), worse, fit, plain, 10).p_adjusted == pytest.approx(10 * found.p_value)


def test_forces_that_begin_at_a_speed_are_among_the_features(changed: TrialLog) -> None:
    problem, _, fit = _fitted(changed, MOMENT)
    knots = knots_of(problem)
    assert knots.shape == (3, 3)
    assert (np.diff(knots, axis=1) > 0).all()
    run, start = problem.runs[0], fit.point.starts[0]
    made = features(run, fit, start, knots)
    surge = np.abs(run.run(fit.point.ship, start).x[:, 0])
    wanted = np.maximum(surge - knots[0, 1], 0.0)
    assert wanted.any()
    assert min(np.abs(made - wanted[:, None]).max(axis=0)) < 1e-12


class _OneProblem:
    """A case that knows one problem."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem

    def problem(self, integrator: str) -> Problem:
        return self._problem


def _candidate(problem: Problem, atom: Atom, fit: Fit, tried: int = 50) -> Candidate:
    proof = proof_of(np.full(100, 1.0) + 0.1 * np.sin(np.arange(100)))
    return Candidate(atom, fit, 400.0, 1e-80, 1e-78, proof, problem.names, tried)


def test_the_robust_covariance_must_bear_a_cause_out(changed: TrialLog) -> None:
    problem, atom, fit = _fitted(changed, MOMENT)
    found = problem.settle(problem.scan(fit, atom), 2)
    real = _sure(_OneProblem(problem), _candidate(problem, atom, found))
    k = problem.numbers_of(found.point, atom)[0]
    numbers, covariance = problem.covariance(found)
    expected = chi2.sf((numbers[k] - 1.0) ** 2 / covariance[k, k], 1)
    assert real.holds
    assert real.p_value == pytest.approx(max(expected, 1e-80), rel=1e-9)
    assert real.p_adjusted == pytest.approx(50 * real.p_value)
    # the moment is far from zero, which is no null; the factor is 1: nothing has changed
    vector = found.point.vector()
    vector[k] = 1.0 + 0.5 * np.sqrt(covariance[k, k])
    point = found.point.at(vector)
    errors = problem.errors(point)
    nu, cost = problem.whitened(found.noise, errors)
    still = replace(found, point=point, cost=cost, nu=tuple(nu), errors=tuple(errors))
    none = _sure(_OneProblem(problem), _candidate(problem, atom, still))
    assert none.p_value > 0.3
    assert not none.holds


def test_the_likelier_of_two_stories_counts_twice(changed: TrialLog) -> None:
    problem, atom, fit = _fitted(changed, MOMENT)
    plain = problem.fit(problem.drop(fit.point, atom), fit.noise)
    # two models alike on the held-out log but for a little: neither proves much
    held = OtherLogs(problem, problem)
    close = problem.fit(fit.point.at(fit.point.vector()), fit.noise)
    once = proof_of(held.contributions(plain) - held.contributions(close))
    assert held.prove(plain, close).p_value == pytest.approx(min(1.0, 2 * once.p_value))
    back = proof_of(held.contributions(close) - held.contributions(plain))
    assert held.prove(close, plain).p_value == pytest.approx(back.p_value)


def test_held_out_errors_have_a_colour_of_their_own(changed: TrialLog) -> None:
    problem, _, fit = _fitted(changed, MOMENT)
    rough = replace(
        changed,
        channels=changed.channels
        | {"u": changed["u"] + 0.1 * np.random.default_rng(4).standard_normal(len(changed))},
    )
    (pair,) = OtherLogs(problem, Problem([LogRun(BASE, rough, "rk4")])).pairs(fit)
    before, after = (noise.groups[0].sensor[0] for noise in (fit.noise, pair.held_fit.noise))
    assert before == pytest.approx(0.014, rel=0.2)
    assert after == pytest.approx(0.101, rel=0.1)


def test_costs_of_channels_sum_to_that_of_all(changed: TrialLog) -> None:
    problem, _, fit = _fitted(changed, MOMENT)
    costs = problem.costs(fit)
    assert costs.shape == (len(problem.groups),)
    assert costs.sum() == pytest.approx(fit.cost)


@pytest.mark.parametrize(("other", "expected"), [(0, True), (1, False)])
def test_a_slow_force_moves_the_same_channel_in_every_log(
    changed: TrialLog, other: int, expected: bool
) -> None:
    problem, _, fit = _fitted(changed, MOMENT)
    poles = problem.poles(fit.point)

    def pushed(channel: int) -> Fit:
        errors = np.array(fit.errors[0])
        errors[:, channel] += 0.3 * np.sin(np.arange(len(errors)) / 50)
        noise = fit_noise([errors], poles, 1.0, problem.groups)
        nu, cost = problem.whitened(noise, [errors])
        return replace(fit, errors=(errors,), noise=noise, nu=tuple(nu), cost=cost)

    pair = Pair(problem, pushed(0), problem, pushed(other))
    assert _drifts([pair]) is expected


def test_causes_that_take_each_others_place_end_the_search(
    changed: TrialLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, atom, fit = _fitted(changed, MOMENT)
    one, two = (
        replace(_candidate(problem, atom, fit), atom=replace(atom, key=key)) for key in ("a", "b")
    )
    steps = []

    def take(case, fit, causes, atoms):
        steps.append([c.atom.key for c in causes])
        taken = two if causes and causes[0].atom.key == "a" else one
        return Step(fit, (), (taken,), taken)

    def newest_alone(case, fit, causes, tried):
        return fit, causes[-1:]

    monkeypatch.setattr(searching, "take_step", take)
    monkeypatch.setattr(searching, "_backward", newest_alone)
    found = searching.search(_OneProblem(problem), fit, [])
    assert steps == [[], ["a"], ["b"]]
    assert [c.atom.key for c in found.causes] == ["a"]


def test_a_run_whose_squares_leave_every_number_ends_the_fit(
    changed: TrialLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, _, fit = _fitted(changed, MOMENT)
    rows = problem.rows(fit.point, fit.noise)
    monkeypatch.setattr(Problem, "rows", lambda *_: [1e200 * r for r in rows])
    found = problem.fit(fit.point, fit.noise)
    assert not found.converged
    np.testing.assert_array_equal(found.point.vector(), fit.point.vector())


@pytest.mark.long
def test_a_strong_wind_is_not_left_to_the_colour_of_the_errors() -> None:
    # taken with errors that were believed slow, its sway coefficient had stayed where it was
    rng = np.random.default_rng([904, zlib.crc32(b"windzigzag"), 0])
    trial = draw(rng, ("wind",), kind="zigzag")
    found = diagnose([trial.estimation], validate=[trial.validation])
    assert found.verdict == "named"
    (wind,) = found.causes
    truth = trial.truth[0].parameters
    for name in ("Wuu", "Wvv", "Wuv"):
        quantity = wind.parameters[name]
        assert abs(quantity.value - truth[name]) < 4 * quantity.std


def test_a_fit_that_is_held_by_slow_errors_is_loosened(changed: TrialLog) -> None:
    problem, atom, fit = _fitted(changed, MOMENT)
    good = problem.settle(problem.scan(fit, atom), 2)
    assert _loosened(problem, good) is good
    slow = 0.5 * np.sin(np.arange(len(changed)) / 60)
    wrong = [np.asarray(e) + slow[:, None] for e in good.errors]
    noise = fit_noise(wrong, problem.poles(good.point), 1.0, problem.groups)
    vector = good.point.vector()
    vector[problem.names.index("Yv")] *= 1.3
    point = good.point.at(vector)
    errors = problem.errors(point)
    nu, cost = problem.whitened(noise, errors)
    held = replace(good, point=point, noise=noise, nu=tuple(nu), errors=tuple(errors), cost=cost)
    found = _loosened(problem, held)
    assert found.cost < held.cost
    assert found.cost == pytest.approx(good.cost, abs=10)


@pytest.mark.long
def test_a_force_slower_than_gusts_is_not_nothing() -> None:
    trial = draw(np.random.default_rng([46, 1]), ("slow_force",), kind="manoeuvres")
    found = diagnose([trial.estimation], validate=[trial.validation])
    assert found.verdict == "unexplained"
    assert "remembered for longer than gusts" in found.remaining


@pytest.mark.long
def test_the_gain_of_a_lever_arm_is_that_of_the_sensors_frame() -> None:
    # the arm of some metres carries 0.1 m/s of the yaw rate's noise into a corrected log
    trial = draw(np.random.default_rng([46, 3]), ("lever_arm",), kind="pulses", positions=False)
    found = diagnose([trial.estimation], validate=[trial.validation])
    assert [c.id for c in found.causes] == ["lever_arm"]
    assert all(found.gain[s].after > found.gain[s].before for s in ("u", "v"))
    assert any("as its sensors show it" in note for note in found.notes)
    held = [r for r in found.runs if r.held_out]
    assert held


@pytest.mark.long
def test_a_current_beside_a_lag_stands_out_with_the_terms_that_it_frees() -> None:
    trial = draw(np.random.default_rng([46, 2]), ("current", "thruster_lag"), kind="pulses")
    found = diagnose([trial.estimation], validate=[trial.validation])
    assert {c.id for c in found.causes} == {"current", "thruster_lag"}


def test_a_run_without_a_covariance_is_judged_without_it(
    changed: TrialLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, atom, fit = _fitted(changed, MOMENT)
    rows = problem.rows(fit.point, fit.noise)
    monkeypatch.setattr(Problem, "rows", lambda *_: [1e200 * r for r in rows])
    numbers, covariance = problem.covariance(fit)
    assert covariance.shape == (len(numbers),) * 2
    assert np.isinf(covariance).all()
    # nothing speaks for a cause whose numbers have no covariance
    assert _sure(_OneProblem(problem), _candidate(problem, atom, fit)).p_value == 1.0
    monkeypatch.setattr(Problem, "settle", lambda self, fit, rounds=2: replace(fit, cost=0.0))
    pair = Pair(problem, fit, problem, replace(fit, cost=60.0))
    found = disagreement([pair])
    assert found.fall == 60.0
    assert found.p_value == pytest.approx(chi2.sf(30.0, len(fit.point.places)))


@pytest.mark.long
def test_variances_stay_positive_where_numbers_are_hardly_known() -> None:
    # a run at the edge of stability: rounding had left a negative variance, and no verdict
    rng = np.random.default_rng([907, zlib.crc32(b"dead_bandpulses"), 2])
    trial = draw(rng, ("dead_band",), kind="pulses")
    found = diagnose([trial.estimation], validate=[trial.validation])
    assert found.verdict == "unexplained"
