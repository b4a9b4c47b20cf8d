"""From recordings to logs: one sample time, gaps kept as gaps, provenance kept."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.errors import LogError
from greybox.trial.completing import complete_channels
from greybox.trial.deriving import derive_signals
from greybox.trial.log import Provenance, TrialLog
from greybox.trial.options import ImportOptions
from greybox.trial.recording import Recording, Signal
from greybox.trial.resampling import (
    Clock,
    clock,
    covered,
    hold,
    hold_mean,
    interpolate,
    nice_period,
    runs,
    usual_step,
)
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]

_MOTION = ("x_n", "y_n", "psi", "u", "v", "r", "v_n", "v_e")
_WIND = ("u_q", "v_q", "w_n", "w_e", "w_x", "w_y")
_BODY, _EARTH, _PLACE = frozenset({"u", "v"}), frozenset({"v_n", "v_e"}), frozenset({"x_n", "y_n"})
# what serves as well as a motion signal
_INSTEAD: dict[str, tuple[frozenset[str], ...]] = {
    "r": (frozenset({"psi"}),), "v_n": (_BODY, _PLACE), "v_e": (_BODY, _PLACE),
    "x_n": (_BODY, _EARTH), "y_n": (_BODY, _EARTH), "u": (_EARTH, _PLACE), "v": (_EARTH, _PLACE),
}  # fmt: skip
_MIN_SEGMENT = 3
# a grid of more samples than this many times those read is a mistake in the times
_MAX_GROWTH = 50
# share of uneven steps below which missing values are a hole and not a quiet sensor
_STEADY = 0.05
# share of the time of the longest signal that another must cover to be of use
_ENOUGH = 0.5
# usual steps by which time may go back without there being two runs in a file
_FAR = 50.0
_MAX_RUNS = 1000


@dataclass(frozen=True)
class Imported:
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


@dataclass(frozen=True)
class Extent:
    """What the samples of a log depend on of one signal's clock.

    Parameters
    ----------
    first, last : float
        [s]
    count : int
        Values.
    period, mean : float
        Usual step, and mean step in the longest stretch without a hole [s].
    covered : float
        Time within stretches [s].
    irregular : int
        Steps within stretches that are not the usual one.
    """

    first: float
    last: float
    count: int
    period: float
    mean: float
    covered: float
    irregular: int

    @property
    def steady(self) -> bool:
        """Whether the signal comes at its own rate, so that missing values are a hole."""
        return self.count > 2 and self.irregular < _STEADY * self.count


def extent(of: Clock) -> Extent:
    """Return what the samples of a log depend on of a clock."""
    return Extent(
        float(of.t[0]), float(of.t[-1]), len(of.t), of.period, of.mean, of.covered, of.irregular
    )


@dataclass(frozen=True)
class Plan:
    """The samples of a log, and which signals it is made of.

    Parameters
    ----------
    name : str
    sample_time, start : float
        [s]
    count : int
        Samples, those in gaps included.
    periods : mapping of str to float
        Usual step of each signal that is used [s].
    leading : tuple of str
        Signals whose holes are gaps.
    notes : tuple of str
    least : int
        Samples of the shortest stretch that is kept.
    """

    name: str
    sample_time: float
    start: float
    count: int
    periods: Mapping[str, float]
    leading: tuple[str, ...]
    notes: tuple[str, ...]
    least: int

    def grid(self, first: int, stop: int) -> Array:
        """Return the times of some samples [s]."""
        # rounding keeps 0.3 from becoming 0.30000000000000004 in the file
        return np.round(self.start + self.sample_time * np.arange(first, stop), 9)


def clean_signals(
    recording: Recording, origin: tuple[float, float] | None, notes: list[str]
) -> dict[str, Signal]:
    """Return the signals in order of time, each time once, derived ones among them."""
    recording = in_order(recording, notes)
    made = derive_signals(recording, origin)
    notes += made.notes[len(recording.notes) :]
    repeated: dict[int, tuple[str, int]] = {}
    signals: dict[str, Signal] = {}
    clocks: dict[tuple[int, bytes], Array] = {}
    for s in made.signals:
        keep = np.isfinite(s.value) & np.isfinite(s.t)
        once = np.concatenate([[True], np.diff(s.t) > 0]) if len(s) else keep
        if not once.all():
            repeated.setdefault(id(s.t), (s.name, int((~once).sum())))
            keep &= _first_kept(s.t, keep)
        if not keep.all():
            # signals that keep the same rows go on sharing their clock
            t = clocks.setdefault((id(s.t), np.packbits(keep).tobytes()), s.t[keep])
            s = replace(s, t=t, value=s.value[keep])
        signals[s.name] = s
    for name, count in repeated.values():
        notes.append(
            f"{count} value{'s' if count > 1 else ''} of {name} repeat a time: the first is kept"
        )
    return signals


def _first_kept(t: Array, keep: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether each is the first of those kept at its time, (N,)."""
    rows = np.flatnonzero(keep)
    first = np.zeros(len(t), bool)
    first[rows[np.concatenate([[True], np.diff(t[rows]) > 0])] if len(rows) else rows] = True
    return first


def in_order(recording: Recording, notes: list[str]) -> Recording:
    """Return the recording with every signal and text in order of time.

    Raises
    ------
    LogError
        Time goes back over what was recorded before: there are two runs in it.
    """
    orders: dict[int, tuple[NDArray[np.int64], Array] | None] = {}

    def order(t: Array, name: str) -> tuple[NDArray[np.int64], Array] | None:
        if id(t) not in orders:
            orders[id(t)] = _order(t, name, recording.name, notes)
        return orders[id(t)]

    signals = []
    for s in recording.signals:
        found = order(s.t, s.name)
        signals.append(s if found is None else replace(s, t=found[1], value=s.value[found[0]]))
    text = {}
    for name, (t, words) in recording.text.items():
        found = order(t, name)
        text[name] = (t, words) if found is None else (found[1], words[found[0]])
    return replace(recording, signals=tuple(signals), text=text)


def _order(
    t: Array, signal: str, name: str, notes: list[str]
) -> tuple[NDArray[np.int64], Array] | None:
    steps = np.diff(t)
    if (steps >= 0).all() and np.isfinite(t).all():
        return None
    rows = np.flatnonzero(np.isfinite(t))
    ordered = t[rows]
    back = np.flatnonzero(np.diff(ordered) < 0)
    if len(back):
        _refuse_two_runs(ordered, back, signal, name)
        notes.append(
            f"time of {signal} goes back {len(back)} time{'s' if len(back) > 1 else ''}, first "
            f"from {ordered[back[0]]:.6g} to {ordered[back[0] + 1]:.6g} s: put in order"
        )
        rows = rows[np.argsort(ordered, kind="stable")]
    return rows, t[rows]


def _refuse_two_runs(t: Array, back: NDArray[np.int64], signal: str, name: str) -> None:
    """Refuse times that go back far, over times that are there already."""
    usual = usual_step(np.sort(t)) or float(np.median(np.abs(np.diff(t))))
    far = back[t[back] - t[back + 1] > _FAR * usual]
    edges = np.concatenate([[0], far + 1, [len(t)]])
    if len(far) > _MAX_RUNS:
        return
    spans = sorted((t[a:b].min(), t[a:b].max()) for a, b in pairwise(edges))
    for (_, stop), (start, end) in pairwise(spans):
        if min(stop, end) - start > _FAR * usual:
            k = int(far[0])
            raise LogError(
                f"time of {signal} in '{name}' goes back from {t[k]:.6g} to {t[k + 1]:.6g} s, over "
                f"{min(stop, end) - start:.4g} s that are there twice: cut the file there and "
                f"import each run, or mend it with --fix."
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


def plan_import(
    extents: Mapping[str, Extent], vessel: Vessel, options: ImportOptions, name: str
) -> Plan:
    """Decide on the samples of a log.

    Raises
    ------
    LogError
        Nothing moves in the recording, or its signals do not overlap; a window
        of smoothing is too short or too long.
    """
    notes = [
        f"{n} has {e.count} value{'s' if e.count != 1 else ''}: left out"
        for n, e in extents.items()
        if e.count < _MIN_SEGMENT
    ]
    commands = set(vessel.commands)
    used = {
        n: e
        for n, e in extents.items()
        if e.count >= _MIN_SEGMENT and n in {*_MOTION, *_WIND, *commands}
    }
    motion = [n for n in _MOTION if n in used]
    inputs = [c for c in vessel.commands if c in used]
    if not motion and not inputs:
        raise LogError(
            f"'{name}' has no position, heading, velocity or thruster column with values among "
            f"{', '.join(extents) or 'nothing'}: map its columns in the vessel file."
        )
    missing = [c for c in vessel.commands if c not in used]
    if missing:
        notes.append(
            f"no thruster column {', '.join(missing)}: motion only, no force model can be fitted"
        )
    most = max(used[n].covered for n in (motion or inputs))
    brief = {n for n in used if n not in commands and used[n].covered < _ENOUGH * most}
    for n in sorted(brief):
        others = used.keys() - brief
        # a sensor that soon died must not take the others with it, where they do without
        if n in _WIND or any(pair <= others for pair in _INSTEAD.get(n, ())):
            notes.append(f"{n} covers {used[n].covered:.4g} of {most:.4g} s: left out")
            used.pop(n)
    leading = [n for n in _MOTION if n in used] or inputs
    sample_time = options.sample_time or _sample_time([used[n] for n in leading])
    held = [n for n in used if n not in leading and used[n].steady]
    late = [n for n in inputs if n not in leading and n not in held]
    leading = [*leading, *held]
    start = max(used[n].first for n in (*leading, *late))
    stop = min(used[n].last for n in leading)
    # a held value lasts until the next would have come
    if stop - start < (_MIN_SEGMENT - 1) * sample_time * (1 - 1e-6):
        one = max((*leading, *late), key=lambda n: used[n].first)
        two = min(leading, key=lambda n: used[n].last)
        raise LogError(
            f"the signals of '{name}' overlap from {start:.6g} s ({one}) to {stop:.6g} s ({two}), "
            f"less than {_MIN_SEGMENT} samples of {sample_time:g} s: check the clocks of the "
            f"files, or choose a shorter sample time."
        )
    values = sum(used[n].count for n in leading)
    samples = (stop - start) / sample_time + 1
    if samples > _MAX_GROWTH * values + 1000:
        raise LogError(
            f"'{name}' spans {stop - start:.4g} s, {samples:.4g} samples of {sample_time:g} s, but "
            f"holds {values} values: correct its times, or choose a longer sample time."
        )
    longest = max(e.last for e in used.values()) - min(e.first for e in used.values())
    if stop - start < 0.9 * longest:
        one = max((*leading, *late), key=lambda n: used[n].first)
        two = min(leading, key=lambda n: used[n].last)
        notes.append(
            f"of {longest:.4g} s, {start:.6g} s ({one} begins) to {stop:.6g} s ({two} ends) are "
            f"covered by every signal"
        )
    count = int(np.floor((stop - start) / sample_time + 1e-6)) + 1
    return Plan(
        name,
        sample_time,
        start,
        count,
        {n: e.period for n, e in used.items()},
        tuple(leading),
        tuple(notes),
        max([_MIN_SEGMENT, *_windows(options, count, sample_time)]),
    )


def _windows(options: ImportOptions, count: int, sample_time: float) -> Iterator[int]:
    """Yield the samples of each window of smoothing."""
    if options.smooth:
        from greybox.trial.smoothing import window_samples
    for name, seconds in options.smooth.items():
        try:
            yield window_samples(count, sample_time, seconds)
        except LogError as error:
            raise LogError(f"{name} cannot be smoothed: {error}") from None


def _sample_time(extents: list[Extent]) -> float:
    slowest = max(extents, key=lambda e: e.period)
    if slowest.period <= 0:
        raise LogError("the motion sensors have one sample each: name a longer recording.")
    near = abs(slowest.mean - slowest.period) < 0.2 * slowest.mean
    return nice_period(slowest.mean if near else slowest.period)


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
        if len(log) >= _MIN_SEGMENT:
            segments.append(log)
    return segments, derived, len(everything) - len(segments)


def gap_notes(spans: Sequence[tuple[float, float]], short: int, least: int) -> list[str]:
    """Say how many gaps there are between spans [s], and what was too short to keep."""
    notes = []
    if short:
        notes.append(
            f"{short} stretch{'es' if short > 1 else ''} of fewer than {least} samples left out"
            f"{', since none can be smoothed' if least > _MIN_SEGMENT else ''}"
        )
    gaps = [(a[1], b[0]) for a, b in pairwise(spans)]
    if gaps:
        longest = max(gaps, key=_length)
        notes.append(
            f"{len(gaps)} gap{'s' if len(gaps) > 1 else ''} kept as such, the longest of "
            f"{_length(longest):.3g} s at t = {longest[0]:.6g} s: {len(spans)} segments"
        )
    return notes


def too_short(plan: Plan) -> LogError:
    """Return the error of a plan without a segment."""
    other = " or a shorter window of smoothing" if plan.least > _MIN_SEGMENT else ""
    return LogError(
        f"'{plan.name}' has {plan.count} samples of {plan.sample_time:g} s but no "
        f"{plan.least} that follow each other in which {', '.join(plan.leading)} all have "
        f"values (two more where velocities are derived): choose another sample time or "
        f"hole{other}."
    )


def _length(gap: tuple[float, float]) -> float:
    return gap[1] - gap[0]


def _resample(
    signals: Mapping[str, Signal],
    clocks: Mapping[str, Clock],
    vessel: Vessel,
    grid: Array,
    sample_time: float,
) -> dict[str, Array]:
    channels: dict[str, Array] = {}
    commands = set(vessel.commands)
    for name, s in signals.items():
        of, value = clocks[name], s.value
        if name in vessel.angle_commands:
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
