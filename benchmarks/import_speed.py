"""Speed of the import, as ratios to what else reads and writes the same files in the same run.

The alternative for CSV is `pandas.read_csv` and `to_csv` of the whole table, for
Parquet `read_parquet` and `to_parquet`, for NMEA 0183 `pynmea2.parse` line by
line. Run it with the number of megabytes and of sentences:

    python benchmarks/import_speed.py 100 200000
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np
import pandas as pd

NAMES = ("x_n", "y_n", "psi", "u", "v", "r", "u_q", "v_q", "n", "alpha1", "alpha2", "extra")
BYTES_PER_ROW = 240


def write_tables(folder: Path, megabytes: float) -> tuple[Path, Path]:
    """Write noise of 13 columns at 10 Hz, in full precision."""
    rows = int(megabytes * 1e6 / BYTES_PER_ROW)
    rng = np.random.default_rng(0)
    table = pd.DataFrame(rng.normal(size=(rows, len(NAMES))), columns=list(NAMES))
    table.insert(0, "t", np.round(np.arange(rows) * 0.1, 1))
    csv, parquet = folder / "raw.csv", folder / "raw.parquet"
    table.to_csv(csv, index=False)
    table.to_parquet(parquet, index=False)
    return csv, parquet


def write_nmea(path: Path, sentences: int) -> Path:
    """Write a second of GGA, RMC, VTG, 10 HDT, 5 ROT, MWV, RSA and RPM again and again."""
    rng = np.random.default_rng(0)
    with open(path, "w", newline="") as handle:
        for k in range(sentences // 21):
            clock = f"{k // 3600 % 24:02}{k // 60 % 60:02}{k % 60:02}.00"
            place = f"63{25 + k * 5e-6:09.6f},N,010{24 + k * 8e-6:09.6f},E"
            for body in (
                f"GPGGA,{clock},{place},2,12,0.8,5.0,M,40.0,M,,",
                f"GPRMC,{clock},A,{place},5.1,45.0,{1 + k // 86400:02}0623,,,A",
                "GPVTG,45.0,T,,M,5.1,N,9.4,K,A",
                *(f"HEHDT,{h:.2f},T" for h in rng.normal(45, 0.3, 10)),
                *(f"TIROT,{r:.1f},A" for r in rng.normal(0, 3, 5)),
                "WIMWV,35.0,R,5.0,M,A",
                "AGRSA,3.2,A,,V",
                "IIRPM,S,1,120.5,80.0,A",
            ):
                handle.write(f"${body}*{reduce(xor, body.encode(), 0):02X}\r\n")
    return path


def seconds(work: Callable[[], object]) -> float:
    """Return the wall time of one call."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def import_seconds(raw: Path, out: Path) -> float:
    """Return the wall time of `greybox import` in a process of its own."""
    command = [sys.executable, "-m", "greybox.commands.main", "import", str(raw)]
    command += ["--vessel", "thesis", "--out", str(out)]
    return seconds(lambda: subprocess.run(command, check=True, capture_output=True))


def with_pynmea2(path: Path) -> int:
    """Parse a file line by line and keep nothing."""
    import pynmea2

    with open(path) as handle:
        return sum(pynmea2.parse(line.strip()) is not None for line in handle)


def main(megabytes: float, sentences: int) -> None:
    """Print one line a format."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        csv, parquet = write_tables(folder, megabytes)
        nmea = write_nmea(folder / "raw.nmea", sentences)
        other = folder / "other"
        cases = (
            ("CSV", csv, folder / "log.csv", "pandas.read_csv + to_csv",
             lambda: pd.read_csv(csv).to_csv(other, index=False)),
            ("Parquet", parquet, folder / "log.parquet", "pandas.read_parquet + to_parquet",
             lambda: pd.read_parquet(parquet).to_parquet(other, index=False)),
            ("NMEA 0183", nmea, folder / "log.csv", "pynmea2.parse", lambda: with_pynmea2(nmea)),
        )  # fmt: skip
        for kind, raw, out, alternative, work in cases:
            size = raw.stat().st_size / 1e6
            here = import_seconds(raw, out)
            there = seconds(work)
            print(
                f"{kind}: {size:.0f} MB in {here:.1f} s; {alternative} {there:.1f} s: "
                f"{there / here:.1f} times as fast as it"
            )
        most = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
        print(f"largest memory of an import: {most:.2f} GiB")


if __name__ == "__main__":
    main(
        float(sys.argv[1]) if len(sys.argv) > 1 else 100.0,
        int(sys.argv[2]) if len(sys.argv) > 2 else 200_000,
    )
