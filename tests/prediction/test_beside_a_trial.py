"""Predictions beside a trial: its own start, commands, rates and wind, and intervals of misfit."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from manoeuvring import LENGTH, LINEAR, RUDDER, model_of, rudder_model, rudder_ship

from greybox.model.catalogue import get_structure, structure_for
from greybox.prediction.predict import predict_manoeuvre
from greybox.rotation import ned_to_body
from greybox.trial.log import make_log
from greybox.trial.manoeuvres import find_manoeuvres
from greybox.vessel.force import force_inputs
from greybox.vessel.toml import vessel_from_dict

DEG = math.pi / 180
STEP = 0.25
FEW = {"draws": 40, "command": 12.0}
WIND = (3.0, -2.0)


def windy_model():
    """The ship of rudder and quadratic resistance, moved by the wind too."""
    vessel = rudder_ship()
    structure = structure_for("thesis", force_inputs(vessel))
    values = RUDDER | {"Wuu": -0.0008, "Wvv": -0.001, "Wuv": -0.00003}
    return model_of(structure, values, vessel, STEP)


def trial(
    model,
    sides,
    reversed_at,
    speed=2.4,
    approach=30.0,
    lasts=300.0,
    rate=math.inf,
    n=12.0,
    then=12.0,
):
    """Sail the model's own step as a trial: rudder angles in turn, each until its heading.

    The propeller speed is held from the first sample on, whatever the ship's speed is then,
    and another one from the order on.
    """
    step = model.step_function()
    windy = step.n_in() > 2
    x = np.zeros(len(model.step_states))
    x[model.step_states.index("u")] = speed
    where = [model.step_states.index(s) for s in ("u", "v", "r", "psi", "x_n", "y_n")]
    rows, delta, leg = [], 0.0, -1
    for k in range(round((approach + lasts) / STEP)):
        u, v, r, psi, north, east = x[where]
        if leg < 0 and k * STEP >= approach:
            leg = 0
        elif leg >= 0 and reversed_at and leg < 4:
            way = math.copysign(1.0, sides[leg % 2])
            leg += way * psi >= reversed_at[leg % 2]
        wanted = 0.0 if leg < 0 else sides[leg % 2]
        air = np.array([u, v]) - np.stack(ned_to_body(*WIND, psi))
        n = n if leg < 0 else then
        rows.append((k * STEP, u, v, r, psi, north, east, n, delta, *air))
        delta += np.clip(wanted - delta, -rate * STEP, rate * STEP)
        x = np.array(step(x, [n, delta], *([WIND] if windy else []))).ravel()
    names = ("t", "u", "v", "r", "psi", "x_n", "y_n", "n", "delta", "u_q", "v_q")
    channels = dict(zip(names, np.array(rows).T, strict=True))
    if not windy:
        channels = {k: c for k, c in channels.items() if k not in ("u_q", "v_q")}
    return make_log(model.vessel, channels, STEP, "trial")


def errors(made, which=0):
    """Return how far each quantity is from the measured one, relative."""
    rows = made.manoeuvres[which].agreement.rows
    return {r.name: abs(r.difference.value) / abs(r.measured.value) for r in rows}


def test_a_zigzag_starts_as_the_trial_did_though_the_ship_still_accelerates():
    """From a third of its speed; to port and starboard by their own angles and headings."""
    model = rudder_model(step=STEP)
    log = trial(model, (20 * DEG, -18 * DEG), (15 * DEG, 13 * DEG), speed=0.9, rate=0.1)
    made = predict_manoeuvre(model, "zigzag", trial=log, draws=40)
    found = errors(made)
    assert len(found) == 8
    assert max(found.values()) < 0.08, found
    (own,) = made.manoeuvres
    assert own.commands["n"].value == pytest.approx(12.0)
    # the ship would need less to hold the speed that it had for a moment
    held = predict_manoeuvre(model, "zigzag", trial=log, speed=0.9, draws=40)
    assert held.manoeuvres[0].commands["n"].value < 6.0
    assert max(errors(held).values()) > 0.3


def test_a_turn_is_sailed_in_the_wind_of_its_trial():
    model = windy_model()
    log = trial(model, (25 * DEG,), (), lasts=220.0)
    made = predict_manoeuvre(model, "turning", trial=log, draws=40)
    assert max(errors(made).values()) < 0.05, errors(made)
    assert any("in the wind of the trial, 3.6 m/s" in n for n in made.notes)
    calm = trial(rudder_model(step=STEP), (25 * DEG,), (), lasts=220.0)
    assert not any("wind" in n for n in predict_manoeuvre(
        rudder_model(step=STEP), "turning", trial=calm, draws=40).notes)  # fmt: skip


@pytest.mark.parametrize(("then", "told"), [(12.0, False), (6.0, True)])
def test_a_speed_loss_by_slower_propellers_is_said_to_be_no_loss_of_the_turn(then, told):
    model = rudder_model(step=STEP)
    log = trial(model, (25 * DEG,), (), lasts=220.0, then=then)
    made = predict_manoeuvre(model, "turning", trial=log, draws=40)
    assert (made.manoeuvres[0].quantities["speed_loss"].value > 0.3) == told
    said = "the propellers run at 12 before the order and at 6 in the turn: the speed loss"
    assert any(n.startswith(said) for n in made.notes) == told
    # a check of the trial says so too
    (turn,) = find_manoeuvres(log)
    assert any(n.startswith(said) for n in turn.notes) == told
    assert any("speed loss" in n for n in made.notes) == told


def in_current(log, north, east):
    """Return a log as it would be in water that flows [m/s]."""
    u, v = ned_to_body(north, east, log["psi"])
    moved = {"u": u, "v": v, "x_n": north * log.t, "y_n": east * log.t}
    channels = {n: c + moved.get(n, 0.0) for n, c in log.channels.items()}
    return make_log(log.vessel, channels, log.sample_time, log.name)


def test_a_turn_is_sailed_in_the_current_of_its_trial():
    """By which the circle drifts: the model itself knows of none."""
    model = rudder_model(step=STEP)
    still = trial(model, (25 * DEG,), (), lasts=220.0)
    made = predict_manoeuvre(model, "turning", trial=in_current(still, 0.2, -0.3), draws=40)
    assert max(errors(made).values()) < 0.05, errors(made)
    (told,) = (n for n in made.notes if "in the current of the trial" in n)
    assert "0.36 ±" in told
    assert "towards 304 deg" in told
    calm = predict_manoeuvre(model, "turning", trial=still, draws=40)
    assert not any("current" in n for n in calm.notes)


def test_a_trial_that_does_not_tell_its_current_is_sailed_in_the_models():
    current = {"current_north": (0.2, 0.01), "current_east": (-0.3, 0.01)}
    model = replace(rudder_model(step=STEP), disturbances=current)
    asked = {"side": "starboard", "angles": [20 * DEG]} | FEW
    log = predict_manoeuvre(model, "zigzag", current=True, **asked).manoeuvres[0].log
    made = predict_manoeuvre(model, "zigzag", trial=log, draws=40)
    told = "sailed in the model's current, 0.36 m/s towards 304 deg"
    assert any(n.startswith(told) for n in made.notes)
    still = predict_manoeuvre(model, "zigzag", trial=log, draws=40, current=False)
    assert not any("model's current" in n for n in still.notes)
    assert max(errors(made).values()) < 0.07
    assert max(errors(still).values()) > 0.15
    # without a trial the water is still
    alone = predict_manoeuvre(model, "zigzag", **asked)
    assert not any("model's current" in n for n in alone.notes)


def test_a_stop_starts_as_the_trial_did_though_the_ship_still_accelerates():
    """At its own propeller speeds, with which it would go faster yet."""
    model = rudder_model(step=STEP)
    log = trial(model, (0.02,), (), speed=2.0, approach=15.0, lasts=150.0, then=-6.0)
    made = predict_manoeuvre(model, "crash", trial=log, draws=40)
    found = errors(made)
    assert max(found[n] for n in ("head_reach", "track_reach", "stopping_time")) < 0.02, found
    assert made.manoeuvres[0].commands["n"].value == pytest.approx(12.0)
    assert any("starts from the trial's own state" in n for n in made.notes)


@pytest.mark.parametrize(("rate", "told"), [(math.inf, "at once"), (0.1, "at 5.73 deg per second")])
def test_the_rate_of_a_helm_is_that_of_its_motion(rate, told):
    """Not that of the rounding of a held angle, of which a turn has most samples."""
    model = rudder_model(step=STEP)
    log = trial(model, (20 * DEG,), (), lasts=150.0, rate=rate)
    rounded = log["delta"] + 1e-14 * np.random.default_rng(1).standard_normal(len(log))
    log = make_log(log.vessel, dict(log.channels) | {"delta": rounded}, STEP, "trial")
    made = predict_manoeuvre(model, "turning", trial=log, draws=40)
    assert any(f"no rate of delta; it moves {told}" in n for n in made.notes)
    limited = rudder_model(step=STEP, actuation={"rate_limit": 0.15, "rate_on": "delta"})
    own = predict_manoeuvre(limited, "turning", trial=log, draws=40)
    stated = [n.split(" of delta")[0] for n in own.notes if "it moves" in n]
    assert stated == (
        [] if rate > 0.15 else ["the vessel file states a rate of 8.59 deg per second"]
    )
    assert all(q is not None for q in made.manoeuvres[0].quantities.values())
    assert max(errors(made).values()) < 0.05


def test_a_limit_that_a_file_rounds_is_no_contradiction():
    model = rudder_model(step=STEP, rudder_limits=[-0.6108, 0.6108])
    made = predict_manoeuvre(model, "turning", side="port", angles=[35 * DEG], draws=40, command=12)
    assert made.manoeuvres[0].log["delta"].min() == pytest.approx(-0.6108)
    wide = trial(model, (40 * DEG,), (), lasts=150.0)
    (own,) = predict_manoeuvre(model, "turning", trial=wide, draws=40).manoeuvres
    assert own.log["delta"].max() == pytest.approx(40 * DEG)


def judged_model(share, own=None, judged_on="held-out", **more):
    """A model whose runs missed other logs by a share of u, v, r = 1 m/s, 0.3 m/s, 0.04 rad/s."""
    spread = dict(zip("uvr", (1.0, 0.3, 0.04), strict=True))
    prediction = {
        "level": "good", "judged_on": judged_on, "spread": spread,
        "noise": dict.fromkeys("uvr", 0.0),
        "rmse": {s: share * v for s, v in spread.items()},
        "memory": dict.fromkeys("uvr", 60.0),
    } | ({} if own is None else {"own_rmse": {s: own * v for s, v in spread.items()}})  # fmt: skip
    ranges = {"u": (0.5, 2.6), "v": (-0.5, 0.5), "r": (-0.08, 0.08), "n": (4.0, 12.0),
              "delta": (-0.5, 0.5)}  # fmt: skip
    record = {"ranges": ranges, "verdict": {"prediction": prediction}}
    return replace(rudder_model(step=STEP, **more), record=record)


def test_what_runs_on_other_logs_missed_is_in_the_intervals_of_one_manoeuvre():
    model = judged_model(0.05, judged_on="validation")
    made = predict_manoeuvre(model, "zigzag", side="port", angles=[10 * DEG], **FEW)
    assert made.manoeuvres[0].quantities["period"].std > 0.5
    assert "by how far its free runs were off on held-out logs" in " ".join(made.notes)


def test_draws_that_leave_every_bound_do_not_warn_where_the_misfit_is_sized():
    model = judged_model(0.05, judged_on="validation")
    covariance = np.zeros_like(model.covariance)
    i = model.names.index("X_|u|u*rudder_drag")
    covariance[i, i] = (20 * model.theta[i]) ** 2
    model = replace(model, covariance=covariance)
    (turn,) = predict_manoeuvre(model, "turning", side="port", **FEW).manoeuvres
    assert turn.diverged


@pytest.mark.long
def test_intervals_are_as_wide_as_runs_on_other_logs_missed():
    asked = {"side": "starboard", "angles": [20 * DEG]} | FEW

    def width(model):
        (turn,) = predict_manoeuvre(model, "turning", **asked).manoeuvres
        low, high = turn.quantities["steady_yaw_rate"].interval
        return high - low

    small, large = (width(judged_model(share, judged_on="validation")) for share in (0.05, 0.1))
    # twice 1.96 times 0.05 of 0.04 rad/s, less what averages out over a circle
    assert 0.3 * 0.0078 < small < 1.3 * 0.0078
    assert large == pytest.approx(2 * small, rel=0.25)
    assert width(judged_model(0.0)) < 1e-9
    # logs that were left out in turn say too much of a model that had them all
    less = width(judged_model(0.1, own=0.02))
    assert less == pytest.approx(0.6 * large, rel=0.3)
    # and two logs tell its size badly: Student's quantile at 2 is twice that of the normal one
    verdict = judged_model(0.1, judged_on="validation")
    verdict.record["verdict"]["prediction"] |= {"logs": ["a", "b"], "samples": 800}
    assert width(verdict) > 1.3 * large


@pytest.mark.long
def test_intervals_cover_ships_that_the_structure_misses():
    """Coefficients 8 % off and taken as exact: the model's errors on a log tell the width."""
    rng = np.random.default_rng(5)
    inside = total = 0
    for _ in range(2):
        true = rudder_model(step=STEP)
        share = 1 + 0.08 * rng.standard_normal(len(true.theta))
        ship = replace(true, theta=true.theta * share)
        zigzag = trial(ship, (25 * DEG, -25 * DEG), (25 * DEG, 25 * DEG))
        model = judged_on_run(true, zigzag)
        for kind, log in (
            ("zigzag", trial(ship, (-20 * DEG, 20 * DEG), (20 * DEG, 20 * DEG))),
            ("turning", trial(ship, (25 * DEG,), (), lasts=220.0)),
        ):
            made = predict_manoeuvre(model, kind, trial=log, draws=60)
            rows = made.manoeuvres[0].agreement.rows
            inside += sum(r.agrees for r in rows)
            total += len(rows)
    assert total == 2 * 20
    assert inside / total >= 0.85


def judged_on_run(model, log):
    """Return the model with its errors on a log, as `estimate --validate` stores them."""
    from greybox.validation.judge_prediction import HeldOut, JudgedOn, judge_prediction

    verdict = judge_prediction([HeldOut.of(model, log)], JudgedOn.VALIDATION)
    ranges = {n: (float(log[n].min()), float(log[n].max())) for n in ("u", "v", "r", "n", "delta")}
    record = {"ranges": ranges, "verdict": {"prediction": verdict.to_dict()}}
    return replace(model, record=record)


def test_a_zigzag_that_speeds_on_either_side_steer_is_found_and_predicted():
    side = {"type": "fixed", "x": -8.0}
    thrusters = [side | {"y": y, "speed": n} for y, n in ((-3.0, "port"), (3.0, "starboard"))]
    vessel = vessel_from_dict({"name": "Catamaran", "length": LENGTH, "thruster": thrusters})
    model = model_of(get_structure("linear"), LINEAR, vessel, 0.05)
    asked = {"side": "port", "angles": [15 * DEG], "share": 0.4}
    (source,) = predict_manoeuvre(model, "zigzag", **asked, **FEW).manoeuvres
    (found,) = find_manoeuvres(source.log)
    assert found.label == "zig-zag by speeds, reversed at 15 deg of heading, first to port"
    assert [c.reason for c in found.criteria] == ["no angle steers"]
    made = predict_manoeuvre(model, "zigzag", trial=source.log, draws=40)
    assert made.manoeuvres[0].order == pytest.approx(-0.4, rel=0.02)
    assert max(errors(made).values()) < 0.05, errors(made)


def test_a_helm_that_moves_acts_by_its_mean_over_each_sample():
    """A rate of 0.1 rad/s to 0.2 rad: half of each tenth at a sample of 1 s."""
    model = rudder_model(step=1.0, rudder_rate=0.1)
    (turn,) = predict_manoeuvre(model, "turning", side="starboard", angles=[0.2], **FEW).manoeuvres
    k = int(np.searchsorted(turn.log.t, turn.order_time - 1e-9))
    np.testing.assert_allclose(turn.log["delta"][k - 1 : k + 4], [0, 0.05, 0.15, 0.2, 0.2])


def test_a_helm_slower_than_its_file_says_is_as_slow_as_in_the_trial():
    log = trial(rudder_model(step=STEP), (20 * DEG,), (), lasts=150.0, rate=0.05)
    model = rudder_model(step=STEP, rudder_rate=0.5)
    made = predict_manoeuvre(model, "turning", trial=log, draws=40)
    assert any("a rate of 28.6 deg per second of delta; it moves at 2.86" in n for n in made.notes)
    assert max(errors(made).values()) < 0.05
