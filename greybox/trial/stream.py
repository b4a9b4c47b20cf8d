"""Logs larger than memory: the segments of many files, read again for each pass over them.

An index knows the rows of each file and where they are cut; a pass reads one window of rows
after another, in as many processes as there are processors, by the same way as `read_segments`.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from greybox.errors import GreyboxError, LogError, UsageError
from greybox.files import sha256
from greybox.numerics.parallel import map_pieces
from greybox.trial.convert.channel_mapping import table_columns, written_log
from greybox.trial.convert.column_names import Assigned
from greybox.trial.convert.read import table_segments
from greybox.trial.convert.time_grid import MIN_SEGMENT
from greybox.trial.convert.time_scale import time_scale
from greybox.trial.gaps import GAP
from greybox.trial.kinematics import decimate_segments
from greybox.trial.log import Provenance, TrialLog
from greybox.trial.log_files import LogFile, local_copy
from greybox.trial.raw_log import Recording
from greybox.trial.readers.formats import open_raw
from greybox.trial.readers.parquet import ParquetFile
from greybox.trial.readers.table import Batch, TableFile
from greybox.trial.readers.topic_files import TopicTable
from greybox.vessel.vessel import Vessel

Result = TypeVar("Result")

# rows of a window: at most so many, for memory; at least so many, for long runs of a model; and
# so many windows or more, for a spread between them
_MOST_ROWS, _LEAST_ROWS, _WINDOWS = 100_000, 5_000, 50
# windows that one piece of work reads from a Parquet file
_A_PIECE = 8
# bytes in which the rows of a text table are counted
_HEAD = 1 << 16


@dataclass(frozen=True)
class StreamedFile:
    """A file of logs, as its index knows it.

    Parameters
    ----------
    file : LogFile
    known : Provenance
    vessel : Vessel
        By which its columns are read.
    cuts : tuple of int
        Rows at which windows start, and the number of rows.
    numbers : tuple of int
        Of segments, as they follow from gaps and cuts, before each window.
    sample_time : float
        On average over the file, that of every window [s].
    whole : bool
        Whether rows can only be found by reading those before them, as in a text.
    skipped : frozenset of int
        Windows that hold no log.
    """

    file: LogFile
    known: Provenance
    vessel: Vessel
    cuts: tuple[int, ...]
    numbers: tuple[int, ...]
    sample_time: float
    whole: bool = False
    skipped: frozenset[int] = frozenset()

    @property
    def rows(self) -> int:
        """Rows of the file."""
        return self.cuts[-1]

    def without(self, window: int, why: str) -> str:
        """Return the sentence that a window takes no part."""
        if len(self.cuts) == 2:
            return f"'{self.file.name}' was left out: {why}"
        first, stop = self.cuts[window : window + 2]
        return f"rows {first + 1} to {stop} of '{self.file.name}' were left out: {why}"

    @property
    def piece(self) -> int:
        """How many windows are read one after another."""
        return len(self.cuts) if self.whole else _A_PIECE

    @property
    def windows(self) -> frozenset[int]:
        """Positions of all windows."""
        return frozenset(range(len(self.cuts) - 1))

    @property
    def gone(self) -> bool:
        """Whether no window takes part."""
        return self.skipped >= self.windows


@dataclass(frozen=True)
class Place:
    """Where a segment stands: file and window by position, and its position in the window."""

    file: int
    window: int
    segment: int


@dataclass(frozen=True)
class LogStream:
    """Files that are read in passes.

    Parameters
    ----------
    files : tuple of StreamedFile
        Those that take no part any more among them, so that places stay.
    vessel : Vessel
    states : tuple of str
        That must be there, as `read_log`.
    sample_time : float, optional
        To which segments are decimated [s].
    left_out : tuple of str
        A sentence for each file that is not read, or no longer.
    """

    files: tuple[StreamedFile, ...]
    vessel: Vessel
    states: tuple[str, ...] = ()
    sample_time: float | None = None
    left_out: tuple[str, ...] = ()

    @property
    def parts(self) -> tuple[StreamedFile, ...]:
        """The files that take part."""
        return tuple(f for f in self.files if not f.gone)

    @property
    def rows(self) -> int:
        """Rows of the files that take part."""
        return sum(f.rows for f in self.parts)

    @property
    def interval(self) -> float:
        """Sample time of the segments [s]."""
        return self.files[0].sample_time if self.sample_time is None else self.sample_time

    def read(self, places: Sequence[Place]) -> list[TrialLog]:
        """Return segments by their places."""
        found = {}
        for file, window in dict.fromkeys((p.file, p.window) for p in places):
            piece = _Piece(self, file, window, window + 1)
            logs = next(_windows(piece))
            if isinstance(logs, str):
                raise LogError(logs)
            found[file, window] = logs
        return [found[p.file, p.window][p.segment] for p in places]

    def run(
        self, function: Callable[[TrialLog], Result]
    ) -> tuple[LogStream, list[tuple[Place, Result]]]:
        """Apply a function to every segment: one pass.

        Parameters
        ----------
        function : callable
            A module-level function of one log, or a `functools.partial` of one.

        Returns
        -------
        tuple of (LogStream, list of (Place, result))
            The stream without what could not be read any more, which its `left_out` names, and
            the results of the rest in order.

        Raises
        ------
        LogError
            No file can be read.
        """
        pieces = [
            _Piece(self, k, first, min(first + f.piece, len(f.cuts) - 1))
            for k, f in enumerate(self.files)
            if not f.gone
            for first in range(0, len(f.cuts) - 1, f.piece)
        ]
        found: list[tuple[Place, Result]] = []
        broken: dict[int, str] = {}
        lost: dict[int, dict[int, str]] = {}
        for piece, made in zip(pieces, map_pieces(partial(_apply, function), pieces), strict=True):
            found += made.results
            lost.setdefault(piece.file, {}).update(made.lost)
            if made.broken:
                broken.setdefault(piece.file, made.broken)
        files: list[StreamedFile] = []
        told: list[str] = []
        for k, file in enumerate(self.files):
            gone = lost.get(k, {})
            if k in broken:
                why = broken[k].rstrip(".")
                told.append(
                    f"'{file.file.name}' could not be read to its end ({why}): its {file.rows} "
                    f"rows take no part."
                )
                files.append(replace(file, skipped=file.windows))
                continue
            told += [file.without(w, why) for w, why in gone.items()]
            files.append(replace(file, skipped=file.skipped | gone.keys()))
        found = [(p, r) for p, r in found if p.file not in broken]
        if not found:
            raise LogError(told[0] if told else "the files hold 0 segments, at least 1 is needed.")
        return replace(self, files=tuple(files), left_out=(*self.left_out, *told)), found


def estimated_rows(files: Sequence[LogFile]) -> int:
    """Return about how many rows files hold; a file that cannot be opened counts none."""
    total = 0
    for file in files:
        try:
            with local_copy(file.path) as path:
                table = open_raw(path)
                total += table.rows if isinstance(table, ParquetFile) else _lines(path)
        except LogError:
            continue
    return total


def _lines(path: Path) -> int:
    """Return about how many lines a text has, by the length of its first ones."""
    with path.open("rb") as handle:
        head = handle.read(_HEAD)
    return round(path.stat().st_size * head.count(b"\n") / max(len(head), 1))


def open_stream(
    files: Sequence[LogFile],
    vessel: Vessel,
    *,
    states: tuple[str, ...] = (),
    sample_time: float | None = None,
) -> LogStream:
    """Index files, so that they can be read in passes.

    Parameters
    ----------
    files : sequence of LogFile
    vessel : Vessel
    states : tuple of str
        As `read_log`.
    sample_time : float, optional
        To which segments are decimated [s].

    Raises
    ------
    LogError
        A file that was named, or every file, is no log; sample times differ.
    UsageError
        Two files are the same.
    """
    rows = min(max(estimated_rows(files) // _WINDOWS, _LEAST_ROWS), _MOST_ROWS)
    found: list[StreamedFile] = []
    told: list[str] = []
    pieces = list(files)
    for file, made in zip(
        pieces, map_pieces(partial(_index, vessel=vessel, most=rows), pieces), strict=True
    ):
        if isinstance(made, StreamedFile):
            found.append(made)
        elif file.found:
            told.append(f"'{file.name}' was left out: {made}")
        else:
            raise LogError(made)
    if not found:
        raise LogError(told[0])
    _require_alike(found)
    return LogStream(tuple(found), vessel, states, sample_time, tuple(told))


def _require_alike(files: Sequence[StreamedFile]) -> None:
    """Refuse files of different sample times, and one file twice."""
    hashes: dict[str, str] = {}
    for file in files:
        name, first = file.file.name, files[0]
        if abs(file.sample_time - first.sample_time) > 1e-6 * first.sample_time:
            raise LogError(
                f"'{first.file.name}' is sampled at {first.sample_time:g} s and '{name}' at "
                f"{file.sample_time:g} s: files of a stream need one sample time, so estimate on "
                f"those of one alone."
            )
        same = hashes.setdefault(file.known.sha256, name)
        if same != name:
            raise UsageError(
                f"'{same}' and '{name}' hold the same {file.rows} rows, which would count as two "
                f"trials: name each trial once."
            )


def _index(file: LogFile, vessel: Vessel, most: int) -> StreamedFile | str:
    """Return a file cut into windows of at most `most` rows, or why it is no log."""
    try:
        with local_copy(file.path) as path:
            table = _opened(path)
            known, own = written_log(path, vessel)
            known = known or Provenance(path.name)
            known = replace(known, sha256=known.sha256 or sha256(path))
            time = table_columns(table, own, guess=False)["t"]
            whole = not isinstance(table, ParquetFile)
            return StreamedFile(file, known, own, *_cuts(table, time, most), whole)
    except (GreyboxError, OSError) as error:
        return str(error)


def _opened(path: Path) -> TableFile:
    """Open a table of samples.

    Raises
    ------
    LogError
        It is a recording, whose signals stand at times of their own.
    """
    table = open_raw(path)
    if isinstance(table, Recording | TopicTable):
        raise LogError(
            f"'{path.name}' is a raw file, and rows of a log are needed: make a log of it first "
            f"with greybox import {shlex.quote(path.name)} --vessel V --out log.parquet."
        )
    return table


def _cuts(
    table: TableFile, time: Assigned, most: int
) -> tuple[tuple[int, ...], tuple[int, ...], float]:
    """Return where windows start, segments before each, and the sample time [s].

    Windows end at a gap where there is one in their second half, else when they are full.
    """
    gaps: list[int] = []
    rows, last, step = 0, np.nan, 0.0
    seconds, count = 0.0, 0
    for batch in table.batches([time.raw]):
        raw = np.asarray(batch[time.raw], float)
        if not step:
            t = time_scale(raw, time, table)
            scale = abs(t.factor)
            step = float(np.median(np.diff(raw))) if len(raw) > 1 else 0.0
        steps = np.diff(raw, prepend=last)
        gaps += (np.flatnonzero(steps > GAP * step) + rows).tolist()
        usual = steps[np.abs(steps - step) < 0.5 * step]
        seconds, count = seconds + float(usual.sum()), count + len(usual)
        rows, last = rows + len(raw), raw[-1] if len(raw) else last
    if not step > 0:
        raise LogError(
            f"time in '{table.path.name}' does not increase over its first rows: greybox import "
            f"sorts the rows and drops repeated ones."
        )
    cuts, numbers, before = [0], [0], 0
    marks = np.array([*gaps, rows])
    while rows - cuts[-1] > most:
        start = cuts[-1]
        within = marks[(marks > start + most // 2) & (marks <= start + most)]
        cut = int(within[-1]) if len(within) else start + most
        if rows - cut < MIN_SEGMENT:
            break
        cuts.append(cut)
        before += int(((marks > start) & (marks < cuts[-1])).sum()) + 1
        numbers.append(before)
    return (*cuts, rows), tuple(numbers), round((seconds / count if count else step) * scale, 9)


@dataclass(frozen=True)
class _Piece:
    """Windows ``first:stop`` of one file of a stream."""

    stream: LogStream
    file: int
    first: int
    stop: int


@dataclass(frozen=True)
class _Found(Generic[Result]):
    """What a piece gave: results, the windows that hold no log, and why its file broke off."""

    results: list[tuple[Place, Result]] = field(default_factory=list)
    lost: dict[int, str] = field(default_factory=dict)
    broken: str = ""


def _apply(function: Callable[[TrialLog], Result], piece: _Piece) -> _Found[Result]:
    """Return the results of all segments of a piece."""
    found: _Found[Result] = _Found()
    windows = _windows(piece)
    for window in range(piece.first, piece.stop):
        try:
            logs = next(windows)
        except (GreyboxError, OSError) as error:
            return replace(found, broken=str(error))
        if isinstance(logs, str):
            found.lost[window] = logs
            continue
        for k, log in enumerate(logs):
            found.results.append((Place(piece.file, window, k), function(log)))
    return found


def _windows(piece: _Piece) -> Iterator[list[TrialLog] | str]:
    """Yield the segments of one window after another, or why it holds none."""
    stream, file = piece.stream, piece.stream.files[piece.file]
    cuts = file.cuts[piece.first : piece.stop + 1]
    with local_copy(file.file.path) as path:
        table = _opened(path)
        assigned = table_columns(table, file.vessel, guess=False)
        # positions are not needed where velocities were logged
        spare = {"x_n", "y_n"} if {"u", "v"} <= assigned.keys() else set()
        columns = [
            a.raw for n, a in assigned.items() if n not in spare or a.raw in file.vessel.columns
        ]
        for k, window in enumerate(_row_windows(table, columns, cuts)):
            yield _segments(stream, file, piece.first + k, window)


def _segments(
    stream: LogStream, file: StreamedFile, window: int, rows: TableFile
) -> list[TrialLog] | str:
    """Return the segments of a window, or why it holds none."""
    if window in file.skipped:
        return []
    try:
        segments = table_segments(
            rows, file.vessel, file.known, states=stream.states, sample_time=file.sample_time
        )
        if stream.sample_time is not None:
            segments, _ = decimate_segments(segments, stream.sample_time)
    except LogError as error:
        return str(error)
    if len(file.cuts) > 2:
        stem, first = rows.path.stem, file.numbers[window] + 1
        segments = [replace(s, name=f"{stem}[{first + i}]") for i, s in enumerate(segments)]
    return [replace(s, vessel=stream.vessel) for s in segments]


@dataclass
class _Rows:
    """Some rows of a table, in memory."""

    table: TableFile
    batch: Batch
    first_row: int
    steps: tuple[Any, ...] = ()
    notes: list[str] = field(default_factory=list)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.table, name)

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns that were read."""
        return tuple(self.batch)

    def batches(self, columns: Sequence[str]) -> Iterator[Batch]:
        """Yield the named columns."""
        yield {c: self.batch[c] for c in columns}


def _row_windows(
    table: TableFile, columns: Sequence[str], cuts: Sequence[int]
) -> Iterator[TableFile]:
    """Yield the rows between cuts as tables of their own, read once from the first cut on."""
    at = 0
    source: TableFile = table
    if isinstance(table, ParquetFile):
        source, at = table.from_row(cuts[0])
    batches = source.batches(columns)
    held: list[Batch] = []
    have = 0
    for start, stop in pairwise(cuts):
        while at + have < stop:
            batch = next(batches, None)
            if batch is None:
                raise LogError(
                    f"'{table.path.name}' ends after {at + have} rows, {stop} were there before: "
                    f"leave the files as they are while they are read."
                )
            held.append(batch)
            have += len(batch[columns[0]])
            if at + have <= start:
                at, have, held = at + have, 0, []
        whole = {c: np.concatenate([b[c] for b in held]) for c in columns}
        own = {c: v[start - at : stop - at] for c, v in whole.items()}
        held = [{c: v[stop - at :] for c, v in whole.items()}]
        at, have = stop, at + have - stop
        yield _Rows(table, own, table.first_row + start)
