"""Compiled forms of a step: the free run of one ship, and of many.

A step takes two compiled forms, chosen by measurement. A few runs: some steps unrolled
into one scalar function, accumulated over the log. Many runs: the same instructions on
vectors with one element a run. (5000 undisturbed steps on one core: one run 3 ms by the
first form; 500 runs 0.08 s by the second, 0.5 s by the first, 1.1 s by a plain
mapaccum of the step.) NumPy buffers go in and out without conversion. Long runs of a few ships
take machine code in place of the first form where that pays, see `greybox.model.run.compiled`.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from greybox.model.run.compiled import loop_of
from greybox.model.run.step import StepModel

Array = NDArray[np.float64]

# steps that are one scalar function, and the instructions that it has at most
_UNROLLED, _INSTRUCTIONS = 25, 4000
# steps in the inner of two nested loops at least
_LEAST_BASE = 10
# from so many runs on the form over runs is the faster one
MANY_RUNS = 24
# steps of that form in one call, so that the call itself costs little
_GROUP = 10


def bind(setter: Callable[..., None], index: int, array: Array) -> None:
    """Point an argument or a result of a buffered call at a contiguous array."""
    setter(index, memoryview(array))  # type: ignore[arg-type]


@dataclass(frozen=True)
class FreeRunStep:
    """A step and what it reads at each sample of a free run.

    Parameters
    ----------
    model : StepModel
    disturbed : bool
        Reads disturbances, which are zero else.
    process_noise : bool
        Reads a noise that is added to each next state.
    """

    model: StepModel
    disturbed: bool = False
    process_noise: bool = False

    @property
    def channels(self) -> tuple[str, ...]:
        """What is read, in order."""
        structure = self.model.structure
        names = list(structure.inputs)
        if self.model.heading == "measured" and structure.marine:
            names.append("psi")
        if self.disturbed:
            names += structure.disturbances
        if self.model.air_measured:
            names += ["u_q", "v_q"]
        if self.process_noise:
            names += [f"w_{state}" for state in structure.states]
        return tuple(names)

    @property
    def function(self) -> ca.Function:
        """The step, ``(state, channels, theta, dt) -> state``."""
        return _free_run_step(self)


@lru_cache(maxsize=128)
def _free_run_step(step: FreeRunStep) -> ca.Function:
    s, structure = step.model.symbolic, step.model.structure
    w = ca.SX.sym("w", len(step.channels))
    value = {name: w[i] for i, name in enumerate(step.channels)}
    none = ca.SX(0)
    after = step.model(
        s.x,
        s.psi if step.model.heading == "simulated" else value.get("psi", none),
        ca.vertcat(*[value[n] for n in structure.inputs]),
        ca.vertcat(*[value.get(n, none) for n in structure.disturbances]),
        ca.vertcat(value.get("u_q", none), value.get("v_q", none)),
        s.theta,
        s.dt,
    )
    after += ca.vertcat(*[value.get(f"w_{name}", none) for name in step.model.states])
    given = [s.state, w, s.theta, s.dt]
    return shallow(ca.Function("step", given, [ca.densify(after)], {"cse": True}), 1)


def shallow(step: ca.Function, carried: int) -> ca.Function:
    """Return a step that adds early what is ready early, and factors in common only once.

    A processor waits for the longest chain of operations from one state to the next, which in a
    sum in the order of its terms holds every addition.

    Parameters
    ----------
    step : casadi.Function
        SX.
    carried : int
        How many arguments are handed on. What follows from the others alone is ready before.
    """
    given = [ca.SX.sym(step.name_in(i), step.sparsity_in(i)) for i in range(step.n_in())]
    results = [ca.SX(step.sparsity_out(i)) for i in range(step.n_out())]
    before = -step.n_instructions()
    # of each number its summands, behind the binary operations that each waits for
    work: dict[int, list[tuple[int, ca.SX]]] = {}

    def total(summands: list[tuple[int, ca.SX]]) -> tuple[int, ca.SX]:
        # what is no sum stays as it is, to be known as the same factor elsewhere
        if len(summands) == 1:
            return summands[0]
        shares: dict[object, tuple[int, int, ca.SX, ca.SX]] = {}
        for i, (wait, x) in enumerate(summands):
            product = x.is_op(ca.OP_MUL)
            share, of = (x.dep(0), x.dep(1)) if product else (x, ca.SX(1))
            key = of.element_hash() if product else (i,)
            if key in shares:
                share += shares[key][2]
            shares[key] = wait, i, share, of
        heap = [(wait, i, share * of) for wait, i, share, of in shares.values()]
        heapq.heapify(heap)
        while len(heap) > 1:
            (_, _, one), (wait, i, other) = heapq.heappop(heap), heapq.heappop(heap)
            heapq.heappush(heap, (wait + 1, i, one + other))
        return heap[0][0], heap[0][2]

    for k in range(step.n_instructions()):
        op = step.instruction_id(k)
        source, target = step.instruction_input(k), step.instruction_output(k)
        if op == ca.OP_OUTPUT:
            results[target[0]].nz[target[1]] = total(work[source[0]])[1]
        elif op == ca.OP_INPUT:
            wait = 0 if source[0] < carried else before
            work[target[0]] = [(wait, given[source[0]].nz[source[1]])]
        elif op == ca.OP_CONST:
            work[target[0]] = [(before, ca.SX(step.instruction_constant(k)))]
        elif op == ca.OP_ADD:
            work[target[0]] = work[source[0]] + work[source[1]]
        else:
            waits, x = zip(*(total(work[i]) for i in source), strict=True)
            made = (ca.SX.unary if len(x) == 1 else ca.SX.binary)(op, *x)
            work[target[0]] = [(max(waits) + len(x) - 1, made)]
    return ca.Function("step", given, results, {"cse": True})


@lru_cache(maxsize=64)
def unrolled(step: ca.Function, carried: int, steps: int) -> ca.Function:
    """Return several steps as one scalar function: less is spent between them.

    Parameters
    ----------
    step : casadi.Function
        SX. Arguments are what it hands to the next one, then a column that changes with
        the step, then constants; results begin with what is handed on.
    carried : int
        How many arguments are handed on.
    steps : int

    Returns
    -------
    casadi.Function
        With a matrix of `steps` columns as what changes. Results are what is handed on at
        the end, then every result of every step, a column each.
    """
    given = [ca.SX.sym(step.name_in(i), step.sparsity_in(i)) for i in range(step.n_in())]
    read = ca.SX.sym("read", step.size1_in(carried), steps)
    found: list[list[ca.SX]] = []
    current = given[:carried]
    for k in range(steps):
        found.append(step.call([*current, read[:, k], *given[carried + 1 :]]))
        current = found[-1][:carried]
    columns = [ca.horzcat(*[f[i] for f in found]) for i in range(step.n_out())]
    arguments = [*given[:carried], read, *given[carried + 1 :]]
    return ca.Function("steps", arguments, [*current, *columns])


def accumulate(step: ca.Function, count: int, carried: Sequence[int] = (0,)) -> ca.Function:
    """Return a step taken many times, as two nested loops of about equal length.

    Of 5000 steps with sensitivities that is built in half the time of ten by ten, and run
    in four fifths.

    Parameters
    ----------
    step : casadi.Function
    count : int
        How often.
    carried : sequence of int
        Arguments that a step hands to the next one, first among its results too.
    """
    base = max(_LEAST_BASE, math.isqrt(count) + 1)
    return step.mapaccum("run", count, list(carried), list(range(len(carried))), {"base": base})


def _block(step: ca.Function) -> int:
    """Return how many steps are one scalar function."""
    return max(1, min(_UNROLLED, _INSTRUCTIONS // step.n_instructions()))


@lru_cache(maxsize=64)
def along(step: ca.Function, carried: int, steps: int, runs: int) -> ca.Function:
    """Accumulate a step over samples, its last arguments constant, and over runs side by side.

    Arguments are the carried ones, then one that changes with the sample, then
    constants; results are those of every sample.
    """
    size = min(_block(step), steps)
    blocks = -(-steps // size)
    several = accumulate(unrolled(step, carried, size), blocks, range(carried))
    given = [
        ca.MX.sym(step.name_in(i), step.size1_in(i), steps if i == carried else 1)
        for i in range(step.n_in())
    ]
    read = given[carried]
    padding = ca.repmat(read[:, -1], 1, blocks * size - steps)
    constants = [ca.repmat(c, 1, blocks) for c in given[carried + 1 :]]
    found = several.call([*given[:carried], ca.horzcat(read, padding), *constants])[carried:]
    one = ca.Function("run", given, [x[:, :steps] for x in found])
    if runs == 1:
        return one
    # the constants are given once
    return one.map("runs", "serial", runs, list(range(carried + 1, step.n_in())), [])


class FreeRunKernel:
    """A step taken along the samples of one run, with its buffers.

    Parameters
    ----------
    step : Function
        SX, ``(state, what changes with the sample, *constants) -> state``.
    samples : int
        N, steps of a run.

    Attributes
    ----------
    start, read : ndarray
        (nx,) and (N, m), to be filled before a call; `read` may be another array, contiguous.
    constants : list of ndarray
        To be filled as well.
    """

    def __init__(self, step: ca.Function, samples: int) -> None:
        # few lengths are compiled: the last samples of a run are padding
        size = _block(step)
        padded = -(-samples // size) * size
        self.start = np.zeros(step.size1_in(0))
        self._read = np.zeros((padded, step.size1_in(1)))
        self.read = self._read[:samples]
        self.constants = [np.zeros(step.size1_in(i)) for i in range(2, step.n_in())]
        self._step, self._loop = step, loop_of(step, 1)

    @cached_property
    def _interpreted(self) -> tuple[Any, Callable[[], None]]:
        buffer, trigger = along(self._step, 1, len(self._read), 1).buffer()
        for i, argument in enumerate((self.start, self._read, *self.constants)):
            bind(buffer.set_arg, i, argument)
        return buffer, trigger

    @cached_property
    def _states(self) -> Array:
        return np.empty((len(self._read), len(self.start)))

    def compiled(self, runs: int) -> bool:
        """Return whether so many runs are to be taken by machine code, and count them."""
        return self._loop.pays(runs * len(self.read))

    def __call__(self, out: Array | None = None) -> Array:
        """Run, and return the states after each step (N, nx).

        Parameters
        ----------
        out : ndarray, optional
            (N, nx), contiguous, to be filled; else the next call overwrites what is returned.
        """
        samples = len(self.read)
        if self._loop.pays(samples):
            out = self._states[:samples] if out is None else out
            self._loop(samples, (self.start, self.read, *self.constants), (out,))
            return out
        buffer, trigger = self._interpreted
        self._read[:samples] = self.read
        self._read[samples:] = self._read[samples - 1]
        bind(buffer.set_res, 0, self._states)
        trigger()
        if out is None:
            return self._states[:samples]
        out[:] = self._states[:samples]
        return out


@lru_cache(maxsize=32)
def over_runs(step: ca.Function, runs: int) -> ca.Function:
    """Return a scalar step of one ship as one of many.

    The instructions of the scalar step are replayed on vectors over the runs.

    Parameters
    ----------
    step : Function
        SX, ``(x, w, theta, dt) -> x⁺``; outputs beyond the first are left out.
    runs : int

    Returns
    -------
    Function
        The same of (R, ·) matrices; ``dt`` stays a scalar.
    """
    inputs = [
        ca.MX.sym(step.name_in(i), 1 if i == 3 else runs, step.numel_in(i))
        for i in range(step.n_in())
    ]
    work: dict[int, ca.MX] = {}
    result: list[ca.MX] = [ca.MX(0)] * step.numel_out(0)
    for k in range(step.n_instructions()):
        op = step.instruction_id(k)
        source, target = step.instruction_input(k), step.instruction_output(k)
        if op == ca.OP_CONST:
            work[target[0]] = ca.MX(step.instruction_constant(k))
        elif op == ca.OP_INPUT:
            work[target[0]] = inputs[source[0]][:, source[1]]
        elif op == ca.OP_OUTPUT:
            if target[0] == 0:
                result[target[1]] = work[source[0]]
        elif len(source) == 1:
            work[target[0]] = ca.MX.unary(op, work[source[0]])
        else:
            work[target[0]] = ca.MX.binary(op, work[source[0]], work[source[1]])
    rows = [ca.repmat(x, runs, 1) if x.numel() == 1 else x for x in result]
    return ca.Function("step", inputs, [ca.horzcat(*rows)], {"cse": True})


@lru_cache(maxsize=32)
def _group(step: ca.Function, runs: int) -> ca.Function:
    """Return `_GROUP` steps of `runs` ships in one call, ``(x, w, *constants) -> X``."""
    one = over_runs(step, runs)
    x = ca.MX.sym("x", runs, one.size2_in(0))
    width = one.size2_in(1)
    w = ca.MX.sym("w", runs, width * _GROUP)
    constants = [ca.MX.sym(one.name_in(i), one.sparsity_in(i)) for i in range(2, one.n_in())]
    current, history = x, []
    for part in ca.horzsplit(w, width):
        current = one(current, part, *constants)
        history.append(current)
    return ca.Function("steps", [x, w, *constants], [ca.horzcat(*history)])


class OverRunsKernel:
    """The free run of many ships, one compiled vector operation an instruction.

    Parameters
    ----------
    step : FreeRunStep
    samples : int
        N, steps of a run.
    size : int
        Runs evaluated together.

    Notes
    -----
    Fill ``w`` (N, m, size), ``x[0]`` (nx, size) and ``theta`` (p, size) before a call.
    """

    def __init__(self, step: FreeRunStep, samples: int, size: int) -> None:
        one = step.function
        self._steps = _group(one, size)
        padded = -(-samples // _GROUP) * _GROUP
        self._w = np.zeros((padded, one.size1_in(1), size))
        self._x = np.zeros((padded + 1, one.size1_in(0), size))
        self.w = self._w[:samples]
        self.x = self._x[: samples + 1]
        self.theta = np.zeros((one.size1_in(2), size))

    def __call__(self, dt: float) -> None:
        """Run from ``x[0]``, filling ``x[1:]``."""
        samples = len(self.w)
        self._w[samples:] = self._w[samples - 1]
        buffer, trigger = self._steps.buffer()
        step_length = np.array([float(dt)])
        bind(buffer.set_arg, 2, self.theta)
        bind(buffer.set_arg, 3, step_length)
        for k in range(0, len(self._w), _GROUP):
            bind(buffer.set_arg, 0, self._x[k])
            bind(buffer.set_arg, 1, self._w[k : k + _GROUP])
            bind(buffer.set_res, 0, self._x[k + 1 : k + 1 + _GROUP])
            trigger()
