"""Output error and likelihood of innovations: exact, against oracles, and when to refuse."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from virtual import virtual_log, write_csv

from greybox.commands.main import main
from greybox.errors import ExcitationError, StructureError, UsageError
from greybox.estimation import free_run, free_run_errors, output_error
from greybox.estimation.efficiency_bounds import _limit, cramer_rao, information, noise_variances
from greybox.estimation.free_run import _follows, fit_free_runs
from greybox.estimation.free_run_errors import (
    flat_top_autocovariance,
    shared_score_covariance,
    slow_errors,
)
from greybox.estimation.innovations import FilterRuns, fit_innovations
from greybox.estimation.output_error import OutputErrorOptions, estimate_oe
from greybox.estimation.output_setup import measured, output_model, output_predictor
from greybox.estimation.shooting import (
    FreeRuns,
    Measured,
    cut,
    measured_starts,
    unrestricted,
)
from greybox.model.catalogue import get_structure
from greybox.model.noise import NoiseLevels
from greybox.model.output import OutputModel
from greybox.model.predictor import build_predictor
from greybox.model.run import output_runs
from greybox.model.run.output_runs import Filter, Observer, Simulator
from greybox.study.chapter6 import TRUE
from greybox.study.efficiency import CASES, determinant_efficiency, virtual_trial

REGIME = (("u", (1,)), ("v", (1,)), ("r", (1, -1)))
THESIS = get_structure("thesis")
CURRENT = (0.2, -0.2)


def truth(predictor):
    return np.array([TRUE[predictor.columns[i].terms[0]] for i in predictor.parameter_columns])


@pytest.fixture(scope="module")
def predictor():
    return output_predictor(THESIS, "wind", REGIME)


@pytest.fixture(scope="module")
def clean():
    return virtual_log(3, 400, spread=0.0, noise=0.0)


def test_a_point_is_run_once_for_all_weights(predictor, clean, monkeypatch):
    model = output_model(predictor, 1.0, "input", "input")
    data = [measured(model, clean)]
    whole = cut(data, len(data[0].y))
    starts = measured_starts(whole, len(model.states))
    p = np.zeros(len(model.parameters))
    p[: len(predictor.columns)] = truth(predictor)
    runs = FreeRuns(model, whole, np.ones(3))
    first = runs.linearise(p, starts)
    monkeypatch.setattr(runs._simulator, "_runs", None)
    again = runs.with_sigma(np.array([0.5, 2.0, 4.0])).linearise(p, starts)
    weights = np.tile([2.0, 0.5, 0.25], len(data[0].y))[:, None]
    np.testing.assert_allclose(again.rows[0], first.rows[0] * weights, rtol=1e-13)
    monkeypatch.undo()
    moved = runs.linearise(p * 1.01, starts)
    fresh = FreeRuns(model, whole, np.ones(3)).linearise(p * 1.01, starts)
    np.testing.assert_array_equal(moved.rows, fresh.rows)


def test_levels_that_have_no_weight_are_not_tried(monkeypatch):
    """The mean of a variance under a likelihood that is known: a noise seen directly."""

    class Runs:
        tried = 0

        def filtered(self, p, nodes, noise):
            self.tried += 1
            return seen / np.sqrt(noise[0]), np.full(seen.shape, np.log(noise[0]))

    rng = np.random.default_rng(0)
    seen = 0.05 * rng.standard_normal(400)
    best = np.array([(seen**2).mean()])
    runs = Runs()
    mean = free_run_errors.mean_variance(runs, None, None, best, 0, 1.0)
    assert runs.tried < 12
    monkeypatch.setattr(free_run_errors, "_UNLIKELY", np.inf)
    every = free_run_errors.mean_variance(runs, None, None, best, 0, 1.0)
    # 400 squares, flat in the logarithm: inverse gamma, with the mean n/(n − 2) of the best;
    # twelve levels are interpolated, which is right to a small part of its deviation of 7 %
    for found in (mean, every):
        assert found == pytest.approx(best[0] * 400 / 398, rel=0.03)


def test_a_likelihood_sharper_than_its_grid_has_its_best_level_as_mean():
    class Runs:
        def filtered(self, p, nodes, noise):
            return 1e6 * (np.sqrt(noise) - 0.05), np.zeros(1)

    found = free_run_errors.mean_variance(Runs(), None, None, np.array([0.05**2]), 0, 1.0)
    assert found == pytest.approx(0.05**2)


def test_levels_under_which_the_run_escapes_have_no_weight():
    class Runs:
        def filtered(self, p, nodes, noise):
            return np.where(noise < 1e-3, 1e200, 1.0), np.log(noise)

    found = free_run_errors.mean_variance(Runs(), None, None, np.array([0.05**2]), 0, 1.0)
    assert 1e-3 < found < 10.0


@pytest.fixture(scope="module")
def noisy():
    return virtual_log(3, 600, spread=0.0)


def problem(predictor, log, heading="output"):
    model = output_model(predictor, 1.0, heading)
    p = np.array([*truth(predictor), *CURRENT])
    return model, measured(model, log), p


def slope_of(function, p, j, floor=1e-3):
    """Return the central difference of a function in one of its parameters."""
    h = 1e-6 * max(abs(p[j]), floor)
    step = h * np.eye(len(p))[j]
    return (function(p + step) - function(p - step)) / (2 * h)


class TestSensitivities:
    def test_equal_finite_differences(self, predictor, noisy):
        model, data, p = problem(predictor, noisy)
        runs = Simulator(model, data.w[None, :200])
        z0 = data.y[:1]
        _, rows, _, slope = runs.sensitivities(z0, p)
        for j in range(len(p)):
            expected, end = (slope_of(lambda p, k=k: runs(z0, p)[k], p, j) for k in (0, 1))
            size = np.abs(expected).max()
            np.testing.assert_allclose(rows[..., j], expected, atol=1e-5 * size)
            atol = 1e-5 * np.abs(slope[..., j]).max() + 1e-9
            np.testing.assert_allclose(slope[..., j], end, atol=atol)

    def test_of_the_initial_state_too(self, predictor, noisy):
        model, data, p = problem(predictor, noisy)
        runs = Simulator(model, data.w[None, :100])
        z0 = data.y[:1]
        rows = runs.sensitivities(z0, p)[1]
        for j in range(4):
            shift = np.zeros((1, 4))
            shift[0, j] = 1e-6
            expected = (runs(z0 + shift, p)[0] - runs(z0 - shift, p)[0]) / 2e-6
            np.testing.assert_allclose(rows[..., len(p) + j], expected, atol=1e-6)

    def test_of_some_parameters_are_columns_of_all(self, predictor, noisy):
        model, data, p = problem(predictor, noisy)
        z0, w, only = data.y[:1], data.w[None], [len(p) - 1, 0, 3]
        runs, use = Simulator(model, w), np.ones((1, len(data.y)))
        rows = runs.sensitivities(z0, p)[1][..., only]
        np.testing.assert_allclose(runs.by_parameters(z0, p, only), rows, rtol=1e-9, atol=1e-9)
        observer = Observer(model, w, data.y[None], use)
        rows = observer(z0, p, 0.3)[1][..., only]
        found = observer.by_parameters(z0, p, 0.3, only)
        np.testing.assert_allclose(found, rows, rtol=1e-9, atol=1e-9)

    def test_a_filter_without_process_noise_is_the_free_run(self, predictor, noisy):
        model, data, p = problem(predictor, noisy)
        sigma2 = np.full(4, 2e-4)
        y, rows, _, _ = Simulator(model, data.w[None]).sensitivities(data.y[:1], p)
        kalman = Filter(model, data.w[None], data.y[None], np.ones((1, len(data.y))))
        r, derivatives, levels = kalman(data.y[:1], p, np.append(sigma2, np.zeros(4)))
        np.testing.assert_allclose(r, (data.y - y) / np.sqrt(sigma2), atol=1e-9)
        np.testing.assert_allclose(derivatives, rows / np.sqrt(2e-4), rtol=1e-9, atol=1e-7)
        np.testing.assert_allclose(levels, np.log(2e-4), rtol=1e-12)

    def test_an_observer_without_gain_is_the_free_run(self, predictor, noisy):
        model, data, p = problem(predictor, noisy)
        y, rows, _, _ = Simulator(model, data.w[None]).sensitivities(data.y[:1], p)
        observer = Observer(model, data.w[None], data.y[None], np.ones((1, len(data.y))))
        error, derivatives = observer(data.y[:1], p, 0.0)
        np.testing.assert_allclose(error, data.y - y, atol=1e-11)
        np.testing.assert_allclose(derivatives, rows, rtol=1e-9, atol=1e-7)

    def test_an_observer_of_full_gain_predicts_one_step(self, predictor, noisy):
        model, data, p = problem(predictor, noisy)
        n = len(data.y)
        observer = Observer(model, data.w[None], data.y[None], np.ones((1, n)))
        error, _ = observer(data.y[:1], p, 1.0, sensitivities=False)
        each = Simulator(model, data.w[:, None])
        _, after = each(data.y, p)
        np.testing.assert_allclose(
            error[0, 1:], (data.y - np.roll(after, 1, axis=0))[1:], atol=1e-12
        )

    def test_those_of_an_observer_equal_finite_differences(self, predictor, noisy):
        model, data, p = problem(predictor, noisy)
        use = np.ones((1, 200))
        use[:, 150:] = 0
        observer = Observer(model, data.w[None, :200], data.y[None, :200], use)
        z0 = data.y[:1]
        rows = observer(z0, p, 0.3)[1]
        assert (rows[:, 150:] == 0).all()
        for j in range(len(p)):
            expected = -slope_of(lambda p: observer(z0, p, 0.3)[0], p, j)
            np.testing.assert_allclose(rows[..., j], expected, atol=1e-5 * np.abs(expected).max())

    def test_an_observer_of_more_sensors_than_states(self, predictor):
        """A constant wind is compared too: its derivatives are in no state."""
        log = virtual_log(3, 120, spread=0.0, wind=3.0)
        model = output_model(predictor, 1.0, "output", "output")
        data = measured(model, log)
        p = np.array([*truth(predictor), *CURRENT, 2.0, -1.0])
        observer = Observer(model, data.w[None], data.y[None], np.ones((1, 120)))
        z0 = data.y[:1, : len(model.states)]
        runs = Simulator(model, data.w[None])
        np.testing.assert_allclose(
            observer(z0, p, 0.0)[1], runs.sensitivities(z0, p)[1], rtol=1e-9, atol=1e-9
        )
        for j in (0, len(p) - 1):
            expected = -slope_of(lambda p: observer(z0, p, 0.5)[0], p, j)
            found = observer(z0, p, 0.5)[1][..., j]
            np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())

    def test_the_likelihood_has_its_exact_gradient(self, predictor, noisy):
        model, data, p = problem(predictor, noisy)
        kalman = Filter(model, data.w[None, :80], data.y[None, :80], np.ones((1, 80)))
        noise = np.array([2e-4, 2e-4, 2e-4, 1e-4, 1e-5, 1e-5, 1e-6, 1e-8])
        _, by_start, by_p = kalman.likelihood(data.y[:1], p, noise)
        for j in (0, 1, 3, 7, 17, 18):
            slope = slope_of(lambda p: kalman.likelihood(data.y[:1], p, noise)[0], p, j, 1e-2)
            assert by_p[j] == pytest.approx(slope, rel=1e-4, abs=1e-3 * np.abs(by_p).max())
        assert np.isfinite(by_start).all()

    @pytest.mark.parametrize(
        ("heading", "wind"), [("output", "input"), ("input", "input"), ("output", "output")]
    )
    def test_innovations_have_exact_derivatives_in_the_variances(
        self, predictor, noisy, heading, wind
    ):
        """Against central differences; with a gap, and wind that depends on the states."""
        model = output_model(predictor, 1.0, heading, wind)
        data = measured(model, noisy)
        p = np.array([*truth(predictor), *CURRENT, 2.0, -3.0])[: len(model.parameters)]
        use = np.ones((2, 60))
        use[0, 30:35], use[1, 50:] = 0, 0
        w, y = (np.stack([x[:60], x[100:160]]) for x in (data.w, data.y))
        kalman, start = Filter(model, w, y, use), y[:, 0, : len(model.states)]
        size = {"u": 2e-4, "v": 2e-4, "r": 2e-4, "psi": 1e-4, "u_q": 0.1, "v_q": 0.1}
        noise = np.array([size[n] for n in model.outputs] + [0.05 * size[n] for n in model.states])
        found = kalman.by_noise(start, p, noise)
        h = 1e-4
        for j in range(len(noise)):
            up, down = noise.copy(), noise.copy()
            up[j] *= np.exp(h)
            down[j] *= np.exp(-h)
            above, below = kalman(start, p, up)[::2], kalman(start, p, down)[::2]
            for exact, a, b in zip(found, above, below, strict=True):
                expected = (a - b) / (2 * h)
                # truncation h²/6 of the third derivative, rounding 1e-15/h of the innovations
                tolerance = 1e-6 * np.abs(expected).max() + 1e-9
                np.testing.assert_allclose(exact[..., j] * noise[j], expected, atol=tolerance)

    def test_long_logs_are_differentiated_a_stretch_at_a_time(self, predictor, noisy, monkeypatch):
        model, data, p = problem(predictor, noisy)
        both = cut(
            [data.first(90), Measured(data.w[200:250], data.y[200:250], data.known[200:250])], 90
        )
        noise = np.array([2e-4, 2e-4, 2e-4, 1e-4, 1e-5, 1e-5, 1e-6, 1e-8])
        starts = both.y[:, 0]

        def derivatives():
            kalman = Filter(model, both.w, both.y, both.use)
            free = Simulator(model, both.w).sensitivities(starts, p)
            return [
                free[1],
                free[3],
                kalman(starts, p, noise)[1],
                *kalman.by_noise(starts, p, noise),
            ]

        whole = derivatives()
        monkeypatch.setattr(output_runs, "_BLOCK", 50)
        for part, expected in zip(derivatives(), whole, strict=True):
            size = np.abs(expected).max()
            np.testing.assert_allclose(part, expected, rtol=1e-9, atol=1e-12 * size)

    def test_likelihoods_of_several_logs_add(self, predictor, noisy):
        """Also where one is padded: rows beyond its end count for nothing."""
        model, data, p = problem(predictor, noisy)
        noise = np.array([2e-4, 2e-4, 2e-4, 1e-4, 1e-5, 1e-5, 1e-6, 1e-8])
        parts = [data.first(80), Measured(data.w[200:250], data.y[200:250], data.known[200:250])]
        both = cut(parts, 80)
        starts = np.array([part.y[0] for part in parts])
        value, by_start, by_p = Filter(model, both.w, both.y, both.use).likelihood(starts, p, noise)
        each = [
            Filter(model, d.w[None], d.y[None], np.ones((1, len(d.y)))).likelihood(
                z[None], p, noise
            )
            for d, z in zip(parts, starts, strict=True)
        ]
        assert value == pytest.approx(sum(e[0] for e in each), rel=1e-12)
        np.testing.assert_allclose(by_start, np.vstack([e[1] for e in each]), rtol=1e-9)
        np.testing.assert_allclose(by_p, sum(e[2] for e in each), rtol=1e-9)

    def test_the_likelihood_of_a_linear_model_is_that_of_a_gaussian(self):
        from scipy.stats import multivariate_normal

        surge = get_structure("surge")
        structure = surge.without(*[n for n in surge.parameters if n not in ("Xu", "Xmu")])
        predictor = output_predictor(structure, "basic", (("u", (1,)),))
        model = OutputModel(predictor, 1.0)
        rng = np.random.default_rng(4)
        n, r, q = 12, 0.3, 0.2
        drivers = rng.standard_normal((n, len(model.drivers)))
        y = rng.standard_normal((n, 1))
        p = np.array([-0.3 if c.name == "Xu" else 0.5 for c in predictor.columns])
        tau = drivers[:, model.drivers.index("taux")]
        gain = p[[c.name for c in predictor.columns].index("Xmu")]
        a, x0 = 0.7, 0.4
        mean, spread = np.zeros(n), np.zeros((n, n))
        x = x0
        for k in range(n):
            mean[k] = x
            x = a * x + gain * tau[k]
        for i in range(n):
            for j in range(n):
                spread[i, j] = q * sum(
                    a ** (i - 1 - k) * a ** (j - 1 - k) for k in range(min(i, j))
                ) + (r if i == j else 0.0)
        kalman = Filter(model, drivers[None], y[None], np.ones((1, n)))
        value = kalman.likelihood(np.array([[x0]]), p, np.array([r, q]))[0]
        expected = -multivariate_normal(mean, spread).logpdf(y[:, 0]) - n / 2 * np.log(2 * np.pi)
        assert value == pytest.approx(expected, rel=1e-9)


class TestFit:
    def test_noise_free_data_give_the_parameters_from_nothing(self, predictor, clean):
        found = estimate_oe(predictor, [clean])
        np.testing.assert_allclose(found.theta, truth(predictor), rtol=1e-5)
        values = [v for _, v, _ in found.current]
        np.testing.assert_allclose(values, CURRENT, atol=1e-6)
        assert found.status.startswith("converged")

    def test_equals_the_optimum_of_scipy(self, predictor, noisy):
        from scipy.optimize import least_squares

        model, data, p = problem(predictor, noisy, "input")
        sigma = np.full(3, np.sqrt(2e-4))
        fit, _ = fit_free_runs(model, [data], p, sigma=sigma)
        simulator = Simulator(model, data.w[None])
        scale = np.sqrt(np.diag(np.linalg.inv(fit.hessian)))

        def residuals(x):
            y, _ = simulator(x[None, -3:], p + x[:-3] * scale)
            return ((data.y - y[0]) / sigma).ravel()

        found = least_squares(
            residuals, np.append(np.zeros(len(p)), data.y[0]), xtol=1e-12, ftol=1e-12, gtol=1e-12
        )
        assert fit.cost == pytest.approx(found.cost, rel=1e-9)
        assert fit.cost <= found.cost * (1 + 1e-12)
        np.testing.assert_allclose((fit.p - p) / scale, found.x[:-3], atol=2e-3)

    def test_starts_that_are_measured_stay_and_the_rest_is_fitted(self, predictor, noisy):
        from scipy.optimize import least_squares

        model, data, p = problem(predictor, noisy, "input")
        sigma = np.full(3, np.sqrt(2e-4))
        fit, _ = fit_free_runs(model, [data], 0 * p, sigma=sigma, fixed=True)
        begin = data.y[:5].mean(axis=0)
        np.testing.assert_allclose(fit.nodes[0], begin, rtol=1e-12)
        simulator = Simulator(model, data.w[None])
        scale = np.sqrt(np.diag(np.linalg.inv(fit.hessian)))

        def residuals(x):
            y, _ = simulator(begin[None], p + x * scale)
            return ((data.y - y[0]) / sigma).ravel()

        found = least_squares(residuals, (fit.p - p) / scale, xtol=1e-12, ftol=1e-12, gtol=1e-12)
        assert fit.converged
        assert fit.cost == pytest.approx(found.cost, rel=1e-9)

    def test_segments_that_join_give_the_same_optimum(self, predictor, noisy):
        model, data, p = problem(predictor, noisy, "input")
        one, single = fit_free_runs(model, [data], p, shooting="single")
        many, joined = fit_free_runs(model, [data], p, shooting="multiple")
        assert many.converged
        assert many.gap < 1e-6
        assert len(joined.segments.use) > 5
        np.testing.assert_allclose(joined.sigma, single.sigma, rtol=1e-6)
        std = np.sqrt(np.diag(np.linalg.inv(one.hessian)))
        np.testing.assert_allclose((many.p - one.p) / std, 0.0, atol=1e-3)
        np.testing.assert_allclose(
            many.hessian / np.outer(1 / std, 1 / std), one.hessian * np.outer(std, std), atol=1e-3
        )

    def test_a_start_far_off_ends_at_the_same_optimum(self, predictor, noisy):
        rng = np.random.default_rng(1)
        near = estimate_oe(predictor, [noisy], start=truth(predictor))
        wild = estimate_oe(predictor, [noisy], start=rng.standard_normal(len(THESIS.terms)))
        np.testing.assert_allclose((wild.theta - near.theta) / near.std, 0.0, atol=1e-2)

    def test_an_unstable_ship_is_fitted(self):
        structure = get_structure("surge").with_terms("X_uuu")
        keep = {"Xu", "Xmu", "X_uuu"}
        structure = structure.without(*[n for n in structure.parameters if n not in keep])
        model = OutputModel(output_predictor(structure, "basic", (("u", (1, -1)),)), 1.0)
        order = [c.name for c in model.columns]
        p = np.array([{"Xu": 0.2, "X_uuu": -0.2, "Xmu": 0.1}[n] for n in order])
        rng = np.random.default_rng(2)
        w = np.zeros((800, len(model.drivers)))
        w[:, model.drivers.index("taux")] = np.repeat(rng.choice([-1.0, 1.0], 40), 20)
        y, _ = Simulator(model, w[None])(np.array([[0.1]]), p)
        seen = y[0] + 0.05 * rng.standard_normal(y[0].shape)
        for shooting in ("auto", "multiple"):
            fit, _ = fit_free_runs(
                model, [Measured(w, seen, np.ones(len(seen), bool))], 0 * p, shooting=shooting
            )
            std = np.sqrt(np.diag(np.linalg.inv(fit.hessian)))
            assert (np.abs(fit.p - p) < 4 * std).all()

    def test_what_only_segments_hold_together_does_not_follow_the_log(self, predictor, noisy):
        model, data, p = problem(predictor, noisy, "input")
        pair = fit_free_runs(model, [data], p, shooting="multiple")
        whole = cut([data], len(data.y))
        starts = measured_starts(whole, len(model.states))
        assert _follows(pair, whole, starts)
        driven = p.copy()
        driven[model.parameters.index("Yv")] = 0.1
        assert not _follows((replace(pair[0], p=driven), pair[1]), whole, starts)

    def test_a_structure_too_small_gets_whole_runs(self, predictor, noisy, monkeypatch):
        """Joined segments that neither follow nor explain the log are given up."""
        model, data, p = problem(predictor, noisy, "input")

        def never(runs, p, nodes, *rest):
            fit, runs = settle(runs, p, nodes, *rest)
            joined = len(runs.segments.use) > 1
            return replace(fit, converged=joined, cost=-1e9 if joined else fit.cost), runs

        settle = free_run._settle
        monkeypatch.setattr(free_run, "_settle", never)
        monkeypatch.setattr(free_run, "_DOUBTFUL", 0.0)
        monkeypatch.setattr(free_run, "_follows", lambda *_: True)
        _, runs = fit_free_runs(model, [data], p)
        assert len(runs.segments.use) > 1
        monkeypatch.setattr(free_run, "_follows", lambda *_: False)
        fit, runs = fit_free_runs(model, [data], p)
        assert len(runs.segments.use) == 1
        std = np.sqrt(np.diag(np.linalg.inv(fit.hessian)))
        assert (np.abs(fit.p - p) < 4.5 * std).all()

    def test_a_constant_wind_can_be_compared_instead_of_driving(self, predictor):
        log = virtual_log(3, 400, spread=0.0, wind=3.0)
        rng = np.random.default_rng(0)
        noisy = {n: log[n] + 0.3 * rng.standard_normal(400) for n in ("u_q", "v_q")}
        log = replace(log, channels={**log.channels, **noisy})
        found = estimate_oe(predictor, [log], options=OutputErrorOptions(wind="output"))
        assert found.noise.wind == pytest.approx(0.3, rel=0.1)
        assert (np.abs(found.theta - truth(predictor)) < 4.5 * found.std).all()

    def test_several_logs_have_their_own_starts(self, predictor):
        logs = [virtual_log(s, 300, spread=0.0) for s in (5, 6)]
        found = estimate_oe(predictor, logs)
        assert found.samples == 600
        assert (np.abs(found.theta - truth(predictor)) < 4.5 * found.std).all()

    def test_outliers_hardly_move_the_robust_loss(self, predictor, noisy):
        channels = dict(noisy.channels)
        channels["u"] = channels["u"].copy()
        channels["u"][::40] += 2.0
        spoilt = replace(noisy, channels=channels)
        heading = {"heading": "input"}
        plain = estimate_oe(predictor, [spoilt], options=OutputErrorOptions(**heading))
        robust = estimate_oe(
            predictor, [spoilt], options=OutputErrorOptions(loss="huber", **heading)
        )
        clean = estimate_oe(predictor, [noisy], options=OutputErrorOptions(**heading))

        def away(e):
            return np.abs((e.theta - clean.theta) / clean.std)[:6].max()

        assert away(robust) < 3
        assert away(plain) > 3 * away(robust)

    def test_scaling_the_input_scales_its_parameter(self, predictor, noisy):
        model, data, p = problem(predictor, noisy, "input")
        w = data.w.copy()
        w[:, model.drivers.index("taux")] *= 10
        one, _ = fit_free_runs(model, [data], p)
        ten, _ = fit_free_runs(model, [Measured(w, data.y, data.known)], 0 * p)
        i = [c.name for c in predictor.columns].index("Xmu")
        assert ten.p[i] == pytest.approx(one.p[i] / 10, rel=1e-4)


class TestHeading:
    def test_a_good_run_of_both_is_the_only_one(self, predictor, noisy, monkeypatch):
        """What leaves no more than sensors do was fitted once, and is what two fits end with."""
        alone = estimate_oe(predictor, [noisy])
        asked = []
        cautious = output_error.fit_free_runs

        def fitted(model, *rest, once=False, **more):
            asked.append((model.heading, once))
            fit, runs = cautious(model, *rest, once=once, **more)
            return (replace(fit, converged=False) if once else fit), runs

        monkeypatch.setattr(output_error, "fit_free_runs", fitted)
        both = estimate_oe(predictor, [noisy])
        assert asked == [("output", True), ("input", False), ("output", False)]
        np.testing.assert_allclose((both.theta - alone.theta) / alone.std, 0.0, atol=1e-4)
        np.testing.assert_allclose(both.std, alone.std, rtol=1e-4)

    def test_a_heading_that_drifts_drives_the_run(self, predictor, noisy):
        walk = 0.02 * np.cumsum(np.random.default_rng(1).standard_normal(len(noisy)))
        turned = replace(noisy, channels={**noisy.channels, "psi": noisy["psi"] + walk})
        found = estimate_oe(predictor, [turned])
        assert not any("heading was simulated" in n for n in found.notes)


class TestExcitation:
    def test_the_own_share_is_one_less_the_others_explanation(self, predictor, noisy):
        """Regressing one sensitivity on all others leaves that share of it."""
        model, data, p = problem(predictor, noisy, "input")
        found = estimate_oe(
            predictor, [noisy], options=OutputErrorOptions(heading="input", covariance="white")
        )
        tests = {t.name: t for t in found.tests}
        p = np.append(found.theta, [v for _, v, _ in found.current])
        runs = Simulator(model, data.w[None])
        fit, free = fit_free_runs(model, [data], p, near=True)
        rows = runs.sensitivities(fit.nodes, fit.p)[1][0] / free.sigma[:, None]
        flat = rows.reshape(-1, rows.shape[2]).T
        for state, name in (("u", "Xuu"), ("r", "Nvr")):
            i = list(model.parameters).index(name)
            # initial states are eliminated from both, then the other parameters
            others = np.delete(flat, i, axis=0)
            starts = flat[len(p) :]

            def left(of, by):
                return of - np.linalg.lstsq(by.T, of, rcond=None)[0] @ by

            share = (left(flat[i], others) ** 2).sum() / (left(flat[i], starts) ** 2).sum()
            assert tests[f"excitation_{state}"].detail["own_share"][name] == pytest.approx(
                share, rel=1e-3
            )


class TestRestrictions:
    def test_bounds_hold_and_are_named(self, predictor, noisy):
        found = estimate_oe(
            predictor, [noisy], options=OutputErrorOptions(bounds={"Xu": (-0.03, 0.0)})
        )
        i = [c.name for c in predictor.columns].index("Xu")
        assert found.theta[i] == pytest.approx(-0.03)
        assert found.std[i] == 0
        assert any("ended at a bound" in n and "Xu at " in n for n in found.notes)
        assert np.isfinite(found.covariance).all()

    def test_a_sharp_prior_holds_its_parameter(self, predictor, noisy):
        found = estimate_oe(
            predictor, [noisy], options=OutputErrorOptions(priors={"Wuu": (-0.0005, 1e-7)})
        )
        i = [c.name for c in predictor.columns].index("Wuu")
        assert found.theta[i] == pytest.approx(-0.0005, abs=1e-6)
        assert found.std[i] == pytest.approx(1e-7, rel=0.2)

    def test_enforced_damping_never_drives(self, predictor):
        log = virtual_log(11, 150, spread=0.0)
        found = estimate_oe(predictor, [log], options=OutputErrorOptions(damping="enforce"))
        for column, value in zip(predictor.columns, found.theta, strict=True):
            if THESIS.terms[THESIS.index(column.terms[0])].dissipates:
                assert value <= 0

    def test_which_terms_dissipate(self):
        damping = {t.name for t in THESIS.terms if t.dissipates}
        assert damping == {"Xu", "Xuu", "Wuu", "Yv", "Yvv", "Wvv", "Nr", "Nvr"}

    @pytest.mark.parametrize(
        ("options", "words"),
        [
            ({"bounds": {"Xuv": (0, 1)}}, "'Xuv', which is not estimated. Did you mean"),
            ({"bounds": {"Xu": (1, 0)}}, "the bounds of Xu are 1 and 0"),
            ({"priors": {"Xu": (0, -1)}}, "deviation -1, it must be positive"),
        ],
    )
    def test_wrong_ones_are_refused(self, predictor, noisy, options, words):
        with pytest.raises(UsageError, match=words.split(",")[0].split(".")[0]):
            estimate_oe(predictor, [noisy], options=OutputErrorOptions(**options))


class TestRefusals:
    def test_two_samples(self, predictor, noisy):
        with pytest.raises(ExcitationError, match="2 samples and 23 unknowns"):
            estimate_oe(
                predictor, [noisy.window(0, 2)], options=OutputErrorOptions(heading="input")
            )

    def test_what_never_moves_is_named(self, predictor, noisy):
        short = noisy.window(0, 200)
        still = replace(short, channels={**short.channels, "n": 0 * short["n"]})
        with pytest.raises(
            ExcitationError, match=r"the run of the whole log is the same|cannot be told apart"
        ):
            estimate_oe(predictor, [still], options=OutputErrorOptions(heading="input"))

    def test_a_heading_needs_a_yaw_rate(self):
        surge = output_predictor(get_structure("surge"), "basic", (("u", (1,)),))
        with pytest.raises(StructureError, match="no yaw rate"):
            OutputModel(surge, 1.0, "output")

    def test_wind_as_an_output_needs_its_mean(self, predictor):
        with pytest.raises(StructureError, match="take the wind as an input"):
            OutputModel(predictor, 1.0, "input", "output")


class TestInnovations:
    def test_process_noise_is_found(self, predictor):
        rng = np.random.default_rng(3)
        log = virtual_trial(rng, CASES[1], 800)
        found = estimate_oe(predictor, [log], options=OutputErrorOptions(process_noise=True))
        assert found.noise.process[2] == pytest.approx(2e-4, rel=0.5)
        assert found.noise.measurement == pytest.approx(np.full(3, np.sqrt(2e-4)), rel=0.15)
        assert (np.abs(found.theta - truth(predictor)) < 4.5 * found.std).all()

    def test_the_likelihood_never_falls(self, predictor):
        log = virtual_trial(np.random.default_rng(5), CASES[1], 300)
        model, data, p = problem(predictor, log)
        fit, runs = fit_innovations(model, [data], p, restrictions=unrestricted(len(p)))
        begin = FilterRuns(model, cut([data], len(data.y)), runs.noise)
        _, _, _ = begin.value(p, fit.nodes)
        at = begin.value(fit.p, fit.nodes)
        before = begin.value(p, fit.nodes)
        total = [(v[0] ** 2).sum() / 2 + v[2] for v in (at, before)]
        assert total[0] < total[1]


class TestLimits:
    def test_information_equals_that_of_the_design(self, predictor):
        from experiment_design.information.sensitivities import SensitivityProgram

        log = virtual_log(9, 300, spread=0.0, noise=0.0)
        model, data, p = problem(predictor, log)
        noise = NoiseLevels(THESIS.states, np.full(3, 0.014), np.zeros(3), 0.01)
        mine = information(model, [data], p, data.y[:1], noise_variances(model, noise))
        other = SensitivityProgram(
            predictor, np.array([TRUE[n] for n in THESIS.parameters]),
            np.array([*CURRENT, 1.0, 1.0]), noise, 1.0,
            means=("current_north", "current_east"),
        )  # fmt: skip
        tau = data.w[:-1, :3]
        y, _ = Simulator(model, data.w[None])(data.y[:1], p)
        f = other(y[:, :-1, :3], y[:, :-1, 3], tau[None]).gram[0]
        p_, start = (
            len(predictor.columns),
            slice(len(predictor.columns), len(predictor.columns) + 4),
        )
        keep = [*range(p_), p_ + 4, p_ + 5]
        eliminated = f[np.ix_(keep, keep)] - f[keep, start] @ np.linalg.solve(
            f[start, start], f[start, keep]
        )
        scale = np.sqrt(np.diag(eliminated))
        np.testing.assert_allclose(
            mine / np.outer(scale, scale), eliminated / np.outer(scale, scale), atol=1e-6
        )

    def test_process_noise_takes_information_away(self, predictor, noisy):
        model, data, p = problem(predictor, noisy)
        quiet = NoiseLevels(THESIS.states, np.full(3, 0.014), np.zeros(3), 0.01)
        pushed = NoiseLevels(THESIS.states, np.full(3, 0.014), np.full(3, 1e-3), 0.01)
        small, large = (
            np.diag(cramer_rao(model, [data], p, data.y[:1], noise_variances(model, n)))
            for n in (quiet, pushed)
        )
        assert (large > small).all()

    def test_determinants_are_corrected_for_the_run_count(self):
        rng = np.random.default_rng(0)
        bound = np.diag([1.0, 4.0, 9.0, 0.25])
        shares = [
            determinant_efficiency(rng.multivariate_normal(np.zeros(4), bound, 12), bound)
            for _ in range(400)
        ]
        mean = np.mean([np.log(s.value) for s in shares])
        assert abs(mean) < 4 * np.std([np.log(s.value) for s in shares]) / 20
        inside = np.mean([s.low <= 1 <= s.high for s in shares])
        assert inside == pytest.approx(0.95, abs=0.04)


class TestErrors:
    def test_shared_scores_equal_the_double_sum(self):
        rng = np.random.default_rng(7)
        rows, r = rng.standard_normal((3, 60, 2)), rng.standard_normal((60, 2))
        r[1:] += 0.6 * r[:-1]
        gamma = flat_top_autocovariance([r], 3)
        total = np.zeros((3, 3))
        for k in range(60):
            for j in range(60):
                lag = abs(k - j)
                if lag < len(gamma):
                    g = gamma[lag] if k >= j else gamma[lag].T
                    total += rows[:, k] @ g @ rows[:, j].T
        found = shared_score_covariance([(rows, r)], "ma", 3)
        values = np.linalg.eigvalsh(total)
        assert values[0] > 0
        np.testing.assert_allclose(found, total, rtol=1e-9)

    def test_white_errors_do_not_wander_and_walks_do(self):
        rng = np.random.default_rng(8)
        rows = rng.standard_normal((4, 500, 2))
        hessian = np.einsum("ikc,jkc->ij", rows, rows)
        white = rng.standard_normal((500, 2))
        walk = white + 0.15 * np.cumsum(rng.standard_normal((500, 2)), axis=0)
        assert (slow_errors([rows], hessian, [white])[1] > 0.01).all()
        assert (slow_errors([rows], hessian, [walk])[1] <= 0.01).all()


class TestCommand:
    def test_result_has_verdict_bounds_and_no_odd_numbers(self, tmp_path, noisy):
        log = write_csv(noisy, tmp_path / "log.csv")
        out = tmp_path / "m.json"
        code = main(
            ["estimate", str(log), "--vessel", "thesis", "--method", "oe", "--json", str(out),
             "--bound", "Xu=-0.5:0", "--prior", "Nr=-0.1:0.05", "--damping", "enforce"]
        )  # fmt: skip
        assert code == 0
        text = out.read_text()
        assert "NaN" not in text
        assert "Infinity" not in text
        data = json.loads(text)
        assert data["method"] == "oe"
        assert data["verdict"]["coefficients"]["level"].startswith(("trust", "do not trust"))
        assert data["verdict"]["prediction"]["level"] in ("good", "limited", "poor")
        assert 0.3 < data["limits"]["cramer_rao"]["determinant_efficiency"] < 3
        assert set(data["noise"]["measurement"]) == {"u", "v", "r"}
        assert "slow_errors_psi" in data["tests"] or "slow_errors_r" in data["tests"]

    @pytest.mark.parametrize(
        ("words", "said"),
        [
            (["--bound", "Xu=1"], "write NAME=LOW:HIGH"),
            (["--margin-u", "0.1"], "a free run needs every one"),
        ],
    )
    def test_wrong_options_are_said(self, tmp_path, noisy, capsys, words, said):
        log = write_csv(noisy, tmp_path / "log.csv")
        code = main(["estimate", str(log), "--vessel", "thesis", "--method", "oe", *words])
        assert code == 1
        assert said in capsys.readouterr().err


def test_standard_errors_agree_where_the_model_holds(predictor, noisy):
    """With white errors: those of the information, of segments, and of blocks drawn again."""
    found = {
        kind: estimate_oe(
            predictor, [noisy], options=OutputErrorOptions(heading="input", covariance=kind)
        ).std
        for kind in ("white", "cluster", "bootstrap")
    }
    # 500 draws of some 30 blocks know a standard deviation to about 15 %
    assert np.median(found["bootstrap"] / found["white"]) == pytest.approx(1.0, abs=0.25)
    assert (found["cluster"] > 0.8 * found["white"]).all()
    assert np.median(found["cluster"] / found["white"]) < 1.3


def test_the_curvature_of_a_misfit_widens_intervals(noisy):
    """A structure too small: its inverse Hessian is that of the likelihood, found by refits."""
    small = output_predictor(get_structure("linear"), "basic", REGIME)
    fits = []
    keep = output_error._inverse_hessian

    def kept(fitted, free, *, concentrated):
        fits.append((fitted, free, keep(fitted, free, concentrated=concentrated)))
        return fits[-1][-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(output_error, "_inverse_hessian", kept)
        estimate_oe(small, [noisy], options=OutputErrorOptions(heading="input"))
    fitted, free, inverse = fits[-1]

    def cost(p):
        """Return −log L with the noise of each output and the starts fitted."""
        starts = fitted.fit.nodes
        for _ in range(3):
            at = fitted.runs.linearise(p, starts)
            slopes = at.rows[0][:, len(p) :]
            starts = starts + np.linalg.lstsq(slopes, at.r[0].ravel(), rcond=1e-10)[0]
        r = fitted.runs.linearise(p, starts).r
        n = fitted.runs.segments.use.sum()
        return 0.5 * n * float(np.log((r**2).sum(axis=(0, 1)) / n).sum())

    # along a direction of one standard error −log L rises by half its square
    for j in range(len(free)):
        step = inverse[:, j] / np.sqrt(inverse[j, j])
        p = [fitted.fit.p.copy() for _ in range(3)]
        p[0][free] -= step
        p[2][free] += step
        rise = cost(p[0]) + cost(p[2]) - 2 * cost(p[1])
        assert rise == pytest.approx(1.0, rel=0.25)


@pytest.mark.long
@pytest.mark.parametrize("memory", [0.0, 20.0])
def test_intervals_cover(predictor, memory):
    """White errors, and process noise that remembers: 95 % intervals hold."""
    from greybox.model.run.simulation import simulate, stationary_disturbance
    from greybox.trial.log import make_log
    from greybox.vessel.toml import load_vessel

    inside = []
    for seed in range(50):
        base = virtual_log(4, 1000, spread=0.0, noise=0.0)
        rng = np.random.default_rng([17, seed])
        commands = {n: base[n] for n in ("n", "alpha1", "alpha2")}
        tau = base.forces(THESIS.inputs)
        push = None
        if memory:
            std = np.array([1e-3, 1e-3, 1e-4])
            push = stationary_disturbance(rng, np.zeros(3), std, 999, correlation_time=memory)[0]
        d = np.tile([*CURRENT, 1.0, 1.0], (999, 1))
        run = simulate(
            THESIS, np.array([TRUE[n] for n in THESIS.parameters]), np.array([1.5, 1.2, 0.0]),
            tau[:-1], 1.0, d=d, process_noise=push,
        )  # fmt: skip
        x, psi = run.x[0], run.psi[0]
        c, s = np.cos(psi), np.sin(psi)
        channels = commands | {n: x[:, i] + np.sqrt(2e-4) * rng.standard_normal(1000)
                               for i, n in enumerate("uvr")}  # fmt: skip
        channels |= {"psi": psi + 0.01 * rng.standard_normal(1000),
                     "u_q": x[:, 0] - (c + s), "v_q": x[:, 1] - (c - s)}  # fmt: skip
        found = estimate_oe(predictor, [make_log(load_vessel("thesis"), channels, 1.0)])
        inside.append(np.abs(found.theta - truth(predictor)) < 1.96 * found.std)
    share = np.mean(inside)
    # runs are independent, parameters within one are not
    error = np.std(np.mean(inside, axis=1)) / np.sqrt(len(inside))
    assert share == pytest.approx(0.95, abs=0.02 + 2 * error)


def test_weights_by_deviation_minimise_the_errors_in_their_own_measure(noisy):
    """On a structure too small: no other start or weight leaves less of Σ (e/spread)²."""
    small = output_predictor(get_structure("linear"), "basic", REGIME)
    y = np.column_stack([noisy[s] for s in "uvr"])

    def left(estimate, first):
        model = output_model(estimate.predictor, estimate.sample_time)
        log = measured(model, noisy)
        runs, _ = Simulator(model, cut([log], len(noisy)).w)(first[None], estimate.theta)
        return float((((y - runs[0]) / y.std(axis=0)) ** 2).sum())

    options = OutputErrorOptions(heading="input", weights="deviation")
    found = estimate_oe(small, [noisy], options=options)
    assert "weighed by the deviation" in found.status
    usual = estimate_oe(small, [noisy], options=OutputErrorOptions(heading="input"))
    model = output_model(small, 1.0)
    data = [measured(model, noisy)]
    fit, _ = fit_free_runs(model, data, found.theta, sigma=y.std(axis=0), near=True)
    first = fit.nodes[0]
    least = left(found, first)
    assert 2 * fit.cost == pytest.approx(least, rel=1e-5)
    assert least < left(usual, first)
    rng = np.random.default_rng(0)
    std = np.sqrt(np.diag(found.covariance))
    for _ in range(5):
        moved = replace(found, theta=found.theta + 0.1 * std * rng.standard_normal(len(std)))
        assert least < left(moved, first)


def test_weights_say_nothing_of_the_noise(predictor, noisy):
    """Where the model is right both find the truth, and the same noise."""
    common = {"heading": "input", "covariance": "white"}
    found = estimate_oe(
        predictor, [noisy], options=OutputErrorOptions(weights="deviation", **common)
    )
    usual = estimate_oe(predictor, [noisy], options=OutputErrorOptions(**common))
    np.testing.assert_allclose(found.noise.measurement, usual.noise.measurement, rtol=0.05)
    errors = (found.theta - truth(predictor)) / np.sqrt(np.diag(found.covariance))
    assert np.sqrt((errors**2).mean()) < 2.0


def test_a_regression_refuses_what_is_zero_where_the_water_rests():
    with pytest.raises(StructureError, match=r"X_r\*vc is zero where the water rests.*--method oe"):
        build_predictor(get_structure("thesis").with_terms("X_r*vc"), "augmented")


def test_a_free_run_in_a_current_has_a_column_for_what_is_zero_without_one():
    plain = output_predictor(get_structure("thesis"), "augmented", REGIME)
    wider = output_predictor(
        get_structure("thesis").with_terms("X_r*vc", "Y_r*uc"), "augmented", REGIME
    )
    assert {*wider.parameter_names} - {*plain.parameter_names} == {"X_r*vc", "Y_r*uc"}
    states = [c.state for c in wider.columns]
    assert states == sorted(states, key="uvr".index)
    for state in "uvr":
        biases = [wider.columns[i].is_bias for i in wider.equation(state)]
        assert biases == sorted(biases)
    assert all(len(b.shares) == len(wider.equation(b.state)) for b in wider.biases)
    point = ([np.array([1.2]), np.array([0.3]), np.array([0.1])], 0.4, [np.array([1.0])] * 3)
    old, new = plain.evaluate(*point), wider.evaluate(*point)
    kept = [i for i, c in enumerate(wider.columns) if c.name not in ("X_r*vc", "Y_r*uc")]
    np.testing.assert_array_equal(new[kept], old)


def test_a_parameter_at_its_bound_takes_no_part_in_the_efficiency():
    information = np.array([[4.0, 1.0], [1.0, 2.0]])
    found = _limit(["Yv", "Nr"], np.linalg.inv(information), np.diag([0.0, 1.0]))
    assert found.std == pytest.approx({"Nr": 2**-0.5})
    assert found.determinant == pytest.approx(0.5)
    assert "inf" not in found.sentence
