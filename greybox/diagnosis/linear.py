"""Derivatives of every step along a run, in the state and in chosen numbers.

Those of the rate come from the structure's own expression, on all samples at once;
a step of several stages follows from them by the chain rule.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from greybox.model.run.step import StepModel
from greybox.numerics.recursion import propagate
from greybox.numerics.vectorised import Vectorised

Array = NDArray[np.float64]

# share of a state that a step moves it by, from which on the step is long
_LONG = 1.0
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


def with_zeros(values: ca.SX, places: Sequence[int], size: int) -> ca.SX:
    """Return a vector (size,) of values at some places and zeros elsewhere."""
    out = ca.SX.zeros(size)
    for k, place in enumerate(places):
        out[place] = values[k]
    return out


class Slopes:
    """Derivatives of a step in a current.

    Those of a step of several stages follow from the rate's at the middle of the step, as the
    exponential of its Jacobian to third order: right to the second power of the step's length.
    At samples where that is long for what the rate does, they are carried through every stage.

    Parameters
    ----------
    step : StepModel
        With the measured heading.
    active : sequence of int
        Coefficients that are not zero.
    """

    def __init__(self, step: StepModel, active: Sequence[int]) -> None:
        self._step, self._active = step, np.array(active, int)
        s, f = step.symbolic, step.increment
        current = ca.SX.sym("current", 2)
        rate = f(s.x, s.psi, s.tau, means(s.d, current), s.air, s.theta)
        slopes = ca.jacobian(rate, ca.vertcat(s.x, s.theta, current, s.tau))
        self._states, self._columns = slopes.shape
        drivers = [s.x, s.tau, s.psi, s.air, current]
        told = ca.vertcat(ca.densify(ca.vec(slopes.T)), ca.densify(rate))
        of_all = ca.Function("slopes", [*drivers, s.theta], [told])
        own = ca.SX.sym("theta", len(active))
        # what only products with zeros lead to is not computed
        found = of_all(*drivers, with_zeros(own, active, s.theta.numel()))
        self._program = Vectorised(ca.vertsplit(found), ca.vertsplit(ca.vertcat(*drivers, own)))

    def __call__(self, x: Array, drivers: Array, theta: Array, places: NDArray[np.int_]) -> Linear:
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
        nx, euler = self._states, self._step.integrator == "euler"
        at = x[:-1] if euler else (x[:-1] + x[1:]) / 2
        own = theta[..., self._active]
        given = (drivers[:-1], own if own.ndim == 1 else own[:-1])
        columns = np.concatenate([np.arange(nx), nx + np.asarray(places, int)])
        slopes = self._rates(at.T.copy(), *given, columns)[1].transpose(2, 0, 1)
        state, driven = np.split(np.ascontiguousarray(slopes), [nx], axis=2)
        if not self._step.structure.increment:
            return Linear(state, driven)
        one = np.eye(nx)
        if euler:
            return Linear(one + state, driven)
        ahead = one + state @ (one / 2 + state / 6)
        moved = Linear(one + state @ ahead, ahead @ driven)
        far = np.abs(state).sum(axis=2).max(axis=1) > _LONG
        if far.any():
            exact = self._through_stages(x[:-1][far], *_of_rows(given, far), columns)
            moved.a[far], moved.driven[far] = exact.a, exact.driven
        return moved

    def _rates(
        self, at: Array, drivers: Array, own: Array, columns: NDArray[np.int_]
    ) -> tuple[Array, Array]:
        """Return the rate (nx, N) at states (nx, N), and its derivatives (nx, columns, N)."""
        nx, steps = at.shape
        values: list[Array | float] = [*at, *drivers.T.copy()]
        values += list(map(float, own)) if own.ndim == 1 else list(own.T.copy())
        wanted = (np.arange(nx)[:, None] * self._columns + columns).ravel()
        rows = np.concatenate([wanted, nx * self._columns + np.arange(nx)])
        out = self._program(values, np.empty((len(rows), steps)), wanted=rows.tolist())
        return out[-nx:], out[:-nx].reshape(nx, len(columns), steps)

    def _through_stages(
        self, x: Array, drivers: Array, own: Array, columns: NDArray[np.int_]
    ) -> Linear:
        """Return the derivatives of steps from states (N, nx), exactly."""
        (steps, nx), size = x.shape, len(columns)

        # time is last in memory: the state first, and behind it its derivatives
        def slope(full: Array) -> Array:
            rate, slopes = self._rates(np.ascontiguousarray(full[:, 0]), drivers, own, columns)
            out = np.empty_like(full)
            out[:, 0], out[:, 1 : 1 + nx], out[:, 1 + nx :] = rate, 0.0, slopes[:, nx:]
            for i in range(nx):
                for j in range(nx):
                    out[i, 1:] += slopes[i, j] * full[j, 1:]
            return out

        start = np.zeros((nx, 1 + size, steps))
        start[:, 0] = x.T
        start[np.arange(nx), 1 + np.arange(nx)] = 1.0
        after = self._step.moved(slope, start).transpose(2, 0, 1)
        return Linear(*map(np.ascontiguousarray, (after[:, :, 1 : 1 + nx], after[:, :, 1 + nx :])))


def _of_rows(given: tuple[Array, Array], rows: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return drivers, and coefficients that may change along the run, at some of its samples."""
    drivers, own = given
    return drivers[rows], own if own.ndim == 1 else own[rows]


@lru_cache(maxsize=128)
def slopes_of(step: StepModel, active: tuple[int, ...]) -> Slopes:
    """Return the derivatives of a step, built once."""
    return Slopes(step, active)


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
