"""The rows of `python -m benchmarks`: what is timed, and against what."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.model.catalogue import get_structure
from greybox.model.run.simulation import simulate
from greybox.study.chapter6 import START, TRUE, pulse_forces

Array = NDArray[np.float64]

# calls of each that are timed; a median of three has a neighbour on each side
REPEATS = 3


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
    ratio : float
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


def seconds(work: Callable[[], object]) -> float:
    """Return the wall time of one call."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def compare(
    name: str,
    size: float,
    unit: str,
    ours: Callable[[], object],
    others: dict[str, Callable[[], Any] | str],
    note: Callable[[str], str] = lambda _: "",
    warm: bool = True,
) -> Iterator[Row]:
    """Yield one row an alternative, all called in turn.

    Parameters
    ----------
    others : dict
        The alternative's name to its work, or to the command that installs it.
    note : callable
        Of the alternative's name, asked after all calls.
    warm : bool
        Whether a first call of each is made and left out.
    """
    works = {n: w for n, w in others.items() if callable(w)}
    if warm:
        for work in (ours, *works.values()):
            work()
    here: list[float] = []
    there: dict[str, list[float]] = {n: [] for n in works}
    for _ in range(REPEATS):
        here.append(seconds(ours))
        for n, work in works.items():
            there[n].append(seconds(work))
    mine = Timing.of(here)
    for n, work in others.items():
        if isinstance(work, str):
            yield Row(name, size, unit, n, note=f"not installed: {work}")
        else:
            its = Timing.of(there[n])
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


def free_run(full: bool) -> Iterator[Row]:
    """A run of the thesis's ship, heading simulated.

    The difference equations by a loop and by Numba, the differential equations between samples by
    `solve_ivp` at its default tolerance, which is not to step over a change of the command.
    """
    from scipy.integrate import solve_ivp

    structure = get_structure("thesis")
    theta = np.array([TRUE[n] for n in structure.parameters])
    for samples in (1000, 5000, 50_000)[: 3 if full else 2]:
        tau = pulse_forces(samples)
        found: dict[str, Array] = {}

        def here(rule: Any = "euler", tau: Array = tau, found: dict[str, Array] = found) -> None:
            run = simulate(structure, theta, START, tau, 1.0, integrator=rule)
            found["here"] = np.column_stack([run.x[0], run.psi[0]])

        def loop(by: Callable[..., None], name: str, tau: Array = tau) -> Callable[[], None]:
            def work() -> None:
                found[name] = np.empty((len(tau) + 1, 4))
                by(theta, tau, START, found[name])

            return work

        others: dict[str, Callable[[], Any] | str] = {
            "loop over NumPy arrays": loop(thesis_loop, "loop over NumPy arrays")
        }
        try:
            import numba
        except ImportError:
            others["numba"] = 'pip install ".[bench]"'
        else:
            others["numba"] = loop(numba.njit(thesis_loop), "numba")
        agreement = lambda n, found=found: f"apart by {apart(found['here'], found[n]):.0e}"
        yield from compare("free-run", samples, "samples", here, others, agreement)

        def integrate(tau: Array = tau, found: dict[str, Array] = found) -> None:
            out = np.empty((2, 4))

            def slope(t: float, x: Array) -> Array:
                k = min(int(t), len(tau) - 1)
                thesis_loop(theta, tau[k : k + 1], x[:3], out)
                out[1, :3] -= x[:3]
                return out[1]

            t = np.arange(len(tau) + 1.0)
            x0 = np.array([*START, 0.0])
            found["scipy.integrate.solve_ivp"] = solve_ivp(
                slope, (0.0, t[-1]), x0, t_eval=t, max_step=1.0
            ).y.T

        smooth = lambda here=here: here("rk4")
        yield from compare(
            "free-run", samples, "samples", smooth, {"scipy.integrate.solve_ivp": integrate}, agreement
        )


def iv(full: bool) -> Iterator[Row]:
    """Two-stage least squares of all three equations, with covariances robust to the variance."""
    from greybox.estimation.covariance import score_covariance
    from greybox.estimation.informative import regime_of
    from greybox.estimation.normal_equations import solve_stacked
    from greybox.model.predictor import build_predictor
    from greybox.regression.instruments import build_instruments
    from greybox.regression.regression import build_regression
    from greybox.study.efficiency import CASES, virtual_trial

    structure = get_structure("thesis")
    theta = np.array([TRUE[n] for n in structure.parameters])
    for samples in (2000, 20_000, 200_000)[: 3 if full else 2]:
        log = virtual_trial(np.random.default_rng(0), CASES[0], samples)
        predictor = build_predictor(structure, "wind", regime_of([log], structure))
        (e,) = build_regression(predictor, [log]).experiments
        (z,) = build_instruments(predictor, [log], theta).z
        equations = []
        for row, state in enumerate(structure.states):
            mine = predictor.equation(state)
            phi, instruments = e.phi[mine], z[mine]
            # the solver of the other does not scale; columns of unit size are what it is meant for
            phi = phi / phi.std(axis=1, keepdims=True)
            instruments = instruments / instruments.std(axis=1, keepdims=True)
            equations.append((e.y[row], phi, instruments))
        found: dict[str, list[Array]] = {}

        def here(equations: Any = equations, found: dict[str, list[Array]] = found) -> None:
            found["here"] = []
            for y, phi, z in equations:
                solution = solve_stacked([z], [phi], [y])
                errors = y - solution.theta @ phi
                middle, _ = score_covariance([solution.projected], [[errors]], "white")
                inverse = np.linalg.inv(solution.information)
                found["here"] += [solution.theta, inverse @ middle @ inverse]

        name = "linearmodels IV2SLS"
        other: Callable[[], None] | str
        try:
            from linearmodels.iv import IV2SLS
        except ImportError:
            other = "pip install linearmodels"
        else:

            def other(equations: Any = equations, found: dict[str, list[Array]] = found) -> None:
                found[name] = []
                for y, phi, z in equations:
                    fit = IV2SLS(y, None, phi.T, z.T).fit(cov_type="robust", debiased=False)
                    found[name] += [fit.params.to_numpy(), fit.cov.to_numpy()]

        def equal(_: str, found: dict[str, list[Array]] = found) -> str:
            off = 0.0
            for mine, its in zip(found["here"], found[name], strict=True):
                np.testing.assert_allclose(mine, its, rtol=1e-8, atol=1e-8 * np.abs(its).max())
                off = max(off, apart(mine, its))
            return f"coefficients and covariances apart by {off:.0e}"

        yield from compare("iv", samples, "samples", here, {name: other}, equal)


ROWS: dict[str, Callable[[bool], Iterator[Row]]] = {"free-run": free_run, "iv": iv}
