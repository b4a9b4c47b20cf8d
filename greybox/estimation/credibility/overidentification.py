"""Whether more instruments than parameters agree on one estimate."""

from __future__ import annotations

import numpy as np

from greybox.estimation.credibility.evidence import Equation
from greybox.estimation.credibility.kernel import Array
from greybox.estimation.credibility.scores import score_test
from greybox.estimation.result import TestResult, not_applicable

LEVEL = 0.05
# samples by which the further instruments of a single log are delayed
_DELAY = 5


def overidentification(equation: Equation, biases: frozenset[str]) -> TestResult:
    """Test that all instruments are valid (Sargan-Hansen).

    Robust to the moving average and to noise that changes its size.
    Several logs bring more equations than parameters by their own instruments;
    to these, and to a single log, the parameters' instruments delayed by five
    samples are added.

    References
    ----------
    Sargan (1958); Hansen (1982); score form: Wooldridge (1995).
    """
    name = f"overidentification_{equation.state}"
    null = "the estimate satisfies the equations of all instruments, delayed ones included"
    if equation.obstacle:
        return not_applicable(name, null, equation.obstacle)
    wanted = [i for i, n in enumerate(equation.labels) if n not in biases]
    later = [delayed(z[wanted], k, _DELAY) for z, k in zip(equation.z, equation.keep, strict=True)]
    xi = later
    if len(equation.z) > 1:
        xi = [np.vstack([s, d]) for s, d in zip(equation.stacked, later, strict=True)]
    score = score_test(
        xi,
        equation.phi,
        equation.solution.projected,
        equation.residuals,
        colour=equation.colour,
    )
    if not score.freedom:
        return not_applicable(name, null, "no further instrument says anything new")
    agree = score.p_value >= LEVEL
    return TestResult(
        name,
        null,
        score.statistic,
        score.p_value,
        f"J = {score.statistic:.1f} on {score.freedom} restrictions (p = {score.p_value:.2g}): "
        + (
            "the instruments agree."
            if agree
            else "the instruments contradict each other: the model lacks something that the inputs "
            "move, or logs differ."
        ),
        LEVEL,
        agree,
        (),
        {"degrees_of_freedom": score.freedom},
    )


def delayed(rows: Array, keep: np.ndarray, delay: int) -> Array:
    """Return rows (k, N) delayed, without mean over the rows that take part, zero elsewhere."""
    out = np.zeros_like(rows)
    valid = keep.copy()
    if delay >= len(keep):
        return out
    valid[:delay] = False
    # a cut row has no value to hand on
    valid[delay:] &= keep[: len(keep) - delay]
    if valid.any():
        out[:, delay:] = rows[:, : rows.shape[1] - delay]
        out = np.where(valid, out - out[:, valid].mean(axis=1, keepdims=True), 0.0)
    return out
