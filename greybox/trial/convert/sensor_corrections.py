"""Taking out of a log what the vessel file's ``[sensors]`` says is wrong with its sensors.

What was done is said in the log's record under the key of ``[sensors]``, so that
a log that is written and read again, or imported with a vessel file that said
so already, is only corrected by what is new.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from math import ceil
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.errors import LogError
from greybox.trial.convert.derived_signals import earth_to_body
from greybox.trial.log import TrialLog
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]
Arm = tuple[float, float]

_SAID = re.compile(r"\[sensors\] (\w+) = (\S+): ")
# velocities that were made with the heading, in the words of the record
_DERIVED = re.compile(r"(u, v|u|v)\b.* from (positions and heading|the velocity over ground)")
_TURN_RATE = re.compile(r"(u, v, )?r from (positions and )?heading")
# how the record begins to tell that a finding was mended, and the key that it makes void
_MENDED = {
    "heading_bias": "heading_bias", "lever_arm": "antenna", "clock_offset": "clock",
    "sign": "reversed",
}  # fmt: skip
_MOTION = frozenset({"x_n", "y_n", "psi", "u", "v", "r"})


@dataclass(frozen=True)
class Correction:
    """Channels without the defects of the sensors.

    Parameters
    ----------
    channels : mapping of str to ndarray
        (N,) each.
    said : tuple of str
        What was done, one sentence each.
    before, after : int
        Samples at either end that hold nothing, since a clock was moved.
    """

    channels: Mapping[str, Array]
    said: tuple[str, ...] = ()
    before: int = 0
    after: int = 0


@dataclass(frozen=True)
class _Defects:
    """Values of the keys of ``[sensors]``; those that are absent are harmless."""

    heading_bias: float = 0.0
    clock: Mapping[str, float] = field(default_factory=dict)
    velocity_at: Arm = (0.0, 0.0)
    antenna: Arm = (0.0, 0.0)
    reversed: tuple[str, ...] = ()


def correct_log(log: TrialLog, vessel: Vessel | None = None) -> TrialLog:
    """Return a log as it should have been by what a vessel file says of the sensors.

    Parameters
    ----------
    log : TrialLog
        What was corrected before is not corrected again.
    vessel : Vessel, optional
        That of the log by default; the log returned has it.

    Raises
    ------
    LogError
        A clock is so late that fewer than three samples remain.
    """
    vessel = vessel or log.vessel
    known = log.provenance
    made = correct_channels(log.channels, log.sample_time, vessel, known.derived, known.fixed)
    out = replace(
        log,
        channels=made.channels,
        vessel=vessel,
        provenance=replace(known, derived=(*known.derived, *made.said)),
    )
    if not made.before and not made.after:
        return out
    if len(log) - made.before - made.after < 3:
        raise too_late(vessel, log.name)
    return out.window(made.before, len(log) - made.after, log.name)


def correct_channels(
    channels: Mapping[str, Array],
    sample_time: float,
    vessel: Vessel,
    derived: Iterable[str] = (),
    fixed: Iterable[str] = (),
) -> Correction:
    """Take the defects that ``[sensors]`` states out of channels on a uniform clock.

    In this order: reversed channels, late clocks, heading, and last the
    velocities, which were made with the heading (their earth-fixed components
    are kept) or measured away from the origin, or both.

    Parameters
    ----------
    channels : mapping of str to ndarray
        (N,) each, angles unwrapped. Without a motion they are a plan, in which
        there is nothing to correct.
    sample_time : float
        [s]
    vessel : Vessel
    derived, fixed : iterable of str
        What the record says was derived and mended before.

    Returns
    -------
    Correction
    """
    derived = tuple(derived)
    if not _MOTION & channels.keys():
        return Correction(channels)
    before = _said_before(derived)
    now, said = _wanted(vessel, before, tuple(fixed))
    was_derived = any(_DERIVED.match(d) for d in derived)
    late = {c: s - before.clock.get(c, 0.0) for c, s in now.clock.items()}
    late = {c: s for c, s in late.items() if s and c in channels}
    if "psi" in late and any(_TURN_RATE.match(d) for d in derived) and "r" in channels:
        late.setdefault("r", late["psi"])
    turned = [c for c in now.reversed if c in channels and c not in before.reversed]
    with_heading = was_derived or bool(vessel.sensors.get("velocities_from_heading"))

    out = {n: -v if n in turned else v for n, v in channels.items()}
    for name, seconds in late.items():
        if name not in ("u", "v"):
            out[name] = _earlier(out[name], seconds / sample_time)
    bias = now.heading_bias - before.heading_bias
    if bias and "psi" in out:
        out["psi"] = out["psi"] - bias
    if {"u", "v"} <= out.keys():
        arms = (
            (before.antenna, now.antenna) if was_derived else (before.velocity_at, now.velocity_at)
        )
        shifts = [
            late.get(own, late.get(place, 0.0) if was_derived else 0.0) / sample_time
            for own, place in (("u", "x_n"), ("v", "y_n"))
        ]
        _correct_velocities(channels, out, arms, shifts, sample_time, with_heading=with_heading)
    said += _sentences(before, now, late, turned, out, was_derived)
    most, least = max(late.values(), default=0.0), min(late.values(), default=0.0)
    return Correction(
        out,
        tuple(said),
        before=ceil(max(-least, 0.0) / sample_time - 1e-9),
        after=ceil(max(most, 0.0) / sample_time - 1e-9),
    )


def too_late(vessel: Vessel, name: str) -> LogError:
    """Return the error of a log that moved clocks leave fewer than three samples."""
    clock = ", ".join(f"{c} by {s:g} s" for c, s in vessel.sensors.get("clock", {}).items())
    return LogError(
        f"'{name}' keeps fewer than 3 samples in which all channels are known once its clocks "
        f"are moved ({clock}): use a longer log, or correct clock in [sensors]."
    )


def _said_before(derived: tuple[str, ...]) -> _Defects:
    found: dict[str, Any] = {}
    for sentence in derived:
        match = _SAID.match(sentence)
        if match is None or match[1] not in _Defects.__dataclass_fields__:
            continue
        try:
            value = json.loads(match[2])
        except ValueError:
            continue
        found[match[1]] = tuple(value) if isinstance(value, list) else value
    return _Defects(**found)


def _wanted(vessel: Vessel, before: _Defects, fixed: tuple[str, ...]) -> tuple[_Defects, list[str]]:
    """Return what the channels must be rid of in all, and what is not to be applied."""
    stated = {k: v for k, v in vessel.sensors.items() if k in _Defects.__dataclass_fields__}
    if "antenna" in stated:
        stated["antenna"] = stated["antenna"][:2]
    said = []
    for kind, key in _MENDED.items():
        if key in stated and any(f.startswith(f"{kind} of") for f in fixed):
            del stated[key]
            said.append(f"[sensors] {key} is not applied: it was mended when the log was made")
    return replace(before, **stated), said


def _earlier(value: Array, samples: float) -> Array:
    """Return what a channel that is late by so many samples should have held."""
    k = np.arange(len(value), dtype=float)
    return np.interp(k + samples, k, value)


def _correct_velocities(
    raw: Mapping[str, Array],
    out: dict[str, Array],
    arms: tuple[Arm, Arm],
    shifts: list[float],
    sample_time: float,
    *,
    with_heading: bool,
) -> None:
    """Correct u and v in place, between where they were measured and the origin."""
    (x0, y0), (x1, y1) = arms
    moved = arms[0] != arms[1]
    heading = with_heading and "psi" in out and out["psi"] is not raw["psi"]
    if not moved and not heading and not any(shifts):
        return
    u, v = out["u"], out["v"]
    if moved or x0 or y0:
        rate = raw["r"] if "r" in raw else np.gradient(raw["psi"], sample_time)
        u, v = u - rate * y0, v + rate * x0
    if heading:
        c, s = np.cos(raw["psi"]), np.sin(raw["psi"])
        north, east = _earlier(c * u - s * v, shifts[0]), _earlier(s * u + c * v, shifts[1])
        u, v = earth_to_body(north, east, out["psi"])
    elif any(shifts):
        u, v = _earlier(u, shifts[0]), _earlier(v, shifts[1])
    if moved or x0 or y0:
        rate = out["r"] if "r" in out else np.gradient(out["psi"], sample_time)
        u, v = u + rate * y1, v - rate * x1
    out["u"], out["v"] = u, v


def _sentences(
    before: _Defects,
    now: _Defects,
    late: Mapping[str, float],
    turned: list[str],
    out: Mapping[str, Array],
    was_derived: bool,
) -> list[str]:
    said = []
    if turned:
        whole = sorted({*before.reversed, *turned})
        said.append(_say("reversed", whole, f"the sign of {', '.join(turned)} turned"))
    if late:
        moved = ", ".join(f"{c} by {s:g} s" for c, s in late.items())
        said.append(_say("clock", {**before.clock, **now.clock}, f"earlier by it, {moved}"))
    if now.heading_bias != before.heading_bias and "psi" in out:
        said.append(_say("heading_bias", now.heading_bias, "psi turned back by it [rad]"))
    key = "antenna" if was_derived else "velocity_at"
    arm = getattr(now, key)
    if arm != getattr(before, key) and {"u", "v"} <= out.keys():
        said.append(_say(key, list(arm), "u, v brought to the body origin"))
    return said


def _say(key: str, value: Any, done: str) -> str:
    return f"[sensors] {key} = {json.dumps(value, separators=(',', ':'))}: {done}"


def said_antenna(antenna: tuple[float, ...]) -> list[str]:
    """Return what the record says of velocities that were derived with this antenna."""
    arm = [float(a) for a in antenna[:2]]
    return [_say("antenna", arm, "u, v are those of the body origin")] if any(arm) else []
