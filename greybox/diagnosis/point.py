"""A hypothesis with values, and where a fit of it ended."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.hypothesis import Hypothesis
from greybox.diagnosis.noise import Noise
from greybox.diagnosis.ship import Ship
from greybox.model.run.step import Integrator

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Point:
    """A hypothesis with values.

    Parameters
    ----------
    base : Ship
        Coefficients, currents and the vessel before the hypotheses with `apply`.
    starts : tuple of ndarray
        Start of each log.
    places : tuple of int
        Free coefficients and currents.
    hypotheses : tuple of Hypothesis
        In force; those with columns have them among `places`.
    values : tuple of ndarray
        Of the hypotheses with `apply`, empty for the others.
    """

    base: Ship
    starts: tuple[Array, ...]
    places: tuple[int, ...]
    hypotheses: tuple[Hypothesis, ...] = ()
    values: tuple[Array, ...] = ()

    @cached_property
    def ship(self) -> Ship:
        """The ship with every hypothesis applied."""
        ship = self.base
        for hypothesis, value in zip(self.hypotheses, self.values, strict=True):
            if hypothesis.apply is not None:
                ship = hypothesis.apply(ship, value)
        return ship

    def vector(self) -> Array:
        """Return all free numbers: coefficients, then the hypotheses' values, then starts."""
        full = np.concatenate([self.base.theta, self.base.current])
        return np.concatenate([full[list(self.places)], *self.values, *self.starts])

    def alike(self, other: Point) -> bool:
        """Whether another point has the same free numbers, and all that is not free the same."""
        mine, its = self.base, other.base
        held = np.ones(len(mine.theta) + len(mine.current), bool)
        held[list(self.places)] = False
        one, two = (np.concatenate([ship.theta, ship.current])[held] for ship in (mine, its))
        return (
            self.places == other.places
            and [h.key for h in self.hypotheses] == [h.key for h in other.hypotheses]
            and list(map(len, self.values)) == list(map(len, other.values))
            and list(map(len, self.starts)) == list(map(len, other.starts))
            and np.array_equal(one, two)
            and mine.vessel == its.vessel
            and (mine.changes, mine.sensors, mine.wires) == (its.changes, its.sensors, its.wires)
        )

    def at(self, vector: Array) -> Point:
        """Return the point with other free numbers."""
        m = len(self.places)
        full = np.concatenate([self.base.theta, self.base.current])
        full[list(self.places)] = vector[:m]
        p = len(self.base.theta)
        base = replace(self.base, theta=full[:p], current=full[p:])
        values, starts = [], []
        for old in self.values:
            values.append(vector[m : m + len(old)])
            m += len(old)
        for old in self.starts:
            starts.append(vector[m : m + len(old)])
            m += len(old)
        return replace(self, base=base, values=tuple(values), starts=tuple(starts))


@dataclass(frozen=True)
class Fit:
    """Where a fit ended.

    Parameters
    ----------
    point : Point
    noise : Noise
        Colours that the errors were whitened with.
    cost : float
        −2 log L, constants apart.
    nu : tuple of ndarray
        (N, ny) innovations of each log, of unit variance.
    errors : tuple of ndarray
        (N, ny) measured less simulated.
    converged : bool
    integrator : {"euler", "rk4"}
    known : tuple of ndarray
        (N, ny) where each output of each log was measured.
    """

    point: Point
    noise: Noise
    cost: float
    nu: tuple[Array, ...]
    errors: tuple[Array, ...]
    converged: bool
    integrator: Integrator
    known: tuple[NDArray[np.bool_], ...]

    def in_sensors(self, noise: Noise | None = None) -> tuple[Array, NDArray[np.int_]]:
        """Return the states' squared errors in their sensors' variances, and how many they are.

        Parameters
        ----------
        noise : Noise, optional
            Whose sensors; by default those of the fit.

        Returns
        -------
        tuple of ndarray
            (groups,) each: of a group of channels the first is a state; a heading beside the yaw
            rate drifts by itself.
        """
        groups = (self.noise if noise is None else noise).groups
        places = [group.outputs[0] for group in groups]
        sizes = np.maximum([group.sensor[0] for group in groups], 1e-300)
        errors, known = (np.concatenate(x)[:, places] for x in (self.errors, self.known))
        return ((errors / sizes) ** 2).sum(axis=0, where=known), known.sum(axis=0)

    @property
    def escaped(self) -> bool:
        """Whether the run has no bound."""
        return not np.isfinite(self.cost)
