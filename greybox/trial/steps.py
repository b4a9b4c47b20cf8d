"""What was done to the channels of a log, as typed values; sentences are rendered from them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

DecidedBy = Literal["format", "vessel", "user", "check", "default"]

# numbers, words, or sequences of numbers: what JSON can hold
Value = float | str | tuple[float, ...]


@dataclass(frozen=True)
class Step:
    """One operation on channels of a log.

    Parameters
    ----------
    operation : str
        A key of `OPERATIONS`.
    channels : tuple of str
        Channels that were made or changed.
    source : tuple of str
        Channels that they were made of; empty where they were changed in place.
    parameters : mapping of str to float, str or tuple of float
        What the operation needs, SI and radians.
    interval : tuple of float, optional
        First and last time that the step acts on [s]; the whole log by default.
    decided_by : {"format", "vessel", "user", "check", "default"}
        Who decided: the file's format, the vessel file, an option, a finding of the checks,
        or the default of the import.
    reason : str
        The evidence where a check decided; it is shown and never read back.
    """

    operation: str
    channels: tuple[str, ...]
    source: tuple[str, ...] = ()
    parameters: Mapping[str, Value] = field(default_factory=dict)
    interval: tuple[float, float] | None = None
    decided_by: DecidedBy = "default"
    reason: str = ""

    def __post_init__(self) -> None:
        if self.operation not in OPERATIONS:
            raise ValueError(f"there is no operation '{self.operation}'")
        if self.decided_by not in get_args(DecidedBy):
            raise ValueError(f"'{self.decided_by}' decides nothing")

    def number(self, name: str) -> float:
        """Return a parameter that is a number, 0 where it is absent."""
        value = self.parameters.get(name, 0.0)
        return float(value) if isinstance(value, int | float) else 0.0

    def numbers(self, name: str) -> tuple[float, ...]:
        """Return a parameter that is a sequence of numbers, empty where it is absent."""
        value = self.parameters.get(name, ())
        return tuple(float(v) for v in value) if isinstance(value, tuple | list) else ()

    @property
    def sentence(self) -> str:
        """What was done, in words."""
        said = OPERATIONS[self.operation](self)
        if self.interval is not None:
            said += f" from t = {self.interval[0]:.6g} to {self.interval[1]:.6g} s"
        return f"{said}: {self.reason}" if self.reason else said

    def to_dict(self) -> dict[str, Any]:
        """Return the step as JSON values."""
        return {
            "operation": self.operation,
            "channels": list(self.channels),
            "source": list(self.source),
            "parameters": {
                k: list(v) if isinstance(v, tuple) else v for k, v in self.parameters.items()
            },
            "interval": None if self.interval is None else list(self.interval),
            "decided_by": self.decided_by,
            "reason": self.reason,
        }


def mend(operation: str, channels: tuple[str, ...], **parameters: Value) -> Step:
    """Return a step that a finding of the checks proposes."""
    return Step(operation, channels, parameters=parameters, decided_by="check")


def _names(step: Step) -> str:
    return ", ".join(step.channels)


# how each operation reads in a record, on a page and in the terminal
OPERATIONS: dict[str, Callable[[Step], str]] = {
    "order": lambda s: f"rows of {_names(s)} put in order of time, each time once",
    "drop": lambda s: f"samples of {_names(s)} left out",
    "cut": lambda s: (
        f"log cut where {_names(s)} jump, at t = {', '.join(f'{x:.6g}' for x in s.numbers('times'))}"
        " s"
    ),
    "scale": lambda s: f"{_names(s)} multiplied by {s.number('factor'):.6g}",
    "offset": lambda s: f"{s.number('offset'):+.6g} added to {_names(s)}",
    "exchange": lambda s: f"{_names(s)} exchanged",
    "earth_to_body": lambda s: f"{_names(s)} turned by the heading into body axes",
    "shift": lambda s: f"{_names(s)} moved by {-s.number('late'):+.4g} s",
    "move_antenna": lambda s: (
        f"{_names(s)} moved by ({s.number('x'):.4g}, {s.number('y'):.4g}) m to the body origin"
    ),
    "turn_heading": lambda s: f"heading turned back by {s.number('angle'):.5g} rad",
}
