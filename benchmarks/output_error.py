"""Output error by this package and by other tools: time, cost, and fit on logs not used.

Part one: the thesis's ship, 5000 samples, wind measured, current unknown, measured
heading as an input. Every tool gets the same model, unknowns (18 parameters, the
current, the first state) and log. The weights are one over the noise that our fit
found; the others are given them, ours has to find them. SciPy's least_squares runs on
a simulator compiled by Numba, with its default finite differences and tolerances
(1e-8 each of cost, step and gradient; ours stops at steps of 1e-6 standard errors).
jax-sysid runs Adam, then L-BFGS to its own stop, on parameters scaled by the standard
errors that ours found, a help that a user would not have. pysindy regresses the next
state on measured ones: equation error, which cannot hold the current as one unknown.

Part two: models estimated on some logs of $GREYBOX_DATA, run freely on others (6.12),
which start from their first samples and know nothing else of the motion. SciPy is
given our weights, and, as one would without them, the deviation of each output. Our own
choice is what `greybox estimate` without --method ends with.

Times are medians of `--repeats` runs after a first one, whose time with compilation
stands beside them.

    pip install ".[bench-output-error]"
    python -m benchmarks.output_error [--samples 5000] [--repeats 3]
    python -m benchmarks.output_error --held-out-only [--logs esso_osaka ...]
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from statistics import median

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.stats import t as student

import greybox as gb
from benchmarks.held_out import DATA, SHIPS
from benchmarks.held_out_logs import AZIMUTHS
from greybox.errors import GreyboxError
from greybox.estimation.free_run import fit_free_runs
from greybox.estimation.informative import regime_of
from greybox.estimation.output_error import OutputErrorOptions, estimate_oe
from greybox.estimation.output_setup import measured, output_model, output_predictor
from greybox.estimation.result import Estimate
from greybox.estimation.shooting import Measured
from greybox.model.catalogue import get_structure, structure_for
from greybox.model.model import ManoeuvringModel
from greybox.model.output import OutputModel
from greybox.model.predictor import build_predictor
from greybox.selection.estimate import estimate_requested
from greybox.selection.fit_single import estimate_iv, estimate_ls
from greybox.selection.request import Request
from greybox.study.chapter6 import TRUE
from greybox.study.efficiency import CASES, CURRENT, virtual_trial
from greybox.trial.convert.read import read_segments
from greybox.trial.kinematics import decimate
from greybox.trial.log import TrialLog
from greybox.trial.store import write_log
from greybox.validation.fit import average_fit, run_model
from greybox.vessel.force import force_inputs

Array = NDArray[np.float64]

OPTIONS = OutputErrorOptions(heading="input")
# what a diverged run counts, in noise deviations
_ESCAPED = 1e6


def expressions(model: OutputModel) -> list[str]:
    """Return each column's regressor as a Python expression of the signals."""
    structure = model.predictor.structure
    terms = [structure.terms[structure.index(c.terms[0])] for c in model.columns]
    return [
        "*".join(f"abs({f.signal})" if f.modulus else f.signal for f in t.factors) for t in terms
    ]


def step_function(model: OutputModel, arrays) -> Callable:
    """Return ``step(x, w, p) -> x⁺`` as a plain function, for a compiler to take."""
    states = model.states
    lines = [f"{n} = x[{i}]" for i, n in enumerate(states)]
    lines += [f"{n} = w[{i}]" for i, n in enumerate(model.drivers)]
    after = dict.fromkeys(states, "")
    for i, (column, text) in enumerate(zip(model.columns, expressions(model), strict=True)):
        after[column.state] += f" + p[{i}]*{text}"
    if "u_q" in model.drivers:
        lines += ["uq, vq = u_q, v_q"]
    else:
        lines += ["uq, vq = u, v"]
    moved = [f"{n}_0 = {n}" for n in states]
    if model.means:
        q = len(model.columns)
        lines += ["c, s = cos(psi), sin(psi)"]
        lines += [f"u, v = u - c*p[{q}] - s*p[{q + 1}], v + s*p[{q}] - c*p[{q + 1}]"]
    lines[len(states) : len(states)] = moved
    result = ", ".join(f"{n}_0{after[n]}" for n in states)
    body = "\n    ".join([*lines, f"return ({result})"])
    space = {"cos": arrays.cos, "sin": arrays.sin}
    exec(f"def step(x, w, p):\n    {body}\n", space)
    return space["step"]


def simulator(model: OutputModel) -> Callable[[Array, Array, Array], Array]:
    """Return the free run ``(z0, w, p) -> x``, compiled by Numba at its first call."""
    import numba

    step = numba.njit(step_function(model, np))

    @numba.njit
    def run(z0, w, p):
        out = np.empty((len(w), 3))
        x = (z0[0], z0[1], z0[2])
        for k in range(len(w)):
            out[k, 0], out[k, 1], out[k, 2] = x
            x = step(x, w[k], p)
        return out

    return run


@dataclass(frozen=True)
class Problem:
    """A model with its logs and weights: what every tool minimises.

    Unknown are the q parameters and each log's first state.
    """

    model: OutputModel
    data: Sequence[Measured]
    sigma: Array
    run: Callable[[Array, Array, Array], Array]

    def residuals(self, unknown: Array) -> Array:
        q = len(self.model.parameters)
        found = []
        for i, log in enumerate(self.data):
            y = self.run(unknown[q + 3 * i : q + 3 * i + 3], log.w, unknown[:q])
            with np.errstate(all="ignore"):
                found.append(((log.y - y) / self.sigma).ravel())
        errors = np.nan_to_num(np.concatenate(found), nan=_ESCAPED)
        return np.clip(errors, -_ESCAPED, _ESCAPED)

    def cost(self, unknown: Array) -> float:
        return float(0.5 * np.sum(self.residuals(unknown) ** 2))

    def first(self, p: Array) -> Array:
        return np.concatenate([p, *[log.y[0] for log in self.data]])

    def scipy(self, p: Array):
        return least_squares(self.residuals, self.first(p), method="trf", x_scale="jac")


def regression(model: OutputModel, logs: Sequence[Measured]) -> list[tuple[Array, Array, list]]:
    """Return regressors, increments and columns of each equation; no current."""
    found = []
    texts = expressions(model)
    for i, state in enumerate(model.states):
        columns = [j for j, c in enumerate(model.columns) if c.state == state]
        phi, y = [], []
        for log in logs:
            names = dict(zip(model.states, log.y[:-1].T, strict=True))
            names |= dict(zip(model.drivers, log.w[:-1].T, strict=True))
            names["uq"], names["vq"] = (
                names.get("u_q", names["u"]),
                names.get("v_q", names["v"]),
            )
            phi.append(np.column_stack([eval(texts[j], {"abs": np.abs}, names) for j in columns]))
            y.append(np.diff(log.y[:, i]))
        found.append((np.vstack(phi), np.concatenate(y), columns))
    return found


def least_squares_start(model: OutputModel, logs: Sequence[Measured]) -> Array:
    """Return one-step least squares (q,), the current 0."""
    p = np.zeros(len(model.parameters))
    for phi, y, columns in regression(model, logs):
        p[columns] = np.linalg.lstsq(phi, y, rcond=None)[0]
    return p


def pysindy_one_step(model: OutputModel, logs: Sequence[Measured]) -> Array:
    """Return pysindy's coefficients (q,): one discrete model an equation, nothing pruned."""
    import pysindy as ps

    names = [*model.states, *model.drivers]
    p = np.zeros(len(model.parameters))
    texts = expressions(model)
    given = ", ".join(names)
    air = "" if "u_q" in names else ", uq=None, vq=None"
    for i, state in enumerate(model.states):
        columns = [j for j, c in enumerate(model.columns) if c.state == state]
        functions = []
        for j in columns:
            text = texts[j]
            text = text.replace("uq", "u_q" if not air else "u")
            text = text.replace("vq", "v_q" if not air else "v")
            functions.append(eval(f"lambda {given}: {text}"))
        library = ps.CustomLibrary(
            library_functions=functions, interaction_only=True, include_bias=False
        )
        sindy = ps.DiscreteSINDy(
            feature_library=library, optimizer=ps.STLSQ(threshold=0.0, alpha=0.0, unbias=False)
        )
        sindy.fit(
            [log.y[:-1] for log in logs],
            t=model.sample_time,
            x_next=[np.diff(log.y[:, i])[:, None] for log in logs],
            u=[log.w[:-1] for log in logs],
        )
        p[columns] = sindy.coefficients()[0]
    return p


def jax_sysid(problem: Problem, p: Array, scale: Array) -> Array:
    """Return jax-sysid's unknowns, from `p` in units of `scale` (q + 3,); one log."""
    import jax
    import jax.numpy as jnp
    from jax_sysid.models import Model

    jax.config.update("jax_enable_x64", True)
    (log,) = problem.data
    step = step_function(problem.model, jnp)
    q, sigma = len(problem.model.parameters), jnp.array(problem.sigma)
    unit, unit_x = jnp.array(scale[:q]), jnp.array(scale[q:])
    model = Model(
        3, 3, log.w.shape[1],
        state_fcn=lambda x, u, th: jnp.stack(step(x * unit_x, u, th[0] * unit)) / unit_x,
        output_fcn=lambda x, u, th: x * unit_x / sigma,
    )  # fmt: skip
    model.init(params=[p / scale[:q]], x0=log.y[0] / scale[q:])
    model.loss(rho_x0=0.0, rho_th=0.0, train_x0=True, xsat=1e6)
    model.optimization(adam_epochs=200, lbfgs_epochs=3000, iprint=-1, memory=50)
    with contextlib.redirect_stdout(io.StringIO()):
        model.fit(log.y / problem.sigma, log.w)
    first = np.asarray(model.x0).ravel()
    return np.concatenate([np.asarray(model.params[0]) * scale[:q], first * scale[q:]])


def iv_start(log: TrialLog, model: OutputModel) -> Array:
    """Return this package's instrumental variables (q,), with the current they reveal."""
    structure = model.predictor.structure
    predictor = build_predictor(structure, "wind", regime_of([log], structure))
    found = estimate_iv(predictor, [log], wind="measured")
    values = dict(zip(structure.parameters, found.structure_theta(), strict=True))
    values |= {n: v for n, v, _ in found.current}
    return np.array([values[n] for n in [c.terms[0] for c in model.columns] + list(model.means)])


def timed(work: Callable, repeats: int) -> tuple[float, float, object]:
    """Return the first time, the median of the others, and the last result."""
    seconds = []
    for _ in range(repeats + 1):
        began = time.perf_counter()
        result = work()
        seconds.append(time.perf_counter() - began)
    return seconds[0], median(seconds[1:] or seconds), result


def parameters(estimate: Estimate) -> Array:
    return np.concatenate([estimate.theta, [v for _, v, _ in estimate.current]])


def our_problem(estimate: Estimate, logs: Sequence[TrialLog]) -> Problem:
    model = output_model(estimate.predictor, estimate.sample_time)
    data = [measured(model, log) for log in logs]
    return Problem(model, data, estimate.noise.measurement, simulator(model))


def optimum(problem: Problem, p: Array) -> Array:
    """Return our parameters with the first states that go with them.

    These are not in an estimate; with the parameters held they are a small problem.
    """
    q = len(p)
    fit = least_squares(
        lambda x: problem.residuals(np.concatenate([p, x])), problem.first(p)[q:],
        xtol=1e-12, ftol=1e-14, gtol=1e-14, x_scale="jac",
    )  # fmt: skip
    return np.concatenate([p, fit.x])


def speed(samples: int, repeats: int) -> None:
    """Print part one."""
    log = virtual_trial(np.random.default_rng(0), CASES[0], samples)
    structure = get_structure("thesis")
    predictor = output_predictor(structure, "wind", regime_of([log], structure))
    names = [c.name for c in predictor.columns]
    rows: list[tuple[str, str, float, float, float]] = []
    # the first estimate gives the weights that the others are given
    first, ours, estimate = timed(lambda: estimate_oe(predictor, [log], options=OPTIONS), repeats)
    problem = our_problem(estimate, [log])
    began = time.perf_counter()
    problem.residuals(problem.first(parameters(estimate)))
    compiled = time.perf_counter() - began
    best = optimum(problem, parameters(estimate))
    least = problem.cost(best)
    rows.append(("this package", "zero", first, ours, least))
    truth = np.array([*[TRUE[n] for n in names], *CURRENT])
    signs = np.random.default_rng(1).choice([-1.0, 1.0], len(truth))
    starts = {
        "zero": np.zeros(len(truth)),
        "least squares": least_squares_start(problem.model, problem.data),
        "our iv": iv_start(log, problem.model),
        "truth ±10 %": truth * (1 + 0.1 * signs),
    }
    order = [names.index(n) for n in structure.parameters]
    for name in ("least squares", "truth ±10 %"):
        first, seconds, found = timed(
            lambda p=starts[name]: estimate_oe(predictor, [log], start=p[order], options=OPTIONS),
            repeats,
        )
        cost = problem.cost(optimum(problem, parameters(found)))
        rows.append(("this package", name, first, seconds, cost))
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "trial.csv"
        write_log([log], path)
        command = [sys.executable, "-m", "greybox", "estimate", str(path)]
        command += ["--vessel", "thesis", "--method", "oe"]
        same = ["--structure", "thesis", "--predictor", "wind", "--heading", "measured"]
        for label, more in (("command, all chosen", []), ("command, same model", same)):
            first, seconds, _ = timed(
                lambda more=more: subprocess.run(
                    [*command, *more], check=True, capture_output=True
                ),
                repeats,
            )
            rows.append((label, "its own", first, seconds, float("nan")))
    notes = [f"Numba compiled in {compiled:.1f} s, outside SciPy's times"]
    for name, p in starts.items():
        first, seconds, fit = timed(lambda p=p: problem.scipy(p), repeats)
        rows.append(("SciPy on Numba", name, first, seconds, fit.cost))
        # the same task: weights given, no standard errors, no search for a start but from zero
        first, seconds, (alone, _) = timed(
            lambda p=p, near=name != "zero": fit_free_runs(
                problem.model, problem.data, p, sigma=problem.sigma, near=near
            ),
            repeats,
        )
        rows.append(("this package, fit alone", name, first, seconds, alone.cost))
        notes.append(f"our fit alone from {name}: {alone.iterations} steps, {alone.converged=}")
        notes.append(f"SciPy from {name}: {fit.nfev} steps, {fit.message}")
    std = np.sqrt(np.diag(estimate.covariance))
    scale = np.concatenate([std, [s for _, _, s in estimate.current], problem.sigma])
    try:
        for name, again in (("truth ±10 %", repeats), ("least squares", 0)):
            first, seconds, found = timed(
                lambda p=starts[name]: jax_sysid(problem, p, scale), again
            )
            rows.append(("jax-sysid", name, first, seconds, problem.cost(found)))
    except ImportError as reason:
        notes.append(f"jax-sysid skipped: {reason}")
    try:
        first, seconds, p = timed(lambda: pysindy_one_step(problem.model, problem.data), repeats)
        cost = problem.cost(optimum(problem, p))
        rows.append(("pysindy (equation error)", "none", first, seconds, cost))
    except ImportError as reason:
        notes.append(f"pysindy skipped: {reason}")
    print(f"{samples} samples, {len(best)} unknowns, load {os.getloadavg()[0]:.1f}")
    print(
        f"{'tool':<26}{'start':<16}{'first [s]':>10}{'median [s]':>11}{'ratio':>8}{'cost':>16}"
        f"{'cost/ours - 1':>15}"
    )
    for tool, start, first, seconds, cost in rows:
        print(
            f"{tool:<26}{start:<16}{first:>10.2f}{seconds:>11.3f}{seconds / ours:>8.2f}"
            f"{cost:>16.6f}{cost / least - 1:>15.1e}"
        )
    print("\n".join(notes))


@dataclass(frozen=True)
class Trials:
    """A vessel file, which logs of its folder, and a sample time [s]."""

    vessel: dict
    pattern: str
    sample_time: float


def _of(ship: str, sample_time: float) -> Trials:
    there = SHIPS[ship]
    return Trials(tomllib.loads(there.vessel), there.pattern, sample_time)


_TRIALS = {
    "esso_osaka": _of("esso", 1.0),
    "kvlcc2": _of("hsva", 0.5),
    "blueboat": _of("blueboat", 0.2),
    "milliampere1": Trials(
        {
            "name": "5 m ferry", "length": 5.0,
            "thruster": [
                {"type": "azimuth", "x": x, "y": y, "speed": f"rpm{i}", "angle": f"az{i}_deg",
                 "thrust": [[-948, -330], [-480, -80], [0, 0], [478, 135], [913, 425]]}
                for i, (x, y) in enumerate(AZIMUTHS, 1)
            ],
            "columns": {f"az{i}_deg": {"name": f"az{i}_deg", "unit": "deg"} for i in (1, 2, 3, 4)},
        },
        "*.csv",
        1.0,
    ),
}  # fmt: skip
# samples that a segment between gaps needs to count
_LEAST = 50


def read(folder: str) -> tuple[list[TrialLog], list[TrialLog]]:
    """Import the raw logs with the safe fixes; every second one is held out.

    Of a single log the last third is held out.
    """
    trials = _TRIALS[folder]
    vessel = gb.vessel_from_dict(trials.vessel)
    files: list[list[TrialLog]] = []
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "log.csv"
        for path in sorted((DATA / folder).glob(trials.pattern)):
            gb.import_files([str(path)], vessel, out, fix=True)
            segments = read_segments(out, vessel, states=("u", "v", "r"))
            slow = [decimate(log, trials.sample_time) for log in segments]
            files.append([log for log in slow if len(log) >= _LEAST])
    if len(files) == 1:
        (log,) = files[0]
        cut = 2 * len(log) // 3
        return [log.window(0, cut)], [log.window(cut, len(log))]
    return list(chain(*files[::2])), list(chain(*files[1::2]))


def with_theta(model: ManoeuvringModel, problem: Problem, p: Array) -> ManoeuvringModel:
    """Return `model` with other coefficients of the same columns."""
    values = {c.terms[0]: p[i] for i, c in enumerate(problem.model.columns)}
    return replace(model, theta=np.array([values.get(n, 0.0) for n in model.names]))


def chosen(logs: list[TrialLog], request: Request) -> ManoeuvringModel:
    """Return the model whose method is left open, and say how it was chosen."""
    estimate = estimate_requested(logs, request)
    print(f"\nown choice: {estimate.method}, {estimate.status}; {estimate.notes[-1]}")
    return estimate.model()


def of_logs(model: ManoeuvringModel, logs: Sequence[TrialLog]) -> Array:
    """Return the fit of each log's free run, mean over u, v and r (len(logs),) [%]."""
    return np.array([np.mean([run_model(model, log).fit[n] for n in "uvr"]) for log in logs])


def difference(one: Array, other: Array) -> str:
    """Return the mean paired difference over logs, and its 95 % interval by Student's t."""
    apart = one - other
    if len(apart) < 2 or not np.isfinite(apart).all():
        return ""
    half = float(student.ppf(0.975, len(apart) - 1) * apart.std(ddof=1) / np.sqrt(len(apart)))
    middle = float(apart.mean())
    return f"{middle:.1f} ({middle - half:.1f} to {middle + half:.1f}), {len(apart)} logs"


def held_out(folder: str, base: str, logs: list[TrialLog], others: list[TrialLog]) -> None:
    """Print the free-run fits of all tools' models on logs not used."""
    structure = structure_for(base, force_inputs(logs[0].vessel))
    regime = regime_of(logs, structure)
    windy = structure.uses_air and all(log.has_wind for log in [*logs, *others])
    kind = "basic+wind" if windy else "basic"
    predictor = output_predictor(structure, kind, regime)
    linear = build_predictor(structure, kind, regime)
    found: dict[str, tuple[float, ManoeuvringModel | str]] = {}

    def take(label: str, work: Callable[[], ManoeuvringModel]) -> None:
        began = time.perf_counter()
        try:
            model: ManoeuvringModel | str = work()
        except (GreyboxError, ImportError) as reason:
            model = str(reason)
        found[label] = time.perf_counter() - began, model

    began = time.perf_counter()
    try:
        estimate = estimate_oe(predictor, logs, options=OPTIONS)
    except GreyboxError as reason:
        print(f"\n{folder}, structure {base}: {reason}")
        return
    seconds = time.perf_counter() - began
    mine = estimate.model()
    found["this package, oe"] = seconds, mine
    problem = our_problem(estimate, logs)
    p = parameters(estimate)
    # a merged column's coefficient stands with its first term in all models
    assert np.allclose(with_theta(mine, problem, p).theta, mine.theta)
    start = least_squares_start(problem.model, problem.data)
    least = problem.cost(optimum(problem, p))
    found_costs = []

    def scipy(sigma: Array) -> ManoeuvringModel:
        fit = replace(problem, sigma=sigma).scipy(start)
        found_costs.append(problem.cost(fit.x))
        return with_theta(mine, problem, fit.x)

    size = np.concatenate([d.y for d in problem.data]).std(axis=0)
    asked = Request(structure=base, predictor=kind)
    take("this package, own choice", lambda: chosen(logs, asked))
    take("this package, iv", lambda: estimate_iv(linear, logs).model())
    take("this package, ls", lambda: estimate_ls(linear, logs).model())
    problem.residuals(problem.first(start))
    take("SciPy on Numba, our weights", lambda: scipy(problem.sigma))
    take("SciPy on Numba, by deviation", lambda: scipy(size))
    take(
        "pysindy (equation error)",
        lambda: with_theta(mine, problem, pysindy_one_step(problem.model, problem.data)),
    )
    print(
        f"\n{folder}, structure {base}, predictor {kind}: {len(start)} parameters, "
        f"{sum(map(len, logs))} samples of {len(logs)} logs to estimate from, "
        f"{sum(map(len, others))} of {len(others)} held out; ours {estimate.status}"
    )
    print(
        f"{'':<30}{'u':>9}{'v':>9}{'r':>9}{'mean':>9}{'median':>9}{'seconds':>10}  diverged  "
        f"own choice less it, 95 %"
    )
    own = found["this package, own choice"][1]
    best = None if isinstance(own, str) else of_logs(own, others)
    for label, (seconds, model) in found.items():
        if isinstance(model, str):
            print(f"{label:<30} {model}")
            continue
        fits = [run_model(model, log) for log in others]
        mean = average_fit(fits)
        # one log that diverges takes every mean with it
        middle = median(float(np.mean([f.fit[n] for n in "uvr"])) for f in fits)
        values = [*(mean[n] for n in "uvr"), float(np.mean([mean[n] for n in "uvr"])), middle]
        print(
            f"{label:<30}{''.join(f'{v:>9.1f}' for v in values)}{seconds:>10.2f}"
            f"  {sum(f.diverged >= 0 for f in fits)} of {len(fits)}"
            f"    {'' if best is None else difference(best, of_logs(model, others))}"
        )
    ratios = ", ".join(f"{c / least - 1:.1e}" for c in found_costs)
    print(f"cost of SciPy's models by our weights, over ours, less 1: {ratios}")


def main() -> None:
    parser = argparse.ArgumentParser(description="Output error against other tools.")
    parser.add_argument("--samples", type=int, default=5000)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--held-out-only", action="store_true")
    parser.add_argument("--logs", nargs="+", choices=sorted(_TRIALS), default=list(_TRIALS))
    options = parser.parse_args()
    if not options.held_out_only:
        speed(options.samples, options.repeats)
    for folder in options.logs:
        if not (DATA / folder).exists():
            print(f"no logs at {DATA / folder}: set GREYBOX_DATA")
            continue
        logs, others = read(folder)
        for base in ("linear", "thesis"):
            held_out(folder, base, logs, others)


if __name__ == "__main__":
    main()
