"""Designs for vessels whose forces come late, and for models that say how thrusters act."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from designs import limited_ship, make_request, thesis_model

from experiment_design import CandidateModel, design_trial
from experiment_design.constraints.limits import LimitReport
from experiment_design.excitation.rollout import Rollout
from experiment_design.feasibility.actuator_delay import late_notes
from experiment_design.output.prediction import predict_motion
from experiment_design.prepare import prepare_request
from experiment_design.request.request import DesignRequest, build_problem
from greybox.model.run.changes import Change
from greybox.trial.log import make_log
from greybox.validation.fit import run_model
from greybox.vessel.vessel import Actuation

LATE = Actuation(lag=3.0, lag_on="speed", delay=1.5)


def late_ship():
    return replace(limited_ship(), actuation=LATE)


def test_the_reported_motion_is_that_of_the_simulator():
    """A plan with lag and delay moves as `run_model` moves on it as a log."""
    request = make_request("surge", duration=30.0, vessel=late_ship(), effort=0.01)
    design = design_trial(request, alternatives=False, workers=1)
    (motion,), (commands,) = design.motions, design.commands
    n = len(commands)
    channels = {c: commands[:, i] for i, c in enumerate(request.vessel.commands)}
    channels["u"] = np.full(n, request.starts[0][0])
    model = replace(thesis_model("surge"), vessel=request.vessel)
    run = run_model(model, make_log(request.vessel, channels, 1.0))
    np.testing.assert_allclose(motion.state[0, :n, 0], run.x[:, 0], atol=1e-10)
    (band,) = predict_motion(design, draws=1)
    np.testing.assert_allclose(band["u"].nominal[:n], run.x[:, 0], atol=1e-10)
    said = [x for x in design.notes if "the search leaves out a lag of 3 s of the propeller" in x]
    assert said
    assert "a delay of 1.5 s" in said[0]
    assert any("with it the standard errors of coefficients are" in x for x in design.notes)


def test_a_limit_that_the_late_motion_misses_is_named():
    """The note holds the number that the reports do."""
    request = make_request(duration=60.0, vessel=late_ship())
    problem = build_problem(request)
    commands = problem.commands(np.zeros(problem.shape))
    motion = problem.scenarios[0].rollout.run(commands[None], late=True)
    reports = (LimitReport(0, "u", 0.5, "m/s", 0.0), LimitReport(0, "v", 0.4, "m/s", 0.123))
    asked = replace(request, contrasts=((CandidateModel("a", *_explanation(request)),) * 2,))
    notes = late_notes(asked, [problem], (motion,), reports, np.eye(2))
    assert notes[1] == (
        "with it trial 1 misses the limit of v by 0.12 m/s: ask for so much more room there"
    )
    assert late_notes(make_request(), [problem], (motion,), reports, np.eye(2)) == []


def _explanation(request):
    return request.structure, request.theta, np.zeros(4)


def test_a_late_rollout_without_lag_is_the_plain_one():
    request = make_request()
    rollout = Rollout(
        request.vessel, request.structure, request.theta, np.zeros(4), request.starts[0], 1.0
    )
    commands = np.random.default_rng(2).uniform(0.6, 20.0, (3, 40, 3))
    np.testing.assert_array_equal(
        rollout.run(commands).state, rollout.run(commands, late=True).state
    )


def test_a_design_takes_the_model_as_it_is_after_its_changes():
    model = thesis_model(spread=0.01)
    changing = replace(model, changes=(Change("Xu", 1.5, 300.0),))
    asked = DesignRequest(60.0, regime="u+v+", start=(1.5, 1.2, 0.0, 0.0))
    prepared = prepare_request(changing, replace(asked, prior=changing))
    at = model.names.index("Xu")
    assert prepared.theta[at] == pytest.approx(1.5 * model.theta[at])
    plain = prepare_request(model, replace(asked, prior=model))
    got, want = prepared, plain
    assert got.covariance[at, at] == pytest.approx(2.25 * want.covariance[at, at])
    assert got.known[1][at, at] == pytest.approx(want.known[1][at, at] / 2.25)
    assert [n for n in prepared.notes if "Xu is 1.5 times its value from 300 s on" in n]


def test_the_model_says_how_the_thrusters_act():
    """Gain and lag of the model, limits of the vessel file; other thrusters stay as they are."""
    ship = late_ship()
    weak = replace(ship, thrusters=(ship.thrusters[0], replace(ship.thrusters[1], gain=0.6)))
    model = replace(thesis_model(), vessel=weak)
    asked = DesignRequest(60.0, regime="u+v+", start=(1.5, 1.2, 0.0, 0.0))
    file = limited_ship(speed=2.0)
    prepared = prepare_request(model, asked, file)
    got = prepared.vessel
    assert [t.gain for t in got.thrusters] == [1.0, 0.6]
    assert got.actuation == LATE
    assert got.thrusters[1].speed_limits.rate == 2.0
    assert any("those that the model was estimated with" in n for n in prepared.notes)
    moved = replace(file, thrusters=(file.thrusters[0], replace(file.thrusters[1], x=-8.0)))
    assert prepare_request(model, asked, moved).vessel == moved


def test_two_explanations_may_differ_in_a_thruster():
    request = make_request(duration=60.0)
    ship = request.vessel
    weak = replace(ship, thrusters=(ship.thrusters[0], replace(ship.thrusters[1], gain=0.6)))
    first = CandidateModel("whole", *_explanation(request))
    for vessel, told in ((None, False), (weak, True)):
        rival = CandidateModel("weak", *_explanation(request), vessel)
        problem = build_problem(replace(request, contrasts=((first, rival),)))
        unit = np.random.default_rng(3).random((1, *problem.shape))
        value = problem.contrast.value(problem.commands(unit))
        assert (np.exp(value) > 100).all() == told
