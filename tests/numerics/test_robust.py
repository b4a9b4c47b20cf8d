"""Spread of what differs from log to log."""

from __future__ import annotations

import numpy as np
import pytest
from statsmodels.stats.meta_analysis import combine_effects

from greybox.numerics.robust import variance_between


@pytest.mark.parametrize("spread", [0.0, 0.5])
def test_the_variance_between_logs_is_that_of_statsmodels(spread: float) -> None:
    rng = np.random.default_rng(3)
    chance = rng.uniform(0.02, 0.3, 9)
    values = 2.0 + rng.normal(0, np.sqrt(chance + spread**2))
    mean = np.average(values, weights=1 / chance)
    theirs = combine_effects(values, chance, method_re="dl").tau2
    assert variance_between(values - mean, 1 / chance) == pytest.approx(max(theirs, 0.0))


def test_a_log_that_tells_little_does_not_make_the_others_differ() -> None:
    # the time constants of four logs, the third of a turn in which commands hardly moved
    values = np.array([0.165, 0.142, 0.011, 0.186])
    chance = np.array([0.012, 0.007, 0.033, 0.011]) ** 2
    mean = np.average(values, weights=1 / chance)
    between = float(variance_between(values - mean, 1 / chance))
    assert np.sqrt(between) == pytest.approx(0.035, abs=0.003)
    assert np.sqrt(np.var(values, ddof=1) - chance.mean()) > 2 * np.sqrt(between)
