"""Which structure the logs support: by free runs on parts that were held out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.errors import GreyboxError, OutOfTimeError, UsageError
from greybox.estimation.registry import ESTIMATORS
from greybox.estimation.result import Estimate
from greybox.estimation.tried import Comparison, TriedModel
from greybox.model.catalogue import structure_for
from greybox.notebook import DisplayMixin
from greybox.numerics.effort import Shares, seconds_left, within
from greybox.numerics.threads import one_thread
from greybox.selection.alternatives import OVER
from greybox.selection.estimate import estimate_requested
from greybox.selection.fit_single import estimate_once
from greybox.selection.held_out import Ranking, folds, rank, score_runs, spread_of
from greybox.selection.request import Request
from greybox.selection.term_selection import law_in_words
from greybox.trial.log import Logs, TrialLog
from greybox.trial.segments import as_segments
from greybox.validation.criteria import independent_samples, information_criteria
from greybox.validation.fit import run_model
from greybox.vessel.force import force_inputs

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]

FOLDS = 5
# shares of the time that is left that choosing method and predictor may take, and comparing
_FOR_SETTLING, FOR_COMPARISON = 0.3, 0.7
# leaves all to the data
CHOOSE = Request()


@dataclass(frozen=True)
class StructureRow:
    """One structure after its held-out runs.

    Parameters
    ----------
    structure : str
    dropped : tuple of str
        What it lacks against the row before, where structures are reduced.
    parameters, columns : int
        Parameters, and all coefficients with the bias-capturing ones.
    score : float or None
        Fit of the held-out free runs against the spread of whole logs [%].
    behind, se : float or None
        How far that falls behind the best row, and the standard error of this [%].
    aic, bic : float or None
        Of the free runs on the estimation logs; None where they diverge.
    chosen : bool
    note : str
        Why a row has no score, or was not taken.
    """

    structure: str
    dropped: tuple[str, ...]
    parameters: int | None
    columns: int | None
    score: float | None
    behind: float | None
    se: float | None
    aic: float | None
    bic: float | None
    chosen: bool
    note: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in self.__dict__.items()}


@dataclass(frozen=True, repr=False)
class StructureChoice(DisplayMixin):
    """An estimate of the chosen structure, and the table that chose it."""

    estimate: Estimate
    rows: tuple[StructureRow, ...]

    def to_list(self) -> list[dict[str, Any]]:
        """Return the rows for JSON."""
        return [r.to_dict() for r in self.rows]

    def summary(self) -> str:
        """Return the table as text."""
        reduced = any(r.dropped for r in self.rows)
        label = "left out" if reduced else "structure"
        lines = [
            f"Structures by free runs on {FOLDS} held-out parts of each log; chosen is the "
            f"smallest within one standard error of the best",
            f"{label:<34}{'terms':>6}{'coef.':>6}{'score %':>9}{'behind':>8}{'se':>7}"
            f"{'AIC':>11}{'BIC':>11}",
        ]
        for row in self.rows:
            name = (", ".join(row.dropped) or "nothing") if reduced else row.structure
            shown = name if len(name) < 34 else name[:30] + "…"
            lines.append(
                f"{shown:<34}{_cell(row.parameters, '6d')}{_cell(row.columns, '6d')}"
                f"{_cell(row.score, '9.1f')}{_cell(row.behind, '8.2f')}{_cell(row.se, '7.2f')}"
                f"{_cell(row.aic, '11.1f')}{_cell(row.bic, '11.1f')}"
                + ("  chosen" if row.chosen else f"  {row.note}" if row.note else "")
            )
        lines.append(
            "AIC and BIC assume Gaussian free-run errors, and count as many of them as the best "
            "row's errors have independent samples; where something that the model lacks moves the "
            "ship they are no more than a hint."
        )
        return "\n".join(lines)


def _cell(value: float | int | None, form: str) -> str:
    return f"{value:>{form}}" if value is not None else f"{'-':>{form.split('.')[0].strip('df')}}"


@dataclass(frozen=True)
class CandidateFit:
    """A structure that may be chosen: its estimate on all logs, its scores on held-out parts."""

    request: Request
    estimate: Estimate | None
    scores: Array | None
    errors: list[Array] | None
    dropped: tuple[str, ...] = ()
    note: str = ""

    @property
    def size(self) -> int:
        """Coefficients of the estimate, 0 where there is none."""
        return 0 if self.estimate is None else len(self.estimate.theta)


class CrossValidation:
    """Fits of structures to whole logs, and their scores on parts that are left out in turn."""

    def __init__(self, logs: Sequence[TrialLog], states: Sequence[str]) -> None:
        self.logs = logs
        self.inputs = force_inputs(logs[0].vessel)
        self.parts = folds(logs, FOLDS)
        self.spread = spread_of(logs, states)

    def once(self, logs: Sequence[TrialLog], request: Request) -> Estimate:
        """Estimate the request's structure with its method and predictor."""
        structure = structure_for(str(request.structure), self.inputs)
        return estimate_once(logs, structure, str(request.method), str(request.predictor), request)

    def scores(self, request: Request) -> Array:
        """Return the held-out scores (FOLDS,)."""
        quick = _without_errors(request)
        found = []
        for fitting, held in self.parts:
            model = self.once(fitting, quick).model()
            found.append(score_runs([run_model(model, log) for log in held], self.spread)[0])
        return np.array(found)

    def fit(
        self, request: Request, *, full: bool = False, dropped: tuple[str, ...] = ()
    ) -> CandidateFit:
        """Estimate and score a structure; one that cannot be estimated says why.

        `full` keeps what the request asks of standard errors.
        """
        try:
            scores = self.scores(request)
            estimate = self.once(self.logs, request if full else _without_errors(request))
        except GreyboxError as error:
            why = OVER if isinstance(error, OutOfTimeError) else str(error)
            return CandidateFit(request, None, None, None, dropped, why)
        model = estimate.model()
        runs = [run_model(model, log) for log in self.logs]
        errors = None
        if all(r.diverged < 0 for r in runs):
            errors = [r.errors() for r in runs]
        return CandidateFit(request, estimate, scores, errors, dropped)


def _without_errors(request: Request) -> Request:
    """Return the request with the quickest standard errors; its prefilter decides scores."""
    return replace(request, covariance="white")


def criteria_of(fitted: CandidateFit, worth: Array) -> tuple[float, float] | tuple[None, None]:
    """Return AIC and BIC of the free runs on the estimation logs, None where they diverge.

    `worth` are the independent samples (nx,) that they count for, common to all structures.
    """
    if fitted.estimate is None or fitted.errors is None:
        return None, None
    means = len(fitted.estimate.current) if ESTIMATORS[fitted.estimate.method].free_run else 0
    return information_criteria(np.concatenate(fitted.errors), fitted.size + means, worth)


def rows_of(tried: Sequence[CandidateFit], found: Ranking) -> tuple[StructureRow, ...]:
    """Return the table, criteria counted by the best row's independent samples."""
    base = tried[found.best].errors
    worth = None if base is None else independent_samples(base)
    rows = []
    for i, t in enumerate(tried):
        aic, bic = (None, None) if worth is None else criteria_of(t, worth)
        scored = t.scores is not None
        rows.append(
            StructureRow(
                str(t.request.structure),
                t.dropped,
                None if t.estimate is None else len(t.estimate.names),
                t.size or None,
                float(found.score[i]) if scored else None,
                float(found.behind[i]) if scored else None,
                float(found.se[i]) if scored else None,
                aic,
                bic,
                i == found.chosen,
                t.note,
            )
        )
    return tuple(rows)


def rank_tried(tried: Sequence[CandidateFit]) -> Ranking:
    """Return the choice of the smallest near the best, the first where there was time for none."""
    if any(t.note == OVER for t in tried) and all(t.scores is None for t in tried):
        none = np.full(len(tried), np.inf)
        return Ranking(-none, none, np.zeros(len(tried)), 0, 0)
    return rank([t.scores for t in tried], [t.size for t in tried])


def settle(logs: Sequence[TrialLog], request: Request) -> Request:
    """Return the request with method, predictor and structure as the data choose them."""
    if request.method and request.predictor and request.structure:
        return request
    with within(_FOR_SETTLING * seconds_left()):
        first = estimate_requested(logs, replace(request, judged=False))
    return replace(
        request,
        method=first.method,
        predictor=first.predictor.kind,
        structure=first.predictor.structure.name,
    )


@one_thread()
def compare_structures(
    logs: Logs,
    names: Sequence[str],
    request: Request = CHOOSE,
    progress: Progress = lambda done, total: None,
) -> StructureChoice:
    """Compare structures by held-out free runs, and estimate the one that is chosen.

    Parameters
    ----------
    logs : TrialLog or sequence of TrialLog
    names : sequence of str
        Structures, such as ``thesis`` and ``thesis-Xkappa``.
    request : Request
        Method and predictor left open are chosen for the first structure and then
        kept for all.
    progress : callable
        Called with how many structures of how many are done.

    Returns
    -------
    StructureChoice

    Raises
    ------
    UsageError
        Fewer than two names, one twice, or structures of different states; logs
        that are too short; no structure can be estimated.
    StructureError
        There is no such structure.
    """
    if len(names) < 2 or len(set(names)) < len(names):
        raise UsageError(
            f"{len(names)} structures are named, {len(set(names))} of them different: name at "
            f"least two different ones, such as thesis linear."
        )
    logs = as_segments(logs)
    inputs = force_inputs(logs[0].vessel)
    states = {name: structure_for(name, inputs).states for name in names}
    other = next((n for n in names if states[n] != states[names[0]]), None)
    if other is not None:
        raise UsageError(
            f"'{names[0]}' has the states {', '.join(states[names[0]])} and '{other}' "
            f"{', '.join(states[other])}: compare structures of the same states."
        )
    with within(request.effort):
        settled = settle(logs, replace(request, structure=names[0]))
        validation = CrossValidation(logs, states[names[0]])
        tried = []
        with within(FOR_COMPARISON * seconds_left()):
            shares = Shares(len(names))
            for i, name in enumerate(names):
                progress(i, len(names))
                with shares.next():
                    tried.append(validation.fit(replace(settled, structure=name)))
        progress(len(names), len(names))
        found = rank_tried(tried)
        estimate = estimate_requested(logs, tried[found.chosen].request)
    rows = rows_of(tried, found)
    return StructureChoice(told(estimate, found, rows), rows)


def told(estimate: Estimate, found: Ranking, rows: Sequence[StructureRow]) -> Estimate:
    """Return the estimate with a note on how its structure was chosen, and the table of it."""
    name = estimate.predictor.structure.name
    untried = sum(r.note == OVER for r in rows)
    if np.isfinite(found.behind[found.chosen]):
        note = (
            f"structure '{name}' is the smallest of {len(rows) - untried} whose held-out free run "
            f"is within one standard error of the best ({found.behind[found.chosen]:.2f} ± "
            f"{found.se[found.chosen]:.2f} % behind); its standard errors do not account for the "
            f"choice on the same logs."
        )
        if untried:
            note += f" {untried} more could not be tried: time ran out (--effort)."
    else:
        note = f"structure '{name}' was compared with no other: time ran out (--effort)."
    own = TriedModel(
        "", estimate.predictor.kind, estimate.method, estimate.sample_time,
        law_in_words(estimate.vessel.thrusters[0].thrust), 0,
    )  # fmt: skip
    compared = Comparison(
        "structures",
        f"free runs on {FOLDS} held-out parts of each log",
        "the smallest that falls behind the best by no more than one standard error",
        tuple(
            replace(
                own, structure=r.structure, terms=r.parameters or 0, score=r.score,
                behind=r.behind, se=r.se, chosen=r.chosen, note=r.note,
            )
            for r in rows
        ),
    )  # fmt: skip
    return replace(estimate, notes=(*estimate.notes, note), tried=(*estimate.tried, compared))
