"""Free runs of one structure with parameters that may change along the way."""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.linear import Linear, slopes_of
from greybox.model.run.kernels import FreeRunKernel
from greybox.model.run.step import Integrator, StepModel
from greybox.model.structure import Structure

Array = NDArray[np.float64]

# a state past this has escaped
_ESCAPED = 1e3


@lru_cache(maxsize=32)
def _step(structure: Structure, air_measured: bool, integrator: Integrator) -> ca.Function:
    """Return ``(x, [tau, psi, air, current, theta]) -> x⁺``."""
    s = structure.symbols
    step = StepModel(structure, integrator, air_measured=air_measured)
    nu, nd, p = s.tau.numel(), s.d.numel(), s.theta.numel()
    w = ca.SX.sym("w", nu + 5 + p)
    d = ca.vertcat(w[nu + 3 : nu + 5], ca.SX.zeros(max(nd - 2, 0)))[:nd]
    after = step(s.x, w[nu], w[:nu], d, w[nu + 1 : nu + 3], w[nu + 5 :], 1.0)
    return ca.Function("step", [s.x, w], [after], {"cse": True})


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
        key = (structure, air_measured, integrator)
        self._kernel = FreeRunKernel(_step(*key), samples - 1)
        self._slopes = slopes_of(*key)
        self._theta, self._drivers = np.zeros(0), np.zeros((0, 0))

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
        kernel, split = self._kernel, drivers.shape[1]
        kernel.read[:, :split] = drivers[:-1]
        kernel.read[:, split:] = theta[:-1] if theta.ndim == 2 else theta
        kernel.start[:] = x0
        out = np.vstack([x0, kernel()])
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
