"""Forty commands whose numbers stand still while the package is rebuilt.

``PYTHONPATH=tests python -m fixed_results.commands --write`` runs them and writes
their numbers anew to ``expected.json``; names behind it do so for these alone.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import time
import zipfile
from collections.abc import Callable, Mapping
from contextlib import chdir, redirect_stdout
from dataclasses import dataclass, field
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from xml.etree import ElementTree

import numpy as np
from fixed_results.inputs import write_inputs

Numbers = dict[str, Any]
EXPECTED = Path(__file__).with_name("expected.json")
# a longer list of numbers is thinned to this many
_LONGEST = 200
_KEPT = 40
# share of the greatest of a list, and size, below which a number is nothing but rounding
_BESIDE, _NOTHING = 1e-3, 1e-6
_DIGITS = 13
# steps of an iteration
_COUNTS = {"iterations", "evaluations", "convergence"}
# what depends on the clock, the machine or the version
_PASSING = {"provenance", "wall_s", "seconds", "version", *_COUNTS}
# no iteration, or one whose end no rounding moves
EXACT = 1e-9


@dataclass(frozen=True)
class Loose:
    """Keys of a result whose numbers an iteration leaves to its tolerance.

    Measured by what rounding the inputs in their last digit moves, with room of
    a factor of ten.

    Parameters
    ----------
    why : str
    rtol : mapping of str to float
        By key; infinite where the iteration may end elsewhere. `""` is every other key.
    """

    why: str = ""
    rtol: Mapping[str, float] = field(default_factory=dict)

    def allowed(self, key: str) -> float:
        """Return how far the numbers of a key may be off, relative to each."""
        return self.rtol.get(key, self.rtol.get("", EXACT))


NOWHERE = Loose()
# tests and standard errors rest on a noise model whose fit stops at its tolerance
_NOISE = dict.fromkeys(("tests", "verdict", "covariance", "limits", "noise"), 1e-4)
LEAST_SQUARES = Loose(
    "the noise model of the tests is fitted to a tolerance", {"tests": 1e-5, "verdict": 1e-5}
)
INSTRUMENTS = Loose(
    "the noise model of standard errors and tests is fitted to a tolerance, and draws of the "
    "estimate by these calibrate the bands",
    _NOISE | dict.fromkeys(("std", "nuisance", "disturbances", "calibration"), 1e-6),
)
REFINED = Loose("the estimate itself rests on that noise model", _NOISE | {"": 1e-5})
FREE_RUNS = Loose(
    "Gauss-Newton and the search for the noise stop at their tolerances", _NOISE | {"": 1e-4}
)
CERTIFIED = Loose(
    "the bound is the largest of several local searches",
    {"certificate": np.inf, "efficiency_lower_bound": np.inf},
)
REFITTED = Loose("each model is fitted to the other's motion, to a tolerance",
                 {"discrimination": 1e-3})  # fmt: skip


@dataclass(frozen=True)
class Fixed:
    """A command and how near its numbers must be to those expected.

    Parameters
    ----------
    name : str
    words : str
        The command line; `OUT` stands for the file whose numbers count.
    out : str
        Name of that file.
    loose : Loose
        Where numbers may differ by more than `EXACT`, and why.
    quick : bool
        Whether it runs among the fast tests.
    """

    name: str
    words: str
    out: str = "out.json"
    loose: Loose = NOWHERE
    quick: bool = False


COMMANDS = (
    # least squares
    Fixed("ls-basic", "estimate calm.csv --vessel ship.toml --method ls --predictor basic "
          "--structure thesis --json OUT",
          loose=LEAST_SQUARES, quick=True),
    Fixed("ls-augmented-white", "estimate current.csv --vessel ship.toml --method ls --predictor "
          "augmented --structure linear --covariance white --json OUT",
          loose=LEAST_SQUARES, quick=True),
    Fixed("ls-modulus", "estimate wind.csv windy.csv --vessel ship.toml --method ls --predictor "
          "basic+wind --structure modulus --json OUT",
          loose=LEAST_SQUARES),
    Fixed("ls-rudder", "estimate rudder.csv zigzag.csv --vessel rudder.toml --method ls "
          "--structure thesis-Xkappa-Wuu-Wvv-Wuv --predictor basic --json OUT",
          loose=LEAST_SQUARES),
    # instrumental variables
    Fixed("iv-plain", "estimate current.csv --vessel ship.toml --method iv --predictor basic "
          "--structure thesis --prefilter none --json OUT",
          loose=INSTRUMENTS, quick=True),
    Fixed("iv-augmented", "estimate current.csv second.csv --vessel ship.toml --method iv "
          "--predictor augmented --structure thesis --prefilter none --json OUT",
          loose=INSTRUMENTS),
    Fixed("iv-refined", "estimate current.csv --vessel ship.toml --method iv --predictor "
          "augmented --structure linear --prefilter noise --json OUT",
          loose=REFINED),
    Fixed("iv-wind-refined", "estimate windy.csv --vessel windy.toml --method iv --predictor "
          "wind --structure thesis --json OUT",
          loose=REFINED),
    Fixed("iv-mean-kept", "estimate wind.csv --vessel ship.toml --method iv --predictor "
          "basic+wind --instruments mean-kept --json OUT",
          loose=INSTRUMENTS),
    Fixed("iv-closed-loop", "estimate current.csv --vessel ship.toml --method iv --predictor "
          "basic --structure linear --loop closed --json OUT",
          loose=INSTRUMENTS),
    Fixed("iv-margins", "estimate current.csv second.csv --vessel ship.toml --method iv "
          "--predictor basic --structure linear --margin-u 1.2 --margin-v 0.6 --json OUT",
          loose=REFINED),
    Fixed("iv-bootstrap", "estimate calm.csv --vessel ship.toml --method iv --predictor basic "
          "--structure linear --covariance bootstrap --prefilter none --seed 3 --json OUT",
          loose=INSTRUMENTS),
    Fixed("iv-decimated", "estimate fine.csv --vessel ship.toml --method iv --predictor "
          "augmented --structure linear --sample-time 1 --json OUT",
          loose=REFINED),
    Fixed("iv-nominal", "estimate pushed.csv --vessel ship.toml --method iv --predictor basic "
          "--structure thesis --nominal plain.json --heading simulated --json OUT",
          loose=REFINED),
    Fixed("iv-thrust-law", "estimate calm.csv --vessel law.toml --method iv --predictor basic "
          "--structure thesis-Xkappa --prefilter none --json OUT",
          loose=INSTRUMENTS),
    Fixed("iv-lag-delay", "estimate late.csv --vessel late.toml --method iv --predictor basic "
          "--structure linear --json OUT",
          loose=REFINED),
    # output error
    Fixed("oe-linear", "estimate calm.csv --vessel ship.toml --method oe --predictor basic "
          "--structure linear --json OUT",
          loose=FREE_RUNS),
    Fixed("oe-current", "estimate current.csv --vessel ship.toml --method oe --predictor "
          "augmented --structure linear --heading simulated --weights deviation --json OUT",
          loose=FREE_RUNS),
    Fixed("oe-multiple-shooting", "estimate calm.csv --vessel table.toml --method oe --predictor "
          "basic --structure linear --shooting multiple --json OUT",
          loose=FREE_RUNS),
    Fixed("oe-huber-bounds", "estimate brief.csv --vessel ship.toml --method oe --predictor "
          "basic+wind --structure linear+Wuu --loss huber --bound Xu=-0.3:0 --prior "
          "Nr=-0.1:0.02 --wind simulated --damping enforce --json OUT",
          loose=FREE_RUNS),
    Fixed("oe-process-noise", "estimate pushed.csv --vessel ship.toml --method oe --predictor "
          "basic --structure linear --process-noise --json OUT",
          loose=FREE_RUNS),
    # choices
    Fixed("chosen", "estimate calm.csv --vessel ship.toml --json OUT",
          loose=REFINED),
    Fixed("reduced", "estimate calm.csv --vessel ship.toml --method ls --predictor "
          "basic --structure linear+N_|r|r --reduce --json OUT",
          loose=LEAST_SQUARES),
    # runs
    Fixed("simulate-rk4", "simulate rk4.json wind.csv --out OUT", "out.csv", quick=True),
    Fixed("simulate-late", "simulate late.json current.csv --heading simulated --no-bands "
          "--out OUT", "out.csv", quick=True),
    Fixed("simulate-changes", "simulate changing.json current.csv --no-bands --out OUT",
          "out.csv", quick=True),
    Fixed("simulate-plan", "simulate blown.json plan.csv --start 1.5,1.2,0,0.2 --heading "
          "simulated --out OUT", "out.csv"),
    Fixed("compare", "compare plain.json other.json slow.json --log calm.csv second.csv "
          "--json OUT"),
    Fixed("compare-simulated", "compare rk4.json late.json --log wind.csv --heading simulated "
          "--no-bands --json OUT", quick=True),
    # what is wrong with a model
    Fixed("diagnose", "diagnose tracked.csv --vessel ship.toml --structure linear --causes "
          "current --json OUT"),
    # manoeuvres
    Fixed("predict-turning", "predict free.json turning --angle 20 --side port --command 12 "
          "--draws 40 --disturbed --current --no-limits --json OUT"),
    Fixed("predict-zigzag-trial", "predict rudder.json zigzag --trial zigzag.csv --draws 40 "
          "--json OUT"),
    # exports
    Fixed("export-c", "export late.json --to c --out OUT", "ship.c"),
    Fixed("export-casadi", "export late.json --to casadi --out OUT", "ship.casadi", quick=True),
    Fixed("export-mat", "export changing.json --to mat --settled --out OUT", "ship.mat",
          quick=True),
    Fixed("export-json", "export blown.json --to json --out OUT", "ship.json", quick=True),
    Fixed("export-fmu", "export slow.json --to fmu --no-binary --out OUT", "ship.fmu",
          quick=True),
    # designs
    Fixed("design-iv", "design --vessel ship.toml --model plain.json --duration 100 --predictor "
          "basic --regime u+v+ --margin-u 0.5 --margin-v 0.4 --start 1.5,1.2,0,0 --effort 0.05 "
          "--workers 1 --out plan_of_design.csv --json OUT",
          loose=CERTIFIED),
    Fixed("design-oe", "design --vessel ship.toml --model surge.json --duration 60 --estimator "
          "oe --criterion A --effort 0.05 --workers 1 --out plan_of_design.csv --json OUT",
          loose=CERTIFIED),
    Fixed("design-between", "design --vessel ship.toml --between plain.json other.json "
          "--duration 80 --regime u+v+ --start 1.5,1.2,0,0 --effort 0.05 --workers 1 --out "
          "plan_of_design.csv --json OUT",
          loose=REFITTED),
)  # fmt: skip


def run(fixed: Fixed, folder: Path) -> Numbers:
    """Run a command where its inputs are and return its numbers by their place."""
    from greybox.commands.main import main

    words = fixed.words.replace("OUT", fixed.out).split()
    with chdir(folder), redirect_stdout(StringIO()):
        status = main([*words, "--no-config", "--quiet"])
    if status:
        raise RuntimeError(f"'greybox {fixed.words}' ended with status {status}")
    return _READERS[Path(fixed.out).suffix](folder / fixed.out)


def _numbers(data: Any, key: str = "") -> Any:
    """Return the numbers of a JSON value, lists of numbers or of rows of them flat, else None."""
    if isinstance(data, dict):
        kept = {k: _numbers(v, k) for k, v in data.items() if k not in _PASSING}
        return {k: v for k, v in kept.items() if v is not None} or None
    if isinstance(data, list):
        flat = _flat(data)
        if flat is None:
            return _numbers({str(i): v for i, v in enumerate(data)})
        return _thinned(_correlation(flat) if key == "covariance" else flat)
    return float(data) if isinstance(data, int | float) else None


def _flat(data: list[Any]) -> list[float] | None:
    if data and all(v is None or isinstance(v, int | float) for v in data):
        return [np.nan if v is None else float(v) for v in data]
    rows = [_flat(v) if isinstance(v, list) else None for v in data]
    found = [row for row in rows if row is not None]
    return [v for row in found for v in row] if found and len(found) == len(rows) else None


def _correlation(covariance: list[float]) -> list[float]:
    """Return the correlations, which are of one size; the standard errors stand beside them."""
    n = round(len(covariance) ** 0.5)
    matrix = np.array(covariance).reshape(n, n)
    std = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    std[std == 0] = 1.0
    return [float(v) for v in (matrix / np.outer(std, std)).ravel()]


def _thinned(values: Any) -> list[float]:
    row = np.asarray(values, float).ravel()
    if len(row) > _LONGEST:
        row = row[np.linspace(0, len(row) - 1, _KEPT).round().astype(int)]
    return [float(v) for v in row]


def _json(path: Path) -> Numbers:
    return _numbers(json.loads(path.read_text())) or {}


def _csv(path: Path) -> Numbers:
    with path.open() as handle:
        return _table(list(csv.reader(handle)))


def _table(lines: list[list[str]]) -> Numbers:
    head, *rows = lines
    table = np.array([[float(v) if v else np.nan for v in row] for row in rows])
    return {name: _thinned(table[:, i]) for i, name in enumerate(head)}


def _mat(path: Path) -> Numbers:
    from scipy.io import loadmat

    def each(value: Any) -> Any:
        if isinstance(value, np.ndarray) and value.dtype.names:
            return {n: each(value[n]) for n in value.dtype.names}
        if isinstance(value, np.ndarray) and value.dtype == object:
            return {str(i): each(v) for i, v in enumerate(value.ravel())}
        numbers = isinstance(value, np.ndarray) and value.dtype.kind in "fiub" and value.size
        return _thinned(value) if numbers else {}

    return {n: each(v) for n, v in loadmat(path).items() if not n.startswith("__")}


def _fmu(path: Path) -> Numbers:
    """Return the start values of an FMU's variables."""
    with zipfile.ZipFile(path) as archive:
        tree = ElementTree.fromstring(archive.read("modelDescription.xml"))
    return {
        variable.get("name", ""): float(kind.get("start", ""))
        for variable in tree.iter("ScalarVariable")
        for kind in variable.iter("Real")
        if kind.get("start")
    }


def _casadi(path: Path) -> Numbers:
    """Return ten steps of every function from its own inputs, and the numbers beside it."""
    import casadi as ca

    side = json.loads(path.with_name(f"{path.stem}.casadi.json").read_text())

    rng = np.random.default_rng(1)
    p = np.array([row["value"] for row in side["p"]])
    found = {"beside": _numbers(side)}
    for name, entry in side["functions"].items():
        function = ca.Function.load(str(path.with_name(entry["file"])))
        sizes = [function.size1_in(i) for i in range(function.n_in())]
        steps = []
        for _ in range(10):
            given = [p if n == len(p) else rng.uniform(0.2, 1.2, n) for n in sizes]
            steps += [np.asarray(value).ravel() for value in function.call(given)]
        found[name] = _thinned(np.concatenate(steps))
    return found


def _c(path: Path) -> Numbers:
    """Return what the exported example prints for commands of a log, built by the compiler."""
    log = path.with_name("current.csv").read_text().splitlines()
    head = log[0].split(",")
    columns = [head.index(n) for n in ("n", "alpha1", "alpha2")]
    rows = [",".join(line.split(",")[i] for i in columns) for line in log]
    words = ["cc", "-std=c99", "-O0", "ship_example.c", "ship.c", "-lm", "-o", "ship"]
    subprocess.run(words, cwd=path.parent, check=True)
    start = ["1.5", "1.2", "0", "0.3", "10", "-5"]
    shown = subprocess.check_output(
        ["./ship", *start], input="\n".join(rows), cwd=path.parent, text=True,
        stderr=subprocess.DEVNULL,
    )  # fmt: skip
    return _table(list(csv.reader(shown.splitlines())))


_READERS: dict[str, Callable[[Path], Numbers]] = {
    ".json": _json, ".csv": _csv, ".mat": _mat, ".fmu": _fmu, ".casadi": _casadi, ".c": _c,
}  # fmt: skip


def difference(got: Any, want: Any) -> tuple[float, str]:
    """Return the greatest relative difference and its place.

    Numbers that are nearly nothing, beside the others of their list or beside
    `_NOTHING`, are held against that; a place that is missing is infinitely
    far, and further ones are free.
    """
    if isinstance(want, dict):
        if not isinstance(got, dict):
            return np.inf, ""
        each = [(difference(got.get(k), v), k) for k, v in want.items()]
        (worst, where), key = max(each, key=lambda e: e[0][0], default=((0.0, ""), ""))
        return worst, f"/{key}{where}" if worst else ""
    old, new = np.atleast_1d(want).astype(float), np.atleast_1d(got)
    if got is None or isinstance(got, dict) or new.shape != old.shape:
        return np.inf, ""
    new = new.astype(float)
    if (np.isnan(new) != np.isnan(old)).any():
        return np.inf, ""
    old, new = np.nan_to_num(old), np.nan_to_num(new)
    size = np.maximum(np.abs(old), max(_BESIDE * np.abs(old).max(initial=0.0), _NOTHING))
    apart = np.abs(new - old) / size
    i = int(apart.argmax()) if len(apart) else 0
    return float(apart.max(initial=0.0)), f"[{i}]" if len(apart) > 1 else ""


def beyond(fixed: Fixed, got: Numbers, want: Numbers) -> list[str]:
    """Return what differs by more than a command's tolerances, one sentence a key."""
    out = []
    for key, value in want.items():
        apart, where = difference(got.get(key), value)
        if apart > fixed.loose.allowed(key):
            allowed = fixed.loose.allowed(key)
            out.append(f"/{key}{where} is off by {apart:.1e}, {allowed:.0e} is allowed")
    return out


def read_expected() -> dict[str, Numbers]:
    """Return the expected numbers of every command."""
    return dict(json.loads(EXPECTED.read_text())) if EXPECTED.is_file() else {}


def _rounded(data: Any) -> Any:
    """Return numbers to the digits that count, what is none as None."""
    if isinstance(data, dict):
        return {k: _rounded(v) for k, v in data.items()}
    if isinstance(data, list):
        return [_rounded(v) for v in data]
    return None if data is None or np.isnan(data) else float(f"{data:.{_DIGITS}g}")


def write_expected(found: dict[str, Numbers]) -> None:
    """Write the numbers of every command, each key of its result on a line."""
    text = ",\n".join(
        f'"{name}": {{\n'
        + ",\n".join(f" {json.dumps(k)}: {json.dumps(_rounded(v))}" for k, v in places.items())
        + "\n}"
        for name, places in found.items()
    )
    EXPECTED.write_text("{\n" + text + "\n}\n")


def _count(data: Any) -> int:
    if isinstance(data, dict):
        return sum(map(_count, data.values()))
    return len(data) if isinstance(data, list) else 1


def _main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="commands (all)")
    parser.add_argument("--write", action="store_true", help="take their numbers as expected")
    options = parser.parse_args()
    expected = read_expected()
    with TemporaryDirectory() as name:
        folder = Path(name)
        write_inputs(folder)
        for fixed in COMMANDS:
            if options.names and fixed.name not in options.names:
                continue
            begun = time.process_time()
            found = run(fixed, folder)
            seconds = time.process_time() - begun
            want = expected.get(fixed.name, {})
            apart, where = difference(found, want)
            off = "  " + "; ".join(beyond(fixed, found, want))
            count = _count(found)
            print(f"{fixed.name:24}{seconds:6.1f} s{count:7} numbers  {apart:.1e} {where}{off}")
            if options.write:
                expected[fixed.name] = found
    if options.write:
        write_expected({f.name: expected[f.name] for f in COMMANDS if f.name in expected})


if __name__ == "__main__":
    _main()
