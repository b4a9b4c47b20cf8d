"""What a cause has to stand before it counts, at the edges of what can be computed too."""

from __future__ import annotations

import zlib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from changing import BASE, MOMENT, OneProblem, candidate, changed_log, fitted
from scipy.stats import chi2

from greybox.diagnosis import search as searching
from greybox.diagnosis.diagnose import diagnose
from greybox.diagnosis.evidence.held_out import HeldOut, OtherLogs, Pair, proof_of, worse
from greybox.diagnosis.evidence.omnibus import disagreement
from greybox.diagnosis.fitting import Problem
from greybox.diagnosis.scores import MOMENTS
from greybox.diagnosis.search import Step, _wald_checked, assess_candidate
from greybox.diagnosis.ship import LogRun
from greybox.numerics.recursion import propagate
from greybox.study.blind import draw
from greybox.trial.log import TrialLog
from greybox.trial.segments import split_segments


@pytest.fixture(scope="module")
def changed() -> TrialLog:
    """A pulse trial whose sway damping grows at a moment."""
    return changed_log()


def test_a_change_counts_for_as_many_causes_as_moments_were_tried(changed: TrialLog) -> None:
    nothing = proof_of(np.zeros(100))
    _, hypothesis, fit = fitted(changed, MOMENT)
    worse = replace(fit, cost=fit.cost + 20.0)
    found = assess_candidate(nothing, worse, fit, hypothesis, 10)
    assert found.p_adjusted == pytest.approx(found.p_value * 10 * MOMENTS)
    plain = replace(
        hypothesis, parameters=tuple(replace(p, reach=0.0) for p in hypothesis.parameters)
    )
    assert assess_candidate(nothing, worse, fit, plain, 10).p_adjusted == pytest.approx(
        10 * found.p_value
    )


def test_the_robust_covariance_must_bear_a_cause_out(changed: TrialLog) -> None:
    problem, hypothesis, fit = fitted(changed, MOMENT)
    found = problem.settle(problem.scan(fit, hypothesis), 2)
    real = _wald_checked(OneProblem(problem), candidate(problem, hypothesis, found))
    k = problem.numbers_of(found.point, hypothesis)[0]
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
    none = _wald_checked(OneProblem(problem), candidate(problem, hypothesis, still))
    assert none.p_value > 0.3
    assert not none.holds


def test_the_likelier_of_two_stories_counts_twice(changed: TrialLog) -> None:
    problem, hypothesis, fit = fitted(changed, MOMENT)
    plain = problem.fit(problem.drop(fit.point, hypothesis), fit.noise)
    # two models alike on the held-out log but for a little: neither proves much
    held = OtherLogs(problem, problem)
    close = problem.fit(fit.point.at(fit.point.vector()), fit.noise)
    once = proof_of(held.contributions(plain) - held.contributions(close))
    assert held.prove(plain, close).p_value == pytest.approx(min(1.0, 2 * once.p_value))
    back = proof_of(held.contributions(close) - held.contributions(plain))
    assert held.prove(close, plain).p_value == pytest.approx(back.p_value)


def test_held_out_errors_have_a_colour_of_their_own(changed: TrialLog) -> None:
    problem, _, fit = fitted(changed, MOMENT)
    rough = replace(
        changed,
        channels=changed.channels
        | {"u": changed["u"] + 0.1 * np.random.default_rng(4).standard_normal(len(changed))},
    )
    (pair,) = OtherLogs(problem, Problem([LogRun(BASE, rough, "rk4")])).pairs(fit)
    before, after = (noise.groups[0].sensor[0] for noise in (fit.noise, pair.held_fit.noise))
    assert before == pytest.approx(0.014, rel=0.2)
    assert after == pytest.approx(0.101, rel=0.1)


def test_each_held_out_log_counts_alike_and_segments_of_one_log_once(changed: TrialLog) -> None:
    rows = np.arange(len(changed)) % 600 != 300
    gap = replace(
        changed,
        t=changed.t[rows],
        channels={n: c[rows] for n, c in changed.channels.items()},
        closed_loop=changed.closed_loop[rows],
    )
    logs = [*split_segments(gap), replace(changed, name="rough")]
    assert len(logs) > 2

    def run(own: float, rough: float) -> SimpleNamespace:
        sizes = [own] * (len(logs) - 1) + [rough]
        return SimpleNamespace(
            integrator="rk4",
            errors=[np.full((len(g), 3), size) for g, size in zip(logs, sizes, strict=True)],
        )

    held = SimpleNamespace(
        structure=SimpleNamespace(states=("u", "v", "r")),
        runs=[SimpleNamespace(log=log) for log in logs],
    )

    class Given(HeldOut):
        def _pairs(self, fit):
            raise AssertionError

        def pairs(self, fit):
            return [SimpleNamespace(held=held, held_fit=fit)]

    known, one, two = Given(), run(0.1, 10.0), run(0.2, 9.0)
    assert known.squares(one).shape == (2, 3)
    assert known.squares(one)[0] == pytest.approx(len(gap) * 0.01)
    # the squares of both logs together are smaller, and yet most of what was predicted is worse
    assert known.squares(two).sum() < known.squares(one).sum()
    assert worse(lambda _: known, two, one) == pytest.approx(np.log(2.0) + np.log(0.9))
    away = run(np.inf, 10.0)
    assert worse(lambda _: known, away, one) == np.inf
    assert worse(lambda _: known, one, away) == -np.inf
    assert worse(lambda _: known, away, away) == 0.0


def test_causes_that_take_each_others_place_end_the_search(
    changed: TrialLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, hypothesis, fit = fitted(changed, MOMENT)
    one, two = (
        replace(candidate(problem, hypothesis, fit), hypothesis=replace(hypothesis, key=key))
        for key in ("a", "b")
    )
    steps = []

    def take(case, fit, causes, hypotheses, passed_over):
        assert passed_over == 0
        steps.append([c.hypothesis.key for c in causes])
        taken = two if causes and causes[0].hypothesis.key == "a" else one
        return Step(fit, (), (taken,), taken)

    def newest_alone(case, fit, causes, tried):
        return fit, causes[-1:]

    monkeypatch.setattr(searching, "take_step", take)
    monkeypatch.setattr(searching, "_backward", newest_alone)
    found = searching.search(OneProblem(problem), fit, [])
    assert steps == [[], ["a"], ["b"]]
    assert [c.hypothesis.key for c in found.causes] == ["a"]


def test_a_run_whose_squares_leave_every_number_ends_the_fit(
    changed: TrialLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, _, fit = fitted(changed, MOMENT)
    slopes = problem.own_slopes(fit.point)
    monkeypatch.setattr(Problem, "own_slopes", lambda *_: [(1e200 * s, at) for s, at in slopes])
    found = Problem(problem.runs).fit(fit.point, fit.noise)
    assert not found.converged
    np.testing.assert_array_equal(found.point.vector(), fit.point.vector())


def test_a_run_without_a_covariance_is_judged_without_it(
    changed: TrialLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, hypothesis, fit = fitted(changed, MOMENT)
    rows = problem.rows(fit.point, fit.noise)
    monkeypatch.setattr(Problem, "rows", lambda *_: [1e200 * r for r in rows])
    numbers, covariance = problem.covariance(fit)
    assert covariance.shape == (len(numbers),) * 2
    assert np.isinf(covariance).all()
    # nothing speaks for a cause whose numbers have no covariance
    assert _wald_checked(OneProblem(problem), candidate(problem, hypothesis, fit)).p_value == 1.0
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
    # no cause is a dead band: of commands that all push one way, thrust that grows faster than the
    # speed is a part of it, and so is a constant force against them
    assert found.verdict != "named"
    assert {c.id for c in found.causes} <= {"quadratic_thrust", "side_force"}
    against = [c.parameters["Y_0"].value for c in found.causes if c.id == "side_force"]
    push = trial.estimation["n1"] * np.sin(trial.estimation["alpha1"])
    assert all(value * push.min() < 0 for value in against)
    stds = [q.std for c in (*found.causes, *found.candidates) for q in c.parameters.values()]
    assert np.isfinite(stds).all()


@pytest.mark.long
def test_a_current_beside_a_lag_stands_out_with_the_terms_that_it_frees() -> None:
    trial = draw(np.random.default_rng([46, 2]), ("current", "thruster_lag"), kind="pulses")
    found = diagnose([trial.estimation], validate=[trial.validation])
    assert {c.id for c in found.causes} == {"current", "thruster_lag"}


def test_derivatives_that_no_number_holds_are_infinite() -> None:
    found = propagate(np.full((5, 2, 2), np.nan), np.ones((5, 2, 3)), np.zeros((2, 3)))
    assert found.shape == (6, 2, 3)
    assert not np.isfinite(found[1:]).any()
