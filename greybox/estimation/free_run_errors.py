"""Tests of free-run errors: their memory, and slow drifts.

All channels of a run share the parameters, so its scores are summed over channels;
and a fit bends towards slow errors, which therefore hide in its residuals.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from greybox.estimation.covariance import CovarianceKind, clip_to_psd
from greybox.numerics.lagged_moments import flat_top, lagged_sums, weighted_lags

Array = NDArray[np.float64]

# cycles a log below which power counts as slow
_CORNERS = (8.0, 24.0, 72.0)
# of the draws of `memory_correction`, and the most that it may multiply a variance by
_SEED, _CORRECTION = 11, 9.0


def shared_score_covariance(
    scores: Sequence[tuple[Array, Array]], kind: CovarianceKind, lags: int
) -> Array:
    """Estimate the covariance of Σ E(k) r(k) where all channels share the parameters.

    Parameters
    ----------
    scores : sequence of tuple
        (q, N, ny) derivatives and (N, ny) residuals of each experiment, both in
        noise deviations.
    kind : {"ma", "hac", "white"}
        ``ma``: Σ E R Eᵀ with the residuals' own autocovariance, channels
        together; ``hac``: from the products, flat-top kernel; ``white``.
    lags : int
        Memory in samples.

    Returns
    -------
    ndarray
        (q, q)

    References
    ----------
    Ljung (1999), eq. 9.42; Newey and West (1987); Politis (2003).
    """
    if kind == "ma":
        gamma = flat_top_autocovariance([r for _, r in scores], lags)
        found = [_filtered_products(rows, gamma[: len(r)]) for rows, r in scores]
        return clip_to_psd(np.sum(found, axis=0))
    products = [np.einsum("qkc,kc->qk", rows, residuals) for rows, residuals in scores]
    return clip_to_psd(weighted_lags(products, [1.0] if kind == "white" else flat_top(lags)))


def flat_top_autocovariance(residuals: Sequence[Array], lags: int) -> Array:
    """Return the flat-top estimate of E r(k + lag) r(k)ᵀ, (2·lags + 1, ny, ny).

    Parameters
    ----------
    residuals : sequence of ndarray
        (N, ny) an uninterrupted stretch each; rows of zeros where nothing was measured.
    lags : int
        Memory in samples.
    """
    samples = max(sum(int(r.any(axis=1).sum()) for r in residuals), 1)
    reach = min(2 * lags, max(len(r) for r in residuals) - 1)
    gamma = lagged_sums([r.T[:, None] for r in residuals], [r.T[None] for r in residuals], reach)
    weight = np.array(flat_top(lags)[: reach + 1])
    return np.asarray(np.moveaxis(gamma * weight, -1, 0) / samples)


def memory_correction(
    rows: Sequence[Array], hessian: Array, residuals: Sequence[Array], lags: int, *, draws: int = 40
) -> Array:
    """Return by how much the fit hides the memory of its residuals from the standard errors.

    A fit bends towards slow errors, so the residuals show less of them than there
    is. Errors are drawn with the autocovariance found, fitted likewise to first
    order, and the estimate of the standard errors compared with the one that the
    drawing used.

    Parameters
    ----------
    rows : sequence of ndarray
        (q, N, ny) derivatives of each experiment.
    hessian : ndarray
        (q, q) Σ E Eᵀ.
    residuals : sequence of ndarray
        (N, ny) of each experiment.
    lags : int
    draws : int

    Returns
    -------
    ndarray
        (q,) factors of at least 1 on the standard errors.
    """
    rng = np.random.default_rng(_SEED)
    gamma = flat_top_autocovariance(residuals, lags)
    roots = [_spectral_root(gamma, len(r)) for r in residuals]
    inverse = np.linalg.pinv(hessian, hermitian=True)
    moved = [np.einsum("ij,jkc->ikc", inverse, e) for e in rows]
    products = [_lagged_products(e, len(gamma)) for e in moved]

    def variance(g: Array) -> Array:
        return np.asarray(sum(np.einsum("lab,qlab->q", g[: c.shape[1]], c) for c in products))

    found = np.zeros(len(hessian))
    for _ in range(draws):
        errors = [_draw(rng, root, len(r)) for root, r in zip(roots, residuals, strict=True)]
        shift = sum(np.einsum("qkc,kc->q", e, r) for e, r in zip(moved, errors, strict=True))
        left = [r - np.einsum("qkc,q->kc", e, shift) for e, r in zip(rows, errors, strict=True)]
        found += np.maximum(variance(flat_top_autocovariance(left, lags)), 0.0)
    truth = np.maximum(variance(gamma), 0.0)
    ratio = truth * draws / np.maximum(found, 1e-300)
    return np.asarray(np.sqrt(np.clip(ratio, 1.0, _CORRECTION)), float)


def _spectral_root(gamma: Array, samples: int) -> NDArray[np.complex128]:
    """Return a root of the spectrum of an autocovariance on a circle, (F, ny, ny)."""
    from scipy.fft import next_fast_len, rfft

    size = 2 * next_fast_len(samples // 2 + len(gamma), real=True)
    kernel = np.zeros((size, *gamma.shape[1:]))
    kernel[: len(gamma)] = gamma
    kernel[size - len(gamma) + 1 :] = gamma[:0:-1].transpose(0, 2, 1)
    values, vectors = np.linalg.eigh(rfft(kernel, axis=0))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :])


def _draw(rng: np.random.Generator, root: NDArray[np.complex128], samples: int) -> Array:
    """Draw (samples, ny) with the spectrum whose root is given."""
    from scipy.fft import irfft, rfft

    size = 2 * (len(root) - 1)
    white = rfft(rng.standard_normal((size, root.shape[1])), axis=0)
    return np.asarray(irfft(np.einsum("fab,fb->fa", root, white), size, axis=0)[:samples])


def _lagged_products(rows: Array, reach: int) -> Array:
    """Return C with Σ_lag Σ_ab γ_ab(lag) C_lab,q the variance that γ gives, (q, reach, ny, ny)."""
    by_channel = rows.transpose(0, 2, 1)
    reach = min(reach, rows.shape[1]) - 1
    sums = lagged_sums([by_channel[:, :, None]], [by_channel[:, None]], reach)
    out = np.ascontiguousarray(np.moveaxis(sums, -1, 1))
    # both signs of every lag but the first
    out[:, 1:] *= 2.0
    return out


def _filtered_products(rows: Array, gamma: Array) -> Array:
    """Return Σ E(k) Γ(k − j) E(j)ᵀ over all pairs of samples, by fast convolution."""
    from scipy.fft import irfft, next_fast_len, rfft

    q, samples, _ = rows.shape
    size = next_fast_len(samples + 2 * len(gamma), real=True)
    # Γ(−lag) = Γ(lag)ᵀ, wrapped around
    kernel = np.zeros((size, *gamma.shape[1:]))
    kernel[: len(gamma)] = gamma
    kernel[size - len(gamma) + 1 :] = gamma[:0:-1].transpose(0, 2, 1)
    spectrum = rfft(kernel, axis=0)
    moved = np.einsum("fab,qfb->qfa", spectrum, rfft(rows, size, axis=1))
    filtered = irfft(moved, size, axis=1)[:, :samples]
    product = rows.reshape(q, -1) @ filtered.reshape(q, -1).T
    return np.asarray((product + product.T) / 2)


def slow_errors(
    rows: Sequence[Array], hessian: Array, residuals: Sequence[Array], *, draws: int = 99
) -> tuple[Array, Array]:
    """Test whether free-run errors wander, channel by channel.

    The statistic is the power below one of some corner frequencies. White noise is
    drawn and fitted to first order with the same derivatives, because a fit removes most
    of what is slow.

    Parameters
    ----------
    rows : sequence of ndarray
        (q, N, ny) derivatives of each experiment, in noise deviations.
    hessian : ndarray
        (q, q) Σ E Eᵀ.
    residuals : sequence of ndarray
        (N, ny) of each experiment.
    draws : int

    Returns
    -------
    tuple of ndarray
        (ny,) how many standard deviations of the drawn powers the power lies above
        their mean, and (ny,) Monte Carlo p-values, multiples of 1/(draws + 1).

    References
    ----------
    Barnard (1963), Monte Carlo tests.
    """
    rng = np.random.default_rng(_SEED)
    inverse = np.linalg.pinv(hessian, hermitian=True)

    def power(errors: Sequence[Array]) -> Array:
        out = np.zeros((len(_CORNERS), errors[0].shape[1]))
        for r in errors:
            spectrum = np.abs(np.fft.rfft(r, axis=0)) ** 2
            cycles = np.arange(len(spectrum))
            for i, corner in enumerate(_CORNERS):
                out[i] += (1 / (1 + (cycles / corner) ** 2)) @ spectrum
        level = np.sum([(r**2).sum(axis=0) for r in errors], axis=0)
        return np.asarray(out / np.maximum(level, 1e-300))

    drawn = [power(residuals)]
    for _ in range(draws):
        errors = [rng.standard_normal(r.shape) for r in residuals]
        shift = inverse @ sum(
            e.reshape(len(e), -1) @ r.ravel() for e, r in zip(rows, errors, strict=True)
        )
        drawn.append(
            power(
                [
                    r - (shift @ e.reshape(len(e), -1)).reshape(r.shape)
                    for e, r in zip(rows, errors, strict=True)
                ]
            )
        )
    values = np.array(drawn)
    spread = values[1:].std(axis=0)
    most = ((values - values[1:].mean(axis=0)) / np.where(spread > 0, spread, 1.0)).max(axis=1)
    return most[0], (1 + (most[1:] >= most[0]).sum(axis=0)) / (1 + draws)
