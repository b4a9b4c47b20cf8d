"""Speeds that stay away from zero: ``--margin-u``, ``--margin-v`` (A10), ``--margin-air`` (A15)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from experiment_design.constraints.limits import (
    Circumstances,
    Limit,
    LimitedTrial,
    PathLimit,
    TrialLimits,
    rounded_up,
)
from greybox.channels import MOTION_WORDS
from greybox.errors import UsageError
from greybox.rotation import ned_to_body

Array = NDArray[np.float64]


class FromZero(PathLimit):
    """A speed that stays away from zero."""

    of_regime = True
    # what else helps where it cannot be kept
    otherwise = "choose another --regime"

    def eased(self, limits: TrialLimits, more: float) -> tuple[TrialLimits, str]:
        """Return limits with a lower margin."""
        value = max(0.0, float(np.floor(1e3 * (self.bound - more)) / 1e3))
        return self.with_bound(limits, value), f"Use {self.option} {value:g}"

    def advice(self, amount: float, circumstances: Circumstances) -> str:
        """Return which margin is within reach instead."""
        unit = f" {self.unit}"
        reached = self.bound - rounded_up(amount)
        said = f"the {self.words}, {self.bound:g}{unit}, cannot be kept: "
        if reached >= 0:
            lower = circumstances.lower or f"{self.option} {0.9 * reached:.3f}"
            said += (
                f"{reached:.3f}{unit} is the most that was reached. Use {lower}, widen the limits "
                f"of the thrusters, or {self.otherwise}."
            )
        else:
            said += (
                f"the sign changes by {-reached:.3f}{unit} in every sequence that was tried. "
                f"Choose another --regime or widen the limits of the thrusters."
            )
        if circumstances.current:
            said += (
                f" Margins are kept through the water too, and a current of "
                f"{circumstances.current:.2g} m/s is expected."
            )
        return said


@dataclass(frozen=True)
class Margin(FromZero):
    """A state that keeps its sign over ground, through the water and, where it matters, the air.

    Parameters
    ----------
    state : str
    sign : int
    streams : tuple of (float, float)
        North and east of the water and the air that move [m/s] (5.7).
    """

    state: str
    sign: int
    streams: tuple[tuple[float, float], ...] = ()
    name = "margin"
    order = 0
    field = "margins"

    @property
    def words(self) -> str:
        """The limit in words."""
        return f"margin of {MOTION_WORDS.get(self.state, self.state)}"

    @property
    def unit(self) -> str:
        """Unit of the bound."""
        return "rad/s" if self.state == "r" else "m/s"

    @property
    def option(self) -> str:
        """Option that sets it."""
        return f"--margin-{self.state}"

    @property
    def signal(self) -> str:
        """The state."""
        return self.state

    def value(self, at: Mapping[str, ca.SX]) -> ca.SX:
        """Return h."""
        least = at[self.state] * self.sign
        for north, east in self.streams:
            moved = ned_to_body(ca.SX(north), ca.SX(east), at["psi"])[self.state == "v"]
            least = ca.fmin(least, (at[self.state] - moved) * self.sign)
        return self.bound - least

    def reach(self, side: Mapping[str, float]) -> float:
        """Return by how much h may rise."""
        return side[self.state] if self.state in side else super().reach(side)

    def edges(self, psi: Array) -> list[tuple[Array, int]]:
        """Return what the state must not pass."""
        moved = [ned_to_body(n, e, psi)[self.state == "v"] for n, e in self.streams]
        edge = self.bound + np.max([0.0 * psi, *[self.sign * m for m in moved]], axis=0)
        return [(self.sign * edge, -self.sign)]

    def with_bound(self, limits: TrialLimits, bound: float) -> TrialLimits:
        """Return limits with another margin of this state."""
        return replace(limits, margins=dict(limits.margins) | {self.state: bound})

    @classmethod
    def of(cls, limits: TrialLimits, trial: LimitedTrial) -> Sequence[Limit]:
        """Return one margin for each sign that is kept."""
        pairs = ((trial.d[:2], True), (trial.d[2:], trial.wind_matters))
        streams = tuple((float(p[0]), float(p[1])) for p, matters in pairs if matters and np.any(p))
        return [
            cls(limits.margins.get(n, 0.0), n, sign, streams if n in ("u", "v") else ())
            for n, sign in limits.signs.items()
        ]

    @classmethod
    def check(cls, limits: TrialLimits) -> None:
        """Refuse what cannot be asked for."""
        for name, value in limits.margins.items():
            if not 0 <= value < np.inf:
                raise UsageError(f"the margin of {name} is {value:g} m/s, it must be 0 or more.")


@dataclass(frozen=True)
class AirMargin(FromZero):
    """A component of the velocity through the air, of either sign.

    Parameters
    ----------
    state : {"u", "v"}
    wind : (float, float)
        North and east [m/s].
    """

    state: str
    wind: tuple[float, float]
    name = "margin through the air"
    order = 1
    field = "margin_air"
    option = "--margin-air"
    unit = "m/s"
    signal = ""
    otherwise = "start on another heading (--start)"

    @property
    def words(self) -> str:
        """The limit in words."""
        return f"margin of {MOTION_WORDS[self.state]} through the air"

    def value(self, at: Mapping[str, ca.SX]) -> ca.SX:
        """Return h."""
        north, east = self.wind
        blown = ned_to_body(ca.SX(north), ca.SX(east), at["psi"])[self.state == "v"]
        return self.bound - ca.fabs(at[self.state] - blown)

    @classmethod
    def of(cls, limits: TrialLimits, trial: LimitedTrial) -> Sequence[Limit]:
        """Return one margin for each component."""
        if limits.margin_air is None:
            return []
        wind = (float(trial.d[2]), float(trial.d[3]))
        return [cls(limits.margin_air, n, wind) for n in ("u", "v") if n in trial.states]

    @classmethod
    def check(cls, limits: TrialLimits) -> None:
        """Refuse what cannot be asked for."""
        if limits.margin_air is not None and not 0 <= limits.margin_air < np.inf:
            raise UsageError(
                f"the margin of the velocity through the air is {limits.margin_air:g} m/s, it must "
                f"be 0 or more."
            )


ENTRIES = (Margin, AirMargin)
