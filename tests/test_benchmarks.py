"""The speed of this package beside other ways to the same numbers, as on record in the manual."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

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
