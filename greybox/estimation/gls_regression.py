"""The normal equations of all equations together, with their error made white.

Each log keeps its constants, one an equation, removed in the metric of Ω⁻¹; sums
add over logs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.errors import ExcitationError
from greybox.estimation.banded_covariance import ErrorBand, ErrorNoise
from greybox.estimation.covariance import (
    CovarianceKind,
    allow_for_segments,
    block_bootstrap,
    curved,
    score_covariance,
    segment_sums,
)
from greybox.estimation.noise import constant_rows
from greybox.model.predictor import Predictor
from greybox.numerics.banded import factor_band

Array = NDArray[np.float64]

# relative singular value below which the prefiltered instruments count as singular
_SINGULAR = 1e-10


@dataclass(frozen=True)
class WhiteRows:
    """One log with its error made white and its constants removed.

    Parameters
    ----------
    z, phi : ndarray
        (p, rows·nx) instruments and regressors.
    y : ndarray
        (rows·nx,)
    constants : ndarray
        (q, rows·nx) an orthonormal basis of what was removed.
    """

    z: Array
    phi: Array
    y: Array
    constants: Array


@dataclass(frozen=True)
class WhiteEquations:
    """All equations of an estimate together, with their error made white.

    Parameters
    ----------
    rows : tuple of WhiteRows
        One per log.
    inverse : ndarray
        (p, p) of Σ z φᵀ.
    equations : int
        How many there are: values of one sample stand together.
    """

    rows: tuple[WhiteRows, ...]
    inverse: Array
    equations: int


def own_constants(predictor: Predictor) -> list[bool]:
    """Return which equations have a constant of their own in each log, (nx,).

    Those whose structure holds one share it between logs.
    """
    with_one = {predictor.columns[i].state for i in predictor.constants}
    return [s not in with_one for s in predictor.structure.states]


def spread_columns(predictor: Predictor, rows: Array) -> Array:
    """Return regressors (p, N) in the rows of their own equations, (p, N, nx)."""
    states = predictor.structure.states
    out = np.zeros((*rows.shape, len(states)))
    for i, state in enumerate(states):
        mine = predictor.equation(state)
        out[mine, :, i] = rows[mine]
    return out


def white_rows(
    predictor: Predictor, band: ErrorBand, noise: ErrorNoise, z: Array, phi: Array, y: Array
) -> WhiteRows:
    """Whiten one log.

    Parameters
    ----------
    predictor : Predictor
    band : ErrorBand
    noise : ErrorNoise
    z, phi : ndarray
        (p, N)
    y : ndarray
        (nx, N)

    Raises
    ------
    ExcitationError
        The covariance of the errors is not positive: the noise levels make no sense.
    """
    factor = factor_band(band.covariance(noise))
    if factor is None:
        raise ExcitationError(
            f"the covariance of {band.rows} equation errors is singular at the noise levels "
            f"{noise.measurement} and {noise.process}: estimate without --prefilter."
        )
    from scipy.linalg.blas import dgemm

    p, own = len(z), own_constants(predictor)
    values = np.zeros((2 * p + 1 + sum(own), *y.T.shape))
    for i, state in enumerate(predictor.structure.states):
        mine = np.array(predictor.equation(state))
        values[mine, :, i], values[p + mine, :, i] = z[mine], phi[mine]
    values[2 * p], values[2 * p + 1 :] = y.T, constant_rows(y.shape[1], own)
    white = band.whiten(factor, noise, values, overwrite=True)
    basis = np.linalg.qr(white[2 * p + 1 :].T)[0].T
    white = white[: 2 * p + 1]
    if len(basis):
        # white −= (white basisᵀ) basis, where it stands
        dgemm(-1.0, basis.T, basis @ white.T, beta=1.0, c=white.T, overwrite_c=1)
    return WhiteRows(white[:p], white[p : 2 * p], white[2 * p], basis)


def solve_white(rows: Sequence[WhiteRows]) -> tuple[Array, Array]:
    """Solve Σ Zᵀ Ω⁻¹ Φ θ = Σ Zᵀ Ω⁻¹ y over all logs.

    Returns
    -------
    tuple of ndarray
        (p,) the estimate, and (p, p) the inverse of the left-hand sum; nan where singular.
    """
    gram = np.sum([r.z @ r.phi.T for r in rows], axis=0)
    right = np.sum([r.z @ r.y for r in rows], axis=0)
    z_size = np.sqrt(np.sum([(r.z**2).sum(axis=1) for r in rows], axis=0))
    phi_size = np.sqrt(np.sum([(r.phi**2).sum(axis=1) for r in rows], axis=0))
    z_size[z_size == 0], phi_size[phi_size == 0] = 1.0, 1.0
    u, values, vt = np.linalg.svd(gram / np.outer(z_size, phi_size))
    if not values[-1] > _SINGULAR * values[0]:
        return np.full(len(gram), np.nan), np.full(gram.shape, np.nan)
    inverse = (vt.T / values) @ u.T / np.outer(phi_size, z_size)
    return inverse @ right, inverse


def white_covariance(
    rows: Sequence[WhiteRows],
    bands: Sequence[ErrorBand],
    theta: Array,
    inverse: Array,
    kind: str = "ma",
    *,
    samples: Sequence[int],
    seed: int = 0,
    change: Array | None = None,
) -> tuple[Array, int]:
    """Return the covariance of the estimate and the lags it allows for.

    Parameters
    ----------
    kind : {"cluster", "ma", "hac", "white", "bootstrap"}
        ``white`` believes the noise model. The others do not: what colour the
        innovations keep counts, by their autocovariance (``ma``), by that of the
        scores (``hac``) or by blocks of rows; ``cluster`` is ``ma``, or more where
        scores differ more between segments.
    samples : sequence of int
        N of each log.
    change : ndarray, optional
        (p, p) of `curved`, for ``cluster``.
    """
    p, nx = len(theta), bands[0].nx
    errors = [r.y - theta @ r.phi for r in rows]
    if kind == "bootstrap":
        draws = block_bootstrap(
            [([r.z for r in rows], [r.phi for r in rows], [r.y for r in rows])],
            np.random.default_rng(seed),
            block=nx * max(10, round(sum(b.rows for b in bands) ** 0.5)),
        )
        return np.cov(draws.T).reshape(p, p), 0
    if kind == "white":
        middle, lags = np.sum([r.z @ r.z.T for r in rows], axis=0), 0
    else:
        robust: CovarianceKind = "hac" if kind == "hac" else "ma"
        projected, residuals = [], []
        for i in range(nx):
            hats, innovations = [], []
            for r, band, error, n in zip(rows, bands, errors, samples, strict=True):
                hat, innovation = np.zeros((p, n)), np.zeros(n)
                hat[:, band.keep] = r.z[:, i::nx]
                innovation[band.keep] = error[i::nx]
                hats.append(hat)
                innovations.append(innovation)
            projected.append(hats)
            residuals.append(innovations)
        blocks, lags = score_covariance(projected, residuals, robust)
        middle = blocks.reshape(nx, p, nx, p).sum(axis=(0, 2))
        count = sum(band.rows for band in bands)
        middle *= count / max(count - (p + nx) / nx, 1)
    found = inverse @ middle @ inverse.T
    if kind == "cluster":
        z = [r.z.reshape(p, -1, nx) for r in rows]
        sums = segment_sums(z, [e.reshape(-1, nx) for e in errors], lags)
        bread = inverse
        if change is not None:
            bread = curved(inverse, np.sum([r.z @ r.z.T for r in rows], axis=0), change)
        found = allow_for_segments(found, [sums], [bread])
    return found, lags
