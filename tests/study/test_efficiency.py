"""The efficiency study: its factors multiply, and the estimators reach what they should."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.report.efficiency import efficiency_output
from greybox.report.studies import write_output
from greybox.study.efficiency import (
    CASES,
    CaseResult,
    Efficiency,
    determinant_efficiency,
    reproduce_efficiency,
)


@pytest.fixture
def drawn():
    """Estimates drawn with twice the covariance of best IV, and with the Cramér-Rao one."""
    rng = np.random.default_rng(0)
    names = ("Xu", "Yv", "Nr")
    bound = np.diag([1.0, 0.25, 4.0])
    best = 3.0 * bound
    true = np.array([1.0, -2.0, 0.5])
    cases = []
    for case in CASES:
        theta, std = {}, {}
        for estimator in case.estimators:
            spread = 2 * best if "IV" in estimator else bound
            theta[estimator] = true + rng.multivariate_normal(np.zeros(3), spread, 400)
            std[estimator] = np.tile(np.sqrt(np.diag(spread)), (400, 1))
            # a failed run is left out
            theta[estimator][7] = np.nan
        cases.append(CaseResult(case, names, true, bound, best, theta, std))
    return Efficiency(400, tuple(cases))


def test_total_is_the_product_of_both_factors(drawn):
    for result in drawn.cases:
        overall, single = result.loss()
        assert overall == pytest.approx(1 / 3)
        total = result.determinant("IV", result.cramer_rao).value
        against = result.determinant("IV", result.optimal_iv).value
        assert total == pytest.approx(against * overall)
        for i, share in enumerate(result.parameter("IV", result.optimal_iv)):
            whole = result.parameter("IV", result.cramer_rao)[i]
            assert whole.value == pytest.approx(share.value * single[i])
            assert share.low < 0.5 < share.high


def test_known_efficiencies_and_coverage_are_found(drawn):
    result = drawn.cases[0]
    share = result.determinant("refined IV", result.optimal_iv)
    assert share.low < 0.5 < share.high
    assert result.determinant("OE", result.cramer_rao).low < 1
    assert result.determinant("OE", result.cramer_rao).high > 1
    assert result.coverage("OE") == pytest.approx(np.full(3, 0.95), abs=0.04)
    assert len(result.errors("OE")) == 399


def test_rescaling_a_parameter_changes_no_efficiency():
    rng = np.random.default_rng(1)
    errors, bound = rng.standard_normal((50, 3)), np.eye(3)
    scale = np.array([1.0, 1e-3, 1e4])
    one = determinant_efficiency(errors, bound)
    other = determinant_efficiency(errors * scale, bound * np.outer(scale, scale))
    assert other.value == pytest.approx(one.value)


def test_output_has_tables_figures_and_both_factors(drawn, tmp_path):
    write_output(efficiency_output(drawn, {"program": "test"}), tmp_path)
    page = (tmp_path / "report.html").read_text()
    for words in (
        "IV against best IV",
        "OE, total",
        "best IV against Cramér-Rao",
        "95 % intervals",
    ):
        assert words in page
    lines = (tmp_path / "tables.csv").read_text().splitlines()
    assert lines[0].startswith("table,set,estimator,parameter,mean,sd")
    assert len(lines) == 1 + 3 * 6
    assert (tmp_path / "efficiency_no_process_noise.png").stat().st_size > 5000


@pytest.mark.long
def test_likelihood_reaches_the_bound():
    study = reproduce_efficiency(24, seed=5, samples=1000)
    for result, estimator, least in zip(
        study.cases, ("OE", "innovations"), (0.95, 0.85), strict=True
    ):
        assert len(result.errors(estimator)) == 24
        assert result.determinant(estimator, result.cramer_rao).high > least
        assert abs(result.coverage(estimator).mean() - 0.95) < 0.06
