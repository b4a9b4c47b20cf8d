"""The search for causes: score all, refit the best, keep the likeliest that held-out logs confirm.

Forward steps with a backward check; a cause counts only when it is significant after
correction for all that were tried, and when it predicts logs that it was not fitted to.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.causes.sensors import alike_to_forces
from greybox.diagnosis.evidence.held_out import HeldOut, Proof, proof_of, worse
from greybox.diagnosis.evidence.omnibus import omnibus
from greybox.diagnosis.evidence.remainder import MOTION_AND_COMMANDS, contributions_beside
from greybox.diagnosis.evidence.standing import Standing, level_of, standing
from greybox.diagnosis.fitting import Problem, stacked
from greybox.diagnosis.hypothesis import Hypothesis
from greybox.diagnosis.null_model import DiagnosisProblem
from greybox.diagnosis.point import Fit
from greybox.diagnosis.refitting import (
    FIRST,
    SETTLE,
    final_refit,
    likelier,
    on_all_processors,
    promises,
    refits,
    shortlist,
)
from greybox.diagnosis.result import Quantity
from greybox.diagnosis.scores import MOMENTS, Score
from greybox.diagnosis.thresholds import (
    AS_CHOSEN,
    BACKWARDS,
    MOST_CAUSES,
    RELEVANT,
    SIGNIFICANT,
    SURE,
    WORTH,
)
from greybox.errors import so_many
from greybox.model.run.step import Integrator
from greybox.numerics.linalg import bounded_step
from greybox.numerics.parallel import map_forked

Array = NDArray[np.float64]

# coefficients that are positive where thrusters push as the vessel file says
_THRUST = ("Xmu", "Ymu", "Nmu")
# other causes that are tried in the place of one of several
_INSTEAD = 2
# share of the best fall of −2 log L from which on held-out logs are asked at once
_ASKED_FIRST = 0.5

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Candidate:
    """One more cause, fitted.

    Parameters
    ----------
    hypothesis : Hypothesis
    fit : Fit
        With all earlier causes and this one.
    gain : float
        Fall of −2 log L against the fit without it, at the noise that each has.
    p_value, p_adjusted : float
        Of that fall, and after correction for the number of causes tried (Holm).
    proof : Proof
        What it does for held-out logs.
    names : tuple of str
        Of the coefficients.
    tried : int
        Causes that the p-value is corrected for.
    freed : int
        Numbers that the cause frees.
    standing : Standing or None
        What it does beside a generic force; None until that is asked.
    told : mapping of str to Quantity, optional
        Its parameters where they stand already, and the fit holds it at them.
    """

    hypothesis: Hypothesis
    fit: Fit
    gain: float
    p_value: float
    p_adjusted: float
    proof: Proof
    names: tuple[str, ...] = ()
    tried: int = 1
    freed: int = 1
    standing: Standing | None = None
    told: Mapping[str, Quantity] | None = None

    @property
    def relevant(self) -> bool:
        """Whether the cause is large enough to matter, and to tell from sampling."""
        numbers = sum(int(known.sum()) for known in self.fit.known)
        both = (self.gain + self.proof.gain) / 2
        return max(self.gain, both) > RELEVANT * numbers and not self.unresolved

    @property
    def unresolved(self) -> bool:
        """Whether sampling itself would look alike."""
        if self.hypothesis.apply is None or self.told is not None:
            return False
        k = [a.key for a in self.fit.point.hypotheses].index(self.hypothesis.key)
        values = self.fit.point.values[k]
        return any(
            abs(v - p.null) < p.least
            for v, p in zip(values, self.hypothesis.parameters, strict=True)
        )

    @property
    def holds(self) -> bool:
        """Whether the cause matters, is significant, and predicts."""
        return self.counts and self.proof.p_value < AS_CHOSEN

    @property
    def counts(self) -> bool:
        """Whether the cause matters, is significant, and does not predict worse."""
        worse = self.proof.p_value > 1 - level_of(self.fit)
        return self.relevant and self.p_adjusted < SIGNIFICANT and not worse


@dataclass(frozen=True)
class Step:
    """One round of the search.

    Parameters
    ----------
    before : Fit
    scores : tuple of Score
        All causes, the most promising first.
    candidates : tuple of Candidate
        Those refitted, the likeliest first.
    taken : Candidate or None
    """

    before: Fit
    scores: tuple[Score, ...]
    candidates: tuple[Candidate, ...]
    taken: Candidate | None


@dataclass(frozen=True)
class Search:
    """The steps of a search and its result.

    Parameters
    ----------
    base, final : Fit
    steps : tuple of Step
    causes : tuple of Candidate
        In the order found, without those that later ones made needless.
    tried : int
        Hypotheses that were scored.
    given : Fit or None
        The model as it was given, no coefficient of it estimated; None where there was none.
    leaning : tuple of Candidate
        Causes that help, and do no more than a generic force would: no part of `final`.
    chosen : Fit or None
        Of the terms that the data chose, where the search went on from them.
    nearest : Fit or None
        The model without causes whose free runs follow the logs most nearly, where that is
        another one than `base`: its colour may take a slow misfit for the sea's own.
    """

    base: Fit
    final: Fit
    steps: tuple[Step, ...]
    causes: tuple[Candidate, ...]
    tried: int
    given: Fit | None = None
    leaning: tuple[Candidate, ...] = ()
    chosen: Fit | None = None
    nearest: Fit | None = None

    @property
    def before(self) -> Fit:
        """What is diagnosed: the model as it was given, or else the fit without causes."""
        return self.given or self.without

    @property
    def without(self) -> Fit:
        """What a gain is measured against: no cause, runs as near to the logs as they can be."""
        return self.nearest or self.base

    def proof(self, held_out: Callable[[Integrator], HeldOut]) -> float:
        """Return the fall of −2 log L of held-out logs by all causes, each fit as it is run."""
        one, two = (held_out(f.integrator).contributions(f) for f in (self.base, self.final))
        with np.errstate(invalid="ignore"):
            return proof_of(one - two).gain


def freed(before: Fit, after: Fit, hypothesis: Hypothesis) -> int:
    """Return how many numbers a cause frees, those that come beside it counted; at least one.

    A fit from first coefficients of its own is of the same structure.
    """
    numbers = [len(f.point.places) + sum(map(len, f.point.values)) for f in (before, after)]
    return max(numbers[1] - numbers[0], len(hypothesis.parameters), 1)


def search(
    case: DiagnosisProblem,
    base: Fit,
    hypotheses: Sequence[Hypothesis],
    *,
    begun: Sequence[Candidate] = (),
    most: int = MOST_CAUSES,
    alone: bool = True,
    progress: Callable[[str], None] = lambda _: None,
    unexplained: Callable[[Fit], None] = lambda _: None,
) -> Search:
    """Look for causes until held-out logs confirm no further one.

    One that is not alone, after which the terms that the data choose may go on, looks for what
    past commands do only, once forces of motion and commands are left that neither a cause takes
    nor two of them.

    Parameters
    ----------
    case : DiagnosisProblem
    base : Fit
        Of the model without any cause, its noise settled.
    hypotheses : sequence of Hypothesis
    begun : sequence of Candidate
        Causes that are in force from the beginning.
    most : int
        Causes at most beside those.
    alone : bool
        Whether no other search may follow.
    progress : callable
        Told what is being done.
    unexplained : callable
        Told a fit that leaves forces of motion and commands, where another search may follow.
    """
    steps: list[Step] = []
    fit = base
    causes: list[Candidate] = list(begun)
    most += len(causes)
    known: set[frozenset[str]] = set()
    # those that are left out on the way were tried, too
    tried = len(hypotheses)
    while len(causes) < most and frozenset(c.hypothesis.key for c in causes) not in known:
        # causes that take each other's place would go round for ever
        known.add(frozenset(c.hypothesis.key for c in causes))
        step = take_step(case, fit, causes, hypotheses, tried - len(hypotheses))
        steps.append(step)
        _told(steps, progress)
        if step.taken is None:
            break
        left = not alone and left_to_motion(case.held_out, fit)
        fit, causes = _with(case, causes, step.taken, tried)
        if left and left_to_motion(case.held_out, fit):
            unexplained(fit)
            more = _completed(case, fit, causes, hypotheses) if len(causes) < most else None
            if more is not None:
                second, fit, causes = more
                steps.append(second)
                _told(steps, progress)
                continue
            _log.info("forces of motion and commands are left that one or two causes do not take")
            # those have no past
            hypotheses = [h for h in hypotheses if h.past]
            if not hypotheses:
                break
    return Search(base, fit, tuple(steps), tuple(causes), tried)


def _told(steps: Sequence[Step], progress: Callable[[str], None]) -> None:
    """Say what the last step found."""
    step = steps[-1]
    progress(f"step {len(steps)}: {so_many(len(step.scores), 'cause')} scored")
    _log.info(
        "step %d: %d causes scored, %s", len(steps), len(step.scores),
        "none holds" if step.taken is None else f"{step.taken.hypothesis.cause} holds",
    )  # fmt: skip


def _with(
    case: DiagnosisProblem, causes: Sequence[Candidate], taken: Candidate, tried: int
) -> tuple[Fit, list[Candidate]]:
    """Return the fit with a cause that was taken, and all causes that are in force then."""
    fit, causes = taken.fit, [*causes, taken]
    if case.metric == "coloured":
        # those beside chosen terms are weighed at the end
        fit, causes = _backward(case, fit, causes, tried)
    # what a better noise would gain must not count for the next cause
    return case.problem(fit.integrator).settle(fit, SETTLE), causes


def _completed(
    case: DiagnosisProblem,
    fit: Fit,
    causes: Sequence[Candidate],
    hypotheses: Sequence[Hypothesis],
) -> tuple[Step, Fit, list[Candidate]] | None:
    """Return the step to a second cause that leaves nothing to motion and commands, if one does."""
    tried = len(hypotheses)
    present = [h for h in hypotheses if not h.past]
    second = take_step(
        case, fit, causes, present, tried - len(present),
        enough=lambda found: not left_to_motion(case.held_out, found),
    )  # fmt: skip
    if second.taken is None:
        return None
    fit, found = _with(case, causes, second.taken, tried)
    return None if left_to_motion(case.held_out, fit) else (second, fit, found)


def left_to_motion(held_out: Callable[[Integrator], HeldOut], fit: Fit) -> bool:
    """Whether a force of motion and commands would explain more than a deviation to be told."""
    pairs = held_out(fit.integrator).pairs(fit)
    numbers = sum(int(pair.held.counts.sum()) for pair in pairs)
    left = omnibus(pairs, MOTION_AND_COMMANDS)
    return left.proof.p_value < SURE and left.gain > WORTH * numbers


def take_step(
    case: DiagnosisProblem,
    fit: Fit,
    causes: Sequence[Candidate],
    hypotheses: Sequence[Hypothesis],
    passed_over: int = 0,
    enough: Callable[[Fit], bool] = lambda _: True,
) -> Step:
    """Score what is left, refit the best, and take the likeliest if it holds.

    As many more than those given were tried as were passed over. One whose fit is not enough is
    not taken.
    """
    left = [a for a in hypotheses if not _taken(a, causes)]
    if case.metric == "free run":
        # beside chosen terms the one does all that the other does
        left = [a for a in left if not any(alike_to_forces(a, c.hypothesis) for c in causes)]
    problem, held_out = case.problem(fit.integrator), case.held_out(fit.integrator)
    near = [a for a in left if not a.refit_from_scratch]
    scores, forgetful = promises(problem, fit, near)
    asked = [*((fit, score) for score in shortlist(scores)), *forgetful]
    fits = refits(problem, asked)
    fits += case.from_far(fit, near, {s.hypothesis.key: s.gain for s in scores})
    if not causes:
        fits += case.restart(fit, left, [s.hypothesis for s in scores if s.gain == -np.inf])
    fits = likelier(fits)
    candidates: list[Candidate] = []
    taken: Candidate | None = None
    for some in _likely_first(fits, held_out, fit):
        proofs = proven(held_out, fit, [found for _, found in some])
        candidates += [
            assess_candidate(proof, fit, found, hypothesis, len(left) + passed_over, problem.names)
            for (hypothesis, found), proof in zip(some, proofs, strict=True)
        ]
        candidates = _beside_others(sorted(candidates, key=_bic))
        sure = (_wald_checked(case, c) for c in candidates if c.holds)
        taken = next((c for c in sure if c.holds), None)
        if taken is not None:
            break
    if taken is not None and not enough(taken.fit):
        taken = None
    if taken is not None:
        better = final_refit(case, taken.fit, taken.hypothesis)
        taken = _wald_checked(case, replace(taken, fit=better))
        if not taken.holds:
            taken = None
    return Step(fit, tuple(scores), tuple(candidates), taken)


def _likely_first(
    fits: Sequence[tuple[Hypothesis, Fit]], held_out: HeldOut, before: Fit
) -> list[list[tuple[Hypothesis, Fit]]]:
    """Return fits with one more cause in the parts in which held-out logs are asked of them.

    One that gains much less than the best is only asked where none of the others holds. Of errors
    that are weighed by their size alone the held-out logs may tell something else than those that
    were fitted to, so that all are asked; and where the run without a cause leaves every bound,
    what others do is part of the proof.
    """
    gains = [before.cost - found.cost for _, found in fits]
    bounded = np.isfinite(gains).any() and np.isfinite(held_out.contributions(before)).all()
    if not (before.noise.coloured and bounded):
        return [list(fits)]
    least = _ASKED_FIRST * max(gains)
    first = [one for one, gain in zip(fits, gains, strict=True) if gain >= least]
    rest = [one for one, gain in zip(fits, gains, strict=True) if not gain >= least]
    return [first, rest]


def proven(held_out: HeldOut, before: Fit, fits: Sequence[Fit]) -> list[Proof]:
    """Return what each of several fits gains on held-out logs, on all processors."""
    # once for all of them
    held_out.contributions(before)
    return map_forked(lambda k: held_out.prove(before, fits[k]), range(len(fits)))


def _beside_others(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Return candidates whose proof, where they hold a run within bounds, is that few others do.

    What no sum tells is told by rank: the p-value is the share of the other causes that hold the
    run as well. Delay, lag and rate limit count as one: each does much of what another one does.
    """

    def kind(candidate: Candidate) -> str:
        return "late" if candidate.hypothesis.past else candidate.hypothesis.cause

    every = {kind(c) for c in candidates}
    holding = {kind(c) for c in candidates if c.proof.gain == np.inf}
    share = (len(holding) - 1) / max(len(every) - 1, 1)
    return [
        replace(c, proof=replace(c.proof, p_value=share)) if c.proof.gain == np.inf else c
        for c in candidates
    ]


def _wald_checked(case: DiagnosisProblem, candidate: Candidate) -> Candidate:
    """Return the candidate with p-values that its robust covariance bears out, too (Wald).

    Where errors have another colour than theirs, or come in bursts, the likelihood falls
    by chance for more than χ²; where it fell because the fit without the cause had stopped
    early, the cause's numbers stand at their null. A number with many hills has no null.
    """
    from scipy.special import chdtrc

    hypothesis, fit = candidate.hypothesis, candidate.fit
    problem = case.problem(fit.integrator)
    away, own, _ = problem.effect(fit, hypothesis)
    if not len(away):
        return candidate
    wald = float(away @ np.linalg.pinv(own) @ away) if np.isfinite(own).all() else 0.0
    p = max(candidate.p_value, float(chdtrc(len(away), wald)))
    return replace(candidate, p_value=p, p_adjusted=min(1.0, p * candidate.tried))


def _taken(hypothesis: Hypothesis, causes: Sequence[Candidate]) -> bool:
    """Whether a hypothesis, or another form of it, is in force."""
    return any(
        hypothesis.key == c.hypothesis.key
        or (
            hypothesis.cause == c.hypothesis.cause
            and (
                hypothesis.only
                or c.hypothesis.only
                or set(_names(hypothesis)) & set(_names(c.hypothesis))
            )
        )
        for c in causes
    )


def _names(hypothesis: Hypothesis) -> list[str]:
    return [p.name for p in hypothesis.parameters] or [hypothesis.key]


def _bic(candidate: Candidate) -> tuple[float, float]:
    """Return −2 log L of all logs with the price of each number (Schwarz, 1978).

    What a cause does for held-out logs counts as much as what it was fitted to: there
    a wrong one falls behind. A thruster that pulls where it should push has a price too:
    reversed columns may otherwise be taken for each other.
    """
    samples = sum(len(e) for e in candidate.fit.errors)
    price = candidate.freed + BACKWARDS * len(backwards(candidate.fit, candidate.names))
    gain = candidate.proof.gain
    value = candidate.fit.cost + price * float(np.log(samples))
    # first comes what keeps a held-out run within bounds that left them before
    return (0.0, value - gain) if np.isfinite(gain) else (-np.sign(gain), value)


def backwards(fit: Fit, names: Sequence[str]) -> list[str]:
    """Return coefficients of thrust that are negative, as no thruster makes them."""
    theta = dict(zip(names, fit.point.base.theta, strict=False))
    return [n for n in _THRUST if theta.get(n, 0.0) < 0]


def assess_candidate(
    proof: Proof,
    before: Fit,
    fit: Fit,
    hypothesis: Hypothesis,
    tried: int,
    names: tuple[str, ...] = (),
) -> Candidate:
    """Return a refitted cause with its significance, and what it does for held-out logs."""
    from scipy.special import chdtrc

    gain = before.cost - fit.cost if np.isfinite(fit.cost) else -np.inf
    numbers = freed(before, fit, hypothesis)
    p = float(chdtrc(numbers, max(gain, 0.0)))
    # the best of many moments is likelier than any one
    tried *= MOMENTS if any(parameter.reach > 0 for parameter in hypothesis.parameters) else 1
    return Candidate(hypothesis, fit, gain, p, min(1.0, p * tried), proof, names, tried, numbers)


def _backward(
    case: DiagnosisProblem, fit: Fit, causes: list[Candidate], tried: int
) -> tuple[Fit, list[Candidate]]:
    """Drop causes that a later one made needless; those kept are told against that."""
    kept = list(causes)
    waiting = list(causes[:-1])
    while waiting:
        dropped = None
        for cause, (without, proof) in zip(waiting, _left_out(case, fit, waiting), strict=True):
            alone = assess_candidate(proof, without, fit, cause.hypothesis, tried, cause.names)
            place = [c.hypothesis.key for c in kept].index(cause.hypothesis.key)
            if not alone.holds:
                _log.info("%s is left out", cause.hypothesis.key)
                del kept[place]
                dropped = without
                break
            kept[place] = alone
        if dropped is None:
            break
        # the rest is told against the fit that is left
        fit, waiting = dropped, waiting[waiting.index(cause) + 1 :]
    return fit, kept


def _left_out(
    case: DiagnosisProblem, fit: Fit, causes: Sequence[Candidate]
) -> list[tuple[Fit, Proof]]:
    """Return the fit without each of several causes, and what that cause does for held-out logs."""
    problem, held_out = case.problem(fit.integrator), case.held_out(fit.integrator)
    # once for all of them
    problem.rows(fit.point, fit.noise)
    held_out.contributions(fit)

    def work(k: int) -> tuple[Fit, Proof]:
        without = _without(problem, fit, causes[k])
        return without, held_out.prove(without, fit)

    return on_all_processors([problem.drop(fit.point, c.hypothesis) for c in causes], work)


def _needed(case: DiagnosisProblem, fit: Fit, without: Fit) -> bool:
    """Whether a model that the data chose predicts worse without what has no name in it.

    By more of the squared error than is told of a deviation.
    """
    if case.metric != "free run":
        return False
    return without.escaped or worse(case.held_out, without, fit) > np.log1p(WORTH)


def _of_the_ship(case: DiagnosisProblem, fit: Fit, cause: Candidate) -> bool:
    """Whether a cause is what the ship does: sensors and changes have a name, or are none."""
    ship = fit.point.ship
    rest = case.problem(fit.integrator).drop(fit.point, cause.hypothesis).ship
    return ship.sensors == rest.sensors and ship.changes == rest.changes


def weighed(case: DiagnosisProblem, found: Search) -> Search:
    """Return the search without causes that do not stand beside a generic force.

    The least of them goes first: what it imitated may be another's once it is gone. Those that
    stood are asked again once none of the others falls. Terms without which held-out runs are
    worse than those of all stay in the model, and lose their name.
    """
    fit, leaning = found.final, []
    waiting = list(found.causes)
    stood: list[tuple[Candidate, Fit]] = []
    while True:
        fallen = [(cause, without) for cause, without in stood if not _stands(cause)]
        if not fallen:
            if not waiting:
                break
            stood += _stood(case, fit, waiting, found)
            waiting = []
            continue
        least, without = min(fallen, key=lambda item: _worth(item[0]))
        leaning.append(least)
        stood = [item for item in stood if item[0] is not least]
        if _of_the_ship(case, found.final, least) and _needed(case, found.final, without):
            continue
        if without.escaped:
            # what does not stand holds the run within bounds: nothing of it can be told
            kept = _as_found(found, [*waiting, *(cause for cause, _ in stood)])
            return replace(found, final=found.base, causes=(), leaning=(*leaning, *kept))
        fit = case.problem(fit.integrator).settle(without, SETTLE)
        waiting += [cause for cause, _ in stood if _stands(cause)]
        others = [cause for cause, _ in stood if not _stands(cause)]
        stood = _stood(case, fit, others, found)
    return replace(
        found,
        final=fit,
        causes=tuple(_as_found(found, [cause for cause, _ in stood])),
        leaning=tuple(leaning),
    )


def _as_found(found: Search, causes: Sequence[Candidate]) -> list[Candidate]:
    """Return causes in the order in which they were found."""
    order = [c.hypothesis.key for c in found.causes]
    return sorted(causes, key=lambda c: order.index(c.hypothesis.key))


def _stood(
    case: DiagnosisProblem, fit: Fit, causes: Sequence[Candidate], found: Search
) -> list[tuple[Candidate, Fit]]:
    """Return causes with what each does beside a generic force, and the fits without them.

    Those whose numbers are told already stand, and come with the fit as it is. Where the fit
    without a cause leaves every bound and that without any cause does not, a better one exists
    and was not found: what the cause does cannot be weighed.
    """
    problem, held_out = case.problem(fit.integrator), case.held_out(fit.integrator)
    pairs = held_out.pairs(fit)
    asked = [c for c in causes if c.told is None]
    if asked and not any(p.held_fit.escaped or p.fit.escaped for p in pairs):
        # once for all of them
        for pair in pairs:
            contributions_beside(pair)
        problem.covariance(fit)

    def work(k: int) -> tuple[Fit, tuple[Standing | None, Proof]]:
        without = _without(problem, fit, asked[k])
        hypothesis, weight = asked[k].hypothesis, None
        if found.base.escaped or not without.escaped:
            weight = standing(problem, hypothesis, fit, without, held_out, found.tried)
        return without, (weight, held_out.prove(without, fit))

    rest = [problem.drop(fit.point, c.hypothesis) for c in asked]
    weighed_now = iter(on_all_processors(rest, work))
    out = []
    for cause in causes:
        if cause.told is not None:
            out.append((cause, fit))
            continue
        without, (weight, proof) = next(weighed_now)
        alone = assess_candidate(proof, without, fit, cause.hypothesis, found.tried, cause.names)
        alone = _wald_checked(case, replace(alone, standing=weight))
        out.append((alone, without))
    return out


def _stands(cause: Candidate) -> bool:
    if cause.told is not None:
        return True
    # what it does for held-out logs is weighed beside a generic force, where misfit hides less
    helps = cause.counts and cause.proof.gain > 0
    return cause.standing is not None and cause.standing.stands and helps


def _worth(cause: Candidate) -> float:
    """Return what a cause does for held-out logs; with a generic force it is told less surely."""
    return -np.inf if cause.standing is None else cause.proof.gain


def _without(problem: Problem, fit: Fit, cause: Candidate) -> Fit:
    """Return the fit without a cause, from where the others make up for it to first order."""
    begun = []
    for vector in (_at_null(problem, fit, cause.hypothesis), fit.point.vector()):
        point = problem.drop(fit.point.at(vector), cause.hypothesis)
        cost = problem.whitened(fit.noise, problem.errors(point))[1]
        begun.append((cost, point))
    point = min(begun, key=lambda item: item[0])[1]
    found = problem.fit(point, fit.noise, most=FIRST)
    return problem.settle(found, 2, None if found.converged else fit.cost)


def _at_null(problem: Problem, fit: Fit, hypothesis: Hypothesis) -> Array:
    """Return the free numbers where those of a cause are at their null values."""
    vector = fit.point.vector()
    where = np.array(problem.numbers_of(fit.point, hypothesis), int)
    null = np.zeros(len(where))
    for k, parameter in enumerate(hypothesis.parameters[: len(where)]):
        null[k] = vector[where[k]] if parameter.reach else parameter.null
    rows = stacked(problem.rows(fit.point, fit.noise))
    rest = np.setdiff1d(np.arange(len(vector)), where)
    change = null - vector[where]
    if np.isfinite(rows).all() and len(where):
        normal, across = rows[:, rest].T @ rows[:, rest], rows[:, rest].T @ rows[:, where]
        low, high = (b[rest] - vector[rest] for b in problem.bounds(fit.point))
        vector[rest] += bounded_step(normal, -across @ change, low, high, 0.0)
    vector[where] = null
    return vector


def instead(
    case: DiagnosisProblem, fit: Fit, best: Candidate, others: Sequence[Candidate]
) -> tuple[Fit, Candidate, list[Candidate]]:
    """Return the fit without one of several causes, that cause, and others in its place.

    All stand beside the remaining causes.
    """
    problem, held_out = case.problem(fit.integrator), case.held_out(fit.integrator)
    rest = problem.drop(fit.point, best.hypothesis)
    without = problem.settle(problem.fit(rest, fit.noise, most=FIRST), 1)
    asked = []
    for other in others[:_INSTEAD]:
        k = [a.key for a in other.fit.point.hypotheses].index(other.hypothesis.key)
        value = other.fit.point.values[k]
        asked.append((without, Score(other.hypothesis, value, other.gain)))
    fits = refits(problem, asked)
    proofs = proven(held_out, without, [found for _, found in fits])
    out = [
        assess_candidate(proof, without, found, hypothesis, 1)
        for (hypothesis, found), proof in zip(fits, proofs, strict=True)
    ]
    proof = held_out.prove(without, fit)
    return without, assess_candidate(proof, without, fit, best.hypothesis, 1), out
