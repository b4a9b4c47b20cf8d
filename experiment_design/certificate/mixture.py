"""Weights of a mixture of sequences that maximise a concave criterion."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

Array = NDArray[np.float64]


def best_weights(
    worth: Callable[[list[Array]], tuple[float, list[Array]]],
    weights: Sequence[Array],
    iterations: int,
    least: float = 1e-6,
) -> list[Array]:
    """Return the weights of each trial's sequences, their sum one, that are worth most.

    Parameters
    ----------
    worth : callable
        Returns the criterion of such weights, and its derivative in those of each trial.
    weights : sequence of ndarray
        To begin with, (n,) a trial.
    iterations : int
        At most.
    least : float
        Weight from which one begins that is smaller, 0 included.
    """
    ends = np.cumsum([len(w) for w in weights])[:-1]

    def shares(flat: Array) -> list[Array]:
        parts = [np.exp(x - x.max()) for x in np.split(flat, ends)]
        return [p / p.sum() for p in parts]

    def cost(flat: Array) -> tuple[float, Array]:
        parts = shares(flat)
        value, slopes = worth(parts)
        if not np.isfinite(value):
            return 1e6, np.zeros_like(flat)
        pulled = [-w * (g - w @ g) for w, g in zip(parts, slopes, strict=True)]
        return -value, np.concatenate(pulled)

    start = np.log(np.maximum(np.concatenate(weights), least))
    found = minimize(cost, start, jac=True, method="L-BFGS-B", options={"maxiter": iterations})
    return shares(found.x)
