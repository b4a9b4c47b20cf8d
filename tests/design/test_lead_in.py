"""Lead-ins: from a start that cannot keep the margins into the regime, within the limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from designs import limited_ship, make_request

from experiment_design.constraints.limits import Circle, TrialLimits
from experiment_design.design import design_trial
from experiment_design.excitation.rollout import Rollout
from experiment_design.feasibility.checks import tells_enough
from experiment_design.optimise.campaign import own_moments
from experiment_design.optimise.lead_in import (
    LONGEST,
    _Shooting,
    after_lead_in,
    find_lead_in,
    short_of_margin,
)
from experiment_design.request.request import build_problem
from greybox.errors import InfeasibleError

MARGINS = {"u": 0.5, "v": 0.4}


def at_rest(**changes):
    limits = {"margins": MARGINS, **changes.pop("limits", {})}
    return make_request(starts=(np.zeros(4),), limits=TrialLimits(**limits), **changes)


def test_a_start_that_keeps_its_margins_needs_none() -> None:
    assert find_lead_in(make_request()) is None


@pytest.mark.parametrize("ship", [limited_ship(), limited_ship(0.5, 0.02)])
def test_it_ends_in_the_regime_within_the_limits(ship) -> None:
    request = at_rest(vessel=ship, limits={"speed_cap": 2.5, "area": Circle(0.0, 0.0, 300.0)})
    found = find_lead_in(request)
    assert found is not None
    assert found.seconds <= LONGEST
    # sailed by itself, from the start that was given
    schedule = replace(request.schedule, samples=round(found.seconds / request.sample_time))
    rollout = Rollout(
        request.vessel, request.structure, request.theta, request.d, request.starts[0],
        request.sample_time, request.integrator,
    )  # fmt: skip
    state = rollout.run(schedule.expand(found.levels)[None]).state[0]
    np.testing.assert_allclose(state[-1, :4], found.end)
    np.testing.assert_allclose(state[-1, 4:], found.place)
    assert state[-1, 0] >= 1.05 * MARGINS["u"]
    assert state[-1, 1] >= 1.05 * MARGINS["v"]
    assert np.hypot(state[:, 0], state[:, 1]).max() <= 2.5 + 1e-4
    assert not short_of_margin(found.after(request))


def test_the_trial_goes_on_from_the_last_commands() -> None:
    request = at_rest(vessel=limited_ship(0.5, 0.02))
    found = find_lead_in(request)
    assert found is not None
    after = found.after(request)
    rng = np.random.default_rng(0)
    s = after.schedule
    levels = s.within_reach(s.lower + (s.upper - s.lower) * rng.random((s.holds, 3)))
    both = np.concatenate([found.levels, levels])
    whole = replace(request.schedule, samples=s.samples + len(found.levels) * s.hold)
    np.testing.assert_allclose(whole.within_reach(both), both)
    np.testing.assert_allclose(whole.expand(both)[-s.samples :], s.expand(levels))


@pytest.mark.long
def test_a_design_keeps_rates_and_limits_from_its_first_command_on() -> None:
    limits = {"speed_cap": 2.5, "area": Circle(0.0, 0.0, 300.0)}
    design = design_trial(
        at_rest(vessel=limited_ship(0.5, 0.02), limits=limits, effort=0.05), workers=1
    )
    whole = design.from_first_command()
    lead, trial = design.parts
    assert (lead.name, trial.name) == ("lead-in", "trial")
    assert trial.seconds == 120.0
    assert len(whole.commands[0]) == trial.end
    steps = np.abs(np.diff(whole.commands[0], axis=0)).max(axis=0)
    np.testing.assert_array_less(steps, [0.5 + 1e-9, 0.02 + 1e-9, 0.02 + 1e-9])
    state = whole.motions[0].state[0]
    assert not state[0].any()
    assert np.hypot(state[:, 0], state[:, 1]).max() <= 2.5 + 1e-3
    assert state[round(lead.end) :, 0].min() >= MARGINS["u"] - 1e-3
    # the trial's own motion is the rest of it, its place counted from the lead-in's end
    own = design.motions[0].state[0]
    np.testing.assert_allclose(own[:, :4], state[-len(own) :, :4])
    np.testing.assert_allclose(own[0, -2:], 0.0, atol=1e-9)
    assert all(x.missed <= 1e-3 for x in design.limits)
    assert "lead-in of" in design.notes[0]
    # and what it is worth is that of the trial alone
    alone = build_problem(design.request).criterion.covariance(
        own_moments(build_problem(design.request), units_of(design))[0]
    )[0]
    np.testing.assert_allclose(design.covariance, alone)


def units_of(design):
    s = design.request.schedule
    return (design.levels[0] - s.lower) / (s.upper - s.lower)


def test_derivatives_are_carried_back_to_the_levels() -> None:
    s = replace(make_request(vessel=limited_ship(0.5, 0.02)).schedule, before=np.ones(3))
    rng = np.random.default_rng(1)
    levels, step = rng.random((2, s.holds, 3))
    weights = rng.standard_normal((s.samples, 3))
    change = (weights * (s.expand(levels + step) - s.expand(levels))).sum()
    assert (s.gather(weights) * step).sum() == pytest.approx(change)


def test_the_descent_has_the_exact_gradient() -> None:
    shooting = _Shooting(at_rest(limits={"speed_cap": 0.65, "area": Circle(0.0, 0.0, 20.0)}), 3)
    flat = np.random.default_rng(2).random(9)
    _, slope = shooting._cost(flat)
    moved = [
        (shooting._cost(flat + h)[0] - shooting._cost(flat - h)[0]) / 2e-6 for h in 1e-6 * np.eye(9)
    ]
    np.testing.assert_allclose(slope, moved, rtol=1e-4, atol=1e-4 * np.abs(slope).max())


@pytest.mark.parametrize(
    ("limits", "told"),
    [
        ({"speed_cap": 0.66}, "the speed cap of 0.66 m/s stops it. Use --speed-cap "),
        pytest.param(
            {"area": Circle(0.0, 0.0, 3.0)},
            "the sea room stops it. Enlarge it by ",
            marks=pytest.mark.long,
        ),
        pytest.param(
            {"margins": {"u": 0.5, "v": 3.4}},
            "the margin of sway of 3.4 m/s stops it, ",
            marks=pytest.mark.long,
        ),
    ],
)
def test_a_refusal_names_the_limit_and_what_helps(limits, told) -> None:
    request = at_rest(limits=limits)
    with pytest.raises(InfeasibleError, match="no lead-in of at most 120 s") as caught:
        find_lead_in(request, tells_enough)
    assert told in str(caught.value)
    if "margins" not in limits:
        return
    # the closest plan begins behind a lead-in to margins that leave its trial room
    closest = after_lead_in(request, tells_enough, best_effort=True)
    assert closest.lead_in is not None
    assert closest.stand_ins in str(caught.value)
    assert closest.as_asked().limits.margins == limits["margins"]


def test_commands_held_too_long_leave_no_room() -> None:
    with pytest.raises(InfeasibleError, match="held 130 s: use --hold 120 or less"):
        find_lead_in(at_rest(hold=130.0, duration=390.0))
