"""Whether designed trials give better models of ships that their prior does not fit.

Ships of `tests/foreign_ships` sail a first trial of random steps, `greybox estimate` gives the
prior, and a second trial of each kind is sailed and estimated with defaults, as a user does:

    PYTHONPATH=tests python -m benchmarks.foreign_designs --out DIR [--ships ...] [--seeds ...]

`random` holds settings for half a length to two lengths, `long` is that for one and a half times
the time, `zigzag` goes to both sides at three speeds, `plan` is `greybox design`. What stands in
DIR is not made again. Fits (6.12) are means over surge, sway and yaw rate and over two held-out
trials.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from foreign_ships import presets  # type: ignore[import-not-found]
from foreign_ships.manoeuvres import (  # type: ignore[import-not-found]
    in_turn,
    random_steps,
    table,
    turning_circle,
    zigzag,
)

SHIPS = ("kvlcc2-7m", "research-catamaran-29m", "survey-catamaran-2m")
ARMS = ("random", "zigzag", "plan", "long")
# lengths sailed in the first and in the second trial, and seconds between logged samples
FIRST, SECOND = 50, 60
EVERY = {
    "kvlcc2-7m": 0.5, "kvlcc2-320m": 2.0, "training-ship-105m": 1.0, "esso-osaka-3m": 0.5,
    "survey-catamaran-1.2m": 0.3, "survey-catamaran-2m": 0.4, "research-catamaran-29m": 0.8,
    "research-vessel-29m": 0.8, "workboat-12m": 0.8, "azimuth-ferry-18m": 0.8,
}  # fmt: skip
MANOEUVRES = {
    "first": random_steps(hold=(0.5, 2.0)),
    "random": random_steps(hold=(0.5, 2.0)),
    "long": random_steps(hold=(0.5, 2.0)),
    "zigzag": in_turn(
        (zigzag(20, 20), 15), (zigzag(-20, 20, ahead=0.6), 15), (zigzag(10, 10), 10),
        (zigzag(-30, 30, ahead=0.8), 15),
    ),
    "held-out-1": random_steps(),
    "held-out-2": in_turn(
        (zigzag(20, 20), 25), (turning_circle(0.6, lengths=15), 20),
        (turning_circle(-0.4, 0.7, lengths=15), 20),
    ),
}  # fmt: skip
LENGTHS = {
    "first": FIRST, "random": SECOND, "zigzag": SECOND, "long": 1.5 * SECOND, "held-out-1": 100,
    "held-out-2": 75,
}  # fmt: skip


def greybox(*arguments: object) -> str:
    """Run a command as a user does, and return what it prints."""
    typed = [sys.executable, "-m", "greybox", *map(str, arguments)]
    return subprocess.run(typed, capture_output=True, text=True, check=True).stdout


def sail(folder: Path, name: str, arm: str, seed: int) -> Path:
    """Return the log of one trial."""
    log = folder / f"{arm}.csv"
    if log.exists():
        return log
    preset = presets()[name]
    every = max(1, round(EVERY[name] / preset.dt))
    number = 100 * seed + sorted([*MANOEUVRES, "plan"]).index(arm)
    if arm != "plan":
        duration = round(LENGTHS[arm] * preset.ship.time_scale)
        preset.sail(MANOEUVRES[arm], duration, seed=number).write_csv(log, every)
        return log
    plan, told = folder / "plan.plan.csv", folder / "plan.json"
    greybox("design", "--vessel", folder / "vessel.toml", "--model", folder / "first.json",
            "--duration", round(SECOND * preset.ship.time_scale), "--out", plan, "--json", told,
            "--seed", seed)  # fmt: skip
    rows = np.genfromtxt(plan, delimiter=",", names=True)
    commands = np.column_stack([rows[a.column] for a in preset.ship.actuators])
    begun = json.loads(told.read_text())["starts"][0]["u"]
    trial = preset.sail(
        table(rows["t"], commands), float(rows["t"][-1]), seed=number, start_speed=begun
    )
    trial.write_csv(log, every)
    return log


def fit(folder: Path, name: str, arm: str, seed: int) -> float:
    """Return the mean held-out fit of the model estimated from one trial [%]."""
    told = folder / f"{arm}.fit"
    if not told.exists():
        log = sail(folder, name, arm, seed)
        greybox("estimate", log, "--vessel", folder / "vessel.toml",
                "--out", folder / f"{arm}.json")  # fmt: skip
        held = [sail(folder, name, f"held-out-{k}", seed) for k in (1, 2)]
        found = greybox("compare", folder / f"{arm}.json", "--log", *held, "--json", "-")
        channels = json.loads(found)["models"][0]["fit"]
        told.write_text(str(float(np.mean([channels[c] for c in ("u", "v", "r")]))))
    return float(told.read_text())


def case(place: Path, name: str, seed: int) -> dict[str, float]:
    """Return the fit of each kind of trial of one ship."""
    folder = place / f"{name}-{seed}"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "vessel.toml").write_text(presets()[name].ship.vessel_toml())
    found: dict[str, float] = {}
    for arm in ("first", *ARMS):
        try:
            found[arm] = fit(folder, name, arm, seed)
        except subprocess.CalledProcessError as error:
            print(f"{name} {seed} {arm}: {error.stderr.strip().splitlines()[-1]}", flush=True)
            found[arm] = float("nan")
    return found


def row(name: str, cases: Sequence[dict[str, Any]]) -> str:
    """Return means, and the paired difference of the plan to the better of the two others."""
    fits = {arm: np.array([c[arm] for c in cases]) for arm in ("first", *ARMS)}
    means = "".join(f"{np.nanmean(fits[arm]):>9.1f}" for arm in ("first", *ARMS))
    better = max(("random", "zigzag"), key=lambda arm: float(np.nanmean(fits[arm])))
    paired = fits["plan"] - fits[better]
    paired = paired[np.isfinite(paired)]
    error = paired.std(ddof=1) / np.sqrt(len(paired)) if len(paired) > 1 else float("nan")
    return (
        f"{name:<26}{means}   {paired.mean():+.1f} ± {error:.1f} to {better}, {len(paired)} pairs"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", required=True, type=Path)
    parser.add_argument("--ships", nargs="+", default=list(SHIPS), choices=sorted(presets()))
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3, 4])
    options = parser.parse_args()
    found: dict[str, list[dict[str, float]]] = {name: [] for name in options.ships}
    for seed in options.seeds:
        for name in options.ships:
            found[name].append(case(options.out, name, seed))
            told = {arm: round(v, 1) for arm, v in found[name][-1].items()}
            print(f"{name} {seed}: {told}", flush=True)
    print(f"{'mean held-out fit [%]':<26}" + "".join(f"{arm:>9}" for arm in ("first", *ARMS)))
    for name, cases in found.items():
        print(row(name, cases))


if __name__ == "__main__":
    main()
