"""Parameters that change during a log: a trim, a growth or damage from some moment on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import ceil, isfinite

import numpy as np
from numpy.typing import NDArray

from greybox.errors import StructureError, suggestion

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Change:
    """From a moment on, a parameter is so many times its value.

    Parameters
    ----------
    parameter : str
    factor : float
        Of the model's value; the latest change of a parameter holds.
    time : float
        From the first sample of the log [s].

    Raises
    ------
    StructureError
        Factor or time is not finite.
    """

    parameter: str
    factor: float
    time: float

    def __post_init__(self) -> None:
        for name, value in (("factor", self.factor), ("time", self.time)):
            if not isfinite(value):
                raise StructureError(
                    f"the change of {self.parameter} has the {name} {value}, a finite number is "
                    f"needed: correct it."
                )

    @property
    def sentence(self) -> str:
        """The change in words."""
        return f"{self.parameter} is {self.factor:g} times its value from {self.time:g} s on"


def require_parameters(changes: Sequence[Change], names: Sequence[str], structure: str) -> None:
    """Raise `StructureError` where a change is of no parameter of a structure."""
    for change in changes:
        if change.parameter not in names:
            raise StructureError(
                f"a change is of '{change.parameter}', which is no parameter of structure "
                f"'{structure}'.{suggestion(change.parameter, names)} It has: {', '.join(names)}."
            )


def factors_at(changes: Sequence[Change], names: Sequence[str], time: float) -> Array:
    """Return what each parameter is multiplied by at a time [s], (p,)."""
    found = np.ones(len(names))
    for change in sorted(changes, key=lambda c: c.time):
        if change.time <= time:
            found[list(names).index(change.parameter)] = change.factor
    return found


def pieces(
    changes: Sequence[Change],
    names: Sequence[str],
    samples: int,
    sample_time: float,
    first: float,
) -> Iterator[tuple[int, int, Array]]:
    """Yield from where to where no parameter changes, and what each is multiplied by there, (p,).

    A change acts from the first sample that is not before it.

    Parameters
    ----------
    changes : sequence of Change
    names : sequence of str
        All parameters.
    samples : int
    sample_time : float
        [s]
    first : float
        Time of the first sample on the clock of the changes [s].
    """
    # a time that is a whole number of samples may lie a rounding error beyond it
    starts = {ceil((c.time - first) / sample_time - 1e-6) for c in changes}
    edges = sorted({0, samples, *(k for k in starts if 0 < k < samples)})
    for a, b in pairwise(edges):
        yield a, b, factors_at(changes, names, first + (a + 1e-6) * sample_time)
