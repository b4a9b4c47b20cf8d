"""All checks of a recording, in the order in which one defect hides another."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from greybox.errors import LogError, UsageError, so_many
from greybox.files import real_path
from greybox.numerics.parallel import map_forked
from greybox.trial.actuator_estimate import ActuatorEstimate
from greybox.trial.checks.actuators import measure_actuators
from greybox.trial.checks.course import course_findings, make_course
from greybox.trial.checks.external_force import force_findings
from greybox.trial.checks.finding import IDS, CheckReport, Finding, Outcome
from greybox.trial.checks.frame_sign_unit import (
    find_readings,
    frame_outcomes,
    reading_findings,
)
from greybox.trial.checks.heading_wrap import wrap_findings
from greybox.trial.checks.motion import Motion, make_motion
from greybox.trial.checks.position_hold import hold_findings
from greybox.trial.checks.position_jump import jump_findings
from greybox.trial.checks.sensor_offsets.findings import Tied, find_offsets
from greybox.trial.checks.signal_quality import (
    MOTION,
    angle_unit_findings,
    coarse_findings,
    missing_findings,
    spike_findings,
    still_rudder_findings,
    stuck_findings,
    time_findings,
    time_format_findings,
)
from greybox.trial.checks.thruster_response import answer_findings
from greybox.trial.checks.track import track_findings
from greybox.trial.checks.wind_convention import wind_findings
from greybox.trial.convert.channel_mapping import read_recording
from greybox.trial.convert.deduplicate import first_run
from greybox.trial.convert.derived_signals import derive_signals
from greybox.trial.raw_log import Recording
from greybox.trial.repair import apply_repairs
from greybox.vessel.vessel import Vessel

_log = logging.getLogger(__name__)


@dataclass
class _Log:
    """A log on its way through the checks.

    Parameters
    ----------
    recorded : Recording
        As it was read.
    findings : list of Finding
        So far.
    outcomes : dict of str to Outcome
        What became of the checks that found nothing.
    mended : Recording
        With what was found so far mended, where that is safe.
    motion : Motion, optional
        Its motion channels on one grid; None where too few overlap.
    """

    recorded: Recording
    findings: list[Finding]
    outcomes: dict[str, Outcome]
    mended: Recording
    motion: Motion | None = None

    def add(self, findings: Sequence[Finding]) -> None:
        """Keep findings, and mend what is safe to mend."""
        self.findings += findings
        self.mended = apply_repairs(self.mended, [f for f in findings if f.safe])

    def say(self, outcomes: Sequence[Outcome]) -> None:
        """Keep what became of checks."""
        self.outcomes |= {o.id: o for o in outcomes}


def check_files(paths: Sequence[str | Path], vessel: Vessel) -> list[CheckReport]:
    """Check log or raw files of one ship together.

    Parameters
    ----------
    paths : sequence of str or Path
    vessel : Vessel

    Returns
    -------
    list of CheckReport
        One a file, in their order.

    Raises
    ------
    LogError
        A file cannot be read.
    UsageError
        A file is named twice, or a copy of it: its evidence would count twice.
    """
    require_each_once(paths)
    return check_recordings([read_recording(path, vessel) for path in paths], vessel)


def require_each_once(paths: Sequence[str | Path]) -> None:
    """Raise where a file is named twice.

    Raises
    ------
    UsageError
        Names the file.
    """
    places = [real_path(path) for path in paths]
    twice = next((p for p in places if places.count(p) > 1), None)
    if twice is not None:
        raise UsageError(
            f"'{twice.name}' is named {places.count(twice)} times and would count as "
            f"{places.count(twice)} logs: name each log once."
        )


def check_recording(recording: Recording, vessel: Vessel) -> CheckReport:
    """Check one recording, as `check_recordings` does several.

    Parameters
    ----------
    recording : Recording
        Canonical signals as they were recorded.
    vessel : Vessel

    Returns
    -------
    CheckReport
        Findings by id, and what became of every check.
    """
    return check_recordings([recording], vessel)[0]


def check_recordings(
    recordings: Sequence[Recording], vessel: Vessel, *, forces: bool = True
) -> list[CheckReport]:
    """Check recordings of one ship: samples log by log, instruments over all logs together.

    Parameters
    ----------
    recordings : sequence of Recording
        Canonical signals as they were recorded; what they say was derived proves nothing.
    vessel : Vessel
    forces : bool
        Whether wind, thrusters and actuators are checked, too.

    Returns
    -------
    list of CheckReport
        One a recording, in their order: findings by id, and what became of every check.

    Raises
    ------
    UsageError
        Two are of the same file, or of copies of one: its evidence would count twice.
    """
    known: dict[tuple[str, ...], str] = {}
    for k, recording in enumerate(recordings):
        content = tuple(f.sha256 for f in recording.files) or (str(k),)
        name = ", ".join(f.name for f in recording.files)
        if content in known:
            raise UsageError(
                f"'{known[content]}' and '{name}' are the same recording, byte for byte, and would "
                f"count as 2 logs: name one of them."
            )
        known[content] = name
    _log.info("samples of %d log(s)", len(recordings))
    logs = map_forked(lambda recording: _signal_quality(recording, vessel), recordings)
    _log.info("axes, signs, units, clocks, antenna and heading of %d log(s) together", len(logs))
    _kinematics(logs, vessel)
    actuators: tuple[ActuatorEstimate, ...] = ()
    if forces:
        _log.info("wind, thrusters and actuators")
        _forces(logs, vessel)
        actuators = _actuators(logs, vessel)
    return [
        CheckReport(
            log.recorded.name,
            tuple(log.findings),
            _outcomes(log.findings, log.outcomes),
            (*log.recorded.notes, *vessel.doubts),
            log.recorded,
            tuple(a for a in actuators if log.recorded.name in a.logs),
        )
        for log in logs
    ]


def misnamed_columns(paths: Sequence[str | Path], vessel: Vessel) -> list[str]:
    """Say which columns hold another unit, frame or sign than their names, as a check finds it.

    Parameters
    ----------
    paths : sequence of str or Path
        Logs of one ship.
    vessel : Vessel

    Returns
    -------
    list of str
        A sentence for each of these findings: the evidence, and what to write or run. A log
        that only a check refuses has none.
    """
    logs = []
    for path in paths:
        with suppress(LogError):
            logs.append(_signal_quality(read_recording(path, vessel), vessel))
    _read_columns(logs)
    return [
        f"{log.recorded.name}: {f.evidence}. To mend it, {f.fix}."
        for log in logs
        for f in log.findings
        if f.id in ("unit", "frame", "sign")
    ]


def _signal_quality(recording: Recording, vessel: Vessel) -> _Log:
    """Check the samples of one log, each channel by itself."""
    raw = time_format_findings(recording)
    raw += time_findings(apply_repairs(recording, raw))
    raw += missing_findings(recording)
    # before the heading is unwrapped
    raw += wrap_findings(first_run(apply_repairs(recording, raw)))
    raw += angle_unit_findings(recording, vessel)
    mended = first_run(apply_repairs(recording, raw))
    tracks = track_findings(mended)
    raw += tracks
    whole = derive_signals(apply_repairs(mended, [f for f in tracks if f.safe]))
    log = _Log(recording, raw, {}, whole)
    log.add(hold_findings(_independent(whole)))
    measured = _independent(log.mended)
    log.add(
        [
            *stuck_findings(measured),
            *spike_findings(measured),
            *coarse_findings(measured),
        ]
    )
    log.add(jump_findings(_independent(log.mended), vessel))
    if not {"x_n", "y_n"} <= set(whole.names):
        missing = "needs positions, which the log has not"
        log.say([Outcome(i, "cannot tell", missing) for i in ("position_hold", "position_jump")])
    if not any(f.channel in vessel.rudders for f in raw):
        log.add(still_rudder_findings(log.mended, vessel))
    log.motion = make_motion(_independent(log.mended))
    return log


def _read_columns(logs: Sequence[_Log]) -> list[Motion | None]:
    """Check units, frames and signs of the motion channels, and return the motions so read."""
    motions = [log.motion for log in logs]
    for log in logs:
        log.say(frame_outcomes(log.motion))
    usable = [i for i, m in enumerate(motions) if m is not None and (m.positioned or m.turned)]
    courses = [make_course(logs[i].mended) for i in usable]
    readings = find_readings([m for i in usable if (m := motions[i]) is not None], courses)
    names = [logs[i].recorded.name for i in usable]
    for i, reading in zip(usable, readings, strict=True):
        logs[i].add(reading_findings(reading, names))
        motions[i] = reading.motion
    return motions


def _kinematics(logs: Sequence[_Log], vessel: Vessel) -> None:
    """Check what ties positions, heading, velocities and yaw rate of the logs together."""
    motions = _read_columns(logs)
    tied = [Tied(log.recorded.name, log.mended, m) for log, m in zip(logs, motions, strict=True)]
    for log, (found, said) in zip(logs, find_offsets(tied, vessel), strict=True):
        log.findings += found
        log.say(said)
    for log, motion in zip(logs, motions, strict=True):
        of_motion = [f for f in log.findings if set(f.channels) & {*MOTION, "lat", "lon", "cog"}]
        doubt = _in_doubt(of_motion)
        if doubt is not None:
            log.say([Outcome("heading_bias", "cannot tell", doubt)])
        elif motion is None or not motion.positioned:
            found, said = course_findings(log.mended, vessel)
            log.findings += found
            log.say(said)


def _forces(logs: Sequence[_Log], vessel: Vessel) -> None:
    """Check wind and thrusters of the logs against their motion."""
    for log in logs:
        log.findings += wind_findings(log.mended, log.findings)
    pushed, untold = force_findings([log.mended for log in logs], vessel)
    # what pushes the ship from outside tells nothing of the signs of its thrusters
    own = [apply_repairs(log.mended, forces) for log, forces in zip(logs, pushed, strict=True)]
    signs = answer_findings(own, vessel, [log.findings for log in logs])
    for log, forces, reason, found in zip(logs, pushed, untold, signs, strict=True):
        log.findings += found
        doubt = _in_doubt(log.findings)
        if doubt is not None:
            log.say([Outcome("external_force", "cannot tell", doubt)])
            continue
        log.findings += forces
        log.say([reason] if reason is not None else [])


def _in_doubt(findings: Sequence[Finding]) -> str | None:
    """Return what must be settled before more is told, None where nothing must."""
    doubt = next((f for f in findings if f.id in ("sign", "frame", "unit") and not f.safe), None)
    if doubt is None:
        return None
    return f"the {doubt.id} of {', '.join(doubt.channels)} must be settled first"


def _actuators(logs: Sequence[_Log], vessel: Vessel) -> tuple[ActuatorEstimate, ...]:
    """Measure the actuators from all logs together."""
    estimates, findings, untold = measure_actuators([log.mended for log in logs], vessel)
    for log in logs:
        log.say([untold] if untold is not None else [])
        log.findings += [finding for finding, names in findings if log.recorded.name in names]
    return estimates


def _independent(recording: Recording) -> Recording:
    """Leave out what was derived from other channels."""
    gone = {n for step in recording.steps if step.derives_motion for n in step.channels}
    return recording.with_signals(s for s in recording.signals if s.name not in gone)


def _outcomes(findings: list[Finding], said: dict[str, Outcome]) -> tuple[Outcome, ...]:
    found = {f.id for f in findings}
    outcomes = []
    for kind in IDS:
        if kind in found:
            count = sum(f.id == kind for f in findings)
            outcomes.append(Outcome(kind, "found", so_many(count, "finding")))
        else:
            outcomes.append(said.get(kind, Outcome(kind, "clean", "nothing found")))
    return tuple(outcomes)
