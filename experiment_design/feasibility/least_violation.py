"""The sequence that violates limits least: which limit stops a trial, and by how much."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from experiment_design.constraints.limits import TOLERANCE, Limit
from experiment_design.optimise.search import (
    Candidate,
    assess,
    draw_two_level,
    limit_scale,
    within_reach,
)
from experiment_design.request.problem import TrialProblem

Array = NDArray[np.float64]

_STARTS = 6
_ITERATIONS = 200
# penalties of the squared shortfall; the last one weighs the worst sample most
_PENALTIES = (1.0, 100.0)
# sizes, in unit coordinates, and number of the changes that are made to a constant sequence
_CHANGES, _TRIED = (0.3, 0.1, 0.03, 0.01), 32


def closest(problem: TrialProblem, starts: Array, seed: int) -> Candidate:
    """Return the sequence that misses the limits least, all information aside.

    Parameters
    ----------
    problem : TrialProblem
    starts : ndarray
        (S, K, nc) sequences to start from, beside constant ones.
    seed : int
    """
    rng = np.random.default_rng([23, seed])
    pool = np.concatenate([starts, _constant(problem, rng), draw_two_level(problem, rng, 100)])
    scale = limit_scale(problem)
    found = assess(problem, pool)
    order = sorted(range(len(pool)), key=lambda i: _short(found[i], scale))
    best = found[order[0]]
    for i in order[:_STARTS]:
        unit = pool[i]
        for penalty in _PENALTIES:
            result = minimize(
                _shortfall,
                unit.ravel(),
                args=(problem, penalty),
                jac=True,
                method="L-BFGS-B",
                bounds=[(0.0, 1.0)] * unit.size,
                options={"maxiter": _ITERATIONS},
            )
            unit = np.asarray(result.x).reshape(problem.shape)
            unit = within_reach(problem, unit)
            candidate = assess(problem, unit[None])[0]
            if _short(candidate, scale) < _short(best, scale):
                best = candidate
        if _short(best, scale) == 0.0:
            break
    return best


def _constant(problem: TrialProblem, rng: np.random.Generator) -> Array:
    holds, commands = problem.shape
    return np.repeat(rng.random((400, 1, commands)), holds, axis=1)


def moved_constant(problem: TrialProblem, seed: int) -> Candidate | None:
    """Return the most informative sequence near constant ones that keep the limits, else None.

    A constant one may lie at the edge of a limit, so that every change of it crosses it:
    several are changed.
    """
    scale = limit_scale(problem)
    found = assess(problem, _constant(problem, np.random.default_rng([23, seed])))
    nearest = sorted(found, key=lambda c: _short(c, scale))[:_STARTS]
    lively = [c for c in (perturbed(problem, still, seed) for still in nearest) if c.feasible]
    return max(lively, key=lambda c: c.value, default=None)


def perturbed(problem: TrialProblem, still: Candidate, seed: int) -> Candidate:
    """Return the most informative sequence near a given one that keeps the limits as it does.

    The sequence that misses limits least is often a constant one, which tells nothing.
    """
    rng = np.random.default_rng([29, seed])
    best = still
    for size in _CHANGES:
        noise = size * rng.standard_normal((_TRIED, *problem.shape))
        around = within_reach(problem, np.clip(still.unit + noise, 0, 1))
        for candidate in assess(problem, around):
            if candidate.feasible and candidate.value > best.value:
                best = candidate
    return best


def _short(candidate: Candidate, scale: Array) -> float:
    over = np.where(candidate.missed > TOLERANCE, candidate.missed, 0.0) / scale
    return float(over.max(initial=0.0))


def _shortfall(flat: Array, problem: TrialProblem, penalty: float) -> tuple[float, Array]:
    """Return the penalty terms alone, with their gradient."""
    unit = flat.reshape(problem.shape)
    with_penalty = problem.gradient(unit, None, penalty)
    without = problem.gradient(unit, None, 0.0)
    if not np.isfinite(with_penalty[1]):
        return 1e9, np.zeros(flat.size)
    cost = without[1] - with_penalty[1]
    return cost, (without[2] - with_penalty[2]).ravel()


def least_change(problem: TrialProblem, best: Candidate) -> list[tuple[Limit, float]]:
    """Return each limit that a sequence misses with the amount, the worst first."""
    limits = problem.scenarios[0].limits.all_limits
    missed = [(x, float(m)) for x, m in zip(limits, best.missed, strict=True) if m > TOLERANCE]
    return sorted(missed, key=lambda item: -item[1] / item[0].scale)
