"""One step of an output model in symbols, with its derivatives.

The same step, differentiated once, gives the free run (output error), a run that an
observer corrects and, with the covariance of an extended Kalman filter beside it, the
innovations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import casadi as ca

from greybox.model.disturbances import WIND, velocity_through
from greybox.model.output import OutputModel
from greybox.model.run.kernels import accumulate
from greybox.model.run.step import Heading, StepModel


@dataclass(frozen=True)
class _Step:
    """Symbols and expressions of one step."""

    z: ca.SX
    w: ca.SX
    p: ca.SX
    next_state: ca.SX
    outputs: ca.SX


@lru_cache(maxsize=64)
def _step(model: OutputModel) -> _Step:
    predictor = model.predictor
    structure = predictor.structure
    names, count = structure.states, len(predictor.columns)
    z = ca.SX.sym("z", len(model.states))
    w = ca.SX.sym("w", len(model.drivers))
    p = ca.SX.sym("p", len(model.parameters))
    given = {name: w[i] for i, name in enumerate(model.drivers)}
    none = ca.SX(0)
    turns = model.heading == "output"
    heading = z[len(names)] if turns else given.get("psi", none)
    mean = {name: p[count + i] for i, name in enumerate(model.means)}
    air = ca.vertcat(given.get("u_q", none), given.get("v_q", none))
    if model.wind == "output":
        state = {name: z[i] for i, name in enumerate(names)}
        air = ca.vertcat(*velocity_through(state, heading, *[mean[n] for n in WIND]))
    role: Heading = "simulated" if turns else "measured"
    step = StepModel.of_predictor(predictor, role, model.integrator)
    next_state = step(
        z[: len(names)],
        heading,
        ca.vertcat(*[given[n] for n in structure.inputs]),
        ca.vertcat(*[mean.get(n, none) for n in structure.disturbances]),
        air,
        p[:count],
        model.sample_time,
    )
    outputs = ca.vertcat(z, air) if model.wind == "output" else z
    return _Step(z, w, p, ca.densify(next_state), ca.densify(outputs))


@dataclass(frozen=True)
class Jacobian:
    """Derivatives of an expression in the carried states and in the parameters."""

    by_z: ca.SX
    by_p: ca.SX

    @classmethod
    def of(cls, expression: ca.SX, s: _Step) -> Jacobian:
        """Differentiate."""
        return cls(ca.jacobian(expression, s.z), ca.jacobian(expression, s.p))

    @property
    def parts(self) -> tuple[ca.SX, ca.SX]:
        """Both."""
        return self.by_z, self.by_p

    def chained(self, before: Jacobian) -> Jacobian:
        """Return it by the chain rule, where the states have derivatives already."""
        return Jacobian(self.by_z @ before.by_z, self.by_z @ before.by_p + self.by_p)


@dataclass(frozen=True)
class OutputStep:
    """A step in symbols, what is found at it, and the derivatives of both.

    Parameters
    ----------
    carried : tuple of SX
        What a step hands to the next one, first the states.
    read : SX
        What changes with the sample.
    constant : tuple of SX
        What does not, first the parameters.
    next, results : tuple of SX
        Next values of what is carried, and what is found at the sample.
    next_jacobian, result_jacobian : Jacobian
        Of the next states, and of the first result.
    """

    carried: tuple[ca.SX, ...]
    read: ca.SX
    constant: tuple[ca.SX, ...]
    next: tuple[ca.SX, ...]
    results: tuple[ca.SX, ...]
    next_jacobian: Jacobian
    result_jacobian: Jacobian


StepBuilder = Callable[[OutputModel], OutputStep]


@lru_cache(maxsize=32)
def free_run_step(model: OutputModel) -> OutputStep:
    """Return the step of the free run, which shows its outputs before it."""
    s = _step(model)
    jacobians = Jacobian.of(s.next_state, s), Jacobian.of(s.outputs, s)
    return OutputStep((s.z,), s.w, (s.p,), (s.next_state,), (s.outputs,), *jacobians)


@lru_cache(maxsize=32)
def observer_step(model: OutputModel) -> OutputStep:
    """Return the step of an observer, which begins at z + gain (y − z) and shows y − h(z).

    The derivatives of what is found are those of h.
    """
    s = _step(model)
    nz, ny = s.z.numel(), s.outputs.numel()
    y, use, gain = ca.SX.sym("y", ny), ca.SX.sym("use"), ca.SX.sym("gain")
    kept = 1 - use * gain
    corrected = kept * s.z + use * gain * y[:nz]
    moved = ca.substitute(s.next_state, s.z, corrected)
    read = ca.vertcat(s.w, y, use)
    error = use * (y - s.outputs)
    jacobians = Jacobian.of(moved, s), Jacobian.of(s.outputs, s)
    return OutputStep((s.z,), read, (s.p, gain), (moved,), (error,), *jacobians)


@lru_cache(maxsize=32)
def filter_step(model: OutputModel) -> OutputStep:
    """Return one sample of an extended Kalman filter.

    It carries the states and their covariance (its lower triangle), reads drivers,
    measurements and whether they count, and shows innovations of unit variance and the
    logarithms of their variances. Derivatives are at its gains, and of what is taken
    from the innovations.
    """
    s = _step(model)
    nz, ny = s.z.numel(), s.outputs.numel()
    y, use = ca.SX.sym("y", ny), ca.SX.sym("use")
    noise = ca.SX.sym("noise", ny + nz)
    # a covariance is carried by its lower triangle: half of what follows is never computed
    cov = ca.SX.sym("P", nz * (nz + 1) // 2)
    at = ca.Function("outputs", [s.z, s.w, s.p], [s.outputs, *Jacobian.of(s.outputs, s).parts])
    z, spread = s.z, ca.tril2symm(ca.SX(ca.Sparsity.lower(nz), cov))
    jacobian = Jacobian(ca.SX.eye(nz), ca.SX(nz, s.p.numel()))
    innovations, rows, levels = [], [], []
    for i in range(ny):
        shown, by_z, by_p = at(z, s.w, s.p)
        h = ca.densify(by_z[i, :])
        gain_row = spread @ h.T
        variance = h @ gain_row + noise[i]
        # rows beyond the log's end change nothing
        gain = use * gain_row / variance
        error = y[i] - shown[i]
        row = Jacobian(by_z[i, :], by_p[i, :]).chained(jacobian)
        weight = use / ca.sqrt(variance)
        innovations.append(weight * error)
        rows.append(Jacobian(weight * row.by_z, weight * row.by_p))
        levels.append(use * ca.log(variance))
        z = z + gain * error
        jacobian = Jacobian(jacobian.by_z - gain @ row.by_z, jacobian.by_p - gain @ row.by_p)
        spread = ca.tril2symm(ca.tril(spread - gain @ gain_row.T))
    step = ca.Function("next", [s.z, s.w, s.p], [s.next_state, *Jacobian.of(s.next_state, s).parts])
    z_next, a, b = step(z, s.w, s.p)
    spread = a @ spread @ a.T + ca.diag(noise[ny:])
    return OutputStep(
        (s.z, cov),
        ca.vertcat(s.w, y, use),
        (s.p, noise),
        (z_next, ca.tril(ca.densify(spread)).nz[:]),
        (ca.vertcat(*innovations), ca.vertcat(*levels)),
        Jacobian(a, b).chained(jacobian),
        Jacobian(ca.vertcat(*[r.by_z for r in rows]), ca.vertcat(*[r.by_p for r in rows])),
    )


@lru_cache(maxsize=32)
def filter_step_by_noise(model: OutputModel) -> OutputStep:
    """Return `filter_step` with other derivatives: in the variances, gains and covariance included.

    They are those of all that it carries and of all that it finds, stacked.
    """
    of, s = filter_step(model), _step(model)
    carried, noise = ca.vertcat(*of.carried), of.constant[1]

    def jacobian(results: tuple[ca.SX, ...]) -> Jacobian:
        stacked = ca.vertcat(*results)
        return Jacobian(ca.jacobian(stacked, carried), ca.jacobian(stacked, noise))

    following, nz = jacobian(of.next), s.z.numel()
    if Jacobian.of(s.outputs, s).by_z.is_eye():
        # gains follow the covariance alone. A change D of it is a change D λ of the states, λ
        # being what the innovations tell of them, and C D Cᵀ a step later, C = ∂z⁺/∂z: a
        # tenth of what differentiating the Riccati step would compute
        c, told = of.next_jacobian.by_z, of.result_jacobian.by_z.T @ of.results[0]
        units = _symmetric_units(nz)
        moved = ca.horzcat(*[d @ told for d in units])
        onward = ca.horzcat(*[ca.tril(ca.densify(c @ d @ c.T)).nz[:] for d in units])
        following.by_z[:nz, nz:] = c @ moved
        following.by_z[nz:, nz:] = onward + following.by_z[nz:, :nz] @ moved
    return replace(of, next_jacobian=following, result_jacobian=jacobian(of.results))


def _symmetric_units(n: int) -> list[ca.SX]:
    """Return the symmetric matrices with one entry of the lower triangle, column by column."""
    low = ca.Sparsity.lower(n)
    return [ca.tril2symm(ca.sparsify(ca.SX(low, x))) for x in ca.horzsplit(ca.DM.eye(low.nnz()))]


@lru_cache(maxsize=16)
def likelihood(model: OutputModel, steps: int, runs: int) -> ca.Function:
    """Return ``(z0, [w; y; use], p, noise) -> −log L`` and its derivatives in z0 and p.

    The adjoint runs back over the samples by a step of its own; differentiating the whole
    accumulated filter would take four times as long.
    """
    u = filter_step(model)
    (z, cov), w, (p, noise) = u.carried, u.read, u.constant
    innovations, levels = u.results
    by_z, by_cov, by_p = (ca.SX.sym(f"by_{i}", x.numel()) for i, x in enumerate((z, cov, p)))
    own = (ca.sumsqr(innovations) + ca.sum1(levels)) / 2
    onward = own + ca.dot(by_z, u.next[0]) + ca.dot(by_cov, u.next[1])
    back = ca.Function(
        "back",
        [by_z, by_cov, by_p, z, cov, w, p, noise],
        [ca.gradient(onward, z), ca.gradient(onward, cov), by_p + ca.gradient(onward, p)],
        {"cse": True},
    )
    forth = ca.Function("forth", [z, cov, w, p, noise], [*u.next, own], {"cse": True})
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
