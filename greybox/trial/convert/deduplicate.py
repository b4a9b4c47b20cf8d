"""Signals in order of time, each time once, ready for a uniform clock."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from greybox.errors import LogError, so_many
from greybox.trial.convert.derived_signals import derive_signals
from greybox.trial.gaps import usual_step
from greybox.trial.raw_log import Array, Mask, Recording
from greybox.trial.time_format import unpadded_numbers

# usual steps by which time may go back without there being two runs in a file
_FAR = 50.0
_MAX_RUNS = 1000
# what to do with two runs in one file: none of them is wrong
CUT_RUNS = "cut the file there and import each run"


def clean_signals(recording: Recording, origin: tuple[float, float] | None = None) -> Recording:
    """Return the signals in order of time, each time once, derived ones among them.

    Parameters
    ----------
    recording : Recording
    origin : tuple of float, optional
        As for `derive_signals`.

    Returns
    -------
    Recording
        Its steps and notes tell what was done.

    Raises
    ------
    LogError
        As `in_order`.
    """
    made = derive_signals(in_order(recording), origin)
    repeated: dict[int, tuple[str, int]] = {}
    signals = []
    clocks: dict[tuple[int, bytes], Array] = {}
    for s in made.signals:
        keep = s.known
        once = np.concatenate([[True], np.diff(s.t) > 0]) if len(s) else keep
        if not once.all():
            repeated.setdefault(id(s.t), (s.name, int((~once).sum())))
            keep &= _first_kept(s.t, keep)
        if not keep.all():
            # signals that keep the same rows go on sharing their clock
            t = clocks.setdefault((id(s.t), np.packbits(keep).tobytes()), s.t[keep])
            s = replace(s, t=t, value=s.value[keep])
        signals.append(s)
    notes = (
        f"{so_many(count, 'value')} of {name} {'repeats' if count == 1 else 'repeat'} a time: "
        f"the first is kept"
        for name, count in repeated.values()
    )
    return made.with_signals(signals, *notes)


def _first_kept(t: Array, keep: Mask) -> Mask:
    """Whether each is the first of those kept at its time, (N,)."""
    rows = np.flatnonzero(keep)
    first = np.zeros(len(t), bool)
    first[rows[np.concatenate([[True], np.diff(t[rows]) > 0])] if len(rows) else rows] = True
    return first


def in_order(recording: Recording) -> Recording:
    """Return the recording with every signal and text in order of time; its notes tell.

    Raises
    ------
    LogError
        Time goes back over what was recorded before: there are two runs in it.
    """
    notes: list[str] = []
    orders: dict[int, tuple[NDArray[np.int64], Array] | None] = {}

    def order(t: Array, name: str) -> tuple[NDArray[np.int64], Array] | None:
        if id(t) not in orders:
            orders[id(t)] = _order(t, recording.epoch or 0.0, name, recording.name, notes)
        return orders[id(t)]

    signals = []
    for s in recording.signals:
        found = order(s.t, s.name)
        signals.append(s if found is None else replace(s, t=found[1], value=s.value[found[0]]))
    text = {}
    for name, (t, words) in recording.text.items():
        found = order(t, name)
        text[name] = (t, words) if found is None else (found[1], words[found[0]])
    return replace(recording, text=text).with_signals(signals, *notes)


def _order(
    t: Array, epoch: float, signal: str, name: str, notes: list[str]
) -> tuple[NDArray[np.int64], Array] | None:
    finite = np.isfinite(t)
    if finite.all() and (np.diff(t) >= 0).all():
        return None
    rows = np.flatnonzero(finite)
    ordered = t[rows]
    back = np.flatnonzero(np.diff(ordered) < 0)
    if len(back):
        wrong = len(unpadded_numbers(ordered + epoch))
        cause = (
            f"; {wrong} time{'s lack' if wrong > 1 else ' lacks'} the leading zeros of the "
            f"fraction of a second: mend with --fix"
            if wrong
            else ""
        )
        if (second := second_run(ordered)) is not None:
            k, twice = second
            raise LogError(
                f"time of {signal} in '{name}' goes back from {ordered[k - 1]:.6g} to "
                f"{ordered[k]:.6g} s, over {twice:.4g} s that are there twice"
                f"{cause or f': {CUT_RUNS}'}."
            )
        notes.append(
            f"time of {signal} goes back {so_many(len(back), 'time')}, first "
            f"from {ordered[back[0]]:.6g} to {ordered[back[0] + 1]:.6g} s: put in order{cause}"
        )
        rows = rows[np.argsort(ordered, kind="stable")]
    return rows, t[rows]


def second_run(t: Array) -> tuple[int, float] | None:
    """Find where a second run begins, by times that go back far over times that are there already.

    Parameters
    ----------
    t : ndarray
        (N,) times in the order of the file, each a number [s].

    Returns
    -------
    tuple of (int, float), optional
        Its first row, and the time that both runs cover [s]; None where there is one run.
    """
    back = np.flatnonzero(np.diff(t) < 0)
    if not len(back):
        return None
    usual = usual_step(np.sort(t)) or float(np.median(np.abs(np.diff(t))))
    far = back[t[back] - t[back + 1] > _FAR * usual]
    if len(far) > _MAX_RUNS:
        return None
    edges = np.concatenate([[0], far + 1, [len(t)]])
    spans = sorted((t[a:b].min(), t[a:b].max()) for a, b in pairwise(edges))
    for (_, stop), (start, end) in pairwise(spans):
        if min(stop, end) - start > _FAR * usual:
            return int(far[0]) + 1, float(min(stop, end) - start)
    return None


def first_run(recording: Recording) -> Recording:
    """Return the recording without what stands behind the first of several runs."""
    shared: dict[int, int] = {}

    def rows(t: Array) -> int:
        if id(t) not in shared:
            finite = np.flatnonzero(np.isfinite(t))
            found = second_run(t[finite])
            shared[id(t)] = len(t) if found is None else int(finite[found[0]])
        return shared[id(t)]

    clocks = {id(s.t): s.t[: rows(s.t)] for s in recording.signals}
    signals = [replace(s, t=clocks[id(s.t)], value=s.value[: rows(s.t)]) for s in recording.signals]
    text = {n: (t[: rows(t)], words[: rows(t)]) for n, (t, words) in recording.text.items()}
    return replace(recording, text=text).with_signals(signals)
