"""Time and memory of an estimate on logs up to a year of 1 Hz data: time a row, start-up apart.

    PYTHONPATH=tests python -m benchmarks.year [--out DIR] [--days D ...] [--method iv ls]

Days of the thesis's ship are written as one Parquet file each, with 13 columns and a gap in the
middle, and `greybox estimate` reads the folder with the augmented predictor, instruments simulated
and refined, verdicts included. The slope is that of a line through time and rows.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from virtual import virtual_log  # type: ignore[import-not-found]

from greybox.rotation import body_to_ned

DAY = 86400
# samples that are missing in the middle of each day, and days drawn before they are repeated
GAP, DRAWN = 600, 12
DAYS = (1, 12, 60, 365)


def write_day(folder: Path, day: int, drawn: Path) -> None:
    """Write one day of 1 Hz data; after `DRAWN` days those drawn before come again."""
    path = folder / f"day-{day:03d}.parquet"
    first = drawn / f"{day % DRAWN}.parquet"
    if path.exists():
        return
    if not first.exists():
        log = virtual_log(day, DAY)
        north, east = body_to_ned(log["u"], log["v"], log["psi"])
        columns = {"t": log.t, "x_n": np.cumsum(north), "y_n": np.cumsum(east)}
        columns |= {n: log[n] for n in log.channels}
        # of the same kind as a motor's own record: read, and not used
        columns["battery"] = 25.0 - 1e-5 * log.t
        keep = np.abs(log.t - DAY / 2) > GAP / 2
        pq.write_table(pa.table({n: x[keep] for n, x in columns.items()}), first)
    table = pq.read_table(first)
    stamps = pa.array(np.asarray(table["t"]) + float(day) * DAY)
    pq.write_table(table.set_column(0, "t", stamps), path)


def timed(typed: Sequence[str]) -> tuple[float, float, float]:
    """Return seconds by the clock, of processor time, and greatest memory [GiB] of a command."""
    began = time.perf_counter()
    child = os.posix_spawn(sys.executable, [sys.executable, "-m", "greybox", *typed], os.environ)
    _, status, used = os.wait4(child, 0)
    if status:
        raise SystemExit(f"greybox {' '.join(typed)} failed")
    taken = time.perf_counter() - began
    return taken, used.ru_utime + used.ru_stime, used.ru_maxrss / 2**20


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--out", type=Path)
    parser.add_argument("--days", nargs="+", type=int, default=list(DAYS))
    parser.add_argument("--method", nargs="+", default=["ls", "iv"], choices=("ls", "iv"))
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as made:
        out: Path = options.out or Path(made)
        drawn = out / "drawn"
        drawn.mkdir(parents=True, exist_ok=True)
        for method in options.method:
            rows, seconds = [], []
            for days in options.days:
                folder = out / f"{days}-days"
                folder.mkdir(exist_ok=True)
                for day in range(days):
                    write_day(folder, day, drawn)
                model = out / "model.json"
                taken, processor, memory = timed(
                    ["-q", "estimate", str(folder), "--vessel", "thesis", "--method", method,
                     "--structure", "thesis", "--predictor", "augmented", "--out", str(model)]
                )  # fmt: skip
                rows.append(days * (DAY - GAP))
                seconds.append(taken)
                print(f"{method} {days} days, {rows[-1]:.3g} rows: {taken:.1f} s, processor "
                      f"{processor:.1f} s, {memory:.2f} GiB", flush=True)  # fmt: skip
            if len(rows) > 2:
                steps = np.diff(seconds) / np.diff(rows)
                told = ", ".join(f"{1e6 * s:.2f}" for s in steps)
                print(f"{method}: from size to size {told} microseconds a row")


if __name__ == "__main__":
    main()
