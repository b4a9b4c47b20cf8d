"""The error budget against errors whose parts are known."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from greybox.diagnosis.budget import (
    MOTION,
    REST,
    SENSOR,
    SwitchedOff,
    averaged,
    error_budget,
    errors_acting,
    errors_before,
    errors_without,
    without_share,
)
from greybox.diagnosis.builder import by_name, leave_out
from greybox.diagnosis.diagnose import diagnose
from greybox.diagnosis.evidence.held_out import Pair
from greybox.diagnosis.fitting import Problem
from greybox.diagnosis.hypothesis import Hypothesis
from greybox.diagnosis.point import Point
from greybox.diagnosis.preparing import prepare
from greybox.diagnosis.result import BudgetPart
from greybox.diagnosis.ship import Ship
from greybox.study.blind import draw


@pytest.fixture(scope="module")
def pair() -> Pair:
    """A ship of the family without any effect, its sensors' noise 0.014 m/s and rad/s."""
    trial = draw(np.random.default_rng([3, 9]), samples=800)
    ready = prepare([trial.estimation], [trial.validation], None, "thesis", ["current"])
    base = ready.base()
    (found,) = ready.case.held_out(base.integrator).pairs(base)
    return found


def beside(pair: Pair, *series: np.ndarray) -> Pair:
    """The pair with more error."""
    fit = pair.held_fit
    errors = [fit.errors[0] + sum(series)]
    return replace(pair, held_fit=replace(fit, errors=tuple(errors)))


def two_series(pair: Pair) -> tuple[np.ndarray, np.ndarray]:
    """Two errors that go together."""
    t = np.arange(len(pair.held_fit.errors[0]))[:, None]
    one = 0.05 * np.sin(2 * np.pi * t / 97) * np.ones(4)
    other = 0.5 * one + 0.02 * np.cos(2 * np.pi * t / 41)
    return one, other


def states_of(pair: Pair) -> np.ndarray:
    """The held-out errors of the states."""
    return pair.held_fit.errors[0][:, :3]


def off(pair: Pair, *series: np.ndarray, relative: float = 0.0) -> SwitchedOff:
    """A cause without which these series are left."""
    (errors,) = beside(pair, *series).held_fit.errors
    return SwitchedOff("current", errors[:, :3], relative)


def test_a_cause_takes_what_switching_it_off_does(pair: Pair) -> None:
    one, other = two_series(pair)
    base = beside(pair, one, other)
    causes = [off(pair, other), replace(off(pair, one), id="wind")]
    budget = {p.part: p for p in error_budget(states_of(base), [pair], causes, None, None, 0)}
    e0 = base.held_fit.errors[0]
    for i, state in enumerate("uvr"):
        whole = (e0[:, i] ** 2).sum()
        assert sum(p.share[state] for p in budget.values()) == pytest.approx(1.0)
        for cause in causes:
            share = budget[cause.id].share[state]
            assert share == pytest.approx(1 - (cause.errors[:, i] ** 2).sum() / whole, abs=1e-9)
            low, high = budget[cause.id].ci[state]
            assert low <= share <= high
            assert budget[cause.id].after[state] == 0.0
        # each takes what the two do only together
        both = -2 * (one * other)[:, i].sum() / whole
        assert budget[REST].share[state] == pytest.approx(both, abs=0.03)


def test_causes_of_one_name_are_one_part_of_the_error() -> None:
    trial = draw(np.random.default_rng([3, 9]), samples=300)
    ready = prepare([trial.estimation], [trial.validation], None, "thesis", ["asymmetry"])
    base = ready.base()
    problem, (one, two) = ready.case.problem(base.integrator), ready.hypotheses[:2]
    assert one.id == two.id
    assert one.key != two.key
    both = problem.add(problem.add(base.point, one), two)
    assert leave_out([one, two], problem, both).hypotheses == ()
    causes = [SimpleNamespace(hypothesis=h) for h in (one, two)]
    assert by_name(causes) == {"asymmetry": causes}


def test_a_cause_without_which_no_run_is_bounded_is_not_split(pair: Pair) -> None:
    one, _ = two_series(pair)
    lost = SwitchedOff("current", np.zeros((0, 3)), 0.1)
    budget = {
        p.part: p for p in error_budget(states_of(beside(pair, one)), [pair], [lost], None, None, 0)
    }
    assert "current" not in budget
    assert budget[REST].share["r"] > 0.8


def test_terms_without_a_name_belong_to_motion_and_commands(pair: Pair) -> None:
    one, other = two_series(pair)
    base = beside(pair, one, other)
    parts = error_budget(states_of(base), [pair], [], off(pair, other).errors, None, 0)
    found = next(p for p in parts if p.part == MOTION)
    e0, without = (p.held_fit.errors[0] for p in (base, beside(pair, other)))
    took = 1 - (without**2).sum(axis=0) / (e0**2).sum(axis=0)
    for i, state in enumerate("uvr"):
        assert found.share[state] == pytest.approx(took[i], abs=0.02)
        low, high = found.ci[state]
        assert low <= found.share[state] <= high
        assert abs(found.after[state]) < 0.02


def test_what_terms_do_beside_causes_only_cannot_be_split(pair: Pair) -> None:
    one, other = two_series(pair)
    base = beside(pair, one)
    # without them the model that has no causes would err more
    worse = off(pair, one, 5 * other).errors
    budget = {p.part: p for p in error_budget(states_of(base), [pair], [], worse, None, 0)}
    plain = {p.part: p for p in error_budget(states_of(base), [pair], [], None, None, 0)}
    for state in "uvr":
        assert budget[MOTION].share[state] == pytest.approx(plain[MOTION].share[state])
        assert budget[REST].share[state] == pytest.approx(plain[REST].share[state])


def test_the_noise_of_the_sensors_has_its_own_share(pair: Pair) -> None:
    one, _ = two_series(pair)
    base = beside(pair, one)
    budget = {p.part: p for p in error_budget(states_of(base), [pair], [off(pair)], None, None, 0)}
    e0 = base.held_fit.errors[0]
    true = 2e-4 * len(e0) / (e0[:, 2] ** 2).sum()
    assert budget[SENSOR].share["r"] == pytest.approx(true, rel=0.15)
    assert abs(budget[MOTION].share["r"]) < 0.02
    assert abs(budget[REST].share["r"]) < 0.1


def test_an_uncertain_cause_has_a_wider_interval(pair: Pair) -> None:
    one, _ = two_series(pair)
    base = beside(pair, one)

    def width(relative: float) -> float:
        cause = off(pair, relative=relative)
        parts = error_budget(states_of(base), [pair], [cause], None, None, 0)
        low, high = next(p for p in parts if p.part == "current").ci["u"]
        return high - low

    assert width(0.3) > 3 * width(0.0)


def test_a_run_that_leaves_every_bound_has_no_budget(pair: Pair) -> None:
    escaped = replace(pair, held_fit=replace(pair.held_fit, cost=np.inf))
    assert error_budget(states_of(pair), [escaped], [], None, None, 0) == ()
    assert error_budget(np.zeros((0, 0)), [pair], [], None, None, 0) == ()


def test_nothing_changes_where_nothing_is_switched_off(pair: Pair) -> None:
    errors = errors_without([pair], pair.fit, lambda _, point: point, lambda _: {})
    own = pair.held_fit.errors[0][:, :3]
    assert (errors**2).sum(axis=0) == pytest.approx((own**2).sum(axis=0), rel=0.02)


def test_coefficients_are_kept_where_no_fit_predicts_within_bounds(pair: Pair, monkeypatch) -> None:
    monkeypatch.setattr(Problem, "settle", lambda self, fit, *_: replace(fit, cost=np.inf))
    errors = errors_without([pair], pair.fit, lambda _, point: point, lambda _: {})
    own = states_of(pair)
    assert (errors**2).sum(axis=0) == pytest.approx((own**2).sum(axis=0), rel=0.1)


@pytest.mark.long
def test_a_current_takes_what_it_would_if_it_were_not_there() -> None:
    trial = draw(np.random.default_rng([5, 77]), ("current",), samples=900)
    still = draw(np.random.default_rng([5, 77]), ("current",), samples=900, size=0.0)
    found = diagnose([trial.estimation], validate=[trial.validation])
    none = diagnose([still.estimation], validate=[still.validation])
    assert [c.id for c in found.causes] == ["current"]
    share = {p.part: p for p in found.budget}["current"].share
    held = [next(r for r in d.runs if r.held_out) for d in (found, none)]
    for state in ("u", "v"):
        one, other = (float(((r.measured[state] - r.before[state]) ** 2).sum()) for r in held)
        assert share[state] == pytest.approx(1 - other / one, abs=0.10)


def test_a_cause_without_which_no_run_has_bounds_is_said_to_have_no_share() -> None:
    part = BudgetPart("current", {"u": 0.4}, {"u": (0.3, 0.5)}, {"u": 0.0})
    (said,) = without_share([part], ["current", "inertia_coupling"])
    assert "no share of the error is told of inertia_coupling" in said
    assert without_share([part], ["current"]) == without_share([], ["current"]) == []


def test_where_nothing_acts_late_the_errors_are_those_before(pair: Pair) -> None:
    before = errors_before([pair], pair.fit, lambda _: {})
    same = errors_acting([pair], pair.fit, lambda _, ship: ship, lambda _: {})
    np.testing.assert_allclose(same, before)


@pytest.mark.long
def test_a_lag_takes_what_the_logs_would_have_without_it() -> None:
    errors = {}
    for size in (1.0, 0.0):
        # one ship in one sea, her propellers late by a lag of 4.8 s or by none
        trial = draw(np.random.default_rng([5, 78]), ("thruster_lag",), samples=600, size=size)
        ready = prepare([trial.estimation], [trial.validation], None, "thesis", ["thruster_lag"])
        base, first = ready.base(), ready.case.first
        pairs = ready.case.held_out(base.integrator).pairs(base)
        errors[size] = errors_before(pairs, base, first)
        if size:
            value = np.array([trial.truth[0].number("lag")])
            lag = next(h for h in ready.hypotheses if h.key == "thruster_lag:speed")
            acting = partial(_acting_as, lag, value)
            mended = errors_acting(pairs, base, acting, first)
    late, prompt, mended = ((e**2).sum(axis=0) for e in (errors[1.0], errors[0.0], mended))
    assert (prompt < 0.8 * late).any()
    np.testing.assert_allclose(1 - mended / late, 1 - prompt / late, atol=0.1)


def _acting_as(hypothesis: Hypothesis, value: np.ndarray, _: Point, ship: Ship) -> Ship:
    assert hypothesis.apply is not None
    return hypothesis.apply(ship, value)


def test_causes_that_do_each_others_work_share_what_both_take() -> None:
    base = np.full((5, 3), 2.0)
    errors = {
        frozenset({"thruster_lag"}): np.full((5, 3), 1.0),
        frozenset({"rate_limit"}): np.full((5, 3), 1.5),
        frozenset({"thruster_lag", "rate_limit"}): np.full((5, 3), 0.5),
    }
    lag, rate = (averaged(base, errors, name) for name in ("thruster_lag", "rate_limit"))
    assert lag is not None
    assert rate is not None
    np.testing.assert_allclose(lag + rate, 2.0**2 - 0.5**2)
    np.testing.assert_allclose(lag, ((2.0**2 - 1.0) + (1.5**2 - 0.5**2)) / 2)
    # one of the runs leaves every bound
    errors[frozenset({"rate_limit"})] = np.zeros((0, 3))
    assert averaged(base, errors, "thruster_lag") is None
