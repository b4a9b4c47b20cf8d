"""What a user asks of an estimate; what is left open the data choose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

from greybox.errors import UsageError, suggestion
from greybox.estimation.closed_loop import Loop
from greybox.estimation.output_error import OutputErrorOptions
from greybox.estimation.registry import ESTIMATORS
from greybox.estimation.solve import Covariance
from greybox.model.model import ManoeuvringModel
from greybox.model.predictor_kinds import PREDICTORS

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
class Request:
    """What to estimate; None leaves the choice to the data.

    Parameters
    ----------
    method : {"ls", "iv", "refined-iv", "oe"}, optional
    predictor : {"basic", "augmented", "wind", "basic+wind"}, optional
    structure : str, optional
        As `get_structure`.
    margins : mapping of str to float, optional
        |u|, |v| [m/s] below which samples are cut out.
    covariance : {"ma", "hac", "white", "bootstrap"}, optional
    heading : {"measured", "simulated"}
        Heading inside the instruments.
    loop : {"auto", "open", "closed"}
        Whether a controller moved the thrusters.
    zero_mean : bool
        Whether instruments lose their mean (4.63).
    refine : bool or int
        Whether, or how many times at most, instruments are simulated again.
    nominal : ManoeuvringModel, optional
        Simulates the first instruments, or starts output error; least squares does
        without it.
    output_error : OutputErrorOptions
        What only ``oe`` heeds.
    seed : int
    prefilter : {"auto", "noise", "none"}
        ``noise`` for refined instrumental variables, ``none`` for plain ones.
    judged : bool
        Whether tests and verdict are asked for.
    without : tuple of str
        Bias-capturing columns to leave out, spelled ``state:function``.

    Raises
    ------
    UsageError
        A value is none of those that can be chosen, or two contradict each other.
    """

    method: str | None = None
    predictor: str | None = None
    structure: str | None = None
    margins: dict[str, float] | None = None
    covariance: Covariance | None = None
    heading: Literal["measured", "simulated"] = "measured"
    loop: Loop = "auto"
    zero_mean: bool = True
    refine: bool | int = True
    nominal: ManoeuvringModel | None = None
    output_error: OutputErrorOptions = field(default_factory=OutputErrorOptions)
    seed: int = 0
    prefilter: Literal["auto", "noise", "none"] = "auto"
    judged: bool = True
    without: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name, choices in _choices().items():
            value = getattr(self, name)
            if value is not None and value not in choices:
                raise UsageError(
                    f"'{value}' is no {name}.{suggestion(str(value), choices)} It is one of "
                    f"{', '.join(choices)}."
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
    return (
        bool(request.margins)
        or request.covariance == "bootstrap"
        or request.prefilter == "noise"
        or not request.zero_mean
    )
