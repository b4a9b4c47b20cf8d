"""A predicted quantity: its value for the estimate, its interval from draws."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from greybox.trial.manoeuvres.quantity import Quantity, Unit

LEVEL = 0.95
# share of the draws that must reach a quantity, for an interval to bound it
LEAST = 1 - (1 - LEVEL) / 2


@dataclass(frozen=True)
class MonteCarloQuantity(Quantity):
    """A quantity whose interval is that of draws.

    Parameters
    ----------
    low, high : float
        Quantiles of 2.5 and 97.5 % of the draws that reach the quantity.
    reached : int
        How many of them do.
    draws : int
        Of how many.
    """

    low: float = math.nan
    high: float = math.nan
    reached: int = 0
    draws: int = 0

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval."""
        return self.low, self.high

    @property
    def certain(self) -> bool:
        """Whether enough draws reach the quantity for its interval to bound it."""
        return self.reached >= LEAST * self.draws

    def scaled(self, factor: float, unit: Unit) -> MonteCarloQuantity:
        """Return the quantity times a constant, such as in ship lengths."""
        ends = sorted((self.low * factor, self.high * factor))
        return MonteCarloQuantity(
            self.value * factor,
            self.std * abs(factor),
            unit,
            self.dof,
            ends[0],
            ends[1],
            self.reached,
            self.draws,
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        return {
            "value": self.value,
            "ci": list(self.interval),
            "unit": self.unit,
            "draws": self.reached,
        }


def over_draws(
    value: Quantity | None, others: Sequence[Quantity | None]
) -> MonteCarloQuantity | None:
    """Return a quantity of the estimate with the interval of its draws.

    Parameters
    ----------
    value : Quantity or None
        None where the estimate itself does not reach it: so does the result.
    others : sequence of Quantity or None
        Of the draws.
    """
    if value is None:
        return None
    found = np.array([q.value for q in others if q is not None])
    if len(found) < 2:
        return MonteCarloQuantity(value.value, math.inf, value.unit, math.inf, -math.inf, math.inf,
                     len(found), len(others))  # fmt: skip
    tail = (1 - LEVEL) / 2
    low, high = np.quantile(found, [tail, 1 - tail], method="weibull")
    return MonteCarloQuantity(
        value.value,
        float(found.std(ddof=1)),
        value.unit,
        math.inf,
        float(low),
        float(high),
        len(found),
        len(others),
    )
