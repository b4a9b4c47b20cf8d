"""Spread: of noise by medians, which few outliers do not move, and of what differs by log."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# of a normal distribution: standard deviation over the median of the absolute value
FROM_MEDIAN = 1.4826
# Huber's bound in standard deviations: 95 % as efficient as least squares on normal errors
HUBER = 1.345
# variance of a third difference of white noise of variance 1
_THIRD = 20.0


def robust_deviation(values: Array) -> float:
    """Return the standard deviation about 0 of normal values, from their median size."""
    return FROM_MEDIAN * float(np.median(np.abs(values)))


def huber_loss(r: Array) -> Array:
    """Return Huber's loss of errors in standard deviations, half a square where they are small."""
    size = np.abs(r)
    return np.where(size <= HUBER, 0.5 * r**2, HUBER * (size - HUBER / 2))


def huber_weights(r: Array) -> Array:
    """Return the weights of errors in standard deviations with which squares do as Huber's loss."""
    return np.asarray(np.minimum(1.0, HUBER / np.maximum(np.abs(r), 1e-12)))


def white_noise(parts: Sequence[Array]) -> float | None:
    """Return the standard deviation of the white noise of a signal, from its third differences.

    That of a motion is small, that of white noise is not.

    Parameters
    ----------
    parts : sequence of ndarray
        (N,) stretches of equally spaced samples, nan where unknown.

    Returns
    -------
    float or None
        None where fewer than four neighbouring samples are known.
    """
    rough = [np.diff(part, 3) for part in parts if len(part) > 3]
    known = np.concatenate([d[np.isfinite(d)] for d in rough]) if rough else np.zeros(0)
    return robust_deviation(known) / float(np.sqrt(_THIRD)) if len(known) else None


def variance_between(apart: Array, weights: Array) -> Array:
    """Return the variance between logs beyond that of chance (DerSimonian and Laird, 1986).

    Parameters
    ----------
    apart : ndarray
        (n, ...) values of the logs from their weighted mean.
    weights : ndarray
        (n, ...) one over the variance by chance of each, 0 where nothing is known of it.

    Returns
    -------
    ndarray
        (...) 0 where chance alone makes values differ as much.
    """
    total = weights.sum(axis=0)
    spare = total - (weights**2).sum(axis=0) / np.maximum(total, 1e-300)
    excess = (weights * apart**2).sum(axis=0) - ((weights > 0).sum(axis=0) - 1)
    return np.asarray(np.maximum(excess, 0.0) / np.maximum(spare, 1e-300))
