"""From a recording in the source's words to canonical signals in SI."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.channels import CHANNELS, unit_factor
from greybox.errors import LogError, suggestion
from greybox.files import sha256
from greybox.trial.names import Assigned, assign
from greybox.trial.readers.formats import open_raw
from greybox.trial.readers.table import Batch, TableFile, read_columns
from greybox.trial.recording import Recording, Signal, SourceFile
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]

# UNIX time is past 1e8 s since 1973, a log's own clock hardly ever is
_EPOCH = 1e8


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
    raw = open_raw(path, **options)
    if not isinstance(raw, Recording):
        raw, assigned = table_recording(raw, vessel, guess=guess)
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


def table_recording(
    table: TableFile, vessel: Vessel, *, guess: bool = True
) -> tuple[Recording, dict[str, Assigned]]:
    """Read the columns of a table that mean something into a recording."""
    assigned = table_columns(table, vessel, guess=guess)
    batch = read_columns(table, [a.raw for a in assigned.values()])
    recording = batch_recording(table, batch, assigned, vessel)
    files = (SourceFile(table.path.name, sha256(table.path), table.format),)
    return replace(recording, files=files, notes=(*table.notes, *recording.notes)), assigned


def table_columns(table: TableFile, vessel: Vessel, *, guess: bool) -> dict[str, Assigned]:
    """Say which columns of a table to read.

    Raises
    ------
    LogError
        There is no time among them.
    """
    assigned = assign(table.columns, vessel, units=table.units, guess=guess)
    if "t" not in assigned:
        raise LogError(
            f"'{table.path.name}' has no column 't'.{suggestion('t', table.columns)} "
            f"Map the time column in the vessel file's [columns] with its unit. "
            f"Its columns: {', '.join(table.columns[:30])}."
        )
    return assigned


def batch_recording(
    table: TableFile, batch: Batch, assigned: dict[str, Assigned], vessel: Vessel
) -> Recording:
    """Return columns of a table as a recording, names as in the source."""
    time = assigned["t"]
    t, epoch, notes = _seconds(batch[time.raw], time, time.raw in table.dates)
    signals, text = [], {}
    loop = vessel.closed_loop[0] if vessel.closed_loop else None
    for name, a in assigned.items():
        if name == "t":
            continue
        if name == loop:
            text[loop] = (t, np.asarray(batch[a.raw]).astype(str))
        elif a.raw in table.text:
            notes.append(f"column '{a.raw}' holds words, not numbers: left out")
        else:
            signals.append(Signal(a.raw, t, batch[a.raw], a.unit, f"column '{a.raw}'"))
    return Recording(table.path.stem, tuple(signals), text, epoch, notes=tuple(notes))


def _seconds(raw: Array, time: Assigned, date: bool) -> tuple[Array, float | None, list[str]]:
    """Return relative seconds, the UNIX time of zero, and notes."""
    notes: list[str] = []
    factor = 1.0
    unit = time.unit
    finite = raw[np.isfinite(raw)]
    if not len(finite):
        raise LogError(
            f"column '{time.raw}' holds no number among its {len(raw)} rows, it cannot be the "
            f"time: map another column to 't' in [columns]."
        )
    size = float(np.max(np.abs(finite)))
    if unit is None and not date:
        for limit, spelled in ((1e17, "ns"), (1e14, "us"), (1e11, "ms")):
            if size > limit:
                unit = spelled
                break
        else:
            steps = np.diff(finite[:10000])
            # nobody logs a manoeuvre every ten seconds, milliseconds are common
            unit = "ms" if len(steps) and np.median(np.abs(steps)) >= 10 else "s"
    if time.how == "guessed" or time.unit is None:
        notes.append(f"column '{time.raw}' taken for time in {unit or 's'}")
    if unit is not None:
        factor = unit_factor(unit, "s", time.raw)
    if size * factor < _EPOCH and not date:
        return raw * factor, None, notes
    first = float(finite[0])
    # the difference first: UNIX nanoseconds do not fit a double
    return (raw - first) * factor, first * factor, notes


def canonical(raw: Recording, assigned: dict[str, Assigned], vessel: Vessel) -> Recording:
    """Rename and convert the signals of a recording; state every guess."""
    by_name = {s.name: s for s in raw.signals}
    signals, notes = [], []
    for name, a in assigned.items():
        signal = by_name.get(a.raw)
        if signal is None:
            continue
        if a.how != "guessed" and signal.unit is not None and a.how != "mapped":
            a = replace(a, unit=signal.unit)
        unit, factor, why = _factor(a, signal, vessel)
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
    return raw.with_signals(signals, *notes)


def _factor(a: Assigned, signal: Signal, vessel: Vessel) -> tuple[str | None, float, str]:
    """Return unit, factor to SI and, where the unit was guessed, why."""
    target = CHANNELS[a.name].unit if a.name in CHANNELS else None
    if a.name in vessel.angle_commands:
        target = "rad"
    if a.unit is not None:
        return a.unit, unit_factor(a.unit, target, a.raw), ""
    if target is None or a.how == "exact":
        return target, 1.0, ""
    if target == "rad":
        finite = signal.value[np.isfinite(signal.value)]
        largest = float(np.max(np.abs(finite))) if len(finite) else 0.0
        # wrapped radians end at 2π; what turns further was unwrapped, and then has no jumps
        steps = float(np.max(np.abs(np.diff(finite)))) if len(finite) > 1 else 0.0
        if largest > 50 or steps > 100:
            return "deg", np.pi / 180, f", since it reaches {largest:.0f}"
        return "rad", 1.0, f", since it stays below {largest:.2f}"
    return target, 1.0, ", no unit being stated"


def _guess_commands(raw: Recording, assigned: dict[str, Assigned], vessel: Vessel) -> None:
    """Give rudders and shafts of NMEA 0183 to the vessel's columns where only one fit exists."""
    missing = [c for c in vessel.commands if c not in assigned]
    rudders = [c for c in missing if c in vessel.angle_commands]
    speeds = [c for c in missing if c not in vessel.angle_commands]
    for wanted, offered in (
        (rudders, [n for n in ("rudder_starboard", "rudder_port") if n in raw]),
        (speeds, [n for n in raw.names if n.startswith("rpm_")]),
    ):
        if wanted and len(wanted) <= len(offered) and (len(wanted) > 1 or len(offered) >= 1):
            pairs = zip(wanted, offered, strict=False)
            if len(wanted) == 1 or len(wanted) == len(offered):
                for name, source in pairs:
                    assigned[name] = Assigned(source, name, raw[source].unit, 1, "guessed")


def merge(recordings: list[Recording], say: Callable[[str], None] | None = None) -> Recording:
    """Merge the files of one trial on their clocks.

    Parameters
    ----------
    recordings : list of Recording
        Canonical. All with a UNIX time, or none: then their times are taken to
        count from the same moment.

    Raises
    ------
    LogError
        Some have a UNIX time and some not.
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
    text: dict[str, tuple[Array, NDArray[Any]]] = {}
    notes: list[str] = []
    for r in recordings:
        shift = r.epoch - epoch if epoch is not None and r.epoch is not None else 0.0
        notes += [f"{r.name}: {n}" for n in r.notes]
        for s in r.signals:
            found.setdefault(s.name, []).append((r.name, replace(s, t=s.t + shift)))
        for name, (t, words) in r.text.items():
            before = text.get(name, (np.empty(0), np.empty(0, dtype=str)))
            joined = np.concatenate([before[1], words])
            text[name] = (np.concatenate([before[0], t + shift]), joined)
    signals = []
    for name, parts in found.items():
        kept = [parts[0]]
        for part in parts[1:]:
            if any(_overlap(part[1], k[1]) for k in kept):
                notes.append(
                    f"{name} stands in '{kept[0][0]}' and '{part[0]}' at the same times: "
                    f"that of '{kept[0][0]}' is used"
                )
            else:
                kept.append(part)
        kept.sort(key=lambda p: float(p[1].t[0]) if len(p[1]) else 0.0)
        first = kept[0][1]
        signals.append(
            replace(
                first,
                t=np.concatenate([p[1].t for p in kept]),
                value=np.concatenate([p[1].value for p in kept]),
            )
        )
    return Recording(
        recordings[0].name,
        tuple(signals),
        text,
        epoch,
        tuple(f for r in recordings for f in r.files),
        tuple(notes),
    )


def _overlap(a: Signal, b: Signal) -> bool:
    if not len(a) or not len(b):
        return False
    return bool(np.nanmin(a.t) <= np.nanmax(b.t) and np.nanmin(b.t) <= np.nanmax(a.t))
