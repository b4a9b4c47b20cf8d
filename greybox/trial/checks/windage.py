"""stub"""
from __future__ import annotations
from greybox.trial.checks.finding import Finding
from greybox.trial.recording import Recording
def wind_findings(recording: Recording, findings: list[Finding]) -> list[Finding]:
    return []
