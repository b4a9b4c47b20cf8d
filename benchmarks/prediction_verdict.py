"""Whether the verdict on predictions tells what a model does on trials that it never saw.

Ships of `tests/foreign_ships` sail campaigns, an estimate is made of each as a user would make
it, well or badly (structure, method, thrust law, number of logs), and its verdict and bands by
logs left out in turn are held against new trials of the same ship, of kinds that the campaign
had and of others:

    PYTHONPATH=tests python -m benchmarks.prediction_verdict --out FILE [--seconds S] [--ships ...]

A case stands in FILE (a JSON line) and is not made again. The truth is the verdict by the same
limits on the new trials. Bands are compared with the quantiles of the errors of the logs left
out by their interval score (Gneiting and Raftery, 2007), each channel in its spread.
"""

from __future__ import annotations

import argparse
import json
import random
import time
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from foreign_ships import DEVELOPMENT, presets  # type: ignore[import-not-found]
from foreign_ships.manoeuvres import kinds  # type: ignore[import-not-found]
from numpy.typing import NDArray

from greybox import estimate_model, load_vessel, read_log
from greybox.errors import GreyboxError
from greybox.estimation.prediction_verdict import JudgedOn, PredictionVerdict
from greybox.numerics.binomial import wilson_interval
from greybox.selection.cross_validation import parts_of
from greybox.selection.prediction import as_read, refit_alike, with_prediction
from greybox.selection.request import Request
from greybox.trial.log import TrialLog
from greybox.validation.bands import predict_bands
from greybox.validation.judge_prediction import HeldOut, judge_prediction

Array = NDArray[np.float64]

CAMPAIGNS = {
    "wide": ("random", "everyday", "zigzag-20", "turn-starboard-15", "speed-steps"),
    "trial": ("zigzag-20", "zigzag-10-port", "turn-starboard-15", "turn-port", "speed-steps"),
    "random": ("random", "random", "random"),
    "few": ("random", "zigzag-20"),
    "one": ("everyday",),
}
NEW = ("random", "zigzag-10-port", "turn-port-15", "everyday")
# the last is what a user gets who asks for nothing; regressions are cheap and so more frequent
WAYS = (
    *(("ls", s) for s in ("linear", "thesis", "thesis", "blanke", "modulus", "modulus")),
    *(("iv", s) for s in ("linear", "thesis", "blanke")),
    *(("oe", s) for s in ("linear", "thesis", "modulus")),
)
THRUST = ("quadratic", "quadratic", "linear")
# what is left of a ship with little beside a quadratic hull
_PLAIN = {"quadratic_thrust", "quadratic_drag", "nonlinear_hull", "coriolis", "actuator_dynamics"}
# samples take this share of a ship length, trials last so many
_SAMPLE, _LENGTHS = 0.1, 60
_ALPHA = 0.05


@dataclass(frozen=True)
class Case:
    """A ship, the weather, a campaign and how it is estimated."""

    ship: str
    plain: bool
    weather: float
    campaign: str
    method: str | None
    structure: str | None
    thrust: str

    @property
    def seed(self) -> int:
        return zlib.crc32(f"{self.ship} {self.plain} {self.weather}".encode()) % 10_000


def cases(ships: Sequence[str], defaults: int) -> list[Case]:
    """Return all cases in an order that mixes them; `defaults` of them choose by themselves."""
    rng = random.Random(1)
    found = []
    for ship in ships:
        for plain in (False, True):
            for weather in (0.0, 0.4):
                for campaign in CAMPAIGNS:
                    for _ in range(2):
                        way, thrust = rng.choice(WAYS), rng.choice(THRUST)
                        found.append(Case(ship, plain, weather, campaign, *way, thrust))
    found = list(dict.fromkeys(found))
    rng.shuffle(found)
    step = max(1, len(found) // max(defaults, 1))
    open_ones = [replace(c, method=None, structure=None) for c in found[::step][:defaults]]
    return [*found, *open_ones]


def sail(case: Case, names: Sequence[str], first: int, folder: Path) -> list[TrialLog]:
    """Return the trials of a case, written and read as a user's."""
    preset = presets()[case.ship]
    if case.plain:
        known = _PLAIN & set(vars(preset.ship.mechanisms))
        preset = replace(preset, ship=preset.ship.only(*known))
    where = preset.weather(case.seed, case.weather) if case.weather else {}
    every = max(1, round(_SAMPLE * preset.ship.time_scale / preset.dt))
    toml = folder / f"{case.ship}-{case.thrust}.toml"
    toml.write_text(preset.ship.vessel_toml(case.thrust))
    vessel = load_vessel(toml)
    logs = []
    for i, name in enumerate(names):
        path = folder / f"{case.seed}-{first + i}-{name}.csv"
        if not path.exists():
            trial = preset.sail(
                kinds()[name], _LENGTHS * preset.ship.time_scale, seed=first + i, **where
            )
            trial.write_csv(path, every, wind=bool(case.weather))
        logs.append(read_log(path, vessel))
    return logs


def judge(case: Case, folder: Path) -> dict[str, Any]:
    """Estimate, and hold the verdict and the bands against new trials."""
    logs = sail(case, CAMPAIGNS[case.campaign], 10, folder)
    # an open choice is judged as it is made
    asked = {"method": case.method, "structure": case.structure}
    estimate = estimate_model(logs, **asked, judged=case.method is None)
    request = Request(**asked)
    if case.method is not None:
        estimate = with_prediction(estimate, logs, request)
    assert estimate.prediction is not None
    model = estimate.model()
    new = as_read(sail(case, NEW, 50, folder), estimate)
    held = [HeldOut.of(model, log) for log in new]
    truth = judge_prediction(held, JudgedOn.VALIDATION)
    out = {"verdict": shown(estimate.prediction), "truth": shown(truth)}
    out["runs"] = list(scores(held, fold_errors(logs, estimate, request), case))
    return out


def shown(verdict: PredictionVerdict) -> dict[str, Any]:
    channels = {
        c.channel: {
            "error": c.error if np.isfinite(c.error) else 1e9,
            "elsewhere": None if c.elsewhere is None else c.elsewhere / c.spread,
            "moves": c.moves,
            "share": c.bands.share if c.bands else None,
        }
        for c in verdict.channels
    }
    return {"level": str(verdict.level), "text": verdict.text, "channels": channels}


def fold_errors(logs: Sequence[TrialLog], estimate: Any, request: Request) -> Array | None:
    """Return the errors (N, nx) of logs left out in turn; None where nothing could be left out."""
    logs = as_read(logs, estimate)
    again = refit_alike(estimate, request)
    found = []
    try:
        parts = parts_of(logs)
    except GreyboxError:
        return None
    for fitting, left in parts:
        try:
            model = again(fitting)
        except GreyboxError:
            continue
        runs = [HeldOut.of(model, log).run for log in left]
        found += [r.errors() for r in runs if r.diverged < 0]
    return np.concatenate(found) if found else None


def interval_score(y: Array, low: Array, high: Array) -> Array:
    """Return the mean interval score of each column."""
    beyond = np.maximum(low - y, 0) + np.maximum(y - high, 0)
    return np.asarray((high - low + 2 / _ALPHA * beyond).mean(axis=0))


def scores(held: Sequence[HeldOut], errors: Array | None, case: Case) -> Iterator[dict[str, Any]]:
    """Yield coverage and interval score of each new trial, and those of the errors' quantiles."""
    had = {n.split("-")[0] for n in CAMPAIGNS[case.campaign]}
    for name, h in zip(NEW, held, strict=True):
        if h.run.diverged >= 0 or errors is None:
            continue
        states = tuple(h.run.fit)
        y, x = h.run.log.states(states), h.run.x
        spread = y.std(axis=0) + 1e-12
        low, high = predict_bands(h.model, h.run.log, runs=64).measurement
        if np.isnan(low).any():
            continue
        peer = np.quantile(errors, [_ALPHA / 2, 1 - _ALPHA / 2], axis=0)
        yield {
            "kind": name,
            "seen": name.split("-")[0] in had,
            "calibrated": h.model.calibration is not None,
            "cover": ((y >= low) & (y <= high)).mean(axis=0).tolist(),
            "score": (interval_score(y, low, high) / spread).tolist(),
            "peer_cover": ((y >= x + peer[0]) & (y <= x + peer[1])).mean(axis=0).tolist(),
            "peer_score": (interval_score(y, x + peer[0], x + peer[1]) / spread).tolist(),
        }


def report(rows: Sequence[dict[str, Any]]) -> None:
    """Print agreement by class, coverage and scores."""
    known = [r for r in rows if "refused" not in r]
    new, kept = len(NEW) * len(known), sum(len(r["runs"]) for r in known)
    print(f"{len(known)} cases, {len(rows) - len(known)} without a model; of {new} new trials "
          f"{new - kept} are left out below: their run escapes or has no band")  # fmt: skip
    table = Counter((r["truth"]["level"], r["verdict"]["level"]) for r in known)
    for level in ("good", "limited", "poor"):
        row = {w: table[level, w] for w in ("good", "limited", "poor")}
        n = sum(row.values())
        if n:
            low, high = wilson_interval(row[level] / n, n)
            print(f"truly {level:<8} {n:4d}: {row}, agreement {100 * row[level] / n:.0f} % "
                  f"({100 * low:.0f}-{100 * high:.0f})")  # fmt: skip
    for what, key in (("parts", "error"), ("kinds of manoeuvre", "elsewhere")):
        pairs = [
            (verdict.get(key), c["truth"]["channels"][name]["error"])
            for c in known
            for name, verdict in c["verdict"]["channels"].items()
            if c["truth"]["channels"][name]["moves"]
        ]
        # beyond twice the spread a model is of no use, however far
        logs = [np.log(np.clip(pair, 0.02, 2.0)) for pair in pairs if pair[0] is not None]
        if logs:
            off = np.subtract(*np.transpose(logs))
            print(f"error by {what} left out over that on new trials: median factor "
                  f"{np.exp(np.median(off)):.2f}, spread {np.exp(off.std()):.2f} ({len(off)} "
                  f"channels)")  # fmt: skip
    for which in (True, False, None):
        runs = [r for c in known for r in c["runs"] if which is None or r["seen"] is which]
        if not runs:
            continue
        cover, score, peer_cover, peer_score = (
            np.array([r[k] for r in runs]) for k in ("cover", "score", "peer_cover", "peer_score")
        )
        print({True: "kinds seen", False: "kinds not seen", None: "all"}[which], len(runs), "runs")
        # cases are independent, runs of one are not
        owner = np.array([i for i, c in enumerate(known) for r in c["runs"]
                          if which is None or r["seen"] is which])  # fmt: skip
        by_case = np.array([cover[owner == i].mean(axis=0) for i in np.unique(owner)])
        error = 1.96 * by_case.std(axis=0) / np.sqrt(len(by_case))
        print("  coverage", (100 * cover.mean(axis=0)).round(1), "±", (100 * error).round(1),
              "quantiles of errors", (100 * peer_cover.mean(axis=0)).round(1))  # fmt: skip
        ratio = np.log(score / peer_score)
        by_case = np.array([ratio[owner == i].mean() for i in np.unique(owner)])
        middle, half = by_case.mean(), 1.96 * by_case.std() / np.sqrt(len(by_case))
        print(f"  interval score over that of quantiles {np.exp(middle):.3f} "
              f"({np.exp(middle - half):.3f}-{np.exp(middle + half):.3f}), by channel",
              np.exp(ratio.mean(axis=0)).round(3))  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seconds", type=float, default=3600.0, help="stop after so long")
    parser.add_argument("--ships", nargs="+", default=list(DEVELOPMENT), choices=sorted(presets()))
    parser.add_argument("--defaults", type=int, default=0, help="cases with nothing asked for")
    given = parser.parse_args()
    rows = [json.loads(x) for x in given.out.read_text().splitlines()] if given.out.exists() else []
    done = {Case(**r["case"]) for r in rows}
    folder = given.out.with_suffix(".logs")
    folder.mkdir(parents=True, exist_ok=True)
    begin = time.monotonic()
    for case in cases(given.ships, given.defaults):
        if case in done:
            continue
        if time.monotonic() - begin > given.seconds:
            break
        try:
            row = judge(case, folder)
        except GreyboxError as error:
            row = {"refused": str(error)}
        rows.append({"case": vars(case), **row})
        with given.out.open("a") as handle:
            handle.write(json.dumps(rows[-1]) + "\n")
    report(rows)


if __name__ == "__main__":
    main()
