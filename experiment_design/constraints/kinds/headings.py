"""The least range of headings that a trial covers: ``--headings``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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

Array = NDArray[np.float64]


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


ENTRY = HeadingRange
