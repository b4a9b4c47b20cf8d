"""The error budget against errors whose parts are known."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from greybox.diagnosis.budget import MOTION, REST, SENSOR, Taken, error_budget
from greybox.diagnosis.diagnose import diagnose
from greybox.diagnosis.evidence.held_out import Pair
from greybox.diagnosis.preparing import prepare
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


def mean_over_orders(part: np.ndarray, others: list[np.ndarray], i: int) -> float:
    """What adding a part adds to the squared error, the mean over all orders of adding."""
    added = []
    for order in permutations(range(len(others) + 1)):
        before = sum((others[k - 1][:, i] for k in order[: order.index(0)]), np.zeros(len(part)))
        added.append(((before + part[:, i]) ** 2).sum() - (before**2).sum())
    return float(np.mean(added))


def test_shares_are_those_of_the_series_that_were_added(pair: Pair) -> None:
    one, other = two_series(pair)
    e1 = pair.held_fit.errors[0]
    base = beside(pair, one, other)
    causes = [
        Taken("current", [beside(pair, one)], [beside(pair, other)], 0.0),
        Taken("wind", [beside(pair, other)], [beside(pair, one)], 0.0),
    ]
    budget = {p.part: p for p in error_budget([base], [pair], causes, None, 0)}
    e0 = base.held_fit.errors[0]
    for i, state in enumerate("uvr"):
        whole = (e0[:, i] ** 2).sum()
        assert sum(p.share[state] for p in budget.values()) == pytest.approx(1.0)
        for name, c in (("current", one), ("wind", other)):
            brute = mean_over_orders(c, [other if c is one else one, e1], i) / whole
            share = budget[name].share[state]
            assert share == pytest.approx(brute, abs=1e-9)
            low, high = budget[name].ci[state]
            assert low <= share <= high
            assert budget[name].after[state] == 0.0


def test_the_noise_of_the_sensors_has_its_own_share(pair: Pair) -> None:
    one, _ = two_series(pair)
    base = beside(pair, one)
    taken = Taken("current", [beside(pair, one)], [pair], 0.0)
    budget = {p.part: p for p in error_budget([base], [pair], [taken], None, 0)}
    e0 = base.held_fit.errors[0]
    true = 2e-4 * len(e0) / (e0[:, 2] ** 2).sum()
    assert budget[SENSOR].share["r"] == pytest.approx(true, rel=0.15)
    assert abs(budget[MOTION].share["r"]) < 0.02
    assert abs(budget[REST].share["r"]) < 0.1


def test_an_uncertain_cause_has_a_wider_interval(pair: Pair) -> None:
    one, _ = two_series(pair)
    base = beside(pair, one)

    def width(relative: float) -> float:
        taken = Taken("current", [beside(pair, one)], [pair], relative)
        parts = error_budget([base], [pair], [taken], None, 0)
        low, high = next(p for p in parts if p.part == "current").ci["u"]
        return high - low

    assert width(0.3) > 3 * width(0.0)


def test_a_run_that_leaves_every_bound_has_no_budget(pair: Pair) -> None:
    escaped = replace(pair, held_fit=replace(pair.held_fit, cost=np.inf))
    assert error_budget([escaped], [pair], [], None, 0) == ()


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
