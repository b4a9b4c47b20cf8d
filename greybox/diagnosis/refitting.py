"""Fits with one more cause, started again where slow errors hold them back, and the final one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import chain
from operator import itemgetter
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.fitting import Problem
from greybox.diagnosis.hypothesis import Hypothesis
from greybox.diagnosis.noise import SEEN
from greybox.diagnosis.null_model import DiagnosisProblem
from greybox.diagnosis.point import Fit, Point
from greybox.diagnosis.scores import ProjectedScores, Score, score_hypotheses
from greybox.numerics.parallel import lanes, map_forked

Array = NDArray[np.float64]
Told = TypeVar("Told")

# hypotheses that are refitted at a step, and promised fall of −2 log L below which none is
_SHORTLIST, _LEAST_GAIN = 7, 9.0
# share of the best promise from which on a hypothesis is worth a refit
_PROMISING = 0.04
# errors that are seen and remembered for more samples than this may be a cause's; they are
# then looked at with so short a memory, so many causes more tried
_SLOW, _FORGOTTEN, _SECOND = 30.0, 3.0, 4
# iterations of a refit before its noise is settled
FIRST = 12
# rounds of noise and fit for a cause that was taken
SETTLE = 4


def refit(problem: Problem, fit: Fit, score: Score) -> Fit:
    """Return the fit with one more hypothesis, its noise settled."""
    point = problem.add(fit.point, score.hypothesis, score.value if len(score.value) else None)
    first = problem.fit(point, fit.noise, most=FIRST, than=fit.cost)
    return problem.settle(problem.scan(first, score.hypothesis), 1, fit.cost)


def refits(problem: Problem, asked: Sequence[tuple[Fit, Score]]) -> list[tuple[Hypothesis, Fit]]:
    """Return the fits with one more hypothesis each."""
    points = [problem.add(fit.point, score.hypothesis) for fit, score in asked]
    found = on_all_processors(points, lambda k: (refit(problem, *asked[k]), None))
    return [(score.hypothesis, fit) for (_, score), (fit, _) in zip(asked, found, strict=True)]


def on_all_processors(
    points: Sequence[Point], work: Callable[[int], tuple[Fit, Told]]
) -> list[tuple[Fit, Told]]:
    """Return what a work finds for each of several points, with the fit that it ends at.

    What a hypothesis applies is a function, which no other process can send: fits come back
    as numbers, and are put in the place of those of the points.

    Parameters
    ----------
    points : sequence of Point
        With the free numbers that the fits end with.
    work : callable
        Of a point's index.
    """

    def numbers(k: int) -> tuple[Array, Fit, Told]:
        fit, told = work(k)
        return fit.point.vector(), replace(fit, point=replace(fit.point, hypotheses=())), told

    found = zip(points, map_forked(numbers, range(len(points))), strict=True)
    return [(replace(fit, point=point.at(v)), told) for point, (v, fit, told) in found]


def shortlist(scores: Sequence[Score]) -> list[Score]:
    """Return the hypotheses worth a refit."""
    best = scores[0].gain if scores else 0.0
    worth = [s for s in scores if s.gain > max(_LEAST_GAIN, _PROMISING * best)]
    # several moments and variants of one kind must not crowd out the other kinds
    out: list[Score] = []
    for score in worth:
        if (
            sum(s.hypothesis.cause == score.hypothesis.cause for s in out) < 3
            and len(out) < _SHORTLIST
        ):
            out.append(score)
    return out


def slow(fit: Fit) -> bool:
    """Whether the errors' own colour could be a cause's: slow, and larger than the sensors'."""
    return any(g.remembered > _SLOW and g.share > SEEN for g in fit.noise.groups)


def loosened(problem: Problem, fit: Fit) -> Fit:
    """Return the likelier of a fit and of one that began with errors that forget.

    Where the colour holds slow errors for its own, coefficients stay where they are.
    """
    if fit.escaped or not slow(fit):
        return fit
    plain = problem.forgetful(fit, _FORGOTTEN)
    found = problem.settle(problem.fit(fit.point, plain.noise), SETTLE)
    return found if found.cost < fit.cost else fit


def promises(
    problem: Problem, fit: Fit, hypotheses: Sequence[Hypothesis]
) -> tuple[list[Score], list[tuple[Fit, Score]]]:
    """Return the scores of hypotheses, the best first, and what to refit from errors that forget.

    A force with a long memory imitates most causes; where it was taken for one, what
    a cause promises is hidden, and its search ends where it began. What promises most to errors
    that forget is to be judged with their likeliest colour.
    """
    fits = [fit, problem.forgetful(fit, _FORGOTTEN)] if slow(fit) else [fit]
    keys = [h.key for h in hypotheses]
    parts = max(1, lanes() // len(fits))
    pieces = [(at, hypotheses[k::parts]) for at in fits for k in range(parts)]

    def work(k: int) -> list[tuple[int, Array, float]]:
        at, some = pieces[k]
        told = score_hypotheses(ProjectedScores(problem, at), some)
        # hypotheses are functions, which no other process can send
        return [(keys.index(s.hypothesis.key), s.value, s.gain) for s in told]

    done = map_forked(work, range(len(pieces)))
    found = []
    for n, at in enumerate(fits):
        numbers = chain.from_iterable(done[n * parts : (n + 1) * parts])
        told = sorted(numbers, key=itemgetter(0))
        scores = [Score(hypotheses[i], value, gain) for i, value, gain in told]
        found.append((at, sorted(scores, key=lambda s: -s.gain)))
    plain, *forgetful = found
    later = [(at, score) for at, scores in forgetful for score in shortlist(scores)[:_SECOND]]
    return plain[1], later


def likelier(fits: Sequence[tuple[Hypothesis, Fit]]) -> list[tuple[Hypothesis, Fit]]:
    """Return the likeliest fit of each hypothesis."""
    best: dict[str, tuple[Hypothesis, Fit]] = {}
    for hypothesis, fit in fits:
        if hypothesis.key not in best or fit.cost < best[hypothesis.key][1].cost:
            best[hypothesis.key] = (hypothesis, fit)
    return list(best.values())


def final_refit(case: DiagnosisProblem, fit: Fit, hypothesis: Hypothesis) -> Fit:
    """Return the likeliest fit that a cause allows once it is in force."""
    problem = case.problem(fit.integrator)
    # what the noise had taken for its own until now would pass for more causes
    better = loosened(problem, problem.settle(fit, SETTLE))
    if case.metric == "free run":
        # terms that were chosen stand in for what least squares and other steps would find
        return problem.scan(case.likeliest_variant(better, hypothesis), hypothesis)
    if not any(a.refit_from_scratch for a in better.point.hypotheses):
        better = case.refit_from_least_squares(better)
    before = better
    better = case.likeliest_variant(case.other_integrator(better), hypothesis)
    if better is not before:
        # what a sample holds decides how it is best stepped, too
        better = case.other_integrator(better)
    problem = case.problem(better.integrator)
    # with errors as small as they are now, its hills are steeper
    return problem.scan(loosened(problem, better), hypothesis)
