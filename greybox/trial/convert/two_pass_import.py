"""Import of a table of any size in two passes, in blocks that fit in memory.

The first pass finds clocks, units and origin, from which the samples of the log are planned;
the second goes the way of every import (`greybox.trial.convert.convert`) block by block.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain, islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.channels import CHANNELS
from greybox.errors import LogError, so_many
from greybox.files import sha256
from greybox.trial.convert.channel_mapping import (
    angle_reach,
    angle_unit,
    batch_recording,
    canonical,
    reading_steps,
    speed_unit,
    table_columns,
    unused_mappings,
    without_false_positions,
    written_log,
)
from greybox.trial.convert.column_names import Assigned, is_short_pair
from greybox.trial.convert.convert import (
    Conversion,
    Cut,
    cut_segments,
    hold_steps,
    make_provenance,
)
from greybox.trial.convert.deduplicate import clean_signals
from greybox.trial.convert.derived_signals import continuous, derive_signals, places
from greybox.trial.convert.options import ImportOptions
from greybox.trial.convert.resample import clock
from greybox.trial.convert.time_grid import Extent, Plan, extent, gap_notes, plan_import
from greybox.trial.convert.time_scale import TimeScale, time_scale
from greybox.trial.gaps import joined_spans
from greybox.trial.log import Provenance, TrialLog
from greybox.trial.raw_log import Array, Recording, Signal, SourceFile
from greybox.trial.readers.table import Batch, TableFile
from greybox.trial.readers.topic_files import TopicTable
from greybox.trial.steps import Step, new_steps
from greybox.vessel.conditions import Conditions
from greybox.vessel.vessel import Vessel

# tables that may hold more numbers are imported in blocks
_LARGE_CELLS = 20_000_000
_BLOCK_ROWS = 300_000
# of the first block, what names the channels that are derived, and what actuators are measured by
_SAMPLE_ROWS, _ACTUATOR_ROWS = 100, 40_000
# samples on both sides of a block that are made with it and not kept
_MARGIN = 4
# time may go back by this share of what a block spans: more cannot be sorted in blocks
_MAX_BACK_ROWS = 10_000


@dataclass(frozen=True)
class Scan:
    """What must be known of a table before its first block can be imported.

    Parameters
    ----------
    assigned : dict of str to Assigned
        Which column is which signal, units decided.
    scale : TimeScale
    origin : tuple of float, optional
        Latitude and longitude [deg] of the first position.
    back : float
        By how much time goes back at most [s].
    plan : Plan
    notes : tuple of str
    before : tuple of Step
        What was done before, where the table is a log that greybox wrote, and by reading it.
    conditions : Conditions
        Of the trial, where the record of that log tells.
    """

    assigned: dict[str, Assigned]
    scale: TimeScale
    origin: tuple[float, float] | None
    back: float
    plan: Plan
    notes: tuple[str, ...]
    before: tuple[Step, ...]
    conditions: Conditions


def scan_table(table: TableFile, vessel: Vessel, options: ImportOptions) -> Scan:
    """Read a table once and decide on the samples of its log.

    Raises
    ------
    LogError
        As `plan_import`; or time goes back too far to be sorted in blocks.
    """
    before, vessel = written_log(table.path, vessel)
    assigned = table_columns(table, vessel, guess=before is None)
    if is_short_pair(assigned):
        pair = [assigned["x_n"].raw, assigned["y_n"].raw]
        for first in islice(table.batches(pair), 1):
            assigned = without_false_positions(assigned, first)
    found = _Found(table, vessel, options, assigned)
    for batch in table.batches([a.raw for a in assigned.values()]):
        found.add(batch)
    if found.scale is None:
        # nothing to measure: the message is that of an empty time column
        time_scale(np.empty(0), assigned["t"], table)
        raise AssertionError
    before = before or Provenance()
    if found.scale.epoch is None:
        found.scale = replace(found.scale, epoch=before.epoch)
    if found.back > _MAX_BACK_ROWS * found.usual:
        raise LogError(
            f"time in '{table.path.name}' goes back by {found.back:.6g} s, at most "
            f"{_MAX_BACK_ROWS * found.usual:.6g} s can be put in order in a file of that size: "
            f"sort it, or cut it where time goes back."
        )
    units = {n: angle_unit(reach) for n, reach in found.reach.items()}
    if "sog" in assigned and assigned["sog"].unit is None:
        units["sog"] = found.speed or "m/s"
    whole = canonical(found.sample, assigned, vessel, found.reach, found.speed)
    derived = derive_signals(whole, found.origin)
    steps = (*before.steps, *reading_steps(table, found.scale))
    decided = {n: replace(a, unit=units[n]) if n in units else a for n, a in assigned.items()}
    extents = {n: parts.extent() for n, parts in found.parts.items()}
    plan = plan_import(extents, vessel, options, table.path.stem)
    notes = [
        *found.scale.notes,
        *derived.notes,
        *unused_mappings([found.raw], vessel),
    ]
    if found.backward:
        notes.append(
            f"time goes back {so_many(found.backward, 'time')}, by "
            f"{found.back:.6g} s at most: put in order"
        )
    if found.repeated:
        notes.append(
            f"{so_many(found.repeated, 'row', 'repeats', 'repeat')} a time: the first is kept"
        )
    said = (*notes, *plan.notes)
    return Scan(
        decided, found.scale, found.origin, found.back, plan, said, steps, before.conditions
    )


class _Parts:
    """The clock of one signal, from batch to batch."""

    def __init__(self, max_gap: float | None) -> None:
        self.max_gap = max_gap
        self.last: float | None = None
        self.extents: list[Extent] = []

    def add(self, t: Array) -> None:
        """Add the times of a batch; they begin with the last time of the one before."""
        if self.last is not None:
            t = np.concatenate([[self.last], t])
        if len(t) > 1 and not (np.diff(t) > 0).all():
            t = np.unique(t)
        if len(t) > 1:
            part = extent(clock(t, self.max_gap))
            self.extents.append(part if self.last is None else replace(part, count=part.count - 1))
            self.last = part.last
        elif len(t) and self.last is None:
            self.last = float(t[0])
            self.extents.append(extent(clock(t, self.max_gap)))

    def extent(self) -> Extent:
        """Return the whole: the usual step is the median over batches, by their counts."""
        parts = [e for e in self.extents if e.period > 0] or self.extents
        order = sorted(parts, key=lambda e: e.period)
        share = np.cumsum([e.count for e in order])
        middle = order[int(np.searchsorted(share, share[-1] / 2))]
        near = [e for e in parts if abs(e.period - middle.period) <= 0.01 * middle.period]
        return Extent(
            min(e.first for e in self.extents),
            max(e.last for e in self.extents),
            sum(e.count for e in self.extents),
            middle.period,
            max(near, key=lambda e: e.covered).mean,
            sum(e.covered for e in self.extents),
            sum(e.irregular for e in self.extents),
        )


class _Found:
    """What has been seen so far of a table."""

    def __init__(
        self,
        table: TableFile,
        vessel: Vessel,
        options: ImportOptions,
        assigned: dict[str, Assigned],
    ) -> None:
        self.table, self.vessel, self.options, self.assigned = table, vessel, options, assigned
        self.scale: TimeScale | None = None
        self.origin = options.origin
        self.back, self.backward, self.repeated = 0.0, 0, 0
        self.usual = 0.0
        self.newest = -np.inf
        self.parts: dict[str, _Parts] = {}
        self.reach: dict[str, tuple[float, float]] = {}
        self.speed = ""
        self.raw = self.sample = Recording("", ())

    def add(self, batch: Batch) -> None:
        """Take in one batch."""
        time = self.assigned["t"]
        column = batch[time.raw]
        if self.scale is None:
            if not np.isfinite(column).any():
                return
            self.scale = time_scale(column, time, self.table)
        raw = batch_recording(self.table, batch, self.assigned, self.scale, self.vessel)
        t = self.scale.seconds(column)
        good = np.isfinite(t)
        self._order(t[good])
        self._reach(raw)
        self.speed = self.speed or speed_unit(raw, self.assigned, self.vessel)
        recording = canonical(raw, self.assigned, self.vessel, speed=self.speed)
        if not self.sample.signals:
            self.sample, self.raw = _head(raw, _SAMPLE_ROWS), recording
        if self.origin is None:
            self.origin = _first_position(recording)
        keeps: dict[tuple[int, bytes], Array] = {}
        for s in derive_signals(recording, self.origin).signals:
            keep = s.known
            t = keeps.setdefault((id(s.t), np.packbits(keep).tobytes()), s.t[keep])
            self.parts.setdefault(s.name, _Parts(self.options.max_gap)).add(t)

    def _order(self, t: Array) -> None:
        if not len(t):
            return
        steps = np.diff(t)
        if len(steps) and not self.usual:
            self.usual = float(np.median(np.abs(steps)))
        before = np.maximum.accumulate(np.concatenate([[self.newest], t]))
        fall = before[:-1] - t
        fall = fall[np.isfinite(fall)]
        self.backward += int(np.sum(steps < 0))
        self.repeated += int(np.sum(steps == 0))
        self.back = max(self.back, float(fall.max(initial=0.0)))
        self.newest = float(before[-1])

    def _reach(self, raw: Recording) -> None:
        for name, a in self.assigned.items():
            angle = name in self.vessel.recorded_angles or (
                name in CHANNELS and CHANNELS[name].unit == "rad"
            )
            if angle and a.unit is None and a.how != "exact" and a.raw in raw:
                new, old = angle_reach(raw[a.raw].value), self.reach.get(name, (0.0, 0.0))
                self.reach[name] = (max(new[0], old[0]), max(new[1], old[1]))


def _head(recording: Recording, rows: int) -> Recording:
    """Return a copy of the first values of a recording."""
    return recording.with_signals(
        Signal(s.name, s.t[:rows].copy(), s.value[:rows].copy(), s.unit, s.source, s.canonical)
        for s in recording.signals
    )


def _first_position(recording: Recording) -> tuple[float, float] | None:
    if "lat" not in recording or "lon" not in recording:
        return None
    _, lat, lon = places(recording["lat"], recording["lon"])
    good = np.flatnonzero(np.isfinite(lat))
    return (float(lat[good[0]]), float(lon[good[0]])) if len(good) else None


def is_large(table: TableFile) -> bool:
    """Whether a table may not fit in memory, and can be imported in blocks."""
    # axes that only the other signals tell need all of them
    unsure = isinstance(table, TopicTable) and bool(table.unsure)
    return table.cells > _LARGE_CELLS and not unsure


class Stream:
    """The two passes over a table: what is known of it, and what one block leaves to the next.

    Parameters
    ----------
    table : TableFile
    vessel : Vessel
    options : ImportOptions

    Attributes
    ----------
    moved : Recording
        The first commands and feedback of the vessel's actuators.
    """

    def __init__(self, table: TableFile, vessel: Vessel, options: ImportOptions) -> None:
        self.table, self.vessel, self.options = table, vessel, options
        self.scan = scan_table(table, vessel, options)
        self.moved = Recording(table.path.stem, ())
        self.first: TrialLog | None = None
        self._steps: tuple[Step, ...] = ()
        self._held: Counter[str] = Counter()
        self.said: tuple[str, ...] = ()
        self.late = False
        self.done = 0
        self.anchors: dict[str, float] = {}
        self.file = SourceFile(table.path.name, sha256(table.path), table.format)
        self._spans: list[tuple[float, float, int]] = []

    @property
    def reach(self) -> float:
        """Time over which filters and clocks that are moved see their neighbours [s]."""
        late = self.vessel.sensors.get("clock", {}).values()
        return self.options.reach + max((abs(s) for s in late), default=0.0)

    @property
    def halo(self) -> float:
        """Time that blocks share, so that no filter sees a block's end [s]."""
        plan = self.scan.plan
        slowest = max(plan.periods.values())
        return 8 * (plan.sample_time + slowest) + 2 * self.reach + self.scan.back

    @property
    def spans(self) -> list[tuple[float, float, int]]:
        """First and last time [s] and samples of each segment so far."""
        return joined_spans(self._spans, self.scan.plan.sample_time)

    @property
    def steps(self) -> tuple[Step, ...]:
        """What was done to the channels so far."""
        return (*self._steps, *hold_steps(self._held, sum(count for _, _, count in self._spans)))

    def provenance(self) -> Provenance:
        """Return where the log came from, with all that is known by now."""
        gaps = gap_notes([s[:2] for s in self.spans], 0, self.scan.plan.least)
        notes = dict.fromkeys([*self.table.notes, *self.scan.notes, *gaps, *self.said])
        whole = Recording(
            self.table.path.stem, (), epoch=self.scan.scale.epoch, files=(self.file,),
            notes=tuple(notes), steps=(*self.scan.before, *self.steps),
            conditions=self.scan.conditions,
        )  # fmt: skip
        return make_provenance(whole, self.options, self.vessel.conditions)

    def segments(self) -> Iterator[TrialLog]:
        """Yield the pieces of the log in order of time.

        Raises
        ------
        LogError
            A row cannot be read, or there is no piece.
        """
        scan = self.scan
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
            raise Cut([], late=self.late).refusal(self._conversion())

    def _block(self, block: Batch, *, last: bool) -> tuple[int, list[TrialLog]]:
        """Return the first row that the next block needs, and the pieces of this one."""
        scan, plan = self.scan, self.scan.plan
        raw = batch_recording(self.table, block, scan.assigned, scan.scale, self.vessel)
        recording = canonical(raw, scan.assigned, self.vessel, speed="")
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
        if not self.done:
            names = {c for a in self.vessel.actuators for c in (a.command, a.feedback)}
            moved = recording.with_signals(s for s in recording.signals if s.name in names)
            self.moved = _head(moved, _ACTUATOR_ROWS)
        recording = self._turned(recording, start)
        pieces = self._pieces(recording, stop)
        self.done = stop
        return start, pieces

    def _conversion(self, before: tuple[Step, ...] = ()) -> Conversion:
        return Conversion(self.vessel, self.options, self.scan.plan, before)

    def _pieces(self, recording: Recording, stop: int) -> list[TrialLog]:
        scan, plan = self.scan, self.scan.plan
        if stop <= self.done:
            return []
        clean = clean_signals(replace(recording, steps=scan.before), scan.origin)
        # samples beside those wanted, so that stretches do not end where the block does
        margin = _MARGIN + int(np.ceil(self.reach / plan.sample_time))
        span = (max(self.done - margin, 0), min(stop + margin, plan.count))
        cut = cut_segments(clean, self._conversion(clean.steps), span)
        made = (*clean.steps[len(scan.before) :], *cut.steps)
        self._steps += new_steps(self._steps, made)
        self.said = tuple(dict.fromkeys([*self.said, *cut.notes]))
        self.late |= cut.late
        low, high = plan.grid(self.done, self.done + 1)[0], plan.grid(stop, stop + 1)[0]
        half = 0.5 * plan.sample_time
        pieces = []
        for log in cut.segments:
            inside = np.flatnonzero((log.t > low - half) & (log.t < high - half))
            if not len(inside):
                continue
            piece = log.window(int(inside[0]), int(inside[-1]) + 1, log.name)
            if self.first is None:
                piece = replace(piece, provenance=self.provenance())
                self.first = piece
            self._held.update(cut.held_in(piece))
            self._spans.append((float(piece.t[0]), float(piece.t[-1]), len(piece)))
            pieces.append(piece)
        return pieces

    def _turned(self, recording: Recording, start: int) -> Recording:
        """Unwrap angles as if the blocks before were there; `start` is where the next begins."""
        out = []
        for s in recording.signals:
            if s.name in {"psi", *self.vessel.recorded_angles} - self.vessel.rudders:
                order = np.argsort(s.t, kind="stable")
                rows = order[np.isfinite(s.value[order]) & np.isfinite(s.t[order])]
                if len(rows):
                    value = s.value.copy()
                    value[rows] = continuous(value[rows])
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
