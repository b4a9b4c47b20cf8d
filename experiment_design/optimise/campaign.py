"""Search over all trials of a campaign, in rounds of independent pieces of work."""

from __future__ import annotations

import logging
import pickle
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from experiment_design.constraints.limits import TOLERANCE
from experiment_design.information.moments import Moments
from experiment_design.optimise.search import (
    REFERENCE,
    Candidate,
    assess,
    best_random,
    climb,
    draw_two_level,
    exchange,
    limit_scale,
    recombine,
)
from experiment_design.request.problem import TrialProblem
from experiment_design.request.request import PreparedRequest, build_problem
from greybox.numerics.parallel import map_pieces, processors

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]

# gradient evaluations of a search at effort 1, in all
_EVALUATIONS = 3000
_CHAINS = 4
_ROUNDS = 2
# passes over the trials of a campaign
_PASSES = 2
# times the evaluations where few sequences keep the limits, and the least that a chain needs then
_LIMITED, _LEAST = 2, 400
# most evaluations of one chain in one round
_LONGEST = 400
# seconds of work from which processes are worth starting
_PARALLEL = 4.0


@dataclass(frozen=True)
class Piece:
    """One chain of a search: what a worker needs, as plain data."""

    request: PreparedRequest
    trial: int
    known: tuple[Moments, ...]
    starts: Array
    seed: int
    budget: int


_log = logging.getLogger(__name__)
_problems: dict[bytes, TrialProblem] = {}


def _problem_of(request: PreparedRequest, trial: int) -> TrialProblem:
    key = pickle.dumps((request, trial))
    if key not in _problems:
        if len(_problems) > 8:
            _problems.clear()
        _problems[key] = build_problem(request, trial)
    return _problems[key]


def search_piece(piece: Piece) -> Candidate:
    """Run one chain."""
    problem = _problem_of(piece.request, piece.trial).with_known(piece.known)
    return climb(problem, piece.starts, piece.seed, piece.budget)


def own_moments(problem: TrialProblem, unit: Array) -> tuple[Moments, ...]:
    """Return the sums of one sequence under each scenario."""
    alone = problem.with_known(())
    commands = problem.commands(unit)
    return tuple(
        alone.moments(s.rollout.run(commands[None]), i) for i, s in enumerate(problem.scenarios)
    )


def add_up(parts: list[tuple[Moments, ...]]) -> tuple[Moments, ...]:
    """Return the sums of several trials."""
    total = parts[0]
    for part in parts[1:]:
        total = tuple(a + b for a, b in zip(total, part, strict=True))
    return total


def sums_of_others(problems: list[TrialProblem], units: list[Array], t: int) -> tuple[Moments, ...]:
    """Return the sums of all trials but one, under each scenario; empty for a single trial."""
    others = [
        own_moments(p, u) for o, (p, u) in enumerate(zip(problems, units, strict=True)) if o != t
    ]
    return add_up(others) if others else ()


def sums_of_all(problems: list[TrialProblem], units: list[Array]) -> Moments:
    """Return the sums of all trials under the nominal prior model."""
    return add_up([own_moments(p, u) for p, u in zip(problems, units, strict=True)])[0]


def covariance_of(problems: list[TrialProblem], units: list[Array]) -> Array:
    """Return the covariance (p_w, p_w) that sequences would give under the nominal prior model."""
    return np.asarray(problems[0].criterion.covariance(sums_of_all(problems, units))[0])


def std_of(problems: list[TrialProblem], units: list[Array]) -> Array:
    """Return the standard errors (p_w,) that sequences would give."""
    # of a parameter that the trial does not tell the covariance is infinite
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(np.diag(covariance_of(problems, units))))


@dataclass(frozen=True)
class Found:
    """What a search found: a candidate a trial, and what it took.

    ``stopped`` tells whether the user stopped it; ``evaluations`` is the work done.
    """

    candidates: tuple[Candidate, ...]
    evaluations: int
    stopped: bool


def random_campaign(problems: list[TrialProblem], seed: int) -> tuple[list[Array] | None, int]:
    """Return the best of 200 random two-level campaigns that keep the limits, and their number."""
    if len(problems) == 1:
        best, number = best_random(problems[0], seed)
        return (None if best is None else [best.unit]), number
    pools = []
    for t, problem in enumerate(problems):
        rng = np.random.default_rng([7, seed, t])
        pool: list[Array] = []
        for _ in range(10):
            unit = draw_two_level(problem, rng, REFERENCE)
            result = problem.evaluate(unit)
            # one trial alone need not excite every direction of a campaign
            good = (result.missed <= TOLERANCE).all(axis=0)
            pool += list(unit[good])
            if len(pool) >= REFERENCE or not good.any():
                break
        pools.append(pool[:REFERENCE])
    count = min(len(p) for p in pools)
    best_value = -np.inf
    best_units: list[Array] | None = None
    for i in range(count):
        units = [pool[i] for pool in pools]
        value = float(problems[0].criterion.value(sums_of_all(problems, units))[0])
        if value > best_value:
            best_value, best_units = value, units
    return best_units, count


def search_campaign(
    request: PreparedRequest,
    problems: list[TrialProblem],
    first: list[Array] | None,
    *,
    effort: float = 1.0,
    progress: Progress | None = None,
    workers: int | None = None,
    quick: bool = False,
) -> Found:
    """Search for the sequences of all trials.

    One trial: four chains of iterated local search in rounds, after each of which stretches of
    their designs are put together and the best so far is handed to the weakest chain. Several:
    one trial after another with the others' information known, twice around.

    Parameters
    ----------
    first : list of ndarray, optional
        (K, nc) per trial to start from, such as the best random ones or a design to be improved.
    effort : float
        Share of the usual number of evaluations.
    quick : bool
        One round from the start alone, for a design that was nearly right.
    """
    trials = len(problems)
    rng = np.random.default_rng([19, request.seed])
    if first is None:
        first = [draw_two_level(p, rng, 1)[0] for p in problems]
    best = [assess(p, u[None])[0] for p, u in zip(problems, first, strict=True)]
    passes = _PASSES if trials > 1 else 1
    # pieces stay short, so that progress shows and an interrupt loses little
    share = _EVALUATIONS * effort / (_CHAINS * passes * trials)
    rounds = max(_ROUNDS, int(np.ceil(share / _LONGEST)))
    if quick:
        passes = rounds = 1
    budget = max(30, round(_EVALUATIONS * effort / (_CHAINS * rounds * passes * trials)))
    if any(_tight(p, rng) for p in problems):
        budget = max(_LIMITED * budget, _LEAST // 2 if quick else _LEAST)
    total, done, spent, stopped = _CHAINS * rounds * passes * trials, 0, 0, False
    workers = workers or _worth_processes(problems[0], best[0].unit, budget * total)
    if workers > 1:
        # copies of this process then have what each would build in every round
        for t in range(trials):
            _problem_of(request, t)
    try:
        for _ in range(passes):
            for t, problem in enumerate(problems):
                known = sums_of_others(problems, [b.unit for b in best], t)
                scale = limit_scale(problem)
                here = problem.with_known(known)
                best[t] = assess(here, best[t].unit[None])[0]
                chains = (
                    [best[t].unit[None]] * _CHAINS if quick else _chain_starts(here, best[t], rng)
                )
                for round_ in range(rounds):
                    pieces = [
                        Piece(request, t, known, s, 100 * round_ + i, budget)
                        for i, s in enumerate(chains)
                    ]
                    found = []
                    for candidate in map_pieces(search_piece, pieces, workers=workers):
                        spent += candidate.evaluations
                        done += 1
                        found.append(candidate)
                        if candidate.beats(best[t], scale):
                            best[t] = candidate
                        if progress is not None:
                            progress(done, total)
                    _log.info(
                        "trial %d, round %d of %d: %d starts, %d evaluations, criterion %.6g",
                        t + 1, round_ + 1, rounds, len(chains), spent, best[t].value,
                    )  # fmt: skip
                    if not quick:
                        crossed = recombine(here, found, rng, budget)
                        spent += crossed.evaluations
                        best[t] = crossed if crossed.beats(best[t], scale) else best[t]
                        _log.info("their stretches put together: criterion %.6g", best[t].value)
                    weakest = 0
                    for i, candidate in enumerate(found):
                        if found[weakest].beats(candidate, scale):
                            weakest = i
                    chains = [c.unit[None] for c in found]
                    chains[weakest] = best[t].unit[None]
    except KeyboardInterrupt:
        stopped = True
    return Found(tuple(replace(b, evaluations=spent) for b in best), spent, stopped)


def _tight(problem: TrialProblem, rng: np.random.Generator) -> bool:
    """Whether fewer than half of random sequences keep the limits."""
    missed = problem.evaluate(draw_two_level(problem, rng, 40)).missed
    return bool((missed <= TOLERANCE).all(axis=0).mean() < 0.5)


def _chain_starts(problem: TrialProblem, best: Candidate, rng: np.random.Generator) -> list[Array]:
    """Return the starts of each chain: an exchanged one, and the best two-level sequences."""
    drawn = draw_two_level(problem, rng, REFERENCE)
    found = assess(problem, drawn)
    scale = limit_scale(problem)
    # feasible first; else those that miss least
    order = sorted(
        range(len(found)),
        key=lambda i: (
            float((np.maximum(found[i].missed, 0.0) / scale).sum()) if not found[i].feasible else 0,
            -found[i].value,
        ),
    )
    top = [best.unit, *[drawn[i] for i in order[: 2 * _CHAINS - 1]]]
    if problem.contrast is None and np.isfinite(best.value):
        # what single moves reach from the best start, beside what gradients reach from the others
        top[0] = exchange(problem, best.unit, 1).unit
    return [np.array(top[c::_CHAINS]) for c in range(_CHAINS)]


def _worth_processes(problem: TrialProblem, unit: Array, evaluations: int) -> int:
    """Return how many processes to use: one where the work is done before they would start."""
    problem.gradient(unit)
    began = time.perf_counter()
    problem.gradient(unit)
    each = time.perf_counter() - began
    return processors() if each * evaluations > _PARALLEL else 1
