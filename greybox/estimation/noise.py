"""How noisy the measurements and the motion were, from the errors of an estimate.

Exact Gaussian likelihood of the equation errors at given coefficients, over the
levels of measurement and process noise: neighbouring errors share a measurement,
which no process noise imitates. The constants of each log are integrated out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from greybox.estimation.banded_covariance import ErrorBand, ErrorNoise
from greybox.model.noise import NoiseLevels
from greybox.numerics.banded import factor_band, inverse_band
from greybox.numerics.effort import require_time
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]

# levels are sought down to this share of the residual's standard deviation
_LEAST = 1e-3
# rows that tell levels to a hundredth, and those of a stretch: many times the slowest memory
_ENOUGH, _STRETCH = 8000, 2000
# slowest process noise that is told from a constant, in samples
_SLOWEST = 300.0
# 2 Δ log-likelihood beyond which nx further levels are believed (χ², p = 0.001, 3 of them)
_BELIEVED = 16.3
# steps of a climb that tell whether it is worth going on, and the gain from which it is
_PROBE, _PROMISING = 3, 5.0
# loss where a covariance is singular: finite, so that a line search goes on
_IMPOSSIBLE = 1e100
# correlation of neighbouring samples that is as good as none
_NEXT_TO_NONE = 1e-12


@dataclass(frozen=True)
class NoiseFit:
    """Noise levels, and which of them were estimated.

    Parameters
    ----------
    noise : ErrorNoise
    free : ndarray of bool
        (nx,) states whose measurement noise was estimated.
    remembers : bool
        Whether the process noise was found to have a memory.
    contradicted : bool
        Whether stated sensors were given up because the errors contradict them.
    """

    noise: ErrorNoise
    free: NDArray[np.bool_]
    remembers: bool = False
    contradicted: bool = False


def on_stretches(keep: Sequence[NDArray[np.bool_]]) -> Sequence[NDArray[np.bool_]]:
    """Return the rows that the levels are estimated from: all, or stretches spread along long logs.

    Parameters
    ----------
    keep : sequence of ndarray of bool
        (N,) per log: rows that take part.
    """
    rows = sum(int(k.sum()) for k in keep)
    if rows <= _ENOUGH:
        return keep
    out = []
    for k in keep:
        whole = len(k) * _ENOUGH / rows
        count = max(1, round(whole / _STRETCH))
        length = int(whole / count)
        some = np.zeros(len(k), bool)
        for start in np.linspace(0, len(k) - length, count).astype(int):
            some[start : start + length] = True
        out.append(k & some)
    return out


def constant_rows(rows: int, equations: Sequence[bool]) -> Array:
    """Return a constant for each equation that has one, (q, N, nx)."""
    own = np.flatnonzero(equations)
    out = np.zeros((len(own), rows, len(equations)))
    out[np.arange(len(own)), :, own] = 1.0
    return out


class ErrorLikelihood:
    """The likelihood of some logs' equation errors.

    Parameters
    ----------
    bands : sequence of ErrorBand
    residuals : sequence of ndarray
        (N, nx) per log.
    equations : sequence of bool
        (nx,) which equations have a constant of their own in each log.
    least : ndarray
        (nx,) spread below which errors count as none.
    regressors : sequence of ndarray, optional
        (p, N, nx) per log, whose coefficients were estimated: what they took from the
        errors is then allowed for (restricted likelihood, each log by itself).
    """

    def __init__(
        self,
        bands: Sequence[ErrorBand],
        residuals: Sequence[Array],
        equations: Sequence[bool],
        least: Array,
        regressors: Sequence[Array] | None = None,
    ) -> None:
        self.bands = bands
        self._own = int(np.sum(equations))
        self._shared = 0 if regressors is None else len(regressors[0])
        # coefficients belong to all logs, so their scale must be one
        size: Array | float = 1.0
        if regressors is not None:
            size = np.sqrt(sum((z**2).sum(axis=(1, 2), keepdims=True) for z in regressors))
        self.values = [
            np.concatenate(
                [
                    constant_rows(len(r), equations),
                    r[None],
                    *([] if regressors is None else [regressors[i] / size]),
                ]
            )
            for i, r in enumerate(residuals)
        ]
        kept = np.concatenate([r[b.keep] for r, b in zip(residuals, bands, strict=True)])
        self.scale = np.maximum(kept.std(axis=0), least)
        self.exact = bool((kept.std(axis=0) < least).any())

    def loss(self, noise: ErrorNoise) -> float:
        """Return minus the logarithm of the likelihood, up to a constant."""
        whitened = self._whitened(noise)
        return _IMPOSSIBLE if whitened is None else whitened[0]

    def slopes(self, noise: ErrorNoise) -> tuple[float, Array, Array, Array]:
        """Return the loss and its derivatives.

        Returns
        -------
        tuple
            The loss; derivatives in the variances of the measurements (nx,), in those of the
            process noise (nx,), and in its memory (nx,), which must not all be zero for that.

        References
        ----------
        Patterson and Thompson (1971).
        """
        nx = len(self.scale)
        total = np.zeros((3, nx))
        whitened = self._whitened(noise)
        if whitened is None:
            return _IMPOSSIBLE, *total
        loss, logs = whitened
        for band, covariance, factor, rows in logs:
            own = rows[:, : band.rows * nx]
            # what each row is multiplied by where it meets an error: P = Ω⁻¹ − Σ v vᵀ
            dual = band.unwhiten(factor, own)
            by_covariance = inverse_band(covariance, len(covariance) - nx, factor)
            for diagonal, entries in enumerate(by_covariance):
                # a stretch of one or two rows is narrower than the band
                left, right = dual[:, diagonal:], dual[:, : max(dual.shape[1] - diagonal, 0)]
                entries[: right.shape[1]] -= np.einsum("qk,qk->k", left, right)
                # both triangles, and ½ log det
                entries *= 0.5 if diagonal == 0 else 1.0
            measured, process, memory = band.slopes(noise, by_covariance)
            if noise.memory.any():
                taken = dual * rows[:, band.rows * nx :]
                memory = memory - taken.reshape(-1, nx).sum(axis=0)
            total += measured[:nx], process, memory
        return loss, *total

    def _whitened(
        self, noise: ErrorNoise
    ) -> tuple[float, list[tuple[ErrorBand, Array, Array, Array]]] | None:
        """Return the loss, and each log's covariance, factor and rows; None where singular.

        Rows are the constants, orthonormal, the regressors, orthonormal over all logs, and
        what the error keeps beside them, first white, then as they are in the row before
        where the process noise has a memory.
        """
        loss, logs = 0.0, []
        own, shared = self._own, self._shared
        gram, score = np.zeros((shared, shared)), np.zeros(shared)
        try:
            for band, values in zip(self.bands, self.values, strict=True):
                if not band.rows:
                    continue
                covariance = band.covariance(noise)
                factor = factor_band(covariance)
                if factor is None:
                    return None
                rows = band.whiten(factor, noise, values)
                n = rows.shape[1]
                if noise.memory.any():
                    rows = np.hstack([rows, band.before(values).reshape(rows.shape)])
                loss += float(np.log(factor[0]).sum())
                if own:
                    constants = rows[:own]
                    root = np.linalg.cholesky(constants[:, :n] @ constants[:, :n].T)
                    constants = rows[:own] = np.linalg.inv(root) @ constants
                    rows[own:] -= (rows[own:, :n] @ constants[:, :n].T) @ constants
                    loss += float(np.log(np.diag(root)).sum())
                error, regressors = rows[own, :n], rows[own + 1 :, :n]
                loss += 0.5 * float(error @ error)
                gram += regressors @ regressors.T
                score += regressors @ error
                logs.append((band, covariance, factor, rows))
            if shared:
                root = np.linalg.cholesky(gram)
                inverse = np.linalg.inv(root)
                taken = inverse @ score
                loss += float(np.log(np.diag(root)).sum()) - 0.5 * float(taken @ taken)
                for *_, rows in logs:
                    rows[own + 1 :] = inverse @ rows[own + 1 :]
                    rows[own] -= taken @ rows[own + 1 :]
        except np.linalg.LinAlgError:
            return None
        return loss, logs

    def fit(self, start: NoiseFit, most: int = 40) -> tuple[NoiseFit, float]:
        """Return the levels of greatest likelihood from a start, and the loss there.

        Parameters
        ----------
        start : NoiseFit
        most : int
            Steps of the climb at most.
        """
        from scipy.optimize import minimize

        nx = len(self.scale)
        free = np.flatnonzero(start.free)
        moved = slice(len(free), len(free) + nx)

        def unpack(p: Array) -> ErrorNoise:
            measurement = start.noise.measurement.copy()
            measurement[free] = self.scale[free] * np.exp(p[: len(free)])
            process = self.scale * np.exp(p[moved])
            memory = np.zeros(nx)
            if start.remembers:
                memory = -np.expm1(-p[moved.stop :])
            return replace(start.noise, measurement=measurement, process=process, memory=memory)

        def at(p: Array) -> tuple[float, Array]:
            noise = unpack(p)
            told = noise
            if start.remembers:
                # none at all has a slope too
                told = replace(noise, memory=np.maximum(noise.memory, _NEXT_TO_NONE))
            loss, measured, process, memory = self.slopes(told)
            slope = [
                2 * noise.measurement[free] ** 2 * measured[free],
                2 * noise.process**2 * process,
            ]
            if start.remembers:
                slope.append((1.0 - noise.memory) * memory)
            return loss, np.concatenate(slope)

        low, longest = np.log(_LEAST), np.log(_SLOWEST)
        first = np.concatenate(
            [
                np.log(start.noise.measurement[free] / self.scale[free]),
                np.log(start.noise.process / self.scale),
                -np.log1p(-start.noise.memory) if start.remembers else [],
            ]
        )
        bounds = [(low, 1.0)] * (len(free) + nx)
        bounds += [(0.0, longest)] * (nx if start.remembers else 0)
        # in these units curvature is about 1, and a slope of 0.01 is next to nothing
        unit = np.sqrt(sum(band.rows for band in self.bands))
        ends = np.array(bounds) * unit

        def scaled(p: Array) -> tuple[float, Array]:
            require_time()
            loss, slope = at(p / unit)
            return loss, slope / unit

        found = minimize(
            scaled,
            np.clip(first * unit, ends[:, 0], ends[:, 1]),
            method="L-BFGS-B",
            jac=True,
            bounds=ends,
            options={"ftol": 1e-9, "gtol": 0.01, "maxiter": most},
        )
        return replace(start, noise=unpack(found.x / unit)), float(found.fun)


def first_levels(likelihood: ErrorLikelihood, stated: Array, further: Array) -> NoiseFit:
    """Find levels with stated sensors kept and a process noise without memory.

    Parameters
    ----------
    likelihood : ErrorLikelihood
    stated : ndarray
        (nx,) standard deviation of each measured state, nan where it is not known.
    further : ndarray
        (m,) of heading and wind, 0 where not known.
    """
    free = np.isnan(stated)
    # the error holds the measurement about twice
    guess = np.where(free, 0.6 * likelihood.scale, stated)
    noise = ErrorNoise(
        guess, 0.2 * likelihood.scale, np.zeros(len(stated)), np.asarray(further, float)
    )
    return likelihood.fit(NoiseFit(noise, free))[0]


def fit_noise(likelihood: ErrorLikelihood, start: NoiseFit) -> NoiseFit:
    """Estimate the levels, and decide which of them the errors support beyond the first ones.

    The process noise has a memory where that explains the errors better, and
    stated sensors are given up where the errors contradict them (p = 0.001 each).
    Errors that are no more than rounding decide nothing.
    """
    if likelihood.exact:
        return start
    nx = len(start.free)
    best, loss = likelihood.fit(start)
    slow = replace(best.noise, memory=np.full(nx, 0.9))
    remembering, found = likelihood.fit(replace(best, noise=slow, remembers=True))
    if 2 * (loss - found) > _BELIEVED:
        best, loss = remembering, found
    if not start.free.all():
        free = replace(best, free=np.ones(nx, bool), contradicted=True)
        opened, found = likelihood.fit(free, most=_PROBE)
        if 2 * (loss - found) > _PROMISING:
            opened, found = likelihood.fit(opened)
        if 2 * (loss - found) > _BELIEVED:
            best = opened
    return best


def stated_levels(
    vessel: Vessel, states: Sequence[str], further: Sequence[str]
) -> tuple[Array, Array]:
    """Return the sensor noise that the vessel file states, nan and 0 where it states none."""
    measured = [vessel.std(s) for s in states]
    rest = [vessel.std("psi" if n == "psi" else "wind") or 0.0 for n in further]
    return np.array([np.nan if v is None else v for v in measured]), np.array(rest)


def noise_levels_of(
    fit: NoiseFit, states: tuple[str, ...], vessel: Vessel, sample_time: float
) -> NoiseLevels:
    """Return the levels as a model keeps them, with a sentence on their origin."""
    found = [s for s, f in zip(states, fit.free, strict=True) if f]
    known = [s for s, f in zip(states, fit.free, strict=True) if not f]
    told = []
    if known:
        told.append(f"noise of {', '.join(known)} as the vessel file states it")
    if found:
        why = ", because the vessel file's contradicts them" if fit.contradicted else ""
        told.append(f"noise of {', '.join(found)} from the equation errors{why}")
    remembered = ""
    if fit.remembers:
        parts = []
        for state, rho in zip(states, fit.noise.memory, strict=True):
            if rho > 0:
                parts.append(f"{state} {-sample_time / np.log(rho):.3g} s")
        remembered = f", with a memory ({', '.join(parts)})" if parts else ""
    told.append(f"process noise from the equation errors{remembered}")
    return NoiseLevels(
        states,
        fit.noise.measurement,
        fit.noise.process,
        vessel.std("psi") or 0.0,
        vessel.std("wind") or 0.0,
        "; ".join(told),
        fit.noise.memory if fit.remembers else np.zeros(0),
    )
