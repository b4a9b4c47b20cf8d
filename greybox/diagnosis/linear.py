"""Derivatives of every step along a run, in the state and in chosen numbers.

Those of the rate come from the structure's own expression, on all samples at once;
a step of several stages follows from them by the chain rule.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from greybox.model.run.step import StepModel
from greybox.numerics.recursion import propagate
from greybox.numerics.vectorised import Vectorised

Array = NDArray[np.float64]

# no number but the state
NOWHERE = np.zeros(0, int)


@dataclass(frozen=True)
class Linear:
    """Derivatives of each step along a run.

    Parameters
    ----------
    a : ndarray
        (N−1, nx, nx) in the state before.
    driven : ndarray
        (N−1, nx, m) in the numbers that were asked for.
    """

    a: Array
    driven: Array


def means(d: ca.SX, current: ca.SX) -> ca.SX:
    """Return disturbance means for the symbols d: a current, and no wind that is not measured."""
    unknown = d.numel()
    return ca.vertcat(current, ca.SX.zeros(max(unknown - 2, 0)))[:unknown]


class Slopes:
    """Derivatives of a step in a current.

    Parameters
    ----------
    step : StepModel
        With the measured heading.
    """

    def __init__(self, step: StepModel) -> None:
        self._step = step
        s, f = step.symbolic, step.increment
        self._states = s.x.numel()
        current = ca.SX.sym("current", 2)
        others = (s.psi, s.tau, means(s.d, current), s.air, s.theta)
        slopes = ca.jacobian(f(s.x, *others), ca.vertcat(s.x, s.theta, current))
        symbols = [s.x, s.tau, s.psi, s.air, current, s.theta]
        of_slopes = ca.Function("slopes", symbols, [ca.densify(slopes)])
        stages: list[ca.SX] = []

        def stage(x: ca.SX) -> ca.SX:
            stages.append(of_slopes(x, *symbols[1:]))
            return f(x, *others)

        step.moved(stage, s.x)
        self._shape = (len(stages), *slopes.shape)
        flat = ca.vertcat(*[ca.vec(stage.T) for stage in stages])
        self._program = Vectorised(ca.vertsplit(flat), ca.vertsplit(ca.vertcat(*symbols)))

    def __call__(self, x: Array, drivers: Array, theta: Array, places: Array) -> Linear:
        """Return the derivatives along a run.

        Parameters
        ----------
        x : ndarray
            (N, nx)
        drivers : ndarray
            (N, nu + 5) generalised inputs, heading, velocity through the air,
            current north and east.
        theta : ndarray
            (p,) or (N, p)
        places : ndarray of int
            (m,) coefficients, and past them the current north and east.
        """
        steps, nx = len(x) - 1, self._states
        values: list[Array | float] = [*x[:-1].T.copy(), *drivers[:-1].T.copy()]
        values += list(map(float, theta)) if theta.ndim == 1 else list(theta[:-1].T.copy())
        out = self._program(values, np.empty((int(np.prod(self._shape)), steps)))
        stages = out.reshape(*self._shape, steps)
        wanted = np.concatenate([np.arange(nx), nx + np.asarray(places, int)])
        total = self._chained(stages[:, :, wanted])
        return Linear(
            np.ascontiguousarray(total[:, :nx].transpose(2, 0, 1)),
            np.ascontiguousarray(total[:, nx:].transpose(2, 0, 1)),
        )

    def _chained(self, stages: Array) -> Array:
        """Return ∂x⁺ (nx, nx + m, N−1) from the rate's derivatives at each stage."""
        nx = self._states
        own = np.arange(nx)
        start = np.zeros(stages.shape[1:])
        start[own, own] = 1.0
        at = iter(stages)

        def slope(by: Array) -> Array:
            """Return the derivatives of a stage's slope, its state having those given."""
            stage = next(at)
            if by is start:
                return np.array(stage)
            after = np.einsum("ijn,jmn->imn", stage[:, :nx], by)
            after[:, nx:] += stage[:, nx:]
            return np.asarray(after)

        return self._step.moved(slope, start)


@lru_cache(maxsize=32)
def slopes_of(step: StepModel) -> Slopes:
    """Return the derivatives of a step, built once."""
    return Slopes(step)


def sensitivities(linear: Linear) -> Array:
    """Return ∂x of every column and of the initial state.

    Returns
    -------
    ndarray
        (N, nx, m + nx), the initial state last.
    """
    steps, nx, columns = linear.driven.shape
    full = np.concatenate([linear.driven, np.zeros((steps, nx, nx))], axis=2)
    start = np.hstack([np.zeros((nx, columns)), np.eye(nx)])
    return propagate(linear.a, full, start)
