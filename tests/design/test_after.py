"""Trials in stages: the rest is designed after what has been sailed."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from designs import hasty_search, make_request, ship_file, thesis_model
from virtual import virtual_log, write_csv

from experiment_design.after import lacking_margin, log_moments, log_motion, sailed_trial
from experiment_design.constraints.limits import TrialLimits
from experiment_design.excitation.rollout import Rollout
from experiment_design.for_prediction import (
    command_ranges,
    design_for_prediction,
    prior_misfit,
)
from experiment_design.information.envelope import build_envelope
from greybox.commands.main import main
from greybox.errors import LogError
from greybox.model.model import load_model
from greybox.model.predictor import build_predictor
from greybox.trial.log import TrialLog, make_log
from greybox.validation.fit import run_model


def sailed_log(seed: int, samples: int, model=None) -> TrialLog:
    """Return a log without wind, of a ship with limits."""
    log = virtual_log(seed, samples, wind=0.0, current=(0.0, 0.0), spread=1e-6)
    channels = {n: x for n, x in log.channels.items() if n not in ("u_q", "v_q")}
    vessel = thesis_model().vessel if model is None else model.vessel
    return make_log(vessel, channels, 1.0, "first")


@pytest.fixture(scope="module")
def model():
    return thesis_model(spread=0.02)


@pytest.fixture(scope="module")
def request_():
    return make_request(
        duration=200.0, regimes=((("u", 1),),), limits=TrialLimits(margins={"u": 0.2})
    )


@pytest.fixture(scope="module")
def envelope(request_):
    r = request_
    rollout = Rollout(
        r.vessel, r.structure, r.theta, r.d, r.starts[0], r.sample_time, r.integrator
    )  # fmt: skip
    predictor = build_predictor(r.structure, "basic", (("u", (1, -1)),))
    ranges = {n: (float(v.lower), float(v.upper)) for n, v in r.vessel.limits.items()}
    return build_envelope(
        rollout, predictor, r.noise, r.schedule, ranges, None, np.full(3, 0.2), 0
    )  # fmt: skip


def test_the_moments_are_those_of_the_same_motion_in_a_plan(envelope, model) -> None:
    # a log that the envelope's own model made, noise-free
    commands = envelope.draw(300, np.random.default_rng(1))
    motion = envelope.rollout.run(commands[None])
    x = motion.state[0, :-1]
    channels = dict(zip(("u", "v", "r", "psi"), x.T, strict=False))
    names = model.vessel.commands
    channels |= dict(zip(names, commands.T, strict=True))
    log = make_log(replace(model.vessel), channels, 1.0, "plan")
    found = log_motion(model, log)
    # its run starts from the mean of five samples
    r = envelope.rollout
    start = np.append(x[:5, :3].mean(axis=0), 0.0)
    again = Rollout(
        r.vessel, r.structure, r.theta, r.d, start, r.sample_time, r.integrator
    ).run(commands[None])  # fmt: skip
    np.testing.assert_allclose(found.state[0, :-1, :3], again.state[0, :-1, :3], atol=1e-9)
    told, asked = log_moments(envelope, [found]), envelope.information(again)[0]
    assert told is not None
    np.testing.assert_allclose(told, asked, atol=1e-6 * np.abs(asked).max())
    both = log_moments(envelope, [found, found])
    np.testing.assert_allclose(both, 2 * told)
    assert log_moments(envelope, []) == 0.0


def test_gaps_begin_anew_and_lost_samples_do_not_count(envelope, model) -> None:
    log = sailed_log(1, 200, model)
    whole = sailed_trial(model, [log], 1)
    parts = sailed_trial(model, [log.window(0, 80), log.window(120, 200)], 1)
    assert (whole.seconds, parts.seconds) == (200.0, 160.0)
    assert len(parts.motions) == 2
    np.testing.assert_array_equal(parts.end, whole.end)
    gap = np.zeros(200, bool)
    gap[50:70] = True
    lost = sailed_trial(model, [replace(log, missing={"u": gap})], 1)
    assert lost.motions[0].tau.shape[1] == 180
    assert whole.sentence() == "200 s of 1 log"
    with pytest.raises(LogError, match="--after"):
        sailed_trial(model, [], 1)
    diag = np.diag(log_moments(envelope, whole.motions))
    assert (np.diag(log_moments(envelope, parts.motions)) <= diag + 1e-9).mean() > 0.9


def test_a_run_that_escapes_leaves_the_measured_states(model) -> None:
    log = sailed_log(2, 120, model)
    theta = model.theta.copy()
    theta[list(model.names).index("Yv")] = 3.0
    wild = replace(model, theta=theta)
    assert run_model(wild, log).diverged >= 0
    found = log_motion(wild, log)
    np.testing.assert_array_equal(found.state[0, :-1, 0], log["u"])


def test_what_was_sailed_moves_on_with_another_model(model) -> None:
    log = sailed_log(3, 121, model)
    sailed = sailed_trial(model, [log], 1)
    half = replace(model, sample_time=0.5 * model.sample_time)
    (motion,) = sailed.as_inputs_of(half, model).motions
    (whole,) = sailed.motions
    np.testing.assert_allclose(motion.state[0, ::2], whole.state[0], atol=1e-12)
    middle = (whole.state[0, :-1] + whole.state[0, 1:]) / 2
    np.testing.assert_allclose(motion.state[0, 1::2], middle, atol=1e-12)
    for late in (0, 1):
        np.testing.assert_array_equal(motion.commands[0, late::2], whole.commands[0])
        np.testing.assert_allclose(motion.tau[0, late::2], whole.tau[0], atol=1e-12)
    same = sailed.as_inputs_of(model, model).motions[0]
    np.testing.assert_allclose(same.state, whole.state, atol=1e-12)


def test_where_the_log_ended(model) -> None:
    log = sailed_log(3, 100, model)
    t = log.t
    place = {"x_n": 2.0 * t, "y_n": -1.0 * t, "psi": 0.1 * t}
    found = sailed_trial(model, [replace(log, channels={**log.channels, **place})], 1)
    assert found.place == pytest.approx((198.0, -99.0))
    assert found.end[3] == pytest.approx(9.9)
    assert found.end[0] == pytest.approx(log["u"][-5:].mean(), abs=0.05)
    assert found.to_dict()["place"] == pytest.approx([198.0, -99.0])


def test_a_start_without_its_margin_is_named(request_) -> None:
    assert lacking_margin(request_) == ""
    slow = replace(request_, starts=(np.array([0.1, 0.0, 0.0, 0.0]),))
    assert lacking_margin(slow) == "u"


@pytest.mark.long
def test_the_plan_covers_what_has_not_been_sailed(request_, model) -> None:
    request = replace(request_, covariance=None, effort=0.15)
    alone = design_for_prediction(request, model)
    sailed = sailed_trial(model, [sailed_log(5, 300, model)], 1)
    after = design_for_prediction(request, model, sailed=sailed.motions)
    # as the search sees it
    r = request
    rollout = Rollout(r.vessel, r.structure, r.theta, r.d, r.starts[0], r.sample_time, r.integrator)
    states = r.structure.states
    predictor = build_predictor(r.structure, "basic", tuple((s, (1, -1)) for s in states))
    seen = build_envelope(
        rollout, predictor, r.noise, r.schedule, command_ranges(model, {}), None,
        prior_misfit(model)[0], r.seed,
    )  # fmt: skip
    known = log_moments(seen, sailed.motions)

    def left(plan, before):
        noise, misfit = seen.errors(plan.design.motions[0], before)
        return float((noise + misfit).mean())

    told = np.mean(
        [(after.noise[s] / d) ** 2 + (after.misfit[s] / d) ** 2
         for s, d in zip(states, seen.spread, strict=True)]
    )  # fmt: skip
    assert left(after, known) == pytest.approx(told, rel=1e-6)
    assert left(after, known) < left(alone, known) < left(alone, 0.0)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    place = tmp_path_factory.mktemp("after")
    (place / "ship.toml").write_text(ship_file())
    log = sailed_log(1, 400)
    t = log.t
    write_csv(replace(log, channels={**log.channels, "x_n": 0.1 * t, "y_n": 0.2 * t}),
              place / "first.csv")  # fmt: skip
    (place / "room.csv").write_text("x_n,y_n\n-900,-900\n900,-900\n900,900\n-900,900\n")
    return place


def run(files, *options):
    return main(["design", "--vessel", str(files / "ship.toml"), "--out", str(files / "plan.csv"),
                 "--effort", "0.1", "--workers", "1", *options])  # fmt: skip


@pytest.fixture(scope="module")
def staged(files):
    """The rest of a trial, for prediction."""
    with hasty_search():
        status = run(files, "--after", str(files / "first.csv"), "--remaining", "120", "--area",
                     str(files / "room.csv"), "--save-model", str(files / "model.json"), "--json",
                     str(files / "plan.json"))  # fmt: skip
    assert status == 0
    return json.loads((files / "plan.json").read_text())


def test_the_command_estimates_and_goes_on(files, staged) -> None:
    assert any("estimated on 400 s of 1 log: " in n and "prediction is" in n
               for n in staged["notes"])  # fmt: skip
    assert any("starts where the last log ended" in n for n in staged["notes"])
    assert staged["after"]["logs"] == 1
    assert staged["after"]["place"] == pytest.approx([39.9, 79.8])
    start = staged["starts"][0]
    assert [start[n] for n in ("u", "v", "r", "psi")] == pytest.approx(staged["after"]["end"])
    plan = pd.read_csv(files / "plan.csv")
    assert len(plan) == 120
    saved = load_model(files / "model.json")
    assert saved.record["verdict"]["prediction"]["level"] in ("good", "limited", "poor")


@pytest.mark.usefixtures("hasty")
def test_a_saved_model_need_not_be_estimated_again(files, staged) -> None:
    first = (files / "plan.csv").read_bytes()
    status = run(files, "--after", str(files / "first.csv"), "--duration", "120", "--area",
                 str(files / "room.csv"), "--model", str(files / "model.json"))  # fmt: skip
    assert status == 0
    assert (files / "plan.csv").read_bytes() == first


@pytest.mark.usefixtures("hasty")
def test_for_coefficients_what_was_learnt_is_the_prior(files, staged) -> None:
    common = ("--for", "coefficients", "--predictor", "basic", "--json", str(files / "c.json"),
              "--model", str(files / "model.json"))  # fmt: skip
    after = ("--after", str(files / "first.csv"), "--remaining", "100")
    assert run(files, *common, *after) == 0
    known = json.loads((files / "c.json").read_text())
    prior = load_model(files / "model.json").coefficient_model()
    for name, std in known["predicted_std"].items():
        if name in prior.names:
            assert std < prior.std[prior.names.index(name)] * 1.001


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "--remaining is missing"),
        (["--remaining", "100", "--duration", "200"], "two names of one time"),
        (["--remaining", "100", "--prior", "none"], "--prior none starts without any trial"),
        (["--remaining", "100", "--prior", "p.json"], "leave out --prior"),
        (["--remaining", "100", "--between", "a.json", "b.json"], "--between tells two apart"),
        (["--remaining", "100", "--model", "m.json", "--save-model", "s.json"], "--save-model"),
    ],
)
def test_options_that_do_not_go_together(files, options, message, capsys) -> None:
    assert run(files, "--after", str(files / "first.csv"), *options) == 1
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1


def test_a_log_without_its_columns_is_named(files, capsys) -> None:
    log = pd.read_csv(files / "first.csv").drop(columns="alpha1")
    log.to_csv(files / "lacking.csv", index=False)
    assert run(files, "--after", str(files / "lacking.csv"), "--remaining", "100") == 1
    assert "alpha1" in capsys.readouterr().err


def test_nothing_to_save_without_logs(files, capsys) -> None:
    assert run(files, "--prior", "none", "--duration", "99", "--save-model", "s.json") == 1
    assert "--after LOG estimates" in capsys.readouterr().err
