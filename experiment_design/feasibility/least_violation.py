"""The sequence that violates limits least: which limit stops a trial, and by how much."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from experiment_design.constraints.limits import TOLERANCE, LimitKind, LimitName
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


def least_change(problem: TrialProblem, best: Candidate) -> list[tuple[LimitName, float]]:
    """Return each limit that a sequence misses with the amount, the worst first."""
    names = problem.scenarios[0].limits.names
    scale = limit_scale(problem)
    missed = [(name, float(m)) for name, m in zip(names, best.missed, strict=True) if m > TOLERANCE]
    order = {n.name: s for n, s in zip(names, scale, strict=True)}
    return sorted(missed, key=lambda item: -item[1] / order[item[0].name])


def in_words(name: LimitName, amount: float, what: str = "", lower: str = "") -> str:
    """Return one sentence: what stops the trial, and the least change that was found to help.

    Parameters
    ----------
    name : LimitName
    amount : float
        By how much it is missed at best, in its unit.
    what : str
        What more there is to say.
    lower : str
        Margins to ask for instead, as options.
    """
    a = float(np.ceil(amount * 1e3) / 1e3)
    unit = f" {name.unit}" if name.unit else ""
    if name.kind is LimitKind.MARGIN:
        reached = name.bound - a
        if reached >= 0:
            other = "start on another heading (--start)"
            if name.margin != "air":
                other = "choose another --regime"
            return (
                f"the {name.name}, {name.bound:g}{unit}, cannot be kept: {reached:.3f}{unit} is "
                f"the most that was reached. Use {lower or f'{name.option} {0.9 * reached:.3f}'}, "
                f"widen the limits of the thrusters, or {other}.{what}"
            )
        return (
            f"the {name.name}, {name.bound:g}{unit}, cannot be kept: the sign changes by "
            f"{-reached:.3f}{unit} in every sequence that was tried. Choose another --regime or "
            f"widen the limits of the thrusters.{what}"
        )
    if name.kind is LimitKind.SEA_ROOM:
        return (
            f"the sea room is too small: the best sequence leaves it by {amount:.1f} m. Enlarge "
            f"it by {np.ceil(amount):.0f} m on every side, or shorten the trial.{what}"
        )
    if name.kind is LimitKind.HEADINGS:
        least = np.floor(99 * (name.bound - a)) / 100
        return (
            f"headings cannot cover {name.bound:.3g} rad: {name.bound - amount:.3g} rad is the "
            f"most that was reached. Lower --headings to {least:g} or "
            f"lengthen the trial.{what}"
        )
    if name.kind is LimitKind.END_STATE:
        return (
            f"the {name.name} within {name.bound:g}{unit} cannot be reached: it is missed by "
            f"{amount:.3g}{unit} beyond that. Raise the tolerance in --end to "
            f"{name.bound + a:.4g}{unit}, or lengthen the trial.{what}"
        )
    return (
        f"the {name.name} of {name.bound:g}{unit} cannot be kept: it is missed by "
        f"{amount:.3g}{unit} at best. Raise {name.option} to {name.bound + a:.4g}{unit}.{what}"
    )
