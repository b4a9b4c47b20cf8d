"""A trial between two explanations: the distance, its derivative, and how sure one will be."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from designs import make_request, thesis_model

from experiment_design import CandidateModel, design_between, design_trial
from experiment_design.criteria.t_optimality import Pair
from experiment_design.discriminate import Discrimination, _steps, probability_right
from experiment_design.request.request import build_problem
from greybox.commands.main import main
from greybox.errors import InfeasibleError, UsageError
from greybox.model.run.simulation import simulate
from greybox.vessel.toml import load_vessel


def _rival(request, current=(0.0, 0.0), **parameters):
    theta = request.theta.copy()
    for name, value in parameters.items():
        theta[request.structure.index(name)] = value
    d = np.zeros(4)
    d[:2] = current
    return CandidateModel("rival", request.structure, theta, d)


def _first(request):
    return CandidateModel("first", request.structure, request.theta, request.d)


def _commands(problem, seed=0):
    unit = (np.random.default_rng(seed).random(problem.shape) < 0.5).astype(float)
    return problem.commands(unit)


def test_distance_equals_filters_stepped_by_hand():
    request = make_request(duration=60.0)
    rival = _rival(request, current=(0.1, -0.05))
    problem = build_problem(replace(request, contrasts=((_first(request), rival),)))
    pair = problem.contrast.pairs[0]
    commands = _commands(problem)
    models = (pair.first, pair.second)
    motions = [m.run(commands[None]).state[0, :, :4] for m in models]
    total = 0.0
    for i, model in enumerate(models):
        data, estimate = motions[1 - i], model.start.copy()
        filter_ = pair._filters[i]
        tau = model.run(commands[None]).tau[0]
        for k in range(60):
            innovation = data[k] - estimate
            total += innovation @ np.linalg.solve(filter_.covariance, innovation) / 2
            free = simulate(
                model.structure, model.theta, estimate[:3], tau[k : k + 1], 1.0,
                psi0=estimate[3], d=model.d[None],
            )  # fmt: skip
            after = np.append(free.x[0, 1], free.psi[0, 1])
            estimate = after + filter_.gain @ innovation
    assert pair.distance(commands) == pytest.approx(total / 2, rel=1e-9)


def test_derivative_of_the_distance():
    request = make_request(duration=60.0)
    rivals = (_rival(request, current=(0.1, 0.0)), _rival(request, Nvr=-0.08))
    pairs = tuple((_first(request), r) for r in rivals)
    problem = build_problem(replace(request, contrasts=pairs))
    unit = np.random.default_rng(1).random(problem.shape)
    value, _, slope, _ = problem.gradient(unit)
    assert value == pytest.approx(problem.evaluate(unit[None]).value[0])
    for k, c in ((0, 0), (2, 1), (4, 2)):
        ends = []
        for step in (1e-5, -1e-5):
            moved = unit.copy()
            moved[k, c] += step
            ends.append(problem.gradient(moved)[0])
        assert slope[k, c] == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-4)


def test_how_sure_one_will_be():
    """The predicted share of right decisions is what virtual trials give."""
    request = make_request(duration=80.0)
    rival = _rival(request, Yvr=-0.1035, Xmu=0.01998)
    problem = build_problem(replace(request, contrasts=((_first(request), rival),)))
    pair: Pair = problem.contrast.pairs[0]
    commands = _commands(problem)
    first, second = pair.innovations(commands)
    expected = probability_right(float(second @ second) / 2)
    assert 0.6 < expected < 0.999
    rng = np.random.default_rng(5)
    truth = pair.first
    motion = truth.run(commands[None])
    runs, samples = 400, len(commands)
    states = np.array([0.002, 0.002, 4e-4, 1e-4])
    right = 0
    w = rng.standard_normal((runs, samples, 3)) * states[:3]
    free = simulate(truth.structure, truth.theta, truth.start[:3], motion.tau[0], 1.0,
                    process_noise=w)  # fmt: skip
    y = np.concatenate([free.x, free.psi[..., None]], axis=2)
    y = y + rng.standard_normal(y.shape) * [*request.noise.measurement, 0.01]
    likelihood = []
    for model, filter_ in zip((pair.first, pair.second), pair._filters, strict=True):
        estimate = np.repeat(model.start[None], runs, axis=0)
        inverse = np.linalg.inv(filter_.covariance)
        log = np.zeros(runs)
        for k in range(samples):
            innovation = y[:, k] - estimate
            log -= np.einsum("ri,ij,rj->r", innovation, inverse, innovation) / 2
            step = simulate(
                model.structure, model.theta, estimate[:, :3],
                np.repeat(motion.tau[:, k : k + 1], runs, axis=0), 1.0, psi0=estimate[:, 3],
            )  # fmt: skip
            after = np.column_stack([step.x[:, 1], step.psi[:, 1]])
            estimate = after + innovation @ filter_.gain.T
        likelihood.append(log - samples * np.linalg.slogdet(filter_.covariance)[1] / 2)
    right = float((likelihood[0] > likelihood[1]).mean())
    # the filters have steady gains and the truth starts known: three standard errors and 3 %
    assert right == pytest.approx(
        expected, abs=0.03 + 3 * np.sqrt(expected * (1 - expected) / runs)
    )
    assert first.shape == second.shape


@pytest.mark.long
def test_a_designed_trial_tells_more_than_a_random_one():
    request = make_request(duration=150.0, effort=0.4)
    rival = _rival(request, current=(0.15, 0.1))
    found = design_between(request, rival, ("still", "current"), workers=1)
    assert min(found.ratio) > 0
    # still water is the other explanation with a current of zero
    assert found.nested
    assert found.telling == max(found.ratio_refitted)
    assert found.probability >= found.probability_refitted
    assert 0.5 <= found.probability_refitted <= 1.0
    data = found.to_dict()
    assert data["criterion"] == "T"
    assert data["discrimination"]["between"] == ["still", "current"]
    assert "decide rightly with probability" in found.summary()
    plain = design_trial(replace(request, effort=0.1), workers=1, alternatives=False)
    contrasts = ((_first(request), rival),)
    pair = build_problem(replace(request, contrasts=contrasts)).contrast.pairs[0]
    assert pair.distance(found.design.commands[0]) > pair.distance(plain.commands[0])


def test_no_random_sequence_that_keeps_the_limits_is_told_in_words():
    plan = SimpleNamespace(request=SimpleNamespace(duration=60.0), status="solved", notes=())
    found = Discrimination(plan, ("a", "b"), (9.0, 8.0), (7.0, 6.0), False, float("nan"))
    told = found.summary()
    assert "8 if b is; no random sequence keeps the limits" in told
    assert "nan" not in told
    assert "best random two-level sequence 3.2" in replace(found, random=3.2).summary()


def test_explanations_that_are_one():
    request = make_request(duration=100.0)
    with pytest.raises(UsageError, match="predict the same motion"):
        design_between(request, _rival(request), ("a", "b"), workers=1)
    both = replace(request, regimes=request.regimes * 2, starts=request.starts * 2)
    with pytest.raises(UsageError, match="one trial at a time"):
        design_between(both, _rival(request, Nvr=-0.08), ("a", "b"))


def test_an_expected_current_and_wind_move_both_explanations(tmp_path, monkeypatch):
    paths = [str(tmp_path / name) for name in ("a.json", "b.json")]
    for path in paths:
        replace(thesis_model(), vessel=load_vessel("thesis")).save(path)
    seen = []

    def stop(request, rival, *_, **__):
        seen.append((request.d, rival.d))
        raise UsageError("seen.")

    monkeypatch.setattr("experiment_design.discriminate.design_between", stop)
    told = ["--regime", "u+v+", "--predictor", "basic", "--current", "0.3,0.1", "--wind", "4,-2"]
    out = str(tmp_path / "plan.csv")
    asked = ["design", "--vessel", "thesis", "--duration", "100", "--between", *paths, *told]
    assert main([*asked, "--out", out]) == 1
    assert len(seen) == 1
    for d in seen[0]:
        np.testing.assert_array_equal(d, [0.3, 0.1, 4.0, -2.0])


def test_explanations_of_other_states(tmp_path, capsys):
    paths = [str(tmp_path / name) for name in ("a.json", "b.json")]
    for name, path in zip(("thesis", "surge"), paths, strict=True):
        replace(thesis_model(name), vessel=load_vessel("thesis")).save(path)
    out = tmp_path / "plan.csv"
    asked = ["design", "--vessel", "thesis", "--duration", "100", "--out", str(out)]
    for pair, regime in ((paths, "u+v+"), (paths, "u+"), (paths[::-1], "auto")):
        assert main([*asked, "--regime", regime, "--between", *pair]) == 1
        said = capsys.readouterr().err
        assert "name two models of the same states" in said
        assert "states u, v, r" in said or "and a u, v, r" in said
        assert said.count("\n") == 1
    assert not out.exists()


def test_a_run_at_the_edge_of_its_bounds_is_refused():
    request = make_request(duration=60.0)
    problem = build_problem(replace(request, contrasts=((_first(request), _rival(request)),)))
    pair = problem.contrast.pairs[0]
    commands = _commands(problem)
    slopes = pair.sensitivities

    def lost(commands, which, positions):
        found = slopes(commands, which, positions)
        found[:, 2] = np.nan
        return found

    pair.sensitivities = lost
    with pytest.raises(InfeasibleError, match="run of a leaves every bound when Xuu changes"):
        _steps(pair, commands, ("a", "b"))
