"""Estimators compared by free runs on parts that were left out."""

from __future__ import annotations

import numpy as np
import pytest
from virtual import virtual_log

from greybox.errors import ExcitationError, UsageError
from greybox.estimation.verdict import Misfit, NoRegression, TrustLevel, Verdict, refused
from greybox.selection import estimate as selecting
from greybox.selection.cross_validation import (
    EstimatorComparison,
    EstimatorVariant,
    compare_estimators,
    parts_of,
)
from greybox.selection.estimate import estimate_model, estimate_requested
from greybox.selection.held_out import FLOOR, spread_of
from greybox.selection.request import Request
from greybox.validation.fit import run_model

VARIANTS = (EstimatorVariant("iv"), EstimatorVariant("oe"), EstimatorVariant("oe", "deviation"))
SMALL = Request(structure="linear", predictor="basic")


def comparison(*rows):
    return EstimatorComparison(VARIANTS[: len(rows)], np.array(rows, float))


def test_the_first_way_stays_unless_another_gains_more_than_its_error():
    clear = comparison([10, 20, 30, 40], [30, 41, 49, 60])
    assert clear.chosen == 1
    gain, se = clear.gains[1]
    assert gain == pytest.approx(20.0)
    # Student's t with 3 degrees of freedom is 1.197 where the normal is 1
    assert se == pytest.approx(1.1969 * np.std([20, 21, 19, 20], ddof=1) / 2, rel=1e-3)
    assert "oe is 20.0 ± 0.5 better than iv." in clear.sentence()
    doubtful = comparison([10, 20, 30, 40], [90, 20, 10, 40])
    assert doubtful.chosen == 0
    assert "better than iv, which stays" in doubtful.sentence()
    worse = comparison([10, 20, 30, 40], [0, 10, 20, 30], [5, 15, 25, 35])
    assert worse.chosen == 0
    assert "none is better than iv." in worse.sentence()


def test_of_several_sure_gains_the_largest_is_taken():
    assert comparison([0, 0, 0, 0], [9, 10, 11, 10], [20, 60, 10, 50]).chosen == 2
    assert comparison([0, 0, 0, 0], [9, 10, 11, 10], [-90, 150, -90, 150]).chosen == 1


def test_parts_that_an_estimator_refuses_are_not_held_against_it():
    none = np.nan
    assert comparison([10, 20, 30, none], [20, 30, 41, -100]).chosen == 1
    refused = comparison([10, 20, none, none], [90, 90, 90, 90])
    assert refused.chosen == 0
    assert "oe refused" in comparison([1, 2, 3, 4], [none] * 4).sentence()


def test_that_all_fail_is_said():
    assert "None predicts better than a constant" in comparison([-9, -8, -7, -5]).sentence()


def test_logs_are_left_out_in_balanced_groups_and_a_single_log_in_parts():
    log = virtual_log(3, 400, spread=0.0)
    logs = [log.window(0, n, str(n)) for n in (400, 60, 120, 300, 90, 200)]
    parts = parts_of(logs)
    assert len(parts) == 4
    assert sorted(x.name for _, held in parts for x in held) == sorted(x.name for x in logs)
    for fitting, held in parts:
        assert {x.name for x in fitting} == {x.name for x in logs} - {x.name for x in held}
        assert 170 <= sum(map(len, held)) <= 400
    assert [len(held[0]) for _, held in parts_of([log])] == [100] * 4
    assert len(parts_of(logs[:2])) == 2
    with pytest.raises(UsageError, match="4 parts of 15"):
        parts_of([log.window(0, 60)])


@pytest.mark.long
def test_an_estimate_to_be_trusted_is_compared_with_nothing(monkeypatch):
    def never(*_):
        raise AssertionError

    monkeypatch.setattr(selecting, "compare_estimators", never)
    assert estimate_model([virtual_log(3, 1500)]).verdict.text == "trust"


@pytest.fixture(scope="module")
def small():
    """Three logs of a ship that the structure is too small for, and a fourth one."""
    return [virtual_log(k, 300, spread=0.0) for k in (3, 5, 6, 8)]


@pytest.mark.long
def test_where_the_model_misfits_held_out_runs_choose(small):
    *logs, other = small
    found = estimate_requested(logs, SMALL)
    assert found.verdict.level is TrustLevel.DO_NOT_TRUST
    assert "so the estimators were compared by free runs" in found.notes[-1]

    def level(estimate):
        fit = run_model(estimate.model(), other).fit.values()
        return np.mean([max(v, FLOOR) for v in fit])

    plain = estimate_model(logs, method="iv", structure="linear", predictor="basic")
    assert level(found) > level(plain) - 5


@pytest.mark.long
def test_ways_that_fail_have_no_score(small, monkeypatch):
    logs = small[:3]
    found = estimate_model(logs, method="ls", structure="linear", predictor="basic")
    whole = compare_estimators(found, logs, SMALL)
    assert whole.variants == (
        EstimatorVariant("ls"),
        EstimatorVariant("iv"),
        EstimatorVariant("oe"),
        EstimatorVariant("oe", "deviation"),
    )
    # of three logs each held-out run is scored in two halves
    assert whole.scores.shape == (4, 6)
    assert np.isfinite(whole.scores).all()

    def refuse(*_, **__):
        raise ExcitationError("nothing moves.")

    monkeypatch.setattr("greybox.estimation.solve.solve_iv", refuse)
    partly = compare_estimators(found, logs, SMALL)
    assert np.isnan(partly.scores[1]).all()
    np.testing.assert_allclose(partly.scores[0], whole.scores[0])


@pytest.mark.long
def test_a_misfit_that_was_found_is_not_forgotten(small, monkeypatch):
    """Output error of a wrong structure may look sound; the regression's tests have spoken."""
    logs = small[:3]
    lacks = Misfit({"input_independence": ("u",)}, {})
    monkeypatch.setattr(selecting, "misfit", lambda _: (lacks,))
    judged = refused([NoRegression("a reason")], ())
    finish = selecting._finished

    def sound(alternative, *rest):
        estimate, diverged = finish(alternative, *rest)
        verdict = Verdict(TrustLevel.TRUST) if alternative.method == "oe" else judged
        return selecting.replace(estimate, verdict=verdict), diverged

    monkeypatch.setattr(selecting, "_finished", sound)
    better = EstimatorComparison(
        (EstimatorVariant("iv"), EstimatorVariant("oe", "deviation")),
        np.array([[0.0] * 4, [9.0] * 4]),
    )
    monkeypatch.setattr(selecting, "compare_estimators", lambda *_: better)
    found = estimate_requested(logs, SMALL)
    assert found.method == "oe"
    assert "weighed by the deviation" in found.status
    assert found.verdict.because == (lacks,)
    assert found.notes[-1] == better.sentence()
    # one that follows its own logs less well than the regression is left
    monkeypatch.setattr(selecting, "_level", lambda e: -50.0 if e.method == "oe" else 0.0)
    found = estimate_requested(logs, SMALL)
    assert found.method != "oe"
    assert "follows the whole logs less well" in found.notes[-1]


def test_where_no_regression_can_be_solved_output_error_is_tried(monkeypatch):
    def singular(*_, **__):
        raise ExcitationError("the instruments are singular.")

    monkeypatch.setattr("greybox.estimation.solve.solve_iv", singular)
    monkeypatch.setattr("greybox.estimation.solve.solve_ls", singular)
    log = virtual_log(3, 400, spread=0.0)
    request = Request(structure="thesis", predictor="wind")
    assert estimate_requested([log], request).method == "oe"
    monkeypatch.setattr("greybox.estimation.output_error.estimate_oe", singular)
    with pytest.raises(ExcitationError, match="the instruments are singular"):
        estimate_requested([log], request)


def test_scores_of_whole_logs_are_the_fit():
    from greybox.model.catalogue import get_structure
    from greybox.model.predictor import build_predictor
    from greybox.selection.fit_single import estimate_ls
    from greybox.selection.held_out import score_runs

    log = virtual_log(3, 400, spread=0.0)
    predictor = build_predictor(get_structure("thesis"), "basic+wind", (("u", (1,)), ("v", (1,))))
    run = run_model(estimate_ls(predictor, [log], judged=False).model(), log)
    want = np.mean([max(v, FLOOR) for v in run.fit.values()])
    assert score_runs([run], spread_of([log], "uvr")) == pytest.approx(want)
