"""Which terms, and how many: paths of the free run on all logs and on parts, judged by the rest.

From each of several sets, a path of sets is followed on all logs, and again without each part
of them; every set of a part's path is run freely on what it left out. Which beginning and how
many terms are worth having is what these runs say, and that set on the path of all logs is taken.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.errors import ExcitationError, GreyboxError, OutOfTimeError, UsageError, so_many
from greybox.estimation.informative import ADVISED_HEADING, heading_range
from greybox.model.catalogue import structure_for
from greybox.model.predictor_kinds import PREDICTORS
from greybox.model.run.step import Integrator
from greybox.model.structure import Structure
from greybox.numerics.effort import Shares, seconds_left, within
from greybox.numerics.parallel import Piece, Result, lanes, map_forked
from greybox.selection.cross_validation import Refit, parts_of
from greybox.selection.family import family_for, first_terms, spell_structure
from greybox.selection.free_run_selection import FreeRunSelection, Selected
from greybox.selection.held_out import extent, folds, rank, spread_of
from greybox.trial.log import TrialLog
from greybox.validation.fit import run_model
from greybox.validation.held_commands import held_bounds, held_commands, known_bounds
from greybox.vessel.force import force_inputs
from greybox.vessel.thrust import ThrustLaw, typical_speed
from greybox.vessel.vessel import Between

Array = NDArray[np.float64]
_log = logging.getLogger(__name__)

# terms at most, and those with which thrust laws are compared
_MOST, FEW = 40, 18
# times the squared error of the better path at which a path has ended in a local minimum
_LOST = 2.0
# samples that a coefficient needs
_SAMPLES = 20
# share by which the error may be larger with the thrust that propeller theory gives, ~ n|n|
_NEAR = 0.1
# share of the error by which a smaller model may be worse [%]
_GIVEN_AWAY = 1.0
# error of a run in deviations that is not told from an escape, and from none
_WORST, _LEAST = 10.0, 1e-6
# logs from which on whole ones judge alone, and one beginning does
_ENOUGH = 4
# share of the time that is left that the runs of the present model may take
_FOR_PRESENT = 0.5
# the speed of a propeller that varies by less than this share tells no law from another
_VARIES = 0.05


@dataclass(frozen=True)
class Terms:
    """A set of terms where its selection ended.

    Parameters
    ----------
    structure : Structure
    kind : str
        Predictor.
    start : ndarray
        (p,) parameters in the order of the structure.
    integrator : {"euler", "rk4"}
    """

    structure: Structure
    kind: str
    start: Array
    integrator: Integrator = "euler"

    @classmethod
    def of(cls, found: Selected, selection: FreeRunSelection, inputs: tuple[str, ...]) -> Terms:
        """Read them off a path."""
        model = selection.model
        names = tuple(n for n in found.terms if n not in model.means)
        structure = structure_for(spell_structure(names, inputs), inputs)
        values = dict(zip(selection.names, found.p, strict=True))
        kind = PREDICTORS[model.predictor.kind]
        if len(names) == len(found.terms):
            kind, structure = PREDICTORS[kind.plain], structure.estimable()
        return cls(structure, kind.name, np.array([values[n] for n in structure.parameters]))


@dataclass(frozen=True)
class Step:
    """The integrator of a model, and how logged commands run between samples."""

    integrator: Integrator = "euler"
    commands: Between = "held"


@dataclass(frozen=True)
class TermChoice:
    """The set of terms that held-out free runs choose, and whether it is to be taken.

    Parameters
    ----------
    terms : Terms
    again : callable
        Returns those of the same number, from the same beginning, that other logs choose, as
        parts of these; None where they choose none.
    logs : tuple of TrialLog
        With the thrust law that was chosen.
    taken : bool
        Whether it is better than the model that it was compared with.
    rows : tuple of dict
        What was tried: the model in words, its coefficients, held-out score, how far behind,
        the standard error of this, whether it was chosen.
    laws : tuple of (ThrustLaw, float)
        Thrust laws that were compared, each with the mean squared error of the free runs on all
        logs in squared deviations; not finite where time was over.
    steps : tuple of (Step, float, float, float)
        Ways over a sample that were compared for these terms: held-out score, how far behind and
        its standard error, not finite where time was over.
    note : str
        The choice in words.
    """

    terms: Terms
    again: Callable[[Sequence[TrialLog]], Terms | None]
    logs: tuple[TrialLog, ...]
    taken: bool
    rows: tuple[dict[str, Any], ...]
    laws: tuple[tuple[ThrustLaw, float], ...]
    steps: tuple[tuple[Step, float, float, float], ...]
    note: str


def select_terms(
    logs: Sequence[TrialLog],
    present: str,
    size: int,
    refit: Refit,
    *,
    stepped: bool = True,
) -> TermChoice:
    """Choose terms by free runs on parts that were left out, and compare with a present model.

    Parameters
    ----------
    logs : sequence of TrialLog
        Of one vessel and sample time.
    present : str
        The model that stands unless terms do better, in words.
    size : int
        Its coefficients.
    refit : Refit
        Estimates it on other logs.
    stepped : bool
        Whether ways over a sample are compared for the terms, too.

    Raises
    ------
    UsageError
        A single log is too short for parts.
    ExcitationError
        No free run of any set follows the logs.
    OutOfTimeError
        Time was over before every part had a set.
    """
    inputs, wind = force_inputs(logs[0].vessel), all(log.has_wind for log in logs)
    kind = "wind" if wind else "augmented"
    if heading_range(logs) < ADVISED_HEADING:
        # a current on one heading is a constant force
        kind = PREDICTORS[kind].plain
    family = family_for(inputs, wind, PREDICTORS[kind].captures)
    beginnings, stay = first_terms(inputs)
    if len(logs) >= _ENOUGH:
        # many manoeuvres show Coriolis terms too, which few must be told of
        beginnings = beginnings[:1]
    most = min(_MOST, sum(len(log) for log in logs) // _SAMPLES)
    spread = np.array(list(spread_of(logs, family.states).values()))

    laws = _laws(logs)
    parts = _judging_parts(logs)
    # the present model keeps the thrust law that it was estimated with
    with within(_FOR_PRESENT * seconds_left()):
        Refit.ahead([refit], [fitting for fitting, _ in parts])
        present_score = [_present_score(refit, *part, spread) for part in parts]
    few_tasks = [(of, b) for of in laws for b in range(len(beginnings)) if len(laws) > 1]
    turns = -(-len(few_tasks) // lanes())
    watch = _Watch(turns + -(-len(beginnings) * (1 + len(parts)) // lanes()))

    def path_of(task: tuple[Sequence[TrialLog], str, int]) -> list[Selected]:
        """Return a path, empty where none follows the logs."""
        of, what, begun = task
        passed: list[Selected] = []
        chosen_on = selection
        if of is not logs:
            chosen_on = FreeRunSelection(of, family, kind)
        else:
            passed = few.get((law, begun), [])
        try:
            with watch.next(what):
                return chosen_on.path(beginnings[begun], stay, most, passed=passed)
        except OutOfTimeError:
            # what was not tried must not count as bad
            raise
        except GreyboxError as error:
            _log.info("no path from %d terms: %s", len(beginnings[begun]), error)
            return []

    def few_terms(task: tuple[ThrustLaw, int]) -> list[Selected]:
        """Return the path to few terms with a thrust law, empty where there is none in time."""
        of, begun = task
        selection = FreeRunSelection(with_law(logs, of), family, kind)
        try:
            with watch.next(f"thrust ~ {law_in_words(of)}"):
                return selection.path(beginnings[begun], stay, min(FEW, most))
        except GreyboxError:
            return []

    few = dict(zip(few_tasks, watch.over(few_terms, few_tasks), strict=True)) if few_tasks else {}
    law, errors = laws[0], [np.nan]
    if few:
        # a path may end where no term helps: the better beginning counts
        ends = np.array([sets[-1].cost if sets else np.inf for sets in few.values()])
        errors = ends.reshape(len(laws), -1).min(axis=1).tolist()
        best_law = int(np.argmin(errors))
        law = laws[-1] if errors[-1] < (1 + _NEAR) * errors[best_law] else laws[best_law]
    logs = with_law(logs, law)
    thrust = law_in_words(law)
    selection = FreeRunSelection(logs, family, kind)
    of_parts = [(logs, "all logs")]
    of_parts += [(part[0], f"all but part {k}") for k, part in enumerate(_judging_parts(logs), 1)]
    tasks = [(*part, begun) for part in of_parts for begun in range(len(beginnings))]
    found_on = iter(watch.over(path_of, tasks))
    whole, *paths = [[next(found_on) for _ in beginnings] for _ in of_parts]
    if not any(whole):
        raise ExcitationError(
            f"no free run of selected terms stays bounded on the {so_many(len(logs), 'log')}: "
            f"use longer "
            f"logs, or name a structure with --structure."
        )
    # runs on parts do not show that the path on all logs ended in a local minimum
    alternatives = [
        (b, n)
        for b, sets in enumerate(whole)
        for n in {len(s.terms) for s in sets}
        if _error(sets, n) <= _LOST * min(_error(others, n) for others in whole)
    ]
    alternatives = _moving(selection, whole, alternatives, spread)
    scores: list[list[float]] = [[] for _ in alternatives]
    for path, (_, held) in zip(paths, _judging_parts(logs), strict=True):
        judged = FreeRunSelection(held, family, kind)
        for (begun, size_of_set), score in zip(alternatives, scores, strict=True):
            small = _of_size(path[begun], size_of_set)
            score.append(_score(judged.errors(small.p) if small else [], spread))
    # parts of logs count as much as whole logs
    by_logs = len(parts_of(logs))
    weight = np.ones(len(parts))
    weight[by_logs:] = by_logs / max(len(parts) - by_logs, 1)
    judged_by = [np.array(s) * weight / weight.mean() for s in (present_score, *scores)]
    preferred = [0, *(n for _, n in alternatives)]
    ranking = rank(judged_by, preferred, given_away=_GIVEN_AWAY)
    sets = [_of_size(whole[b], n) for b, n in alternatives]
    chosen, left_out = _staying(ranking.chosen, judged_by, preferred, sets, (logs, family, kind))
    shown = chosen or int(np.argmax(ranking.score[1:])) + 1
    begun, size_shown = alternatives[shown - 1]
    best = sets[shown - 1]
    assert best is not None
    shorter = [_of_size(path[begun], size_shown) for path in paths]
    named = {name for found in shorter if found for name in found.terms}
    reduced = replace(family, terms=tuple(t for t in family.terms if t.name in named))

    def score_step(step: Step) -> Array:
        """Return the weighted scores of these terms, fitted again on each part's other logs."""
        score = []
        for found, part in zip(shorter, _judging_parts(logs), strict=True):
            fitting, held = (
                FreeRunSelection(with_commands(of, step.commands), reduced, kind, step.integrator)
                for of in part
            )
            errors: list[Array] = []
            if found is not None:
                place = [selection.names.index(name) for name in fitting.names]
                errors = held.errors(fitting.fitted(replace(found, p=found.p[place])).p)
            score.append(_score(errors, spread))
        return np.asarray(np.array(score) * weight / weight.mean())

    own, *rest = _steps(logs)
    steps = _compare_steps([own, *rest], score_step) if chosen and stepped else []
    error = 100 - max((score for _, score, _, _ in steps), default=0.0)
    near = _GIVEN_AWAY / 100 * error
    step = next((s for s, _, behind, se in steps if behind <= max(se, near)), own)
    logs = with_commands(logs, step.commands)
    fit = 100 * (1 - np.exp(-ranking.score / 100))
    means = selection.model.means
    # a mean current or wind is no term
    counts = [size, *(sum(n not in means for n in s.terms) for s in sets if s)]
    rows = [
        {
            "model": f"{n} terms" if i else present,
            "coefficients": n,
            "score": float(fit[i]),
            "behind": float(fit.max() - fit[i]),
            # of the logarithm of the error, as points of fit
            "se": float((1 - fit[i] / 100) * ranking.se[i]),
            "chosen": i == chosen,
        }
        for i, n in enumerate(counts)
    ]
    said = (
        f"terms were selected by free runs on parts of the logs that were left out in turn: "
        f"{counts[shown]} terms (thrust ~ {thrust}) have a fit of {fit[shown]:.1f} % and {present} "
        f"{fit[0]:.1f} % (of the geometric mean error over channels and parts, in deviations of "
        f"the logs); "
        + (
            f"the smallest set whose error is larger than the least by no more than one standard "
            f"error and {_GIVEN_AWAY:g} % was chosen."
            if chosen
            else f"{present} stays."
        )
    )
    if left_out:
        said += (
            f" {so_many(left_out, 'set')} preferred to it ran away with commands "
            f"of the logs held constant."
        )
    if step != own:
        said += (
            f" Steps by {step.integrator} with commands {step.commands} between samples predict "
            f"better by more than one standard error and {_GIVEN_AWAY:g} % of the error, and were "
            f"taken."
        )
    if watch.cut:
        said += f" Time ran out (--effort) before larger sets were tried on {', '.join(watch.cut)}."
    known = {
        extent(fitting): found
        for (fitting, _), found in zip(_judging_parts(logs), shorter, strict=True)
    }

    def again(of: Sequence[TrialLog]) -> Terms | None:
        """Follow the path anew on logs that were no part."""
        found = known.get(extent(of))
        if extent(of) not in known:
            # terms were chosen before the step was
            other = FreeRunSelection(of, family, kind)
            try:
                found = _of_size(other.path(beginnings[begun], stay, size_shown), size_shown)
            except ExcitationError as error:
                _log.info("no path on a part: %s", error)
        return None if found is None else terms(found)

    def terms(found: Selected) -> Terms:
        return replace(Terms.of(found, selection, inputs), integrator=step.integrator)

    return TermChoice(
        terms(best),
        again,
        tuple(logs),
        chosen > 0,
        tuple(rows),
        tuple(zip(laws, errors, strict=True)),
        tuple(steps),
        said,
    )


def _judging_parts(
    logs: Sequence[TrialLog],
) -> list[tuple[list[TrialLog], list[TrialLog]]]:
    """Return (to select on, held out): those of `parts_of`, and of few logs also parts of each.

    What is left of two or three logs without one of them may hold no second manoeuvre.
    """
    parts = parts_of(logs)
    if 1 < len(logs) < _ENOUGH:
        try:
            parts += folds(logs, _ENOUGH)
        except UsageError as error:
            _log.info("logs are not parted: %s", error)
    return parts


class _Watch:
    """Shares of the time for paths, and the names of those that it cut.

    Parameters
    ----------
    stages : int
        Paths that are followed one after another.
    """

    def __init__(self, stages: int) -> None:
        self._shares = Shares(stages)
        self.cut: dict[str, None] = {}

    def over(self, function: Callable[[Piece], Result], pieces: Sequence[Piece]) -> list[Result]:
        """Apply a function that follows paths to pieces, on all processors."""
        found = map_forked(lambda piece: (function(piece), dict(self.cut)), pieces)
        for _, cut in found:
            self.cut |= cut
        return [result for result, _ in found]

    @contextmanager
    def next(self, what: str) -> Iterator[None]:
        with self._shares.next():
            try:
                yield
            finally:
                if seconds_left() <= 0:
                    self.cut[what] = None


def _score(errors: Sequence[Array], spread: Array) -> float:
    """Return −100 times the mean log error over the channels, in deviations; cut at `_WORST`."""
    moving = spread > 0
    ratio = np.full(moving.sum(), _WORST)
    if len(errors) and all(np.isfinite(e).all() for e in errors):
        with np.errstate(over="ignore"):
            ratio = np.sqrt(np.mean(np.concatenate(errors)[:, moving] ** 2, axis=0))
        ratio = np.clip(ratio / spread[moving], _LEAST, _WORST)
    return float(-100 * np.log(ratio).mean())


def law_in_words(law: ThrustLaw) -> str:
    """Return how the force goes with the speed n."""
    if law.kind == "linear":
        return "n and n|n|" if 0 < law.quadratic_share < 1 else "n"
    return "n|n|" if law.kind == "quadratic" else "a bollard table"


def _of_size(sets: Sequence[Selected], size: int) -> Selected | None:
    """Return the set of best fit with at most so many terms, None where there is none."""
    small = [s for s in sets if len(s.terms) <= size]
    return min(small, key=lambda s: s.cost, default=None)


def _moving(
    selection: FreeRunSelection,
    whole: Sequence[Sequence[Selected]],
    alternatives: Sequence[tuple[int, int]],
    spread: Array,
) -> list[tuple[int, int]]:
    """Return those (beginning, size) that move in every channel in which another one does.

    One that follows its own logs no better than a constant does somewhere, where another set
    follows them, may still have the best mean over the channels of short parts.
    """
    moves = spread > 0
    sets = [found for b, n in alternatives if (found := _of_size(whole[b], n))]
    errors = [np.concatenate(selection.errors(found.p))[:, moves] for found in sets]
    ratio = np.mean(np.square(errors), axis=1) / spread[moves] ** 2
    rests = (ratio >= 1) & (ratio > _LOST * ratio.min(axis=0))
    return [a for a, still in zip(alternatives, rests.any(axis=1), strict=True) if not still]


def _staying(
    chosen: int,
    scores: Sequence[Array],
    preferred: Sequence[int],
    sets: Sequence[Selected | None],
    family: tuple[Sequence[TrialLog], Structure, str],
) -> tuple[int, int]:
    """Return the choice among sets whose runs stay bounded with commands of the logs held.

    Beside it how many that were preferred do not. Terms may follow all parts of a log and drive
    the ship where it never stayed. The first choice stands where none stays that is better than
    the present model; of those that stay one is preferred that stays near motions of the logs.

    Parameters
    ----------
    chosen : int
        The first choice, counted from the present model.
    scores, preferred
        Of the present model and of each set, see `rank`.
    sets : sequence of Selected or None
    family : tuple
        The logs, the structure and the predictor that the sets are of.
    """
    logs, structure, kind = family
    held = held_commands(logs)
    if not chosen or not held:
        return chosen, 0
    runs = FreeRunSelection(held, structure, kind)
    left: list[Array | None] = [*scores]
    now, taken, passed = chosen, chosen, 0
    for bounds in (held_bounds(logs, structure.states), known_bounds(logs, structure.states)):
        while now and (found := sets[now - 1]) is not None and runs.escapes(found.p, bounds):
            left[now] = None
            now = rank(left, preferred, given_away=_GIVEN_AWAY).chosen
        if not now:
            break
        taken, passed = now, sum(s is None for s in left)
    return taken, passed


def _error(sets: Sequence[Selected], size: int) -> float:
    """Return the squared error of the set of best fit with at most so many terms."""
    found = _of_size(sets, size)
    return found.cost if found else np.inf


def _present_score(
    refit: Refit,
    fitting: Sequence[TrialLog],
    held: Sequence[TrialLog],
    spread: Array,
) -> float:
    try:
        model = refit(fitting)
    except OutOfTimeError:
        raise
    except GreyboxError as error:
        _log.info("the present model on a part: %s", error)
        return _score([], spread)
    runs = [run_model(model, log) for log in held]
    return _score([] if any(r.diverged >= 0 for r in runs) else [r.errors() for r in runs], spread)


def _laws(logs: Sequence[TrialLog]) -> list[ThrustLaw]:
    """Return the thrust laws to compare, the vessel's own first and force ~ n|n| last.

    A bollard table or a law other than force ~ n was somebody's decision; and a speed that
    hardly varies cannot tell one from another.
    """
    vessel = logs[0].vessel
    own = vessel.thrusters[0].thrust
    if any(t.thrust != ThrustLaw() for t in vessel.thrusters):
        return [own]
    speeds = [np.concatenate([log[t.speed] for log in logs]) for t in vessel.thrusters]
    usual = [typical_speed([n]) for n in speeds]
    if not any(np.std(np.abs(n)) > _VARIES * u for n, u in zip(speeds, usual, strict=True)):
        return [own]
    reference = float(np.max(usual))
    return [own, ThrustLaw(quadratic_share=0.5, reference=reference), ThrustLaw("quadratic")]


def _steps(logs: Sequence[TrialLog]) -> list[Step]:
    """Return the ways over a sample to compare, the usual one first.

    Measured angles and speeds moved between their samples, orders did not.
    """
    vessel = logs[0].vessel
    measured = all(t.drive == "feedback" for t in vessel.thrusters)
    own = vessel.actuation.between
    other: Between = "held" if own == "interpolated" else "interpolated"
    found = [Step(commands=own), *([Step(commands=other)] if measured else ())]
    return [*found, *(replace(s, integrator="rk4") for s in found)]


def _compare_steps(
    steps: Sequence[Step], score: Callable[[Step], Array]
) -> list[tuple[Step, float, float, float]]:
    """Return ways over a sample with their scores, how far behind they are and its error."""

    def in_time(step: Step) -> Array | None:
        try:
            return score(step)
        except OutOfTimeError:
            return None

    scores = map_forked(in_time, steps)
    if scores[0] is None:
        return []
    found = rank(scores, range(len(steps)))
    fit = 100 * (1 - np.exp(-found.score / 100))
    points = 1 - fit[found.best] / 100
    return [
        (s, float(f), float(points * b), float(points * e))
        for s, f, b, e in zip(steps, fit, found.behind, found.se, strict=True)
    ]


def with_commands(logs: Sequence[TrialLog], between: Between) -> Sequence[TrialLog]:
    """Return logs of the vessel with commands that are held or interpolated between samples."""
    vessel = logs[0].vessel
    if between == vessel.actuation.between:
        return logs
    changed = replace(vessel, actuation=replace(vessel.actuation, between=between))
    return [replace(log, vessel=changed) for log in logs]


def with_law(logs: Sequence[TrialLog], law: ThrustLaw) -> Sequence[TrialLog]:
    """Return logs of the vessel with a thrust law, as they are where it has it already."""
    vessel = logs[0].vessel
    if law == vessel.thrusters[0].thrust:
        return logs
    changed = replace(vessel, thrusters=tuple(replace(t, thrust=law) for t in vessel.thrusters))
    return [replace(log, vessel=changed) for log in logs]
