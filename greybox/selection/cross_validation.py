"""Which estimator simulates best where the model is too small, by runs on parts left out.

Where the structure fits, theory says which estimator is right. Where it does not, each
ends at parameters of its own, none of them true, and what is left to ask is how well
they predict a motion that they were not fitted to.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, stdtrit

from greybox.errors import ExcitationError, GreyboxError, OutOfTimeError
from greybox.estimation.output_error import Weights
from greybox.estimation.registry import ESTIMATORS, automatic_estimators
from greybox.estimation.result import Estimate
from greybox.model.model import ManoeuvringModel
from greybox.numerics.parallel import map_forked
from greybox.selection.fit_single import estimate_once
from greybox.selection.held_out import FLOOR, extent, folds, score_runs, spread_of
from greybox.selection.request import Request
from greybox.trial.log import TrialLog
from greybox.trial.manoeuvres.kinds import alike
from greybox.validation.fit import average_fit, run_model

Array = NDArray[np.float64]
_log = logging.getLogger(__name__)

# parts that are left out in turn, scores that are wanted of estimators, that a standard error of
# them needs, and that are wanted of models
_FOLDS, _WANTED, _LEAST, _SCORES = 4, 4, 3, 8
# refinements of the instruments of a part
_REFINEMENTS = 4


@dataclass(frozen=True)
class EstimatorVariant:
    """An estimator: its method, and the scale of errors of output error."""

    method: str
    weights: Weights = "noise"

    @property
    def label(self) -> str:
        """The estimator in words."""
        return self.method + (" weighed by deviation" if self.weights == "deviation" else "")

    def asked(self, request: Request, start: Estimate | None = None) -> Request:
        """Return the request with this variant's weights.

        From a start that stays bounded, whole runs are fitted: segments would hold up a
        model that no run follows. The likelihood is sought in all ways.
        """
        options = replace(request.output_error, weights=self.weights)
        nearest = self.weights == "deviation" or not options.search
        if start is not None and nearest and options.shooting == "auto":
            options = replace(options, shooting="single")
        return replace(request, output_error=options)


def _variants() -> list[EstimatorVariant]:
    """Return the estimators that the data may choose."""
    return [
        EstimatorVariant(e.name, weights) for e in automatic_estimators() for weights in e.weights
    ]


@dataclass(frozen=True)
class EstimatorComparison:
    """Estimators after their held-out runs.

    Parameters
    ----------
    variants : tuple of EstimatorVariant
        The one that stands first.
    scores : ndarray
        (V, parts) [%]; no number where a part did not do for an estimate.
    """

    variants: tuple[EstimatorVariant, ...]
    scores: Array

    @cached_property
    def gains(self) -> tuple[tuple[float, float], ...]:
        """Mean gain on the variant that stands, and its one-sided 84 % limit [%], by variant.

        The limit is a standard error that allows for the number of parts.
        """
        return tuple(gain(row - self.scores[0]) for row in self.scores)

    @property
    def best(self) -> int:
        """The variant of largest gain."""
        return max(range(len(self.variants)), key=lambda i: self.gains[i][0])

    @property
    def chosen(self) -> int:
        """The best variant of those that gain more than a standard error, else the first."""
        sure = [i for i, (by, se) in enumerate(self.gains) if by > se]
        return max(sure, key=lambda i: self.gains[i][0], default=0)

    def sentence(self) -> str:
        """Return what was compared, and each variant's score."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            mean = np.nanmean(self.scores, axis=1)
        shown = ", ".join(
            f"{w.label} {m:.1f}" if np.isfinite(m) else f"{w.label} refused"
            for w, m in zip(self.variants, mean, strict=True)
        )
        i = self.chosen or self.best
        by, se = self.gains[i]
        first = self.variants[0].label
        told = (
            f"{self.variants[i].label} is {by:.1f} ± {se:.1f} better than {first}"
            if i
            else f"none is better than {first}"
        )
        kept = "" if self.chosen or not i else ", which stays: a gain must exceed its error"
        constant = " None predicts better than a constant." if np.nanmax(mean) < 0 else ""
        return (
            f"tests or free runs speak against {first}, so the estimators were compared by free "
            f"runs on parts of the logs that were left out in turn (mean fit in %, cut at "
            f"{FLOOR:.0f}, which is what a "
            f"run that diverges counts): {shown}; {told}{kept}.{constant}"
        )


def gain(difference: Array) -> tuple[float, float]:
    """Return the mean of differences of scores, and its one-sided 84 % limit by Student's t [%].

    Without a finite mean where fewer than half of the parts, or three, have a score.
    """
    known = difference[np.isfinite(difference)]
    n = len(known)
    if 2 * n < len(difference) or n < _LEAST:
        return -np.inf, 0.0
    # as sure as one standard error of many
    factor = float(stdtrit(n - 1, ndtr(1.0)))
    return float(known.mean()), factor * float(known.std(ddof=1)) / float(np.sqrt(n))


def parts_of(logs: Sequence[TrialLog]) -> list[tuple[list[TrialLog], list[TrialLog]]]:
    """Return (to estimate on, held out): kinds of manoeuvre, groups of logs, or parts of one.

    What a model lacks shows where the ship moves as it did not before, so logs that are alike,
    such as zig-zags, are left out together, unless all are.

    Raises
    ------
    UsageError
        A single log is too short.
    """
    if len(logs) == 1:
        return stretches_of(logs)
    pieces = [own for _, own in alike(logs)]
    if len(pieces) == 1:
        pieces = [[i] for i in pieces[0]]
    groups: list[list[int]] = [[] for _ in range(min(len(pieces), _FOLDS))]
    for piece in sorted(pieces, key=lambda piece: -sum(len(logs[i]) for i in piece)):
        min(groups, key=lambda g: sum(len(logs[j]) for j in g)).extend(piece)
    return [
        ([log for i, log in enumerate(logs) if i not in group], [logs[i] for i in group])
        for group in groups
    ]


def stretches_of(logs: Sequence[TrialLog]) -> list[tuple[list[TrialLog], list[TrialLog]]]:
    """Return (to estimate on, held out): a stretch of each log is held out in turn.

    What is left shows all that the logs show, so that its model stands for that of all logs.

    Raises
    ------
    UsageError
        No log is long enough.
    """
    return folds(logs, _FOLDS)


def kinds_left_out(logs: Sequence[TrialLog]) -> tuple[str, ...]:
    """Return the kinds of manoeuvre that `parts_of` leaves out; none where it leaves out logs."""
    kinds = dict.fromkeys(kind.name for kind, _ in alike(logs)) if len(logs) > 1 else {}
    return tuple(kinds) if len(kinds) > 1 else ()


def compare_estimators(
    found: Estimate, logs: Sequence[TrialLog], request: Request, spare: Estimate | None = None
) -> EstimatorComparison:
    """Compare estimators of the model of `found`, its own first.

    Parameters
    ----------
    found : Estimate
        Its predictor and structure are kept; its variant stays unless another is better by
        more than one standard error of the difference.
    logs : sequence of TrialLog
        Those it was estimated on.
    request : Request
    spare : Estimate, optional
        Where output error starts if no regression of a part can be run freely.

    Raises
    ------
    OutOfTimeError
        Time was over before each was estimated without every part.
    UsageError
        A single log is too short to be parted.
    """
    variants = list(dict.fromkeys([EstimatorVariant(found.method), *_variants()]))
    spread = spread_of(logs, found.predictor.structure.states) if len(logs) == 1 else None
    parts = parts_of(logs)
    blocks = -(-_WANTED // max(len(logs), len(parts)))
    scores = []
    for fitting, held in parts:
        estimates = _estimates(variants, fitting, found, request, spare)
        scores.append(
            np.array(
                [
                    np.full(len(held) * blocks, np.nan) if e is None
                    else np.concatenate([_score(e, log, spread, blocks) for log in held])
                    for e in estimates
                ]
            )
        )  # fmt: skip
        _log.info("a part left out: %s", ", ".join(
            f"{w.label} {s.mean():.1f}" for w, s in zip(variants, scores[-1], strict=True)
        ))  # fmt: skip
    return EstimatorComparison(tuple(variants), np.concatenate(scores, axis=1))


def _estimates(
    variants: Sequence[EstimatorVariant],
    logs: Sequence[TrialLog],
    like: Estimate,
    request: Request,
    spare: Estimate | None,
) -> list[Estimate | None]:
    """Estimate by each variant, output error from the regression that follows the logs best."""
    request = replace(
        request,
        covariance="white",
        refine=_REFINEMENTS if request.refine else False,
        judged=False,
        output_error=replace(request.output_error, search=False, levels=False, process_noise=False),
    )
    found: dict[EstimatorVariant, Estimate | None] = {}
    start: Estimate | None = None
    most = -np.inf
    # regressions first: output error starts from one of them
    for variant in sorted(variants, key=lambda w: ESTIMATORS[w.method].free_run):
        free_run = ESTIMATORS[variant.method].free_run
        from_here = start or (spare if free_run else None)
        try:
            found[variant] = estimate_variant(variant, logs, like, request, from_here)
        except OutOfTimeError:
            raise
        except GreyboxError as error:
            _log.info("%s on a part: %s", variant.label, error)
            found[variant] = None
        estimate = found[variant]
        if estimate is not None and not free_run:
            runs = [run_model(estimate.model(), log) for log in logs]
            level = float(np.mean(list(average_fit(runs).values())))
            if level > most and all(run.diverged < 0 for run in runs):
                start, most = estimate, level
    return [found[variant] for variant in variants]


class Refit:
    """A model from some of the logs, chosen and estimated as that of all of them was.

    The same logs, or parts of them, are estimated on once.

    Parameters
    ----------
    estimate : callable
        Returns the model.
    """

    def __init__(self, estimate: Callable[[Sequence[TrialLog]], ManoeuvringModel]) -> None:
        self._estimate = estimate
        self._known: dict[tuple[tuple[str, float, float], ...], ManoeuvringModel | str] = {}

    def __call__(self, logs: Sequence[TrialLog]) -> ManoeuvringModel:
        """Return the model of logs.

        Raises
        ------
        ExcitationError
            There is none.
        OutOfTimeError
            Time was over before.
        """
        key = extent(logs)
        if key not in self._known:
            self._known[key] = self._tried(logs)
        found = self._known[key]
        if isinstance(found, str):
            raise ExcitationError(found)
        return found

    def _tried(self, logs: Sequence[TrialLog]) -> ManoeuvringModel | str:
        """Return the model, or why there is none."""
        try:
            return self._estimate(logs)
        except OutOfTimeError:
            raise
        except GreyboxError as error:
            return str(error)

    def _in_time(self, logs: Sequence[TrialLog]) -> ManoeuvringModel | str | None:
        try:
            return self._tried(logs)
        except OutOfTimeError:
            return None

    @staticmethod
    def ahead(refits: Sequence[Refit], parts: Sequence[Sequence[TrialLog]]) -> None:
        """Estimate on each of the parts where that is still to be done, on all processors."""
        tasks = [(r, p) for r in refits for p in parts if extent(p) not in r._known]
        for (refit, part), found in zip(
            tasks, map_forked(lambda task: task[0]._in_time(task[1]), tasks), strict=True
        ):
            if found is not None:
                refit._known[extent(part)] = found


def score_refits(refits: Sequence[Refit], logs: Sequence[TrialLog]) -> list[Array]:
    """Return the scores of models over parts of the logs that are left out of them in turn.

    Parameters
    ----------
    refits : sequence of Refit
        Where one fails, its run counts as escaped.
    logs : sequence of TrialLog

    Raises
    ------
    OutOfTimeError
        Time was over before each was run over every part.
    UsageError
        A single log is too short to be parted.
    """
    parts = parts_of(logs)
    blocks = -(-_SCORES // max(len(logs), len(parts)))
    Refit.ahead(refits, [fitting for fitting, _ in parts])
    found = []
    for refit in refits:
        scores: list[Array] = []
        for fitting, held in parts:
            spread = None
            try:
                model = refit(fitting)
                spread = spread_of(logs, model.structure.states)
            except OutOfTimeError:
                raise
            except GreyboxError as error:
                _log.info("without a part there is no estimate: %s", error)
            for log in held:
                none = np.full(blocks, FLOOR)
                scores.append(
                    none if spread is None else score_runs([run_model(model, log)], spread, blocks)
                )
        found.append(np.concatenate(scores))
    return found


def estimate_variant(
    variant: EstimatorVariant,
    logs: Sequence[TrialLog],
    like: Estimate,
    request: Request,
    start: Estimate | None = None,
) -> Estimate:
    """Estimate the model of `like` by one variant, output error from `start`.

    Raises
    ------
    GreyboxError
        The logs do not do for it.
    """
    predictor = like.predictor
    return estimate_once(
        logs,
        predictor.structure,
        variant.method,
        predictor.kind,
        variant.asked(request, start),
        start,
    )


def _score(found: Estimate, log: TrialLog, spread: dict[str, float] | None, blocks: int) -> Array:
    """Return the fit of a free run, cut, against the log's own spread or a given one [%]."""
    run = run_model(found.model(), log)
    return score_runs([run], spread or spread_of([log], tuple(run.fit)), blocks)
