"""Stacked normal equations of experiments, those without a row among them."""

from __future__ import annotations

import numpy as np

from greybox.estimation.normal_equations import solve_stacked


def test_instruments_that_are_all_zero_determine_nothing():
    """As of a simulated motion that escaped, whose every row was cut."""
    rng = np.random.default_rng(1)
    phi = rng.standard_normal((2, 9))
    found = solve_stacked([np.zeros((2, 9))], [phi], [rng.standard_normal(9)])
    assert np.isnan(found.theta).all()
    assert not found.singular_values.any()
    assert not found.weakest.any()


def test_an_experiment_without_a_row_changes_nothing():
    rng = np.random.default_rng(2)
    phi, z = rng.standard_normal((2, 2, 30))
    y = np.array([0.3, -1.0]) @ phi
    alone = solve_stacked([z], [phi], [y])
    beside = solve_stacked([z, np.zeros((2, 5))], [phi, np.zeros((2, 5))], [y, np.zeros(5)])
    np.testing.assert_allclose(beside.theta, alone.theta, rtol=1e-12)
    np.testing.assert_allclose(alone.theta, [0.3, -1.0], rtol=1e-9)
