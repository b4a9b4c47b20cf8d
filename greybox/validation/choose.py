"""Choosing method and predictor when the user does not, and saying why."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace

from greybox.errors import GreyboxError
from greybox.estimation.credibility import judge
from greybox.estimation.credibility.verdict import misfit
from greybox.estimation.limits import limits_of
from greybox.estimation.result import Estimate, Verdict
from greybox.regression.regression import common_sample_time
from greybox.trial.log import TrialLog
from greybox.validation.alternatives import Alternative, alternatives_for
from greybox.validation.fit import average_fit, run_model
from greybox.validation.once import estimate_once
from greybox.validation.request import Request, regression_only

_log = logging.getLogger(__name__)
_OPEN = Request()


def estimate_model(logs: Sequence[TrialLog], request: Request = _OPEN) -> Estimate:
    """Estimate a model, choosing what the request leaves open.

    Where the method is open and the tests speak against the estimate that theory or
    held-out runs prefer, output error is tried on the same predictor, and the one with
    the better verdict is kept.

    Parameters
    ----------
    logs : sequence of TrialLog
        One experiment each, of one vessel and sample time.
    request : Request

    Returns
    -------
    Estimate
        With its free-run fit on `logs` and notes on every choice.

    Raises
    ------
    ExcitationError
        No alternative can be estimated.
    LogError
        Logs differ in sample time, or lack a channel.
    """
    common_sample_time(logs)
    notes: list[str] = []
    alternatives = alternatives_for(logs, request, notes)
    _log.info("%d ways to estimate, first %s", len(alternatives), alternatives[0].label)
    _log.debug("in this order: %s", "; ".join(a.label for a in alternatives))
    estimate = _first_that_runs(logs, alternatives, request, notes)
    if request.method is None and request.judged and not _is_trusted(estimate):
        return _or_output_error(estimate, logs, request, notes)
    return estimate


def _is_trusted(estimate: Estimate) -> bool:
    return _rank(estimate)[0] == 0


def _rank(estimate: Estimate) -> tuple[int, int]:
    """Order estimates, the best first: trust, by the number excepted, do not trust.

    Of those not to be trusted, the one whose free run is worse than a constant in fewest states.
    """
    verdict = estimate.verdict
    if verdict.text.startswith("do not trust"):
        return 2, len(_poor(estimate.fit))
    return (1 if verdict.excepted else 0), len(verdict.excepted)


def _poor(fit: Mapping[str, float]) -> list[str]:
    """Return the states whose free run is worse than a constant."""
    return [s for s, v in fit.items() if v < 0]


def _or_output_error(
    found: Estimate, logs: Sequence[TrialLog], request: Request, notes: Sequence[str]
) -> Estimate:
    """Return output error on the same predictor where its verdict is better than `found`'s."""
    if regression_only(request) or (misfit(found.tests) and not _poor(found.fit)):
        # no other estimator mends what the structure lacks, but one may simulate
        return found
    before = f"{found.method} of this predictor alone is judged '{found.verdict.text}'"
    way = Alternative(found.predictor.structure, "oe", found.predictor.kind)
    try:
        tried, diverged = _finished(way, logs, request, notes)
    except GreyboxError as error:
        return _noting(found, f"output error was tried too, and failed: {error}")
    if diverged:
        return _noting(found, "output error was tried too, and its free run diverges.")
    if _rank(tried) < _rank(found):
        why = f"it is judged '{tried.verdict.text}' and {before}"
        if _rank(tried)[0] == 2:
            why = (
                f"its free run is better than a constant in more of the states, though neither "
                f"is to be trusted: {before}"
            )
        return _noting(tried, f"output error was taken, because {why}.")
    return _noting(
        found, f"output error was tried too, and is judged no better: '{tried.verdict.text}'."
    )


def _noting(estimate: Estimate, note: str) -> Estimate:
    return replace(estimate, notes=(*estimate.notes, note))


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
        try:
            estimate, diverged = _finished(alternative, logs, request, notes)
        except GreyboxError as error:
            _log.info("%s is left: %s", alternative.label, error)
            failures.append(error)
            notes.append(f"{alternative.label} was left: {error}")
            continue
        if not diverged:
            return estimate
        notes.append(f"{alternative.label} was left: its free run diverges.")
        fallback = fallback or estimate
    if fallback is None:
        raise failures[0]
    return _noting(
        fallback,
        "the free run of this model diverges on the estimation logs: do not simulate with it. "
        "Use a smaller structure or a longer, more exciting log.",
    )


def _finished(
    alternative: Alternative, logs: Sequence[TrialLog], request: Request, notes: Sequence[str]
) -> tuple[Estimate, bool]:
    """Return an estimate with fit, verdict, bounds and notes, and whether its free run diverges."""
    estimate = estimate_once(
        logs, alternative.structure, alternative.method, alternative.kind, request
    )
    model = estimate.model()
    runs = [run_model(model, log) for log in logs]
    own = list(estimate.notes)
    if alternative.reason:
        own.append(f"{alternative.label} was taken: {alternative.reason}.")
    if estimate.method == "iv":
        own.append(f"instruments: {estimate.status}.")
    elif estimate.method == "oe":
        own.append(f"the fit {estimate.status}.")
    if estimate.predictor.contaminated:
        own.append(
            f"{', '.join(estimate.predictor.contaminated)} also carry a second moment of the "
            f"current, which this structure cannot separate."
        )
    fit = average_fit(runs)
    diverged = any(r.diverged >= 0 for r in runs)
    poor = _poor(fit)
    if poor and not diverged:
        own.append(
            f"the free run of {', '.join(poor)} is worse than a constant on the very logs it "
            f"was estimated on: this model does not explain that motion."
        )
    estimate = replace(estimate, notes=(*notes, *own), fit=fit)
    if request.judged:
        found, trouble = limits_of(estimate, logs)
        lacking = (f"bounds: {trouble}",) if trouble else ()
        estimate = replace(
            estimate,
            verdict=_verdict(estimate, diverged),
            limits=found,
            notes=(*estimate.notes, *lacking),
        )
    _log.info(
        "%s: %d iterations, fit %s%s", alternative.label, estimate.iterations,
        ", ".join(f"{k} {v:.1f} %" for k, v in fit.items()),
        f"; verdict: {estimate.verdict.text}" if request.judged else "",
    )  # fmt: skip
    return estimate, diverged


def _verdict(estimate: Estimate, diverged: bool) -> Verdict:
    """Weigh the tests again, now with the loop and the free run."""
    return judge(
        estimate.tests,
        estimate.labels,
        estimate.method,
        contaminated=estimate.predictor.contaminated,
        fit=estimate.fit,
        diverged=diverged,
    )
