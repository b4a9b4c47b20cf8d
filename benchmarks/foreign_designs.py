"""Whether designed trials give better models of ships that their prior does not fit.

Ships of `tests/foreign_ships` sail a first trial of random steps, `greybox estimate` gives the
prior, and a second trial of each kind is sailed and estimated with defaults, as a user does:

    PYTHONPATH=tests python -m benchmarks.foreign_designs --out DIR [--ships ...] [--seeds ...]
        [--arms ...] [--prior none]

Trials last sixty lengths, 5 to 15 min. `random` holds settings for half a length to two lengths,
`zigzag` goes to both sides at three speeds, `plan` is `greybox design`; `long-` is half as long
again. `whole` is one plan of 15 min, `stages` three of 5 min, the later ones made by `--after` of
those before. With `--prior none` there is no first trial: plans begin with main dimensions. What
stands in DIR is not made again. Errors are those of free runs over one long trial of the operating
envelope: random steps, zig-zags and turns, to both sides at all speeds. Coefficients are compared
as linear derivatives, which every simulator has: slopes of sway and yaw accelerations in sway and
yaw rate, by differences on both sides; on a straight course with those in the turn of the helm, and
at motions all along the trial of the envelope.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import casadi as ca
import numpy as np
from foreign_ships import presets  # type: ignore[import-not-found]
from foreign_ships.manoeuvres import (  # type: ignore[import-not-found]
    in_turn,
    random_steps,
    steady,
    table,
    turning_circle,
    zigzag,
)
from numpy.typing import NDArray
from scipy.special import stdtrit

from benchmarks.foreign_causes import SAMPLE_TIMES
from greybox.model.model import ManoeuvringModel, load_model
from greybox.vessel.force import generalised_force
from greybox.vessel.toml import load_vessel

Array = NDArray[np.float64]

SHIPS = (
    "kvlcc2-7m", "esso-osaka-3m", "training-ship-105m", "research-catamaran-29m",
    "survey-catamaran-2m",
)  # fmt: skip
ARMS = ("random", "zigzag", "plan", "long-random", "long-zigzag", "whole", "stages", "limited")
# lengths sailed in a trial, its least and its greatest duration [s]
TRIAL, SHORTEST, LONGEST = 60, 300.0, 900.0
STEPS = random_steps(hold=(0.5, 2.0))
ZIGZAGS = in_turn(
    (zigzag(20, 20), 15), (zigzag(-20, 20, ahead=0.6), 15), (zigzag(10, 10), 10),
    (zigzag(-30, 30, ahead=0.8), 15),
)  # fmt: skip
HELD_OUT = in_turn(
    (random_steps(), 40), (zigzag(20, 20), 15), (turning_circle(-0.8, 0.5, lengths=10), 15),
    (STEPS, 20), (turning_circle(0.6, lengths=12), 15), (zigzag(-10, 10, ahead=0.6), 15),
    (turning_circle(-0.4, 0.75, lengths=12), 15), (zigzag(-30, 25, ahead=0.45), 15),
    (turning_circle(0.3, 0.5, lengths=10), 15), (zigzag(15, 15, ahead=0.8), 15),
    (turning_circle(-0.7, 0.9, lengths=10), 20),
)  # fmt: skip
MANOEUVRES = {
    "first": STEPS, "random": STEPS, "long-random": STEPS, "zigzag": ZIGZAGS,
    "long-zigzag": ZIGZAGS, "held-out": HELD_OUT,
}  # fmt: skip
# lengths of the trial that errors are measured by
JUDGED = 200
# share of full ahead on the straight course of linear derivatives, and steps from it: of speeds
# as a share of the ship's own, of the helm as one of 35 degrees
AHEAD, STEP, HELM = 0.75, 0.02, 0.1
# motions along the trial of the envelope at which they are compared too
MOTIONS = 24
# lengths at service speed after which a course is steady
COURSE = 40
# plans that are made one after another, and the duration of each [s]
STAGES, STAGE = 3, 300.0
# half the side of the square of `limited` plans, in lengths
ROOM = 16


def greybox(*arguments: object) -> str:
    """Run a command as a user does, and return what it prints."""
    typed = [sys.executable, "-m", "greybox", *map(str, arguments)]
    return subprocess.run(typed, capture_output=True, text=True, check=True).stdout


def lasting(name: str, arm: str) -> float:
    """Return the duration of a trial [s]."""
    scale = presets()[name].ship.time_scale
    if arm == "held-out":
        return float(round(JUDGED * scale))
    if arm in ("whole", "stages"):
        return STAGES * STAGE
    usual = round(min(max(TRIAL * scale, SHORTEST), LONGEST))
    return 1.5 * usual if arm.startswith("long") else float(usual)


def sail(folder: Path, name: str, arm: str, seed: int) -> list[Path]:
    """Return the logs of one kind of trial."""
    number = 100 * seed + sorted([*MANOEUVRES, "plan"]).index(arm if arm in MANOEUVRES else "plan")
    if arm == "stages":
        logs: list[Path] = []
        for k in range(1, STAGES + 1):
            # the first begins from what was known before, the others from what was sailed
            made = _prior(folder, name, seed, STAGE)
            if logs:
                start = f"{_begun(logs[0])},0,0,0"
                made = ("--after", *logs, "--remaining", STAGE, "--start", start)
            logs.append(folder / f"stage-{k}.csv")
            _sail_planned(logs[-1], name, made, number + k, seed)
        return logs
    log = folder / f"{arm}.csv"
    if arm in MANOEUVRES and not log.exists():
        preset = presets()[name]
        trial = preset.sail(MANOEUVRES[arm], lasting(name, arm), seed=number)
        trial.write_csv(log, _every(name))
    elif arm not in MANOEUVRES:
        made = _prior(folder, name, seed, lasting(name, arm))
        if arm == "limited":
            made = (*made, *_limits(folder, name))
        _sail_planned(log, name, made, number, seed)
    return [log]


def _square(name: str) -> float:
    """Return half the side of the sea room of `limited` plans [m]."""
    return float(ROOM * presets()[name].ship.length)


def _limits(folder: Path, name: str) -> list[object]:
    """Return the limits of a `limited` plan as options of `greybox design`."""
    half, first = _square(name), np.genfromtxt(folder / "first.csv", delimiter=",", names=True)
    area = folder / "area.csv"
    corners = [(1, 1), (1, -1), (-1, -1), (-1, 1)]
    area.write_text("x_n,y_n\n" + "".join(f"{half * x:g},{half * y:g}\n" for x, y in corners))
    speed = np.hypot(first["u"], first["v"]).max()
    return ["--area", area, "--speed-cap", speed, "--yaw-cap", np.abs(first["r"]).max()]


def kept(folder: Path, name: str, true: Mapping[str, Array]) -> None:
    """Write what a `limited` plan stated and by which share of each limit the ship was within."""
    typed = [float(x) for x in _limits(folder, name)[3::2]]
    bounds = dict(zip(("room", "speed", "yaw"), (_square(name), *typed), strict=True))
    reached = {
        "room": max(np.abs(true["x_n"]).max(), np.abs(true["y_n"]).max()),
        "speed": np.hypot(true["u"], true["v"]).max(),
        "yaw": np.abs(true["r"]).max(),
    }
    left = {limit: round(1 - float(reached[limit]) / b, 4) for limit, b in bounds.items()}
    plan = json.loads((folder / "limited.design.json").read_text())
    told = {"stated": plan["keeps_limits"]["probability"], "left": left}
    (folder / "limited.kept").write_text(json.dumps(told))


def _every(name: str) -> int:
    """Return how many steps of a simulator are between two logged samples."""
    return max(1, round(SAMPLE_TIMES[name] / presets()[name].dt))


def _prior(folder: Path, name: str, seed: int, duration: float) -> tuple[object, ...]:
    """Return how a plan of some duration is made before its trial."""
    if load_vessel(folder / "vessel.toml").beam is not None:
        return ("--prior", "none", "--duration", duration)
    fit(folder, name, "first", seed)
    return ("--model", folder / "first.json", "--duration", duration)


def _sail_planned(log: Path, name: str, made: Sequence[object], number: int, seed: int) -> None:
    """Design a trial, and sail it from a straight course."""
    if log.exists():
        return
    preset, plan = presets()[name], log.with_suffix(".plan.csv")
    greybox("design", "--vessel", log.with_name("vessel.toml"), *made, "--out", plan,
            "--json", log.with_suffix(".design.json"), "--seed", seed, "--workers", 1)  # fmt: skip
    rows = np.genfromtxt(plan, delimiter=",", names=True)
    commands = np.column_stack([rows[a.column] for a in preset.ship.actuators])
    trial = preset.sail(
        table(rows["t"], commands), float(rows["t"][-1]), seed=number, start_speed=_begun(log),
        start_heading=_begun(log, "psi"),
    )  # fmt: skip
    if log.stem == "limited":
        kept(log.parent, name, trial.true)
    trial.write_csv(log, _every(name))


def _begun(log: Path, state: str = "u") -> float:
    """Return the speed ahead [m/s], or another state, from which a planned trial sets out."""
    return float(json.loads(log.with_suffix(".design.json").read_text())["starts"][0][state])


def fit(folder: Path, name: str, arm: str, seed: int) -> list[float]:
    """Return the held-out fits of surge, sway and yaw rate of the model of one trial [%]."""
    told = folder / f"{arm}.fit"
    if not told.exists():
        logs = sail(folder, name, arm, seed)
        greybox("estimate", *logs, "--vessel", folder / "vessel.toml",
                "--out", folder / f"{arm}.json")  # fmt: skip
        (held,) = sail(folder, name, "held-out", seed)
        found = greybox("compare", folder / f"{arm}.json", "--log", held, "--json", "-")
        channels = json.loads(found)["models"][0]["fit"]
        # a run that diverges predicts nothing
        told.write_text(json.dumps([channels[c] or 0.0 for c in ("u", "v", "r")]))
    return [float(f) for f in json.loads(told.read_text())]


def vessel_file(name: str, *, dimensions: bool) -> str:
    """Return the vessel file of a ship, with its main dimensions where they are the prior."""
    ship = presets()[name].ship
    if not dimensions:
        return str(ship.vessel_toml())
    known = {"beam": ship.beam, "mass": ship.inertia[0], "service_speed": ship.service_speed}
    first = [f"{k} = {v:g}" for k, v in known.items()]
    return "\n".join([*first, ship.vessel_toml(), "[conditions]", f"draught = {ship.draught:g}\n"])


def slopes(
    rates: Callable[[Array, Sequence[float]], Array],
    at: Sequence[tuple[Array, Sequence[float]]],
    speed: float,
    scale: float,
) -> Array:
    """Return slopes of sway and yaw accelerations in sway and yaw rate at some motions, (n, 2, 2).

    In speeds, lengths and lengths sailed; `scale` is the time of one [s].
    """
    steps = STEP * np.array([speed, 1 / scale])
    apart = [
        [rates(x + d, commands)[1:3] - rates(x - d, commands)[1:3]
         for d in np.column_stack([np.zeros(2), np.diag(steps)])]
        for x, commands in at
    ]  # fmt: skip
    rows = np.array([speed / scale, 1 / scale**2])
    return np.asarray(np.swapaxes(apart, 1, 2) / (2 * STEP) / rows[:, None])


def on_course(
    name: str, rates: Callable[[Array, Sequence[float]], Array], course: Array, scale: float
) -> Array:
    """Return the slopes on a straight course in sway, yaw rate and turn of the helm, (2, 3)."""
    ship, speed = presets()[name].ship, course[0]
    (motion,) = slopes(rates, [(course, ship.helm(AHEAD, 0.0))], speed, scale)
    turned = [rates(course, ship.helm(AHEAD, side * HELM))[1:3] for side in (1.0, -1.0)]
    rows = np.array([speed / scale, 1 / scale**2])
    return np.column_stack([motion, (turned[0] - turned[1]) / (2 * HELM) / rows])


def model_rates(model: ManoeuvringModel) -> Callable[[Array, Sequence[float]], Array]:
    """Return the accelerations (3,) of a model in still water and air."""
    s = model.structure
    step = ca.Function("step", [s.symbols.x, s.symbols.tau], [ca.substitute(
        s.increment_expression(air_measured=False),
        ca.vertcat(s.symbols.psi, s.symbols.d, s.symbols.theta),
        ca.vertcat(0, ca.DM.zeros(len(s.disturbances)), model.theta),
    )])  # fmt: skip

    def rates(x: Array, commands: Sequence[float]) -> Array:
        columns = dict(zip(model.vessel.commands, np.array(commands)[:, None], strict=True))
        made = generalised_force(model.vessel, columns)
        tau = [made.get(n, np.zeros(1))[0] for n in s.inputs]
        return np.array(step(x, tau)).ravel() / model.sample_time

    return rates


def coefficient_errors(
    folder: Path, name: str, arms: Mapping[str, object]
) -> dict[str, tuple[float, float]]:
    """Return by how much linear derivatives of each arm's model are off, as a share of their size.

    On a straight course, and over the trial of the envelope; nan where an arm has no model.
    """
    ship = presets()[name].ship
    sailed = presets()[name].sail(steady(AHEAD), COURSE * ship.time_scale)
    course = np.array([float(sailed.true["u"][-1]), 0.0, 0.0])
    scale = ship.length / course[0]
    log = np.genfromtxt(folder / "held-out.csv", delimiter=",", names=True)
    log = log[np.linspace(0, len(log) - 1, MOTIONS + 1).astype(int)[1:]]
    motions = [
        (np.array([row[n] for n in ("u", "v", "r")]), [row[a.column] for a in ship.actuators])
        for row in log
    ]

    def rates(x: Array, commands: Sequence[float]) -> Array:
        return np.array(ship.accelerations(x, commands, (0.0, 0.0, 0.0)))

    def both(rates: Callable[[Array, Sequence[float]], Array]) -> tuple[Array, Array]:
        return on_course(name, rates, course, scale), slopes(rates, motions, course[0], scale)

    true, off = both(rates), {}
    for arm in arms:
        path = folder / f"{arm}.json"
        off[arm] = (float("nan"), float("nan"))
        if path.exists():
            found = zip(both(model_rates(load_model(path))), true, strict=True)
            first, second = (float(np.linalg.norm(a - b) / np.linalg.norm(b)) for a, b in found)
            off[arm] = first, second
    return off


def case(
    place: Path, name: str, seed: int, arms: Sequence[str], *, dimensions: bool = False
) -> dict[str, list[float]]:
    """Return the fits of each kind of trial of one ship; `dimensions` are the prior of plans."""
    folder = place / f"{name}-{seed}"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "vessel.toml").write_text(vessel_file(name, dimensions=dimensions))
    found: dict[str, list[float]] = {}
    for arm in (*(() if dimensions else ("first",)), *arms):
        try:
            found[arm] = fit(folder, name, arm, seed)
        except subprocess.CalledProcessError as error:
            print(f"{name} {seed} {arm}: {error.stderr.strip().splitlines()[-1]}", flush=True)
            found[arm] = [float("nan")] * 3
    return found


def paired(logs: Array) -> str:
    """Return the ratio of errors that logarithms (n,) tell, its 95 % interval (Student's t), and n.

    A pair of which one trial or estimate failed is left out.
    """
    logs = logs[np.isfinite(logs)]
    n = len(logs)
    half = stdtrit(n - 1, 0.975) * logs.std(ddof=1) / np.sqrt(n) if n > 1 else np.nan
    low, middle, high = np.exp([logs.mean() - half, logs.mean(), logs.mean() + half])
    return f"{middle:.2f} ({low:.2f} to {high:.2f}) n={n}"


def row(
    name: str,
    cases: Sequence[dict[str, list[float]]],
    base: str,
    off: Sequence[dict[str, tuple[float, float]]],
) -> str:
    """Return mean fits, and errors of each other kind of trial over those of `base`.

    First of free runs, then of linear derivatives on a course and over the envelope.
    """
    fits = {arm: np.array([c[arm] for c in cases]) for arm in cases[0]}
    means = "".join(f"{np.nanmean(f):>12.1f}" for f in fits.values())
    # geometric mean over the states of the rms error in the deviation of each
    errors = {arm: np.log(np.maximum(1 - f / 100, 1e-6)).mean(axis=1) for arm, f in fits.items()}
    others = [arm for arm in errors if arm not in ("first", base)] if base else []
    both = [{arm: np.log([o[arm][k] for o in off]) for arm in errors} for k in range(2)]
    told = "".join(
        f"   {paired(of[arm] - of[base]):<24}" for of in (errors, *both) for arm in others
    )
    return f"{name:<24}{means}{told}".rstrip()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", required=True, type=Path)
    parser.add_argument("--ships", nargs="+", default=list(SHIPS), choices=sorted(presets()))
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3, 4])
    parser.add_argument("--arms", nargs="+", default=list(ARMS[:5]), choices=ARMS)
    parser.add_argument("--prior", choices=("first", "none"), default="first")
    options = parser.parse_args()
    dimensions = options.prior == "none"
    found: dict[str, list[dict[str, list[float]]]] = {name: [] for name in options.ships}
    off: dict[str, list[dict[str, tuple[float, float]]]] = {name: [] for name in options.ships}
    for seed in options.seeds:
        for name in options.ships:
            found[name].append(case(options.out, name, seed, options.arms, dimensions=dimensions))
            off[name].append(
                coefficient_errors(options.out / f"{name}-{seed}", name, found[name][-1])
            )
            told = {arm: round(float(np.mean(v)), 1) for arm, v in found[name][-1].items()}
            print(f"{name} {seed}: {told}", flush=True)
    base = next((arm for arm in ("plan", "stages") if arm in options.arms), "")
    sailed = [*(() if dimensions else ("first",)), *options.arms]
    others = [arm for arm in options.arms if arm != base] if base else []
    print(f"{'mean held-out fit [%]':<24}" + "".join(f"{arm:>12}" for arm in sailed)
          + "".join(f"   {f'{x} over {base}':<24}" for x in others * 3)
          + f"   (errors of {len(others)}, then of their derivatives, twice)")  # fmt: skip
    for name, cases in found.items():
        print(row(name, cases, base, off[name]))
    told = sorted(options.out.glob("*/limited.kept")) if "limited" in options.arms else []
    for path in told:
        one = json.loads(path.read_text())
        within = all(left >= 0 for left in one["left"].values())
        print(f"{path.parent.name:<28}limits {'kept' if within else 'passed'}, stated "
              f"{one['stated']:.2f}, left {one['left']}")  # fmt: skip
    every = [c for cases in found.values() for c in cases]
    print(row("all", every, base, [o for one in off.values() for o in one]))


if __name__ == "__main__":
    main()
