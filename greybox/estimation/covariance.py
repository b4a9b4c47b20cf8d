"""Covariance of the estimates when residuals are coloured, as they always are.

The equation error of (4.3) holds the measurement noise of two neighbouring
samples, so it is a moving average even where everything else is white; process
noise and wind add longer memory. A white-noise formula is off by up to a factor
six (FORMULAS). Where the structure is only nearly right the residuals also depend on
the motion: then scores are summed over segments of the logs, and their spread counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from greybox.estimation.error_variance_profile import ErrorVarianceProfile, fit_scaled_arma_noise
from greybox.numerics.lagged_moments import autocovariance, flat_top, lagged_sums, weighted_lags
from greybox.numerics.linalg import sizes

Array = NDArray[np.float64]
CovarianceKind = Literal["hac", "ma", "white"]
Covariance = Literal["cluster", "hac", "ma", "white", "bootstrap"]

# segments that logs are cut into, at least, where the memory of the residuals allows it, and
# where it does not
_SEGMENTS, _FEWEST = 30, 10
# lengths of the residuals' memory that a segment holds at least
_MEMORIES = 4
# half-width of a normal 95 % interval, in standard errors
_NORMAL = 1.959964
# share of an equation's information from which on a segment alone determines a direction
_ALONE = 1e-6
# share of the information that the curvature of a misfit may not take
LEFT = 0.2
# degrees of freedom that count as certain
_SURE = 1e4


def correlation_lags(residuals: Sequence[Array]) -> int:
    """Return the lag after which the autocorrelation stays insignificant, N/10 at most.

    Parameters
    ----------
    residuals : sequence of ndarray
        (N,) an uninterrupted stretch each.

    References
    ----------
    Politis (2003), empirical rule for flat-top kernels: the smallest m with
    |ρ(m+k)| < 2√(log₁₀ N / N) for k = 1 … K.
    """
    total = sum(len(r) for r in residuals)
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


def segment_length(samples: Sequence[int], lags: int) -> int:
    """Return how many samples a segment of logs holds, several times the residuals' memory.

    Parameters
    ----------
    samples : sequence of int
        Of each log.
    lags : int
        Memory of the residuals.
    """
    total = sum(samples)
    return max(1, round(min(max(total / _SEGMENTS, _MEMORIES * lags), total / _FEWEST)))


def segment_sums(
    rows: Sequence[Array], residuals: Sequence[Array], lags: int
) -> tuple[Array, Array]:
    """Return the scores Σ ẑ e and the moments Σ ẑ ẑᵀ of each segment, (G, p) and (G, p, p).

    A segment is a log, or a part of one where that leaves more segments. Parts hold several
    times the memory of the residuals, so that scores of different segments are nearly
    independent.

    Parameters
    ----------
    rows : sequence of ndarray
        (p, N) or (p, N, ny) an experiment, zero in rows that do not take part.
    residuals : sequence of ndarray
        (N,) or (N, ny).
    lags : int
        Memory of the residuals in samples.
    """
    length = segment_length([len(r) for r in residuals], lags)
    scores, moments = [], []
    for z, e in zip(rows, residuals, strict=True):
        edges = np.linspace(0, len(e), max(1, round(len(e) / length)) + 1).astype(int)
        for start, stop in pairwise(edges):
            own = z[:, start:stop].reshape(len(z), -1)
            scores.append(own @ e[start:stop].ravel())
            moments.append(own @ own.T)
    return np.array(scores), np.array(moments)


def cluster_std(scores: Array, moments: Array, bread: Array) -> tuple[Array, Array]:
    """Return standard errors by the spread of the scores between segments, and their freedom.

    Parameters
    ----------
    scores, moments : ndarray
        (G, p) and (G, p, p) of `segment_sums`.
    bread : ndarray
        (p, p), which maps a score to a change of the estimate.

    Returns
    -------
    tuple of ndarray
        (p,) standard errors (CR2), unbiased where errors are in truth white, and (p,)
        Satterthwaite's degrees of freedom of their squares in that case.

    References
    ----------
    Bell and McCaffrey (2002); Pustejovsky and Tipton (2018).
    """
    whole = moments.sum(axis=0)
    # rows and columns of a score in units in which the information is the identity
    size = sizes(whole)
    values, vectors = np.linalg.eigh(whole / np.outer(size, size))
    known = values > _ALONE**2 * values[-1]
    root = vectors[:, known] * np.sqrt(values[known])
    into = (vectors[:, known] / np.sqrt(values[known])).T / size
    share = into @ moments @ into.T
    left, axes = np.linalg.eigh(np.eye(len(into)) - share)
    # what one segment alone determines leaves no residual to judge by
    grown = np.where(left > _ALONE, 1 / np.sqrt(np.maximum(left, _ALONE)), 0.0)
    adjust = axes * grown[:, None] @ axes.transpose(0, 2, 1)
    map_ = bread @ (size[:, None] * root)
    # (G, p, k) weights of the scores in each coefficient
    weights = map_ @ adjust
    away = np.einsum("gck,gk->gc", weights, scores @ into.T)
    variance = (away**2).sum(axis=0)
    seen = weights @ share
    own = np.einsum("gck,gck->gc", seen, weights)
    # Ω_gh = δ_gh wᵀ S_g w − wᵀ S_g S_h w, coefficient by coefficient
    trace = own.sum(axis=0) - (seen**2).sum(axis=(0, 2))
    cross = np.einsum("gck,hck->cgh", seen, seen)
    square = (cross**2).sum(axis=(1, 2)) + (own**2 - 2 * own * np.einsum("cgg->gc", cross)).sum(
        axis=0
    )
    freedom = trace**2 / np.maximum(square, 1e-300)
    return np.sqrt(variance), freedom


def curved(bread: Array, moments: Array, change: Array) -> Array:
    """Return the bread of an estimate whose instruments or sensitivities move with it.

    Residuals of a model that is only nearly right do not average out of Σ (∂ẑ/∂θ) e.

    Parameters
    ----------
    bread : ndarray
        (p, p), the inverse of Σ ẑ φᵀ.
    moments : ndarray
        (p, p) Σ ẑ ẑᵀ.
    change : ndarray
        (p, p) Σ (∂ẑ/∂θ_j) e in column j.

    Returns
    -------
    ndarray
        (p, p) the inverse of Σ ẑ φᵀ less the change, as far as that leaves a fifth of what the
        logs tell of each direction.

    References
    ----------
    White (1982), the sandwich of an M-estimate.
    """
    size = sizes(moments)
    values, vectors = np.linalg.eigh(moments / np.outer(size, size))
    root = np.sqrt(np.maximum(values, values[-1] * 1e-15))
    into, back = (vectors / root).T / size, size[:, None] * vectors * root
    u, kept, vt = np.linalg.svd(np.eye(len(bread)) - into @ change @ bread @ back)
    inverse = (vt.T / np.maximum(kept, LEFT)) @ u.T
    return np.asarray(bread @ back @ inverse @ into)


def moderated(ratio: Array, freedom: Array) -> tuple[Array, Array]:
    """Return ratios of variances drawn together as far as their own freedom explains the scatter.

    Few segments make each ratio uncertain; that of many coefficients together is not. Where
    the ratios scatter no more than their degrees of freedom say, their common value is taken.

    Parameters
    ----------
    ratio, freedom : ndarray
        (p,) of coefficients: the variance by segments over that without, and its degrees of
        freedom.

    Returns
    -------
    tuple of ndarray
        (p,) and (p,), the ratios and their degrees of freedom.

    References
    ----------
    Smyth (2004), section 6: empirical Bayes, prior from all of them by moments of log F.
    """
    from scipy.optimize import brentq
    from scipy.special import digamma, polygamma

    def centre(d: Array | float) -> Array:
        return np.asarray(digamma(d / 2) - np.log(d / 2))

    logs = np.log(ratio) - centre(freedom)
    beyond = 0.0
    if len(logs) > 1:
        beyond = float(logs.var(ddof=1) - polygamma(1, freedom / 2).mean())
    prior = _SURE
    if beyond > polygamma(1, _SURE / 2):
        prior = 2 * float(brentq(lambda x: polygamma(1, x) - beyond, 1e-3, _SURE))
    common = np.exp(logs.mean() + centre(prior))
    return (prior * common + freedom * ratio) / (prior + freedom), prior + freedom


def allow_for_segments(
    covariance: Array, sums: Sequence[tuple[Array, Array]], breads: Sequence[Array]
) -> Array:
    """Return a covariance that is no smaller than the spread between segments says.

    Standard errors grow where `cluster_std` finds more, by so much that 1.96 of them are the
    95 % interval of Student's t; correlations stay.

    Parameters
    ----------
    covariance : ndarray
        (p, p); columns of zeros are left as they are.
    sums : sequence of tuple
        Of `segment_sums`, one an equation, whose columns follow each other.
    breads : sequence of ndarray
        As `cluster_std`, likewise.
    """
    from scipy.special import stdtrit

    found = [cluster_std(*s, b) for s, b in zip(sums, breads, strict=True)]
    std, freedom = (np.concatenate(x) for x in zip(*found, strict=True))
    before = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    known = np.flatnonzero((before > 0) & (std > 0))
    factor = np.ones(len(covariance))
    if len(known):
        ratio, sure = moderated((std[known] / before[known]) ** 2, np.maximum(freedom[known], 1.0))
        factor[known] = np.maximum(np.sqrt(ratio) * stdtrit(sure, 0.975) / _NORMAL, 1.0)
    return covariance * np.outer(factor, factor)


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
