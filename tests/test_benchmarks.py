"""The benchmarks: speed as on record in the manual, and what counts in a comparison."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from greybox.numerics.compiler import find_compiler
from greybox.numerics.machine_code import cache_folder

ROOT = Path(__file__).parents[1]


def ratios(path: Path) -> dict[tuple[str, float, str], float]:
    rows = json.loads(path.read_text(encoding="utf-8"))["rows"]
    return {
        (r["name"], r["size"], r["alternative"]): r["ratio"] for r in rows if r["ratio"] is not None
    }


# the record is of a step in machine code
NO_LOOPS = find_compiler() is None or cache_folder() is None


@pytest.mark.long
@pytest.mark.parametrize(
    "row",
    [
        pytest.param("free-run", marks=pytest.mark.skipif(NO_LOOPS, reason="no C compiler")),
        "iv",
    ],
)
def test_speed_is_at_least_half_of_that_on_record(tmp_path, row):
    made = tmp_path / "benchmarks.json"
    command = [sys.executable, "-m", "benchmarks", "--rows", row, "--json", made]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    record, now = ratios(ROOT / "docs" / "benchmarks.json"), ratios(made)
    both = sorted(record.keys() & now.keys())
    assert {name for name, _, _ in both} == {row}
    slower = {k: (now[k], record[k]) for k in both if now[k] < record[k] / 2}
    assert not slower


def test_a_run_of_scipy_that_escapes_counts_as_one_of_ours_does(monkeypatch, tmp_path):
    for folder in (ROOT, ROOT / "benchmarks"):
        monkeypatch.syspath_prepend(folder)
    # interpreted, where Numba is not installed
    monkeypatch.setitem(sys.modules, "numba", SimpleNamespace(njit=lambda **_: lambda work: work))
    held_out, logs, peer = map(import_module, ("benchmarks.held_out", "held_out_logs",
                                               "held_out_scipy"))  # fmt: skip
    monkeypatch.delitem(sys.modules, "held_out_scipy")
    y = 0.1 * np.random.default_rng(0).standard_normal((200, 3))
    run = logs.Run("log", np.arange(200.0), y, np.ones((200, 1)))
    np.savetxt(tmp_path / "raw.csv", np.c_[run.t, y], delimiter=",", header="t,u,v,r", comments="")
    family = peer.Family([(0, "", "x,,"), (1, "", ",x,"), (2, "", ",,x")], [""], [run])
    # surge grows by a half a sample
    x, _, left = family.run(np.array([0.5, 0, 0]) / family.scale, run, np.arange(3))
    assert 0 < left < 50
    logs.write({"out": tmp_path}, run, x)
    escaped, none = (held_out.score(tmp_path / "raw.csv", tmp_path / f"{n}.csv")
                     for n in ("log", "none"))  # fmt: skip
    assert escaped == none


def test_pairs_with_a_failed_trial_are_told_by_their_number(monkeypatch):
    monkeypatch.syspath_prepend(ROOT)
    designs = import_module("benchmarks.foreign_designs")
    case = {arm: [80.0, 80.0, 80.0] for arm in ("first", *designs.ARMS)}
    cases = [case, case | {"random": [60.0] * 3}, case | {"zigzag": [np.nan] * 3}]
    off = [dict.fromkeys(case, (0.2, 0.3)) for _ in cases]
    off[1]["random"] = (0.4, 0.3)
    told = designs.row("ship", cases, "plan", off)
    assert "1.26 (0.47 to 3.40) n=3" in told
    assert "1.00 (1.00 to 1.00) n=2" in told
    # of linear derivatives on a course, and over the envelope, after those of free runs
    others = len(designs.ARMS) - 1
    course, envelope = (told.split("   ")[k * others :] for k in (-2, -1))
    assert "(0.47 to 3.40)" in " ".join(course)
    assert {x.strip() for x in envelope if x} == {"1.00 (1.00 to 1.00) n=3"}


def test_linear_derivatives_are_those_of_the_simulator(monkeypatch):
    monkeypatch.syspath_prepend(ROOT)
    designs = import_module("benchmarks.foreign_designs")
    ship, length, speed = designs.presets()["kvlcc2-7m"].ship, 7.0, 1.0
    made = np.array([[-0.3, 0.2, 0.05], [-1.1, -2.0, -0.4]])
    scale = length / speed
    sizes = np.array([speed / scale, 1 / scale**2])

    def rates(x, commands):
        turn = commands[1] / ship.helm(designs.AHEAD, 1.0)[1]
        told = made @ [x[1] / speed, x[2] * scale, turn]
        # what is even in the motion has no slope on a straight course
        return np.append(0.0, sizes * (told + 5 * x[1] ** 2))

    course = np.array([speed, 0.0, 0.0])
    found = designs.on_course("kvlcc2-7m", rates, course, scale)
    np.testing.assert_allclose(found, made, atol=1e-9)
    drifting = [(np.add(course, [0.0, v, 0.0]), ship.helm(0.5, 0.3)) for v in (-0.1, 0.2)]
    across, back = designs.slopes(rates, drifting, speed, scale)
    np.testing.assert_allclose(across, made[:, :2] + [[-1.0, 0.0]] * 2, atol=1e-9)
    np.testing.assert_allclose(back, made[:, :2] + [[2.0, 0.0]] * 2, atol=1e-9)


def test_an_alternative_that_fails_is_not_called_one_that_is_missing(monkeypatch):
    monkeypatch.syspath_prepend(ROOT)
    rows = import_module("benchmarks.rows")

    def fails():
        raise ArithmeticError("no solution")

    def missing():
        raise ImportError("no module")

    others = {"one": (fails, "pip install one"), "two": (missing, "pip install two")}
    notes = [r.note for r in rows.compare("work", 1, "runs", lambda: None, others)]
    assert notes == ["failed: ArithmeticError: no solution",
                     "not installed: pip install two (no module)"]  # fmt: skip


def test_a_group_that_holds_no_real_cause_is_wrong(monkeypatch):
    monkeypatch.syspath_prepend(ROOT)
    wrong = import_module("benchmarks.foreign_causes").wrong
    real = {"current", "asymmetry"}
    assert wrong(["current"], [], real) == []
    assert wrong(["wind"], [("current", "sign")], real) == ["wind"]
    assert wrong([], [("wind", "sign"), ("current", "waves")], real) == ["sign", "wind"]
