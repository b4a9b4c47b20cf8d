"""From a recording in the source's words to canonical signals in SI."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.channels import CHANNELS
from greybox.errors import LogError, suggestion
from greybox.files import sha256
from greybox.trial.convert.column_names import Assigned, assign, is_short_pair
from greybox.trial.convert.derived_signals import wind_state
from greybox.trial.convert.file_clocks import on_one_clock
from greybox.trial.convert.settle_axes import settle_axes
from greybox.trial.log import Provenance
from greybox.trial.raw_log import Recording, Signal, SourceFile
from greybox.trial.readers.formats import open_raw
from greybox.trial.readers.table import Batch, TableFile, read_columns
from greybox.trial.readers.topic_files import STAMP, TopicTable
from greybox.trial.steps import Step, new_steps
from greybox.trial.store import read_record, recorded_provenance
from greybox.units import is_unix_time, time_unit, unit_factor, unix_unit
from greybox.vessel.conditions import Conditions
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]

MOTION = frozenset({"x_n", "y_n", "psi", "u", "v", "r", "v_n", "v_e", "lat", "lon", "sog"})

_HEAD = 10_000
# a position changes from row to row by less than this share of what it spreads over
_SMOOTH = 0.2
_NO_MOTION = "no position, heading or velocity was recognised: map their columns in [columns]"
# files that overlap for less than this share of the shorter one follow one another
_OVERLAP = 0.05


def read_recording(
    path: str | Path, vessel: Vessel, *, guess: bool = True, **options: Any
) -> Recording:
    """Read one raw file into canonical signals.

    Parameters
    ----------
    path : str or Path
        Any format of `open_raw`.
    vessel : Vessel
        Its ``[columns]`` rename and convert.
    guess : bool
        Whether columns that are neither mapped nor canonical are guessed.
    **options
        Handed to the reader.

    Returns
    -------
    Recording
        Canonical names, SI and radians (lat, lon in degrees); ``notes`` state
        every guess. Time is relative to `epoch` where that is known.

    Raises
    ------
    LogError
        The file cannot be read, or has no time.
    """
    return settle_axes(_read(path, vessel, guess=guess, **options), vessel)


def read_trial(paths: Sequence[str | Path], vessel: Vessel, **options: Any) -> Recording:
    """Read the raw files of one trial and merge them on their clocks.

    Parameters
    ----------
    paths : sequence of str or Path
        In any order. Columns of several files may be qualified by their file
        (``az1.data``).
    vessel : Vessel
        Its ``[columns]`` rename and convert.
    **options
        Handed to the readers.

    Returns
    -------
    Recording
        As `read_recording`.

    Raises
    ------
    LogError
        A file cannot be read, or has no time; none tells anything that is known; or the
        files are not of one trial.
    """
    if len(paths) == 1:
        recording = read_recording(paths[0], vessel, **options)
        return recording.with_signals(recording.signals, *unused_mappings([recording], vessel))
    recordings = [_read(p, vessel, alone=False, **options) for p in paths]
    notes = unused_mappings(recordings, vessel)
    kept = [r for r in recordings if r.signals or r.text]
    if not kept:
        raise LogError(
            f"no column of the {len(paths)} files but their times is known: map them in the "
            f"vessel file's [columns], qualified as in '{recordings[0].name}.column'."
        )
    notes += [f"{r.name}: no column but its time is known" for r in recordings if r not in kept]
    kept, moved = on_one_clock(kept, MOTION)
    notes += [s.sentence for s in moved]
    recording = settle_axes(merge(kept).with_steps(*moved), vessel)
    if not MOTION & set(recording.names):
        notes.append(_NO_MOTION)
    return recording.with_signals(recording.signals, *notes)


def _read(
    path: str | Path, vessel: Vessel, *, guess: bool = True, alone: bool = True, **options: Any
) -> Recording:
    """Read one file; `alone` where no other belongs to it, so that it must tell something."""
    raw = open_raw(path, **options)
    if not isinstance(raw, Recording):
        known, vessel = written_log(Path(path), vessel)
        source = SourceFile(raw.path.name, sha256(raw.path), raw.format)
        raw, assigned = table_recording(raw, vessel, guess=guess and known is None, alone=alone)
        raw = replace(raw, files=(source,))
        if known is not None:
            epoch = known.epoch if raw.epoch is None else raw.epoch
            raw = replace(
                raw,
                epoch=epoch,
                steps=(*map(_past, known.steps), *raw.steps),
                conditions=known.conditions,
            )
    else:
        assigned = assign(
            raw.names,
            vessel,
            units={s.name: s.unit for s in raw.signals if s.unit and not s.canonical},
            canonical=[s.name for s in raw.signals if s.canonical],
            guess=guess,
        )
        _guess_commands(raw, assigned, vessel)
    return canonical(raw, assigned, vessel)


def written_log(path: Path, vessel: Vessel) -> tuple[Provenance | None, Vessel]:
    """Return the provenance of a log that greybox wrote, None of any other file.

    With it comes the vessel by which the columns are read: what greybox wrote is canonical,
    and a mapping would convert it twice.
    """
    record = read_record(path)
    if record is None:
        return None, vessel
    return recorded_provenance(record), replace(vessel, columns={})


def table_recording(
    table: TableFile, vessel: Vessel, *, guess: bool = True, alone: bool = True
) -> tuple[Recording, dict[str, Assigned]]:
    """Read the columns of a table that mean something into a recording."""
    assigned = table_columns(table, vessel, guess=guess, alone=alone)
    batch = read_columns(table, [a.raw for a in assigned.values()])
    if is_short_pair(assigned) and not all(
        _travelled(batch[assigned[n].raw]) for n in ("x_n", "y_n")
    ):
        assigned = {n: a for n, a in assigned.items() if n not in ("x_n", "y_n")}
    time = assigned["t"]
    scale = time_scale(batch[time.raw], time, table)
    return whole_recording(table, batch, assigned, scale, vessel, alone=alone), assigned


def whole_recording(
    table: TableFile,
    batch: Batch,
    assigned: dict[str, Assigned],
    scale: TimeScale,
    vessel: Vessel,
    *,
    alone: bool = True,
) -> Recording:
    """Return all columns of a table as a recording that tells what reading them took."""
    recording = batch_recording(table, batch, assigned, scale, vessel, alone=alone)
    if isinstance(table, TopicTable):
        stamped = assigned["t"].raw == STAMP
        unsure = frozenset(n for n, a in assigned.items() if a.raw in table.unsure)
        recording = replace(recording, unsure=unsure, ahead=table.ahead if stamped else None)
    notes = (*table.notes, *scale.notes, *recording.notes)
    return replace(recording, notes=notes, steps=reading_steps(table, scale))


def reading_steps(table: TableFile, scale: TimeScale) -> tuple[Step, ...]:
    """Return what reading the rows of a table took, on the clock of its recording."""
    return tuple(on_zero(s, -scale.zero) for s in table.steps)


def on_zero(step: Step, shift: float) -> Step:
    """Return a step of reading with the places that it names on another zero of time."""
    if step.operation != "pad_fractions":
        return step
    times = tuple(t + shift for t in step.numbers("times"))
    return replace(step, parameters={**step.parameters, "times": times})


def _past(step: Step) -> Step:
    """Return a step of an earlier reading without its places, which are not in this file."""
    if step.operation != "pad_fractions":
        return step
    kept = {k: v for k, v in step.parameters.items() if k not in ("times", "late")}
    return replace(step, parameters=kept)


def table_columns(
    table: TableFile, vessel: Vessel, *, guess: bool = True, alone: bool = True
) -> dict[str, Assigned]:
    """Say which columns of a table to read.

    Raises
    ------
    LogError
        There is no time among them, or it is written in words.
    """
    parts = _parts(table)
    assigned = assign(
        table.columns, vessel, units=table.units, guess=guess, stem=table.path.stem,
        parts={c for of in parts.values() for c in of},
    )  # fmt: skip
    own = {a.raw for a in assigned.values()}
    # what the vessel file maps itself is not made of the same columns once more
    assigned = {n: a for n, a in assigned.items() if not own & set(parts.get(a.raw, ()))}
    if "t" not in assigned:
        raise LogError(
            f"'{table.path.name}' has no column 't'.{suggestion('t', table.columns)} "
            f"Map the time column in the vessel file's [columns] with its unit. "
            f"Its columns: {', '.join(table.columns[:30])}."
        )
    time = assigned["t"].raw
    if time in table.text:
        raise LogError(
            f"column '{time}' of '{table.path.name}' holds words where the time should be: "
            f"write seconds, UNIX time or ISO 8601 (2024-05-01T12:00:00Z), or map another column "
            f"to 't' in [columns]."
        )
    if len(assigned) == 1 and alone:
        raise LogError(
            f"no column of '{table.path.name}' but its time '{time}' is known: map them in the "
            f"vessel file's [columns]. Its columns: {', '.join(table.columns[:30])}."
        )
    return assigned


def _travelled(value: NDArray[Any]) -> bool:
    """Whether values change as positions do: all the time, and little from row to row."""
    if value.dtype == object or not np.isfinite(value).any():
        return False
    value = value[np.isfinite(value)]
    steps = np.diff(value)
    smooth = float(np.sqrt(np.mean(steps**2))) < _SMOOTH * float(np.std(value)) if len(steps) else 0
    return bool(smooth) and float(np.mean(steps == 0)) < 0.5


def _parts(table: TableFile) -> dict[str, tuple[str, ...]]:
    """Return the columns of the file behind each column that is made of others."""
    return table.parts if isinstance(table, TopicTable) else {}


def _listed(columns: Sequence[str]) -> str:
    return ", ".join(f"'{c}'" for c in columns)


@dataclass(frozen=True)
class TimeScale:
    """How a time column becomes relative seconds.

    Parameters
    ----------
    factor : float
        To seconds.
    zero : float
        Value of the column where the time is zero.
    epoch : float, optional
        UNIX time [s] of zero, None where the column counts from a moment of its own.
    notes : tuple of str
    """

    factor: float
    zero: float
    epoch: float | None
    notes: tuple[str, ...] = ()

    def seconds(self, raw: Array) -> Array:
        """Return relative times [s], (N,)."""
        # the difference first: UNIX nanoseconds do not fit a double
        return (raw - self.zero) * self.factor if self.zero else raw * self.factor


def time_scale(raw: Array, time: Assigned, table: TableFile) -> TimeScale:
    """Find out from its first values in what unit a time column is.

    Raises
    ------
    LogError
        It holds no number.
    """
    finite = raw[np.isfinite(raw)]
    if not len(finite):
        raise LogError(
            f"column '{time.raw}' of '{table.path.name}' holds no number among its {len(raw)} "
            f"rows, it cannot be the time: map another column to 't' in [columns]."
        )
    head = finite[:_HEAD]
    size = float(np.median(np.abs(head)))
    date, unit = time.raw in table.dates, time.unit
    notes: list[str] = []
    # the name 't' alone promises seconds, which numbers of that size cannot be
    stated = unit is not None and not (unit == "s" and time.how == "exact" and unix_unit(size))
    if not stated and not date:
        unit = time_unit(head)
    if time.raw == STAMP:
        notes.append("times are the header stamps")
    elif time.how == "guessed" or not stated:
        notes.append(f"column '{time.raw}' taken for time in {unit or 's'}")
    if date or time.raw in table.clocks:
        unit = "s"
    factor = unit_factor(unit or "s", "s", time.raw)
    first = float(finite[0])
    if not is_unix_time(size * factor) and not date:
        return TimeScale(factor, 0.0, None, tuple(notes))
    return TimeScale(factor, first, first * factor, tuple(notes))


def batch_recording(
    table: TableFile,
    batch: Batch,
    assigned: dict[str, Assigned],
    scale: TimeScale,
    vessel: Vessel,
    *,
    alone: bool = True,
) -> Recording:
    """Return columns of a table as a recording, names as in the source.

    Motion is missed only where the file stands `alone`.
    """
    t = scale.seconds(batch[assigned["t"].raw])
    signals, text, notes = [], {}, []
    loop = vessel.closed_loop[0] if vessel.closed_loop else None
    parts = _parts(table)
    for name, a in assigned.items():
        if name == "t":
            continue
        if name == loop:
            text[loop] = (t, np.asarray(batch[a.raw]).astype(str))
        elif a.raw in table.text or a.raw in table.dates:
            notes.append(f"column '{a.raw}' holds words or dates, not numbers: left out")
        else:
            source = (
                f"column '{a.raw}'" if a.raw not in parts else f"columns {_listed(parts[a.raw])}"
            )
            signals.append(Signal(a.raw, t, batch[a.raw], a.unit, source))
    used = {a.raw for a in assigned.values()}
    used |= {c for made, of in parts.items() if made in used for c in of}
    ignored = [c for c in table.columns if c not in used]
    if ignored:
        more = f" and {len(ignored) - 12} more" if len(ignored) > 12 else ""
        notes.append(f"columns not used: {', '.join(ignored[:12])}{more}")
    if alone and not set(assigned) & MOTION:
        notes.append(_NO_MOTION)
    return Recording(table.path.stem, tuple(signals), text, scale.epoch, notes=tuple(notes))


def canonical(
    raw: Recording,
    assigned: dict[str, Assigned],
    vessel: Vessel,
    reach: Mapping[str, tuple[float, float]] | None = None,
) -> Recording:
    """Rename and convert the signals of a recording; state every guess.

    `reach` gives largest value and step of angles whose unit is to be guessed,
    where the recording is only a part of what there is.
    """
    by_name = {s.name: s for s in raw.signals}
    signals, notes = [], []
    for name, a in assigned.items():
        signal = by_name.get(a.raw)
        if signal is None:
            continue
        if a.how != "guessed" and signal.unit is not None and a.how != "mapped":
            a = replace(a, unit=signal.unit)
        unit, factor, why = _factor(a, signal, vessel, (reach or {}).get(name))
        if a.how == "guessed":
            size = f" in {unit}" if unit else ""
            notes.append(f"{a.raw} taken for {name}{size}{why}")
        elif why:
            notes.append(f"{a.raw} is {name}{why}")
        scale = factor * a.sign
        value = signal.value if scale == 1.0 else signal.value * scale
        target = CHANNELS[name].unit if name in CHANNELS else None
        source = signal.source if a.raw == name else (signal.source or f"'{a.raw}'")
        signals.append(Signal(name, signal.t, value, target, source, True))
    guessed = frozenset(n for n, a in assigned.items() if a.how == "guessed")
    mapped = {n: a.raw for n, a in assigned.items() if a.raw in vessel.columns}
    return replace(raw.with_signals(signals, *notes), guessed=guessed, mapped=mapped)


def _factor(
    a: Assigned, signal: Signal, vessel: Vessel, known: tuple[float, float] | None = None
) -> tuple[str | None, float, str]:
    """Return unit, factor to SI and, where the unit was guessed, why."""
    target = vessel.unit(a.name)
    if a.unit is not None:
        return a.unit, unit_factor(a.unit, target, a.raw), ""
    if target is None or a.how == "exact":
        return target, 1.0, ""
    if target == "rad":
        reach = known or angle_reach(signal.value)
        if angle_unit(reach) == "deg":
            return "deg", np.pi / 180, f", since it reaches {reach[0]:.0f}"
        return "rad", 1.0, f", since it stays below {reach[0]:.2f}"
    return target, 1.0, ", no unit being stated"


def angle_reach(value: Array) -> tuple[float, float]:
    """Return the largest size and the largest step of an angle whose unit is to be guessed."""
    finite = value[np.isfinite(value)]
    largest = float(np.max(np.abs(finite))) if len(finite) else 0.0
    steps = float(np.max(np.abs(np.diff(finite)))) if len(finite) > 1 else 0.0
    return largest, steps


def angle_unit(reach: tuple[float, float]) -> str:
    """Return the unit of an angle, from `angle_reach`."""
    # wrapped radians end at 2π; what turns further was unwrapped, and then has no jumps
    return "deg" if reach[0] > 50 or reach[1] > 100 else "rad"


def _guess_commands(raw: Recording, assigned: dict[str, Assigned], vessel: Vessel) -> None:
    """Give rudders and shafts of NMEA 0183 to the vessel's columns where only one fit exists."""
    # sensors tell what was measured, also where the command drives the model
    measured = {
        (kind, column if t.drive == "feedback" else other)
        for t in vessel.thrusters
        for kind, column, other, _ in t.movements
    }
    missing = [c for c in vessel.recorded_columns if c not in assigned]
    # azimuths are not what RSA tells of: their sign and range differ from a rudder's
    rudders = [c for c in missing if ("rudder", c) in measured]
    speeds = [c for c in missing if ("speed", c) in measured]
    shafts = sorted((n for n in raw.names if n.startswith("rpm_")), key=_shaft)
    of_kind = [n for n in shafts if n.startswith("rpm_shaft")]
    # an engine and its shaft turn together: one of each kind is enough
    offered_speeds = of_kind if len(of_kind) >= len(speeds) else shafts
    for wanted, offered in (
        (rudders, [n for n in ("rudder_starboard", "rudder_port") if n in raw]),
        (speeds, offered_speeds),
    ):
        if len(wanted) == 1 or len(wanted) == len(offered):
            for name, source in zip(wanted, offered, strict=False):
                assigned[name] = Assigned(source, name, raw[source].unit, 1, "guessed")


def _shaft(name: str) -> tuple[str, int]:
    stem = name.rstrip("0123456789")
    return stem, int(name[len(stem) :] or 0)


def merge(recordings: list[Recording]) -> Recording:
    """Merge the files of one trial on their clocks.

    Parameters
    ----------
    recordings : list of Recording
        Canonical. All with a UNIX time, or none: then their times are taken to
        count from the same moment.

    Raises
    ------
    LogError
        Some have a UNIX time and some not; or one wind was moved or brought to
        another height before, and the other not; or two columns that ``[columns]`` maps
        to one signal tell of the same times.
    """
    if len(recordings) == 1:
        return recordings[0]
    absolute = [r for r in recordings if r.epoch is not None]
    if absolute and len(absolute) < len(recordings):
        other = next(r for r in recordings if r.epoch is None)
        raise LogError(
            f"'{absolute[0].name}' has the time of day and '{other.name}' only seconds from its "
            f"start: they cannot be merged. Give both a UNIX or ISO time, or import them apart."
        )
    epoch = min(r.epoch for r in absolute if r.epoch is not None) if absolute else None
    found: dict[str, list[tuple[str, Signal]]] = {}
    stated: dict[str, int] = {}
    text: dict[str, tuple[Array, NDArray[Any]]] = {}
    notes: list[str] = []
    steps: list[Step] = []
    for r in recordings:
        shift = r.epoch - epoch if epoch is not None and r.epoch is not None else 0.0
        notes += [f"{r.name}: {n}" for n in r.notes]
        steps += [on_zero(s, shift) for s in r.steps]
        moved: dict[int, Array] = {}
        for s in r.signals:
            t = moved.setdefault(id(s.t), s.t + shift)
            parts = found.setdefault(s.name, [])
            # what a file states is preferred to what was guessed of another
            at = len(parts) if s.name in r.guessed else stated.get(s.name, 0)
            parts.insert(at, (r.name, replace(s, t=t)))
            stated[s.name] = stated.get(s.name, 0) + (s.name not in r.guessed)
        for name, (t, words) in r.text.items():
            first = text.get(name, (np.empty(0), np.empty(0, dtype=str)))
            text[name] = (
                np.concatenate([first[0], t + shift]),
                np.concatenate([first[1], words]),
            )
    signals = []
    clocks: dict[tuple[int, ...], Array] = {}
    unsure = {(r.name, n) for r in recordings for n in r.unsure}
    still: set[str] = set()
    mapped = {(r.name, n): raw for r in recordings for n, raw in r.mapped.items()}
    done = {r.name: r.steps for r in recordings}
    for name, parts in found.items():
        kept = [parts[0]]
        for part in parts[1:]:
            same = next((k[0] for k in kept if _overlap(part[1], k[1])), None)
            if same is not None:
                one, two = mapped.get((same, name)), mapped.get((part[0], name))
                if one is not None and two is not None and one != two:
                    raise LogError(
                        f"columns '{one}' of '{same}' and '{two}' of '{part[0]}' tell of the same "
                        f"times, and [columns] maps both to '{name}': remove one of the two lines "
                        f"from the vessel file."
                    )
                notes.append(
                    f"{name} stands in '{same}' and '{part[0]}' at the same times: "
                    f"that of '{same}' is used"
                )
            else:
                kept.append(part)
        _refuse_two_states(name, [(n, done[n]) for n, _ in kept])
        still |= {name for n, _ in kept if (n, name) in unsure}
        kept.sort(key=lambda p: _span(p[1])[0])
        # columns of one table go on sharing their clock
        key = tuple(id(p[1].t) for p in kept)
        if key not in clocks:
            clocks[key] = np.concatenate([p[1].t for p in kept])
        value = np.concatenate([p[1].value for p in kept])
        signals.append(replace(kept[0][1], t=clocks[key], value=value))
    return Recording(
        recordings[0].name,
        tuple(signals),
        text,
        epoch,
        tuple(f for r in recordings for f in r.files),
        tuple(notes),
        conditions=reduce(Conditions.over, (r.conditions for r in recordings)),
        steps=new_steps((), steps),
        unsure=frozenset(still),
    )


def _refuse_two_states(name: str, parts: list[tuple[str, tuple[Step, ...]]]) -> None:
    """Refuse a signal of several files of which one was corrected or moved and the other not."""
    (first, before), *others = parts
    for other, steps in others:
        if name in ("u_q", "v_q") and wind_state(steps) != wind_state(before):
            raise LogError(
                f"the wind of '{first}' is {wind_state(before)}, that of '{other}' is "
                f"{wind_state(steps)}: they cannot be merged. Import both from their raw files."
            )
        one, two = (_corrections(of, name) for of in (before, steps))
        if one != two:
            raise LogError(
                f"{name} of '{first}' is {_in_words(one)}, that of '{other}' is {_in_words(two)}: "
                f"they cannot be merged. Import both from their raw files."
            )


def _corrections(steps: Iterable[Step], name: str) -> list[Step]:
    return [s for s in steps if s.decided_by == "vessel" and name in s.channels]


def _in_words(steps: list[Step]) -> str:
    return f"corrected ({'; '.join(s.sentence for s in steps)})" if steps else "as recorded"


def _span(signal: Signal) -> tuple[float, float]:
    finite = signal.t[np.isfinite(signal.t)]
    return (float(finite.min()), float(finite.max())) if len(finite) else (np.inf, -np.inf)


def _overlap(a: Signal, b: Signal) -> bool:
    """Whether two signals tell of the same times, beyond the seam between two files."""
    (a0, a1), (b0, b1) = _span(a), _span(b)
    common = min(a1, b1) - max(a0, b0)
    return common > _OVERLAP * min(a1 - a0, b1 - b0)


def unused_mappings(recordings: Iterable[Recording], vessel: Vessel) -> list[str]:
    """Say which columns the vessel file maps and no file has."""
    recordings = list(recordings)
    names = {n for r in recordings for n in (*r.names, *r.mapped)}
    return [
        f"[columns] maps '{raw}' to '{m.name}', which no file has"
        for raw, m in vessel.columns.items()
        if m.name not in names and m.name != "t"
    ]
