"""The largest rate of turn: ``--yaw-cap``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from experiment_design.constraints.limits import LimitedTrial, LimitKind, PathLimit, TrialLimits
from greybox.errors import UsageError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class YawRateCap(PathLimit):
    """The largest rate of turn to either side [rad/s]."""

    name = "yaw-rate cap"
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


def _of(limits: TrialLimits, trial: LimitedTrial) -> Sequence[YawRateCap]:
    known = limits.yaw_cap is not None and "r" in trial.states
    return [YawRateCap(float(limits.yaw_cap or 0.0))] if known else []


def _check(limits: TrialLimits) -> None:
    if limits.yaw_cap is not None and not 0 < limits.yaw_cap < np.inf:
        raise UsageError(f"the yaw-rate cap is {limits.yaw_cap:g}, it must be positive.")


ENTRY = LimitKind("yaw-rate cap", 3, _of, _check)
