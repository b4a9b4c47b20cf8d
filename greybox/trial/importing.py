"""From recordings to logs: one sample time, gaps kept as gaps, provenance kept."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from greybox.channels import LOGGED
from greybox.errors import LogError
from greybox.trial.conditioning import velocities_from_positions
from greybox.trial.deriving import derive_signals, earth_to_body
from greybox.trial.log import Provenance, TrialLog
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
)
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]

_MOTION = ("x_n", "y_n", "psi", "u", "v", "r", "v_n", "v_e")
_MIN_SEGMENT = 3
# a grid of more samples than this many times those read is a mistake in the times
_MAX_GROWTH = 50


@dataclass(frozen=True)
class ImportOptions:
    """What the user may decide about an import.

    Parameters
    ----------
    sample_time : float, optional
        Ts of the log [s]; that of the slowest motion sensor by default.
    hole : float, optional
        Shortest step that counts as a gap [s]; 2.5 usual steps of the sensor
        by default.
    velocities : {"central", "savgol"}
        How u, v, r are made from positions where nothing measured them.
    window : float
        Window of the Savitzky-Golay filter [s].
    reference_height : float, optional
        Height [m] to which the wind is brought; as measured by default.
    origin : tuple of float, optional
        Latitude and longitude [deg] of ``x_n = y_n = 0``.
    notes : mapping of str to str
        Draught, loading, depth, sea state and what else was noted of the trial.
    """

    sample_time: float | None = None
    hole: float | None = None
    velocities: str = "central"
    window: float = 2.0
    reference_height: float | None = None
    origin: tuple[float, float] | None = None
    notes: Mapping[str, str] = field(default_factory=dict)


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
    zero: float | None = None,
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
    zero : float, optional
        A time [s] that the samples are to meet, so that blocks of one file share
        their grid; the first common time by default.

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
    recording = derive_signals(recording, options.origin)
    notes: list[str] = []
    signals = {s.name: _orderly(s, notes) for s in recording.signals}
    signals = {n: s for n, s in signals.items() if _filled(s, notes)}
    clocks: dict[int, Clock] = {}
    by_name: dict[str, Clock] = {}
    for name, s in signals.items():
        # columns of one table share their clock: found once
        if id(s.t) not in clocks:
            clocks[id(s.t)] = clock(s.t, options.hole)
        by_name[name] = clocks[id(s.t)]
    motion = [n for n in _MOTION if n in signals]
    inputs = [c for c in vessel.commands if c in signals]
    if not motion and not inputs:
        raise LogError(
            f"'{recording.name}' has no position, heading, velocity or thruster column among "
            f"{', '.join(recording.names) or 'nothing'}: map its columns in the vessel file."
        )
    missing = [c for c in vessel.commands if c not in signals]
    if missing:
        notes.append(
            f"no thruster column {', '.join(missing)}: motion only, no force model can be fitted"
        )
    leading = motion or inputs
    sample_time = options.sample_time or _sample_time([by_name[n] for n in leading])
    grid, keep = _grid([by_name[n] for n in leading], sample_time, recording.name, zero)
    channels = _resample(signals, by_name, vessel, grid, sample_time)
    stretches = [r for r in runs(keep) if r[1] - r[0] >= _MIN_SEGMENT]
    short = len(runs(keep)) - len(stretches)
    if short:
        notes.append(f"{short} stretches of fewer than {_MIN_SEGMENT} samples left out")
    if not stretches:
        raise LogError(
            f"'{recording.name}' has no stretch of {_MIN_SEGMENT} samples at {sample_time:g} s in "
            f"which {', '.join(leading)} all have values: choose a longer sample time or hole."
        )
    held = {
        n: (clock(t), words) for n, (t, words) in recording.text.items() if len(t)
    }
    segments = []
    derived: list[str] = []
    for k, (start, stop) in enumerate(stretches):
        part = {n: v[start:stop].copy() for n, v in channels.items()}
        part, made, trim = _derive(part, vessel, sample_time, options)
        derived = made
        closed, known = _loop(held, vessel, grid[start:stop])
        name = recording.name if len(stretches) == 1 else f"{recording.name}[{k + 1}]"
        log = TrialLog(
            name, sample_time, grid[start:stop], part, vessel, closed, known,
            Provenance(recording.name),
        )  # fmt: skip
        log = log.window(1, len(log) - 1, name) if trim else log
        if len(log) >= _MIN_SEGMENT:
            segments.append(log)
    if not segments:
        raise LogError(
            f"'{recording.name}' has {len(grid)} samples at {sample_time:g} s, too few to derive "
            f"velocities (3.57) between its gaps: choose a shorter sample time."
        )
    gaps = [
        (float(a.t[-1]), float(b.t[0])) for a, b in zip(segments[:-1], segments[1:], strict=True)
    ]
    if gaps:
        longest = max(gaps, key=_length)
        notes.append(
            f"{len(gaps)} gap{'s' if len(gaps) > 1 else ''} kept as such, the longest of "
            f"{_length(longest):.3g} s at t = {longest[0]:.6g} s: {len(segments)} segments"
        )
    first = recording.files[0] if recording.files else None
    provenance = Provenance(
        source=", ".join(f.name for f in recording.files) or recording.name,
        sha256=first.sha256 if first and len(recording.files) == 1 else "",
        derived=tuple(derived),
        fixed=fixed,
        files=tuple((f.name, f.sha256, f.format) for f in recording.files),
        read=(*recording.notes, *notes),
        epoch=recording.epoch,
        notes=dict(options.notes),
    )
    segments = [replace(s, provenance=provenance) for s in segments]
    return Imported(tuple(segments), (*recording.notes, *notes, *derived))


def _length(gap: tuple[float, float]) -> float:
    return gap[1] - gap[0]


def _orderly(signal: Signal, notes: list[str]) -> Signal:
    """Return the signal without missing values, in order of time, each time once."""
    keep = np.isfinite(signal.value) & np.isfinite(signal.t)
    t, value = signal.t, signal.value
    if not keep.all():
        t, value = t[keep], value[keep]
    if len(t) > 1 and not (np.diff(t) > 0).all():
        order = np.argsort(t, kind="stable")
        t, value = t[order], value[order]
        once = np.concatenate([[True], np.diff(t) > 0])
        t, value = t[once], value[once]
    if t is signal.t:
        return signal
    return replace(signal, t=t, value=value)


def _filled(signal: Signal, notes: list[str]) -> bool:
    if len(signal) < _MIN_SEGMENT:
        notes.append(f"{signal.name} has {len(signal)} values: left out")
        return False
    return True


def _sample_time(clocks: list[Clock]) -> float:
    periods = sorted({round(c.period, 9) for c in clocks if c.period > 0})
    if not periods:
        raise LogError("the motion sensors have one sample each: name a longer recording.")
    slowest = max(clocks, key=lambda c: c.period)
    within = [
        (c.t[b - 1] - c.t[a]) / (b - 1 - a)
        for c in [slowest]
        for a, b in zip(c.starts, c.stops, strict=True)
        if b - a > 2
    ]
    # the mean over the longest stretch does not depend on the jitter of single times
    lengths = [b - a for a, b in zip(slowest.starts, slowest.stops, strict=True) if b - a > 2]
    mean = float(within[int(np.argmax(lengths))]) if within else slowest.period
    return nice_period(mean if abs(mean - slowest.period) < 0.2 * mean else slowest.period)


def _grid(
    clocks: list[Clock], sample_time: float, name: str, zero: float | None
) -> tuple[Array, NDArray[np.bool_]]:
    start = max(float(c.t[0]) for c in clocks)
    if zero is not None:
        start = zero + sample_time * np.ceil((start - zero) / sample_time - 1e-6)
    stop = min(float(c.t[-1]) for c in clocks)
    if stop - start < _MIN_SEGMENT * sample_time:
        raise LogError(
            f"the signals of '{name}' overlap from {start:.6g} to {stop:.6g} s, less than "
            f"{_MIN_SEGMENT} samples of {sample_time:g} s: check the clocks of the files, or "
            f"choose a shorter sample time."
        )
    count = int(np.floor((stop - start) / sample_time + 1e-6)) + 1
    read = sum(len(c.t) for c in clocks)
    if count > _MAX_GROWTH * read + 1000:
        raise LogError(
            f"'{name}' spans {stop - start:.4g} s, {count} samples of {sample_time:g} s, but holds "
            f"{read} values: correct its times, or choose a longer sample time."
        )
    # rounding keeps 0.3 from becoming 0.30000000000000004 in the file
    grid = np.round(start + sample_time * np.arange(count), 9)
    keep = np.ones(count, bool)
    for c in {id(c): c for c in clocks}.values():
        keep &= covered(grid, c)
    return grid, keep


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


def _derive(
    part: dict[str, Array], vessel: Vessel, sample_time: float, options: ImportOptions
) -> tuple[dict[str, Array], list[str], bool]:
    """Return the channels of the log, what was derived, and whether the ends must go."""
    derived: list[str] = []
    antenna = vessel.sensors.get("antenna", (0.0, 0.0))
    trim = False
    psi = part.get("psi")
    if psi is not None and "r" not in part and len(psi) > 2:
        part["r"] = np.gradient(psi, sample_time)
        derived.append("r from heading by central differences (3.57)")
        trim = True
    if psi is not None and "u" not in part and "v_n" in part and "v_e" in part:
        # speed and course are the antenna's, u and v the body origin's
        u, v = earth_to_body(part["v_n"], part["v_e"], psi)
        r = part.get("r", np.zeros_like(u))
        part["u"] = u + r * antenna[1]
        part.setdefault("v", v - r * antenna[0])
        derived.append("u, v from the velocity over ground and the heading")
    if psi is not None and "u" not in part and {"x_n", "y_n"} <= part.keys() and len(psi) > 2:
        if options.velocities == "savgol":
            from greybox.trial.smoothing import savgol_velocities

            u, v, r = savgol_velocities(
                part["x_n"], part["y_n"], psi, sample_time, window_s=options.window, order=3,
                heading_std=vessel.std("psi") or 0.0, antenna=antenna,
            )  # fmt: skip
            how = f"Savitzky-Golay over {options.window:g} s"
        else:
            u, v, r = velocities_from_positions(
                part["x_n"], part["y_n"], psi, sample_time,
                heading_std=vessel.std("psi") or 0.0, antenna=antenna,
            )  # fmt: skip
            how = "central differences (3.57)"
        part["u"] = u
        part.setdefault("v", v)
        if any(d.startswith("r from") for d in derived):
            part["r"] = r
        derived.append(f"u, v from positions and heading by {how}")
        trim = True
    _derive_wind(part, vessel, options, derived)
    keep = [n for n in (*LOGGED, *vessel.commands) if n in part]
    return {n: part[n] for n in keep}, derived, trim


def _derive_wind(
    part: dict[str, Array], vessel: Vessel, options: ImportOptions, derived: list[str]
) -> None:
    from greybox.trial.wind import move_anemometer, wind_at_height

    psi, u, v = part.get("psi"), part.get("u"), part.get("v")
    height = vessel.sensors.get("anemometer", (0.0, 0.0, 0.0))[2]
    if "u_q" not in part and psi is not None and u is not None and v is not None:
        if "w_n" in part:
            # components of where it comes from: the air moves the other way
            from_x, from_y = earth_to_body(part["w_n"], part["w_e"], psi)
        elif "w_x" in part:
            from_x, from_y = part["w_x"], part["w_y"]
        else:
            return
        part["u_q"], part["v_q"] = u + from_x, v + from_y
        derived.append("u_q, v_q from the true wind, the heading and the velocity over ground")
    elif "u_q" in part and "anemometer" in vessel.sensors and "r" in part:
        x, y, _ = vessel.sensors["anemometer"]
        part["u_q"], part["v_q"] = move_anemometer(part["u_q"], part["v_q"], part["r"], x, y)
        if x or y:
            derived.append(f"u_q, v_q moved from the anemometer at ({x:g}, {y:g}) m to the origin")
    if options.reference_height is not None and "u_q" in part and u is not None and v is not None:
        if "anemometer" not in vessel.sensors:
            raise LogError(
                f"the wind cannot be brought to {options.reference_height:g} m without the height "
                f"of the anemometer: add anemometer = [x, y, height] to [sensors]."
            )
        part["u_q"], part["v_q"] = wind_at_height(
            part["u_q"], part["v_q"], u, v, height, reference_height=options.reference_height
        )
        derived.append(
            f"true wind brought from {height:g} to {options.reference_height:g} m (1/7 power law)"
        )


def _loop(
    held: Mapping[str, tuple[Clock, NDArray[np.str_]]], vessel: Vessel, grid: Array
) -> tuple[NDArray[np.bool_], bool]:
    if vessel.closed_loop is None or vessel.closed_loop[0] not in held:
        return np.zeros(len(grid), bool), False
    of, words = held[vessel.closed_loop[0]]
    index = hold(of, np.arange(len(words), dtype=float), grid).astype(int)
    return np.isin(words[index], vessel.closed_loop[1]), True
