"""Kinds of predictors: which disturbances are measured, captured by regressors, or neither."""

from __future__ import annotations

from dataclasses import dataclass

from greybox.errors import StructureError
from greybox.registry import Registry


@dataclass(frozen=True)
class PredictorKind:
    """How a predictor treats current and wind.

    Parameters
    ----------
    name : str
        As ``--predictor`` takes it.
    air_measured : bool
        Whether the velocity through the air is a measured regressor.
    captures : bool
        Whether bias-capturing regressors stand for what is not measured.
    plain : str
        The kind that measures the same and captures nothing.
    """

    name: str
    air_measured: bool
    captures: bool
    plain: str


PREDICTORS: Registry[PredictorKind] = Registry(
    "predictor",
    PredictorKind("basic", False, False, "basic"),
    PredictorKind("augmented", False, True, "basic"),
    PredictorKind("wind", True, True, "basic+wind"),
    PredictorKind("basic+wind", True, False, "basic+wind"),
    error=StructureError,
)
