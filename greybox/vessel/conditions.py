"""Conditions under which a trial was run, and for which its model holds: draught, depth, sea."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from math import inf, isfinite
from typing import Any

from greybox.errors import GreyboxError, LogError, suggestion
from greybox.units import UNITS as LOG_UNITS
from greybox.units import unit_factor

Value = float | int | str
# field -> unit; words and codes have none
UNITS: dict[str, str] = {
    "draught": "m", "trim": "m", "loading": "", "water_depth": "m", "sea_state": "",
}  # fmt: skip
# greatest code of WMO table 3700
_PHENOMENAL = 9
_NUMBER = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(.*?)\s*")


@dataclass(frozen=True)
class Conditions:
    """What else than its thrusters decides how a ship moves; None where nothing is stated.

    Parameters
    ----------
    draught : float, optional
        Mean draught [m].
    trim : float, optional
        Draught aft minus draught forward [m], positive by the stern.
    loading : str, optional
        In words, such as ``ballast``.
    water_depth : float, optional
        From the surface to the bottom [m].
    sea_state : int, optional
        Code 0 to 9 of WMO table 3700: 0 calm, 3 slight, 4 moderate, 9 phenomenal.

    Raises
    ------
    LogError
        A value is none that the field can have.
    """

    draught: float | None = None
    trim: float | None = None
    loading: str | None = None
    water_depth: float | None = None
    sea_state: int | None = None

    def __post_init__(self) -> None:
        for name in ("draught", "trim", "water_depth"):
            value = getattr(self, name)
            if value is None:
                continue
            if not isfinite(value) or (value <= 0 and name != "trim"):
                least = "finite" if name == "trim" else "finite and positive"
                raise LogError(f"{words(name)} is {value:g} m, it must be {least}: correct it.")
        if self.sea_state is not None and not 0 <= self.sea_state <= _PHENOMENAL:
            raise LogError(
                f"sea state is {self.sea_state}, the codes of WMO table 3700 go from 0 (calm) to "
                f"{_PHENOMENAL} (phenomenal): correct it."
            )

    @classmethod
    def read(cls, values: Mapping[str, Any]) -> Conditions:
        """Return the conditions that some texts or numbers state.

        Parameters
        ----------
        values : mapping
            By field: SI numbers, or texts with or without a unit, such as ``120 cm``. Keys
            that are no field are passed over.

        Raises
        ------
        LogError
            A value cannot be read, or is none that the field can have.
        """
        found: dict[str, Any] = {
            n: _read(n, v) for n, v in values.items() if n in UNITS and v is not None
        }
        return cls(**found)

    @classmethod
    def recorded(cls, record: Mapping[str, Any]) -> Conditions:
        """Return the conditions that the record beside a log holds; malformed ones are left out.

        Records of versions that had no such fields hold them as free notes.
        """
        stated = record.get("conditions")
        if not isinstance(stated, dict):
            stated = record.get("notes")
        found = cls()
        for name, value in stated.items() if isinstance(stated, dict) else ():
            try:
                found = cls.read({name: value}).over(found)
            except GreyboxError:
                continue
        return found

    def over(self, default: Conditions) -> Conditions:
        """Return these conditions, with those of `default` where nothing is stated."""
        return Conditions(**(default.to_dict() | self.to_dict()))

    def __bool__(self) -> bool:
        return bool(self.to_dict())

    def to_dict(self) -> dict[str, Any]:
        """Return what is stated, SI."""
        return {
            f.name: getattr(self, f.name) for f in fields(self) if getattr(self, f.name) is not None
        }

    @property
    def sentence(self) -> str:
        """What is stated, in words."""
        return ", ".join(f"{words(n)} {spelled(n, v)}" for n, v in self.to_dict().items())


def words(name: str) -> str:
    """Return a field's name in words."""
    return name.replace("_", " ")


def spelled(name: str, value: Value) -> str:
    """Return a value of a field with its unit."""
    text = value if isinstance(value, str) else f"{value:g}"
    return f"{text} {UNITS[name]}".rstrip()


def _read(name: str, value: Any) -> Value:
    if name == "loading":
        if isinstance(value, str) and value.strip():
            return " ".join(value.split())
        raise LogError(f"loading is {value!r}, words are needed, such as 'ballast': correct it.")
    number, unit = _quantity(value)
    if name == "sea_state":
        if number is not None and not unit and number.is_integer():
            return int(number)
        raise LogError(
            f"sea state is {value!r}, a code of WMO table 3700 is needed, such as 3: correct it."
        )
    if number is None:
        raise LogError(
            f"{words(name)} is {value!r}, a length is needed, such as 1.2 or '120 cm': correct it."
        )
    try:
        return number * unit_factor(unit, UNITS[name], name) if unit else number
    except LogError:
        lengths = [w for u in LOG_UNITS.values() if u.si == "m" for w in (u.symbol, *u.spellings)]
        raise LogError(
            f"{words(name)} is {value!r}, and '{unit}' is no unit of length."
            f"{suggestion(unit, lengths)} Write metres, or a unit such as cm or ft."
        ) from None


def _quantity(value: Any) -> tuple[float | None, str]:
    """Return number and unit that a text or a number states, None where it states no number."""
    if isinstance(value, str):
        match = _NUMBER.fullmatch(value)
        return (float(match[1]), match[2]) if match else (None, "")
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None, ""
    try:
        return float(value), ""
    except OverflowError:
        # an integer of hundreds of digits
        return inf, ""
