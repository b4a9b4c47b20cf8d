"""Estimates, covariances and tests against linearmodels and statsmodels."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import statsmodels.api as sm
from linearmodels.iv import IV2SLS
from scipy.optimize import minimize_scalar
from scipy.signal import lfilter
from scipy.stats import binom
from scipy.stats import t as student

from greybox.credibility.evidence import Equation
from greybox.credibility.score_statistic import score_test
from greybox.credibility.weak import measure_strength
from greybox.estimation.arma_noise import WHITE, fit_arma_noise
from greybox.estimation.covariance import (
    allow_for_segments,
    cluster_std,
    curved,
    moderated,
    score_covariance,
    segment_sums,
)
from greybox.estimation.normal_equations import solve_stacked
from greybox.numerics.lagged_moments import bartlett_sums

ROWS = 400


def endogenous(seed=0, q=4, changing=False):
    """Two noisy regressors and an exact one, with q instruments beside it."""
    rng = np.random.default_rng(seed)
    exact, outer = rng.normal(size=(1, ROWS)), rng.normal(size=(q, ROWS))
    noise, e = rng.normal(size=(2, ROWS)), rng.normal(size=ROWS)
    e = e + 0.5 * noise[0]
    if changing:
        e = e * (1 + np.abs(outer[0]))
    first = rng.normal(size=(2, q)) @ outer + 0.4 * exact + noise
    y = np.array([1.0, -0.5]) @ first + 0.3 * exact[0] + e
    return y, exact, first, outer


def as_equation(y, exact, first, outer):
    phi, z = np.vstack([first, exact]), np.vstack([outer, exact])
    keep = np.ones(len(y), bool)
    return Equation("u", (0, 1, 2), ("a", "b", "c"), (y,), (phi,), (z,), (keep,), False)


def fitted(seed=0, q=4, changing=False, **options):
    y, exact, first, outer = endogenous(seed, q, changing)
    return as_equation(y, exact, first, outer), IV2SLS(y, exact.T, first.T, outer.T).fit(**options)


# the exact regressor comes first there and last here
ORDER = [1, 2, 0]


def test_two_stage_least_squares_and_its_robust_covariance():
    for changing in (False, True):
        equation, oracle = fitted(1, changing=changing, cov_type="robust", debiased=False)
        solution = equation.solution
        np.testing.assert_allclose(solution.theta, oracle.params.to_numpy()[ORDER], rtol=1e-8)
        middle, _ = score_covariance([solution.projected], [equation.residuals], "white")
        inverse = np.linalg.inv(solution.information)
        want = oracle.cov.to_numpy()[np.ix_(ORDER, ORDER)]
        np.testing.assert_allclose(inverse @ middle @ inverse, want, rtol=1e-8)


def test_several_experiments_with_their_own_instruments():
    """Stacked as (4.5): blocks of instruments, each zero-mean in its own rows."""
    cut = (0, 150, 290, ROWS)
    y, exact, first, outer = endogenous(2)
    phi, z = np.vstack([first, exact]), np.vstack([outer, exact])
    parts = [slice(a, b) for a, b in pairwise(cut)]
    zs = [z[:, s] - z[:, s].mean(axis=1, keepdims=True) for s in parts]
    blocks = np.zeros((5 * 3, ROWS))
    for i, (s, part) in enumerate(zip(parts, zs, strict=True)):
        blocks[5 * i : 5 * i + 5, s] = part
    solution = solve_stacked(zs, [phi[:, s] for s in parts], [y[s] for s in parts])
    oracle = IV2SLS(y, None, phi.T, blocks.T).fit(cov_type="robust", debiased=False)
    np.testing.assert_allclose(solution.theta, oracle.params.to_numpy(), rtol=1e-8)
    errors = [y[s] - solution.theta @ phi[:, s] for s in parts]
    middle, _ = score_covariance([solution.projected], [errors], "white")
    inverse = np.linalg.inv(solution.information)
    np.testing.assert_allclose(inverse @ middle @ inverse, oracle.cov.to_numpy(), rtol=1e-8)


def test_least_squares_with_memory_equals_statsmodels():
    """The kernel is flat-top, so Bartlett's weights are put in its place."""
    rng = np.random.default_rng(3)
    x, e = rng.normal(size=(2, ROWS)), np.convolve(rng.normal(size=ROWS + 3), np.ones(4), "valid")
    y = np.array([1.0, 2.0]) @ x + e
    solution = solve_stacked([x], [x], [y])
    oracle = sm.OLS(y, x.T).fit(cov_type="HAC", cov_kwds={"maxlags": 5, "use_correction": False})
    residual = y - solution.theta @ x
    middle = bartlett_sums((x * residual).T, 5)
    inverse = np.linalg.inv(solution.information)
    np.testing.assert_allclose(solution.theta, oracle.params, rtol=1e-8)
    np.testing.assert_allclose(inverse @ middle @ inverse, oracle.cov_params(), rtol=1e-8)


def clustered(x, y, lengths):
    """Residuals, segment sums (logs of these lengths) and bread of least squares on x (p, N)."""
    residual = y - np.linalg.lstsq(x.T, y, rcond=None)[0] @ x
    ends = np.cumsum(lengths)[:-1]
    sums = segment_sums(np.split(x, ends, axis=1), np.split(residual, ends), 0)
    return residual, sums, np.linalg.inv(x @ x.T)


def test_alike_segments_equal_the_clusters_of_statsmodels():
    """Where all segments move alike, CR2 is the sandwich times G/(G - 1)."""
    rng = np.random.default_rng(6)
    x = np.tile(rng.normal(size=(3, 12)), 30)
    y = np.array([1.0, -2.0, 0.5]) @ x + np.repeat(rng.normal(size=30), 12) * x[0]
    y += rng.normal(size=360)
    groups = np.repeat(np.arange(30), 12)
    kwds = {"groups": groups, "use_correction": False}
    oracle = sm.OLS(y, x.T).fit(cov_type="cluster", cov_kwds=kwds)
    _, sums, bread = clustered(x, y, [12] * 30)
    assert len(sums[0]) == 30
    std, freedom = cluster_std(*sums, bread)
    np.testing.assert_allclose(std, oracle.bse * np.sqrt(30 / 29), rtol=1e-8)
    np.testing.assert_allclose(freedom, 29, rtol=1e-8)


def test_a_coefficient_without_errors_stays_without():
    """A channel that never moves leaves equations that hold exactly."""
    rng = np.random.default_rng(8)
    x = rng.normal(size=(2, 120))
    _, sums, bread = clustered(x, x[0] + rng.normal(size=120), [120])
    still = (np.zeros_like(sums[0]), sums[1])
    found = allow_for_segments(np.diag([0.01, 0.01, 0.0, 0.0]), [sums, still], [bread, bread])
    assert (found[2:] == 0).all()
    assert (np.diag(found)[:2] >= 0.01).all()
    found = allow_for_segments(np.diag([0.0, 0.0, 0.01, 0.01]), [sums, still], [bread, bread])
    np.testing.assert_array_equal(found, np.diag([0.0, 0.0, 0.01, 0.01]))
    mixed = allow_for_segments(np.diag([0.0, 0.01]), [sums], [bread])
    assert mixed[0, 0] == 0.0


def test_segments_equal_bell_and_mccaffrey_by_matrices_of_rows():
    """Logs of two lengths, cut into 13 and 17 segments; units far apart."""
    rng = np.random.default_rng(7)
    x = rng.normal(size=(3, 240)) * [[1.0], [1.0], [1e4]] * np.linspace(0.2, 2, 240)
    y = np.array([1.0, 2.0, 3e-4]) @ x + rng.normal(size=240)
    residual, sums, bread = clustered(x, y, [104, 136])
    std, freedom = cluster_std(*sums, bread)
    edges = [*np.linspace(0, 104, 14).astype(int), *(104 + np.linspace(0, 136, 18).astype(int))]
    hat = np.eye(240) - x.T @ bread @ x
    variance, weights = np.zeros(3), []
    for a, b in pairwise(edges):
        if a == b:
            continue
        values, vectors = np.linalg.eigh(hat[a:b, a:b])
        into = bread @ x[:, a:b] @ (vectors / np.sqrt(values)) @ vectors.T
        variance += (into @ residual[a:b]) ** 2
        weights.append(into @ hat[a:b])
    np.testing.assert_allclose(std, np.sqrt(variance), rtol=1e-8)
    omega = np.einsum("gpn,hpn->pgh", weights, weights)
    expected = np.trace(omega, axis1=1, axis2=2) ** 2 / (omega**2).sum(axis=(1, 2))
    np.testing.assert_allclose(freedom, expected, rtol=1e-8)


def test_the_bread_of_a_wrong_curve_is_that_of_the_whole_hessian():
    """y = exp(θ x) fitted to a parabola: residuals do not average out of the second derivative."""
    x = np.linspace(0, 2, 60)
    y = 1 + 2 * x - 0.8 * x**2
    theta = minimize_scalar(lambda t: ((y - np.exp(t * x)) ** 2).sum(), (0, 0.5)).x
    slope, bend = x * np.exp(theta * x), x**2 * np.exp(theta * x)
    moments, change = (slope @ slope).reshape(1, 1), (bend @ (y - np.exp(theta * x))).reshape(1, 1)
    found = curved(1 / moments, moments, change)
    np.testing.assert_allclose(found, 1 / (moments - change), rtol=1e-10)
    # what is left of the information has a floor, so that no direction is lost altogether
    least = curved(1 / moments, moments, 0.95 * moments)
    np.testing.assert_allclose(least, 5 / moments, rtol=1e-10)


def test_standard_errors_hold_where_errors_depend_on_the_motion():
    """A line through a wave, in slow motion: 95 % intervals hold the slope of 2000 trials."""
    rng = np.random.default_rng(8)

    def logs(count):
        x = lfilter([1], [1, -0.95], rng.normal(size=(count, 4, 300)))
        return x, 0.5 * x + 0.3 * np.sin(x) + 0.1 * rng.normal(size=x.shape)

    x, y = logs(2000)
    pooled = (x * y).sum() / (x * x).sum()
    inside = np.zeros(2)
    for xs, ys in zip(x[:200], y[:200], strict=True):
        flat = xs.reshape(1, -1)
        residual, sums, bread = clustered(flat, ys.ravel(), [300] * 4)
        std, freedom = cluster_std(*sums, bread)
        away = abs((flat @ ys.ravel() * bread).item() - pooled)
        white = np.sqrt(bread * residual.var()).item()
        inside += away < student.ppf(0.975, freedom.item()) * std.item(), away < 1.96 * white
    assert inside[1] < 160
    assert binom.ppf(0.001, 200, 0.93) <= inside[0] <= binom.ppf(0.999, 200, 0.97)


def test_ratios_that_scatter_by_chance_are_drawn_together():
    rng = np.random.default_rng(9)
    freedom = np.full(200, 10.0)
    chance = 2 * rng.chisquare(10, 200) / 10
    alike, sure = moderated(chance, freedom)
    assert alike.std() < 0.25 * chance.std()
    assert abs(alike.mean() - 2) < 0.2
    assert (sure > 50).all()
    apart, kept = moderated(chance * np.exp(rng.normal(size=200)), freedom)
    assert (kept < 20).all()
    assert apart.std() > 1


def test_sargan_and_its_robust_form():
    equation, oracle = fitted(4)
    args = (equation.z, equation.phi, equation.solution.projected, equation.residuals)
    sargan = score_test(*args, memory="iid")
    assert sargan.freedom == 2
    np.testing.assert_allclose(sargan.statistic, oracle.sargan.stat, rtol=1e-8)
    np.testing.assert_allclose(sargan.p_value, oracle.sargan.pval, rtol=1e-8)
    equation, oracle = fitted(5, changing=True)
    args = (equation.z, equation.phi, equation.solution.projected, equation.residuals)
    robust = score_test(*args, memory="white")
    np.testing.assert_allclose(robust.statistic, oracle.wooldridge_overid.stat, rtol=1e-8)


def test_durbin_and_its_robust_score():
    for seed, memory, name in ((6, "iid", "durbin"), (7, "white", "wooldridge_score")):
        equation, oracle = fitted(seed, changing=memory == "white")
        phi = equation.phi[0]
        theta = np.linalg.solve(phi @ phi.T, phi @ equation.y[0])
        found = score_test(
            equation.solution.projected, [phi], [phi], [equation.y[0] - theta @ phi], memory=memory
        )
        want = getattr(oracle, name)
        want = want() if callable(want) else want
        assert found.freedom == 2
        np.testing.assert_allclose(found.statistic, want.stat, rtol=1e-8)


def test_shea_and_the_first_stage():
    equation, oracle = fitted(8)
    strength = measure_strength(equation)
    first = oracle.first_stage.diagnostics
    np.testing.assert_allclose(strength.shea[:2], first["shea.rsquared"], rtol=1e-8)
    assert np.isinf(strength.own[2])


def test_cragg_donald_of_one_regressor_is_its_first_stage_f():
    """And Kleibergen-Paap without memory is the homoskedastic statistic times its freedom."""
    y, exact, first, outer = endogenous(9)
    phi, z = np.vstack([first[:1], exact]), np.vstack([outer, exact])
    keep = np.ones(ROWS, bool)
    equation = Equation("u", (0, 1), ("a", "c"), (y,), (phi,), (z,), (keep,), False)
    strength = measure_strength(equation)
    full = sm.OLS(first[0], z.T).fit()
    restricted = sm.OLS(first[0], exact.T).fit()
    f = full.compare_f_test(restricted)[0]
    np.testing.assert_allclose(strength.cragg_donald, f, rtol=1e-8)
    assert strength.rank_freedom == 4
    assert 0.5 * f < strength.rank / 4 < 2 * f


def test_noise_model_equals_statsmodels():
    rng = np.random.default_rng(10)
    white = rng.normal(size=3001)
    series = white[1:] - 0.9 * white[:-1]
    series = series - series.mean()
    keep = np.ones(3000, bool)
    found = fit_arma_noise([series], [keep])
    oracle = sm.tsa.ARIMA(series, order=(0, 0, 1), trend="n").fit()
    assert len(found.moving_average) == 2
    assert abs(found.moving_average[1] - oracle.params[0]) < 0.3 * oracle.bse[0]
    assert fit_arma_noise([rng.normal(size=2000)], [np.ones(2000, bool)]) == WHITE


def test_the_noise_model_of_many_stretches_is_known_as_well_as_it_is():
    """Missing samples between them are none: Kalman's filter passes over them."""
    rng = np.random.default_rng(12)
    white = rng.normal(size=2000)
    series = np.zeros(2000)
    for k in range(1, 2000):
        series[k] = -0.6 * series[k - 1] + white[k]
    keep = np.arange(2000) % 30 < 22
    found = fit_arma_noise([series], [keep])
    oracle = sm.tsa.ARIMA(np.where(keep, series, np.nan), order=(1, 0, 0), trend="n").fit()
    (beside,) = found.neighbours
    own = abs(beside.autoregression[1] - found.autoregression[1])
    assert len(found.autoregression) == 2
    assert own == pytest.approx(oracle.bse[0], rel=0.1)


def test_adjoint_and_innovations_are_one_operator():
    rng = np.random.default_rng(11)
    white = rng.normal(size=501)
    series = np.convolve(white, [1, 0.6], "valid")
    colour = fit_arma_noise([series], [np.ones(500, bool)])
    z = rng.normal(size=(3, 500))
    np.testing.assert_allclose(
        colour.adjoint(z) @ colour.innovations(series), z @ series, rtol=1e-8
    )


@pytest.mark.parametrize("lag", [0, 1])
def test_white_noise_has_the_plain_covariance(lag):
    rng = np.random.default_rng(12 + lag)
    z, e = rng.normal(size=(2, 3000)), rng.normal(size=3000)
    found, memory = score_covariance([[z]], [[e]], "ma")
    np.testing.assert_allclose(found, (z * e) @ (z * e).T, rtol=0.15, atol=60)
    assert memory <= 2
