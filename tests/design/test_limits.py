"""Limits: their values, their derivatives, and what a sequence may do between two levels."""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
import pytest
from designs import limited_ship, make_request

from experiment_design.command import add_arguments
from experiment_design.constraints.limit_program import LimitProgram
from experiment_design.constraints.limits import LIMITS, Circle, Circumstances, TrialLimits
from experiment_design.excitation.schedule import make_schedule
from experiment_design.feasibility.checks import feasible_or_reason, unexcited
from experiment_design.feasibility.constraint_satisfaction import (
    keep_probability,
    keeps_start,
    tighten,
)
from experiment_design.feasibility.least_violation import moved_constant
from experiment_design.optimise.campaign import covariance_of
from experiment_design.optimise.search import assess
from experiment_design.request.request import build_problem
from greybox.errors import UsageError, VesselError
from greybox.model.catalogue import get_structure
from greybox.vessel.toml import load_vessel
from greybox.vessel.vessel import Limits

ROOM = np.array([[-60.0, -40.0], [90.0, -40.0], [90.0, 20.0], [30.0, 60.0], [90.0, 110.0],
                 [-60.0, 110.0]])  # fmt: skip


def inside(corners, point):
    """Winding number of a polygon around a point, by angles."""
    away = corners - point
    angle = np.arctan2(away[:, 1], away[:, 0])
    turn = np.diff(np.append(angle, angle[0]))
    turn = (turn + np.pi) % (2 * np.pi) - np.pi
    return abs(turn.sum()) > np.pi


def test_distance_to_a_sea_room_that_is_not_convex():
    request = make_request(limits=TrialLimits(area=ROOM, position=(5.0, 7.0)), regimes=((),))
    program = build_problem(request).scenarios[0].limits
    rng = np.random.default_rng(0)
    state = np.zeros((300, 6))
    state[:, 4:] = rng.uniform(-120, 150, (300, 2))
    found = program.path_values(state)[0]
    for value, place in zip(found, state[:, 4:] + [5.0, 7.0], strict=True):
        nearest = np.inf
        for a, b in zip(ROOM, np.roll(ROOM, -1, axis=0), strict=True):
            t = np.clip((place - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
            nearest = min(nearest, np.linalg.norm(place - a - t * (b - a)))
        sign = -1 if inside(ROOM, place) else 1
        assert value == pytest.approx(sign * nearest, abs=1e-5)


def test_every_limit_has_its_derivative():
    limits = TrialLimits(
        margins={"u": 1.2, "v": 0.85}, area=Circle(10.0, 20.0, 25.0), speed_cap=1.5, yaw_cap=0.03,
        end={"x_n": (0.0, 5.0), "psi": (1.0, 0.1)}, energy=0.2, headings=5.0, clearance=3.0,
    )  # fmt: skip
    request = make_request(
        limits=limits, vessel=limited_ship(0.5, 0.02), d=np.array([0.2, 0.1, 0, 0])
    )
    problem = build_problem(request)
    rng = np.random.default_rng(2)
    unit = rng.random(problem.shape)
    h = problem.gradient(unit, None, 1.0)[3]
    multipliers = rng.random(h.size) * 0.1
    _, _, slope, _ = problem.gradient(unit, multipliers, 2.0)
    for k, c in ((0, 0), (4, 1), (9, 2), (11, 0)):
        ends = []
        for step in (1e-6, -1e-6):
            moved = unit.copy()
            moved[k, c] += step
            ends.append(problem.gradient(moved, multipliers, 2.0)[1])
        difference = (ends[0] - ends[1]) / 2e-6
        assert slope[k, c] == pytest.approx(difference, rel=1e-4, abs=1e-5 * abs(slope).max())


def test_every_limit_has_an_option_a_field_words_and_advice():
    limits = TrialLimits(
        margins={"u": 0.6, "v": 0.5}, margin_air=0.7, area=Circle(0.0, 0.0, 90.0), speed_cap=1.5,
        yaw_cap=0.03, end={"psi": (1.0, 0.1)}, energy=0.2, headings=5.0,
    )  # fmt: skip
    request = make_request(limits=limits, predictor="wind", d=np.array([0.0, 0.0, 3.0, 4.0]))
    found = build_problem(request).scenarios[0].limits.all_limits
    assert [type(x) for x in found] == sorted(map(type, found), key=lambda k: k.order)
    assert {type(x) for x in found} == set(LIMITS.values())
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    for limit in found:
        assert limit.option in parser._option_string_actions
        assert hasattr(limits, limit.field)
        said = limit.advice(0.04, Circumstances(0.0, lambda: 30.0))
        assert limit.words in said or f"{limit.bound:g} {limit.unit}" in said
        assert said.endswith(".")
    room = next(x for x in found if x.field == "area")
    eased, helps = room.eased(limits, 12.3)
    assert eased.clearance == -13.0
    assert helps == "Enlarge it by 13 m on every side"


def test_margins_see_the_current():
    """u_r and u must both keep their sign (5.7)."""
    request = make_request(d=np.array([0.3, 0.0, 0.0, 0.0]))
    program = build_problem(request).scenarios[0].limits
    state = np.zeros((2, 6))
    state[:, 0], state[:, 1] = 0.7, 0.5
    state[1, 3] = np.pi
    values = program.path_values(state)
    assert values[0, 0] == pytest.approx(0.5 - (0.7 - 0.3))
    assert values[0, 1] == pytest.approx(0.5 - 0.7)
    assert values[1, 0] == pytest.approx(0.4 - 0.5)


def test_the_velocity_through_the_air_keeps_a_margin_of_either_sign():
    """|u_q| and |v_q| of (5.3) from the law of cosines, wind 3 north and 4 east."""
    request = make_request(
        predictor="wind", d=np.array([0.0, 0.0, 3.0, 4.0]), limits=TrialLimits(margin_air=0.7)
    )
    program = build_problem(request).scenarios[0].limits
    names = [n.words for n in program.path_limits[2:]]
    assert names == ["margin of surge through the air", "margin of sway through the air"]
    assert program.path_limits[3].option == "--margin-air"
    state = np.zeros((1, 6))
    state[0, :4] = 1.5, 1.2, 0.0, 0.4
    ground = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]]) @ state[0, :2]
    through = ground - [3.0, 4.0]
    along = np.array([np.cos(0.4), np.sin(0.4)])
    expected = [0.7 - abs(through @ along), 0.7 - abs(through @ [-along[1], along[0]])]
    np.testing.assert_allclose(program.path_values(state)[2:, 0], expected, atol=1e-12)
    with pytest.raises(UsageError, match="through the air is -1 m/s"):
        TrialLimits(margin_air=-1.0)


def test_ramps_keep_the_rates():
    ship = limited_ship(speed=2.0, angle=0.02)
    schedule = make_schedule(ship, 100.0, 10.0, 1.0)
    assert schedule.ramp == (5, 10, 10)
    assert schedule.reach[0] == np.inf
    assert schedule.reach[1] == pytest.approx(0.2)
    rng = np.random.default_rng(1)
    levels = schedule.within_reach(rng.uniform(schedule.lower, schedule.upper, (7, 10, 3)))
    commands = schedule.expand(levels)
    step = np.abs(np.diff(commands, axis=1)).max(axis=(0, 1))
    assert (step <= np.array([2.0, 0.02, 0.02]) + 1e-9).all()
    # gathering is the transpose of expanding
    weight = rng.standard_normal((100, 3))
    there = (schedule.expand(levels[0]) * weight).sum()
    back = (levels[0] * schedule.gather(weight)).sum()
    assert there == pytest.approx(back)


def test_a_last_hold_that_is_cut_short():
    schedule = make_schedule(limited_ship(), 35.0, 10.0, 1.0)
    assert schedule.holds == 4
    assert schedule.expand(np.zeros((4, 3))).shape == (35, 3)
    assert schedule.gather(np.ones((35, 3)))[-1, 0] == 5


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"margins": {"u": -1.0}}, "margin of u is -1 m/s"),
        ({"speed_cap": 0.0}, "the speed cap is 0"),
        ({"energy": -1.0}, "the energy share is -1"),
        ({"headings": 0.0}, "heading coverage is 0"),
        (
            {"signs": {"u": 1, "v": 1}, "margins": {"u": 0.6, "v": 0.8}, "speed_cap": 0.9},
            "need a speed of at least 1 m/s, the cap is 0.9 m/s",
        ),
    ],
)
def test_limits_that_cannot_be(change, message):
    with pytest.raises(UsageError, match=message):
        TrialLimits(**change)


def test_an_end_state_of_nothing():
    request = make_request(limits=TrialLimits(end={"w": (0.0, 1.0)}))
    with pytest.raises(UsageError, match="the end state names 'w'"):
        build_problem(request)


def test_holds_that_cannot_be():
    ship = limited_ship()
    with pytest.raises(UsageError, match="--hold 2"):
        make_schedule(ship, 100.0, 2.5, 1.0)
    with pytest.raises(UsageError, match="a trial of 15 s has no change of command"):
        make_schedule(ship, 15.0, 10.0, 1.0)
    with pytest.raises(VesselError, match=r"'n1', 'alpha1', .* have no limits.*angle_limits"):
        make_schedule(load_vessel("ferry"), 100.0, 10.0, 1.0)
    first, second = ship.thrusters
    apart = replace(second, speed_limits=Limits(25.0, 30.0))
    with pytest.raises(VesselError, match="limits of 'n' contradict: the lower one is 25"):
        make_schedule(replace(ship, thrusters=(first, apart)), 100.0, 10.0, 1.0)


def test_a_backoff_tightens_path_limits_only():
    request = make_request()
    plain = build_problem(request).scenarios[0]
    tight = LimitProgram(
        plain.rollout, request.schedule, request.trial_limits(0), backoff=(0.1, 0.2)
    )
    state = np.ones((1, 6))
    np.testing.assert_allclose(
        tight.path_values(state) - plain.limits.path_values(state), [[0.1], [0.2]]
    )


def test_a_steady_course_at_the_edge_of_its_limits_is_not_the_only_one_that_is_moved():
    # what the first steady course of this seed reaches itself: every change of it loses some
    edge = TrialLimits(margins={"u": 1.6947, "v": 1.06405})
    found = moved_constant(build_problem(make_request(duration=200.0, limits=edge)), 0)
    assert found is not None
    assert found.feasible


def test_where_only_what_tells_nothing_keeps_the_limits_the_limit_is_named():
    request = make_request()
    problem = build_problem(request)
    (silent,) = assess(problem, np.full((1, *problem.shape), 0.5))
    assert (silent.missed <= 0).all()
    assert silent.value == -np.inf
    telling = replace(silent, value=1.0, missed=np.array([0.2, 0.0]))
    chosen, reason = feasible_or_reason(problem, request, 0, telling, silent)
    assert chosen is telling
    assert reason.startswith("the margin of surge, 0.5 m/s, cannot be kept: 0.300 m/s is the most")
    _, reason = feasible_or_reason(problem, request, 0, replace(telling, value=-np.inf), silent)
    assert "regressor" in reason
    lively = replace(silent, value=1.0)
    assert feasible_or_reason(problem, request, 0, telling, lively) == (lively, "")


def test_a_constant_force_is_sent_to_output_error():
    """Instrumental variables take the means out, so nothing of it is left; sensitivities stay."""
    request, structure = make_request(), get_structure("thesis+X_0")
    known = dict(zip(request.structure.parameters, request.theta, strict=True))
    theta = np.array([known.get(n, 1e-3) for n in structure.parameters])
    request = replace(request, structure=structure, theta=theta)
    problem = build_problem(request)
    unit = np.random.default_rng(0).random(problem.shape)
    said = unexcited([problem], [unit], request)
    assert said.startswith("no sequence within these limits moves X_0: its regressor varies by 0.")
    assert "--estimator oe" in said
    free = build_problem(replace(request, estimator="oe"))
    assert np.isfinite(covariance_of([free], [unit])).all()


def test_models_that_all_run_away_keep_no_limit():
    request = make_request(limits=TrialLimits(margins={"u": 0.2, "v": 0.2}, speed_cap=5.0))
    spread = np.zeros(len(request.theta))
    for name in ("Xu", "Yv", "Nr"):
        # damping either drives her beyond every bound, or stops her with a jerk that grows
        spread[request.structure.index(name)] = 1e3
    request = replace(request, covariance=np.diag(spread**2))
    problem = build_problem(request)
    found = keep_probability(request, [np.full(problem.shape, 0.5)], draws=50)
    assert found.probability == 0.0
    assert not found.shortfall.any()
    assert found.margins["u"] == -np.inf


def test_models_begin_where_the_commands_at_the_start_hold_them():
    """A trial that slows down passes its cap at the start, under models that are faster."""
    held = np.array([15.0, 0.6, 0.6])
    request = make_request(duration=60.0, limits=TrialLimits(), regimes=((),))
    ends = request.rollout(request.starts[0]).run(np.repeat(held[None, None], 400, axis=1))
    start = np.append(ends.state[0, -1, :3], 0.0)
    spread = np.zeros(len(request.theta))
    spread[request.structure.index("Xmu")] = 0.2 * request.theta[request.structure.index("Xmu")]
    asked = replace(
        request, starts=(start,), start_commands=(held,), covariance=np.diag(spread**2),
        limits=TrialLimits(speed_cap=1.002 * float(np.hypot(*start[:2]))),
    )  # fmt: skip
    slow = [np.zeros(build_problem(asked).shape)]
    known = replace(asked, start_commands=())
    assert keep_probability(known, slow).probability > 0.99
    assert keep_probability(asked, slow).probability < asked.probability
    assert keeps_start(known, 0)
    assert not keeps_start(asked, 0)


def test_limits_that_cannot_be_tightened_as_much_are_tightened_half_as_much():
    request = make_request(duration=60.0, regimes=((),))
    request = replace(request, covariance=np.diag((0.1 * request.theta) ** 2))
    problem = build_problem(request)
    drawn = np.random.default_rng(0).random((60, *problem.shape))
    state = problem.scenarios[0].rollout.run(problem.commands(drawn)).state
    speed = np.hypot(state[:, 1:, 0], state[:, 1:, 1]).max(axis=1)
    slow, fast = int(speed.argmin()), int(speed.argmax())
    middle = int(np.argsort(speed)[len(speed) // 2])
    asked = replace(request, limits=TrialLimits(speed_cap=1.001 * float(speed[middle])))
    tried = []

    def again(tighter, _):
        tried.append(tighter.backoff)
        # too tight for any but a sequence that breaks the cap as it was asked for
        return fast if len(tried) == 1 else slow

    tighter, chosen, keeping = tighten(asked, middle, again, lambda which: [drawn[which]], 2)
    assert tried[1] == tighter.backoff == pytest.approx(0.5 * np.array(tried[0]))
    assert chosen == slow
    assert keeping.probability > keep_probability(asked, [drawn[middle]]).probability


def test_tightening_gives_up_no_limit_that_was_asked_for():
    """Margins kept more surely at the cost of the end state are no plan of this request."""
    request = make_request(duration=60.0)
    request = replace(request, covariance=np.diag((0.05 * request.theta) ** 2))
    problem = build_problem(request)
    drawn = np.random.default_rng(0).random((60, *problem.shape))
    state = problem.scenarios[0].rollout.run(problem.commands(drawn)).state
    sway = state[:, :, 1]
    slow, fast = int(sway.min(axis=1).argmin()), int(sway.min(axis=1).argmax())
    limits = TrialLimits(
        margins={"u": 0.1, "v": float(sway[slow].min())}, end={"v": (float(sway[slow, -1]), 0.01)}
    )
    assert abs(sway[fast, -1] - sway[slow, -1]) > 0.02
    asked = replace(request, limits=limits)
    assert keep_probability(asked, [drawn[fast]]).probability > 0.9

    def found(request):
        return tighten(request, slow, lambda *_: fast, lambda which: [drawn[which]], 2)

    tighter, chosen, keeping = found(asked)
    assert chosen == slow
    assert keeping.probability < 0.9
    assert not tighter.backoff
    free = replace(asked, limits=replace(limits, end={}))
    assert found(free)[1] == fast
