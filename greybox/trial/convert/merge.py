"""Merging the files of one trial on their clocks."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from greybox.errors import LogError
from greybox.trial.convert.derived_signals import wind_state
from greybox.trial.raw_log import Recording, Signal
from greybox.trial.steps import Step, new_steps, on_zero
from greybox.vessel.conditions import Conditions

Array = NDArray[np.float64]

# files that overlap for less than this share of the shorter one follow one another
_OVERLAP = 0.05


def merge(recordings: list[Recording]) -> Recording:
    """Merge the files of one trial on their clocks.

    Parameters
    ----------
    recordings : list of Recording
        Canonical. All with a UNIX time, or none: then their times are taken to
        count from the same moment.

    Raises
    ------
    LogError
        Some have a UNIX time and some not; or one wind was moved or brought to
        another height before, and the other not; or two columns that ``[columns]`` maps
        to one signal tell of the same times.
    """
    if len(recordings) == 1:
        return recordings[0]
    absolute = [r for r in recordings if r.epoch is not None]
    if absolute and len(absolute) < len(recordings):
        other = next(r for r in recordings if r.epoch is None)
        raise LogError(
            f"'{absolute[0].name}' has the time of day and '{other.name}' only seconds from its "
            f"start: they cannot be merged. Give both a UNIX or ISO time, or import them apart."
        )
    epoch = min(r.epoch for r in absolute if r.epoch is not None) if absolute else None
    parts: dict[str, list[_Part]] = {}
    text: dict[str, tuple[Array, NDArray[Any]]] = {}
    notes: list[str] = []
    steps: list[Step] = []
    cuts: list[Step] = []
    for r in recordings:
        shift = r.epoch - epoch if epoch is not None and r.epoch is not None else 0.0
        notes += [f"{r.name}: {n}" for n in r.notes]
        # last, since what moved the positions of one file moved no other's
        cuts += [on_zero(s, shift) for s in r.cut_steps]
        steps += [on_zero(s, shift) for s in r.steps if s.operation != "cut"]
        moved: dict[int, Array] = {}
        for s in r.signals:
            t = moved.setdefault(id(s.t), s.t + shift)
            parts.setdefault(s.name, []).append(_Part(r, replace(s, t=t)))
        for name, (t, words) in r.text.items():
            first = text.get(name, (np.empty(0), np.empty(0, dtype=str)))
            text[name] = (
                np.concatenate([first[0], t + shift]),
                np.concatenate([first[1], words]),
            )
    signals, unsure = [], set()
    clocks: dict[tuple[int, ...], Array] = {}
    for name, offered in parts.items():
        kept = _one_at_a_time(name, offered, notes)
        _refuse_two_states(name, kept)
        if any(name in p.file.unsure for p in kept):
            unsure.add(name)
        kept.sort(key=lambda p: _span(p.signal)[0])
        # columns of one table go on sharing their clock
        key = tuple(id(p.signal.t) for p in kept)
        if key not in clocks:
            clocks[key] = np.concatenate([p.signal.t for p in kept])
        value = np.concatenate([p.signal.value for p in kept])
        signals.append(replace(kept[0].signal, t=clocks[key], value=value))
    return Recording(
        recordings[0].name,
        tuple(signals),
        text,
        epoch,
        tuple(f for r in recordings for f in r.files),
        tuple(notes),
        conditions=reduce(Conditions.over, (r.conditions for r in recordings)),
        steps=new_steps((), [*steps, *cuts]),
        unsure=frozenset(unsure),
    )


class _Part(NamedTuple):
    """What one file, whose name another may have too, gives of a signal."""

    file: Recording
    signal: Signal


def _one_at_a_time(name: str, offered: list[_Part], notes: list[str]) -> list[_Part]:
    """Return the parts of a signal of which no two tell of the same times; add notes on others.

    Raises
    ------
    LogError
        ``[columns]`` maps two columns to the signal, and both tell of the same times.
    """
    # what a file states is preferred to what was guessed of another
    first, *others = sorted(offered, key=lambda p: name in p.file.guessed)
    kept = [first]
    for part in others:
        same = next((k.file for k in kept if _overlap(part.signal, k.signal)), None)
        if same is None:
            kept.append(part)
            continue
        one, two = same.mapped.get(name), part.file.mapped.get(name)
        if one is not None and two is not None and one != two:
            raise LogError(
                f"columns '{one}' of '{same.name}' and '{two}' of '{part.file.name}' hold values "
                f"at the same times, and [columns] maps both to '{name}': remove one of the two "
                f"lines "
                f"from the vessel file."
            )
        notes.append(
            f"{name} stands in '{same.name}' and '{part.file.name}' at the same times: "
            f"that of '{same.name}' is used"
        )
    return kept


def _refuse_two_states(name: str, parts: list[_Part]) -> None:
    """Refuse a signal of several files of which one was corrected or moved and the other not."""
    first, *others = (p.file for p in parts)
    for other in others:
        if name in ("u_q", "v_q") and wind_state(other.steps) != wind_state(first.steps):
            raise LogError(
                f"the wind of '{first.name}' is {wind_state(first.steps)}, that of '{other.name}' "
                f"is {wind_state(other.steps)}: they cannot be merged. Import both from their raw "
                f"files."
            )
        one, two = (_corrections(of.steps, name) for of in (first, other))
        if one != two:
            raise LogError(
                f"{name} of '{first.name}' is {_in_words(one)}, that of '{other.name}' is "
                f"{_in_words(two)}: they cannot be merged. Import both from their raw files."
            )


def _corrections(steps: Iterable[Step], name: str) -> list[Step]:
    return [s for s in steps if s.decided_by == "vessel" and name in s.channels]


def _in_words(steps: list[Step]) -> str:
    return f"corrected ({'; '.join(s.sentence for s in steps)})" if steps else "as recorded"


def _span(signal: Signal) -> tuple[float, float]:
    finite = signal.t[np.isfinite(signal.t)]
    return (float(finite.min()), float(finite.max())) if len(finite) else (np.inf, -np.inf)


def _overlap(a: Signal, b: Signal) -> bool:
    """Whether two signals tell of the same times, beyond the seam between two files."""
    (a0, a1), (b0, b1) = _span(a), _span(b)
    common = min(a1, b1) - max(a0, b0)
    return common > _OVERLAP * min(a1 - a0, b1 - b0)
