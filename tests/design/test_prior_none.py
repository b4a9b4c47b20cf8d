"""`greybox design --prior none`: a first trial of ships of which no model is known."""

from __future__ import annotations

import json

import pandas as pd
import pytest
from foreign_ships import presets

from greybox.commands.main import main

ALIKE = ["--workers", "1", "--seed", "1", "--predictor", "basic"]
BRIEF = [*ALIKE, "--effort", "0.02"]
# one coefficient in one direction: a plan within seconds
FAST = [*ALIKE, "--effort", "0.001", "--want", "Xmu", "--regime", "u+", "--margin-u", "0.05"]


def vessel_file(folder, name, *, known=True, without=()):
    ship = presets()[name].ship
    lines = [x for x in ship.vessel_toml().splitlines() if x.split(" =")[0] not in without]
    if known:
        lines.insert(1, f"beam = {ship.beam:g}")
        lines.insert(1, f"mass = {ship.inertia[0]:g}")
        lines.insert(1, f"service_speed = {ship.service_speed:g}")
        lines += ["[conditions]", f"draught = {ship.draught:g}"]
    path = folder / f"{name}.toml"
    path.write_text("\n".join(lines))
    return path


def design(folder, vessel, *options):
    plan = folder / "plan.csv"
    return main(["design", "--vessel", str(vessel), "--out", str(plan), *options]), plan


def require_plan(plan, name, said, notes, *parts):
    ship = presets()[name].ship
    table = pd.read_csv(plan)
    assert list(table) == ["t", *["part"] * bool(parts), *(a.column for a in ship.actuators)]
    assert not parts or set(table["part"]) == set(parts)
    for a in ship.actuators:
        low, high = (1.0001 * limit for limit in a.limits)
        assert table[a.column].between(low, high).all()
    assert "planned without an estimated model" in said
    assert any("the model comes from length" in n for n in notes)


LONG = pytest.mark.long
# a plan for prediction, of the whole model
WHOLE = (BRIEF, ("trial", "validation"))


@pytest.mark.usefixtures("hasty")
@pytest.mark.parametrize(
    ("name", "duration", "hold", "options", "parts"),
    [
        ("kvlcc2-320m", "250", "50", FAST, ()),
        pytest.param("kvlcc2-7m", "60", "20", FAST, (), marks=LONG),
        pytest.param("training-ship-105m", "150", "50", FAST, (), marks=LONG),
        ("research-catamaran-29m", "60", "20", FAST, ()),
        pytest.param("kvlcc2-320m", "900", "60", *WHOLE, marks=LONG),
        pytest.param("training-ship-105m", "900", "30", *WHOLE, marks=LONG),
        pytest.param("research-catamaran-29m", "300", "10", *WHOLE, marks=LONG),
    ],
)
def test_a_plan_comes_for_each_kind_of_ship(
    tmp_path, capsys, name, duration, hold, options, parts
):  # fmt: skip
    out = tmp_path / "design.json"
    status, plan = design(
        tmp_path, vessel_file(tmp_path, name), "--prior", "none", "--duration", duration,
        "--hold", hold, "--json", str(out), *options,
    )  # fmt: skip
    said = capsys.readouterr()
    assert status == 0, said.err
    require_plan(plan, name, said.out, json.loads(out.read_text())["notes"], *parts)


@pytest.mark.usefixtures("hasty")
def test_sheet_and_page_say_it_first(tmp_path):
    vessel = vessel_file(tmp_path, "training-ship-105m")
    sheet, page = tmp_path / "sheet.html", tmp_path / "page.html"
    status, _ = design(
        tmp_path, vessel, "--prior", "none", "--duration", "150", "--hold", "50",
        "--sheet", str(sheet), "--report", str(page), *FAST,
    )  # fmt: skip
    assert status == 0
    assert "identification trial, planned without an estimated model</h1>" in sheet.read_text()
    assert "Planned without an estimated model, from main dimensions" in page.read_text()


@pytest.mark.usefixtures("hasty")
def test_thesis_ship_of_length_alone(tmp_path, capsys):
    status, _ = design(tmp_path, "thesis", "--prior", "none", "--duration", "100", *FAST)
    assert status == 0
    assert "state service_speed in the vessel file" in capsys.readouterr().out


@pytest.mark.parametrize("other", [["--model", "m.json"], ["--between", "a.json", "b.json"]])
def test_a_model_beside_none_is_refused(tmp_path, capsys, other):
    vessel = vessel_file(tmp_path, "kvlcc2-7m")
    status, plan = design(tmp_path, vessel, "--prior", "none", "--duration", "100", *other)
    said = capsys.readouterr().err
    assert status == 1
    assert not plan.exists()
    assert "--prior none starts without any model" in said
    assert other[0] in said
    assert said.strip().count("\n") == 0


def test_missing_length_names_key_and_file(tmp_path, capsys):
    vessel = vessel_file(tmp_path, "kvlcc2-7m", without=("length",))
    status, plan = design(tmp_path, vessel, "--prior", "none", "--duration", "100")
    said = capsys.readouterr().err
    assert status == 1
    assert not plan.exists()
    assert "the vessel file 'kvlcc2-7m.toml' has no 'length'" in said


def test_neither_model_nor_none_tells_both_ways(tmp_path, capsys):
    vessel = vessel_file(tmp_path, "kvlcc2-7m")
    status, _ = design(tmp_path, vessel, "--duration", "100")
    assert status == 1
    assert "--prior none" in capsys.readouterr().err
