"""Each unit against the others: calibrated, and what differs is named."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import t as student

from greybox.errors import UsageError
from greybox.fleet.differing import compare_units


def fleet(seed, ships=10, odd=0.0):
    """Estimates of four coefficients; ship 3 differs in the second by `odd` deviations."""
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((ships, 4, 4))
    covariances = 0.1 * (root @ root.transpose(0, 2, 1)) + 0.05 * np.eye(4)
    spread = np.array([0.0, 0.3, 0.5, 1.0])
    theta = spread * rng.standard_normal((ships, 4))
    theta[3, 1] += odd * np.sqrt(covariances[3, 1, 1] + spread[1] ** 2)
    noise = np.array([rng.multivariate_normal(np.zeros(4), c) for c in covariances])
    return theta + noise, covariances


def test_one_coefficient_without_errors_is_student_s_t():
    y = np.array([1.0, 2.0, 4.0, 3.5, 2.2, 9.0])
    found = compare_units(y[:, None], np.full((6, 1, 1), 1e-9))
    others = y[:5]
    ratio = (y[5] - others.mean()) / (others.std(ddof=1) * np.sqrt(1 + 1 / 5))
    assert found[5].p_value == pytest.approx(2 * student.sf(ratio, 4), rel=0.05)


def test_an_odd_ship_is_found_and_its_coefficient_named():
    found = compare_units(*fleet(1, odd=10.0))
    assert [c.unit for c in found if c.differs] == [3]
    (difference,) = found[3].differences
    assert difference.coefficient == 1
    assert difference.value > 3 * difference.std
    assert all(not c.differences for c in found if c.unit != 3)


def test_two_odd_ships_do_not_hide_one_another():
    y, c = fleet(2, odd=14.0)
    y[7, 0] += 14.0 * np.sqrt(c[7, 0, 0])
    assert [f.unit for f in compare_units(y, c) if f.differs] == [3, 7]


def test_ships_that_are_alike_are_left_alone():
    """Of 60 fleets, 5 % are 3: 8 or more would come by chance in one case of 300."""
    assert sum(any(f.differs for f in compare_units(*fleet(s))) for s in range(60)) < 8


def test_units_change_nothing():
    y, c = fleet(3, odd=8.0)
    scale = np.array([1e-3, 10.0, 1.0, 1e4])
    plain, other = compare_units(y, c), compare_units(y * scale, c * np.outer(scale, scale))
    assert [o.p_value for o in other] == pytest.approx([p.p_value for p in plain], rel=1e-2)


def test_too_few_units_are_refused():
    with pytest.raises(UsageError, match="2 units cannot show how much units differ"):
        compare_units(np.zeros((2, 1)), np.ones((2, 1, 1)))
