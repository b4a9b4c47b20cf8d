"""Reading a clean log from CSV or Parquet, with the vessel's column names and units.

It goes the way of every import (`greybox.trial.convert.convert`) with its samples as they were
recorded, guesses nothing, and refuses what would have to be mended.
"""

from __future__ import annotations

import logging
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from greybox.errors import LogError, so_many, suggestion
from greybox.files import sha256
from greybox.trial.convert.channel_mapping import (
    beyond_reach,
    canonical,
    possible,
    table_columns,
    whole_recording,
    written_log,
)
from greybox.trial.convert.column_names import Assigned
from greybox.trial.convert.convert import Conversion, cut_segments
from greybox.trial.convert.deduplicate import clean_signals
from greybox.trial.convert.derived_signals import MOTION_SIGNALS
from greybox.trial.convert.options import ImportOptions
from greybox.trial.convert.time_grid import MIN_SEGMENT, Plan
from greybox.trial.convert.time_scale import LATEST, time_scale
from greybox.trial.gaps import split_at_gaps
from greybox.trial.log import Provenance, TrialLog
from greybox.trial.raw_log import Array, Recording
from greybox.trial.readers.formats import open_raw
from greybox.trial.readers.table import Batch, TableFile, read_columns
from greybox.trial.segments import join_segments, numbered
from greybox.vessel.vessel import Vessel

_log = logging.getLogger(__name__)
# share of a sample by which a time step may differ from the others
_JITTER = 0.2
# samples by which a time may differ from a uniform clock
_DRIFT = 0.6
# wind of fewer rows than this share is none
_LEAST_WIND = 0.5
_WIND = ("u_q", "v_q", "V_q", "gamma_q", "dir_q", "V_w", "dir_w", "dir_t")
# share of steps past which gaps are another sample time
_MOST_GAPS = 0.2


def read_log(
    path: str | Path,
    vessel: Vessel,
    *,
    states: tuple[str, ...] = (),
    fill: Mapping[str, float] | None = None,
    gaps: bool = False,
) -> TrialLog:
    """Read one log file for a vessel.

    Parameters
    ----------
    path : str or Path
        CSV or Parquet, one row a sample.
    vessel : Vessel
        Its ``[columns]`` rename and convert; its thruster columns are required.
    states : tuple of str
        States that must be there or follow from the rest; u, v, r by default.
    fill : mapping of str to float, optional
        Constant values of channels that the file may lack, such as the start of
        a plan that holds commands only.
    gaps : bool
        Whether rows may be missing: runs of a model then begin anew after each gap.

    Returns
    -------
    TrialLog
        SI and radians, ψ unwrapped, velocities derived where absent (3.57), (3.64),
        without the defects that ``[sensors]`` of the vessel file states.

    Raises
    ------
    LogError
        The file cannot be read; a column is missing (the nearest name is
        suggested); a value is not a number; time does not increase; there are
        two sample times, or a gap.
    """
    segments = read_segments(path, vessel, states=states, fill=fill)
    if len(segments) > 1 and not gaps:
        raise LogError(
            f"'{Path(path).name}' has {len(segments) - 1} gaps in its time, and one run cannot "
            f"cross them: cut the log at them, or read it as segments."
        )
    return join_segments(segments, Path(path).stem)


def read_segments(
    path: str | Path,
    vessel: Vessel,
    *,
    states: tuple[str, ...] = (),
    fill: Mapping[str, float] | None = None,
) -> list[TrialLog]:
    """Read one log file as the segments between its gaps.

    A gap is a step of a whole number of sample times, as `write_log` leaves it;
    segments of fewer than three samples are dropped.

    Parameters
    ----------
    path, vessel, states, fill
        As `read_log`.

    Returns
    -------
    list of TrialLog
        In order of time, at least one.

    Raises
    ------
    LogError
        As `read_log`, gaps apart.
    """
    path = Path(path)
    table = open_raw(path)
    if isinstance(table, Recording):
        raise LogError(
            f"'{path.name}' is a raw file ({table.files[0].format if table.files else 'raw'}): "
            f"make a log of it first with greybox import {shlex.quote(path.name)} --vessel V "
            f"--out log.csv."
        )
    known, vessel = written_log(path, vessel)
    known = known or Provenance(path.name)
    segments = table_segments(table, vessel, known, states=states, fill=fill)
    known = segments[0].provenance
    known = replace(known, sha256=known.sha256 or sha256(path))
    return [replace(s, provenance=known) for s in segments]


def table_segments(
    table: TableFile,
    vessel: Vessel,
    known: Provenance,
    *,
    states: tuple[str, ...] = (),
    fill: Mapping[str, float] | None = None,
    sample_time: float | None = None,
) -> list[TrialLog]:
    """Return the segments between the gaps of a table, as `read_segments` does of a file's.

    Parameters
    ----------
    known : Provenance
        Of the table; what is done here is added to it.
    sample_time : float, optional
        Of the file of which the table is a part [s], taken where the part agrees with it; the
        part's own mean by default.
    """
    name = table.path.name
    recording, sample_time, lost = _clean_recording(
        table, vessel, known, sample_time, plan=bool(fill)
    )
    plan = _recorded_grid(recording, table, sample_time)
    conversion = Conversion(vessel, ImportOptions(), plan, recording.steps)
    cut = cut_segments(recording, conversion)
    if not cut.segments:
        raise cut.refusal(conversion)
    steps = (*recording.steps, *cut.steps)
    read = (*known.read, *(n for n in (*lost, *cut.notes) if n not in known.read))
    conditions = known.conditions.over(vessel.conditions)
    epoch = recording.epoch if known.epoch is None else known.epoch
    known = replace(known, steps=steps, read=read, epoch=epoch, conditions=conditions)
    columns = [str(c) for c in table.columns]
    segments = []
    for log in cut.segments:
        channels = dict(log.channels)
        for other, value in (fill or {}).items():
            channels.setdefault(other, np.full(len(log), float(value)))
        _require(channels, vessel, states or ("u", "v", "r"), name, columns)
        segments.append(replace(log, channels=channels, provenance=known))
    _log.info(
        "read %s: %d rows every %g s in %d segment(s); columns %s%s", table.path, plan.count,
        sample_time, len(segments), ", ".join(columns), "".join(f"; {d}" for d in known.derived),
    )  # fmt: skip
    return numbered(segments, table.path.stem)


def _clean_recording(
    table: TableFile,
    vessel: Vessel,
    known: Provenance,
    sample_time: float | None,
    *,
    plan: bool,
) -> tuple[Recording, float, list[str]]:
    """Return the table as a recording that needs no mending, sample time [s], what was left out.

    Raises
    ------
    LogError
        It needs mending, or a mapped column is missing.
    """
    assigned = table_columns(table, vessel, guess=False)
    _require_mapped(assigned, vessel, table, plan=plan)
    batch = read_columns(table, [a.raw for a in assigned.values()])
    batch, rows, notes = _known_rows(assigned, batch, vessel, table)
    time = assigned["t"]
    scale = time_scale(batch[time.raw], time, table)
    if time.raw not in table.dates:
        # a log's own clock is kept as it is
        scale = replace(scale, zero=0.0, epoch=None)
    t = scale.seconds(batch[time.raw])
    sample_time = _require_uniform(t, rows, table, notes, sample_time)
    raw = whole_recording(table, batch, assigned, scale, vessel)
    recording = replace(canonical(raw, assigned, vessel), steps=(*known.steps, *raw.steps))
    for rudder in (s for s in recording.signals if s.name in vessel.rudders):
        if beyond := beyond_reach(rudder, vessel):
            if beyond[0] > 90:
                raise LogError(
                    f"'{rudder.name}' of '{table.path.name}' reaches {beyond[0]:.4g}, and no "
                    f"rudder passes 90 deg: wrong column? Map that of the rudder angle in "
                    f"[columns]."
                )
            raise LogError(
                f"'{rudder.name}' of '{table.path.name}' reaches {beyond[0]:.4g}, above the "
                f"{beyond[1]:.3g} rad of a right angle: it holds degrees. Convert it to radians, "
                f"or import the raw file with greybox import --fix."
            )
    return clean_signals(recording), sample_time, notes


def _recorded_grid(recording: Recording, table: TableFile, sample_time: float) -> Plan:
    """Return the samples as they were recorded: every signal stands at each of them."""
    signals = recording.signals
    # a motion may have holes, over which the others go on
    t = signals[0].t
    if not all(np.array_equal(s.t, t) for s in signals[1:]):
        t = np.unique(np.concatenate([s.t for s in signals]))
    names = tuple(s.name for s in signals)
    return Plan(
        table.path.stem, sample_time, float(t[0]), len(t), dict.fromkeys(names, sample_time),
        names, (), MIN_SEGMENT, times=t,
    )  # fmt: skip


def _require_mapped(
    assigned: Mapping[str, Assigned], vessel: Vessel, table: TableFile, *, plan: bool
) -> None:
    """Refuse a table without a column that ``[columns]`` maps and that is needed."""
    for raw, mapping in vessel.columns.items():
        name = mapping.name
        if raw in table.columns or name in assigned:
            continue
        beside = name in vessel.recorded_columns and name not in vessel.commands
        if not beside and (name in vessel.commands or not plan):
            raise LogError(
                f"'{table.path.name}' has no column '{raw}', which [columns] maps to '{name}'."
                f"{suggestion(raw, table.columns)} Correct the name in the vessel file."
            )


def _known_rows(
    assigned: dict[str, Assigned], batch: Batch, vessel: Vessel, table: TableFile
) -> tuple[Batch, NDArray[np.intp], list[str]]:
    """Return the rows in which time, inputs and wind are numbers, which, and what is left out.

    Columns that hold none and are not needed are left out, in place. Motions keep their
    holes, over which a run of the model goes on.
    """
    loop = vessel.closed_loop[0] if vessel.closed_loop else None
    batch = {c: possible(v) if c != assigned["t"].raw else v for c, v in batch.items()}
    numbers = {n: np.isfinite(_floats(batch, a)) for n, a in assigned.items() if n != loop}
    numbers["t"] = np.abs(_floats(batch, assigned["t"])) <= LATEST
    # positions are not needed where velocities were logged, nor what moves no model
    spare = {"x_n", "y_n"} if {"u", "v"} <= assigned.keys() else set()
    beside = set(vessel.recorded_columns) - set(vessel.commands)
    notes = []
    for name in [n for n, known in numbers.items() if not known.all()]:
        known = numbers[name]
        lacking = name in _WIND and known.mean() < _LEAST_WIND
        if name in beside or lacking or (name in spare and not known.any()):
            if name not in beside:
                notes.append(
                    f"'{assigned[name].raw}' holds no number in {int((~known).sum())} of "
                    f"{so_many(len(known), 'row')}: left out"
                )
            del assigned[name], numbers[name]
        elif not known.any():
            raise LogError(
                f"column '{assigned[name].raw}' of '{table.path.name}' holds no finite number in "
                f"{so_many(len(known), 'row')}, from row {table.first_row} on: export it again, "
                f"or take it "
                f"out of the file."
            )
    needed = [n for n in numbers if n in {"t", *vessel.commands, *_WIND}]
    keep = np.all([numbers[n] for n in needed], axis=0)
    rows = np.flatnonzero(keep)
    if keep.all():
        return batch, rows, notes
    first = int(np.flatnonzero(~keep)[0])
    lost = [assigned[n].raw for n in needed if not numbers[n].all()]
    notes.append(
        f"{int((~keep).sum())} of {so_many(len(keep), 'row')} left out, the first row "
        f"{first + table.first_row}, where {', '.join(lost)} hold{'s' * (len(lost) == 1)} no "
        f"finite number"
    )
    return {n: values[keep] for n, values in batch.items()}, rows, notes


def _floats(batch: Batch, a: Assigned) -> Array:
    values = batch[a.raw]
    if values.dtype == object:
        return np.full(len(values), np.nan)
    return np.asarray(values, float)


def _require_uniform(
    t: Array,
    rows: NDArray[np.intp],
    table: TableFile,
    left_out: Sequence[str],
    whole: float | None = None,
) -> float:
    """Return the sample time [s]; refuse a table whose samples would have to be resampled.

    Times are those of some `rows` of the table, and `left_out` says why there are no more. That
    of the `whole` file is taken where the table is a part of one and agrees with it.
    """
    name = table.path.name
    importer = "recording_from_pandas" if table.format == "DataFrame" else "greybox import"
    if len(t) < MIN_SEGMENT:
        raise LogError(
            f"'{name}' has {so_many(len(t), 'sample')}, at least {MIN_SEGMENT} are needed: use "
            f"a longer log."
        )
    steps = np.diff(t)
    wrong = np.flatnonzero(steps <= 0)
    if len(wrong):
        k = int(wrong[0])
        raise LogError(
            f"time in '{name}' goes from {t[k]:.13g} to {t[k + 1]:.13g} s in row "
            f"{rows[k + 1] + table.first_row}, it must increase: {importer} sorts the rows and "
            f"drops repeated ones."
        )
    beside = np.diff(rows) == 1
    usual = float(np.median(steps[beside] if beside.any() else steps))
    found = split_at_gaps(t, usual)
    gaps = np.zeros(len(steps), bool)
    gaps[[a - 1 for a, _ in found[1:]]] = True
    off = np.abs(steps - np.round(steps / usual) * usual) > _JITTER * usual
    if off.any() or gaps.sum() > _MOST_GAPS * len(steps):
        k = int(np.flatnonzero(off | gaps)[0])
        if not off.any() and not gaps[beside].any():
            raise LogError(
                f"'{name}' falls into {len(found)} pieces, too many for one log: {left_out[-1]}. "
                f"Make one log of it with {importer}, which holds inputs over short holes."
            )
        raise LogError(
            f"'{name}' has two sample times: {usual:.6g} s, but {steps[k]:.6g} s after "
            f"t = {t[k]:.6g} s ({int((off | gaps).sum())} of {so_many(len(steps), 'step')} "
            f"differ). "
            f"Resample it to one with {importer}."
        )
    found = [(a, b) for a, b in found if b - a >= MIN_SEGMENT]
    if not found:
        raise LogError(
            f"'{name}' has no {MIN_SEGMENT} samples between two gaps: use a log with fewer."
        )
    means = []
    for a, b in found:
        mean = float((t[b - 1] - t[a]) / (b - 1 - a))
        drift = np.abs(t[a:b] - t[a] - mean * np.arange(b - a))
        if drift.max() > _DRIFT * mean:
            k = a + (b - a) // 2
            one, two = (t[k] - t[a]) / (k - a), (t[b - 1] - t[k]) / (b - 1 - k)
            raise LogError(
                f"'{name}' has two sample times: {one:.6g} s on average in its first half and "
                f"{two:.6g} s in its second. Resample it to one with {importer}."
            )
        means.append((b - a, mean))
    count, mean = max(means)
    if whole is not None and abs(mean - whole) * (count - 1) <= 2 * _DRIFT * whole:
        # means of two parts differ by the jitter of their ends
        return whole
    return round(mean, 9)


def _require(
    channels: dict[str, Array],
    vessel: Vessel,
    states: tuple[str, ...],
    name: str,
    columns: list[str],
) -> None:
    # what names another channel already is no misspelling
    free = [c for c in columns if c not in channels]
    for column in vessel.commands:
        if column not in channels:
            raise LogError(
                f"'{name}' has no column '{column}', which moves a thruster of "
                f"'{vessel.name}'.{suggestion(column, free)} Give the vessel file, or the model, "
                f"of the ship that sailed it, or name the right one of its columns there: "
                f"{', '.join(columns[:30])}."
            )
    for state in states:
        if state not in channels:
            need = {"u": "psi and x_n, y_n", "v": "psi and x_n, y_n", "r": "psi"}.get(state)
            underived = f" and it cannot be derived without {need}" if need else ""
            still = not channels.keys() & set(MOTION_SIGNALS)
            raise LogError(
                f"'{name}' has no '{state}'{underived}."
                f"{suggestion(state, free)} Map the columns in the vessel file's [columns]"
                + ("; commands alone are simulated with --start." if still else ".")
            )
    if "psi" not in channels and set(states) & {"v", "r"}:
        raise LogError(
            f"'{name}' has no heading 'psi'.{suggestion('psi', free)} "
            f"Map it in the vessel file's [columns] with its unit."
        )
