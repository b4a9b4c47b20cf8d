"""The contents of a log: standard manoeuvres, and how long each sign regime lasts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from greybox.errors import GreyboxError, so_many
from greybox.notebook import DisplayMixin
from greybox.trial.convert.convert import import_recording
from greybox.trial.log import TrialLog
from greybox.trial.manoeuvres import Compliance, Criterion, Manoeuvre, Quantity, find_manoeuvres
from greybox.trial.raw_log import Recording
from greybox.trial.segments import by_sign
from greybox.vessel.vessel import Vessel

# regimes shorter than this tell nothing about a trial [s]
_SHORTEST = 5.0
# a state keeps its sign with a margin of this share of its usual size
_MARGIN = 0.1
# samples after a cut within which a manoeuvre begins on it
_AFTER_CUT = 5
# a step of the position by less than this share of the length does not end a manoeuvre, whose
# quantities are told in lengths: it is a receiver that corrects itself, not another recording
_SMALL_STEP = 0.1


@dataclass(frozen=True, repr=False)
class Contents(DisplayMixin):
    """What the segments of one trial hold.

    Parameters
    ----------
    manoeuvres : tuple of Manoeuvre
        In order of time.
    regimes : mapping of str to float
        Seconds by sign regime of surge and sway, such as ``u+v-``.
    seconds : float
        Length of all segments.
    note : str
        Why nothing can be said; empty otherwise.
    """

    manoeuvres: tuple[Manoeuvre, ...] = ()
    regimes: Mapping[str, float] | None = None
    seconds: float = 0.0
    note: str = ""

    def summary(self) -> str:
        """Return manoeuvres and regimes as text; empty where there is nothing to tell."""
        told = [m.summary().splitlines() for m in self.manoeuvres]
        of = Counter(
            line
            for lines in told
            for line in lines
            if line.startswith("  note: ") or Compliance.NOT_APPLICABLE.value in line
        )
        parts = ["\n".join(x for x in lines if of[x] < 2) for lines in told]
        parts += [f"of {n} manoeuvres: {x.strip()}" for x, n in of.items() if n > 1]
        if self.regimes and self.seconds > 0:
            said = ", ".join(
                f"{name} {100 * s / self.seconds:.0f} %"
                for name, s in sorted(self.regimes.items(), key=lambda item: -item[1])
            )
            rest = 100 * (1 - sum(self.regimes.values()) / self.seconds)
            mixed = f"; for {rest:.0f} % u or v is near zero or changes sign sooner"
            parts.append(
                f"sign regimes kept for {_SHORTEST:g} s or more: {said}{mixed if rest > 50 else ''}"
            )
        return "\n".join(parts)

    def _line(self) -> str:
        count = len(self.manoeuvres)
        return self.note or f"{so_many(count, 'manoeuvre')} in {self.seconds:g} s"

    def to_dict(self) -> dict[str, Any]:
        """Return the contents as plain values, angles in radians."""
        return {
            "manoeuvres": [manoeuvre_to_dict(m) for m in self.manoeuvres],
            "regimes": dict(self.regimes or {}),
        }


def describe_logs(segments: Sequence[TrialLog]) -> Contents:
    """Find the manoeuvres and sign regimes of the segments of one trial.

    Parameters
    ----------
    segments : sequence of TrialLog
        Without gaps, in order of time.
    """
    manoeuvres: list[Manoeuvre] = []
    regimes: dict[str, float] = {}
    seconds = 0.0
    for log in segments:
        seconds += len(log) * log.sample_time
        states = [n for n in ("u", "v") if n in log]
        if "psi" in log and "u" in log and len(log) * log.sample_time > _SHORTEST:
            manoeuvres += find_manoeuvres(log)
        if states:
            margins = {n: _MARGIN * float(abs(log[n]).mean()) for n in states}
            for s in by_sign(log, margins, shortest=_SHORTEST):
                regimes[s.label] = regimes.get(s.label, 0.0) + len(s) * log.sample_time
    return Contents(tuple(manoeuvres), regimes, seconds)


def describe_recording(recording: Recording, vessel: Vessel) -> Contents:
    """Describe the log that a mended recording gives, or say why it gives none.

    Parameters
    ----------
    recording : Recording
    vessel : Vessel

    Returns
    -------
    Contents
        Manoeuvres and sign regimes; ``note`` says why where there are none.
    """
    small = _SMALL_STEP * vessel.length
    kept = (
        s
        for s in recording.steps
        if s.operation != "cut" or "size" not in s.parameters or s.number("size") >= small
    )
    try:
        segments = import_recording(replace(recording, steps=tuple(kept)), vessel).segments
        found = describe_logs(segments)
    except GreyboxError as error:
        return Contents(note=str(error))
    # what begins on a jump was cut in two: its first part is missing
    begin = [c + _AFTER_CUT * segments[0].sample_time for c in recording.cuts]
    whole = tuple(
        m
        for m in found.manoeuvres
        if not any(c <= m.start <= b for c, b in zip(recording.cuts, begin, strict=True))
    )
    return replace(found, manoeuvres=whole)


def manoeuvre_to_dict(manoeuvre: Manoeuvre) -> dict[str, Any]:
    """Return a manoeuvre as plain values; quantities with standard error and interval."""
    kind = {"TurningCircle": "turning_circle", "ZigZag": "zigzag", "Stopping": "stopping"}
    found: dict[str, Any] = {"kind": kind[type(manoeuvre).__name__]}
    for field in fields(manoeuvre):
        found[field.name] = _plain(getattr(manoeuvre, field.name))
    return found


def _plain(value: Any) -> Any:
    if isinstance(value, Quantity):
        return {
            "value": value.value,
            "std": value.std,
            "unit": value.unit,
            "ci": list(value.interval),
        }
    if isinstance(value, Criterion):
        return {f.name: _plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Compliance):
        return value.value
    if isinstance(value, tuple | list):
        return [_plain(v) for v in value]
    return value
