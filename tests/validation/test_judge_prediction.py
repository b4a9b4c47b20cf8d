"""What free runs are good for: levels by stated limits, errors in units, bands, horizons."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from virtual import PARAMETERS, virtual_log

from greybox.estimation.prediction_verdict import (
    LIMITS,
    BandShare,
    ChannelPrediction,
    JudgedOn,
    NoisierThanStated,
    NothingHeldOut,
    PredictionLevel,
    RunsDiverge,
    weigh_prediction,
)
from greybox.files import to_json
from greybox.model.catalogue import get_structure
from greybox.model.model import ManoeuvringModel
from greybox.model.noise import NoiseLevels
from greybox.numerics.binomial import wilson_interval
from greybox.study.chapter6 import TRUE
from greybox.validation.judge_prediction import HeldOut, judge_prediction

SIGMA = 0.3 * np.sqrt(2e-4)
STATES = ("u", "v", "r")


def true_model(log, **changed):
    """The thesis's ship, with some parameters multiplied."""
    theta = np.array([TRUE[n] * changed.get(n, 1.0) for n in PARAMETERS])
    p = len(theta)
    noise = NoiseLevels(STATES, np.full(3, SIGMA), np.zeros(3), 0.0, 0.0, "known")
    return ManoeuvringModel(
        get_structure("thesis"), theta, np.zeros((p, p)), 1.0, log.vessel,
        disturbances={"current_north": (0.2, 0.0), "current_east": (-0.2, 0.0)}, noise=noise,
    )  # fmt: skip


@pytest.fixture(scope="module")
def log():
    # past the ship's own start, which is no mean of its first samples
    return virtual_log(41, 650, wind=0.0, spread=1e-12, noise=0.3).window(50, 650, "virtual")


def channel(name="v", error=0.3, spread=1.0, moves=True, **more):
    numbers = {"noise": 0.1, "horizon": 40.0, "lasting": error < 1} | more
    return ChannelPrediction(name, "m/s", error * spread, spread, moves=moves, **numbers)


def judged(*channels, found=(), judged_on=JudgedOn.HELD_OUT):
    return weigh_prediction(channels, judged_on, found=found, parts=4)


def test_the_true_model_is_good_and_its_error_is_that_of_the_sensors(log):
    found = judge_prediction([HeldOut.of(true_model(log), log)], JudgedOn.VALIDATION)
    assert found.text == "good"
    assert found.reason.startswith("the error of surge, sway, yaw rate is at most")
    # n = 600: a standard deviation is known to 3 %, heading noise adds a little
    for c in found.channels:
        assert c.rmse == pytest.approx(SIGMA, rel=0.12)
        assert c.noise == pytest.approx(SIGMA, rel=0.25)
        assert c.spread == pytest.approx(np.std(log[c.channel]))
        assert c.fit == pytest.approx(100 * (1 - c.rmse / c.spread))
        assert c.lasting
        assert c.horizon == 599.0
        assert c.bands.interval[0] < 0.95 < c.bands.interval[1]
        assert 100 < c.bands.independent <= c.bands.samples == 600


def test_a_wrong_channel_limits_the_model_and_the_horizon_is_told(log):
    # the run starts right and goes elsewhere
    found = judge_prediction([HeldOut.of(true_model(log, Ymu=1.4), log)], JudgedOn.VALIDATION)
    sway = found.channels[1]
    assert found.level is not PredictionLevel.GOOD
    assert sway.fit < 0
    assert not sway.lasting
    assert 0 < sway.horizon < 60
    assert f"sway is worse than a constant after {sway.horizon:.3g} s" in found.text
    assert sway.bands.share < 0.5
    assert "bands of sway hold" in found.text


def test_parts_of_one_log_share_its_mean(log):
    model = true_model(log)
    parts = [HeldOut.of(model, log.window(a, a + 150, log.name)) for a in range(0, 600, 150)]
    found = judge_prediction(parts)
    assert found.channels[0].spread == pytest.approx(np.std(log["u"]))
    # other logs have a constant of their own, though they have the same name
    two = [HeldOut.of(model, x) for x in (log, replace(log, channels=log.channels | {
        "u": log["u"] + 5.0}))]  # fmt: skip
    assert judge_prediction(two).channels[0].spread == pytest.approx(np.std(log["u"]))


def test_errors_left_out_and_own_ones_are_weighed(log):
    """Efron's .632 estimator; what diverges is lost, but is not the model that is judged."""
    model, wrong = true_model(log), true_model(log, Ymu=1.3)
    own, left = HeldOut.of(model, log), HeldOut.of(wrong, log)
    found = judge_prediction([left], own=[own])
    for state in STATES:
        mine, other = (judge_prediction([h]).rmse[state] for h in (own, left))
        share = 1 - np.exp(-1)
        assert found.rmse[state] == pytest.approx(np.sqrt(share * other**2 + (1 - share) * mine**2))
    away = HeldOut.of(true_model(log, Nr=-30.0), log)
    found = judge_prediction([away], own=[own])
    assert found.channels[2].error == pytest.approx(3 * np.sqrt(share), rel=0.05)
    assert found.because[0].kind == "large_error"
    assert "refits_diverge" in {r.kind for r in found.because}


def test_a_share_that_differs_between_runs_is_known_by_so_many_runs(log):
    """One run inside its bands and one outside: two opinions, however many samples."""
    one, other = (HeldOut.of(true_model(log, Ymu=m), log) for m in (1.0, 1.4))
    apart = [judge_prediction([h]).channels[1].bands for h in (one, other)]
    both = judge_prediction([one, other]).channels[1].bands
    assert both.share == pytest.approx(np.mean([b.share for b in apart]))
    off = np.diff([b.share for b in apart])[0] / 2
    # the variance of a mean of two is that of their difference over four
    assert both.independent == pytest.approx(both.share * (1 - both.share) / off**2)
    assert both.independent < 2 < apart[0].independent


def test_what_kinds_of_manoeuvre_left_out_show_is_told_beside_the_level(log):
    own = HeldOut.of(true_model(log), log)
    wrong = HeldOut.of(true_model(log, Ymu=2.5), log)
    found = judge_prediction([own], own=[own, own], elsewhere=[wrong], kinds=["turn"])
    assert found.level is PredictionLevel.GOOD
    assert "a kind of manoeuvre that the estimate did not use (turn)" in found.reasons[-1]
    told = found.to_dict()
    assert told["elsewhere_rmse"]["v"] > 2 * told["rmse"]["v"]


def test_units_change_nothing(log):
    """A ship in other units of speed and force is the same ship."""
    small = {n: log[n] * (1e-3 if n in STATES else 1.0) for n in log.channels}
    tiny = replace(log, channels=small)
    model = true_model(log)
    one = judge_prediction([HeldOut.of(model, log)])
    run = HeldOut.of(model, log).run
    less = HeldOut(replace(model, noise=None), replace(run, log=tiny, x=run.x * 1e-3))
    two = judge_prediction([less])
    np.testing.assert_allclose([c.fit for c in two.channels], [c.fit for c in one.channels])
    assert [c.moves for c in two.channels][:2] == [c.moves for c in one.channels][:2]
    assert "no noise levels" in two.reasons[-1]
    assert two.coverage == {}


def test_limits_separate_the_levels():
    good, just, bad = LIMITS.good, LIMITS.usable, 1.2
    assert judged(channel("u", good), channel("v", good)).level is PredictionLevel.GOOD
    limited = judged(channel("u", good), channel("v", bad))
    assert limited.text == "limited: sway is worse than a constant after 40 s"
    assert judged(channel("v", just)).level is PredictionLevel.LIMITED
    poor = judged(channel("u", just + 0.01), channel("v", bad, horizon=0.0))
    assert poor.text == (
        "poor: the error of surge is 71 % of its spread (50 % is allowed); "
        "sway is worse than a constant from the start"
    )


def test_what_hardly_moves_does_not_decide():
    still = channel("r", 3.0, spread=0.02, moves=False)
    found = judged(channel("u", 0.2), still)
    assert found.text == "good"
    assert "yaw rate hardly moved (0.02 m/s beside a noise of 0.1)" in found.reasons[0]
    nothing = judged(still)
    assert nothing.text == (
        "poor: no channel moved beyond its noise, so its prediction was not tested"
    )


def test_a_sensor_that_is_noisier_than_stated_is_told(log):
    """White noise of ten times the stated level in sway, on a ship that is known."""
    stated = replace(log, vessel=replace(log.vessel, sensors={"v_std": SIGMA / 3}))
    rng = np.random.default_rng(5)
    noisy = log["v"] + 3 * SIGMA * rng.standard_normal(len(log))
    rough = replace(stated, channels={**stated.channels, "v": noisy})
    found = judge_prediction([HeldOut.of(true_model(log), rough)], JudgedOn.VALIDATION)
    (told,) = [r for r in found.because if isinstance(r, NoisierThanStated)]
    # the third differences of n = 600 samples tell a deviation to some 5 %
    assert told.seen == pytest.approx(np.sqrt(10) * SIGMA, rel=0.2)
    assert f"v_std = {told.seen:.2g} under [sensors]" in told.sentence
    assert told.sentence in found.reasons
    # errors of a model that is wrong are smooth: they are no sensor's
    wrong = judge_prediction([HeldOut.of(true_model(log, Ymu=1.4), stated)], JudgedOn.VALIDATION)
    assert not any(isinstance(r, NoisierThanStated) for r in wrong.because)


def test_bands_that_miss_limit_the_model_where_that_is_certain():
    few, many = (BandShare(0.8, wilson_interval(0.8, n), 400, float(n)) for n in (10, 200))
    assert judged(channel("u", 0.2, bands=few)).text == "good"
    found = judged(channel("u", 0.2, bands=many))
    assert found.text == (
        "limited: the 95 % bands of surge hold 80 % (74-85) of the measurements (85 % is required)"
    )


def test_a_run_that_diverges_is_poor(log):
    found = judge_prediction(
        [HeldOut.of(true_model(log), log), HeldOut.of(true_model(log, Nr=-30.0), log)]
    )
    assert found.level is PredictionLevel.POOR
    assert found.text.startswith("poor: its free run diverges in 1 of 2 runs, first after")
    told = json.loads(to_json(found.to_dict()))
    assert told["because"][0]["kind"] == "runs_diverge"
    assert told["fit"]["u"] is None
    assert judged(channel(), found=[RunsDiverge(("a",), 8, 12.0)]).level is PredictionLevel.POOR


def test_models_within_the_standard_errors_that_diverge_limit_it(log):
    model = true_model(log)
    wide = np.zeros_like(model.covariance)
    i = model.names.index("Nr")
    wide[i, i] = 30.0**2
    found = judge_prediction([HeldOut.of(replace(model, covariance=wide), log)])
    assert found.text == (
        "limited: half of the models within its standard errors diverge, so it has no bands"
    )
    assert found.coverage == {}


def test_its_own_logs_never_make_a_model_good():
    own = NothingHeldOut("it has 50 samples.")
    found = judged(channel("u", 0.1), found=[own], judged_on=JudgedOn.OWN)
    assert found.text.startswith("limited: judged on its own logs, nothing was held out, because")
    assert judged(channel("u", 1.5), found=[own], judged_on=JudgedOn.OWN).level == "poor"


def test_the_summary_has_a_row_a_channel():
    shown = judged(channel("u", 0.2), channel("v", 1.2, horizon=12.5)).summary().splitlines()
    assert shown[0] == "limited: sway is worse than a constant after 12.5 s"
    assert shown[2].split()[:2] == ["surge", "0.2"]
    assert "12.5 s" in shown[3]
    assert shown[4] == "  on 4 parts of the log, each left out of an estimate in turn"


def test_errors_on_the_own_logs_and_their_memory_are_kept(log):
    wrong = HeldOut.of(true_model(log, Yv=1.5), log)
    found = judge_prediction([wrong], own=[HeldOut.of(true_model(log), log)]).to_dict()
    assert found["own_rmse"]["v"] < 0.5 * found["rmse"]["v"]
    assert found["memory"]["v"] > 2.0
    assert judge_prediction([wrong]).to_dict()["own_rmse"] == {}


def test_large_errors_of_several_channels_are_one_sentence():
    found = judged(channel("u", 0.85), channel("v", 0.9), channel("r", 1.2))
    assert found.text == (
        "poor: the error is too large a share of the spread (surge 85 %, sway 90 %; 50 % is "
        "allowed); yaw rate is worse than a constant after 40 s"
    )
