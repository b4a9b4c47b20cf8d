"""The verdict on an estimate's predictions, by logs that are left out of it in turn."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from greybox.errors import GreyboxError, OutOfTimeError, UsageError
from greybox.estimation.prediction_verdict import (
    TOO_SHORT,
    JudgedOn,
    NothingHeldOut,
    NotRefitted,
)
from greybox.estimation.registry import ESTIMATORS
from greybox.estimation.result import Estimate
from greybox.estimation.verdict import Divergence, Reason
from greybox.model.model import ManoeuvringModel
from greybox.selection.alternatives import ranking_request
from greybox.selection.cross_validation import (
    EstimatorVariant,
    Refit,
    estimate_variant,
    kinds_left_out,
    parts_of,
    stretches_of,
)
from greybox.selection.request import Request
from greybox.trial.kinematics import decimate_segments
from greybox.trial.log import TrialLog
from greybox.trial.segments import as_segments
from greybox.trial.validity import extrapolation_note
from greybox.validation.calibration import calibrate_bands, run_errors
from greybox.validation.held_commands import held_commands_diverge
from greybox.validation.judge_prediction import HeldOut, judge_prediction

_log = logging.getLogger(__name__)

# samples from which on plain instruments predict as well as those refined by the noise
_MANY = 10_000


def with_prediction(
    estimate: Estimate, logs: Sequence[TrialLog], request: Request, refit: Refit | None = None
) -> Estimate:
    """Return an estimate with the verdict on its prediction of held-out logs.

    Parameters
    ----------
    estimate : Estimate
    logs : sequence of TrialLog
        Those it was estimated on. A stretch of each is left out in turn and tells what the free
        run is good for; kinds of manoeuvre, or logs, are left out too, and calibrate the bands.
    request : Request
        Its ``validate`` logs judge instead, where there are some; the logs left out in turn
        then calibrate the bands alone.
    refit : Refit, optional
        Whatever the data chose must be chosen again in it. By default the same structure,
        predictor and method.

    Raises
    ------
    UsageError
        A log that validates is one of those of the estimate.
    """
    model = estimate.model()
    told: list[Reason] = []
    if any(v == -np.inf for v in estimate.fit.values()):
        told.append(Divergence())
    if request.validate:
        require_others(logs, request.validate)
    failed: list[str] = []
    logs = as_read(logs, estimate)
    runs_away = held_commands_diverge(model, logs) if not told else None
    told += [runs_away] if runs_away else []
    again = refit or refit_alike(estimate, request)
    held: list[HeldOut] = []
    parts = 0
    if not request.validate:
        held, parts = _left_out(stretches_of, logs, again, failed)
    lost: list[str] = []
    elsewhere, groups = _left_out(parts_of, logs, again, lost)
    if not held and not request.validate:
        # logs too short for parts are left out whole
        held, parts, failed = elsewhere, groups, lost or failed
    errors = [run_errors(h.model, h.run, request.seed) for h in elsewhere]
    kinds = kinds_left_out(logs)
    calibration = calibrate_bands(
        [e for e in errors if e is not None], model.structure.states, kinds
    )
    estimate = replace(estimate, calibration=calibration)
    if request.validate:
        model = replace(model, calibration=calibration)
        others = as_read(as_segments(request.validate), estimate)
        runs = [HeldOut.of(model, log) for log in others]
        verdict = judge_prediction(runs, JudgedOn.VALIDATION, found=told, seed=request.seed)
        said = extrapolation_note(estimate.data.ranges, request.validate)
        notes = dict.fromkeys([*estimate.notes, *([said] if said else [])])
        return replace(estimate, prediction=verdict, notes=tuple(notes))
    if not held:
        runs = [HeldOut.of(model, log) for log in logs]
        told.append(NothingHeldOut(failed[0]))
        verdict = judge_prediction(runs, JudgedOn.OWN, found=told, seed=request.seed)
        return replace(estimate, prediction=verdict)
    if failed:
        told.append(NotRefitted(len(failed), parts, failed[0], TOO_SHORT not in failed))
    verdict = judge_prediction(
        held,
        parts=parts - len(failed),
        found=told,
        own=[HeldOut.of(model, log) for log in logs],
        elsewhere=elsewhere,
        kinds=kinds,
        seed=request.seed,
        errors=errors,
    )
    _log.info("prediction: %s", verdict.text)
    return replace(estimate, prediction=verdict)


def _left_out(
    parting: Callable[[Sequence[TrialLog]], Sequence[tuple[list[TrialLog], list[TrialLog]]]],
    logs: Sequence[TrialLog],
    again: Refit,
    failed: list[str],
) -> tuple[list[HeldOut], int]:
    """Return runs over parts of the logs without which a model was estimated, and their number.

    `failed` is told why a part is missing.
    """
    held: list[HeldOut] = []
    try:
        parts = parting(logs)
    except UsageError as error:
        failed.append(str(error))
        return held, 0
    Refit.ahead([again], [fitting for fitting, _ in parts])
    for k, (fitting, left_out) in enumerate(parts):
        try:
            other = again(fitting)
        except GreyboxError as error:
            _log.info("without a part there is no estimate: %s", error)
            failed.append(TOO_SHORT if isinstance(error, OutOfTimeError) else str(error))
            continue
        held += [HeldOut.of(other, log, k) for log in left_out]
    return held, len(parts)


def as_read(logs: Sequence[TrialLog], estimate: Estimate) -> Sequence[TrialLog]:
    """Return logs as an estimate reads them: at its sample time, with its vessel.

    The data may have chosen both: a step, and a thrust law.
    """
    own = [log if log.vessel == estimate.vessel else replace(log, vessel=estimate.vessel)
           for log in logs]  # fmt: skip
    if abs(own[0].sample_time - estimate.sample_time) < 1e-6 * estimate.sample_time:
        return own
    return decimate_segments(own, estimate.sample_time)[0]


def require_others(logs: Sequence[TrialLog], validate: Sequence[TrialLog]) -> None:
    """Refuse samples that are to be estimated on and to validate the estimate.

    Parts of one log that share no time may do either.

    Raises
    ------
    UsageError
        Names it.
    """
    for log in validate:
        for own in logs:
            same = own.provenance.sha256 == log.provenance.sha256 != ""
            if same and own.t[0] <= log.t[-1] and log.t[0] <= own.t[-1]:
                raise part_of_estimate(log)
            if _alike(log, own):
                raise UsageError(
                    f"'{log.name}' holds the same samples as '{own.name}', and a log that the "
                    f"estimate used cannot judge it: name another to validate."
                )


def part_of_estimate(log: TrialLog) -> UsageError:
    """Return the error that a log validates an estimate which it is part of."""
    return UsageError(
        f"'{log.name}' is given both to estimate on and to validate: a log that the estimate used "
        f"cannot judge it. Name it once."
    )


def _alike(log: TrialLog, other: TrialLog) -> bool:
    """Whether two logs hold the same samples."""
    return (
        np.array_equal(log.t, other.t)
        and log.channels.keys() == other.channels.keys()
        and all(np.array_equal(log[c], other[c]) for c in log.channels)
    )


def require_distinct(logs: Sequence[TrialLog]) -> None:
    """Refuse logs of equal samples, since copies would count as further, independent trials.

    Raises
    ------
    UsageError
        Names two of them.
    """
    for i, log in enumerate(logs):
        for other in logs[:i]:
            if _alike(log, other):
                raise UsageError(
                    f"'{other.name}' and '{log.name}' hold the same {len(log)} samples, which "
                    f"would count as two trials: name each trial once."
                )


def refit_alike(estimate: Estimate, request: Request) -> Refit:
    """Return how to estimate the model of an estimate on fewer logs, from where it ended.

    Standard errors and noise are those of the estimate, the former as fewer samples leave them.
    """
    few = sum(x["samples"] for x in estimate.logs) < _MANY
    quick = ranking_request(request)
    quick = replace(
        quick,
        output_error=replace(quick.output_error, search=False, levels=False, process_noise=False),
        prefilter=request.prefilter if estimate.prefilter == "noise" and few else "none",
        # a free run starts from the estimate itself, which has its current too
        nominal=None if ESTIMATORS[estimate.method].free_run else estimate.model(),
    )
    variant = EstimatorVariant(estimate.method, request.output_error.weights)
    whole = estimate.model()

    def refit(logs: Sequence[TrialLog]) -> ManoeuvringModel:
        model = estimate_variant(variant, logs, estimate, quick, estimate).model()
        if model.names != whole.names:
            return model
        more = sum(x["samples"] for x in estimate.logs) / sum(map(len, logs))
        return replace(model, covariance=more * whole.covariance, noise=whole.noise)

    return Refit(refit)
