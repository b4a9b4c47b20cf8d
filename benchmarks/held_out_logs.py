"""Logs as the other tools of `held_out.py` read them, in an interpreter without this package."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
# what a job asks for: (training runs, names of the drivers, held-out runs) at a sample time
Loaded = tuple[list["Run"], list[str], list["Run"]]

# sample times that are tried [s], the usual one first
SAMPLE_TIMES = {
    "esso": (1.0, 0.5), "hsva": (1.0, 0.5), "marin": (4.0, 2.0), "blueboat": (0.2, 0.4),
    "ferry": (0.5, 1.0), "ferry_2": (0.5, 1.0),
}  # fmt: skip
BOLLARD = ((-948, -721, -480, -241, 0, 238, 478, 718, 913),
           (-330, -190, -80, -22.5, 0, 49, 135, 275, 425))  # fmt: skip
AZIMUTHS = ((1.8, -0.8), (1.8, 0.8), (-1.8, 0.8), (-1.8, -0.8))
# an escaped run counts as this many deviations of the training logs
WORST = 10.0


@dataclass(frozen=True)
class Run:
    """A stretch without gaps at the tool's sample time: (N,), (N, 3), (N, m)."""

    name: str
    t: Array
    y: Array
    w: Array

    @property
    def first(self) -> Array:
        """Mean over the first second, at least one sample."""
        count = max(1, round(1.0 / float(self.t[1] - self.t[0])))
        return np.asarray(self.y[:count].mean(axis=0))

    def window(self, low: int, high: int) -> Run:
        return Run(self.name, self.t[low:high], self.y[low:high], self.w[low:high])


def signals(ship: str, raw: dict[str, Array]) -> dict[str, Array]:
    """Return what drives the ship, by name, from the columns of a log."""
    n = len(raw["t"])
    found = {"": np.ones(n)}
    if ship in ("esso", "hsva", "marin"):
        speed, rudder = next(
            (raw[a], raw[b])
            for a, b in (("n_prop [rps]", "delta_rudder [rad]"), ("n_rps", "delta_deg"),
                         ("rpm", "delta_deg")) if a in raw
        )  # fmt: skip
        s = speed / {"esso": 10.0, "hsva": 10.0, "marin": 90.0}[ship]
        thrust = s * np.abs(s)
        found |= {"n": s, "N": np.abs(s), "T": thrust, "d": rudder, "Td": thrust * rudder,
                  "nd": s * rudder, "dd": rudder**2, "Tdd": thrust * rudder**2,
                  "Tddd": thrust * rudder**3, "Rd": np.maximum(s, 0) ** 2 * rudder}  # fmt: skip
    elif ship == "blueboat":
        total = raw["left_force"] + raw["right_force"]
        apart = raw["left_force"] - raw["right_force"]
        found |= {"S": total, "D": apart, "A": np.abs(total), "AD": np.abs(apart),
                  "SS": total * np.abs(total), "DD": apart * np.abs(apart),
                  "SD": total * apart}  # fmt: skip
    else:
        forces = np.zeros((3, n))
        for i, (x, y) in enumerate(AZIMUTHS, 1):
            f = np.interp(raw[f"n{i}"], *BOLLARD)
            fx, fy = f * np.cos(raw[f"alpha{i}"]), f * np.sin(raw[f"alpha{i}"])
            forces += np.array([fx, fy, x * fy - y * fx])
        found |= dict(zip(("X", "Y", "Z"), forces, strict=True))
    if "u_q" in raw:
        speed = np.hypot(raw["u_q"], raw["v_q"])
        found |= {"wx": raw["u_q"] * speed, "wy": raw["v_q"] * speed, "wn": raw["u_q"] * raw["v_q"]}
    if ship in ("blueboat", "ferry", "ferry_2"):
        found |= {"c": np.cos(raw["psi"]), "s": np.sin(raw["psi"])}
    return found


def read(path: Path, ship: str, step: float) -> tuple[list[Run], list[str]]:
    """Return the stretches of a log, averaged around each sample, commands over the next step."""
    with path.open(newline="") as handle:
        head = next(csv.reader(handle))
    table = np.genfromtxt(path, delimiter=",", skip_header=1)
    raw = {n: table[:, i] for i, n in enumerate(head) if np.isfinite(table[:, i]).any()}
    t = raw["t"]
    for name, value in raw.items():
        bad = ~np.isfinite(value)
        if bad.any():
            raw[name] = np.where(bad, np.interp(t, t[~bad], value[~bad]), value)
    drivers = signals(ship, raw)
    names = sorted(drivers)
    w, y = np.column_stack([drivers[n] for n in names]), np.column_stack([raw[n] for n in "uvr"])
    usual = float(np.median(np.diff(t)))
    ratio = max(1, round(step / usual))
    cuts = [0, *(np.flatnonzero(np.diff(t) > 1.5 * usual) + 1), len(t)]
    runs = []
    for a, b in pairwise(cuts):
        centres = np.arange(a + ratio // 2, b - ratio, ratio)
        if len(centres) >= 3:
            motion = [y[i - ratio // 2 :][:ratio].mean(axis=0) for i in centres]
            commands = [w[i : i + ratio].mean(axis=0) for i in centres]
            runs.append(Run(path.stem, t[centres], np.array(motion), np.array(commands)))
    return runs, names


def folds(runs: list[Run], count: int = 4) -> list[tuple[list[Run], list[Run]]]:
    """Return training and left-out runs: by logs, and by quarters too where logs are few."""

    def split(parts: list[list[Run]]) -> list[tuple[list[Run], list[Run]]]:
        return [([r for q in parts if q is not p for r in q], p) for p in parts]

    found = split([runs[i::count] for i in range(min(count, len(runs)))]) if len(runs) > 1 else []
    if len(runs) < 3:
        cuts = [[len(r.t) * i // 4 for i in range(5)] for r in runs]
        found += split(
            [[r.window(c[i], c[i + 1]) for r, c in zip(runs, cuts, strict=True)] for i in range(4)]
        )
    return found


def judge(rmse: Sequence[Array]) -> float:
    """Return the mean over folds and channels of the logarithm of the error."""
    return float(np.mean(np.log(np.maximum(rmse, 1e-3))))


_WRITTEN: dict[str, bool] = {}


def write(job: dict[str, Any], run: Run, x: Array) -> None:
    """Write a run; a further stretch of the same log goes on in its file."""
    again = _WRITTEN.get(run.name, False)
    with (Path(job["out"]) / f"{run.name}.csv").open("a" if again else "w") as handle:
        if not again:
            handle.write("t,u,v,r\n")
        np.savetxt(handle, np.column_stack([run.t, x]), delimiter=",", fmt="%.9g")
    _WRITTEN[run.name] = True
