"""Free runs of one structure with parameters that may change along the way."""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.linear import Linear, slopes_of
from greybox.model.functions import Integrator, accumulate, bind, step_function, unrolled
from greybox.model.structure import Structure

Array = NDArray[np.float64]

# steps in one scalar function
_UNROLLED = 10
# a state past this has escaped
_ESCAPED = 1e3


@lru_cache(maxsize=32)
def _step(structure: Structure, air_measured: bool, integrator: Integrator) -> ca.Function:
    """Return ``(x, [tau, psi, air, current, theta]) -> x⁺``."""
    s = structure.symbols
    step = step_function(structure, air_measured=air_measured, integrator=integrator)
    nu, nd, p = s.tau.numel(), s.d.numel(), s.theta.numel()
    w = ca.SX.sym("w", nu + 5 + p)
    d = ca.vertcat(w[nu + 3 : nu + 5], ca.SX.zeros(max(nd - 2, 0)))[:nd]
    after = step(s.x, w[nu], w[:nu], d, w[nu + 1 : nu + 3], w[nu + 5 :], 1.0)
    return ca.Function("step", [s.x, w], [after], {"cse": True})


@lru_cache(maxsize=64)
def _run(
    structure: Structure, air_measured: bool, integrator: Integrator, blocks: int
) -> ca.Function:
    step = _step(structure, air_measured, integrator)
    return accumulate(unrolled(step, 1, _UNROLLED), blocks)


class Simulator:
    """Runs of one length.

    Parameters
    ----------
    structure : Structure
    samples : int
        N, of the log.
    air_measured : bool
        Whether terms see a measured velocity through the air.
    integrator : {"euler", "rk4"}
    """

    def __init__(
        self, structure: Structure, samples: int, air_measured: bool, integrator: Integrator
    ) -> None:
        self.structure = structure
        self.samples = samples
        blocks = -(-(samples - 1) // _UNROLLED)
        key = (structure, air_measured, integrator)
        function = _run(*key, blocks)
        nx, width = len(structure.states), function.size1_in(1)
        self._x0 = np.zeros(nx)
        self._w = np.zeros((blocks * _UNROLLED, width))
        self._last = np.zeros((blocks, nx))
        self._history = np.zeros((blocks * _UNROLLED, nx))
        buffer, self._trigger = function.buffer()
        bind(buffer.set_arg, 0, self._x0)
        bind(buffer.set_arg, 1, self._w)
        bind(buffer.set_res, 0, self._last)
        bind(buffer.set_res, 1, self._history)
        self._buffer = buffer
        self._slopes = slopes_of(*key)
        self._theta, self._drivers = np.zeros(0), np.zeros((0, width))

    def __call__(self, x0: Array, drivers: Array, theta: Array) -> Array:
        """Run from x0.

        Parameters
        ----------
        x0 : ndarray
            (nx,)
        drivers : ndarray
            (N, nu + 5) generalised inputs, heading, velocity through the air,
            current north and east.
        theta : ndarray
            (p,) or (N, p)

        Returns
        -------
        ndarray
            (N, nx); infinite where the run escaped.
        """
        self._drivers, self._theta = drivers, theta
        steps = self.samples - 1
        split = drivers.shape[1]
        self._w[:steps, :split] = drivers[:steps]
        self._w[:steps, split:] = theta[:steps] if theta.ndim == 2 else theta
        self._w[steps:] = self._w[steps - 1]
        self._x0[:] = x0
        self._trigger()
        out = np.vstack([x0, self._history[:steps]])
        with np.errstate(invalid="ignore"):
            if not (np.abs(out) < _ESCAPED).all():
                out = np.full_like(out, np.inf)
        return out

    def linearise(self, x: Array, places: Array) -> Linear:
        """Return the derivatives along the run that was made last.

        Parameters
        ----------
        x : ndarray
            (N, nx)
        places : ndarray of int
            (m,) coefficients, and past them the current north and east.
        """
        return self._slopes(x, self._drivers, self._theta, places)
