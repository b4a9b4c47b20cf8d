"""Plans after which a model predicts best: what they minimise, and what they keep."""

from __future__ import annotations

import json
from argparse import Namespace
from dataclasses import replace

import numpy as np
import pytest
from designs import limited_ship, make_request, ship_file, thesis_model

from experiment_design import for_prediction
from experiment_design.command import Planned, _idle_cap, _shorter
from experiment_design.constraints.limits import Circle, TrialLimits
from experiment_design.design import CLOSEST
from experiment_design.excitation.rollout import Rollout
from experiment_design.feasibility.constraint_satisfaction import ConstraintSatisfaction
from experiment_design.for_causes import AskedCauses, open_causes
from experiment_design.for_prediction import (
    _crossed,
    _vague_note,
    command_ranges,
    design_for_prediction,
    diagnosed_misfit,
    operating_envelope,
    planning_model,
    prior_misfit,
    shown_settings,
    started_in,
)
from experiment_design.information.envelope import _sensitivities, build_envelope
from experiment_design.optimise.envelope_search import (
    exchange_settings,
    one_sided,
    usual_beginnings,
    usual_manoeuvres,
)
from experiment_design.output.next_steps import after_design
from experiment_design.prepare import both_sides, prepare_request
from experiment_design.request.request import DesignRequest, OutOfReach, build_problem
from greybox.commands.main import main
from greybox.errors import InfeasibleError, UsageError
from greybox.model.model import ManoeuvringModel
from greybox.model.predictor import build_predictor
from greybox.model.semi_empirical import semi_empirical_model
from greybox.study.chapter6 import TRUE
from greybox.vessel.thrust import ThrustLaw
from greybox.vessel.vessel import Limits, Thruster, Vessel

BOTH = ((("u", 1),),)


def request_of(**changes):
    changes = {"regimes": BOTH, "limits": TrialLimits(margins={"u": 0.2}), **changes}
    return make_request(**changes)


def envelope_of(request, seed=0, speeds=None, shown=None, **given):
    predictor = build_predictor(request.structure, "basic", (("u", (1, -1)),))
    rollout = Rollout(
        request.vessel, request.structure, request.theta, request.d, request.starts[0],
        request.sample_time, request.integrator,
    )  # fmt: skip
    ranges = {n: (float(v.lower), float(v.upper)) for n, v in request.vessel.limits.items()}
    return build_envelope(
        rollout, predictor, request.noise, request.schedule, ranges | given, speeds,
        np.full(3, 0.2), seed, shown,
    )  # fmt: skip


@pytest.fixture(scope="module")
def envelope():
    return envelope_of(request_of())


def motion_of(envelope, samples=150, seed=1):
    rng = np.random.default_rng(seed)
    return envelope.rollout.run(envelope.draw(samples, rng)[None])


def test_the_errors_are_those_of_output_error(envelope) -> None:
    motion = motion_of(envelope)
    noise, unknown = envelope.errors(motion)
    rows, every = _sensitivities(envelope.rollout, envelope.predictor, envelope._features, motion)
    assert every == 1
    # in deviations of the output error
    s = rows[0] / np.sqrt(envelope.variance)[:, None]
    s = s.reshape(-1, s.shape[-1])
    p, draws = len(envelope.predictor.columns), 2000
    rng = np.random.default_rng(2)
    by_noise = s.T @ rng.standard_normal((len(s), draws))
    beta = np.zeros((s.shape[1], draws))
    beta[p:] = rng.standard_normal((s.shape[1] - p, draws))
    beta[p:] /= np.sqrt(envelope._precision[p:, None])
    normal = s.T @ s + np.diag(envelope._precision)
    # the prior means of the coefficients are 0
    for off, told in (
        (np.linalg.solve(normal, by_noise), noise),
        (np.linalg.solve(normal, s.T @ (s @ beta)) - beta, unknown),
    ):
        for i, w in enumerate(envelope._moments):
            each = np.einsum("an,ab,bn->n", off, w, off)
            assert told[0, i] == pytest.approx(each.mean(), abs=5 * each.std() / np.sqrt(draws))


def test_each_part_is_left_out_in_turn(envelope) -> None:
    motion = motion_of(envelope, 160)
    whole = envelope.information(motion)[0]
    parts = envelope._by_part(motion, np.array([0]), 4)[:, 0]
    np.testing.assert_allclose(parts.sum(axis=0), whole, rtol=1e-9, atol=1e-9 * whole.max())
    found = envelope.error_without_parts(motion, 0.0, 4)[0]
    each = []
    for part in parts:
        left = np.linalg.inv(whole - part + np.diag(envelope._precision))
        each.append([np.sum(w * left) for w in envelope._moments])
    # directions that are hardly excited are held by 1e-9 of what is told
    assert found == pytest.approx(np.mean(each), rel=1e-3)
    assert found > sum(envelope.errors(motion)).mean()


def test_the_moments_are_those_of_free_runs(envelope) -> None:
    # one coefficient a little off moves free runs by its sensitivity
    r = envelope.rollout
    name = "Yv"
    place = r.structure.index(name)
    column = next(i for i, c in enumerate(envelope.predictor.columns) if name in c.terms)
    step = 1e-4 * abs(TRUE[name])
    theta = r.theta.copy()
    theta[place] += step
    other = Rollout(r.vessel, r.structure, theta, r.d, r.start, r.sample_time, r.integrator)
    samples = int(20 * envelope.time_scale / r.sample_time)
    moved, spread = [], []
    for seed in range(60):
        commands = envelope.draw(samples, np.random.default_rng([3, seed]))[None]
        x = r.run(commands).state[0, 1:, :3]
        moved.append((other.run(commands).state[0, 1:, :3] - x) / step)
        spread.append(x)
    variance = np.concatenate(spread).var(axis=0)
    mean = (np.concatenate(moved) ** 2).mean(axis=0) / variance
    told = [w[column, column] for w in envelope._moments]
    # sequences of another draw: within a third
    np.testing.assert_allclose(told[1], mean[1], rtol=0.35)


def test_forces_that_mislead_move_free_runs_by_the_misfit(envelope) -> None:
    samples = int(20 * envelope.time_scale / envelope.rollout.sample_time)
    off = []
    for seed in range(12):
        motion = motion_of(envelope, samples, seed)
        off.append(envelope.misled(motion, 100))
        assert off[-1].shape == (100, samples + 1, 3)
        assert not off[-1][:, 0].any()
    told = np.sqrt(np.mean(np.square(off), axis=(0, 1, 2))) / envelope.spread
    # no variance is negative, so a state may be given more than its misfit
    assert (told > 0.7 * envelope.misfit).all()
    assert told.min() < 1.4 * envelope.misfit.min()
    # a steady error in surge is a distance
    run = envelope.rollout.moved(motion, np.broadcast_to([0.1, 0.0, 0.0], off[-1][:1].shape))
    before, after = motion.state[0, -1], run.state[0, -1]
    assert after[0] - before[0] == pytest.approx(0.1)
    assert after[3] == before[3]
    turned = envelope.rollout.moved(motion, np.broadcast_to([0, 0, 1e-3], off[-1][:1].shape))
    dt = envelope.rollout.sample_time
    assert turned.state[0, -1, 3] - before[3] == pytest.approx(1e-3 * samples * dt)


def test_a_trial_goes_to_both_sides(envelope) -> None:
    motion = motion_of(envelope)
    r = motion.state[..., 2]
    both = replace(envelope, reached=np.vstack([envelope.reached, -envelope.reached]))
    turned = replace(motion, state=np.abs(motion.state))
    assert one_sided(both, turned)[0] == pytest.approx(0.35)
    share = min((r > 0).mean(), (r < 0).mean())
    assert one_sided(both, motion)[0] >= 0.35 - share - 1e-12
    # a ship that turns to one side only is not asked to do otherwise
    alone = replace(envelope, reached=np.abs(envelope.reached))
    assert one_sided(alone, turned)[0] == 0.0


def test_a_setting_that_leaves_the_speeds_is_held_for_as_long_as_it_does_not() -> None:
    request = request_of()
    # many settings end below 0.55 of the slowest speed
    found = envelope_of(request, speeds=(2.8, 2.7))
    low, high = found.speeds
    assert (low, high) == pytest.approx((0.55 * 2.8, 1.1 * 2.7))
    dt, scale = request.sample_time, found.time_scale
    kept = np.round(found.lasting / dt).astype(int)
    # few are missing, and each is held half a length at least
    assert len(found.settings) > 990
    assert 0.5 * scale <= found.lasting.min() < found.lasting.max() <= 6 * scale
    long = found.rollout.run(np.repeat(found.settings[:, None], int(60 * scale / dt), axis=1))
    surge = long.state[..., 0]
    short = found.lasting < found.lasting.max()
    assert 0.05 < short.mean() <= (surge < low).any(axis=1).mean()
    for i in np.flatnonzero(short):
        assert (surge[i, : kept[i] + 1] >= low).all()
        assert surge[i, kept[i] + 1] < low
        assert long.state[i, kept[i], :3] == pytest.approx(found.reached[i])
    # a plan that has such settings one after the other leaves the speeds and is not taken
    problem = build_problem(replace(request, starts=(found.rollout.start,)))
    best = exchange_settings(
        problem, found, lambda m: found.error_without_parts(m, 0.0, 4) ** -1, 1, effort=0.1
    ).candidate
    plan = found.rollout.run(problem.commands(best.unit)[None])
    assert found.within(plan).all()
    assert not found.within(long).all()


def test_more_samples_leave_less_and_a_run_that_escapes_nothing(envelope) -> None:
    short, long = motion_of(envelope, 100), motion_of(envelope, 400)
    assert envelope.errors(long)[0].sum() < envelope.errors(short)[0].sum()
    lost = replace(short, stable=np.array([False]))
    assert not np.isfinite(envelope.errors(lost)[0]).any()
    # another trial's moments add to its own
    known = envelope.information(long)[0]
    assert envelope.errors(short, known)[0].sum() < envelope.errors(long)[0].sum()


def test_usual_manoeuvres_go_to_both_sides_at_two_speeds(envelope) -> None:
    hold = envelope.time_scale
    levels = usual_manoeuvres(envelope, 60, hold)
    assert levels.shape == (60, 3)
    states = np.array(
        [envelope.reached[np.abs(envelope.settings - v).sum(axis=1).argmin()] for v in levels]
    )
    assert states[:, 2].max() > 0 > states[:, 2].min() or np.ptp(states[:, 2]) > 0
    assert np.ptp(states[:, 0]) > 0
    assert len(usual_manoeuvres(envelope, 5, hold)) == 5


def test_usual_beginnings_are_zigzags_and_turns_for_a_stated_share(envelope) -> None:
    hold = envelope.time_scale
    found = usual_beginnings(envelope, 100, hold)
    assert found.shape[1:] == (15, 3)
    rate = envelope.reached[
        [[np.abs(envelope.settings - v).sum(axis=1).argmin() for v in e] for e in found], 2
    ]
    for zigzag, turn in zip(rate[::4], rate[2::4], strict=True):
        # legs of three lengths, and the turn is one of them
        assert list(zigzag[:3]) == list(turn[:3])
        assert len(set(zigzag)) == 2
        assert zigzag[3] == zigzag[5] != zigzag[6]
        assert len(set(turn)) == 1
    # two legs at least, and never more than a third
    assert usual_beginnings(envelope, 24, hold).shape[1] == 6
    assert usual_beginnings(envelope, 9, hold).shape[1] == 3


@pytest.fixture(scope="module")
def model() -> ManoeuvringModel:
    found = thesis_model(spread=0.02)
    verdict = {"prediction": {"level": "poor", "fit": {"u": 40.0, "v": 70.0, "r": 90.0}}}
    return replace(found, record={"verdict": verdict})


@pytest.fixture(scope="module")
def found(model):
    request = request_of(duration=200.0, covariance=model.covariance)
    return design_for_prediction(request, model)


def test_a_plan_leaves_less_than_random_sequences(found) -> None:
    assert found.random > 1.2
    total = {n: np.hypot(found.noise[n], found.misfit[n]) for n in found.noise}
    assert set(total) == {"u", "v", "r"}
    assert all(np.isfinite(v) and v > 0 for v in total.values())
    told = found.to_dict()
    assert told["for"] == "prediction"
    assert told["prediction"]["prior"] == "poor"
    assert json.dumps(told["prediction"])
    # of the best of 200, which leave less than their median does
    gain = told["efficiency_vs_random"]
    assert 1 < gain < found.random**2
    assert told["random_kept"] > 0
    assert told["efficiency_of"].startswith("mean squared error of predictions")
    assert f"leaves {gain:.2f} times the mean squared error" in found.summary()
    assert "the mean would predict" not in found.summary()
    assert "poor" in found.headline()
    error = np.hypot(found.noise["r"], found.misfit["r"])
    assert f", r {error:.2g} rad/s (rms" in found.headline()
    # commands stay in the envelope, the motion keeps way on
    commands = found.design.commands[0]
    for i, (low, high) in enumerate(found.commands.values()):
        assert commands[:, i].min() >= low - 1e-9
        assert commands[:, i].max() <= high + 1e-9
    assert found.design.motions[0].state[0, :, 0].min() > 0.2 - 1e-3


def test_random_steps_are_left_out_where_they_are_not_known(found) -> None:
    said = f"; after random steps of the same length by {found.random:.2f} times as much"
    assert said in found.headline()
    several = replace(found, random=float("nan"))
    assert several.headline() == found.headline().replace(said, "")
    assert several.to_dict()["prediction"]["random_error_over_this"] is None


def test_a_trial_begins_with_a_usual_manoeuvre_that_judges_the_estimate(found, envelope) -> None:
    validation, trial = found.to_dict()["parts"]
    assert (validation["part"], validation["from"]) == ("validation", 0.0)
    assert (trial["part"], trial["to"]) == ("trial", 200.0)
    assert trial["from"] == validation["to"]
    assert found.to_dict()["prediction"]["validation_share"] == validation["share"] <= 1 / 3
    assert f"the first {100 * validation['share']:.0f} % of each trial" in found.summary()
    r = found.design.request
    begin = round(trial["from"] / r.sample_time)
    plan = found.design.to_pandas()
    assert list(plan["part"]) == ["validation"] * begin + ["trial"] * (len(plan) - begin)
    # one or two settings, of which the ship's own rates may make ramps
    held = found.design.levels[0][: round(trial["from"] / r.hold)]
    assert len(np.unique(held.round(6), axis=0)) <= 2


@pytest.mark.long
def test_the_same_request_gives_the_same_plan(found, model) -> None:
    again = design_for_prediction(request_of(duration=200.0, covariance=model.covariance), model)
    assert np.array_equal(again.design.commands[0], found.design.commands[0])
    assert again.misfit == found.misfit


def test_the_misfit_of_a_prior_is_what_its_verdict_says(model) -> None:
    share, level = prior_misfit(model)
    assert share == pytest.approx([0.6, 0.3, 0.1])
    assert level == "poor"
    share, level = prior_misfit(replace(model, record={}))
    assert (share == 0.3).all()
    assert level == ""


def runaway(model):
    """Return a prior whose free run diverged with commands of its own logs held."""
    sentence = "its free run diverges or goes astern with 4 of 16 settings of the commands"
    because = [{"kind": "held_commands_diverge", "fatal": True, "sentence": sentence}]
    prediction = {"level": "poor", "fit": {"u": 88.0}, "because": because}
    ranges = {"u": [0.5, 2.5], "r": [-0.1, 0.1], "n": [12.0, 18.0]}
    return replace(model, record={"verdict": {"prediction": prediction}, "ranges": ranges})


def test_a_prior_that_runs_away_gives_way_to_main_dimensions(model) -> None:
    ship = limited_ship()
    prior = replace(runaway(model), vessel=ship)
    found, said = planning_model(prior, ship)
    assert found.record["method"] == "semi-empirical"
    assert "its free run diverges or goes astern with 4 of 16 settings" in said
    assert said.endswith("the ship's main dimensions take its place")
    assert "service speed 2.5 m/s" in found.record["notes"][0]
    # as the prior was used, and as little as it was trusted
    assert command_ranges(found, {})["n"] == command_ranges(prior, {})["n"]
    misfit, level = prior_misfit(found)
    assert level == "poor"
    assert (misfit == prior_misfit(replace(prior, record={}))[0]).all()
    # planned with as it is where it holds the commands, or too little of the ship is known
    steady = replace(prior, record={})
    assert planning_model(steady, ship) == (steady, "")
    bare = replace(ship, thrusters=tuple(replace(t, speed_limits=Limits()) for t in ship.thrusters))
    assert planning_model(replace(prior, vessel=bare), bare)[1] == ""


def test_a_plan_that_tells_nothing_says_what_helps() -> None:
    assert _vague_note(["u", "r"], 12).endswith("predict u, r no worse: lengthen it")
    said = _vague_note(["u"], 0)
    assert "the prior keeps none of 200 random sequences within the limits" in said
    assert said.endswith("or use --prior none")


def gained(**after):
    return {"gain": {s: {"before": 0.0, "after": fit, "ci": [0, 1]} for s, fit in after.items()}}


@pytest.mark.usefixtures("hasty")
def test_a_diagnosed_prior_errs_by_what_its_held_out_runs_missed(found, model, monkeypatch) -> None:
    diagnosis = gained(u=90.0, v=20.0, r=None)
    of_diagnosis = replace(model, record={"diagnosis": diagnosis})
    assert diagnosed_misfit(of_diagnosis) == pytest.approx({"u": 0.1, "v": 0.8})
    share, level = prior_misfit(of_diagnosis)
    # a plan allows for no less than for a prior that nothing is known of
    assert share == pytest.approx([0.3, 0.8, 0.3])
    assert level == "diagnosed"
    record = {"diagnosis": diagnosis, "remainder": gained(u=95.0) | {"added": True}}
    assert diagnosed_misfit(replace(model, record=record)) == pytest.approx({"u": 0.05})
    record["remainder"]["added"] = False
    assert diagnosed_misfit(replace(model, record=record)) == diagnosed_misfit(of_diagnosis)

    request = request_of(duration=200.0, effort=0.01, covariance=model.covariance)
    searched = []
    campaign = for_prediction._campaign

    def known(request, envelope, *more):
        searched.append(envelope)
        return campaign(request, envelope, *more)

    keeping = ConstraintSatisfaction(0.15, 0.12, 0.19, 400, np.zeros(1), {}, misled=True)
    monkeypatch.setattr(for_prediction, "_campaign", known)
    monkeypatch.setattr(
        for_prediction, "tighten", lambda request, searches, *_: (request, searches, keeping)
    )
    plan = design_for_prediction(request, of_diagnosis)
    assert plan.misfit["u"] >= 0.1 * searched[0].spread[0]
    assert plan.misfit["v"] >= 0.8 * searched[0].spread[1]
    said = plan.headline()
    assert "(u 10 %, v 80 % of the spread) is taken to stay" in said
    assert "Only its diagnosis tried the prior" in said
    assert "Only its diagnosis" not in found.headline()
    assert "assumed to miss 30 %" in replace(plan, level="", missed={}).headline()
    # a plan that breaks its limits is told as one, by its notes and by what comes next
    note = plan.design.notes[0]
    assert note.startswith("the limits are kept with probability 0.15, 0.9 was asked for: do not")
    assert "narrow --envelope" in note
    assert note in plan.summary()
    (step,) = after_design({}, True, plan.design.remedy)
    assert step.line().startswith("next: do not sail this plan as it is: shorten it (--duration)")
    assert found.design.remedy == ""
    # half the duration is tried, and its command told where it keeps the limits
    options = Namespace(
        target=None, duration=900.0, remaining=None,
        typed=["design", "--vessel", "my ship.toml", "--duration=900", "--out", "plan.csv"],
    )  # fmt: skip
    planned, tried = Planned(plan.design, plan, (), {}), []

    def again(design):
        return lambda halved: tried.append(halved.duration) or replace(planned, design=design)

    command = "greybox design --vessel 'my ship.toml' --duration 450 --out plan.csv"
    assert _shorter(options, planned, again(found.design)) == command
    assert _shorter(options, planned, again(plan.design)) == ""
    assert _shorter(options, replace(planned, design=found.design), again(found.design)) == ""
    assert tried == [450.0, 450.0]
    (step,) = after_design({}, True, plan.design.remedy, (), command)
    assert step.line().endswith(f"half the duration keeps its limits, as was tried: {command}")


def test_a_highest_speed_that_limits_nothing_is_told() -> None:
    model = replace(thesis_model(), record={"ranges": {"u": (2.6, 7.6)}})
    (told,) = _idle_cap(14.0, model)
    assert told == ("--speed-cap 14 m/s limits nothing, as the ship goes 7.6 m/s; 14 kn is 7.2 m/s")
    assert _idle_cap(8.0, model) == _idle_cap(None, model) == []


def test_an_envelope_ends_at_the_limits_of_the_commands() -> None:
    with pytest.raises(UsageError, match=r"of n, 25 to 30, lies beyond its limits, 10 to 20: name"):
        envelope_of(request_of(), n=(25.0, 30.0))
    found = envelope_of(request_of(), n=(15.0, 30.0))
    assert (found.lower[0], found.upper[0]) == (15.0, 20.0)


def test_ranges_are_those_of_the_trial_to_both_sides(model) -> None:
    assert command_ranges(model, {})["alpha1"] == (0.6, 1.1)
    ship = limited_ship(angles=(-1.0, 1.0))
    shown = {"n": [12.0, 16.0], "alpha1": [-0.1, 0.4], "alpha2": [-0.5, 0.0]}
    ranges = command_ranges(replace(model, vessel=ship, record={"ranges": shown}), {})
    assert ranges["n"] == pytest.approx((11.6, 16.4))
    assert ranges["alpha1"] == pytest.approx((-0.45, 0.45))
    given = command_ranges(replace(model, vessel=ship), {"n": (11.0, 13.0)})
    assert given["n"] == (11.0, 13.0)


def test_settings_lie_between_those_that_the_trial_showed() -> None:
    request = request_of()
    columns = request.schedule.commands
    (n, one, other), (low, high) = (columns.index(c) for c in ("n", "alpha1", "alpha2")), (0.6, 1.1)
    shown = np.zeros((3, 3))
    shown[:, n], shown[:, one], shown[:, other] = (
        (12.0, 18.0, 18.0), (low, high, low), (low, high, high),
    )  # fmt: skip
    found = envelope_of(request, shown=shown).settings
    # barycentric coordinates in the triangle of what was shown
    corners = np.vstack([shown.T, np.ones(3)])
    shares = np.linalg.lstsq(corners, np.vstack([found.T, np.ones(len(found))]), rcond=None)[0]
    np.testing.assert_allclose(corners[:3] @ shares, found.T, atol=1e-4)
    assert shares.min() > -1e-4
    # each corner is used, and what lies between
    assert (shares > 0.9).any(axis=1).all()
    assert ((shares > 0.1).all(axis=0)).any()
    # a command whose range is given goes as far as that
    shown[:, n] = np.nan
    found = envelope_of(request, shown=shown).settings
    assert found[:, n].min() < 11
    assert found[:, n].max() > 19
    # the plane of both angles is a triangle
    assert found[:, one].max() > 1.0
    assert not ((found[:, one] > 1.0) & (found[:, other] < 0.7)).any()


def test_shown_settings_go_to_both_sides_and_as_far_as_ranges(model) -> None:
    ship = limited_ship(angles=(-1.0, 1.0))
    record = {"settings": {"n": [12.0, 16.0], "alpha1": [-0.1, 0.4], "alpha2": [0.2, 0.2]}}
    prior, names = replace(model, vessel=ship, record=record), ("n", "alpha1", "alpha2")
    found = shown_settings(prior, names, {})
    np.testing.assert_allclose(
        found, [[11.6, -0.15, 0.2], [16.4, 0.45, 0.2], [11.6, 0.15, -0.2], [16.4, -0.45, -0.2]]
    )
    given = shown_settings(prior, names, {"n": (11.0, 13.0)})
    assert np.isnan(given[:, 0]).all()
    np.testing.assert_array_equal(given[:, 1:], found[:, 1:])
    assert shown_settings(replace(prior, record={}), names, {}) is None


def test_a_prior_that_cannot_hold_the_ship_is_refused() -> None:
    request = request_of()
    theta = request.theta.copy()
    theta[request.structure.index("Xu")] = 0.4
    theta[request.structure.index("Xuu")] = 0.0
    with pytest.raises(InfeasibleError, match="--prior none"):
        envelope_of(replace(request, theta=theta))


def test_a_prior_of_another_ship_is_refused() -> None:
    request, model = request_of(), thesis_model(spread=0.02)
    thrusters = tuple(replace(t, speed="rpm") for t in model.vessel.thrusters)
    other = replace(model, vessel=replace(model.vessel, name="tug", thrusters=thrusters))
    with pytest.raises(UsageError, match="'tug', which has no n as '"):
        design_for_prediction(request, other)
    with pytest.raises(UsageError, match="'tug', which has no n as '"):
        open_causes(request, other, AskedCauses({"current": {}}, named=True))
    for asked in (DesignRequest(duration=100.0), DesignRequest(duration=100.0, criterion="A")):
        with pytest.raises(UsageError, match="'tug', which has no n as '"):
            prepare_request(other, asked, request.vessel)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    place = tmp_path_factory.mktemp("prediction")
    thesis_model(spread=0.02).save(place / "model.json")
    (place / "ship.toml").write_text(ship_file())
    return place


def test_the_command(files, capsys: pytest.CaptureFixture[str]) -> None:
    plan = files / "plan.csv"
    asked = ["design", "--vessel", str(files / "ship.toml"), "--model", str(files / "model.json"),
             "--duration", "120", "--out", str(plan), "--json", "-", "--process-noise",
             "0.002,0.002,0.0004", "--effort", "0.2", "--for", "prediction"]  # fmt: skip
    assert main(asked) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["prediction"]["random_error_over_this"] > 1
    assert plan.read_text().startswith("t,")
    (held,) = told["start_commands"]
    (note,) = [n for n in told["notes"] if "steady motion" in n]
    name, level = next(iter(held.items()))
    assert f"rad/s, psi 0 rad, held by {name} {level:.4g}" in note


@pytest.mark.usefixtures("hasty")
def test_the_command_with_a_prior_that_runs_away(files, capsys) -> None:
    prior = files / "runaway.json"
    runaway(thesis_model(spread=0.02)).save(prior)
    asked = ["design", "--vessel", str(files / "ship.toml"), "--model", str(prior), "--duration",
             "120", "--out", str(files / "away.csv"), "--effort", "0.2"]  # fmt: skip
    assert main(asked) == 0
    said = capsys.readouterr().out
    assert "planned without an estimated model, from main dimensions" in said
    assert (
        "Note: the prior is not planned with: its free run diverges or goes astern with 4 of 16"
        in said
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--for", "prediction", "--want", "Yv"], "leave out --want"),
        (["--for", "coefficients", "--envelope", "n=1:2"], "use --for prediction"),
        (["--envelope", "n"], "COLUMN=LOW:HIGH"),
        (["--envelope", "m=1:2"], "no command of"),
        (["--envelope", "n=3:2"], "give the lower first"),
    ],
)
def test_options_that_do_not_go_together(files, options, message, capsys) -> None:
    asked = ["design", "--vessel", str(files / "ship.toml"), "--model", str(files / "model.json"),
             "--duration", "100", "--out", str(files / "none.csv"), *options]  # fmt: skip
    assert main(asked) == 1
    assert message in capsys.readouterr().err
    assert not (files / "none.csv").exists()


def test_settings_are_exchanged_where_a_sequence_breaks_a_limit(envelope) -> None:
    """No random sequence keeps this margin for so long, and one that is mended does."""
    start = envelope.rollout.start
    request = request_of(duration=400.0, limits=TrialLimits(margins={"u": 1.8}), starts=(start,))
    problem = build_problem(request)
    search = exchange_settings(
        problem, envelope, lambda motion: np.zeros(len(motion.state)), 0, effort=0.15, tries=16,
        workers=1,
    )  # fmt: skip
    assert search.kept == 0
    assert search.reference.missed.max() > 0.1
    assert search.candidate.missed.max() == 0.0


def test_a_trial_starts_on_the_fastest_course_that_its_cap_allows(envelope) -> None:
    fast = started_in(request_of(), envelope, 0).starts[0]
    np.testing.assert_allclose(fast, envelope.rollout.start)
    cap = 0.8 * float(np.hypot(*fast[:2]))
    slow = started_in(request_of(limits=TrialLimits(speed_cap=cap)), envelope, 0)
    speed = float(np.hypot(*slow.starts[0][:2]))
    assert 0.8 * cap < speed <= cap
    held = np.repeat(slow.start_commands[0][None, None], 600, axis=1)
    np.testing.assert_allclose(envelope.rollout.run(held).state[0, -1, :3], slow.starts[0][:3])


@pytest.mark.long
@pytest.mark.usefixtures("hasty")
def test_a_course_is_begun_with_no_rudder_held_against_another() -> None:
    stern = Thruster(
        "propeller_rudder", -27.0, -3.0, "n1", rudder="d1", speed_limits=Limits(0.0, 5.0),
        rudder_limits=Limits(-0.6, 0.6), thrust=ThrustLaw("quadratic"),
    )  # fmt: skip
    twin = Vessel(
        "twin", 60.0, (stern, replace(stern, y=3.0, speed="n2", rudder="d2")), beam=11.0,
        mass=1.2e6, service_speed=7.0, sensors={"u_std": 0.02, "v_std": 0.02, "r_std": 0.001},
    )  # fmt: skip
    model = semi_empirical_model(twin)
    asked = DesignRequest(duration=300.0, predictor="basic")
    request = prepare_request(model, both_sides(asked, model), twin)
    envelope, _ = operating_envelope(request, model, {})
    first, rudders = envelope.begun[::2], envelope.begun[1::2]
    assert first[0] == first[1]
    assert not rudders.any()
    assert not envelope.rollout.start[1:].any()
    begun = started_in(replace(request, misfit=envelope.misled), envelope, 0)
    assert begun.start_commands[0][1] == begun.start_commands[0][3] == 0


@pytest.mark.long
def test_the_closest_plan_where_no_other_is_found(model) -> None:
    room = TrialLimits(margins={"u": 0.2}, area=Circle(0.0, 0.0, 8.0))
    request = request_of(duration=60.0, effort=0.01, limits=room)
    with pytest.raises(InfeasibleError, match="the sea room is too small") as told:
        design_for_prediction(request, model)
    design = design_for_prediction(request, model, best_effort=True).design
    assert design.status == CLOSEST
    assert str(told.value) in design.notes
    assert [x.name for x in design.broken] == ["sea room"]
    assert design.missed()[0].startswith("the sea room is missed by ")


@pytest.mark.long
@pytest.mark.usefixtures("hasty")
def test_the_closest_plan_to_a_margin_out_of_reach(model) -> None:
    """It says which margin it keeps, and is held against the one that was asked for."""
    told = OutOfReach(TrialLimits(margins={"u": 9.0}), None, "no motion keeps 9 m/s.")
    # so long a plan does not go to both sides at this speed
    limits = TrialLimits(margins={"u": 2.1})
    request = request_of(duration=300.0, effort=0.01, limits=limits, out_of_reach=told)
    found = design_for_prediction(request, model, best_effort=True)
    design = found.design
    assert design.status == CLOSEST
    kept = design.margins["u"]
    assert kept < 2.1
    # no random steps keep it either, so there are none to beat
    assert design.random_kept == 0
    assert "after random steps" not in found.headline()
    # the margin that it keeps is lower than the one that was to stand in
    assert "no motion keeps 9 m/s." in design.notes
    assert f"Use {design.request.stand_ins}, or shorten the trial." in " ".join(design.notes)
    assert f"this plan was designed for {design.request.stand_ins} instead" in design.notes
    # it hardly moves the ship
    assert any(n.startswith("after this trial the mean would predict") for n in design.notes)
    assert design.request.stand_ins == f"--margin-u {np.floor(1e3 * kept) / 1e3:g}"
    (report,) = design.broken
    assert report.missed == pytest.approx(9.0 - kept)


@pytest.mark.usefixtures("hasty")
def test_a_start_short_of_its_margins_is_led_in(model) -> None:
    request = request_of(duration=200.0, covariance=None, starts=(np.zeros(4),), effort=0.1)
    found = design_for_prediction(request, model, kept_starts=1)
    lead, validation, trial = found.to_dict()["parts"]
    assert [p["part"] for p in (lead, validation, trial)] == ["lead-in", "validation", "trial"]
    assert lead["from"] == 0.0
    assert lead["to"] == validation["from"] == found.design.lead_in_s > 0
    assert trial["from"] == validation["to"]
    assert trial["to"] == pytest.approx(lead["to"] + 200.0)
    # the margin holds behind the lead-in, which begins at rest
    assert found.design.motions[0].state[0, :, 0].min() >= 0.2 - 1e-3
    with pytest.raises(InfeasibleError, match="lead-in"):
        design_for_prediction(replace(request, hold=150.0, duration=300.0), model, kept_starts=1)


def test_a_sway_that_hardly_leaves_its_noise_is_not_cut_out() -> None:
    few, most = _crossed([(1.0, 3.0), (50.0, 53.0)], 100.0), _crossed([(0.0, 98.0)], 100.0)
    assert "from zero 2 times, 5 % of the trial: --margin-v of greybox estimate cuts" in few
    assert "for 98 % of the trial, so it tells little of sway" in most
    assert "once, 20 % of the trial" in _crossed([(10.0, 30.0)], 100.0)
