"""The commands as a user types them."""

from __future__ import annotations

import csv
import json
import shlex
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from browser import without_scripts
from schemas import schema
from virtual import recorded, virtual_log, write_csv

from greybox.commands.diagnose import _where_antenna, _with_files, _with_model
from greybox.commands.main import main
from greybox.diagnosis.result import DiagnosisVerdict
from greybox.diagnosis.ruling import _next
from greybox.model.catalogue import get_structure
from greybox.report.next_steps import after_comparison
from greybox.trial.log import make_log
from greybox.vessel.toml import load_vessel

SCRIPT = [sys.executable, "-m", "greybox"]


def run(*arguments):
    return main([str(a) for a in arguments])


# no choice of structure, predictor and estimator
LEAST = ("--method", "ls", "--predictor", "basic", "--structure", "thesis")


def test_estimate_simulate_compare(tmp_path, capsys):
    log, model = write_csv(virtual_log(2, 2000), tmp_path / "trial.csv"), tmp_path / "m.json"
    assert run("estimate", log, "--vessel", "thesis", "--out", model) == 0
    shown = capsys.readouterr().out
    assert "Estimate of Thesis ship" in shown
    data = json.loads(model.read_text())
    schema("model-4").validate(data)
    assert data["names"][0] == "Xu"
    assert data["sample_time"] == 1.0
    assert data["provenance"]["command"]["vessel"] == "thesis"
    assert set(data["fit"]) == {"u", "v", "r"}

    out = tmp_path / "run.csv"
    assert run("simulate", model, log, "--out", out) == 0
    with open(out) as handle:
        rows = list(csv.DictReader(handle))
    assert list(rows[0])[:7] == ["t", "u", "v", "r", "psi", "x_n", "y_n"]
    assert len(rows) == 2000

    other = tmp_path / "ls.json"
    assert run("estimate", log, "--vessel", "thesis", *LEAST, "--out", other) == 0
    page, result = tmp_path / "c.html", tmp_path / "c.json"
    capsys.readouterr()
    assert run("compare", model, other, "--log", log, "--json", result, "--report", page) == 0
    compared = json.loads(result.read_text())
    assert [m["model"] for m in compared["models"]] == ["m", "ls"]
    assert set(compared["models"][0]["logs"][0]["fit"]) == {"u", "v", "r"}
    assert "'m' was estimated on this log: how it fits there" in capsys.readouterr().out
    raw = tmp_path / "raw.csv"
    raw.write_text("tvec,u\n0,1\n")
    assert run("simulate", model, raw, "--out", out) == 1
    assert "greybox import raw.csv --vessel thesis --out log.csv" in capsys.readouterr().err
    html = without_scripts(page.read_text())
    assert html.count("<svg") == 1
    assert "http://" not in html.replace("http://www.w3.org", "").replace(
        "http://purl.org", ""
    ).replace("http://creativecommons.org", "")
    assert "<script>" not in html


@pytest.mark.long
def test_same_input_same_bytes(noisy_csv, tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        assert run("estimate", noisy_csv, "--vessel", "thesis", "--covariance", "bootstrap",
                   "--method", "iv", "--predictor", "augmented", "--seed", "4",
                   "--out", tmp_path / name / "m.json") == 0  # fmt: skip
    one, two = (json.loads((tmp_path / n / "m.json").read_text()) for n in "ab")
    one["provenance"] = two["provenance"] = None
    assert one == two


@pytest.mark.long
def test_a_nominal_model_starts_the_refinement(noisy_csv, tmp_path):
    """From least squares or from a nominal model, the refinement ends at one estimate."""
    iv = ["--method", "iv", "--predictor", "augmented", "--structure", "thesis"]
    one, two = tmp_path / "one.json", tmp_path / "two.json"
    assert run("estimate", noisy_csv, "--vessel", "thesis", *iv, "--out", one) == 0
    assert run("estimate", noisy_csv, "--vessel", "thesis", *iv, "--nominal", one,
               "--out", two) == 0  # fmt: skip
    first, second = (json.loads(p.read_text()) for p in (one, two))
    np.testing.assert_allclose(second["theta"], first["theta"], rtol=1e-3)
    assert second["iterations"] < first["iterations"]


def test_json_to_standard_output(noisy_csv, capsys):
    assert run("estimate", noisy_csv, "--vessel", "thesis", "--method", "ls", "--predictor",
               "basic", "--json", "-") == 0  # fmt: skip
    assert json.loads(capsys.readouterr().out)["method"] == "ls"


def test_a_plan_of_commands_is_simulated_from_a_start(noisy_csv, tmp_path, capsys):
    model = tmp_path / "m.json"
    assert run("estimate", noisy_csv, "--vessel", "thesis", *LEAST, "--out", model) == 0
    plan = tmp_path / "plan.csv"
    t = np.arange(50)
    np.savetxt(plan, np.column_stack([t, 0 * t + 15, 0 * t + 0.8, 0 * t + 0.8]), delimiter=",",
               header="t,n,alpha1,alpha2", comments="")  # fmt: skip
    assert run("simulate", model, plan, "--out", tmp_path / "r.csv") == 1
    error = capsys.readouterr().err
    assert "cannot be derived" in error
    assert error.endswith("; commands alone are simulated with --start.\n")
    assert run("simulate", model, plan, "--start", "1.5,1.2,0,0", "--out", tmp_path / "r.csv") == 0
    for start in ("1.5,1.2", "1.5,1.2,0,nan", "inf,1.2,0,0"):
        assert run("simulate", model, plan, "--start", start, "--out", tmp_path / "n.csv") == 1
        assert "four finite numbers are needed" in capsys.readouterr().err
    held = ["--start", "1.5,1.2,0,0", "--heading", "measured", "--out", tmp_path / "n.csv"]
    assert run("simulate", model, plan, *held) == 1
    assert "holds no heading that changes: leave --heading out" in capsys.readouterr().err
    assert not (tmp_path / "n.csv").exists()
    given = ["simulate", model, noisy_csv, "--start", "1.5,1.2,0,0.5"]
    assert run(*given, "--out", tmp_path / "none.csv") == 1
    assert "leave --start out, or name a log of commands only." in capsys.readouterr().err
    assert not (tmp_path / "none.csv").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["estimate", "none.csv", "--vessel", "thesis"], "there is no file 'none.csv'"),
        (["estimate", "{log}", "--vessel", "none.toml"], "cannot read the vessel file"),
        (["estimate", "{log}", "--vessel", "thesis", "--structure", "thesys"], "Did you mean"),
        (["estimate", "{log}", "--vessel", "thesis", "--sample-time", "1.5"], "whole multiple"),
        (["compare", "{log}", "--log", "{log}"], "is not a model file"),
        (["compare", "m", "--log", "{log}", "--report", "x.pdf"], "a page is HTML: name a file"),
        (["diagnose", "{log}", "--vessel", "thesis", "--validate", "{log}"], "Name it once"),
        (
            ["diagnose", "{log}", "--vessel", "thesis", "--validate", "{log},{log}"],
            "separate the files with spaces",
        ),
        (["diagnose", "{log}", "{log}", "--vessel", "thesis"], "name each trial once"),
        (["reproduce", "chapter4", "--runs", "1"], "needs at least 2 runs"),
        (["reproduce", "chapter4", "--estimate", "x"], "belong to chapter7"),
        (["reproduce", "chapter6", "--sample-time", "2"], "takes no --sample-time: logs and"),
        (["reproduce", "chapter4", "--out", "{log}"], "cannot make the folder"),
        (["reproduce", "power", "--runs", "0"], "each effect needs at least 1 trial"),
        (["reproduce", "chapter7", "--sample-time", "2"], "and none is named"),
        (
            [
                "reproduce",
                "chapter7",
                "--estimate",
                "{log}",
                "--validate",
                "{log}",
                "--vessel",
                "thesis",
            ],
            "cannot judge it",
        ),
        (["import", "{log}", "{log}", "--vessel", "thesis", "--out", "x.csv"], "named 2 times"),
        (
            ["import", "{log}", "--vessel", "thesis", "--out", "x.csv", "--smooth", "r"],
            "write --smooth CHANNEL=S.",
        ),
        (["estimate", "", "--vessel", "thesis"], "a file of logs has an empty name"),
        (["check", "{log}", "--vessel", ""], "a file of vessel has an empty name"),
        (["check", "{log}", "--vessel", "thesis", "--report", "-"], "only --json writes to"),
        (["reproduce", "chapter7", "--estimate", "x"], "together"),
        (["reproduce", "chapter4", "--out", ""], "--out is empty: name what to write"),
        (["demo", "--out", ""], "--out is empty: name what to write"),
        (["estimate", "{log}", "--vessel", "thesis", "--json", ""], "--json is empty: name what"),
        (
            [
                "estimate",
                "{log}",
                "--vessel",
                "thesis",
                "--bound",
                "Xu=0:1",
                "Xu=0:2",
                "--method",
                "oe",
            ],
            "--bound gives 'Xu' twice: keep one of them.",
        ),
        (
            ["estimate", "{log}", "--vessel", "thesis", "--structure", "surge", "--margin-v", "1"],
            "--margin-v cuts out samples by v, which structure 'surge' has not",
        ),
        (["predict", "m.json", "turning", "--course", "nan"], "--course is nan, a finite number"),
        # what is named as its default is asked for all the same
        (
            ["estimate", "{log}", "--vessel", "thesis", "--method", "ls", "--loss", "gaussian"],
            "--loss applies to --method oe only",
        ),
        (
            ["estimate", "{log}", "--vessel", "thesis", "--method", "iv", "--wind", "measured"],
            "--wind applies to --method oe only",
        ),
        (
            ["import", "{log}", "--vessel", "thesis", "--out", "x.csv", "--window", "2"],
            "--velocities central has none",
        ),
    ],
)
def test_input_at_fault_is_one_sentence(noisy_csv, capsys, arguments, message):
    status = run(*[a.replace("{log}", str(noisy_csv)) for a in arguments])
    error = capsys.readouterr().err
    assert status == 1
    assert message in error
    assert error.count("\n") == 1
    assert "Traceback" not in error


def test_a_link_that_leads_round_is_no_file(tmp_path, capsys):
    loop = tmp_path / "loop.csv"
    loop.symlink_to(loop)
    for given in (["check", loop], ["estimate", loop], ["import", loop, "--out", loop]):
        assert run(*given, "--vessel", "thesis") == 1
        error = capsys.readouterr().err
        assert "loop.csv" in error
        assert error.count("\n") == 1


def test_a_folder_of_a_study_that_came_to_nothing_is_taken_away(noisy_csv, tmp_path):
    given = ["--estimate", noisy_csv, "--validate", noisy_csv, "--vessel", "thesis"]
    assert run("reproduce", "chapter7", *given, "--out", tmp_path / "c7" / "of" / "today") == 1
    assert not (tmp_path / "c7").exists()


def test_nothing_is_left_half_written(noisy_csv, tmp_path, capsys):
    out = tmp_path / "folder" / "m.json"
    assert run("estimate", noisy_csv, "--vessel", "thesis", "--out", out) == 1
    assert "cannot write" in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["trial.csv"]


def test_targets_are_checked_before_anything_is_written(noisy_csv, tmp_path, capsys):
    model = tmp_path / "m.json"
    assert run("estimate", noisy_csv, "--vessel", "thesis", "--out", model,
               "--json", tmp_path / "none" / "x.json") == 1  # fmt: skip
    assert run("estimate", noisy_csv, "--vessel", "thesis", "--out", tmp_path) == 1
    assert "it is a folder" in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["trial.csv"]


def test_a_device_is_written_and_not_replaced(noisy_csv):
    assert run("estimate", noisy_csv, "--vessel", "thesis", *LEAST, "--out", "/dev/null") == 0
    assert not Path("/dev/null").is_file()


def test_wrong_usage_exits_with_2(capsys):
    with pytest.raises(SystemExit) as stop:
        run("estmate")
    assert stop.value.code == 2
    assert "Did you mean 'estimate'" in capsys.readouterr().err
    with pytest.raises(SystemExit) as stop:
        run("estimate", "x.csv", "--vessel", "v", "--metod", "ls")
    assert stop.value.code == 2
    assert "Did you mean '--method'" in capsys.readouterr().err


def test_help_of_every_command(capsys):
    for command in ("estimate", "simulate", "compare", "reproduce"):
        with pytest.raises(SystemExit) as stop:
            run(command, "--help")
        assert stop.value.code == 0
        assert f"greybox {command}" in capsys.readouterr().out


def test_entry_points_are_the_declared_ones():
    declared = tomllib.loads(Path("pyproject.toml").read_text())["project"]["entry-points"]
    done = subprocess.run([*SCRIPT, "--help"], capture_output=True, text=True, check=True)
    for name in declared["greybox.commands"]:
        assert name in done.stdout


def test_help_imports_nothing_heavy():
    code = (
        "import sys; from greybox.commands.main import main\n"
        "try: main(['--help'])\nexcept SystemExit: pass\n"
        "assert not {'casadi', 'numpy', 'pandas', 'matplotlib'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


@pytest.mark.long
def test_reproduce_writes_tables_figures_and_page(tmp_path, capsys):
    out = tmp_path / "c4"
    assert run("reproduce", "chapter4", "--runs", "2", "--workers", "1", "--out", out) == 0
    with open(out / "tables.csv") as handle:
        rows = list(csv.DictReader(handle))
    assert list(rows[0]) == ["table", "set", "estimator", "parameter", "mean", "sd",
                             "published_mean", "published_sd", "runs"]  # fmt: skip
    assert {r["set"] for r in rows} == {"4.1-4.2", "4.3-4.5", "4.6-4.8", "4.9-4.11"}
    assert (out / "report.html").read_text().count("<svg") == 4
    assert len(list(out.glob("*.png"))) == 4


def test_reproduce_chapter7_on_logs(tmp_path, capsys):
    files = []
    for i in range(3):
        log = virtual_log(30 + i, 500, wind=3.0 if i < 2 else 0.5, name=f"day{i}")
        files.append(write_csv(log, tmp_path / f"day{i}.csv"))
    assert run("reproduce", "chapter7", "--vessel", "thesis", "--estimate", *files[:2],
               "--validate", files[2], "--runs", "5", "--out", tmp_path / "c7") == 0  # fmt: skip
    told = capsys.readouterr().out
    assert "estimation sets: 2 of 1 log;" in told
    assert "note: --runs changed nothing" in told
    assert (tmp_path / "c7" / "table_7.1.png").exists()


def test_physical_quantities_when_a_mass_is_given(noisy_csv, capsys):
    assert run("estimate", noisy_csv, "--vessel", "thesis", *LEAST, "--mass", "150000") == 0
    shown = capsys.readouterr().out
    assert "Physical quantities for m = 150000 kg" in shown
    assert "assumed added mass" in shown
    assert "Xvr·Yur = −Ts²" in shown


def test_no_command_writes_over_what_it_reads(tmp_path, capsys):
    write_csv(virtual_log(1, 200), tmp_path / "trial.csv")
    kept = (tmp_path / "trial.csv").read_bytes()
    path = str(tmp_path / "trial.csv")
    assert main(["estimate", path, "--vessel", "thesis", "--out", path]) == 1
    assert "--out would write over" in capsys.readouterr().err
    assert (tmp_path / "trial.csv").read_bytes() == kept
    same = str(tmp_path / "same")
    assert main(["estimate", path, "--vessel", "thesis", "--out", same, "--json", same]) == 1
    assert "which out names too" in capsys.readouterr().err


@pytest.mark.long
def test_columns_in_another_unit_are_told_by_every_command_that_reads_logs(tmp_path, capsys):
    columns = recorded(5, rate=1.0)
    columns |= {n: np.degrees(columns[n]) for n in ("psi", "alpha1")}
    columns |= {n: columns[n] / 0.514444 for n in ("u", "v")}
    log = tmp_path / "trial.csv"
    write_csv(make_log(load_vessel("thesis"), columns, 1.0), log, **columns)
    known = ("--log", log), (log, "--vessel", "thesis")
    model = tmp_path / "m.json"
    assert run("check", *known[1]) == 0
    found = [s.strip().removeprefix("fix: ") for s in capsys.readouterr().out.splitlines()]
    for command in (
        ["estimate", *known[1], *LEAST, "--out", model],
        ["compare", model, *known[0], "--no-bands"],
        ["simulate", model, log, "--no-bands", "--out", tmp_path / "run.csv"],
        [
            "diagnose",
            *known[1],
            "--model",
            model,
            "--causes",
            "current",
            "--out",
            tmp_path / "x.json",
        ],
    ):
        assert run(*command) == 0
        said = " ".join(capsys.readouterr().out.split())
        if command[0] == "diagnose":
            assert said.endswith("x.json: the model without a cause, as none stands")
        for name, unit in (("psi", "deg"), ("alpha1", "deg"), ("u", "kn"), ("v", "kn")):
            mend = f'"{name}" = {{ name = "{name}", unit = "{unit}" }}'
            assert mend in said, (command[0], mend)
            assert any(mend in line for line in found)


def test_more_than_two_causes_are_told_apart_by_one_trial():
    named = [SimpleNamespace(hypothesis=SimpleNamespace(id=i)) for i in ("current", "wind", "sign")]
    pair, whole = (_next(DiagnosisVerdict.CONFUSED, [g], False) for g in (named[:2], named))
    assert "--between MODEL.current.json MODEL.wind.json " in pair[0]
    assert "current from wind from sign: " in whole[0]
    assert "--model MODEL --for causes " in whole[0]


def test_sensors_are_doubted_before_an_error_without_a_cause_is():
    steps = _next(DiagnosisVerdict.UNEXPLAINED, [], False)
    record = {"command": {"logs": ["a.csv"], "vessel": "ship.toml", "out": "m.json"}}
    first, second = _with_files(steps, record)
    assert first.endswith(": greybox check a.csv --vessel ship.toml --report check.html")
    assert second.startswith("measure what the model does not know")


def test_next_steps_name_the_files_of_the_user():
    steps = [
        "tell apart: greybox design --vessel V --between MODEL.a.json MODEL.b.json --out plan.csv",
        "plan: greybox design --vessel V --model MODEL --duration 900 --out plan.csv",
    ]
    known = {"vessel": "my ship.toml"}
    record = {"command": known, "line": "greybox diagnose log.csv --vessel 'my ship.toml'"}
    first, between, plan = _with_files(steps, record)
    assert first == "write the models to files: the same command with: --out mended.json"
    assert "--vessel 'my ship.toml' --between mended.a.json mended.b.json " in between
    assert "--vessel 'my ship.toml' --model mended.json " in plan
    filled = _with_files(steps, record | {"command": known | {"out": "runs/better.json"}})
    assert "--between runs/better.a.json runs/better.b.json " in filled[0]
    assert "--model runs/better.json " in filled[1]
    assert len(filled) == 2
    model = SimpleNamespace(record={"provenance": record}, structure=get_structure("thesis"))
    verdict = SimpleNamespace(best="mine", in_sample=(), untested=False, diverging=None, weak=["u"])
    runs = [[SimpleNamespace(samples=600)]]
    best = SimpleNamespace(verdict=verdict, best=lambda: 0, runs=runs)
    (step,) = after_comparison(
        best, [model], {"command": {"models": ["mine.json"], "log": ["day 2.csv"]}}
    )
    assert step.command == (
        "greybox diagnose 'day 2.csv' --vessel 'my ship.toml' --model mine.json "
        "--report diagnosis.html"
    )


def test_after_a_diagnosis_both_models_are_compared_and_the_antenna_is_asked_for():
    found = SimpleNamespace(
        id="inertia_coupling", evidence="or an antenna ahead, which looks alike"
    )
    vessel = load_vessel("thesis")
    model = SimpleNamespace(vessel=vessel, structure=get_structure("thesis"))
    diagnosis = SimpleNamespace(causes=(found,), candidates=(), verdict="named", model=model)
    record = {"command": {"out": "mended.json", "validate": ["t3.csv"]}}
    compared, predicted = _with_model(diagnosis, record)
    assert compared.endswith(": greybox compare model.json mended.json --log t3.csv")
    # the limits of this ship keep her from straight ahead
    assert predicted.endswith(
        ": greybox predict mended.json zigzag --no-limits --report zigzag.html"
    )
    assert _with_model(diagnosis, {"command": {}}) == []
    none = SimpleNamespace(
        verdict="none", model=model, held_out_fit={"u": 90.0}, noise_bounds=lambda: {"u": 96.0}
    )
    (told,) = _with_model(none, {"command": {"model": "mine.json"}})
    assert "greybox predict mine.json zigzag" in told
    none.held_out_fit["u"] = 20.0
    assert _with_model(none, record) == []
    (asked,) = _where_antenna(diagnosis, replace(vessel, sensors={}))
    assert asked.endswith("state antenna = [x, y] in [sensors] of the vessel file, and repeat")
    assert _where_antenna(diagnosis, replace(vessel, sensors={"antenna": (1.0, 0.0)})) == []


def test_what_is_told_to_do_next_can_be_typed_as_it_stands(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_csv(virtual_log(2, 600), Path("my raw.csv"))
    command = ["greybox", "import", "my raw.csv", "--vessel", "thesis", "--out", "my log.csv"]
    walked = []
    while len(walked) < 3:
        walked.append(command[1])
        assert run(*command[1:], *(LEAST if command[1] == "estimate" else ())) == 0
        steps = [s for s in capsys.readouterr().out.splitlines() if s.startswith("next: ")]
        command = shlex.split(steps[0].split(": ")[-1])
    assert walked == ["import", "check", "estimate"]
    assert command[0] == "greybox"
    assert Path("check.html").exists()


def test_a_folder_of_raw_files_is_mended_as_it_was_checked(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("raw").mkdir()
    for seed in (2, 3):
        log = virtual_log(seed, 300)
        write_csv(log, Path(f"raw/day{seed}.csv"), psi=np.degrees(log["psi"]))
    assert run("check", "raw", "--vessel", "thesis") == 0
    told = capsys.readouterr().out.splitlines()
    step = next(s for s in told if s.startswith("next: ") and "--fix" in s)
    assert run(*shlex.split(step.split(": ")[-1])[1:]) == 0
    assert sorted(p.name for p in Path("mended").glob("*.csv")) == ["day2.csv", "day3.csv"]


def test_an_error_about_a_raw_file_tells_the_whole_command(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("my raw.csv").write_text("Time UTC,RPM\n0,1\n1,1\n")
    assert run("estimate", "my raw.csv", "--vessel", "thesis") == 1
    told = capsys.readouterr().err
    assert "greybox import 'my raw.csv' --vessel thesis --out log.csv" in told


@pytest.mark.parametrize("command", ["estimate", "diagnose"])
def test_a_model_is_not_written_under_the_ending_of_a_log(command, tmp_path, capsys):
    out = tmp_path / "model.csv"
    assert run(command, "none.csv", "--vessel", "thesis", "--out", out) == 1
    assert "a model is JSON: name a file that ends in .json" in capsys.readouterr().err
    assert not out.exists()


def test_a_predicted_run_is_written_as_a_log_only(tmp_path, capsys):
    assert run("predict", "m.json", "zigzag", "--out", tmp_path / "run.json") == 1
    assert "ends in '.json': name a log that ends in .csv or .parquet" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("given", "what"),
    [
        (("simulate", "m.json", "trial.csv"), "a run"),
        (("fleet", "."), "the table"),
        (("design", "--vessel", "thesis", "--model", "m.json", "--duration", "60"), "a plan"),
    ],
)
def test_text_is_not_written_under_the_ending_of_another_format(given, what, tmp_path, capsys):
    out = tmp_path / "run.parquet"
    assert run(*given, "--out", out) == 1
    assert f"{what} is CSV: name a file that ends in .csv" in capsys.readouterr().err
    assert not out.exists()
