"""CasADi functions of a structure: step, Jacobians, and the free run of many ships.

The step is written once from the structure's expression and takes two compiled
forms, chosen by measurement. A few runs: some steps unrolled into one scalar
function, accumulated over the log. Many runs: the same instructions on vectors
with one element a run. (5000 undisturbed steps on one core: one run 3 ms by the
first form; 500 runs 0.08 s by the second, 0.5 s by the first, 1.1 s by a plain
mapaccum of the step.) NumPy buffers go in and out without conversion.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from greybox.errors import StructureError
from greybox.model.structure import Structure

Array = NDArray[np.float64]
Integrator = Literal["euler", "rk4"]
Heading = Literal["measured", "simulated"]

# the classical Runge-Kutta rule: the share of a stage's slope at which the next one looks,
# and what each counts
RK4_AHEAD = (0.5, 0.5, 1.0)
RK4_WEIGHTS = (1 / 6, 1 / 3, 1 / 3, 1 / 6)

_UNROLLED = 25
# steps in the inner of two nested loops at least
_LEAST_BASE = 10
# from so many runs on the form over runs is the faster one
MANY_RUNS = 24
# steps of that form in one call, so that the call itself costs little
_GROUP = 10


def _rate(structure: Structure, air_measured: bool) -> ca.Function:
    s = structure.symbols
    f = structure.increment_expression(air_measured=air_measured)
    return ca.Function("rate", [s.x, s.psi, s.tau, s.d, s.air, s.theta], [f])


@lru_cache(maxsize=64)
def step_function(
    structure: Structure,
    *,
    air_measured: bool = False,
    integrator: Integrator = "euler",
    heading: Heading = "measured",
) -> ca.Function:
    """Return one step, ``(x, psi, tau, d, air, theta, dt) -> x⁺[, psi⁺]``.

    Parameters
    ----------
    structure : Structure
    air_measured : bool
        Whether ``air`` is used; else the wind mean in ``d``.
    integrator : {"euler", "rk4"}
        Explicit Euler as (2.6), or the classical fourth-order rule on the same
        increment, with inputs held over the step.
    heading : {"measured", "simulated"}
        ``simulated``: the heading is integrated with the states, ψ⁺ = ψ + Ts·r,
        and returned as a second output.

    Raises
    ------
    StructureError
        The heading is to be simulated but the structure has no yaw rate, or a
        map that is not an increment is to be integrated by RK4.
    """
    s = structure.symbols
    rate = _rate(structure, air_measured)
    dt = ca.SX.sym("dt")
    if heading == "simulated" and "r" not in structure.states:
        raise StructureError(
            f"structure '{structure.name}' has no yaw rate to integrate: use the measured heading."
        )
    if not structure.increment:
        if integrator != "euler":
            raise StructureError(f"structure '{structure.name}' is a map, not a rate: use euler.")
        x_next = rate(s.x, s.psi, s.tau, s.d, s.air, s.theta)
        return ca.Function("step", [s.x, s.psi, s.tau, s.d, s.air, s.theta, dt], [x_next])

    def slope(x: ca.SX, psi: ca.SX) -> tuple[ca.SX, ca.SX]:
        turn = dt * x[structure.states.index("r")] if heading == "simulated" else ca.SX(0)
        return rate(x, psi, s.tau, s.d, s.air, s.theta), turn

    dx, dpsi = slope(s.x, s.psi)
    if integrator == "rk4":
        stages = [(dx, dpsi)]
        for share in RK4_AHEAD:
            moved, turned = stages[-1]
            stages.append(slope(s.x + share * moved, s.psi + share * turned))
        dx, dpsi = (
            sum((w * part for w, part in zip(RK4_WEIGHTS[1:], parts[1:], strict=True)),
                RK4_WEIGHTS[0] * parts[0])
            for parts in zip(*stages, strict=True)
        )  # fmt: skip
    outputs = [s.x + dx] + ([s.psi + dpsi] if heading == "simulated" else [])
    return ca.Function("step", [s.x, s.psi, s.tau, s.d, s.air, s.theta, dt], outputs)


@lru_cache(maxsize=64)
def jacobians(structure: Structure, *, air_measured: bool = False) -> ca.Function:
    """Return the derivatives of x⁺: ``(x, psi, tau, d, air, theta) -> A, B, P, E``.

    ``A`` (nx, nx) in the states, ``B`` (nx, nu) in the inputs, ``P`` (nx, p) in
    the parameters, ``E`` (nx, nd) in the disturbance means; by differentiation
    of the Euler step (3.51).
    """
    s = structure.symbols
    f = structure.increment_expression(air_measured=air_measured)
    x_next = s.x + f if structure.increment else f
    return ca.Function(
        "jacobians",
        [s.x, s.psi, s.tau, s.d, s.air, s.theta],
        [ca.jacobian(x_next, v) for v in (s.x, s.tau, s.theta, s.d)],
        ["x", "psi", "tau", "d", "air", "theta"],
        ["A", "B", "P", "E"],
    )


def bind(setter: Callable[..., None], index: int, array: Array) -> None:
    """Point an argument or a result of a buffered call at a contiguous array."""
    setter(index, memoryview(array))  # type: ignore[arg-type]


@dataclass(frozen=True)
class RunVariant:
    """What a free run reads beside the inputs.

    Parameters
    ----------
    heading : {"measured", "simulated"}
    air_measured : bool
        Reads the velocity through the air.
    disturbed : bool
        Reads disturbances at each step.
    process_noise : bool
        Reads a noise that is added to each next state.
    integrator : {"euler", "rk4"}
    """

    heading: Heading = "measured"
    air_measured: bool = False
    disturbed: bool = False
    process_noise: bool = False
    integrator: Integrator = "euler"


def run_channels(structure: Structure, variant: RunVariant) -> list[str]:
    """Return what a free run reads at each step, in order."""
    heading, air_measured, disturbed = variant.heading, variant.air_measured, variant.disturbed
    channels = list(structure.inputs)
    if heading == "measured" and structure.disturbance == "marine":
        channels.append("psi")
    if disturbed:
        channels += structure.disturbances
    if air_measured:
        channels += ["u_q", "v_q"]
    if variant.process_noise:
        channels += [f"w_{state}" for state in structure.states]
    return channels


@lru_cache(maxsize=128)
def _unrolled(
    structure: Structure,
    variant: RunVariant,
    steps: int = _UNROLLED,
) -> ca.Function:
    """Return `steps` steps as one scalar function ``(x, w, theta, dt) -> x⁺, X``."""
    s = structure.symbols
    step = step_function(
        structure,
        air_measured=variant.air_measured,
        integrator=variant.integrator,
        heading=variant.heading,
    )
    simulated = variant.heading == "simulated"
    state = ca.vertcat(s.x, s.psi) if simulated else s.x
    channels = run_channels(structure, variant)
    w = ca.SX.sym("w", len(channels), steps)
    dt = ca.SX.sym("dt")
    nx = s.x.numel()
    current: ca.SX = state
    history: list[ca.SX] = []
    for k in range(steps):
        value = {name: w[i, k] for i, name in enumerate(channels)}
        x, psi = current[:nx], current[nx] if simulated else value.get("psi", ca.SX(0))
        tau = ca.vertcat(*[value[n] for n in structure.inputs])
        d = ca.vertcat(*[value.get(n, ca.SX(0)) for n in structure.disturbances])
        air = ca.vertcat(value.get("u_q", ca.SX(0)), value.get("v_q", ca.SX(0)))
        after = step.call([x, psi, tau, d, air, s.theta, dt])
        current = ca.SX(ca.vertcat(*after))
        for i, name in enumerate(structure.states):
            if f"w_{name}" in value:
                current[i] = current[i] + value[f"w_{name}"]
        history.append(current)
    return ca.Function(
        "steps", [state, w, s.theta, dt], [current, ca.horzcat(*history)], {"cse": True}
    )


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


def accumulate(
    step: ca.Function, count: int, carried: Sequence[int] = (0,), name: str = "run"
) -> ca.Function:
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
    name : str
    """
    base = max(_LEAST_BASE, math.isqrt(count) + 1)
    return step.mapaccum(name, count, list(carried), list(range(len(carried))), {"base": base})


@lru_cache(maxsize=32)
def _free_run(
    structure: Structure,
    variant: RunVariant,
    blocks: int,
    runs: int,
) -> ca.Function:
    steps = _unrolled(structure, variant)
    run = accumulate(steps, blocks)
    x0 = ca.MX.sym("x0", steps.size1_in(0))
    w = ca.MX.sym("w", steps.size1_in(1), blocks * _UNROLLED)
    theta = ca.MX.sym("theta", steps.size1_in(2))
    dt = ca.MX.sym("dt")
    history = run(x0, w, ca.repmat(theta, 1, blocks), ca.repmat(dt, 1, blocks))[1]
    one = ca.Function("free_run", [x0, w, theta, dt], [history])
    return one if runs == 1 else one.map(runs)


class FreeRunKernel:
    """A compiled free run for batches of at most `size` runs, with its buffers.

    Parameters
    ----------
    structure : Structure
    samples : int
        N, steps of a run.
    size : int
        Runs evaluated together; fewer are padded by the last one.
    """

    def __init__(
        self,
        structure: Structure,
        samples: int,
        size: int,
        variant: RunVariant,
    ) -> None:
        blocks = -(-samples // _UNROLLED)
        self.channels = run_channels(structure, variant)
        self.samples = samples
        self._padded = blocks * _UNROLLED
        nx = len(structure.states) + (variant.heading == "simulated")
        # (size, N, m): fill [:n, :N] before a call
        self.w = np.zeros((size, self._padded, len(self.channels)))
        self.x0 = np.zeros((size, nx))
        self.theta = np.zeros((size, len(structure.terms)))
        self._dt = np.zeros(size)
        self._history = np.zeros((size, self._padded, nx))
        buffer, self._trigger = _free_run(structure, variant, blocks, size).buffer()
        for i, argument in enumerate((self.x0, self.w, self.theta, self._dt)):
            bind(buffer.set_arg, i, argument)
        bind(buffer.set_res, 0, self._history)
        self._buffer = buffer

    def __call__(self, dt: float, out: Array) -> None:
        """Run the ships whose `w`, `x0` and `theta` were filled.

        Parameters
        ----------
        dt : float
            Sampling time [s].
        out : ndarray
            (n, N+1, nx) filled with the states, the initial ones first; n ≤ size.
        """
        n = len(out)
        self._dt[:] = dt
        self.w[:n, self.samples :] = self.w[:n, self.samples - 1 : self.samples]
        for a in (self.w, self.x0, self.theta):
            a[n:] = a[n - 1]
        self._trigger()
        out[:, 0] = self.x0[:n]
        out[:, 1:] = self._history[:n, : self.samples]


@lru_cache(maxsize=32)
def _step_over_runs(
    structure: Structure,
    variant: RunVariant,
    runs: int,
) -> ca.Function:
    """Return one step of `runs` ships, ``(x, w, theta, dt) -> x⁺``, each an (R, ·) matrix."""
    return over_runs(_unrolled(structure, variant, steps=1), runs)


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
def _steps_over_runs(structure: Structure, variant: RunVariant, runs: int) -> ca.Function:
    """Return `_GROUP` steps of `runs` ships in one call, ``(x, w, theta, dt) -> X``."""
    step = _step_over_runs(structure, variant, runs)
    nx, width = step.size2_in(0), step.size2_in(1)
    x = ca.MX.sym("x", runs, nx)
    w = ca.MX.sym("w", runs, width * _GROUP)
    theta = ca.MX.sym("theta", runs, step.size2_in(2))
    dt = ca.MX.sym("dt")
    current, history = x, []
    for part in ca.horzsplit(w, width):
        current = step(current, part, theta, dt)
        history.append(current)
    return ca.Function("steps", [x, w, theta, dt], [ca.horzcat(*history)])


class OverRunsKernel:
    """The free run of many ships, one compiled vector operation an instruction.

    Parameters
    ----------
    structure : Structure
    samples : int
        N, steps of a run.
    size : int
        Runs evaluated together.
    variant : RunVariant

    Notes
    -----
    Fill ``w`` (N, m, size), ``x[0]`` (nx, size) and ``theta`` (p, size) before a call.
    """

    def __init__(
        self,
        structure: Structure,
        samples: int,
        size: int,
        variant: RunVariant,
    ) -> None:
        self._steps = _steps_over_runs(structure, variant, size)
        self.channels = run_channels(structure, variant)
        nx = len(structure.states) + (variant.heading == "simulated")
        padded = -(-samples // _GROUP) * _GROUP
        self._w = np.zeros((padded, len(self.channels), size))
        self._x = np.zeros((padded + 1, nx, size))
        self.w = self._w[:samples]
        self.x = self._x[: samples + 1]
        self.theta = np.zeros((len(structure.terms), size))

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
