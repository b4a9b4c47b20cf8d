"""Speeds that have a largest value: ``--speed-cap``, ``--yaw-cap``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from experiment_design.constraints.limits import (
    Limit,
    LimitedTrial,
    PathLimit,
    TrialLimits,
)
from greybox.errors import UsageError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SpeedCap(PathLimit):
    """The largest speed over ground [m/s]."""

    name = "speed cap"
    order = 2
    field = "speed_cap"
    option = "--speed-cap"
    unit = "m/s"
    signal = "speed"

    def value(self, at: Mapping[str, ca.SX]) -> ca.SX:
        """Return h."""
        # the root has no slope at rest
        return ca.sqrt(at["u"] ** 2 + at.get("v", ca.SX(0)) ** 2 + 1e-12) - self.bound

    def edges(self, psi: Array) -> list[tuple[Array, int]]:
        """Return what the speed must not pass."""
        return [(np.full(len(psi), self.bound), 1)]

    @classmethod
    def check(cls, limits: TrialLimits) -> None:
        """Refuse a cap below the margins."""
        super().check(limits)
        u, v = (limits.margins.get(s, 0.0) for s in ("u", "v"))
        floor = float(np.hypot(u * ("u" in limits.signs), v * ("v" in limits.signs)))
        if limits.speed_cap is not None and limits.speed_cap <= floor:
            raise UsageError(
                f"the limits contradict: margins of {u:g} and {v:g} m/s in surge and sway need a "
                f"speed of at least {floor:.3g} m/s, the cap is {limits.speed_cap:g} m/s. Raise "
                f"the cap above {floor:.3g}, or lower the margins."
            )


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


ENTRIES = (SpeedCap, YawRateCap)
