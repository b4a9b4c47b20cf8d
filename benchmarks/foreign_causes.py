"""Whether diagnoses name what is wrong with ships whose simulators share nothing with the model.

Ships of `tests/foreign_ships` sail two trials to fit and two to hold out, with one effect planted
or with none, and `greybox.diagnose` is asked without being told anything:

    PYTHONPATH=tests python -m benchmarks.foreign_causes --out FILE [--ships ...] [--effects ...]
        [--seeds ...]

A case stands in FILE (a JSON line) and is not made again. An effect counts where switching it off
changes the squared held-out error of the model without causes by 1 % or more in some state, and
what it moves the ship by is as large: a model fitted anew errs otherwise by chance. What a
ship holds beyond (3.51) by itself is measured first, in the same way: each switch of its simulator
is turned off, and those that count stand for the causes in `HOLDS`. A cause that stands and is
neither planted nor held is wrong, and so is a group of causes none of which is. The budget's share
of the planted cause stands beside the share that switching it off took.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from foreign_ships import DEVELOPMENT, presets  # type: ignore[import-not-found]
from foreign_ships.environment import Current  # type: ignore[import-not-found]
from foreign_ships.manoeuvres import kinds  # type: ignore[import-not-found]
from foreign_ships.presets import Preset  # type: ignore[import-not-found]
from foreign_ships.ship import Faults  # type: ignore[import-not-found]
from foreign_ships.simulate import Trial  # type: ignore[import-not-found]

from greybox import diagnose, load_vessel, read_log
from greybox.diagnosis.budget import errors_before
from greybox.diagnosis.preparing import prepare
from greybox.numerics.binomial import wilson_interval
from greybox.selection.estimate import estimate_model
from greybox.trial.log import TrialLog
from greybox.validation.fit import mean_fit, run_model

TRIALS = ("random", "zigzag-20", "turn-port-15", "random")
HELD_OUT = 2
# share of the squared error from which on an effect counts
COUNTS = 0.01
_HULL = {"crossflow", "cubic_damping", "quadratic_yaw_damping"}
# causes that a switch of a simulator may come out as
HOLDS: dict[str, set[str]] = {
    "nonlinear_hull": _HULL, "crossflow": _HULL, "separate_hulls": _HULL, "lift": _HULL,
    "straightening": _HULL, "roll": _HULL, "coupled_inertia": {"inertia_coupling"},
    "quadratic_thrust": {"quadratic_thrust"}, "advance": {"advance_speed"},
    "race": {"advance_speed"}, "rudder_inflow": {"advance_speed"},
    "ram_drag": {"advance_speed"}, "tunnel_loss": {"advance_speed"},
    "wake_drift": {"asymmetry", "advance_speed"},
    "asymmetry": {"asymmetry", "side_force", "thruster_gain"},
    "propeller_walk": {"side_force", "asymmetry"}, "interaction": {"thruster_gain"},
    # what is logged of them are samples of a motion that goes on between
    "actuator_dynamics": {"feedback_sampling"},
}  # fmt: skip
# seconds between logged samples; the simulators' own are shorter
SAMPLE_TIMES = {
    "kvlcc2-7m": 0.5, "kvlcc2-320m": 2.0, "training-ship-105m": 1.0, "esso-osaka-3m": 0.5,
    "survey-catamaran-1.2m": 0.3, "survey-catamaran-2m": 0.4, "research-catamaran-29m": 0.8,
    "research-vessel-29m": 0.8, "workboat-12m": 0.8, "azimuth-ferry-18m": 0.8,
}  # fmt: skip


@dataclass(frozen=True)
class Planted:
    """What was planted: the cause it is, other ids that it may have, and its numbers."""

    cause: str
    also: tuple[str, ...] = ()
    numbers: tuple[tuple[str, float], ...] = ()
    # whether all of these names may stand for parts of the effect at once
    together: bool = False


EFFECTS = (
    "none", "current", "wind", "gain", "lag", "delay", "angle_offset", "clock", "heading_bias",
    "lever_arm",
)  # fmt: skip


def sail(
    name: str, effect: str, seed: int, clean: bool, ship: Any = None
) -> tuple[str, list[Trial], Planted] | None:
    """Return the vessel file and the trials, the effect left out where they are to be clean."""
    preset: Preset = presets()[name]
    if ship is not None:
        preset = replace(preset, ship=ship)
    ship, rng = preset.ship, np.random.default_rng([seed, 99])
    where: dict[str, Any] = {}
    faults: dict[str, Any] = {}
    planted = Planted("")
    size, way = rng.uniform(3, 6), float(rng.choice([-1, 1]))
    if effect == "current":
        speed, to = ship.service_speed * rng.uniform(0.05, 0.15), rng.uniform(-math.pi, math.pi)
        where["current"] = Current(speed, to)
        numbers = (("current_north", speed * math.cos(to)), ("current_east", speed * math.sin(to)))
        planted = Planted("current", (), numbers)
    elif effect == "wind":
        where["wind"] = preset.weather(seed, 1.0)["wind"]
        planted = Planted("wind")
    elif effect == "gain":
        weak = next((n for n in ("weaker_port", "weaker") if hasattr(ship, n)), None)
        if weak is None:
            return None
        planted = Planted("thruster_gain", ("asymmetry",))
        ship = ship if clean else replace(ship, **{weak: 0.75})
    elif effect == "lag":
        planted = Planted("thruster_lag", ("rate_limit", "input_delay"), together=True)
    elif effect == "delay":
        planted = Planted("input_delay", (), (("delay", _delay(preset)),))
    elif effect == "angle_offset":
        column = next((a.column for a in ship.actuators if a.angle), None)
        if column is None:
            return None
        faults["offset"] = {column: way * math.radians(size)}
        planted = Planted(
            "angle_offset", ("side_force", "asymmetry"),
            ((f"offset_{column}", -way * math.radians(size)),),
        )  # fmt: skip
    elif effect == "clock":
        channel, late = str(rng.choice(["u", "r", "psi"])), max(1.0, 0.15 * ship.time_scale)
        faults["late"] = {channel: late}
        planted = Planted("clock_offset", (), ((f"clock_{channel}", late),))
    elif effect == "heading_bias":
        faults["heading_bias"] = way * math.radians(size)
        planted = Planted("heading_bias", (), (("heading_bias", way * math.radians(size)),))
    elif effect == "lever_arm":
        arm = (way * ship.length * size / 15, ship.length * rng.uniform(-0.1, 0.1))
        faults["antenna"] = arm
        planted = Planted(
            "lever_arm", (), (("lever_arm_x", arm[0]), ("lever_arm_y", arm[1]))
        )  # fmt: skip
    preset = replace(preset, ship=ship)
    trials = []
    for i, kind in enumerate(TRIALS):
        chance = 1000 * seed + i
        trial = preset.sail(kinds()[kind], seed=chance, **({} if clean else where))
        trials.append(
            trial.measured_again(chance, faults=Faults(**faults)) if faults and not clean else trial
        )
    return ship.vessel_toml(), trials, planted


def _delay(preset: Preset) -> float:
    return float(max(1.5, 0.25 * preset.ship.time_scale))


def write(
    folder: Path, name: str, effect: str, seed: int, clean: bool = False, ship: Any = None
) -> tuple[list[TrialLog], Planted] | None:
    """Write the logs of a case, and read them as a user does."""
    made = sail(name, effect, seed, clean, ship)
    if made is None:
        return None
    text, trials, planted = made
    folder.mkdir()
    (folder / "vessel.toml").write_text(text)
    vessel = load_vessel(folder / "vessel.toml")
    every = max(1, round(SAMPLE_TIMES[name] / presets()[name].dt))
    logs = []
    for i, trial in enumerate(trials):
        columns = trial.columns(every, wind=effect == "wind")
        for actuator in trial.ship.actuators:
            if clean:
                continue
            if effect == "lag":
                # what was ordered stands where what was done should
                columns[actuator.column] = trial.true[f"{actuator.column}_command"][::every]
            elif effect == "delay":
                early = np.interp(
                    trial.t + _delay(presets()[name]), trial.t, trial.measured[actuator.column]
                )
                columns[actuator.column] = early[::every]
        path = folder / f"{i:02d}.csv"
        table = np.column_stack(list(columns.values()))
        np.savetxt(path, table, delimiter=",", header=",".join(columns), comments="", fmt="%.9g")
        logs.append(read_log(path, vessel))
    return logs, planted


def squares(logs: Sequence[TrialLog]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the squared held-out error of each state of the model without causes.

    Infinite where no run of it stays bounded.
    """
    ready = prepare(logs[:-HELD_OUT], logs[-HELD_OUT:], None, "thesis", None)
    base = ready.base()
    pairs = ready.case.held_out(base.integrator).pairs(base)
    errors = errors_before(pairs, base, ready.case.first)
    return np.asarray((errors**2).mean(axis=0)) if len(errors) else np.full(3, np.inf)


def switches(name: str) -> dict[str, float]:
    """Return the largest change of a squared held-out error by each switch of a simulator."""
    preset: Preset = presets()[name]
    found = {}
    with tempfile.TemporaryDirectory() as place:
        made = write(Path(place) / "all", name, "none", 0)
        assert made is not None
        whole = squares(made[0])
        for switch in fields(preset.ship.mechanisms):
            less = replace(preset.ship.mechanisms, **{switch.name: False})
            ship = replace(preset.ship, mechanisms=less)
            made = write(Path(place) / switch.name, name, "none", 0, ship=ship)
            assert made is not None
            found[switch.name] = float(np.max(np.abs(1 - squares(made[0]) / whole)))
    return found


def case(name: str, effect: str, seed: int, switches: Sequence[str]) -> dict[str, Any] | None:
    """Return what a diagnosis says of one case."""
    with tempfile.TemporaryDirectory() as place:
        made = write(Path(place) / "logs", name, effect, seed)
        if made is None:
            return None
        logs, planted = made
        shares, moves = np.zeros(3), np.zeros(3, bool)
        if effect != "none":
            again = write(Path(place) / "clean", name, effect, seed, clean=True)
            assert again is not None
            whole = squares(logs)
            shares = 1 - squares(again[0]) / whole
            # what leaves no bounded run counts, whatever it moves
            moves = (_moves(name, effect, seed) >= COUNTS * whole) | np.isinf(whole)
        begun = time.perf_counter()
        found = diagnose(logs[:-HELD_OUT], validate=logs[-HELD_OUT:]).to_dict()
    held = set().union(*(HOLDS.get(s, set()) for s in switches))
    ids = [c["id"].split(":")[0] for c in found["causes"]]
    groups = [[c.split(":")[0] for c in g] for g in found["groups"]]
    true = {planted.cause, *planted.also} if effect != "none" else set()
    numbers = [
        (k, q["value"], q["std"], dict(planted.numbers)[k])
        for c in found["causes"] for k, q in c["parameters"].items()
        if k in dict(planted.numbers)
    ]  # fmt: skip
    return {
        "ship": name, "effect": effect, "seed": seed, "share": float(shares.max()),
        "counts": bool((moves & (shares >= COUNTS)).any()),
        "budget": _budget(found["budget"], planted, shares.tolist()), "verdict": found["verdict"],
        "causes": ids, "groups": groups,
        "partial": [c["id"] for c in found["partial"]],
        "stands": bool(true & {*ids, *(c for g in groups for c in g)}),
        "headline": bool(true & {*ids}) if ids else bool(true & {c for g in groups for c in g}),
        "wrong": wrong(ids, groups, true | held), "numbers": numbers,
        "gain": {k: (g["before"], g["after"]) for k, g in found["gain"].items()},
        "estimate": _fits(logs),
        "seconds": time.perf_counter() - begun,
    }  # fmt: skip


def wrong(ids: Sequence[str], groups: Sequence[Sequence[str]], real: set[str]) -> list[str]:
    """Return what is said and is not so: causes, and members of groups that hold no real one."""
    return sorted({*ids, *(c for g in groups if real.isdisjoint(g) for c in g)} - real)


def _moves(name: str, effect: str, seed: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the mean squared change of each held-out state by an effect; infinite where none is.

    What is planted in sensors and commands moves no ship.
    """
    ways = (sail(name, effect, seed, clean) for clean in (False, True))
    held = [made[1][-HELD_OUT:] for made in ways if made is not None]
    moved = [
        np.concatenate([a.true[s] - b.true[s] for a, b in zip(*held, strict=True)]) for s in "uvr"
    ]
    square = np.array([float((m**2).mean()) for m in moved])
    return square if square.any() else np.full(3, np.inf)


def _fits(logs: Sequence[TrialLog]) -> list[float]:
    """Return what `estimate` by default fits of each held-out log, mean of the channels."""
    model = estimate_model(logs[:-HELD_OUT]).model()
    return [
        mean_fit(run_model(model, replace(log, vessel=model.vessel)).fit)
        for log in logs[-HELD_OUT:]
    ]


def _budget(
    parts: Sequence[dict[str, Any]], planted: Planted, shares: Sequence[float]
) -> list[tuple[float, float, float, float]]:
    """Return the share of the planted cause by state: measured, told, and its interval.

    What else it may be called counts only where it does not stand by its own name, or as one sum
    with it where orders are late by a lag and by a limited rate at once.
    """
    ids = {part["part"].split(":")[0] for part in parts}
    names = {planted.cause} if planted.cause in ids else {*planted.also}
    if planted.together:
        names |= {*planted.also}
    mine = [part for part in parts if part["part"].split(":")[0] in names]
    groups = [mine] if planted.together and mine else [[part] for part in mine]
    out = []
    for group in groups:
        for state, measured in zip(group[0]["share"], map(float, shares), strict=True):
            told = sum(part["share"][state] for part in group)
            low, high = np.array([part["ci"][state] for part in group]).T
            middle, half = (high + low) / 2, float(np.hypot.reduce((high - low) / 2))
            out.append((measured, told, middle.sum() - half, middle.sum() + half))
    return out


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return shares with 95 % intervals (Wilson)."""

    def line(what: str, hits: Sequence[bool]) -> str:
        if not hits:
            return f"{what:<58}none"
        low, high = wilson_interval(float(np.mean(hits)), len(hits))
        return (
            f"{what:<58}{sum(hits):>4} of {len(hits):<4} = {100 * np.mean(hits):5.1f} % "
            f"({100 * low:.0f}-{100 * high:.0f})"
        )

    def fit(what: str, values: Sequence[float]) -> str:
        """Return the median, and the range of the half in the middle."""
        low, half, high = np.quantile(values, [0.25, 0.5, 0.75]) if values else [np.nan] * 3
        return f"{what:<58}{half:5.1f} % ({low:.1f} to {high:.1f}), {len(values)} cases"

    counted = [r for r in rows if r["counts"]]
    before, after = (
        [float(np.mean([pair[k] for pair in r["gain"].values()])) for r in rows if r["gain"]]
        for k in (0, 1)
    )
    shares = [b for r in counted for b in r["budget"]]
    inside = [abs(v - t) <= 1.96 * s for r in rows for _, v, s, t in r["numbers"]]
    return "\n".join(
        [
            line("the planted cause stands", [r["stands"] for r in counted]),
            line("the planted cause is in the headline", [r["headline"] for r in counted]),
            line("a cause that is not there", [bool(r["wrong"]) for r in rows]),
            line("the same on ships as they are",
                 [bool(r["wrong"]) for r in rows if r["effect"] == "none"]),
            line("95 % intervals that hold the planted number", inside),
            line("shares of the budget within 10 points",
                 [abs(told - true) <= 0.1 for true, told, _, _ in shares]),
            line("95 % intervals that hold the share",
                 [low <= true <= high for true, _, low, high in shares]),
            fit("held-out fit of the base: median (quarters)", before),
            fit("of the extended model", after),
            fit("of estimate", [float(np.mean(r["estimate"])) for r in rows if "estimate" in r]),
        ]
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", required=True, type=Path)
    parser.add_argument("--ships", nargs="+", default=list(DEVELOPMENT))
    parser.add_argument("--effects", nargs="+", default=list(EFFECTS), choices=EFFECTS)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    options = parser.parse_args()
    lines = options.out.read_text().splitlines() if options.out.exists() else []
    rows = [json.loads(line) for line in lines]
    known = {(r["ship"], r["effect"], r["seed"]) for r in rows}
    held = {}
    for name in options.ships:
        held[name] = [s for s, share in switches(name).items() if share >= COUNTS]
        print(f"{name} holds {', '.join(held[name])}", flush=True)
    for seed in options.seeds:
        for effect in options.effects:
            for name in options.ships:
                row = None
                if (name, effect, seed) not in known:
                    row = case(name, effect, seed, held[name])
                if row is None:
                    continue
                rows.append(row)
                with options.out.open("a") as handle:
                    handle.write(json.dumps(row) + "\n")
                told = "stands" if row["stands"] else "-"
                print(
                    f"{name} {effect} {seed}: {row['verdict']} {row['causes']} {row['groups']} "
                    f"{told}, share {row['share']:.3f}, wrong {row['wrong']}, "
                    f"{row['seconds']:.0f} s",
                    flush=True,
                )
    print(table(rows))


if __name__ == "__main__":
    main()
