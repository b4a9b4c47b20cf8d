"""The request for an estimate; the data choose what is left open."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

from greybox.errors import UsageError, suggestion
from greybox.estimation.closed_loop import Loop
from greybox.estimation.covariance import Covariance
from greybox.estimation.problem import EstimationOptions
from greybox.estimation.registry import ESTIMATORS
from greybox.model.predictor_kinds import PREDICTORS
from greybox.numerics.effort import EFFORT
from greybox.trial.log import TrialLog

# methods that are another one with a prefilter
_PREFILTERED: Mapping[str, tuple[str, Literal["noise"]]] = {"refined-iv": ("iv", "noise")}


def _choices() -> dict[str, tuple[str, ...]]:
    """Return what each field may be, estimators as they are registered now."""
    return {
        "method": (*ESTIMATORS, *_PREFILTERED),
        "predictor": tuple(PREDICTORS),
        "covariance": get_args(Covariance),
        "heading": ("measured", "simulated"),
        "loop": get_args(Loop),
        "prefilter": ("auto", "noise", "none"),
    }


@dataclass(frozen=True)
class Request(EstimationOptions):
    """The options of an estimate; None leaves a choice to the data.

    Parameters
    ----------
    method : {"ls", "iv", "refined-iv", "oe"}, optional
    predictor : {"basic", "augmented", "wind", "basic+wind"}, optional
    structure : str, optional
        As `get_structure`.
    margins, covariance, heading, loop, zero_mean, refine, nominal
        As `estimate_model`.
    output_error, seed, prefilter, judged, without
        As `estimate_model`.
    validate : tuple of TrialLog
        Logs that judge the prediction and take no part in the estimate.
    effort : float
        Seconds that the choice of what is left open may take.

    Raises
    ------
    UsageError
        A value is none of those that can be chosen, or two contradict each other.
    """

    method: str | None = None
    predictor: str | None = None
    structure: str | None = None
    validate: tuple[TrialLog, ...] = ()
    effort: float = EFFORT

    def __post_init__(self) -> None:
        for name, choices in _choices().items():
            value = getattr(self, name)
            if value is not None and value not in choices:
                raise UsageError(
                    f"'{value}' is no {name}.{suggestion(str(value), choices)} It is one of "
                    f"{', '.join(choices)}."
                )
        if not self.effort > 0:
            raise UsageError(
                f"effort is {self.effort:g} s and must be positive: give the seconds that a "
                f"choice may take."
            )
        if self.method is not None and self.method in _PREFILTERED:
            method, prefilter = _PREFILTERED[self.method]
            if self.prefilter == "none":
                raise UsageError(
                    f"method '{self.method}' refines by the noise and prefilter 'none' does not: "
                    f"use method '{method}' for plain instrumental variables."
                )
            object.__setattr__(self, "method", method)
            object.__setattr__(self, "prefilter", prefilter)


def regression_only(request: Request) -> bool:
    """Whether the request holds what only an estimate from one-step equations can heed."""
    return bool(request.margins) or request.prefilter == "noise" or not request.zero_mean
