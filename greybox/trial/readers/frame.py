"""A pandas DataFrame as a table, so that it is read like a file."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from greybox.errors import LogError
from greybox.trial.readers import cells
from greybox.trial.readers.parquet import column_kind, column_values
from greybox.trial.readers.table import Batch
from greybox.trial.steps import Step
from greybox.units import spelled_unit

if TYPE_CHECKING:
    import pandas as pd

_HEAD = 64


@dataclass
class FrameTable:
    """The columns of a DataFrame that hold numbers, times or words; ``path`` is its name."""

    path: Path
    columns: tuple[str, ...]
    arrays: Mapping[str, Any]
    kinds: Mapping[str, str]
    units: dict[str, str]
    text: frozenset[str]
    dates: frozenset[str]
    notes: list[str]
    clocks: frozenset[str] = frozenset()
    format: str = "DataFrame"
    first_row: int = 0
    steps: tuple[Step, ...] = ()

    @property
    def cells(self) -> int:
        """How many numbers the table holds."""
        return sum(map(len, self.arrays.values()))

    def batches(self, columns: Sequence[str]) -> Iterator[Batch]:
        """Yield the named columns, all at once."""
        yield {c: column_values(self.arrays[c], self.kinds[c]) for c in columns}


def open_frame(frame: pd.DataFrame, name: str, any_unit: Collection[str] = ()) -> FrameTable:
    """Return a DataFrame as a table.

    Parameters
    ----------
    frame : DataFrame
        Time in a column, or as the index: seconds, datetime64 or timedelta64. Units of
        columns in ``frame.attrs["units"]``, where they are stated.
    name : str
        By which messages call it.
    any_unit : collection of str
        Columns whose unit is kept as it is, also one that is not known.

    Raises
    ------
    LogError
        No DataFrame, none or several rows of names, names that stand twice, or no rows.
    """
    import pandas as pd
    import pyarrow as pa

    if not isinstance(frame, pd.DataFrame):
        raise LogError(
            f"'{name}' is a {type(frame).__name__}, a DataFrame is needed: name a file to "
            f"read_log, arrays to make_log, a Dataset to log_from_xarray."
        )
    if not len(frame):
        raise LogError(f"'{name}' has no rows: give a frame with samples.")
    series = _columns(frame, name)
    arrays: dict[str, Any] = {}
    kinds: dict[str, str] = {}
    dropped: list[str] = []
    units = _stated_units(frame, any_unit)
    for column, values in series.items():
        try:
            array = pa.array(values, from_pandas=True)
            if isinstance(array, pa.ChunkedArray):
                array = array.combine_chunks()
        except (pa.ArrowInvalid, pa.ArrowTypeError, pa.ArrowNotImplementedError):
            array = None
        kind = None if array is None else column_kind(array.type)
        if array is None or kind is None:
            dropped.append(column)
            continue
        if kind == "text" and cells.kind(cells.text(array[:_HEAD]).tolist(), comma=False) == "date":
            kind = "parsed"
        if kind == "duration":
            units[column] = "s"
        arrays[column], kinds[column] = array, "number" if kind == "duration" else kind
    notes = [f"column '{n}' is neither number, time nor text: left out" for n in dropped]
    text = frozenset(n for n, k in kinds.items() if k == "text")
    dates = frozenset(n for n, k in kinds.items() if k in ("date", "parsed"))
    return FrameTable(Path(name), tuple(arrays), arrays, kinds, units, text, dates, notes)


def _columns(frame: pd.DataFrame, name: str) -> dict[str, Any]:
    """Return the columns by name, with the index where it is a time."""
    import pandas as pd

    if frame.columns.nlevels > 1 or frame.index.nlevels > 1:
        raise LogError(
            f"'{name}' has {frame.columns.nlevels} rows of names and {frame.index.nlevels} of "
            f"index, one of each is needed: choose one with frame.xs(), or join the names."
        )
    names = [str(c) for c in frame.columns]
    twice = next((n for n in names if names.count(n) > 1), None)
    if twice is not None:
        raise LogError(
            f"'{name}' has {names.count(twice)} columns called '{twice}': give each a name."
        )
    found: dict[str, Any] = {n: frame.iloc[:, k] for k, n in enumerate(names)}
    index = frame.index
    label = "t" if index.name is None else str(index.name)
    # an index of row numbers is no time
    timed = isinstance(index, pd.DatetimeIndex | pd.TimedeltaIndex) or index.name is not None
    return {label: index.to_series()} | found if timed and label not in found else found


def _stated_units(frame: pd.DataFrame, any_unit: Collection[str]) -> dict[str, str]:
    stated = frame.attrs.get("units")
    if not isinstance(stated, Mapping):
        return {}
    found = {str(n): (spelled_unit(str(u)), str(u)) for n, u in stated.items() if u}
    return {n: known or said for n, (known, said) in found.items() if known or n not in any_unit}
