"""One estimate: by a given method, predictor and structure."""

from __future__ import annotations

from collections.abc import Sequence

from greybox.estimation.informative import require_informative
from greybox.estimation.problem import EstimationProblem
from greybox.estimation.registry import ESTIMATORS
from greybox.estimation.result import Estimate
from greybox.model.predictor_kinds import PREDICTORS
from greybox.model.structure import Structure
from greybox.trial.log import TrialLog
from greybox.validation.request import Request

# what a problem takes from a request as it is
_ASKED = (
    "margins", "covariance", "heading", "loop", "zero_mean", "refine", "nominal", "output_error",
    "seed", "prefilter", "judged", "without",
)  # fmt: skip


def estimate_once(
    logs: Sequence[TrialLog],
    structure: Structure,
    method: str,
    kind: str,
    request: Request,
    start: Estimate | None = None,
) -> Estimate:
    """Estimate with one method and predictor; output error from `start` where it is given.

    Raises
    ------
    ExcitationError
        The logs cannot determine the parameters.
    LogError
        A channel is missing.
    UsageError
        There is no such method.
    """
    estimator, predictor = ESTIMATORS[method], PREDICTORS[kind]
    require_informative(logs, predictor)
    asked = {name: getattr(request, name) for name in _ASKED}
    return estimator.fit(EstimationProblem(tuple(logs), structure, predictor, start, **asked))
