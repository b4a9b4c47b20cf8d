"""Thrust laws: how the force of a propeller depends on its speed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from typing import Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from greybox.errors import VesselError


@dataclass(frozen=True)
class ThrustLaw:
    """Force of one thruster at bollard condition as a function of its speed.

    Parameters
    ----------
    kind : {"linear", "quadratic", "table"}
        Force proportional to n; to n|n|; or interpolated between bollard points.
    table : tuple of (float, float)
        Speed and force [N] of the bollard points, speed increasing. Points with
        zero force make a dead band; the ends are extended by their last slope.
    quadratic_share : float
        Share s of a linear law that goes with n|n|: (1 − s) n + s n|n|/reference.
    reference : float
        Speed at which both parts are equal, in the unit of the speed.
    """

    kind: Literal["linear", "quadratic", "table"] = "linear"
    table: tuple[tuple[float, float], ...] = ()
    quadratic_share: float = 0.0
    reference: float = 1.0

    def __post_init__(self) -> None:
        if not 0 <= self.quadratic_share <= 1:
            raise VesselError(
                f"quadratic_share is {self.quadratic_share:g}, it must be within 0 (force ~ n) "
                f"and 1 (force ~ n|n|): correct it."
            )
        if not 0 < self.reference < inf:
            raise VesselError(
                f"the reference speed of a quadratic share is {self.reference:g}, it must be "
                f"positive: give a usual speed of the propeller."
            )
        if self.kind != "linear" and (self.quadratic_share, self.reference) != (0, 1):
            raise VesselError(
                f"a {self.kind} thrust law has quadratic_share = {self.quadratic_share:g} and "
                f"reference = {self.reference:g}, which only a linear law can have: remove them."
            )
        if self.kind != "table":
            return
        if len(self.table) < 2:
            raise VesselError(
                f"a bollard table has {len(self.table)} point, at least 2 are needed: "
                f"add [speed, force] pairs."
            )
        for (n0, _), (n1, _) in zip(self.table, self.table[1:], strict=False):
            if n1 <= n0:
                raise VesselError(
                    f"in a bollard table the speed goes from {n0:g} to {n1:g}: "
                    f"list the points with increasing speed."
                )

    @property
    def unit(self) -> str:
        """Unit of the force: N for a table, else that of the speed itself."""
        return {"linear": "n", "quadratic": "n²", "table": "N"}[self.kind]

    @property
    def shares(self) -> tuple[float, float]:
        """What of the force goes with n, and what with n|n|, where the law is no table."""
        if self.kind == "quadratic":
            return 0.0, 1.0
        return 1 - self.quadratic_share, self.quadratic_share / self.reference

    @property
    def plain(self) -> ThrustLaw:
        """The law without the shares."""
        return ThrustLaw() if self.kind == "linear" else self

    def force(self, speed: ca.SX) -> ca.SX:
        """Return the force as an expression of the speed.

        A table becomes a sum of hinges, so the expression stays one branch-free
        formula that can be differentiated and designed with.
        """
        if self.kind == "linear":
            straight, squared = self.shares
            return straight * speed + squared * speed * ca.fabs(speed) if squared else speed
        if self.kind == "quadratic":
            return speed * ca.fabs(speed)
        slopes = [
            (f1 - f0) / (n1 - n0)
            for (n0, f0), (n1, f1) in zip(self.table, self.table[1:], strict=False)
        ]
        force = self.table[0][1] + slopes[0] * (speed - self.table[0][0])
        for (n, _), before, after in zip(self.table[1:-1], slopes, slopes[1:], strict=False):
            if after != before:
                force = force + (after - before) * ca.fmax(speed - n, 0)
        return force


def typical_speed(logged: Sequence[NDArray[np.float64]]) -> float:
    """Return the root mean square of a propeller's speed in several logs, each (N,).

    A propeller that idles for most of a log turns slowly there, and at no typical speed: a median
    would be that of idling.
    """
    return float(np.sqrt(np.mean(np.concatenate(logged) ** 2)))
