"""Records of version 1, whose sentences on the processing of a log are read as steps.

The only place that knows those sentences. A step keeps the sentence that it was made of, so
that it is told as it was; what none of them matches is kept as a step without an operation.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any

from greybox.trial.steps import RECORDED, Step, Value, finite_number

_NUMBER = r"([-+.\deE]+)"
# operation, channels at least, and parameters of what each finding's mend was
_MENDS: dict[str, tuple[str, Mapping[str, Value]]] = {
    "duplicate_time": ("order", {}), "nan": ("drop", {}), "outlier": ("drop", {}),
    "stuck": ("drop", {}), "sign": ("scale", {"factor": -1.0}), "clock_offset": ("shift", {}),
    "heading_bias": ("turn_heading", {}), "lever_arm": ("move_antenna", {}),
}  # fmt: skip


def steps_of_sentences(derived: Iterable[str], fixed: Iterable[str]) -> tuple[Step, ...]:
    """Return the steps that the sentences of a record of version 1 describe.

    Parameters
    ----------
    derived, fixed : iterable of str
        Lists of these names in the record, oldest first. Mends came before the rest.
    """
    steps = [_mend(sentence) for sentence in fixed]
    # the record gave the whole of a correction each time, a step gives what was added to it
    whole: dict[str, Any] = {}
    for sentence in derived:
        stated = _STATED.fullmatch(sentence)
        if stated:
            steps += _corrections(sentence, stated[1], stated[2], whole)
        else:
            steps.append(_derived(sentence))
    polynomials = next((s for s in steps if s.operation == "local_polynomials"), None)
    if polynomials is not None:
        # they made the yaw rate too, whatever the sentence says
        steps = [
            replace(s, operation="local_polynomials", parameters={**s.parameters, "window":
                    polynomials.number("window")})
            if s.operation == "difference" and s.channels == ("r",) else s for s in steps
        ]  # fmt: skip
    return tuple(steps)


def _step(
    sentence: str,
    operation: str,
    channels: Iterable[str],
    source: Iterable[str] = (),
    **parameters: Value,
) -> Step:
    return Step(operation, tuple(channels), tuple(source), {**parameters, RECORDED: sentence})


def _mend(sentence: str) -> Step:
    match = _FIXED.match(sentence)
    operation, parameters = _MENDS.get(match[1] if match else "", ("recorded", {}))
    channels = tuple(match[2].split(", ")) if match else ()
    return Step(
        operation, channels, (), {**parameters, RECORDED: sentence}, decided_by="check"
    )  # fmt: skip


def _derived(sentence: str) -> Step:
    for pattern, operation, channels, source, names in _SENTENCES:
        match = re.fullmatch(pattern, sentence)
        if match is None:
            continue
        found = list(match.groups())
        named = found.pop(0).split(", ") if channels is None else channels
        with suppress(ValueError):
            numbers = map(finite_number, found)
            return _step(
                sentence, operation, named, source, **dict(zip(names, numbers, strict=True))
            )
        break
    return _step(sentence, "recorded", ())


def _corrections(sentence: str, key: str, text: str, whole: dict[str, Any]) -> list[Step]:
    """Return the steps of a correction that ``[sensors]`` stated; `whole` is what came before."""
    try:
        value = json.loads(text)
        steps = list(_REMOVED[key](value, whole.get(key)))
    except (KeyError, ValueError, TypeError, AttributeError, IndexError, RecursionError):
        return [_step(sentence, "recorded", ())]
    whole[key] = value
    return [
        Step(op, channels, (), {**parameters, RECORDED: sentence}, decided_by="vessel")
        for op, channels, parameters in steps
    ]


Told = Iterable[tuple[str, tuple[str, ...], Mapping[str, Value]]]


def _reversed(now: Any, before: Any) -> Told:
    turned = tuple(str(c) for c in now if c not in (before or []))
    return [("scale", turned, {"factor": -1.0})]


def _clock(now: Any, before: Any) -> Told:
    late = {c: finite_number(s) - (before or {}).get(c, 0.0) for c, s in now.items()}
    return [("shift", (str(c),), {"late": s}) for c, s in late.items() if s]


def _heading_bias(now: Any, before: Any) -> Told:
    return [("turn_heading", ("psi",), {"angle": finite_number(now) - (before or 0.0)})]


def _arm(sensor: str) -> Callable[[Any, Any], Told]:
    def told(now: Any, before: Any) -> Told:
        x, y = (finite_number(a) - b for a, b in zip(now, before or (0.0, 0.0), strict=True))
        return [("move_velocity", ("u", "v"), {"x": x, "y": y, "sensor": sensor})]

    return told


_REMOVED: dict[str, Callable[[Any, Any], Told]] = {
    "reversed": _reversed, "clock": _clock, "heading_bias": _heading_bias,
    "antenna": _arm("antenna"), "velocity_at": _arm("velocity_at"),
}  # fmt: skip
_STATED = re.compile(r"\[sensors\] (\w+) = (\S+): .*")
_FIXED = re.compile(r"(\w+) of ([^:]+): ")
# sentence, operation, channels (None: those that it names first), what these were made of, and what
# the numbers in it are
_SENTENCES: tuple[
    tuple[str, str, tuple[str, ...] | None, tuple[str, ...], tuple[str, ...]], ...
] = (
    (r"([urv](?:, [urv])*) from positions and heading by central .*",
     "difference", None, ("x_n", "y_n", "psi"), ()),
    (r"([urv](?:, [urv])*) from heading by central .*", "difference", None, ("psi",), ()),
    (rf"u, v from positions and heading by Savitzky-Golay over {_NUMBER} s",
     "local_polynomials", ("u", "v"), ("x_n", "y_n", "psi"), ("window",)),
    (r"u, v from the velocity over ground and the heading",
     "earth_to_body", ("u", "v"), ("v_n", "v_e", "psi"), ()),
    (r"u_q, v_q from (?:V_q, gamma_q|the apparent wind's speed and direction) .*",
     "polar", ("u_q", "v_q"), ("V_q",), ()),
    (r"u_q, v_q from the true wind, .*", "true_wind", ("u_q", "v_q"), ("psi", "u", "v"), ()),
    (rf"u_q, v_q moved from the anemometer at \({_NUMBER}, {_NUMBER}\) m .*",
     "move_anemometer", ("u_q", "v_q"), (), ("x", "y")),
    (rf"true wind brought from {_NUMBER} to {_NUMBER} m\b.*",
     "wind_height", ("u_q", "v_q"), (), ("measured", "height")),
    (rf"(\w+) smoothed over {_NUMBER} s \(local polynomials of order (2)\)",
     "smooth", None, (), ("window", "order")),
    (rf"decimated from {_NUMBER} s to {_NUMBER} s",
     "decimate", (), (), ("measured", "sample_time")),
)  # fmt: skip
