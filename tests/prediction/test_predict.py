"""Predicted manoeuvres: closed forms, the model's own free run, measuring, intervals."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from manoeuvring import LENGTH, LINEAR, RUDDER, azimuth_ship, linear_ship, model_of, rudder_model
from scipy.stats import norm

from greybox.errors import InfeasibleError, LogError, UsageError
from greybox.estimation.verdict import TrustLevel
from greybox.model.catalogue import get_structure
from greybox.model.model import load_model
from greybox.model.noise import NoiseLevels
from greybox.prediction.measuring import quantities
from greybox.prediction.predict import predict_manoeuvre
from greybox.report.next_steps import after_prediction, fewer_terms
from greybox.report.prediction import headline, prediction_page
from greybox.trial.log import make_log
from greybox.trial.manoeuvres import Compliance, Criterion, find_manoeuvres
from greybox.validation.fit import run_model
from greybox.vessel.conditions import Conditions

FEW = {"draws": 40, "command": 12.0}


def value(made, name, which=0):
    return made.manoeuvres[which].quantities[name].value


def test_the_steady_turn_of_decoupled_equations():
    """Each state alone: u = −Xmu τx/Xu, v = −Ymu τy/Yv, r = −Nmu τn/Nr."""
    values = {k: v for k, v in LINEAR.items() if k not in ("Yur", "Nuv")} | {"Xu": -0.2}
    model = model_of(get_structure("linear"), values, azimuth_ship())
    made = predict_manoeuvre(model, "turning", side="starboard", angles=[0.4], **FEW)
    along, across = 12 * math.cos(0.4), -12 * math.sin(0.4)
    u, v = along * 0.01 / 0.2, across * 0.01 / 0.2
    r = -8.0 * across * 0.001 / 0.3
    assert value(made, "steady_yaw_rate") == pytest.approx(r, rel=1e-4)
    assert value(made, "steady_speed") == pytest.approx(math.hypot(u, v), rel=1e-3)
    assert value(made, "steady_diameter") == pytest.approx(2 * math.hypot(u, v) / r, rel=1e-3)
    assert value(made, "steady_radius") == value(made, "steady_diameter") / 2
    assert value(made, "steady_drift_angle") == pytest.approx(math.atan2(-v, u), rel=2e-3)
    assert value(made, "approach_speed") == pytest.approx(12 * 0.01 / 0.2)
    # ψ(t) of ṙ = −0.3 (r − r∞)
    t = np.linspace(0, 200, 200001)
    psi = r * (t - (1 - np.exp(-0.3 * t)) / 0.3)
    for name, angle in (("time_90", 0.5), ("time_180", 1.0), ("time_360", 2.0)):
        expected = np.interp(angle * math.pi, psi, t)
        assert value(made, name) == pytest.approx(expected, abs=0.06)


def test_head_reach_without_thrust():
    """Linear drag: (U₀ − U)/|Xu|, of the trapezoidal rule; quadratic: ln(U₀/U)/|Xuu|."""
    made = predict_manoeuvre(linear_ship(), "stopping", until=0.3, **FEW)
    start = 12 * 0.01 / 0.05
    expected = 0.7 * start / 0.05 * (1 - 0.05 * 0.05 / 2)
    assert value(made, "head_reach") == pytest.approx(expected, rel=1e-4)
    assert value(made, "track_reach") == pytest.approx(expected, rel=1e-4)
    assert value(made, "lateral_deviation") == pytest.approx(0.0, abs=1e-9)
    assert value(made, "stopping_time") == pytest.approx(-math.log(0.3) / 0.05, rel=2e-3)

    made = predict_manoeuvre(rudder_model(step=0.02), "stopping", **FEW)
    assert value(made, "head_reach") == pytest.approx(math.log(5) / 0.02, rel=2e-3)
    assert made.manoeuvres[0].criteria[0].verdict is Compliance.NOT_APPLICABLE


@pytest.mark.long
def test_intervals_are_those_of_the_parameters():
    """Head reach goes with 1/|Xu|, whose quantiles are known."""
    model = linear_ship(step=0.25)
    covariance = np.zeros_like(model.covariance)
    i = model.names.index("Xu")
    covariance[i, i] = (0.1 * model.theta[i]) ** 2
    model = replace(model, covariance=covariance)
    made = predict_manoeuvre(model, "stopping", speed=2.0, draws=400, seed=3)
    low, high = made.manoeuvres[0].quantities["head_reach"].interval
    middle = value(made, "head_reach")
    z = norm.ppf(0.975)
    # standard error of such a quantile of 400 draws: 1.1 and 2 % of the middle
    assert low / middle == pytest.approx(1 / (1 + 0.1 * z), abs=0.033)
    assert high / middle == pytest.approx(1 / (1 - 0.1 * z), abs=0.06)
    # the command that holds the speed has the same share of error
    (command,) = (q for n, q in made.manoeuvres[0].commands.items() if n == "n")
    assert (command.high - command.low) / command.value == pytest.approx(0.2 * z, rel=0.15)


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
@pytest.mark.parametrize(
    "actuation",
    [
        None,
        {"delay": 0.37, "lag": 0.8},
        {"lag": 0.8, "lag_on": "speed", "lag_held": "mean"},
        {"lag": 0.8, "lag_on": "command", "lag_held": "end", "delay": 0.1},
        {
            "lag": 0.8,
            "lag_on": "delta",
            "delay": 0.37,
            "delay_on": "delta",
            "rate_limit": 0.15,
            "rate_on": "delta",
        },
    ],
)
def test_a_run_is_the_models_own_free_run(actuation, integrator):
    """The commands of the predicted log, given to the model, move it just so."""
    model = replace(rudder_model(actuation=actuation, rudder_rate=0.2), integrator=integrator)
    for kind in ("zigzag", "crash"):
        extra = {"astern": 6.0} if kind == "crash" else {"side": "port", "angles": [0.3]}
        made = predict_manoeuvre(model, kind, **FEW, **extra)
        log = made.manoeuvres[0].log
        run = run_model(model, log, heading="simulated")
        np.testing.assert_allclose(run.x, log.states(("u", "v", "r")), atol=1e-9)
        np.testing.assert_allclose(run.psi, log["psi"], atol=1e-8)
        if kind == "zigzag":
            assert np.abs(np.diff(log["delta"])).max() <= 0.2 * 0.05 * (1 + 1e-9)


@pytest.mark.parametrize(
    ("actuation", "instant"),
    [
        (None, True),
        ({"rate_limit": 0.15, "rate_on": "delta"}, False),
        ({"lag": 0.8, "lag_on": "delta"}, False),
        ({"lag": 0.8}, False),
        ({"lag": 0.8, "lag_on": "speed"}, True),
    ],
)
def test_orders_are_not_said_to_act_at_once_where_the_model_delays_them(actuation, instant):
    made = predict_manoeuvre(
        rudder_model(actuation=actuation), "zigzag", side="port", angles=[0.3], **FEW
    )
    assert (
        "delta follows orders at once, because the vessel file states no rudder_rate"
        in made.summary()
    ) == instant
    assert ("orders are taken to act at once" in headline(made)) == instant
    first = after_prediction(made, {}, "ship.toml")[0].line()
    assert first.startswith("next: state rudder_rate in the vessel file, estimate ag") == instant
    assert first.endswith("(where they do on board, state a high rate)") == instant


@pytest.mark.parametrize("kind", ["turning", "zigzag", "crash"])
def test_the_trials_measuring_finds_the_same(kind):
    """A predicted run, read as a trial, is found and measured alike."""
    extra = (
        {"astern": 8.0} if kind == "crash" else {"side": "starboard", "angles": [math.radians(20)]}
    )
    made = predict_manoeuvre(rudder_model(rudder_rate=0.1), kind, **FEW, **extra)
    (predicted,) = made.manoeuvres
    (found,) = find_manoeuvres(predicted.log)
    assert abs(found.start - predicted.order_time) < 0.2
    for name, measured in quantities(found).items():
        beside = predicted.quantities[name]
        assert (measured is None) == (beside is None)
        if measured is not None:
            assert measured.value == pytest.approx(beside.value, rel=0.02, abs=0.03), name


def test_a_zigzag_does_not_depend_on_the_sample_time():
    """The helm is reversed between samples, where the heading is reached."""
    angles = [(math.radians(20), math.radians(10))]
    fine, coarse = (
        predict_manoeuvre(
            replace(rudder_model(step=step), integrator="rk4"),
            "zigzag",
            side="port",
            angles=angles,
            **FEW,
        )
        for step in (0.02, 0.5)
    )
    for name in ("first_overshoot", "second_overshoot", "reach", "period", "initial_turning"):
        assert value(coarse, name) == pytest.approx(value(fine, name), rel=0.01), name


def test_both_sides_of_a_symmetric_ship_are_equal():
    made = predict_manoeuvre(rudder_model(spread=0.02), "zigzag", angles=[math.radians(10)], **FEW)
    one, other = made.manoeuvres
    assert (one.side, other.side) == ("starboard", "port")
    for name, quantity in one.quantities.items():
        assert quantity.interval == pytest.approx(other.quantities[name].interval, rel=1e-6)


@pytest.mark.long
def test_criteria_are_judged_by_the_interval():
    """Twice the tactical diameter that is allowed fails, well below it meets."""
    wide = dict(RUDDER, **{"N_|u|u*rudder": 0.0012})
    for values, verdict in ((RUDDER, Compliance.PASS), (wide, Compliance.FAIL)):
        model = rudder_model(step=0.25)
        theta = 0.25 * np.array([values[n] for n in model.names])
        made = predict_manoeuvre(replace(model, theta=theta), "turning", side="port", **FEW)
        criterion = made.manoeuvres[0].criterion("tactical_diameter")
        assert criterion.verdict is verdict
        assert criterion.limit == 5.0
        assert criterion.measured.value == pytest.approx(value(made, "tactical_diameter") / LENGTH)
    # an interval about the limit
    middle = rudder_model(step=0.25)
    covariance = np.zeros_like(middle.covariance)
    i = middle.names.index("N_|u|u*rudder")
    covariance[i, i] = (0.3 * middle.theta[i]) ** 2
    for share in (0.25, 0.35):
        theta = middle.theta.copy()
        theta[i] *= share
        model = replace(middle, theta=theta, covariance=covariance * share**2)
        made = predict_manoeuvre(model, "turning", side="port", **FEW)
        criterion = made.manoeuvres[0].criterion("tactical_diameter")
        low, high = criterion.measured.interval
        assert (criterion.verdict is Compliance.OPEN) == (low <= 5 < high)


def test_draws_that_diverge_are_counted():
    model = rudder_model(step=0.25)
    covariance = np.zeros_like(model.covariance)
    i = model.names.index("Nr")
    covariance[i, i] = (0.45 * model.theta[i]) ** 2
    made = predict_manoeuvre(
        replace(model, covariance=covariance), "turning", side="port", draws=60, command=12.0
    )
    (turn,) = made.manoeuvres
    lost = turn.diverged + turn.incomplete
    assert 0 < lost < 40
    assert turn.quantities["advance"].reached <= 60 - turn.diverged
    assert f"{turn.diverged} of 60 draws diverge, which is a defect of the model" in made.summary()
    criterion, reached = turn.criterion("advance"), turn.quantities["advance"].reached
    assert criterion.verdict is not Compliance.PASS
    told = f"all {reached} draws that complete it meet it; {turn.diverged} diverge"
    assert criterion.reason == told
    # the next step names the command of the model's own logs
    logs = {"command": {"logs": ["a.csv"], "vessel": "v.toml", "validate": ["b.csv"]}}
    fewer = fewer_terms(replace(model, record={"provenance": logs}))
    steps = [s.line() for s in after_prediction(made, {}, "v.toml", fewer)]
    assert any(
        s.endswith("greybox estimate a.csv --vessel v.toml --validate b.csv --reduce --out "
                   "reduced.json") for s in steps)  # fmt: skip
    logs["command"]["reduce"] = True
    assert fewer_terms(replace(model, record={"provenance": logs})) == ""


def test_draws_that_cannot_hold_the_speed_are_counted():
    model = linear_ship(spread=0.05, speed_limits=[0.0, 10.0])
    made = predict_manoeuvre(model, "stopping", speed=1.95, draws=60)
    assert 0 < made.manoeuvres[0].unheld < 60
    assert "do not hold the approach speed within the limits" in made.summary()
    _, high = made.manoeuvres[0].commands["n"].interval
    assert high <= 10.0 * (1 + 1e-9)


def test_the_same_seed_gives_the_same_numbers():
    model = rudder_model(step=0.25, spread=0.05)
    one, two, other = (
        predict_manoeuvre(model, "stopping", seed=seed, **FEW).to_dict() for seed in (1, 1, 2)
    )
    assert one == two
    assert one != other


def test_current_moves_the_ship_only_when_asked():
    model = replace(
        rudder_model(), disturbances={"current_north": (0.3, 0.02), "current_east": (0.0, 0.02)}
    )
    still = predict_manoeuvre(model, "turning", side="port", **FEW)
    moved = predict_manoeuvre(model, "turning", side="port", current=True, **FEW)
    assert value(moved, "approach_speed") == pytest.approx(value(still, "approach_speed") + 0.3)
    assert still.manoeuvres[0].quantities["advance"].std < 1e-9
    assert moved.manoeuvres[0].quantities["advance"].std > 0.01


@pytest.mark.parametrize(
    ("said", "level"),
    [
        ("do not trust: it diverges", TrustLevel.DO_NOT_TRUST),
        ("trust except Xu", TrustLevel.TRUST_EXCEPT),
        ("trust", TrustLevel.TRUST),
    ],
)
def test_the_verdict_of_an_older_model_file_is_known(said, level, tmp_path):
    """Files had its text only, without its level."""
    verdict = {"text": said, "excepted": [], "reasons": []}
    path = tmp_path / "model.json"
    older = replace(linear_ship(), record={"verdict": verdict}).to_dict() | {"version": 2}
    path.write_text(json.dumps(older))
    made = predict_manoeuvre(load_model(path), "stopping", until=0.3, **FEW)
    assert made.trust is level
    told = f"the estimate's own verdict on its coefficients is '{said}'."
    assert (told in made.notes) == (level is not TrustLevel.TRUST)
    assert ("not to be trusted" in headline(made)) == (level is TrustLevel.DO_NOT_TRUST)


@pytest.mark.parametrize(("far", "cut"), [(1.3, False), (20.0, True)])
def test_a_draw_that_leaves_its_circle_does_not_make_the_picture_small(far, cut):
    made = predict_manoeuvre(rudder_model(spread=0.03), "turning", side="port", **FEW)
    turn = made.manoeuvres[0]
    run = turn.bundle.tracks[0]
    tracks = (*[run] * 20, (far * run[0], far * run[1]))
    shown = replace(turn, bundle=replace(turn.bundle, tracks=tracks))
    lead = prediction_page(replace(made, manoeuvres=(shown,)), {}).lead
    assert ("A few draws go on beyond the edge." in lead.caption) == cut


def test_the_headline_names_the_limits_that_are_not_met():
    made = predict_manoeuvre(linear_ship(), "stopping", until=0.3, **FEW)
    limits = [
        Criterion(name, None, 4.5, verdict)
        for name, verdict in (
            ("tactical diameter", Compliance.PASS),
            *[("advance", Compliance.FAIL)] * 2,
            ("first overshoot", Compliance.OPEN),
        )
    ]
    judged = replace(made.manoeuvres[0], criteria=tuple(limits))
    said = headline(replace(made, manoeuvres=(judged,)))
    told = "1 of 4 met, 2 of 4 failed (advance), 1 of 4 cannot be told (first overshoot)."
    assert said.startswith(f"Limits of IMO MSC.137(76): {told}")


@pytest.mark.parametrize(
    ("level", "doubt"), [("good", ""), ("limited", "limited use"), ("poor", "was poor")]
)
def test_what_logs_that_took_no_part_say_counts_before_the_tests(level, doubt):
    coefficients = {"level": "do not trust", "text": "do not trust: it misfits", "except": []}
    prediction = {"level": level, "text": f"{level}: sway is worse than a constant"}
    record = {"verdict": {"prediction": prediction, "coefficients": coefficients}}
    made = predict_manoeuvre(replace(linear_ship(), record=record), "stopping", until=0.3, **FEW)
    assert "not to be trusted" not in headline(made)
    assert doubt in headline(made)
    assert any(prediction["text"] in n for n in made.notes) == (level != "good")


def test_leaving_the_range_of_the_logs_is_said():
    model = replace(
        rudder_model(), record={"ranges": {"r": (-0.02, 0.02), "u": (0.0, 9.0), "n": (0.0, 15.0)}}
    )
    made = predict_manoeuvre(model, "turning", side="starboard", **FEW)
    told = [n for n in made.notes if n.startswith("extrapolated")]
    assert len(told) == 1
    assert "yaw rate goes from" in told[0]
    assert "estimated on -1.15 to 1.15 deg/s" in told[0]
    # the terminal begins with it, and says it once
    shown = made.summary().splitlines()
    assert shown[1] == told[0]
    assert made.summary().count("extrapolated: ") == 1 + len(made.manoeuvres[0].criteria)
    silent = predict_manoeuvre(replace(model, record={}), "turning", side="port", **FEW)
    assert any("does not say on what motions" in n for n in silent.notes)


def test_rows_from_where_the_run_leaves_the_logs_rest_on_no_log():
    """The helm is at once beyond its range, and the ship slower than in the logs at the end."""
    ranges = {"r": (-1.0, 1.0), "u": (0.0, 9.0), "v": (-9.0, 9.0), "n": (0.0, 15.0)}
    near = {"delta": (-math.radians(28), math.radians(28))}
    whole = {"delta": (-1.0, 1.0)}
    made = {}
    for name, more in (("helm", near), ("speed", whole | {"u": (2.3, 2.5)}), ("none", whole)):
        model = replace(rudder_model(step=0.25), record={"ranges": ranges | more})
        made[name] = predict_manoeuvre(model, "turning", side="starboard", **FEW)
    rows = {n: {r["name"]: r for r in m.to_dict()["quantities"]} for n, m in made.items()}
    flags = {n: {k for k, r in found.items() if r["extrapolated"]} for n, found in rows.items()}
    assert flags["none"] == set()
    assert flags["helm"] == set(rows["helm"]) - {"approach_speed"}
    assert {"steady_speed", "speed_loss"} <= flags["speed"] < flags["helm"] - {"advance"}

    assert rows["none"]["tactical_diameter"]["verdict"] == "meets"
    assert rows["helm"]["tactical_diameter"]["verdict"] == "cannot be told"
    shown = made["helm"].summary()
    assert "IMO tactical diameter, at most 5 L: extrapolated: cannot be told" in shown
    assert "  steady speed " in shown
    assert "cannot be told" in headline(made["helm"])

    record = {"command": {"model": "m.json"}}
    step = after_prediction(made["helm"], record, "V")[0]
    assert step.line() == (
        "next: your logs go to 28 deg of delta: sail a 35 deg turn and estimate with its log too, "
        "or predict what they hold: greybox predict m.json turning --angle 28"
    )
    assert (
        "your logs hold 2.3 to 2.5 m/s of surge"
        in after_prediction(made["speed"], record, "V")[0].line()
    )
    assert not any("your logs" in s.line() for s in after_prediction(made["none"], record, "V"))


def trial_of(made, rng, share=1.0):
    log = made.manoeuvres[0].log
    noise = {"x_n": 0.05, "y_n": 0.05, "psi": 0.002, "u": 0.01, "v": 0.01, "r": 0.001}
    channels = {
        n: v + share * noise.get(n, 0.0) * rng.standard_normal(len(v))
        for n, v in log.channels.items()
    }
    return make_log(log.vessel, channels, log.sample_time, "trial")


def test_prediction_and_trial_side_by_side():
    """The ship's own model agrees with its trial, one that turns harder does not."""
    model = rudder_model(step=0.1, spread=0.02, rudder_rate=0.2)
    angles = [math.radians(20)]
    source = predict_manoeuvre(model, "zigzag", side="port", angles=angles, **FEW)
    trial = trial_of(source, np.random.default_rng(4))
    made = predict_manoeuvre(model, "zigzag", trial=trial, draws=80)
    (own,) = made.manoeuvres
    assert own.side == "port"
    assert math.degrees(own.heading) == pytest.approx(20, abs=0.5)
    assert len(own.agreement.rows) == 8
    assert sum(r.agrees for r in own.agreement.rows) >= 7
    assert value(made, "approach_speed") == pytest.approx(value(source, "approach_speed"), rel=0.01)
    assert not made.conditions

    known = replace(trial.provenance, conditions=Conditions(draught=2.0))
    loaded = replace(trial, provenance=known)
    light = replace(model, conditions={"draught": (1.5,)})
    (elsewhere,) = predict_manoeuvre(light, "zigzag", trial=loaded, draws=40).conditions
    assert elsewhere.sentence.startswith("draught is 2 m in trial, the model was estimated at 1.5")

    theta = model.theta.copy()
    theta[model.names.index("N_|u|u*rudder")] *= 1.6
    other = predict_manoeuvre(replace(model, theta=theta), "zigzag", trial=trial, draws=80)
    agreement = other.manoeuvres[0].agreement
    assert "first overshoot" in agreement.sentence
    assert "Clearest: " in agreement.sentence
    row = next(r for r in agreement.rows if r.name == "first_overshoot")
    assert row.difference.high < 0
    assert not row.agrees
    with pytest.raises(LogError, match="no turning manoeuvre in 'trial', but zig-zag 20/20"):
        predict_manoeuvre(model, "turning", trial=trial)
    pieces = [trial.window(k, k + 5, f"trial[{k}]") for k in range(1, 8)]
    with pytest.raises(LogError, match=r"in 'trial\[1\]', .* and 3 more, nor any other: name"):
        predict_manoeuvre(model, "turning", trial=pieces)
    with pytest.raises(LogError, match="of that side or angle"):
        predict_manoeuvre(model, "zigzag", trial=trial, side="starboard")


@pytest.mark.parametrize(
    ("kind", "asked", "message"),
    [
        ("turning", {"draws": 10}, "10 draws are too few"),
        ("turning", {"speed": 1.0, "command": 2.0}, "each determines the other"),
        ("stopping", {"side": "port"}, "--side belongs to turning and zigzag"),
        ("turning", {"until": 0.1}, "--until belongs to stopping and crash"),
        ("stopping", {"astern": 3.0}, "--astern belongs to crash"),
        ("stopping", {"until": 1.5}, "--until is 1.5"),
        ("turning", {"angles": [(0.3, 0.2)]}, "a turning circle has one angle"),
        (
            "turning",
            {"angles": [0.8]},
            "45.8.* deg is beyond the limits of delta, which allow 34.3",
        ),
        ("turning", {"command": {"m": 3.0}}, "no propeller speed of Rudder ship"),
        ("turning", {"command": 40.0}, "asks n = 40, and the vessel file keeps it from -5 to 20"),
        ("turning", {"share": 0.3}, "--share is 0.3, but Rudder ship is steered by the rudder"),
        ("crash", {"astern": 9.0}, "--astern is 9, and the vessel file allows n down to -5"),
    ],
)
def test_wrong_uses_are_one_sentence(kind, asked, message):
    model = rudder_model(speed_limits=[-5.0, 20.0], rudder_limits=[-0.6, 0.6])
    with pytest.raises(UsageError, match=message):
        predict_manoeuvre(model, kind, **asked)


def test_a_speed_astern_is_none_ahead():
    with pytest.raises(InfeasibleError, match="no steady speed ahead at n = -4"):
        predict_manoeuvre(rudder_model(speed_limits=[-5.0, 20.0]), "turning", command=-4.0)


def test_bands_are_those_of_draws_under_way():
    """Where the manoeuvre is over for most draws, nothing is drawn of what they do after it."""
    made = predict_manoeuvre(
        linear_ship(spread=0.3), "stopping", until=0.3, draws=80, command=12.0
    ).manoeuvres[0]
    low, high = made.bundle.low["speed"], made.bundle.high["speed"]
    told = np.isfinite(low)
    assert (np.isfinite(high) == told).all()
    assert told[: len(told) // 2].all()
    # no draw still under way is slower than where it ends, which is a share of its approach
    assert low[told].min() > 0.25 * low[0]


def test_what_a_crash_stop_needs():
    with pytest.raises(UsageError, match="states no least speed of n"):
        predict_manoeuvre(rudder_model(), "crash", command=12.0)
    bound = rudder_model(speed_limits=[0.0, 20.0])
    with pytest.raises(UsageError, match="keeps n at 0 or more, so it cannot run astern"):
        predict_manoeuvre(bound, "crash", command=12.0)
    with pytest.raises(UsageError, match="a stop without thrust needs n at 0"):
        predict_manoeuvre(rudder_model(speed_limits=[4.0, 20.0]), "stopping", command=12.0)


def test_steering_of_the_wrong_sign_is_said():
    model = rudder_model(step=0.25)
    theta = model.theta.copy()
    for name in ("N_|u|u*rudder", "Y_|u|u*rudder"):
        theta[model.names.index(name)] *= -1
    made = predict_manoeuvre(replace(model, theta=theta), "turning", side="port", **FEW)
    assert "turns against the order to port" in made.summary()


def test_a_model_that_diverges_predicts_nothing():
    model = rudder_model()
    theta = model.theta.copy()
    theta[model.names.index("Nr")] *= -1
    with pytest.raises(InfeasibleError, match="run of the estimate itself diverges"):
        predict_manoeuvre(replace(model, theta=theta), "turning", side="port", **FEW)


@pytest.mark.long
def test_intervals_cover():
    """Models drawn as an estimate would be cover the true ship as often as they say."""
    true = rudder_model(step=0.2)
    std = 0.08 * np.abs(true.theta)
    asked = {"side": "port", "angles": [math.radians(20)], "speed": 2.0, "draws": 80}
    names = ("first_overshoot", "second_overshoot", "initial_turning", "reach")
    own = predict_manoeuvre(true, "zigzag", **asked)
    rng = np.random.default_rng(8)
    runs, inside = 60, dict.fromkeys(names, 0)
    for run in range(runs):
        theta = true.theta + std * rng.standard_normal(len(std))
        model = replace(true, theta=theta, covariance=np.diag(std**2))
        made = predict_manoeuvre(model, "zigzag", seed=run, **asked)
        for name in names:
            low, high = made.manoeuvres[0].quantities[name].interval
            inside[name] += low <= value(own, name) <= high
    # three standard errors of a share of 60, and the chance of 80 draws
    for name in names:
        assert inside[name] / runs == pytest.approx(0.95, abs=0.09), name


def test_process_noise_widens_the_draws_only():
    model = rudder_model(step=0.25, spread=0.01)
    noise = NoiseLevels(("u", "v", "r"), np.full(3, 0.01), np.array([0.0, 0.0, 1e-3]))
    model = replace(model, noise=noise)
    asked = {"side": "port", "angles": [math.radians(10)], **FEW}
    plain, rough = (
        predict_manoeuvre(model, "zigzag", disturbed=disturbed, **asked)
        for disturbed in (False, True)
    )
    for name in ("first_overshoot", "period"):
        one, two = (m.manoeuvres[0].quantities[name] for m in (plain, rough))
        assert one.value == two.value
        assert two.std > 2 * one.std
