"""T-optimality: how different the motions are that two models predict, as a filter sees them.

A Kalman filter of model M, run on the motion that model N predicts, has the
innovations ε(k) = z_N(k) − ẑ_M(k|k−1), and ½ Σ εᵀ S⁻¹ ε is the expected
log-likelihood ratio (the Kullback-Leibler divergence) between the two when N is
true: what process noise would wash out does not count. The filters have steady
gains, from the linearised models and the noise levels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from experiment_design.criteria.objective import Objective, Slope
from experiment_design.excitation.rollout import Motion, Rollout, step_expression
from experiment_design.excitation.schedule import Schedule
from experiment_design.information.moments import InformationModel, Moments
from greybox.model.noise import NoiseLevels
from greybox.model.run.kernels import accumulate

Array = NDArray[np.float64]

# of a heading whose sensor is not described [rad], and a process noise that keeps it tracked
_HEADING, _DRIFT = 0.01, 1e-4


@dataclass(frozen=True)
class SteadyFilter:
    """Gain (n, m) and innovation covariance (m, m) of a model's steady Kalman filter."""

    gain: Array
    covariance: Array


def steady_filter(rollout: Rollout, outputs: tuple[str, ...], noise: NoiseLevels) -> SteadyFilter:
    """Return the steady filter of one model, linearised at its start.

    Parameters
    ----------
    rollout : Rollout
    outputs : tuple of str
        Measured states; ``psi`` is the heading.
    noise : NoiseLevels
    """
    states = (*rollout.structure.states, "psi")
    n = len(states)
    state, commands = rollout.symbols
    vessel = rollout.vessel
    middle = [
        0.5 * ((v.lower or 0.0) + (v.upper or 0.0))
        for v in (vessel.limits[c] for c in vessel.commands)
    ]
    slope = ca.Function("a", [state, commands], [ca.jacobian(rollout.step[:n], state[:n])])
    a = slope([*rollout.start, 0.0, 0.0], middle).full()
    level = dict(zip(noise.states, noise.measurement, strict=True))
    moved = dict(zip(noise.states, noise.process, strict=True))
    level["psi"] = noise.heading or _HEADING
    q = np.diag(
        [max(moved.get(s, 0.0), _DRIFT * (0.1 if s != "psi" else 1.0)) ** 2 for s in states]
    )
    h = np.array([[1.0 if s == o else 0.0 for s in states] for o in outputs])
    r = np.diag([level[o] ** 2 for o in outputs])
    p = solve_discrete_are(a.T, h.T, q, r)
    s = h @ p @ h.T + r
    return SteadyFilter(a @ p @ h.T @ np.linalg.inv(s), s)


class Contrast(Objective):
    """Logarithm of the expected log-likelihood ratio between explanations.

    The two directions (which of them is true) are averaged; over several pairs
    the harmonic mean is taken, which the nearest pair rules.

    Parameters
    ----------
    pairs : sequence of (Rollout, Rollout)
    noise : NoiseLevels
    schedule : Schedule
    """

    def __init__(
        self,
        pairs: Sequence[tuple[Rollout, Rollout]],
        noise: NoiseLevels,
        schedule: Schedule,
    ) -> None:
        self.pairs = [Pair(a, b, noise, schedule.samples) for a, b in pairs]

    @property
    def size(self) -> int:
        """One: it is about no parameter."""
        return 1

    def of_motion(
        self, motion: Motion, information: InformationModel, known: Moments | None
    ) -> Array:
        """Return the objective of R motions, (R,)."""
        return self.value(motion.commands)

    def slope(self, motion: Motion, information: InformationModel, known: Moments | None) -> Slope:
        """Return the objective of one motion, with its derivatives."""
        value, d_commands = self.gradient(motion.commands[0])
        state, tau = motion.state[0, :-1, :-2], motion.tau[0]
        return Slope(value, lambda: (np.zeros_like(state), np.zeros_like(tau), d_commands))

    def value(self, commands: Array) -> Array:
        """Return the objective of sequences (R, N, nc)."""
        return np.array([self._combine([p.distance(c) for p in self.pairs]) for c in commands])

    @staticmethod
    def _combine(distances: list[float]) -> float:
        d = np.array(distances)
        if not (np.isfinite(d).all() and (d > 0).all()):
            return float("-inf")
        return float(np.log(len(d) / (1 / d).sum()))

    def gradient(self, commands: Array) -> tuple[float, Array]:
        """Return the objective of one sequence (N, nc) and its derivative (N, nc)."""
        found = [p.distance_gradient(commands) for p in self.pairs]
        d = np.array([f[0] for f in found])
        value = self._combine(list(d))
        if not np.isfinite(value):
            return value, np.zeros_like(commands)
        weights = (1 / d**2) / (1 / d).sum()
        return value, np.asarray(sum(w * f[1] for w, f in zip(weights, found, strict=True)))


class Pair:
    """Two models of the same states on the same commands, each filtered by the other.

    Parameters
    ----------
    first, second : Rollout
    noise : NoiseLevels
    samples : int
        N.
    """

    def __init__(self, first: Rollout, second: Rollout, noise: NoiseLevels, samples: int) -> None:
        self.first, self.second, self.samples = first, second, samples
        states = first.structure.states
        self.outputs = (*states, "psi") if "r" in states else states
        self._filters = [steady_filter(m, self.outputs, noise) for m in (first, second)]
        self.roots = [np.linalg.cholesky(np.linalg.inv(f.covariance)).T for f in self._filters]
        self._build()

    def _build(self) -> None:
        models = (self.first, self.second)
        commands = ca.SX.sym("c", len(self.first.vessel.commands))
        # parameters stay symbolic, so that innovations can be differentiated in them
        theta = [ca.SX.sym(f"theta{i}", m.theta.size + m.d.size) for i, m in enumerate(models)]
        sizes = [m.nx + 1 for m in models]
        steps = []
        for m, t in zip(models, theta, strict=True):
            split = m.theta.size
            symbols, stepped = step_expression(
                m.vessel, m.structure, t[:split], t[split:], m.sample_time, m.integrator
            )
            n = m.nx + 1
            steps.append(ca.Function("step", [symbols[0][:n], symbols[1], t], [stepped[:n]]))
        picks = [[(*m.structure.states, "psi").index(o) for o in self.outputs] for m in models]
        # the motion of each model, and the estimate of each filter on the other's motion
        x = [ca.SX.sym(f"x{i}", n) for i, n in enumerate(sizes)]
        e = [ca.SX.sym(f"e{i}", n) for i, n in enumerate(sizes)]
        after: list[ca.SX] = []
        whitened: list[ca.SX] = []
        for i in range(2):
            other = 1 - i
            innovation = x[other][picks[other]] - e[i][picks[i]]
            gain = ca.DM(self._filters[i].gain)
            after.append(steps[i](e[i], commands, theta[i]) + gain @ innovation)
            whitened.append(ca.DM(self.roots[i]) @ innovation)
        moved = [steps[i](x[i], commands, theta[i]) for i in range(2)]
        joint = ca.vertcat(*x, *e)
        cost = sum((ca.sumsqr(w) for w in whitened), ca.SX(0)) / 4
        # innovations come before the step: what is seen at sample k+1 is the next call's
        step = ca.Function(
            "joint",
            [joint, commands, ca.vertcat(*theta)],
            [ca.vertcat(*moved, *after), cost, ca.vertcat(*whitened)],
            {"cse": True},
        )
        n = self.samples
        run = accumulate(step, n)
        mx = ca.MX.sym("commands", commands.numel(), n)
        parameters = ca.MX.sym("theta", sum(t.numel() for t in theta))
        start = np.concatenate(
            [self.first.start, self.second.start, self.first.start, self.second.start]
        )
        final, costs, whites = run(ca.DM(start), mx, ca.repmat(parameters, 1, n))
        del final
        total = ca.sum2(costs)
        self._value = ca.Function("value", [mx, parameters], [total])
        self._slope = ca.Function("slope", [mx, parameters], [total, ca.gradient(total, mx)])
        self._whites = ca.Function("whites", [mx, parameters], [whites])
        self._parameters = np.concatenate([np.concatenate([m.theta, m.d]) for m in models])

    def distance(self, commands: Array) -> float:
        """Return the mean expected log-likelihood ratio of both directions."""
        return float(self._value(commands.T, self._parameters))

    def distance_gradient(self, commands: Array) -> tuple[float, Array]:
        """Return it with its derivative in the commands (N, nc)."""
        value, slope = self._slope(commands.T, self._parameters)
        return float(value), slope.full().T

    def innovations(self, commands: Array, parameters: Array | None = None) -> tuple[Array, Array]:
        """Return whitened innovations, (2, N·m) in effect: the first model's filter, the second's.

        Parameters
        ----------
        commands : ndarray
            (N, nc)
        parameters : ndarray, optional
            Parameters and disturbances of the first, then of the second model.
        """
        values = self._whites(commands.T, self._parameters if parameters is None else parameters)
        half = len(self.outputs)
        full = values.full()
        return full[:half].T.ravel(), full[half:].T.ravel()

    def sensitivities(self, commands: Array, which: int, positions: list[int]) -> Array:
        """Return how the innovations of one model's filter move with its parameters.

        Parameters
        ----------
        which : int
            0 or 1: the model whose filter runs on the other's motion.
        positions : list of int
            Of the parameters (and disturbances) of that model.

        Returns
        -------
        ndarray
            (N·m, len(positions))
        """
        first = 0 if which == 0 else self.first.theta.size + self.first.d.size
        base = self._parameters
        columns = []
        for position in positions:
            size = max(abs(base[first + position]), 1e-3) * 1e-5
            pair = []
            for sign in (1, -1):
                moved = base.copy()
                moved[first + position] += sign * size
                pair.append(self.innovations(commands, moved)[which])
            columns.append((pair[0] - pair[1]) / (2 * size))
        return np.array(columns).T
