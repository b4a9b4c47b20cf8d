"""stub"""
from __future__ import annotations
from greybox.trial.checks.finding import Finding
from greybox.trial.recording import Recording
from greybox.vessel.vessel import Vessel
def response_findings(recording: Recording, vessel: Vessel, findings: list[Finding]) -> list[Finding]:
    return []
