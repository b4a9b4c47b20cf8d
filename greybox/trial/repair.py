"""Repairs of a recording by the findings of the checks."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from greybox.errors import LogError, UsageError, suggestion
from greybox.rotation import body_to_ned, ned_to_body
from greybox.trial.checks.finding import IDS, CheckReport, Finding
from greybox.trial.checks.signal_quality import clean
from greybox.trial.convert.derived_signals import PLACE, derive_signals
from greybox.trial.raw_log import Array, Recording, Signal
from greybox.trial.steps import Step, mend
from greybox.trial.time_format import unpadded_numbers

# a velocity is a difference, and its noise another one
_LEAST_SAMPLES = 3
# a channel has one clock, a heading one mounting, an antenna one place
_ONCE = frozenset({"shift", "turn_heading", "move_antenna", "earth_to_body"})


def repair(
    recording: Recording,
    report: CheckReport,
    *,
    also: tuple[str, ...] = (),
    without: tuple[str, ...] = (),
) -> tuple[Recording, tuple[str, ...], list[str]]:
    """Mend what is safe to mend.

    Parameters
    ----------
    recording : Recording
        As it was checked.
    report : CheckReport
    also : tuple of str
        Ids of findings to mend although they need judgement.
    without : tuple of str
        Ids of findings to leave although they are safe to mend.

    Returns
    -------
    recording : Recording
    fixed : tuple of str
        What was done, one sentence each.
    left : list of str
        What was found and left.

    Raises
    ------
    UsageError
        `also` or `without` names no id of a check, or both name one.
    LogError
        Two mends contradict each other, or too little would be left.
    """
    check_ids(also, without)
    wanted = [
        f for f in report.findings if f.repair and (f.safe or f.id in also) and f.id not in without
    ]
    left = [
        f"{f.id} ({', '.join(f.channels or (f.channel,))}): {f.fix}"
        for f in report.findings
        if f not in wanted and f.id != "gap"
    ]
    _refuse_contradictions(recording.name, wanted)
    mended = _mended_in_turn(recording, wanted)
    fixed = tuple(
        f"{f.id} of {', '.join(f.channels or (f.channel,))}: {f.evidence}" for f in wanted
    )
    return mended, fixed, left


def check_ids(also: tuple[str, ...], without: tuple[str, ...]) -> None:
    """Refuse ids of no check, and those that are to be mended and left.

    Raises
    ------
    UsageError
        With the nearest id.
    """
    for name in (*also, *without):
        if name not in IDS:
            raise UsageError(
                f"there is no check '{name}'.{suggestion(name, IDS)} Checks: {', '.join(IDS)}."
            )
    for name in also:
        if name in without:
            raise UsageError(f"'{name}' stands in --fix-also and in --fix-not: keep one of them.")


def _refuse_contradictions(name: str, wanted: Sequence[Finding]) -> None:
    """Refuse two mends that give one channel different clocks, mountings or places."""
    known: dict[tuple[str, str], tuple[Step, Finding]] = {}
    for finding in wanted:
        for step in finding.repair:
            for channel in step.channels if step.operation in _ONCE else ():
                before = known.setdefault((step.operation, channel), (step, finding))
                if dict(before[0].parameters) != dict(step.parameters):
                    ids = " and ".join(dict.fromkeys((before[1].id, finding.id)))
                    raise LogError(
                        f"two mends of {channel} in '{name}' contradict each other, "
                        f"'{before[0].sentence}' and '{step.sentence}': leave one out by "
                        f"--fix-not with {ids}, or change the log."
                    )


def _mended_in_turn(recording: Recording, wanted: Sequence[Finding]) -> Recording:
    """Apply the repairs finding by finding; refuse one that leaves a channel too few samples."""
    for finding in wanted:
        had, mended = _beside(recording), apply_repairs(recording, [finding])
        have = _beside(mended)
        for channel in dict.fromkeys(c for s in finding.repair for c in s.channels):
            if have.get(channel, 0) < _LEAST_SAMPLES <= had.get(channel, 0):
                raise LogError(
                    f"to mend '{finding.id}' of {channel} in '{recording.name}' would leave "
                    f"{have.get(channel, 0)} of its {had[channel]} samples beside the other "
                    f"channels, at least {_LEAST_SAMPLES} are needed: leave it out by --fix-not "
                    f"{finding.id}, or look at the log."
                )
        recording = mended
    return recording


def _beside(recording: Recording) -> dict[str, int]:
    """Return how many samples of each channel lie within the time that all channels cover."""
    clocks = {}
    for s in recording.signals:
        t = s.t[s.known]
        if len(t):
            clocks[s.name] = t
    if not clocks:
        return {}
    start = max(float(t.min()) for t in clocks.values())
    stop = min(float(t.max()) for t in clocks.values())
    found = {n: int(((t >= start) & (t <= stop)).sum()) for n, t in clocks.items()}
    return found | {s.name: 0 for s in recording.signals if s.name not in clocks}


def apply_repairs(recording: Recording, findings: Iterable[Finding]) -> Recording:
    """Return the recording with the repairs of the findings applied in order, as its steps."""
    # what reading did already is not done again
    steps = [
        replace(step, reason=step.reason or f.evidence)
        for f in findings
        for step in f.repair
        if step not in recording.steps
    ]
    for step in steps:
        if step.operation in _ON_DERIVED or _lacks_derived(recording, step):
            # not before: what was interpolated across a wrap must go before it is unwrapped
            recording = derive_signals(recording)
        recording = _ACTIONS[step.operation](recording, step)
    return recording.with_steps(*steps)


def _changed(
    recording: Recording, names: Collection[str], change: Callable[[Signal], Signal]
) -> Recording:
    """Return the recording with some of its signals changed."""
    return recording.with_signals(change(s) if s.name in names else s for s in recording.signals)


def _order(recording: Recording, step: Step) -> Recording:
    clocks: dict[int, tuple[NDArray[np.int64], Array]] = {}

    def in_order(s: Signal) -> Signal:
        if id(s.t) not in clocks:
            order = np.argsort(s.t, kind="stable")
            t = s.t[order]
            once = np.concatenate([[True], np.diff(t) != 0])
            clocks[id(s.t)] = (order[once], t[once])
        rows, t = clocks[id(s.t)]
        return replace(s, t=t, value=s.value[rows])

    return _changed(recording, step.channels, in_order)


def _signals_of(recording: Recording, step: Step) -> set[str]:
    """Return the signals that hold the channels of a step, or of which they are derived."""
    names: set[str] = set()
    for n in step.channels:
        names |= {n} if n in recording else set(_MEASURED_AS.get(n, ()))
    return names


def _interpolate(recording: Recording, step: Step) -> Recording:
    times = np.array(step.numbers("times"))

    def bridged(s: Signal) -> Signal:
        bad = np.isin(s.t, times)
        good = s.known & ~bad
        if not (bad.any() and good.any()):
            return s
        value = s.value.copy()
        value[bad] = np.interp(s.t[bad], s.t[good], s.value[good])
        return s.with_value(value)

    return _changed(recording, _signals_of(recording, step), bridged)


def _drop(recording: Recording, step: Step) -> Recording:
    times = np.array(step.numbers("times"))
    shared: dict[tuple[int, bytes], Array] = {}

    def without(s: Signal) -> Signal:
        keep = s.known
        if len(times):
            keep &= ~np.isin(s.t, times)
        if step.interval is not None:
            keep &= (s.t < step.interval[0]) | (s.t > step.interval[1])
        # signals that keep the same rows keep sharing one clock
        t = shared.setdefault((id(s.t), np.packbits(keep).tobytes()), s.t[keep])
        return replace(s, t=t, value=s.value[keep])

    return _changed(recording, _signals_of(recording, step), without)


def _pad_fractions(recording: Recording, step: Step) -> Recording:
    zero = recording.epoch or 0.0
    shared: dict[int, Array] = {}

    def padded(s: Signal) -> Signal:
        if id(s.t) not in shared:
            wrong = unpadded_numbers(s.t + zero)
            t = s.t.copy()
            t[wrong.rows] = wrong.times - zero
            shared[id(s.t)] = t
        return replace(s, t=shared[id(s.t)])

    return _changed(recording, step.channels, padded)


def _scale(recording: Recording, step: Step) -> Recording:
    factor = step.number("factor")
    return _changed(recording, step.channels, lambda s: s.with_value(s.value * factor))


def _offset(recording: Recording, step: Step) -> Recording:
    offset = step.number("offset")
    return _changed(recording, step.channels, lambda s: s.with_value(s.value + offset))


def _lacks_derived(recording: Recording, step: Step) -> bool:
    """Whether a step changes what is still to be derived, such as a local position."""
    if step.operation not in ("scale", "offset"):
        return False
    return any(set(_MEASURED_AS.get(n, ())) & set(recording.names) for n in step.channels)


def _exchange(recording: Recording, step: Step) -> Recording:
    names = step.channels
    if names == PLACE and {"lat", "lon"} <= set(recording.names):
        # a degree of longitude is shorter than one of latitude
        names = ("lat", "lon")
    new = dict(zip(names, (*names[1:], names[0]), strict=True))
    return recording.with_signals(
        replace(s, name=new.get(s.name, s.name)) for s in recording.signals
    )


def _shift(recording: Recording, step: Step) -> Recording:
    late = step.number("late")
    shared: dict[int, Array] = {}
    return _changed(
        recording,
        step.channels,
        lambda s: replace(s, t=shared.setdefault(id(s.t), s.t - late)),
    )


def _turn_heading(recording: Recording, step: Step) -> Recording:
    return _offset(recording, mend("offset", ("psi",), offset=-step.number("angle")))


def _earth_to_body(recording: Recording, step: Step) -> Recording:
    north, east = (recording[n] for n in step.channels)
    psi = _heading_at(recording, north.t)
    u, v = ned_to_body(north.value, np.interp(north.t, east.t, east.value), psi)
    made = {"u": u, "v": v}
    return _changed(recording, made, lambda s: replace(s, t=north.t, value=made[s.name]))


def _move_antenna(recording: Recording, step: Step) -> Recording:
    def at_origin(s: Signal) -> Signal:
        arm = body_to_ned(step.number("x"), step.number("y"), _heading_at(recording, s.t))
        return s.with_value(s.value - arm[s.name == "y_n"])

    return _changed(recording, ("x_n", "y_n"), at_origin)


def _heading_at(recording: Recording, t: Array) -> Array:
    return np.interp(t, *clean(recording["psi"]))


# what a channel is derived from, where a recording does not hold it yet
_MEASURED_AS = {
    "x_n": ("lat", "lon"), "y_n": ("lat", "lon"), "v_n": ("sog", "cog"), "v_e": ("sog", "cog"),
    "u_q": ("V_q", "gamma_q", "dir_q"), "v_q": ("V_q", "gamma_q", "dir_q"),
}  # fmt: skip
_ACTIONS: dict[str, Callable[[Recording, Step], Recording]] = {
    "order": _order, "drop": _drop, "interpolate": _interpolate, "scale": _scale,
    "offset": _offset, "exchange": _exchange, "shift": _shift, "turn_heading": _turn_heading,
    "earth_to_body": _earth_to_body, "move_antenna": _move_antenna,
    "pad_fractions": _pad_fractions,
    # the steps themselves tell where a recording is cut
    "cut": lambda recording, step: recording,
}  # fmt: skip
# these act on positions and unwrapped headings
_ON_DERIVED = frozenset({"earth_to_body", "move_antenna", "shift", "turn_heading"})
