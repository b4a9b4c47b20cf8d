"""Segments of a log: between its gaps, and those in which states keep their signs."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.errors import LogError, so_many
from greybox.trial.gaps import runs, split_at_gaps
from greybox.trial.log import Logs, TrialLog, as_list
from greybox.trial.raw_log import Array

# what the name of a segment has behind that of its log
_SEGMENT = re.compile(r"\[\d+\]$")
# standard errors by which a smoothed state must be inside its margin's width
_SURE = 3.0
# samples over which a state is averaged at most, where its noise is large beside the margin
_LONGEST_AVERAGE = 101


@dataclass(frozen=True)
class Segment:
    """Samples ``start:stop`` of a log.

    Parameters
    ----------
    start, stop : int
        First sample, and the one after the last.
    label : str
        The regime, such as ``u+v+``.
    t_start, t_stop : float
        Time of the first and of the last sample [s].
    """

    start: int
    stop: int
    label: str
    t_start: float
    t_stop: float

    def __len__(self) -> int:
        return self.stop - self.start

    def summary(self) -> str:
        """Return one line: what, when, how many samples."""
        held = so_many(len(self), "sample")
        return f"{self.label}: {self.t_start:.1f} to {self.t_stop:.1f} s, {held}"

    def cut(self, log: TrialLog) -> TrialLog:
        """Return the samples of this segment as a log of their own."""
        return log.window(self.start, self.stop, f"{log.name}[{self.label}]")


def join_segments(segments: Sequence[TrialLog], name: str) -> TrialLog:
    """Return segments that follow each other in time as one log with gaps."""
    if len(segments) == 1:
        return replace(segments[0], name=name)
    names = [n for n in segments[0].channels if all(n in s for s in segments)]
    lacking = {n for s in segments for n in s.missing if n in names}
    return replace(
        segments[0],
        name=name,
        t=np.concatenate([s.t for s in segments]),
        channels={n: np.concatenate([s[n] for s in segments]) for n in names},
        closed_loop=np.concatenate([s.closed_loop for s in segments]),
        missing={n: np.concatenate([~s.known((n,)) for s in segments]) for n in lacking},
    )


def of_one_log(logs: Sequence[TrialLog]) -> list[list[int]]:
    """Return the places of logs, those of neighbouring segments of one log together."""
    out: list[list[int]] = []
    for k, log in enumerate(logs):
        if out and _continues(logs[k - 1], log):
            out[-1].append(k)
        else:
            out.append([k])
    return out


def _continues(before: TrialLog, log: TrialLog) -> bool:
    """Whether a log is a later segment of the one that another one is a segment of."""
    return (
        whole_name(before.name) == whole_name(log.name) != log.name
        and before.provenance == log.provenance
        and bool(before.t[-1] < log.t[0])
    )


def whole_name(name: str) -> str:
    """Return the name of the log of which `split_segments` named a segment, others as they are."""
    return _SEGMENT.sub("", name)


def numbered(segments: Sequence[TrialLog], name: str) -> list[TrialLog]:
    """Return segments by the name of their log, each with its number where there are several."""
    if len(segments) == 1:
        return [replace(segments[0], name=name)]
    return [replace(s, name=f"{name}[{k + 1}]") for k, s in enumerate(segments)]


def split_segments(log: TrialLog) -> list[TrialLog]:
    """Return the segments between the gaps of a log's time; the log itself where it has none."""
    found = split_at_gaps(log.t, log.sample_time)
    if len(found) < 2:
        return [log]
    return [log.window(a, b, f"{log.name}[{k + 1}]") for k, (a, b) in enumerate(found)]


def as_segments(logs: Logs, least: int = 1) -> list[TrialLog]:
    """Return the segments between the gaps of one log or of several, as `as_list` takes them.

    Single samples are left out where there are others: they tell of no step.
    """
    found = [segment for log in as_list(logs, least) for segment in split_segments(log)]
    return [s for s in found if len(s) > 1] or found


@dataclass(frozen=True)
class LogGaps:
    """Gaps of one log.

    Parameters
    ----------
    log : str
    channels : tuple of str
        Motions that were not measured, over which a run goes on; empty where rows are
        missing altogether, so that a run begins anew.
    count, samples : int
        Stretches, and samples in them.
    longest, start : float
        Length of the longest stretch, and the time of its first sample [s].
    """

    log: str
    channels: tuple[str, ...]
    count: int
    samples: int
    longest: float
    start: float

    @property
    def sentence(self) -> str:
        """What is missing, and what a run and a fit make of it."""
        several = self.count != 1
        where = (
            f"{'the longest of ' if several else ''}{self.longest:.4g} s of samples from "
            f"t = {self.start:.10g} s on"
        )
        if not self.channels:
            return (
                f"'{self.log}' has {so_many(self.count, 'gap')} in which inputs or rows are "
                f"missing, {where}: a run begins anew after {'each' if several else 'it'}."
            )
        return (
            f"'{self.log}' lacks {', '.join(self.channels)} in "
            f"{so_many(self.count, 'stretch')} of {so_many(self.samples, 'sample')} in all, "
            f"{where}: no fit counts "
            f"them, and a run goes on over them."
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the gaps for JSON, SI."""
        return {
            "log": self.log,
            "channels": list(self.channels),
            "run": "goes on" if self.channels else "begins anew",
            "count": self.count,
            "samples": self.samples,
            "longest": self.longest,
            "start": self.start,
        }


def find_log_gaps(log: TrialLog) -> tuple[LogGaps, ...]:
    """Return the gaps of a log: in its time, and in the motions that a model has."""
    made = []
    breaks = [stop for _, stop in split_at_gaps(log.t, log.sample_time)[:-1]]
    if breaks:
        lost = np.diff(log.t)[np.array(breaks) - 1] - log.sample_time
        k = int(np.argmax(lost))
        samples = round(float(lost.sum()) / log.sample_time)
        begin = float(log.t[breaks[k] - 1]) + log.sample_time
        made.append(LogGaps(log.name, (), len(breaks), samples, float(lost[k]), begin))
    alike: dict[bytes, list[str]] = {}
    for name, gap in log.missing.items():
        if name in ("x_n", "y_n"):
            # no model has them as states
            continue
        alike.setdefault(gap.tobytes(), []).append(name)
    for names in alike.values():
        first, stop = np.array(runs(log.missing[names[0]])).T
        k = int(np.argmax(stop - first))
        made.append(
            LogGaps(
                log.name, tuple(names), len(first), int((stop - first).sum()),
                float(stop[k] - first[k]) * log.sample_time, float(log.t[first[k]]),
            )
        )  # fmt: skip
    return tuple(made)


def by_sign(
    log: TrialLog, margins: Mapping[str, float], *, shortest: float = 0.0
) -> tuple[Segment, ...]:
    """Return the runs of samples in which states keep their signs with a margin.

    Where the vessel file gives the noise of a state, the decision is taken on a
    running mean, just long enough that its standard error is a third of the
    margin, so that noise does not break a run.

    Parameters
    ----------
    log : TrialLog
    margins : mapping of str to float
        For each state that matters, such as u and v, how far it stays from zero
        [m/s], [rad/s]; not negative.
    shortest : float
        Runs of less time are dropped [s].

    Returns
    -------
    tuple of Segment
        In time order, each labelled with its regime, such as ``u+v-``. None
        reaches over a gap of the log.

    Raises
    ------
    LogError
        A margin is negative, none is given, or the log lacks the state.

    References
    ----------
    Ljungberg (2020), assumption A10.
    """
    if not margins:
        raise LogError("no state was named: give margins such as {'u': 0.2, 'v': 0.1}.")
    for name, margin in margins.items():
        if margin < 0 or not math.isfinite(margin):
            raise LogError(f"the margin of {name} is {margin:g}, it cannot be negative.")
    made = []
    for first, last in split_at_gaps(log.t, log.sample_time):
        signs = np.stack(
            [
                _sign(log[name][first:last], margin, log.vessel.std(name))
                for name, margin in margins.items()
            ]
        )
        changes = np.flatnonzero((np.diff(signs, axis=1) != 0).any(axis=0)) + 1
        for a, b in pairwise([0, *changes.tolist(), last - first]):
            start, stop = first + a, first + b
            duration = float(log.t[stop - 1] - log.t[start]) + log.sample_time
            if not signs[:, a].all() or duration < shortest:
                continue
            label = "".join(
                f"{n}{'+' if s > 0 else '-'}" for n, s in zip(margins, signs[:, a], strict=True)
            )
            span = (float(log.t[start]), float(log.t[stop - 1]))
            made.append(Segment(start, stop, label, *span))
    return tuple(made)


def _sign(value: Array, margin: float, std: float | None) -> NDArray[np.int64]:
    """Return 1, −1, or 0 where the state is within its margin, a sample each."""
    size = 1
    if std and margin > 0:
        size = min(math.ceil((_SURE * std / margin) ** 2), _LONGEST_AVERAGE)
    elif std:
        size = _LONGEST_AVERAGE
    half = min(size // 2, (len(value) - 1) // 2)
    if half > 0:
        total = np.concatenate([[0.0], np.cumsum(value)])
        k = np.arange(len(value))
        # windows shrink at the ends instead of leaning to one side
        own = np.minimum(half, np.minimum(k, len(value) - 1 - k))
        value = (total[k + own + 1] - total[k - own]) / (2 * own + 1)
    clear = (np.abs(value) >= margin) & (value != 0)
    return np.where(clear, np.sign(value), 0.0).astype(np.int64)
