"""The largest rate of turn: ``--yaw-cap``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from experiment_design.constraints.limits import Limit, LimitedTrial, PathLimit, TrialLimits

Array = NDArray[np.float64]


@dataclass(frozen=True)
class YawRateCap(PathLimit):
    """The largest rate of turn to either side [rad/s]."""

    name = "yaw-rate cap"
    order = 3
    field = "yaw_cap"
    option = "--yaw-cap"
    unit = "rad/s"
    signal = "r"

    def value(self, at: Mapping[str, ca.SX]) -> ca.SX:
        """Return h."""
        return ca.fabs(at["r"]) - self.bound

    def reach(self, side: Mapping[str, float]) -> float:
        """Return by how much h may rise."""
        return side.get("r", 0.0)

    def edges(self, psi: Array) -> list[tuple[Array, int]]:
        """Return what the yaw rate must not pass."""
        return [(np.full(len(psi), s * self.bound), s) for s in (1, -1)]

    @classmethod
    def of(cls, limits: TrialLimits, trial: LimitedTrial) -> Sequence[Limit]:
        """Return the cap of a ship that turns."""
        return super().of(limits, trial) if "r" in trial.states else []


ENTRY = YawRateCap
