"""Free runs of one structure with parameters that may change along the way."""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.linear import Linear, means, slopes_of
from greybox.model.run.kernels import FreeRunKernel
from greybox.model.run.step import StepModel

Array = NDArray[np.float64]

# a state past this has escaped
_ESCAPED = 1e3


@lru_cache(maxsize=32)
def _function(step: StepModel) -> ca.Function:
    """Return ``(x, [tau, psi, air, current, theta]) -> x⁺``."""
    s = step.symbolic
    nu = s.tau.numel()
    w = ca.SX.sym("w", nu + 5 + s.theta.numel())
    d = means(s.d, w[nu + 3 : nu + 5])
    after = step(s.x, w[nu], w[:nu], d, w[nu + 1 : nu + 3], w[nu + 5 :], 1.0)
    return ca.Function("step", [s.x, w], [after], {"cse": True})


class VaryingSimulator:
    """Runs of one length.

    Parameters
    ----------
    step : StepModel
        With the measured heading.
    samples : int
        N, of the log.
    """

    def __init__(self, step: StepModel, samples: int) -> None:
        self._kernel = FreeRunKernel(_function(step), samples - 1)
        self._slopes = slopes_of(step)
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
