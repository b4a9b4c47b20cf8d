"""Whether more instruments than parameters agree on one estimate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from greybox.credibility.evidence import Equation
from greybox.credibility.score_statistic import ScoreStatistic
from greybox.credibility.score_test import Conclusion, ScoreTest, equation_score
from greybox.estimation.verdict import TestResult

Array = NDArray[np.float64]

# samples by which the further instruments of a single log are delayed
_DELAY = 5
_TEST = ScoreTest(
    "overidentification",
    "the estimate satisfies the equations of all instruments, delayed ones included",
    "no further instrument says anything new",
)


def overidentification(
    equation: Equation, biases: frozenset[str], *, each_log: bool = True
) -> TestResult:
    """Test that all instruments are valid (Sargan-Hansen).

    Robust to the moving average and to noise that changes its size. The simulated
    states and their products stand for terms that the structure may lack.
    Several logs bring more equations than parameters by their own instruments;
    to these, and to a single log, the parameters' instruments delayed by five
    samples are added.

    Parameters
    ----------
    equation : Equation
    biases : frozenset of str
        Labels of columns that only capture a disturbance.
    each_log : bool
        Whether each log's own instruments are asked too: not where the estimate does not
        rest on them.

    References
    ----------
    Sargan (1958); Hansen (1982); score form: Wooldridge (1995).
    """

    def score() -> ScoreStatistic:
        wanted = [i for i, n in enumerate(equation.labels) if n not in biases]
        xi = [delayed(z[wanted], k, _DELAY) for z, k in zip(equation.z, equation.keep, strict=True)]
        if equation.states:
            further = [
                delayed(_products(x), k, 0)
                for x, k in zip(equation.states, equation.keep, strict=True)
            ]
            xi = [np.vstack([d, f]) for d, f in zip(xi, further, strict=True)]
        if each_log and len(equation.z) > 1:
            xi = [np.vstack([s, d]) for s, d in zip(equation.stacked, xi, strict=True)]
        return equation_score(equation, xi)

    return _TEST.apply(equation, score, _conclude)


def _products(x: Array) -> Array:
    """Return states (nx, N) and their products in pairs."""
    first, second = np.triu_indices(len(x))
    return np.vstack([x, x[first] * x[second]])


def _conclude(score: ScoreStatistic, agree: bool) -> Conclusion:
    if agree:
        return Conclusion("the instruments agree.", True, {})
    return Conclusion(
        "the instruments contradict each other, since the simulated motion still explains the "
        "residuals: the model lacks something that the inputs move, or the logs differ from one "
        "another.",
        False,
        {},
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
