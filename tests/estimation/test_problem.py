"""One estimate forms its regression once, its instruments once a model, its forces once a log."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from virtual import virtual_log

from greybox.model.predictor import build_predictor
from greybox.regression.problem import RegressionProblem
from greybox.selection.cross_validation import Refit
from greybox.selection.estimate import estimate_model

REGIME = (("u", (1,)), ("v", (1,)), ("r", (1, -1)))


@pytest.fixture
def counted(monkeypatch):
    """How often what is expensive is formed, by function and model."""
    count: Counter[str] = Counter()

    def count_calls(place, name, key=lambda *_: ""):
        module = __import__(place, fromlist=[name])
        original = getattr(module, name)

        def call(*args, **options):
            count[name, key(*args)] += 1
            return original(*args, **options)

        monkeypatch.setattr(module, name, call)

    count_calls("greybox.regression.problem", "build_regression")
    count_calls(
        "greybox.regression.problem", "build_instruments", lambda p, logs, theta: theta.tobytes()
    )
    count_calls(
        "greybox.trial.log", "actuated_force",
        lambda _, given, *__: b"".join(np.asarray(v).tobytes() for v in given.values()),
    )  # fmt: skip
    count_calls("greybox.credibility.judge", "assess")
    count_calls("greybox.selection.estimate", "weigh")
    return count


def test_one_estimate_forms_each_thing_once(counted, monkeypatch):
    log, other = virtual_log(31, 1000), virtual_log(34, 100)
    # estimates on parts of the log, which calibrate the bands, form their own
    monkeypatch.setattr(
        "greybox.selection.prediction.refit_alike", lambda found, _: Refit(lambda _: found.model())
    )
    counted.clear()
    found = estimate_model(
        [log], method="iv", predictor="augmented", structure="linear", validate=other
    )
    assert found.prefilter == "noise"
    assert {name for name, _ in counted} == {
        "build_regression", "build_instruments", "actuated_force", "assess", "weigh"
    }  # fmt: skip
    assert max(counted.values()) == 1
    # the first model, each refinement, and the estimate itself for its tests
    refinements = sum(name == "build_instruments" for name, _ in counted)
    assert 3 <= refinements <= 10


def test_instruments_of_a_model_are_simulated_once(thesis, true_theta, counted):
    predictor = build_predictor(thesis, "basic", REGIME)
    problem = RegressionProblem(predictor, (virtual_log(32, 300),))
    counted.clear()
    first = problem.instruments(true_theta)
    assert problem.instruments(true_theta.copy()) is first
    other = problem.instruments(0.9 * true_theta)
    assert other is not first
    assert max(counted.values()) == 1
    cut = [np.arange(299) > 10]
    np.testing.assert_array_equal(problem.instruments(true_theta, cut).keep[0], cut[0])
