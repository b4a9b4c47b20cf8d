"""From a recording in the source's words to canonical signals in SI."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.channels import CHANNELS
from greybox.errors import LogError, suggestion
from greybox.files import sha256
from greybox.trial.convert.column_names import Assigned, assign, is_short_pair
from greybox.trial.convert.derived_signals import (
    BODY,
    EARTH,
    MOTION_SIGNALS,
    PLACE,
    local_positions,
    places,
    usual_reach,
    wraps_by_degrees,
)
from greybox.trial.convert.merge import merge, on_one_clock
from greybox.trial.convert.settle_axes import settle_axes
from greybox.trial.convert.speed_unit import unit_of_speed
from greybox.trial.convert.time_scale import TimeScale, time_scale
from greybox.trial.log import Provenance
from greybox.trial.raw_log import Array, Recording, Signal, SourceFile, shortened
from greybox.trial.readers.formats import open_raw
from greybox.trial.readers.table import Batch, TableFile, read_columns
from greybox.trial.readers.topic_files import STAMP, TopicTable
from greybox.trial.steps import Step, on_zero
from greybox.trial.store import read_record, recorded_provenance
from greybox.units import unit_factor
from greybox.vessel.vessel import Vessel

MOTION = frozenset({*MOTION_SIGNALS, "lat", "lon", "sog"})

# channels that tell what others would
_ALTERNATIVES = ((("lat", "lon"), PLACE), (PLACE, ("lat", "lon")), (EARTH, BODY), (BODY, EARTH))

# a position changes from row to row by less than this share of what it spreads over
_SMOOTH = 0.2
# largest number of a signal: encoders, and degrees of longitude times 1e7
_LARGEST = 1e10
_NO_MOTION = "no position, heading or velocity was recognised: map their columns in [columns]"


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
                steps=(*map(_without_times, known.steps), *raw.steps),
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
    """Read the recognised columns of a table into a recording."""
    assigned = table_columns(table, vessel, guess=guess, alone=alone)
    batch = read_columns(table, [a.raw for a in assigned.values()])
    assigned = without_false_positions(assigned, batch)
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
    """Return the recognised columns of a table, with the notes and steps of reading them."""
    recording = batch_recording(table, batch, assigned, scale, vessel, alone=alone)
    if isinstance(table, TopicTable):
        stamped = assigned["t"].raw == STAMP
        unsure = frozenset(n for n, a in assigned.items() if a.raw in table.unsure)
        recording = replace(recording, unsure=unsure, ahead=table.ahead if stamped else None)
    notes = (*table.notes, *scale.notes, *recording.notes)
    return replace(recording, notes=notes, steps=reading_steps(table, scale))


def reading_steps(table: TableFile, scale: TimeScale) -> tuple[Step, ...]:
    """Return the steps of reading a table, their times counted from the recording's zero."""
    return tuple(on_zero(s, -scale.zero) for s in table.steps)


def _without_times(step: Step) -> Step:
    """Return a step of an earlier reading without its times, which another file had."""
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
        making = f"greybox import {shlex.quote(table.path.name)} --vessel V --out log.csv"
        advice = "Map" if guess else f"Make a log of it with {making}, or map"
        timed = (c for c in table.columns if c in table.dates | table.clocks or "time" in c.lower())
        likely = next(timed, "tvec")
        read = likely in table.dates | table.clocks
        entry = f'"{likely}" = ' + ('"t"' if read else '{ name = "t", unit = "s" }')
        raise LogError(
            f"'{table.path.name}' has no column 't'.{suggestion('t', table.columns)} "
            f"{advice} the time column in the vessel file's [columns], such as {entry}"
            f"{' (dates and times of day are read as such)' if read else ''}. "
            f"Its columns: {', '.join(table.columns[:30])}."
        )
    time = assigned["t"].raw
    if time in table.text:
        word = read_columns(table, [time])[time][0]
        raise LogError(
            f"column '{time}' of '{table.path.name}' holds '{word}' where the time should be: "
            f"write seconds, UNIX time or ISO 8601 (2024-05-01T12:00:00Z), or map another column "
            f"to 't' in [columns]."
        )
    if len(assigned) == 1 and alone:
        raise LogError(
            f"no column of '{table.path.name}' but its time '{time}' is known: map them in the "
            f"vessel file's [columns]. Its columns: {', '.join(table.columns[:30])}."
        )
    return assigned


def without_false_positions(assigned: dict[str, Assigned], batch: Batch) -> dict[str, Assigned]:
    """Leave out columns ``n`` and ``e`` whose values do not change as positions do."""
    moves = (_moves_like_a_position(batch[assigned[n].raw]) for n in PLACE if n in assigned)
    if not is_short_pair(assigned) or all(moves):
        return assigned
    return {n: a for n, a in assigned.items() if n not in PLACE}


def _moves_like_a_position(value: NDArray[Any]) -> bool:
    """Whether values change as positions do: all the time, and little from row to row."""
    if value.dtype == object or not np.isfinite(value).any():
        return False
    value = value[np.isfinite(value)]
    if len(value) < 2:
        return False
    # damaged numbers may be too large to be squared
    with np.errstate(over="ignore", invalid="ignore"):
        steps = np.diff(value)
        smooth = float(np.sqrt(np.mean(steps**2))) < _SMOOTH * float(np.std(value))
    return smooth and float(np.mean(steps == 0)) < 0.5


def _parts(table: TableFile) -> dict[str, tuple[str, ...]]:
    """Return the columns of the file behind each column that is made of others."""
    return table.parts if isinstance(table, TopicTable) else {}


def possible(values: NDArray[Any]) -> NDArray[Any]:
    """Return a column without numbers that no signal of a ship has, which overflow in sums."""
    if values.dtype == object or not (np.abs(values) > _LARGEST).any():
        return values
    return np.where(np.abs(values) > _LARGEST, np.nan, values)


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
            made_of = ", ".join(f"'{c}'" for c in parts.get(a.raw, ()))
            source = f"columns {made_of}" if made_of else f"column '{a.raw}'"
            signals.append(Signal(a.raw, t, possible(batch[a.raw]), a.unit, source))
    used = {a.raw for a in assigned.values()}
    used |= {c for made, of in parts.items() if made in used for c in of}
    ignored = [c for c in table.columns if c not in used]
    if ignored:
        notes.append(
            f"columns not used: {shortened(ignored, 12)} (map those that belong to the log in the "
            f"vessel file's [columns])"
        )
    if alone:
        notes += [
            f"no column '{c}', which the vessel file names.{near}"
            for c in vessel.commands
            if c not in assigned and (near := suggestion(c, ignored))
        ]
    if alone and not set(assigned) & MOTION:
        notes.append(_NO_MOTION)
    return Recording(
        table.path.stem,
        tuple(signals),
        text,
        scale.epoch,
        notes=tuple(notes),
        unused=tuple(ignored),
    )


def canonical(
    raw: Recording,
    assigned: dict[str, Assigned],
    vessel: Vessel,
    reach: Mapping[str, tuple[float, float]] | None = None,
    speed: str | None = None,
) -> Recording:
    """Rename and convert the signals of a recording; state every guess.

    Where the recording is only a part of what there is, `reach` gives largest value and step
    of angles whose unit is to be guessed, and `speed` what `speed_unit` found, empty for nothing.
    """
    by_name = {s.name: s for s in raw.signals}
    if speed is None:
        speed = speed_unit(raw, assigned, vessel)
    signals, notes = [], []
    for name, a in assigned.items():
        signal = by_name.get(a.raw)
        if signal is None:
            continue
        if a.how != "guessed" and signal.unit is not None and a.how != "mapped":
            a = replace(a, unit=signal.unit)
        unit, factor, why = _factor(a, signal, vessel, (reach or {}).get(name))
        if name == "sog" and speed:
            fitting = unit_factor(speed, "m/s", a.raw)
            if a.unit is None and a.how != "exact":
                unit, factor, why = speed, fitting, ", since so it goes as far as the positions do"
            elif not math.isclose(fitting, factor, rel_tol=0.3):
                notes.append(
                    f"{a.raw} is read in {unit}, and goes as far as the positions do in {speed}: "
                    f"correct its unit in [columns]"
                )
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
    knots = " (if it is in knots, say so in [columns])" if target == "m/s" else ""
    return target, 1.0, f", no unit being stated{knots}"


def speed_unit(raw: Recording, assigned: Mapping[str, Assigned], vessel: Vessel) -> str:
    """Return the unit by which the speed over ground goes as far as positions, or ``""``."""
    by_name = {s.name: s for s in raw.signals}
    a = assigned.get("sog")
    if a is None or a.raw not in by_name:
        return ""
    pair = next((p for p in (PLACE, ("lat", "lon")) if assigned.keys() >= set(p)), None)
    if pair is None or any(assigned[n].raw not in by_name for n in pair):
        return ""
    place = [(assigned[n], by_name[assigned[n].raw]) for n in pair]
    north, east = (replace(s, value=s.value * _factor(a, s, vessel)[1]) for a, s in place)
    if len(north) != len(east):
        return ""
    if pair != PLACE:
        if not np.isfinite(places(north, east)[1]).any():
            return ""
        north, east, _ = local_positions(north, east)
    return unit_of_speed(by_name[a.raw], north, east) or ""


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


def beyond_reach(signal: Signal, vessel: Vessel) -> tuple[float, float] | None:
    """Return how far an angle reaches and how far it can [rad], where it is beyond."""
    finite = signal.value[np.isfinite(signal.value)]
    if len(finite) < 3:
        return None
    largest = usual_reach(finite)
    if signal.name == "psi" and not wraps_by_degrees(finite):
        # an unwrapped heading has no limit
        return None
    # no rudder passes a right angle, no wrapped angle two turns
    limit = np.pi / 2 if signal.name in vessel.rudders else 4 * np.pi
    return (largest, limit) if largest > limit else None


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


def unused_mappings(recordings: Iterable[Recording], vessel: Vessel) -> list[str]:
    """Say which columns the vessel file maps and no file has, nor others that tell the same."""
    recordings = list(recordings)
    names = {n for r in recordings for n in (*r.names, *r.mapped)}
    for one, other in _ALTERNATIVES:
        if names.issuperset(one):
            names.update(other)
    unused = [c for r in recordings for c in r.unused]
    return [
        f"[columns] maps '{raw}' to '{m.name}', which no file has"
        + (f".{near}" if (near := suggestion(raw, unused)) else "")
        for raw, m in vessel.columns.items()
        if m.name not in names and m.name != "t"
    ]
