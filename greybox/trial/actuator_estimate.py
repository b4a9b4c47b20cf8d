"""The dynamics of an actuator from its command and feedback, and their place in a record."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, get_args

from greybox.vessel.vessel import ActuatorKind

# what differs from an ideal actuator: response [s] (or one sample), gain, and the gains between
# which both columns can have one unit
_RESPONSE, _GAIN_ERROR, _ONE_UNIT = 0.1, 0.02, (0.5, 2.0)
# fields with an interval, in the order of a record
_NUMBERS = ("delay", "time_constant", "response", "gain", "offset", "rate_limit", "dead_band")


@dataclass(frozen=True)
class Measured:
    """A number with its 95 % interval."""

    value: float
    ci: tuple[float, float]

    def to_dict(self) -> dict[str, Any]:
        """Return value and interval for JSON."""
        return {"value": self.value, "ci": list(self.ci)}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Measured:
        """Return the number that `to_dict` wrote."""
        low, high = data["ci"]
        return cls(float(data["value"]), (float(low), float(high)))

    def __str__(self) -> str:
        return f"{self.value:.3g} ({self.ci[0]:.3g} to {self.ci[1]:.3g})"


@dataclass(frozen=True)
class ActuatorEstimate:
    """How the feedback of one actuator follows its command.

    Parameters
    ----------
    thruster : int
        Which of the vessel's thrusters, counted from 1.
    kind : {"speed", "angle", "rudder"}
    command, feedback : str
        Log columns.
    delay, time_constant : Measured
        Dead time d and time constant T of the feedback as it was logged [s].
    response : Measured
        d + T [s].
    gain : Measured
        g, feedback over command.
    offset : Measured
        o, in the unit of the feedback.
    rate_limit : Measured, optional
        R, unit of the feedback per second; None where the log shows none.
    dead_band : Measured, optional
        Half its width: of the error that an angle leaves standing, or of the commands that a
        propeller does not answer (unit of the command); None where the log shows none.
    residual_std : float
        Robust standard deviation of what remains, unit of the feedback.
    step : float
        Usual sample time of the slower of both columns [s].
    hold : float
        Mean age of the feedback where the recorder repeats it while it should move [s]; else 0.
    at_renewal : tuple of Measured, optional
        Delay and time constant where each value of a held feedback is new [s]: those of the
        actuator without the recorder's.
    logs : tuple of str
        Names of the logs that were fitted together.
    """

    thruster: int
    kind: ActuatorKind
    command: str
    feedback: str
    delay: Measured
    time_constant: Measured
    response: Measured
    gain: Measured
    offset: Measured
    rate_limit: Measured | None
    dead_band: Measured | None
    residual_std: float
    step: float
    hold: float = 0.0
    at_renewal: tuple[Measured, Measured] | None = None
    logs: tuple[str, ...] = ()

    @property
    def unit(self) -> str:
        """Unit of the feedback."""
        return "as logged" if self.kind == "speed" else "rad"

    @property
    def one_unit(self) -> bool:
        """Whether command and feedback can have one unit, so that a gain of 1 is expected."""
        return self.kind != "speed" or _ONE_UNIT[0] < self.gain.value < _ONE_UNIT[1]

    @property
    def slow(self) -> bool:
        """Whether delay and lag exceed a sample and a tenth of a second for certain."""
        return self.response.ci[0] > max(_RESPONSE, self.step)

    @property
    def scaled(self) -> bool:
        """Whether the gain differs for certain from 1 by more than it may."""
        low, high = self.gain.ci
        return self.one_unit and (low > 1 + _GAIN_ERROR or high < 1 - _GAIN_ERROR)

    @property
    def ideal(self) -> bool:
        """Whether the feedback may be taken for the command."""
        limited = self.rate_limit is not None or self.dead_band is not None
        return not (self.slow or self.scaled or limited)

    @property
    def sentence(self) -> str:
        """The numbers in words."""
        unit = "" if self.unit == "as logged" else f" {self.unit}"
        parts = [
            f"a delay of {self.delay} s",
            f"a time constant of {self.time_constant} s",
            f"a gain of {self.gain}" + ("" if self.one_unit else " (another unit)"),
        ]
        if self.rate_limit is not None:
            parts.append(f"at most {self.rate_limit}{unit} per second")
        if self.dead_band is not None:
            where = "commands" if self.kind == "speed" else "errors"
            parts.append(f"no answer to {where} below {self.dead_band}{unit}")
        said = f"{self.feedback} follows {self.command} with {', '.join(parts)}"
        if self.at_renewal is not None:
            d, lag = self.at_renewal
            said += (
                f"; the recorder repeats old values, {self.hold:.2g} s old on average: where "
                f"they are new, the delay is {d} s and the time constant {lag} s"
            )
        return said

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers for JSON, seconds and the columns' units."""

        def shown(x: Measured | None) -> dict[str, Any] | None:
            return None if x is None else x.to_dict()

        new = self.at_renewal
        return {
            **{n: getattr(self, n) for n in ("thruster", "kind", "command", "feedback", "unit")},
            **{n: shown(getattr(self, n)) for n in _NUMBERS},
            **{n: getattr(self, n) for n in ("residual_std", "step", "hold")},
            "delay_at_renewal": shown(new[0] if new else None),
            "time_constant_at_renewal": shown(new[1] if new else None),
            "logs": list(self.logs),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> ActuatorEstimate:
        """Return the estimate that `to_dict` wrote.

        Raises
        ------
        KeyError, TypeError, ValueError
            The values are not such an estimate.
        """

        def known(name: str) -> Measured:
            return Measured.from_dict(data[name])

        def optional(name: str) -> Measured | None:
            return None if data.get(name) is None else known(name)

        kind = data["kind"]
        if kind not in get_args(ActuatorKind):
            raise ValueError(f"an actuator has no '{kind}'")
        delay, lag = optional("delay_at_renewal"), optional("time_constant_at_renewal")
        return cls(
            int(data["thruster"]),
            kind,
            str(data["command"]),
            str(data["feedback"]),
            known("delay"),
            known("time_constant"),
            known("response"),
            known("gain"),
            known("offset"),
            optional("rate_limit"),
            optional("dead_band"),
            float(data["residual_std"]),
            float(data["step"]),
            float(data.get("hold", 0.0)),
            None if delay is None or lag is None else (delay, lag),
            tuple(map(str, data.get("logs", ()))),
        )


def recorded_actuators(record: Mapping[str, Any]) -> tuple[ActuatorEstimate, ...]:
    """Return the actuators that a record holds; what is malformed is left out."""
    found = []
    entries = record.get("actuators")
    for entry in entries if isinstance(entries, list) else []:
        with suppress(KeyError, TypeError, ValueError, AttributeError, OverflowError):
            found.append(ActuatorEstimate.from_dict(entry))
    return tuple(found)


def known_actuators(logs: Iterable[Iterable[ActuatorEstimate]]) -> tuple[ActuatorEstimate, ...]:
    """Return one estimate an actuator: of the most logs, then of the narrowest interval."""
    best: dict[tuple[str, str], ActuatorEstimate] = {}
    for estimates in logs:
        for e in estimates:
            key = (e.command, e.feedback)
            if key not in best or _rank(e) < _rank(best[key]):
                best[key] = e
    return tuple(best.values())


def _rank(estimate: ActuatorEstimate) -> tuple[int, float]:
    low, high = estimate.response.ci
    return -len(estimate.logs), high - low
