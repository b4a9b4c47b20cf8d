"""The clocks of the files of one trial: time zones between them, and what contradicts itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np

from greybox.errors import LogError
from greybox.trial.raw_log import Recording
from greybox.trial.readers.topic_files import QUARTER, zone_of
from greybox.trial.steps import Step

Span = tuple[float, float]

# share of the shorter of two files in which they must overlap to be one trial's
_OVERLAP = 0.05
# the same where only another time zone lets them
_ZONE_OVERLAP = 0.8
_LARGEST_ZONE = 14 * 3600.0
# seconds since 1970 that a date can have: the year 5138
_LATEST = 1e11


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
    told = {r.name: zone_of(r.ahead) or 0.0 for r in recordings if r.ahead is not None}
    if not told:
        return None
    one, two = min(told, key=lambda n: told[n]), max(told, key=lambda n: told[n])
    if told[one] != told[two]:
        raise LogError(
            f"the recorder of '{one}' is {told[one] / 3600:g} h ahead of its header stamps and "
            f"that of '{two}' {told[two] / 3600:g} h: export both in one time zone."
        )
    return told[one]


def _shift(
    r: Recording, span: Span, whole: Span, zone: float | None, reference: Sequence[Recording]
) -> float:
    """Return by how much the times of a file must be moved [s]."""
    options = [0.0] if zone is None else [0.0, -zone]
    best = min(options, key=lambda s: _apart(_moved(span, s), whole))
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
    if zone is None and abs(found) <= _LARGEST_ZONE and overlap >= _ZONE_OVERLAP:
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


def _apart(a: Span, b: Span) -> float:
    return abs(a[0] - b[0]) + abs(a[1] - b[1])


def _overlap(a: Span, b: Span) -> float:
    """Return the share of the shorter in which two spans overlap; a moment within counts whole."""
    common = min(a[1], b[1]) - max(a[0], b[0])
    shorter = min(a[1] - a[0], b[1] - b[0])
    return float(common >= 0) if shorter <= 0 else common / shorter


def _clock(time: float) -> str:
    """Return a UNIX time as a date, as a number where it is none that a calendar has."""
    if not abs(time) < _LATEST:
        return f"{time:.6g} s"
    return datetime.fromtimestamp(time, UTC).strftime("%Y-%m-%d %H:%M:%S")
