"""The one way from a recording to logs: time grid, resampling, corrections, derived channels.

A clean log that is read, the raw files of a trial and the blocks of a large one all go it.
What was measured is corrected before anything is made of it, so that velocities and wind
inherit no defect that is known.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from greybox.errors import LogError, so_many
from greybox.notebook import DisplayMixin, items, table
from greybox.trial.convert.deduplicate import clean_signals
from greybox.trial.convert.derived_signals import complete_channels, continuous
from greybox.trial.convert.options import ImportOptions
from greybox.trial.convert.resample import (
    AVERAGED,
    HELD,
    Clock,
    clock,
    held_rows,
    hold,
    hold_mean,
    interpolate,
    resampled_by,
)
from greybox.trial.convert.sensor_corrections import clock_shift_error, correct_channels
from greybox.trial.convert.time_grid import (
    MIN_SEGMENT,
    Plan,
    extent,
    gap_notes,
    plan_import,
    too_short,
)
from greybox.trial.kinematics import carried_gaps
from greybox.trial.log import Provenance, TrialLog
from greybox.trial.raw_log import Array, Mask, Recording
from greybox.trial.segments import numbered
from greybox.trial.steps import Step, Value
from greybox.vessel.conditions import Conditions
from greybox.vessel.vessel import Vessel


@dataclass(frozen=True, repr=False)
class Imported(DisplayMixin):
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
        rows = [f"  {n}: {t} s, {so_many(count, 'sample')}" for n, t, count in self._rows()]
        return "\n".join([self._line(), *rows, *(f"  note: {n}" for n in self.notes)])

    def _line(self) -> str:
        first = self.segments[0]
        samples = sum(map(len, self.segments))
        return (
            f"{so_many(len(self.segments), 'segment')} of {first.vessel.name}: "
            f"{so_many(samples, 'sample')} every {first.sample_time:g} s"
        )

    def _rows(self) -> list[tuple[str, str, int]]:
        return [(s.name, f"{s.t[0]:.6g} to {s.t[-1]:.6g}", len(s)) for s in self.segments]

    def _parts(self) -> tuple[str, ...]:
        head = ("segment", "time [s]", "samples")
        return table(head, self._rows()), items("Notes", self.notes)


@dataclass(frozen=True)
class Conversion:
    """What turns signals of one trial into its log, the same for all of its stretches.

    Parameters
    ----------
    vessel : Vessel
    options : ImportOptions
    plan : Plan
    before : tuple of Step
        What was done to the signals already.
    """

    vessel: Vessel
    options: ImportOptions
    plan: Plan
    before: tuple[Step, ...] = ()


@dataclass(frozen=True)
class Cut:
    """Segments of a log that were cut out of its signals.

    Parameters
    ----------
    segments : list of TrialLog
    steps : tuple of Step
        What was done to their channels.
    notes : tuple of str
    short : int
        Stretches that were too short.
    late : bool
        Whether some of them were, since clocks had to be moved.
    held : mapping of str to ndarray
        Times of the rows in which a channel holds the value before [s].
    """

    segments: list[TrialLog]
    steps: tuple[Step, ...] = ()
    notes: tuple[str, ...] = ()
    short: int = 0
    late: bool = False
    held: Mapping[str, Array] = field(default_factory=dict)

    def held_in(self, log: TrialLog) -> dict[str, int]:
        """Return in how many rows of a log, cut out of these segments, each channel is held."""
        half = 0.5 * log.sample_time
        low, high = log.t[0] - half, log.t[-1] + half
        return {n: int(np.count_nonzero((t > low) & (t < high))) for n, t in self.held.items()}

    def refusal(self, conversion: Conversion) -> LogError:
        """Return why there is no segment."""
        if self.late:
            return clock_shift_error(conversion.vessel, conversion.plan.name)
        return too_short(conversion.plan)


def import_recording(
    recording: Recording, vessel: Vessel, options: ImportOptions | None = None
) -> Imported:
    """Make a log of a recording.

    Parameters
    ----------
    recording : Recording
        Canonical signals, each on its own clock.
    vessel : Vessel
        The defects that its ``[sensors]`` states are taken out.
    options : ImportOptions

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
    clean = clean_signals(recording, options.origin)
    clocks = signal_clocks(clean, options)
    plan = plan_import({n: extent(c) for n, c in clocks.items()}, vessel, options, clean.name)
    conversion = Conversion(vessel, options, plan, clean.steps)
    cut = cut_segments(clean, conversion)
    segments = numbered(cut.segments, plan.name)
    spans = [(float(s.t[0]), float(s.t[-1])) for s in segments]
    if not segments:
        raise cut.refusal(conversion)
    notes = (*clean.notes, *plan.notes, *gap_notes(spans, cut.short, plan.least), *cut.notes)
    held: Counter[str] = Counter()
    for s in segments:
        held.update(cut.held_in(s))
    rows = sum(map(len, segments))
    made = replace(clean, notes=notes).with_steps(*cut.steps, *hold_steps(held, rows))
    provenance = make_provenance(made, options, vessel.conditions)
    segments = [replace(s, provenance=provenance) for s in segments]
    done = made.steps[len(recording.steps) :]
    return Imported(tuple(segments), (*notes, *(s.sentence for s in done)))


def hold_steps(held: Mapping[str, int], rows: int) -> tuple[Step, ...]:
    """Return the step that says in how many of some rows each channel holds the value before."""
    counts = {n: float(count) for n, count in held.items() if count}
    parameters: dict[str, Value] = {"rows": tuple(counts.values()), "of": float(rows)}
    return (Step("hold", tuple(counts), parameters=parameters),) if counts else ()


def make_provenance(
    recording: Recording, options: ImportOptions, default: Conditions
) -> Provenance:
    """Return where a log came from and what was done, as its recording says at the end.

    `default` are the conditions where neither the recording nor the options state any.
    """
    first = recording.files[0] if recording.files else None
    return Provenance(
        source=", ".join(f.name for f in recording.files) or recording.name,
        sha256=first.sha256 if first and len(recording.files) == 1 else "",
        steps=recording.steps,
        files=tuple((f.name, f.sha256, f.format) for f in recording.files),
        read=recording.notes,
        epoch=recording.epoch,
        notes=dict(options.notes),
        conditions=options.conditions.over(recording.conditions).over(default),
    )


def signal_clocks(
    recording: Recording, options: ImportOptions, periods: Mapping[str, float] | None = None
) -> dict[str, Clock]:
    """Return the clock of each signal; those that share their times share it."""
    found: dict[tuple[int, float | None], Clock] = {}
    clocks = {}
    for s in recording.signals:
        if not len(s):
            continue
        period = None if periods is None else periods[s.name]
        key = (id(s.t), period)
        if key not in found:
            found[key] = clock(s.t, options.max_gap, period, recording.cuts)
        clocks[s.name] = found[key]
    return clocks


def cut_segments(
    recording: Recording, conversion: Conversion, span: tuple[int, int] | None = None
) -> Cut:
    """Make the segments among some samples of a plan: resample, correct, derive.

    Parameters
    ----------
    recording : Recording
        Signals in order of time, each time once.
    conversion : Conversion
    span : tuple of int, optional
        First sample, and the one after the last; all of the plan by default.
    """
    vessel, plan = conversion.vessel, conversion.plan
    grid = plan.grid(*(span or (0, plan.count)))
    used = recording.with_signals(s for s in recording.signals if s.name in plan.periods and len(s))
    if len(used.signals) < len(plan.periods):
        # a whole block without one signal is a gap in it
        return Cut([])
    clocks = signal_clocks(used, conversion.options, plan.periods)
    channels, kept = _resample(used, clocks, vessel, grid, plan.sample_time)
    everything = plan.stretches(grid, clocks, recording.cuts)
    held = {n: (clock(t), words) for n, (t, words) in recording.text.items() if len(t)}
    gaps = plan.gaps(grid, used, clocks)
    segments = []
    steps: tuple[Step, ...] = ()
    notes: tuple[str, ...] = ()
    late = False
    for start, stop in everything:
        if stop - start < plan.least:
            continue
        measured = {n: v[start:stop] for n, v in channels.items()}
        corrected = correct_channels(measured, plan.sample_time, vessel, conversion.before)
        first, last = start + corrected.before, stop - corrected.after
        if last - first < plan.least:
            late = True
            continue
        own = slice(corrected.before, stop - start - corrected.after)
        made = complete_channels(
            {n: v[own] for n, v in corrected.channels.items()},
            vessel, plan.sample_time, conversion.options, conversion.before,
        )  # fmt: skip
        steps, notes = (*plan.steps, *corrected.steps, *made.steps), corrected.notes
        missing = {n: m[start:stop] for n, m in gaps.items()}
        missing = carried_gaps(missing, corrected.steps, plan.sample_time)
        missing = carried_gaps(
            {n: m[own] for n, m in missing.items()}, made.steps, plan.sample_time
        )
        missing = {n: m for n, m in missing.items() if n in made.channels}
        closed, known = _loop(held, vessel, grid[first:last])
        log = TrialLog(
            plan.name, plan.sample_time, grid[first:last], made.channels, vessel, closed, known,
            Provenance(plan.name), missing,
        )  # fmt: skip
        log = log.window(1, len(log) - 1, plan.name) if made.trim else log
        # a clock of what was made only now
        more = correct_channels(
            log.channels, plan.sample_time, vessel, (*conversion.before, *steps)
        )
        if more.steps:
            first, last = more.before, len(log) - more.after
            if last - first < plan.least:
                late = True
                continue
            steps = (*steps, *more.steps)
            missing = carried_gaps(log.missing, more.steps, plan.sample_time)
            log = replace(log, channels=more.channels, missing=missing)
            log = log.window(first, last, plan.name)
        log = _between_known(log)
        if len(log) >= MIN_SEGMENT:
            segments.append(log)
    return Cut(segments, steps, notes, len(everything) - len(segments), late, kept)


def _between_known(log: TrialLog) -> TrialLog:
    """Return a log from its first to its last sample that holds every motion of its model."""
    if not log.missing:
        return log
    known = np.flatnonzero(log.known(("u", "v", "r", "psi")))
    return log.window(known[0], known[-1] + 1, log.name) if len(known) else log.window(0, 0)


def _resample(
    recording: Recording,
    clocks: Mapping[str, Clock],
    vessel: Vessel,
    grid: Array,
    sample_time: float,
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Return the channels on a grid, and the times at which they hold the value before."""
    channels: dict[str, Array] = {}
    held: dict[str, Array] = {}
    commands = set(vessel.recorded_columns)
    for s in recording.signals:
        name, of, value = s.name, clocks[s.name], s.value
        if name in vessel.recorded_angles - vessel.rudders:
            value = continuous(value)
        if len(s.t) == len(grid) and np.abs(s.t - grid).max() < 0.01 * sample_time:
            channels[name] = np.asarray(value, float)
            continue
        how = resampled_by(of.period, sample_time, held=name in commands)
        if name in commands:
            channels[name] = hold_mean(of, value, grid, sample_time)
        else:
            channels[name] = interpolate(of, value, grid, sample_time)
        if name in commands or how == HELD:
            held[name] = grid[held_rows(of, grid, sample_time, averaged=how == AVERAGED)]
    return channels, held


def _loop(
    held: Mapping[str, tuple[Clock, NDArray[np.str_]]], vessel: Vessel, grid: Array
) -> tuple[Mask, bool]:
    if vessel.closed_loop is None or vessel.closed_loop[0] not in held:
        return np.zeros(len(grid), bool), False
    of, words = held[vessel.closed_loop[0]]
    index = hold(of, np.arange(len(words), dtype=float), grid).astype(int)
    return np.isin(words[index], vessel.closed_loop[1]), True
