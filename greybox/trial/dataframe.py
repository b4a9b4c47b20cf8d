"""Logs from pandas and xarray, by the same reader as files.

A frame that `TrialLog.to_pandas` made says so in its ``attrs`` and is canonical: it comes
back as the same log. Any other is read as a file with its columns would be.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from greybox.errors import LogError
from greybox.trial.convert.channel_mapping import canonical, table_recording
from greybox.trial.convert.read import table_segments
from greybox.trial.log import FRAME_KEY, RECORD_FORMAT, Provenance, TrialLog, require_xarray
from greybox.trial.raw_log import Recording
from greybox.trial.readers import cells
from greybox.trial.readers.parquet import column_kind, column_values
from greybox.trial.readers.table import Batch
from greybox.trial.steps import Step
from greybox.trial.store import recorded_provenance
from greybox.units import spelled_unit
from greybox.vessel.vessel import Vessel

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

# a frame that was thinned out has another sample time than it says
_SAME = 1e-6
# values of a column of texts by which it is told whether they are dates
_HEAD = 64


def log_from_pandas(
    frame: pd.DataFrame,
    vessel: Vessel,
    *,
    name: str = "frame",
    states: tuple[str, ...] = (),
    fill: Mapping[str, float] | None = None,
) -> TrialLog:
    """Return the log that a DataFrame holds.

    Parameters
    ----------
    frame : DataFrame
        One row a sample. Columns by canonical names, thruster columns, or the names in
        the vessel's ``[columns]``. Time as column ``t`` or the one mapped to it, or as
        the index: seconds, datetime64 or timedelta64. Units in ``frame.attrs["units"]``
        are believed.
    vessel : Vessel
    name : str
        Of the log; one that was a log before keeps its own.
    states, fill
        As `read_log`.

    Returns
    -------
    TrialLog
        As `read_log` gives of a file with these columns.

    Raises
    ------
    LogError
        As `read_log`, and where the frame is none or has no time.
    """
    record = _recorded(frame.attrs.get(FRAME_KEY) if hasattr(frame, "attrs") else None)
    own = vessel
    known = Provenance(name)
    if record:
        # it is canonical, and without the sensors' defects
        own = replace(vessel, columns={}, sensors={})
        known, name = recorded_provenance(record), str(record.get("name", name))
    table = open_frame(frame, name, vessel.recorded_columns)
    if not any(n == "t" or ((m := own.columns.get(n)) and m.name == "t") for n in table.columns):
        raise LogError(
            f"'{name}' has no time: neither a column 't' nor an index of seconds or dates. "
            f"Name one with frame.set_index('…').rename_axis('t'), or map it in [columns]. "
            f"Its columns: {', '.join(table.columns[:30])}."
        )
    segments = table_segments(table, own, known, states=states, fill=fill)
    if len(segments) > 1:
        raise LogError(
            f"'{name}' has {len(segments) - 1} gaps in its time, and one run cannot cross them: "
            f"cut the frame at them, with frame.loc[start:stop]."
        )
    stated = record.get("sample_time")
    log = segments[0]
    order = [c for c in table.columns if c in log] if record else list(log.channels)
    log = replace(log, name=name, vessel=vessel, channels={n: log[n] for n in order})
    if isinstance(stated, float) and abs(stated - log.sample_time) <= _SAME * stated:
        log = replace(log, sample_time=stated)
    return log


def log_from_xarray(
    dataset: xr.Dataset,
    vessel: Vessel,
    *,
    name: str = "dataset",
    states: tuple[str, ...] = (),
    fill: Mapping[str, float] | None = None,
) -> TrialLog:
    """Return the log that a Dataset over one dimension, its time, holds.

    Parameters
    ----------
    dataset : Dataset
        One variable a channel, each (N,) over the time; units in their ``units``
        attributes are believed.
    vessel : Vessel
    name : str
        Of the log; one that was a log before keeps its own.
    states, fill
        As `read_log`.

    Returns
    -------
    TrialLog
        As `log_from_pandas` gives of the same columns.

    Raises
    ------
    LogError
        As `log_from_pandas`, and where it is no Dataset, or has not one dimension.
    UsageError
        xarray is not installed.
    """
    xarray = require_xarray()
    if not isinstance(dataset, xarray.Dataset):
        raise LogError(
            f"'{name}' is a {type(dataset).__name__}, a Dataset is needed: use log_from_pandas "
            f"for a DataFrame, DataArray.to_dataset(dim=…) for a DataArray."
        )
    if len(dataset.dims) != 1:
        sizes = ", ".join(f"{k} {n}" for k, n in dataset.sizes.items()) or "none"
        raise LogError(
            f"'{name}' has {len(dataset.dims)} dimensions ({sizes}), a log has time alone: choose "
            f"one trial with dataset.sel(…) or isel(…)."
        )
    dimension = next(iter(dataset.dims))
    import pandas as pd

    columns = {n: v for n, v in dataset.variables.items() if v.dims and n != dimension}
    index = dataset.indexes.get(dimension)
    frame = pd.DataFrame({n: np.asarray(v.values) for n, v in columns.items()}, index=index)
    frame = frame.rename_axis(dimension if index is not None else None)
    units = {n: v.attrs["units"] for n, v in dataset.variables.items() if "units" in v.attrs}
    frame.attrs = {"units": units, FRAME_KEY: dataset.attrs.get(FRAME_KEY)}
    return log_from_pandas(frame, vessel, name=name, states=states, fill=fill)


def recording_from_pandas(
    frame: pd.DataFrame, vessel: Vessel, *, name: str = "frame", guess: bool = True
) -> Recording:
    """Return a DataFrame as a recording, which can be checked, mended and imported.

    Unlike `log_from_pandas` it may have holes, jitter and gaps in its time, and names
    that are to be guessed, as `read_recording` reads them from a file. A frame that was a log
    tells what was done to it, so that nothing is corrected twice.

    Parameters
    ----------
    frame : DataFrame
        As for `log_from_pandas`.
    vessel : Vessel
    name : str
    guess : bool
        Whether columns that are neither mapped nor canonical are guessed.

    Returns
    -------
    Recording
        SI and radians, as `read_recording` gives of a file with these columns.

    Raises
    ------
    LogError
        It is no DataFrame, or has no time.
    """
    record = _recorded(frame.attrs.get(FRAME_KEY) if hasattr(frame, "attrs") else None)
    if record:
        # it is canonical
        vessel, guess = replace(vessel, columns={}), False
    table = open_frame(frame, name, vessel.recorded_columns)
    raw, assigned = table_recording(table, vessel, guess=guess)
    recording = canonical(raw, assigned, vessel)
    if not record:
        return recording
    known = recorded_provenance(record)
    return replace(
        recording,
        epoch=known.epoch if recording.epoch is None else recording.epoch,
        steps=(*known.steps, *recording.steps),
        conditions=known.conditions,
    )


def _recorded(said: Any) -> dict[str, Any]:
    """Return what a frame or dataset says of the log it was; empty where it says nothing."""
    if isinstance(said, str):
        try:
            said = json.loads(said)
        except (ValueError, RecursionError):
            return {}
    return said if isinstance(said, dict) and said.get("format") == RECORD_FORMAT else {}


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
