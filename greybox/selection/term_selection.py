"""Which terms, and how many: paths of the free run on all logs and on parts, judged by the rest.

The path of sets is followed on all logs, and again without each part of them; every set of
a part's path is run freely on what it left out. How many terms are worth having is what
these runs say, and the set of that size on the path of all logs is taken.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.errors import GreyboxError
from greybox.model.catalogue import structure_for
from greybox.model.model import ManoeuvringModel
from greybox.model.predictor_kinds import PREDICTORS
from greybox.model.structure import Structure
from greybox.numerics.effort import OutOfTimeError, Shares, seconds_left, within
from greybox.selection.cross_validation import parts_of
from greybox.selection.family import family_for, first_terms, spell_structure
from greybox.selection.free_run_selection import FreeRunSelection, Selected
from greybox.selection.held_out import rank, score_errors, spread_of
from greybox.trial.log import TrialLog
from greybox.validation.fit import run_model
from greybox.vessel.force import force_inputs
from greybox.vessel.thrust import ThrustLaw

Array = NDArray[np.float64]
_log = logging.getLogger(__name__)

# terms at most, and those with which thrust laws are compared
_MOST, FEW = 40, 18
# samples that a coefficient needs
_SAMPLES = 20
# share by which the error may be larger with the thrust that propeller theory gives, ~ n|n|
_NEAR = 0.1
# points of fit that a smaller model may give away
_GIVEN_AWAY = 0.5
# scores that a standard error needs
_SCORES = 8
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
    """

    structure: Structure
    kind: str
    start: Array

    @classmethod
    def of(cls, found: Selected, selection: FreeRunSelection, inputs: tuple[str, ...]) -> Terms:
        """Read them off a path."""
        model = selection.model
        names = tuple(n for n in found.terms if n not in model.means)
        structure = structure_for(spell_structure(names, inputs), inputs)
        values = dict(zip(selection.names, found.p, strict=True))
        kind = PREDICTORS[model.predictor.kind]
        if len(names) == len(found.terms):
            kind = PREDICTORS[kind.plain]
        return cls(structure, kind.name, np.array([values[n] for n in structure.parameters]))


@dataclass(frozen=True)
class TermChoice:
    """The set of terms that held-out free runs choose, and whether it is to be taken.

    Parameters
    ----------
    terms : Terms
    parts : tuple of Terms or None
        Those of the same number that each part's other logs choose, in the order of `parts_of`;
        None where they choose none.
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
    note : str
        The choice in words.
    """

    terms: Terms
    parts: tuple[Terms | None, ...]
    logs: tuple[TrialLog, ...]
    taken: bool
    rows: tuple[dict[str, Any], ...]
    laws: tuple[tuple[ThrustLaw, float], ...]
    note: str


def select_terms(
    logs: Sequence[TrialLog],
    present: str,
    size: int,
    refit: Callable[[Sequence[TrialLog]], ManoeuvringModel],
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
    refit : callable
        Estimates it on other logs.

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
    family = family_for(inputs, wind)
    kind = "wind" if wind else "augmented"
    first, stay = first_terms(inputs)
    most = min(_MOST, sum(len(log) for log in logs) // _SAMPLES)
    spread = np.array(list(spread_of(logs, family.states).values()))

    laws = _laws(logs)
    parts = parts_of(logs)
    blocks = -(-_SCORES // max(len(logs), len(parts)))
    shares = Shares(len(laws) * (len(laws) > 1) + 1 + len(parts))
    # the present model keeps the thrust law that it was estimated with
    with within(_FOR_PRESENT * seconds_left()):
        own = [
            score
            for fitting, held in parts
            for score in _present_scores(refit, fitting, held, spread, blocks)
        ]
    cut: list[str] = []

    def path(
        of: Sequence[TrialLog], what: str, terms: int = most
    ) -> tuple[FreeRunSelection, list[Selected]]:
        selection = FreeRunSelection(of, family, kind)
        with shares.next():
            try:
                return selection, selection.path(first, stay, terms)
            finally:
                if seconds_left() <= 0:
                    cut.append(what)

    def cost(of: ThrustLaw) -> float:
        try:
            name = f"thrust ~ {law_in_words(of)}"
            return path(with_law(logs, of), name, min(FEW, most))[1][-1].cost
        except OutOfTimeError:
            return np.inf

    law, errors = laws[0], [np.nan]
    if len(laws) > 1:
        errors = [cost(of) for of in laws]
        best_law = int(np.argmin(errors))
        law = laws[-1] if errors[-1] < (1 + _NEAR) * errors[best_law] else laws[best_law]
    logs = with_law(logs, law)
    thrust = law_in_words(law)
    selection, sets = path(logs, "all logs")
    sizes = sorted({len(s.terms) for s in sets})
    scores: list[list[Array]] = [[] for _ in sizes]
    paths: list[list[Selected]] = []
    for k, (fitting, held) in enumerate(parts_of(logs), 1):
        try:
            found = path(fitting, f"all but part {k}")[1]
        except OutOfTimeError:
            # what was not tried must not count as bad
            raise
        except GreyboxError as error:
            _log.info("no path on a part: %s", error)
            found = []
        paths.append(found)
        judged = FreeRunSelection(held, family, kind)
        for runs_of, count in zip(scores, sizes, strict=True):
            small = _of_size(found, count)
            runs = (
                judged.errors(small.p)
                if small
                else [np.full_like(spread, np.inf)[None]] * len(held)
            )
            runs_of += [score_errors(e, spread, blocks) for e in runs]
    alternatives = [np.concatenate(own), *(np.concatenate(s) for s in scores)]
    # a published structure whose numbers were tested comes before terms chosen on the data
    ranking = rank(alternatives, [0, *sizes], given_away=_GIVEN_AWAY)
    counts = [size, *sizes]
    chosen = ranking.chosen
    shown = chosen or int(np.argmax(ranking.score[1:])) + 1
    best = _of_size(sets, counts[shown])
    assert best is not None
    rows = [
        {
            "model": f"{n} terms" if i else present,
            "coefficients": n,
            "score": float(ranking.score[i]),
            "behind": float(ranking.behind[i]),
            "se": float(ranking.se[i]),
            "chosen": i == chosen,
        }
        for i, n in enumerate(counts)
    ]
    said = (
        f"terms were selected by free runs on parts of the logs that were left out in turn: "
        f"{counts[shown]} terms (thrust ~ {thrust}) score "
        f"{ranking.score[shown]:.1f} % and {present} {ranking.score[0]:.1f} % (mean fit over the "
        f"channels, cut at -100); "
        + (
            f"the smallest set that falls behind the best by no more than one standard error and "
            f"{_GIVEN_AWAY:g} points was taken."
            if chosen
            else f"{present} stays."
        )
    )
    if cut:
        said += f" Time was over (--effort) before larger sets were tried on {', '.join(cut)}."
    return TermChoice(
        Terms.of(best, selection, inputs),
        tuple(
            None if one is None else Terms.of(one, selection, inputs)
            for one in (_of_size(found, counts[shown]) for found in paths)
        ),
        tuple(logs),
        chosen > 0,
        tuple(rows),
        tuple(zip(laws, errors, strict=True)),
        said,
    )


def law_in_words(law: ThrustLaw) -> str:
    """Return how the force goes with the speed n."""
    if law.kind == "linear":
        return "n and n|n|" if 0 < law.quadratic_share < 1 else "n"
    return "n|n|" if law.kind == "quadratic" else "a bollard table"


def _of_size(sets: Sequence[Selected], size: int) -> Selected | None:
    """Return the set of best fit with at most so many terms, None where there is none."""
    small = [s for s in sets if len(s.terms) <= size]
    return min(small, key=lambda s: s.cost, default=None)


def _present_scores(
    refit: Callable[[Sequence[TrialLog]], ManoeuvringModel],
    fitting: Sequence[TrialLog],
    held: Sequence[TrialLog],
    spread: Array,
    blocks: int,
) -> list[Array]:
    escaped = np.full_like(spread, np.inf)[None]
    try:
        model = refit(fitting)
    except OutOfTimeError:
        raise
    except GreyboxError as error:
        _log.info("the present model on a part: %s", error)
        return [score_errors(escaped, spread, blocks) for _ in held]
    found = []
    for log in held:
        run = run_model(model, log)
        errors = run.errors() if run.diverged < 0 else escaped
        found.append(score_errors(errors, spread, blocks))
    return found


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
    usual = [float(np.sqrt(np.mean(n**2))) for n in speeds]
    if not any(np.std(np.abs(n)) > _VARIES * u for n, u in zip(speeds, usual, strict=True)):
        return [own]
    reference = float(np.max(usual))
    return [own, ThrustLaw(quadratic_share=0.5, reference=reference), ThrustLaw("quadratic")]


def with_law(logs: Sequence[TrialLog], law: ThrustLaw) -> Sequence[TrialLog]:
    """Return logs of the vessel with a thrust law, as they are where it has it already."""
    vessel = logs[0].vessel
    if law == vessel.thrusters[0].thrust:
        return logs
    changed = replace(vessel, thrusters=tuple(replace(t, thrust=law) for t in vessel.thrusters))
    return [replace(log, vessel=changed) for log in logs]
