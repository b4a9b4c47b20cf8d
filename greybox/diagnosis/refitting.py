"""Fits with one more cause: begun, begun again where slow errors hold them, and final_refit."""

from __future__ import annotations

from collections.abc import Sequence

from greybox.diagnosis.base import Case
from greybox.diagnosis.fitting import Problem
from greybox.diagnosis.hypothesis import Hypothesis
from greybox.diagnosis.noise import SEEN
from greybox.diagnosis.point import Fit
from greybox.diagnosis.scores import ProjectedScores, Score, score_hypotheses

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
    first = problem.fit(point, fit.noise, most=FIRST)
    return problem.settle(problem.scan(first, score.hypothesis), 1)


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


def seen_as_slow(
    problem: Problem, fit: Fit, hypotheses: Sequence[Hypothesis]
) -> list[tuple[Hypothesis, Fit]]:
    """Return refits that begin with errors that forget, judged with their likeliest colour.

    A force with a long memory imitates most causes; where it was taken for one, what
    a cause promises is hidden, and its search ends where it began.
    """
    plain = problem.forgetful(fit, _FORGOTTEN)
    promising = shortlist(score_hypotheses(ProjectedScores(problem, plain), hypotheses))
    return [(s.hypothesis, refit(problem, plain, s)) for s in promising[:_SECOND]]


def likelier(
    fits: Sequence[tuple[Hypothesis, Fit]], others: Sequence[tuple[Hypothesis, Fit]]
) -> list[tuple[Hypothesis, Fit]]:
    """Return the likeliest fit of each hypothesis."""
    best: dict[str, tuple[Hypothesis, Fit]] = {}
    for hypothesis, fit in (*fits, *others):
        if hypothesis.key not in best or fit.cost < best[hypothesis.key][1].cost:
            best[hypothesis.key] = (hypothesis, fit)
    return list(best.values())


def final_refit(case: Case, fit: Fit, hypothesis: Hypothesis) -> Fit:
    """Return the likeliest fit that a cause allows once it is in force."""
    problem = case.problem(fit.integrator)
    # what the noise had taken for its own until now would pass for more causes
    better = loosened(problem, problem.settle(fit, SETTLE))
    if not any(a.refit_from_scratch for a in better.point.hypotheses):
        better = case.refit_from_least_squares(better)
    better = case.likeliest_variant(case.other_integrator(better), hypothesis)
    # what a sample holds decides how it is best stepped, too
    better = case.other_integrator(better)
    # with errors as small as they are now, its hills are steeper
    return case.problem(better.integrator).scan(better, hypothesis)
