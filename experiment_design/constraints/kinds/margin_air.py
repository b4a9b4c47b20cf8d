"""Velocity through the air that stays away from zero, of either sign: ``--margin-air`` (A15)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from experiment_design.constraints.kinds.margin import WORDS, FromZero
from experiment_design.constraints.limits import Limit, LimitedTrial, TrialLimits
from greybox.errors import UsageError
from greybox.rotation import ned_to_body


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
        return f"margin of {WORDS[self.state]} through the air"

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


ENTRY = AirMargin
