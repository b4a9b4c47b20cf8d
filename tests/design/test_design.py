"""Sequences keep their limits; predicted precision equals what Monte Carlo finds."""

from __future__ import annotations

import numpy as np
import pytest

from experiment_design import prbs, predict_precision, random_two_level, to_log
from greybox.errors import ExcitationError, VesselError
from greybox.model.predictor import build_predictor
from greybox.model.simulation import simulate
from greybox.study.monte_carlo import Batch, BatchRegression
from greybox.vessel.toml import load_vessel

START = np.array([1.5, 1.2, 0.0, 0.0])


def test_two_level_sequences_sit_at_their_limits(ship):
    c = random_two_level(ship, 95, 10, np.random.default_rng(0))
    assert set(np.unique(c["n"])) <= {10.0, 20.0}
    assert set(np.unique(c["alpha1"])) <= {0.6, 1.1}
    changes = np.flatnonzero(np.diff(c["n"])) + 1
    assert (changes % 10 == 0).all()
    assert len(c["n"]) == 95


def test_prbs_is_balanced_and_shifted(ship):
    c = prbs(ship, 511, 1)
    assert abs((c["n"] == 20).mean() - 256 / 511) < 1e-9
    assert abs(np.corrcoef(c["n"], c["alpha1"])[0, 1]) < 0.01


def test_commands_without_limits_are_refused():
    with pytest.raises(VesselError, match="'n1' has no limits"):
        prbs(load_vessel("ferry"), 10, 1)


def test_predicted_precision_holds(ship, thesis, true_theta):
    """White equation error: the spread of IV estimates is the predicted one."""
    rng = np.random.default_rng(1)
    plan = to_log(ship, random_two_level(ship, 600, 10, rng), 1.0)
    predictor = build_predictor(thesis, "basic", (("u", (1,)), ("v", (1,))))
    noise = {"u": 2e-3, "v": 2e-3, "r": 4e-4}
    predicted = predict_precision(predictor, true_theta, plan, START, noise)
    runs = 300
    tau = plan.forces(thesis.inputs)
    w = rng.standard_normal((runs, 600, 3)) * list(noise.values())
    ship_runs = simulate(thesis, true_theta, START[:3], tau, 1.0, process_noise=w)
    batch = Batch(ship_runs.x, np.array(ship_runs.psi), tau[None], None, START[:3])
    iv = BatchRegression(predictor, batch).refine(true_theta)
    spread = iv.theta[:, predictor.parameter_columns].std(axis=0, ddof=1)
    # basic regressors see the process noise too, which moves the states a little
    assert np.abs(np.log(spread / predicted.std)).max() < 0.3
    assert predicted.names == predictor.parameter_names
    assert "log det" in predicted.summary()


def test_a_plan_that_moves_nothing(ship, thesis, true_theta):
    still = {"n": np.full(60, 10.0), "alpha1": np.zeros(60), "alpha2": np.zeros(60)}
    predictor = build_predictor(thesis, "basic", (("u", (1,)), ("v", (1,))))
    start = np.array([1.0, 0.0, 0.0, 0.0])
    with pytest.raises(ExcitationError, match="is not excited by this plan"):
        predict_precision(
            predictor, true_theta, to_log(ship, still, 1.0), start, {"u": 1, "v": 1, "r": 1}
        )
