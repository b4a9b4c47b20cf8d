"""Errors that a slow force imitates, and likelihoods with many hills."""

from __future__ import annotations

import zlib
from dataclasses import replace

import numpy as np
import pytest
from changing import FACTOR, MOMENT, changed_log, fitted

from greybox.diagnosis.diagnose import diagnose
from greybox.diagnosis.evidence.features import features, knots_of
from greybox.diagnosis.evidence.held_out import Pair
from greybox.diagnosis.noise import fit_noise
from greybox.diagnosis.point import Fit
from greybox.diagnosis.refitting import loosened
from greybox.diagnosis.ruling import _drifts
from greybox.study.blind import draw
from greybox.trial.log import TrialLog


@pytest.fixture(scope="module")
def changed() -> TrialLog:
    """A pulse trial whose sway damping grows at a moment."""
    return changed_log()


def test_a_moment_far_off_is_found_by_scanning(changed: TrialLog) -> None:
    problem, hypothesis, fit = fitted(changed, MOMENT - 18.0)
    found = problem.settle(problem.scan(fit, hypothesis), 2)
    factor, moment = problem.scan(found, hypothesis).point.values[0]
    assert moment == pytest.approx(MOMENT, abs=2.0)
    assert factor == pytest.approx(FACTOR, rel=0.1)


def test_the_profile_is_the_least_squares_of_the_other_numbers(changed: TrialLog) -> None:
    problem, hypothesis, fit = fitted(changed, MOMENT)
    k = problem.numbers_of(fit.point, hypothesis)[1]
    vector = fit.point.vector()
    rows = np.concatenate([r.reshape(-1, r.shape[2]) for r in problem.rows(fit.point, fit.noise)])
    others = np.delete(rows, k, axis=1)
    values = vector[k] + np.array([-20.0, 0.0, 7.0])
    expected = []
    for value in values:
        vector[k] = value
        nu, _ = problem.whitened(fit.noise, problem.errors(fit.point.at(vector)))
        stacked = np.concatenate([n.ravel() for n in nu])
        scale = np.sqrt((others**2).sum(axis=0))
        solved = np.linalg.lstsq(others / scale, stacked, rcond=None)[0]
        expected.append(float(((stacked - others / scale @ solved) ** 2).sum()))
    np.testing.assert_allclose(problem.profile(fit, k, values), expected, rtol=1e-6)


def test_the_interval_of_a_moment_holds_it_and_reaches_no_further_than_was_looked(
    changed: TrialLog,
) -> None:
    problem, hypothesis, fit = fitted(changed, MOMENT)
    found = problem.settle(problem.scan(fit, hypothesis), 2)
    spread = problem.spread(found, hypothesis)
    assert set(spread) == {"Yv_time"}
    reach = hypothesis.parameters[1].reach
    assert 0 <= spread["Yv_time"] <= reach / 3
    assert abs(found.point.values[0][1] - MOMENT) <= 3 * spread["Yv_time"] + 1.5


def test_a_colour_that_forgets_remembers_no_longer_than_asked(changed: TrialLog) -> None:
    problem, _, fit = fitted(changed, MOMENT)
    slow = 0.3 * np.sin(np.arange(len(changed)) / 60)
    errors = [np.asarray(fit.errors[0]) + slow[:, None]]
    poles = problem.poles(fit.point)
    free = fit_noise(errors, poles, 1.0, problem.groups)
    short = fit_noise(errors, poles, 1.0, problem.groups, longest=3.0)
    assert max(g.remembered for g in free.groups) > 30
    assert max(g.remembered for g in short.groups) <= 3.0 + 1e-6
    # no colour under a bound is likelier than the likeliest of all
    assert problem.whitened(free, errors)[1] <= problem.whitened(short, errors)[1] + 1e-6


def test_forces_that_begin_at_a_speed_are_among_the_features(changed: TrialLog) -> None:
    problem, _, fit = fitted(changed, MOMENT)
    knots = knots_of(problem)
    assert knots.shape == (3, 3)
    assert (np.diff(knots, axis=1) > 0).all()
    run, start = problem.runs[0], fit.point.starts[0]
    made = features(run, fit, start, knots).values
    surge = np.abs(run.run(fit.point.ship, start).x[:, 0])
    wanted = np.maximum(surge - knots[0, 1], 0.0)
    assert wanted.any()
    assert min(np.abs(made - wanted[:, None]).max(axis=0)) < 1e-12


def test_costs_of_channels_sum_to_that_of_all(changed: TrialLog) -> None:
    problem, _, fit = fitted(changed, MOMENT)
    costs = problem.costs(fit)
    assert costs.shape == (len(problem.groups),)
    assert costs.sum() == pytest.approx(fit.cost)


@pytest.mark.parametrize(("other", "expected"), [(0, True), (1, False)])
def test_a_slow_force_moves_the_same_channel_in_every_log(
    changed: TrialLog, other: int, expected: bool
) -> None:
    problem, _, fit = fitted(changed, MOMENT)
    poles = problem.poles(fit.point)

    def pushed(channel: int) -> Fit:
        errors = np.array(fit.errors[0])
        errors[:, channel] += 0.3 * np.sin(np.arange(len(errors)) / 50)
        noise = fit_noise([errors], poles, 1.0, problem.groups)
        nu, cost = problem.whitened(noise, [errors])
        return replace(fit, errors=(errors,), noise=noise, nu=tuple(nu), cost=cost)

    pair = Pair(problem, pushed(0), problem, pushed(other))
    assert _drifts([pair]) is expected


@pytest.mark.long
def test_a_strong_wind_is_not_left_to_the_colour_of_the_errors() -> None:
    # taken with errors that were believed slow, its sway coefficient had stayed where it was
    rng = np.random.default_rng([904, zlib.crc32(b"windzigzag"), 0])
    trial = draw(rng, ("wind",), kind="zigzag")
    found = diagnose([trial.estimation], validate=[trial.validation])
    assert found.verdict == "named"
    (wind,) = found.causes
    truth = trial.truth[0].parameters
    for name in ("Wuu", "Wvv", "Wuv"):
        quantity = wind.parameters[name]
        assert abs(quantity.value - truth[name]) < 4 * quantity.std


def test_a_fit_that_is_held_by_slow_errors_isloosened(changed: TrialLog) -> None:
    problem, hypothesis, fit = fitted(changed, MOMENT)
    good = problem.settle(problem.scan(fit, hypothesis), 2)
    assert loosened(problem, good) is good
    slow = 0.5 * np.sin(np.arange(len(changed)) / 60)
    wrong = [np.asarray(e) + slow[:, None] for e in good.errors]
    noise = fit_noise(wrong, problem.poles(good.point), 1.0, problem.groups)
    vector = good.point.vector()
    vector[problem.names.index("Yv")] *= 1.3
    point = good.point.at(vector)
    errors = problem.errors(point)
    nu, cost = problem.whitened(noise, errors)
    held = replace(good, point=point, noise=noise, nu=tuple(nu), errors=tuple(errors), cost=cost)
    found = loosened(problem, held)
    assert found.cost < held.cost
    assert found.cost == pytest.approx(good.cost, abs=10)


@pytest.mark.long
def test_a_force_slower_than_gusts_is_not_nothing() -> None:
    trial = draw(np.random.default_rng([46, 1]), ("slow_force",), kind="manoeuvres")
    found = diagnose([trial.estimation], validate=[trial.validation])
    assert found.verdict == "unexplained"
    assert "lasts longer than gusts" in found.remaining


@pytest.mark.long
def test_the_gain_of_a_lever_arm_is_that_of_the_sensors_frame() -> None:
    # the arm of some metres carries 0.1 m/s of the yaw rate's noise into a corrected log
    trial = draw(np.random.default_rng([46, 3]), ("lever_arm",), kind="pulses", positions=False)
    found = diagnose([trial.estimation], validate=[trial.validation])
    assert [c.id for c in found.causes] == ["lever_arm"]
    assert all(found.gain[s].after > found.gain[s].before for s in ("u", "v"))
    assert any("as its sensors show it" in note for note in found.notes)
    held = [r for r in found.runs if r.held_out]
    assert held
