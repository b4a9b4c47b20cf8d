"""Importing files of any size: what does not fit in memory goes through it in blocks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.errors import LogError
from greybox.files import sha256
from greybox.trial.checks.check import check_recording
from greybox.trial.convert.channel_mapping import (
    batch_recording,
    canonical,
    merge,
    read_recording,
    unused_mappings,
)
from greybox.trial.convert.convert import cut_segments, import_recording, make_provenance
from greybox.trial.convert.deduplicate import clean_signals
from greybox.trial.convert.first_pass import Scan, scan_table
from greybox.trial.convert.options import ImportOptions
from greybox.trial.convert.time_grid import gap_notes, too_short
from greybox.trial.log import Provenance, TrialLog
from greybox.trial.raw_log import Recording, SourceFile
from greybox.trial.readers.formats import open_raw
from greybox.trial.readers.table import Batch, TableFile
from greybox.trial.repair import repair
from greybox.trial.store import record_path, write_log
from greybox.vessel.vessel import Vessel

# tables that may hold more numbers are imported in blocks
_LARGE_CELLS = 20_000_000
_BLOCK_ROWS = 300_000
# samples on both sides of a block that are made with it and not kept
_MARGIN = 4


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
    _keep_sources(paths, out)
    if len(paths) == 1 and not fix and not fix_also and Path(paths[0]).is_file():
        table = open_raw(paths[0], **(reader or {}))
        if not isinstance(table, Recording) and table.cells > _LARGE_CELLS:
            return _in_blocks(table, vessel, out, options, extra)
    recordings = [read_recording(p, vessel, **(reader or {})) for p in paths]
    unused = unused_mappings(recordings, vessel)
    recording = merge(recordings)
    recording = recording.with_signals(recording.signals, *unused)
    del recordings
    fixed: tuple[str, ...] = ()
    left: list[str] = []
    if fix or fix_also:
        report = check_recording(recording, vessel)
        recording, fixed, left = repair(recording, vessel, report, also=fix_also)
    imported = import_recording(recording, vessel, options, fixed=fixed)
    write_log(imported.segments, out, extra=extra)
    first, last = imported.segments[0], imported.segments[-1]
    return _summary(
        first,
        sum(len(s) for s in imported.segments),
        float(last.t[-1] - first.t[0]),
        len(imported.segments),
        [f"note: {n}" for n in imported.notes]
        + [f"mended: {n}" for n in fixed]
        + [f"left as it is: {n}" for n in left],
    )


def _keep_sources(paths: Sequence[str | Path], out: str | Path) -> None:
    """Refuse to write the log over a raw file: it could not be imported again."""
    targets = {Path(out).resolve(), record_path(out).resolve()}
    for path in paths:
        if Path(path).resolve() in targets:
            raise LogError(
                f"'{Path(path).name}' is also the log to write: name another file for the log."
            )


def _summary(
    first: TrialLog, samples: int, seconds: float, segments: int, lines: Sequence[str]
) -> str:
    return "\n".join(
        [
            f"{first.provenance.source}: {samples} samples of {first.sample_time:g} s, "
            f"{seconds:.6g} s, {segments} segment{'s' if segments > 1 else ''}",
            f"channels: {', '.join(first.channels)}",
            *lines,
        ]
    )


def _in_blocks(
    table: TableFile,
    vessel: Vessel,
    out: str | Path,
    options: ImportOptions,
    extra: Mapping[str, Any] | None,
) -> str:
    scan = scan_table(table, vessel, options)
    stream = _Stream(table, vessel, options, scan)
    write_log(stream.segments(), out, extra=extra, provenance=stream.provenance)
    assert stream.first is not None
    notes = [*stream.provenance().read, *stream.derived]
    return _summary(
        stream.first,
        stream.samples,
        stream.spans[-1][1] - stream.spans[0][0],
        len(stream.spans),
        [f"note: {n}" for n in notes],
    )


class _Stream:
    """The second pass over a table: what one block leaves to the next."""

    def __init__(
        self, table: TableFile, vessel: Vessel, options: ImportOptions, scan: Scan
    ) -> None:
        self.table, self.vessel, self.options, self.scan = table, vessel, options, scan
        self.first: TrialLog | None = None
        self.samples = 0
        self.spans: list[tuple[float, float]] = []
        self.derived: dict[str, None] = {}
        self.done = 0
        self.anchors: dict[str, float] = {}
        self.file = SourceFile(table.path.name, sha256(table.path), table.format)

    @property
    def halo(self) -> float:
        """Time that blocks share, so that no filter sees a block's end [s]."""
        plan = self.scan.plan
        slowest = max(plan.periods.values())
        return 8 * (plan.sample_time + slowest) + 2 * self.options.reach + self.scan.back

    def provenance(self) -> Provenance:
        """Return where the log came from, with all that is known by now."""
        notes = dict.fromkeys(
            [*self.table.notes, *self.scan.notes, *gap_notes(self.spans, 0, self.scan.plan.least)]
        )
        whole = Recording(
            self.table.path.stem, (), epoch=self.scan.scale.epoch, files=(self.file,),
            derived=self.scan.derived,
        )  # fmt: skip
        return make_provenance(whole, self.options, list(notes), list(self.derived))

    def segments(self) -> Iterator[TrialLog]:
        """Yield the pieces of the log in order of time.

        Raises
        ------
        LogError
            A row cannot be read, or there is no piece.
        """
        scan, plan = self.scan, self.scan.plan
        columns = [a.raw for a in scan.assigned.values()]
        held: dict[str, list[NDArray[Any]]] = {c: [] for c in columns}
        fresh = 0
        for batch in chain(self.table.batches(columns), [None]):
            if batch is not None:
                for c in columns:
                    held[c].append(batch[c])
                fresh += len(batch[columns[0]])
                if fresh < _BLOCK_ROWS:
                    continue
            block = {c: np.concatenate(held[c]) if held[c] else np.empty(0) for c in columns}
            start, pieces = self._block(block, last=batch is None)
            # a copy, so that the whole block is not kept for its end
            held = {c: [block[c][start:].copy()] for c in columns}
            del block
            yield from pieces
            fresh = 0
        if self.first is None:
            raise too_short(plan)

    def _block(self, block: Batch, *, last: bool) -> tuple[int, list[TrialLog]]:
        """Return the first row that the next block needs, and the pieces of this one."""
        scan, plan = self.scan, self.scan.plan
        raw = batch_recording(self.table, block, scan.assigned, scan.scale, self.vessel)
        recording = canonical(raw, scan.assigned, self.vessel)
        t = scan.scale.seconds(block[scan.assigned["t"].raw])
        finite = t[np.isfinite(t)]
        if not len(finite):
            return len(t), []
        newest = float(finite.max())
        stop = plan.count
        if not last:
            until = (newest - self.halo - plan.start) / plan.sample_time
            stop = int(np.clip(np.floor(until), self.done, plan.count))
        # the samples of the next block, and before them what its filters see
        needed = plan.start + stop * plan.sample_time - self.halo
        # the first row from which on nothing older comes: rows may be out of order
        older = np.flatnonzero(t < needed)
        start = int(older[-1]) + 1 if len(older) else 0
        recording = self._turned(recording, start)
        pieces = self._pieces(recording, stop)
        self.done = stop
        return start, pieces

    def _pieces(self, recording: Recording, stop: int) -> list[TrialLog]:
        scan, plan = self.scan, self.scan.plan
        if stop <= self.done:
            return []
        notes: list[str] = []
        signals = clean_signals(recording, scan.origin, notes)
        # samples beside those wanted, so that stretches do not end where the block does
        margin = _MARGIN + int(np.ceil(self.options.reach / plan.sample_time))
        span = (max(self.done - margin, 0), min(stop + margin, plan.count))
        found, derived, _ = cut_segments(
            signals, recording.text, plan, span, self.vessel, self.options, scan.derived
        )
        self.derived.update(dict.fromkeys(derived))
        low, high = plan.grid(self.done, self.done + 1)[0], plan.grid(stop, stop + 1)[0]
        half = 0.5 * plan.sample_time
        pieces = []
        for log in found:
            inside = np.flatnonzero((log.t > low - half) & (log.t < high - half))
            if not len(inside):
                continue
            piece = log.window(int(inside[0]), int(inside[-1]) + 1, log.name)
            if self.first is None:
                piece = replace(piece, provenance=self.provenance())
                self.first = piece
            begin, end = float(piece.t[0]), float(piece.t[-1])
            if self.spans and begin - self.spans[-1][1] < 1.5 * plan.sample_time:
                self.spans[-1] = (self.spans[-1][0], end)
            else:
                self.spans.append((begin, end))
            self.samples += len(piece)
            pieces.append(piece)
        return pieces

    def _turned(self, recording: Recording, start: int) -> Recording:
        """Unwrap angles as if the blocks before were there; `start` is where the next begins."""
        out = []
        for s in recording.signals:
            if s.name in {"psi", *self.vessel.recorded_angles}:
                order = np.argsort(s.t, kind="stable")
                rows = order[np.isfinite(s.value[order]) & np.isfinite(s.t[order])]
                if len(rows):
                    value = s.value.copy()
                    value[rows] = np.unwrap(value[rows])
                    if s.name in self.anchors:
                        turns = np.round((self.anchors[s.name] - value[rows[0]]) / (2 * np.pi))
                        value += 2 * np.pi * turns
                    following = rows[rows >= start]
                    # the same row comes first in the next block; else the last is nearest
                    self.anchors[s.name] = float(
                        value[following[0] if len(following) else rows[-1]]
                    )
                    s = s.with_value(value)
            out.append(s)
        return recording.with_signals(out)
