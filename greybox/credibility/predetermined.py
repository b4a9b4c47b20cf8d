"""What regressors that hold earlier noise leave in moments of least-squares residuals.

A state feels the noise of the samples before, so least squares is biased in short
logs although its moments vanish sample by sample, and with it Σ ξ ê. For white errors
E Σ f(s) e(s) = σ² E Σ ∂f(s)/∂e(s); with f = ξ̃ the rows left of ξ after the regressors,
and γ(j) = E v(t+j) e(t) the noise of the regressors j samples after the error,

    E Σ ξ ê = −Σ_j { Σ_s ξ̃(s+j) φ(s)ᵀ G⁻¹ γ(j) − B γ(j) Σ_s φ(s)ᵀ G⁻¹ φ(s+j) },

B = Σ ξ φᵀ G⁻¹; rows without their mean add B Σ_j γ(j) for each experiment.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from greybox.numerics.lagged_moments import convolve, lagged_products, lagged_sums
from greybox.numerics.linalg import scaled_inverse

Array = NDArray[np.float64]


# lags that are looked at, in roots of the number of rows
_REACH = 2.0


def noise_after_error(noise: Sequence[Array], errors: Sequence[Array]) -> Array:
    """Return γ(1) … γ(J), (J, p), J twice the root of the number of rows.

    Parameters
    ----------
    noise : sequence of ndarray
        (p, N) an experiment: regressors less what no error has moved.
    errors : sequence of ndarray
        (N,) an experiment.
    """
    rows = sum(len(e) for e in errors)
    reach = int(_REACH * np.sqrt(rows))
    sums = lagged_sums(noise, [e[None] for e in errors], reach)[:, 1:]
    return np.asarray((sums / np.maximum(rows - np.arange(1, reach + 1), 1)).T)


def moments_mean(
    xi: Sequence[Array], phi: Sequence[Array], after: Array, *, centred: bool
) -> Array:
    """Return E Σ ξ ê of least-squares residuals ê, (k,).

    Parameters
    ----------
    xi : sequence of ndarray
        (k, N) an experiment, free of the errors.
    phi : sequence of ndarray
        (p, N) regressors.
    after : ndarray
        (J, p) of `noise_after_error`.
    centred : bool
        Whether the rows are without their mean, experiment by experiment.

    References
    ----------
    Kendall (1954); Stein (1981), lemma 1; Stambaugh (1999).
    """
    inverse = scaled_inverse(lagged_products(phi, phi, 0), 1e-13)
    weights = lagged_products(xi, phi, 0) @ inverse
    left = [x - weights @ f for x, f in zip(xi, phi, strict=True)]
    # Σ_s φ(s)ᵀ G⁻¹ φ(s+j), and Σ_s ξ̃(s+j) φ(s)ᵀ G⁻¹ γ(j) summed over j
    traces = lagged_sums(phi, [inverse @ f for f in phi], len(after)).sum(axis=0)[1:]
    mean = weights @ (traces @ after)
    steps = np.concatenate([np.zeros((1, len(inverse))), after @ inverse.T])
    for x, f in zip(left, phi, strict=True):
        mean = mean - x @ convolve(f, steps.T[:, : f.shape[1]]).sum(axis=0)
    if centred:
        mean += len(phi) * (weights @ after.sum(axis=0))
    return np.asarray(mean)
