"""Designs with a model that holds a force without a name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from designs import thesis_model

from experiment_design import (
    DesignRequest,
    TrialLimits,
    design_trial,
    predict_precision,
    prepare_request,
)
from experiment_design.request.request import build_problem
from greybox.model.model import ManoeuvringModel
from greybox.model.terms import Factor, Term
from greybox.study.chapter6 import TRUE


def with_bump(model: ManoeuvringModel, size: float) -> ManoeuvringModel:
    """Return the model with a brake of surge where sway is about 1.2 m/s."""
    bump = Term("X_g1", "u", (Factor("v", centre=1.2, width=0.8),))
    covariance = np.zeros((len(model.theta) + 1,) * 2)
    covariance[:-1, :-1] = model.covariance
    covariance[-1, -1] = (0.1 * size) ** 2
    structure = replace(model.structure, terms=(*model.structure.terms, bump))
    return replace(
        model, structure=structure, theta=np.append(model.theta, size), covariance=covariance
    )


@pytest.mark.usefixtures("hasty")
def test_it_moves_the_ship_and_is_no_parameter() -> None:
    asked = DesignRequest(
        60.0, TrialLimits(margins={"u": 0.2, "v": 0.2}), regime="u+v+", start=(1.5, 1.2, 0.0, 0.0),
        predictor="basic", effort=0.02, process_noise=np.array([2e-3, 2e-3, 4e-4]),
    )  # fmt: skip
    prior = replace(thesis_model(spread=0.05), residual_std=np.full(3, 0.02))
    prepared = prepare_request(with_bump(prior, -0.05), asked)
    assert any("1 bumps" in note for note in prepared.notes)
    found = design_trial(prepared, workers=1)
    assert "X_g1" not in found.names
    assert set(found.names) < set(TRUE)
    assert np.isfinite(found.std).all()
    motion = found.motions[0].state[0]
    assert np.min(motion[:, :2]) > 0.2 - 1e-3
    # the motion is that of the whole model: without the force it is another one
    bare = build_problem(prepare_request(prior, asked)).scenarios[0].rollout
    assert np.abs(bare.run(found.commands[0][None]).state[0, :, 0] - motion[:, 0]).max() > 0.05
    # and the information of output error follows it too
    plan = dict(zip(found.request.schedule.commands, found.commands[0].T, strict=True))
    told = predict_precision(replace(prepared, estimator="oe"), [plan])
    other = predict_precision(prepare_request(prior, replace(asked, estimator="oe")), [plan])
    assert told.names == other.names
    assert not np.allclose(told.std, other.std, rtol=0.02)
