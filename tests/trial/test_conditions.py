"""Conditions of validity: stated, recorded, kept in models, and told where they differ."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from schemas import schema
from virtual import virtual_log, write_csv

from greybox.commands.main import main
from greybox.diagnosis.diagnose import DiagnosisOptions, diagnose
from greybox.errors import LogError, VesselError
from greybox.model.model import ManoeuvringModel, load_model, model_from_dict
from greybox.selection.estimate import estimate_model
from greybox.trial.convert.options import ImportOptions
from greybox.trial.convert.read import read_log
from greybox.trial.dataframe import log_from_pandas
from greybox.trial.import_files import import_files
from greybox.trial.kinematics import decimate
from greybox.trial.log import make_log
from greybox.trial.store import write_log
from greybox.trial.validity import (
    extrapolation_note,
    other_conditions,
    pooled_conditions,
    settings_of,
)
from greybox.validation.comparison import compare
from greybox.vessel.conditions import Conditions
from greybox.vessel.toml import load_vessel, vessel_from_dict, vessel_to_dict

SHIP = {"name": "V", "length": 10, "thruster": [{"type": "fixed", "speed": "n"}]}


def at(log, **stated):
    """Return a log under conditions."""
    known = replace(log.provenance, conditions=Conditions.read(stated))
    return replace(log, provenance=known)


def some_log(name="a", **stated):
    t = np.arange(20.0)
    ship = vessel_from_dict(SHIP)
    channels = {"u": 1 + 0.01 * t, "v": 0 * t, "r": 0 * t, "psi": 0 * t, "n": 1 + 0 * t}
    return at(make_log(ship, channels, 1.0, name), **stated)


def test_texts_with_units_become_si():
    read = Conditions.read(
        {"draught": "120 cm", "trim": "-.1", "loading": " half  load", "water_depth": "10ft",
         "sea_state": "3", "crew": "two"}
    )  # fmt: skip
    assert read == Conditions(1.2, -0.1, "half load", 3.048, 3)
    assert read.sentence == (
        "draught 1.2 m, trim -0.1 m, loading half load, water depth 3.048 m, sea state 3"
    )
    assert not Conditions.read({"crew": "two"})
    assert Conditions(draught=2.0, sea_state=1).over(read) == replace(
        read, draught=2.0, sea_state=1
    )


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"draught": "deep"}, "draught is 'deep', a length is needed, such as 1.2 or '120 cm'"),
        ({"draught": "1.2 kn"}, "draught is '1.2 kn', and 'kn' is no unit of length"),
        ({"draught": "1.2 metrs"}, "'metrs' is no unit of length. Did you mean 'metres'"),
        ({"draught": 10**400}, "draught is inf m, it must be finite"),
        ({"sea_state": 10**400}, "sea state is 1000"),
        ({"draught": -1}, "draught is -1 m, it must be finite and positive"),
        ({"draught": True}, "draught is True"),
        ({"water_depth": 0}, "water depth is 0 m"),
        ({"trim": "1e999"}, "trim is inf m, it must be finite"),
        ({"sea_state": 10}, "sea state is 10, the codes of WMO table 3700 go from 0"),
        ({"sea_state": "2.5"}, "sea state is '2.5', a code"),
        ({"sea_state": "rough"}, "sea state is 'rough', a code"),
        ({"loading": 3}, "loading is 3, words are needed"),
        ({"loading": " "}, "words are needed"),
    ],
)
def test_what_no_condition_can_be(values, message):
    with pytest.raises(LogError, match=message):
        Conditions.read(values)
    with pytest.raises(VesselError, match=message):
        vessel_from_dict(SHIP | {"conditions": values})
    with pytest.raises(LogError, match=message):
        ImportOptions(notes=values)


def test_a_vessel_file_states_those_of_logs_that_state_none(tmp_path, monkeypatch):
    ship = vessel_from_dict(SHIP | {"conditions": {"draught": "12 ft"}})
    assert ship.conditions.draught == pytest.approx(3.6576)
    assert vessel_from_dict(json.loads(json.dumps(vessel_to_dict(ship)))) == ship
    assert "draught 3.6576 m" in ship.summary()
    with pytest.raises(VesselError, match=r"unknown key 'draft'\. Did you mean 'draught'"):
        vessel_from_dict(SHIP | {"conditions": {"draft": 1}})
    with pytest.raises(VesselError, match=r"\[conditions\] is not a table but 3"):
        vessel_from_dict(SHIP | {"conditions": 3})
    raw = tmp_path / "raw.csv"
    raw.write_text("t,u,v,r,psi,n\n" + "".join(f"{k},1,0,0,0,5\n" for k in range(9)))
    assert read_log(raw, ship).conditions == ship.conditions
    out = tmp_path / "log.csv"
    options = ImportOptions(notes={"water_depth": "20 m", "crew": "two"})
    import_files([raw], ship, out, options)
    record = json.loads((tmp_path / "log.csv.json").read_text())
    assert record["conditions"] == {"draught": ship.conditions.draught, "water_depth": 20.0}
    assert record["notes"] == {"water_depth": "20 m", "crew": "two"}
    # what the log states holds, whatever the vessel file says later
    later = replace(ship, conditions=Conditions(draught=1.0, sea_state=2))
    known = Conditions(ship.conditions.draught, water_depth=20.0, sea_state=2)
    log = read_log(out, later)
    assert log.conditions == known
    assert "conditions: draught 3.6576 m, water depth 20 m, sea state 2" in log.summary()
    assert decimate(log, 2.0).conditions == known
    assert log_from_pandas(log.to_pandas(), ship).conditions == known
    # and is kept when the log is imported again, in one piece or in blocks
    for cells in (10**9, 1):
        monkeypatch.setattr("greybox.trial.convert.two_pass_import._LARGE_CELLS", cells)
        import_files([out], later, tmp_path / "again.csv")
        assert read_log(tmp_path / "again.csv", vessel_from_dict(SHIP)).conditions == known


def test_records_of_released_versions_state_them_as_notes(tmp_path):
    log = tmp_path / "log.csv"
    write_log([some_log()], log)
    record = json.loads((tmp_path / "log.csv.json").read_text())
    del record["conditions"]
    record["notes"] = {"draught": "1.2 m", "sea_state": "rough", "crew": "two"}
    (tmp_path / "log.csv.json").write_text(json.dumps(record))
    read = read_log(log, vessel_from_dict(SHIP))
    assert read.conditions == Conditions(draught=1.2)
    assert read.provenance.notes["sea_state"] == "rough"


@pytest.mark.parametrize(
    ("name", "known", "same", "other"),
    [
        ("draught", 2.0, 2.09, 2.2),
        ("trim", 0.0, 0.15, 0.3),
        ("loading", "Ballast", "ballast", "full"),
        ("water_depth", 6.0, 7.0, 9.0),
        ("sea_state", 3, 4, 5),
    ],
)
def test_what_parameters_can_ignore_and_what_not(name, known, same, other):
    """Beside a draught of 2 m."""

    def log(label, value):
        return some_log(label, **({"draught": 2.0} | {name: value}))

    assert not pooled_conditions([log("a", known), log("b", same)]).differences
    pooled = pooled_conditions([log("a", known), log("b", other), log("c", known), some_log("d")])
    assert set(pooled.values[name]) == {known, other}
    (one,) = pooled.differences
    assert one.condition == name
    assert one.logs == (("a", known), ("b", other), ("c", known))
    assert f"the logs differ in {name.replace('_', ' ')}" in one.sentence
    model = pooled_conditions([log("a", known)]).values
    assert not other_conditions(model, [log("b", same), some_log("c")])
    (two,) = other_conditions(model, [log("b", other), log("c", same)])
    assert (two.logs, two.model) == ((("b", other),), (known,))
    assert two.to_dict()["logs"] == {"b": other}
    assert "the model was estimated at" in two.sentence
    assert not other_conditions(pooled.values, [log("b", other), log("c", same)])


def test_the_bottom_is_not_felt_in_deep_water():
    deep, deeper = ({"draught": 2.0, "water_depth": h} for h in (20.0, 200.0))
    assert not pooled_conditions([some_log(**deep), some_log(**deeper)]).differences
    # of unknown draught it may be
    one, two = (some_log(water_depth=h) for h in (20.0, 200.0))
    assert len(pooled_conditions([one, two]).differences) == 1


def test_many_logs_are_told_by_the_first_names():
    logs = [some_log(f"run{k}", draught=1.0 + (k > 5)) for k in range(9)]
    (one,) = pooled_conditions(logs).differences
    assert "1 m in run0, run1, run2 and 3 more; 2 m in run6, run7, run8)" in one.sentence


@pytest.fixture(scope="module")
def logs():
    return [
        at(replace(virtual_log(k, 600), name=f"day{k}"), draught=1.2 + 0.3 * (k > 1), sea_state=2)
        for k in (1, 2)
    ]


@pytest.fixture(scope="module")
def estimate(logs):
    return estimate_model(logs, method="ls", structure="thesis")


def test_logs_of_other_conditions_are_not_pooled_without_a_word(logs, estimate):
    (one,) = estimate.conditions.differences
    assert one.logs == (("day1", 1.2), ("day2", 1.5))
    assert one.sentence in estimate.notes
    assert "Conditions: draught 1.2 m to 1.5 m, sea state 2" in estimate.summary()
    model = estimate.model()
    assert "estimated at draught 1.2 m to 1.5 m, sea state 2" in model.summary()
    data = json.loads(json.dumps(model.to_dict()))
    assert data["conditions"] == {"draught": [1.2, 1.5], "sea_state": 2}
    assert [d["condition"] for d in data["condition_differences"]] == ["draught"]
    schema("model-4").validate(data)
    assert dict(model_from_dict(data).conditions) == {"draught": (1.2, 1.5), "sea_state": (2,)}
    alike = estimate_model(logs[:1], method="ls", structure="thesis")
    assert not alike.conditions.differences
    assert not any("differ in" in n for n in alike.notes)
    assert alike.model().to_dict()["conditions"] == {"draught": 1.2, "sea_state": 2}


def test_a_model_is_not_used_elsewhere_without_a_word(logs, estimate):
    model: ManoeuvringModel = replace(estimate.model(), conditions={"draught": (1.2,)})
    compared = compare({"m": model}, logs, bands=False)
    (one,) = compared.conditions[0]
    assert one.logs == (("day2", 1.5),)
    assert one.sentence == (
        "draught is 1.5 m in day2, the model was estimated at 1.2 m: its parameters may not hold "
        "there."
    )
    assert one.sentence in compared.summary()
    (told,) = compared.to_dict()["models"][0]["condition_differences"]
    assert told["logs"] == {"day2": 1.5}
    assert not compare({"m": estimate}, logs, bands=False).conditions[0]


def test_a_diagnosis_tells_them(logs, estimate):
    model = replace(estimate.model(), conditions={"draught": (2.0,)})
    options = DiagnosisOptions(causes=["current"])
    first, second = (log.window(0, 150, log.name) for log in logs)
    made = diagnose([first], model=model, validate=[second], options=options)
    assert [(d.logs, d.model) for d in made.conditions] == [
        ((("day2", 1.5),), (1.2,)), ((("day1", 1.2),), (2.0,)),
    ]  # fmt: skip
    assert {d.sentence for d in made.conditions} <= set(made.notes)
    assert made.to_dict()["condition_differences"] == [d.to_dict() for d in made.conditions]


def run(capsys, *arguments):
    status = main([str(a) for a in arguments])
    return status, *capsys.readouterr()


def test_the_shell_tells_them(tmp_path, capsys, logs, estimate):
    raw, log = write_csv(logs[0], tmp_path / "raw.csv"), tmp_path / "log.csv"
    status, _, error = run(
        capsys, "import", raw, "--vessel", "thesis", "--out", log, "--note", "draught=deep"
    )
    assert status != 0
    assert "--note: draught is 'deep'" in error
    assert not log.exists()
    status, out, error = run(
        capsys, "import", raw, "--vessel", "thesis", "--out", log, "--note", "draught=1.8 m",
        "--note", "sea_state=2", "--note", "pilot=A. B.", "--note", "depth=30 m",
    )  # fmt: skip
    assert status == 0, error
    assert "note: 'depth' is kept in words, as no condition. Did you mean 'water_depth'?" in out
    assert "pilot" not in out
    assert read_log(log, load_vessel("thesis")).conditions == Conditions(1.8, sea_state=2)
    model = tmp_path / "model.json"
    estimate.model().save(model)
    assert load_model(model).conditions["draught"] == (1.2, 1.5)
    sentence = "draught is 1.8 m in log, the model was estimated at 1.2 m and 1.5 m"
    status, out, error = run(
        capsys, "simulate", model, log, "--out", tmp_path / "run.csv", "--no-bands"
    )
    assert status == 0, error
    assert sentence in out
    status, out, error = run(capsys, "compare", model, "--log", log, "--no-bands")
    assert status == 0, error
    assert sentence in out


def test_settings_stood_together_in_a_log_and_reach_its_ends():
    logs = [virtual_log(70 + k, 200, name=f"log{k}") for k in range(2)]
    found = settings_of(logs)
    names = logs[0].vessel.commands
    assert tuple(found) == names
    rows = np.concatenate([np.column_stack([log[n] for n in names]) for log in logs])
    settings = np.column_stack([found[n] for n in names])
    assert 2 < len(settings) <= 16
    for setting in settings:
        assert (rows == setting).all(axis=1).any()
    spread = np.ptp(rows, axis=0)
    assert (np.ptp(settings, axis=0) > 0.8 * spread)[spread > 0].all()
    model = estimate_model(logs, method="ls", structure="thesis").model()
    assert model.record["settings"] == found


def with_channels(log, **channels):
    return replace(log, channels={**log.channels, **channels})


def test_logs_that_go_beyond_those_of_a_model():
    known = {"u": (1.0, 1.2), "r": (0.0, 0.0), "n": (1.0, 1.0), "w": (0.0, 1.0)}
    log = some_log("far")
    assert not extrapolation_note(known, [log])
    # half of its samples turn, a few of which surge ahead as well
    turning = 0.1 * (np.arange(20) >= 10)
    far = with_channels(log, r=turning, u=log["u"] + 0.4 * (np.arange(20) >= 16))
    said = extrapolation_note(known, [far])
    assert said.startswith("far leaves what the model was estimated on for 50 % of the time: surge")
    assert "yaw rate 0 to 5.73 deg/s (estimated on 0 to 0)" in said
    assert " n " not in said
    both = extrapolation_note(known, [log, far])
    assert both.startswith("far, far leave what")
    assert "for 25 % of the time" in both
    # single samples are outliers
    spiky = with_channels(log, u=np.where(np.arange(20) == 4, 9.0, 1.1))
    assert not extrapolation_note(known, [log, spiky])


def test_held_out_logs_beyond_those_of_the_estimate_are_told(logs, estimate):
    slow, fast = logs[0], with_channels(logs[1], u=logs[1]["u"] + 1.0)
    beyond = "leaves what the model was estimated on"
    for judge, told in ((logs[1], False), (fast, True)):
        found = estimate_model([slow], validate=[judge], method="ls", structure="thesis")
        assert any(beyond in n for n in found.notes) == told
        options = DiagnosisOptions(causes=["current"])
        made = diagnose([slow], model=estimate.model(), validate=[judge], options=options)
        assert any(beyond in n for n in made.notes) == told
