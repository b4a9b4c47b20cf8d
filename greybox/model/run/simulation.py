"""Free runs of a model on the inputs of a log, or of many ships at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.errors import DivergenceError, UsageError, so_many
from greybox.model.run.changes import Change, pieces, require_parameters
from greybox.model.run.kernels import MANY_RUNS, FreeRunKernel, FreeRunStep, OverRunsKernel
from greybox.model.run.step import Heading, Integrator, StepModel, held, integrated
from greybox.model.structure import Structure
from greybox.notebook import DisplayMixin, number, sparkline, table
from greybox.numerics.recursion import recursive
from greybox.rotation import body_to_ned

Array = NDArray[np.float64]


# runs stepped together: enough to hide the call, few enough to bound memory
_BATCH_RUNS = 256
_STEP_RUNS = 16


@dataclass(frozen=True, repr=False)
class FreeRun(DisplayMixin):
    """The result of a free run.

    Parameters
    ----------
    x : ndarray
        (R, N+1, nx) states [m/s, rad/s], initial state first.
    psi : ndarray
        (R, N+1) heading [rad]: simulated, or the measured one that was used.
    diverged : ndarray of int
        (R,) first sample outside the bound, −1 where the run stayed inside.
    bound : ndarray
        (nx,) the bound on each state's magnitude.
    """

    x: Array
    psi: Array
    diverged: NDArray[np.int64]
    bound: Array

    def summary(self) -> str:
        """Return the size of the runs, and the range of each state, as text."""
        rows = [f"  state {k}: {low} to {high}" for k, low, high, _ in self._rows()]
        return "\n".join([self._line(), *rows])

    def _line(self) -> str:
        runs, samples = self.x.shape[:2]
        gone = int((self.diverged >= 0).sum())
        return (
            f"{so_many(runs, 'free run')} of {samples - 1} steps, "
            f"{f'{gone} diverged' if gone else 'none diverged'}"
        )

    def _parts(self) -> tuple[str, ...]:
        return (table(("state", "least", "most", "first run"), self._rows()),)

    def _rows(self) -> list[tuple[int, str, str, str]]:
        return [
            (k, number(float(x.min())), number(float(x.max())), sparkline(x[0]))
            for k, x in enumerate(np.moveaxis(self.x, 2, 0))
        ]

    def require_bounded(self, states: tuple[str, ...], what: str) -> None:
        """Raise if some run diverged.

        Raises
        ------
        DivergenceError
            Names the state, the sample and the bound.
        """
        if (self.diverged < 0).all():
            return
        run = int(np.flatnonzero(self.diverged >= 0)[0])
        k = int(self.diverged[run])
        size = np.abs(self.x[run, k])
        worst = int(np.argmax(np.where(np.isfinite(size), size / self.bound, np.inf)))
        raise DivergenceError(
            f"{what} diverged: |{states[worst]}| passed {self.bound[worst]:.3g} at sample {k} "
            f"of {self.x.shape[1] - 1}. Estimate with another method or structure, "
            f"or on a log with more excitation."
        )


def simulate(
    structure: Structure,
    theta: Array,
    x0: Array,
    tau: Array,
    sample_time: float,
    *,
    psi: Array | None = None,
    psi0: Array | float = 0.0,
    d: Array | None = None,
    air: Array | None = None,
    process_noise: Array | None = None,
    integrator: Integrator = "euler",
    bound: Array | None = None,
    changes: Sequence[Change] = (),
    first: float = 0.0,
) -> FreeRun:
    """Run one or many ships freely from their initial states.

    Parameters
    ----------
    structure : Structure
    theta : ndarray
        (p,) or (R, p) discrete parameters at `sample_time`.
    x0 : ndarray
        (nx,) or (R, nx) initial states [m/s, rad/s].
    tau : ndarray
        (N, nu) or (R, N, nu) generalised inputs, held over each sample.
    sample_time : float
        Ts [s].
    psi : ndarray, optional
        (N+1,) or (R, N+1) measured heading [rad]; without it the heading is simulated.
    psi0 : float or ndarray
        Scalar or (R,) initial heading of a simulated one [rad].
    d : ndarray, optional
        (nd,), (N, nd) or (R, N, nd) disturbances [m/s]: constant, or a series
        such as `stationary_disturbance` gives. None: still water and air.
    air : ndarray, optional
        (N, 2) or (R, N, 2) measured velocity through the air [m/s].
    process_noise : ndarray, optional
        (N, nx) or (R, N, nx) noise added to each next state, w of (4.1a).
    integrator : {"euler", "rk4"}
    bound : ndarray, optional
        (nx,) magnitude past which a state counts as diverged.
    changes : sequence of Change
        Of parameters on the way; each acts from the first sample that is not before it.
    first : float
        Time of the first sample on the clock of the changes [s].

    Returns
    -------
    FreeRun
        R = 1 when no argument has runs.

    Raises
    ------
    UsageError
        The shapes of two arguments do not fit each other.
    StructureError
        A change is of no parameter of the structure.
    """
    require_parameters(changes, structure.parameters, structure.name)
    theta, x0 = np.atleast_1d(np.asarray(theta, float)), np.atleast_1d(np.asarray(x0, float))
    tau = np.asarray(tau, float)
    nx = len(structure.states)
    samples = tau.shape[-2] if tau.ndim > 1 else 0
    runs = _common_runs(
        {
            "theta": (theta, (len(structure.parameters),)),
            "x0": (x0, (nx,)),
            "tau": (tau, (samples, len(structure.inputs))),
            "psi": (psi, (samples + 1,)),
            "psi0": (psi0, ()),
            "d": (d, (samples, len(structure.disturbances))),
            "air": (air, (samples, 2)),
            "process_noise": (process_noise, (samples, nx)),
        }
    )
    theta, x0 = np.atleast_2d(theta), np.atleast_2d(x0)
    tau = tau[None] if tau.ndim == 2 else tau
    heading: Heading = "simulated" if psi is None and structure.turns else "measured"
    series: list[Array] = [np.broadcast_to(tau, (runs, samples, tau.shape[2]))]
    if heading == "measured" and structure.marine:
        measured = np.zeros(samples + 1) if psi is None else np.asarray(psi, float)
        measured = held(measured, integrator, axis=-1)
        series.append(np.broadcast_to(measured[..., :samples, None], (runs, samples, 1)))
    if d is not None:
        d = np.asarray(d, float)
        series.append(np.broadcast_to(d, (runs, samples, d.shape[-1])))
    if air is not None:
        blow = held(np.asarray(air, float), integrator, axis=-2)
        series.append(np.broadcast_to(blow, (runs, samples, 2)))
    theta = np.broadcast_to(theta, (runs, theta.shape[1]))
    if process_noise is not None:
        series.append(np.broadcast_to(np.asarray(process_noise, float), (runs, samples, nx)))
    step = FreeRunStep(
        StepModel(structure, integrator, heading, air is not None),
        d is not None,
        process_noise is not None,
    )
    out = np.empty((runs, samples + 1, nx + (heading == "simulated")))
    out[:, 0, :nx], out[:, 0, nx:] = x0, np.reshape(psi0, (-1, 1))
    advance = _few if runs < MANY_RUNS else _many
    with np.errstate(all="ignore"):
        for a, b, factors in pieces(changes, structure.parameters, samples, sample_time, first):
            read = [part[:, a:b] for part in series]
            advance(step, read, theta * factors, sample_time, out[:, a : b + 1])
    x = out[:, :, :nx]
    if heading == "simulated":
        angle = out[:, :, nx]
    elif psi is not None:
        angle = np.broadcast_to(np.asarray(psi, float)[..., : samples + 1], (runs, samples + 1))
    else:
        angle = np.zeros((runs, samples + 1))
    if bound is None:
        bound = np.full(nx, 1e6)
    diverged = np.full(runs, -1)
    # extremes of all states together are found sooner than which sample is outside
    if not max(out.max(), -out.min()) <= min(bound):
        outside = beyond(x, bound)
        diverged = np.where(outside.any(axis=1), outside.argmax(axis=1), -1)
    return FreeRun(x, angle, diverged, np.asarray(bound, float))


def beyond(x: Array, bound: Array) -> NDArray[np.bool_]:
    """Return where some state (..., nx) is past its bound (nx,), or no number, (...)."""
    outside = np.zeros(x.shape[:-1], bool)
    # state by state: a reduction over the few states of each sample takes ten times as long
    with np.errstate(invalid="ignore"):
        for state, most in enumerate(bound):
            outside |= ~(np.abs(x[..., state]) <= most)
    return outside


def _common_runs(given: Mapping[str, tuple[Any, tuple[int, ...]]]) -> int:
    """Return how many runs arguments are for; each comes with its shape for one run.

    Raises
    ------
    UsageError
        One has another shape, or two are for other numbers of runs.
    """
    runs, first = 1, ""
    for name, (value, one) in given.items():
        if value is None:
            continue
        shape = np.shape(value)
        # what is constant over the samples may stand for all of them
        fits = [one, (1, *one[1:])] if len(one) == 2 else [one]
        last = shape[max(len(shape) - len(one), 0) :]
        constant = name == "d" and shape == one[1:]
        longer = name == "psi" and len(last) == 1 and last > one
        if not (constant or longer or last in fits) or len(shape) > len(one) + 1:
            several = ", ".join(["R", *map(str, one)])
            raise UsageError(
                f"'{name}' has the shape {shape}, where {one or 'a number'}, or ({several}) for R "
                f"runs, is needed: give one row a sample and one column a signal."
            )
        own = shape[0] if len(shape) > len(one) else 1
        if own > 1 and runs > 1 and own != runs:
            raise UsageError(
                f"'{first}' is for {runs} runs and '{name}' for {own}: give both for as many, or "
                f"one of them for a single run."
            )
        if own > runs:
            runs, first = own, name
    return runs


def _few(
    step: FreeRunStep, series: list[Array], theta: Array, sample_time: float, out: Array
) -> None:
    """Fill `out` (R, N+1, ·) from its first states on, run by run."""
    runs, samples = series[0].shape[:2]
    kernel = FreeRunKernel(step.function, samples)
    kernel.constants[1][:] = sample_time
    for run in range(runs):
        own = [part[run] for part in series]
        kernel.read = np.concatenate(own, axis=1) if own[1:] else np.ascontiguousarray(own[0])
        kernel.start[:] = out[run, 0]
        kernel.constants[0][:] = theta[run]
        kernel(out[run, 1:])


def _many(
    step: FreeRunStep, series: list[Array], theta: Array, sample_time: float, out: Array
) -> None:
    """Fill `out` (R, N+1, ·) from its first states on, in batches of runs."""
    runs, samples = series[0].shape[:2]
    # few sizes are compiled: the last batch holds copies of its last run
    size = min(-(-runs // _STEP_RUNS) * _STEP_RUNS, _BATCH_RUNS)
    kernel = OverRunsKernel(step, samples, size)
    for first in range(0, runs, size):
        batch = slice(first, min(first + size, runs))
        n = batch.stop - first
        column = 0
        for part in series:
            width = part.shape[2]
            kernel.w[:, column : column + width, :n] = part[batch].transpose(1, 2, 0)
            column += width
        kernel.x[0, :, :n] = out[batch, 0].T
        kernel.theta[:, :n] = theta[batch].T
        for a in (kernel.w, kernel.x[0], kernel.theta):
            a[..., n:] = a[..., n - 1 : n]
        kernel(sample_time)
        out[batch] = kernel.x[:, :, :n].transpose(2, 0, 1)


def stationary_disturbance(
    rng: np.random.Generator,
    mean: Array,
    std: Array | float,
    samples: int,
    *,
    runs: int = 1,
    correlation_time: float = 0.0,
    sample_time: float = 1.0,
) -> Array:
    """Draw n-frame current and wind as stationary processes.

    Each component is its mean plus a first-order Gauss-Markov process; with no
    correlation time, white noise as (6.2e-h).

    Parameters
    ----------
    rng : numpy.random.Generator
    mean : ndarray
        (nd,) means [m/s].
    std : float or ndarray
        Scalar or (nd,) stationary standard deviation of each [m/s].
    samples, runs : int
        N and R.
    correlation_time : float
        Time constant [s].
    sample_time : float
        Ts [s].

    Returns
    -------
    ndarray
        (R, N, nd) [m/s].
    """
    mean = np.asarray(mean, float)
    white = rng.standard_normal((runs, samples, mean.size))
    if correlation_time > 0:
        a = float(np.exp(-sample_time / correlation_time))
        gain = np.sqrt(1 - a**2)
        start = rng.standard_normal((runs, 1, mean.size)) * a
        white *= gain
        white[:, :1] += start
        white = recursive(np.array([1.0, -a]), white.swapaxes(1, 2)).swapaxes(1, 2)
    return np.asarray(mean + np.asarray(std) * white)


def positions(x: Array, psi: Array, sample_time: float, start: Array | None = None) -> Array:
    """Integrate body velocities to north-east positions by Euler, p⁺ = p + Ts·R(ψ)(u, v).

    Parameters
    ----------
    x : ndarray
        (..., N, ≥2) with surge and sway first [m/s].
    psi : ndarray
        (..., N) heading [rad].

    Returns
    -------
    ndarray
        (..., N, 2) positions [m].
    """
    rate = np.stack(body_to_ned(x[..., 0], x[..., 1], psi), axis=-1)
    way = integrated(rate, sample_time, "euler", axis=-2)
    return way + (0.0 if start is None else np.asarray(start))
