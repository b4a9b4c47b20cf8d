"""The IMO standards for ship manoeuvrability, and whether a measurement meets them.

References
----------
IMO resolution MSC.137(76), Standards for ship manoeuvrability (2002), section 5.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import Enum

from greybox.trial.manoeuvres.quantity import Quantity

ADVANCE_LENGTHS = 4.5
TACTICAL_LENGTHS = 5.0
INITIAL_TURNING_LENGTHS = 2.5
TRACK_REACH_LENGTHS = 15.0
TRACK_REACH_AT_MOST = 20.0
# the standards are for ships of at least this length
SHORTEST_SHIP = 100.0


class Compliance(Enum):
    """Whether a limit is met; the values are the sentences that users read."""

    PASS = "pass"
    FAIL = "fail"
    OPEN = "within uncertainty, cannot be said"
    NOT_APPLICABLE = "not applicable"


@dataclass(frozen=True)
class Criterion:
    """One limit and the verdict on it.

    Parameters
    ----------
    name : str
    measured : Quantity or None
        In the unit of the limit: ship lengths ("1") or angle [rad].
    limit : float or None
    verdict : Compliance
    reason : str
        Why the limit does not apply, or what else is to be known.
    """

    name: str
    measured: Quantity | None
    limit: float | None
    verdict: Compliance
    reason: str = ""

    def summary(self) -> str:
        """Return one line: limit, verdict, reason."""
        if self.limit is None:
            return f"{self.name}: {self.verdict.value}, because {self.reason}"
        angle = self.measured is not None and self.measured.unit == "rad"
        limit = f"{math.degrees(self.limit):.1f} deg" if angle else f"{self.limit:g} L"
        note = f" ({self.reason})" if self.reason else ""
        return f"{self.name}, at most {limit}: {self.verdict.value}{note}"


def as_text(
    head: str,
    rows: Iterable[tuple[str, Quantity | None]],
    length: float,
    criteria: Iterable[Criterion],
    notes: Iterable[str],
) -> str:
    """Return a manoeuvre as text: quantities that were measured, verdicts and notes."""
    lines = [f"  {n:<20}{q.text(length)}" for n, q in rows if q is not None]
    alike: dict[Criterion, list[str]] = {}
    for c in criteria:
        alike.setdefault(replace(c, name="") if c.limit is None else c, []).append(c.name)
    lines += [f"  IMO {replace(c, name=' and '.join(n)).summary()}" for c, n in alike.items()]
    return "\n".join([head, *lines, *(f"  note: {n}" for n in notes)])


def check_limit(name: str, measured: Quantity | None, limit: float, reason: str = "") -> Criterion:
    """Compare a measurement with an upper limit by its 95 % interval.

    Parameters
    ----------
    name : str
    measured : Quantity or None
        None where the manoeuvre did not go so far.
    limit : float
        In the unit of `measured`.
    """
    if measured is None:
        return not_applicable(name, "the log ends before it")
    low, high = measured.interval
    verdict = (
        Compliance.PASS if high <= limit else Compliance.FAIL if low > limit else Compliance.OPEN
    )
    return Criterion(name, measured, limit, verdict, reason)


def not_applicable(name: str, reason: str) -> Criterion:
    """Return the verdict that a limit does not apply, with the reason."""
    return Criterion(name, None, None, Compliance.NOT_APPLICABLE, reason)


def first_overshoot_limit(length_over_speed: float) -> float:
    """Return the limit of the first overshoot angle in the 10/10 zig-zag [rad].

    Parameters
    ----------
    length_over_speed : float
        L/V of the full-scale ship at test speed [s].
    """
    return math.radians(5 + min(max(length_over_speed, 10.0), 30.0) / 2)


def second_overshoot_limit(length_over_speed: float) -> float:
    """Return the limit of the second overshoot angle in the 10/10 zig-zag [rad]."""
    return math.radians(17.5 + 0.75 * min(max(length_over_speed, 10.0), 30.0))


def first_overshoot_limit_20() -> float:
    """Return the limit of the first overshoot angle in the 20/20 zig-zag [rad]."""
    return math.radians(25.0)
