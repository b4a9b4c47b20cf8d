"""Limits of a trial as a whole: ``--end``, ``--energy``, ``--headings``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from experiment_design.constraints.limits import (
    Circumstances,
    Limit,
    LimitedTrial,
    TrialLimits,
    WholeLimit,
    rounded_up,
)
from experiment_design.excitation.rollout import Motion
from greybox.errors import UsageError, suggestion

Array = NDArray[np.float64]

_UNITS = {"u": "m/s", "v": "m/s", "r": "rad/s", "psi": "rad", "x_n": "m", "y_n": "m"}


@dataclass(frozen=True)
class EndState(WholeLimit):
    """A tolerance of one final value.

    Parameters
    ----------
    signal : {"u", "v", "r", "psi", "x_n", "y_n"}
    wanted : float
        Its final value [m/s, rad/s, rad, m].
    place : int
        Among the entries of a motion's state.
    target : float
        What that entry is then: places are counted from the start.
    """

    signal: str
    wanted: float
    place: int
    target: float
    name = "end state"
    order = 5
    field = "end"
    option = "--end"

    @property
    def words(self) -> str:
        """The limit in words."""
        return f"end state of {self.signal} = {self.wanted:g}"

    @property
    def unit(self) -> str:
        """Unit of the value."""
        return _UNITS[self.signal]

    def values(self, motion: Motion) -> Array:
        """Return h, (R,)."""
        return np.asarray(np.abs(motion.state[:, -1, self.place] - self.target) - self.bound)

    def pull(self, motion: Motion, weight: float, d_state: Array, d_commands: Array) -> None:
        """Add the derivatives."""
        off = motion.state[0, -1, self.place] - self.target
        d_state[-1, self.place] += weight * np.sign(off)

    def with_bound(self, limits: TrialLimits, bound: float) -> TrialLimits:
        """Return limits with another tolerance."""
        return replace(limits, end=dict(limits.end) | {self.signal: (self.wanted, bound)})

    def advice(self, amount: float, circumstances: Circumstances) -> str:
        """Return the tolerance that is within reach."""
        return (
            f"the {self.words} within {self.bound:g} {self.unit} cannot be reached: it is missed "
            f"by {amount:.3g} {self.unit} beyond that. Raise the tolerance in --end to "
            f"{self.bound + rounded_up(amount):.4g} {self.unit}, or lengthen the trial."
        )

    @classmethod
    def of(cls, limits: TrialLimits, trial: LimitedTrial) -> Sequence[Limit]:
        """Return a tolerance for each value that is asked for."""
        found = []
        for name, (value, tolerance) in limits.end.items():
            if name not in trial.signals:
                raise UsageError(
                    f"the end state names '{name}'.{suggestion(name, trial.signals)} It can name "
                    f"{', '.join(trial.signals)}."
                )
            if not (np.isfinite(value) and 0 < tolerance < np.inf):
                raise UsageError(
                    f"the end state {name} = {value:g} has the tolerance {tolerance:g}: both "
                    f"must be finite, and the tolerance positive. Write --end "
                    f"{name}=VALUE:TOLERANCE."
                )
            shift = dict(zip(("x_n", "y_n"), limits.position, strict=True)).get(name, 0.0)
            place = trial.signals.index(name)
            found.append(cls(tolerance, name, value, place, value - shift))
        return found


@dataclass(frozen=True)
class Energy(WholeLimit):
    """The largest mean of the cube of the propeller speeds over that of full speed.

    Parameters
    ----------
    speeds : tuple of (int, float)
        Place of each propeller speed among the commands, and its full speed.
    """

    speeds: tuple[tuple[int, float], ...]
    name = "energy"
    order = 6
    field = "energy"
    option = "--energy"
    unit = ""

    @cached_property
    def _places(self) -> list[int]:
        return [place for place, _ in self.speeds]

    def _share(self, commands: Array) -> Array:
        """Return the propeller speeds of commands (..., nc) as shares of full speed."""
        return np.asarray(commands[..., self._places] / np.array([full for _, full in self.speeds]))

    def mean_cube(self, command: ca.SX) -> ca.SX:
        """Return the mean of the cubes of the shares of one command (nc,)."""
        cubes = [ca.fabs(command[i] / full) ** 3 for i, full in self.speeds]
        return ca.sum1(ca.vertcat(*cubes)) / len(cubes)

    def values(self, motion: Motion) -> Array:
        """Return h, (R,)."""
        used = np.abs(self._share(motion.commands)) ** 3
        return np.asarray(used.mean(axis=(1, 2)) - self.bound)

    def pull(self, motion: Motion, weight: float, d_state: Array, d_commands: Array) -> None:
        """Add the derivatives."""
        share = self._share(motion.commands[0])
        slope = 3 * share * np.abs(share) / share.size
        d_commands[:, self._places] += weight * slope / [full for _, full in self.speeds]

    @classmethod
    def of(cls, limits: TrialLimits, trial: LimitedTrial) -> Sequence[Limit]:
        """Return the limit of all propellers together."""
        return [] if limits.energy is None else [cls(limits.energy, trial.speeds)]

    @classmethod
    def check(cls, limits: TrialLimits) -> None:
        """Refuse what cannot be asked for."""
        if limits.energy is not None and not 0 < limits.energy <= 1:
            raise UsageError(
                f"the energy share is {limits.energy:g}, it must lie between 0 and 1, full speed."
            )


@dataclass(frozen=True)
class HeadingRange(WholeLimit):
    """The least range of headings [rad].

    Parameters
    ----------
    place : int
        Of the heading among the entries of a motion's state.
    """

    place: int
    name = "heading coverage"
    order = 7
    field = "headings"
    option = "--headings"
    unit = "rad"

    def values(self, motion: Motion) -> Array:
        """Return h, (R,)."""
        psi = motion.state[..., self.place]
        return np.asarray(self.bound - (psi.max(axis=1) - psi.min(axis=1)))

    def pull(self, motion: Motion, weight: float, d_state: Array, d_commands: Array) -> None:
        """Add the derivatives."""
        psi = motion.state[0, :, self.place]
        d_state[int(psi.argmax()), self.place] -= weight
        d_state[int(psi.argmin()), self.place] += weight

    def advice(self, amount: float, circumstances: Circumstances) -> str:
        """Return the range that is within reach."""
        least = np.floor(99 * (self.bound - rounded_up(amount))) / 100
        return (
            f"headings cannot cover {self.bound:.3g} rad: {self.bound - amount:.3g} rad is the "
            f"most that was reached. Lower --headings to {least:g} or lengthen the trial."
        )

    @classmethod
    def of(cls, limits: TrialLimits, trial: LimitedTrial) -> Sequence[Limit]:
        """Return the range that is to be covered."""
        if limits.headings is None:
            return []
        return [cls(limits.headings, trial.signals.index("psi"))]


ENTRIES = (EndState, Energy, HeadingRange)
