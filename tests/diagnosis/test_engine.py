"""Simulator, recursion, noise and fitting of the diagnosis, each against something slow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.diagnosis.causes import Context, known_causes
from greybox.diagnosis.evidence.held_out import long_run_variance, proof_of
from greybox.diagnosis.extension import extended_vessel
from greybox.diagnosis.fitting import Problem
from greybox.diagnosis.hypothesis import Hypothesis, Parameter
from greybox.diagnosis.linear import NOWHERE, Slopes, sensitivities
from greybox.diagnosis.noise import Likelihood, Noise, NoiseModel, fit_noise
from greybox.diagnosis.null_model import _as_it_should_be
from greybox.diagnosis.point import Fit, Point
from greybox.diagnosis.scores import ProjectedScores
from greybox.diagnosis.ship import (
    Change,
    LogRun,
    Sensors,
    Ship,
    derived_motions,
    shifted,
    wired,
)  # fmt: skip
from greybox.diagnosis.simulator import VaryingSimulator
from greybox.diagnosis.waves import find_waves, noise_in, squares_in
from greybox.model.catalogue import get_structure
from greybox.model.run.simulation import simulate
from greybox.model.run.step import StepModel
from greybox.numerics import machine_code
from greybox.rotation import body_to_ned, ned_to_body
from greybox.study.blind import draw
from greybox.study.chapter6 import TRUE
from greybox.trial.convert.sensor_corrections import correct_log
from greybox.trial.log import TrialLog
from greybox.trial.steps import Step

BASE = get_structure("thesis").without("Wuu", "Wvv", "Wuv")
WIDE = BASE.with_terms("N_|r|r", "X_uuu", "Y_u*tauy")


@pytest.fixture(scope="module")
def log() -> TrialLog:
    return draw(np.random.default_rng([5, 1]), kind="pulses", samples=300).estimation


def _theta(structure) -> np.ndarray:
    return np.array([TRUE.get(n, 0.0) for n in structure.parameters])


def _point(run: LogRun, log: TrialLog) -> Point:
    places = tuple(run.structure.index(n) for n in BASE.parameters)
    return Point(Ship(_theta(WIDE), np.zeros(2), log.vessel), (run.start(),), places)


# of a step of several stages the derivatives are those at its middle
_CLOSE = {"euler": 1e-5, "rk4": 5e-3}


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
def test_run_equals_the_free_run_and_differences(log: TrialLog, integrator) -> None:
    run = LogRun(WIDE, log, integrator)
    ship = Ship(_theta(WIDE), np.array([0.2, -0.1]), log.vessel)
    start = run.start()
    shown = run.run(ship, start)
    d = np.array([0.2, -0.1, 0.0, 0.0])
    expected = simulate(
        WIDE, ship.theta, start[:3], log.forces(WIDE.inputs)[:-1], 1.0, psi=log["psi"], d=d,
        integrator=integrator,
    ).x[0]  # fmt: skip
    np.testing.assert_allclose(shown.x, expected, atol=1e-9)
    places = np.array([0, 5, len(ship.theta) + 1])
    found = run.columns(ship, shown, places)
    for k, place in enumerate(places):
        step = 1e-6
        full = np.concatenate([ship.theta, ship.current])
        up, down = (
            run.run(ship.with_value(int(place), full[place] + s), start).y for s in (step, -step)
        )
        slope = (up - down) / (2 * step)
        np.testing.assert_allclose(found[:, :, k], slope, atol=_CLOSE[integrator] * np.ptp(slope))
    # the start's own columns
    moved = start.copy()
    moved[1] += 1e-6
    slope = (run.run(ship, moved).y - shown.y) / 1e-6
    np.testing.assert_allclose(found[:, :, 4], slope, atol=max(1e-4, _CLOSE[integrator]))


def test_slopes_of_a_step_longer_than_the_ship_are_differences(log: TrialLog) -> None:
    """Damping that acts within a sample: no expansion about the middle of the step holds there."""
    run = LogRun(WIDE, log, "rk4")
    theta = _theta(WIDE)
    theta[WIDE.index("Xu")] = -2.0
    ship = Ship(theta, np.array([0.2, -0.1]), log.vessel)
    start = run.start()
    places = np.arange(len(theta) + 2)
    slopes = run.columns(ship, run.run(ship, start), places)
    for place in places:
        value = [*theta, *ship.current][place]
        ends = [run.run(ship.with_value(place, value + h), start).y for h in (-1e-6, 1e-6)]
        difference = (ends[1] - ends[0]) / 2e-6
        size = max(float(np.abs(difference).max()), 1e-6)
        np.testing.assert_allclose(slopes[:, :, place], difference, atol=1e-4 * size)


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
@pytest.mark.parametrize("damping", [-0.2, -2.0])
@pytest.mark.parametrize("changing", [False, True])
def test_slopes_on_arrays_are_those_of_machine_code(
    log: TrialLog, integrator, damping: float, changing: bool, monkeypatch
) -> None:
    step = LogRun(WIDE, log, integrator)._simulator._step
    theta = _theta(WIDE)
    theta[WIDE.index("Xu")] = damping
    if changing:
        theta = theta * np.linspace(0.9, 1.1, len(log))[:, None]
    ship = Ship(_theta(WIDE), np.array([0.2, -0.1]), log.vessel)
    run = LogRun(WIDE, log, integrator)
    given = (run.run(ship, run.start()).x, run._drivers(ship), theta, np.arange(theta.shape[-1]))
    found = Slopes(step)(*given)
    monkeypatch.setattr(machine_code, "find_compiler", lambda: None)
    monkeypatch.setattr(machine_code, "cache_folder", lambda: None)
    expected = Slopes(step)(*given)
    for one, two in ((found.a, expected.a), (found.driven, expected.driven)):
        np.testing.assert_allclose(one, two, rtol=1e-12, atol=1e-13 * np.abs(two).max())


@pytest.mark.parametrize("late", [2.5, -1.25, 0.5])
def test_a_late_channel_is_asked_only_for_what_the_log_holds(log: TrialLog, late: float) -> None:
    run = LogRun(WIDE, log, "rk4")
    plain = Ship(_theta(WIDE), np.zeros(2), log.vessel)
    ship = replace(plain, sensors=Sensors(late=(("u", late),)))
    start = run.start() + np.array([0.4, 0.0, 0.0, 0.0])
    shown, true = run.run(ship, start), run.run(plain, start)
    error = run.y - shown.y
    np.testing.assert_allclose(shown.y[:, 1:], true.y[:, 1:], atol=1e-14)
    u = np.interp(np.arange(len(log)) - late, np.arange(len(log)), true.y[:, 0])
    whole = run.y[:, 0] - u
    if late > 2:
        # samples 0 and 1 show the motion before the log, of sample 2 half
        np.testing.assert_array_equal(error[:2, 0], 0.0)
        np.testing.assert_allclose(error[2, 0], 0.5 * whole[2])
        np.testing.assert_allclose(error[3:, 0], whole[3:], atol=1e-12)
    elif late < 0:
        np.testing.assert_array_equal(error[-1, 0], 0.0)
        np.testing.assert_allclose(error[-2, 0], 0.75 * whole[-2])
        np.testing.assert_allclose(error[:-2, 0], whole[:-2], atol=1e-12)
    else:
        np.testing.assert_allclose(error[0, 0], 0.5 * whole[0])
        np.testing.assert_allclose(error[1:, 0], whole[1:], atol=1e-12)
    slope = run.columns(ship, shown, np.array([0]))[:, :, 0]
    step = 1e-6
    up, down = (run.run(ship.with_value(0, ship.theta[0] + s), start).y for s in (step, -step))
    np.testing.assert_allclose(slope, (up - down) / (2 * step), atol=_CLOSE["rk4"] * np.ptp(slope))


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
def test_slopes_of_hypotheses_are_differences_of_free_runs(log: TrialLog, integrator) -> None:
    run = LogRun(WIDE, log, integrator)
    problem = Problem([run])
    context = Context(
        BASE, log.vessel, run.outputs, False, float(log.t[-1]), 1.0, {"n1": 5.0, "n2": 5.0}
    )
    compared = 0
    for cause in known_causes().values():
        for hypothesis in cause.hypotheses(context):
            if hypothesis.apply is None or not hypothesis.parameters:
                continue
            # off the null, where lags and delays have a kink
            value = hypothesis.start + [7.3 * p.step for p in hypothesis.parameters]
            value = np.clip(value, *np.array([(p.low, p.high) for p in hypothesis.parameters]).T)
            point = replace(_point(run, log), places=())
            point = problem.add(point, hypothesis, value)
            found = problem.slopes(point)[0]
            vector = point.vector()
            for k, parameter in enumerate(hypothesis.parameters):
                step = parameter.step * np.eye(len(vector))[k]
                low, high = (vector[k] + s * step[k] for s in (-1, 1))
                if low < parameter.low or high > parameter.high:
                    continue
                up, down = (problem.errors(point.at(vector + s * step))[0] for s in (-1, 1))
                slope = (up - down) / (2 * step[k])
                size = np.abs(slope).max(axis=0).max()
                assert np.abs(found[:, :, k] - slope).max() < 0.02 * size, hypothesis.key
                compared += 1
    assert compared >= 15


def test_a_log_as_it_should_be_is_what_better_sensors_had_shown(log: TrialLog) -> None:
    run = LogRun(WIDE, log, "rk4")
    sensors = Sensors(lever=(3.0, -2.0), turned=0.1, late=(("v", 2.0),), reversed=("r",))
    ship = Ship(_theta(WIDE), np.zeros(2), log.vessel, sensors=sensors)
    x = run.y[:, :, None]
    seen = run.sense(sensors, x)[:, :, 0]
    channels = dict(log.channels) | {n: seen[:, i] for i, n in enumerate(run.outputs)}
    mended = _as_it_should_be(replace(log, channels=channels), ship)
    for i, name in enumerate(("u", "v", "r")):
        # the last samples of a channel that is two seconds late are not in the log
        np.testing.assert_allclose(mended[name][:-2], run.y[:-2, i], atol=1e-12)


@pytest.mark.parametrize("late", ["u", "r"])
def test_what_was_made_of_one_sensor_shares_its_clock(log: TrialLog, late: str) -> None:
    made = [("u", "v"), ("r",)]
    steps = tuple(Step("difference", c, ("x_n", "y_n", "psi"), {}) for c in made)
    log = replace(log, provenance=replace(log.provenance, steps=steps))
    run = LogRun(WIDE, log, "rk4")
    context = Context(
        BASE, log.vessel, run.outputs, False, float(log.t[-1]), 1.0, {},
        derived=derived_motions(log),
    )  # fmt: skip
    cause = known_causes()["clock_offset"]
    clocks = {h.key: h for h in cause.hypotheses(context)}
    assert list(clocks) == ["clock_offset:u", "clock_offset:r"]
    clock = clocks[f"clock_offset:{late}"]
    pair = "u and v" if late == "u" else "r and psi"
    said = cause.evidence_of(clock, {f"clock_{late}": (2.0, 0.1)})
    assert said == f"{pair}, of one clock, come 2.00 ± 0.10 s too late against the other channels"
    ship = clock.apply(Ship(_theta(WIDE), np.zeros(2), log.vessel), np.array([2.0]))
    # velocities over ground of two seconds before, or turned by the heading of then
    k = np.maximum(np.arange(len(log)) - (2 if late == "u" else 0), 0)
    true = log["psi"] if late == "u" else shifted(log["psi"], -2.0)
    north, east = body_to_ned(run.y[:, 0], run.y[:, 1], true)
    u, v = ned_to_body(north[k], east[k], log["psi"])
    seen = run.sense(ship.sensors, run.y[:, :, None])[:, :, 0]
    np.testing.assert_allclose(seen[2:-2, :2], np.column_stack([u, v])[2:-2], atol=1e-12)
    if late == "u":
        # the vessel file that the model is written with takes it out again
        vessel = extended_vessel(log.vessel, ship.sensors, (), log)
        mended = correct_log(replace(log, channels={**log.channels, "u": u, "v": v}), vessel)
        for i, name in enumerate("uv"):
            np.testing.assert_allclose(mended[name], run.y[: len(mended), i], atol=1e-12)


def test_a_change_is_two_runs(log: TrialLog) -> None:
    run = LogRun(WIDE, log, "euler")
    k = WIDE.index("Yv")
    ship = Ship(_theta(WIDE), np.zeros(2), log.vessel, (Change(k, 2.0, 100.0),))
    x = run.run(ship, run.start()).x
    tau = log.forces(WIDE.inputs)
    later = _theta(WIDE)
    later[k] *= 2
    first = simulate(WIDE, _theta(WIDE), run.start()[:3], tau[:100], 1.0, psi=log["psi"][:101])
    then = simulate(WIDE, later, first.x[0, -1], tau[100:-1], 1.0, psi=log["psi"][100:])
    np.testing.assert_allclose(x, np.vstack([first.x[0], then.x[0, 1:]]), atol=1e-9)


def test_sensors_show_what_they_say(log: TrialLog) -> None:
    run = LogRun(WIDE, log, "euler")
    x = np.random.default_rng(2).standard_normal((len(log), 4, 1))
    lever = run.sense(Sensors(lever=(3.0, -2.0)), x)
    np.testing.assert_allclose(lever[:, 0], x[:, 0] + 2.0 * x[:, 2])
    np.testing.assert_allclose(lever[:, 1], x[:, 1] + 3.0 * x[:, 2])
    turned = run.sense(Sensors(turned=0.1), x)
    np.testing.assert_allclose(turned[:, 0], np.cos(0.1) * x[:, 0] + np.sin(0.1) * x[:, 1])
    late = run.sense(Sensors(late=(("v", 2.0),)), x)
    np.testing.assert_allclose(late[2:, 1], x[:-2, 1])
    np.testing.assert_array_equal(run.sense(Sensors(reversed=("r",)), x)[:, 2], -x[:, 2])
    np.testing.assert_allclose(shifted(np.arange(5.0), 0.5), [0, 0.5, 1.5, 2.5, 3.5])
    commands = {"a": np.ones(2), "b": np.zeros(2)}
    out = wired(commands, (("a", "b", 1.0), ("b", "a", -1.0)))
    np.testing.assert_array_equal(out["b"], -np.ones(2))


def test_noise_is_found_and_whitened() -> None:
    rng = np.random.default_rng(3)
    samples = 4000
    force, e = np.zeros(samples), np.zeros(samples)
    for k in range(samples - 1):
        force[k + 1] = 0.9 * force[k] + np.sqrt(1 - 0.9**2) * 0.05 * rng.standard_normal()
        e[k + 1] = 0.8 * e[k] + force[k]
    y = (e + 0.1 * rng.standard_normal(samples))[:, None]
    noise = fit_noise([y], np.array([0.8]), 1.0, [(0,)])
    (group,) = noise.groups
    assert group.sensor[0] == pytest.approx(0.1, rel=0.05)
    assert group.force == pytest.approx(0.05, rel=0.2)
    assert group.memory == pytest.approx(0.9, abs=0.05)
    nu = noise.whiten(y[:, :, None])[:, 0, 0]
    assert nu.std() == pytest.approx(1.0, abs=0.02)
    for lag in (1, 2, 5):
        assert abs(np.corrcoef(nu[lag:], nu[:-lag])[0, 1]) < 3.5 / np.sqrt(samples)


@pytest.mark.parametrize("group", [(0,), (0, 1)])
def test_whitening_is_the_stationary_kalman_filter_of_its_errors(group) -> None:
    from scipy.linalg import cholesky, solve_discrete_are

    rng = np.random.default_rng(4)
    k, pole, dt = len(group), 0.9, 0.7
    y = rng.standard_normal((200, k)).cumsum(axis=0) * 0.1
    (colour,) = fit_noise([y], np.full(k, pole), dt, [group]).groups
    n = k + 1
    a = np.zeros((n, n))
    a[0, 0], a[0, -1], a[-1, -1] = pole, 1, colour.memory
    if k == 2:
        a[1, 0], a[1, 1] = dt, 1
    q = np.diag([*(1e-5 * colour.sensor) ** 2, colour.force**2 * (1 - colour.memory**2)])
    c, r = np.eye(k, n), np.diag(colour.sensor**2)
    p = solve_discrete_are(a.T, c.T, q, r)
    s = c @ p @ c.T + r
    gain, root = a @ p @ c.T @ np.linalg.inv(s), cholesky(s, lower=True)
    x, expected = np.zeros(n), []
    for row in y:
        expected.append(np.linalg.solve(root, row - c @ x))
        x = a @ x + gain @ (row - c @ x)
    np.testing.assert_allclose(colour.whiten(y[:, :, None])[:, :, 0], expected, atol=1e-6)
    assert colour.log_det == pytest.approx(np.linalg.slogdet(s)[1], abs=1e-6)


@pytest.mark.parametrize("k", [1, 2])
def test_slopes_of_the_likelihood_are_differences(k: int) -> None:
    parts = [np.random.default_rng(i).standard_normal((90 + i, k)).cumsum(axis=0) for i in (1, 2)]
    likelihood = Likelihood(parts, (np.full(k, 0.7), 0.95, 0.5))
    x = np.array([-1.0, 2.0, *[0.1, -0.2][:k]])
    found, information = likelihood.slopes(x)
    step = 1e-5 * np.eye(len(x))
    expected = [(likelihood.value(x + s) - likelihood.value(x - s)) / 2e-5 for s in step]
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-4)
    assert np.linalg.eigvalsh(information).min() > 0


def test_fit_equals_least_squares(log: TrialLog) -> None:
    from scipy.optimize import least_squares

    run = LogRun(WIDE, log, "rk4")
    problem = Problem([run])
    point = _point(run, log)
    sigma = (0.014, 0.014, 0.014, 0.01)
    one = np.ones(1)
    white = (
        NoiseModel((i,), one[None, None] / s, one, np.array([[s]]), s * one)
        for i, s in enumerate(sigma)
    )
    noise = Noise(tuple(white), ())
    fit = problem.fit(point, noise)
    scale = np.maximum(np.abs(point.vector()), 1e-3)

    def residual(z: np.ndarray) -> np.ndarray:
        return (problem.errors(point.at(z * scale))[0] / [0.014, 0.014, 0.014, 0.01]).ravel()

    other = least_squares(residual, point.vector() / scale, x_scale="jac")
    assert fit.converged
    assert (fit.nu[0] ** 2).sum() == pytest.approx(2 * other.cost, rel=1e-5)


def test_adding_and_dropping_an_atom_changes_nothing_else(log: TrialLog) -> None:
    problem = Problem([LogRun(WIDE, log, "euler")])
    point = _point(problem.runs[0], log)
    columns = Hypothesis(
        "quadratic_yaw_damping", "q", (Parameter("N_|r|r", "1", 0.0),), ("N_|r|r",)
    )
    moved = problem.add(point, columns)
    assert len(moved.vector()) == len(point.vector()) + 1
    again = problem.drop(moved, columns)
    np.testing.assert_array_equal(again.vector(), point.vector())


def test_proof_counts_memory() -> None:
    rng = np.random.default_rng(6)
    slow = np.convolve(rng.standard_normal(5000), np.ones(10) / 10, "valid")
    white = rng.standard_normal(5000)
    assert long_run_variance(white) == pytest.approx(1.0, rel=0.3)
    assert long_run_variance(slow) == pytest.approx(1.0, rel=0.4)
    assert proof_of(white + 0.2).p_value < 1e-6
    assert proof_of(np.full(10, np.inf)).p_value in (0.0, 1.0)


def test_waves_are_a_line_and_humps_are_not() -> None:
    rng = np.random.default_rng(7)
    samples, t = 1200, np.arange(1200.0)
    quiet = rng.standard_normal((samples, 3))
    assert find_waves([quiet], [quiet], ("u", "v", "r"), 1.0) is None
    line = quiet + 2 * np.sin(2 * np.pi * 0.11 * t)[:, None]
    found = find_waves([line], [line], ("u", "v", "r"), 1.0)
    assert found is not None
    assert found.frequency == pytest.approx(0.11, abs=3 * found.frequency_std + 0.002)
    assert found.std["u"] == pytest.approx(np.sqrt(2), rel=0.2)
    hump = np.array([np.convolve(c, np.ones(4), "same") for c in quiet.T]).T
    assert find_waves([hump], [hump], ("u", "v", "r"), 1.0) is None


def test_in_waves_third_differences_tell_the_sensors_and_the_sea_is_no_misfit() -> None:
    rng = np.random.default_rng(8)
    t = 0.5 * np.arange(3000)
    # a sea of some width: the phase wanders
    phase = 2 * np.pi * 0.12 * t + np.cumsum(0.1 * rng.standard_normal(len(t)))
    errors = 0.1 * np.sin(phase)[:, None] + 0.03 * rng.standard_normal((len(t), 2))
    groups = [(0,), (1,)]
    poles = np.array([0.9, 0.9])
    noise = fit_noise([errors], poles, 0.5, groups)
    nu = noise.whiten(errors[:, :, None])[:, :, 0]
    known = np.ones(errors.shape, bool)
    fit = Fit(None, noise, 0.0, (nu,), (errors,), True, "rk4", (known,))  # type: ignore[arg-type]
    waves = find_waves([nu], [errors], ("u", "v"), 0.5)
    assert waves is not None
    assert waves.std["u"] == pytest.approx(0.1 / np.sqrt(2), rel=0.1)
    told = noise_in(waves, fit)
    np.testing.assert_allclose([g.sensor[0] for g in told.groups], 0.03, rtol=0.15)
    assert noise_in(None, fit) is noise
    squares, counts = squares_in(waves, fit, ("u", "v"), told)
    assert (squares / counts < 2).all()
    whole, _ = squares_in(None, fit, ("u", "v"), told)
    assert (whole / counts > 5).all()


def test_every_cause_says_what_it_is(log: TrialLog) -> None:
    context = Context(
        BASE, log.vessel, ("u", "v", "r", "psi"), True, 1200.0, 1.0,
        dict.fromkeys(("n1", "n2"), 15.0),
    )  # fmt: skip
    keys = []
    for name, cause in known_causes().items():
        assert cause.id == name
        assert all([cause.title, cause.signature, cause.extension, cause.reference])
        for hypothesis in cause.hypotheses(context):
            keys.append(hypothesis.key)
            told = {p.name: (p.start, 0.1) for p in hypothesis.parameters}
            sentence = cause.evidence(told or {hypothesis.key.split(":", 1)[1]: (-1.0, 0.0)})
            assert len(sentence) > 20
    assert len(keys) == len(set(keys)) > 40


def test_sensitivities_of_nothing_are_those_of_the_start(log: TrialLog) -> None:
    simulator = VaryingSimulator(StepModel(WIDE), len(log))
    drivers = np.column_stack([log.forces(WIDE.inputs), log["psi"], np.zeros((len(log), 4))])
    theta = _theta(WIDE)
    x = simulator(np.array([1.5, 0.5, 0.0]), drivers, theta)
    linear = simulator.linearise(x, drivers, theta, NOWHERE)
    found = sensitivities(linear)
    np.testing.assert_allclose(found[0], np.eye(3))
    np.testing.assert_allclose(found[1], linear.a[0])


def test_whiteness_equals_statsmodels() -> None:
    from statsmodels.stats.diagnostic import acorr_ljungbox

    from greybox.diagnosis.residuals import _whiteness

    e = np.convolve(np.random.default_rng(8).standard_normal(600), [1.0, 0.3], "valid")
    found, expected = _whiteness("u", e), acorr_ljungbox(e, lags=[20])
    assert found.statistic == pytest.approx(float(expected["lb_stat"].iloc[0]), rel=1e-9)
    assert found.p_value == pytest.approx(float(expected["lb_pvalue"].iloc[0]), rel=1e-9)


def test_what_was_not_measured_counts_nowhere(log: TrialLog) -> None:
    gap = np.zeros(len(log), bool)
    gap[100:200] = True
    run = LogRun(WIDE, replace(log, missing={"u": gap}), "rk4")
    problem = Problem([run])
    point = _point(run, log)
    errors = problem.errors(point)
    noise = problem.noise_of(errors, point)
    fit = problem.fit(point, noise, most=1)
    columns = np.random.default_rng(3).normal(size=(len(log), 4, 2))
    directions = ProjectedScores(problem, fit)
    white = problem.whiten(noise, [columns])
    assert not white[0][gap, 0].any()
    assert (directions.clear([columns])[1] == (white[0] ** 2).sum(axis=(0, 1))).all()
    _, _, before = directions.alone([columns])
    np.testing.assert_allclose(before, (white[0] ** 2).sum(axis=(0, 1)), rtol=1e-12)
    assert sum(known.sum() for known in fit.known) == 4 * len(log) - 100


def test_a_change_is_tested_by_what_it_changes() -> None:
    """A coefficient that hardly differs from another is not known, nor is its factor."""
    theta, factor = -2.0, 1.5
    change = (factor - 1) * theta
    # of the coefficient (1), and of what it changes by (0.01)
    turned = np.array([[1.0, 0.0], [-change / theta**2, 1 / theta]])
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = turned @ np.diag([1.0, 1e-4]) @ turned.T
    covariance[2, 2] = 4.0
    trial = draw(np.random.default_rng([4, 2]), (), samples=60)
    problem = Problem([LogRun(get_structure("thesis"), trial.estimation, "rk4")])
    place = problem.place("Xuu")
    factors = (
        Parameter("Xuu_factor", "1", 1.0, null=1.0), Parameter("Xuu_time", "s", 0.0, reach=5.0)
    )  # fmt: skip
    hypothesis = Hypothesis(
        "parameter_change", "c", factors, (), lambda ship, _: ship, multiplied="Xuu"
    )
    known = np.zeros(len(problem.structure.parameters))
    known[place] = theta
    ship = Ship(known, np.zeros(2), trial.estimation.vessel)
    point = Point(ship, (), (place,), (hypothesis,), (np.array([factor, 30.0]),))
    fit = Fit(point, Noise((), ()), 0.0, (), (), True, "rk4", ())
    problem._covariances.append((fit, (point.vector(), covariance)))
    away, own, _ = problem.effect(fit, hypothesis)
    np.testing.assert_allclose(away, [change])
    np.testing.assert_allclose(own, [[1e-4]])
