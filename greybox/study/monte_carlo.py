"""Many virtual trials estimated at once.

The same predictors, free runs and instruments as for one log, on arrays with
runs in front: regressors are evaluated in one call for all runs, free runs in
one compiled function, normal equations by one batched product. Runs that have
converged leave the refinement.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.model.predictor import Predictor
from greybox.model.run.simulation import simulate

Array = NDArray[np.float64]

# relative change of every parameter below which a run has converged, and refinements at most
_TOLERANCE, _MOST = 1e-4, 30
# values of one array that are worked on together
_CACHED = 40_000
# simulated states beyond this multiple of the largest measured one have diverged
_BOUND = 10.0


@dataclass(frozen=True)
class Batch:
    """Measured logs of R virtual trials of N+1 samples, with runs in front.

    Parameters
    ----------
    x : ndarray
        (R, N+1, nx) measured states.
    psi : ndarray or float
        (R, N+1) measured heading [rad]; 0 where there is none.
    tau : ndarray
        (R or 1, N, nu) generalised inputs.
    air : tuple of ndarray, optional
        (R, N) each, measured velocity through the air [m/s].
    start : ndarray
        (nx,) or (R, nx) known initial state of simulated instruments.
    measured : ndarray, optional
        (R, N+1, nx) states as the regressors see them (4.13); by default `x`.
    """

    x: Array
    psi: Array | float
    tau: Array
    air: tuple[Array, Array] | None
    start: Array
    measured: Array | None = None

    @property
    def runs(self) -> int:
        """Number of runs R."""
        return len(self.x)


@dataclass(frozen=True)
class BatchEstimate:
    """Estimates of every run.

    ``theta`` (R, p) coefficients of all columns; ``unconverged`` (R,) runs that never
    stopped moving or whose instruments diverged.
    """

    theta: Array
    unconverged: NDArray[np.bool_]


class BatchRegression:
    """y, Φ and the refinement of IV for one predictor on a batch.

    Parameters
    ----------
    predictor : Predictor
    batch : Batch
    """

    def __init__(self, predictor: Predictor, batch: Batch) -> None:
        self.predictor = predictor
        self.batch = batch
        structure = predictor.structure
        self._tau = [np.ascontiguousarray(c) for c in np.moveaxis(batch.tau, 2, 0)]
        self._psi = batch.psi[:, :-1] if isinstance(batch.psi, np.ndarray) else batch.psi
        increments = np.diff(batch.x, axis=1) if structure.increment else batch.x[:, 1:]
        self._y = np.ascontiguousarray(np.moveaxis(increments, 2, 0))
        measured = batch.x if batch.measured is None else batch.measured
        self._prepared = predictor.prepare(self._psi, self._tau, batch.air)
        self.phi = self.regressors(measured[:, :-1])
        self._phi_mean = self.phi.mean(axis=2).T
        self._y_mean = self._y.mean(axis=2).T
        self._equations = [predictor.equation(s) for s in structure.states]
        self._bound = _BOUND * np.abs(batch.x).max(axis=(0, 1))

    def regressors(self, x: Array, runs: NDArray[np.intp] | None = None) -> Array:
        """Return the regressors (p, R, N) at states (R, N, nx) of some runs.

        A few runs at a time, so that the working arrays stay in the cache.
        """
        index = np.arange(self.batch.runs) if runs is None else runs
        out = np.empty((len(self.predictor.columns), *x.shape[:2]))
        step = max(1, _CACHED // x.shape[1])
        for first in range(0, len(index), step):
            part = slice(first, first + step)
            prepared = {
                k: v[index[part]] if isinstance(v, np.ndarray) and len(v) > 1 else v
                for k, v in self._prepared.items()
            }
            states = [np.ascontiguousarray(x[part, :, i]) for i in range(x.shape[2])]
            self.predictor.evaluate_prepared(states, prepared, out[:, part])
        return out

    def solve(
        self, z: Array, runs: NDArray[np.intp] | None = None, *, zero_mean: bool = False
    ) -> Array:
        """Solve Σ Z Φᵀ θ = Σ Z y for each run (2.21).

        Parameters
        ----------
        z : ndarray
            (p, R, N) instruments of some runs.
        zero_mean : bool
            Take each instrument's mean away (4.63), from the sums rather than
            from the instruments: Σ (z − z̄) φ = Σ z φ − N z̄ φ̄.

        Returns
        -------
        ndarray
            (R, p)
        """
        index = slice(None) if runs is None else runs
        samples = z.shape[2]
        ones = np.full(samples, 1.0 / samples)
        theta = np.empty((z.shape[1], len(self.predictor.columns)))
        for row, mine in enumerate(self._equations):
            first, last = mine[0], mine[-1] + 1
            zr = z[first:last].transpose(1, 0, 2)
            fr = self.phi[first:last, index].transpose(1, 2, 0)
            y = self._y[row, index]
            gram = np.matmul(zr, fr)
            right = np.matmul(zr, y[..., None])[..., 0]
            if zero_mean:
                mean = np.matmul(zr, ones)
                gram -= samples * mean[:, :, None] * self._phi_mean[index, None, first:last]
                right -= samples * mean * self._y_mean[index, row, None]
            theta[:, first:last] = _solve_scaled(gram, right)
        return theta

    def least_squares(self) -> Array:
        """Return the least-squares estimates (R, p)."""
        return self.solve(self.phi)

    def structure_theta(self, theta: Array) -> Array:
        """Return (R, p_structure) parameters to simulate, sums at their first term."""
        structure = self.predictor.structure
        out = np.zeros((len(theta), len(structure.terms)))
        for i in self.predictor.parameter_columns:
            out[:, structure.index(self.predictor.columns[i].terms[0])] = theta[:, i]
        return out

    def instruments(self, theta: Array, runs: NDArray[np.intp]) -> tuple[Array, NDArray[np.bool_]]:
        """Simulate models and return their regressors, and which runs diverged.

        Parameters
        ----------
        theta : ndarray
            (n, p_structure) parameters of the runs.
        runs : ndarray of int
            (n,)

        Returns
        -------
        tuple
            (p, n, N) instruments; (n,) diverged, whose instruments are not usable.
        """
        batch = self.batch
        start = batch.start if batch.start.ndim == 1 else batch.start[runs]
        tau = batch.tau if len(batch.tau) == 1 else batch.tau[runs]
        # in still water and air the heading plays no part in the states
        psi = np.zeros(tau.shape[1] + 1) if "r" in self.predictor.structure.states else None
        run = simulate(
            self.predictor.structure,
            theta,
            np.broadcast_to(start, (len(runs), batch.x.shape[2])),
            np.broadcast_to(tau, (len(runs), *tau.shape[1:])),
            1.0,
            psi=psi,
            bound=self._bound,
        )
        bad = run.diverged >= 0
        x = run.x[:, :-1]
        x[bad] = 0.0
        return self.regressors(x, runs), bad

    def refine(
        self,
        start: Array,
        *,
        zero_mean: bool = True,
        again: Array | None = None,
    ) -> BatchEstimate:
        """Estimate by IV, simulating the instruments anew until nothing moves (4.60-4.63).

        Parameters
        ----------
        start : ndarray
            (R, p_structure) or (p_structure,) models of the first instruments.
        again : ndarray, optional
            (R, p_structure) models from which runs that fail are tried once more.

        Returns
        -------
        BatchEstimate
        """
        every = np.arange(self.batch.runs)
        first = np.broadcast_to(start, (len(every), start.shape[-1]))
        theta = np.full((len(every), len(self.predictor.columns)), np.nan)
        failed = self._refine_runs(theta, first, every, zero_mean)
        if again is not None and failed.any():
            failed = self._refine_runs(theta, again, every[failed], zero_mean)
        return BatchEstimate(theta, failed | ~np.isfinite(theta).all(axis=1))

    def _refine_runs(
        self, theta: Array, start: Array, runs: NDArray[np.intp], zero_mean: bool
    ) -> NDArray[np.bool_]:
        """Refine some runs, filling `theta`, and return who failed, (R,)."""
        model = start.copy()
        theta[runs] = np.nan
        failed = np.zeros(self.batch.runs, bool)
        last = model.copy()
        wanted = self.predictor.parameter_columns
        for iteration in range(_MOST + 1):
            z, bad = self.instruments(model[runs], runs)
            # halfway models settle too, but not at an estimate that can be simulated
            halfway = bad.copy()
            for _ in range(4):
                if not bad.any() or iteration == 0:
                    break
                # step halfway back to the last model whose simulation was bounded
                model[runs[bad]] = (model[runs[bad]] + last[runs[bad]]) / 2
                again, still = self.instruments(model[runs[bad]], runs[bad])
                z[:, bad] = again
                where = np.flatnonzero(bad)
                bad = np.zeros(len(runs), bool)
                bad[where[still]] = True
            fine = ~bad
            failed[runs[bad]] = True
            runs = runs[fine]
            if not len(runs):
                break
            new = self.solve(z if fine.all() else z[:, fine], runs, zero_mean=zero_mean)
            old = theta[runs]
            theta[runs] = new
            last[runs] = model[runs]
            model[runs] = self.structure_theta(new)
            with np.errstate(invalid="ignore"):
                change = np.abs(new - old)[:, wanted] / (np.abs(new[:, wanted]) + 1e-12)
            moving = ~(change.max(axis=1) < _TOLERANCE) | halfway[fine]
            runs = runs[moving]
            if not len(runs):
                break
        failed[runs] = True
        return failed

    def with_instruments_of(self, theta: Array, doubtful: NDArray[np.bool_]) -> BatchEstimate:
        """Estimate once, with instruments simulated from given models.

        Parameters
        ----------
        theta : ndarray
            (R, p_structure) models, such as another predictor's estimates.
        doubtful : ndarray of bool
            (R,) runs whose models did not converge.
        """
        runs = np.arange(self.batch.runs)
        z, bad = self.instruments(np.nan_to_num(theta), runs)
        out = np.full((len(runs), len(self.predictor.columns)), np.nan)
        fine = ~bad
        if fine.any():
            part = z[:, fine] if bad.any() else z
            out[fine] = self.solve(part, runs[fine], zero_mean=True)
        return BatchEstimate(out, doubtful | bad)


def _solve_scaled(gram: Array, right: Array) -> Array:
    """Solve (R, p, p) systems after scaling rows and columns to unit size."""
    row = np.sqrt((gram**2).sum(axis=2))
    row[row == 0] = 1.0
    gram = gram / row[..., None]
    column = np.sqrt((gram**2).sum(axis=1))
    column[column == 0] = 1.0
    gram = gram / column[:, None, :]
    try:
        solution = np.linalg.solve(gram, (right / row)[..., None])[..., 0]
    except np.linalg.LinAlgError:
        solution = np.full(right.shape, np.nan)
        for i in range(len(gram)):
            if np.linalg.matrix_rank(gram[i]) == gram.shape[1]:
                solution[i] = np.linalg.solve(gram[i], (right / row)[i])
    return np.asarray(solution / column)
