"""Damaged logs, vessel and model files end a command in one sentence, or are read."""

from __future__ import annotations

import json

import numpy as np
import pytest
from designs import thesis_model
from virtual import virtual_log

from greybox.commands.main import main
from greybox.vessel.toml import example_vessel

CELLS = ("", "nan", "inf", "-1e300", "abc", "12,5", "999999", '"', "1.2.3", "é")
VALUES = (None, True, "x", -1, 1e308, float("nan"), [], {"a": 1}, "RK4", [[1]])
# what no message may hold
PROGRAM = ("casadi", "numpy", "Traceback", "Error:", "broadcast")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    where = tmp_path_factory.mktemp("damaged")
    thesis_model().save(where / "m.json")
    log = virtual_log(1, 100)
    names = ["t", *log.channels]
    rows = [[f"{x:.6g}" for x in row] for row in np.column_stack([log.t, *log.channels.values()])]
    (where / "rows.json").write_text(json.dumps([names, rows]))
    write(where / "clean.csv", names, rows)
    return where


def write(path, names, rows):
    path.write_text("\n".join(",".join(r) for r in [names, *rows]) + "\n")
    return str(path)


def damaged_log(folder, seed):
    """A log with a few cells, rows and times damaged."""
    rng = np.random.default_rng([7, seed])
    names, rows = json.loads((folder / "rows.json").read_text())
    for _ in range(rng.integers(1, 4)):
        k, j = int(rng.integers(3, len(rows) - 4)), int(rng.integers(0, len(names)))
        bad = CELLS[rng.integers(0, len(CELLS))]
        match int(rng.integers(0, 6)):
            case 0 | 1:
                rows[k][j : j + 1] = [bad]
            case 2:
                for row in rows[k : k + 20]:
                    row[j : j + 1] = [bad]
            case 3:
                rows.insert(k, list(rows[k]))
            case 4:
                # a single sample between two gaps
                del rows[k + 1 : k + 3], rows[k - 2 : k]
            case 5:
                rows[k] = rows[k][:j]
    return write(folder / "log.csv", names, rows)


def damaged_model(folder, seed):
    """A model file with one entry gone or of another kind."""
    rng = np.random.default_rng([8, seed])
    data = json.loads((folder / "m.json").read_text())
    node = data
    while True:
        keys = list(node) if isinstance(node, dict) else range(len(node))
        key = keys[rng.integers(0, len(keys))]
        if isinstance(node[key], dict | list) and node[key] and rng.random() < 0.7:
            node = node[key]
            continue
        if rng.random() < 0.3:
            del node[key]
        else:
            node[key] = VALUES[rng.integers(0, len(VALUES))]
        break
    (folder / "damaged.json").write_text(json.dumps(data))
    return str(folder / "damaged.json")


def damaged_vessel(folder, seed):
    """A vessel file with one line damaged."""
    rng = np.random.default_rng([9, seed])
    lines = example_vessel("thesis").read_text().splitlines()
    k = int(rng.integers(0, len(lines)))
    values = ("nan", "-1", '"x"', "[]", "true", "1e308", "{a=1}")
    if "=" in lines[k] and rng.random() < 0.6:
        lines[k] = f"{lines[k].split('=')[0]}= {values[rng.integers(0, len(values))]}"
    else:
        at = int(rng.integers(0, len(lines[k]) + 1))
        lines[k] = lines[k][:at] + "[]=#x"[rng.integers(0, 5)] + lines[k][at + 1 :]
    (folder / "v.toml").write_text("\n".join(lines))
    return str(folder / "v.toml")


def ended_well(words, capsys):
    """Run a command: it is done, or says one sentence of its own."""
    code = main(words)
    said = capsys.readouterr().err.strip()
    if code == 0:
        return True
    assert code == 1
    assert said
    assert "\n" not in said
    assert not any(word in said for word in PROGRAM), said
    return False


def test_damaged_logs(folder, capsys):
    out, model = str(folder / "run.csv"), str(folder / "m.json")
    done = [
        ended_well(["simulate", model, damaged_log(folder, k), "--no-bands", "--out", out], capsys)
        for k in range(30)
    ]
    assert 5 < sum(done) < 30


@pytest.mark.parametrize("method", ["ls", "iv", "oe"])
def test_estimates_of_damaged_logs(folder, method, capsys):
    for k in range(3):
        ended_well(
            ["estimate", damaged_log(folder, k), "--vessel", "thesis", "--structure", "thesis",
             "--predictor", "basic", "--method", method, "--covariance", "white",
             "--out", str(folder / "e.json")], capsys,
        )  # fmt: skip


@pytest.mark.parametrize(
    ("column", "rows", "cell"),
    [
        ("t", slice(50, 51), "1e308"),
        ("n", slice(None), ""),
        ("u", slice(30, 31), "1e300"),
        ("alpha1", slice(40, 42), "-1e200"),
    ],
)
def test_logs_with_columns_of_nothing_or_of_what_no_ship_does_are_checked(
    folder, column, rows, cell, capsys
):
    names, values = json.loads((folder / "rows.json").read_text())
    for row in values[rows]:
        row[names.index(column)] = cell
    log, found = write(folder / "blank.csv", names, values), folder / "found.json"
    assert ended_well(["check", log, "--vessel", "thesis", "--json", str(found)], capsys)
    findings = json.loads(found.read_text())["findings"]
    assert [f["channel"] for f in findings if f["id"] == "nan"] == (
        [column] if column != "t" else []
    )
    ended_well(
        ["import", "--fix", log, "--vessel", "thesis", "--out", str(folder / "i.csv")], capsys
    )


def test_damaged_models_and_vessels(folder, capsys):
    log, out = str(folder / "clean.csv"), str(folder / "run.csv")
    done = []
    for k in range(24):
        words = ["simulate", damaged_model(folder, k), log, "--no-bands", "--out", out]
        done.append(ended_well(words, capsys))
    assert 5 < sum(done) < 24
    for k in range(12):
        ended_well(
            ["estimate", log, "--vessel", damaged_vessel(folder, k), "--structure", "thesis",
             "--predictor", "basic", "--method", "ls", "--covariance", "white",
             "--out", str(folder / "e.json")], capsys,
        )  # fmt: skip
