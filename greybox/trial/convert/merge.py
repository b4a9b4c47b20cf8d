"""Merging the files of one trial on their clocks."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import reduce
from typing import Any

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
    found: dict[str, list[tuple[str, Signal]]] = {}
    stated: dict[str, int] = {}
    text: dict[str, tuple[Array, NDArray[Any]]] = {}
    notes: list[str] = []
    steps: list[Step] = []
    for r in recordings:
        shift = r.epoch - epoch if epoch is not None and r.epoch is not None else 0.0
        notes += [f"{r.name}: {n}" for n in r.notes]
        steps += [on_zero(s, shift) for s in r.steps]
        moved: dict[int, Array] = {}
        for s in r.signals:
            t = moved.setdefault(id(s.t), s.t + shift)
            parts = found.setdefault(s.name, [])
            # what a file states is preferred to what was guessed of another
            at = len(parts) if s.name in r.guessed else stated.get(s.name, 0)
            parts.insert(at, (r.name, replace(s, t=t)))
            stated[s.name] = stated.get(s.name, 0) + (s.name not in r.guessed)
        for name, (t, words) in r.text.items():
            first = text.get(name, (np.empty(0), np.empty(0, dtype=str)))
            text[name] = (
                np.concatenate([first[0], t + shift]),
                np.concatenate([first[1], words]),
            )
    signals = []
    clocks: dict[tuple[int, ...], Array] = {}
    unsure = {(r.name, n) for r in recordings for n in r.unsure}
    still: set[str] = set()
    mapped = {(r.name, n): raw for r in recordings for n, raw in r.mapped.items()}
    done = {r.name: r.steps for r in recordings}
    for name, parts in found.items():
        kept = [parts[0]]
        for part in parts[1:]:
            same = next((k[0] for k in kept if _overlap(part[1], k[1])), None)
            if same is not None:
                one, two = mapped.get((same, name)), mapped.get((part[0], name))
                if one is not None and two is not None and one != two:
                    raise LogError(
                        f"columns '{one}' of '{same}' and '{two}' of '{part[0]}' tell of the same "
                        f"times, and [columns] maps both to '{name}': remove one of the two lines "
                        f"from the vessel file."
                    )
                notes.append(
                    f"{name} stands in '{same}' and '{part[0]}' at the same times: "
                    f"that of '{same}' is used"
                )
            else:
                kept.append(part)
        _refuse_two_states(name, [(n, done[n]) for n, _ in kept])
        still |= {name for n, _ in kept if (n, name) in unsure}
        kept.sort(key=lambda p: _span(p[1])[0])
        # columns of one table go on sharing their clock
        key = tuple(id(p[1].t) for p in kept)
        if key not in clocks:
            clocks[key] = np.concatenate([p[1].t for p in kept])
        value = np.concatenate([p[1].value for p in kept])
        signals.append(replace(kept[0][1], t=clocks[key], value=value))
    return Recording(
        recordings[0].name,
        tuple(signals),
        text,
        epoch,
        tuple(f for r in recordings for f in r.files),
        tuple(notes),
        conditions=reduce(Conditions.over, (r.conditions for r in recordings)),
        steps=new_steps((), steps),
        unsure=frozenset(still),
    )


def _refuse_two_states(name: str, parts: list[tuple[str, tuple[Step, ...]]]) -> None:
    """Refuse a signal of several files of which one was corrected or moved and the other not."""
    (first, before), *others = parts
    for other, steps in others:
        if name in ("u_q", "v_q") and wind_state(steps) != wind_state(before):
            raise LogError(
                f"the wind of '{first}' is {wind_state(before)}, that of '{other}' is "
                f"{wind_state(steps)}: they cannot be merged. Import both from their raw files."
            )
        one, two = (_corrections(of, name) for of in (before, steps))
        if one != two:
            raise LogError(
                f"{name} of '{first}' is {_in_words(one)}, that of '{other}' is {_in_words(two)}: "
                f"they cannot be merged. Import both from their raw files."
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
