"""The largest speed over ground: ``--speed-cap``."""

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
class SpeedCap(PathLimit):
    """The largest speed over ground [m/s]."""

    name = "speed cap"
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


def _of(limits: TrialLimits, trial: LimitedTrial) -> Sequence[SpeedCap]:
    return [] if limits.speed_cap is None else [SpeedCap(limits.speed_cap)]


def _check(limits: TrialLimits) -> None:
    cap = limits.speed_cap
    if cap is None:
        return
    if not 0 < cap < np.inf:
        raise UsageError(f"the speed cap is {cap:g}, it must be positive.")
    u, v = (limits.margins.get(s, 0.0) for s in ("u", "v"))
    floor = float(np.hypot(u * ("u" in limits.signs), v * ("v" in limits.signs)))
    if cap <= floor:
        raise UsageError(
            f"the limits contradict: margins of {u:g} and {v:g} m/s in surge and sway need a speed "
            f"of at least {floor:.3g} m/s, the cap is {cap:g} m/s. Raise the cap above "
            f"{floor:.3g}, or lower the margins."
        )


ENTRY = LimitKind("speed cap", 2, _of, _check)
