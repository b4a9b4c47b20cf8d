"""Parameters that change during a log: a trim, a growth or damage from some moment on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import ceil, isfinite

import numpy as np
from numpy.typing import NDArray

from greybox.errors import StructureError
from greybox.model.run.simulation import FreeRun, simulate
from greybox.model.run.step import Integrator
from greybox.model.structure import Structure

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


def factors_at(changes: Sequence[Change], names: Sequence[str], time: float) -> Array:
    """Return what each parameter is multiplied by at a time [s], (p,)."""
    found = np.ones(len(names))
    for change in sorted(changes, key=lambda c: c.time):
        if change.time <= time:
            found[list(names).index(change.parameter)] = change.factor
    return found


def simulate_changing(
    structure: Structure,
    theta: Array,
    changes: Sequence[Change],
    x0: Array,
    tau: Array,
    sample_time: float,
    *,
    first: float = 0.0,
    psi: Array | None = None,
    psi0: Array | float = 0.0,
    d: Array | None = None,
    air: Array | None = None,
    process_noise: Array | None = None,
    integrator: Integrator = "euler",
    bound: Array | None = None,
) -> FreeRun:
    """Run freely with parameters that change on the way.

    Parameters are those of `simulate`; the run is made of pieces, each of which
    starts where the one before ended. A change acts from the first sample that
    is not before it.

    Parameters
    ----------
    changes : sequence of Change
        Of parameters of the structure.
    first : float
        Time of the first sample on the clock of the changes [s].

    Returns
    -------
    FreeRun
    """
    samples = np.shape(tau)[-2]
    # a time that is a whole number of samples may lie a rounding error beyond it
    starts = {ceil((c.time - first) / sample_time - 1e-6) for c in changes}
    edges = [0, *sorted(k for k in starts if 0 < k < samples), samples]
    x: list[Array] = []
    angle: list[Array] = []
    diverged: NDArray[np.int64] | None = None
    for a, b in pairwise(edges):
        now = factors_at(changes, structure.parameters, first + (a + 1e-6) * sample_time)
        run = simulate(
            structure, theta * now, x0, np.asarray(tau)[..., a:b, :], sample_time,
            psi=None if psi is None else np.asarray(psi)[..., a : b + 1],
            psi0=psi0,
            d=None if d is None else _rows(d, a, b),
            air=None if air is None else _rows(air, a, b),
            process_noise=None if process_noise is None else _rows(process_noise, a, b),
            integrator=integrator,
            bound=bound,
        )  # fmt: skip
        with np.errstate(invalid="ignore"):
            x0, psi0 = run.x[:, -1], run.psi[:, -1]
        x.append(run.x[:, 1:] if x else run.x)
        angle.append(run.psi[:, 1:] if angle else run.psi)
        later = np.where(run.diverged >= 0, run.diverged + a, -1)
        diverged = later if diverged is None else np.where(diverged >= 0, diverged, later)
    assert diverged is not None
    return FreeRun(np.concatenate(x, axis=1), np.concatenate(angle, axis=1), diverged, run.bound)


def _rows(series: Array, a: int, b: int) -> Array:
    """Return samples of a series; a constant (n,) or (R, 1, n) has none to choose."""
    series = np.asarray(series, float)
    if series.ndim < 2 or series.shape[-2] == 1:
        return series
    return series[..., a:b, :]
