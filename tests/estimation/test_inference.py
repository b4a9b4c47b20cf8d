"""Labelled results: parameters, intervals, and tests of linear restrictions."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import statsmodels.api as sm
from linearmodels.iv import IV2SLS

import greybox as gb
from greybox.errors import GreyboxError
from greybox.estimation.inference import wald_test

NAMES = ("Xu", "X_uuu", "N_|r|r")


@pytest.fixture(scope="module")
def regression():
    rng = np.random.default_rng(7)
    x = rng.standard_normal((200, 3)) * [1.0, 1e3, 1e-4]
    y = x @ [0.1, 2e-4, 900.0] + rng.standard_normal(200)
    return y, pd.DataFrame(x, columns=["a", "b", "c"])


@pytest.fixture(scope="module")
def estimate(thesis, noisy_log):
    return gb.estimate_ls(gb.build_predictor(thesis, "basic"), [noisy_log], judged=False)


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        ("Xu = 0", "a = 0"),
        ("Xu = 0, X_uuu = 3e-4", "a = 0, b = 0.0003"),
        ("N_|r|r = 5000*Xu + 2", "c - 5000*a = 2"),
        ("X_uuu - 0.001 Xu = 0", "b - 0.001*a = 0"),
    ],
)
def test_wald_statistics_are_those_of_others(regression, ours, theirs):
    y, x = regression
    ols = sm.OLS(y, x).fit(use_t=False)
    mine = wald_test(NAMES, ols.params.to_numpy(), ols.cov_params().to_numpy(), ours)
    other = ols.wald_test(theirs, use_f=False, scalar=True)
    assert mine.statistic == pytest.approx(float(other.statistic), rel=1e-8)
    assert mine.p_value == pytest.approx(float(other.pvalue), rel=1e-6)
    assert mine.df == theirs.count("=")
    robust = IV2SLS(y, x, None, None).fit(cov_type="robust")
    again = wald_test(NAMES, robust.params.to_numpy(), robust.cov.to_numpy(), ours)
    assert again.statistic == pytest.approx(robust.wald_test(formula=theirs).stat, rel=1e-8)


def test_values_of_parameters_are_a_restriction_each(regression):
    y, x = regression
    ols = sm.OLS(y, x).fit(use_t=False)
    theta, covariance = ols.params.to_numpy(), ols.cov_params().to_numpy()
    by_value = wald_test(NAMES, theta, covariance, {"Xu": 0.1, "N_|r|r": 900})
    in_words = wald_test(NAMES, theta, covariance, ["Xu = 0.1", "N_|r|r = 900"])
    assert by_value.statistic == pytest.approx(in_words.statistic)
    assert by_value.null == "Xu = 0.1 and N_|r|r = 900"
    assert by_value.parameters == ("Xu", "N_|r|r")
    every = wald_test(NAMES, theta, covariance, None)
    assert every.statistic == pytest.approx(float(ols.wald_test(np.eye(3), scalar=True).statistic))


@pytest.mark.parametrize(
    ("restriction", "told"),
    [
        ("Xu", "write it as 'Xu = 2\\*Yv \\+ 0.1'"),
        ("Xu = = 2", "cannot be read"),
        ("Xu * X_uuu = 0", "cannot be read"),
        ("Xuu = 0", "Did you mean 'Xu'"),
        ("Xu = 0, 2*Xu = 0", "2 restrictions hold 1 independent"),
        ({}, "there is no restriction to test"),
        (0.1, "the restriction 0.1 names no parameter: write 'Xu = 0.1' or {'Xu': 0.1}"),
        ([0.1, 0.2, 0.3], "the restriction 0.1 names no parameter"),
        (np.eye(3), "names no parameter: write 'Xu = 0.1'"),
        (("Xu = 0", 2), "the restriction 2 names no parameter"),
        ("2 = 2", "'2 = 2' names no parameter: write it as 'Xu = 0.1'"),
        ("Xu = Xu", "'Xu = Xu' names no parameter"),
        ({0: 0.1}, "names '0', which is no parameter"),
        ({"Xu": "fast"}, "restriction of 'Xu' is 'fast', a finite number is needed"),
        ({"Xu": np.nan}, "restriction of 'Xu' is nan, a finite number is needed"),
    ],
)
def test_a_restriction_that_cannot_be_tested_says_so(restriction, told):
    with pytest.raises(GreyboxError, match=told):
        wald_test(NAMES, np.ones(3), np.eye(3), restriction)


def test_a_parameter_that_is_known_exactly_cannot_be_tested():
    with pytest.raises(GreyboxError, match="standard error of Xu = 0 is not known"):
        wald_test(NAMES, np.ones(3), np.zeros((3, 3)), "Xu = 0")


def test_results_are_labelled(estimate):
    assert list(estimate.params.index) == list(estimate.names)
    assert estimate.params["Xu"] == estimate["Xu"]
    table = estimate.to_pandas()
    np.testing.assert_allclose(estimate.std_errors, table["std"])
    np.testing.assert_allclose(np.sqrt(np.diag(estimate.cov)), estimate.std_errors)
    limits = estimate.conf_int(level=0.9)
    width = (limits["upper"] - limits["lower"]) / estimate.std_errors
    np.testing.assert_allclose(width, 2 * 1.6448536269514722)
    tested = estimate.wald_test({"Xu": estimate["Xu"], "Nr": 0.0})
    assert tested.df == 2
    assert tested.null.startswith("Xu = ")
    assert tested.to_dict()["distribution"] == "χ²(2)"
    with pytest.raises(GreyboxError, match="level of an interval is 95"):
        estimate.conf_int(level=95)
    with pytest.raises(GreyboxError, match="level of an interval is 2, give a number"):
        estimate.conf_int(np.float64(2.0))
    with pytest.raises(GreyboxError, match="level of an interval is 'Xu', give a number"):
        estimate.conf_int("Xu")
    with pytest.raises(KeyError, match=r"no parameter 'Xuv'\. Did you mean"):
        estimate["Xuv"]
