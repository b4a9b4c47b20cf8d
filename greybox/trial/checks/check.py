"""All checks of a recording, in the order in which one defect hides another."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from greybox.trial.checks.course import course_findings
from greybox.trial.checks.finding import IDS, CheckReport, Finding, Outcome
from greybox.trial.checks.frame_sign_unit import (
    find_reading,
    frame_outcomes,
    read,
    reading_findings,
)
from greybox.trial.checks.motion import make_motion
from greybox.trial.checks.sensor_offsets.find import find_offsets
from greybox.trial.checks.signal_quality import (
    angle_unit_findings,
    coarse_findings,
    missing_findings,
    spike_findings,
    stuck_findings,
    time_findings,
)
from greybox.trial.checks.thruster_response import response_findings
from greybox.trial.checks.wind_convention import wind_findings
from greybox.trial.convert.channel_mapping import read_recording
from greybox.trial.convert.derived_signals import derive_signals
from greybox.trial.raw_log import Recording
from greybox.trial.repair import apply_repairs
from greybox.vessel.vessel import Vessel


def check_files(paths: Sequence[str | Path], vessel: Vessel) -> list[CheckReport]:
    """Check log or raw files, each by itself.

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
    """
    reports = []
    for path in paths:
        reports.append(check_recording(read_recording(path, vessel), vessel))
    return reports


def check_recording(recording: Recording, vessel: Vessel) -> CheckReport:
    """Check one recording.

    Parameters
    ----------
    recording : Recording
        Canonical signals as they were recorded; what it says was derived proves nothing.
    vessel : Vessel

    Returns
    -------
    CheckReport
        Findings by id, and what became of every check.
    """
    findings: list[Finding] = []
    findings += time_findings(recording)
    findings += missing_findings(recording)
    findings += angle_unit_findings(recording, vessel)
    whole = derive_signals(apply_repairs(recording, findings))
    measured = _independent(whole)
    rows = [
        *stuck_findings(measured, vessel),
        *spike_findings(measured),
        *coarse_findings(measured),
    ]
    findings += rows
    steady = apply_repairs(whole, [f for f in rows if f.safe])
    independent = _independent(steady)
    motion = make_motion(independent)
    outcomes = {o.id: o for o in frame_outcomes(motion)}
    if motion is not None and (motion.positioned or motion.turned):
        reading = find_reading(motion)
        findings += reading_findings(reading)
        motion = read(motion, reading.changes)
        steady = apply_repairs(steady, reading_findings(reading))
        found, said = find_offsets(motion, vessel)
        findings += found
        outcomes |= {o.id: o for o in said}
    if motion is None or not motion.positioned:
        found, said = course_findings(steady, vessel)
        findings += found
        outcomes |= {o.id: o for o in said}
    findings += wind_findings(steady, findings)
    findings += response_findings(steady, vessel, findings)
    return CheckReport(
        recording.name,
        tuple(findings),
        _outcomes(findings, outcomes),
        recording.notes,
        recording,
    )


def _independent(recording: Recording) -> Recording:
    """Leave out what was derived from other channels."""
    gone: set[str] = set()
    for sentence in recording.derived:
        names, _, source = sentence.partition(" from ")
        if source.startswith(("positions", "heading", "the velocity over ground")):
            gone |= {n.strip() for n in names.split(",")}
    return recording.with_signals(s for s in recording.signals if s.name not in gone)


def _outcomes(findings: list[Finding], said: dict[str, Outcome]) -> tuple[Outcome, ...]:
    found = {f.id for f in findings}
    outcomes = []
    for kind in IDS:
        if kind in found:
            count = sum(f.id == kind for f in findings)
            outcomes.append(Outcome(kind, "found", f"{count} finding{'s' if count > 1 else ''}"))
        else:
            outcomes.append(said.get(kind, Outcome(kind, "clean", "nothing found")))
    return tuple(outcomes)
