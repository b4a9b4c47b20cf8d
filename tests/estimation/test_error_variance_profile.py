"""Noise that changes along a log: its factor, its share, and the standard errors it gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom, chi2
from virtual import virtual_log

from greybox.estimation.arma_noise import ARMANoise
from greybox.estimation.banded_covariance import ErrorBand, ErrorNoise
from greybox.estimation.covariance import score_covariance
from greybox.estimation.error_variance_profile import (
    ErrorVarianceProfile,
    _Restricted,
    error_variance_profiles,
    fit_scaled_arma_noise,
)
from greybox.model.catalogue import get_structure
from greybox.model.predictor import build_predictor
from greybox.regression.motion import measured_slopes
from greybox.regression.regression import build_regression
from greybox.selection.fit_single import estimate_iv
from greybox.study.chapter6 import TRUE
from greybox.study.efficiency import CASES, virtual_trial

REGIME = (("u", (1,)), ("v", (1,)))


def drawn(rng, samples=800):
    """Errors n(k+1) − a(k) n(k), their shape, and a slow instrument large where 1 − a is."""
    swell = np.sin(np.arange(samples) * 2 * np.pi / 400) ** 2
    a = 1 - 0.3 * swell
    n = rng.standard_normal(samples + 1)
    e = n[1:] - a * n[:-1]
    tie = np.append(0.0, -a[1:])
    return e, ErrorVarianceProfile(1 + a**2, tie), swell * np.sign(np.sin(np.arange(samples) / 90))


def dense(shape, share):
    """Return the covariance that the factor stands for."""
    matrix = np.diag(shape.same + share * shape.same.mean())
    below = np.arange(1, len(matrix))
    matrix[below, below - 1] = matrix[below - 1, below] = shape.tie[1:]
    return matrix


def test_the_factor_makes_the_covariance_white():
    _, shape, _ = drawn(np.random.default_rng(0), 60)
    factor = shape.factor(0.1)
    inverse = factor.solve(np.eye(60)).T
    np.testing.assert_allclose(inverse @ dense(shape, 0.1) @ inverse.T, np.eye(60), atol=1e-10)
    # a log of one row has no neighbours
    one = ErrorVarianceProfile(np.array([4.0]), np.zeros(1)).factor(0.0)
    np.testing.assert_allclose(one.solve(np.array([6.0])), [3.0])


def test_adjoint_and_innovations_are_one_operator_on_every_log():
    rng = np.random.default_rng(1)
    pairs = [drawn(rng, samples) for samples in (300, 500)]
    residuals = [p[0] for p in pairs]
    keep = [np.ones(len(e), bool) for e in residuals]
    factors = tuple(p[1].factor(0.01) for p in pairs)
    colour = ARMANoise(np.array([1.0, 0.4]), np.array([1.0, -0.6]), factors=factors)
    z = [rng.standard_normal((2, len(e))) for e in residuals]
    for log, (x, e) in enumerate(zip(z, residuals, strict=True)):
        np.testing.assert_allclose(
            colour.adjoint(x, log) @ colour.innovations(e, log), x @ e, rtol=1e-9
        )
    found = fit_scaled_arma_noise(residuals, keep, [p[1] for p in pairs], z)
    assert found.white
    assert len(found.factors) == 2


def test_the_restricted_likelihood_equals_dense_algebra():
    rng = np.random.default_rng(2)
    logs, gaps = [drawn(rng, n) for n in (70, 90)], []
    z = [rng.standard_normal((2, n)) for n in (70, 90)]
    likelihood = _Restricted([v[0] for v in logs], [np.ones(n, bool) for n in (70, 90)],
                             [v[1] for v in logs], z)  # fmt: skip
    size = np.sqrt(sum((v**2).sum(axis=1) for v in z))
    x = np.zeros((160, 4))
    x[:70, 0] = x[70:, 1] = 1.0
    x[:, 2:] = np.hstack(z).T / size[:]
    e = np.concatenate([v[0] for v in logs])
    for share in (1e-4, 0.03, 2.0):
        v = np.zeros((160, 160))
        v[:70, :70], v[70:, 70:] = dense(logs[0][1], share), dense(logs[1][1], share)
        inverse = np.linalg.inv(v)
        gram = x.T @ inverse @ x
        left = e @ inverse @ e - (x.T @ inverse @ e) @ np.linalg.solve(gram, x.T @ inverse @ e)
        expected = (
            np.linalg.slogdet(v)[1] + np.linalg.slogdet(gram)[1] + (160 - 4) * np.log(left)
        ) / 2
        gaps.append(likelihood.loss(share) - expected)
    np.testing.assert_allclose(gaps, 0.0, atol=1e-7)


@pytest.mark.parametrize("kind", ["basic", "wind"])
def test_shapes_are_the_equations_blocks_of_the_whole_covariance(thesis, noisy_log, kind):
    predictor = build_predictor(thesis, kind, REGIME)
    theta = estimate_iv(predictor, [noisy_log], judged=False).theta
    e = build_regression(predictor, [noisy_log]).experiments[0]
    keep = np.ones(e.phi.shape[1], bool)
    keep[100:130] = False
    errors = [
        [np.where(keep, e.y[i] - theta[predictor.equation(s)] @ e.phi[predictor.equation(s)], 0.0)]
        for i, s in enumerate("uvr")
    ]
    shapes = error_variance_profiles(predictor, [noisy_log], theta, errors, [keep])
    slopes = measured_slopes(predictor, noisy_log, theta)
    std = np.array([noisy_log.vessel.std(n) for n in ("u", "v", "r")])
    further = np.zeros(slopes.shape[2] - 3)
    further[0] = noisy_log.vessel.std("psi")
    noise = ErrorNoise(std, np.zeros(3), np.zeros(3), further)
    band = ErrorBand(slopes, keep).covariance(noise).reshape(6, -1, 3)
    for i in range(3):
        np.testing.assert_allclose(shapes[i][0].same[keep], band[0, :, i], rtol=1e-10)
        expected = np.append(0.0, band[3, :-1, i])
        np.testing.assert_allclose(shapes[i][0].tie[keep], expected, rtol=1e-10, atol=1e-18)


def test_sensors_that_nobody_states_are_found_by_what_neighbours_share(thesis, true_theta):
    log = virtual_log(31, 3000, wind=0.0, current=(0.0, 0.0), spread=0.0)
    predictor = build_predictor(thesis, "basic", REGIME)
    theta = estimate_iv(predictor, [log], start=true_theta, judged=False).theta
    e = build_regression(predictor, [log]).experiments[0]
    keep = [np.ones(e.phi.shape[1], bool)]
    errors = [
        [e.y[i] - theta[predictor.equation(s)] @ e.phi[predictor.equation(s)]]
        for i, s in enumerate("uvr")
    ]
    silent = replace(log, vessel=replace(log.vessel, sensors={}))
    stated = error_variance_profiles(predictor, [log], theta, errors, keep)
    found = error_variance_profiles(predictor, [silent], theta, errors, keep)
    for (one,), (two,) in zip(found, stated, strict=True):
        ratio = one.tie[1:].mean() / two.tie[1:].mean()
        # Bartlett: a lag's covariance is known to γ₀ √(1 + 2ρ²) / √N
        rho = two.tie[1:].mean() / two.same.mean()
        assert abs(ratio - 1) < 3.5 * np.sqrt((1 + 2 * rho**2) / len(keep[0])) / abs(rho)


@pytest.mark.long
def test_what_a_slow_instrument_sums_has_the_variance_that_is_reported():
    """A noise model that is alike everywhere gives too little."""
    runs, sums, told, alike = 200, [], [], []
    for seed in range(runs):
        e, shape, z = drawn(np.random.default_rng([7, seed]))
        z = z - z.mean()
        e = e - e.mean()
        sums.append(z @ e)
        told.append(score_covariance([[z[None]]], [[e]], "ma", shapes=[[shape]])[0][0, 0])
        alike.append(score_covariance([[z[None]]], [[e]], "ma")[0][0, 0])
    variance = np.mean(np.square(sums))
    low, high = chi2.ppf([0.001, 0.999], runs) / runs
    assert low < variance / np.mean(told) < high
    assert variance / np.mean(alike) > high


def test_a_shape_that_the_errors_contradict_is_drowned():
    rng = np.random.default_rng(5)
    _, shape, z = drawn(rng, 1500)
    slow = np.zeros(1500)
    for k in range(1, 1500):
        slow[k] = 0.8 * slow[k - 1] + rng.standard_normal()
    told = score_covariance([[z[None]]], [[slow]], "ma", shapes=[[shape]])[0][0, 0]
    alike = score_covariance([[z[None]]], [[slow]], "ma")[0][0, 0]
    assert abs(told / alike - 1) < 0.02


def test_steady_noise_has_no_shape(thesis, clean_log):
    predictor = build_predictor(thesis, "basic", REGIME)
    theta = estimate_iv(predictor, [clean_log], judged=False).theta
    samples = len(clean_log) - 1
    keep = [np.ones(samples, bool)]
    nothing = [[np.zeros(samples)]] * 3
    far = np.where(np.arange(len(theta)) == 0, np.nan, theta)
    assert error_variance_profiles(predictor, [clean_log], far, nothing, keep) == ((), (), ())


@pytest.mark.long
@pytest.mark.parametrize("case", [0, 1])
def test_intervals_of_plain_instruments_cover_in_yaw(case):
    """A noise model alike everywhere covered `Nmu` in 88 % of a thousand runs."""
    structure, runs = get_structure("thesis"), 100
    regime = (("u", (1,)), ("v", (1,)), ("r", (1, -1)))
    predictor = build_predictor(structure, "wind", regime)
    start = np.array([TRUE[n] for n in structure.parameters])
    ratio = []
    for k in range(runs):
        log = virtual_trial(np.random.default_rng([31, case, k]), CASES[case])
        model = estimate_iv(
            predictor, [log], start=start, refine=False, wind="measured", judged=False,
            covariance="ma",
        ).model()  # fmt: skip
        at = model.names.index("Nmu")
        ratio.append((model.theta[at] - TRUE["Nmu"]) / model.std[at])
    inside = int((np.abs(ratio) < 1.96).sum())
    assert binom.ppf(0.005, runs, 0.93) <= inside
    # with standard errors too small by 1.28 the square is 1.64
    low, high = chi2.ppf([0.005, 0.995], runs) / runs
    assert low < np.mean(np.square(ratio)) < high
