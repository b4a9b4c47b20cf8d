"""Bands of a free run: what they are made of, and that they cover what they promise."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from virtual import PARAMETERS, virtual_log, write_csv

from greybox.commands.main import main
from greybox.estimation.output_error import estimate_oe
from greybox.estimation.output_setup import output_predictor
from greybox.model.catalogue import get_structure
from greybox.model.model import ManoeuvringModel, load_model
from greybox.model.noise import NoiseLevels
from greybox.model.run.simulation import simulate, stationary_disturbance
from greybox.selection.estimate import estimate_requested
from greybox.selection.request import Request
from greybox.study.chapter6 import TRUE
from greybox.study.inputs import smoothed_pulses
from greybox.trial.log import make_log
from greybox.validation.bands import draw_parameters, predict_bands
from greybox.validation.comparison import compare
from greybox.vessel.toml import load_vessel

STATES = ("u", "v", "r")
# per sample and state, of what moves the ship beside the model
PUSH = np.array([1e-3, 1e-3, 3e-4])


SIGMA = 2e-4**0.5


def pushed(seed, samples, push=0.0, sigma=SIGMA):
    """A log of the thesis's ship in steady current and wind, and the true motion."""
    structure, vessel = get_structure("thesis"), load_vessel("thesis")
    rng = np.random.default_rng([300, seed])
    commands = {
        name: smoothed_pulses(rng, samples, low, high, widths=(20, 80), smoothing=10)
        for name, low, high in (("n", 10, 20), ("alpha1", 0.6, 1.1), ("alpha2", 0.6, 1.1))
    }
    tau = make_log(vessel, commands, 1.0).forces(structure.inputs)[:-1]
    d = np.array([0.2, -0.2, 1.0, 1.0])
    w = push * PUSH * stationary_disturbance(rng, np.zeros(3), 1.0, samples - 1)
    theta = np.array([TRUE[n] for n in PARAMETERS])
    run = simulate(structure, theta, np.array([1.5, 1.2, 0.0]), tau, 1.0, d=d, process_noise=w)
    x, psi = run.x[0], run.psi[0]
    c, s = np.cos(psi), np.sin(psi)
    noise = rng.standard_normal((samples, 4)) * np.array([sigma, sigma, sigma, 0.01])
    channels = commands | {
        "u": x[:, 0] + noise[:, 0], "v": x[:, 1] + noise[:, 1], "r": x[:, 2] + noise[:, 2],
        "psi": psi + noise[:, 3],
        "u_q": x[:, 0] - (c * d[2] + s * d[3]), "v_q": x[:, 1] - (c * d[3] - s * d[2]),
    }  # fmt: skip
    return make_log(vessel, channels, 1.0, f"pushed {seed}"), x


def model_of(covariance=None, noise=None, **more):
    structure = get_structure("thesis")
    p = len(structure.terms)
    return ManoeuvringModel(
        structure,
        np.array([TRUE[n] for n in PARAMETERS]),
        np.zeros((p, p)) if covariance is None else covariance,
        1.0,
        load_vessel("thesis"),
        disturbances={"current_north": (0.2, 0.0), "current_east": (-0.2, 0.0)},
        noise=noise,
        **more,
    )


def levels(measurement=0.0, process=0.0, memory=()):
    quiet = np.full(3, measurement if measurement else 1e-12)
    return NoiseLevels(STATES, quiet, process * np.ones(3), memory=np.array(memory))


def test_without_uncertainty_the_band_is_the_run():
    log, x = pushed(1, 300, sigma=0.0)
    exact = {**log.channels, "psi": np.cumsum(np.append(0.0, x[:-1, 2]))}
    log = make_log(log.vessel, exact, 1.0)
    bands = predict_bands(model_of(noise=levels()), log)
    np.testing.assert_allclose(bands.motion, np.stack([x, x]), atol=1e-9)
    np.testing.assert_allclose(bands.measurement, np.stack([x, x]), atol=1e-9)
    assert bands.notes == ("the model has no covariance, so its parameters were taken as exact.",)


def test_process_noise_spreads_as_the_linear_theory_says():
    """At rest the yaw equation is linear: variance q² (1 − a²ᵏ) / (1 − a²), a = 1 + Nr."""
    vessel = load_vessel("thesis")
    still = {n: np.zeros(200) for n in ("n", "alpha1", "alpha2", "u", "v", "r", "psi")}
    log = make_log(vessel, still, 1.0)
    q, a = 1e-3, 1 + TRUE["Nr"]
    model = replace(model_of(noise=levels(process=q)), disturbances={})
    bands = predict_bands(model, log, heading="simulated", runs=1500)
    half = (bands.motion[1, :, 2] - bands.motion[0, :, 2]) / 2
    k = np.arange(200)
    want = 1.96 * q * np.sqrt((1 - a ** (2 * k)) / (1 - a**2))
    # an outer quantile of 1500 draws scatters by 5 %
    np.testing.assert_allclose(half[20:].mean(), want[20:].mean(), rtol=0.05)
    remembering = replace(model, noise=levels(process=q, memory=[0.0, 0.0, 0.95]))
    slow = predict_bands(remembering, log, heading="simulated", runs=1500).motion
    rho = 0.95
    gain = np.sqrt((1 + a * rho) / (1 - a * rho))
    np.testing.assert_allclose((slow[1] - slow[0])[100:, 2].mean() / 2, want[-1] * gain, rtol=0.06)


def test_models_keep_the_memory_of_their_noise(tmp_path):
    for memory in ([], [0.0, 0.5, 0.9]):
        model = model_of(noise=levels(0.01, 1e-3, memory))
        model.save(tmp_path / "m.json")
        again = load_model(tmp_path / "m.json").noise
        np.testing.assert_array_equal(again.memory, memory)


def test_errors_of_parameters_and_current_are_drawn_together(tmp_path):
    """What one gives the other takes: the sum is known well, its parts are not."""
    p = len(PARAMETERS)
    factor = np.zeros((p + 2, 2))
    factor[0] = factor[p] = 0.01, 0.0
    factor[p + 1] = -0.01, 0.001
    joint = factor @ factor.T
    model = model_of(joint[:p, :p], disturbance_covariance=joint[:, p:])
    model = replace(
        model, disturbances={"current_north": (0.2, 0.01), "current_east": (-0.2, 0.01)}
    )
    model.save(tmp_path / "m.json")
    for m in (model, load_model(tmp_path / "m.json")):
        theta, d = draw_parameters(m, np.random.default_rng(0), 4000)
        np.testing.assert_allclose(theta[:, 0] - d[:, 0, 0], model.theta[0] - 0.2, atol=1e-9)
        assert (theta[:, 0] + d[:, 0, 1]).std() == pytest.approx(0.001, rel=0.05)
        assert d[:, 0, 0].std() == pytest.approx(0.01, rel=0.05)
    apart = replace(model, disturbance_covariance=np.zeros((0, 0)))
    theta, d = draw_parameters(apart, np.random.default_rng(0), 4000)
    assert (theta[:, 0] - d[:, 0, 0]).std() == pytest.approx(0.01 * np.sqrt(2), rel=0.05)


def test_an_estimate_tells_how_its_current_moves_with_its_parameters():
    predictor = output_predictor(get_structure("thesis"), "wind", (("u", (1,)), ("v", (1,))))
    estimate = estimate_oe(predictor, [virtual_log(3, 500, spread=0.0)])
    model = estimate.model()
    p = len(model.theta)
    assert model.disturbance_covariance.shape == (p + 2, 2)
    std = [s for _, s in model.disturbances.values()]
    np.testing.assert_allclose(np.sqrt(np.diag(model.disturbance_covariance[p:])), std)
    joint = np.block(
        [
            [model.covariance, model.disturbance_covariance[:p]],
            [model.disturbance_covariance[:p].T, model.disturbance_covariance[p:]],
        ]
    )
    scale = np.sqrt(np.diag(joint))
    assert np.linalg.eigvalsh(joint / np.outer(scale, scale))[0] > 0


def test_measurements_add_their_noise_as_squares():
    log, _ = pushed(2, 200)
    bands = predict_bands(model_of(noise=levels(0.02, 1e-3)), log)
    low, high = bands.motion
    half = (bands.measurement[1] - bands.measurement[0]) / 2
    assert (half >= 1.96 * 0.02 - 1e-9).all()
    np.testing.assert_allclose(half, np.hypot((high - low) / 2, 1.96 * 0.02), rtol=0.1)


def test_same_seed_same_band_and_long_logs_are_one_run():
    log, _ = pushed(3, 2600)
    covariance = np.diag((0.02 * model_of().theta) ** 2)
    model = model_of(covariance, levels(0.014, 1e-3, [0.9, 0.9, 0.9]))
    one, two = (predict_bands(model, log, seed=4, runs=64) for _ in range(2))
    np.testing.assert_array_equal(one.motion, two.motion)
    assert (predict_bands(model, log, seed=5, runs=64).motion != one.motion).any()
    # pieces of the simulation join without a jump
    width = (one.motion[1] - one.motion[0])[:, 0]
    assert abs(np.diff(width)[2040:2056]).max() < 10 * np.median(abs(np.diff(width)))


def test_a_draw_that_diverges_is_left_out_and_counted():
    log, _ = pushed(4, 300)
    covariance = np.zeros((len(PARAMETERS), len(PARAMETERS)))
    i = PARAMETERS.index("Nr")
    covariance[i, i] = 0.1**2
    some = predict_bands(model_of(covariance, levels(0.014)), log)
    assert 0 < some.diverged < 128
    assert f"{some.diverged} of 256 draws of the parameters diverge" in some.notes[0]
    assert np.isfinite(some.motion).all()
    unstable = replace(model_of(covariance, levels(0.014)), theta=model_of().theta * -1)
    none = predict_bands(unstable, log)
    assert np.isnan(none.motion[:, -1]).all()
    assert none.coverage == {}
    assert "too many for a band" in none.notes[0]


def test_what_is_missing_is_said():
    log, _ = pushed(5, 200)
    bands = predict_bands(model_of(), log)
    assert [n.split(",")[0] for n in bands.notes] == [
        "the model has no covariance",
        "the model has no noise levels",
    ]
    assert bands.coverage == {}


def test_a_ship_that_changed_leaves_its_band():
    log, _ = pushed(6, 400)
    good = predict_bands(model_of(noise=levels(SIGMA)), log)
    for state in STATES:
        c = good.coverage[state]
        # 400 measurements: the share has a deviation of 1.1 %
        assert c.share == pytest.approx(0.95, abs=0.045)
        assert c.holds
    weaker = np.where(np.array(PARAMETERS) == "Xmu", 0.9, 1.0)
    other = replace(model_of(noise=levels(SIGMA)), theta=model_of().theta * weaker)
    c = predict_bands(other, log).coverage["u"]
    assert not c.holds
    assert c.share < 0.8
    assert "the model lacks" in c.sentence


@pytest.mark.long
def test_commands_write_bands(tmp_path, capsys):
    log, _ = pushed(7, 900)
    trial, model = write_csv(log, tmp_path / "a.csv"), tmp_path / "m.json"
    assert main(["estimate", str(trial), "--vessel", "thesis", "--out", str(model)]) == 0
    first = ["t", "u", "v", "r", "psi"]
    limits = ["u_low", "u_high", "v_low", "v_high", "r_low", "r_high"]
    for name, more in (("r.csv", []), ("s.csv", []), ("n.csv", ["--no-bands"])):
        assert main(["simulate", str(model), str(trial), "--out", str(tmp_path / name), *more]) == 0
    with open(tmp_path / "r.csv") as handle:
        rows = list(csv.DictReader(handle))
    assert list(rows[0]) == [*first, "x_n", "y_n", *limits]
    assert all(float(r["u_low"]) <= float(r["u_high"]) for r in rows)
    assert (tmp_path / "r.csv").read_bytes() == (tmp_path / "s.csv").read_bytes()
    with open(tmp_path / "n.csv") as handle:
        assert next(csv.reader(handle)) == [*first, "x_n", "y_n"]
    capsys.readouterr()
    out, page = tmp_path / "c.json", tmp_path / "c.html"
    assert main(["compare", str(model), "--log", str(trial), "--json", str(out),
                 "--report", str(page)]) == 0  # fmt: skip
    assert "samples in the 95 % band: u " in capsys.readouterr().out
    band = json.loads(out.read_text())["models"][0]["logs"][0]["band"]
    assert set(band) == set(STATES)
    assert set(band["u"]) == {"coverage", "expected", "usual", "sentence"}
    assert "Shaded: where 95\u00a0%" in page.read_text()
    assert load_model(model).noise is not None
    without = compare({"m": load_model(model)}, log, bands=False)
    assert without.to_dict()["models"][0]["logs"][0]["band"] == {}


@pytest.mark.long
@pytest.mark.parametrize(("push", "least", "most"), [(0.0, 0.95, 1.0), (1.0, 0.92, 0.98)])
def test_bands_cover_the_motion_of_another_log(push, least, most):
    """Estimated on one log, the bands hold another one's motion and measurements.

    Without process noise they are wide, because a log never tells that there is none.
    """
    motion, measured = [], []
    for k in range(20):
        log, _ = pushed(2 * k, 1500, push)
        new, x = pushed(2 * k + 1, 600, push)
        request = Request(method="oe", predictor="wind", structure="thesis")
        bands = predict_bands(estimate_requested([log], request).model(), new, seed=k)
        motion.append(((x >= bands.motion[0]) & (x <= bands.motion[1])).mean())
        measured.append(np.mean([c.share for c in bands.coverage.values()]))
    assert least < np.mean(motion) <= most
    assert np.mean(measured) == pytest.approx(0.95, abs=0.01)
