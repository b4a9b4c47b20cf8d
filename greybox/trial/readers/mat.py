"""Signals out of MATLAB files: columns, structs, tables and timeseries saved as structs."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.errors import LogError, so_many, suggestion
from greybox.files import sha256
from greybox.trial.raw_log import Array, Recording, Signal, SourceFile, free_name, shortened
from greybox.trial.readers.limits import limits
from greybox.trial.readers.mat_process import Tree, Unreadable
from greybox.trial.readers.matfile import load_tree
from greybox.units import UNITS, find_unit, is_unix_time, spelled_unit, time_unit, unix_unit

# settings among the notes
_MAX_SCALARS = 40

# days since the year 0 and since 1970, as MATLAB's datenum counts
_DATENUM = (7e5, 8e5)
_DATENUM_1970 = 719529.0
_RISING = 0.9

_TIME = re.compile(
    r"(?:.*[_.])?(?:t|time|times|tout|timestamps?|time_?stamps?|unix_?time|posix_?time|utc|"
    r"date_?time|datenum|sim_?time|elapsed|row_?times)(?:[_.]?(?P<unit>s|sec|seconds|ms|us|ns|min))?"
)
# the one column of a timeseries has the name of the series
_BARE = frozenset({"data", "values", "value"})
_LABELS = ("variablenames", "columns", "names", "labels", "channels", "header", "headers")
_MATRICES = frozenset({"variables", "data", "values"})


def read_mat(path: Path) -> Recording:
    """Read the signals of a MATLAB file of version 4, 5 to 7.2, or 7.3.

    Structs are flattened to dotted names (``log.u``), a struct array of samples
    becomes columns, an N x k matrix ``name_1`` to ``name_k`` or the names that stand
    beside it (``VariableNames`` of a table, ``label`` of Simulink's structure with
    time). A signal takes the time of its own struct, or else of one further out, or
    else the only time in the file of its length. Times are columns called ``t``,
    ``time``, ``timestamp``, ``tout`` or the like.

    Parameters
    ----------
    path : Path

    Returns
    -------
    Recording
        ``t`` [s] as recorded. Where the times are UNIX seconds (above 1e8, also in ms,
        us or ns), MATLAB's datenum (7e5 to 8e5 days) or dates as text, `epoch` is the
        UNIX time of the first and ``t`` counts from it; dates without a zone are taken as
        UTC. Units only where a table or timeseries states them. Texts of length N go to
        `text`, scalars and short texts to `notes` as ``name = value``. Complex and large
        sparse arrays, functions and MATLAB objects (datetime, table, timetable,
        timeseries) are left out, which the notes say.

    Raises
    ------
    LogError
        The file is no MATLAB file, damaged, or larger than the bounds; or it holds no
        time or no signal, with the variables that it does hold and what to do.
    """
    path = Path(path)
    tree, kind = load_tree(path)
    reader = _Reader(path.name)
    reader.collect(tree)
    recording = reader.recording(path.stem, tree)
    return Recording(
        *recording, files=(SourceFile(path.name, sha256(path), kind),), notes=tuple(reader.notes)
    )


@dataclass(frozen=True, eq=False)
class _Time:
    """One time column as it stands in the file, and what it turned out to be."""

    name: str
    t: Array
    epoch: float | None
    note: str


@dataclass
class _Scope:
    """One struct: its times, and the struct that it stands in."""

    name: str
    times: list[_Time]
    outer: _Scope | None


@dataclass
class _Found:
    """A value that may be a signal, with its scope."""

    name: str
    value: Any
    scope: _Scope
    labels: list[str] = field(default_factory=list)
    units: list[str] = field(default_factory=list)


class _Reader:
    def __init__(self, name: str) -> None:
        self.name = name
        self.notes: list[str] = []
        self.found: list[_Found] = []
        self.times: list[_Time] = []
        # what is said of the first value that cannot be read
        self.unreadable = ""
        self.scalars = 0

    def note(self, text: str) -> None:
        if len(self.notes) < limits().notes:
            self.notes.append(text)
        elif len(self.notes) == limits().notes:
            self.notes.append("more was left out than is listed here.")

    # first the structure, so that every time is known before signals look for theirs

    def collect(self, tree: Tree, name: str = "", outer: _Scope | None = None) -> None:
        """Take in one struct and those inside it."""
        scope = _Scope(name, [], outer)
        stated = _stated_time_unit(tree)
        for key, value in tree.items():
            match = _TIME.fullmatch(key.casefold())
            if match is None:
                continue
            unit = spelled_unit(match["unit"]) if match["unit"] else stated
            time = _time(_join(name, key), value, unit)
            if time is not None:
                scope.times.append(time)
                self.times.append(time)
        if len(scope.times) > 1 and "T" in tree:
            # beside another time a capital T is a thrust, torque or temperature
            capital = _join(name, "T")
            scope.times = [t for t in scope.times if t.name != capital]
            self.times = [t for t in self.times if t.name != capital]
        own = {t.name for t in scope.times}
        for key, value in tree.items():
            path = _join(name, key)
            if path not in own:
                self._value(path, key, value, scope, tree)

    def _value(self, path: str, key: str, value: Any, scope: _Scope, tree: Tree) -> None:
        if isinstance(value, Unreadable):
            said = f"'{path}' was left out: {value.reason}."
            self.unreadable = self.unreadable or f"{said} "
            self.note(said)
        elif isinstance(value, dict):
            if key.casefold() in ("properties", "timeinfo", "datainfo"):
                return
            if key.casefold() == "signals" and "values" in value:
                self._simulink([value], scope)
            else:
                self.collect(value, path, scope)
        elif isinstance(value, list):
            self._list(path, key, value, scope)
        elif isinstance(value, str):
            if value:
                self._scalar(path, value[: limits().text])
        elif value.size == 1:
            self._scalar(path, f"{float(value.ravel()[0]):.12g}")
        elif value.size:
            bare = key.casefold() in _BARE and scope.name
            labels, units = _labels(tree, key)
            self.found.append(
                _Found(scope.name if bare and not labels else path, value, scope, labels, units)
            )

    def _scalar(self, path: str, value: str) -> None:
        # notes of what was left out must not drown in a struct of settings
        self.scalars += 1
        if self.scalars <= _MAX_SCALARS:
            self.note(f"{path} = {value}")

    def _list(self, path: str, key: str, value: list[Any], scope: _Scope) -> None:
        if value and all(isinstance(v, str) for v in value):
            if key.casefold() not in _LABELS:
                self.found.append(_Found(path, value, scope))
            return
        if value and all(isinstance(v, dict) for v in value):
            if key.casefold() == "signals" and all("values" in v for v in value):
                self._simulink(value, scope)
                return
            columns = _records(value)
            if columns:
                self.collect(columns, path, scope)
                return
            for k, item in enumerate(value[: limits().matrix_columns], start=1):
                self.collect(item, f"{path}_{k}", scope)
            if len(value) > limits().matrix_columns:
                self.note(
                    f"of the {len(value)} structs of '{path}' {limits().matrix_columns} were read."
                )
            return
        for k, item in enumerate(value[: limits().matrix_columns], start=1):
            if isinstance(item, dict):
                self.collect(item, f"{path}_{k}", scope)
            elif isinstance(item, (Unreadable, np.ndarray)):
                self._value(f"{path}_{k}", f"{key}_{k}", item, scope, {})

    def _simulink(self, signals: list[Tree], scope: _Scope) -> None:
        for k, item in enumerate(signals[: limits().matrix_columns], start=1):
            label = item.get("label")
            if not isinstance(label, str) or not label:
                block = item.get("blockName")
                label = block.rsplit("/", 1)[-1] if isinstance(block, str) and block else None
            name = _join(scope.name, label or f"signals_{k}")
            if isinstance(item["values"], dict):
                self.collect(item["values"], name, scope)
            elif isinstance(item["values"], np.ndarray) and item["values"].size > 1:
                self.found.append(_Found(name, item["values"], scope))

    # then the signals

    def recording(
        self, name: str, tree: Tree
    ) -> tuple[str, tuple[Signal, ...], dict[str, tuple[Array, NDArray[np.str_]]], float | None]:
        """Return the first fields of the recording."""
        if not self.times:
            raise LogError(self._no_time(tree))
        epochs = [t.epoch for t in self.times if t.epoch is not None]
        epoch = min(epochs) if epochs else None
        if epochs and len(epochs) < len(self.times):
            loose = next(t.name for t in self.times if t.epoch is None)
            self.note(
                f"'{loose}' does not count from 1970 as other times of the file do: "
                f"its zero was put at the first of them."
            )
        for note in dict.fromkeys(t.note for t in self.times if t.note):
            self.note(note)
        clocks = {
            id(t): t.t + ((t.epoch - epoch) if t.epoch and epoch else 0.0) for t in self.times
        }
        signals: list[Signal] = []
        text: dict[str, tuple[Array, NDArray[np.str_]]] = {}
        used: set[str] = set()
        left: list[str] = []
        for item in self.found:
            if isinstance(item.value, list):
                time = self._own_time(item, (len(item.value),))
                if time is not None:
                    words = np.array([w[: limits().text] for w in item.value])
                    text[free_name(item.name, used)] = (clocks[id(time)], words)
                continue
            time = self._own_time(item, item.value.shape)
            if time is None:
                left.append(f"'{item.name}' {_shape(item.value)}")
                continue
            for column, values, unit in self._columns(item, len(time.t)):
                signals.append(
                    Signal(free_name(column, used), clocks[id(time)], values, unit, item.name)
                )
        if left:
            self.note(f"no time is as long as {shortened(left, 12)}: left out.")
        if not signals:
            lengths = ", ".join(f"'{t.name}' ({len(t.t)})" for t in self.times[:5])
            raise LogError(
                f"'{self.name}' holds times {lengths} but no signal of that length; it holds "
                f"{_inventory(tree)}. {self.unreadable}Save columns as long as their time."
            )
        return name, tuple(signals), text, epoch

    def _own_time(self, item: _Found, shape: tuple[int, ...]) -> _Time | None:
        """Return the time of the nearest scope that fits one of the lengths in `shape`."""
        scope: _Scope | None = item.scope
        while scope is not None:
            fitting = [t for t in scope.times if len(t.t) in shape]
            if fitting:
                return max(fitting, key=lambda t: _likeness(t.name, item.name))
            scope = scope.outer
        fitting = [t for t in self.times if len(t.t) in shape]
        if len(fitting) != 1:
            return None
        self.note(f"'{item.name}' has no time of its own: '{fitting[0].name}' is as long.")
        return fitting[0]

    def _columns(self, item: _Found, count: int) -> Iterator[tuple[str, Array, str | None]]:
        """Yield name, values (N,) and unit of the columns of an array."""
        value = np.asarray(item.value, float)
        # samples go down; along the last axis in Simulink; across in a row
        axis = 0 if value.shape[0] == count else value.ndim - 1
        if value.shape[axis] != count:
            axis = value.shape.index(count)
        table = np.moveaxis(value, axis, 0).reshape(count, -1)
        width, most = table.shape[1], limits().matrix_columns
        if width > most:
            self.note(f"of the {width} columns of '{item.name}' {most} were read.")
        named = len(item.labels) == width
        units = item.units if len(item.units) == width else [""] * width
        for k in range(min(width, most)):
            name = item.name if width == 1 else f"{item.name}_{k + 1}"
            if named:
                name = _join(item.scope.name, item.labels[k])
            yield name, np.ascontiguousarray(table[:, k]), self._unit(name, units[k])

    def _unit(self, name: str, stated: str) -> str | None:
        stated = stated.strip()
        if not stated:
            return None
        unit = find_unit(stated)
        if unit is None:
            self.note(f"the unit '{stated}' of '{name}' is unknown and was left out.")
            return None
        return unit.symbol

    def _no_time(self, tree: Tree) -> str:
        names = [f.name.rsplit(".", 1)[-1] for f in self.found]
        near = suggestion("time", [n for n in names if n.casefold().startswith("t")])
        return (
            f"'{self.name}' holds no time; it holds {_inventory(tree)}.{near} {self.unreadable}"
            f"Save a column of seconds called 't' beside the signals, or in their struct."
        )


def _join(outer: str, name: str) -> str:
    return f"{outer}.{name}" if outer else name


def _likeness(time: str, name: str) -> tuple[int, int]:
    """Order times by what their name shares with a signal's, then the plainest first."""
    time, name = time.rsplit(".", 1)[-1].casefold(), name.rsplit(".", 1)[-1].casefold()
    prefix = re.split(r"[_.]", time)[0]
    shared = len(prefix) if time != prefix and name.startswith(prefix) else 0
    return shared, -len(time)


def _shape(value: Any) -> str:
    return f"({' x '.join(map(str, value.shape))})"


def _inventory(tree: Tree) -> str:
    """Return what the file holds, a few words each."""
    words = []
    for name, value in tree.items():
        if isinstance(value, dict):
            words.append(f"{name} (struct with {shortened(value, 6)})")
        elif isinstance(value, list):
            words.append(f"{name} ({so_many(len(value), 'cell')})")
        elif isinstance(value, (str, Unreadable)):
            words.append(f"{name} ({'text' if isinstance(value, str) else 'unreadable'})")
        else:
            words.append(f"{name} {_shape(value)}")
    return shortened(words, 12) or "nothing"


def _child(tree: Mapping[str, Any], name: str) -> Any:
    for key, value in tree.items():
        if key.casefold() == name:
            return value
    return None


def _texts(value: Any) -> list[str]:
    if isinstance(value, str):
        return [value]
    if isinstance(value, list) and all(
        isinstance(v, str) or (isinstance(v, np.ndarray) and not v.size) for v in value
    ):
        return [v if isinstance(v, str) else "" for v in value]
    return []


def _labels(tree: Tree, key: str) -> tuple[list[str], list[str]]:
    """Return the names and units that a table or timeseries states for its columns."""
    properties = _child(tree, "properties")
    properties = properties if isinstance(properties, dict) else {}
    labels: list[str] = []
    units = _texts(_child(properties, "variableunits")) or _texts(_child(tree, "variableunits"))
    if key.casefold() in _MATRICES:
        for name in _LABELS:
            labels = labels or _texts(_child(properties, name)) or _texts(_child(tree, name))
        info = _child(tree, "datainfo")
        if isinstance(info, dict) and not units:
            units = _texts(_child(info, "units"))
    else:
        # columns as fields of their own: the unit stands at the place of the name
        names = _texts(_child(properties, "variablenames"))
        units = [units[names.index(key)]] if key in names and len(units) == len(names) else []
    return labels, units


def _stated_time_unit(tree: Tree) -> str | None:
    """Return the unit of time that a timeseries states, None where it states none."""
    info = _child(tree, "timeinfo")
    stated = _child(info, "units") if isinstance(info, dict) else None
    unit = find_unit(stated) if isinstance(stated, str) else None
    return unit.symbol if unit is not None and unit.si == "s" else None


def _records(items: list[Any]) -> Tree:
    """Return the columns of a struct array of samples; nothing if it is none."""
    first = items[0]
    if len(items) < 2 or not any(_TIME.fullmatch(k.casefold()) for k in first):
        return {}
    columns: Tree = {}
    for key in first:
        values = [item.get(key) for item in items]
        if all(isinstance(v, str) for v in values):
            columns[key] = values
        elif all(isinstance(v, np.ndarray) and v.size == 1 for v in values):
            columns[key] = np.array([v.ravel()[0] for v in values])
        elif all(isinstance(v, np.ndarray) and v.size <= 1 for v in values):
            # an empty field is a sample that was not taken
            columns[key] = np.array([v.ravel()[0] if v.size else math.nan for v in values])
    times = [k for k in columns if _TIME.fullmatch(k.casefold())]
    return columns if times else {}


def _time(name: str, value: Any, stated: str | None) -> _Time | None:
    """Return a time column in its stated or guessed unit, None where the value cannot be one."""
    if isinstance(value, list):
        return _dates(name, value)
    if not isinstance(value, np.ndarray) or value.size < 2 or max(value.shape) != value.size:
        return None
    raw = value.ravel()
    if raw.dtype.kind == "b":
        return None
    known = raw[np.isfinite(raw)]
    if len(known) < 2:
        return None
    steps = np.diff(known.astype(float))
    # repeated, lost and reset times are for the checks to find, but a time does rise
    if not steps.max() > 0 or np.mean(steps >= 0) < _RISING:
        return None
    middle = float(np.median(known))
    if _counts_days(known, stated):
        start = float(known[0])
        note = f"'{name}' was taken as MATLAB datenum (days), for it is near {middle:.0f}."
        t = np.asarray((raw - start) * 86400.0, float)
        return _Time(name, t, (start - _DATENUM_1970) * 86400.0, note)
    unit = unix_unit(middle) or stated or time_unit(known)
    factor = UNITS[unit].factor
    if is_unix_time(middle * factor):
        note = f"'{name}' was taken as UNIX time in {unit}, for it is near {middle:.6g}."
        # integers are subtracted as integers: a float of nanoseconds is 0.2 us coarse
        whole = raw.astype(np.int64) if raw.dtype.kind in "iu" else raw
        first = whole[np.isfinite(whole)][0]
        t = np.asarray(whole - first, float) * factor
        return _Time(name, t, float(first) * factor, note)
    note = f"'{name}' was taken as time in {unit}." if unit != "s" else ""
    return _Time(name, np.asarray(raw, float) * factor, None, note)


def _counts_days(known: NDArray[Any], stated: str | None) -> bool:
    """Whether times are MATLAB's datenum, by their unit and size, or by size and step."""
    if stated not in (None, "d") or not _DATENUM[0] <= np.median(known) <= _DATENUM[1]:
        return False
    # seconds as large are days apart when they are read as days
    return stated == "d" or time_unit((known - known[0]) * 86400.0) == "s"


def _dates(name: str, value: list[Any]) -> _Time | None:
    """Return a time column written as dates in text."""
    if len(value) < 2 or not all(isinstance(v, str) for v in value):
        return None
    stamps: list[float] = []
    for word in value:
        moment = _date(word.strip())
        if moment is None:
            return None
        stamps.append(moment)
    t = np.array(stamps)
    note = f"'{name}' holds dates; where they name no zone they were taken as UTC."
    return _Time(name, t - t[0], float(t[0]), note)


def _date(word: str) -> float | None:
    for parse in (
        datetime.fromisoformat,
        lambda w: datetime.strptime(w, "%d-%b-%Y %H:%M:%S"),
        lambda w: datetime.strptime(w, "%d-%b-%Y %H:%M:%S.%f"),
    ):
        try:
            moment = parse(word)
            zoned = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
            return zoned.timestamp()
        except (ValueError, OverflowError):
            continue
    return None
