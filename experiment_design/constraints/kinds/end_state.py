"""Where a trial ends: ``--end``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

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
                    f"the end state {name} = {value:g} has the tolerance {tolerance:g}, it must be "
                    f"positive: write --end {name}=VALUE:TOLERANCE."
                )
            shift = dict(zip(("x_n", "y_n"), limits.position, strict=True)).get(name, 0.0)
            place = trial.signals.index(name)
            found.append(cls(tolerance, name, value, place, value - shift))
        return found


ENTRY = EndState
