"""Search for the best levels: exchange at the limits, and ascent along exact gradients.

Good designs switch between the limits, and the criterion has very many local
maxima. One ascent by L-BFGS-B costs tens of milliseconds, so many are made: from
the best random two-level sequences, then from the best design so far
with one stretch drawn anew (iterated local search). Limits on the motion enter by
an augmented Lagrangian, so that a start need not keep them.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from experiment_design.constraints.limits import TOLERANCE
from experiment_design.excitation.inputs import random_two_level
from experiment_design.request.problem import TrialProblem

Array = NDArray[np.float64]
_log = logging.getLogger(__name__)

# random sequences that `efficiency_vs_random` is measured against
REFERENCE = 200
_DRAWS = 4000
_OUTER = 10
_ITERATIONS = 150
# fewer where limits matter: multipliers are better renewed than a penalty followed to its end
_LIMITED_ITERATIONS = 50
# a criterion a parameter that is gained for each scaled unit of a limit, at first
_PENALTY = 3.0
# most sequences put together from others at a time, how many of them are climbed from and by how
# many evaluations of the gradient, and how often this is done while it gains this much
_SPLICES, _CLIMBED, _ASCENT = 1000, 3, 100
_CROSSINGS, _ENOUGH = 4, 1e-3


@dataclass(frozen=True)
class Candidate:
    """A sequence with what it is worth.

    Parameters
    ----------
    unit : ndarray
        (K, nc) unit coordinates of the levels.
    value : float
        Criterion.
    missed : ndarray
        (m,) by how much each limit is missed.
    evaluations : int
        Evaluations that it took.
    """

    unit: Array
    value: float
    missed: Array
    evaluations: int = 0

    @property
    def feasible(self) -> bool:
        """Whether every limit is kept and every direction excited."""
        return bool((self.missed <= TOLERANCE).all() and np.isfinite(self.value))

    def beats(self, other: Candidate | None, scale: Array) -> bool:
        """Whether this one is to be preferred: kept limits first, then the value."""
        if other is None:
            return True
        mine, theirs = self.shortfall(scale), other.shortfall(scale)
        if mine == theirs == 0.0:
            return self.value > other.value
        return mine < theirs

    def shortfall(self, scale: Array) -> float:
        """Return by how much limits are missed, in their units (m,) added up."""
        over = np.where(self.missed > TOLERANCE, self.missed, 0.0) / scale
        total = float(over.sum()) if over.size else 0.0
        return total if np.isfinite(self.value) else total + 1e6


def limit_scale(problem: TrialProblem) -> Array:
    """Return the unit of each limit (m,)."""
    return problem.scenarios[0].limits.scale


def assess(problem: TrialProblem, unit: Array) -> list[Candidate]:
    """Return candidates of sequences (R, K, nc)."""
    result = problem.evaluate(unit)
    return [
        Candidate(u, float(v), result.missed[:, i])
        for i, (u, v) in enumerate(zip(unit, result.value, strict=True))
    ]


def to_unit(problem: TrialProblem, levels: Array) -> Array:
    """Return the unit coordinates of levels."""
    s = problem.schedule
    span = np.where(s.upper > s.lower, s.upper - s.lower, 1.0)
    return np.asarray((levels - s.lower) / span)


def within_reach(problem: TrialProblem, unit: Array) -> Array:
    """Return unit coordinates (..., K, nc) clipped to what limits and rates allow."""
    return to_unit(problem, problem.schedule.within_reach(problem.levels(unit)))


def draw_two_level(problem: TrialProblem, rng: np.random.Generator, count: int) -> Array:
    """Draw sequences (count, K, nc) with each command at one of its limits, as rates allow."""
    return within_reach(problem, random_two_level(*problem.shape, count, rng))


def best_random(
    problem: TrialProblem, seed: int, count: int = REFERENCE
) -> tuple[Candidate | None, int]:
    """Return the best of `count` random two-level sequences that keep the limits.

    Returns
    -------
    tuple
        The best, None where no draw kept the limits, and how many did.
    """
    rng = np.random.default_rng([7, seed])
    best, kept, drawn = None, 0, 0
    while kept < count and drawn < _DRAWS:
        unit = draw_two_level(problem, rng, min(count, _DRAWS - drawn))
        drawn += len(unit)
        for candidate in assess(problem, unit):
            if candidate.feasible and kept < count:
                kept += 1
                if best is None or candidate.value > best.value:
                    best = candidate
        if drawn >= 2 * count and kept == 0:
            break
    return best, kept


def ascend(problem: TrialProblem, unit: Array, budget: int) -> Candidate:
    """Climb from a sequence, feasible or not, to a local maximum within the limits.

    Parameters
    ----------
    problem : TrialProblem
    unit : ndarray
        (K, nc) start.
    budget : int
        Most evaluations of the gradient.
    """
    shape = problem.shape
    spent = 0
    best: Candidate | None = None
    scale = limit_scale(problem)
    multipliers: Array | None = None
    penalty = _PENALTY
    current = np.asarray(unit, float)
    iterations = _ITERATIONS
    for outer in range(_OUTER):
        held = multipliers

        def cost(
            flat: Array, held: Array | None = held, penalty: float = penalty
        ) -> tuple[float, Array]:
            _, value, slope, _ = problem.gradient(flat.reshape(shape), held, penalty)
            if not np.isfinite(value):
                return 1e6, np.zeros(flat.size)
            return -value, -slope.ravel()

        most = max(2, min(2 * iterations, budget - spent))
        result = minimize(
            cost,
            current.ravel(),
            jac=True,
            method="L-BFGS-B",
            bounds=[(0.0, 1.0)] * current.size,
            options={"maxiter": iterations, "maxfun": most},
        )
        spent += int(result.nfev)
        current = np.asarray(result.x).reshape(shape)
        if problem.schedule.limited:
            current = within_reach(problem, current)
        candidate = assess(problem, current[None])[0]
        if candidate.beats(best, scale):
            best = candidate
        _, _, _, h = problem.gradient(current, held, penalty)
        spent += 1
        if not h.size or spent >= budget:
            break
        known = np.zeros_like(h) if multipliers is None else multipliers
        updated = np.maximum(0.0, known + penalty * h)
        if h.max() <= 1e-3 and (outer > 1 or not updated.any()):
            break
        iterations = _LIMITED_ITERATIONS
        if multipliers is not None and h.max() > 1e-3:
            penalty *= 2.0
        multipliers = updated
    assert best is not None
    return Candidate(best.unit, best.value, best.missed, spent)


def exchange(problem: TrialProblem, unit: Array, passes: int) -> Candidate:
    """Improve a sequence by moving one level at a time to a limit or the middle.

    All single moves are evaluated together; those that gain are then made one
    after another, best first, while they still gain.

    Parameters
    ----------
    passes : int
        Most rounds over all levels.
    """
    holds, commands = problem.shape
    scale = limit_scale(problem)
    best = assess(problem, unit[None])[0]
    spent = 1
    places = np.array(
        [(k, c, v) for k in range(holds) for c in range(commands) for v in (0, 0.5, 1)]
    )
    for _ in range(passes):
        trials = np.repeat(best.unit[None], len(places), axis=0)
        where = places[:, :2].astype(int)
        trials[np.arange(len(places)), where[:, 0], where[:, 1]] = places[:, 2]
        trials = within_reach(problem, trials)
        found = assess(problem, trials)
        spent += len(found)
        good = [i for i, c in enumerate(found) if c.beats(best, scale)]
        if not good:
            break
        good.sort(key=lambda i: (-found[i].feasible, -found[i].value))
        # several moves at once: cumulated best first, the best prefix is kept
        stacked, current = [], best.unit
        for i in good[:24]:
            current = current.copy()
            current[where[i, 0], where[i, 1]] = places[i, 2]
            stacked.append(current)
        several = within_reach(problem, np.array(stacked))
        candidates = [found[good[0]], *assess(problem, several)]
        spent += len(several)
        before = best
        for candidate in candidates:
            if candidate.beats(best, scale):
                best = candidate
        if best is before:
            break
    return Candidate(best.unit, best.value, best.missed, spent)


def recombine(
    problem: TrialProblem, found: list[Candidate], rng: np.random.Generator, budget: int
) -> Candidate:
    """Return what grows from stretches of one sequence put into another (two-point crossover).

    Local maxima differ in a few stretches, each of which is better in one of them than in the
    others: ascents leave them where they are.

    Parameters
    ----------
    problem : TrialProblem
    found : list of Candidate
        At least one; one alone is given back.
    rng : Generator
    budget : int
        Evaluations of the gradient to spend.
    """
    scale = limit_scale(problem)
    best = found[0]
    for candidate in found[1:]:
        best = candidate if candidate.beats(best, scale) else best
    holds = len(best.unit)
    pool, spent, climbed = list(found), 0, 0
    for _ in range(_CROSSINGS if min(holds, len(found)) > 1 else 0):
        into = rng.integers(len(pool), size=_SPLICES)
        of = (into + rng.integers(1, len(pool), size=_SPLICES)) % len(pool)
        first, last = np.sort(rng.integers(holds + 1, size=(2, _SPLICES)), axis=0)
        units, hold = np.array([c.unit for c in pool]), np.arange(holds)
        taken = (hold >= first[:, None]) & (hold < last[:, None])
        spliced = np.where(taken[..., None], units[of], units[into])
        if problem.schedule.limited:
            spliced = within_reach(problem, spliced)
        result = problem.evaluate(spliced)
        spent += len(spliced)
        kept = (result.missed <= TOLERANCE).all(axis=0)
        value = np.where(kept & np.isfinite(result.value), result.value, -np.inf)
        before = best
        _, each = np.unique(value.round(6), return_index=True)
        for i in each[::-1][:_CLIMBED]:
            if not np.isfinite(value[i]) or climbed >= budget:
                break
            candidate = ascend(problem, spliced[i], min(_ASCENT, budget))
            climbed += candidate.evaluations
            pool.append(candidate)
            best = candidate if candidate.beats(best, scale) else best
        if best is before or best.value - before.value < _ENOUGH:
            break
        pool = sorted(pool, key=lambda c: -c.value if c.feasible else np.inf)[: len(found)]
    return Candidate(best.unit, best.value, best.missed, spent + climbed)


def perturb(unit: Array, rng: np.random.Generator) -> Array:
    """Return a copy with one stretch of the sequence drawn anew, sometimes shifted or mirrored."""
    holds, commands = unit.shape
    out = unit.copy()
    kind = rng.random()
    first = int(rng.integers(0, holds))
    width = int(rng.integers(1, max(2, holds // 6) + 1))
    if kind < 0.8:
        out[first : first + width] = rng.random(out[first : first + width].shape)
    elif kind < 0.9:
        column = int(rng.integers(0, commands))
        out[:, column] = np.roll(out[:, column], int(rng.integers(1, max(2, holds // 4))))
    else:
        column = int(rng.integers(0, commands))
        out[first : first + 2 * width, column] = 1 - out[first : first + 2 * width, column]
    return out


def climb(problem: TrialProblem, starts: Array, seed: int, budget: int) -> Candidate:
    """Search from several starts by iterated local search.

    Parameters
    ----------
    problem : TrialProblem
    starts : ndarray
        (S, K, nc), the most promising first.
    seed : int
    budget : int
        Evaluations to spend.
    """
    rng = np.random.default_rng([11, seed])
    scale = limit_scale(problem)
    best: Candidate | None = None
    spent = 0
    queue = list(starts)
    while spent < budget or best is None:
        unit = queue.pop(0) if queue else perturb(best.unit, rng)  # type: ignore[union-attr]
        found = ascend(problem, unit, max(20, budget - spent))
        spent += found.evaluations
        if found.beats(best, scale):
            best = found
        _log.debug(
            "start with %d evaluations: criterion %.6g, best %.6g", found.evaluations, found.value,
            best.value if best is not None else found.value,
        )  # fmt: skip
    return Candidate(best.unit, best.value, best.missed, spent)
