"""Partial pooling against published analyses and a dense computation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from greybox.errors import UsageError
from greybox.fleet.pooling import pool

# Rubin (1981): coaching in eight schools; Gelman et al. (2013), table 5.2
SCHOOLS = np.array([28.0, 8, -3, 7, -1, 1, 18, 12])
SCHOOLS_STD = np.array([15.0, 10, 16, 11, 9, 11, 10, 18])
# BCG vaccine against tuberculosis, Colditz et al. (1994): cases and others of the vaccinated, of
# the controls, and the latitude of each trial
BCG = np.array(
    [
        [4, 119, 11, 128, 44], [6, 300, 29, 274, 55], [3, 228, 11, 209, 42],
        [62, 13536, 248, 12619, 52], [33, 5036, 47, 5761, 13], [180, 1361, 372, 1079, 44],
        [8, 2537, 10, 619, 19], [505, 87886, 499, 87892, 13], [29, 7470, 45, 7232, 27],
        [17, 1699, 65, 1600, 42], [186, 50448, 141, 27197, 18], [5, 2493, 3, 2338, 33],
        [27, 16886, 29, 17825, 33],
    ], float,
)  # fmt: skip


def vaccine():
    """Log risk ratios (13, 1) and their variances (13, 1, 1)."""
    cases, others, controls, fine, _ = BCG.T
    ratio = np.log(cases / (cases + others) / (controls / (controls + fine)))
    variance = 1 / cases - 1 / (cases + others) + 1 / controls - 1 / (controls + fine)
    return ratio[:, None], variance[:, None, None]


def fleet(seed, ships=6, size=3, spread=(0.0, 1.0, 3.0)):
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((ships, size, size))
    covariances = root @ root.transpose(0, 2, 1) + 0.5 * np.eye(size)
    theta = 5.0 + np.array(spread) * rng.standard_normal((ships, size))
    noise = np.array([rng.multivariate_normal(np.zeros(size), c) for c in covariances])
    return theta + noise, covariances, theta


def test_variance_and_mean_are_those_that_metafor_publishes():
    """Viechtbauer (2010), J. Statist. Software 36, section 3: rma() of dat.bcg."""
    pooled = pool(*vaccine())
    assert pooled.omega == pytest.approx([0.3132], abs=5e-5)
    assert np.sqrt(pooled.omega_covariance) == pytest.approx(0.1664, abs=5e-5)
    assert pooled.beta == pytest.approx([-0.7145], abs=5e-5)
    assert pooled.beta_std == pytest.approx([0.1798], abs=5e-5)


def test_a_regression_of_the_mean_is_the_one_that_metafor_publishes():
    """The same with the latitude as a moderator; there the search ends at steps of 1e-5."""
    latitude = BCG[:, 4]
    design = np.stack([np.ones(13), latitude], axis=1)[:, None, :]
    pooled = pool(*vaccine(), design)
    assert pooled.omega == pytest.approx([0.0764], abs=6e-5)
    assert pooled.beta == pytest.approx([0.2515, -0.0291], abs=5e-5)
    assert pooled.beta_std == pytest.approx([0.2491, 0.0072], abs=5e-5)


def test_eight_schools_are_pooled_wholly():
    """Gelman et al. (2013), section 5.5: pooled estimate 7.7, standard error 4.1."""
    pooled = pool(SCHOOLS[:, None], SCHOOLS_STD[:, None, None] ** 2)
    assert pooled.omega == pytest.approx([0.0])
    assert pooled.beta == pytest.approx([7.7], abs=0.05)
    assert pooled.beta_std == pytest.approx([4.1], abs=0.05)
    assert np.all(pooled.shrinkage == 1.0)
    # what is not known of the spread keeps the schools' own effects uncertain
    assert np.all(pooled.theta_std > 1.4 * pooled.beta_std)


def test_equal_variances_give_the_shrinkage_of_efron_and_morris():
    """With equal variances restricted likelihood shrinks by (k − 1) c / Σ (y − ȳ)²."""
    y = np.array([1.0, 4.0, -2.0, 7.0, 3.0])
    c = 2.0
    pooled = pool(y[:, None], np.full((5, 1, 1), c))
    shrinkage = 4 * c / ((y - y.mean()) ** 2).sum()
    assert pooled.shrinkage == pytest.approx(shrinkage, rel=1e-6)
    expected = y.mean() + (1 - shrinkage) * (y - y.mean())
    assert pooled.theta[:, 0] == pytest.approx(expected, rel=1e-6)
    # Prasad and Rao's mean squared error in closed form
    total = c / shrinkage
    error = c * (1 - shrinkage) + shrinkage**2 * total / 5 + 2 * shrinkage**2 * 2 * total / 4
    assert pooled.theta_std**2 == pytest.approx(error, rel=1e-6)


def dense(y, c, omega):
    """Restricted log-likelihood, its mean and its posterior from one large matrix each."""
    ships, size = y.shape
    big = np.zeros((ships * size, ships * size))
    for i in range(ships):
        part = slice(i * size, (i + 1) * size)
        big[part, part] = c[i] + np.diag(omega)
    x = np.tile(np.eye(size), (ships, 1))
    inverse = np.linalg.inv(big)
    projection = inverse - inverse @ x @ np.linalg.inv(x.T @ inverse @ x) @ x.T @ inverse
    flat = y.ravel()
    value = -0.5 * (
        np.linalg.slogdet(big)[1]
        + np.linalg.slogdet(x.T @ inverse @ x)[1]
        + flat @ projection @ flat
    )
    theta = y - np.array([c[i] @ (projection @ flat).reshape(ships, size)[i] for i in range(ships)])
    places = [np.arange(ships) * size + j for j in range(size)]
    information = [[0.5 * (projection[np.ix_(a, b)] ** 2).sum() for b in places] for a in places]
    return value, theta, np.array(information)


def test_correlated_estimates_agree_with_a_dense_computation():
    y, c, _ = fleet(4)
    pooled = pool(y, c)
    value, theta, information = dense(y, c, pooled.omega)
    assert pooled.theta == pytest.approx(theta, rel=1e-8)
    assert pooled.omega_covariance == pytest.approx(np.linalg.inv(information), rel=1e-6)
    best = minimize(
        lambda root: -dense(y, c, root**2)[0], np.sqrt(pooled.omega) + 0.3, method="Nelder-Mead",
        options={"xatol": 1e-8, "fatol": 1e-12, "maxiter": 5000, "maxfev": 5000},
    )  # fmt: skip
    assert value == pytest.approx(-best.fun, abs=1e-7)
    assert pooled.omega == pytest.approx(best.x**2, abs=1e-3)


def test_units_and_order_change_nothing():
    y, c, _ = fleet(5)
    scale, order = np.array([1e-4, 3.0, 2e5]), [4, 2, 0, 5, 1, 3]
    plain = pool(y, c)
    other = pool(y[order] * scale, c[order] * np.outer(scale, scale))
    assert other.theta / scale == pytest.approx(plain.theta[order], rel=1e-5)
    assert other.theta_std / scale == pytest.approx(plain.theta_std[order], rel=1e-4)
    assert other.omega / scale**2 == pytest.approx(plain.omega, rel=1e-4, abs=1e-6)


def test_intervals_hold_what_they_promise():
    """Of 1800 coefficients and 900 means; the standard error of a share is 0.5 and 0.7 %."""
    held, means = [], []
    for seed in range(100):
        y, c, theta = fleet(seed, spread=(0.5, 1.0, 2.0))
        pooled = pool(y, c)
        held.append(np.abs(pooled.theta - theta) < 1.96 * pooled.theta_std)
        interval = pooled.beta_interval()
        means.append((interval[:, 0] < 5.0) & (interval[:, 1] > 5.0))
    assert 0.93 < np.mean(held) < 0.99
    assert np.mean(means) > 0.92


def test_too_few_or_misshapen_estimates_are_refused():
    with pytest.raises(UsageError, match="1 estimates of 2 coefficients cannot tell 2"):
        pool(np.zeros((1, 2)), np.eye(2)[None])
    with pytest.raises(UsageError, match=r"give one \(2, 2\) covariance for each"):
        pool(np.zeros((3, 2)), np.eye(2)[None])
