"""Correction of a log for the sensor errors that the vessel file's ``[sensors]`` states.

Each correction is a step that the vessel file decided. What such steps add up to is known of
a log, so that one that is written and read again, or imported with a vessel file that said so
already, is only corrected by what is new.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from math import ceil, isclose

import numpy as np

from greybox.channels import MOTIONS
from greybox.errors import LogError
from greybox.rotation import body_to_ned, ned_to_body
from greybox.trial.kinematics import carried_gaps
from greybox.trial.log import TrialLog
from greybox.trial.raw_log import Array
from greybox.trial.steps import Step, Value
from greybox.vessel.vessel import Vessel

Arm = tuple[float, float]

# keys that a finding made void which mended the same
_MENDED_BY = {"heading_bias": "turn_heading", "antenna": "move_antenna"}
# sums of corrections that a record tells differ from what is stated by rounding only
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Correction:
    """Channels without the defects of the sensors.

    Parameters
    ----------
    channels : mapping of str to ndarray
        (N,) each.
    steps : tuple of Step
        What was done.
    notes : tuple of str
        What is stated and was not done, and why.
    before, after : int
        Samples at either end that hold nothing, since a clock was moved.
    """

    channels: Mapping[str, Array]
    steps: tuple[Step, ...] = ()
    notes: tuple[str, ...] = ()
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
    """Return a log corrected for the sensor errors that a vessel file states.

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
    made = correct_channels(log.channels, log.sample_time, vessel, known.steps)
    read = (*known.read, *(n for n in made.notes if n not in known.read))
    provenance = replace(known, steps=(*known.steps, *made.steps), read=read)
    missing = carried_gaps(log.missing, made.steps, log.sample_time)
    out = replace(
        log, channels=made.channels, vessel=vessel, provenance=provenance, missing=missing
    )
    if not made.before and not made.after:
        return out
    if len(log) - made.before - made.after < 3:
        raise clock_shift_error(vessel, log.name)
    return out.window(made.before, len(log) - made.after, log.name)


def correct_channels(
    channels: Mapping[str, Array], sample_time: float, vessel: Vessel, steps: Iterable[Step] = ()
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
    steps : iterable of Step
        What was done to the channels before.
    """
    steps = tuple(steps)
    if not MOTIONS & channels.keys():
        return Correction(channels)
    before = _removed(steps)
    now, notes = _wanted(vessel, before, steps)
    derived = {n for s in steps if s.derives_motion for n in s.channels}
    was_derived = bool(derived & {"u", "v"})
    late = {c: s - before.clock.get(c, 0.0) for c, s in now.clock.items()}
    late = {c: s for c, s in late.items() if not _same(s, 0.0) and c in channels}
    if "psi" in late and "r" in derived and "r" in channels:
        late.setdefault("r", late["psi"])
    turned = [c for c in now.reversed if c in channels and c not in before.reversed]
    with_heading = was_derived or bool(vessel.sensors.get("velocities_from_heading"))

    out = {n: -v if n in turned else v for n, v in channels.items()}
    for name, seconds in late.items():
        if name not in ("u", "v"):
            out[name] = _earlier(out[name], seconds / sample_time)
    bias = now.heading_bias - before.heading_bias
    if not _same(bias, 0.0) and "psi" in out:
        out["psi"] = out["psi"] - bias
    sensor = "antenna" if was_derived else "velocity_at"
    arms = getattr(before, sensor), getattr(now, sensor)
    if {"u", "v"} <= out.keys():
        shifts = [
            late.get(own, late.get(place, 0.0) if was_derived else 0.0) / sample_time
            for own, place in (("u", "x_n"), ("v", "y_n"))
        ]
        _correct_velocities(channels, out, arms, shifts, sample_time, with_heading=with_heading)
    most, least = max(late.values(), default=0.0), min(late.values(), default=0.0)
    return Correction(
        out,
        _steps(out, turned, late, bias, arms, sensor),
        notes,
        before=ceil(max(-least, 0.0) / sample_time - 1e-9),
        after=ceil(max(most, 0.0) / sample_time - 1e-9),
    )


def clock_shift_error(vessel: Vessel, name: str) -> LogError:
    """Return the error of a log that moved clocks leave fewer than three samples."""
    clock = ", ".join(f"{c} by {s:g} s" for c, s in vessel.sensors.get("clock", {}).items())
    return LogError(
        f"'{name}' keeps fewer than 3 samples in which all channels are known once its clocks "
        f"are moved ({clock}): use a longer log, or correct clock in [sensors]."
    )


def _same(a: float, b: float) -> bool:
    return isclose(a, b, rel_tol=_ROUNDING, abs_tol=_ROUNDING)


def _removed(steps: Iterable[Step]) -> _Defects:
    """Return what the vessel file's corrections took out of the channels, in all."""
    clock: dict[str, float] = {}
    bias, turned = 0.0, set[str]()
    arms: dict[Value, Arm] = {"antenna": (0.0, 0.0), "velocity_at": (0.0, 0.0)}
    for step in steps:
        if step.decided_by != "vessel":
            continue
        if step.operation == "shift":
            for c in step.channels:
                clock[c] = clock.get(c, 0.0) + step.number("late")
        elif step.operation == "turn_heading":
            bias += step.number("angle")
        elif step.operation == "scale" and step.number("factor") < 0:
            turned ^= set(step.channels)
        elif step.operation == "move_velocity":
            sensor = step.parameters.get("sensor", "velocity_at")
            x, y = arms.get(sensor, (0.0, 0.0))
            arms[sensor] = (x + step.number("x"), y + step.number("y"))
    return _Defects(bias, clock, arms["velocity_at"], arms["antenna"], tuple(sorted(turned)))


def _wanted(
    vessel: Vessel, before: _Defects, steps: Iterable[Step]
) -> tuple[_Defects, tuple[str, ...]]:
    """Return what the channels must be rid of in all, and what is not to be applied."""
    stated = {k: v for k, v in vessel.sensors.items() if k in _Defects.__dataclass_fields__}
    if "antenna" in stated:
        stated["antenna"] = stated["antenna"][:2]
    mends = [s for s in steps if s.decided_by != "vessel" and not s.source]
    done = {s.operation for s in mends}
    void = [k for k, operation in _MENDED_BY.items() if k in stated and operation in done]
    for key in void:
        del stated[key]
    signs = {n for s in mends if s.operation == "scale" and s.number("factor") < 0
             for n in s.channels}  # fmt: skip
    mended = signs & set(stated.get("reversed", ()))
    if mended:
        stated["reversed"] = tuple(c for c in stated["reversed"] if c not in mended)
        void.append(f"reversed of {', '.join(sorted(mended))}")
    shifted = {n for s in mends if s.operation == "shift" for n in s.channels}
    if shifted & MOTIONS:
        # the checks move either side of a lateness, and leave all motions on one clock
        shifted |= MOTIONS
    mended = shifted & set(stated.get("clock", ()))
    if mended:
        stated["clock"] = {c: late for c, late in stated["clock"].items() if c not in mended}
        void.append(f"clock of {', '.join(sorted(mended))}")
    notes = (f"[sensors] {k} is not applied: it was mended when the log was made" for k in void)
    return replace(before, **stated), tuple(notes)


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
    moved = not (_same(x0, x1) and _same(y0, y1))
    late = any(shifts)
    heading = with_heading and "psi" in out and (late or out["psi"] is not raw["psi"])
    if not moved and not heading and not late:
        return
    u, v = out["u"], out["v"]
    if moved or x0 or y0:
        rate = raw["r"] if "r" in raw else np.gradient(raw["psi"], sample_time)
        u, v = u - rate * y0, v + rate * x0
    if heading:
        north, east = body_to_ned(u, v, raw["psi"])
        u, v = ned_to_body(_earlier(north, shifts[0]), _earlier(east, shifts[1]), out["psi"])
    elif late:
        u, v = _earlier(u, shifts[0]), _earlier(v, shifts[1])
    if moved or x0 or y0:
        rate = out["r"] if "r" in out else np.gradient(out["psi"], sample_time)
        u, v = u + rate * y1, v - rate * x1
    out["u"], out["v"] = u, v


def _steps(
    out: Mapping[str, Array],
    turned: list[str],
    late: Mapping[str, float],
    bias: float,
    arms: tuple[Arm, Arm],
    sensor: str,
) -> tuple[Step, ...]:
    """Return what was done, each by how much more than before."""

    def step(operation: str, channels: Iterable[str], **parameters: Value) -> Step:
        return Step(operation, tuple(channels), (), parameters, decided_by="vessel")

    steps = [step("scale", turned, factor=-1.0)] if turned else []
    for seconds in dict.fromkeys(late.values()):
        steps.append(step("shift", (c for c, s in late.items() if s == seconds), late=seconds))
    if not _same(bias, 0.0) and "psi" in out:
        steps.append(step("turn_heading", ("psi",), angle=bias))
    (x0, y0), (x1, y1) = arms
    if not (_same(x0, x1) and _same(y0, y1)) and {"u", "v"} <= out.keys():
        steps.append(step("move_velocity", ("u", "v"), x=x1 - x0, y=y1 - y0, sensor=sensor))
    return tuple(steps)
