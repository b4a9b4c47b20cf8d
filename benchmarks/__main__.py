"""How fast this package is, as ratios to named alternatives that do the same work in the same run.

    python -m benchmarks [--rows NAME ...] [--full] [--json FILE] [--write]

One table: for each size the time of this package, that of the alternative, and how many times as
long the alternative takes. Both are called in turn, so that a machine that slows down slows both;
times are medians, with the shortest and the longest beside them. The first call of each, which
imports and compiles, is left out. What is not installed is named with the command that installs it.
`--write` keeps the table in docs/benchmarks.json, from which the manual draws it.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from collections.abc import Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from benchmarks.rows import ROWS, Row
from greybox.numerics.parallel import processors

RECORD = Path(__file__).parents[1] / "docs" / "benchmarks.json"
_NAMED = (
    "casadi", "numpy", "scipy", "numba", "pandas", "linearmodels", "pyomo", "cyipopt", "pydex",
    "pynmea2",
)  # fmt: skip


def processor() -> str:
    """Return the name of the processor."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text("utf-8").splitlines() if info.exists() else []
    names = [x.split(":", 1)[1].strip() for x in lines if x.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def machine() -> dict[str, Any]:
    """Return what the times depend on: machine, its load before the first row, and versions."""
    found = {}
    for name in _NAMED:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return {
        "date": datetime.now(UTC).date().isoformat(),
        "processor": processor(),
        "cores": processors(),
        "system": f"{platform.system()} {platform.machine()}",
        "load_before": round(os.getloadavg()[0], 1),
        "threads": os.environ.get("OMP_NUM_THREADS", "not limited"),
        "python": platform.python_version(),
        "versions": found,
    }


def cells(row: Row) -> tuple[str, ...]:
    """Return a row of the table as text."""
    name = (row.name, f"{row.size:g} {row.unit}", row.alternative)
    if row.ours is None or row.theirs is None:
        return (*name, "", "", "", row.note)
    return (*name, str(row.ours), str(row.theirs), f"{row.ratio:.3g}", row.note)


def table(rows: Sequence[Row]) -> str:
    """Return rows in columns under their heading."""
    lines = [("row", "size", "alternative", "here [s]", "it [s]", "ratio", "note")]
    lines += [cells(r) for r in rows]
    widths = [max(len(line[i]) for line in lines) for i in range(6)]
    return "\n".join(
        "  ".join([*(c.ljust(w) for c, w in zip(line, widths, strict=False)), line[6]]).rstrip()
        for line in lines
    )


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks", description=__doc__.split("\n")[0]
    )
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), default=list(ROWS), metavar="NAME",
                        help=f"of {', '.join(ROWS)}; all by default")  # fmt: skip
    parser.add_argument("--full", action="store_true", help="larger sizes beside the quick ones")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the table there too")
    parser.add_argument("--write", action="store_true", help=f"write it to docs/{RECORD.name}")
    given = parser.parse_args(arguments)
    if given.write and given.rows != list(ROWS):
        parser.error("--write keeps the whole table: leave out --rows.")
    about, rows = machine(), []
    for name in given.rows:
        for row in ROWS[name](given.full):
            rows.append(row)
            print(" | ".join(filter(None, cells(row))), file=sys.stderr, flush=True)
    about["load_after"] = round(os.getloadavg()[0], 1)
    print(table(rows))
    print("\n".join(f"{k}: {v}" for k, v in about.items()))
    text = json.dumps({"machine": about, "rows": [asdict(r) for r in rows]}, indent=1) + "\n"
    for path in [given.json] * bool(given.json) + [RECORD] * given.write:
        path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
