"""A folder of logs is estimated as its files are when they are named."""

from __future__ import annotations

import json

import numpy as np
import pytest
from virtual import virtual_log, write_csv

from greybox.commands.main import main

OPTIONS = ("--vessel", "thesis", "--method", "ls", "--predictor", "basic")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    where = tmp_path_factory.mktemp("trials") / "logs"
    where.mkdir()
    for k in range(3):
        write_csv(virtual_log(k, 400, wind=0.0, current=(0.0, 0.0)), where / f"day{k}.csv")
    return where


def estimated(tmp_path, *logs):
    out = tmp_path / "model.json"
    main(["estimate", *map(str, logs), *OPTIONS, "--json", str(out)])
    found = json.loads(out.read_text())
    made = found.pop("provenance")
    return found, made


def test_a_folder_gives_what_naming_its_files_gives(folder, tmp_path):
    named, how = estimated(tmp_path, *sorted(folder.glob("*.csv")))
    for typed in (folder, folder / "day*.csv"):
        found, made = estimated(tmp_path, typed)
        assert found == named
        assert made["inputs"] == how["inputs"]


def test_what_is_no_log_in_a_folder_is_left_out_and_named(folder, tmp_path):
    named, _ = estimated(tmp_path, *sorted(folder.glob("*.csv")))
    (folder / "broken.csv").write_text("t,u\n0,1\n1,2\n2,3\n")
    try:
        found, _ = estimated(tmp_path, folder)
    finally:
        (folder / "broken.csv").unlink()
    assert found["theta"] == named["theta"]
    assert any(n.startswith("'broken.csv' was left out: ") for n in found["notes"])


def test_a_broken_file_that_is_named_stops_the_command(folder, tmp_path, capsys):
    broken = tmp_path / "broken.csv"
    broken.write_text("t,u\n0,1\n1,2\n2,3\n")
    assert main(["estimate", str(folder), str(broken), *OPTIONS]) == 1
    assert "broken.csv" in capsys.readouterr().err


def test_a_run_is_of_one_log_of_a_folder(folder, tmp_path, capsys):
    model, out, few = tmp_path / "m.json", tmp_path / "run.csv", tmp_path / "few"
    main(["estimate", str(folder / "day0.csv"), *OPTIONS, "--out", str(model)])
    few.mkdir()
    for said in ("holds 0 files that end in .csv", "holds 3 logs, and one run is of 1"):
        typed = few if " 0 " in said else folder
        assert main(["simulate", str(model), str(typed), "--out", str(out)]) == 1
        assert said in capsys.readouterr().err
    (few / "day0.csv").write_bytes((folder / "day0.csv").read_bytes())
    assert main(["simulate", str(model), str(few), "--no-bands", "--out", str(out)]) == 0


def test_a_folder_is_compared_and_checked_file_by_file(folder, tmp_path):
    model, out = tmp_path / "m.json", tmp_path / "c.json"
    main(["estimate", str(folder), *OPTIONS, "--out", str(model)])
    main(["compare", str(model), "--log", str(folder), "--no-bands", "--json", str(out)])
    assert len(json.loads(out.read_text())["provenance"]["logs"]) == 3
    main(["check", str(folder), "--vessel", "thesis", "--json", str(out)])
    assert len(json.loads(out.read_text())["logs"]) == 3


def test_what_is_noted_of_all_logs_is_told_once(folder, tmp_path, capsys):
    raw = tmp_path / "raw"
    raw.mkdir()
    for log in folder.glob("*.csv"):
        named = log.read_text().replace("psi", "Gyro heading [rad]", 1)
        (raw / log.name).write_text(named)
    assert main(["check", str(raw), "--vessel", "thesis"]) == 0
    out = capsys.readouterr().out
    told = "Gyro heading [rad] taken for psi in rad"
    assert out.count(told) == 1
    alike = out.partition("all logs:\n")[2].partition("\nday0: ")[0]
    assert f"  note: {told}" in alike.splitlines()
    assert main(["check", str(raw / "day0.csv"), "--vessel", "thesis"]) == 0
    assert f"  note: {told}\n" in capsys.readouterr().out


def test_a_comparison_counts_each_trial_once_and_names_what_is_no_log(folder, tmp_path, capsys):
    model, log = tmp_path / "m.json", folder / "day0.csv"
    main(["estimate", str(log), *OPTIONS, "--out", str(model)])
    logs = tmp_path / "logs"
    logs.mkdir()
    given = ["compare", str(model), "--no-bands", "--log"]
    (logs / "run.csv").write_text("t,u\n0,1\n1,2\n2,3\n")
    assert main([*given, str(logs)]) == 1
    (logs / "first.csv").write_bytes(log.read_bytes())
    capsys.readouterr()
    assert main([*given, str(logs)]) == 0
    assert "note: 'run.csv' was left out: " in capsys.readouterr().out
    assert main([*given, str(log), str(log)]) == 1
    assert "'day0.csv' is named 2 times" in capsys.readouterr().err
    assert main([*given, str(log), str(logs / "first.csv")]) == 1
    assert "'day0' and 'first' hold the same 400 samples" in capsys.readouterr().err


def test_a_folder_beyond_the_memory_is_compared_with_the_same_numbers(
    folder, tmp_path, monkeypatch
):
    monkeypatch.setattr("greybox.report.comparison.MOST_LOGS", 1)
    model, found = tmp_path / "model.json", []
    main(["estimate", str(folder / "day0.csv"), *OPTIONS, "--out", str(model)])
    for k, memory in enumerate((4, 1e-9)):
        out, page = tmp_path / f"{k}.json", tmp_path / f"{k}.html"
        main(["compare", str(model), "--log", str(folder), "--json", str(out),
              "--memory", str(memory), "--report", str(page)])  # fmt: skip
        found.append(json.loads(out.read_text()) | {"provenance": None})
        assert "fits worst" in page.read_text()
    assert found[0] == found[1]
    assert [log["samples"] for log in found[1]["models"][0]["logs"]] == [400] * 3


def test_logs_beyond_the_memory_are_read_in_passes(folder, tmp_path, capsys):
    named, _ = estimated(tmp_path, folder)
    found, _ = estimated(tmp_path, folder, "--memory", "0.001")
    told = found["stream"]
    assert (told["files"], told["rows"]) == (3, 1200)
    assert told["drawn"]["share"] == 1.0
    assert [s["samples"] for s in told["drawn"]["stretches"]] == [400, 400, 400]
    # least squares of segments is that of all samples
    np.testing.assert_allclose(found["theta"], named["theta"], rtol=1e-7)
    assert any("rest on 1200 of them (100 %) in 3 stretches" in n for n in found["notes"])
    assert {t.split("_")[0] for t in found["tests"]} >= {"relevance", "input", "stability"}
    assert found["verdict"]["prediction"]["level"] in ("good", "limited", "poor")


@pytest.mark.long
def test_logs_beyond_the_memory_are_diagnosed_on_stretches(folder, tmp_path, monkeypatch):
    monkeypatch.setattr("greybox.selection.stretches._DRAWN", 800)
    model, out = tmp_path / "model.json", tmp_path / "d.json"
    main(["estimate", str(folder / "day0.csv"), *OPTIONS, "--out", str(model)])
    asked = ["diagnose", str(folder), "--vessel", "thesis", "--model", str(model), "--causes",
             "input_delay", "--memory", "0.001"]  # fmt: skip
    main([*asked, "--json", str(out)])
    found = json.loads(out.read_text())
    assert (found["stream"]["files"], found["stream"]["rows"]) == (3, 1200)
    assert found["stream"]["drawn"]["share"] == pytest.approx(2 / 3)
    assert any("rests on 800 of them (66.7 %) in 2 stretches" in n for n in found["notes"])
    assert len(found["provenance"]["logs"]) == 2
    assert main([*asked, "--validate", str(folder / "day2.csv")]) == 1


@pytest.mark.long
def test_logs_beyond_the_memory_are_checked_in_groups(folder, tmp_path, capsys):
    found = []
    for name, memory in (("whole", 4), ("groups", 0.00045)):
        out, page = tmp_path / f"{name}.json", tmp_path / f"{name}.html"
        main(["check", str(folder), "--vessel", "thesis", "--memory", str(memory),
              "--json", str(out), "--report", str(page)])  # fmt: skip
        found.append(json.loads(out.read_text()))
        assert page.exists()
    whole, groups = found
    assert groups["provenance"]["judged_together"] == [["day0.csv", "day1.csv"], ["day2.csv"]]
    assert (
        "3 logs take more than --memory, and were judged together in 2" in capsys.readouterr().out
    )
    # what each log is judged by alone is the same
    for a, b in zip(whole["logs"], groups["logs"], strict=True):
        assert (a["log"], a["regimes"], a["manoeuvres"]) == (
            b["log"],
            b["regimes"],
            b["manoeuvres"],
        )
    assert "judged_together" not in whole["provenance"]


def test_a_broken_file_of_a_stream_is_left_out_and_named(folder, tmp_path):
    named, _ = estimated(tmp_path, folder, "--memory", "0.001")
    (folder / "broken.csv").write_text("t,u\n0,1\n1,2\n2,3\n")
    try:
        found, _ = estimated(tmp_path, folder, "--memory", "0.001")
    finally:
        (folder / "broken.csv").unlink()
    assert found["theta"] == named["theta"]
    (told,) = found["stream"]["left_out"]
    assert told.startswith("'broken.csv' was left out: ")
    assert told in found["notes"]


@pytest.mark.parametrize(
    ("options", "asked"),
    [
        (["--method", "oe"], "--method oe"),
        (["--method", "iv", "--prefilter", "noise"], "--prefilter noise"),
        (["--method", "ls", "--covariance", "hac"], "--covariance hac"),
    ],
)
def test_what_needs_all_samples_is_refused_of_a_stream(folder, capsys, options, asked):
    common = ["estimate", str(folder), "--vessel", "thesis", "--memory", "0.001"]
    assert main([*common, *options]) == 1
    assert f"{asked} needs all samples in memory at once" in capsys.readouterr().err


@pytest.mark.long
def test_structures_are_compared_on_stretches_of_a_stream(folder, tmp_path):
    out = tmp_path / "model.json"
    options = ["--vessel", "thesis", "--method", "iv", "--memory", "0.001", "--json", str(out)]
    main(["estimate", str(folder), *options, "--compare-structures", "thesis", "linear"])
    found = json.loads(out.read_text())
    assert found["structure_choice"]
    assert found["stream"]["passes"] >= 2


def test_a_file_of_a_stream_does_not_validate_it(folder, capsys):
    options = [*OPTIONS, "--memory", "0.001", "--validate", str(folder / "day1.csv")]
    assert main(["estimate", str(folder), *options]) == 1
    assert "a log that the estimate used cannot judge it" in capsys.readouterr().err
