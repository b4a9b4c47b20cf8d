"""From recordings to logs: one sample time, gaps kept as gaps, provenance kept."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.notebook import Shown, items, table
from greybox.trial.convert.deduplicate import clean_signals
from greybox.trial.convert.derived_channels import complete_channels
from greybox.trial.convert.options import ImportOptions
from greybox.trial.convert.resample import (
    Clock,
    clock,
    covered,
    hold,
    hold_mean,
    interpolate,
    runs,
)
from greybox.trial.convert.time_grid import (
    MIN_SEGMENT,
    Plan,
    extent,
    gap_notes,
    plan_import,
    too_short,
)
from greybox.trial.log import Provenance, TrialLog
from greybox.trial.raw_log import Recording, Signal
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]


@dataclass(frozen=True, repr=False)
class Imported(Shown):
    """The segments of one trial, in order of time.

    Parameters
    ----------
    segments : tuple of TrialLog
        Each without a gap; at least one.
    notes : tuple of str
        What was guessed, derived, skipped.
    """

    segments: tuple[TrialLog, ...]
    notes: tuple[str, ...]

    def summary(self) -> str:
        """Return the segments and notes as text."""
        rows = [f"  {n}: {t} s, {count} samples" for n, t, count in self._rows()]
        return "\n".join([self._line(), *rows, *(f"  note: {n}" for n in self.notes)])

    def _line(self) -> str:
        first = self.segments[0]
        samples = sum(map(len, self.segments))
        return (
            f"{len(self.segments)} segment{'s'[: len(self.segments) != 1]} of {first.vessel.name}: "
            f"{samples} samples every {first.sample_time:g} s"
        )

    def _rows(self) -> list[tuple[str, str, int]]:
        return [(s.name, f"{s.t[0]:.6g} to {s.t[-1]:.6g}", len(s)) for s in self.segments]

    def _parts(self) -> tuple[str, ...]:
        head = ("segment", "time [s]", "samples")
        return table(head, self._rows()), items("Notes", self.notes)


def import_recording(
    recording: Recording,
    vessel: Vessel,
    options: ImportOptions | None = None,
    *,
    fixed: tuple[str, ...] = (),
) -> Imported:
    """Make a log of a recording.

    Parameters
    ----------
    recording : Recording
        Canonical signals, each on its own clock.
    vessel : Vessel
    options : ImportOptions
    fixed : tuple of str
        What was mended before, for the provenance.

    Returns
    -------
    Imported
        One `TrialLog` for each stretch in which every motion sensor gave values.

    Raises
    ------
    LogError
        Nothing moves in the recording, or no stretch is long enough.
    """
    options = options or ImportOptions()
    notes: list[str] = []
    signals = clean_signals(recording, options.origin, notes)
    clocks = signal_clocks(signals, options)
    extents = {n: extent(clocks[n]) for n in signals}
    plan = plan_import(extents, vessel, options, recording.name)
    span = (0, plan.count)
    segments, derived, short = cut_segments(
        signals, recording.text, plan, span, vessel, options, recording.derived
    )
    if len(segments) > 1:
        segments = [replace(s, name=f"{s.name}[{k + 1}]") for k, s in enumerate(segments)]
    spans = [(float(s.t[0]), float(s.t[-1])) for s in segments]
    notes += [*plan.notes, *gap_notes(spans, short, plan.least)]
    if not segments:
        raise too_short(plan)
    origin_notes = [n for n in notes if n not in recording.notes]
    provenance = make_provenance(recording, options, (*recording.notes, *origin_notes), derived)
    provenance = replace(provenance, fixed=fixed)
    segments = [replace(s, provenance=provenance) for s in segments]
    return Imported(tuple(segments), (*recording.notes, *origin_notes, *derived))


def make_provenance(
    recording: Recording, options: ImportOptions, notes: Sequence[str], derived: Sequence[str]
) -> Provenance:
    """Return where a log came from; what was derived before is kept."""
    first = recording.files[0] if recording.files else None
    return Provenance(
        source=", ".join(f.name for f in recording.files) or recording.name,
        sha256=first.sha256 if first and len(recording.files) == 1 else "",
        derived=(*recording.derived, *derived),
        files=tuple((f.name, f.sha256, f.format) for f in recording.files),
        read=tuple(notes),
        epoch=recording.epoch,
        notes=dict(options.notes),
    )


def signal_clocks(
    signals: Mapping[str, Signal],
    options: ImportOptions,
    periods: Mapping[str, float] | None = None,
) -> dict[str, Clock]:
    """Return the clock of each signal; those that share their times share it."""
    found: dict[tuple[int, float | None], Clock] = {}
    clocks = {}
    for name, s in signals.items():
        if not len(s):
            continue
        period = None if periods is None else periods[name]
        key = (id(s.t), period)
        if key not in found:
            found[key] = clock(s.t, options.hole, period)
        clocks[name] = found[key]
    return clocks


def cut_segments(
    signals: Mapping[str, Signal],
    text: Mapping[str, tuple[Array, NDArray[Any]]],
    plan: Plan,
    span: tuple[int, int],
    vessel: Vessel,
    options: ImportOptions,
    earlier: Sequence[str] = (),
) -> tuple[list[TrialLog], tuple[str, ...], int]:
    """Make the segments among samples `span` of a plan.

    `earlier` is what was derived before, where the source is a log that greybox wrote.

    Returns
    -------
    segments : list of TrialLog
    derived : tuple of str
        What was derived.
    short : int
        Stretches that were too short.
    """
    grid = plan.grid(*span)
    signals = {n: s for n, s in signals.items() if n in plan.periods and len(s)}
    if len(signals) < len(plan.periods):
        # a whole block without one signal is a gap in it
        return [], (), 0
    clocks = signal_clocks(signals, options, plan.periods)
    keep = np.ones(len(grid), bool)
    for c in {id(clocks[n]): clocks[n] for n in plan.leading}.values():
        keep &= covered(grid, c)
    channels = _resample(signals, clocks, vessel, grid, plan.sample_time)
    everything = runs(keep)
    stretches = [r for r in everything if r[1] - r[0] >= plan.least]
    held = {n: (clock(t), words) for n, (t, words) in text.items() if len(t)}
    segments = []
    derived: tuple[str, ...] = ()
    for start, stop in stretches:
        part = {n: v[start:stop] for n, v in channels.items()}
        part, made, trim = complete_channels(part, vessel, plan.sample_time, options, earlier)
        derived = tuple(made)
        closed, known = _loop(held, vessel, grid[start:stop])
        log = TrialLog(
            plan.name, plan.sample_time, grid[start:stop], part, vessel, closed, known,
            Provenance(plan.name),
        )  # fmt: skip
        log = log.window(1, len(log) - 1, plan.name) if trim else log
        if len(log) >= MIN_SEGMENT:
            segments.append(log)
    return segments, derived, len(everything) - len(segments)


def _resample(
    signals: Mapping[str, Signal],
    clocks: Mapping[str, Clock],
    vessel: Vessel,
    grid: Array,
    sample_time: float,
) -> dict[str, Array]:
    channels: dict[str, Array] = {}
    commands = set(vessel.recorded_columns)
    for name, s in signals.items():
        of, value = clocks[name], s.value
        if name in vessel.recorded_angles:
            value = np.unwrap(value)
        if len(s.t) == len(grid) and np.abs(s.t - grid).max() < 0.01 * sample_time:
            channels[name] = np.asarray(value, float)
        elif name in commands:
            channels[name] = hold_mean(of, value, grid, sample_time)
        else:
            channels[name] = interpolate(of, value, grid, sample_time)
    return channels


def _loop(
    held: Mapping[str, tuple[Clock, NDArray[np.str_]]], vessel: Vessel, grid: Array
) -> tuple[NDArray[np.bool_], bool]:
    if vessel.closed_loop is None or vessel.closed_loop[0] not in held:
        return np.zeros(len(grid), bool), False
    of, words = held[vessel.closed_loop[0]]
    index = hold(of, np.arange(len(words), dtype=float), grid).astype(int)
    return np.isin(words[index], vessel.closed_loop[1]), True
