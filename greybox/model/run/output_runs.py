"""Runs of an output model side by side, with exact sensitivities.

The run itself is a loop over the samples. Its derivatives are not: those of each step
are computed at all samples at once, and their recursion is linear.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from greybox.model.output import OutputModel
from greybox.model.run.compiled import loop_of
from greybox.model.run.kernels import along, bind
from greybox.model.run.output_step import (
    StepBuilder,
    filter_step,
    filter_step_by_noise,
    free_run_step,
    likelihood,
    observer_step,
)
from greybox.numerics.recursion import propagate
from greybox.numerics.vectorised import Vectorised

Array = NDArray[np.float64]

# samples whose derivatives are computed at once: a long log needs no more memory than these
_BLOCK = 8192
# and that are turned from rows to columns at once: what is read stays in a processor's memory
_NEAR = 128


@lru_cache(maxsize=32)
def _plain_step(build: StepBuilder, model: OutputModel) -> ca.Function:
    """Return the step without derivatives."""
    of = build(model)
    return ca.Function(
        "step", [*of.carried, of.read, *of.constant], [*of.next, *of.results], {"cse": True}
    )


@dataclass(frozen=True)
class _Table:
    """Derivatives of one step, at any number of samples at once.

    Parameters
    ----------
    program : Vectorised
        Of the rows [∂z⁺/∂z, ∂z⁺/∂p, 0], and below them those of what is found unless
        `same`; the zeros are those of the run's own first states, where these are asked for.
    shape : tuple of int
    states : int
        How many z there are.
    same : bool
        What is found are the states themselves.
    """

    program: Vectorised
    shape: tuple[int, int]
    states: int
    same: bool


@lru_cache(maxsize=32)
def _table(build: StepBuilder, model: OutputModel, starts: bool) -> _Table:
    of = build(model)
    after, found = of.next_jacobian, of.result_jacobian
    same = bool(found.by_z.is_eye()) and not found.by_p.nnz()
    nz = after.by_z.size1()
    own = nz if starts else 0
    rows = [ca.horzcat(s.by_z, s.by_p, ca.SX(s.by_z.size1(), own)) for s in (after, found)]
    matrix = rows[0] if same else ca.vertcat(*rows)
    symbols = ca.vertcat(*of.carried, of.read, *of.constant)
    program = Vectorised(ca.vertsplit(ca.vec(ca.densify(matrix).T)), ca.vertsplit(symbols))
    return _Table(program, matrix.shape, nz, same)


def _samples(x: Array) -> Array:
    """Return what runs hold (M, m, n) as one row of all samples for each (n, M·m)."""
    return np.ascontiguousarray(x.reshape(-1, x.shape[2]).T)


def _by_sample(rows: Array) -> Array:
    """Return rows (n, N) as columns (N, n), so few samples at once that they stay near."""
    out = np.empty(rows.shape[::-1])
    for first in range(0, len(out), _NEAR):
        out[first : first + _NEAR] = rows[:, first : first + _NEAR].T
    return out


class _Evaluator:
    """Evaluates functions on NumPy arrays, in memory that each is given once."""

    def __init__(self) -> None:
        self._buffers: dict[int, tuple[ca.Function, Any, Callable[[], None]]] = {}

    def __call__(
        self, function: ca.Function, arguments: tuple[Array, ...], out: tuple[Array, ...]
    ) -> None:
        if id(function) not in self._buffers:
            self._buffers[id(function)] = (function, *function.buffer())
        _, buffer, trigger = self._buffers[id(function)]
        held = [np.ascontiguousarray(a, float) for a in arguments]
        for i, a in enumerate(held):
            if a.size:
                bind(buffer.set_arg, i, a)
        for i, a in enumerate(out):
            if a.size:
                bind(buffer.set_res, i, a)
        trigger()


_Found = TypeVar("_Found", bound=tuple[Array, ...])


def _kept(last: tuple[tuple[Array, ...], _Found] | None, *point: Array) -> _Found | None:
    """Return what was found last, if it was at this point."""
    if last is None:
        return None
    return last[1] if all(map(np.array_equal, last[0], point)) else None


def _fixed(*arrays: Array) -> Any:
    """Return arrays that nothing can write to."""
    for array in arrays:
        array.flags.writeable = False
    return arrays


class _Runs:
    """A step taken along runs side by side, with derivatives and buffers.

    The latest run is kept: derivatives are asked for where it was run before.

    Parameters
    ----------
    build : callable
        Of the step.
    model : OutputModel
    read : ndarray
        (M, m, nr) what each step reads.
    """

    def __init__(self, build: StepBuilder, model: OutputModel, read: Array) -> None:
        self._build, self._model = build, model
        self.runs, self.steps = read.shape[:2]
        self._read = np.ascontiguousarray(read, float)
        self._evaluate = _Evaluator()
        self._blocks: dict[bool, list[tuple[slice, Array, dict[int, Any]]]] = {}
        # those of the module are found by the hash of a model, which takes longer
        self._tables: dict[bool, _Table] = {}
        self._last: tuple[tuple[Array, ...], tuple[Array, ...]] | None = None

    def __call__(
        self, carried: Sequence[Array], constant: Sequence[Array]
    ) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        """Return what is carried after each step, and what is found, each (M, m, ·).

        None of it is to be written to.
        """
        point = (*carried, *constant)
        out = _kept(self._last, *point)
        if out is None:
            out = _fixed(*self._run(carried, constant))
            self._last = tuple(a.copy() for a in point), out
        return out[: len(carried)], out[len(carried) :]

    def _run(self, carried: Sequence[Array], constant: Sequence[Array]) -> list[Array]:
        step, count = _plain_step(self._build, self._model), len(carried)
        loop = loop_of(step, count)
        out = [np.empty((self.runs, self.steps, step.numel_out(i))) for i in range(step.n_out())]
        if loop.pays(self.runs * self.steps):
            start, fixed = (
                [np.ascontiguousarray(a, float) for a in x] for x in (carried, constant)
            )
            for k in range(self.runs):
                given = [*(a[k] for a in start), self._read[k], *fixed]
                loop(self.steps, given, [a[k] for a in out])
        else:
            function = along(step, count, self.steps, self.runs)
            self._evaluate(function, (*carried, self._read, *constant), tuple(out))
        return out

    def _prepared(
        self, table: _Table, first: int, starts: bool
    ) -> list[tuple[slice, Array, dict[int, Any]]]:
        """Return, of stretches of all runs, what is read and all that depends on it alone."""
        if starts not in self._blocks:
            self._blocks[starts] = []
            length = max(1, _BLOCK // self.runs)
            for begin in range(0, self.steps, length):
                block = slice(begin, begin + length)
                read = _samples(self._read[:, block])
                known = table.program.prepare({first + i: x for i, x in enumerate(read)})
                self._blocks[starts].append((block, read, known))
        return self._blocks[starts]

    def slopes(
        self,
        carried: Sequence[Array],
        constant: Sequence[Array],
        after: Sequence[Array],
        *,
        starts: bool = True,
        only: Sequence[int] | None = None,
    ) -> tuple[Array, Array]:
        """Return derivatives in the parameters, then in the run's own first states.

        Parameters
        ----------
        carried, constant : sequence of ndarray
            As a call took them.
        after : sequence of ndarray
            What was carried after each step.
        starts : bool
            Whether those in the first states are asked for.
        only : sequence of int, optional
            Columns that are asked for; by default all.

        Returns
        -------
        tuple of ndarray
            Of what is found first, (M, m, ny, q + nz), and of the states after the last
            step, (M, nz, q + nz).
        """
        if starts not in self._tables:
            self._tables[starts] = _table(self._build, self._model, starts)
        table = self._tables[starts]
        (rows, columns), nz = table.shape, table.states
        wanted: list[int] | None = None
        if only is not None:
            asked = [*range(nz), *(nz + i for i in only)]
            wanted = [row * columns + column for row in range(rows) for column in asked]
            columns = len(asked)
        states = np.concatenate(
            [
                np.concatenate([x[:, None], y[:, :-1]], axis=1)
                for x, y in zip(carried, after, strict=True)
            ],
            axis=2,
        )
        fixed = [float(x) for c in constant for x in c]
        found = nz if table.same else rows - nz
        shown = np.empty((self.runs, self.steps, found, columns - nz))
        slope = np.zeros((self.runs, nz, columns - nz))
        if starts:
            slope[:, :, columns - 2 * nz :] = np.eye(nz)
        with np.errstate(all="ignore"):
            for block, read, known in self._prepared(table, states.shape[2], starts):
                arguments = [*_samples(states[:, block]), *read, *fixed]
                found_at = np.empty((rows * columns, read.shape[1]))
                table.program(arguments, found_at, known, wanted)
                by = _by_sample(found_at).reshape(self.runs, -1, rows, columns)
                slopes = propagate(by[:, :, :nz, :nz], by[:, :, :nz, nz:], slope)
                slope = slopes[:, -1]
                if table.same:
                    shown[:, block] = slopes[:, :-1]
                else:
                    np.matmul(by[:, :, nz:, :nz], slopes[:, :-1], out=shown[:, block])
                    shown[:, block] += by[:, :, nz:, nz:]
        return shown, slope


class Simulator:
    """Free runs of equal length side by side, with sensitivities and buffers.

    Parameters
    ----------
    model : OutputModel
    w : ndarray
        (M, m, nw) what each step reads, in the order of ``model.drivers``.

    Notes
    -----
    Sensitivity columns are the parameters, then the run's own initial state.
    """

    def __init__(self, model: OutputModel, w: Array) -> None:
        self.model = model
        self._runs = _Runs(free_run_step, model, w)
        # the latest run whose derivatives were asked for
        self._last: tuple[tuple[Array, ...], tuple[Array, Array, Array, Array]] | None = None

    def __call__(self, z0: Array, p: Array) -> tuple[Array, Array]:
        """Return outputs (M, m, ny) and the states after the last step (M, nz)."""
        kept = _kept(self._last, z0, p)
        if kept is not None:
            return kept[0], kept[2]
        (states,), (y,) = self._runs([z0], [p])
        return y, states[:, -1]

    def by_parameters(self, z0: Array, p: Array, only: Sequence[int]) -> Array:
        """Return derivatives of the outputs in some parameters, (M, m, ny, len(only))."""
        states, _ = self._runs([z0], [p])
        return self._runs.slopes([z0], [p], states, starts=False, only=only)[0]

    def sensitivities(self, z0: Array, p: Array) -> tuple[Array, Array, Array, Array]:
        """Run with derivatives.

        Parameters
        ----------
        z0 : ndarray
            (M, nz) initial states.
        p : ndarray
            (q,) parameters.

        Returns
        -------
        tuple of ndarray
            Outputs (M, m, ny); their derivatives (M, m, ny, q + nz); states after
            the last step (M, nz) and their derivatives (M, nz, q + nz). Not to be written
            to: the latest are kept, for the same point is asked for with other weights.
        """
        kept = _kept(self._last, z0, p)
        if kept is None:
            (states,), (y,) = self._runs([z0], [p])
            rows, slope = self._runs.slopes([z0], [p], [states])
            kept = _fixed(y, rows, states[:, -1], slope)
            self._last = (z0.copy(), p.copy()), kept
        return kept


class Observer:
    """Runs whose measured states are drawn towards the measurements at every step.

    Parameters
    ----------
    model : OutputModel
    w, y, use : ndarray
        As a `Filter` takes them.
    """

    def __init__(self, model: OutputModel, w: Array, y: Array, use: Array) -> None:
        self.model = model
        self._runs = _Runs(observer_step, model, np.concatenate([w, y, use[..., None]], axis=2))
        self._unused = use == 0

    def by_parameters(self, z0: Array, p: Array, gain: float, only: Sequence[int]) -> Array:
        """Return derivatives of h(z) in some parameters, (M, m, ny, len(only))."""
        constant = [p, np.array([gain])]
        states, _ = self._runs([z0], constant)
        rows, _ = self._runs.slopes([z0], constant, states, starts=False, only=only)
        if self._unused.any():
            rows[self._unused] = 0.0
        return rows

    def __call__(
        self, z0: Array, p: Array, gain: float, *, sensitivities: bool = True
    ) -> tuple[Array, Array]:
        """Run from initial states, each step beginning at z + gain (y − z).

        Parameters
        ----------
        z0 : ndarray
            (M, nz)
        p : ndarray
            (q,)
        gain : float
            0 is the free run, 1 begins each step at the measurement.

        Returns
        -------
        tuple
            Errors y − h(z) before each correction (M, m, ny), and the derivatives of h(z)
            (M, m, ny, q + nz), without columns where they are not asked for.
        """
        constant = [p, np.array([gain])]
        states, (error,) = self._runs([z0], constant)
        if not sensitivities:
            return error, np.empty((*error.shape, 0))
        rows, _ = self._runs.slopes([z0], constant, states)
        if self._unused.any():
            rows[self._unused] = 0.0
        return error, rows


class Filter:
    """Extended Kalman filters over logs side by side, padded to one length.

    Parameters
    ----------
    model : OutputModel
    w : ndarray
        (M, m, nw) what each step reads.
    y : ndarray
        (M, m, ny) measurements.
    use : ndarray
        (M, m) 1 for samples of a log, 0 for padding.
    """

    def __init__(self, model: OutputModel, w: Array, y: Array, use: Array) -> None:
        self.model = model
        self._w = np.ascontiguousarray(np.concatenate([w, y, use[..., None]], axis=2), float)
        self._runs = _Runs(filter_step, model, self._w)
        self._by_noise = _Runs(filter_step_by_noise, model, self._w)
        nz = len(model.states)
        self._certain = np.zeros((len(w), nz * (nz + 1) // 2))
        self._evaluate = _Evaluator()

    def __call__(
        self, z0: Array, p: Array, noise: Array, *, sensitivities: bool = True
    ) -> tuple[Array, Array, Array]:
        """Filter from exactly known initial states.

        Parameters
        ----------
        z0 : ndarray
            (M, nz)
        p : ndarray
            (q,)
        noise : ndarray
            (ny + nz,) variances of the measurements and of what is added a step.

        Returns
        -------
        tuple
            Innovations of unit variance (M, m, ny); their sensitivities with the
            gains held (M, m, ny, q + nz), negative derivatives of the innovations,
            without columns where they are not asked for; and the logarithms of their
            variances (M, m, ny).
        """
        after, (innovations, levels) = self._runs([z0, self._certain], [p, noise])
        if not sensitivities:
            return innovations, np.empty((*innovations.shape, 0)), levels
        rows, _ = self._runs.slopes([z0, self._certain], [p, noise], after)
        return innovations, rows, levels

    def by_noise(self, z0: Array, p: Array, noise: Array) -> tuple[Array, Array]:
        """Return the exact derivatives of a call's results in the variances.

        Parameters
        ----------
        z0, p, noise : ndarray
            As a call takes them.

        Returns
        -------
        tuple of ndarray
            (M, m, ny, ny + nz) of the innovations of unit variance and of the logarithms of
            their variances.
        """
        carried = [z0, self._certain]
        after, (innovations, _) = self._runs(carried, [p, noise])
        ny = innovations.shape[2]
        rows, _ = self._by_noise.slopes(carried, [p, noise], after, starts=False)
        return rows[:, :, :ny], rows[:, :, ny:]

    def likelihood(self, z0: Array, p: Array, noise: Array) -> tuple[float, Array, Array]:
        """Return the negative log-likelihood and its derivatives, gains included.

        Parameters
        ----------
        z0, p, noise : ndarray
            As a call takes them.

        Returns
        -------
        tuple
            −log L without its constant; its derivatives in `z0` (M, nz) and `p` (q,).

        References
        ----------
        Ljung (1999), section 7.4; Åström (1980), eq. 4.6.
        """
        function = likelihood(self.model, *self._w.shape[1::-1])
        out = (np.empty(1), np.empty(z0.shape), np.empty(p.shape))
        self._evaluate(function, (z0, self._w, p, noise), out)
        return float(out[0][0]), out[1], out[2]
