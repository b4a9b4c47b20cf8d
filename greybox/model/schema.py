"""The tables of a model file as a schema, and what is said of a file that does not keep it."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from greybox.errors import ModelFileError

Number = Annotated[float, Field(allow_inf_nan=False)]
# what is not known is null
Numbers = list[float | None]

_EXPECTED = {
    "missing": "", "float_type": "a number", "finite_number": "a finite number",
    "string_type": "a word", "bool_type": "true or false", "list_type": "a list",
    "dict_type": "a table", "model_type": "a table", "too_short": "a list that is not empty",
}  # fmt: skip
_LONGEST = 40


class _Table(BaseModel):
    # a file may hold more than this program reads
    model_config = ConfigDict(extra="ignore", strict=True)


class TermTable(_Table):
    """One term of an equation."""

    name: str
    state: str
    factors: list[str]


class StructureTable(_Table):
    """Terms of the equations."""

    name: str
    reference: str = ""
    states: Annotated[list[str], Field(min_length=1)]
    inputs: list[str]
    disturbance: str
    increment: bool
    terms: Annotated[list[TermTable], Field(min_length=1)]


class MeanTable(_Table):
    """A mean of a disturbance."""

    value: Number
    std: Number | None


class NoiseTable(_Table):
    """Levels of the noises."""

    measurement: dict[str, Number]
    process: dict[str, Number]
    heading: Number
    wind: Number
    source: str
    memory: dict[str, Number] = {}


class CalibrationTable(_Table):
    """How far bands reach."""

    factor: dict[str, Number]
    misfit: dict[str, Annotated[list[Number], Field(min_length=2, max_length=2)]]
    runs: int
    kinds: list[str]


class ModelTable(_Table):
    """A model file of this version."""

    sample_time: float
    integrator: str
    structure: StructureTable
    theta: Numbers
    covariance: list[Numbers]
    disturbances: dict[str, MeanTable]
    disturbance_covariance: list[Numbers]
    residual_std: dict[str, float | None]
    noise: NoiseTable | None
    sums: dict[str, list[str]]
    vessel: dict[str, Any]
    calibration: CalibrationTable | None = None


def require_tables(data: Any, source: str) -> None:
    """Refuse the tables of a model file that lack an entry, or hold another kind of value.

    Raises
    ------
    ModelFileError
        Names the entry.
    """
    try:
        ModelTable.model_validate(data)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        # a list of what may be given stands behind the entry itself
        place = ".".join(str(part) for part in first["loc"])
        expected = _EXPECTED.get(first["type"], "another value")
        shown = repr(first["input"])
        shown = shown if len(shown) <= _LONGEST else f"{shown[:_LONGEST]}…"
        what = f"is {shown}, where {expected} is needed" if expected else "is missing"
        raise ModelFileError(
            f"'{source}' is a damaged model file: its entry '{place}' {what}. Estimate the model "
            f"again."
        ) from None
