"""A model as a simulator of what the sensors see, with exact sensitivities.

States z are those of the structure and, where it is simulated, the heading; the
outputs are the measured states, and the heading and the velocity through the
air where they count as measurements and not as inputs. The parameters are the
coefficients of a predictor's columns, followed by disturbance means. One symbolic
step, differentiated once, gives the free run (output error) and, with the
covariance of an extended Kalman filter beside it, the innovations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from greybox.errors import StructureError
from greybox.model.disturbances import CURRENT, WIND, rotate_to_body
from greybox.model.functions import accumulate, bind, unrolled
from greybox.model.predictor import Column, Predictor
from greybox.recursion import propagate
from greybox.vectorised import Vectorised

Array = NDArray[np.float64]

# samples whose derivatives are computed at once: a long log needs no more memory than these
_BLOCK = 8192
# steps that are one scalar function, and the instructions that it has at most
_UNROLLED, _INSTRUCTIONS = 16, 2000
Role = Literal["input", "output"]


@dataclass(frozen=True)
class OutputModel:
    """What is simulated, from what, and with which unknowns.

    Parameters
    ----------
    predictor : Predictor
        Its columns are the terms of each equation; coefficients in its order.
    sample_time : float
        [s]
    heading : {"input", "output"}
        The measured heading drives the run, or is simulated and compared.
    wind : {"input", "output"}
        Likewise for the velocity through the air; as an output it follows from
        a constant wind.
    means : tuple of str
        Disturbance means that are parameters, such as the current.
    """

    predictor: Predictor
    sample_time: float
    heading: Role = "input"
    wind: Role = "input"
    means: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        structure = self.predictor.structure
        if self.heading == "output" and "r" not in structure.states:
            raise StructureError(
                f"structure '{structure.name}' has no yaw rate, so its heading cannot be "
                f"simulated: take the heading as an input."
            )
        unknown = [n for n in self.means if n not in structure.disturbances]
        if unknown:
            raise StructureError(
                f"structure '{structure.name}' has no disturbance '{unknown[0]}'. "
                f"It has: {', '.join(structure.disturbances) or 'none'}."
            )
        if self.wind == "output" and not set(WIND) <= set(self.means):
            raise StructureError(
                f"the velocity through the air follows from {', '.join(WIND)}, which are no "
                f"parameters here: take the wind as an input."
            )

    @property
    def states(self) -> tuple[str, ...]:
        """Simulated states, the heading last where it is simulated."""
        own = self.predictor.structure.states
        return (*own, "psi") if self.heading == "output" else own

    @property
    def outputs(self) -> tuple[str, ...]:
        """Channels that are compared."""
        return (*self.states, "u_q", "v_q") if self.wind == "output" else self.states

    @property
    def drivers(self) -> tuple[str, ...]:
        """What a step reads of the log: generalised inputs, heading, wind."""
        structure = self.predictor.structure
        names = list(structure.inputs)
        if self.heading == "input" and structure.disturbance == "marine":
            names.append("psi")
        if self.wind == "input" and self.predictor.air_measured:
            names += ["u_q", "v_q"]
        return tuple(names)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters: equation and column, then the means."""
        columns = [c.label if not c.is_bias else f"{c.state}: {c.name}" for c in self.columns]
        return (*columns, *self.means)

    @property
    def columns(self) -> tuple[Column, ...]:
        """Columns of the predictor."""
        return self.predictor.columns


@dataclass(frozen=True)
class _Step:
    """Symbols and expressions of one step."""

    z: ca.SX
    w: ca.SX
    p: ca.SX
    after: ca.SX
    seen: ca.SX


@lru_cache(maxsize=64)
def _step(model: OutputModel) -> _Step:
    predictor = model.predictor
    structure = predictor.structure
    s = structure.symbols
    names = structure.states
    z = ca.SX.sym("z", len(model.states))
    w = ca.SX.sym("w", len(model.drivers))
    p = ca.SX.sym("p", len(model.parameters))
    given = {name: w[i] for i, name in enumerate(model.drivers)}
    heading = z[len(names)] if model.heading == "output" else given.get("psi", ca.SX(0))
    count = len(predictor.columns)
    d = [ca.SX(0)] * len(structure.disturbances)
    for i, name in enumerate(model.means):
        d[structure.disturbances.index(name)] = p[count + i]
    air = ca.vertcat(given.get("u_q", ca.SX(0)), given.get("v_q", ca.SX(0)))
    if model.wind == "output":
        state = {name: z[i] for i, name in enumerate(names)}
        u_w, v_w = rotate_to_body(heading, *[d[structure.disturbances.index(n)] for n in WIND])
        air = ca.vertcat(state["u"] - u_w, state.get("v", ca.SX(0)) - v_w)
    regressors = structure.regressors(air_measured=predictor.air_measured)
    at_zero = predictor.expressions
    # biases capture what the means do not; wind that is not measured is in them
    unknown_wind = (
        [] if predictor.air_measured else [n for n in WIND if n in structure.disturbances]
    )
    calm = [s.d[structure.disturbances.index(n)] for n in unknown_wind]
    rows = [ca.SX(0)] * len(names)
    for i, column in enumerate(predictor.columns):
        expression = at_zero[i] if column.is_bias else regressors[structure.index(column.terms[0])]
        if calm:
            expression = ca.substitute(expression, ca.vertcat(*calm), ca.SX.zeros(len(calm)))
        rows[names.index(column.state)] += p[i] * expression
    change = ca.substitute(
        ca.vertcat(*rows),
        ca.vertcat(s.x, s.psi, s.tau, s.d, s.air),
        ca.vertcat(z[: len(names)], heading, *[given[n] for n in structure.inputs], *d, air),
    )
    after = z[: len(names)] + change if structure.increment else change
    if model.heading == "output":
        after = ca.vertcat(after, heading + model.sample_time * z[names.index("r")])
    seen = ca.vertcat(z, air) if model.wind == "output" else z
    return _Step(z, w, p, ca.densify(after), ca.densify(seen))


@dataclass(frozen=True)
class _Slope:
    """Derivatives of an expression in the carried states and in the parameters."""

    by_z: ca.SX
    by_p: ca.SX

    @classmethod
    def of(cls, expression: ca.SX, s: _Step) -> _Slope:
        return cls(ca.jacobian(expression, s.z), ca.jacobian(expression, s.p))

    @property
    def parts(self) -> tuple[ca.SX, ca.SX]:
        """Both."""
        return self.by_z, self.by_p

    def after(self, before: _Slope) -> _Slope:
        """Chain: this slope taken where the states have another already."""
        return _Slope(self.by_z @ before.by_z, self.by_z @ before.by_p + self.by_p)


@dataclass(frozen=True)
class _Walk:
    """A step in symbols, what is found at it, and the derivatives of both.

    Parameters
    ----------
    carried : tuple of SX
        What a step hands to the next one, first the states.
    read : SX
        What changes with the sample.
    constant : tuple of SX
        What does not, first the parameters.
    after, found : tuple of SX
        Next values of what is carried, and results.
    slope_after, slope_found : _Slope
        Of the next states, and of the first result.
    """

    carried: tuple[ca.SX, ...]
    read: ca.SX
    constant: tuple[ca.SX, ...]
    after: tuple[ca.SX, ...]
    found: tuple[ca.SX, ...]
    slope_after: _Slope
    slope_found: _Slope


Walk = Callable[[OutputModel], _Walk]


@lru_cache(maxsize=32)
def _free(model: OutputModel) -> _Walk:
    """Return the free run, which shows its outputs before each step."""
    s = _step(model)
    after, seen = _Slope.of(s.after, s), _Slope.of(s.seen, s)
    return _Walk((s.z,), s.w, (s.p,), (s.after,), (s.seen,), after, seen)


@lru_cache(maxsize=32)
def _observed(model: OutputModel) -> _Walk:
    """Return a run whose steps begin at z + gain (y − z), and which shows y − h(z).

    The derivatives of what is found are those of h.
    """
    s = _step(model)
    nz, ny = s.z.numel(), s.seen.numel()
    y, use, gain = ca.SX.sym("y", ny), ca.SX.sym("use"), ca.SX.sym("gain")
    kept = 1 - use * gain
    corrected = kept * s.z + use * gain * y[:nz]
    after = ca.substitute(s.after, s.z, corrected)
    read = ca.vertcat(s.w, y, use)
    error = use * (y - s.seen)
    slopes = _Slope.of(after, s), _Slope.of(s.seen, s)
    return _Walk((s.z,), read, (s.p, gain), (after,), (error,), *slopes)


def _over(step: ca.Function, carried: int, steps: int, runs: int) -> ca.Function:
    """Accumulate a step over samples, its last arguments constant, and over runs side by side.

    Arguments are the carried ones, then one that changes with the sample, then
    constants; results are those of every sample.
    """
    size = max(1, min(_UNROLLED, _INSTRUCTIONS // step.n_instructions(), steps))
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


@lru_cache(maxsize=32)
def _filtered(model: OutputModel) -> _Walk:
    """Return one sample of an extended Kalman filter.

    It carries the states and their covariance (its lower triangle), reads drivers,
    measurements and whether they count, and shows innovations of unit variance and the
    logarithms of their variances. Derivatives are at its gains, and of what is taken
    from the innovations.
    """
    s = _step(model)
    nz, ny = s.z.numel(), s.seen.numel()
    y, use = ca.SX.sym("y", ny), ca.SX.sym("use")
    noise = ca.SX.sym("noise", ny + nz)
    # a covariance is carried by its lower triangle: half of what follows is never computed
    cov = ca.SX.sym("P", nz * (nz + 1) // 2)
    at = ca.Function("seen", [s.z, s.w, s.p], [s.seen, *_Slope.of(s.seen, s).parts])
    z, spread = s.z, ca.tril2symm(ca.SX(ca.Sparsity.lower(nz), cov))
    slope = _Slope(ca.SX.eye(nz), ca.SX(nz, s.p.numel()))
    innovations, rows, levels = [], [], []
    for i in range(ny):
        shown, by_z, by_p = at(z, s.w, s.p)
        h = ca.densify(by_z[i, :])
        gain_row = spread @ h.T
        variance = h @ gain_row + noise[i]
        # rows beyond the log's end change nothing
        gain = use * gain_row / variance
        error = y[i] - shown[i]
        row = _Slope(by_z[i, :], by_p[i, :]).after(slope)
        weight = use / ca.sqrt(variance)
        innovations.append(weight * error)
        rows.append(_Slope(weight * row.by_z, weight * row.by_p))
        levels.append(use * ca.log(variance))
        z = z + gain * error
        slope = _Slope(slope.by_z - gain @ row.by_z, slope.by_p - gain @ row.by_p)
        spread = ca.tril2symm(ca.tril(spread - gain @ gain_row.T))
    step = ca.Function("after", [s.z, s.w, s.p], [s.after, *_Slope.of(s.after, s).parts])
    z_next, a, b = step(z, s.w, s.p)
    spread = a @ spread @ a.T + ca.diag(noise[ny:])
    return _Walk(
        (s.z, cov),
        ca.vertcat(s.w, y, use),
        (s.p, noise),
        (z_next, ca.tril(ca.densify(spread)).nz[:]),
        (ca.vertcat(*innovations), ca.vertcat(*levels)),
        _Slope(a, b).after(slope),
        _Slope(ca.vertcat(*[r.by_z for r in rows]), ca.vertcat(*[r.by_p for r in rows])),
    )


@lru_cache(maxsize=32)
def _pass(walk: Walk, model: OutputModel, steps: int, runs: int) -> ca.Function:
    """Return the walk over samples of runs side by side, without derivatives."""
    of = walk(model)
    step = ca.Function(
        "step", [*of.carried, of.read, *of.constant], [*of.after, *of.found], {"cse": True}
    )
    return _over(step, len(of.carried), steps, runs)


@dataclass(frozen=True)
class _Table:
    """Derivatives of one step, at any number of samples at once.

    Parameters
    ----------
    program : Vectorised
        Of the rows [∂z⁺/∂z, ∂z⁺/∂p, 0], and below them those of what is found unless
        `same`.
    shape : tuple of int
    same : bool
        What is found are the states themselves.
    """

    program: Vectorised
    shape: tuple[int, int]
    same: bool


@lru_cache(maxsize=32)
def _table(walk: Walk, model: OutputModel) -> _Table:
    of = walk(model)
    after, found = of.slope_after, of.slope_found
    same = bool(found.by_z.is_eye()) and not found.by_p.nnz()
    nz = after.by_z.size1()
    rows = [ca.horzcat(s.by_z, s.by_p, ca.SX(s.by_z.size1(), nz)) for s in (after, found)]
    matrix = rows[0] if same else ca.vertcat(*rows)
    symbols = ca.vertcat(*of.carried, of.read, *of.constant)
    program = Vectorised(ca.vertsplit(ca.vec(ca.densify(matrix).T)), ca.vertsplit(symbols))
    return _Table(program, matrix.shape, same)


@lru_cache(maxsize=16)
def _likelihood(model: OutputModel, steps: int, runs: int) -> ca.Function:
    """Return ``(z0, [w; y; use], p, noise) -> −log L`` and its derivatives in z0 and p.

    The adjoint runs back over the samples by a step of its own; differentiating the whole
    accumulated filter would take four times as long.
    """
    u = _filtered(model)
    (z, cov), w, (p, noise) = u.carried, u.read, u.constant
    innovations, levels = u.found
    by_z, by_cov, by_p = (ca.SX.sym(f"by_{i}", x.numel()) for i, x in enumerate((z, cov, p)))
    own = (ca.sumsqr(innovations) + ca.sum1(levels)) / 2
    onward = own + ca.dot(by_z, u.after[0]) + ca.dot(by_cov, u.after[1])
    back = ca.Function(
        "back",
        [by_z, by_cov, by_p, z, cov, w, p, noise],
        [ca.gradient(onward, z), ca.gradient(onward, cov), by_p + ca.gradient(onward, p)],
        {"cse": True},
    )
    forth = ca.Function("forth", [z, cov, w, p, noise], [*u.after, own], {"cse": True})
    given = [ca.MX.sym("z0", z.numel()), ca.MX.sym("w", w.numel(), steps)]
    given += [ca.MX.sym("p", p.numel()), ca.MX.sym("noise", noise.numel())]
    start, read, *constant = given
    constants = [ca.repmat(c, 1, steps) for c in constant]
    certain = ca.MX.zeros(cov.numel())
    states, spreads, losses = accumulate(forth, steps, range(2)).call(
        [start, certain, read, *constants]
    )
    before = [ca.horzcat(start, states[:, :-1]), ca.horzcat(certain, spreads[:, :-1])]
    backwards = [x[:, ::-1] for x in (*before, read)]
    nothing = [ca.MX.zeros(x.numel()) for x in (by_z, by_cov, by_p)]
    found = accumulate(back, steps, range(3)).call([*nothing, *backwards, *constants])
    one = ca.Function("likelihood", given, [ca.sum2(losses), found[0][:, -1], found[2][:, -1]])
    # values and the parameters' derivatives add over the runs
    return one if runs == 1 else one.map("runs", "serial", runs, [2, 3], [0, 2])


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


class _Runs:
    """A walk along runs side by side, with derivatives and buffers.

    Parameters
    ----------
    walk : callable
    model : OutputModel
    read : ndarray
        (M, m, nr) what each step reads.
    """

    def __init__(self, walk: Walk, model: OutputModel, read: Array) -> None:
        self._walk, self._model = walk, model
        self.runs, self.steps = read.shape[:2]
        self._read = np.ascontiguousarray(read, float)
        self._evaluate = _Evaluator()
        self._blocks: list[tuple[slice, list[Array], dict[int, Any]]] | None = None

    def __call__(
        self, carried: Sequence[Array], constant: Sequence[Array]
    ) -> tuple[list[Array], list[Array]]:
        """Return what is carried after each step, and what is found, each (M, m, ·)."""
        of = self._walk(self._model)
        function = _pass(self._walk, self._model, self.steps, self.runs)
        out = [np.empty((self.runs, self.steps, x.numel())) for x in (*of.after, *of.found)]
        self._evaluate(function, (*carried, self._read, *constant), tuple(out))
        return out[: len(carried)], out[len(carried) :]

    def _prepared(
        self, table: _Table, first: int
    ) -> list[tuple[slice, list[Array], dict[int, Any]]]:
        """Return, of blocks of samples, what is read and all that depends on it alone."""
        if self._blocks is None:
            flat = self._read.reshape(self.runs * self.steps, self._read.shape[2]).T
            self._blocks = []
            for begin in range(0, flat.shape[1], _BLOCK):
                block = slice(begin, begin + _BLOCK)
                read = [np.ascontiguousarray(x[block]) for x in flat]
                known = table.program.prepare({first + i: x for i, x in enumerate(read)})
                self._blocks.append((block, read, known))
        return self._blocks

    def slopes(
        self, carried: Sequence[Array], constant: Sequence[Array], after: Sequence[Array]
    ) -> tuple[Array, Array]:
        """Return derivatives in the parameters, then in the run's own first states.

        Parameters
        ----------
        carried, constant : sequence of ndarray
            As a call took them.
        after : sequence of ndarray
            What was carried after each step.

        Returns
        -------
        tuple of ndarray
            Of what is found first, (M, m, ny, q + nz), and of the states after the last
            step, (M, nz, q + nz).
        """
        table = _table(self._walk, self._model)
        rows, columns = table.shape
        runs, steps, nz = after[0].shape
        before = [
            np.concatenate([x[:, None], y[:, :-1]], axis=1)
            for x, y in zip(carried, after, strict=True)
        ]
        states = np.concatenate([x.reshape(runs * steps, x.shape[2]).T for x in before])
        fixed = [float(x) for c in constant for x in c]
        matrix = np.empty((runs * steps, rows * columns))
        start = np.zeros((runs, nz, columns - nz))
        start[:, :, columns - 2 * nz :] = np.eye(nz)
        with np.errstate(all="ignore"):
            for block, read, known in self._prepared(table, len(states)):
                table.program([*states[:, block], *read, *fixed], matrix[block].T, known)
            by = matrix.reshape(runs, steps, rows, columns)
            slopes = propagate(by[:, :, :nz, :nz], by[:, :, :nz, nz:], start)
            if table.same:
                return slopes[:, :-1], slopes[:, -1]
            shown = by[:, :, nz:, :nz] @ slopes[:, :-1]
            shown += by[:, :, nz:, nz:]
        return shown, slopes[:, -1]


_Found = TypeVar("_Found", bound=tuple[Array, ...])


def _kept(last: tuple[Array, Array, _Found] | None, z0: Array, p: Array) -> _Found | None:
    """Return what was found last, if it was at this point."""
    if last is None:
        return None
    return last[2] if np.array_equal(last[0], z0) and np.array_equal(last[1], p) else None


def _fixed(*arrays: Array) -> Any:
    """Return arrays that nothing can write to."""
    for array in arrays:
        array.flags.writeable = False
    return arrays


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
        self._runs = _Runs(_free, model, w)
        # the latest run, and the latest whose derivatives were asked for
        self._ran: tuple[Array, Array, tuple[Array, Array]] | None = None
        self._last: tuple[Array, Array, tuple[Array, Array, Array, Array]] | None = None

    def _run(self, z0: Array, p: Array) -> tuple[Array, Array]:
        """Return outputs and the states after each step, not to be written to."""
        found = _kept(self._ran, z0, p)
        if found is None:
            (states,), (y,) = self._runs([z0], [p])
            found = _fixed(y, states)
            self._ran = (z0.copy(), p.copy(), found)
        return found

    def __call__(self, z0: Array, p: Array) -> tuple[Array, Array]:
        """Return outputs (M, m, ny) and the states after the last step (M, nz)."""
        kept = _kept(self._last, z0, p)
        if kept is not None:
            return kept[0], kept[2]
        y, states = self._run(z0, p)
        return y, states[:, -1]

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
            y, states = self._run(z0, p)
            rows, slope = self._runs.slopes([z0], [p], [states])
            kept = _fixed(y, rows, states[:, -1], slope)
            self._last = (z0.copy(), p.copy(), kept)
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
        self._runs = _Runs(_observed, model, np.concatenate([w, y, use[..., None]], axis=2))
        self._unused = use == 0

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
        self._runs = _Runs(_filtered, model, self._w)
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
        nz = z0.shape[1]
        carried = [z0, np.zeros((len(z0), nz * (nz + 1) // 2))]
        after, (innovations, levels) = self._runs(carried, [p, noise])
        if not sensitivities:
            return innovations, np.empty((*innovations.shape, 0)), levels
        rows, _ = self._runs.slopes(carried, [p, noise], after)
        return innovations, rows, levels

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
        function = _likelihood(self.model, *self._w.shape[1::-1])
        out = (np.empty(1), np.empty(z0.shape), np.empty(p.shape))
        self._evaluate(function, (z0, self._w, p, noise), out)
        return float(out[0][0]), out[1], out[2]


def current_means(predictor: Predictor) -> tuple[str, ...]:
    """Return the means of the current that a marine structure can feel."""
    structure = predictor.structure
    if structure.disturbance != "marine":
        return ()
    sees = {f.signal for t in structure.terms for f in t.factors} & {"u", "v"}
    return CURRENT if sees else ()
