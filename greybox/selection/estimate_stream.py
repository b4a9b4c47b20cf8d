"""An estimate from logs larger than memory: sums over all samples, tests on selected stretches."""

from __future__ import annotations

import logging
from dataclasses import dataclass, fields, replace
from typing import Any

from greybox.credibility.assess import assess
from greybox.credibility.judge import convergence, evidence_of
from greybox.errors import UsageError, so_many
from greybox.estimation.closed_loop import CLOSED_LOOP_LAG
from greybox.estimation.problem import EstimationOptions, EstimationProblem, Fitted
from greybox.estimation.refined import add_noise
from greybox.estimation.registry import ESTIMATORS
from greybox.estimation.result import Estimate
from greybox.estimation.streamed import Streamed, estimate_sums
from greybox.model.predictor import Predictor
from greybox.model.predictor_kinds import PREDICTORS
from greybox.numerics.effort import within
from greybox.numerics.threads import one_thread
from greybox.regression.problem import RegressionProblem, RegressionSettings
from greybox.selection.estimate import estimate_requested, weighed, with_runs
from greybox.selection.prediction import refit_alike, with_prediction
from greybox.selection.request import Request
from greybox.selection.stretches import Drawn

_log = logging.getLogger(__name__)

# estimators whose sums add over segments; the first is taken where none is named
_ADDING = ("iv", "ls")
# what an estimate with its tests holds in memory for each sample: 7 kB were measured for one log,
# 17 kB for twenty
BYTES = 16_384


@dataclass(frozen=True)
class StreamEstimate:
    """An estimate from a stream.

    Parameters
    ----------
    estimate : Estimate
    drawn : Drawn
        The stretches that its tests rest on.
    streamed : Streamed
        What its passes saw.
    """

    estimate: Estimate
    drawn: Drawn
    streamed: Streamed

    def to_dict(self) -> dict[str, Any]:
        """Return for JSON what was read, and what rests on a part of it."""
        stream = self.streamed.sums.stream
        return {
            "files": len(stream.parts),
            "rows": stream.rows,
            "passes": self.streamed.passes,
            "segments_without_bounded_simulation": list(self.streamed.sums.lost),
            "left_out": list(stream.left_out),
            "drawn": self.drawn.to_dict(["predictor", "noise", "tests", "prediction", "fit"]),
        }


def require_adding(request: Request) -> None:
    """Refuse options that need all samples in memory at once.

    Raises
    ------
    UsageError
        Names the option.
    """
    asked = ""
    if request.method not in (None, *_ADDING):
        asked = f"--method {request.method}"
    elif request.prefilter == "noise":
        asked = "--prefilter noise"
    elif request.covariance not in (None, "cluster"):
        asked = f"--covariance {request.covariance}"
    if asked:
        raise UsageError(
            f"{asked} needs all samples in memory at once, and these logs are read in passes: "
            f"give it more --memory or fewer logs, or use --method {' or '.join(_ADDING)} with "
            f"--covariance cluster."
        )


@one_thread()
def estimate_stream(
    drawn: Drawn, request: Request, first: Estimate | None = None
) -> StreamEstimate:
    """Estimate a model from a stream, choosing on its stretches what is left open.

    Parameters
    ----------
    drawn : Drawn
        Of the stream.
    request : Request
        Instrumental variables where it names no method.
    first : Estimate, optional
        An estimate on the stretches whose predictor is taken.

    Returns
    -------
    StreamEstimate

    Raises
    ------
    ExcitationError
        The samples do not determine some direction; its parameters are named.
    LogError
        No file can be read any more.
    UsageError
        The request asks for what needs all samples at a time.
    """
    require_adding(request)
    logs = list(drawn.logs)
    drawn.require_others(request.validate)
    notes: list[str] = []
    if request.method is None:
        notes.append(
            f"{ESTIMATORS[_ADDING[0]].words} were chosen: of the methods whose sums add over a "
            f"stream, noise in the regressors does not bias them."
        )
    request = replace(request, method=request.method or _ADDING[0], prefilter="none")
    if first is None:
        quick = replace(request, judged=False, covariance="white", validate=())
        first = estimate_requested(logs, quick)
    kind = PREDICTORS[first.predictor.kind]
    asked = {f.name: getattr(request, f.name) for f in fields(EstimationOptions)}
    problem = EstimationProblem(tuple(logs), first.predictor.structure, kind, **asked)
    instruments = ESTIMATORS[request.method or ""].instruments
    closed, loop_test = problem.loop_test(request.method or "")
    settings = RegressionSettings(
        first.predictor,
        margins=request.margins,
        zero_mean=request.zero_mean and instruments,
        heading=request.heading,
        wind=problem.instrument_wind,
        lag=CLOSED_LOOP_LAG if closed and instruments else 0,
    )
    start = first.structure_theta() if instruments else None

    def fit(predictor: Predictor) -> Streamed:
        own = replace(settings, predictor=predictor)
        return estimate_sums(own, drawn.stream, drawn.data, start, request.refine)

    streamed, dropped = problem.drop_unexcited(first.predictor, fit)
    estimate = streamed.estimate
    regression = replace(settings, predictor=estimate.predictor).on(logs)
    # how the estimate on the stretches ended says nothing of this one
    ended = ESTIMATORS[first.method].ended.format(status=first.status)
    notes += [*(n for n in first.notes if n != ended), *dropped, drawn.sentence]
    if streamed.sums.lost:
        notes.append(
            so_many(len(streamed.sums.lost), "segment", "takes", "take")
            + f" no part, since {streamed.sums.lost[0]}."
        )
    estimate, diverged = with_runs(estimate, logs, notes)
    if request.judged:
        estimate = _judged(add_noise(regression, estimate), streamed, regression)
        estimate = replace(estimate, tests=(*estimate.tests, loop_test))
        estimate = replace(estimate, verdict=weighed(estimate, diverged))
        with within(request.effort):
            estimate = with_prediction(estimate, logs, request, refit_alike(estimate, request))
    told = (*streamed.sums.stream.left_out, *estimate.notes)
    return StreamEstimate(replace(estimate, notes=told), drawn, streamed)


def _judged(estimate: Estimate, streamed: Streamed, regression: RegressionProblem) -> Estimate:
    """Return an estimate with its tests on the stretches, which know what all samples tell."""
    information = [s.information for s in streamed.solutions]
    evidence = evidence_of(Fitted(estimate, regression), information)
    return replace(estimate, tests=(*assess(evidence), *convergence(estimate)))
