"""Conditions of several logs, and of a model and a log: what they share, and where they differ.

Every rule of when conditions differ stands here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.channels import MOTION_WORDS
from greybox.trial.log import TrialLog
from greybox.trial.raw_log import shortened
from greybox.vessel.conditions import UNITS, Conditions, Value, spelled, words

Array = NDArray[np.float64]

# field -> values of the logs of a model, ascending, each once
Validity = Mapping[str, tuple[Any, ...]]

# share of the draught: the lateral force of a hull goes with its square, so 10 % of that
_DRAUGHT = 0.05
# share of the draught: the sway force goes with 1 + 2/3 trim/draught (Inoue, Hirano and Kijima,
# 1981), so 7 % of that
_TRIM = 0.1
# share of the depth, where the bottom is felt
_DEPTH = 0.2
# draughts under which the bottom is felt (PIANC, 1992, calls more than three deep)
_DEEP = 4.0
# observers differ by one code
_SEA = 2
_MOST_NAMED = 3
# share of the samples left out at either end of a range: single ones are outliers
_TAIL = 1e-3
# share of a range by which a log may be outside it, as logs of one kind of trial are; share of its
# samples that is told; signals are named by their samples outside, as a share of the most of any
_SLACK, _OFTEN, _PART = 0.25, 0.05, 0.1
# settings that stand for all of a log
_SETTINGS = 16


@dataclass(frozen=True)
class ConditionDifference:
    """One condition in which logs differ, among themselves or from those of a model.

    Parameters
    ----------
    condition : str
        Field of `Conditions`.
    logs : tuple of (str, value)
        Name of each log that states it and what it states; beside a model only those
        that differ from it.
    model : tuple of value
        What the logs of the model stated; empty where logs differ among themselves.
    """

    condition: str
    logs: tuple[tuple[str, Value], ...]
    model: tuple[Value, ...] = ()

    @property
    def sentence(self) -> str:
        """What differs, and what follows from it."""
        name = words(self.condition)
        by_value: dict[Value, list[str]] = {}
        for log, value in self.logs:
            by_value.setdefault(value, []).append(log)
        shown = "; ".join(
            f"{spelled(self.condition, v)} in {shortened(logs, _MOST_NAMED)}"
            for v, logs in by_value.items()
        )
        if not self.model:
            return (
                f"the logs differ in {name} ({shown}): parameters that are common to them hold "
                f"for none of these conditions exactly, so estimate on logs of one {name} too."
            )
        known = " and ".join(spelled(self.condition, v) for v in _ends(self.model))
        return (
            f"{name} is {shown}, the model was estimated at {known}: its parameters may not hold "
            f"there."
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the difference for JSON, SI."""
        return {
            "condition": self.condition,
            "unit": UNITS[self.condition] or None,
            "logs": dict(self.logs),
            "model": list(self.model) or None,
            "sentence": self.sentence,
        }


@dataclass(frozen=True)
class PooledConditions:
    """Conditions of the logs of one estimate.

    Parameters
    ----------
    values : mapping of str to tuple
        What the logs state, by field of `Conditions`.
    differences : tuple of ConditionDifference
        In what they differ by more than the parameters can ignore.
    """

    values: Validity = field(default_factory=dict)
    differences: tuple[ConditionDifference, ...] = ()


def pooled_conditions(logs: Sequence[TrialLog]) -> PooledConditions:
    """Return the conditions that logs of one estimate share, and in what they differ."""
    found: dict[str, tuple[Any, ...]] = {}
    differences = []
    draught = max((v for log in logs if (v := log.conditions.draught) is not None), default=None)
    for name in UNITS:
        stated = [(log.name, v) for log in logs if (v := getattr(log.conditions, name)) is not None]
        values = sorted({v for _, v in stated})
        if not values:
            continue
        found[name] = tuple(values)
        if any(_differ(name, values[0], v, draught) for v in values):
            differences.append(ConditionDifference(name, tuple(stated)))
    return PooledConditions(found, tuple(differences))


def other_conditions(model: Validity, logs: Sequence[TrialLog]) -> tuple[ConditionDifference, ...]:
    """Return the conditions in which logs differ from those that a model was estimated on.

    Parameters
    ----------
    model : mapping of str to tuple
        As `PooledConditions.values`. Numbers between its ends are taken to be covered.
    logs : sequence of TrialLog
    """
    differences = []
    for name, values in model.items():
        off = []
        for log in logs:
            value = getattr(log.conditions, name)
            if value is None:
                continue
            known: Sequence[Any] = values
            if not isinstance(value, str):
                # numbers between those of the model's logs are covered by them
                known = [np.clip(value, values[0], values[-1])]
            draughts = (*model.get("draught", ()), log.conditions.draught)
            draught = max((d for d in draughts if d is not None), default=None)
            if all(_differ(name, value, v, draught) for v in known):
                off.append((log.name, value))
        if off:
            differences.append(ConditionDifference(name, tuple(off), values))
    return tuple(differences)


def validity_to_dict(values: Validity) -> dict[str, Any]:
    """Return conditions for JSON: a value where the logs agree, a list where they do not."""
    return {n: v[0] if len(v) == 1 else list(v) for n, v in values.items()}


def validity_from_dict(data: Any) -> Validity:
    """Return the conditions of a model file.

    Raises
    ------
    LogError
        A value is none that the field can have.
    """
    found: dict[str, tuple[Any, ...]] = {}
    for name, given in data.items():
        if name in UNITS:
            several = given if isinstance(given, list) else [given]
            read = {getattr(Conditions.read({name: v}), name) for v in several}
            found[name] = tuple(sorted(read))
    return found


def in_words(values: Validity) -> str:
    """Return the conditions of a model in words; empty where none are known."""
    return ", ".join(
        f"{words(n)} {' to '.join(spelled(n, x) for x in _ends(v))}" for n, v in values.items()
    )


def _differ(name: str, one: Any, other: Any, draught: float | None) -> bool:
    """Whether two values of a condition differ by more than parameters can ignore."""
    if name == "loading":
        return bool(one.casefold() != other.casefold())
    if name == "sea_state":
        return bool(abs(one - other) >= _SEA)
    if name == "water_depth" and draught is not None:
        one, other = min(one, _DEEP * draught), min(other, _DEEP * draught)
    scale = max(abs(one), abs(other))
    if name == "trim" and draught is not None:
        scale = draught
    share = {"draught": _DRAUGHT, "trim": _TRIM, "water_depth": _DEPTH}[name]
    return bool(abs(one - other) > share * scale)


def _ends(values: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return least and greatest number, or all words."""
    return values if isinstance(values[0], str) or len(values) < 2 else (values[0], values[-1])


def ranges(logs: Sequence[TrialLog], states: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Return the least and greatest value of each state and command.

    Parameters
    ----------
    logs : sequence of TrialLog
        Of one vessel.
    states : sequence of str
        Names of the states; commands are the vessel's.

    Returns
    -------
    dict of str to (float, float)
        Quantiles of 0.1 and 99.9 %, as wide as the widest log; channels that no log has are
        left out [SI; propeller speeds in the unit of the log].
    """
    found: dict[str, tuple[float, float]] = {}
    for log in logs:
        for name in (*states, *log.vessel.commands):
            if name not in log:
                continue
            low, high = (float(q) for q in np.quantile(log[name], [_TAIL, 1 - _TAIL]))
            before = found.get(name, (low, high))
            found[name] = min(low, before[0]), max(high, before[1])
    return found


class Excursions:
    """For how long logs, one after another, leave the ranges of those of a model.

    Parameters
    ----------
    known : mapping of str to (float, float)
        `ranges` of the logs that the model was estimated on.
    """

    def __init__(self, known: Mapping[str, tuple[float, float]]) -> None:
        self.known = known
        self._names: list[str] = []
        self._samples = self._left = 0
        self._beyond: dict[str, int] = {}
        self._seen: dict[str, tuple[float, float]] = {}
        self._angles: set[str] = set()

    def add(self, log: TrialLog) -> None:
        """Take a log into account."""
        outside = {n: _outside(log[n], *span) for n, span in self.known.items() if n in log}
        self._names.append(log.name)
        self._samples += len(log)
        self._left += int(np.any([*outside.values(), np.zeros(len(log), bool)], axis=0).sum())
        self._angles |= log.vessel.angle_commands
        for name, (low, high) in ranges([log], tuple(outside)).items():
            if name in outside:
                before = self._seen.get(name, (low, high))
                self._seen[name] = min(low, before[0]), max(high, before[1])
                self._beyond[name] = self._beyond.get(name, 0) + int(outside[name].sum())

    @property
    def sentence(self) -> str:
        """Signals and ranges, ``""`` where the logs hardly leave them."""
        if self._left < max(_OFTEN * self._samples, 1):
            return ""
        most = max(self._beyond.values())
        said = ", ".join(
            self._spans(n) for n, count in self._beyond.items() if count >= _PART * most
        )
        leave = "leaves" if len(self._names) == 1 else "leave"
        return (
            f"{shortened(self._names, _MOST_NAMED)} {leave} what the model was estimated on for "
            f"{100 * self._left / self._samples:.0f} % of the time: {said}. Errors there are those "
            f"of extrapolation: to predict so far, estimate with a log that goes there too."
        )

    def _spans(self, name: str) -> str:
        factor, unit = 1.0, {"u": " m/s", "v": " m/s"}.get(name, "")
        if name == "r" or name in self._angles:
            factor, unit = 180 / np.pi, " deg/s" if name == "r" else " deg"
        a, b, low, high = (factor * x for x in (*self._seen[name], *self.known[name]))
        said = MOTION_WORDS.get(name, name)
        return f"{said} {a:z.3g} to {b:z.3g}{unit} (estimated on {low:z.3g} to {high:z.3g})"


def extrapolation_note(known: Mapping[str, tuple[float, float]], logs: Sequence[TrialLog]) -> str:
    """Return what `Excursions` say of logs, such as those held out."""
    found = Excursions(known)
    for log in logs:
        found.add(log)
    return found.sentence


def _outside(value: Array, low: float, high: float) -> NDArray[np.bool_]:
    slack = max(_SLACK * (high - low), 0.01 * max(abs(low), abs(high)))
    return np.asarray((value < low - slack) | (value > high + slack))


def settings_of(logs: Sequence[TrialLog]) -> dict[str, list[float]]:
    """Return settings of all commands that the logs had at one time, by command.

    Up to 16, as unlike one another as the logs allow: the others lie between them.

    Parameters
    ----------
    logs : sequence of TrialLog
        Of one vessel.

    Returns
    -------
    dict of str to list of float
        The k-th values of all commands stood together; commands that not every log has are left
        out [propeller speeds in the unit of the log, angles in rad].
    """
    names = [n for n in logs[0].vessel.commands if all(n in log for log in logs)]
    if not names:
        return {}
    return unlike({n: np.concatenate([np.asarray(log[n], float) for log in logs]) for n in names})


def unlike(settings: Mapping[str, Sequence[float] | Array]) -> dict[str, list[float]]:
    """Return those of many settings that are farthest from one another, in deviations."""
    values = np.column_stack([np.asarray(v, float) for v in settings.values()])
    values = values[np.isfinite(values).all(axis=1)]
    if not len(values):
        return {}
    scaled = (values - values.mean(axis=0)) / np.maximum(values.std(axis=0), 1e-12)
    chosen = [int(np.argmax((scaled**2).sum(axis=1)))]
    away = ((scaled - scaled[chosen[0]]) ** 2).sum(axis=1)
    while len(chosen) < _SETTINGS and away.max() > 0:
        chosen.append(int(np.argmax(away)))
        away = np.minimum(away, ((scaled - scaled[chosen[-1]]) ** 2).sum(axis=1))
    return dict(zip(settings, values[chosen].T.tolist(), strict=True))
