"""Free runs of one structure with parameters that may change along the way."""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.linear import Linear, Slopes, means, slopes_of, with_zeros
from greybox.model.run.kernels import FreeRunKernel
from greybox.model.run.step import StepModel

Array = NDArray[np.float64]

# a state past this has escaped
_ESCAPED = 1e3


# lengths of log and sets of terms that a simulator keeps at hand
_KEPT = 16
# runs of a diagnosis that each of them counts for when it is asked whether machine code pays
_RUNS = 30
Active = tuple[int, ...]


@lru_cache(maxsize=256)
def _function(step: StepModel, active: Active, changing: bool) -> ca.Function:
    """Return ``(x, [tau, psi, air, current], theta) -> x⁺`` of the coefficients that are not zero.

    With `changing` these are read at each step, as the drivers are.
    """
    s = step.symbolic
    nu = s.tau.numel()
    drivers, own = ca.SX.sym("drivers", nu + 5), ca.SX.sym("theta", len(active))
    theta = with_zeros(own, active, s.theta.numel())
    d = means(s.d, drivers[nu + 3 : nu + 5])
    after = step(s.x, drivers[nu], drivers[:nu], d, drivers[nu + 1 : nu + 3], theta, 1.0)
    given = [ca.vertcat(drivers, own)] if changing else [drivers, own]
    return ca.Function("step", [s.x, *given], [ca.densify(after)], {"cse": True})


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
        self._step, self._samples = step, samples
        self._kernels: dict[tuple[Active, bool], FreeRunKernel] = {}
        # shared by runs of all lengths, and found sooner than by the hash of a structure
        self._slopes: Slopes | None = None

    def __getstate__(self) -> dict[str, object]:
        """Drop what belongs to one process when pickled."""
        return self.__dict__ | {"_kernels": {}, "_slopes": None}

    def _kernel(self, active: Active, changing: bool) -> FreeRunKernel:
        key = (active, changing)
        # the sets of terms that are compared come again and again; those of old steps do not
        kernel = self._kernels.pop(key, None)
        if kernel is None:
            kernel = FreeRunKernel(_function(self._step, *key), self._samples - 1)
        self._kernels[key] = kernel
        if len(self._kernels) > _KEPT:
            del self._kernels[next(iter(self._kernels))]
        return kernel

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
        changing, split = theta.ndim == 2, drivers.shape[1]
        # as machine code one kernel does for all sets of terms, sooner than one is made for each
        used = np.arange(theta.shape[-1])
        kernel = self._kernel(tuple(used.tolist()), changing)
        if not kernel.compiled(_RUNS):
            used = _used(theta)
            kernel = self._kernel(tuple(used.tolist()), changing)
        kernel.read[:, :split] = drivers[:-1]
        if changing:
            kernel.read[:, split:] = theta[:-1, used]
        else:
            kernel.constants[0][:] = theta[used]
        kernel.start[:] = x0
        out = np.vstack([x0, kernel()])
        with np.errstate(invalid="ignore"):
            if not (np.abs(out) < _ESCAPED).all():
                out = np.full_like(out, np.inf)
        return out

    def linearise(self, x: Array, drivers: Array, theta: Array, places: NDArray[np.int_]) -> Linear:
        """Return the derivatives along a run.

        Parameters
        ----------
        x : ndarray
            (N, nx)
        drivers, theta : ndarray
            That it was made with.
        places : ndarray of int
            (m,) coefficients, and past them the current north and east.
        """
        if self._slopes is None:
            self._slopes = slopes_of(self._step)
        return self._slopes(x, drivers, theta, places)


def _used(theta: Array) -> NDArray[np.int_]:
    """Return which coefficients are not zero all along."""
    return np.flatnonzero(theta.any(axis=0) if theta.ndim == 2 else theta)
