"""A model as a simulator of what the sensors see, with exact sensitivities.

States z are those of the structure and, where it is simulated, the heading; the
outputs are the measured states, and the heading and the velocity through the
air where they count as measurements and not as inputs. The parameters are the
coefficients of a predictor's columns, followed by disturbance means. One symbolic
step, differentiated once, gives the free run (output error) and, with the
covariance of an extended Kalman filter beside it, the innovations.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

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


@lru_cache(maxsize=32)
def _run(model: OutputModel, steps: int, runs: int, sensitivities: bool) -> ca.Function:
    """Return ``(z0, S0, W, p) -> z after each step, S, y before each step, ∂y``, runs side by side.

    Parameters are the same for all runs of a call.
    """
    s = _step(model)
    nz, q = s.z.numel(), s.p.numel()
    columns = q + nz if sensitivities else 0
    a, h = ca.jacobian(s.after, s.z), ca.jacobian(s.seen, s.z)
    sens = ca.SX.sym("S", nz, columns)
    after, seen = ca.SX(nz, columns), ca.SX(s.seen.numel(), columns)
    if sensitivities:
        rest = nz
        after = a @ sens + ca.horzcat(ca.jacobian(s.after, s.p), ca.SX(nz, rest))
        seen = h @ sens + ca.horzcat(ca.jacobian(s.seen, s.p), ca.SX(s.seen.numel(), rest))
    step = ca.Function(
        "step",
        [s.z, sens, s.w, s.p],
        [s.after, ca.densify(after), s.seen, ca.densify(seen)],
        {"cse": True},
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


@lru_cache(maxsize=32)
def _filter(model: OutputModel, steps: int, runs: int, sensitivities: bool) -> ca.Function:
    """Return the extended Kalman filter with sensitivities at its gains.

    ``(z, P, S, [w; y; use], p, noise) -> z⁺, P⁺, S⁺, ν, ∂ν, log v`` with ν the
    innovations one channel after another, each divided by its deviation √v.
    """
    s = _step(model)
    nz, q, ny = s.z.numel(), s.p.numel(), s.seen.numel()
    columns = q + nz if sensitivities else 0
    y, use = ca.SX.sym("y", ny), ca.SX.sym("use")
    noise = ca.SX.sym("noise", ny + nz)
    cov = ca.SX.sym("P", nz, nz)
    sens = ca.SX.sym("S", nz, columns)
    seen = ca.Function("seen", [s.z, s.w, s.p], [s.seen, ca.jacobian(s.seen, s.z),
                                                 ca.jacobian(s.seen, s.p)])  # fmt: skip
    z, spread, slope = s.z, cov, sens
    innovations, derivatives, levels = [], [], []
    for i in range(ny):
        shown, by_z, by_p = seen(z, s.w, s.p)
        h = ca.densify(by_z[i, :])
        gain_row = spread @ h.T
        variance = h @ gain_row + noise[i]
        # rows beyond the log's end change nothing
        gain = use * gain_row / variance
        error = y[i] - shown[i]
        row = h @ slope
        if sensitivities:
            row = row + ca.horzcat(ca.densify(by_p[i, :]), ca.SX.zeros(1, nz))
        innovations.append(use * error / ca.sqrt(variance))
        derivatives.append(use * row / ca.sqrt(variance))
        levels.append(use * ca.log(variance))
        z = z + gain * error
        slope = slope - gain @ row
        spread = spread - gain @ gain_row.T
    after = ca.Function("after", [s.z, s.w, s.p], [s.after, ca.jacobian(s.after, s.z),
                                                   ca.jacobian(s.after, s.p)])  # fmt: skip
    z_next, a, b = after(z, s.w, s.p)
    slope = a @ slope
    if sensitivities:
        slope = slope + ca.horzcat(ca.densify(b), ca.SX.zeros(nz, nz))
    spread = a @ spread @ a.T + ca.diag(noise[ny:])
    step = ca.Function(
        "step",
        [s.z, cov, sens, ca.vertcat(s.w, y, use), s.p, noise],
        [
            z_next,
            ca.densify((spread + spread.T) / 2),
            ca.densify(slope),
            ca.vertcat(*innovations),
            ca.densify(ca.vertcat(*derivatives)),
            ca.vertcat(*levels),
        ],
        {"cse": True},
    )
    return _over(step, 3, steps, runs)


@lru_cache(maxsize=16)
def _likelihood(model: OutputModel, steps: int, runs: int) -> ca.Function:
    """Return ``(z0, [w; y; use], p, noise) -> −log L`` and its derivatives in z0 and p."""
    run = _filter(model, steps, runs, sensitivities=False)
    nz = run.size1_in(0)
    z0, w = ca.MX.sym("z0", nz, runs), ca.MX.sym("w", run.size1_in(3), runs * steps)
    p, noise = ca.MX.sym("p", run.size1_in(4)), ca.MX.sym("noise", run.size1_in(5))
    out = run.call([z0, ca.MX.zeros(nz, nz * runs), ca.MX(nz, 0), w, p, noise])
    value = (ca.sumsqr(out[3]) + ca.sum2(ca.sum1(out[5]))) / 2
    slopes = [ca.gradient(value, v) for v in (z0, p)]
    return ca.Function("likelihood", [z0, w, p, noise], [value, *slopes])


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
        self._last: tuple[Array, Array, tuple[Array, Array, Array, Array]] | None = None

    def __call__(self, z0: Array, p: Array) -> tuple[Array, Array]:
        """Return outputs (M, m, ny) and the states after the last step (M, nz)."""
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
        last = self._last
        if last is None or not (np.array_equal(last[0], z0) and np.array_equal(last[1], p)):
            end, slope, y, rows = self._call(z0, p, sensitivities=True)
            last = (z0.copy(), p.copy(), (y, rows, end[:, -1], slope[:, -1]))
            for part in last[2]:
                part.flags.writeable = False
            self._last = last
        return last[2]

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
        _evaluate(function, (z0, first, self._w, p), out)
        return out


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
            np.empty((runs, steps, nz, nz)),
            np.empty((runs, steps, columns, nz)),
            np.empty((runs, steps, ny)),
            np.empty((runs, steps, columns, ny)),
            np.empty((runs, steps, ny)),
        )
        _evaluate(function, (z0, np.zeros((runs, nz, nz)), first, self._w, p, noise), out)
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
        _evaluate(function, (z0, self._w, p, noise), out)
        return float(out[0][0]), out[1], out[2]


def _evaluate(function: ca.Function, arguments: tuple[Array, ...], out: tuple[Array, ...]) -> None:
    buffer, trigger = function.buffer()
    held = [np.ascontiguousarray(a, float) for a in arguments]
    for i, a in enumerate(held):
        if a.size:
            bind(buffer.set_arg, i, a)
    for i, a in enumerate(out):
        if a.size:
            bind(buffer.set_res, i, a)
    trigger()


def current_means(predictor: Predictor) -> tuple[str, ...]:
    """Return the means of the current that a marine structure can feel."""
    structure = predictor.structure
    if structure.disturbance != "marine":
        return ()
    sees = {f.signal for t in structure.terms for f in t.factors} & {"u", "v"}
    return CURRENT if sees else ()
