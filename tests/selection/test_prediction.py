"""The verdict on predictions of an estimate: logs left out in turn, or given to validate."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from schemas import schema
from virtual import virtual_log, write_csv

from greybox.commands.main import main
from greybox.errors import ExcitationError, UsageError
from greybox.estimation.prediction_verdict import JudgedOn, PredictionLevel, weigh_prediction
from greybox.selection.cross_validation import Refit
from greybox.selection.estimate import estimate_model
from greybox.selection.prediction import refit_alike, with_prediction
from greybox.selection.request import Request
from greybox.trial.steps import Step
from greybox.validation.held_commands import held_bounds, held_commands_diverge

ASKED = {"structure": "thesis", "predictor": "basic"}
CALM = {"wind": 0.0, "spread": 1e-12, "current": (0.0, 0.0)}


@pytest.fixture(scope="module")
def logs():
    return [virtual_log(60 + k, 300, name=f"log{k}", **CALM) for k in range(5)]


@pytest.fixture(scope="module")
def estimate(logs):
    return estimate_model(logs, method="oe", **ASKED)


def test_an_estimate_in_its_family_predicts(estimate, logs):
    found = estimate.prediction
    assert found.text == "good"
    assert found.judged_on is JudgedOn.HELD_OUT
    assert found.parts == 4
    assert sorted(found.logs) == [log.name for log in logs]
    assert found.samples == 1500
    assert set(found.fit) == set(found.coverage) == {"u", "v", "r"}
    # nothing was left to choose
    assert not any("was chosen" in note for note in estimate.notes)
    assert estimate.summary().splitlines()[2:4] == [
        "Prediction: good", f"Coefficients: {estimate.verdict.text}"
    ]  # fmt: skip


@pytest.fixture
def here(monkeypatch):
    """Refits run in this process, which sees what they are given."""
    monkeypatch.setattr("greybox.numerics.parallel.lanes", lambda: 1)


@pytest.mark.usefixtures("here")
def test_a_log_that_is_judged_took_no_part(estimate, logs):
    seen = []

    def refit(fitting):
        seen.append({log.name for log in fitting})
        return estimate.model()

    found = with_prediction(estimate, logs, Request(), Refit(refit)).prediction
    every = {log.name for log in logs}
    assert set().union(*(every - fitting for fitting in seen)) == every
    assert len(found.logs) == len(logs)
    # left out, a log is worth as much as on the whole model here
    np.testing.assert_allclose(
        list(found.rmse.values()), list(estimate.prediction.rmse.values()), rtol=0.05
    )


def test_parts_without_which_there_is_no_estimate_are_told(estimate, logs):
    def refuse(fitting):
        if not any(log.name == "log0" and log.t[0] == logs[0].t[0] for log in fitting):
            raise ExcitationError("nothing turns.")
        return estimate.model()

    found = with_prediction(estimate, logs, Request(), Refit(refuse)).prediction
    assert found.level is PredictionLevel.GOOD
    assert found.parts == 3
    assert "1 of 4 parts was not judged" in found.reasons[-1]
    assert "nothing turns" in found.reasons[-1]

    def never(_):
        raise ExcitationError("nothing turns.")

    own = with_prediction(estimate, logs, Request(), Refit(never)).prediction
    assert own.judged_on is JudgedOn.OWN
    assert own.level is PredictionLevel.LIMITED
    assert "nothing turns (give logs to --validate)" in own.text


def test_a_model_that_diverges_on_its_own_logs_is_poor(estimate, logs):
    left = replace(estimate, fit=dict.fromkeys("uvr", -np.inf))
    found = with_prediction(left, logs, Request(), Refit(lambda _: estimate.model())).prediction
    assert found.text.startswith("poor: its free run diverges on the estimation logs")


def test_a_log_too_short_for_parts_is_judged_on_itself(logs):
    short = logs[0].window(0, 75, "short")
    found = estimate_model(short, method="ls", structure="linear", predictor="basic").prediction
    assert found.judged_on is JudgedOn.OWN
    assert found.level in (PredictionLevel.LIMITED, PredictionLevel.POOR)
    assert "judged on its own logs, nothing was held out" in found.text


@pytest.mark.usefixtures("here")
def test_logs_faster_than_the_estimate_are_taken_at_its_rate(estimate, logs):
    fast = [replace(log, t=log.t / 2, sample_time=0.5) for log in logs]
    seen = []

    def refit(fitting):
        seen.extend(log.sample_time for log in fitting)
        return estimate.model()

    found = with_prediction(estimate, fast, Request(), Refit(refit)).prediction
    assert set(seen) == {1.0}
    # half a window is lost at each log's end
    assert found.samples == 5 * 149


def test_logs_are_read_with_the_vessel_of_the_estimate(estimate, logs):
    """Its thrust law may be another than that of the vessel file: here all push twice as much."""
    thrusters = estimate.vessel.thrusters
    stronger = replace(
        estimate.vessel, thrusters=tuple(replace(t, gain=2 * t.gain) for t in thrusters)
    )
    double = [replace(log, vessel=stronger) for log in logs]
    found = with_prediction(
        estimate, double, Request(), Refit(lambda _: estimate.model())
    ).prediction
    assert found.text == "good"
    # a copy of the logs would be refused
    other = tuple(log.window(0, len(log) - 1) for log in double)
    found = with_prediction(estimate, logs, Request(validate=other)).prediction
    assert found.text == "good"


def test_logs_given_to_validate_judge(estimate, logs):
    other = replace(logs[0], channels=logs[0].channels | {"v": logs[0]["v"][::-1].copy()})
    found = with_prediction(estimate, logs, Request(validate=(other,))).prediction
    assert found.judged_on is JudgedOn.VALIDATION
    assert "sway" in found.text
    told = " ".join(replace(estimate, prediction=found).summary().split())
    assert (
        f"{found.text}; on 1 log kept from the estimate that was judged, 300 s Coefficients" in told
    )


@pytest.mark.parametrize(
    ("made", "sensors", "said"),
    [(True, {}, True), (False, {}, False), (True, {"heading_bias": 0.01}, False)],
)
def test_a_compass_that_nothing_checks_is_told_beside_the_current(made, sensors, said):
    log = virtual_log(3, 300)
    ship = replace(log.vessel, sensors={**log.vessel.sensors, **sensors})
    steps = (Step("earth_to_body", ("u", "v"), ("v_n", "v_e", "psi")),) * made
    log = replace(log, vessel=ship, provenance=replace(log.provenance, steps=steps))
    found = estimate_model([log], method="ls", structure="thesis", predictor="wind")
    assert any("no check can tell a bias of the compass" in n for n in found.notes) == said


def test_a_refit_starts_where_the_estimate_ended(estimate, logs):
    model = refit_alike(estimate, Request(method="oe", **ASKED))(logs[1:])
    assert model.names == estimate.model().names
    assert (model.theta != estimate.model().theta).any()
    # as if the lost fifth had told as much as the rest
    np.testing.assert_allclose(model.covariance, 1.25 * estimate.model().covariance)


def test_by_command(tmp_path, logs, capsys):
    a, b = (write_csv(log, tmp_path / f"{log.name}.csv") for log in logs[:2])
    words = ["estimate", str(a), "--vessel", "thesis", "--method", "ls", "--predictor", "basic",
             "--structure", "thesis", "--json", str(tmp_path / "m.json")]  # fmt: skip
    assert main([*words, "--validate", str(b)]) == 0
    assert "Prediction: " in capsys.readouterr().out
    data = json.loads((tmp_path / "m.json").read_text())
    schema("model-4").validate(data)
    told = data["verdict"]["prediction"]
    assert told["judged_on"] == "validation"
    assert told["logs"] == ["log1"]
    assert set(told["fit"]) == {"u", "v", "r"}
    assert told["limits"]["good"] == 0.5
    assert main([*words, "--validate", str(a)]) == 1
    assert "a log that the estimate used cannot judge it" in capsys.readouterr().err


def test_the_validation_of_a_plan_judges_and_then_takes_part(tmp_path, logs, capsys):
    log, plan = logs[0], tmp_path / "plan.csv"
    names = [*log.vessel.commands]
    parts = ["lead-in"] * 40 + ["trial"] * 160 + ["validation"] * 100
    rows = zip(parts, *(log[n] for n in names), strict=True)
    plan.write_text(
        f"t,part,{','.join(names)}\n"
        + "".join(f"{k},{','.join(map(str, row))}\n" for k, row in enumerate(rows))
    )
    words = ["estimate", "--vessel", "thesis", "--method", "ls", "--predictor", "basic",
             "--structure", "thesis", "--json", str(tmp_path / "m.json")]  # fmt: skip
    found = []
    # by its own clock; and on a clock that began 25 s before the plan
    for late in (0, 25):
        sailed = write_csv(replace(log, t=log.t + late), tmp_path / f"late{late}.csv")
        assert main([*words, str(sailed), "--plan", str(plan)]) == 0
        said = " ".join(capsys.readouterr().out.split())
        assert "left out of the estimate are 40 of lead-in" in said
        assert ("shifted by 25 s" in said) == bool(late)
        data = json.loads((tmp_path / "m.json").read_text())
        schema("model-4").validate(data)
        assert data["provenance"]["plan"] == [
            {"log": f"late{late}", "plan": "plan.csv", "shift": late, "followed": 1.0,
             "samples": {"lead-in": 40, "trial": 160, "validation": 100}}
        ]  # fmt: skip
        assert data["verdict"]["prediction"]["judged_on"] == "validation"
        assert data["verdict"]["prediction"]["logs"] == [f"late{late}, validation"]
        found.append(data["theta"])
    assert found[0] == found[1]
    # the lead-in tells nothing: the model is that of what follows it, and its verdict that on an
    # estimate of the trial alone by the validation as a log of its own
    verdict = data["verdict"]["prediction"]
    whole = write_csv(log.window(40, 300), tmp_path / "whole.csv")
    assert main([*words, str(whole)]) == 0
    data = json.loads((tmp_path / "m.json").read_text())
    np.testing.assert_allclose(found[0], data["theta"])
    fit = write_csv(log.window(40, 200), tmp_path / "fit.csv")
    judge = write_csv(log.window(200, 300), tmp_path / "judge.csv")
    assert main([*words, str(fit), "--validate", str(judge)]) == 0
    data = json.loads((tmp_path / "m.json").read_text())
    assert verdict["fit"] == pytest.approx(data["verdict"]["prediction"]["fit"])
    assert np.abs(np.subtract(found[0], data["theta"])).max() > 0
    capsys.readouterr()
    other = write_csv(logs[1], tmp_path / "other.csv")
    assert main([*words, str(other), "--plan", str(plan)]) == 1
    error = capsys.readouterr().err
    assert "'other' follows the plan 'plan.csv' in " in error
    assert "and 80 % are needed" in error
    assert error.count("\n") == 1


def test_a_log_of_the_estimate_cannot_judge(estimate, logs):
    own = replace(logs[0], provenance=replace(logs[0].provenance, sha256="ab"))
    with pytest.raises(UsageError, match="Name it once"):
        with_prediction(estimate, [own], Request(validate=(own,)))


def test_a_copy_of_a_log_is_no_second_trial(logs):
    with pytest.raises(UsageError, match=r"'copy' hold the same \d+ samples.*name each trial once"):
        estimate_model([*logs, replace(logs[0], name="copy")])


def test_a_model_that_runs_away_where_commands_are_held_is_poor(estimate, logs):
    """Its turning drives itself beyond yaw rates that the logs keep for moments only."""
    model = estimate.model()
    structure = model.structure.with_terms("N_rrr")
    theta = np.append(model.theta, 0.0)
    place = structure.parameters.index("N_rrr")
    theta = np.insert(np.delete(theta, -1), place, 6.0)
    unstable = replace(
        model, structure=structure, theta=theta, covariance=np.zeros((len(theta),) * 2)
    )
    found = held_commands_diverge(unstable, logs)
    assert found is not None
    assert set(found.commands) == set(estimate.vessel.commands)
    assert 0 < found.after < 300
    words = "of 16 settings of the commands of the logs, each held constant"
    assert f"diverges or goes astern with {found.count} {words}" in found.sentence
    assert held_commands_diverge(model, logs) is None
    judged = weigh_prediction(estimate.prediction.channels, JudgedOn.HELD_OUT, found=[found])
    assert judged.level is PredictionLevel.POOR
    assert judged.text == f"poor: {found.sentence}"


def test_a_model_that_goes_astern_under_thrust_ahead_is_poor(estimate, logs):
    """Within the bound of free runs, but where a ship that only pushed ahead cannot be."""
    model = estimate.model()
    reversed_thrust = np.where(np.array(model.names) == "Xmu", -1.0, 1.0) * model.theta
    least, most = held_bounds(logs, model.structure.states)
    fastest = max(log["u"].max() for log in logs)
    np.testing.assert_allclose(least, [-0.05 * fastest, *-most[1:]])
    found = held_commands_diverge(replace(model, theta=reversed_thrust), logs)
    assert found is not None
    assert found.count > found.settings / 2
    # of a ship that did push astern nothing is known
    astern = replace(logs[0], channels={**logs[0].channels, "n": -logs[0]["n"]})
    np.testing.assert_array_equal(held_bounds([*logs, astern], model.structure.states)[0], -most)
