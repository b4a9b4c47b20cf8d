"""Refined IV: equal to dense algebra, exact without noise, as precise as its bound."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from statsmodels.tsa.statespace.structural import UnobservedComponents
from virtual import virtual_log

from greybox.errors import DivergenceError, ExcitationError, UsageError
from greybox.estimation import refined as refinement
from greybox.estimation.banded_covariance import ErrorBand, ErrorNoise
from greybox.estimation.bound import iv_bound
from greybox.estimation.gls_regression import solve_white, spread_columns, white_rows
from greybox.estimation.noise import (
    ErrorLikelihood,
    constant_rows,
    first_levels,
    fit_noise,
)
from greybox.estimation.refined import add_noise, estimate_refined_iv
from greybox.estimation.summary import weak_safe_sets
from greybox.model.catalogue import get_structure
from greybox.model.model import model_from_dict
from greybox.model.noise import NoiseLevels
from greybox.model.predictor import build_predictor
from greybox.model.run.simulation import stationary_disturbance
from greybox.numerics.banded import factor_band
from greybox.regression.motion import predicted_motion, smoothed_heading
from greybox.regression.problem import RegressionProblem
from greybox.regression.regression import build_regression
from greybox.selection.fit_single import estimate_iv, estimate_ls, estimate_once
from greybox.selection.request import Request
from greybox.study.chapter6 import TRUE
from greybox.study.efficiency import CASES, virtual_trial

REGIME = (("u", (1,)), ("v", (1,)), ("r", (1, -1)))
STILL = {"wind": 0.0, "current": (0.0, 0.0), "spread": 0.0}
NOISE = ErrorNoise(
    np.array([0.1, 0.2, 0.3]),
    np.array([0.05, 0.1, 0.2]),
    np.array([0.9, 0.5, 0.0]),
    np.array([0.1, 0.2]),
)


def dense_covariance(slopes, keep, noise):
    """The covariance of kept errors, written out noise by noise."""
    samples, nx, channels = slopes.shape
    state = np.zeros((samples * nx, (samples + 1) * nx))
    further = np.zeros((samples * nx, samples * (channels - nx)))
    process = np.zeros((samples * nx, samples * nx))
    stretch = np.cumsum(~keep)
    for k in range(samples):
        rows = slice(k * nx, k * nx + nx)
        state[rows, (k + 1) * nx : (k + 2) * nx] = np.eye(nx)
        state[rows, rows] = -slopes[k, :, :nx]
        further[rows, k * (channels - nx) : (k + 1) * (channels - nx)] = -slopes[k, :, nx:]
        for j in range(samples):
            if stretch[j] == stretch[k]:
                memory = np.where(j == k, 1.0, noise.memory ** abs(j - k))
                process[rows, j * nx : j * nx + nx] = np.diag(noise.process**2 * memory)
    total = state @ np.kron(np.eye(samples + 1), np.diag(noise.measurement**2)) @ state.T
    total += further @ np.kron(np.eye(samples), np.diag(noise.further**2)) @ further.T
    index = np.repeat(keep, nx)
    return (total + process)[np.ix_(index, index)]


@pytest.fixture(scope="module")
def still_log():
    return virtual_log(11, 1500, **STILL)


@pytest.fixture(scope="module")
def basic(thesis):
    return build_predictor(thesis, "basic", REGIME)


@pytest.fixture(scope="module")
def refined(basic, still_log):
    return estimate_refined_iv(basic, [still_log], covariance="ma")


@pytest.mark.parametrize("remembers", [False, True])
@pytest.mark.parametrize("cut", [False, True])
def test_the_band_equals_the_dense_covariance(remembers, cut):
    rng = np.random.default_rng(0)
    slopes = 0.5 * rng.normal(size=(30, 3, 5))
    keep = np.ones(30, bool)
    if cut:
        keep[[7, 8, 15, 20]] = False
    noise = NOISE if remembers else replace(NOISE, memory=np.zeros(3))
    band = ErrorBand(slopes, keep)
    factor = factor_band(band.covariance(noise))
    omega = dense_covariance(slopes, keep, noise)
    values = rng.normal(size=(4, 30, 3))
    white = band.whiten(factor, noise, values)
    flat = values[:, keep].reshape(4, -1)
    np.testing.assert_allclose(
        white @ white.T, flat @ np.linalg.solve(omega, flat.T), rtol=1e-10, atol=1e-9
    )
    other = rng.normal(size=white.shape[1])
    back = band.adjoint(factor, noise, other)
    np.testing.assert_allclose(flat @ back.ravel(), white @ other, rtol=1e-10, atol=1e-9)
    np.testing.assert_allclose(2 * np.log(factor[0]).sum(), np.linalg.slogdet(omega)[1], rtol=1e-12)


def test_the_estimator_equals_dense_generalised_instrumental_variables(thesis, true_theta, basic):
    logs = [virtual_log(s, 150, **STILL) for s in (1, 2)]
    regression = build_regression(basic, logs)
    theta = estimate_iv(basic, logs, start=true_theta, refine=False).theta
    noise = ErrorNoise(
        np.full(3, 0.014), np.array([2e-3, 4e-3, 2e-4]), np.zeros(3), np.array([0.01])
    )
    keep = np.ones(149, bool)
    keep[40:60] = False
    rows, left, right = [], 0.0, 0.0
    for log, e in zip(logs, regression.experiments, strict=True):
        motion = predicted_motion(basic, log, theta, np.zeros(3))
        rows.append(white_rows(basic, ErrorBand(motion.slopes, keep), noise, motion.z, e.phi, e.y))
        inverse = np.linalg.inv(dense_covariance(motion.slopes, keep, noise))
        ones = np.tile(np.eye(3), (int(keep.sum()), 1))
        inner = np.linalg.inv(ones.T @ inverse @ ones)
        weight = inverse - inverse @ ones @ inner @ ones.T @ inverse
        z, phi = (spread_columns(basic, m)[:, keep].reshape(len(m), -1) for m in (motion.z, e.phi))
        left = left + z @ weight @ phi.T
        right = right + z @ weight @ e.y.T[keep].ravel()
    got, inverse = solve_white(rows)
    np.testing.assert_allclose(got, np.linalg.solve(left, right), rtol=1e-8, atol=1e-12)
    mixed = [
        replace(r, z=np.random.default_rng(1).normal(size=(len(r.z),) * 2) @ r.z) for r in rows
    ]
    np.testing.assert_allclose(solve_white(mixed)[0], got, rtol=1e-6)


def test_slopes_are_the_derivatives_of_the_prediction(basic, still_log, true_theta):
    theta = estimate_iv(basic, [still_log], start=true_theta, refine=False).theta
    motion = predicted_motion(basic, still_log, theta, np.zeros(3))
    k, step = 100, 1e-6
    tau = still_log.forces(basic.structure.inputs)[k]

    def after(x):
        phi = basic.evaluate([np.array([v]) for v in x], 0.0, [np.array([v]) for v in tau])[:, 0]
        return x + [theta[basic.equation(s)] @ phi[basic.equation(s)] for s in "uvr"]

    x = motion.x[k]
    np.testing.assert_allclose(after(x), motion.x[k + 1], rtol=1e-10)
    for j in range(3):
        move = step * np.eye(3)[j]
        slope = (after(x + move) - after(x - move)) / (2 * step)
        np.testing.assert_allclose(motion.slopes[k, :, j], slope, atol=1e-8)


@pytest.mark.parametrize("kind", ["basic", "augmented", "wind"])
def test_exact_without_noise(thesis, true_theta, kind):
    still = kind == "basic"
    log = virtual_log(
        3,
        800,
        wind=0.0 if still else 0.3,
        current=(0.0, 0.0) if still else (0.2, -0.2),
        noise=0.0,
        spread=0.0,
        wind_spread=1.0 if kind == "wind" else 0.0,
    )
    predictor = build_predictor(thesis, kind, REGIME)
    estimate = estimate_refined_iv(predictor, [log], start=true_theta, wind="measured")
    want = [
        sum(true_theta[thesis.index(t)] for t in predictor.columns[i].terms)
        for i in predictor.parameter_columns
    ]
    got = estimate.theta[predictor.parameter_columns]
    np.testing.assert_allclose(got, want, rtol=2e-5, atol=1e-8)


def test_standard_errors_reach_the_bound(basic, still_log, true_theta, refined):
    noise = NoiseLevels(("u", "v", "r"), np.full(3, 0.014142), np.zeros(3), 0.01)
    bound = iv_bound(basic, [still_log], true_theta, noise)
    np.testing.assert_allclose(refined.std, np.sqrt(np.diag(bound)), rtol=0.25)
    plain = estimate_iv(basic, [still_log])
    assert (refined.std < plain.std).all()
    assert np.median(refined.std / plain.std) < 0.5
    error = refined.theta - estimate_iv(basic, [virtual_log(11, 1500, noise=0.0, **STILL)]).theta
    assert float(error @ np.linalg.solve(refined.covariance, error)) < 40  # χ² of 15, p = 5e-4


def test_two_logs_halve_the_variance_bound(basic, still_log, true_theta):
    noise = NoiseLevels(("u", "v", "r"), np.full(3, 0.014), np.full(3, 1e-3))
    one = iv_bound(basic, [still_log], true_theta, noise)
    two = iv_bound(basic, [still_log, still_log], true_theta, noise)
    np.testing.assert_allclose(two, one / 2, rtol=1e-8)


@pytest.mark.parametrize("kind", ["cluster", "hac", "white", "bootstrap"])
def test_other_covariances_agree(basic, still_log, refined, kind):
    plain = estimate_iv(basic, [still_log])
    other = estimate_refined_iv(basic, [still_log], start=plain, covariance=kind)
    np.testing.assert_allclose(other.theta, refined.theta, rtol=1e-10)
    np.testing.assert_allclose(other.std, refined.std, rtol=0.35)
    assert other.covariance_kind == kind


def test_noise_levels_are_found_and_kept(basic, still_log):
    vessel = replace(still_log.vessel, sensors={})
    estimate = estimate_refined_iv(basic, [replace(still_log, vessel=vessel)])
    noise = estimate.noise
    # an nx-th of 1500 squares each: four standard errors
    np.testing.assert_allclose(noise.measurement, 0.014142, rtol=4 / np.sqrt(2 * 1500))
    assert (noise.process < 4e-3).all()
    assert noise.source.startswith("noise of u, v, r from the equation errors")
    read = model_from_dict(estimate.model().to_dict())
    np.testing.assert_allclose(read.noise.measurement, noise.measurement)
    assert read.record["prefilter"] == "noise"
    assert "iv, prefiltered" in estimate.summary()


def test_wrong_sensors_are_contradicted(basic, still_log):
    sensors = {"u_std": 0.05, "v_std": 0.003, "r_std": 0.014, "heading_std": 0.01}
    log = replace(still_log, vessel=replace(still_log.vessel, sensors=sensors))
    noise = estimate_refined_iv(basic, [log]).noise
    assert "contradicts" in noise.source
    np.testing.assert_allclose(noise.measurement, 0.014142, rtol=0.1)


def test_the_memory_of_process_noise_is_found():
    rng = np.random.default_rng(4)
    samples = 3000
    slopes = np.tile(np.diag([0.9, 0.8, 0.9])[None], (samples, 1, 1))
    e = 0.1 * rng.normal(size=(samples + 1, 3))
    slow = stationary_disturbance(rng, np.zeros(3), 0.1, samples, correlation_time=20.0)[0]
    errors = e[1:] - np.einsum("kij,kj->ki", slopes, e[:-1])
    band = ErrorBand(slopes, np.ones(samples, bool))
    stated = np.full(3, 0.1)
    for added, remembers in ((slow, True), (0.0, False)):
        likelihood = ErrorLikelihood([band], [errors + added], [True] * 3, np.full(3, 1e-9))
        fit = fit_noise(likelihood, first_levels(likelihood, stated, np.zeros(0)))
        assert fit.remembers == remembers
        assert not fit.contradicted
        if remembers:
            np.testing.assert_allclose(fit.noise.memory, np.exp(-1 / 20), atol=0.04)
            np.testing.assert_allclose(fit.noise.process, 0.1, rtol=0.4)
        else:
            assert (fit.noise.process < 0.02).all()


def test_the_restricted_likelihood_equals_dense_algebra():
    rng = np.random.default_rng(3)
    keep = np.ones(25, bool)
    noise = replace(NOISE, memory=np.zeros(3), further=np.zeros(0))
    slopes = [0.5 * rng.normal(size=(25, 3, 3)) for _ in range(2)]
    errors = [rng.normal(size=(25, 3)) for _ in range(2)]
    z = [rng.normal(size=(5, 25, 3)) for _ in range(2)]
    own = [True, False, True]
    bands = [ErrorBand(s, keep) for s in slopes]
    got = ErrorLikelihood(bands, errors, own, np.full(3, 1e-9), z).loss(noise)
    omega = block_diag(*[dense_covariance(s, keep, noise) for s in slopes])
    ones = block_diag(*[constant_rows(25, own).reshape(2, -1).T] * 2)
    size = np.sqrt(sum((part**2).sum(axis=(1, 2)) for part in z))
    shared = np.concatenate([part.reshape(5, -1).T for part in z]) / size
    x, y = np.hstack([ones, shared]), np.concatenate([e.ravel() for e in errors])
    inverse = np.linalg.inv(omega)
    information = x.T @ inverse @ x
    weight = inverse - inverse @ x @ np.linalg.solve(information, x.T @ inverse)
    want = np.linalg.slogdet(omega)[1] + np.linalg.slogdet(information)[1] + y @ weight @ y
    np.testing.assert_allclose(got, want / 2, rtol=1e-10)


@pytest.mark.parametrize("own", [(True, True, True), (False, True, False)])
@pytest.mark.parametrize("memory", [(0.0, 0.0, 0.0), (0.5, 0.2, 0.7)])
@pytest.mark.parametrize("restricted", [False, True])
def test_slopes_of_the_likelihood_equal_differences(own, memory, restricted):
    rng = np.random.default_rng(0)
    bands, errors, regressors = [], [], []
    # the last log is narrower than the band of its covariance
    for samples in (90, 60, 1):
        slopes = 0.5 * rng.standard_normal((samples, 3, 5))
        bands.append(ErrorBand(slopes, rng.random(samples) > 0.1))
        errors.append(rng.standard_normal((samples, 3)))
        regressors.append(rng.standard_normal((4, samples, 3)))
    likelihood = ErrorLikelihood(
        bands, errors, own, np.full(3, 1e-6), regressors if restricted else None
    )
    at = ErrorNoise(
        np.array([0.3, 0.5, 0.4]), np.array([0.6, 0.3, 0.8]), np.array(memory), np.array([0.1, 0.2])
    )
    loss, *found = likelihood.slopes(at)
    assert loss == pytest.approx(likelihood.loss(at), rel=1e-12)

    def differences(name, power):
        out = []
        for i in range(3):
            step = 1e-5 * np.eye(3)[i]
            level = getattr(at, name)
            ends = [(level**power + sign * step) ** (1 / power) for sign in (1, -1)]
            high, low = (likelihood.loss(replace(at, **{name: end})) for end in ends)
            out.append((high - low) / 2e-5)
        return out

    powers = {"measurement": 2, "process": 2} | ({"memory": 1} if any(memory) else {})
    for slope, (name, power) in zip(found, powers.items(), strict=False):
        np.testing.assert_allclose(slope, differences(name, power), rtol=1e-6, atol=1e-6)


def test_plain_estimates_keep_noise_levels(basic, still_log):
    problem = RegressionProblem(basic, (still_log,))
    estimate = add_noise(problem, estimate_iv(basic, [still_log]))
    assert estimate.prefilter == "none"
    np.testing.assert_allclose(estimate.noise.measurement, 0.014142)


def test_margins_cut_rows_of_the_simulated_motion(basic, still_log):
    estimate = estimate_refined_iv(basic, [still_log], margins={"v": 1.0})
    assert estimate.kept < estimate.samples
    assert estimate.status.startswith("prefiltered by the noise, converged")


def test_a_short_log_is_estimated(basic):
    estimate = estimate_refined_iv(basic, [virtual_log(7, 150, **STILL)])
    assert np.isfinite(estimate.theta).all()
    assert (estimate.std > 0).all()


def sets_shown(estimate):
    """Sets that hold under weak instruments, as the summary shows them."""
    sets = weak_safe_sets(estimate.tests)
    assert ("weak-safe" in estimate.summary()) == bool(sets)
    return sets


@pytest.mark.parametrize("prefilter", ["noise", "none"])
def test_sets_that_hold_under_weak_instruments_belong_to_the_estimate(thesis, prefilter):
    log = virtual_log(11, 700)
    found = estimate_once([log], thesis, "iv", "augmented", Request(prefilter=prefilter))
    sets = sets_shown(found)
    assert set(sets) == set(found.labels)
    for label, value, std in zip(found.labels, found.params, found.std_errors, strict=True):
        assert any((a is None or a <= value) and (b is None or value <= b) for a, b in sets[label])
        low, high = sets[label][0]
        # never surer than the interval beside it
        assert low is None or high is None or high - low > 2 * 1.9 * std


def test_no_other_estimate_shows_sets_of_instruments(basic, still_log):
    assert not sets_shown(estimate_ls(basic, [still_log]))
    test = next(t for t in estimate_ls(basic, [still_log]).tests if t.kind == "anderson_rubin")
    assert test.sentence.startswith("of plain instrumental variables beside this estimate")


def test_the_choice_says_why_it_does_not_refine(thesis, still_log):
    refined = estimate_once([still_log], thesis, "iv", "basic", Request())
    assert refined.prefilter == "noise"
    closed = estimate_once([still_log], thesis, "iv", "basic", Request(loop="closed"))
    assert closed.prefilter == "none"
    assert closed.noise is not None
    assert any("not refined by the noise" in n for n in closed.notes)
    with pytest.raises(UsageError, match="open loop and zero-mean instruments, and instruments"):
        estimate_once(
            [still_log], thesis, "iv", "basic", Request(prefilter="noise", zero_mean=False)
        )


def test_a_prediction_that_diverges_is_an_error(basic, still_log, refined, monkeypatch):
    plain = estimate_iv(basic, [still_log])
    wild = replace(plain, theta=1e3 * plain.theta)
    assert add_noise(RegressionProblem(basic, (still_log,)), wild).noise is None
    # least squares serves as a start where the plain estimate cannot be simulated
    again = estimate_refined_iv(basic, [still_log], start=wild)
    assert (np.abs(again.theta - refined.theta) < 0.05 * refined.std).all()
    monkeypatch.setattr("greybox.estimation.refined.solve_ls", lambda problem: wild)
    with pytest.raises(ExcitationError, match="left its bound at sample"):
        estimate_refined_iv(basic, [still_log], start=wild)


@pytest.mark.parametrize("converging", [1, 2, 3])
def test_rounds_that_do_not_converge_begin_again_from_least_squares(
    basic, still_log, refined, monkeypatch, converging
):
    tried = []
    rounds = refinement._refine

    def only_some(work, point, theta, keep):
        found = rounds(work, point, theta, keep)
        tried.append((point.theta, found))
        return replace(found, converged=len(tried) >= converging)

    monkeypatch.setattr(refinement, "_refine", only_some)
    again = estimate_refined_iv(basic, [still_log])
    assert len(tried) == min(converging, 2)
    # where no start converges the first one's estimate is given, else the converged one
    kept = 1 if converging == 2 else 0
    np.testing.assert_array_equal(again.theta, tried[kept][1].theta)
    # both starts end at one estimate here: the choice of the start is no choice of the result
    np.testing.assert_allclose(again.theta, refined.theta, atol=0.05 * refined.std.max())
    if converging > 1:
        ls = estimate_ls(basic, [still_log], covariance="white").theta
        np.testing.assert_array_equal(tried[1][0], ls)


def test_singular_instruments_are_an_error(basic, still_log):
    e = build_regression(basic, [still_log]).experiments[0]
    motion = predicted_motion(basic, still_log, np.zeros(len(basic.columns)), np.zeros(3))
    noise = replace(NOISE, memory=np.zeros(3), further=np.array([0.01]))
    band = ErrorBand(motion.slopes, np.ones(len(motion.x), bool))
    rows = white_rows(basic, band, noise, np.tile(e.phi[:1], (len(e.phi), 1)), e.phi, e.y)
    assert np.isnan(solve_white([rows])[0]).all()
    bad = replace(noise, measurement=np.full(3, np.nan))
    with pytest.raises(ExcitationError, match="covariance of 1499 equation errors is singular"):
        white_rows(basic, band, bad, motion.z, e.phi, e.y)


def test_a_bound_needs_a_model_that_runs(basic, still_log, true_theta):
    noise = NoiseLevels(("u", "v", "r"), np.full(3, 0.014), np.zeros(3))
    with pytest.raises(DivergenceError, match="the model on the inputs of 'virtual'"):
        iv_bound(basic, [still_log], -20 * true_theta, noise)


@pytest.mark.long
@pytest.mark.parametrize("correlation_time", [0.0, 40.0])
def test_intervals_cover_and_the_bound_is_reached(thesis, true_theta, basic, correlation_time):
    """60 trials with process noise, white or slow: coverage, and efficiency where white."""
    from scipy.special import digamma

    from greybox.model.run.simulation import simulate
    from greybox.trial.log import make_log

    runs, samples = 60, 1200
    base = virtual_log(21, samples, noise=0.0, **STILL)
    tau = base.forces(thesis.inputs)[:-1]
    levels = np.array([2e-3, 4e-3, 2e-4])
    rng = np.random.default_rng(8)
    want = estimate_iv(basic, [base], start=true_theta).theta
    theta, std = [], []
    for _ in range(runs):
        w = levels * stationary_disturbance(
            rng, np.zeros(3), 1.0, samples - 1, correlation_time=correlation_time
        )
        run = simulate(thesis, true_theta, np.array([1.5, 1.2, 0.0]), tau, 1.0, process_noise=w)
        x = run.x[0] + np.sqrt(2e-4) * rng.standard_normal(run.x[0].shape)
        channels = dict(base.channels) | {"u": x[:, 0], "v": x[:, 1], "r": x[:, 2]}
        channels["psi"] = run.psi[0] + 0.01 * rng.standard_normal(samples)
        estimate = estimate_refined_iv(basic, [make_log(base.vessel, channels, 1.0, "run")])
        theta.append(estimate.theta)
        std.append(estimate.std)
    inside = (np.abs(np.array(theta) - want) < 1.96 * np.array(std)).mean(axis=1)
    assert abs(inside.mean() - 0.95) < 0.01 + 3 * inside.std() / np.sqrt(runs)
    noise = NoiseLevels(("u", "v", "r"), np.full(3, np.sqrt(2e-4)), levels, 0.01)
    memory = np.full(3, np.exp(-1 / correlation_time)) if correlation_time else None
    bound = iv_bound(basic, [base], true_theta, noise, memory=memory)
    p = len(want)
    # mean of log det of a sample covariance
    shift = digamma((runs - 1 - np.arange(p)) / 2).sum() + p * np.log(2 / (runs - 1))
    empirical = np.linalg.slogdet(np.cov(np.array(theta).T))[1] - shift
    efficiency = np.exp((np.linalg.slogdet(bound)[1] - empirical) / p)
    assert efficiency > 0.9 * (1 - 3 * np.sqrt(2 / (runs * p)))


@pytest.mark.parametrize(("walk", "left"), [(0.0, 0.3), (2e-3, 0.75)])
def test_a_heading_is_freed_of_its_noise_as_far_as_it_drifts(walk, left):
    rng = np.random.default_rng(3)
    rate = 0.02 * np.sin(np.arange(1500) / 40)
    true = np.concatenate([[0.3], 0.3 + np.cumsum(rate[:-1] + walk * rng.standard_normal(1499))])
    noise = 0.01 * rng.standard_normal(1500)
    found = smoothed_heading(true + noise, rate, 1.0)
    error = found - true
    assert error.std() < left * noise.std()
    # little of a sample's own noise is left in it
    assert np.corrcoef(error, noise)[0, 1] < 0.6
    # without noise, or on a short log, it is what was measured
    np.testing.assert_array_equal(smoothed_heading(0.3 + 0 * rate, 0 * rate, 1.0), 0.3 + 0 * rate)
    np.testing.assert_array_equal(smoothed_heading(true[:15], rate[:15], 1.0), true[:15])


def test_the_smoothed_heading_equals_that_of_statsmodels():
    rng = np.random.default_rng(8)
    drift = np.cumsum(2e-3 * rng.standard_normal(400))
    measured = drift + 0.01 * rng.standard_normal(400)
    found = smoothed_heading(measured, np.zeros(400), 1.0)
    change, grown = np.diff(measured), measured[20:] - measured[:-20]
    noise = -np.mean(change[1:] * change[:-1])
    walk = max((np.mean(grown**2) - 2 * noise) / 20, 1e-4 * noise)
    model = UnobservedComponents(measured, "llevel", use_exact_diffuse=True)
    expected = model.smooth([noise, walk]).smoothed_state[0]
    np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.long
def test_a_measured_heading_is_no_instrument_for_itself():
    """With its noise in the instruments `Ymu` was 0.6 of its standard error off."""
    names = get_structure("thesis").parameters
    structure = get_structure("thesis")
    regime = (("u", (1,)), ("v", (1,)), ("r", (1, -1)))
    predictor = build_predictor(structure, "wind", regime)
    off = []
    for k in range(40):
        log = virtual_trial(np.random.default_rng([5, k]), CASES[0])
        plain = estimate_iv(predictor, [log], wind="measured", judged=False)
        found = estimate_refined_iv(predictor, [log], start=plain, wind="measured").model()
        order = [found.names.index(n) for n in names]
        true = np.array([TRUE[n] for n in names])
        off.append((found.theta[order] - true) / found.std[order])
    mean = np.mean(off, axis=0)
    # means of 40 have a standard error of 0.16
    assert np.abs(mean).max() < 0.16 * 3.5
    assert abs(mean[names.index("Ymu")]) < 0.2 + 0.16 * 1.5


def test_a_stretch_in_which_nothing_can_be_used_changes_nothing(basic, still_log):
    log, short = still_log.window(0, 400, "log"), still_log.window(500, 504, "short")
    holes = replace(short, missing={"v": np.array([False, True, True, False])})
    alone, beside = estimate_refined_iv(basic, [log]), estimate_refined_iv(basic, [log, holes])
    assert beside.kept == alone.kept
    np.testing.assert_allclose(beside.theta, alone.theta, rtol=1e-6, atol=1e-9)
