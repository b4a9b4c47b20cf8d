"""Diagnoses of blind trials, whose truth is looked at only after the verdict."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from schemas import schema

from greybox.commands.main import main
from greybox.diagnosis.builder import diverging
from greybox.diagnosis.diagnose import DiagnosisOptions, diagnose
from greybox.diagnosis.null_model import run_on
from greybox.diagnosis.preparing import _chosen
from greybox.errors import LogError, UsageError
from greybox.model.catalogue import get_structure
from greybox.model.model import ManoeuvringModel, load_model
from greybox.selection.prediction import require_others
from greybox.study.blind import Trial, draw, write
from greybox.study.chapter6 import TRUE
from greybox.validation.gain import block_sums, blocks, gains


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
    schema("model-4").validate(json.loads((written / "m.json").read_text()))
    model = load_model(written / "m.json")
    for name, (value, std) in model.disturbances.items():
        assert value == cause["parameters"][name]["value"]
        assert std == pytest.approx(cause["parameters"][name]["std"], rel=1e-6)
    shared = np.array(model.disturbance_covariance)
    assert shared.shape == (len(model.names) + 2, 2)
    np.testing.assert_allclose(
        np.sqrt(np.diag(shared[-2:])), [std for _, std in model.disturbances.values()]
    )
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


def test_words_of_the_field_are_answered_with_the_id() -> None:
    for said, meant in (
        ("antenna", "lever_arm"),
        ("curent", "current"),
        ("compass", "heading_bias"),
    ):
        with pytest.raises(UsageError, match=rf"no cause '{said}'\. Did you mean '{meant}'"):
            _chosen([said])


def test_a_copy_of_a_log_cannot_validate() -> None:
    log = _draw(4, kind="pulses", samples=200).estimation
    copy = replace(log, name="copy", provenance=replace(log.provenance, sha256="other"))
    with pytest.raises(UsageError, match="'copy' holds the same samples as"):
        require_others([log], [copy])


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


def test_a_block_bootstrap_draws_each_sample_as_often_as_any_other() -> None:
    rng = np.random.default_rng(0)
    values = rng.standard_normal((50, 2))
    starts, length = blocks(50, 10.0, 4000, rng)
    drawn = block_sums(values, starts, length)
    whole = np.array([values[(starts[3, :, None] + np.arange(length)) % 50].sum(axis=(0, 1))])
    np.testing.assert_allclose(drawn[3], whole[0])
    # its mean is that of the samples, ends and all, to within four of its standard errors
    error = drawn.std(axis=0) / np.sqrt(len(drawn))
    count = starts.shape[1] * length
    assert (np.abs(drawn.mean(axis=0) - count * values.mean(axis=0)) < 4 * error).all()
    first = np.zeros(50)
    first[0] = 1.0
    counted = block_sums(first, starts, length).mean()
    assert counted == pytest.approx(count / 50, abs=4 * np.sqrt(count / 50 / len(drawn)))


def test_a_covariance_whose_models_diverge_is_told() -> None:
    trial = _draw(1, kind="pulses", samples=200)
    sure = ManoeuvringModel(
        get_structure("thesis"), np.array([TRUE[n] for n in get_structure("thesis").parameters]),
        1e-8 * np.eye(18), 1.0, trial.vessel,
    )  # fmt: skip
    assert diverging(sure, [trial.estimation, trial.validation]) == []
    (told,) = diverging(replace(sure, covariance=np.eye(18)), [trial.validation])
    count = re.search(r"of 64 models drawn .*, (\d+) diverge on", told)
    assert count is not None
    # standard errors of one are far above the coefficients themselves
    assert int(count[1]) > 32
