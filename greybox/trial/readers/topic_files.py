"""Topics of ROS that were exported as text, one file a topic: header stamps, quaternions, twists.

Recorders and players write a message as one row, its fields as columns whose names are paths
(``header.stamp.secs``, ``header_stamp_secs``, ``field.header.stamp``). Here they become columns
of a ship's log; the axes are those of `greybox.trial.readers.ros.axes`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

import numpy as np

from greybox.trial.raw_log import Array
from greybox.trial.readers.ros.axes import (
    OTHER_CLOCK,
    compass_heading,
    frame_name,
    is_frd,
    is_ned,
    is_world,
    north_east,
    starboard,
    tells_axes,
)
from greybox.trial.readers.table import Batch, TableFile
from greybox.units import EARLIEST_UNIX, unix_seconds

STAMP = "header_stamp"
# between the clocks of two time zones there are whole quarters of an hour, and a short delay
QUARTER = 900.0
ZONE_DELAY = 10.0
# the earth has zones from 12 h behind to 14 h ahead of UTC
LARGEST_ZONE = 14 * 3600.0

_SECONDS = re.compile(r"^(.*?)(?:secs|sec)$")
_NANOS = ("nsecs", "nsec", "nanosecs", "nanosec", "nanoseconds")
_RECORDERS = ("time", "rosbagtimestamp", "timestamp", "recv_time", "log_time")
_QUATERNION = re.compile(r"^(.*?(?:quaternion|orientation|rotation|q))_?([xyzw])$")

Made = Callable[[Batch], Array]


@dataclass(frozen=True)
class _Column:
    """A column that is made of others.

    Parameters
    ----------
    name : str
    parts : tuple of str
        Columns of the file that it is made of.
    make : callable
        From a batch of them to its values.
    unit : str
    """

    name: str
    parts: tuple[str, ...]
    make: Made
    unit: str


@dataclass
class TopicTable:
    """A table of messages, with what ROS says of their fields made into columns.

    What it does not say itself the table of the file says.

    Parameters
    ----------
    table : TableFile
        The file.
    made : tuple of _Column
        Beside its columns; canonical names where ROS defines them.
    unsure : frozenset of str
        Those of `made` whose axes the file does not tell.
    ahead : float, optional
        How far the recorder's clock is ahead of the header stamps [s].
    """

    table: TableFile
    made: tuple[_Column, ...]
    unsure: frozenset[str]
    ahead: float | None
    remarks: list[str] = field(default_factory=list)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.table, name)

    @property
    def columns(self) -> tuple[str, ...]:
        """Names, those that are made first."""
        return (*(m.name for m in self.made), *self.table.columns)

    @property
    def units(self) -> dict[str, str]:
        """Units, where they are known."""
        return {**self.table.units, **{m.name: m.unit for m in self.made if m.unit}}

    @property
    def dates(self) -> frozenset[str]:
        """Columns in UNIX time [s]."""
        return self.table.dates | {m.name for m in self.made if m.name == STAMP}

    @property
    def notes(self) -> list[str]:
        """What was recovered and taken for granted."""
        return [*self.table.notes, *self.remarks]

    @property
    def parts(self) -> dict[str, tuple[str, ...]]:
        """The columns of the file behind each that is made."""
        return {m.name: m.parts for m in self.made}

    def batches(self, columns: Sequence[str]) -> Iterator[Batch]:
        """Yield the named columns.

        Raises
        ------
        LogError
            A row cannot be read.
        """
        made = [m for m in self.made if m.name in columns]
        plain = [c for c in columns if c not in {m.name for m in made}]
        needed = list(dict.fromkeys([*plain, *(p for m in made for p in m.parts)]))
        for batch in self.table.batches(needed):
            found = {c: batch[c] for c in plain}
            # damaged numbers may be too large to be multiplied
            with np.errstate(over="ignore", invalid="ignore"):
                found |= {m.name: m.make(batch) for m in made}
            yield found


def as_topic(table: TableFile) -> TableFile:
    """Return a table of messages as such, any other as it is.

    Parameters
    ----------
    table : TableFile

    Raises
    ------
    LogError
        A row cannot be read.
    """
    names = {_path(c): c for c in reversed(table.columns)}
    numbers = {
        p: c
        for p, c in names.items()
        if c not in table.text and c not in table.dates and c not in table.clocks
    }
    stamp = _stamp_columns(numbers)
    turn = _quaternion(numbers)
    if stamp is None and turn is None:
        return table
    frames = [names[p] for p in ("header_frame_id", "frame_id", "child_frame_id") if p in names]
    frames = [f for f in frames if f in table.text]
    found = _Messages(table, names, numbers, turn)
    recorder = next((names[r] for r in _RECORDERS if r in names), None)
    if recorder in table.text:
        recorder = None
    wanted = list(
        dict.fromkeys(
            [*frames, *(stamp or ()), *found.all_parts, *([recorder] if recorder else [])]
        )
    )
    first = next(iter(islice(table.batches(wanted), 1)), {c: np.empty(0) for c in wanted})
    for f in frames:
        found.frames[_path(f)] = next((str(w) for w in first[f][:1000] if str(w).strip()), "")
    ahead = None
    made = None if stamp is None else _stamp_column(stamp)
    # headers that nobody stamps hold zero
    if made is not None and np.isfinite(made.make(first)).any():
        ahead = _ahead(first, made, recorder, table) if recorder else None
        if ahead is not None and abs(ahead) > OTHER_CLOCK and zone_of(ahead) is None:
            found.remarks.append(
                f"the header stamps are {ahead:.6g} s behind '{recorder}', which is no time zone: "
                f"they come from another clock, and '{recorder}' is used"
            )
            ahead = None
        else:
            found.made.append(made)
    found.add_motion(first)
    return TopicTable(table, tuple(found.made), frozenset(found.unsure), ahead, found.remarks)


def zone_of(ahead: float) -> float | None:
    """Return the time zone [s] by which one clock is ahead of another, None where it is none."""
    zone = QUARTER * round(ahead / QUARTER)
    known = zone != 0 and abs(zone) <= LARGEST_ZONE
    return zone if known and abs(ahead - zone) <= ZONE_DELAY else None


def _path(column: str) -> str:
    """Return the path of a field as words joined by underscores, in lower case."""
    bare = column.strip().lower().lstrip("%").strip("./ ")
    bare = re.sub(r"[./\s]+", "_", bare)
    return bare.removeprefix("field_")


def _stamp_columns(numbers: dict[str, str]) -> tuple[str, ...] | None:
    """Return the columns of seconds and nanoseconds of the header, or the one of both."""
    for path, column in numbers.items():
        match = _SECONDS.match(path)
        if match is None or path in _NANOS or path.endswith(tuple(f"_{n}" for n in _NANOS)):
            continue
        stem = match.group(1)
        if stem not in ("", "stamp_", "header_stamp_"):
            continue
        nanos = next((numbers[stem + n] for n in _NANOS if stem + n in numbers), None)
        if nanos is not None:
            return column, nanos
    whole = numbers.get(STAMP)
    return None if whole is None else (whole,)


def _stamp_column(columns: tuple[str, ...]) -> _Column:
    def make(batch: Batch) -> Array:
        value = np.asarray(batch[columns[0]], float)
        if len(columns) == 1:
            value = unix_seconds(value)
        else:
            value = value + 1e-9 * np.asarray(batch[columns[1]], float)
        return np.where(value > 0, value, np.nan)

    return _Column(STAMP, columns, make, "s")


def _ahead(batch: Batch, stamp: _Column, recorder: str, table: TableFile) -> float | None:
    """Return how far the recorder's clock is ahead of the stamps [s], None where none counts."""
    recorded = np.asarray(batch[recorder], float)
    if recorder not in table.dates:
        recorded = unix_seconds(recorded)
    difference = recorded - stamp.make(batch)
    difference = difference[np.isfinite(difference) & (recorded >= EARLIEST_UNIX)]
    return float(np.median(difference)) if len(difference) else None


def _quaternion(numbers: dict[str, str]) -> tuple[str, ...] | None:
    """Return the columns of x, y, z and w."""
    groups: dict[str, dict[str, str]] = {}
    for path, column in numbers.items():
        match = _QUATERNION.match(path)
        if match is not None:
            groups.setdefault(match.group(1), {})[match.group(2)] = column
    return next((tuple(g[k] for k in "xyzw") for g in groups.values() if len(g) == 4), None)


@dataclass
class _Messages:
    """What the fields of a message give, by their paths."""

    table: TableFile
    names: dict[str, str]
    numbers: dict[str, str]
    turn: tuple[str, ...] | None
    frames: dict[str, str] = field(default_factory=dict)
    made: list[_Column] = field(default_factory=list)
    unsure: set[str] = field(default_factory=set)
    remarks: list[str] = field(default_factory=list)

    @property
    def all_parts(self) -> tuple[str, ...]:
        """Every column that a signal may be made of."""
        pairs = (self._pair("linear"), self._pair("position"))
        single = (self._ends("angular_z"), self._ends("angular_velocity_z"), self._status)
        found = [*(self.turn or ()), *(c for p in pairs if p for c in p), *filter(None, single)]
        return tuple(dict.fromkeys(found))

    def add_motion(self, first: Batch) -> None:
        """Add heading, velocity, yaw rate and position; `first` shows what is never set."""
        header = frame_name(self.frames.get("header_frame_id", self.frames.get("frame_id", "")))
        child = frame_name(self.frames.get("child_frame_id", ""))
        ned = is_ned(header)
        position = self._pair("position")
        twist = self._pair("linear")
        rate = self._ends("angular_velocity_z")
        if position is not None and self.turn is not None:
            self._add("x_n", position, lambda b: north_east(*_two(b, position), ned=ned)[0], "m")
            self._add("y_n", position, lambda b: north_east(*_two(b, position), ned=ned)[1], "m")
        if self.turn is not None:
            turn = self.turn
            # an IMU tells of its own axes, REP 145
            as_is = is_frd(header) if rate else ned
            self._add(
                "psi", turn, lambda b: compass_heading(*(b[c] for c in turn), ned=as_is), "rad"
            )
            if not (tells_axes(header) or child or rate):
                self.unsure.add("psi")
        if twist is not None:
            self._add_twist(twist, child or header, ned and bool(child), first)
        elif rate is not None:
            sign = is_frd(header)
            self._add("r", (rate,), lambda b: starboard(b[rate], frd=sign), "rad/s")
        self._add_fix()

    def _add_twist(self, twist: tuple[str, str], frame: str, ned: bool, first: Batch) -> None:
        if is_world(frame):
            north = is_ned(frame)
            self._add("v_n", twist, lambda b: north_east(*_two(b, twist), ned=north)[0], "m/s")
            self._add("v_e", twist, lambda b: north_east(*_two(b, twist), ned=north)[1], "m/s")
            return
        frd = is_frd(frame) or (ned and "flu" not in frame)
        self._add("u", twist, lambda b: _two(b, twist)[0], "m/s")
        self._add("v", twist, lambda b: starboard(_two(b, twist)[1], frd=frd), "m/s")
        if not tells_axes(frame):
            self.unsure |= {"u", "v"}
        rate = self._ends("angular_z")
        # drivers that do not measure a turn write zeros
        if rate is not None and np.any(first[rate] != 0):
            self._add("r", (rate,), lambda b: starboard(b[rate], frd=frd), "rad/s")

    def _add_fix(self) -> None:
        if self._status is None or not {"latitude", "longitude"} <= self.numbers.keys():
            return
        status = self._status
        for name, path in (("lat", "latitude"), ("lon", "longitude")):
            column = self.numbers[path]

            def make(b: Batch, column: str = column) -> Array:
                return np.where(np.asarray(b[status], float) >= 0, b[column], np.nan)

            self._add(name, (column, status), make, "deg")

    def _add(self, name: str, parts: Sequence[str], make: Made, unit: str) -> None:
        if name not in self.table.columns:
            self.made.append(_Column(name, tuple(parts), make, unit))

    @property
    def _status(self) -> str | None:
        return self.numbers.get("status_status")

    def _pair(self, kind: str) -> tuple[str, str] | None:
        x, y = self._ends(f"{kind}_x"), self._ends(f"{kind}_y")
        return None if x is None or y is None else (x, y)

    def _ends(self, end: str) -> str | None:
        found = (c for p, c in self.numbers.items() if p == end or p.endswith(f"_{end}"))
        return next(found, None)


def _two(batch: Batch, columns: tuple[str, str]) -> tuple[Array, Array]:
    return np.asarray(batch[columns[0]], float), np.asarray(batch[columns[1]], float)
