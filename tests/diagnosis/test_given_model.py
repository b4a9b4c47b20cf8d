"""A model that was given is judged as it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.diagnosis.diagnose import DiagnosisOptions, diagnose
from greybox.errors import LogError
from greybox.study.blind import draw
from greybox.vessel.toml import load_vessel

QUICK = DiagnosisOptions(causes=["current"])


@pytest.fixture(scope="module")
def sailed():
    trial = draw(np.random.default_rng([3, 11]), samples=900)
    found = diagnose([trial.estimation], validate=[trial.validation], options=QUICK)
    assert found.verdict == "none"
    return trial, found.model


def test_the_model_of_these_logs_has_nothing_wrong(sailed) -> None:
    trial, model = sailed
    found = diagnose([trial.estimation], model=model, validate=[trial.validation], options=QUICK)
    assert found.verdict == "none"
    assert found.model.theta.tolist() == model.theta.tolist()
    assert any("'before' is the model as it was given" in n for n in found.notes)


def test_a_model_of_another_ship_is_refused(sailed) -> None:
    trial, model = sailed
    other = replace(model, vessel=load_vessel("ferry"))
    with pytest.raises(LogError, match=r"has no 'n3', .* the model's ship, 'Ferry': give a model"):
        diagnose([trial.estimation], model=other)


def test_coefficients_that_do_not_hold_here_are_wrong(sailed) -> None:
    trial, model = sailed
    scale = np.ones(len(model.theta))
    scale[model.names.index("Nr")] = 1.4
    other = replace(model, theta=model.theta * scale)
    found = diagnose([trial.estimation], model=other, validate=[trial.validation], options=QUICK)
    assert found.verdict == "unexplained"
    assert "estimating the coefficients of the model again lowers the squared error" in (
        found.remaining
    )
    assert found.next_steps[0].startswith("estimate the model's coefficients from these logs")
    # what is told to be wrong is of the model as it is, not of one that was mended
    assert any("yaw rate" in s.sentence for s in found.wrong)
    assert found.model.theta.tolist() == other.theta.tolist()
