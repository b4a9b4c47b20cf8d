"""LS and IV: exact without noise, equal to outside oracles, honest standard errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import statsmodels.api as sm
from linearmodels.iv import IV2SLS
from virtual import virtual_log

from greybox.credibility.judge import run_tests
from greybox.errors import ExcitationError, UsageError
from greybox.estimation.covariance import (
    block_bootstrap,
    correlation_lags,
    score_covariance,
)
from greybox.estimation.disturbance import estimate_current
from greybox.estimation.normal_equations import solve_stacked
from greybox.estimation.problem import Fitted
from greybox.estimation.solve import _less_mean
from greybox.model.catalogue import get_structure
from greybox.model.predictor import build_predictor
from greybox.regression.instruments import build_instruments
from greybox.regression.problem import RegressionProblem
from greybox.regression.regression import build_regression
from greybox.selection.fit_single import estimate_iv, estimate_ls
from greybox.study.chapter6 import TRUE as STUDY
from greybox.study.efficiency import CASES, virtual_trial
from greybox.trial.log import make_log

REGIME = (("u", (1,)), ("v", (1,)))


def sums(predictor, true_theta, structure):
    return np.array(
        [
            sum(true_theta[structure.index(t)] for t in predictor.columns[i].terms)
            for i in predictor.parameter_columns
        ]
    )


@pytest.mark.parametrize("method", [estimate_ls, estimate_iv])
def test_exact_without_noise(thesis, true_theta, clean_log, method):
    predictor = build_predictor(thesis, "basic", REGIME)
    estimate = method(predictor, [clean_log])
    np.testing.assert_allclose(
        estimate.theta, sums(predictor, true_theta, thesis), rtol=1e-6, atol=1e-10
    )


@pytest.mark.parametrize("kind", ["augmented", "wind"])
def test_exact_with_a_constant_disturbance(thesis, true_theta, kind):
    """Constant current, no noise: the bias terms take all of it."""
    # the wind must change to be told from what its mean does
    varying = 1.0 if kind == "wind" else 0.0
    log = virtual_log(3, 1500, wind=0.3, noise=0.0, spread=0.0, wind_spread=varying)
    predictor = build_predictor(thesis, kind, REGIME)
    estimate = estimate_iv(predictor, [log], start=true_theta)
    got = estimate.theta[predictor.parameter_columns]
    np.testing.assert_allclose(got, sums(predictor, true_theta, thesis), rtol=2e-5, atol=1e-8)
    np.testing.assert_allclose([c[1] for c in estimate.current], [0.2, -0.2], rtol=1e-4)


def test_least_squares_equals_statsmodels(thesis, noisy_log):
    predictor = build_predictor(thesis, "basic", REGIME)
    estimate = estimate_ls(predictor, [noisy_log], covariance="white")
    e = build_regression(predictor, [noisy_log]).experiments[0]
    for row, state in enumerate("uvr"):
        mine = predictor.equation(state)
        oracle = sm.OLS(e.y[row], e.phi[mine].T).fit(cov_type="HC1")
        np.testing.assert_allclose(estimate.theta[mine], oracle.params, rtol=1e-8)
        np.testing.assert_allclose(estimate.std[mine], oracle.bse, rtol=1e-8)


def test_instrumental_variables_equal_linearmodels(thesis, noisy_log, nominal_theta):
    """Three logs with instruments of their own: two-stage least squares on blocks."""
    logs = [noisy_log.window(i * 1200, (i + 1) * 1200) for i in range(3)]
    predictor = build_predictor(thesis, "augmented", REGIME)
    estimate = estimate_iv(predictor, logs, start=nominal_theta, refine=False)
    regression = build_regression(predictor, logs)
    instruments = build_instruments(predictor, logs, nominal_theta)
    for row, state in enumerate("uvr"):
        mine = predictor.equation(state)
        phi = np.hstack([e.phi[mine] for e in regression.experiments]).T
        y = np.concatenate([e.y[row] for e in regression.experiments])
        z = np.zeros((len(y), 3 * len(mine)))
        for i, part in enumerate(instruments.z):
            block = part[mine].T / part[mine].std(axis=1)
            z[i * 1199 : (i + 1) * 1199, i * len(mine) : (i + 1) * len(mine)] = block
        oracle = IV2SLS(y, None, phi / phi.std(axis=0), z).fit()
        want = oracle.params.to_numpy() / phi.std(axis=0)
        np.testing.assert_allclose(estimate.theta[mine], want, rtol=1e-5)


def test_robust_covariance_equals_a_slow_sum():
    rng = np.random.default_rng(0)
    z, e = rng.normal(size=(3, 80)), rng.normal(size=80)
    fast, _ = score_covariance([[z]], [[e]], "hac", lags=3)
    slow = np.zeros((3, 3))
    for i in range(80):
        for j in range(80):
            weight = min(1.0, max(0.0, (7 - abs(i - j)) / 4))
            slow += weight * np.outer(z[:, i] * e[i], z[:, j] * e[j])
    if np.linalg.eigvalsh(slow)[0] > 0:
        np.testing.assert_allclose(fast, slow, rtol=1e-10)
    gamma = [float(e[k:] @ e[: 80 - k]) / (80 - k) for k in range(3)]
    r = sum(gamma[k] * (np.eye(80, k=k) + (np.eye(80, k=-k) if k else 0)) for k in range(3))
    ma, _ = score_covariance([[z]], [[e]], "ma", lags=2)
    want = z @ r @ z.T
    if np.linalg.eigvalsh(want)[0] > 0:
        np.testing.assert_allclose(ma, want, rtol=1e-10)


def test_cut_rows_do_not_shrink_the_covariance():
    rng = np.random.default_rng(5)
    z, e = rng.normal(size=(2, 4000)), rng.normal(size=4000)
    keep = np.arange(4000) % 4 == 0
    z[:, ~keep], e[~keep] = 0.0, 0.0
    for kind in ("white", "hac", "ma"):
        total, _ = score_covariance([[z]], [[e]], kind, lags=0)
        np.testing.assert_allclose(np.diag(total), 1000, rtol=0.15)


def test_memory_of_a_moving_average_is_found():
    rng = np.random.default_rng(1)
    white = rng.normal(size=4001)
    assert correlation_lags([white]) == 0
    assert correlation_lags([white[1:] - 0.9 * white[:-1]]) == 1


def test_rescaling_units_changes_nothing(thesis, noisy_log, nominal_theta):
    """Twice the propeller unit halves the gains and leaves the rest."""
    log = noisy_log.window(0, 1500)
    doubled = replace(log, channels={**log.channels, "n": 2 * log["n"]})
    predictor = build_predictor(thesis, "augmented", REGIME)
    start = nominal_theta.copy()
    scale = np.array([0.5 if "tau" in str(t) else 1.0 for t in thesis.terms])
    one = estimate_iv(predictor, [log], start=start)
    two = estimate_iv(predictor, [doubled], start=start * scale)
    wanted = predictor.parameter_columns
    ratio = np.array([scale[thesis.index(predictor.columns[i].terms[0])] for i in wanted])
    np.testing.assert_allclose(two.theta[wanted], one.theta[wanted] * ratio, rtol=1e-4)
    np.testing.assert_allclose(two.std[wanted], one.std[wanted] * ratio, rtol=1e-3)


def test_mixing_instruments_changes_nothing():
    rng = np.random.default_rng(2)
    z = [rng.normal(size=(4, 50)) for _ in range(3)]
    phi = [a[:2] + 0.3 * rng.normal(size=(2, 50)) for a in z]
    y = [np.array([1.0, -2.0]) @ f + 0.1 * rng.normal(size=50) for f in phi]
    mix = rng.normal(size=(4, 4)) + 3 * np.eye(4)
    one = solve_stacked(z, phi, y)
    two = solve_stacked([mix @ a for a in z], phi, y)
    np.testing.assert_allclose(one.theta, two.theta, rtol=1e-9)
    plain = solve_stacked(z, phi, y, metric="identity")
    rows, right = [], []
    for ze, fe, ye in zip(z, phi, y, strict=True):
        zs = ze / np.sqrt((ze**2).mean(axis=1))[:, None]
        rows.append(zs @ fe.T / 50)
        right.append(zs @ ye / 50)
    want = np.linalg.lstsq(np.vstack(rows), np.concatenate(right), rcond=None)[0]  # (4.5)
    np.testing.assert_allclose(plain.theta, want, rtol=1e-9)


@pytest.mark.long
def test_standard_errors_cover(thesis, true_theta, nominal_theta):
    """95 % intervals of IV2, and of the current, over independent trials."""
    predictor = build_predictor(thesis, "augmented", REGIME)
    truth = sums(predictor, true_theta, thesis)
    inside, current = [], []
    runs = 40
    for seed in range(runs):
        log = virtual_log(500 + seed, 3000, wind=0.2)
        e = estimate_iv(predictor, [log], start=nominal_theta)
        wanted = predictor.parameter_columns
        inside.append(np.abs(e.theta[wanted] - truth) < 1.96 * e.std[wanted])
        current.append(
            [abs(v - w) < 1.96 * s for (_, v, s), w in zip(e.current, (0.2, -0.2), strict=True)]
        )
    share = np.mean(inside)
    # rows of one run are related: count a run as about four independent draws
    assert abs(share - 0.95) < 3 * np.sqrt(0.95 * 0.05 / (4 * runs))
    assert np.mean(current) > 0.95 - 3 * np.sqrt(0.95 * 0.05 / (2 * runs))


def test_bootstrap_agrees_with_the_moving_average(thesis, noisy_log, nominal_theta):
    predictor = build_predictor(thesis, "augmented", REGIME)
    one = estimate_iv(predictor, [noisy_log], start=nominal_theta, covariance="ma")
    two = estimate_iv(predictor, [noisy_log], start=nominal_theta, covariance="bootstrap")
    wanted = predictor.parameter_columns
    ratio = two.std[wanted] / one.std[wanted]
    assert 0.6 < np.median(ratio) < 1.6
    assert (ratio < 4).all()


def test_the_centre_of_an_equation_is_that_of_the_samples_that_take_part():
    keep = np.array([True, True, False])
    np.testing.assert_array_equal(_less_mean(np.array([[1.0, 2.0, 9.0]]), keep), [[-0.5, 0.5, 7.5]])
    # what is cut out everywhere counts nowhere
    np.testing.assert_array_equal(_less_mean(np.ones((1, 3)), ~keep & keep), np.ones((1, 3)))


def test_bootstrap_of_white_noise_has_the_known_spread():
    rng = np.random.default_rng(3)
    x = rng.normal(size=(2, 4000))
    y = np.array([1.0, 2.0]) @ x + rng.normal(size=4000)
    draws = block_bootstrap([([x], [x], [y])], rng, draws=400)
    np.testing.assert_allclose(draws.std(axis=0), 1 / np.sqrt(4000), rtol=0.25)


def test_bootstrap_keeps_what_equations_have_in_common():
    rng = np.random.default_rng(4)
    x = rng.normal(size=(1, 4000))
    e = rng.multivariate_normal([0, 0], [[1.0, 0.8], [0.8, 1.0]], 4000).T
    draws = block_bootstrap([([x], [x], [x[0] + e[i]]) for i in range(2)], rng)
    # 500 draws of about 63 blocks
    assert np.corrcoef(draws.T)[0, 1] == pytest.approx(0.8, abs=0.15)


def test_mean_kept_instruments_need_an_intercept(thesis, noisy_log):
    predictor = build_predictor(thesis, "augmented", REGIME)
    with pytest.raises(UsageError, match="intercept"):
        estimate_iv(predictor, [noisy_log], zero_mean=False)
    with_constant = build_predictor(thesis, "augmented", REGIME, intercept=True)
    assert np.isfinite(estimate_iv(with_constant, [noisy_log], zero_mean=False).theta).all()


def test_margins_cut_samples_and_count_them(thesis, noisy_log, nominal_theta):
    predictor = build_predictor(thesis, "basic", REGIME)
    limit = float(np.quantile(noisy_log["u"], 0.3))
    e = estimate_iv(predictor, [noisy_log], start=nominal_theta, margins={"u": limit}, refine=False)
    assert 0.4 * e.samples < e.kept < e.samples
    ls = estimate_ls(predictor, [noisy_log], margins={"u": limit})
    assert abs(ls.kept / ls.samples - 0.7) < 0.02
    cut = next(t for t in e.tests if t.name == "margin_u")
    assert f"{e.samples - e.kept} samples were cut out" in cut.sentence


def test_second_measurement_of_the_disturbance():
    """(4.13): y1 + y2 in the regressors removes the bias of a disturbance with a mean."""
    from greybox.study.chapter4 import SETS, virtual_batch
    from greybox.study.monte_carlo import BatchRegression

    rng = np.random.default_rng(0)
    batch = virtual_batch(rng, SETS[3], 40, 5000)
    regression = BatchRegression(build_predictor(get_structure("siso"), "basic"), batch)
    iv2 = regression.refine(regression.least_squares())
    error = iv2.theta.mean(axis=0) - [-0.1, 1.0]
    assert (np.abs(error) < 4 * iv2.theta.std(axis=0) / np.sqrt(40) + [0.003, 0.002]).all()


@pytest.mark.long
def test_anemometer_noise_does_not_bias_the_wind_terms(thesis, true_theta):
    """Smoothed wind in the instruments; as measured, its noise biases Wuu towards zero."""
    predictor = build_predictor(thesis, "wind", REGIME)
    found = {"smoothed": [], "measured": []}
    for seed in range(10):
        log = virtual_log(700 + seed, 3000, wind=5.0, wind_spread=0.8**2)
        rng = np.random.default_rng(seed)
        noisy = {k: log[k] + 1.5 * rng.standard_normal(len(log)) for k in ("u_q", "v_q")}
        log = make_log(log.vessel, {**log.channels, **noisy}, 1.0)
        for wind, values in found.items():
            values.append(estimate_iv(predictor, [log], start=true_theta, wind=wind)["Wuu"])
    truth = true_theta[thesis.index("Wuu")]
    smoothed, measured = (np.array(found[k]) for k in ("smoothed", "measured"))
    assert abs(np.median(smoothed) - truth) < 4 * smoothed.std() / np.sqrt(10)
    assert np.median(measured) / truth < 0.6


def test_a_constant_term_takes_the_mean_residual(clean_log):
    structure = get_structure("thesis-Wuu-Wvv-Wuv+X_0")
    predictor = build_predictor(structure, "basic", REGIME)
    e = estimate_iv(predictor, [clean_log], start=estimate_ls(predictor, [clean_log]))
    assert abs(e["X_0"]) < 1e-7


def test_diverging_instruments_are_reported(thesis, noisy_log, nominal_theta):
    predictor = build_predictor(thesis, "basic", REGIME)
    unstable = nominal_theta.copy()
    unstable[0] = 0.9
    with pytest.raises(ExcitationError, match="left its bound at sample"):
        estimate_iv(predictor, [noisy_log], start=unstable)


def test_too_few_samples(thesis, noisy_log):
    predictor = build_predictor(thesis, "augmented", REGIME)
    with pytest.raises(ExcitationError, match="25 samples take part and one equation has 15"):
        estimate_ls(predictor, [noisy_log.window(0, 26)])


def test_unexcited_parameters_are_named(thesis, clean_log):
    still = {**clean_log.channels, "v": 0 * clean_log["v"]}
    log = replace(clean_log, channels=still)
    with pytest.raises(ExcitationError, match=r"parameters Xvr, .* are not excited"):
        estimate_ls(build_predictor(thesis, "basic", REGIME), [log])


def test_singular_instruments_name_the_parameters(thesis, clean_log):
    slave = {**clean_log.channels, "v": 2 * clean_log["u"], "u": clean_log["u"]}
    log = replace(clean_log, channels=slave)
    with pytest.raises(ExcitationError, match="cannot be told apart in the v equation"):
        estimate_ls(build_predictor(thesis, "basic", REGIME), [log])


def test_no_current_without_bias_terms(thesis):
    predictor = build_predictor(thesis, "basic", REGIME)
    p = len(predictor.columns)
    assert estimate_current(predictor, np.ones(p), np.eye(p)) == ()


def test_summary_names_everything(thesis, noisy_log, nominal_theta):
    predictor = build_predictor(thesis, "augmented", REGIME)
    text = estimate_iv(predictor, [noisy_log], start=nominal_theta).summary()
    for name in ("Xuu+Wuu", "Nmu", "current_north", "excitation_u", "per second", "[0.025"):
        assert name in text


@pytest.mark.parametrize(
    ("run", "ends"),
    # rounding decides how the second one ends, which differs from machine to machine
    [(138, ("stopped after",)), (24, ("the refinement had not", "stopped after"))],
)
def test_a_refinement_that_runs_off_gives_what_its_best_instruments_gave(thesis, run, ends):
    """The last estimates of these logs were off by thousands of standard errors."""
    regime = (("u", (1,)), ("v", (1,)), ("r", (1, -1)))
    predictor = build_predictor(thesis, "wind", regime)
    log = virtual_trial(np.random.default_rng([23, 0, run]), CASES[0])
    model = (found := estimate_iv(predictor, [log], wind="measured", judged=False)).model()
    assert found.status.startswith(ends)
    assert found.status.endswith("the estimate of the strongest instruments is given")
    true = np.array([STUDY[n] for n in model.names])
    # 18 intervals that hold their value in 999 of 1000 logs each
    assert (np.abs(model.theta - true) < 3.3 * model.std).all()
    # neither are the standard errors those of an estimate that says nothing
    bound = estimate_iv(predictor, [log], start=true, refine=False, wind="measured", judged=False)
    assert np.median(model.std / bound.model().std) < 3


@pytest.mark.parametrize(("run", "settles"), [(24, False), (0, True)])
def test_a_refinement_that_does_not_settle_is_told(thesis, run, settles):
    regime = (("u", (1,)), ("v", (1,)), ("r", (1, -1)))
    predictor = build_predictor(thesis, "wind", regime)
    log = virtual_trial(np.random.default_rng([23, 0, run]), CASES[0])
    found = estimate_iv(predictor, [log], wind="measured")
    (told,) = [t for t in found.tests if t.name == "convergence"]
    assert (found.converged, told.passed) == (settles, settles)
    assert told.statistic == found.iterations > 0
    assert any("95 % intervals of such" in r for r in found.verdict.reasons) == (not settles)
    again = run_tests(Fitted(found, RegressionProblem(predictor, (log,), wind="measured")))
    assert [t.sentence for t in again.tests if t.name == "convergence"] == [told.sentence]
    once = estimate_iv(predictor, [log], refine=False, wind="measured")
    assert not any(t.name == "convergence" for t in once.tests)
