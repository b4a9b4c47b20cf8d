"""Planted fleets: pooling helps, and the odd ship is found; see `benchmarks/fleet.py`."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.study.fleets import ODD, plant_fleet, study_fleets


def test_a_planted_fleet_has_the_spread_and_the_odd_ship_that_it_says():
    plain, odd = plant_fleet(1, 200, 2.0), plant_fleet(1, 200, 2.0, deviation=ODD)
    spread = (plain.theta - plain.mean).std(axis=0) / plain.error
    # variances are those of χ² with two degrees of freedom about 4
    assert 1.0 < np.sqrt(np.mean(spread**2)) < 4.0
    moved = np.flatnonzero(np.any(odd.theta != plain.theta, axis=0))
    assert odd.odd in moved
    own = np.sqrt(np.diagonal(plain.covariances, axis1=1, axis2=2)) / plain.error
    assert own.min() > 0.69
    assert own.max() < 1.41


@pytest.mark.long
@pytest.mark.parametrize("spread", [0.0, 1.0])
def test_pooling_is_no_worse_and_the_odd_ship_is_found(spread):
    """Of 40 fleets of ten ships: 90 % are 36, and 31 or fewer come by chance in 1 % of cases."""
    (cell,) = study_fleets(40, ships=[10], spreads=[spread])
    separate, complete, partial = cell.rmse()
    assert partial < separate
    # where there is no spread at all nothing beats taking all ships as one, and looking for a
    # spread costs a tenth of a ship's standard error at most
    assert partial < complete + 0.1
    # 5 % are 2, and 7 or more come by chance in 0.3 % of cases
    assert sum(o.false for o in cell.outcomes) < 7
    assert sum(o.found for o in cell.outcomes) > 31
