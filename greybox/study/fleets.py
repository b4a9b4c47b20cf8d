"""Planted fleets: whether pooling helps, and whether the odd ship is found.

Coefficients of each ship are drawn about those of the thesis's Table 6.1, estimates about them with
covariances of their own, correlated within each equation as those of trials are. Nothing is shared
with the pooling that is judged but for the model itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.fleet.differing import compare_units
from greybox.fleet.pooling import pool
from greybox.model.catalogue import get_structure
from greybox.numerics.binomial import wilson_interval
from greybox.numerics.parallel import map_pieces
from greybox.study.chapter6 import TRUE

Array = NDArray[np.float64]

# standard error of a coefficient beside its value, as 10 trials of 20 min give
ERROR = 0.1
# spread between ships beside the standard error of one: none, as much, and three times as much
SPREADS = (0.0, 0.5, 1.0, 3.0)
SHIPS = (5, 10, 20)
# by how many standard deviations of a coefficient (error and spread) the odd ship differs
ODD = 10.0
# directions beside its own that the errors of an equation's coefficients share
_SHARED = 2


@dataclass(frozen=True)
class Planted:
    """A fleet whose truth is known.

    Parameters
    ----------
    theta, estimates : ndarray
        (k, p)
    covariances : ndarray
        (k, p, p)
    mean, error : ndarray
        (p,) of the class, and the usual standard error.
    odd : int
        Coefficient in which ship 0 differs, -1 where it does not.
    """

    theta: Array
    estimates: Array
    covariances: Array
    mean: Array
    error: Array
    odd: int


def plant_fleet(seed: int, ships: int, spread: float, deviation: float = 0.0) -> Planted:
    """Draw a fleet.

    Parameters
    ----------
    seed : int
    ships : int
    spread : float
        Between ships, in standard errors of one; each coefficient has its own about it.
    deviation : float
        By how many standard deviations ship 0 differs in one coefficient.
    """
    rng = np.random.default_rng([2024, seed, ships, round(10 * spread)])
    structure = get_structure("thesis")
    mean = np.array([TRUE[n] for n in structure.parameters])
    error = ERROR * np.abs(mean)
    size = len(mean)
    equations = [t.state for t in structure.terms]
    together = np.array([[a == b for b in equations] for a in equations])
    covariances = np.empty((ships, size, size))
    for i in range(ships):
        shared = rng.standard_normal((size, _SHARED))
        unit = (np.eye(size) + shared @ shared.T) * together
        deviations = np.sqrt(np.diag(unit))
        own = error * rng.uniform(0.7, 1.4)
        covariances[i] = unit / np.outer(deviations, deviations) * np.outer(own, own)
    between = spread * error * np.sqrt(rng.chisquare(2, size) / 2)
    theta = mean + between * rng.standard_normal((ships, size))
    odd = -1
    if deviation:
        odd = int(rng.integers(size))
        std = np.hypot(between[odd], np.sqrt(covariances[0, odd, odd]))
        theta[0, odd] += deviation * std * rng.choice([-1.0, 1.0])
    noise = np.array([rng.multivariate_normal(np.zeros(size), c) for c in covariances])
    return Planted(theta, theta + noise, covariances, mean, error, odd)


@dataclass(frozen=True)
class FleetOutcome:
    """What was found of one planted fleet, and of the same with an odd ship.

    Parameters
    ----------
    squared : tuple of float
        Mean squared error in standard errors: separate, complete and partial pooling.
    held : float
        Share of the ships' coefficients within their 95 % intervals.
    false, found, named : bool
        Whether a ship of a fleet without an odd one was said to differ; whether the odd one was
        found; whether its coefficient was named first.
    also : bool
        Whether another ship was said to differ beside the odd one.
    """

    squared: tuple[float, float, float]
    held: float
    false: bool
    found: bool
    named: bool
    also: bool


@dataclass(frozen=True)
class FleetCell:
    """All outcomes of fleets of one size and spread."""

    ships: int
    spread: float
    outcomes: tuple[FleetOutcome, ...]

    def rmse(self) -> tuple[float, ...]:
        """Return the root mean squared errors: separate, complete, partial pooling."""
        return tuple(np.sqrt(np.mean([o.squared for o in self.outcomes], axis=0)))

    def gain(self, over: int) -> tuple[float, float]:
        """Return the 95 % interval of partial pooling's squared error less that of another.

        Parameters
        ----------
        over : int
            0 for separate, 1 for complete pooling.
        """
        less = np.array([o.squared[2] - o.squared[over] for o in self.outcomes])
        half = 1.96 * less.std(ddof=1) / np.sqrt(len(less))
        return float(less.mean() - half), float(less.mean() + half)

    def share(self, what: str) -> tuple[float, float, float]:
        """Return a share of the fleets with its 95 % interval, by the name of an outcome."""
        count = len(self.outcomes)
        value = float(np.mean([getattr(o, what) for o in self.outcomes]))
        return (value, *wilson_interval(value, count))


def judge_planted(piece: tuple[int, int, float, float]) -> FleetOutcome:
    """Return what is found of the fleet of a seed, a number of ships, a spread, a deviation."""
    plain = plant_fleet(*piece[:3])
    pooled = pool(plain.estimates, plain.covariances)
    weights = np.linalg.inv(plain.covariances)
    complete = np.linalg.solve(
        weights.sum(axis=0), np.einsum("kij,kj->i", weights, plain.estimates)
    )

    def squared(theta: Array) -> float:
        return float(np.mean(((theta - plain.theta) / plain.error) ** 2))

    odd = plant_fleet(*piece)
    compared = compare_units(odd.estimates, odd.covariances)
    first = compared[0].differences[:1]
    return FleetOutcome(
        (squared(plain.estimates), squared(complete), squared(pooled.theta)),
        float(np.mean(np.abs(pooled.theta - plain.theta) < 1.96 * pooled.theta_std)),
        any(c.differs for c in compare_units(plain.estimates, plain.covariances)),
        compared[0].differs,
        bool(first) and first[0].coefficient == odd.odd,
        any(c.differs for c in compared[1:]),
    )


def study_fleets(
    runs: int,
    *,
    ships: Sequence[int] = SHIPS,
    spreads: Sequence[float] = SPREADS,
    deviation: float = ODD,
    seed: int = 0,
) -> tuple[FleetCell, ...]:
    """Judge planted fleets of several sizes and spreads.

    Parameters
    ----------
    runs : int
        Fleets of each size and spread.
    ships : sequence of int
    spreads : sequence of float
        In standard errors of one ship.
    deviation : float
        Of the odd ship in one coefficient, in standard deviations of error and spread.
    seed : int
        Of the first; the others follow.
    """
    places = [(k, s) for k in ships for s in spreads]
    pieces = [(seed + run, k, s, deviation) for k, s in places for run in range(runs)]
    outcomes = list(map_pieces(judge_planted, pieces))
    return tuple(
        FleetCell(k, s, tuple(outcomes[i * runs : (i + 1) * runs]))
        for i, (k, s) in enumerate(places)
    )
