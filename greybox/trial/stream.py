"""Importing files of any size: what does not fit in memory goes through it in blocks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.errors import LogError
from greybox.files import sha256
from greybox.trial.canonical import (
    batch_recording,
    canonical,
    merge,
    read_recording,
    table_columns,
)
from greybox.trial.checks.check import check_recording
from greybox.trial.importing import Imported, ImportOptions, import_recording
from greybox.trial.log import TrialLog
from greybox.trial.names import Assigned
from greybox.trial.readers.formats import open_raw
from greybox.trial.readers.table import Batch, TableFile
from greybox.trial.recording import Recording, SourceFile
from greybox.trial.repair import repair
from greybox.trial.resampling import nice_period
from greybox.trial.writing import write_log
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]

# tables above this size are imported in blocks [bytes]
_LARGE = 200_000_000
_BLOCK_ROWS = 400_000
# rows that neighbouring blocks share, so that no filter sees a block's end
_HALO_ROWS = 2_000


def import_files(
    paths: Sequence[str | Path],
    vessel: Vessel,
    out: str | Path,
    options: ImportOptions | None = None,
    *,
    fix: bool = False,
    fix_also: tuple[str, ...] = (),
    reader: Mapping[str, Any] | None = None,
    extra: Mapping[str, Any] | None = None,
) -> str:
    """Import the raw files of one trial into one log file.

    Parameters
    ----------
    paths : sequence of str or Path
        Raw files; several are merged on their clocks.
    vessel : Vessel
    out : str or Path
        CSV or Parquet; its record is written beside it.
    options : ImportOptions
    fix : bool
        Whether to mend what the checks find and what is safe to mend.
    fix_also : tuple of str
        Ids of findings to mend although they need judgement.
    reader : mapping, optional
        Handed to the readers, such as ``topics``.
    extra : mapping, optional
        More entries of the record.

    Returns
    -------
    str
        What was read, guessed, derived and mended.

    Raises
    ------
    LogError
        A file cannot be read, or no log can be made of them.
    """
    options = options or ImportOptions()
    large = [p for p in map(Path, paths) if p.is_file() and p.stat().st_size > _LARGE]
    if large and len(paths) == 1 and not fix and not fix_also:
        table = open_raw(large[0])
        if not isinstance(table, Recording):
            return _in_blocks(table, vessel, out, options, extra)
    recording = merge([read_recording(p, vessel, **(reader or {})) for p in paths])
    fixed: tuple[str, ...] = ()
    left: list[str] = []
    if fix or fix_also:
        report = check_recording(recording, vessel)
        recording, fixed, left = repair(recording, vessel, report, also=fix_also)
    imported = import_recording(recording, vessel, options, fixed=fixed)
    write_log(imported.segments, out, extra=extra)
    return _summary(imported, fixed, left)


def _summary(imported: Imported, fixed: Sequence[str], left: Sequence[str]) -> str:
    first, last = imported.segments[0], imported.segments[-1]
    samples = sum(len(s) for s in imported.segments)
    lines = [
        f"{first.provenance.source}: {samples} samples of {first.sample_time:g} s, "
        f"{last.t[-1] - first.t[0]:.6g} s, {len(imported.segments)} segment"
        f"{'s' if len(imported.segments) > 1 else ''}",
        f"channels: {', '.join(first.channels)}",
    ]
    lines += [f"note: {n}" for n in imported.notes]
    lines += [f"mended: {n}" for n in fixed]
    lines += [f"left as it is: {n}" for n in left]
    return "\n".join(lines)


def _in_blocks(
    table: TableFile,
    vessel: Vessel,
    out: str | Path,
    options: ImportOptions,
    extra: Mapping[str, Any] | None,
) -> str:
    assigned = table_columns(table, vessel, guess=True)
    state = _State(options)
    files = (SourceFile(table.path.name, sha256(table.path), table.format),)

    def segments() -> Iterator[TrialLog]:
        for batch, before, last in _blocks(table, [a.raw for a in assigned.values()]):
            yield from state.block(table, batch, before, last, assigned, vessel, files)

    write_log(segments(), out, extra=extra)
    notes = list(dict.fromkeys([*table.notes, *state.notes]))
    lines = [
        f"{table.path.name}: {state.samples} samples of {state.sample_time:g} s, imported in blocks"
    ]
    return "\n".join(lines + [f"note: {n}" for n in notes])


def _blocks(table: TableFile, columns: Sequence[str]) -> Iterator[tuple[Batch, int, bool]]:
    """Yield blocks of rows with the halo of the one before, and whether it is the last.

    The second item is the number of rows at the front that were there before.
    """
    held: dict[str, list[NDArray[Any]]] = {c: [] for c in columns}
    rows, before = 0, 0
    for batch in table.batches(columns):
        for c in columns:
            held[c].append(batch[c])
        rows += len(batch[columns[0]])
        if rows >= _BLOCK_ROWS + before:
            block = {c: np.concatenate(held[c]) for c in columns}
            yield block, before, False
            before = 2 * _HALO_ROWS
            held = {c: [block[c][-before:]] for c in columns}
            rows = before
    if rows > before or before == 0:
        yield {c: np.concatenate(held[c]) for c in columns if held[c]}, before, True
    elif before:
        yield {c: np.concatenate(held[c]) for c in columns}, before, True


class _State:
    """What one block leaves to the next: the grid's origin and the turns of the angles."""

    def __init__(self, options: ImportOptions) -> None:
        self.options = options
        self.sample_time = 0.0
        self.start: float | None = None
        self.epoch: float | None = None
        self.last = -np.inf
        self.turns: dict[str, tuple[float, float]] = {}
        self.samples = 0
        self.notes: list[str] = []

    def block(
        self,
        table: TableFile,
        batch: Batch,
        before: int,
        last: bool,
        assigned: dict[str, Assigned],
        vessel: Vessel,
        files: tuple[SourceFile, ...],
    ) -> Iterator[TrialLog]:
        """Yield the segments of one block, its halo cut off, angles continued."""
        recording = canonical(batch_recording(table, batch, assigned, vessel), assigned, vessel)
        t = recording.signals[0].t
        if self.epoch is None:
            self.epoch = recording.epoch
        elif recording.epoch is not None and self.epoch is not None:
            shift = recording.epoch - self.epoch
            recording = recording.with_signals(
                replace(s, t=s.t + shift) for s in recording.signals
            )
            t = recording.signals[0].t
        if self.start is None:
            self.start = float(t[0])
            self.sample_time = self.options.sample_time or nice_period(float(np.median(np.diff(t))))
        elif (np.diff(t) <= 0).all():
            raise LogError(
                f"time in '{table.path.name}' runs backwards in a file too large to sort: "
                f"sort it first."
            )
        options = replace(self.options, sample_time=self.sample_time)
        recording = replace(recording, files=files)
        # a grid point before the block's first row, so that all blocks share one grid
        offset = np.ceil((float(np.nanmin(t)) - self.start) / self.sample_time - 1e-6)
        zero = self.start + offset * self.sample_time
        imported = import_recording(recording, vessel, options, zero=zero)
        self.notes += [n for n in imported.notes if n not in self.notes]
        # half of the halo belongs to the block before, half to the next
        stop = np.inf if last else float(t[-_HALO_ROWS])
        for log in imported.segments:
            inside = (log.t > self.last + 0.5 * self.sample_time) & (log.t < stop)
            k = np.flatnonzero(inside)
            if not len(k):
                continue
            part = log.window(int(k[0]), int(k[-1]) + 1, log.name)
            part = self._continue(part, vessel)
            self.last = float(part.t[-1])
            self.samples += len(part)
            yield part

    def _continue(self, log: TrialLog, vessel: Vessel) -> TrialLog:
        channels = dict(log.channels)
        for name in {"psi", *vessel.angle_commands} & channels.keys():
            value = channels[name]
            if name in self.turns:
                jump = np.round((value[0] - self.turns[name][1]) / (2 * np.pi))
                value = value - 2 * np.pi * jump
                channels[name] = value
            self.turns[name] = (float(log.t[-1]), float(value[-1]))
        return replace(log, channels=channels)
