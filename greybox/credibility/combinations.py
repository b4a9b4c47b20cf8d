"""Parameters that are poorly known alone but well known in combination."""

from __future__ import annotations

from typing import Any

import numpy as np

from greybox.credibility.evidence import Evidence
from greybox.estimation.verdict import TestResult, not_applicable

# a combination is reported where its standard error is so many times smaller
_FACTOR = 3.0
_REPORTED = 3


def combinations(evidence: Evidence, state: str) -> TestResult:
    """Name pairs of parameters whose combination is known far better than either.

    θ_i + c θ_j with c = −C_ij / C_jj has the standard error s_i √(1 − ρ²).
    """
    null = "each parameter is known about as well as any combination of two"
    predictor = evidence.predictor
    mine = [i for i in predictor.equation(state) if not predictor.columns[i].is_bias]
    std = evidence.std
    known = [i for i in mine if np.isfinite(std[i]) and std[i] > 0]
    if len(known) < 2:
        reason = "fewer than two parameters have a standard error"
        return not_applicable("combinations", null, reason, state)
    found = []
    for a, i in enumerate(known):
        for j in known[a + 1 :]:
            rho = float(evidence.covariance[i, j] / (std[i] * std[j]))
            factor = 1 / np.sqrt(max(1 - rho**2, 1e-12))
            found.append((factor, i, j))
    found.sort(reverse=True)
    shown: list[dict[str, Any]] = []
    parts: list[str] = []
    used: set[int] = set()
    for factor, i, j in found:
        if factor < _FACTOR or len(shown) == _REPORTED or {i, j} <= used:
            continue
        used |= {i, j}
        c = -float(evidence.covariance[i, j]) / float(std[j]) ** 2
        one, other = predictor.columns[i].label, predictor.columns[j].label
        together, alone = 1.96 * std[i] / factor, 1.96 * std[i]
        parts.append(
            f"{one} {'+' if c > 0 else '−'} {abs(c):.2g}·{other} is known to ± {together:.2g}, "
            f"{one} alone only to ± {alone:.2g}"
        )
        shown.append(
            {"of": [one, other], "weights": [1.0, c], "half_width": together, "alone": alone}
        )
    sentence = (
        "; ".join(parts) + "."
        if parts
        else f"no pair is known more than {_FACTOR:g} times better than its members."
    )
    return TestResult(
        "combinations",
        null,
        float(found[0][0]),
        None,
        sentence,
        _FACTOR,
        None,
        (),
        {"pairs": shown},
        state=state,
    )
