"""Coefficients and prediction from two estimates in one model, each number said to be whose."""

from __future__ import annotations

import html
import json
from dataclasses import replace

import numpy as np
import pytest
from browser import without_scripts
from schemas import schema
from virtual import virtual_log

from greybox.estimation.prediction_verdict import PredictionLevel
from greybox.estimation.tried import Comparison, TriedModel
from greybox.estimation.verdict import TrustLevel, Verdict
from greybox.model.model import load_model
from greybox.model.versions import VERSION
from greybox.report.estimation import estimation_page
from greybox.report.page import render
from greybox.selection import estimate as selecting
from greybox.selection.estimate import estimate_model
from greybox.validation.fit import average_fit, run_model

TRUST = Verdict(TrustLevel.TRUST)


@pytest.fixture(scope="module")
def log():
    return virtual_log(2, 500, wind=0.0, current=(0.0, 0.0), wind_spread=1e-12)


@pytest.fixture(scope="module")
def small(log):
    """An estimate of coefficients that are trusted, of a structure that is too small to predict."""
    found = estimate_model(log, method="iv", structure="linear", predictor="basic", judged=False)
    return replace(found, verdict=TRUST)


@pytest.fixture(scope="module")
def both(small, log):
    found = estimate_model(log, method="ls", structure="thesis", predictor="basic", judged=False)
    rows = tuple(
        TriedModel(e.predictor.structure.name, "basic", e.method, 1.0, "n", len(e.names), fit)
        for e, fit in ((small, 50.0), (found, 90.0))
    )
    compared = Comparison("ways to predict", "held-out runs", "the best", rows)
    return replace(found, coefficients=small, tried=(compared,))


@pytest.mark.long
def test_a_run_is_never_worse_than_that_of_least_squares(log, small, monkeypatch):
    judged = replace(small, fit=dict.fromkeys("uvr", 0.0))
    monkeypatch.setattr(selecting, "_first_choice", lambda *_: judged)
    found = estimate_model(log)
    fit = average_fit([run_model(found.model(), log)])
    for structure in ("thesis", "linear"):
        plain = estimate_model(log, method="ls", structure=structure, predictor="basic")
        least = average_fit([run_model(plain.model(), log)])
        assert np.mean(list(fit.values())) >= np.mean(list(least.values())) - 1.0
    (compared,) = (c for c in found.tried if c.title == "ways to predict")
    assert {(r.method, r.structure) for r in compared.rows} >= {("ls", "thesis"), ("iv", "linear")}
    assert compared.chosen != compared.rows[0]
    assert found.prediction is not None
    assert found.prediction.level is PredictionLevel.GOOD
    assert found.coefficients is judged or found.coefficients.names == small.names


def test_the_file_keeps_both_and_says_whose_the_verdict_is(both, small, tmp_path):
    both.model().save(tmp_path / "m.json")
    data = json.loads((tmp_path / "m.json").read_text())
    schema(f"model-{VERSION}").validate(data)
    assert data["verdict"]["coefficients"]["of"] == "coefficients"
    assert data["verdict"]["coefficients"]["level"] == "trust"
    assert data["coefficients"]["names"] == list(small.names)
    assert data["coefficients"]["method"] == "iv"
    assert data["names"] == list(both.names)
    model = load_model(tmp_path / "m.json")
    assert model.names == both.names
    assert model.coefficient_model().names == small.names
    np.testing.assert_allclose(model.coefficient_model().theta, small.model().theta)
    assert model.coefficient_model().coefficient_model() == model.coefficient_model()


def test_a_single_estimate_speaks_of_its_own_numbers(small):
    data = small.model().to_dict()
    assert data["verdict"]["coefficients"]["of"] == "theta"
    assert "coefficients" not in data
    assert small.model().coefficient_model() == small.model()


def test_summary_and_page_show_both(both, small, log):
    for shown in (
        both.summary(),
        html.unescape(without_scripts(render(estimation_page(both, [log], {"program": "p"})))),
    ):
        told = " ".join(shown.split())
        assert "are those of iv of structure 'linear', predictor 'basic'" in told
        assert f"{small.theta[0]:.4g}".replace("e-", "e−") in told.replace("e-", "e−")
        assert f"{both.theta[0]:.4g}".replace("e-", "e−") in told.replace("e-", "e−")
        assert "Chosen on the same logs" in told
