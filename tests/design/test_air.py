"""The velocity through the air in a trial that measures the wind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from designs import hasty_search, make_request, thesis_model

from experiment_design import DesignRequest, TrialLimits, design_trial, prepare_request
from experiment_design.feasibility.least_violation import moved_constant
from experiment_design.optimise.campaign import random_campaign
from experiment_design.request.apparent_wind import air_velocity, clear_heading, share_near_zero
from experiment_design.request.request import build_problem, draw_gusts
from greybox.errors import UsageError

WIND = (5.0, 2.0)


def measured_wind(**changes):
    model = thesis_model()
    sensors = {"u_std": 0.0141, "v_std": 0.0141, "r_std": 0.0141, "wind_std": 0.2}
    vessel = replace(model.vessel, sensors=sensors | changes)
    return replace(model, vessel=vessel)


def wind_request(margin=None, **asked):
    asked = DesignRequest(
        300.0, predictor="wind", wind=WIND, effort=0.05, limits=TrialLimits(margin_air=margin),
        **asked,
    )  # fmt: skip
    return prepare_request(measured_wind(), asked)


def through_the_air(motion, wind):
    """u_q, v_q (N, 2) by rotating the ground velocity out and back."""
    state = motion.state[0, :-1]
    e = np.exp(1j * state[:, 3])
    q = ((state[:, 0] + 1j * state[:, 1]) * e - (wind[..., 0] + 1j * wind[..., 1])) / e
    return np.stack([q.real, q.imag], axis=1)


@pytest.fixture(scope="module")
def free():
    with hasty_search():
        return design_trial(wind_request(), workers=1, alternatives=False)


def test_gusts_are_of_regressors_alone():
    asked = {"regime": "u+v+", "start": (1.5, 1.2, 0.0, 0.0)}
    assert any("--gust to change" in n for n in wind_request(**asked).notes)
    asked["estimator"] = "oe"
    assert not any("--gust" in n for n in wind_request(**asked).notes)
    with pytest.raises(UsageError, match="and estimator 'oe' fits free runs: leave it"):
        wind_request(gust=2.0, **asked)


@pytest.mark.long
def test_where_no_random_sequence_keeps_a_margin_a_steady_course_is_moved():
    problem = build_problem(wind_request(0.6))
    assert random_campaign([problem], 0) == (None, 0)
    found = moved_constant(problem, 0)
    assert found is not None
    assert found.feasible
    assert np.isfinite(found.value)
    assert np.ptp(found.unit, axis=0).min() > 0.01
    # a margin above the speed of the wind and the ship is kept on no course
    assert moved_constant(build_problem(wind_request(9.0)), 0) is None


@pytest.mark.long
def test_a_plan_keeps_its_margin_through_the_air():
    """No random sequence keeps it, a steady course does; the plan still tells every parameter."""
    design = design_trial(wind_request(0.6), workers=1, alternatives=False)
    assert design.random_kept == 0
    found = through_the_air(design.motions[0], np.array(WIND))
    assert np.abs(found).min() >= 0.6 - 1e-3
    # neither component changes its sign
    assert (np.abs(np.sign(found).sum(axis=0)) == len(found)).all()
    assert np.isfinite(design.std).all()
    assert not [n for n in design.notes if "planned sample" in n]


def test_without_a_margin_the_share_of_doubtful_samples_is_told(free):
    request = free.request
    wind = np.array(WIND) + draw_gusts(request)
    near = (np.abs(through_the_air(free.motions[0], wind)) <= 0.6).any(axis=1).mean()
    assert share_near_zero(request, free.motions) == near > 0
    note = next(n for n in free.notes if "planned samples" in n)
    assert note.startswith(f"{100 * near:.2g} % of the planned samples have |u_q| or |v_q| within")
    assert "Remark 4.2" in note
    assert "--margin-air" in note


@pytest.mark.long
def test_a_wind_sensor_of_unknown_noise():
    request = wind_request()
    silent = replace(request, noise=replace(request.noise, wind=0.0), duration=120.0)
    design = design_trial(silent, workers=1, alternatives=False)
    assert any("state wind_std under [sensors]" in n for n in design.notes)


@pytest.mark.usefixtures("hasty")
def test_only_a_measured_wind_has_a_margin():
    with pytest.raises(UsageError, match="predictor 'augmented' does not measure it"):
        prepare_request(
            thesis_model(), DesignRequest(150.0, wind=WIND, limits=TrialLimits(margin_air=0.5))
        )
    design = design_trial(make_request(effort=0.05), workers=1, alternatives=False)
    assert not [n for n in design.notes if "|u_q|" in n]


def test_the_start_heads_where_the_margin_is_kept_best():
    velocity, wind = np.array([1.5, 1.2]), np.array(WIND)
    psi = clear_heading(velocity, wind)
    best = np.abs(air_velocity(velocity, np.array(psi), wind)).min()
    for other in np.linspace(0, 2 * np.pi, 721):
        e = np.exp(1j * other)
        q = (1.5 + 1.2j) - (WIND[0] + 1j * WIND[1]) / e
        # a degree turns the wind by at most its speed times 0.0175
        assert min(abs(q.real), abs(q.imag)) <= best + 5.4 * 0.0175
    request = wind_request(0.6)
    assert request.starts[0][3] != 0.0
    given = wind_request(0.6, start=(1.5, 1.2, 0.0, 0.3))
    assert given.starts[0][3] == 0.3
