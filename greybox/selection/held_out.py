"""Scores of free runs on held-out logs, and the choice among alternatives by them.

Differences between alternatives matter, not scores: parts of a log are harder or
easier for all alike. So an alternative is as good as the best when it falls behind by
no more than one standard error of the difference (Breiman et al., 1984; Hastie,
Tibshirani and Friedman, 2009, section 7.10, for the rule on scores).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.errors import UsageError, so_many
from greybox.trial.log import TrialLog
from greybox.validation.fit import LogFit

Array = NDArray[np.float64]

# score of a run that is worse than this, or diverges [%]
FLOOR = -100.0
# where one part alone differs the mean gap is its own standard error, and rounding must not decide
_AT_MOST = 1 + 1e-9
# pieces with fewer samples are no experiment of their own
_SHORTEST = 20


@dataclass(frozen=True)
class Ranking:
    """Alternatives after their scores on the same parts.

    Parameters
    ----------
    score : ndarray
        (A,) mean over the parts [%], −inf for those that have none.
    behind : ndarray
        (A,) how far the score falls behind the best one [%].
    se : ndarray
        (A,) standard error of `behind` [%].
    best, chosen : int
    """

    score: Array
    behind: Array
    se: Array
    best: int
    chosen: int


def rank(
    scores: Sequence[Array | None], preferred: Sequence[int], *, given_away: float = np.inf
) -> Ranking:
    """Choose the most preferred alternative within one standard error of the best.

    Parameters
    ----------
    scores : sequence of ndarray
        (parts,) an alternative [%]; None where it could not be estimated.
    preferred : sequence of int
        (A,) smaller is preferred: the number of parameters, or a rank.
    given_away : float
        Points that a preferred alternative may fall behind at most [%].

    Raises
    ------
    UsageError
        No alternative has a score.
    """
    known = [i for i, s in enumerate(scores) if s is not None]
    if not known:
        raise UsageError(
            f"none of the {len(scores)} alternatives could be estimated on part of the logs: use "
            f"longer logs, or smaller structures."
        )
    mean = np.array([-np.inf if s is None else float(np.mean(s)) for s in scores])
    best = max(known, key=lambda i: (mean[i], -preferred[i]))
    behind, se = np.full(len(scores), np.inf), np.zeros(len(scores))
    for i in known:
        gap = np.asarray(scores[best]) - np.asarray(scores[i])
        behind[i] = gap.mean()
        se[i] = _AT_MOST * gap.std(ddof=1) / np.sqrt(len(gap)) if len(gap) > 1 else 0.0
    near = [i for i in known if behind[i] <= min(se[i], given_away)]
    chosen = min(near, key=lambda i: (preferred[i], behind[i]))
    return Ranking(mean, behind, se, best, chosen)


def spread_of(logs: Sequence[TrialLog], states: Sequence[str]) -> dict[str, float]:
    """Return the standard deviation of each state over whole logs.

    A held-out part in which little moves would otherwise count for everything.
    """
    return {s: float(np.std(np.concatenate([log[s] for log in logs]))) for s in states}


def score_runs(runs: Sequence[LogFit], spread: dict[str, float], blocks: int = 1) -> Array:
    """Return the fit against the spread of whole logs, averaged over the states [%].

    Parameters
    ----------
    runs : sequence of LogFit
    spread : dict of str to float
        Of `spread_of`.
    blocks : int
        Parts of equal length into which the runs, one after another, are cut.

    Returns
    -------
    ndarray
        (blocks,), at least −100.
    """
    if any(r.diverged >= 0 for r in runs):
        return np.full(blocks, FLOOR)
    errors = np.concatenate([r.errors() for r in runs])
    return score_errors(errors, np.array([spread[s] for s in runs[0].fit]), blocks)


def score_errors(errors: Array, spread: Array, blocks: int) -> Array:
    """Return what `score_runs` does of the errors (N, nx) of runs, not finite where one escapes."""
    out = np.full(blocks, FLOOR)
    if not np.isfinite(errors).all() or len(errors) < blocks:
        return out
    moving = spread > 0
    for b, part in enumerate(np.array_split(errors[:, moving], blocks)):
        with np.errstate(over="ignore"):
            ratio = np.sqrt(np.mean(part**2, axis=0)) / spread[moving]
        out[b] = np.mean(np.maximum(100 * (1 - ratio), FLOOR))
    return out


def extent(logs: Sequence[TrialLog]) -> tuple[tuple[str, float, float], ...]:
    """Return the identity of logs, or parts of them: names, beginnings and ends."""
    return tuple((log.name, float(log.t[0]), float(log.t[-1])) for log in logs)


def folds(logs: Sequence[TrialLog], count: int) -> list[tuple[list[TrialLog], list[TrialLog]]]:
    """Return (to estimate on, held out) for each of `count` contiguous parts of every log.

    Logs too short for parts, such as pieces between gaps, are always estimated on.

    Raises
    ------
    UsageError
        The parts of every log would be too short to run on.
    """
    longest = max(logs, key=len)
    if len(longest) // count < _SHORTEST:
        raise UsageError(
            f"'{longest.name}' has {so_many(len(longest), 'sample')} and gives "
            f"{so_many(count, 'part')} of "
            f"{len(longest) // count}, at least {_SHORTEST} samples are needed: use longer logs."
        )
    out = []
    for k in range(count):
        fitting, held = [], []
        for log in logs:
            if len(log) // count < _SHORTEST:
                fitting.append(log)
                continue
            edges = np.linspace(0, len(log), count + 1).astype(int)
            held.append(log.window(int(edges[k]), int(edges[k + 1]), log.name))
            for a, b in ((0, int(edges[k])), (int(edges[k + 1]), len(log))):
                if b - a >= _SHORTEST:
                    fitting.append(log.window(a, b, log.name))
        out.append((fitting, held))
    return out
