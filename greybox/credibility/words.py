"""Combinations of named quantities in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def combination(labels: Sequence[str], weights: Array, least: float = 0.2) -> str:
    """Return ``A − 0.8·B``: the largest weights, relative to the first named.

    Parameters
    ----------
    labels : sequence of str
    weights : ndarray
        Alike.
    least : float
        Share of the largest weight below which one is not named.
    """
    size = np.abs(weights)
    order = [i for i in np.argsort(-size) if size[i] >= least * size.max()]
    first = order[0]
    parts = [labels[first]]
    for i in order[1:]:
        ratio = weights[i] / weights[first]
        parts.append(f"{'+' if ratio > 0 else '−'} {abs(ratio):.2g}·{labels[i]}")
    return " ".join(parts)


def listed(names: Sequence[str]) -> str:
    """Return names separated by commas."""
    return ", ".join(names)
