"""The rows of `python -m benchmarks`: what is timed, and against what."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from statistics import median
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from greybox.estimation.informative import regime_of
from greybox.model.catalogue import get_structure
from greybox.model.run.kernels import FreeRunKernel, FreeRunStep
from greybox.model.run.simulation import simulate
from greybox.model.run.step import StepModel
from greybox.study.chapter6 import START, TRUE, pulse_forces
from greybox.study.efficiency import CASES, SENSOR_VARIANCE, virtual_trial

Array = NDArray[np.float64]
Work = Callable[[], object]

# calls of each that are timed; a median of three has a neighbour on each side
REPEATS = 3
# seconds that one timing lasts at least, many times what the system takes away for other processes
_LONG_ENOUGH = 0.05

# steps after which a free run is compiled, where there is a compiler
_COMPILES = 10**6

STRUCTURE = get_structure("thesis")
THETA = np.array([TRUE[n] for n in STRUCTURE.parameters])


@dataclass(frozen=True)
class Timing:
    """Seconds of several calls."""

    median: float
    shortest: float
    longest: float

    @classmethod
    def of(cls, seconds: list[float]) -> Timing:
        return cls(median(seconds), min(seconds), max(seconds))

    def __str__(self) -> str:
        return f"{self.median:.3g} ({self.shortest:.3g}-{self.longest:.3g})"


@dataclass(frozen=True)
class Row:
    """One work at one size, here and by an alternative.

    Parameters
    ----------
    name : str
        Of the row, a key of `ROWS`.
    size : float
        How much work, in `unit`.
    alternative : str
        What else does the same work.
    ours, theirs : Timing or None
        None where the alternative is not installed.
    ratio : float or None
        Median of theirs over median of ours; above 1 this package is faster.
    note : str
        How far the results agree, or how to install what is missing.
    """

    name: str
    size: float
    unit: str
    alternative: str
    ours: Timing | None = None
    theirs: Timing | None = None
    ratio: float | None = None
    note: str = ""


def seconds(work: Work, calls: int = 1) -> float:
    """Return the wall time of one call, the mean of several in a row."""
    began = time.perf_counter()
    for _ in range(calls):
        work()
    return (time.perf_counter() - began) / calls


def calls_of(work: Work) -> int:
    """Call a work for the first time, and return how many calls are long enough to be timed."""
    # the first call may have compiled
    once = seconds(work)
    return 1 if once > 20 * _LONG_ENOUGH else max(1, round(_LONG_ENOUGH / seconds(work)))


def compare(
    name: str,
    size: float,
    unit: str,
    ours: Work,
    others: Mapping[str, tuple[Work, str]],
    note: Callable[[str], str] = lambda _: "",
) -> Iterator[Row]:
    """Yield one row an alternative, all called in turn after a first call of each.

    Parameters
    ----------
    others : mapping
        The alternative's name to its work, which raises ImportError where it is not installed,
        and to the command that installs it. What it raises else is told as its failure.
    note : callable
        Of the alternative's name, asked after all calls.
    """
    calls = {"": calls_of(ours)}
    works, missing = {"": ours}, {}
    for n, (work, command) in others.items():
        try:
            calls[n] = calls_of(work)
        except ImportError as reason:
            missing[n] = f"not installed: {command} ({reason})" if command else str(reason)
        except Exception as reason:
            missing[n] = f"failed: {type(reason).__name__}: {reason}"
        else:
            works[n] = work
    taken: dict[str, list[float]] = {n: [] for n in works}
    for _ in range(REPEATS):
        for n, work in works.items():
            taken[n].append(seconds(work, calls[n]))
    mine = Timing.of(taken[""])
    for n in others:
        if n in missing:
            yield Row(name, size, unit, n, note=missing[n])
        else:
            its = Timing.of(taken[n])
            yield Row(name, size, unit, n, mine, its, its.median / mine.median, note(n))


def apart(one: Array, other: Array) -> float:
    """Return the largest difference, relative to the largest number."""
    return float(np.max(np.abs(one - other)) / np.max(np.abs(one)))


def thesis_loop(th: Array, tau: Array, start: Array, out: Array) -> None:
    """Fill `out` (N+1, 4) with a free run in still water and air, one statement an equation."""
    u, v, r, psi = start[0], start[1], start[2], 0.0
    out[0, 0], out[0, 1], out[0, 2], out[0, 3] = u, v, r, psi
    for k in range(len(tau)):
        tx, ty, tn = tau[k, 0], tau[k, 1], tau[k, 2]
        au, av = abs(u), abs(v)
        du = (th[0] + (th[2] + th[3]) * au + th[5] * tx) * u + th[1] * v * r + th[4] * tx
        dv = (th[6] + (th[8] + th[10]) * av) * v + (th[7] * u + th[9] * av) * r + th[11] * ty
        dr = (th[12] + th[15] * av) * r + (th[13] + th[16]) * u * v + th[14] * av * v + th[17] * tn
        psi += r
        u, v, r = u + du, v + dv, r + dr
        out[k + 1, 0], out[k + 1, 1], out[k + 1, 2], out[k + 1, 3] = u, v, r, psi


def free_run(samples: int) -> Iterator[Row]:
    """Time a run of the thesis's ship, heading simulated.

    The difference equations by a loop and by Numba, which is compared with the bare loop here too;
    the differential equations between samples by `solve_ivp` at its default tolerance, which must
    not step over a change of the command, against the Runge-Kutta rule here. Both steps are machine
    code by then, as Numba's loop is.
    """
    for rule in ("euler", "rk4"):
        simulate(STRUCTURE, THETA, START, pulse_forces(_COMPILES), 1.0, integrator=rule)
    tau = pulse_forces(samples)
    loop, compiled, ivp = "loop over NumPy arrays", "numba", "scipy.integrate.solve_ivp"
    found: dict[str, Array] = {}
    made: list[Callable[..., None]] = []
    kernel = FreeRunKernel(FreeRunStep(StepModel.free(STRUCTURE, "euler")).function, samples)
    kernel.start[:3], kernel.read[:] = START, tau
    kernel.constants = [THETA, np.ones(1)]

    def bare() -> None:
        found["here"] = np.empty((samples + 1, 4))
        found["here"][0] = kernel.start
        kernel(found["here"][1:])

    def here(rule: Literal["euler", "rk4"] = "euler") -> None:
        run = simulate(STRUCTURE, THETA, START, tau, 1.0, integrator=rule)
        found["here"] = np.column_stack([run.x[0], run.psi[0]])

    def by_loop() -> None:
        found[loop] = np.empty((samples + 1, 4))
        thesis_loop(THETA, tau, START, found[loop])

    def by_numba() -> None:
        if not made:
            import numba

            made.append(numba.njit(thesis_loop))
        found[compiled] = np.empty((samples + 1, 4))
        made[0](THETA, tau, START, found[compiled])

    def by_ivp() -> None:
        from scipy.integrate import solve_ivp

        out = np.empty((2, 4))

        def slope(t: float, x: Array) -> Array:
            k = min(int(t), samples - 1)
            thesis_loop(THETA, tau[k : k + 1], x[:3], out)
            out[1, :3] -= x[:3]
            return out[1]

        t = np.arange(samples + 1.0)
        x0 = np.array([*START, 0.0])
        found[ivp] = solve_ivp(slope, (0.0, t[-1]), x0, t_eval=t, max_step=1.0).y.T

    def agreement(name: str) -> str:
        return f"apart by {apart(found['here'], found[name]):.0e}"

    discrete = {loop: (by_loop, ""), compiled: (by_numba, 'pip install ".[bench]"')}
    yield from compare("free-run", samples, "samples", here, discrete, agreement)
    alone = {f"{compiled}, loops alone": discrete[compiled]}
    yield from compare("free-run", samples, "samples", bare, alone, lambda _: agreement(compiled))
    yield from compare(
        "free-run", samples, "samples", lambda: here("rk4"), {ivp: (by_ivp, "")}, agreement
    )


def iv(samples: int) -> Iterator[Row]:
    """Two-stage least squares of all three equations, with covariances robust to the variance."""
    from greybox.estimation.covariance import score_covariance
    from greybox.estimation.normal_equations import solve_stacked
    from greybox.model.predictor import build_predictor
    from greybox.regression.instruments import build_instruments
    from greybox.regression.regression import build_regression

    log = virtual_trial(np.random.default_rng(0), CASES[0], samples)
    predictor = build_predictor(STRUCTURE, "wind", regime_of([log], STRUCTURE))
    (e,) = build_regression(predictor, [log]).experiments
    (z,) = build_instruments(predictor, [log], THETA).z
    equations = []
    for row, state in enumerate(STRUCTURE.states):
        mine = predictor.equation(state)
        # linearmodels does not scale; with columns of unit size both lose no digits
        columns = [x[mine] / x[mine].std(axis=1, keepdims=True) for x in (e.phi, z)]
        equations.append((e.y[row], *columns))
    name = "linearmodels IV2SLS"
    found: dict[str, list[Array]] = {}

    def here() -> None:
        found["here"] = []
        for y, phi, z in equations:
            solution = solve_stacked([z], [phi], [y])
            errors = y - solution.theta @ phi
            middle, _ = score_covariance([solution.projected], [[errors]], "white")
            inverse = np.linalg.inv(solution.information)
            found["here"] += [solution.theta, inverse @ middle @ inverse]

    def there() -> None:
        from linearmodels.iv import IV2SLS

        found[name] = []
        for y, phi, z in equations:
            fit = IV2SLS(y, None, phi.T, z.T).fit(cov_type="robust", debiased=False)
            found[name] += [fit.params.to_numpy(), fit.cov.to_numpy()]

    def equal(_: str) -> str:
        pairs = list(zip(found["here"], found[name], strict=True))
        for mine, its in pairs:
            np.testing.assert_allclose(mine, its, rtol=1e-8, atol=1e-8 * np.abs(its).max())
        off = max(apart(*pair) for pair in pairs)
        return f"coefficients and covariances apart by {off:.0e}"

    others = {name: (there, 'pip install ".[bench]"')}
    yield from compare("iv", samples, "samples", here, others, equal)


def output_error(samples: int) -> Iterator[Row]:
    """Least squares of the errors of a free run: 18 coefficients, the current, the first state.

    All have the same errors and weights, and begin at one-step least squares. SciPy takes finite
    differences of this package's free run, and of one that Numba compiled, with its own tolerances.
    """
    from benchmarks.output_error import Problem, least_squares_start, simulator
    from greybox.estimation.free_run import fit_free_runs
    from greybox.estimation.output_setup import measured, output_model, output_predictor
    from greybox.model.run.output_runs import Simulator

    sigma = np.full(3, np.sqrt(SENSOR_VARIANCE))
    log = virtual_trial(np.random.default_rng(0), CASES[0], samples)
    predictor = output_predictor(STRUCTURE, "wind", regime_of([log], STRUCTURE))
    model = output_model(predictor, log.sample_time)
    data = measured(model, log)
    start = least_squares_start(model, [data])
    runs = Simulator(model, data.w[None])
    plain, compiled = "SciPy least_squares, our run", "SciPy least_squares, numba's run"
    costs: dict[str, float] = {}
    made: list[Callable[[Array, Array, Array], Array]] = []

    def same(z0: Array, w: Array, p: Array) -> Array:
        return runs(z0[None], p)[0][0]

    def here() -> None:
        costs["here"] = fit_free_runs(model, [data], start, sigma=sigma)[0].cost

    def by_ours() -> None:
        costs[plain] = Problem(model, [data], sigma, same).scipy(start).cost

    def by_numba() -> None:
        if not made:
            made.append(simulator(model))
        costs[compiled] = Problem(model, [data], sigma, made[0]).scipy(start).cost

    def higher(name: str) -> str:
        more = costs[name] / costs["here"] - 1
        # their own tolerances end within this of the same cost
        end = "the same minimum" if abs(more) < 1e-6 else "not the same minimum"
        return f"{end}: its cost over ours less 1 is {more:.0e}"

    others = {
        plain: (by_ours, ""),
        compiled: (by_numba, 'pip install ".[bench-output-error]"'),
    }
    yield from compare("output-error", samples, "samples", here, others, higher)


def monte_carlo(runs: int) -> Iterator[Row]:
    """Chapter 6: six estimators on runs in light and in strong wind, 500 samples each.

    All in one process; `greybox reproduce` uses every processor. What a loop over runs takes is
    that of one run of each wind times their number.
    """
    from benchmarks.chapter6 import agree, by_numpy, data_by_numpy
    from greybox.study.chapter6 import reproduce_chapter6

    samples, most = 500, 64
    tau = pulse_forces(samples)
    off = agree(samples)

    def vectorised(runs: int) -> None:
        for wind in (1, 10):
            for first in range(0, runs, most):
                size = min(most, runs - first)
                by_numpy(data_by_numpy(first, size, samples, wind, tau))

    def here() -> None:
        reproduce_chapter6(runs, samples=samples, fit_runs=0, workers=1)

    others = {"NumPy over runs": (lambda: vectorised(runs), "")}
    note = f"estimates apart by {off:.0e}"
    (row,) = compare("monte-carlo", runs, "runs", here, others, lambda _: note)
    yield row
    assert row.ours is not None
    loop = Timing.of([runs * seconds(lambda: vectorised(1)) for _ in range(REPEATS)])
    yield Row(
        "monte-carlo", runs, "runs", "NumPy, one run at a time", row.ours, loop,
        loop.median / row.ours.median, f"{runs} times the time of one run",
    )  # fmt: skip


def design(intervals: int) -> Iterator[Row]:
    """Time the D-optimal input of surge, held in N intervals; IPOPT here and in Pyomo.DoE."""
    from benchmarks.design import information, middle, ours, pydex, pyomo_doe, sequences

    given = sequences(intervals)
    first, candidates = middle(intervals), given[:20]
    found: dict[str, Any] = {}
    how = 'pip install ".[bench-design]"'

    def work(name: str, *makes: Callable[[], Any]) -> tuple[Work, str]:
        def made() -> None:
            found[name] = max((make() for make in makes), key=lambda r: r.logdet)

        return made, how

    def said(name: str) -> str:
        mine, its = found["here"], found[name]
        check = information(mine.u)
        assert abs(check - mine.logdet) < 1e-4, (check, mine.logdet)
        return f"log det here {mine.logdet:.3f}, it {its.logdet:.3f}; {its.note}"

    def doe(start: Array) -> Callable[[], Any]:
        return lambda: pyomo_doe(intervals, start)

    one, two, weighed = "Pyomo.DoE, one start", "Pyomo.DoE, two starts", "pydex, of 20 sequences"
    here, _ = work("here", lambda: ours(intervals, False))
    others = {one: work(one, doe(first))}
    yield from compare("design", intervals, "intervals", here, others, said)
    here, _ = work("here", lambda: ours(intervals, True))
    others = {
        two: work(two, doe(first), doe(given[0])),
        weighed: work(weighed, lambda: pydex(intervals, candidates)),
    }
    yield from compare("design", intervals, "intervals", here, others, said)


def diagnosis(samples: int) -> Iterator[Row]:
    """Scoring every cause and refitting the promising ones, against refitting every cause.

    A step of the search of `diagnose`, of a log with a thruster that follows late.
    """
    from greybox.diagnosis.preparing import prepare
    from greybox.diagnosis.refitting import refit, shortlist
    from greybox.diagnosis.scores import ProjectedScores, Score, score_hypotheses
    from greybox.study.blind import draw

    trial = draw(np.random.default_rng(1), ("thruster_lag",), size=2.0)
    ready = prepare([trial.estimation.window(0, samples)], [], None, "thesis", None)
    base = ready.base()
    problem = ready.case.problem(base.integrator)
    near = [h for h in ready.hypotheses if not h.refit_from_scratch]
    name = f"refit of all {len(near)} causes"
    best: dict[str, str] = {}

    def likeliest(of: str, scores: list[Score]) -> None:
        best[of] = min((refit(problem, base, s).cost, s.hypothesis.key) for s in scores)[1]

    def here() -> None:
        likeliest("here", shortlist(score_hypotheses(ProjectedScores(problem, base), near)))

    def there() -> None:
        likeliest(name, [Score(h, np.empty(0), 0.0) for h in near])

    def same(_: str) -> str:
        return f"likeliest here {best['here']}, it {best[name]}"

    yield from compare("diagnosis", samples, "samples", here, {name: (there, "")}, same)


def noise_levels(samples: int) -> Iterator[Row]:
    """Nine levels of sensors and of process noise with a memory, by exact slopes and without."""
    from benchmarks.noise_levels import draw, fit

    likelihood, name = draw(samples), "SciPy's finite differences"
    found: dict[str, Any] = {}

    def here() -> None:
        found["here"] = fit(likelihood, exact=True)

    def there() -> None:
        found[name] = fit(likelihood, exact=False)

    def ends(_: str) -> str:
        mine, its = found["here"], found[name]
        return f"loss here {mine.fun:.4f} in {mine.nit} steps, it {its.fun:.4f} in {its.nit}"

    yield from compare("noise-levels", samples, "samples", here, {name: (there, "")}, ends)


def raw_import(megabytes: int) -> Iterator[Row]:
    """`greybox import` in a process of its own, with all checks, against what only reads.

    pandas reads and writes the table, pynmea2 reads lines and keeps nothing, both in this process.
    """
    import resource
    import tempfile
    from pathlib import Path

    import pandas as pd

    from benchmarks.import_speed import run_import, with_pynmea2, write_nmea, write_tables

    def memory(_: str) -> str:
        most = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
        return f"imports so far took at most {most:.2f} GiB of memory"

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        csv, parquet = write_tables(folder, megabytes)
        # a sentence has some 25 characters: files of a quarter of the table's size
        nmea, other = write_nmea(folder / "raw.nmea", 10_000 * megabytes), folder / "other"
        install = 'pip install ".[bench]"'
        cases: list[tuple[Path, str, str, Work, str]] = [
            (csv, "log.csv", "pandas read_csv, to_csv",
             lambda: pd.read_csv(csv).to_csv(other, index=False), ""),
            (parquet, "log.parquet", "pandas read_parquet, to_parquet",
             lambda: pd.read_parquet(parquet).to_parquet(other, index=False), ""),
            (nmea, "log.csv", "pynmea2.parse", lambda: with_pynmea2(nmea), install),
        ]  # fmt: skip
        for raw, out, alternative, work, how in cases:
            size = round(raw.stat().st_size / 1e6, 1)
            # import does not write over a log that stands
            path = folder / out
            mine = lambda raw=raw, path=path: (path.unlink(missing_ok=True), run_import(raw, path))
            yield from compare("import", size, "MB", mine, {alternative: (work, how)}, memory)


@dataclass(frozen=True)
class Rows:
    """Rows of one kind of work: at each size, and at larger ones where there is time."""

    at: Callable[[int], Iterator[Row]]
    quick: tuple[int, ...]
    more: tuple[int, ...]

    def __call__(self, full: bool) -> Iterator[Row]:
        return chain.from_iterable(map(self.at, self.quick + (self.more if full else ())))


ROWS = {
    "free-run": Rows(free_run, (1000, 5000, 50_000), (1_000_000,)),
    "iv": Rows(iv, (2000, 20_000), (200_000,)),
    "output-error": Rows(output_error, (5000, 10_000), (2000, 20_000)),
    "monte-carlo": Rows(monte_carlo, (16, 64), (256,)),
    "design": Rows(design, (25, 50), (100, 200)),
    "diagnosis": Rows(diagnosis, (300, 600), (1200,)),
    "noise-levels": Rows(noise_levels, (2000,), (20_000,)),
    "import": Rows(raw_import, (2, 8), (50,)),
}
