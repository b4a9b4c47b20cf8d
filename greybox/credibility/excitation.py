"""What the instruments determine of each parameter, and the direction that is missing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from greybox.credibility.evidence import Equation
from greybox.estimation.verdict import TestResult
from greybox.numerics.linalg import scaled_inverse, sizes

Array = NDArray[np.float64]

# a direction with a smaller share of the largest singular value is called weak
_WEAK = 1e-3
_NAMED = 0.3


def excitation(equation: Equation) -> TestResult:
    """Tell how far the instruments move each regressor apart from the others.

    The variance inflation of each explained regressor, and what remains of it
    against the noise of its measurement, are in ``detail``.

    References
    ----------
    Belsley, Kuh and Welsch (1980).
    """
    solution = equation.solution
    labels = equation.labels
    values = solution.singular_values
    ratio = float(values[-1] / values[0]) if values[0] > 0 else 0.0
    gram = solution.information
    size = sizes(gram)
    inflation = np.maximum(np.diag(scaled_inverse(gram)) * size**2, 1.0)
    noise = np.sqrt(
        sum(
            ((f - h) ** 2).sum(axis=1)
            for f, h in zip(equation.phi, solution.projected, strict=True)
        )
    )
    alone = size / np.sqrt(inflation)
    against = np.divide(alone, noise, out=np.full(len(labels), np.inf), where=noise > 1e-9 * size)
    worst = int(np.argmax(inflation))
    missing = combination(labels, solution.weakest, _NAMED)
    verdict = (
        f"{missing} is weakly determined: change what these parameters multiply separately."
        if ratio < _WEAK
        else f"every combination of the parameters is determined, the weakest is {missing}."
    )
    return TestResult(
        "excitation",
        "the regressors that the instruments explain are independent",
        ratio,
        None,
        f"smallest relative singular value {ratio:.1e} ({_WEAK:.0e} is needed): {verdict} "
        f"{labels[worst]} has the largest variance inflation, {inflation[worst]:.3g}.",
        _WEAK,
        ratio >= _WEAK,
        (),
        {
            "variance_inflation": dict(zip(labels, inflation.tolist(), strict=True)),
            "movement_against_noise": {
                n: float(v) if np.isfinite(v) else None
                for n, v in zip(labels, against, strict=True)
            },
        },
        state=equation.state,
    )


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
