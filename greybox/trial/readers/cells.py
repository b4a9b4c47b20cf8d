"""Conversion of cells to numbers, words and times; unreadable ones are counted."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.trial.readers.limits import limits
from greybox.trial.steps import Step
from greybox.trial.time_format import unpadded_text

NULLS = ["", "NaN", "nan", "NAN", "NA", "N/A", "n/a", "null", "NULL", "None", "none", "-", "--"]
NULLS += ["#N/A", "NaT"]
DAY = 86400.0

_NOTHING = {n.lower() for n in NULLS} | {"inf", "-inf", "+inf"}
# a dash is how people fill a cell of any row, also of a row of units
_BLANK = {"", "-", "--"}
_POINT = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eEdD][+-]?\d+)?")
_COMMA = re.compile(r"[+-]?(\d+,\d*|,\d+)([eEdD][+-]?\d+)?")
# points between thousands, before a decimal comma
_THOUSANDS = re.compile(r"[+-]?\d{1,3}(\.\d{3})+,\d+")
_DATE = re.compile(r"\d{4}([-/])\d\d\1\d\d[T ]\d\d:\d\d|\d\d\.\d\d\.\d{4}[T ]\d\d:\d\d")
# behind the seconds of a time of day
_FRACTION = r":\d\d[.,](\d+)"
_CLOCK = re.compile(r"\d\d?:\d\d:\d\d([.,]\d+)?(\s*[AaPp]\.?[Mm]\.?)?")
_HALF = r"\s*([AaPp])\.?[Mm]\.?$"
# 10.0 S, S10: an angle without a sign, and the side that it is to
_SIDE = r"(starboard|stbd|s|port|p)?"
_SIDED = re.compile(rf"{_SIDE}[ :]*(\d[\d.,]*|[.,]\d+)[ °]*(?:deg)?[ :]*{_SIDE}", re.IGNORECASE)
_RUDDER = re.compile("rud|helm|steer|wheel", re.IGNORECASE)
# RE2, on bytes
_GROUPED = r"^\s*[-+]?(\d{1,3}(\.\d{3})*|\d+)(,\d+)?\s*$"
_PLAIN = r"^-?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?$"
_MOST_DIGITS = 9
# wrong times of which the place is kept
_MOST_PLACES = 100


def is_blank(cell: str) -> bool:
    """Whether a cell of a first line says nothing."""
    return cell.strip() in _BLANK


def is_date(cell: str) -> bool:
    """Whether a cell is a date with a time of day that can be read in one way only."""
    return bool(_DATE.match(cell.strip()))


def is_clock(cell: str) -> bool:
    """Whether a cell is a time of day."""
    return bool(_CLOCK.fullmatch(cell.strip()))


def is_number(cell: str, *, comma: bool) -> bool:
    """Whether a cell is a number or stands for a missing one; `comma` allows 1,5."""
    bare = cell.strip()
    return (
        bool(_POINT.fullmatch(bare))
        or (comma and has_comma(bare))
        or (bare.lower() in _NOTHING and bool(bare))
    )


def has_comma(cell: str) -> bool:
    """Whether a cell is a number with a decimal comma."""
    bare = cell.strip()
    return bool(_COMMA.fullmatch(bare) or _THOUSANDS.fullmatch(bare))


def _to_starboard(cell: str) -> str | None:
    """Return an angle to a side as a number, negative to port; None where a cell is none."""
    found = _SIDED.fullmatch(cell.strip())
    if found is None or bool(found[1]) == bool(found[3]):
        return None
    return ("-" if (found[1] or found[3])[0] in "pP" else "") + found[2]


def sided(column: Any) -> Any:
    """Return a column of angles to a side as text of numbers, negative to port."""
    import pyarrow as pa

    return pa.array([_to_starboard(c) or c or None for c in text(column)], pa.string())


def kind(cells: Iterable[str], *, comma: bool, name: str = "") -> str:
    """Return what most cells of a column hold: number, date, clock, side or text."""
    filled = [c.strip() for c in cells]
    filled = [c for c in filled if c.lower() not in _NOTHING]
    for what, test in (("date", is_date), ("clock", is_clock)):
        if filled and sum(map(test, filled)) > 0.5 * len(filled):
            return what
    if filled and sum(is_number(c, comma=comma) for c in filled) < 0.5 * len(filled):
        sides = [s for s in map(_to_starboard, filled) if s]
        # S alone may be the south of a latitude
        known = bool(_RUDDER.search(name)) or any(s.startswith("-") for s in sides)
        return "side" if known and len(sides) > 0.5 * len(filled) else "text"
    return "number"


def grouped(column: Any) -> bool:
    """Whether a column of text holds points between thousands, and every cell fits that."""
    import pyarrow as pa
    from pyarrow import compute

    if not compute.any(compute.match_substring_regex(column, _THOUSANDS.pattern)).as_py():
        return False
    missing = compute.is_in(compute.ascii_lower(column), pa.array(sorted(_NOTHING)))
    fits = compute.or_(compute.match_substring_regex(column, _GROUPED), missing)
    return bool(compute.all(fits).as_py())


def numbers(column: Any, decimal: str, name: str, words: Counter[str]) -> NDArray[np.float64]:
    """Return a column of text as numbers, NaN where it holds words.

    Parameters
    ----------
    column : pyarrow.Array
        (n,) of strings, None where missing.
    decimal : str
        Decimal mark.
    name : str
        Column, for the count.
    words : Counter
        Receives how many cells hold words.

    Returns
    -------
    ndarray
        (n,)
    """
    import pyarrow as pa
    from pyarrow import compute

    if decimal == ",":
        column = compute.replace_substring(column, ",", ".")
    try:
        return _floats(column.cast(pa.float64()))
    except pa.ArrowInvalid:
        pass
    # RE2 refuses text with damaged characters: one such cell must not cost the others
    ascii_only = compute.all(compute.string_is_ascii(column), min_count=0).as_py()
    raw = column if ascii_only else pa.array([_ascii(w) for w in text(column)], pa.string())
    raw = compute.ascii_trim_whitespace(raw)
    raw = compute.replace_substring_regex(raw, r"^\+", "")
    raw = compute.replace_substring_regex(raw, r"^([-\d.]+),(\d*([eE][+-]?\d+)?)$", r"\1.\2")
    raw = compute.replace_substring_regex(raw, r"^(.*\d\.?)[dD]([+-]?\d+)$", r"\1E\2")
    plain = compute.match_substring_regex(raw, _PLAIN)
    missing = compute.is_in(compute.ascii_lower(raw), pa.array(sorted(_NOTHING)))
    lost = compute.and_not(compute.is_valid(raw), compute.or_(plain, missing))
    count = int(compute.sum(lost.cast(pa.int64())).as_py() or 0)
    if count:
        words[name] += count
    kept = compute.if_else(plain, raw, pa.scalar(None, pa.string()))
    return np.asarray(kept.cast(pa.float64()).to_numpy(zero_copy_only=False))


def _floats(column: Any) -> NDArray[np.float64]:
    """Return an array of doubles, (n,), NaN where missing; Arrow's own way loads pandas."""
    valid, data = column.buffers()
    n, first = len(column), column.offset
    values = np.frombuffer(data, np.float64, first + n)[first:].copy()
    if valid is not None:
        bits = np.frombuffer(valid, np.uint8, -(-(first + n) // 8))
        values[np.unpackbits(bits, bitorder="little")[first : first + n] == 0] = np.nan
    return values


def _ascii(cell: str) -> str | None:
    # the minus sign of typesetting, and blanks that are no ASCII
    return cell.replace("\u2212", "-").strip() or None


def text(column: Any) -> NDArray[Any]:
    """Return a column of text, or a dictionary of it, as str, (n,) object, long cells cut."""
    import pyarrow as pa
    from pyarrow import compute

    if pa.types.is_dictionary(column.type):
        words = [*text(column.dictionary), ""]
        at = compute.fill_null(column.indices.cast(pa.int64()), len(words) - 1).to_pylist()
        return np.array([words[k] for k in at], object)
    large = pa.types.is_large_string(column.type) or pa.types.is_large_binary(column.type)
    # NumPy gives every word of an array the room of the longest
    cut = compute.binary_slice(
        column.cast(pa.large_binary() if large else pa.binary()), 0, limits().text
    )
    raw = cut.to_pylist()
    return np.array(["" if c is None else c.decode("utf-8", "replace") for c in raw], object)


def dates(column: Any) -> NDArray[np.float64]:
    """Return dates as UNIX time [s], (n,); those without a zone are taken for UTC."""
    import pandas as pd
    import pyarrow as pa

    for zone in (None, "UTC"):
        try:
            stamps = column.cast(pa.timestamp("ns", zone))
            return unix_seconds(stamps)
        except pa.ArrowInvalid:
            continue
    words = pd.Series(text(column)).str.strip()
    words = words.str.replace(r"^(\d\d)\.(\d\d)\.(\d{4})", r"\3-\2-\1", regex=True)
    words = words.str.replace(r"^(\d{4})/(\d\d)/", r"\1-\2-", regex=True)
    words = words.str.replace(",", ".", regex=False)
    words, later = _without_halves(words)
    parsed = pd.to_datetime(words, utc=True, errors="coerce", format="ISO8601")
    ns = parsed.astype("datetime64[ns, UTC]").astype("int64").to_numpy().astype(float)
    return np.where(parsed.isna().to_numpy(), np.nan, ns * 1e-9 + later)


def unix_seconds(stamps: Any) -> NDArray[np.float64]:
    """Return time stamps of Arrow as UNIX time [s], (n,), NaN where missing."""
    import pyarrow as pa

    # whole seconds apart from the rest: UNIX nanoseconds do not fit a double
    ns = stamps.cast(pa.int64()).fill_null(np.iinfo(np.int64).min).to_numpy(zero_copy_only=False)
    seconds = ns // 1_000_000_000
    value = seconds + (ns - seconds * 1_000_000_000) * 1e-9
    return np.where(ns == np.iinfo(np.int64).min, np.nan, value)


class Stamps:
    """Times written as text, from one block to the next; short fractions are read as meant.

    Parameters
    ----------
    column, file : str
        Names of column and file.
    days : bool
        Whether they are times of day, which go on past midnight, and not dates.
    """

    def __init__(self, column: str, file: str, *, days: bool) -> None:
        self._source = f"column '{column}' of {file}"
        self._days = DayClock() if days else None
        self._width = 0
        self._count = 0
        self._first = ("", "")
        self._places: list[float] = []
        self._late: list[float] = []

    def seconds(self, column: Any) -> NDArray[np.float64]:
        """Return dates as UNIX time [s], times of day as seconds since the first midnight, (n,)."""
        value = dates(column) if self._days is None else times_of_day(column)
        value = self._as_meant(value, column)
        return value if self._days is None else self._days.past_midnight(value)

    @property
    def step(self) -> Step | None:
        """What was done to the times, None where nothing had to be."""
        if not self._count:
            return None
        written, meant = self._first
        return Step(
            "pad_fractions",
            ("t",),
            (self._source,),
            {
                "count": float(self._count),
                "written": written,
                "meant": meant,
                "times": tuple(self._places),
                "late": tuple(self._late),
            },
            decided_by="format",
        )

    def _as_meant(self, value: NDArray[np.float64], column: Any) -> NDArray[np.float64]:
        import pandas as pd
        from pyarrow import compute

        size = compute.min_max(compute.utf8_length(column))
        if not self._width and size["min"].as_py() == size["max"].as_py():
            return value
        words = pd.Series(text(column))
        part = words.str.extract(_FRACTION)[0].fillna("").astype(str)
        length = np.array([len(d) for d in part], np.int64)
        # nanoseconds are the finest that anybody writes
        length[length > _MOST_DIGITS] = 0
        self._width = max(self._width, int(length.max(initial=0)))
        digits = np.array([int(d) if 0 < len(d) <= _MOST_DIGITS else 0 for d in part], float)
        zero_ends = part.str.endswith("0").to_numpy(dtype=bool)
        found = unpadded_text(value, digits, length, zero_ends, self._width)
        if len(found):
            room = _MOST_PLACES - len(self._places)
            self._late += (value[found.rows] - found.times)[:room].tolist()
            self._places += found.times[:room].tolist()
            value = value.copy()
            value[found.rows] = found.times
            if not self._count:
                bare = part.iloc[int(found.rows[0])]
                self._first = (f".{bare}", f".{bare:0>{self._width}}")
            self._count += len(found)
        return value


def times_of_day(column: Any) -> NDArray[np.float64]:
    """Return times of day as seconds since midnight, (n,), NaN where there is none."""
    import pandas as pd

    words = pd.Series(text(column)).str.strip().str.replace(",", ".", regex=False)
    words, later = _without_halves(words)
    parts = words.str.extract(r"^(\d\d?):(\d\d):(\d\d(?:\.\d+)?)$").astype(float).to_numpy()
    value: NDArray[np.float64] = parts @ np.array([3600.0, 60.0, 1.0]) + later
    return value


def _without_halves(words: Any) -> tuple[Any, NDArray[np.float64]]:
    """Return times without AM or PM, and the seconds that these stand for, NaN beside 13 h."""
    half = words.str.extract(_HALF)[0].str.lower()
    if half.isna().all():
        return words, np.zeros(len(words))
    hour = words.str.extract(r"(\d\d?):\d\d")[0].astype(float)
    later = DAY / 2 * (1.0 * ((half == "p") & (hour < 12)) - ((half == "a") & (hour == 12)))
    wrong = half.notna() & ~hour.between(1, 12)
    return words.str.replace(_HALF, "", regex=True), later.mask(wrong).to_numpy(float)


class DayClock:
    """Times of day that go on past midnight, from one block to the next."""

    def __init__(self) -> None:
        self.day = 0
        self.last: float | None = None

    def past_midnight(self, value: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return seconds since midnight as seconds since the first midnight, (n,)."""
        good = np.flatnonzero(np.isfinite(value))
        if not len(good):
            return value
        before = value[good[0]] if self.last is None else self.last
        steps = np.diff(np.concatenate([[before], value[good]]))
        turns = (steps < -DAY / 2).astype(int) - (steps > DAY / 2).astype(int)
        days = self.day + np.cumsum(turns)
        self.day, self.last = int(days[-1]), float(value[good[-1]])
        value[good] += DAY * days
        return value
