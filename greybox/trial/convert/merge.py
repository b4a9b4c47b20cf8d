"""The files of one trial: put on one clock, and merged on it.

Time zones between their clocks are found, and what contradicts itself is refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from greybox.errors import LogError
from greybox.trial.convert.derived_signals import wind_state
from greybox.trial.raw_log import Array, Recording, Signal
from greybox.trial.readers.topic_files import LARGEST_ZONE, QUARTER, zone_of
from greybox.trial.steps import LATEST_DATE, Step, new_steps, on_zero
from greybox.vessel.conditions import Conditions

Span = tuple[float, float]

# files that overlap for less than this share of the shorter one follow one another, and such
# files are not seen to be of one trial
_OVERLAP = 0.05
# the same where only another time zone lets them
_ZONE_OVERLAP = 0.8


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
        kept.sort(key=lambda p: _signal_span(p.signal)[0])
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
        same = next((k.file for k in kept if _same_times(part.signal, k.signal)), None)
        if same is None:
            kept.append(part)
            continue
        one, two = same.mapped.get(name), part.file.mapped.get(name)
        if one is not None and two is not None and one != two:
            raise LogError(
                f"columns '{one}' of '{same.name}' and '{two}' of '{part.file.name}' hold values "
                f"at the same times, and [columns] maps both to '{name}': remove one of the two "
                f"lines from the vessel file."
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
        one, two = (
            [s for s in of.steps if s.decided_by == "vessel" and name in s.channels]
            for of in (first, other)
        )
        if one != two:
            raise LogError(
                f"{name} of '{first.name}' is {_in_words(one)}, that of '{other.name}' is "
                f"{_in_words(two)}: they cannot be merged. Import both from their raw files."
            )


def _in_words(steps: list[Step]) -> str:
    return f"corrected ({'; '.join(s.sentence for s in steps)})" if steps else "as recorded"


def _signal_span(signal: Signal) -> Span:
    finite = signal.t[np.isfinite(signal.t)]
    return (float(finite.min()), float(finite.max())) if len(finite) else (np.inf, -np.inf)


def _same_times(a: Signal, b: Signal) -> bool:
    """Whether two signals tell of the same times, beyond the seam between two files."""
    (a0, a1), (b0, b1) = _signal_span(a), _signal_span(b)
    common = min(a1, b1) - max(a0, b0)
    return common > _OVERLAP * min(a1 - a0, b1 - b0)


def on_one_clock(
    recordings: Sequence[Recording], motion: frozenset[str]
) -> tuple[list[Recording], tuple[Step, ...]]:
    """Put the files of one trial on one clock where they differ by a time zone.

    Files that hold both header stamps and the recorder's time tell how far the recorder is
    ahead. Without them, files that would overlap if one of them were moved by whole quarters
    of an hour differ by a time zone.

    Parameters
    ----------
    recordings : sequence of Recording
        Canonical.
    motion : frozenset of str
        Signals that make a file the reference where nothing tells which one is right.

    Returns
    -------
    recordings : list of Recording
    steps : tuple of Step
        What was moved.

    Raises
    ------
    LogError
        Two recorders are ahead by different zones; or the times of a file are apart from
        those of all others by what is no time zone.
    """
    recordings = list(recordings)
    timed = [r for r in recordings if r.epoch is not None and _span(r) is not None]
    if len(timed) < 2:
        return recordings, ()
    zone = _told_zone(timed)
    stamped = [r for r in timed if r.ahead is not None]
    moving = [r for r in timed if motion & set(r.names)]
    reference = stamped or moving or timed[:1]
    whole = _union(reference)
    moved: dict[float, list[Recording]] = {}
    placed = []
    for r in recordings:
        span = None if any(r is x for x in reference) else _span(r)
        shift = 0.0 if span is None else _shift(r, span, whole, zone, reference)
        if shift and r.epoch is not None:
            moved.setdefault(shift, []).append(r)
            r = replace(r, epoch=r.epoch + shift)
        placed.append(r)
    return placed, tuple(_step(shift, of, bool(stamped)) for shift, of in moved.items())


def _step(shift: float, of: Sequence[Recording], utc: bool) -> Step:
    names = tuple(dict.fromkeys(n for r in of for n in (*r.names, *r.text)))
    files = tuple(f.name for r in of for f in r.files)
    return Step(
        "time_zone",
        names,
        files or tuple(r.name for r in of),
        {"ahead": -shift, "against": "UTC" if utc else "the files that hold the motion"},
        decided_by="format" if utc else "default",
    )


def _told_zone(recordings: Sequence[Recording]) -> float | None:
    """Return by how much the recorders say they are ahead of UTC [s], None where none says."""
    told = [(zone_of(r.ahead) or 0.0, r.name) for r in recordings if r.ahead is not None]
    if not told:
        return None
    (least, one), (most, two) = min(told), max(told)
    if least != most:
        raise LogError(
            f"the recorder of '{one}' is {least / 3600:g} h ahead of its header stamps and "
            f"that of '{two}' {most / 3600:g} h: export both in one time zone."
        )
    return least


def _shift(
    r: Recording, span: Span, whole: Span, zone: float | None, reference: Sequence[Recording]
) -> float:
    """Return by how much the times of a file must be moved [s]."""
    options = [0.0] if zone is None else [0.0, -zone]
    best = min(options, key=lambda s: abs(span[0] + s - whole[0]) + abs(span[1] + s - whole[1]))
    if _overlap(_moved(span, best), whole) > _OVERLAP:
        return best
    names = {n for x in reference for n in x.names}
    if names & set(r.names):
        # a log in two parts
        return 0.0
    # the ends of two recordings of one trial are near each other
    middle = 0.5 * (sum(whole) - sum(span))
    found = QUARTER * round(middle / QUARTER)
    overlap = _overlap(_moved(span, found), whole)
    if zone is None and abs(found) <= LARGEST_ZONE and overlap >= _ZONE_OVERLAP:
        return found
    raise LogError(
        f"'{r.name}' runs from {_clock(span[0])} to {_clock(span[1])} and "
        f"'{reference[0].name}' from {_clock(whole[0])} to {_clock(whole[1])}, which is "
        f"{abs(middle):.6g} s apart and no time zone: name files of one trial, or correct the "
        f"clock of one."
    )


def _span(r: Recording) -> Span | None:
    """Return the first and last UNIX time [s] of a file."""
    times = [t for t in (*(s.t for s in r.signals), *(t for t, _ in r.text.values())) if len(t)]
    ends = [(np.nanmin(t), np.nanmax(t)) for t in times if np.isfinite(t).any()]
    if not ends or r.epoch is None:
        return None
    return r.epoch + float(min(e[0] for e in ends)), r.epoch + float(max(e[1] for e in ends))


def _union(recordings: Sequence[Recording]) -> Span:
    spans = [s for s in map(_span, recordings) if s is not None]
    return min(s[0] for s in spans), max(s[1] for s in spans)


def _moved(span: Span, shift: float) -> Span:
    return span[0] + shift, span[1] + shift


def _overlap(a: Span, b: Span) -> float:
    """Return the share of the shorter in which two spans overlap; a moment within counts whole."""
    common = min(a[1], b[1]) - max(a[0], b[0])
    shorter = min(a[1] - a[0], b[1] - b[0])
    return float(common >= 0) if shorter <= 0 else common / shorter


def _clock(time: float) -> str:
    """Return a UNIX time as a date, as a number where it is none that a calendar has."""
    if not abs(time) < LATEST_DATE:
        return f"{time:.6g} s"
    return datetime.fromtimestamp(time, UTC).strftime("%Y-%m-%d %H:%M:%S")
