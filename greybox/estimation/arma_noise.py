"""A noise model of the residuals of low order, which gives the variance of their sums.

The equation error of (4.3) is nearly a difference of measurement noise: what a
slow instrument sums of it almost cancels, and sample autocovariances miss the
small rest by more than its size (in yaw by several times). A fitted
H(q) = C(q)/D(q) is positive by construction, and var Σ z e = Σ (Hᵀz)² var ε
follows from the innovations ε, whose variance may change along the log.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from greybox.trial.gaps import runs

Array = NDArray[np.float64]

# (AR, MA) orders tried; the least BIC is taken
_ORDERS = ((0, 0), (0, 1), (1, 0), (1, 1), (2, 2))
_LEAST_ROWS = 60
# partial correlations closer to one than this are not told from a difference
_EDGE = 0.9995
# the linear error of a fit says little at a unit root
_LEAST_FREEDOM = 8.0


@dataclass(frozen=True)
class NoiseFactor:
    """What makes one log's errors alike: e(k) = root(k) ν(k) + tie(k) root(k−1) ν(k−1).

    Parameters
    ----------
    root, tie : ndarray
        (N,) of the Cholesky factor L √D of a covariance with one neighbour.
    """

    root: Array
    tie: Array

    def solve(self, e: Array) -> Array:
        """Return ν along the last axis."""
        from scipy.linalg.lapack import dtbtrs

        band = np.zeros((2, len(self.root)))
        band[1, :-1] = self.tie[1:]
        flat = e.reshape(-1, e.shape[-1]).T
        found, _ = dtbtrs(band, flat, uplo="L", diag="U")
        return np.asarray(found.T.reshape(e.shape) / self.root)

    def adjoint(self, z: Array) -> Array:
        """Return what ν is multiplied by in Σ z e, along the last axis."""
        out = z.copy()
        out[..., :-1] += self.tie[1:] * z[..., 1:]
        return np.asarray(out * self.root)


@dataclass(frozen=True)
class ARMANoise:
    """e = C(q)/D(q) ε, behind a factor of each log where the noise changes along it.

    Parameters
    ----------
    moving_average, autoregression : ndarray
        (m+1,) and (n+1,) coefficients of C and D in delays, each led by 1.
    neighbours : tuple of ARMANoise
        Models one standard error away along each principal axis of the fit.
    factors : tuple of NoiseFactor
        Of each experiment; empty where the noise is alike everywhere.
    """

    moving_average: Array
    autoregression: Array
    neighbours: tuple[ARMANoise, ...] = ()
    factors: tuple[NoiseFactor, ...] = ()

    @property
    def white(self) -> bool:
        """Whether there is no memory, beside that of the factors."""
        return len(self.moving_average) == 1 and len(self.autoregression) == 1

    @property
    def memory(self) -> int:
        """Samples until the impulse response of H stays below one hundredth."""
        pulse = np.zeros(400)
        pulse[-1] = 1.0
        back = _filtered(self.moving_average, self.autoregression, pulse[::-1])
        return int(np.flatnonzero(np.abs(back) > 0.01)[-1]) + (len(self.factors) > 0)

    def innovations(self, e: Array, log: int = 0) -> Array:
        """Return ε along the last axis, of one of the logs."""
        alike = self.factors[log].solve(e) if self.factors else e
        return _filtered(self.autoregression, self.moving_average, alike)

    def adjoint(self, z: Array, log: int = 0) -> Array:
        """Return Hᵀz along the last axis, with Σ z e = Σ (Hᵀz) ε."""
        z = self.factors[log].adjoint(z) if self.factors else z
        back = _filtered(self.moving_average, self.autoregression, z[..., ::-1])
        return np.asarray(back[..., ::-1])

    def beside(self, factors: tuple[NoiseFactor, ...]) -> ARMANoise:
        """Return this model with one more neighbour, of other factors."""
        other = replace(self, neighbours=(), factors=factors)
        return replace(self, neighbours=(*self.neighbours, other))

    def freedom_of(self, z: Sequence[Array], *, together: bool = False) -> Array:
        """Return the degrees of freedom of the variance of Σ z e, for each row of z.

        2/ρ² with ρ the relative standard error that the fit leaves to it.

        Parameters
        ----------
        z : sequence of ndarray
            (k, N) an experiment.
        together : bool
            Of all rows together, (1,), in place of (k,).
        """

        def variance(colour: ARMANoise) -> Array:
            each = np.asarray(
                sum((colour.adjoint(x, log) ** 2).sum(axis=1) for log, x in enumerate(z))
            )
            return each.sum(keepdims=True) if together else each

        base = np.maximum(variance(self), 1e-300)
        square = np.zeros_like(base)
        for other in self.neighbours:
            square += (variance(other) / base - 1) ** 2
        return np.asarray(np.clip(2 / np.maximum(square, 1e-12), _LEAST_FREEDOM, 1e9))


WHITE = ARMANoise(np.ones(1), np.ones(1))


def _filtered(numerator: Array, denominator: Array, rows: Array) -> Array:
    """Run rows (..., N) through numerator over denominator, both with a leading 1.

    A banded triangular system; a signal library would take longer to load than to run.
    """
    from scipy.linalg.blas import dtbsv

    samples = rows.shape[-1]
    out = np.zeros(rows.shape)
    for i, coefficient in enumerate(numerator[:samples]):
        out[..., i:] += coefficient * rows[..., : samples - i]
    order = min(len(denominator), samples) - 1
    if order < 1:
        return out
    band = np.empty((order + 1, samples), order="F")
    band[:] = np.asarray(denominator, float)[: order + 1, None]
    for row in out.reshape(-1, samples):
        dtbsv(order, band, row, lower=1, diag=1, overwrite_x=1)
    return out


def fit_arma_noise(
    residuals: Sequence[Array],
    keep: Sequence[NDArray[np.bool_]],
    factors: tuple[NoiseFactor, ...] = (),
) -> ARMANoise:
    """Fit the noise model by least squares of the innovations, its order by BIC.

    Parameters
    ----------
    residuals : sequence of ndarray
        (N,) an experiment, zero in rows that do not take part.
    keep : sequence of ndarray of bool
        Only uninterrupted stretches are used; too few rows give white noise.
    factors : tuple of NoiseFactor
        What makes the errors of each log alike; none where they are.

    References
    ----------
    Box and Jenkins (1976), section 7.1; Schwarz (1978).
    """
    alike = list(residuals)
    if factors:
        alike = [f.solve(e) for f, e in zip(factors, residuals, strict=True)]
    stretches = [
        e[a:b] for e, k in zip(alike, keep, strict=True) for a, b in runs(k) if b - a >= 20
    ]
    rows = sum(len(r) for r in stretches)
    scale = np.sqrt(sum(float(r @ r) for r in stretches) / max(rows, 1))
    if rows < _LEAST_ROWS or not scale > 0:
        return replace(WHITE, factors=factors)
    # a gap of zeros between stretches lets one filter call serve them all
    series = np.concatenate([np.append(r / scale, np.zeros(30)) for r in stretches])
    inside = np.concatenate([np.append(np.ones(len(r)), np.zeros(30)) for r in stretches]) > 0
    best, least = WHITE, np.inf
    for ar, ma in _ORDERS:
        if factors and ar > 1 and best is WHITE:
            # what a factor leaves is most often white, and two orders fit that slowly
            continue
        candidate, squares = _fit(series, inside, ar, ma)
        criterion = rows * np.log(squares / rows) + (ar + ma) * np.log(rows)
        if criterion < least:
            best, least = candidate, criterion
    behind = tuple(replace(n, factors=factors) for n in best.neighbours)
    return replace(best, neighbours=behind, factors=factors)


def _polynomial(free: Array) -> Array:
    """Return a polynomial in delays with its roots inside the unit circle (Levinson)."""
    out = np.ones(1)
    for value in np.clip(np.tanh(free), -_EDGE, _EDGE):
        padded = np.append(out, 0.0)
        out = padded + value * padded[::-1]
    return out


def _fit(series: Array, inside: NDArray[np.bool_], ar: int, ma: int) -> tuple[ARMANoise, float]:
    from scipy.optimize import least_squares

    def colour(free: Array) -> ARMANoise:
        return ARMANoise(_polynomial(free[ar:]), _polynomial(free[:ar]))

    def innovations(free: Array) -> Array:
        return colour(free).innovations(series)[inside]

    if ar + ma == 0:
        return WHITE, float(innovations(np.zeros(0)) @ innovations(np.zeros(0)))
    start = np.full(ar + ma, -0.3)
    start[:ar] = -0.6
    found = least_squares(innovations, start, method="trf", x_scale=1.0, max_nfev=40, xtol=1e-4,
                          ftol=1e-6)  # fmt: skip
    best = colour(found.x)
    freedom = max(int(inside.sum()) - ar - ma, 1)
    spread = np.linalg.pinv(found.jac.T @ found.jac) * 2 * found.cost / freedom
    values, vectors = np.linalg.eigh(spread)
    axes = (vectors * np.sqrt(np.maximum(values, 0.0))).T
    return replace(best, neighbours=tuple(colour(found.x + axis) for axis in axes)), float(
        2 * found.cost
    )
