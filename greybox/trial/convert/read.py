"""Reading a clean log from CSV or Parquet, with the vessel's column names and units.

Logs that may hold defects are read by `greybox.trial.convert.channel_mapping` and made clean
by `greybox.trial.convert.convert`; this reader refuses what it would have to mend.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.channels import CHANNELS, unit_factor
from greybox.errors import LogError, suggestion
from greybox.files import sha256
from greybox.trial.convert.column_names import Assigned, assign
from greybox.trial.convert.sensor_corrections import correct_channels, said_antenna, too_late
from greybox.trial.kinematics import velocities_from_positions
from greybox.trial.log import Provenance, TrialLog
from greybox.trial.raw_log import Recording
from greybox.trial.readers.formats import open_raw
from greybox.trial.readers.table import Batch, TableFile, read_columns
from greybox.trial.store import read_record, recorded_provenance
from greybox.trial.wind import relative_wind, relative_wind_from_direction
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]

_log = logging.getLogger(__name__)
_MIN_SAMPLES = 3
# share of a sample by which a time step may differ from the others
_JITTER = 0.2
# samples by which a time may differ from a uniform clock
_DRIFT = 0.6


def read_log(
    path: str | Path,
    vessel: Vessel,
    *,
    states: tuple[str, ...] = (),
    fill: Mapping[str, float] | None = None,
) -> TrialLog:
    """Read one log file without gaps for a vessel.

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
    if len(segments) > 1:
        raise LogError(
            f"'{Path(path).name}' has {len(segments) - 1} gaps in its time, and one run cannot "
            f"cross them: cut the log at them, or read it as segments."
        )
    return segments[0]


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
            f"make a log of it first with greybox import {path.name} --vessel V --out LOG.csv."
        )
    record = read_record(path)
    if record is not None:
        # what greybox wrote is canonical already: the raw names were mapped before
        vessel = replace(vessel, columns={})
    known = Provenance(path.name) if record is None else recorded_provenance(record)
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
) -> list[TrialLog]:
    """Return the segments between the gaps of a table, as `read_segments` does of a file's.

    Parameters
    ----------
    known : Provenance
        Of the table; what is derived here is added to it.
    """
    path = table.path
    channels, text = _canonical(table, vessel, path, plan=bool(fill))
    t = channels.pop("t")
    if len(t) < _MIN_SAMPLES:
        raise LogError(
            f"'{path.name}' has {len(t)} samples, at least {_MIN_SAMPLES} are needed: "
            f"use a longer log."
        )
    stretches, sample_time = _stretches(t, table)
    for name in {"psi", "gamma_q", *vessel.recorded_angles} & channels.keys():
        channels[name] = np.unwrap(channels[name])
    segments: list[TrialLog] = []
    for k, (start, stop) in enumerate(stretches):
        part = {n: v[start:stop] for n, v in channels.items()}
        words = {n: v[start:stop] for n, v in text.items()}
        name = path.stem if len(stretches) == 1 else f"{path.stem}[{k + 1}]"
        log = _segment(
            name, path, vessel, t[start:stop], sample_time, part, words, states, fill or {},
            [str(c) for c in table.columns], known,
        )  # fmt: skip
        if log is not None:
            segments.append(log)
    if not segments:
        raise too_late(vessel, path.name)
    derived = (*known.derived, *segments[0].provenance.derived)
    _log.info(
        "read %s: %d rows every %g s in %d segment(s); columns %s%s", path, len(t), sample_time,
        len(segments), ", ".join(map(str, table.columns)), "".join(f"; {d}" for d in derived),
    )  # fmt: skip
    known = replace(known, derived=derived)
    return [replace(s, provenance=known) for s in segments]


def _segment(
    name: str,
    path: Path,
    vessel: Vessel,
    t: Array,
    sample_time: float,
    channels: dict[str, Array],
    text: Mapping[str, NDArray[Any]],
    states: tuple[str, ...],
    fill: Mapping[str, float],
    columns: list[str],
    before: Provenance,
) -> TrialLog | None:
    """Return the log of one stretch, None where a late clock leaves too little of it."""
    derived: list[str] = []
    if "V_q" in channels and "u_q" not in channels:
        if "gamma_q" in channels:
            pair = relative_wind(channels["V_q"], channels["gamma_q"])
            derived.append("u_q, v_q from V_q, gamma_q (5.41-5.43)")
            channels["u_q"], channels["v_q"] = pair
        elif "dir_q" in channels:
            pair = relative_wind_from_direction(channels["V_q"], channels["dir_q"])
            derived.append("u_q, v_q from the apparent wind's speed and direction (5.40)")
            channels["u_q"], channels["v_q"] = pair
    correction = correct_channels(channels, sample_time, vessel, before.derived, before.fixed)
    derived += correction.said
    kept = slice(correction.before, len(t) - correction.after)
    t = t[kept]
    if len(t) < _MIN_SAMPLES:
        return None
    channels = {n: v[kept] for n, v in correction.channels.items()}
    text = {n: v[kept] for n, v in text.items()}
    _derive_velocities(channels, vessel, sample_time, derived)
    for other, value in fill.items():
        channels.setdefault(other, np.full(len(t), float(value)))
    _require(channels, vessel, states or ("u", "v", "r"), path.name, columns)
    closed, known = np.zeros(len(t), bool), False
    if vessel.closed_loop is not None and vessel.closed_loop[0] in text:
        closed = np.isin(text[vessel.closed_loop[0]], vessel.closed_loop[1])
        known = True
    log = TrialLog(
        name, sample_time, t, channels, vessel, closed, known, Provenance(derived=tuple(derived))
    )
    if any(d.startswith("u, v") and "(3.57)" in d for d in derived):
        # the first and last sample have only one neighbour (3.57)
        log = replace(log.window(1, len(log) - 1), name=name)
    return log


def _canonical(
    table: TableFile, vessel: Vessel, path: Path, *, plan: bool
) -> tuple[dict[str, Array], dict[str, NDArray[Any]]]:
    """Return the numeric channels in SI, and the text columns, by canonical name."""
    assigned = assign(table.columns, vessel, units=table.units, guess=False)
    missing = [raw for raw in vessel.columns if raw not in table.columns]
    if "t" not in assigned:
        raise LogError(
            f"'{path.name}' has no column 't'.{suggestion('t', table.columns)} "
            f"Map the time column in the vessel file's [columns] with its unit."
        )
    batch = read_columns(table, [a.raw for a in assigned.values()])
    channels: dict[str, Array] = {}
    text: dict[str, NDArray[Any]] = {}
    loop = vessel.closed_loop[0] if vessel.closed_loop else None
    if loop is not None and loop in assigned:
        text[loop] = batch[assigned.pop(loop).raw].astype(str)
    positions = [n for n in ("x_n", "y_n") if n in assigned]
    if {"u", "v"} <= assigned.keys() and any(
        not np.isfinite(_floats(batch, assigned[n])).all() for n in positions
    ):
        # positions are not needed where velocities were logged: they may have holes
        for place in positions:
            assigned.pop(place)
    for beside in set(vessel.recorded_columns) - set(vessel.commands):
        # what moves no model is not needed either
        if beside in assigned and not np.isfinite(_floats(batch, assigned[beside])).all():
            assigned.pop(beside)
    for name, a in assigned.items():
        target = CHANNELS[name].unit if name in CHANNELS else None
        if name in vessel.recorded_angles:
            target = "rad"
        factor = a.sign * (unit_factor(a.unit, target, a.raw) if a.unit is not None else 1.0)
        value = _finite(_floats(batch, a), a.raw, table)
        if a.raw in table.dates and name == "t":
            value = value - value[0]
        channels[name] = value if factor == 1.0 else value * factor
    for raw in missing:
        name = vessel.columns[raw].name
        if name in vessel.recorded_columns and name not in vessel.commands:
            continue
        if name not in channels and (name in vessel.commands or not plan):
            raise LogError(
                f"'{path.name}' has no column '{raw}', which [columns] maps to '{name}'."
                f"{suggestion(raw, table.columns)} Correct the name in the vessel file."
            )
    return channels, text


def _floats(batch: Batch, a: Assigned) -> Array:
    values = batch[a.raw]
    if values.dtype == object:
        return np.full(len(values), np.nan)
    return np.asarray(values, float)


def _finite(values: Array, name: str, table: TableFile) -> Array:
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        raise LogError(
            f"column '{name}' of '{table.path.name}' holds no finite number in row "
            f"{int(bad[0]) + table.first_row} and in {len(bad)} of {len(values)} rows: "
            f"{_importer(table)} reads such logs and keeps the holes as gaps."
        )
    return values


def _importer(table: TableFile) -> str:
    """Return what mends a table that is no clean log."""
    return "recording_from_pandas" if table.format == "DataFrame" else "greybox import"


def _stretches(t: Array, table: TableFile) -> tuple[list[tuple[int, int]], float]:
    """Return the stretches between gaps, and the sample time."""
    name, importer = table.path.name, _importer(table)
    steps = np.diff(t)
    wrong = np.flatnonzero(steps <= 0)
    if len(wrong):
        k = int(wrong[0])
        raise LogError(
            f"time in '{name}' goes from {t[k]:.6g} to {t[k + 1]:.6g} s in row "
            f"{k + 1 + table.first_row}, it must increase: {importer} sorts the rows and drops "
            f"repeated ones."
        )
    usual = float(np.median(steps))
    multiple = np.round(steps / usual)
    off = np.abs(steps - multiple * usual) > _JITTER * usual
    gaps = (multiple > 1) & ~off
    if off.any() or gaps.sum() > 0.2 * len(steps):
        k = int(np.flatnonzero(off | gaps)[0])
        raise LogError(
            f"'{name}' has two sample times: {usual:.6g} s, but {steps[k]:.6g} s after "
            f"t = {t[k]:.6g} s ({int((off | gaps).sum())} of {len(steps)} steps differ). "
            f"Resample it to one with {importer}."
        )
    edges = [0, *(np.flatnonzero(gaps) + 1).tolist(), len(t)]
    found = [(a, b) for a, b in pairwise(edges) if b - a >= _MIN_SAMPLES]
    if not found:
        raise LogError(
            f"'{name}' has no {_MIN_SAMPLES} samples between two gaps: use a log with fewer."
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
    return found, round(max(means)[1], 9)


def _derive_velocities(
    channels: dict[str, Array], vessel: Vessel, sample_time: float, derived: list[str]
) -> None:
    wanted = [n for n in ("u", "v", "r") if n not in channels]
    if not wanted or "psi" not in channels:
        return
    positioned = "x_n" in channels and "y_n" in channels
    if not positioned and wanted != ["r"]:
        return
    zeros = np.zeros_like(channels["psi"])
    u, v, r = velocities_from_positions(
        channels["x_n"] if positioned else zeros,
        channels["y_n"] if positioned else zeros,
        channels["psi"],
        sample_time,
        heading_std=vessel.std("psi") or 0.0,
        antenna=vessel.sensors.get("antenna", (0.0, 0.0)),
    )
    for name, value in zip("uvr", (u, v, r), strict=True):
        if name in wanted:
            channels[name] = value
    made = ", ".join(wanted)
    derived.append(f"{made} from positions and heading by central differences (3.57)")
    if "u" in wanted:
        derived += said_antenna(vessel.sensors.get("antenna", (0.0, 0.0)))


def _require(
    channels: dict[str, Array],
    vessel: Vessel,
    states: tuple[str, ...],
    name: str,
    columns: list[str],
) -> None:
    for column in vessel.commands:
        if column not in channels:
            raise LogError(
                f"'{name}' has no column '{column}', which moves a thruster of "
                f"'{vessel.name}'.{suggestion(column, columns)} Its columns: "
                f"{', '.join(columns[:30])}."
            )
    for state in states:
        if state not in channels:
            need = "psi and x_n, y_n" if state in "uv" else "psi"
            raise LogError(
                f"'{name}' has no '{state}' and it cannot be derived without {need}."
                f"{suggestion(state, columns)} Map the columns in the vessel file's [columns]."
            )
    if "psi" not in channels and set(states) & {"v", "r"}:
        raise LogError(
            f"'{name}' has no heading 'psi'.{suggestion('psi', columns)} "
            f"Map it in the vessel file's [columns] with its unit."
        )
