"""From the levels of each hold to the command at each sample: held, or ramped at a fixed pace.

The map is linear in the levels, so a gradient in the commands is carried back
by its transpose, and a rate limit is a limit on the step between two levels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.errors import UsageError, VesselError
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]

# samples of the longest trial that is designed in one piece
MOST_SAMPLES = 50_000


@dataclass(frozen=True)
class Schedule:
    """When commands change, how far and how fast.

    Parameters
    ----------
    commands : tuple of str
    sample_time : float
        [s]
    samples, hold : int
        N, and samples between changes.
    lower, upper : ndarray
        (nc,) limits of each command.
    ramp : tuple of int
        Samples over which each command moves to a new level; 1 is a step.
    reach : ndarray
        (nc,) largest step between neighbouring levels, inf where any is allowed.
    before : ndarray, optional
        (nc,) commands that a lead-in ends with; without one the trial begins at its first level.
    """

    commands: tuple[str, ...]
    sample_time: float
    samples: int
    hold: int
    lower: Array
    upper: Array
    ramp: tuple[int, ...]
    reach: Array
    before: Array | None = None

    @property
    def holds(self) -> int:
        """Number of levels a command, K."""
        return -(-self.samples // self.hold)

    @property
    def limited(self) -> bool:
        """Whether some rate stops a command from crossing its range in one hold."""
        return bool((self.reach < self.upper - self.lower).any())

    def expand(self, levels: Array) -> Array:
        """Return the commands (..., N, nc) of levels (..., K, nc)."""
        out = np.repeat(levels, self.hold, axis=-2)[..., : self.samples, :]
        if max(self.ramp) == 1:
            return out
        first = levels[..., :1, :]
        if self.before is not None:
            first = np.broadcast_to(self.before, first.shape)
        before = np.concatenate([first, levels[..., :-1, :]], axis=-2)
        held = np.repeat(before, self.hold, axis=-2)[..., : self.samples, :]
        share = self._share()
        return np.asarray(held + share * (out - held))

    def gather(self, gradient: Array) -> Array:
        """Carry a derivative in the commands (N, nc) to the levels (K, nc)."""
        starts = np.arange(0, self.samples, self.hold)
        if max(self.ramp) == 1:
            return np.asarray(np.add.reduceat(gradient, starts, axis=0))
        share = self._share()
        out = np.add.reduceat(gradient * share, starts, axis=0)
        before = np.add.reduceat(gradient * (1 - share), starts, axis=0)
        out[:-1] += before[1:]
        if self.before is None:
            out[0] += before[0]
        return np.asarray(out)

    def _share(self) -> Array:
        k = np.arange(self.samples) % self.hold + 1
        return np.asarray(np.minimum(1.0, k[:, None] / np.array(self.ramp)))

    def within_reach(self, levels: Array) -> Array:
        """Return levels (..., K, nc) clipped to the limits and to the rates, first to last."""
        out = np.clip(levels, self.lower, self.upper)
        if self.limited:
            if self.before is not None:
                out[..., 0, :] = np.clip(
                    out[..., 0, :], self.before - self.reach, self.before + self.reach
                )
            for k in range(1, out.shape[-2]):
                before = out[..., k - 1, :]
                out[..., k, :] = np.clip(out[..., k, :], before - self.reach, before + self.reach)
        return out


def make_schedule(vessel: Vessel, duration: float, hold: float, sample_time: float) -> Schedule:
    """Return the schedule that a vessel's limits and rates allow.

    Parameters
    ----------
    vessel : Vessel
        With limits for every command; where it states a rate, changes are ramps.
    duration, hold : float
        [s]
    sample_time : float
        [s]

    Raises
    ------
    VesselError
        A command has no limits, or limits without room.
    UsageError
        The hold is no multiple of the sample time or longer than the trial.
    """
    if duration / sample_time > MOST_SAMPLES:
        raise UsageError(
            f"a trial of {duration:g} s has {duration / sample_time:.3g} samples, {MOST_SAMPLES} "
            f"is the most: use --duration {MOST_SAMPLES * sample_time:g} or less."
        )
    samples, held = round(duration / sample_time), round(hold / sample_time)
    if held < 1 or abs(held * sample_time - hold) > 1e-6 * hold:
        raise UsageError(
            f"commands cannot change every {hold:g} s when the model's sample time is "
            f"{sample_time:g} s: use a multiple, such as --hold {max(1, held) * sample_time:g}."
        )
    if samples < 2 * held:
        raise UsageError(
            f"a trial of {duration:g} s has no change of command when each is held {hold:g} s: "
            f"use --duration {2 * hold:g} or more, or a shorter --hold."
        )
    lower, upper, ramp, reach = [], [], [], []
    _require_limits(vessel)
    for name, limits in vessel.limits.items():
        assert limits.lower is not None
        assert limits.upper is not None
        if limits.upper < limits.lower:
            raise VesselError(
                f"the limits of '{name}' contradict: the lower one is {limits.lower:g}, the upper "
                f"one {limits.upper:g}. Widen one of the thrusters that share the column."
            )
        lower.append(limits.lower)
        upper.append(limits.upper)
        span = limits.upper - limits.lower
        if limits.rate is None or limits.rate <= 0 or span == 0:
            ramp.append(1)
            reach.append(np.inf)
            continue
        needed = max(1, int(np.ceil(span / (limits.rate * sample_time) - 1e-9)))
        ramp.append(min(needed, held))
        reach.append(np.inf if needed <= held else limits.rate * held * sample_time)
    return Schedule(
        tuple(vessel.limits), sample_time, samples, held, np.array(lower), np.array(upper),
        tuple(ramp), np.array(reach),
    )  # fmt: skip


def _require_limits(vessel: Vessel) -> None:
    """Raise where commands have no limits, with the lines that give them some."""
    kinds = {column: kind for t in vessel.thrusters for kind, column, _, _ in t.movements}
    lacking = [n for n, x in vessel.limits.items() if x.lower is None or x.upper is None]
    if lacking:
        lines = (
            f"{kinds[n]}_limits = [LEAST, MOST]{'' if kinds[n] == 'speed' else ' in rad'} for '{n}'"
            for n in lacking
        )
        raise VesselError(
            f"{', '.join(map(repr, lacking))} {'has' if len(lacking) == 1 else 'have'} no limits, "
            f"and a sequence must stay within some: write {', '.join(lines)} under [[thruster]] in "
            f"the vessel file."
        )
