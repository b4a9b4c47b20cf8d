"""Fleets as `greybox fleet` finds them, without logs behind them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from greybox.fleet.fleet import ClassModel, Fleet, ShipEstimate, pool_ships
from greybox.fleet.ships import LeftOut
from greybox.model.catalogue import get_structure
from greybox.model.terms import parameter_unit
from greybox.study.fleets import plant_fleet

MODEL = ClassModel("iv", "wind", "thesis", 1.0, ("ship 1",), ("ship 1", "ship 4"))


def planted(ships=6, periods=8, *, odd=0.0, change=0.0, left_out=()) -> Fleet:
    """A fleet of the thesis's ship; ship 1 may differ in one coefficient, Nr of ship 2 change."""
    found = plant_fleet(3, ships, 0.5, odd)
    structure = get_structure("thesis")
    units = tuple(parameter_unit(t) for t in structure.terms)
    rng = np.random.default_rng(7)
    estimates = []
    for i in range(ships):
        covariance = found.covariances[i]
        noise = rng.multivariate_normal(np.zeros(18), 4 * covariance, periods)
        times = np.arange(1.0, periods + 1)
        own = found.theta[i] + noise
        if i == 1:
            own[:, structure.parameters.index("Nr")] += change * times
        estimates.append(
            ShipEstimate(
                f"ship {i + 1}", structure.parameters, units, found.estimates[i], covariance,
                {"u": 80.0, "v": 70.0, "r": 60.0}, periods, times, False, own,
                np.broadcast_to(4 * covariance, (periods, 18, 18)), (),
            )
        )  # fmt: skip
    return pool_ships("ferries", MODEL, estimates, [LeftOut(*one) for one in left_out])


def renamed(fleet: Fleet, names) -> Fleet:
    """The same fleet with other names of its ships."""
    ships = tuple(replace(s, name=n) for s, n in zip(fleet.ships, names, strict=True))
    return replace(fleet, ships=ships)
