"""Sensor faults that need no force model, because the log contradicts itself.

Positions, heading, velocities and rates of one ship tie each other. What the log checks
find there with certainty is taken out before forces are judged.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr

from greybox.channels import CHANNELS
from greybox.diagnosis.causes import Cause
from greybox.diagnosis.result import Found, Quantity
from greybox.errors import GreyboxError
from greybox.trial.checks.check import check_recordings
from greybox.trial.checks.finding import Finding, Outcome
from greybox.trial.log import TrialLog
from greybox.trial.raw_log import Recording, Signal
from greybox.vessel.vessel import Vessel

# parameters of each cause by the ids of the checks, in the order of a finding's values
_NAMES = {"lever_arm": ("lever_arm_x", "lever_arm_y"), "heading_bias": ("heading_bias",)}
_POSITIONS = ("x_n", "y_n")
_MOTIONS = {"u", "v", "r", "psi"}
# half a 95 % interval in standard errors
_HALF = 1.96


def recording_of(log: TrialLog) -> Recording:
    """Return a log as the checks take it."""
    signals = tuple(
        Signal(n, log.t, v, CHANNELS[n].unit if n in CHANNELS else None, n, True)
        for n, v in log.channels.items()
    )
    return Recording(log.name, signals, steps=log.provenance.steps)


@dataclass(frozen=True)
class Kinematics:
    """What the logs show about their sensors without any force model.

    Parameters
    ----------
    findings : tuple of Finding
        What they prove.
    agreeing : frozenset of str
        Causes, or their places, of which they show nothing though they could: the sensors agree
        with each other. Only a defect that all of them share would not show.
    together : frozenset of str
        Channels that show one time, which may be late against all else.
    """

    findings: tuple[Finding, ...] = ()
    agreeing: frozenset[str] = frozenset()
    together: frozenset[str] = frozenset()


def judged_by_kinematics(logs: Sequence[TrialLog]) -> Kinematics:
    """Return what the logs show about clocks, lever arms, heading biases and reversed motions.

    Thrusters are left to the force model. Several logs are judged together and must all have
    it; the first one's values are taken.
    """
    if not logs or not all(set(_POSITIONS) <= log.channels.keys() for log in logs):
        return Kinematics()
    try:
        reports = check_recordings(
            [recording_of(log) for log in logs], logs[0].vessel, forces=False
        )
    except GreyboxError:
        return Kinematics()
    each = [[f for f in report.findings if _kinematic(f)] for report in reports]
    shared = set.intersection(*({_place(f) for f in found} for found in each))
    clean = [
        {place for o in report.outcomes if o.status == "clean" for place in _places(o)}
        for report in reports
    ]
    together = [
        {c for o in report.outcomes if o.status == "cannot tell" for c in o.channels}
        for report in reports
    ]
    return Kinematics(
        tuple(f for f in each[0] if _place(f) in shared),
        frozenset(set.intersection(*clean)),
        frozenset(set.intersection(*together)),
    )


def _place(finding: Finding) -> tuple[str, frozenset[str]]:
    """Return what a finding is of, and where."""
    return finding.id, frozenset(finding.channels or (finding.channel,))


def decided(findings: Sequence[Finding]) -> frozenset[str]:
    """Return causes, or their places, whose values the kinematics give: no force model may."""
    places = set()
    for finding in findings:
        channels = finding.channels or (finding.channel,)
        if finding.id == "clock_offset":
            places |= {f"{finding.id}:{channel}" for channel in channels}
        elif finding.id in _NAMES:
            places.add(finding.id)
    return frozenset(places)


def denied(key: str, agreeing: Collection[str]) -> bool:
    """Whether sensors that agree deny a hypothesis of this key."""
    return key in agreeing or key.split(":", 1)[0] in agreeing


def _places(outcome: Outcome) -> list[str]:
    if outcome.id == "clock_offset":
        return [f"{outcome.id}:{channel}" for channel in outcome.channels if channel in _MOTIONS]
    return [outcome.id] if outcome.id in _NAMES else []


def _kinematic(finding: Finding) -> bool:
    channels = set(finding.channels or (finding.channel,))
    if finding.id == "clock_offset":
        return channels <= {*_POSITIONS, "x", "y", *_MOTIONS}
    if finding.id == "sign":
        return channels <= _MOTIONS
    return finding.id in _NAMES


def found_by_checks(finding: Finding, cause: Cause, tried: int) -> Found:
    """Return a finding as a cause."""
    values = finding.value if isinstance(finding.value, tuple) else (finding.value,)
    cis = finding.ci if isinstance(finding.value, tuple) else (finding.ci,)
    what = "sign" if finding.id == "sign" else "clock"
    channels = finding.channels or (finding.channel,)
    names = _NAMES.get(finding.id, tuple(f"{what}_{c}" for c in channels))
    parameters = {}
    z = 0.0
    for name, value, ci in zip(names, values, cis, strict=False):
        std = max((ci[1] - ci[0]) / (2 * _HALF), 1e-12)
        parameters[name] = Quantity(float(value), float(std), finding.unit)
        z = max(z, abs(value) / std)
    p = float(2 * ndtr(-min(z, 37.0)))
    # of two late clocks, or reversed channels, each has its place
    place = () if finding.id in _NAMES else channels
    key = ":".join([finding.id, *place, "kinematics"])
    return Found(
        finding.id, key, cause.title, parameters, p, min(1.0, p * tried),
        finding.evidence, cause.extension, cause.reference,
    )  # fmt: skip


def mended(vessel: Vessel, findings: Sequence[Finding]) -> Vessel:
    """Return the vessel with what the findings say of its sensors.

    They are of logs that are corrected for what the vessel states already. Nothing moves positions,
    so that a lever arm is one from the origin, and all the others come on top of what is stated.
    """
    said = dict(vessel.sensors)
    for finding in findings:
        if finding.id == "heading_bias" and isinstance(finding.value, float):
            said["heading_bias"] = said.get("heading_bias", 0.0) + finding.value
        if finding.id == "lever_arm" and isinstance(finding.value, tuple):
            height = tuple(said.get("antenna", ()))[2:]
            said["antenna"] = (*map(float, finding.value), *height)
        if finding.id == "clock_offset" and isinstance(finding.value, float):
            clock = dict(said.get("clock", {}))
            for name in finding.channels or (finding.channel,):
                clock[name] = clock.get(name, 0.0) + finding.value
            said["clock"] = clock
        if finding.id == "sign":
            turned = dict.fromkeys(finding.channels or (finding.channel,))
            before = tuple(said.get("reversed", ()))
            said["reversed"] = (
                *(c for c in before if c not in turned), *(c for c in turned if c not in before),
            )  # fmt: skip
    return replace(vessel, sensors=said)


def causes_of(findings: Sequence[Finding], causes: Mapping[str, Cause], tried: int) -> list[Found]:
    """Return findings as causes, each place once."""
    out: dict[str, Found] = {}
    for finding in findings:
        if finding.id in causes:
            found = found_by_checks(finding, causes[finding.id], tried)
            out.setdefault(found.key, found)
    return [f for f in out.values() if all(np.isfinite(q.value) for q in f.parameters.values())]
