"""The first pass over a table that does not fit in memory: its clocks, units and origin."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from greybox.channels import CHANNELS
from greybox.errors import LogError
from greybox.trial.convert.channel_mapping import (
    TimeScale,
    angle_reach,
    angle_unit,
    batch_recording,
    canonical,
    table_columns,
    time_scale,
    unused_mappings,
)
from greybox.trial.convert.column_names import Assigned
from greybox.trial.convert.derived_signals import derive_signals
from greybox.trial.convert.options import ImportOptions
from greybox.trial.convert.resample import clock
from greybox.trial.convert.time_grid import Extent, Plan, extent, plan_import
from greybox.trial.raw_log import Recording, Signal
from greybox.trial.readers.table import Batch, TableFile
from greybox.trial.store import read_record, recorded_provenance
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]

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
    derived : tuple of str
        What was derived before, where the table is a log that greybox wrote.
    """

    assigned: dict[str, Assigned]
    scale: TimeScale
    origin: tuple[float, float] | None
    back: float
    plan: Plan
    notes: tuple[str, ...]
    derived: tuple[str, ...] = ()


def scan_table(table: TableFile, vessel: Vessel, options: ImportOptions) -> Scan:
    """Read a table once and decide on the samples of its log.

    Raises
    ------
    LogError
        As `plan_import`; or time goes back too far to be sorted in blocks.
    """
    record = read_record(table.path)
    if record is not None:
        # what greybox wrote is canonical: a mapping would convert it twice
        vessel = replace(vessel, columns={})
    assigned = table_columns(table, vessel, guess=record is None)
    found = _Found(table, vessel, options, assigned)
    for batch in table.batches([a.raw for a in assigned.values()]):
        found.add(batch)
    if found.scale is None:
        # nothing to measure: the message is that of an empty time column
        time_scale(np.empty(0), assigned["t"], table)
        raise AssertionError
    before = recorded_provenance(record or {})
    if found.scale.epoch is None:
        found.scale = replace(found.scale, epoch=before.epoch)
    if found.back > _MAX_BACK_ROWS * found.usual:
        raise LogError(
            f"time in '{table.path.name}' goes back by {found.back:.6g} s, at most "
            f"{_MAX_BACK_ROWS * found.usual:.6g} s can be put in order in a file of that size: "
            f"sort it, or cut it where time goes back."
        )
    units = {n: angle_unit(reach) for n, reach in found.reach.items()}
    whole = canonical(found.sample, assigned, vessel, found.reach)
    derived = derive_signals(whole, found.origin)
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
            f"time goes back {found.backward} time{'s' if found.backward > 1 else ''}, by "
            f"{found.back:.6g} s at most: put in order"
        )
    if found.repeated:
        notes.append(
            f"{found.repeated} row{'s' if found.repeated > 1 else ''} repeat a time: "
            f"the first is kept"
        )
    return Scan(
        decided, found.scale, found.origin, found.back, plan, (*notes, *plan.notes), before.derived
    )


class _Parts:
    """The clock of one signal, from batch to batch."""

    def __init__(self, hole: float | None) -> None:
        self.hole = hole
        self.last: float | None = None
        self.extents: list[Extent] = []

    def add(self, t: Array) -> None:
        """Add the times of a batch; they begin with the last time of the one before."""
        if self.last is not None:
            t = np.concatenate([[self.last], t])
        if len(t) > 1 and not (np.diff(t) > 0).all():
            t = np.unique(t)
        if len(t) > 1:
            part = extent(clock(t, self.hole))
            self.extents.append(part if self.last is None else replace(part, count=part.count - 1))
            self.last = part.last
        elif len(t) and self.last is None:
            self.last = float(t[0])
            self.extents.append(extent(clock(t, self.hole)))

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
        recording = canonical(raw, self.assigned, self.vessel)
        if not self.sample.signals:
            self.sample, self.raw = _head(raw), recording
        if self.origin is None:
            self.origin = _first_position(recording)
        keeps: dict[tuple[int, bytes], Array] = {}
        for s in derive_signals(recording, self.origin).signals:
            keep = np.isfinite(s.t) & np.isfinite(s.value)
            t = keeps.setdefault((id(s.t), np.packbits(keep).tobytes()), s.t[keep])
            self.parts.setdefault(s.name, _Parts(self.options.hole)).add(t)

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


def _head(recording: Recording) -> Recording:
    """Return the first values of a recording, enough to name what is derived of them."""
    return recording.with_signals(
        Signal(s.name, s.t[:100], s.value[:100], s.unit, s.source, s.canonical)
        for s in recording.signals
    )


def _first_position(recording: Recording) -> tuple[float, float] | None:
    if "lat" not in recording or "lon" not in recording:
        return None
    lat, lon = recording["lat"].value, recording["lon"].value
    good = np.flatnonzero(np.isfinite(lat) & np.isfinite(lon))
    return (float(lat[good[0]]), float(lon[good[0]])) if len(good) else None
