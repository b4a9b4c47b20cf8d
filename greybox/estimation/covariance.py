"""Covariance of the estimates when residuals are coloured, as they always are.

The equation error of (4.3) holds the measurement noise of two neighbouring
samples, so it is a moving average even where everything else is white; process
noise and wind add longer memory. A white-noise formula is off by up to a factor
six (FORMULAS).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from greybox.estimation.error_variance_profile import ErrorVarianceProfile, fit_scaled_arma_noise
from greybox.numerics.lagged_moments import autocovariance, flat_top, lagged_sums, weighted_lags

Array = NDArray[np.float64]
CovarianceKind = Literal["hac", "ma", "white"]


def correlation_lags(residuals: Sequence[Array], largest: int | None = None) -> int:
    """Return the lag after which the autocorrelation stays insignificant.

    Parameters
    ----------
    residuals : sequence of ndarray
        (N,) an uninterrupted stretch each.
    largest : int, optional
        Upper limit; by default N/10.

    References
    ----------
    Politis (2003), empirical rule for flat-top kernels: the smallest m with
    |ρ(m+k)| < 2√(log₁₀ N / N) for k = 1 … K.
    """
    total = sum(len(r) for r in residuals)
    if largest is None:
        largest = max(1, min(total // 10, 200))
    mean = sum(float(r.sum()) for r in residuals) / max(total, 1)
    residuals = [r - mean for r in residuals]
    variance = sum(float(r @ r) for r in residuals)
    if variance == 0.0:
        return 0
    look = max(5, int(np.sqrt(np.log10(max(total, 10)))) + 3)
    limit = 2.0 * np.sqrt(np.log10(max(total, 10)) / total)
    rho = lagged_sums(residuals, residuals, largest + look)[1:] / variance
    small = np.abs(rho) < limit
    for m in range(largest + 1):
        if small[m : m + look].all():
            return m
    return largest


def score_covariance(
    projected: Sequence[Sequence[Array]],
    residuals: Sequence[Sequence[Array]],
    kind: CovarianceKind = "hac",
    lags: int | None = None,
    shapes: Sequence[Sequence[ErrorVarianceProfile]] = (),
) -> tuple[Array, int]:
    """Estimate the covariance of the summed scores Σ ẑ e, equations together.

    Parameters
    ----------
    projected : sequence over equations of sequence over experiments of ndarray
        (p_i, N) combined instruments, zero in rows that do not take part.
    residuals : alike, of ndarray
        (N,) residuals, zero in rows that do not take part.
    kind : {"hac", "ma", "white"}
        ``hac``: robust to colour and to variance that changes, flat-top kernel;
        ``ma``: Σ Z R Zᵀ for instruments independent of the noise, R by a noise
        model of each equation's residuals; ``white``: no memory.
    lags : int, optional
        Memory in samples; by default found from the residuals. Given with
        ``ma``, R holds the residuals' own autocovariance up to there.
    shapes : sequence over equations of sequence over experiments of ErrorVarianceProfile
        How measurement noise changes along each log, for ``ma``; empty where it
        is alike everywhere.

    Returns
    -------
    tuple
        (p, p) covariance of the sum, and the lags used.

    References
    ----------
    Ljungberg (2020), eq. 2.21; Newey and West (1987); Politis (2003).
    """
    if kind == "ma" and lags is None:
        return _coloured(projected, residuals, shapes)
    if lags is None:
        lags = 0
        if kind != "white":
            lags = max(correlation_lags(equation) for equation in residuals)
    sizes = [equation[0].shape[0] for equation in projected]
    if kind == "ma":
        return clip_to_psd(_moving_average(projected, residuals, sizes, lags)), lags
    spread = np.repeat(np.arange(len(sizes)), sizes)
    scores = [
        np.vstack(hats) * np.array(errors)[spread]
        for hats, errors in zip(
            zip(*projected, strict=True), zip(*residuals, strict=True), strict=True
        )
    ]
    kernel = [1.0] if kind == "white" else flat_top(lags)
    return clip_to_psd(weighted_lags(scores, kernel)), lags


def _coloured(
    projected: Sequence[Sequence[Array]],
    residuals: Sequence[Sequence[Array]],
    shapes: Sequence[Sequence[ErrorVarianceProfile]],
) -> tuple[Array, int]:
    """Return Σ s sᵀ with s = (Hᵀ ẑ) ε of all equations, and the longest memory of a model."""
    keep = [np.asarray(hat.any(axis=0)) for hat in projected[0]]
    shapes = shapes or [()] * len(residuals)
    colours = [
        fit_scaled_arma_noise(equation, keep, shape, hats)
        for equation, shape, hats in zip(residuals, shapes, projected, strict=True)
    ]
    sizes = sum(equation[0].shape[0] for equation in projected)
    total = np.zeros((sizes, sizes))
    for e in range(len(keep)):
        scores = np.vstack(
            [
                c.adjoint(hats[e], e) * c.innovations(errors[e], e)
                for c, hats, errors in zip(colours, projected, residuals, strict=True)
            ]
        )
        total += scores @ scores.T
    return total, max(c.memory for c in colours)


def _moving_average(
    projected: Sequence[Sequence[Array]],
    residuals: Sequence[Sequence[Array]],
    sizes: list[int],
    lags: int,
) -> Array:
    """Return Σ Z R Zᵀ with R the residuals' autocovariance over all experiments."""
    spread = np.repeat(np.arange(len(sizes)), sizes)
    errors = [np.array(e) for e in zip(*residuals, strict=True)]
    stacked = [np.vstack(hats) for hats in zip(*projected, strict=True)]
    gammas = autocovariance(errors, [np.asarray(s.any(axis=0)) for s in stacked], lags)
    return weighted_lags(stacked, [gamma[np.ix_(spread, spread)] for gamma in gammas])


def clip_to_psd(matrix: Array) -> Array:
    """Return the nearest matrix without negative variances, in correlation units."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    if not (scale > 0).all():
        scale = np.where(scale > 0, scale, 1.0)
    unit = matrix / np.outer(scale, scale)
    values, vectors = np.linalg.eigh((unit + unit.T) / 2)
    if values[0] >= 0:
        return matrix
    floor = 1e-6 * values[-1]
    fixed = (vectors * np.maximum(values, floor)) @ vectors.T
    return np.asarray(fixed * np.outer(scale, scale))


def block_bootstrap(
    equations: Sequence[tuple[Sequence[Array], Sequence[Array], Sequence[Array]]],
    rng: np.random.Generator,
    *,
    draws: int = 500,
    block: int | None = None,
) -> Array:
    """Draw estimates of all equations by resampling blocks of rows that do not overlap.

    The normal equations add over blocks, so a draw is a weighted sum of block
    sums and costs nothing more than a solve. A block brings its rows of every
    equation, so that what errors of different equations have in common is kept.

    Parameters
    ----------
    equations : sequence of tuple
        Instruments as the estimator combined them and regressors, (p, N) an experiment
        each, and (N,) the left-hand side.
    rng : numpy.random.Generator
    draws : int
    block : int, optional
        Rows a block; by default about N^(1/2), at least 10.

    Returns
    -------
    ndarray
        (draws, p), equation after equation.

    References
    ----------
    Carlstein (1986).
    """
    lengths = [len(e) for e in equations[0][2]]
    if block is None:
        block = max(10, round(sum(lengths) ** 0.5))
    starts = [(e, start) for e, n in enumerate(lengths) for start in range(0, n, block)]
    counts = rng.multinomial(len(starts), np.full(len(starts), 1 / len(starts)), size=draws)
    found = []
    for projected, phi, y in equations:
        information, right = [], []
        for e, start in starts:
            part = slice(start, start + block)
            information.append(projected[e][:, part] @ phi[e][:, part].T)
            right.append(projected[e][:, part] @ y[e][part])
        a = np.tensordot(counts.astype(float), np.array(information), axes=1)
        b = counts @ np.array(right)
        found.append(np.linalg.solve(a, b[..., None])[..., 0])
    return np.concatenate(found, axis=1)
