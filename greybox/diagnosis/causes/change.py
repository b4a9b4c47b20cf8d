"""Coefficients that change while the log runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.causes.cause import Cause, Context
from greybox.diagnosis.hypothesis import Hypothesis, Parameter
from greybox.diagnosis.ship import Change, Ship
from greybox.notebook import with_error

Array = NDArray[np.float64]

# the change lies between these shares of the log, and multiplies by less
_EARLIEST, _LATEST = 0.05, 0.95
_FACTORS = (0.05, 20.0)
# distance of the moments that are tried first, as a share of the log
_REACH = 0.05


class ParameterChange(Cause):
    """One coefficient takes another value from some moment on."""

    id = "parameter_change"
    kind = "change"
    title = "coefficient that changes during the log"
    signature = "the model fits up to some moment and errs from then on, or the reverse"
    extension = "the coefficient with its value before and after that moment"
    reference = "Andrews (1993)"

    def hypotheses(self, context: Context) -> Sequence[Hypothesis]:
        """Return one hypothesis per coefficient; a scan finds the time."""
        out = []
        for i, term in enumerate(context.structure.terms):

            def apply(ship: Ship, value: Array, i: int = i) -> Ship:
                change = Change(i, float(value[0]), float(value[1]))
                return replace(ship, changes=(*ship.changes, change))

            parameters = (
                Parameter(f"{term.name}_factor", "1", 1.0, *_FACTORS, 1.0),
                Parameter(
                    f"{term.name}_time", "s", 0.5 * context.duration,
                    _EARLIEST * context.duration, _LATEST * context.duration,
                    step=0.5 * context.sample_time, coarse=0.5 * context.sample_time,
                    reach=_REACH * context.duration,
                ),
            )  # fmt: skip
            out.append(
                Hypothesis(
                    self.id, f"{self.id}:{term.name}", parameters, (), apply, multiplied=term.name
                )
            )  # fmt: skip
        return out

    def evidence(self, values: Mapping[str, tuple[float, float]]) -> str:
        """Say which, when and how much."""
        (name, (factor, _)), (_, (time, std)), *rest = values.items()
        by = "".join(f"changes by {with_error(*change)}, and " for _, change in rest)
        return (
            f"{name.removesuffix('_factor')} {by}is {factor:.2f} times its value from {time:.0f} ± "
            f"{max(std, 1):.0f} s on"
        )
