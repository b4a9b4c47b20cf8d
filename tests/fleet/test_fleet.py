"""`greybox fleet`: folders of ships, one table, and what is told of them."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from fleet.fleets import planted
from schemas import schema
from virtual import virtual_log, write_csv

from greybox.commands.main import main
from greybox.errors import LogError, VesselError
from greybox.fleet.differing import least_deviation
from greybox.fleet.ships import find_ships
from greybox.fleet.trend import fit_trend
from greybox.report.fleet import fleet_page
from greybox.vessel.toml import example_vessel


def make_fleet(folder, names="abc", vessel="thesis", logs=1):
    for name in names:
        (folder / name).mkdir()
        shutil.copy(example_vessel(vessel), folder / name / "ship.toml")
        for k in range(logs):
            (folder / name / f"trial{k}.csv").write_text("t\n")


def test_ships_are_the_folders_with_a_vessel_file_and_logs(tmp_path):
    make_fleet(tmp_path, logs=2)
    (tmp_path / "notes").mkdir()
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / "trial.csv").write_text("t\n")
    ships, left_out = find_ships(tmp_path)
    assert [(s.name, len(s.logs)) for s in ships] == [("a", 2), ("b", 2), ("c", 2)]
    assert [one.sentence for one in left_out] == [
        "ship 'd' was left out: its folder has 0 vessel files (*.toml): keep exactly 1 there."
    ]


def test_a_folder_without_three_ships_is_refused(tmp_path):
    with pytest.raises(LogError, match="is no folder"):
        find_ships(tmp_path / "nowhere")
    make_fleet(tmp_path, "ab")
    (tmp_path / "c").mkdir()
    shutil.copy(tmp_path / "a" / "ship.toml", tmp_path / "c")
    with pytest.raises(LogError, match=r"has 2 ships \(a, b\) .* at least 3 .*'c' was left out"):
        find_ships(tmp_path)


def test_a_ship_of_another_class_is_named(tmp_path):
    make_fleet(tmp_path)
    make_fleet(tmp_path, "d", vessel="ferry")
    with pytest.raises(
        VesselError, match=r"ship 'd' has the thrusters .* 3 of 4 ships have azimuth"
    ):
        find_ships(tmp_path)


def test_outputs_stay_out_of_the_folders_of_ships(tmp_path, capsys):
    make_fleet(tmp_path)
    assert main(["fleet", str(tmp_path), "--out", str(tmp_path / "a" / "table.csv")]) == 1
    assert "in the folder of a ship" in capsys.readouterr().err


def test_a_line_in_time_is_found_and_scatter_is_not():
    rng = np.random.default_rng(1)
    times = np.arange(10.0)
    covariances = np.broadcast_to(0.01 * np.eye(2), (10, 2, 2))
    # beside their errors the second scatters from log to log
    y = np.column_stack([0.1 * times, 0.5 * rng.standard_normal(10)])
    trend = fit_trend(times, y + 0.1 * rng.standard_normal((10, 2)), covariances)
    assert trend.slope_interval[0, 0] < 0.1 < trend.slope_interval[0, 1]
    assert trend.p_values[0] < 1e-4
    assert trend.p_values[1] > 0.05
    assert trend.slope_df == 8


@pytest.mark.parametrize("periods", [4, 8])
def test_scatter_that_no_covariance_holds_is_no_change(periods):
    """Of models that do not fit, estimates differ by more than their standard errors."""
    rng = np.random.default_rng(periods)
    runs, times = 300, np.arange(float(periods))
    covariances = np.broadcast_to(0.01 * np.eye(2), (periods, 2, 2))
    found = []
    for _ in range(runs):
        y = 0.1 * rng.choice([1.0, 4.0], (periods, 1)) * rng.standard_normal((periods, 2))
        found.append(fit_trend(times, y, covariances).p_values)
    share = np.mean(np.array(found) < 0.05)
    assert share < 0.05 + 3 * np.sqrt(0.05 * 0.95 / (2 * runs))


def test_the_verdict_names_ship_and_coefficient():
    fleet = planted(odd=30.0, change=0.03)
    assert fleet.verdict.startswith("1 of 6 ships differs from the others: 'ship 1' in ")
    assert fleet.verdict.endswith("changing in time: Nr of 'ship 2'")
    value, _, shrinkage = fleet.pooled_of(0)
    assert value == pytest.approx(fleet.ships[0].theta)
    assert not shrinkage.any()
    assert planted().verdict == (
        "none of 6 ships differs from the others beyond chance; no coefficient of the 6 ships "
        "followed in time changes"
    )


def test_cautions_say_how_far_the_numbers_reach():
    reach, slope = planted().cautions
    assert slope.startswith("a line through 8 periods must climb by about 7 of its standard")
    assert "among 6 ships one coefficient must deviate by about 13 standard deviations" in reach
    # as the manual has it
    known = [least_deviation(units, 18) for units in (5, 10, 20)]
    np.testing.assert_allclose(known, [20, 7, 5], rtol=0.03)
    # of three ships, one of which differs, two are left, between which there is no spread
    assert any("among 3 ships" in c for c in planted(3, odd=2000.0).cautions)
    found = planted(3, 2)
    lost = replace(found.ships[0], fit={"u": -np.inf, "v": 3.0, "r": 4.0})
    fleet = replace(found, ships=(lost, *found.ships[1:]))
    assert fleet.cautions[0].startswith("the free run of 'ship 1' fits its own logs no better")
    assert fleet.cautions[1].startswith("each of 'ship 1', 'ship 2', 'ship 3' has fewer than 4 l")
    assert f"caution: {fleet.cautions[0]}." in fleet.summary()
    assert "u diverged, v 3 %" in fleet.summary()


def test_json_and_table_hold_every_coefficient_of_every_ship():
    fleet = planted(odd=30.0, left_out=[("ship 9", "its folder has no logs.")])
    made = {"program": "", "command": {}}
    data = json.loads(json.dumps(fleet.to_dict() | {"provenance": made}, default=np.ndarray.tolist))
    schema("fleet-1").validate(data)
    assert not schema("fleet-1").is_valid(data | {"ships": []})
    rows = fleet.rows()
    assert len(rows) == 6 * 18
    assert {r["ship"] for r in rows if r["difference"] is not None} == {"ship 1"}


@pytest.fixture(scope="module")
def sailed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fleets") / "ferries"
    folder.mkdir()
    make_fleet(folder, "abcd", logs=0)
    for k, name in enumerate("abc"):
        for n in range(2):
            write_csv(virtual_log(10 * k + n, 500), folder / name / f"trial{n}.csv")
    (folder / "d" / "trial.csv").write_text("t,u\n0,zero\n")
    return folder


@pytest.mark.long
def test_the_command_leaves_out_what_cannot_be_read_and_does_the_rest(sailed, capsys):
    table, result = sailed.parent / "table.csv", sailed.parent / "result.json"
    page = sailed.parent / "page.html"
    given = ["--out", str(table), "--json", str(result), "--report", str(page)]
    assert main(["fleet", str(sailed), *given]) == 0
    assert "ship 'd' was left out: " in capsys.readouterr().out
    data = json.loads(result.read_text())
    schema("fleet-1").validate(data)
    assert [s["ship"] for s in data["ships"]] == ["a", "b", "c"]
    assert len(data["provenance"]["inputs"]) == 4 + 7
    with open(table, newline="") as handle:
        rows = list(csv.DictReader(handle))
    assert len(rows) == 3 * len(data["names"])
    assert float(rows[0]["pooled"]) == pytest.approx(data["ships"][0]["pooled"][0])
    assert "Ship &#39;d&#39; was left out" in page.read_text()


def test_units_on_the_page_are_those_of_other_pages():
    page = fleet_page(planted(change=0.03), {})
    units = {row[0]: row[-1] for row in page.sections[0].tables[0].rows}
    assert (units["Nr"], units["Nuv"]) == ("", "s/m²")
    assert page.sections[2].pictures[0].chart.panels[0].y_label == "Nr"
