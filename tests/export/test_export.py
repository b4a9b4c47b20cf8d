"""`export_model` and `greybox export`: options, refusals, files."""

from __future__ import annotations

import json
import os
from dataclasses import replace

import numpy as np
import pytest
from free_runs import CHANGES

import greybox as gb
from greybox.commands import export as command
from greybox.commands.main import main
from greybox.errors import LogError, StructureError, UsageError
from greybox.export.export import TARGETS, export_model
from greybox.export.names import comment, distinct, identifier, line, string
from greybox.export.ports import base_units, command_ports
from greybox.model.catalogue import get_structure
from greybox.model.model import ManoeuvringModel
from greybox.vessel.toml import load_vessel, vessel_from_dict
from greybox.vessel.vessel import Actuation


@pytest.fixture(scope="module")
def model(thesis, ship, true_theta):
    return ManoeuvringModel(thesis, true_theta, np.zeros((18, 18)), 1.0, ship)


def test_every_target_by_command(model, tmp_path, capsys):
    model.save(tmp_path / "m.json")
    assert TARGETS == command.TARGETS
    for target in TARGETS:
        out = tmp_path / f"ship.{target}"
        words = ["export", str(tmp_path / "m.json"), "--to", target, "--out", str(out)]
        assert main([*words, *(["--no-binary"] if target == "fmu" else [])]) == 0
        shown = capsys.readouterr().out
        assert f"wrote {out}" in shown
        assert "in:  n [unit of the log], alpha1 [rad], alpha2 [rad], wind_north [m/s]" in shown
        assert out.is_file()


@pytest.mark.parametrize(
    ("words", "status", "message"),
    [
        (["--to", "fmi"], 2, "Did you mean 'fmu'"),
        (["--to", "fmu", "--wind", "earth"], 1, "chooses its wind where it runs"),
        (["--to", "fmu", "--heading", "measured"], 1, "chooses its heading where it runs"),
        (["--to", "mat", "--no-binary"], 1, "only an FMU holds a binary, 'mat' does not"),
        (["--to", "c", "--out", "none/x.c"], 1, "there is no folder 'none'"),
        (["--to", "c", "--out", "-"], 1, "only --json writes to standard output"),
        (["--to", "c", "--out", "."], 1, "it is a folder"),
    ],
)
def test_wrong_use_is_one_sentence(model, tmp_path, monkeypatch, capsys, words, status, message):
    monkeypatch.chdir(tmp_path)
    model.save("m.json")
    words = ["export", "m.json", *words]
    words += [] if "--out" in words else ["--out", "x"]
    if status == 2:
        with pytest.raises(SystemExit) as stop:
            main(words)
        assert stop.value.code == 2
    else:
        assert main(words) == 1
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error
    assert os.listdir() == ["m.json"]


def test_wrong_use_in_code(model, tmp_path):
    with pytest.raises(UsageError, match=r"cannot be exported to 'matlab'. Did you mean 'mat'"):
        export_model(model, "matlab", tmp_path / "x")
    with pytest.raises(UsageError, match=r"heading is 'mesured'. Did you mean 'measured'"):
        export_model(model, "c", tmp_path / "x.c", heading="mesured")
    with pytest.raises(UsageError, match=r"wind is 'air'. Use earth or relative"):
        export_model(model, "c", tmp_path / "x.c", wind="air")
    with pytest.raises(UsageError, match=r"name a file that ends in .c, or export to fmu"):
        export_model(model, "c", tmp_path / "x.fmu")
    assert gb.export_model is export_model


def test_what_is_no_ship_is_refused(ship, model, tmp_path):
    siso = ManoeuvringModel(get_structure("siso"), np.array([-0.1, 1.0]), np.eye(2), 1.0, ship)
    with pytest.raises(StructureError, match="'siso' is a map of input and not the motion of a s"):
        export_model(siso, "c", tmp_path / "x.c")
    broken = replace(model, theta=np.full(18, np.nan))
    with pytest.raises(StructureError, match="theta of the model holds a number that is not fin"):
        export_model(broken, "fmu", tmp_path / "x.fmu")
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_written_where_one_file_cannot_be(model, tmp_path):
    (tmp_path / "ship.h").mkdir()
    with pytest.raises(LogError, match="it is a folder"):
        export_model(model, "c", tmp_path / "ship.c")
    assert [p.name for p in tmp_path.iterdir()] == ["ship.h"]


def test_settled_is_the_model_after_its_changes(model, tmp_path):
    changing = replace(model, changes=CHANGES)
    exported = export_model(changing, "json", tmp_path / "a.json")
    assert any("Xu is 3 times its value from 40 s on" in n for n in exported.notes)
    exported = export_model(changing, "json", tmp_path / "b.json", settled=True)
    assert exported.notes == ()
    exported = export_model(model, "json", tmp_path / "c.json", settled=True)
    assert exported.notes == ("settled changed nothing, as no parameter of the model changes",)
    table = json.loads((tmp_path / "b.json").read_text())
    assert table["parameters"][0]["value"] == pytest.approx(1.5 * model.theta[0])
    assert table["changes"] == []


def test_ports_say_what_the_log_was_corrected_for(model):
    ferry = {c.name: c.unit for c in command_ports(load_vessel("ferry"))}
    assert ferry["n1"] == "rpm"
    assert ferry["alpha1"] == "rad"
    vessel = vessel_from_dict(
        {"name": "s", "length": 1.0, "sensors": {"reversed": ["n"], "clock": {"n": 1.5}},
         "columns": {"N": {"name": "n", "unit": "kn"}},
         "thruster": [{"type": "fixed", "speed": "n", "speed_limits": [0, 5]}]}
    )  # fmt: skip
    (port,) = command_ports(vessel)
    assert port.unit == "m/s"
    assert "allows 0 to 5, not kept" in port.meaning
    assert "its sign is turned" in port.meaning
    assert "without the 1.5 s" in port.meaning


def test_notes_of_corrected_sensors(model, tmp_path):
    sensors = {"reversed": ("n", "r"), "clock": {"n": 1.5}, "heading_bias": 0.1}
    actuation = Actuation(between="interpolated")
    vessel = replace(model.vessel, sensors=sensors, actuation=actuation)
    odd = replace(model, vessel=vessel, integrator="rk4")
    notes = export_model(odd, "c", tmp_path / "x.c", heading="measured").notes
    for part in ("turns the sign of the log's n:", "n is 1.5 s late", "shows 0.1 rad more",
                 "heading or wind is held over the step", "a command is held over"):  # fmt: skip
        assert sum(part in n for n in notes) == 1
    assert not any("rad more" in n for n in export_model(odd, "c", tmp_path / "x.c").notes)


@pytest.mark.parametrize(
    ("unit", "base"),
    [
        ("1", {}), ("m/s", {"m": 1, "s": -1}), ("s/m^2", {"s": 1, "m": -2}), ("rad", {"rad": 1}),
        ("1/(m s N)", {"m": -2, "kg": -1, "s": 1}), ("m N", {"m": 2, "kg": 1, "s": -2}),
        ("rpm", {"rad": 1, "s": -1}), ("m/(s n)", None), ("1/(s n²)", None),
    ],
)  # fmt: skip
def test_base_units(unit, base):
    assert base_units(unit) == base


def test_names_become_harmless():
    assert identifier("n_prop [rps]") == "n_prop_rps"
    assert identifier("9 lives") == "x_9_lives"
    assert identifier("α") == "x"
    assert identifier("while") == "x_while"
    assert len(identifier("a" * 500)) == 60
    assert distinct(["a", "a", "a_2", "a"]) == ["a", "a_2", "a_2_2", "a_3"]
    assert comment("a */ b /* ??/\n") == "a * / b / * ? ?/ "
    assert line("\x00\ud800\n\x7f￿é") == "?? ??é"
    assert string('a"\\%é\n') == '"a\\042\\134\\045\\303\\251 "'
