"""The time grid of a log: start, end and sample time, and the channels whose holes are gaps."""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from greybox.channels import LOGGED
from greybox.errors import LogError, so_many
from greybox.trial.convert.derived_signals import (
    BODY,
    EARTH,
    MOTION_SIGNALS,
    PLACE,
    POSITION_ORDER,
    made_from_positions,
)
from greybox.trial.convert.options import ImportOptions
from greybox.trial.convert.resample import Clock, covered, nice_period, resampled_by, stretches
from greybox.trial.gaps import split_at_gaps
from greybox.trial.raw_log import Array, Mask, Recording
from greybox.trial.smoothing import window_samples
from greybox.trial.steps import Step
from greybox.vessel.vessel import Vessel

_WIND = ("u_q", "v_q", "w_n", "w_e", "w_x", "w_y")
_BODY, _EARTH, _PLACE = map(frozenset, (BODY, EARTH, PLACE))
# what serves as well as a motion signal
_INSTEAD: dict[str, tuple[frozenset[str], ...]] = {
    "r": (frozenset({"psi"}),), "v_n": (_BODY, _PLACE), "v_e": (_BODY, _PLACE),
    "x_n": (_BODY, _EARTH), "y_n": (_BODY, _EARTH), "u": (_EARTH, _PLACE), "v": (_EARTH, _PLACE),
}  # fmt: skip
MIN_SEGMENT = 3
# a grid of more samples than this many times those read is a mistake in the times
_MAX_GROWTH = 50
# share of uneven steps below which missing values are a hole and not a quiet sensor
_STEADY = 0.05
# share of the time of the longest signal that another must cover to be of use
_ENOUGH = 0.5


@dataclass(frozen=True)
class Extent:
    """What the samples of a log depend on of one signal's clock.

    Parameters
    ----------
    first, last : float
        [s]
    count : int
        Values.
    period, mean : float
        Usual step, and mean step in the longest stretch without a hole [s].
    covered : float
        Time within stretches [s].
    irregular : int
        Steps within stretches that are not the usual one.
    """

    first: float
    last: float
    count: int
    period: float
    mean: float
    covered: float
    irregular: int

    @property
    def steady(self) -> bool:
        """Whether the signal comes at its own rate, so that missing values are a hole."""
        return self.count > 2 and self.irregular < _STEADY * self.count


def extent(of: Clock) -> Extent:
    """Return what the samples of a log depend on of a clock."""
    return Extent(
        float(of.t[0]), float(of.t[-1]), len(of.t), of.period, of.mean, of.covered, of.irregular
    )


@dataclass(frozen=True)
class Plan:
    """The samples of a log, and which signals it is made of.

    Parameters
    ----------
    name : str
    sample_time, start : float
        [s]
    count : int
        Samples, those in gaps included.
    periods : mapping of str to float
        Usual step of each signal that is used [s].
    reference_channels : tuple of str
        Signals whose holes are gaps.
    notes : tuple of str
    least : int
        Samples of the shortest stretch that is kept.
    steps : tuple of Step
        How signals of other rates are brought to the sample time.
    times : ndarray, optional
        (count,) [s] where the samples are those that were recorded, without a change.
    """

    name: str
    sample_time: float
    start: float
    count: int
    periods: Mapping[str, float]
    reference_channels: tuple[str, ...]
    notes: tuple[str, ...]
    least: int
    steps: tuple[Step, ...] = ()
    times: Array | None = None

    def grid(self, first: int, stop: int) -> Array:
        """Return the times of some samples [s]."""
        if self.times is not None:
            return self.times[first:stop]
        # rounding keeps 0.3 from becoming 0.30000000000000004 in the file
        return np.round(self.start + self.sample_time * np.arange(first, stop), 9)

    def stretches(
        self, grid: Array, clocks: Mapping[str, Clock], cuts: Sequence[float] = ()
    ) -> list[tuple[int, int]]:
        """Return the runs of samples (start, stop) in which every reference channel has values.

        None reaches over one of `cuts` [s].
        """
        if self.times is not None:
            return split_at_gaps(grid, self.sample_time)
        return stretches(grid, (clocks[n] for n in self.reference_channels), cuts)

    def gaps(
        self, grid: Array, recording: Recording, clocks: Mapping[str, Clock]
    ) -> dict[str, Mask]:
        """Return the samples at which motions were not measured, of those that have such."""
        gaps = {}
        for s in recording.signals:
            if s.name not in MOTION_SIGNALS or (
                self.times is None and s.name in self.reference_channels
            ):
                continue
            if self.times is None:
                gap = ~covered(grid, clocks[s.name])
            else:
                gap = ~np.isin(grid, s.t) if len(s) < len(grid) else np.zeros(len(grid), bool)
            if gap.any():
                gaps[s.name] = gap
        return gaps


def plan_import(
    extents: Mapping[str, Extent], vessel: Vessel, options: ImportOptions, name: str
) -> Plan:
    """Choose the time grid of a log, and the signals that it is made of.

    Raises
    ------
    LogError
        Nothing moves in the recording, or its signals do not overlap; a window
        of smoothing is too short or too long.
    """
    used, notes = _usable(extents, vessel, name)
    inputs = [c for c in vessel.commands if c in used]
    # a run needs no positions where its velocities were measured
    spare = _PLACE if any(pair <= used.keys() for pair in (_BODY, _EARTH)) else frozenset()
    beside = set(vessel.recorded_columns) - set(vessel.commands)
    reference = [n for n in MOTION_SIGNALS if n in used] or inputs
    sample_time = options.sample_time or _sample_time([used[n] for n in reference])
    held = [n for n in used if n not in (*reference, *beside) and used[n].steady]
    late = [n for n in inputs if n not in reference and n not in held]
    reference = [*reference, *held]
    one = max((*reference, *late), key=lambda n: used[n].first)
    two = min(reference, key=lambda n: used[n].last)
    start, stop = used[one].first, used[two].last
    # a held value lasts until the next would have come
    if stop - start < (MIN_SEGMENT - 1) * sample_time * (1 - 1e-6):
        raise LogError(
            f"the signals of '{name}' overlap from {start:.6g} s ({one}) to {stop:.6g} s ({two}), "
            f"less than {MIN_SEGMENT} samples of {sample_time:g} s: check the clocks of the "
            f"files, or choose a shorter sample time."
        )
    values = sum(used[n].count for n in reference)
    samples = (stop - start) / sample_time + 1
    if samples > _MAX_GROWTH * values + 1000:
        raise LogError(
            f"'{name}' spans {stop - start:.4g} s, {samples:.4g} samples of {sample_time:g} s, but "
            f"holds {so_many(values, 'value')}: correct its times, or choose a longer sample time."
        )
    shaping = [e for n, e in used.items() if n not in beside]
    longest = max(e.last for e in shaping) - min(e.first for e in shaping)
    if stop - start < 0.9 * longest:
        notes.append(
            f"of {longest:.4g} s, {start:.6g} s ({one} begins) to {stop:.6g} s ({two} ends) are "
            f"covered by every signal"
        )
    count = int(np.floor((stop - start) / sample_time + 1e-6)) + 1
    return Plan(
        name,
        sample_time,
        start,
        count,
        {n: e.period for n, e in used.items()},
        tuple(n for n in reference if n not in spare),
        tuple(notes),
        max([MIN_SEGMENT, *_windows(options, used, count, sample_time)]),
        _resampling({n: e.period for n, e in used.items()}, sample_time, vessel),
    )


def _usable(
    extents: Mapping[str, Extent], vessel: Vessel, name: str
) -> tuple[dict[str, Extent], list[str]]:
    """Return the signals that the log is made of, and what is said of the others."""
    notes = [
        f"{n} has {so_many(e.count, 'value')}: left out"
        for n, e in extents.items()
        if e.count < MIN_SEGMENT
    ]
    commands = set(vessel.commands)
    # a command beside its feedback, or the other way round: it moves no model, so its holes
    # and its ends must not cut the log
    beside = set(vessel.recorded_columns) - commands
    used = {
        n: e
        for n, e in extents.items()
        if e.count >= MIN_SEGMENT and n in {*MOTION_SIGNALS, *_WIND, *commands, *beside}
    }
    motion = [n for n in MOTION_SIGNALS if n in used]
    inputs = [c for c in vessel.commands if c in used]
    if not motion and not inputs:
        held = ", ".join(f"{n} ({e.count})" for n, e in extents.items())
        raise LogError(
            f"'{name}' has no position, heading, velocity or thruster column with "
            f"{MIN_SEGMENT} values or more{held and f'; it has {held}'}. Map its columns in the "
            f"vessel file, or use a longer log."
        )
    missing = [c for c in vessel.commands if c not in used]
    if missing:
        notes.append(
            f"no thruster column {', '.join(missing)}: motion only, no force model can be fitted"
        )
    most = max(used[n].covered for n in (motion or inputs))
    brief = {n for n in used if n not in commands and used[n].covered < _ENOUGH * most}
    for n in sorted(brief):
        others = used.keys() - brief
        # a sensor that soon died must not take the others with it, where they do without
        if n in beside and not used[n].steady:
            # recorded where it changes, it holds until it changes again
            continue
        if n in beside or n in _WIND or any(pair <= others for pair in _INSTEAD.get(n, ())):
            notes.append(f"{n} covers {used[n].covered:.4g} of {most:.4g} s: left out")
            used.pop(n)
    return used, notes


def _resampling(
    periods: Mapping[str, float], sample_time: float, vessel: Vessel
) -> tuple[Step, ...]:
    """Return how signals whose rate is not the log's are brought to it."""
    held = frozenset(vessel.recorded_columns)
    done: dict[str, list[str]] = {}
    for name, period in periods.items():
        how = resampled_by(period, sample_time, held=name in held)
        if how is not None:
            done.setdefault(how, []).append(name)
    return tuple(
        Step("resample", tuple(names), parameters={"how": how, "sample_time": sample_time})
        for how, names in done.items()
    )


def _windows(
    options: ImportOptions, names: Container[str], count: int, sample_time: float
) -> Iterator[int]:
    """Yield the samples of each window of smoothing, and of that which makes velocities."""
    if options.velocities == "savgol" and made_from_positions(names):
        yield window_samples(count, sample_time, options.window, POSITION_ORDER)
    for name, seconds in options.smooth.items():
        # that a log has no such channel is said where all of its channels are known
        if name not in names and name not in LOGGED:
            continue
        try:
            yield window_samples(count, sample_time, seconds)
        except LogError as error:
            raise LogError(f"{name} cannot be smoothed: {error}") from None


def _sample_time(extents: list[Extent]) -> float:
    slowest = max(extents, key=lambda e: e.period)
    if slowest.period <= 0:
        raise LogError("the motion sensors have one sample each: name a longer recording.")
    near = abs(slowest.mean - slowest.period) < 0.2 * slowest.mean
    return nice_period(slowest.mean if near else slowest.period)


def gap_notes(spans: Sequence[tuple[float, float]], short: int, least: int) -> list[str]:
    """Say how many gaps there are between spans [s], and what was too short to keep."""
    notes = []
    if short:
        notes.append(
            f"{so_many(short, 'stretch')} of fewer than {least} samples left out"
            f"{', since none can be smoothed' if least > MIN_SEGMENT else ''}"
        )
    gaps = [(a[1], b[0]) for a, b in pairwise(spans)]
    if gaps:
        begin, end = max(gaps, key=lambda gap: gap[1] - gap[0])
        notes.append(
            f"{so_many(len(gaps), 'gap')} kept as such, the longest of "
            f"{end - begin:.3g} s at t = {begin:.6g} s: {so_many(len(spans), 'segment')}"
        )
    return notes


def too_short(plan: Plan) -> LogError:
    """Return the error of a plan without a segment."""
    other = " or a shorter window of smoothing" if plan.least > MIN_SEGMENT else ""
    return LogError(
        f"'{plan.name}' has {so_many(plan.count, 'sample')} of {plan.sample_time:g} s but no "
        f"{plan.least} that follow each other in which "
        f"{', '.join(plan.reference_channels)} all have values (two more where "
        f"velocities are derived): choose another sample time{other}, or bridge longer "
        f"steps by greybox import --hole."
    )
