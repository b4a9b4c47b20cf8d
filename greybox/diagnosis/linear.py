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

    Those of a step of several stages follow from the rate's at the middle of the step, as the
    exponential of its Jacobian to third order: right to the second power of the step's length.

    Parameters
    ----------
    step : StepModel
        With the measured heading.
    """

    def __init__(self, step: StepModel) -> None:
        self._step = step
        s, f = step.symbolic, step.increment
        current = ca.SX.sym("current", 2)
        rate = f(s.x, s.psi, s.tau, means(s.d, current), s.air, s.theta)
        slopes = ca.jacobian(rate, ca.vertcat(s.x, s.theta, current, s.tau))
        symbols = ca.vertcat(s.x, s.tau, s.psi, s.air, current, s.theta)
        self._states, self._columns = slopes.shape
        self._program = Vectorised(
            ca.vertsplit(ca.densify(ca.vec(slopes.T))), ca.vertsplit(symbols)
        )

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
            (m,) coefficients, past them the current north and east, and past those the
            generalised inputs.
        """
        steps, nx = len(x) - 1, self._states
        euler = self._step.integrator == "euler"
        at = x[:-1] if euler else (x[:-1] + x[1:]) / 2
        values: list[Array | float] = [*at.T.copy(), *drivers[:-1].T.copy()]
        values += list(map(float, theta)) if theta.ndim == 1 else list(theta[:-1].T.copy())
        columns = np.concatenate([np.arange(nx), nx + np.asarray(places, int)])
        wanted = (np.arange(nx)[:, None] * self._columns + columns).ravel()
        out = self._program(values, np.empty((len(wanted), steps)), wanted=wanted.tolist())
        moved = out.reshape(nx, len(columns), steps).transpose(2, 0, 1)
        own, driven = (np.ascontiguousarray(part) for part in np.split(moved, [nx], axis=2))
        if not self._step.structure.increment:
            return Linear(own, driven)
        one = np.eye(nx)
        if euler:
            return Linear(one + own, driven)
        ahead = one + own @ (one / 2 + own / 6)
        return Linear(one + own @ ahead, ahead @ driven)


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
