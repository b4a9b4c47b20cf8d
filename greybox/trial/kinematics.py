"""Body velocities from positions and heading, and decimation to a longer sample time."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from greybox.errors import LogError
from greybox.rotation import ned_to_body
from greybox.trial.log import TrialLog
from greybox.trial.raw_log import Array, Mask
from greybox.trial.steps import Step

# corrections of derived velocities that those of the positions and heading imply
_FOLLOWED = frozenset({"turn_heading", "move_velocity"})


def velocities_from_positions(
    x_n: Array,
    y_n: Array,
    psi: Array,
    sample_time: float,
    *,
    heading_std: float = 0.0,
    antenna: tuple[float, ...] = (0.0, 0.0),
) -> tuple[Array, Array, Array]:
    """Estimate body velocities from positions and heading by central differences.

    Parameters
    ----------
    x_n, y_n : ndarray
        (N,) position of the antenna, north and east [m].
    psi : ndarray
        (N,) heading, unwrapped [rad].
    sample_time : float
        Ts [s].
    heading_std : float
        Standard deviation of the heading noise [rad]; its shrinking of u and v
        by ρ = exp(−λ/2) is divided out.
    antenna : tuple of float
        Position of the antenna from the body origin, forward and starboard [m].

    Returns
    -------
    tuple of ndarray
        u, v [m/s] at the body origin and r [rad/s], (N,) each; the first and
        last sample are one-sided.

    References
    ----------
    Ljungberg (2020), eq. 3.57 (with Rᵀ, from n-frame differences to the body
    frame) and 3.64.
    """
    north, east, r = (np.asarray(np.gradient(x, sample_time)) for x in (x_n, y_n, psi))
    rho = np.exp(-(heading_std**2) / 2)
    u, v = (w / rho for w in ned_to_body(north, east, psi))
    return u + r * antenna[1], v - r * antenna[0], r


def decimate(log: TrialLog, sample_time: float) -> TrialLog:
    """Return the log at a longer sample time.

    Positions, heading, wind and velocities are averaged over the interval around each new
    sample; inputs are averaged over the interval that follows, which is what the ship then
    feels. Velocities and yaw rate that central differences made are made anew, of the averaged
    positions and heading: the average of differences over an interval is the difference of two
    single samples, with all of their noise. Local polynomials and sensors of velocity have no
    such loss and are averaged.

    Parameters
    ----------
    log : TrialLog
    sample_time : float
        A whole multiple of the log's own [s].

    Returns
    -------
    TrialLog

    Raises
    ------
    LogError
        It is not a multiple, or fewer than three samples would remain.
    """
    ratio = sample_time / log.sample_time
    step = round(ratio)
    if step < 1 or abs(ratio - step) > 0.01 * step:
        raise LogError(
            f"a sample time of {sample_time:g} s is {ratio:.3g} times the {log.sample_time:g} s "
            f"of '{log.name}': choose a whole multiple."
        )
    if step == 1:
        return log
    half = step // 2
    centres = np.arange(half, len(log) - step, step)
    if len(centres) < 3:
        raise _too_few(log, len(centres), sample_time)
    sums = {k: np.concatenate([[0.0], np.cumsum(v)]) for k, v in log.channels.items()}
    channels: dict[str, Array] = {}
    inputs = set(log.vessel.recorded_columns)
    for name, total in sums.items():
        first = centres if name in inputs else centres - half
        channels[name] = (total[first + step] - total[first]) / step
        if name not in inputs and step % 2 == 0:
            # an even window has no middle sample: halve its two ends
            last = centres + half
            value = log.channels[name]
            channels[name] += (value[last] - value[centres - half]) / (2 * step)
    made = [Step("decimate", tuple(channels), parameters={
        "measured": log.sample_time, "sample_time": sample_time})]  # fmt: skip
    made += _differences(log, channels, sample_time)
    then = made[1:]
    anew = {n for s in then for n in s.channels}
    measured = {n: gap for n, gap in log.missing.items() if n not in anew}
    if any(_antenna(log)):
        then.append(Step("move_velocity", ("u", "v"), ("r",)))
    out = replace(
        log,
        sample_time=sample_time,
        t=log.t[centres],
        channels=channels,
        closed_loop=log.closed_loop[centres],
        missing=carried_gaps(_without_means(measured, centres - half, step), then, sample_time),
        provenance=replace(log.provenance, steps=(*log.provenance.steps, *made)),
    )
    if len(made) == 1:
        return out
    # the first and last sample have only one neighbour (3.57)
    if len(out) < 5:
        raise _too_few(log, len(out) - 2, sample_time)
    return replace(out.window(1, len(out) - 1), name=log.name)


def _without_means(
    missing: Mapping[str, Mask], first: NDArray[np.int_], step: int
) -> dict[str, Mask]:
    """Return the samples of each channel with gaps most of whose mean was not measured."""
    sums = {n: np.concatenate([[0], np.cumsum(gap)]) for n, gap in missing.items()}
    return {n: 2 * (s[first + step] - s[first]) > step for n, s in sums.items()}


def carried_gaps(
    missing: Mapping[str, Mask], steps: Iterable[Step], sample_time: float
) -> dict[str, Mask]:
    """Return which samples of each channel are not measured once steps have been taken.

    Parameters
    ----------
    missing : mapping of str to ndarray of bool
        (N,) of the channels with gaps, as they were before.
    steps : iterable of Step
        In order: what is made of a gap is one, with the neighbours that a difference reaches.
    sample_time : float
        [s]
    """
    from scipy.ndimage import binary_dilation

    out = dict(missing)
    for step in steps if missing else ():
        # velocities are moved with the yaw rate
        source = ("r",) if step.operation == "move_velocity" else step.source
        gaps = []
        for n in out.keys() & set(source):
            # how many neighbours on either side are taken into a sample
            reach = math.ceil(step.number("window") / (2 * sample_time))
            if step.operation == "difference":
                # velocities are turned by the heading of the sample alone
                reach = int(n != "psi" or "r" in step.channels)
            gaps.append(binary_dilation(out[n], iterations=reach) if reach else out[n])
        if gaps:
            gap = np.any(gaps, axis=0)
            out |= {n: gap | out.get(n, False) for n in step.channels}
        if step.operation == "shift":
            late = step.number("late") / sample_time
            for name in out.keys() & set(step.channels):
                k = np.arange(len(out[name]))
                out[name] = np.interp(k + late, k, out[name].astype(float)) > 0
    return {n: m for n, m in out.items() if m.any()}


class _TooShortError(LogError):
    """A log keeps fewer than three samples at a longer sample time."""


def _too_few(log: TrialLog, kept: int, sample_time: float) -> LogError:
    return _TooShortError(
        f"'{log.name}' keeps {kept} samples at {sample_time:g} s, at least 3 are needed: choose a "
        f"shorter sample time."
    )


def decimate_segments(
    logs: Sequence[TrialLog], sample_time: float
) -> tuple[list[TrialLog], tuple[str, ...]]:
    """Return segments at a longer sample time without those that it leaves too short.

    Parameters
    ----------
    logs : sequence of TrialLog
        Such as the segments between the gaps of several files.
    sample_time : float
        As of `decimate` [s].

    Returns
    -------
    tuple of (list of TrialLog, tuple of str)
        At least one log, and a sentence for each segment that was left out.

    Raises
    ------
    LogError
        As of `decimate`, where no segment is long enough.
    """
    kept, notes, refused = [], [], None
    for log in logs:
        try:
            kept.append(decimate(log, sample_time))
        except _TooShortError as error:
            refused = refused or error
            notes.append(
                f"'{log.name}' was left out: its {len(log)} samples "
                f"({len(log) * log.sample_time:.3g} s) are too few for a sample time of "
                f"{sample_time:g} s."
            )
    if refused is not None and not kept:
        raise refused
    return kept, tuple(notes)


def _differences(log: TrialLog, channels: dict[str, Array], sample_time: float) -> list[Step]:
    """Make anew, in place, what central differences made; return the steps."""
    by_difference = {
        n: s
        for n in ("u", "v", "r")
        if (s := _last_made(log, n)) is not None and channels.keys() >= {n, *s.source}
    }
    if not by_difference:
        return []
    psi = channels["psi"]
    positioned = {"x_n", "y_n"} <= channels.keys()
    u, v, r = velocities_from_positions(
        channels["x_n"] if positioned else psi,
        channels["y_n"] if positioned else psi,
        psi,
        sample_time,
        heading_std=log.vessel.std("psi") or 0.0,
        antenna=_antenna(log),
    )
    made: dict[tuple[str, ...], list[str]] = {}
    for name, value in (("u", u), ("v", v), ("r", r)):
        if name in by_difference:
            channels[name] = value
            made.setdefault(by_difference[name].source, []).append(name)
    return [
        Step("difference", tuple(names), source, {"sample_time": sample_time})
        for source, names in made.items()
    ]


def _antenna(log: TrialLog) -> tuple[float, float]:
    """Return from where derived velocities were brought to the origin, forward and starboard."""
    moved = [
        s for s in log.provenance.steps
        if s.operation == "move_velocity" and s.parameters.get("sensor") == "antenna"
    ]  # fmt: skip
    return sum(s.number("x") for s in moved), sum(s.number("y") for s in moved)


def _last_made(log: TrialLog, name: str) -> Step | None:
    """Return the central differences that made a channel, None where others came after."""
    for step in reversed(log.provenance.steps):
        if name in step.channels and step.operation not in ("decimate", *_FOLLOWED):
            return step if step.operation == "difference" and "psi" in step.source else None
    return None
