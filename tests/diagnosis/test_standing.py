"""Causes against a force of motion and commands that has no name."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from greybox.diagnosis.evidence.features import features
from greybox.diagnosis.evidence.held_out import Proof
from greybox.diagnosis.evidence.remainder import (
    ANYTHING,
    MOTION_AIR_AND_COMMANDS,
    MOTION_AND_COMMANDS,
    _Pushers,
    generic_force,
)
from greybox.diagnosis.evidence.standing import Standing, _own_arguments, _rival, standing
from greybox.diagnosis.fitting import Problem
from greybox.diagnosis.preparing import prepare
from greybox.diagnosis.ruling import rule
from greybox.diagnosis.search import FIRST, Search, _stands, assess_candidate, weighed
from greybox.diagnosis.thresholds import PROVEN, SAME
from greybox.study.blind import draw
from greybox.vessel.vessel import Thruster, Vessel


def proof(gain: float, p: float) -> Proof:
    return Proof(gain, 1.0, p, np.zeros(1))


@pytest.mark.parametrize(
    ("beyond", "share", "half", "clear", "told", "known", "stands"),
    [
        ((50.0, 1e-9), None, 1.0, 1e-9, 1e-9, PROVEN, True),
        # no better than the force without a name, which is no function of what it is
        ((3.0, 0.2), None, 1.0, 1e-9, 1e-9, PROVEN, False),
        # as good as a force of its own arguments
        ((-4.0, 0.8), 0.9, 1e-4, 1e-9, 1e-9, SAME, True),
        ((-4.0, 0.8), 0.7, 1e-4, 1e-9, 1e-9, SAME, False),
        ((-4.0, 0.8), 0.9, 0.2, 1e-9, 1e-9, SAME, False),
        # its value may be null once that force is there
        ((50.0, 1e-9), 0.9, 1e-4, 0.3, 1e-9, SAME, False),
        # it moves by less than it is, or by more
        ((50.0, 1e-9), 0.9, 1e-4, 1e-9, 0.1, SAME, True),
        ((50.0, 1e-9), 0.9, 1e-4, 1e-9, 0.4, SAME, False),
        # what says that a log is wrong, or heading, time or earlier commands do, must be surer
        ((50.0, 1e-9), 0.9, 1e-4, 1e-9, 0.04, PROVEN, True),
        ((50.0, 1e-9), 0.9, 1e-4, 1e-9, 0.1, PROVEN, False),
        ((50.0, 1e-9), None, 1.0, 1e-9, 0.04, PROVEN, True),
        ((50.0, 1e-9), None, 1.0, 1e-9, 0.1, PROVEN, False),
        # where it holds the run within bounds, nothing else speaks for it, and many causes would:
        # 20 were tried
        ((np.inf, 0.0), None, 1.0, 1e-9, 4e-4, PROVEN, True),
        ((np.inf, 0.0), None, 1.0, 1e-9, 6e-4, PROVEN, False),
    ],
)
def test_what_makes_a_cause_stand(beyond, share, half, clear, told, known, stands) -> None:
    found = Standing(proof(*beyond), share, half, np.zeros(1), clear, told, known=known, tried=20)
    assert found.stands is stands


@pytest.mark.parametrize(
    ("beyond", "half", "clear", "told", "more"),
    [
        ((3.0, 0.2), 0.2, 1e-9, 1e-9, True),
        # it stands, or held-out logs speak against it
        ((3.0, 0.01), 0.2, 1e-9, 1e-9, False),
        ((3.0, 0.2), 0.01, 1e-9, 1e-9, False),
        ((-3.0, 0.8), 0.2, 1e-9, 1e-9, False),
        # no log would make it stand
        ((3.0, 0.2), 0.2, 0.2, 1e-9, False),
        ((3.0, 0.2), 0.2, 1e-9, 0.2, False),
    ],
)
def test_more_logs_are_asked_only_where_they_may_decide(beyond, half, clear, told, more) -> None:
    found = Standing(proof(*beyond), 0.9, half, np.zeros(1), clear, told)
    assert found.open is more


def test_what_makes_held_out_logs_less_likely_has_no_name() -> None:
    def candidate(gain: float) -> SimpleNamespace:
        return SimpleNamespace(
            told=None, standing=SimpleNamespace(stands=True), counts=True, proof=proof(gain, 0.5)
        )

    assert _stands(candidate(1.0))
    assert _stands(candidate(np.inf))
    assert not _stands(candidate(-200.0))


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


def test_in_the_mirror_of_port_and_starboard_each_feature_becomes_its_image() -> None:
    rng = np.random.default_rng(4)
    n = 40
    vessel = Vessel(
        "Twin", 20.0,
        (
            Thruster("propeller_rudder", -9.0, -2.0, "n_port", rudder="delta_port"),
            Thruster("propeller_rudder", -9.0, 2.0, "n_starboard", rudder="delta_starboard"),
            Thruster("azimuth", 8.0, 0.0, "n_bow", "alpha"),
            Thruster("tunnel", 6.0, 0.0, "n_tunnel"),
            Thruster("fixed", -5.0, 3.0, "n_alone"),
        ),
    )  # fmt: skip
    of = {c: rng.normal(size=n) for c in vessel.commands}
    mirrored = {
        "n_port": of["n_starboard"], "n_starboard": of["n_port"],
        "delta_port": -of["delta_starboard"], "delta_starboard": -of["delta_port"],
        "n_bow": of["n_bow"], "alpha": -of["alpha"], "n_tunnel": -of["n_tunnel"],
        "n_alone": of["n_alone"],
    }  # fmt: skip
    assert mirrored.keys() == of.keys()
    x, tau, way = rng.normal(size=(n, 3)), rng.normal(size=(n, 3)), np.array([1.0, -1.0, -1.0])
    ship = SimpleNamespace(vessel=vessel, wires=(), current=np.zeros(2))
    fit = SimpleNamespace(point=SimpleNamespace(ship=ship))

    class Log(dict):
        pass

    def made(commands, sign):
        log = Log(commands)
        log.vessel = vessel
        run = SimpleNamespace(
            states=("u", "v", "r"), log=log, run=lambda *_: SimpleNamespace(x=x * sign),
            forces=lambda *_: tau * sign, sample_time=0.5, time=np.arange(n), duration=n - 1,
            air_measured=False,
            structure=SimpleNamespace(inputs=("taux", "tauy", "taun")),
        )  # fmt: skip
        return features(run, fit, x[0], np.full((3, 1), 0.5))

    one, other = made(of, np.ones(3)), made(mirrored, way)
    has = one.signs != 0
    assert np.allclose(other.values[:, has], (one.signs * one.values[:, one.images])[:, has])
    # what has no image: the heading, and a thruster with none on the other side
    alone = [bool(a & {"heading", "n_alone"}) and not a & {"u", "v", "r"} for a in one.arguments]
    assert (has == ~np.array(alone)).all()
    assert sorted(one.images) == list(range(len(one.images)))


def test_prior_of_forces_that_keep_and_that_break_the_symmetry() -> None:
    # the second and third are images of each other, the last has none
    pushing = (("u", frozenset({"u"})),) * 4
    pushers = _Pushers(
        np.ones(1), ((0, 0),) * 4, pushing, np.array([1.0, -1.0, -1.0, 0.0]), np.array([0, 2, 1, 3])
    )
    every = pushers.used(ANYTHING)
    reflection = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, -1, 0, 0], [0, 0, 0, 0]])
    kept, broken = 0.7, 0.2
    root = pushers.deviations(every, kept, broken)
    own = (kept**2 + broken**2) / 2 * np.eye(4)
    expected = own + (kept**2 - broken**2) / 2 * reflection
    assert np.allclose(root @ root.T, expected, atol=1e-15)
    # alone, each keeps to its own
    assert np.allclose(pushers.deviations(every, 1.0, 0.0)[0, 0], 1.0)
    assert np.allclose(pushers.deviations(every, 0.0, 1.0)[0], 0.0)
    # one whose image takes no part is as free as both are together
    left = pushers.deviations(np.array([0, 1]), kept, broken)
    assert np.allclose(left @ left.T, expected[:2, :2], atol=1e-15)


def test_heading_time_and_past_commands_are_no_part_of_the_rival(sailed) -> None:
    _, _, problem, _, fit = sailed
    made = features(problem.runs[0], fit, fit.point.starts[0], np.zeros((3, 0)))
    kept = [a for a in made.arguments if MOTION_AND_COMMANDS.takes("u", a)]
    commands = set(problem.runs[0].log.vessel.commands)
    assert set.union(*map(set, kept)) <= {"u", "v", "r"} | commands
    assert len(kept) < sum(ANYTHING.takes("u", a) for a in made.arguments)


def test_a_current_stands_because_no_force_of_motion_knows_the_heading(sailed) -> None:
    ready, base, problem, hypothesis, fit = sailed
    held = ready.case.held_out(fit.integrator)
    found = standing(problem, hypothesis, fit, base, held, len(ready.hypotheses))
    assert found.stands
    assert found.share is None
    assert found.moved.shape == (len(problem.numbers_of(fit.point, hypothesis)),)


def test_what_becomes_free_with_a_cause_is_no_evidence_of_it(
    sailed, monkeypatch: pytest.MonkeyPatch
) -> None:
    ready, base, problem, hypothesis, fit = sailed
    assert hypothesis.co_freed
    held = ready.case.held_out(fit.integrator)
    effect = Problem.effect

    def no_current(*given):
        away, own, along = effect(*given)
        away[: len(hypothesis.columns)] = 0.0
        return away, own, along

    assert standing(problem, hypothesis, fit, base, held, 20).told < 1e-6
    monkeypatch.setattr(Problem, "effect", no_current)
    assert standing(problem, hypothesis, fit, base, held, 20).told == pytest.approx(1.0)


def test_logs_that_a_model_was_fitted_to_are_held_out_in_turn(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    trial = draw(np.random.default_rng([3, 2]), ("uneven_damping",), samples=600)
    ready = prepare([trial.estimation], [trial.validation], None, "thesis", None)
    base = ready.base()
    case = ready.case.wider((), "free run")
    problem, held = case.problem(base.integrator), case.held_out(base.integrator)
    hypothesis = next(a for a in ready.hypotheses if a.cause == "current")
    start = case.carried(base)
    without = problem.settle(start)
    fit = problem.settle(problem.fit(problem.add(start.point, hypothesis), without.noise))
    alone = standing(problem, hypothesis, fit, without, held, 20)
    other = held.exchanged()
    assert other is not None
    (pair,) = other.pairs(fit)
    # on the other log the same numbers are free, and they are those of that log
    assert pair.held is problem
    assert pair.problem is held.problem
    assert pair.fit.point.ship.current != pytest.approx(fit.point.ship.current, rel=1e-6)
    assert pair.fit.converged
    assert other.exchanged() is None
    monkeypatch.setattr(Standing, "open", True)
    both = standing(problem, hypothesis, fit, without, held, 20)
    counts = [sum(len(run.y) for run in p.runs) for p in (held.problem, problem)]
    assert len(alone.beyond.samples) == counts[0]
    np.testing.assert_array_equal(both.beyond.samples[: counts[0]], alone.beyond.samples)
    assert len(both.beyond.samples) == sum(counts)


@pytest.mark.long
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
    assert use.takes("u", frozenset({"u"}))
    assert not use.takes("u", frozenset({"u", "v"}))
    assert not use.takes("r", frozenset({"u"}))
    assert _own_arguments(problem, hypotheses["thruster_lag:force"]) is None
    # a damping keeps the symmetry of port and starboard, a constant side force breaks it
    parities = {a.cause: u.parity for a in ready.hypotheses if (u := _own_arguments(problem, a))}
    assert (parities["cubic_damping"], parities["crossflow"]) == (1, 1)
    assert (parities["side_force"], parities["angle_offset"]) == (-1, -1)
    assert _own_arguments(problem, hypotheses["current"]) is None


def test_a_search_without_causes_is_left_as_it_is(sailed) -> None:
    ready, base, *_ = sailed
    found = Search(base, base, (), (), 1)
    assert weighed(ready.case, found) == found


def test_what_may_be_chance_is_told_as_no_help(sailed) -> None:
    ready, base, _, hypothesis, fit = sailed
    held = ready.case.held_out
    current = assess_candidate(held(fit.integrator).prove(base, fit), base, fit, hypothesis, 20)
    assert current.p_adjusted < 1e-9
    alike = replace(current, p_adjusted=0.2)
    found = Search(base, base, (), (), 20, leaning=(current, alike))
    ruled = rule(found, held, (), (), {}, None)
    assert ruled.leaning == (current,)


@pytest.mark.long
def test_beside_a_measured_wind_a_current_is_weighed_against_forces_of_the_air_too() -> None:
    trial = draw(np.random.default_rng([3, 4]), ("wind",), samples=400)
    ready = prepare([trial.estimation], [trial.validation], None, "thesis", ["wind", "current"])
    base = ready.base()
    problem = ready.case.problem(base.integrator)
    by_cause = {a.cause: a for a in ready.hypotheses}
    assert _rival(problem, by_cause["current"]) is MOTION_AIR_AND_COMMANDS
    assert _rival(problem, by_cause["wind"]) is MOTION_AND_COMMANDS
    made = features(problem.runs[0], base, base.point.starts[0], np.zeros((3, 0)))
    of_air = [k for k, a in enumerate(made.arguments) if a == {"air"}]
    ahead, abeam = trial.estimation["u_q"], trial.estimation["v_q"]
    assert any(np.array_equal(made.values[:, k], abeam * np.abs(ahead)) for k in of_air)
    # in the mirror the air comes from the other side
    signs = {made.signs[k] for k in of_air if np.array_equal(made.values[:, k], abeam)}
    assert signs == {-1.0}
    assert not any(ANYTHING.takes("u", made.arguments[k]) for k in of_air)
    assert all(MOTION_AIR_AND_COMMANDS.takes("u", made.arguments[k]) for k in of_air)
