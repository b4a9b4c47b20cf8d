"""Causes against a force of motion and commands that has no name."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.diagnosis.evidence.held_out import Proof
from greybox.diagnosis.evidence.remainder import (
    anything,
    features,
    generic_force,
    motion_and_commands,
)
from greybox.diagnosis.evidence.standing import Standing, _own_arguments, standing
from greybox.diagnosis.preparing import prepare
from greybox.diagnosis.search import FIRST, Search, weighed
from greybox.study.blind import draw


def proof(gain: float, p: float) -> Proof:
    return Proof(gain, 1.0, p, np.zeros(1))


@pytest.mark.parametrize(
    ("beyond", "share", "half", "clear", "told", "stands"),
    [
        ((50.0, 1e-9), None, 1.0, 1e-9, 1e-9, True),
        # no better than the force without a name, which is no function of what it is
        ((3.0, 0.2), None, 1.0, 1e-9, 1e-9, False),
        # as good as a force of its own arguments
        ((-4.0, 0.8), 0.9, 1e-4, 1e-9, 1e-9, True),
        ((-4.0, 0.8), 0.7, 1e-4, 1e-9, 1e-9, False),
        ((-4.0, 0.8), 0.9, 0.2, 1e-9, 1e-9, False),
        # its value may be null once that force is there
        ((50.0, 1e-9), 0.9, 1e-4, 0.3, 1e-9, False),
        # it moves by less than it is, or by more
        ((50.0, 1e-9), 0.9, 1e-4, 1e-9, 0.1, True),
        ((50.0, 1e-9), 0.9, 1e-4, 1e-9, 0.4, False),
        # where it holds the run within bounds, nothing else speaks for it
        ((np.inf, 0.0), None, 1.0, 1e-9, 0.01, True),
        ((np.inf, 0.0), None, 1.0, 1e-9, 0.1, False),
    ],
)
def test_what_makes_a_cause_stand(beyond, share, half, clear, told, stands) -> None:
    found = Standing(proof(*beyond), share, half, np.zeros(1), clear, told)
    assert found.stands is stands


@pytest.fixture(scope="module")
def sailed():
    """A trial with a current, its base, and the fit with the current in force."""
    trial = draw(np.random.default_rng([3, 1]), ("current",), samples=600)
    ready = prepare([trial.estimation], [trial.validation], None, "thesis", None)
    base = ready.base()
    problem = ready.case.problem(base.integrator)
    hypothesis = next(a for a in ready.hypotheses if a.cause == "current")
    fit = problem.settle(problem.fit(problem.add(base.point, hypothesis), base.noise, most=FIRST))
    return ready, base, problem, hypothesis, fit


def test_features_are_functions_of_what_they_say(sailed) -> None:
    _, _, problem, _, fit = sailed
    run, start = problem.runs[0], fit.point.starts[0]
    knots = np.zeros((3, 0))
    made = features(run, fit, start, knots)
    assert len(made.arguments) == made.values.shape[1]
    of_u = [k for k, a in enumerate(made.arguments) if a == {"u"}]
    x = run.run(fit.point.ship, start).x
    north, east = fit.point.ship.current
    psi = run.log["psi"]
    through = x[:, 0] - np.cos(psi) * north - np.sin(psi) * east
    # the velocity through the water, not that over ground
    assert np.abs(made.values[:, of_u] - through[:, None]).max(axis=0).min() < 1e-12


def test_heading_time_and_past_commands_are_no_part_of_the_rival(sailed) -> None:
    _, _, problem, _, fit = sailed
    made = features(problem.runs[0], fit, fit.point.starts[0], np.zeros((3, 0)))
    kept = [a for a in made.arguments if motion_and_commands("u", a)]
    commands = set(problem.runs[0].log.vessel.commands)
    assert set.union(*map(set, kept)) <= {"u", "v", "r"} | commands
    assert len(kept) < sum(anything("u", a) for a in made.arguments)


def test_a_current_stands_because_no_force_of_motion_knows_the_heading(sailed) -> None:
    ready, base, problem, hypothesis, fit = sailed
    held = ready.case.held_out(fit.integrator)
    found = standing(problem, hypothesis, fit, held.pairs(fit), held.pairs(base))
    assert found.stands
    assert found.share is None
    assert found.moved.shape == (len(problem.numbers_of(fit.point, hypothesis)),)


def test_a_generic_force_takes_most_of_what_no_term_is_there_for() -> None:
    trial = draw(np.random.default_rng([3, 2]), ("uneven_damping",), samples=900)
    ready = prepare([trial.estimation], [trial.validation], None, "thesis", ["crossflow"])
    base = ready.base()
    (pair,) = ready.case.held_out(base.integrator).pairs(base)
    force = generic_force(pair)
    before = np.concatenate(pair.held_fit.errors)[:, 1]
    after = np.concatenate(force.errors)[:, 1]
    assert (after**2).sum() < 0.7 * (before**2).sum()
    # and what it predicts in the whitened errors is what it takes from the plain ones
    assert force.predicted.shape == force.seen.shape


def test_a_held_out_run_at_the_edge_of_stability_leaves_the_errors_as_they_are(
    sailed, monkeypatch: pytest.MonkeyPatch
) -> None:
    # its derivatives overflow, as those of a 1.2 m catamaran in a current did
    ready, base, *_ = sailed
    (pair,) = ready.case.held_out(base.integrator).pairs(base)
    pair.known.clear()
    slopes = type(pair.held).slopes

    def overflowing(self, point):
        return [s * (1e200 if self is pair.held else 1.0) for s in slopes(self, point)]

    monkeypatch.setattr(type(pair.held), "slopes", overflowing)
    force = generic_force(pair)
    assert np.isfinite(force.predicted).all()
    monkeypatch.setattr(
        type(pair.held), "slopes", lambda self, point: [np.inf * s for s in slopes(self, point)]
    )
    pair.known.clear()
    force = generic_force(pair)
    assert not force.predicted.any()
    assert all(
        np.array_equal(a, b) for a, b in zip(force.errors, pair.held_fit.errors, strict=False)
    )


def test_own_arguments_are_those_of_the_terms_factors(sailed) -> None:
    ready, _, problem, _, _ = sailed
    hypotheses = {a.key: a for a in ready.hypotheses}
    use = _own_arguments(problem, hypotheses["cubic_damping:X_uuu"])
    assert use is not None
    assert use("u", frozenset({"u"}))
    assert not use("u", frozenset({"u", "v"}))
    assert not use("r", frozenset({"u"}))
    assert _own_arguments(problem, hypotheses["current"]) is None
    assert _own_arguments(problem, hypotheses["thruster_lag:force"]) is None


def test_a_search_without_causes_is_left_as_it_is(sailed) -> None:
    ready, base, *_ = sailed
    found = Search(base, base, (), (), 1)
    assert weighed(ready.case, found) == found
