"""A measured value with its standard error."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from scipy import special

Unit = Literal["m", "s", "m/s", "rad", "rad/s", "1"]

_SHOWN: dict[str, tuple[str, float]] = {
    "rad": ("deg", 180 / math.pi),
    "rad/s": ("deg/s", 180 / math.pi),
    "1": ("", 1.0),
}


@dataclass(frozen=True)
class Quantity:
    """One measured quantity.

    Parameters
    ----------
    value : float
        [SI, rad]
    std : float
        Standard error, in the unit of `value`.
    unit : {"m", "s", "m/s", "rad", "rad/s", "1"}
    dof : float
        Degrees of freedom behind `std`; infinite where it is known.
    """

    value: float
    std: float
    unit: Unit
    dof: float = math.inf

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval, by Student's t at `dof`."""
        factor = 1.959964 if math.isinf(self.dof) else float(special.stdtrit(self.dof, 0.975))
        return self.value - factor * self.std, self.value + factor * self.std

    def scaled(self, factor: float, unit: Unit) -> Quantity:
        """Return the quantity times a constant, such as in ship lengths."""
        return Quantity(self.value * factor, self.std * abs(factor), unit, self.dof)

    def text(self, length: float | None = None) -> str:
        """Return the value and its interval in words: degrees, and ship lengths where given."""
        shown, interval = self.words(length)
        return f"{shown} (95 %: {interval})"

    def words(self, length: float | None = None) -> tuple[str, str]:
        """Return the value in words, and its interval."""
        unit, factor = _SHOWN.get(self.unit, (self.unit, 1.0))
        low, high = (b * factor for b in self.interval)
        digits = _decimals(high - low, abs(self.value * factor))
        shown = f"{self.value * factor:z.{digits}f} {unit}".rstrip()
        if length is not None and self.unit == "m":
            shown = f"{self.value / length:.2f} L = {shown}"
        return shown, f"{low:z.{digits}f} to {high:z.{digits}f}"


def _decimals(width: float, size: float) -> int:
    """Return decimals that show two digits of the interval's width, four of the value at most."""
    finest = 3 - math.floor(math.log10(size)) if size > 0 else 3
    if not width > 0 or not math.isfinite(width):
        return max(0, min(finest, 6))
    return max(0, min(1 - math.floor(math.log10(width)), finest, 6))
