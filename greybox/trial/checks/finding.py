"""What a check returns: a finding with its interval, evidence and fix, or why it has none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from greybox.errors import so_many
from greybox.notebook import DisplayMixin, items, table
from greybox.trial.actuator_estimate import ActuatorEstimate
from greybox.trial.raw_log import Recording
from greybox.trial.steps import Step

IDS = (
    "gap", "duplicate_time", "nan", "outlier", "stuck", "quantised", "unit", "frame", "sign",
    "clock_offset", "lever_arm", "heading_bias",
    "heading_wrap", "position_jump", "position_hold", "time_format", "external_force", "actuator",
)  # fmt: skip
# what a channel is instead of being multiplied by a value, which then is 0
_INSTEAD = {"sign": "exchanged", "frame": "other axes"}


@dataclass(frozen=True, repr=False)
class Finding(DisplayMixin):
    """One defect of a log.

    Parameters
    ----------
    id : str
        One of `IDS`.
    channel : str
        The channel at fault; of several, the first.
    value : float or tuple of float
        Size of the defect, in `unit`.
    ci : tuple
        95 % interval (low, high), one for each component of `value`; low = high
        where the value is counted.
    unit : str
    evidence : str
        One sentence that an engineer can check.
    fix : str
        What to do.
    channels : tuple of str
        All channels at fault.
    repair : tuple of Step
        What ``import --fix`` does; empty where nothing can be done.
    safe : bool
        Whether the repair needs no judgement.
    picture : mapping
        Arrays that the report draws.
    logs : tuple of str
        Logs whose evidence was pooled for the value; empty where it is this log's own.
    """

    id: str
    channel: str
    value: float | tuple[float, ...]
    ci: tuple[Any, ...]
    unit: str
    evidence: str
    fix: str
    channels: tuple[str, ...] = ()
    repair: tuple[Step, ...] = ()
    safe: bool = False
    picture: Mapping[str, Any] = field(default_factory=dict)
    logs: tuple[str, ...] = ()

    @property
    def key(self) -> tuple[Any, ...]:
        """Key by which one finding is recognised in all logs that share it."""
        return (self.id, self.channels, self.value, self.logs)

    def summary(self) -> str:
        """Return channels, size, evidence and fix as text."""
        return f"{self.line}\n  {self.evidence}\n  fix: {self.fix}"

    @property
    def line(self) -> str:
        """Id, channels and size in one line."""
        return f"{self.id} ({', '.join(self.channels or (self.channel,))}): {size_in_words(self)}"

    def to_dict(self) -> dict[str, Any]:
        """Return the finding as the documented JSON, with `channels`, `safe` and `logs` added."""
        vector = isinstance(self.value, tuple)
        pooled = {"logs": list(self.logs)} if len(self.logs) > 1 else {}
        return {
            "id": self.id,
            "channel": self.channel,
            "value": list(self.value) if isinstance(self.value, tuple) else self.value,
            "ci": [list(c) for c in self.ci] if vector else list(self.ci),
            "unit": self.unit,
            "evidence": self.evidence,
            "fix": self.fix,
            "channels": list(self.channels or (self.channel,)),
            "safe": self.safe,
            **pooled,
        }


def exact_finding(
    id: str,
    channels: tuple[str, ...],
    value: float,
    unit: str,
    evidence: str,
    fix: str,
    repair: tuple[Step, ...] = (),
    safe: bool = False,
    picture: Mapping[str, Any] | None = None,
    logs: tuple[str, ...] = (),
) -> Finding:
    """Return a finding whose size is counted or known, so that its interval is one number."""
    interval = (value, value)
    return Finding(
        id, channels[0], value, interval, unit, evidence, fix, channels, repair, safe,
        picture or {}, logs,
    )  # fmt: skip


def factor_of(repair: Sequence[Step]) -> float:
    """Return by what channels that a repair multiplies are wrong; 0 where it does not."""
    return next((1 / s.number("factor") for s in repair if s.operation == "scale"), 0.0)


def declare_unit(names: Sequence[str], unit: str) -> str:
    """Return how to declare the unit that columns are in, or to convert them."""
    entries = " and ".join(f'"{n}" = {{ name = "{n}", unit = "{unit}" }}' for n in names)
    return (
        f"write {entries} under [columns] of the vessel file, or let greybox import --fix convert "
        f"the log"
    )


@dataclass(frozen=True)
class Outcome:
    """What became of one check.

    Parameters
    ----------
    id : str
    status : {"clean", "found", "cannot tell"}
    sentence : str
        What was looked at, or why nothing in the log can show it.
    channels : tuple of str
        Of a check of several channels, those that would have shown it; where it cannot tell,
        those that agree with each other and may all have it.
    """

    id: str
    status: Literal["clean", "found", "cannot tell"]
    sentence: str
    channels: tuple[str, ...] = ()


@dataclass(frozen=True, repr=False)
class CheckReport(DisplayMixin):
    """All findings of one log, and what became of every check.

    Parameters
    ----------
    name : str
    findings : tuple of Finding
    outcomes : tuple of Outcome
    notes : tuple of str
        What was guessed or skipped while reading.
    recording : Recording, optional
        What was checked, for pictures.
    actuators : tuple of ActuatorEstimate
        Actuators whose command and feedback the log holds, as all logs together measure them.
    """

    name: str
    findings: tuple[Finding, ...]
    outcomes: tuple[Outcome, ...]
    notes: tuple[str, ...] = ()
    recording: Recording | None = None
    actuators: tuple[ActuatorEstimate, ...] = ()

    def summary(self) -> str:
        """Return the findings as text."""
        return self.summary_beside(())

    @property
    def remarks(self) -> list[str]:
        """What is said beside the findings: checks that cannot tell, actuators and notes."""
        untold = [f"{o.id}: {o.sentence}" for o in self.outcomes if o.status == "cannot tell"]
        actuators = [f"actuator: {a.sentence}" for a in self.actuators]
        return [*untold, *actuators, *(f"note: {n}" for n in self.notes)]

    def summary_beside(self, told: Sequence[Finding], remarks: Sequence[str] = ()) -> str:
        """Return the report as text, without remarks that were told, of such findings the size."""
        count = len(self.findings)
        untold = sum(o.status == "cannot tell" for o in self.outcomes)
        verdict = so_many(count, "finding") if count else "clean"
        if untold and not count:
            verdict = f"nothing found, but {untold} of {len(self.outcomes)} checks cannot tell"
        lines = [f"{self.name}: {verdict}"]
        known = {f.key for f in told}
        for f in self.findings:
            text = f"{f.line}, as above" if f.key in known else f.summary()
            lines += [f"  {line}" for line in text.splitlines()]
        lines += [f"  {r}" for r in self.remarks if r not in remarks]
        return "\n".join(lines)

    def _parts(self) -> tuple[str, ...]:
        untold = [f"{o.id}: {o.sentence}" for o in self.outcomes if o.status == "cannot tell"]
        return (
            table(
                ("finding", "channels", "size (95 %)", "evidence", "fix"),
                [
                    (f.id, ", ".join(f.channels or (f.channel,)), f"{size_in_words(f)}",
                     f.evidence, f.fix)
                    for f in self.findings
                ],
            ),
            items("Cannot be told", untold),
            items("Actuators", [a.sentence for a in self.actuators]),
        )  # fmt: skip

    def to_dict(self) -> dict[str, Any]:
        """Return the report as the documented JSON, with `checks` and `notes` added."""
        return {
            "log": self.name,
            "findings": [f.to_dict() for f in self.findings],
            "checks": [
                {"id": o.id, "status": o.status, "sentence": o.sentence} for o in self.outcomes
            ],
            "notes": list(self.notes),
            "actuators": [a.to_dict() for a in self.actuators],
        }


def shared_findings(reports: Sequence[CheckReport]) -> list[Finding]:
    """Return the findings that several logs share, each once."""
    found: dict[tuple[Any, ...], Finding] = {}
    for report in reports:
        for f in report.findings:
            if len(f.logs) > 1:
                found.setdefault(f.key, f)
    return list(found.values())


def shared_remarks(reports: Sequence[CheckReport]) -> list[str]:
    """Return what is said of all of several logs beside their findings."""
    first, *others = (r.remarks for r in reports)
    return [told for told in first if others and all(told in other for other in others)]


def size_in_words(f: Finding) -> str:
    """Return the value of a finding with its interval and unit."""
    if isinstance(f.value, tuple):
        parts = [f"{v:.3g} ({c[0]:.3g} to {c[1]:.3g})" for v, c in zip(f.value, f.ci, strict=True)]
        return f"{', '.join(parts)} {f.unit}"
    unit = "" if f.unit == "1" else f" {f.unit}"
    if f.value == 0 and f.id in _INSTEAD:
        return _INSTEAD[f.id]
    if f.ci[0] == f.ci[1]:
        return f"{f.value:.4g}{unit}"
    return f"{f.value:.3g} ({f.ci[0]:.3g} to {f.ci[1]:.3g}){unit}"
