"""The processing of a log's channels as typed values, from which sentences are made."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

DecidedBy = Literal["format", "vessel", "user", "check", "default"]

# numbers, words, or sequences of numbers: what JSON can hold
Value = float | str | tuple[float, ...]
# the parameter under which a step keeps how an older record tells of it
RECORDED = "recorded"
# numbers of a sequence that a record keeps: thousands of times would burst it
_LONGEST = 1000
# no time, angle or length in SI is larger, and sums and ratios of such numbers are finite
_LARGEST = 1e30
# seconds since 1970 that a date can have: the year 5138
LATEST_DATE = 1e11
_OF_MOTION = frozenset({"difference", "local_polynomials", "earth_to_body"})


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
    def derives_motion(self) -> bool:
        """Whether velocities or yaw rate were made of other channels: they prove nothing more."""
        return bool(self.source) and self.operation in _OF_MOTION

    @property
    def sentence(self) -> str:
        """What was done, in words."""
        recorded = self.parameters.get(RECORDED)
        if isinstance(recorded, str):
            return recorded
        said = OPERATIONS[self.operation](self)
        if self.interval is not None:
            said += f" from t = {self.interval[0]:.6g} to {self.interval[1]:.6g} s"
        if self.decided_by == "vessel":
            said += ", as the vessel file states"
        return f"{said}: {self.reason}" if self.reason else said

    def to_dict(self) -> dict[str, Any]:
        """Return the step as JSON values; of long sequences the beginning and the count."""
        parameters: dict[str, Any] = {}
        for name, value in self.parameters.items():
            parameters[name] = list(value[:_LONGEST]) if isinstance(value, tuple) else value
            if isinstance(value, tuple) and len(value) > _LONGEST:
                parameters[f"{name}_count"] = len(value)
        return {
            "operation": self.operation,
            "channels": list(self.channels),
            "source": list(self.source),
            "parameters": parameters,
            "interval": None if self.interval is None else list(self.interval),
            "decided_by": self.decided_by,
            "reason": self.reason,
        }


def step_from_dict(data: Any) -> Step | None:
    """Return the step that JSON values hold, None where they hold none."""
    if not isinstance(data, Mapping):
        return None
    parameters, interval = data.get("parameters", {}), data.get("interval")
    try:
        return Step(
            str(data["operation"]),
            tuple(map(str, data["channels"])),
            tuple(map(str, data.get("source", ()))),
            {str(k): _value(v) for k, v in parameters.items()},
            None if interval is None else (finite_number(interval[0]), finite_number(interval[1])),
            data.get("decided_by", "default"),
            str(data.get("reason", "")),
        )
    except (KeyError, TypeError, ValueError, AttributeError, IndexError):
        return None


def _value(value: Any) -> Value:
    if isinstance(value, list | tuple):
        return tuple(finite_number(v) for v in value)
    return value if isinstance(value, str) else finite_number(value)


def finite_number(value: Any) -> float:
    """Return a number of a record.

    Raises
    ------
    ValueError
        It is none, or none that a log can hold.
    """
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not abs(number) < _LARGEST:
        raise ValueError(f"{number} is no quantity of a log")
    return number


def new_steps(known: Iterable[Step], more: Iterable[Step]) -> tuple[Step, ...]:
    """Return the steps of `more` that are not among those known, each once."""
    before, found = list(known), []
    for step in more:
        if step not in before:
            before.append(step)
            found.append(step)
    return tuple(found)


def on_zero(step: Step, shift: float) -> Step:
    """Return a step with the times that it names counted from another zero, `shift` earlier."""
    parameters, interval = dict(step.parameters), step.interval
    if "times" in parameters:
        parameters["times"] = tuple(t + shift for t in step.numbers("times"))
    if interval is not None:
        interval = (interval[0] + shift, interval[1] + shift)
    return replace(step, parameters=parameters, interval=interval)


def mend(operation: str, channels: tuple[str, ...], **parameters: Value) -> Step:
    """Return a step that a finding of the checks proposes."""
    return Step(operation, channels, parameters=parameters, decided_by="check")


def _word(step: Step, name: str) -> str:
    # a record may have been damaged
    return str(step.parameters.get(name, "?"))


def _names(step: Step) -> str:
    return ", ".join(step.channels)


def _times(step: Step) -> str:
    return ", ".join(f"{t:.6g}" for t in step.numbers("times"))


def _sources(step: Step) -> str:
    places = {"x_n", "y_n"} <= set(step.source)
    words = ["positions"] if places else []
    words += [n for n in step.source if n not in ("x_n", "y_n", "psi")]
    words += ["heading"] if "psi" in step.source else []
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def _earth_to_body(step: Step) -> str:
    if step.source:
        return f"{_names(step)} from the velocity over ground and the heading"
    return f"{_names(step)} turned by the heading into body axes"


def _resampled(step: Step) -> str:
    how = str(step.parameters.get("how", "interpolated"))
    return f"{_names(step)} {how} at a sample time of {step.number('sample_time'):g} s"


def _held(step: Step) -> str:
    counts = dict(zip(step.channels, step.numbers("rows"), strict=False))
    said = [f"{name} in {count:.0f}" for name, count in counts.items()]
    return f"of {step.number('of'):.0f} rows the value before is held: {', '.join(said)}"


# how each operation reads in a record, on a page and in the terminal
OPERATIONS: dict[str, Callable[[Step], str]] = {
    # signals on their own clocks
    "order": lambda s: f"rows of {_names(s)} put in order of time, each time once",
    "drop": lambda s: f"samples of {_names(s)} left out",
    "interpolate": lambda s: f"samples of {_names(s)} interpolated between their neighbours",
    "cut": lambda s: f"log cut where {_names(s)} begin anew, at t = {_times(s)} s",
    "scale": lambda s: f"{_names(s)} multiplied by {s.number('factor'):.6g}",
    "offset": lambda s: f"{s.number('offset'):+.6g} added to {_names(s)}",
    "exchange": lambda s: f"{_names(s)} exchanged",
    "earth_to_body": _earth_to_body,
    "shift": lambda s: f"{_names(s)} moved by {-s.number('late'):+.4g} s",
    "move_antenna": lambda s: (
        f"{_names(s)} moved by ({s.number('x'):.4g}, {s.number('y'):.4g}) m to the body origin"
    ),
    "turn_heading": lambda s: f"heading turned back by {s.number('angle'):.5g} rad",
    "tangent_plane": lambda s: (
        f"{_names(s)} from {', '.join(s.source)} north and east of "
        f"{s.number('lat'):.8f}, {s.number('lon'):.8f} deg"
    ),
    "polar": lambda s: f"{_names(s)} from speed and direction ({', '.join(s.source)})",
    # channels on the clock of the log
    "resample": _resampled,
    "hold": _held,
    "difference": lambda s: f"{_names(s)} from {_sources(s)} by central differences (3.57)",
    "local_polynomials": lambda s: (
        f"{_names(s)} from {_sources(s)} by Savitzky-Golay over {s.number('window'):g} s"
    ),
    "move_velocity": lambda s: (
        f"{_names(s)} brought from ({s.number('x'):g}, {s.number('y'):g}) m to the body origin"
    ),
    "true_wind": lambda s: (
        f"{_names(s)} from the true wind, the heading and the velocity over ground"
    ),
    "move_anemometer": lambda s: (
        f"{_names(s)} moved from the anemometer at ({s.number('x'):g}, {s.number('y'):g}) m "
        f"to the origin"
    ),
    "wind_height": lambda s: (
        f"true wind brought from {s.number('measured'):g} to {s.number('height'):g} m "
        f"(1/7 power law)"
    ),
    "smooth": lambda s: (
        f"{_names(s)} smoothed over {s.number('window'):g} s (local polynomials of order "
        f"{s.number('order'):g})"
    ),
    "decimate": lambda s: (
        f"decimated from {s.number('measured'):g} s to {s.number('sample_time'):g} s"
    ),
    # what a record of an older version tells and this version has no operation for
    "recorded": lambda s: f"{_names(s)} changed, as an older record tells",
    "time_zone": lambda s: (
        f"clock of {', '.join(s.source)} is {s.number('ahead') / 3600:+g} h ahead of "
        f"{_word(s, 'against')}: put on that"
    ),
    "read_axes": lambda s: f"{_names(s)} read in axes {_word(s, 'axes')}",
    "pad_fractions": lambda s: (
        f"{s.number('count'):.0f} times of {_names(s)} lack leading zeros in their fraction of a "
        f"second, such as {_word(s, 'written')} for {_word(s, 'meant')}: read as meant"
    ),
}
