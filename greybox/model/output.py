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
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from greybox.errors import StructureError
from greybox.model.disturbances import CURRENT, WIND, rotate_to_body
from greybox.model.functions import accumulate, bind
from greybox.model.predictor import Column, Predictor

Array = NDArray[np.float64]
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


def _with_slopes(
    given: Sequence[ca.SX],
    carried: Sequence[ca.SX],
    found: Sequence[ca.SX],
    after: _Slope,
    seen: _Slope,
    sensitivities: bool,
) -> ca.Function:
    """Return a step that carries the derivatives of the states along.

    The scalar instructions give the slopes of one step; their product with the
    derivatives so far is one of dense matrices, at half the time of scalars.

    Parameters
    ----------
    given : sequence of SX
        States, what else is carried, then what the step reads.
    carried, found : sequence of SX
        Next values of what is carried, and results; the derivatives stand after the
        carried ones and after the first result.
    after, seen : _Slope
        Of the next states and of the first result.
    sensitivities : bool
        Without, the derivatives have no columns.
    """
    nz, q = given[0].numel(), after.by_p.size2()
    ny = seen.by_z.size1()
    k = len(carried)
    if not sensitivities:
        none = ca.SX.sym("S", nz, 0)
        return ca.Function(
            "step",
            [*given[:k], none, *given[k:]],
            [*carried, ca.SX(nz, 0), found[0], ca.SX(ny, 0), *found[1:]],
            {"cse": True},
        )
    slopes = [after.by_z, after.by_p, seen.by_z, seen.by_p]
    one = ca.Function("one", list(given), [*carried, *found, *slopes], {"cse": True})
    symbols = [ca.MX.sym(f"a{i}", x.sparsity()) for i, x in enumerate(given)]
    sens = ca.MX.sym("S", nz, q + nz)
    out = one.call(symbols)
    values, (a, b, h, d) = out[: k + len(found)], out[k + len(found) :]

    def moved(by_z: ca.MX, by_p: ca.MX) -> ca.MX:
        return ca.densify(by_z @ sens + ca.horzcat(by_p, ca.MX(by_z.size1(), nz)))

    # sensors that show the states themselves show their derivatives
    same = seen.by_z.is_eye() and not seen.by_p.nnz()
    return ca.Function(
        "step",
        [*symbols[:k], sens, *symbols[k:]],
        [*values[:k], moved(a, b), values[k], sens if same else moved(h, d), *values[k + 1 :]],
    )


@lru_cache(maxsize=32)
def _run(model: OutputModel, steps: int, runs: int, sensitivities: bool) -> ca.Function:
    """Return ``(z0, S0, W, p) -> z after each step, S, y before each step, ∂y``, runs side by side.

    Parameters are the same for all runs of a call.
    """
    s = _step(model)
    after, seen = _Slope.of(s.after, s), _Slope.of(s.seen, s)
    step = _with_slopes([s.z, s.w, s.p], [s.after], [s.seen], after, seen, sensitivities)
    return _over(step, 2, steps, runs)


@lru_cache(maxsize=32)
def _observed(model: OutputModel, steps: int, runs: int, sensitivities: bool) -> ca.Function:
    """Return ``(z, S, [w; y; use], p, gain) -> z⁺, S⁺, y − h(z), ∂h``, measured states corrected.

    Each step is taken from z + gain (y − z); S and ∂h are as those of `_run`.
    """
    s = _step(model)
    nz, ny = s.z.numel(), s.seen.numel()
    y, use, gain = ca.SX.sym("y", ny), ca.SX.sym("use"), ca.SX.sym("gain")
    kept = 1 - use * gain
    corrected = kept * s.z + use * gain * y[:nz]
    after = ca.substitute(s.after, s.z, corrected)
    step = _with_slopes(
        [s.z, ca.vertcat(s.w, y, use), s.p, gain],
        [after],
        [use * (y - s.seen)],
        _Slope.of(after, s),
        _Slope.of(s.seen, s),
        sensitivities,
    )
    return _over(step, 2, steps, runs)


def _over(step: ca.Function, carried: int, steps: int, runs: int) -> ca.Function:
    """Accumulate a step over samples, its last arguments constant, and over runs side by side.

    Arguments are the carried ones, then one that changes with the sample, then
    constants.
    """
    accumulated = accumulate(step, steps, range(carried))
    given = [
        ca.MX.sym(f"a{i}", step.size1_in(i), step.size2_in(i) * (steps if i == carried else 1))
        for i in range(step.n_in())
    ]
    spread = [
        value if i <= carried else ca.repmat(value, 1, steps) for i, value in enumerate(given)
    ]
    one = ca.Function("run", given, accumulated.call(spread))
    if runs == 1:
        return one
    # the constants are given once
    many = one.map("runs", "serial", runs, list(range(carried + 1, step.n_in())), [])
    return many


@dataclass(frozen=True)
class _Update:
    """One sample of an extended Kalman filter in symbols.

    Arguments are the states, their covariance (its lower triangle), what the sample
    reads (drivers, measurements, whether they count), parameters and variances; results
    the next states and covariance, innovations of unit variance and the logarithms of
    their variances.
    """

    given: tuple[ca.SX, ca.SX, ca.SX, ca.SX, ca.SX]
    after: ca.SX
    spread: ca.SX
    innovations: ca.SX
    levels: ca.SX
    slope_after: _Slope
    slope_seen: _Slope


@lru_cache(maxsize=32)
def _update(model: OutputModel) -> _Update:
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
    return _Update(
        (s.z, cov, ca.vertcat(s.w, y, use), s.p, noise),
        z_next,
        ca.tril(ca.densify(spread)).nz[:],
        ca.vertcat(*innovations),
        ca.vertcat(*levels),
        _Slope(a, b).after(slope),
        _Slope(ca.vertcat(*[r.by_z for r in rows]), ca.vertcat(*[r.by_p for r in rows])),
    )


@lru_cache(maxsize=32)
def _filter(model: OutputModel, steps: int, runs: int, sensitivities: bool) -> ca.Function:
    """Return the extended Kalman filter with sensitivities at its gains.

    ``(z, P, S, [w; y; use], p, noise) -> z⁺, P⁺, S⁺, ν, ∂ν, log v`` with ν the
    innovations one channel after another, each divided by its deviation √v.
    """
    u = _update(model)
    step = _with_slopes(
        u.given,
        [u.after, u.spread],
        [u.innovations, u.levels],
        u.slope_after,
        u.slope_seen,
        sensitivities,
    )
    return _over(step, 3, steps, runs)


@lru_cache(maxsize=16)
def _likelihood(model: OutputModel, steps: int, runs: int) -> ca.Function:
    """Return ``(z0, [w; y; use], p, noise) -> −log L`` and its derivatives in z0 and p.

    The adjoint runs back over the samples by a step of its own; differentiating the whole
    accumulated filter would take four times as long.
    """
    u = _update(model)
    z, cov, w, p, noise = u.given
    by_z, by_cov, by_p = (ca.SX.sym(f"by_{i}", x.numel()) for i, x in enumerate((z, cov, p)))
    own = (ca.sumsqr(u.innovations) + ca.sum1(u.levels)) / 2
    onward = own + ca.dot(by_z, u.after) + ca.dot(by_cov, u.spread)
    back = ca.Function(
        "back",
        [by_z, by_cov, by_p, z, cov, w, p, noise],
        [ca.gradient(onward, z), ca.gradient(onward, cov), by_p + ca.gradient(onward, p)],
        {"cse": True},
    )
    forth = ca.Function("forth", list(u.given), [u.after, u.spread, own], {"cse": True})
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
        self.runs, self.steps = w.shape[:2]
        self.nz, self.ny = len(model.states), len(model.outputs)
        self.q = len(model.parameters)
        self._w = np.ascontiguousarray(w, float)
        self._evaluate = _Evaluator()
        self._last: tuple[Array, Array, tuple[Array, Array, Array, Array]] | None = None

    def _kept(self, z0: Array, p: Array) -> tuple[Array, Array, Array, Array] | None:
        """Return the latest run with derivatives, if it was of this point."""
        if self._last is None:
            return None
        same = np.array_equal(self._last[0], z0) and np.array_equal(self._last[1], p)
        return self._last[2] if same else None

    def __call__(self, z0: Array, p: Array) -> tuple[Array, Array]:
        """Return outputs (M, m, ny) and the states after the last step (M, nz)."""
        kept = self._kept(z0, p)
        if kept is not None:
            return kept[0], kept[2]
        end, _, y, _ = self._call(z0, p, sensitivities=False)
        return y, end[:, -1]

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
            Outputs (M, m, ny); their derivatives (M, m, q + nz, ny); states after
            the last step (M, nz) and their derivatives (M, q + nz, nz). Not to be written
            to: the latest are kept, for the same point is asked for with other weights.
        """
        kept = self._kept(z0, p)
        if kept is None:
            end, slope, y, rows = self._call(z0, p, sensitivities=True)
            kept = (y, rows, end[:, -1], slope[:, -1])
            for part in kept:
                part.flags.writeable = False
            self._last = (z0.copy(), p.copy(), kept)
        return kept

    def _call(
        self, z0: Array, p: Array, *, sensitivities: bool
    ) -> tuple[Array, Array, Array, Array]:
        runs, steps, nz, ny = self.runs, self.steps, self.nz, self.ny
        columns = self.q + nz if sensitivities else 0
        function = _run(self.model, steps, runs, sensitivities)
        first = np.zeros((runs, columns, nz))
        if columns:
            first[:, self.q :] = np.eye(nz)
        out = (
            np.empty((runs, steps, nz)),
            np.empty((runs, steps, columns, nz)),
            np.empty((runs, steps, ny)),
            np.empty((runs, steps, columns, ny)),
        )
        self._evaluate(function, (z0, first, self._w, p), out)
        return out


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
        self.runs, self.steps = w.shape[:2]
        self.nz, self.ny = len(model.states), len(model.outputs)
        self.q = len(model.parameters)
        self._w = np.ascontiguousarray(np.concatenate([w, y, use[..., None]], axis=2), float)
        self._evaluate = _Evaluator()
        self._use = use[..., None] > 0

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
            (M, m, q + nz, ny).
        """
        runs, steps, nz, ny = self.runs, self.steps, self.nz, self.ny
        columns = self.q + nz if sensitivities else 0
        function = _observed(self.model, steps, runs, sensitivities)
        first = np.zeros((runs, columns, nz))
        if columns:
            first[:, self.q :] = np.eye(nz)
        out = (
            np.empty((runs, steps, nz)),
            np.empty((runs, steps, columns, nz)),
            np.empty((runs, steps, ny)),
            np.empty((runs, steps, columns, ny)),
        )
        self._evaluate(function, (z0, first, self._w, p, np.array([gain])), out)
        if columns and not self._use.all():
            out[3][~self._use[..., 0]] = 0.0
        return out[2], out[3]


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
        self.runs, self.steps = w.shape[:2]
        self.nz, self.ny = len(model.states), len(model.outputs)
        self.q = len(model.parameters)
        self._w = np.ascontiguousarray(np.concatenate([w, y, use[..., None]], axis=2), float)
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
            gains held (M, m, q + nz, ny), negative derivatives of the innovations;
            and the logarithms of their variances (M, m, ny).
        """
        runs, steps, nz, ny = self.runs, self.steps, self.nz, self.ny
        columns = self.q + nz if sensitivities else 0
        function = _filter(self.model, steps, runs, sensitivities)
        first = np.zeros((runs, columns, nz))
        if columns:
            first[:, self.q :] = np.eye(nz)
        out = (
            np.empty((runs, steps, nz)),
            np.empty((runs, steps, nz * (nz + 1) // 2)),
            np.empty((runs, steps, columns, nz)),
            np.empty((runs, steps, ny)),
            np.empty((runs, steps, columns, ny)),
            np.empty((runs, steps, ny)),
        )
        certain = np.zeros((runs, nz * (nz + 1) // 2))
        self._evaluate(function, (z0, certain, first, self._w, p, noise), out)
        return out[3], out[4], out[5]

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
        function = _likelihood(self.model, self.steps, self.runs)
        out = (np.empty(1), np.empty((self.runs, self.nz)), np.empty(self.q))
        self._evaluate(function, (z0, self._w, p, noise), out)
        return float(out[0][0]), out[1], out[2]


def current_means(predictor: Predictor) -> tuple[str, ...]:
    """Return the means of the current that a marine structure can feel."""
    structure = predictor.structure
    if structure.disturbance != "marine":
        return ()
    sees = {f.signal for t in structure.terms for f in t.factors} & {"u", "v"}
    return CURRENT if sees else ()
