"""Whether trials that took no part lie within the intervals of predicted manoeuvres.

A model is estimated as a user does (`greybox estimate LOG... --vessel V`), from other logs of the
same ship: real ships in two halves or by kinds of manoeuvre, ships of `tests/foreign_ships` from
random orders, a 20/20 and a 10/10 zig-zag and a turn. Turns and zig-zags of the rest are then
predicted beside their trial (`predict --trial`):

    PYTHONPATH=tests python -m benchmarks.predicted_manoeuvres --out DIR [--cases ...]

A model stands in DIR and is not estimated again. A quantity is inside where the difference lies
within both intervals; widths and errors are relative to what was measured.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from foreign_ships import presets  # type: ignore[import-not-found]
from foreign_ships.manoeuvres import kinds  # type: ignore[import-not-found]

from benchmarks.held_out import greybox, prepare, vessel_of
from greybox.commands.common import read_logs
from greybox.errors import GreyboxError
from greybox.model.model import load_model
from greybox.numerics.binomial import wilson_interval
from greybox.prediction.predict import predict_manoeuvre

_DRAWS = 128
# a foreign ship's trials, the first four to estimate from; every fifth sample of these is kept
_FOREIGN = (
    "random", "zigzag-20", "turn-port", "zigzag-10-port",
    "turn-starboard", "zigzag-20-port", "zigzag-10", "turn-port-15", "turn-starboard-15",
)  # fmt: skip
_OWN, _EVERY, _SEED = 4, 5, 7000


@dataclass(frozen=True)
class Real:
    """Logs of a real ship to estimate from and to predict: patterns of their files."""

    ship: str
    own: tuple[str, ...]
    new: tuple[str, ...]


_ESSO_A = ("turn_14-Oct-2020_14_08*", "turn_14-Sep-2020_14*", "zigzag*13_14*", "zigzag*13_50*")
_ESSO_B = (
    "turn_14-Oct-2020_14_39*", "turn_14-Oct-2020_15*", "turn_14-Sep-2020_15*",
    "zigzag*13_29*", "zigzag*14_03*",
)  # fmt: skip
REAL = {
    "esso-a": Real("esso", ("random_03*", "random_31*", *_ESSO_A), _ESSO_B),
    "esso-b": Real("esso", ("random_06*", "random_31*", *_ESSO_B), _ESSO_A),
    "hsva-a": Real("hsva", ("hsva_Z_10_05", "hsva_Z_35_05"), ("hsva_Z_20*",)),
    "hsva-b": Real("hsva", ("hsva_Z_20*",), ("hsva_Z_10_05", "hsva_Z_35_05")),
    "marin-turn": Real("marin", ("marin_zz*",), ("marin_tc*",)),
    "marin-zigzag": Real("marin", ("marin_tc*", "marin_zz_20"), ("marin_zz_-10",)),
}


@dataclass(frozen=True)
class Row:
    """A quantity: which, whether inside, half width and error relative to the measured value."""

    name: str
    inside: bool
    half: float
    error: float


def real_logs(case: Real, out: Path) -> tuple[str, list[Path], list[Path]]:
    """Return vessel file, and logs to estimate from and to predict."""
    folder = prepare(case.ship, out)
    own, new = ([p for x in which for p in sorted(folder.glob(f"{x}.csv"))]
                for which in (case.own, case.new))  # fmt: skip
    return vessel_of(case.ship, out), own, new


def foreign_logs(name: str, out: Path) -> tuple[str, list[Path], list[Path]]:
    """Sail the trials of a foreign ship once; see `real_logs`."""
    preset, folder = presets()[name], out / name
    folder.mkdir(parents=True, exist_ok=True)
    vessel = folder / "vessel.toml"
    vessel.write_text(preset.ship.vessel_toml())
    logs = [folder / f"{i:02d}-{kind}.csv" for i, kind in enumerate(_FOREIGN)]
    for i, (path, kind) in enumerate(zip(logs, _FOREIGN, strict=True)):
        if not path.exists():
            trial = preset.sail(kinds()[kind], seed=_SEED + i)
            trial.write_csv(path, _EVERY if i < _OWN else 1, wind=False)
    return str(vessel), logs[:_OWN], logs[_OWN:]


def rows_of(model_file: Path, logs: Sequence[Path]) -> Iterator[Row]:
    """Yield the quantities of each trial, printing a line for each manoeuvre."""
    model = load_model(model_file)
    for path in logs:
        kind = "zigzag" if "zigzag" in path.name or "_Z_" in path.name or "_zz_" in path.name else (
            "turning")  # fmt: skip
        try:
            trial, _ = read_logs([str(path)], model.vessel, states=model.structure.states)
            made = predict_manoeuvre(model, kind, trial=trial, draws=_DRAWS)
        except GreyboxError as error:
            print(f"  {path.stem}: {error}")
            continue
        for manoeuvre in made.manoeuvres:
            assert manoeuvre.agreement is not None
            found = []
            for r in manoeuvre.agreement.rows:
                size = max(abs(r.measured.value), 1e-12)
                half = (r.predicted.high - r.predicted.low) / 2 / size
                found.append(Row(r.name, r.agrees, half, abs(r.difference.value) / size))
            print(f"  {path.stem}: {told(found)}")
            yield from found


def told(rows: Sequence[Row]) -> str:
    """Return the share inside with its Wilson interval, and the medians."""
    if not rows:
        return "nothing"
    inside, n = sum(r.inside for r in rows), len(rows)
    low, high = wilson_interval(inside / n, n)
    half, error = (100 * float(np.median([getattr(r, x) for r in rows])) for x in ("half", "error"))
    return (
        f"{inside} of {n} inside = {100 * inside / n:.1f} % ({100 * low:.1f}-{100 * high:.1f}), "
        f"median half width {half:.1f} %, median error {error:.1f} %"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--out", type=Path, required=True)
    names = [*REAL, *sorted(presets())]
    parser.add_argument("--cases", nargs="+", default=list(REAL), choices=names)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    warnings.simplefilter("ignore")
    groups: dict[str, list[Row]] = {"real": [], "foreign": []}
    for name in given.cases:
        logs = real_logs(REAL[name], given.out) if name in REAL else foreign_logs(name, given.out)
        vessel, own, new = logs
        model = given.out / f"{name}.json"
        if not model.exists():
            done = greybox("estimate", *map(str, own), "--vessel", vessel, "--out", str(model))
            if done.returncode:
                print(f"{name}: {done.stderr.strip()}")
                continue
        print(name)
        groups["real" if name in REAL else "foreign"] += rows_of(model, new)
    for group, rows in groups.items():
        if rows:
            print(f"{group}: {told(rows)}")
            for quantity in dict.fromkeys(r.name for r in rows):
                print(f"  {quantity:22} {told([r for r in rows if r.name == quantity])}")


if __name__ == "__main__":
    main()
