"""Free runs over logs that took no part: `greybox estimate` against other tools on real ships.

Each split of `SPLITS` names the real logs that a tool estimates from and those it is then run
over freely (6.12): from the mean of their first samples, on the measured commands, and on the
measured wind where there is any. The logs of a ship are imported once, together, with the
findings mended that `greybox check` names; every tool gets the same files. This package is run
as a user runs it (`greybox estimate LOG... --vessel V --out MODEL`, then `greybox simulate`); the
others are in `held_out_peers.py`, which runs in an interpreter of its own:

    python -m venv PEERS; PEERS/bin/pip install scipy numba jax-sysid sysidentpy
    python -m benchmarks.held_out --peers PEERS/bin/python [--splits ...] [--tools ...] [--out DIR]

A result stands in DIR/SPLIT/TOOL and is not made again unless `--again TOOL` asks for it.
Errors are root mean squares over all samples of the held-out logs; what no run shows (no model,
a diverged run), and what is beyond it, counts as ten times the error of the log's own mean.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

DATA = Path(os.environ.get("GREYBOX_DATA", "../shared/data"))
OURS = "greybox"
PEERS = ("scipy", "jax-sysid", "sysidentpy")
CHANNELS = ("u", "v", "r")
# a run that escaped, or none, counts as this many times the error of the log's own mean
_WORST = 10.0


@dataclass(frozen=True)
class Ship:
    """Raw files of one ship, how they are imported, and what the peers need to know of it.

    `parts` cuts a log in stretches: name -> (file, from, to) [s] on the log's clock.
    """

    folder: str
    pattern: str
    vessel: str
    import_options: tuple[str, ...] = ()
    parts: dict[str, tuple[str, float, float]] | None = None


def _propeller(name: str, length: float, speed: str, rudder: str, degrees: bool) -> str:
    columns = f'[columns]\n"{rudder}" = {{ name = "{rudder}", unit = "deg" }}\n' if degrees else ""
    return (
        f'name = "{name}"\nlength = {length}\n[[thruster]]\ntype = "propeller_rudder"\n'
        f'x = {-length / 2}\nspeed = "{speed}"\nrudder = "{rudder}"\n{columns}'
    )


_PUSHED = "".join(
    f'[[thruster]]\ntype = "fixed"\ny = {y}\nspeed = "{side}_force"\n'
    for side, y in (("left", -0.285), ("right", 0.285))
)
_SIGN = ("--fix-also", "sign")

SHIPS = {
    "esso": Ship(
        "esso_osaka", "*.csv",
        _propeller("3 m tanker model", 3.0, "n_prop [rps]", "delta_rudder [rad]", False),
    ),
    "hsva": Ship(
        "kvlcc2", "hsva*.csv", _propeller("7 m tanker model", 7.0, "n_rps", "delta_deg", True),
        _SIGN,
    ),
    "marin": Ship(
        "kvlcc2", "marin*.csv", _propeller("320 m tanker", 320.0, "rpm", "delta_deg", True), _SIGN
    ),
    "blueboat": Ship(
        "blueboat", "*.csv", f'name = "1.2 m catamaran"\nlength = 1.2\nmass = 15.0\n{_PUSHED}',
        _SIGN,
    ),
    "ferry": Ship(
        "milliampere1", "maneuvering1.csv", "ferry",
        parts={"dp_1": ("maneuvering1", 0.0, 157.0), "dp_2": ("maneuvering1", 157.0, 240.0)},
    ),
    "ferry_2": Ship(
        "milliampere1/nlp1", "*.csv", "ferry",
        parts={
            "nlp_1": ("nlp1", 13.0, 175.0), "nlp_2": ("nlp1", 175.0, 335.0),
            "nlp_3": ("nlp1", 335.0, 500.0),
        },
    ),
}  # fmt: skip

_BERTHING = tuple(f"berthing_12-Nov-2020_{t}" for t in ("11_07_23", "11_38_50", "13_21_03"))
_DAYS = ("03-Aug-2020_11_04_37", "06-Aug-2020_16_24_25_4", "31-Jul-2020_12_29_58")
_RANDOM = tuple(f"random_{t}" for t in _DAYS)
_OCTOBER = tuple(f"turn_14-Oct-2020_{t}" for t in ("14_08_51", "14_39_54", "15_21_57"))
_SEPTEMBER = tuple(f"turn_14-Sep-2020_{t}" for t in ("14_16_04", "15_58_08"))
_ZIGZAG = tuple(f"zigzag_31-Jul-2020_{t}" for t in ("13_14_21", "13_29_19", "13_50_28", "14_03_39"))
_TURNS = _OCTOBER + _SEPTEMBER
_ESSO = _BERTHING + _RANDOM + _TURNS + _ZIGZAG
_HSVA = ("hsva_Z_10_05", "hsva_Z_20_05", "hsva_Z_20_10_P", "hsva_Z_35_05")
_BLUE = tuple(f"fixed_00000{n}" for n in (216, 220, 222, 224, 226, 230, 233, 235))


@dataclass(frozen=True)
class Split:
    """Logs to estimate from and logs held out, by the names of their files or parts."""

    ship: str
    train: tuple[str, ...]
    held_out: tuple[str, ...]


def _without(names: Sequence[str], held_out: Sequence[str]) -> tuple[str, ...]:
    return tuple(n for n in names if n not in held_out)


def _kind(ship: str, names: Sequence[str], held_out: Sequence[str]) -> Split:
    return Split(ship, _without(names, held_out), tuple(held_out))


# committed before any tool was run on them; never changed with a result in sight
SPLITS = {
    # a kind of manoeuvre that no training log shows
    "esso_turns": _kind("esso", _ESSO, _TURNS),
    "esso_zigzags": _kind("esso", _ESSO, _ZIGZAG),
    "esso_random": _kind("esso", _ESSO, _RANDOM),
    "esso_berthing": _kind("esso", _ESSO, _BERTHING),
    # summer to autumn; every second file; little to learn from
    "esso_dates": _kind("esso", _ESSO, _TURNS + _BERTHING),
    "esso_second": _kind("esso", sorted(_ESSO), sorted(_ESSO)[1::2]),
    "esso_few": Split("esso", (_RANDOM[2], *_ZIGZAG[:2]), (*_RANDOM[:2], *_ZIGZAG[2:])),
    # mild to wide and back; one manoeuvre held out
    "hsva_wide": Split("hsva", _HSVA[:2], _HSVA[2:]),
    "hsva_mild": Split("hsva", _HSVA[2:], _HSVA[:2]),
    "hsva_port": _kind("hsva", _HSVA, _HSVA[2:3]),
    "hsva_35": _kind("hsva", _HSVA, _HSVA[3:]),
    # zig-zags to the turning circle; turn and 20/20 to the other side's 10/10
    "marin_turn": Split("marin", ("marin_zz_-10", "marin_zz_20"), ("marin_tc_35",)),
    "marin_zigzag": Split("marin", ("marin_tc_35", "marin_zz_20"), ("marin_zz_-10",)),
    # every second file and the others; the earlier hour to the later
    "blue_second": Split("blueboat", _BLUE[::2], _BLUE[1::2]),
    "blue_first": Split("blueboat", _BLUE[1::2], _BLUE[::2]),
    "blue_hour": Split("blueboat", _BLUE[:5], _BLUE[5:]),
    # whole stretches of a run; another run of the day
    "ferry_last": Split("ferry", ("dp_1",), ("dp_2",)),
    "ferry_nlp_3": Split("ferry_2", ("nlp_1", "nlp_2"), ("nlp_3",)),
    "ferry_nlp_1": Split("ferry_2", ("nlp_2", "nlp_3"), ("nlp_1",)),
}


def greybox(*words: str, timeout: float | None = None) -> subprocess.CompletedProcess[str]:
    """Run the command line as a user does."""
    command = [sys.executable, "-m", "greybox", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout)


def prepare(name: str, cache: Path) -> Path:
    """Import the logs of a ship once, and return their folder."""
    ship, folder = SHIPS[name], cache / name
    if (folder / "done").exists():
        return folder
    folder.mkdir(parents=True, exist_ok=True)
    vessel = vessel_of(name, cache)
    raw = sorted(str(p) for p in (DATA / ship.folder).glob(ship.pattern))
    if not raw:
        raise SystemExit(f"no logs at {DATA / ship.folder}: set GREYBOX_DATA")
    whole = None if ship.parts is None else folder / f"{next(iter(ship.parts.values()))[0]}.csv"
    done = greybox(
        "import", *raw, "--vessel", vessel, "--fix", *ship.import_options,
        "--out", f"{folder}/" if whole is None else str(whole),
    )  # fmt: skip
    if done.returncode:
        raise SystemExit(done.stderr)
    for part, (_, low, high) in (ship.parts or {}).items():
        assert whole is not None
        head, *rows = whole.read_text().splitlines()
        kept = [row for row in rows if low <= float(row.split(",", 1)[0]) < high]
        (folder / f"{part}.csv").write_text("\n".join([head, *kept]) + "\n")
    (folder / "done").write_text(done.stdout)
    return folder


def vessel_of(name: str, cache: Path) -> str:
    """Return the vessel file of a ship, written where it is no example of the package."""
    text = SHIPS[name].vessel
    if "\n" not in text:
        return text
    path = cache / f"{name}.toml"
    path.write_text(text)
    return str(path)


def estimate_ours(
    split: Split, logs: Path, out: Path, cache: Path, options: Sequence[str], limit: float
) -> str:
    """Estimate and run freely; return what went wrong, nothing if all went well."""
    model = out / "model.json"
    train = [str(logs / f"{n}.csv") for n in split.train]
    vessel = vessel_of(split.ship, cache)
    words = ["estimate", *train, "--vessel", vessel, "--out", str(model), *options]
    try:
        done = greybox(*words, timeout=limit)
    except subprocess.TimeoutExpired:
        return f"no model after {limit:g} s"
    (out / "said.txt").write_text(done.stdout + done.stderr)
    if done.returncode:
        return done.stderr.strip().splitlines()[-1]
    wrong = []
    for name in split.held_out:
        words = ["simulate", str(model), str(logs / f"{name}.csv"), "--no-bands"]
        run = greybox(*words, "--out", str(out / f"{name}.csv"))
        wrong += [run.stderr.strip()] * bool(run.returncode)
    return "; ".join(wrong)


def processor_time() -> float:
    """Return the seconds of processor that ended programs of ours have used."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def estimate_peer(
    tool: str, split: Split, logs: Path, out: Path, python: str, budget: float, limit: float
) -> str:
    """Run a peer in its own interpreter."""
    job = {"ship": split.ship, "logs": str(logs), "train": split.train,
           "held_out": split.held_out, "out": str(out), "budget": budget}  # fmt: skip
    (out / "job.json").write_text(json.dumps(job))
    program = Path(__file__).with_name("held_out_peers.py")
    command = [python, str(program), tool, str(out / "job.json")]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=limit)
    except subprocess.TimeoutExpired:
        return f"no model after {limit:g} s"
    (out / "said.txt").write_text(done.stdout + done.stderr)
    return done.stderr.strip().splitlines()[-1] if done.returncode else ""


def read_columns(path: Path) -> dict[str, Array]:
    """Return time and motion of a CSV."""
    with path.open(newline="") as handle:
        head = next(csv.reader(handle))
    wanted = ("t", *CHANNELS)
    table = np.genfromtxt(
        path, delimiter=",", skip_header=1, usecols=[head.index(n) for n in wanted]
    )
    return dict(zip(wanted, table.T, strict=True))


def score(log: Path, run: Path) -> dict[str, list[float]]:
    """Return mean squared errors of a run and of the log's own mean, a channel, and samples."""
    measured = read_columns(log)
    found = read_columns(run) if run.exists() else None
    error, spread, count = [], [], []
    for name in CHANNELS:
        y = measured[name]
        known = np.isfinite(y)
        power = float(np.mean((y[known] - y[known].mean()) ** 2))
        lost = np.inf
        if found is not None:
            x = np.interp(measured["t"], found["t"], found[name])
            with np.errstate(over="ignore", invalid="ignore"):
                lost = float(np.mean((x - y)[known] ** 2))
        error.append(min(lost, _WORST**2 * power) if np.isfinite(lost) else _WORST**2 * power)
        spread.append(power)
        count.append(float(known.sum()))
    return {"error": error, "spread": spread, "samples": count}


def pooled(scores: dict[str, dict[str, list[float]]], key: str) -> Array:
    """Return the root mean square over all samples of all logs, a channel (3,)."""
    n = np.array([s["samples"] for s in scores.values()])
    return np.asarray(np.sqrt((np.array([s[key] for s in scores.values()]) * n).sum(0) / n.sum(0)))


def interval(logs: Array, seed: int = 0) -> tuple[float, float | None, float | None]:
    """Return the geometric mean of paired ratios with its 95 % bootstrap interval over splits."""
    if len(logs) < 2:
        return float(np.exp(logs.mean())), None, None
    drawn = np.random.default_rng(seed).integers(0, len(logs), (4000, len(logs)))
    low, high = np.quantile(logs[drawn].mean(axis=1), [0.025, 0.975])
    return float(np.exp(logs.mean())), float(np.exp(low)), float(np.exp(high))


def summary(results: dict[str, dict[str, Any]], tools: Sequence[str]) -> dict[str, Any]:
    """Print errors a split, and our errors over those of the peers; return the ratios."""
    print(f"{'split':<14}{'tool':<12}" + "".join(f"{c + ' rmse':>11}{'fit':>7}" for c in CHANNELS)
          + f"{'seconds':>9}{'cpu':>7}")  # fmt: skip
    rmse: dict[str, dict[str, Array]] = {}
    useful: dict[str, NDArray[np.bool_]] = {}
    for split, found in results.items():
        rmse[split] = {t: pooled(found[t]["scores"], "error") for t in tools if t in found}
        spread = pooled(next(iter(found.values()))["scores"], "spread")
        useful[split] = np.any([e < spread for e in rmse[split].values()], axis=0)
        for tool, e in rmse[split].items():
            cells = "".join(
                f"{a:>11.4g}{100 * (1 - a / b):>6.1f}{' ' if ok else '-'}"
                for a, b, ok in zip(e, spread, useful[split], strict=True)
            )
            record = found[tool]
            times = f"{record['seconds']:>9.0f}{record['processor seconds']:>7.0f}"
            print(f"{split:<14}{tool:<12}{cells}{times}  {record['wrong'][:60]}")
    print("'-': no tool beats the mean of the log, the channel is left out below\n")
    ratios: dict[str, Any] = {}
    peers = [t for t in tools if t != OURS]
    groups = {"all": list(rmse)}
    groups |= {s: [k for k in rmse if SPLITS[k].ship == s] for s in SHIPS}
    for group, members in groups.items():
        for rival in (*peers, "best peer"):
            row = {}
            for i, channel in enumerate((*CHANNELS, "mean")):
                logs = []
                for split in members:
                    errors = rmse[split]
                    others = [errors[t] for t in peers if t in errors and rival in (t, "best peer")]
                    if OURS not in errors or not others:
                        continue
                    log = np.log(errors[OURS] / np.min(others, axis=0))
                    kept = useful[split]
                    if channel == "mean" and kept.any():
                        logs.append(log[kept].mean())
                    elif channel != "mean" and kept[i]:
                        logs.append(log[i])
                if logs:
                    row[channel] = (*interval(np.array(logs)), len(logs))
            if row:
                ratios.setdefault(group, {})[rival] = row
                cells = "  ".join(
                    f"{c} {m:.3f} " + (f"(n={n})" if a is None else f"({a:.3f} to {b:.3f}, n={n})")
                    for c, (m, a, b, n) in row.items()
                )
                print(f"our rmse over that of {rival:<11} {group:<9} {cells}")
    return ratios


def versions(python: str) -> dict[str, str]:
    """Return the machine and what the tools are."""
    names = ("numpy", "scipy", "numba", "jax-sysid", "sysidentpy", "greybox-marine")
    found = {"machine": platform.processor() or platform.machine(), "cores": str(os.cpu_count())}
    for interpreter in dict.fromkeys((sys.executable, python)):
        code = (
            "import importlib.metadata as m\n"
            f"for n in {names!r}:\n    try: print(n, m.version(n))\n    except Exception: pass"
        )
        said = subprocess.run([interpreter, "-c", code], capture_output=True, text=True).stdout
        label = "ours" if interpreter == sys.executable else "peers"
        found |= {f"{label} {k}": v for k, v in (line.split() for line in said.splitlines())}
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--splits", nargs="+", choices=SPLITS, default=list(SPLITS))
    parser.add_argument("--tools", nargs="+", choices=(OURS, *PEERS), default=[OURS, *PEERS])
    parser.add_argument("--out", type=Path, default=Path("held_out"))
    parser.add_argument("--cache", type=Path, help="imported logs; OUT/logs by default")
    parser.add_argument("--peers", default=sys.executable, help="interpreter of the peers")
    parser.add_argument("--again", nargs="*", default=[], help="tools whose results are made anew")
    parser.add_argument("--options", default="", help="further options of greybox estimate")
    parser.add_argument("--budget", type=float, default=60.0, help="processor time of a peer [s]")
    parser.add_argument("--limit", type=float, default=900.0, help="a tool is ended after this [s]")
    parser.add_argument("--only-summary", action="store_true")
    asked = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    cache = asked.cache or asked.out / "logs"
    results: dict[str, dict[str, Any]] = {}
    for name in asked.splits:
        split = SPLITS[name]
        logs = prepare(split.ship, cache)
        for tool in asked.tools:
            out = asked.out / name / tool
            record = out / "record.json"
            if (tool in asked.again or not record.exists()) and not asked.only_summary:
                out.mkdir(parents=True, exist_ok=True)
                for old in out.glob("*"):
                    old.unlink()
                began, before = time.perf_counter(), processor_time()
                if tool == OURS:
                    more = asked.options.split()
                    wrong = estimate_ours(split, logs, out, cache, more, asked.limit)
                else:
                    wrong = estimate_peer(
                        tool, split, logs, out, asked.peers, asked.budget, asked.limit
                    )
                seconds = time.perf_counter() - began
                said = {
                    "seconds": seconds,
                    "processor seconds": processor_time() - before,
                    "wrong": wrong,
                    "load": os.getloadavg()[0],
                }
                record.write_text(json.dumps(said))
                print(f"{name}, {tool}: {seconds:.0f} s {wrong}", file=sys.stderr)
            if record.exists():
                files = {n: (logs / f"{n}.csv", out / f"{n}.csv") for n in split.held_out}
                found = json.loads(record.read_text())
                found["scores"] = {n: score(*pair) for n, pair in files.items()}
                results.setdefault(name, {})[tool] = found
    ratios = summary(results, asked.tools)
    whole = {"ratios": ratios, "results": results, "versions": versions(asked.peers)}
    (asked.out / "result.json").write_text(json.dumps(whole, indent=1))


if __name__ == "__main__":
    main()
