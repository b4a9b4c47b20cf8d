"""Tests of free-run errors, their memory and slow drifts, and the noise that they tell of.

All channels of a run share the parameters, so its scores are summed over channels;
and a fit bends towards slow errors, which therefore hide in its residuals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from greybox.estimation.covariance import CovarianceKind, clip_to_psd
from greybox.estimation.free_run import noise_of
from greybox.estimation.innovations import FilterRuns, first_noise, fit_noise
from greybox.estimation.output_setup import measured, turns
from greybox.estimation.shooting import FreeRuns, Loss, cut
from greybox.model.output import OutputModel
from greybox.numerics.lagged_moments import flat_top, lagged_sums, weighted_lags
from greybox.trial.log import TrialLog

Array = NDArray[np.float64]

# cycles a log below which power counts as slow
_CORNERS = (8.0, 24.0, 72.0)
# of the draws of `memory_correction` and `slow_errors`, how many each has, and the most that the
# former may multiply a variance by
_SEED, _DRAWS, _CORRECTION = 11, (40, 99), 9.0
# process noise to start from, in deviations of the measurements
_BESIDE = 0.1
# least and largest process noise that is tried, likewise, and how many
_GRID = (3e-3, 1.0, 12)
# samples of each log that noise levels are sought in
_NOISE_SAMPLES = 1500
# what −log L rises by where a level has no weight left
_UNLIKELY = 25.0
# least noise of an output, in its weight of the fit
_LEAST = 1e-9


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
    rows: Sequence[Array], hessian: Array, residuals: Sequence[Array], lags: int
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
    for _ in range(_DRAWS[0]):
        errors = [_draw(rng, root, len(r)) for root, r in zip(roots, residuals, strict=True)]
        shift = sum(np.einsum("qkc,kc->q", e, r) for e, r in zip(moved, errors, strict=True))
        left = [r - np.einsum("qkc,q->kc", e, shift) for e, r in zip(rows, errors, strict=True)]
        found += np.maximum(variance(flat_top_autocovariance(left, lags)), 0.0)
    truth = np.maximum(variance(gamma), 0.0)
    ratio = truth * _DRAWS[0] / np.maximum(found, 1e-300)
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
    rows: Sequence[Array], hessian: Array, residuals: Sequence[Array]
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

    Returns
    -------
    tuple of ndarray
        (ny,) how many standard deviations of the drawn powers the power lies above
        their mean, and (ny,) Monte Carlo p-values, multiples of a hundredth.

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

    flat = [e.reshape(len(e), -1) for e in rows]
    drawn = [power(residuals)]
    for _ in range(_DRAWS[1]):
        errors = [rng.standard_normal(r.shape) for r in residuals]
        pairs = list(zip(flat, errors, strict=True))
        shift = inverse @ sum(e @ r.ravel() for e, r in pairs)
        drawn.append(power([r - (shift @ e).reshape(r.shape) for e, r in pairs]))
    values = np.array(drawn)
    spread = values[1:].std(axis=0)
    most = ((values - values[1:].mean(axis=0)) / np.where(spread > 0, spread, 1.0)).max(axis=1)
    return most[0], (1 + (most[1:] >= most[0]).sum(axis=0)) / (1 + _DRAWS[1])


def residual_noise(runs: FreeRuns, p: Array, nodes: Array, loss: Loss) -> FreeRuns:
    """Return the runs weighted by their own residuals, whatever weights they were fitted with."""
    r, _, _ = runs.value(p, nodes)
    return runs.with_sigma(noise_of(r, runs.sigma, runs.segments.use, loss, _LEAST * runs.sigma))


def noise_of_sensors(runs: FreeRuns) -> tuple[OutputModel, Array, str]:
    """Return the residuals' variances as those of the measurements, and no process noise."""
    nz = len(runs.model.states)
    variances = np.concatenate([runs.sigma**2, np.zeros(nz)])
    return runs.model, variances, "residuals of the free run, process noise taken as none"


def noise_of_run(
    runs: FreeRuns, p: Array, nodes: Array, logs: Sequence[TrialLog]
) -> tuple[OutputModel, Array, str]:
    """Return variances of the measurements and of a step, of a fit that knew the former only.

    The parameters are held: a free run tells them best where little moves the ship
    beside the model, and how much that is, its innovations tell. Those of the heading
    take part, because they tell yaw noise that the yaw rate's own sensor hides.
    """
    model = runs.model
    ends = np.flatnonzero(~runs.segments.joined)
    nodes = nodes[np.concatenate([[0], ends[:-1] + 1])]
    seen = dict(zip(model.outputs, runs.sigma, strict=True))
    if turns(model.predictor.structure, logs) and "psi" not in seen:
        model = replace(model, heading="output")
        nodes = np.column_stack([nodes, [log["psi"][0] for log in logs]])
    # levels need fewer samples than coefficients
    data = [measured(model, log).first(_NOISE_SAMPLES) for log in logs]
    whole = cut(data, max(len(d.y) for d in data))
    first = first_noise(data, len(model.states))
    sigma = np.array([seen.get(n, np.sqrt(first[i])) for i, n in enumerate(model.outputs)])
    start = np.concatenate([sigma, _BESIDE * sigma[: len(model.states)]]) ** 2
    filtered = FilterRuns(model, whole, start)
    if not np.isfinite(filtered.value(p, nodes)[2]):
        return noise_of_sensors(runs)
    found = fit_noise(filtered, p, nodes)
    mean = found.copy()
    for i in range(len(sigma), len(found)):
        mean[i] = mean_variance(filtered, p, nodes, found, i, sigma[i - len(sigma)])
    return model, mean, "likelihood of the innovations at the coefficients of the free run"


def mean_variance(
    runs: FilterRuns, p: Array, nodes: Array, noise: Array, i: int, unit: float
) -> float:
    """Return the mean of one variance under its likelihood, flat in the logarithm.

    Where little moves the ship the most likely deviation is often 0, and a band that
    believes it is too narrow.
    """
    from scipy.interpolate import PchipInterpolator

    steps = np.unique(np.append(unit * np.geomspace(*_GRID), np.sqrt(noise[i])))
    loss: list[float] = []
    for step in steps:
        trial = noise.copy()
        trial[i] = step**2
        r, levels = runs.filtered(p, nodes, trial)
        # a variance under which the run escapes is not likely at all
        with np.errstate(over="ignore"):
            loss.append((float((r**2).sum()) + float(levels.sum())) / 2)
        if step > np.sqrt(noise[i]) and loss[-1] > min(loss) + _UNLIKELY:
            # larger ones are less likely still
            break
    steps = steps[: len(loss)]
    fine = np.geomspace(steps[0], steps[-1], 400)
    values = np.array(loss)
    values = np.where(np.isfinite(values), values, np.nanmax(values[np.isfinite(values)]))
    weight = np.exp(values.min() - PchipInterpolator(np.log(steps), values)(np.log(fine)))
    if not weight.any():
        # sharper than the grid
        return float(steps[values.argmin()] ** 2)
    return float(weight @ fine**2 / weight.sum())
