"""Raw files for the import, and what else reads and writes them: rows of `python -m benchmarks`.

The alternative for CSV is `pandas.read_csv` and `to_csv` of the whole table, for
Parquet `read_parquet` and `to_parquet`, for NMEA 0183 `pynmea2.parse` line by line.
"""

from __future__ import annotations

import subprocess
import sys
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


def run_import(raw: Path, out: Path) -> None:
    """Run `greybox import` in a process of its own."""
    command = [sys.executable, "-m", "greybox", "import", str(raw)]
    command += ["--vessel", "thesis", "--out", str(out)]
    subprocess.run(command, check=True, capture_output=True)


def with_pynmea2(path: Path) -> int:
    """Parse a file line by line and keep nothing."""
    import pynmea2

    with open(path) as handle:
        return sum(pynmea2.parse(line.strip()) is not None for line in handle)
