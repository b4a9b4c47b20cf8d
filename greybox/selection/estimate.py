"""Choosing method and predictor when the user does not, and saying why."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from greybox.credibility.verdict import free_run_faults, misfit, weigh
from greybox.errors import ExcitationError, GreyboxError, LogError, OutOfTimeError, UsageError
from greybox.estimation.closed_loop import Loop
from greybox.estimation.covariance import Covariance
from greybox.estimation.efficiency_bounds import limits_of
from greybox.estimation.informative import orders_logged
from greybox.estimation.output_error import OutputErrorOptions
from greybox.estimation.prediction_verdict import (
    NOT_JUDGED,
    Elsewhere,
    HeldCommandsDiverge,
    LargeError,
    PredictionLevel,
    RefitsDiverge,
    RunsDiverge,
)
from greybox.estimation.registry import ESTIMATORS, free_run_estimator
from greybox.estimation.result import Estimate
from greybox.estimation.tried import Comparison
from greybox.estimation.verdict import Divergence, TrustLevel, Verdict, refused
from greybox.model.catalogue import structure_for
from greybox.model.model import ManoeuvringModel
from greybox.model.predictor_kinds import PREDICTORS
from greybox.model.structure import Structure
from greybox.numerics.effort import EFFORT, seconds_left, within, without_limit
from greybox.numerics.threads import one_thread
from greybox.public import known_keywords
from greybox.regression.regression import common_sample_time
from greybox.selection.alternatives import (
    Alternative,
    alternatives_for,
    ranking_request,
    structures_to_try,
    tried_model,
)
from greybox.selection.compared import estimators_tried, runs_tried, terms_tried
from greybox.selection.cross_validation import (
    EstimatorVariant,
    Refit,
    compare_estimators,
    score_refits,
)
from greybox.selection.fit_single import estimate_once
from greybox.selection.held_out import FLOOR, rank
from greybox.selection.prediction import (
    refit_alike,
    require_distinct,
    require_others,
    with_prediction,
)
from greybox.selection.request import Request, regression_only
from greybox.selection.term_selection import Terms, select_terms
from greybox.trial.kinematics import decimate_segments
from greybox.trial.log import Logs, TrialLog
from greybox.trial.segments import as_segments
from greybox.validation.fit import average_fit, run_model
from greybox.vessel.force import force_inputs

Array = NDArray[np.float64]
_log = logging.getLogger(__name__)

# share of length over speed that a sample may take, and samples that logs keep at least: a ship
# that hardly moves is pushed about by thrusters that do not wait for her
_SHARE, _KEPT = 0.05, 500
# shares of the time that is left that output error may take beside a regression, and the
# selection of terms, so that their estimate ends too; share of all that the verdict may
_FOR_FREE_RUN, _FOR_TERMS, _FOR_VERDICT = 0.3, 0.7, 0.25
# error of held-out free runs beyond the sensors' noise, as a share of the spread, up to which a
# published structure is not compared with terms that the data select. Ships written by others
# were followed to 63 % where selected terms follow them to 76 %; short logs of ships in the
# family leave as much by the noise in their coefficients alone, and follow their own logs, which
# must be left by the second number too. Instruments are held to that alone: of a 3 m tanker an
# estimate by them left 13 to 17 % of its own log, passed every test, and followed other manoeuvres
# by 56 %, selected terms by 81 %
_SMALL, _OWN = 0.2, 0.1


@known_keywords
def estimate_model(
    logs: Logs,
    request: Request | None = None,
    *,
    method: str | None = None,
    predictor: str | None = None,
    structure: str | None = None,
    margins: Mapping[str, float] | None = None,
    covariance: Covariance | None = None,
    heading: Literal["measured", "simulated"] = "measured",
    loop: Loop = "auto",
    zero_mean: bool = True,
    refine: bool | int = True,
    nominal: ManoeuvringModel | None = None,
    output_error: OutputErrorOptions | None = None,
    seed: int = 0,
    prefilter: Literal["auto", "noise", "none"] = "auto",
    judged: bool = True,
    without: Sequence[str] = (),
    validate: Logs = (),
    effort: float = EFFORT,
) -> Estimate:
    """Estimate a model from logs, choosing what is left open, and say whether to trust it.

    Where the method is open and the tests speak against the estimate that theory or
    held-out runs prefer, output error is tried on the same predictor, and kept if it can
    be trusted. Where the model itself is at fault, all estimators are compared by free
    runs on parts of the logs that are left out in turn.

    Parameters
    ----------
    logs : TrialLog or sequence of TrialLog
        One experiment each, of one vessel and sample time.
    request : Request, optional
        Deprecated: the same as keywords.
    method : {"ls", "iv", "refined-iv", "oe"}, optional
        Least squares, instrumental variables (refined by the noise where nothing speaks
        against it, or always), output error; by default chosen.
    predictor : {"basic", "augmented", "wind", "basic+wind"}, optional
        Which disturbances are captured or measured; by default chosen.
    structure : str, optional
        As `get_structure`; by default chosen.
    margins : mapping of str to float, optional
        |u|, |v| [m/s] below which samples are cut out.
    covariance : {"cluster", "ma", "hac", "white", "bootstrap"}, optional
        What the standard errors allow for; by default ``cluster``.
    heading : {"measured", "simulated"}
        Heading inside the instruments.
    loop : {"auto", "open", "closed"}
        Whether a controller moved the thrusters.
    zero_mean : bool
        Whether instruments lose their mean (4.63).
    refine : bool or int
        Whether, or how many times at most, instruments are simulated again.
    nominal : ManoeuvringModel, optional
        Simulates the first instruments, or starts output error.
    output_error : OutputErrorOptions, optional
        What only ``oe`` heeds.
    seed : int
    prefilter : {"auto", "noise", "none"}
        Whether instrumental variables are refined by the noise.
    judged : bool
        Whether tests and verdict are asked for.
    without : sequence of str
        Bias-capturing columns to leave out, spelled ``state:function``.
    validate : TrialLog or sequence of TrialLog
        Logs that judge the prediction and take no part in the estimate; without them the
        logs are left out in turn.
    effort : float
        Seconds that the choice of what is left open may take: what could not be tried is
        named in the notes. The first estimate always ends, and where time is ample nothing
        depends on it.

    Returns
    -------
    Estimate
        With its free-run fit on `logs`, both verdicts, and notes on every choice.

    Raises
    ------
    ExcitationError
        No alternative can be estimated.
    LogError
        Logs differ in sample time, or lack a channel.
    UsageError
        A keyword is unknown or has a value that it cannot have, or two contradict each other.
    """
    asked = Request(
        method,
        predictor,
        structure,
        margins=None if margins is None else dict(margins),
        covariance=covariance,
        heading=heading,
        loop=loop,
        zero_mean=zero_mean,
        refine=refine,
        nominal=nominal,
        output_error=OutputErrorOptions() if output_error is None else output_error,
        seed=seed,
        prefilter=prefilter,
        judged=judged,
        without=tuple(without),
        validate=(validate,) if isinstance(validate, TrialLog) else tuple(validate),
        effort=effort,
    )
    if request is not None:
        if asked != Request():
            raise UsageError(
                "a Request is given and keywords too: give all of them in one of the two ways."
            )
        warnings.warn(
            "estimate_model(logs, Request(method=…)) is deprecated: write "
            "estimate_model(logs, method=…).",
            DeprecationWarning,
            stacklevel=3,
        )
        asked = request
    return estimate_requested(as_segments(logs), asked)


@one_thread()
def estimate_requested(logs: Sequence[TrialLog], request: Request) -> Estimate:
    """Return what `estimate_model` does of a request."""
    require_distinct(logs)
    require_others(logs, request.validate)
    common_sample_time(logs)
    with within(request.effort):
        return _estimated(logs, request)


def _estimated(logs: Sequence[TrialLog], request: Request) -> Estimate:
    """Return the estimate that is chosen while time is left, the first one at any rate."""
    notes = orders_logged(logs)
    if all(n is None for n in (request.method, *_named(request))):
        logs = at_own_pace(logs, notes)
    estimate = _first_choice(logs, request, notes)
    if not request.judged:
        return estimate
    if not _open(request, estimate):
        return _judged(estimate, logs, request)
    trusted = _rank(estimate)[0] < 2
    refit = refit_alike(estimate, request)
    first = _judged(estimate, logs, request, refit) if trusted else estimate
    good = _level_of(first) is PredictionLevel.GOOD and not _leaves_more(first)
    predicts = _or_better_run(first, refit, logs, request, notes, free_run=trusted and not good)
    if predicts.method != first.method or predicts.predictor != first.predictor:
        refit = refit_alike(predicts, request)
        predicts = _judged(predicts, logs, request, refit) if trusted else predicts
    if good or (trusted and not _leaves_more(predicts)):
        return _both(predicts, first)
    selected, logs, again = _or_selected_terms(predicts, refit, logs, request, notes)
    return _both(_judged(selected, logs, request, again or refit), first)


def _level_of(estimate: Estimate) -> PredictionLevel:
    return (estimate.prediction or NOT_JUDGED).level


def _leaves_more(estimate: Estimate) -> bool:
    """Whether free runs on what took no part err by more than the sensors' noise explains."""
    judged = estimate.prediction or NOT_JUDGED
    told = LargeError | RunsDiverge | RefitsDiverge | Divergence | HeldCommandsDiverge | Elsewhere
    if any(isinstance(r, told) for r in judged.because):
        return True

    def beyond(error: float | None, noise: float | None, spread: float) -> float:
        """Return an error without the sensors' noise, as a share of the spread."""
        left = max((np.inf if error is None else error) ** 2 - (noise or 0.0) ** 2, 0.0)
        return float(np.sqrt(left)) / spread

    if ESTIMATORS[estimate.method].instruments:
        return any(beyond(c.rmse, c.noise, c.spread) > _OWN for c in judged.channels)
    # what is not there on the logs of the estimate is the noise of its coefficients
    return any(
        beyond(c.rmse, c.noise, c.spread) > _SMALL and beyond(c.own, c.noise, c.spread) > _OWN
        for c in judged.channels
    )


def _both(predicts: Estimate, first: Estimate) -> Estimate:
    """Return the estimate that predicts, with the first one's coefficients where they are better.

    Those of a published structure stay where they are to be trusted, all or with exceptions.
    """
    same = predicts.method == first.method and np.array_equal(predicts.theta, first.theta)
    if same or _rank(first)[0] == 2:
        return predicts
    return replace(predicts, coefficients=first)


def _or_better_run(
    found: Estimate,
    refit: Refit,
    logs: Sequence[TrialLog],
    request: Request,
    notes: Sequence[str],
    *,
    free_run: bool,
) -> Estimate:
    """Return the estimate whose runs over parts left out are best, `found` within an error.

    Compared are plain least squares of each structure, where they follow the logs better than
    `found` does, and with `free_run` output error of its own structure.
    """
    wind = all(log.has_wind for log in logs)
    inputs = force_inputs(logs[0].vessel)
    plain = PREDICTORS[found.predictor.kind].plain
    ways = [
        Alternative(structure_for(name, inputs), "ls", plain)
        for name in structures_to_try(logs, wind)
    ]
    quick, estimates = ranking_request(request), [found]
    try:
        for way in ways:
            other = _quickly(way, logs, quick)
            if other is not None and _level(other) > _level(found):
                estimates.append(other)
        if free_run and not ESTIMATORS[found.method].free_run:
            way = Alternative(
                found.predictor.structure, free_run_estimator().name, found.predictor.kind
            )
            with within(_FOR_FREE_RUN * seconds_left()):
                other = _quickly(way, logs, quick)
            estimates += [other] if other is not None else []
        if len(estimates) == 1:
            return found
        others = [refit_alike(e, request) for e in estimates[1:]]
        scores = score_refits([refit, *others], logs)
    except GreyboxError as error:
        return _noting(found, f"other ways to predict were not compared: {error}")
    ranking = rank(scores, range(len(estimates)))
    compared = runs_tried(estimates, ranking, logs)
    found = _noting(found, f"compared for prediction: {compared.decision}", compared)
    if not ranking.chosen:
        return found
    best = estimates[ranking.chosen]
    way = Alternative(best.predictor.structure, best.method, best.predictor.kind)
    try:
        taken, diverged = _finished(way, logs, request, notes)
    except GreyboxError as error:
        return _noting(found, f"{way.label} failed on the whole logs: {error}")
    return found if diverged else replace(_noting(taken, found.notes[-1]), tried=found.tried)


def _quickly(way: Alternative, logs: Sequence[TrialLog], request: Request) -> Estimate | None:
    """Return an estimate with its fit and without tests, None where there is none to simulate."""
    try:
        found = estimate_once(logs, way.structure, way.method, way.kind, request)
        runs = [run_model(found.model(), log) for log in logs]
    except OutOfTimeError:
        raise
    except GreyboxError as error:
        _log.info("%s: %s", way.label, error)
        return None
    if any(r.diverged >= 0 for r in runs):
        return None
    return replace(found, fit=average_fit(runs))


def _judged(
    estimate: Estimate, logs: Sequence[TrialLog], request: Request, refit: Refit | None = None
) -> Estimate:
    """Return the estimate with the verdict on its predictions, which has time of its own."""
    _log.info("verdict on predictions")
    seconds = max(seconds_left(), request.effort * _FOR_VERDICT)
    with without_limit(), within(seconds):
        return with_prediction(estimate, logs, request, refit)


def _first_choice(logs: Sequence[TrialLog], request: Request, notes: list[str]) -> Estimate:
    """Return the estimate of a published structure that tests and runs prefer."""
    tried: list[Comparison] = []
    alternatives = alternatives_for(logs, request, notes, tried)
    _log.info("%d ways to estimate, first %s", len(alternatives), alternatives[0].label)
    _log.debug("in this order: %s", "; ".join(a.label for a in alternatives))
    try:
        estimate = _first_that_runs(logs, alternatives, request, notes)
    except GreyboxError as error:
        if request.method is not None or regression_only(request):
            raise
        estimate = _without_regression(logs, alternatives, request, notes, error)
    estimate = replace(estimate, tried=tuple(tried))
    if request.method is not None or not request.judged or regression_only(request):
        return estimate
    if _rank(estimate)[0] == 0:
        return estimate
    spare: Estimate | None = None
    if not ESTIMATORS[estimate.method].free_run and not misfit(estimate.tests):
        # what the structure lacks no other estimator mends
        estimate, spare = _or_output_error(estimate, logs, request, notes)
    if _at_fault(estimate, spare) and not _open(request, estimate):
        return _by_held_out_runs(estimate, spare, logs, request, notes)
    return estimate


def _open(request: Request, estimate: Estimate) -> bool:
    """Whether method, predictor and structure are left to the data, which are a ship's."""
    named = (request.method, *_named(request))
    ship = estimate.predictor.structure.marine
    return ship and all(n is None for n in named) and not regression_only(request)


def _named(request: Request) -> tuple[object, ...]:
    """Return what a request may name of the model."""
    return request.predictor, request.structure, request.nominal


def at_own_pace(
    logs: Sequence[TrialLog], notes: list[str], share: float = _SHARE
) -> Sequence[TrialLog]:
    """Return logs at a sample time that suits how fast the ship moves; `notes` are told.

    A ship answers in times of the order of its length over its speed: a twentieth of that
    shows all of it, and more samples hold sensor noise and cost time. Few samples cost none.

    Parameters
    ----------
    logs : sequence of TrialLog
    notes : list of str
        What was done is added to them.
    share : float
        Of length over speed that a sample may take.
    """
    speeds = [np.hypot(log["u"], log["v"]) for log in logs if {"u", "v"} <= log.channels.keys()]
    if not speeds:
        return logs
    speed = float(np.sqrt(np.mean(np.concatenate(speeds) ** 2)))
    length, own = logs[0].vessel.length, logs[0].sample_time
    most = sum(map(len, logs)) // _KEPT
    times = min(int(share * length / speed / own), most) if speed > 0 else 1
    if times < 2:
        return logs
    try:
        slower, left_out = decimate_segments(logs, times * own)
    except LogError:
        return logs
    notes.append(
        f"the logs were taken at {times * own:g} s instead of {own:g} s, the next multiple below "
        f"{share:g} of length over speed ({length:g} m, {speed:.3g} m/s)"
        f"{f' that keeps {_KEPT} samples' if times == most else ''}; --sample-time sets it."
    )
    notes += left_out
    return slower


def _or_selected_terms(
    found: Estimate,
    refit_found: Refit,
    logs: Sequence[TrialLog],
    request: Request,
    notes: Sequence[str],
) -> tuple[Estimate, Sequence[TrialLog], Refit | None]:
    """Return the free run of terms that the data select, where it predicts better than `found`.

    With it the logs with the thrust law that it has, and how to choose terms on fewer logs.
    """
    before = f"{found.method} of structure '{found.predictor.structure.name}'"
    size = len(found.predictor.parameter_columns)
    _log.info("selection of terms")
    try:
        with within(_FOR_TERMS * seconds_left()):
            choice = select_terms(logs, before, size, refit_found)
    except GreyboxError as error:
        return _noting(found, f"no terms were selected: {error}"), logs, None
    compared = terms_tried(choice, found, logs)
    told = _noting(found, choice.note, *compared)
    if not choice.taken:
        return told, logs, None
    try:
        estimate, diverged = _finished(
            *_of_terms(choice.terms, choice.logs, request), [*notes, choice.note]
        )
    except GreyboxError as error:
        note = f"the selected terms could not be estimated on the whole logs: {error}"
        return _noting(told, note), logs, None
    if diverged:
        return _noting(told, "the selected terms diverge, and were rejected."), logs, None
    estimate = replace(estimate, tried=told.tried)

    def refit(fitting: Sequence[TrialLog]) -> ManoeuvringModel:
        """Estimate the terms that these logs choose, their noise that of all logs."""
        terms = choice.again(fitting)
        if terms is None:
            raise ExcitationError("no terms were selected on a part of the logs.")
        way, on, asked = _of_terms(terms, fitting, ranking_request(request))
        model = estimate_once(on, way.structure, way.method, way.kind, asked).model()
        return replace(model, noise=estimate.noise)

    return estimate, choice.logs, Refit(refit)


def _of_terms(
    terms: Terms, logs: Sequence[TrialLog], request: Request
) -> tuple[Alternative, Sequence[TrialLog], Request]:
    """Return how selected terms are estimated: a free run from where their selection ended."""
    options = replace(
        request.output_error,
        search=False,
        starts="measured",
        levels=request.judged,
        heading="input",
        damping="enforce",
        integrator=terms.integrator,
    )
    start = nominal_model(terms.structure, terms.start, logs)
    asked = replace(request, nominal=start, output_error=options)
    return Alternative(terms.structure, free_run_estimator().name, terms.kind), logs, asked


def nominal_model(structure: Structure, theta: Array, logs: Sequence[TrialLog]) -> ManoeuvringModel:
    """Return a model to start from, without anything known of its errors."""
    return ManoeuvringModel(
        structure, theta, np.zeros((len(theta), len(theta))), logs[0].sample_time, logs[0].vessel
    )


def _without_regression(
    logs: Sequence[TrialLog],
    alternatives: Sequence[Alternative],
    request: Request,
    notes: list[str],
    error: GreyboxError,
) -> Estimate:
    """Return output error where no regression can be solved, else raise what stopped that.

    A free run may tell apart what is nearly one regressor: it feels its own noise-free states.
    """
    reason = "no regression could be solved, and a free run tells the parameters apart"
    ways = {
        a.structure.name: Alternative(a.structure, free_run_estimator().name, a.kind, reason)
        for a in reversed(alternatives)
    }
    try:
        return _first_that_runs(logs, list(reversed(ways.values())), request, notes)
    except GreyboxError:
        raise error from None


def _at_fault(estimate: Estimate, tried: Estimate | None) -> bool:
    """Whether an estimate is not to be trusted because of the model, as far as tests tell."""
    if _rank(estimate)[0] < 2:
        return False
    return any(misfit(e.tests) or free_run_faults(e.tests, e.fit) for e in (estimate, tried) if e)


def _rank(estimate: Estimate) -> tuple[int, int]:
    """Order estimates, the best first: trust, by the number excepted, do not trust.

    Of those not to be trusted, the one whose free run is worse than a constant in fewest states.
    """
    verdict = estimate.verdict
    if verdict.level is TrustLevel.DO_NOT_TRUST:
        return 2, len(_poor(estimate.fit))
    return (1 if verdict.excepted else 0), len(verdict.excepted)


def _poor(fit: Mapping[str, float]) -> list[str]:
    """Return the states whose free run is worse than a constant."""
    return [s for s, v in fit.items() if v < 0]


def _or_output_error(
    found: Estimate, logs: Sequence[TrialLog], request: Request, notes: Sequence[str]
) -> tuple[Estimate, Estimate | None]:
    """Return output error on the same predictor where its verdict is better than `found`'s.

    Beside it output error's own estimate, if its free run stays bounded.
    """
    before = f"{found.method} of this predictor alone is judged '{found.verdict.text}'"
    other = free_run_estimator()
    way = Alternative(found.predictor.structure, other.name, found.predictor.kind)
    first = Alternative(found.predictor.structure, found.method, found.predictor.kind)

    def compared(taken: bool, result: str) -> Comparison:
        return Comparison(
            "output error beside the regression",
            "the verdict on the coefficients",
            "its verdict is better" if taken else "the other one's verdict is no better",
            (
                tried_model(first, logs, chosen=not taken, note=str(found.verdict.level)),
                tried_model(way, logs, chosen=taken, note=result),
            ),
        )

    try:
        with within(_FOR_FREE_RUN * seconds_left()):
            tried, diverged = _finished(way, logs, request, notes)
    except GreyboxError as error:
        note = f"{other.words} was tried too, and failed: {error}"
        return _noting(found, note, compared(False, str(error))), None
    if diverged:
        note = f"{other.words} was tried too, and its free run diverges."
        return _noting(found, note, compared(False, "its run diverges")), None
    tried = replace(tried, tried=found.tried)
    if _rank(tried) < _rank(found):
        why = f"it is judged '{tried.verdict.text}' and {before}"
        if _rank(tried)[0] == 2:
            why = (
                f"its free run is better than a constant in more of the states, though neither "
                f"can be trusted: {before}"
            )
        note = f"{other.words} was chosen, because {why}."
        return _noting(tried, note, compared(True, str(tried.verdict.level))), tried
    note = f"{other.words} was tried too, and is judged no better: '{tried.verdict.text}'."
    return _noting(found, note, compared(False, str(tried.verdict.level))), tried


def _by_held_out_runs(
    found: Estimate,
    spare: Estimate | None,
    logs: Sequence[TrialLog],
    request: Request,
    notes: Sequence[str],
) -> Estimate:
    """Return the way to estimate whose runs on parts left out are best, `found` in doubt."""
    try:
        compared = compare_estimators(found, logs, request, spare)
    except GreyboxError as error:
        return _noting(found, f"estimators were not compared by held-out runs: {error}")
    table = estimators_tried(compared, found, logs)
    found = _noting(found, compared.sentence(), table)
    way = compared.variants[compared.chosen]
    if not compared.chosen:
        return found
    if spare is not None and way == EstimatorVariant(spare.method):
        other, diverged = spare, False
    else:
        start = spare if _diverges(found) else found
        asked = Alternative(found.predictor.structure, way.method, found.predictor.kind)
        try:
            other, diverged = _finished(asked, logs, way.asked(request, start), notes, start)
        except GreyboxError as error:
            return _noting(found, f"{way.label} failed on the whole logs: {error}")
    if diverged and not _diverges(found):
        return _noting(found, f"{way.label} diverges on the whole logs, and was rejected.")
    if ESTIMATORS[way.method].free_run and _level(other) < _level(found):
        # the free run is what it fits, so this is no optimum to speak of
        return _noting(
            found,
            f"{way.label} follows the whole logs less well than {found.method}, and was rejected.",
        )
    lacks = misfit(found.tests) or (misfit(spare.tests) if spare else ())
    if lacks and _rank(other)[0] < 2:
        # output error hides a misfit that the regression's tests have found
        other = replace(other, verdict=refused(lacks, other.verdict.excepted))
    return _noting(replace(other, tried=found.tried), compared.sentence())


def _level(estimate: Estimate) -> float:
    """Return the free-run fit on the estimation logs, mean over the states and cut [%]."""
    return float(np.mean([max(v, FLOOR) for v in estimate.fit.values()]))


def _diverges(estimate: Estimate) -> bool:
    return any(v == -np.inf for v in estimate.fit.values())


def _noting(estimate: Estimate, note: str, *tried: Comparison) -> Estimate:
    return replace(estimate, notes=(*estimate.notes, note), tried=(*estimate.tried, *tried))


def _first_that_runs(
    logs: Sequence[TrialLog],
    alternatives: Sequence[Alternative],
    request: Request,
    notes: list[str],
) -> Estimate:
    """Return the first estimate whose free run stays bounded, else the first one at all."""
    failures: list[GreyboxError] = []
    fallback: Estimate | None = None
    for alternative in alternatives:
        if fallback is not None and seconds_left() <= 0:
            notes.append(f"{alternative.label} was not tried: time ran out (--effort).")
            continue
        try:
            # the first one ends at any rate
            with without_limit() if fallback is None else nullcontext():
                estimate, diverged = _finished(alternative, logs, request, notes)
        except GreyboxError as error:
            _log.info("%s is left: %s", alternative.label, error)
            failures.append(error)
            notes.append(f"{alternative.label} was rejected: {error}")
            continue
        if not diverged:
            return estimate
        notes.append(f"{alternative.label} was rejected: its free run diverges.")
        fallback = fallback or estimate
    if fallback is None:
        raise failures[0]
    return _noting(
        fallback,
        "the free run of this model diverges on the estimation logs: do not simulate with it. "
        "Use a smaller structure or a longer, more exciting log.",
    )


def _finished(
    alternative: Alternative,
    logs: Sequence[TrialLog],
    request: Request,
    notes: Sequence[str],
    start: Estimate | None = None,
) -> tuple[Estimate, bool]:
    """Return an estimate with fit, verdict, bounds and notes, and whether its free run diverges."""
    estimate = estimate_once(
        logs, alternative.structure, alternative.method, alternative.kind, request, start
    )
    reason = f"{alternative.label} was chosen: {alternative.reason}." if alternative.reason else ""
    estimate, diverged = with_runs(estimate, logs, notes, reason)
    fit = estimate.fit
    if request.judged:
        found, trouble = limits_of(estimate, logs)
        lacking = (f"bounds: {trouble}",) if trouble else ()
        estimate = replace(
            estimate,
            verdict=weighed(estimate, diverged),
            limits=found,
            notes=(*estimate.notes, *lacking),
        )
    _log.info(
        "%s: %d iterations, fit %s%s", alternative.label, estimate.iterations,
        ", ".join(f"{k} {v:.1f} %" for k, v in fit.items()),
        f"; verdict: {estimate.verdict.text}" if request.judged else "",
    )  # fmt: skip
    return estimate, diverged


def _compass_unproven(log: TrialLog) -> bool:
    """Whether velocities were made of a heading of which no bias is stated or mended."""
    known = log.provenance
    mended = any(s.operation == "turn_heading" for s in known.steps)
    stated = "heading_bias" in log.vessel.sensors
    return known.velocities_derived and not mended and not stated


def with_runs(
    estimate: Estimate, logs: Sequence[TrialLog], notes: Sequence[str] = (), reason: str = ""
) -> tuple[Estimate, bool]:
    """Return an estimate with its free-run fit and notes on it, and whether a run diverges.

    Parameters
    ----------
    estimate : Estimate
    logs : sequence of TrialLog
    notes : sequence of str
        Those that stand before its own.
    reason : str
        Why it was taken, behind them.
    """
    model = estimate.model()
    runs = [run_model(model, log) for log in logs]
    own = [*estimate.notes, *([reason] if reason else [])]
    ended = ESTIMATORS[estimate.method].ended
    if ended:
        own.append(ended.format(status=estimate.status))
    if estimate.predictor.contaminated:
        own.append(
            f"{', '.join(estimate.predictor.contaminated)} also carry a second moment of the "
            f"current, which this structure cannot separate."
        )
    if estimate.current and any(_compass_unproven(log) for log in logs):
        own.append(
            "u and v were made of the heading, so no check can tell a bias of the compass: the "
            "intervals of the current allow for none (state a known one as heading_bias in "
            "[sensors])."
        )
    fit = average_fit(runs)
    diverged = any(r.diverged >= 0 for r in runs)
    poor = _poor(fit)
    if poor and not diverged:
        own.append(
            f"the free run of {', '.join(poor)} is worse than a constant on the very logs it "
            f"was estimated on: this model does not explain that motion."
        )
    own += [d.sentence for d in estimate.conditions.differences]
    return replace(estimate, notes=(*notes, *own), fit=fit), diverged


def weighed(estimate: Estimate, diverged: bool) -> Verdict:
    """Weigh the tests again, now with the loop and the free run."""
    return weigh(
        estimate.tests,
        estimate.labels,
        estimate.method,
        contaminated=estimate.predictor.contaminated,
        fit=estimate.fit,
        diverged=diverged,
    )
