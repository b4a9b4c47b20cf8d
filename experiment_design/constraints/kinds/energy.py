"""The mean of the cube of the propeller speeds over that of full speed: ``--energy``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from experiment_design.constraints.limits import Limit, LimitedTrial, TrialLimits, WholeLimit
from experiment_design.excitation.rollout import Motion
from greybox.errors import UsageError

Array = NDArray[np.float64]


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


ENTRY = Energy
