"""The predicted covariance is that of zero-mean IV: by its definition, and by Monte Carlo."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from designs import make_request, thesis_model

from experiment_design.criteria.covariance import Criterion
from experiment_design.information.moments import Moments
from experiment_design.request.noise import noise_levels
from experiment_design.request.request import build_problem
from greybox.errors import UsageError
from greybox.model.noise import NoiseLevels
from greybox.model.run.simulation import simulate
from greybox.model.run.step import StepModel
from greybox.study.monte_carlo import Batch, BatchRegression
from greybox.vessel.toml import load_vessel


def _random_motion(request, seed=0, count=1):
    problem = build_problem(request)
    unit = np.random.default_rng(seed).random((count, *problem.shape))
    motion = problem.scenarios[0].rollout.run(problem.commands(unit))
    return problem, unit, motion


def _covariance_by_definition(request, problem, motion):
    """C = G⁻¹ Z R Zᵀ G⁻ᵀ with Z and R written out, sample by sample."""
    predictor = request.build_predictor()
    x, psi, tau = motion.state[0, :-1, :3], motion.state[0, :-1, 3], motion.tau[0]
    z = predictor.evaluate(list(x.T), psi, list(tau.T))
    z = z - z.mean(axis=1, keepdims=True)
    samples = len(x)
    big = np.zeros((len(z), 3 * samples))
    for i, state in enumerate(request.structure.states):
        mine = predictor.equation(state)
        big[mine, i::3] = z[mine]
    slope = StepModel(request.structure).jacobians
    d = np.zeros((3 * samples, 3 * (samples + 1)))
    for k in range(samples):
        a = slope(x[k], psi[k], tau[k], request.d, [0, 0], request.theta, 1)[0].full()
        d[3 * k : 3 * k + 3, 3 * k + 3 : 3 * k + 6] = np.eye(3)
        d[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = -a
    e = np.kron(np.eye(samples + 1), np.diag(request.noise.measurement**2))
    r = d @ e @ d.T + np.kron(np.eye(samples), np.diag(request.noise.process**2))
    gram = np.zeros((len(z), len(z)))
    for i in range(3):
        gram += big[:, i::3] @ big[:, i::3].T
    inverse = np.linalg.inv(gram)
    wanted = list(problem.criterion.wanted)
    return (inverse @ big @ r @ big.T @ inverse)[np.ix_(wanted, wanted)]


@pytest.mark.parametrize(("predictor", "duration"), [("basic", 60.0), ("augmented", 200.0)])
def test_covariance_equals_its_definition(predictor, duration):
    request = make_request(duration=duration, predictor=predictor)
    problem, _, motion = _random_motion(request)
    moments = problem.moments(motion, 0)
    expected = _covariance_by_definition(request, problem, motion)
    found = problem.criterion.covariance(moments)[0]
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found / np.outer(scale, scale), expected / np.outer(scale, scale),
                               atol=1e-6)  # fmt: skip


def test_the_slopes_are_those_of_the_priors_integrator():
    """Noise of a sample enters the next equation error as an RK4 step carries it on."""
    request = make_request(integrator="rk4", d=np.array([0.2, -0.1, 1.0, 0.5]))
    request = replace(request, noise=replace(request.noise, heading=0.01))
    problem, _, motion = _random_motion(request)
    k = 7
    x, tau = motion.state[0, k, :4], motion.tau[0, k]
    information = problem.scenarios[0].information
    _, slopes = information.regressors(x[None, None, :3], x[None, None, 3], tau[None, None])
    for j in range(4):
        ends = []
        for step in (1e-6, -1e-6):
            moved = x.copy()
            moved[j] += step
            run = simulate(
                request.structure, request.theta, moved[:3], tau[None], 1.0, psi0=moved[3],
                d=request.d, integrator="rk4",
            )  # fmt: skip
            ends.append(run.x[0, 1])
        expected = (ends[0] - ends[1]) / 2e-6
        np.testing.assert_allclose(slopes[:, j, 0, 0], expected, rtol=1e-6, atol=1e-9)


def test_white_residuals_give_the_gram_matrix():
    request = make_request(estimator="iv-white")
    problem, _, motion = _random_motion(request)
    moments = problem.moments(motion, 0)
    c = problem.criterion.covariance(moments)[0]
    mine = request.build_predictor().equation("r")
    gram = moments.gram[0][np.ix_(mine, mine)]
    ratio = c[np.ix_(mine, mine)] @ gram
    np.testing.assert_allclose(ratio / ratio[0, 0], np.eye(len(mine)), atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "estimator", "integrator"),
    [
        *((k, e, "euler") for k in ("D", "A", "E", "c") for e in ("iv", "iv-white")),
        ("D", "iv", "rk4"),
    ],
)
def test_gradient_equals_finite_differences(kind, estimator, integrator):
    request = make_request(
        criterion=kind, combination={"Yvv": 1.0, "Ymu": 3.0} if kind == "c" else {},
        wanted=("Yvv", "Yv", "Ymu", "Nmu") if kind != "c" else (), estimator=estimator,
        vessel=make_request().vessel, predictor="basic", integrator=integrator,
    )  # fmt: skip
    problem, unit, _ = _random_motion(request)
    value, _, slope, _ = problem.gradient(unit[0])
    if kind != "E":
        assert value == pytest.approx(problem.evaluate(unit).value[0], rel=1e-12)
    size = len(problem.criterion.wanted)
    for k, c in ((0, 0), (3, 1), (7, 2), (11, 0)):
        ends = []
        for step in (1e-6, -1e-6):
            moved = unit[0].copy()
            moved[k, c] += step
            ends.append(problem.gradient(moved)[0])
        difference = (ends[0] - ends[1]) / 2e-6 / size
        assert slope[k, c] == pytest.approx(difference, rel=1e-4, abs=1e-5 * abs(slope).max())


def test_measured_wind_is_told_by_its_gusts():
    """With a steady wind the air's terms are combinations of the water's; gusts tell them apart."""
    steady = make_request(
        duration=300.0, predictor="wind", d=np.array([0.1, 0.0, 5.0, 2.0]), gust=0.0
    )
    problem, unit, _ = _random_motion(steady)
    assert problem.evaluate(unit).value[0] == -np.inf
    problem, unit, _ = _random_motion(replace(steady, gust=0.8))
    assert np.isfinite(problem.evaluate(unit).value[0])
    assert len(problem.criterion.wanted) == 18
    _, _, slope, _ = problem.gradient(unit[0])
    ends = []
    for step in (1e-6, -1e-6):
        moved = unit[0].copy()
        moved[8, 1] += step
        ends.append(problem.evaluate(moved[None]).value[0])
    assert slope[8, 1] == pytest.approx((ends[0] - ends[1]) / 2e-6 / 18, rel=1e-4, abs=1e-6)


def test_gradient_with_prior_and_known_trials():
    information = np.diag(1 / (0.3 * np.abs(make_request().theta[:2])) ** 2)
    request = make_request(known=(("Xu", "Xvr"), information), predictor="augmented",
                           duration=220.0)  # fmt: skip
    problem, unit, motion = _random_motion(request)
    other = (problem.moments(motion, 0),)
    problem = problem.with_known(other)
    _, _, slope, _ = problem.gradient(unit[0][::-1])
    ends = []
    for step in (1e-6, -1e-6):
        moved = unit[0][::-1].copy()
        moved[5, 0] += step
        ends.append(problem.evaluate(moved[None]).value[0])
    size = len(problem.criterion.wanted)
    difference = (ends[0] - ends[1]) / 2e-6 / size
    assert slope[5, 0] == pytest.approx(difference, rel=1e-4, abs=1e-5 * abs(slope).max())


def test_prior_information_adds():
    rng = np.random.default_rng(3)
    a = rng.standard_normal((3, 9))
    gram = np.diag([2.0, 3.0, 4.0])
    score = a @ a.T
    prior = np.diag([0.5, 0.0, 7.0])
    moments = Moments(gram[None], score[None])
    plain = Criterion("D", (0, 1, 2), np.ones(3), np.ones(3)).covariance(moments)[0]
    both = Criterion("D", (0, 1, 2), np.ones(3), np.ones(3), prior).covariance(moments)[0]
    np.testing.assert_allclose(np.linalg.inv(both), np.linalg.inv(plain) + prior, rtol=1e-9)


def test_units_do_not_matter():
    """A parameter in another unit changes D by a constant, and no design."""
    rng = np.random.default_rng(4)
    a = rng.standard_normal((5, 3, 40))
    scale = np.array([1.0, 1e4, 1e-5])
    values = []
    for s in (np.ones(3), scale):
        z = a * s[:, None]
        gram = z @ z.transpose(0, 2, 1)
        values.append(Criterion("D", (0, 1, 2), s, s).value(Moments(gram, gram)))
    shift = values[1] - values[0]
    np.testing.assert_allclose(shift, 2 * np.log(scale).sum(), rtol=1e-9)


def test_criteria_of_a_diagonal():
    c = np.diag([4.0, 1.0])[None]
    unit = np.ones(2)
    assert Criterion("D", (0, 1), unit, unit).of_covariance(c)[0] == pytest.approx(-np.log(4))
    assert Criterion("A", (0, 1), unit, unit).of_covariance(c)[0] == pytest.approx(-np.log(2.5))
    assert Criterion("E", (0, 1), unit, unit).of_covariance(c)[0] == pytest.approx(-np.log(4))
    h = np.array([1.0, -1.0])
    assert Criterion("c", (0, 1), unit, h).of_covariance(c)[0] == pytest.approx(-np.log(5))


@pytest.mark.parametrize("predictor", ["basic", "augmented"])
def test_predicted_errors_are_those_of_monte_carlo(predictor):
    """200 IV estimates with the noises of (6.2): within 20 % and their own sampling error."""
    request = make_request(duration=400.0, predictor=predictor)
    problem = build_problem(request)
    rng = np.random.default_rng(1)
    unit = (rng.random(problem.shape) < 0.5).astype(float)
    commands = problem.commands(unit)
    motion = problem.scenarios[0].rollout.run(commands[None])
    predicted = np.sqrt(np.diag(problem.criterion.covariance(problem.moments(motion, 0))[0]))
    runs, samples = 200, len(commands)
    w = rng.standard_normal((runs, samples, 3)) * request.noise.process
    start = request.starts[0][:3]
    truth = simulate(request.structure, request.theta, start, motion.tau[0], 1.0, process_noise=w)
    y = truth.x + rng.standard_normal(truth.x.shape) * request.noise.measurement
    psi = truth.psi + 0.01 * rng.standard_normal(truth.psi.shape)
    batch = Batch(y, psi, motion.tau, None, start)
    estimates = BatchRegression(request.build_predictor(), batch).refine(request.theta)
    spread = estimates.theta[:, list(problem.criterion.wanted)].std(axis=0, ddof=1)
    # sampling error of a standard deviation of 200 runs: 5 %
    assert np.abs(np.log(spread / predicted)).max() < np.log(1.2) + 2 * 0.05
    assert abs(np.log(spread / predicted).mean()) < 0.1


def test_noise_levels_from_residuals_and_sensors():
    request = make_request()
    model = thesis_model()
    levels = noise_levels(model, model.vessel)
    np.testing.assert_allclose(levels.measurement, 0.014142)
    assert (levels.process == 0).all()
    jacobians = StepModel(request.structure).jacobians
    a = jacobians([1, 1, 1], 0, [0, 0, 0], model.d, [1, 1], model.theta, 1)[0]
    beyond = (np.eye(3) + a.full() ** 2) @ levels.measurement**2
    residual = np.sqrt(beyond + 0.003**2)
    levels = noise_levels(replace(model, residual_std=residual), model.vessel)
    np.testing.assert_allclose(levels.process, 0.003, rtol=1e-6)
    assert levels.source == "sensors of the vessel file; process noise from the model's residuals"
    with pytest.raises(UsageError, match="one that is not negative is needed for each of u, v, r"):
        noise_levels(model, model.vessel, np.array([1.0]))
    blind = replace(model, vessel=load_vessel("ferry"))
    with pytest.raises(
        UsageError, match=r"nothing tells how noisy u, v, r are: state u_std, v_std, r_std under"
    ):
        noise_levels(replace(blind, vessel=replace(blind.vessel, sensors={})),
                     replace(blind.vessel, sensors={}))  # fmt: skip
    with pytest.raises(UsageError, match="the noise of u is 0"):
        NoiseLevels(("u",), np.zeros(1), np.zeros(1))


def test_noise_levels_that_the_model_found_take_the_place_of_sensors():
    model = thesis_model()
    found = NoiseLevels(
        model.structure.states, np.array([0.05, 0.06, 0.004]), np.full(3, 0.01), 0.02, 0.3
    )
    bare = replace(model.vessel, sensors={})
    levels = noise_levels(replace(model, noise=found), bare)
    np.testing.assert_array_equal(levels.measurement, found.measurement)
    assert (levels.heading, levels.wind) == (0.02, 0.3)
    assert levels.source.startswith("noise of u, v, r, heading, wind as the model's estimate")
    partly = replace(model.vessel, sensors={"u_std": 0.1, "heading_std": 0.01})
    levels = noise_levels(replace(model, noise=replace(found, wind=0.0)), partly)
    np.testing.assert_array_equal(levels.measurement, [0.1, 0.06, 0.004])
    assert levels.heading == 0.01
    assert "sensors of the vessel file; noise of v, r as the model's" in levels.source


def test_a_parameter_of_zero_is_measured_by_its_own_equation():
    request = make_request(predictor="wind", d=np.array([0.0, 0.0, 5.0, 2.0]), criterion="A")
    theta = request.theta.copy()
    zero = {"Wuu": "X", "Wvv": "Y", "Wuv": "N"}
    theta[[request.structure.index(n) for n in zero]] = 0.0
    request = replace(request, theta=theta)
    value = dict(zip(request.structure.parameters, np.abs(theta), strict=True))
    alone = replace(request, wanted=("Wuu",))
    for asked in (request, alone):
        predictor = asked.build_predictor()
        criterion = build_problem(asked).criterion
        names = [predictor.columns[i].name for i in criterion.wanted]
        for name, scale in zip(names, criterion.scale, strict=True):
            others = [v for n, v in value.items() if n[0] == zero.get(name)]
            expected = min(others) if others else value[name]
            assert scale == pytest.approx(expected), name


def test_an_unknown_criterion():
    with pytest.raises(UsageError, match="there is no criterion 'G'"):
        Criterion("G", (0,), np.ones(1), np.ones(1))


def test_casadi_is_what_differentiates():
    """The information model's slopes follow a new term without any other edit."""
    request = make_request(structure="thesis")
    longer = request.structure.with_terms("N_|r|r")
    request = replace(request, structure=longer, theta=np.append(request.theta, -0.3))
    problem, unit, _ = _random_motion(request)
    assert len(problem.criterion.wanted) == 16
    assert np.isfinite(problem.gradient(unit[0])[2]).all()
    assert isinstance(problem.scenarios[0].rollout.step, ca.SX)
