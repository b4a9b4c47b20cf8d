"""`greybox predict` as a user types it, and its page."""

from __future__ import annotations

import json
import math
import re

import numpy as np
import pytest
from manoeuvring import rudder_model

from greybox.commands.main import main
from greybox.model.model import load_model
from greybox.prediction.predict import predict_manoeuvre
from greybox.trial.convert.read import read_log
from greybox.trial.manoeuvres import find_manoeuvres


def run(*arguments):
    return main([str(a) for a in arguments])


@pytest.fixture
def model(tmp_path):
    path = tmp_path / "m.json"
    limits = {"rudder_limits": [-0.7, 0.7], "rudder_rate": 0.2, "speed_limits": [-10.0, 15.0]}
    rudder_model(step=0.25, spread=0.03, **limits).save(path)
    return path


def test_a_turn_is_predicted_written_and_shown(model, tmp_path, capsys):
    result, page, out = tmp_path / "t.json", tmp_path / "t.html", tmp_path / "t.csv"
    assert run("predict", model, "turning", "--speed", "2", "--draws", "60", "--json", result,
               "--report", page, "--out", out) == 0  # fmt: skip
    shown = capsys.readouterr().out
    assert "Turning circle of Rudder ship, predicted" in shown
    assert "IMO advance, at most 4.5 L: meets" in shown
    assert "are for ships of 100 m and more, and this one is 20 m long" in shown
    data = json.loads(result.read_text())
    rows = {(r["side"], r["name"]): r for r in data["quantities"]}
    row = rows["starboard", "tactical_diameter"]
    assert row["unit"] == "m"
    assert row["ci"][0] < row["value"] < row["ci"][1]
    assert row["criterion"]["at_most"] == 100.0
    assert row["verdict"] == "meets"
    assert rows["port", "steady_yaw_rate"]["value"] < 0
    assert row["steering"] == pytest.approx(math.radians(35))
    html = page.read_text()
    assert html.count("<svg") == 4
    assert "Limits of IMO MSC.137(76): 4 of 4 met." in html
    assert "<script" not in html
    # what the approach was sailed with, as the terminal tells it, and how it was computed
    assert "approach with n = " in shown
    assert html.count(">n of the approach</td>") == 2
    assert ">computed with</td>" in html
    assert "versions numpy" not in html
    logs = sorted(tmp_path.glob("t_*.csv"))
    assert [p.name for p in logs] == ["t_port_35.csv", "t_starboard_35.csv"]
    log = read_log(logs[0], load_model(model).vessel)
    (turn,) = find_manoeuvres(log)
    assert turn.direction == -1


def test_json_to_standard_output_is_that_of_the_library(model, capsys):
    assert run("predict", model, "zigzag", "--angle", "10", "20/15", "--side", "port",
               "--draws", "40", "--json", "-") == 0  # fmt: skip
    data = json.loads(capsys.readouterr().out)
    data.pop("provenance")
    made = predict_manoeuvre(
        load_model(model),
        "zigzag",
        angles=[math.radians(10), (math.radians(20), math.radians(15))],
        side="port",
        draws=40,
    )
    assert [r["value"] for r in data["quantities"]] == [
        r["value"] for r in made.to_dict()["quantities"]
    ]
    assert made.summary() in made._repr_html_().replace("&#x27;", "'")
    assert {r["reversed_at"] for r in data["quantities"]} == {math.radians(10), math.radians(15)}


def test_a_trial_beside_it(model, tmp_path, capsys):
    """What the model itself sailed agrees with it."""
    out, page = tmp_path / "z.csv", tmp_path / "z.html"
    zigzag = ["zigzag", "--angle", "20", "--side", "starboard", "--draws", "60"]
    assert run("predict", model, *zigzag, "--out", out) == 0
    assert run("predict", model, *zigzag, "--trial", out, "--report", page) == 0
    shown = capsys.readouterr().out
    assert "agree: all 8 differences lie within both intervals" in shown
    assert "8 of 8 measured quantities agree" in page.read_text()
    assert f"greybox export {model} --to c --out model.c" in shown
    assert run("predict", model, "crash", "--trial", out) == 1
    assert "no crash manoeuvre in 'z', but zig-zag 20/20" in capsys.readouterr().err


def test_a_crash_stop(model, tmp_path, capsys):
    page = tmp_path / "c.html"
    assert run("predict", model, "crash", "--command", "n=12", "--draws", "40",
               "--report", page) == 0  # fmt: skip
    shown = capsys.readouterr().out
    assert re.search(r"IMO track reach, at most 15 L: extrapolated: cannot be told", shown)
    assert page.read_text().count("<svg") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["turning", "--angle", "x"], "--angle is 'x': write degrees"),
        (["zigzag", "--angle", "20/10/5"], "--angle is '20/10/5': write degrees"),
        (["turning", "--command", "n=fast"], "--command is 'n=fast': write one number"),
        (["turning", "--speed", "40"], "does not hold 40 m/s"),
        (["turning", "--speed", "4"], "4 kn is 2.06 m/s. Give --speed between these"),
        (["turning", "--current", "--still-water"], "--current and --still-water exclude one"),
        (["turning", "--draws", "3"], "3 draws are too few"),
        (["turning", "--trial", "none.csv"], "there is no file 'none.csv'"),
        (["turning", "--report", "no/x.html"], "cannot write 'no/x.html'"),
    ],
)
def test_input_at_fault_is_one_sentence(model, capsys, arguments, message):
    assert run("predict", model, *arguments) == 1
    error = capsys.readouterr().err
    assert error.startswith("greybox predict: ")
    assert message in error
    assert error.count("\n") == 1


def test_an_angle_in_radians_is_asked_about(model, capsys):
    assert run("predict", model, "turning", "--angle", "0.01", "--draws", "40") == 0
    said = "--angle 0.01 is in degrees, and the ship hardly turns; 0.01 rad is 0.6 deg."
    assert said in capsys.readouterr().out


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("predict m.json turning --rudder 35", "Did you mean '--angle'?"),
        ("design --vessel v --out p --duration 15min", "no positive number, write seconds: 900."),
        ("design --vessel v --out p --duration 0.5h", "no positive number, write seconds: 1800."),
    ],
)
def test_what_is_meant_is_told_in_the_options_own_words(line, message, capsys):
    with pytest.raises(SystemExit):
        main(line.split())
    assert message in capsys.readouterr().err


def test_estimates_keep_the_ranges_of_their_logs(noisy_csv, tmp_path):
    path = tmp_path / "m.json"
    assert run("estimate", noisy_csv, "--vessel", "thesis", "--method", "ls", "--predictor",
               "basic", "--out", path) == 0  # fmt: skip
    ranges = load_model(path).record["ranges"]
    assert set(ranges) == {"u", "v", "r", "n", "alpha1", "alpha2"}
    log = read_log(noisy_csv, load_model(path).vessel)
    for name, (low, high) in ranges.items():
        assert log[name].min() <= low < high <= log[name].max()
        assert np.mean((log[name] >= low) & (log[name] <= high)) >= 0.997
