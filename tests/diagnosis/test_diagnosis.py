"""Diagnoses of blind trials, whose truth is looked at only after the verdict."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from schemas import schema

from greybox.commands.main import main
from greybox.diagnosis.diagnose import DiagnosisOptions, diagnose
from greybox.diagnosis.gain import gains, run_on
from greybox.errors import LogError, UsageError
from greybox.model.catalogue import get_structure
from greybox.model.model import ManoeuvringModel, load_model
from greybox.study.blind import Order, Trial, draw, draw_many, write
from greybox.study.blind_conditions import Conditions
from greybox.study.chapter6 import TRUE
from greybox.study.power import judge_by_diagnosis


def _draw(seed: int, *effects: str, **conditions) -> Trial:
    return draw(np.random.default_rng([31, seed]), effects, **conditions)


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("trial")
    write(_draw(1, "current", kind="manoeuvres", samples=700), folder)
    return folder


def test_command_writes_what_the_contract_says(written: Path, capsys) -> None:
    at = [str(written / n) for n in ("estimation.csv", "vessel.toml", "validation.csv")]
    status = main(
        ["diagnose", at[0], "--vessel", at[1], "--validate", at[2], "--json", str(written / "d"),
         "--out", str(written / "m.json"), "--report", str(written / "d.html")]
    )  # fmt: skip
    assert status == 0
    assert "verdict: named" in capsys.readouterr().out
    found = json.loads((written / "d").read_text())
    schema("diagnose-1").validate(found)
    truth = json.loads((written / "truth.json").read_text())["effects"][0]["parameters"]
    assert found["verdict"] == "named"
    (cause,) = found["causes"]
    assert cause["id"] == "current"
    for name, value in truth.items():
        told = cause["parameters"][name]
        assert told["unit"] == "m/s"
        assert abs(told["value"] - value) < 4 * told["std"] + 0.005
    assert cause["p_value"] <= cause["p_adjusted"] < 1e-6
    assert set(found["gain"]) == {"u", "v", "r"}
    for gain in found["gain"].values():
        assert gain["ci"][0] <= gain["after"] - gain["before"] <= gain["ci"][1]
    assert found["gain"]["u"]["ci"][0] > 0
    assert any("heading" in text for text in found["wrong"])
    before, after = found["residuals"]["before"], found["residuals"]["after"]
    assert not before["whiteness_u"]["passed"]
    assert before["whiteness_u"]["statistic"] > 10 * after["whiteness_u"]["statistic"]
    assert before["independence"]["detail"]["explicable"] >= 0
    page = (written / "d.html").read_text()
    assert page.count("the free-run error of surge is white") == 2
    schema("model-2").validate(json.loads((written / "m.json").read_text()))
    model = load_model(written / "m.json")
    assert model.disturbances["current_north"][0] == cause["parameters"]["current_north"]["value"]
    # the extended model is an ordinary one: compare gives the same fit
    assert main(["compare", str(written / "m.json"), "--log", at[2], "--json", str(written / "c"),
                 "--no-bands"]) == 0  # fmt: skip
    fit = json.loads((written / "c").read_text())["models"][0]["fit"]
    for state, gain in found["gain"].items():
        assert fit[state] == pytest.approx(gain["after"], abs=1e-6)


@pytest.mark.long
def test_nothing_wrong_and_no_validation_log() -> None:
    found = diagnose([_draw(2, kind="pulses", samples=600).estimation])
    assert found.verdict == "none"
    assert found.causes == ()
    assert "held out" in found.validated_on or "parts of the logs" in found.validated_on
    assert found.model is found.base
    assert np.isfinite([g.after for g in found.gain.values()]).all()
    json.dumps(found.to_dict(), allow_nan=False)


@pytest.mark.long
def test_only_the_causes_that_are_asked_for() -> None:
    trial = _draw(3, "thruster_gain", kind="manoeuvres", samples=600)
    found = diagnose(
        [trial.estimation],
        validate=[trial.validation],
        options=DiagnosisOptions(causes=["current"]),
    )
    assert {c.id for c in found.causes} <= {"current"}
    assert found.tried == 1
    with pytest.raises(UsageError, match=r"no cause 'curent'\. Did you mean 'current'"):
        diagnose([trial.estimation], options=DiagnosisOptions(causes=["curent"]))


def test_short_logs_are_refused_with_both_numbers() -> None:
    log = _draw(4, kind="pulses", samples=200).estimation
    with pytest.raises(LogError, match="has 90 samples, a diagnosis needs at least 120"):
        diagnose([log.window(0, 90)])


def test_gain_of_a_model_on_itself_is_nothing() -> None:
    trial = _draw(1, kind="pulses", samples=200)
    model = ManoeuvringModel(
        get_structure("thesis"), np.array([TRUE[n] for n in get_structure("thesis").parameters]),
        np.zeros((18, 18)), 1.0, trial.vessel,
    )  # fmt: skip
    run = run_on(model, trial.validation)
    for gain in gains([run], [run], 1.0, 0).values():
        assert gain.before == gain.after
        assert gain.ci == (0.0, 0.0)


# effects with a name, two of each kind of input where they show
_NAMED = (
    "current", "wind", "thruster_gain", "thruster_lag", "input_delay", "quadratic_thrust",
    "advance_speed", "crossflow", "heading_bias", "lever_arm", "angle_offset", "clock_offset",
    "parameter_change", "waves", "sign",
)  # fmt: skip


def _answers(
    effects: list[tuple[str, ...]], seed: int, kind: str, **conditions
) -> list[tuple[set[str], Trial, object]]:
    trials = draw_many(
        [np.random.default_rng([seed, i]) for i in range(len(effects))],
        [Order(e) for e in effects],
        Conditions(kind=kind, **conditions),
    )
    judged = [judge_by_diagnosis(t) for t in trials]
    return [(set(e), t, j) for e, t, j in zip(effects, trials, judged, strict=True)]


@pytest.mark.long
@pytest.mark.parametrize("kind", ["manoeuvres", "pulses"])
def test_named_effects_are_named(kind: str) -> None:
    right = wrong = within = told = 0
    answers = _answers([(n,) for n in _NAMED], 41, kind)
    for true, trial, judged in answers:
        grouped = any(true & set(g) for g in judged.groups)
        right += judged.ids == tuple(true) or grouped
        wrong += bool(set(judged.ids) - true)
        for name, value in trial.truth[0].parameters.items():
            if name in judged.parameters and not isinstance(value, str):
                found, std = judged.parameters[name]
                told += 1
                within += abs(found - value) <= 3 * std
    # 15 trials: binomial room of two standard errors around 95 % and 2 %
    assert right >= 0.95 * len(answers) - 2
    assert wrong <= 1
    assert within >= 0.95 * told - 2


@pytest.mark.long
def test_nothing_is_named_where_nothing_is_wrong() -> None:
    cases = [("pulses", {}), ("manoeuvres", {"colour": "memory"}), ("zigzag", {"gusts": True})]
    verdicts = []
    for kind, conditions in cases:
        verdicts += [j.verdict for _, _, j in _answers([()] * 4, 42, kind, **conditions)]
    assert verdicts.count("none") >= len(verdicts) - 1


@pytest.mark.long
def test_two_effects_are_both_named() -> None:
    pairs = [("current", "thruster_gain"), ("thruster_lag", "current"), ("wind", "current"),
             ("heading_bias", "thruster_gain"), ("lever_arm", "current")]  # fmt: skip
    answers = _answers(pairs, 43, "manoeuvres")
    both = sum(true == set(j.ids) for true, _, j in answers)
    assert both >= 0.8 * len(answers) - 1


@pytest.mark.long
def test_effects_without_a_name_get_none() -> None:
    answers = _answers([(n,) for n in ("dead_band", "backlash", "interaction")] * 2, 44, "zigzag")
    assert sum(bool(j.ids) and j.verdict == "named" for _, _, j in answers) <= 1
