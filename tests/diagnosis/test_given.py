"""Causes that are taken for granted: the same model as where they were found."""

from __future__ import annotations

import zlib

import numpy as np
import pytest

from greybox.diagnosis.assumed_causes import fit_given
from greybox.diagnosis.diagnose import diagnose
from greybox.diagnosis.null_model import run_on
from greybox.study.blind import draw


def squares(model, log) -> float:
    """Squared free-run errors of the states in their sensors' variances."""
    run = run_on(model, log)
    sigma = [log.vessel.sensors[f"{s}_std"] for s in run.fit]
    error = (log.states(tuple(run.fit)) - run.x) / sigma
    return float((error**2).sum())


@pytest.mark.long
def test_a_cause_that_is_given_is_fitted_as_one_that_was_found() -> None:
    trial = draw(np.random.default_rng([31, 1]), ("current",), kind="manoeuvres", samples=600)
    given = fit_given([trial.estimation], ["current"], validate=[trial.validation])
    found = diagnose([trial.estimation], validate=[trial.validation])
    assert [c.id for c in found.causes] == ["current"]
    assert given.after.names == found.model.names
    std = np.sqrt(np.diag(found.model.covariance))
    assert (np.abs(given.after.theta - found.model.theta) < 0.1 * std).all()
    for state, gain in given.gain.items():
        assert gain.after == pytest.approx(found.gain[state].after, abs=0.5)
    # its first states are measured there, fitted here
    before, after = (squares(m, trial.estimation) for m in (given.before, given.after))
    assert given.fall == pytest.approx(1 - after / before, abs=0.03)
    assert given.fall > 0.5


@pytest.mark.long
def test_a_cause_that_does_not_act_lowers_little() -> None:
    trial = draw(np.random.default_rng([31, 2]), (), kind="pulses", samples=400)
    given = fit_given([trial.estimation], ["quadratic_yaw_damping"], validate=[trial.validation])
    assert "N_|r|r" in given.after.names
    assert abs(given.fall) < 0.05


@pytest.mark.long
def test_a_thrust_law_whose_run_leaves_every_bound_gets_coefficients_of_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # a zig-zag at several speeds: with the coefficients of a linear law, a share of n|n| that is
    # counted at a speed below the root mean square runs away
    monkeypatch.setattr(
        "greybox.diagnosis.preparing.typical_speed",
        lambda logged: float(np.median(np.abs(np.concatenate(logged)))),
    )
    rng = np.random.default_rng([2027, zlib.crc32(b"quadratic_thrust zigzag"), 0])
    trial = draw(rng, ("quadratic_thrust",), kind="zigzag")
    found = diagnose([trial.estimation], validate=[trial.validation])
    assert found.steps[0][0].key == "quadratic_thrust"
    assert found.steps[0][0].promise == 0.0
    assert [c.id for c in found.causes] == ["quadratic_thrust"]
    share = found.causes[0].parameters["quadratic_share"]
    assert abs(share.value - 1.0) < 3 * share.std
    assert all(g.ci[0] > 0 for g in found.gain.values())
    given = fit_given([trial.estimation], ["quadratic_thrust"], validate=[trial.validation])
    assert given.fall > 0.9


@pytest.mark.long
def test_a_wrong_sign_that_is_given_stays_beside_other_causes() -> None:
    effects = ("current", "sign")
    trial = draw(np.random.default_rng([31, 5]), effects, kind="manoeuvres", samples=600)
    given = fit_given([trial.estimation], effects, validate=[trial.validation])
    true = trial.truth[0].parameters
    for name, value in true.items():
        found, std = given.after.disturbances[name]
        assert abs(found - float(value)) < 4 * std + 0.005
    assert all(g.after > 50 for g in given.gain.values())
