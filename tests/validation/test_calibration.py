"""Bands that held-out runs calibrate: they hold what the model lacks, and no more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from virtual import virtual_log

from greybox.model.model import load_model
from greybox.model.noise import BandCalibration
from greybox.selection.estimate import estimate_model
from greybox.validation.bands import predict_bands
from greybox.validation.calibration import (
    RunErrors,
    calibrate_bands,
    cross_calibrated,
    reach,
)
from greybox.validation.fit import run_model

STATES = ("u", "v", "r")


def runs_of(errors, half=0.0, noise=0.0):
    """Runs from their errors (N, 3)."""
    return [RunErrors(e, np.full(e.shape, half), np.full(3, noise)) for e in errors]


def share(runs, calibration):
    inside = [
        (e.error >= -low) & (e.error <= high) for e in runs for low, high in [reach(e, calibration)]
    ]
    return np.concatenate(inside).mean(axis=0)


def drawn(seed, runs=40, samples=200, size=1.0):
    return list(size * np.random.default_rng(seed).standard_normal((runs, samples, 3)))


def test_bands_hold_errors_that_draws_know_nothing_of():
    found = calibrate_bands(runs_of(drawn(1)), STATES)
    # 8000 errors: their quantiles are known to 2 %, and 40 runs widen by 1 %
    np.testing.assert_allclose(found.misfit, 1.0, rtol=0.06)
    np.testing.assert_allclose(share(runs_of(drawn(2)), found), 0.95, atol=0.01)


def test_draws_that_say_all_are_left_as_they_are_and_useless_ones_are_not_used():
    rng = np.random.default_rng(3)
    widths = np.exp(rng.standard_normal((40, 200, 3)))
    known = [RunErrors(w / 1.96 * rng.standard_normal(w.shape), w, np.zeros(3)) for w in widths]
    found = calibrate_bands(known, STATES)
    np.testing.assert_allclose(found.factor, 1.0, atol=0.05)
    assert (found.misfit < 0.3).all()
    useless = [replace(r, error=e) for r, e in zip(known, drawn(4), strict=True)]
    assert (calibrate_bands(useless, STATES).factor < 0.6).all()


def test_the_noise_of_the_sensors_is_no_misfit():
    noisy = runs_of(drawn(5, size=0.5), noise=0.5)
    found = calibrate_bands(noisy, STATES)
    assert (found.misfit < 0.15).all()
    np.testing.assert_allclose(share(noisy, found), 0.955, atol=0.01)


def test_what_is_off_to_one_side_widens_that_side():
    found = calibrate_bands(runs_of([e + 5.0 for e in drawn(6)]), STATES)
    assert (found.misfit[0] < 0.1).all()
    np.testing.assert_allclose(found.misfit[1], 7.0 / 1.96, rtol=0.05)


def test_few_runs_make_wide_bands_and_units_change_nothing():
    few, many = (calibrate_bands(runs_of(drawn(7, n, 2000)), STATES) for n in (2, 40))
    # Student's quantile of four degrees of freedom over the normal one
    np.testing.assert_allclose(few.misfit, 2.776 / 1.96, rtol=0.05)
    assert (few.misfit > many.misfit).all()
    scaled = calibrate_bands(runs_of(drawn(7, 2, 2000, 1e-3)), STATES)
    np.testing.assert_allclose(scaled.misfit, 1e-3 * few.misfit)


def test_a_run_has_no_say_in_its_own_band():
    errors = drawn(8, 3)
    errors[0] = errors[0] * 100
    wide = [w.max() > 100 for w in cross_calibrated(runs_of(errors), STATES)]
    assert wide == [False, True, True]
    assert cross_calibrated(runs_of(errors[:1]), STATES) == []
    assert calibrate_bands([], STATES) is None


def test_a_calibrated_model_keeps_its_bands_in_its_file(tmp_path):
    log = virtual_log(9, 300, wind=0.0, spread=1e-12, current=(0.0, 0.0))
    estimate = estimate_model(log, method="ls", structure="thesis", predictor="basic", judged=False)
    misfit = np.array([[0.1, 0.2, 0.003], [0.3, 0.2, 0.003]])
    model = replace(
        estimate.model(), calibration=BandCalibration(STATES, np.zeros(3), misfit, 4, ("turn",))
    )
    model.save(tmp_path / "m.json")
    again = load_model(tmp_path / "m.json")
    assert again == model
    bands = predict_bands(again, log, runs=8)
    x = run_model(model, log).x
    np.testing.assert_allclose(bands.motion[0], x - 1.96 * misfit[0], atol=1e-4)
    np.testing.assert_allclose(bands.motion[1], x + 1.96 * misfit[1], atol=1e-4)
    # least squares finds no noise levels; its held-out runs are enough
    assert set(bands.coverage) == set(STATES)
    assert bands.notes == ()


def test_an_estimate_is_calibrated_by_its_held_out_runs():
    logs = [virtual_log(70 + k, 200, wind=0.0, spread=1e-12) for k in range(3)]
    estimate = estimate_model(logs, method="ls", structure="linear", predictor="basic")
    assert estimate.calibration.runs == 3
    assert estimate.model().calibration is estimate.calibration
    assert set(estimate.prediction.coverage) == set(STATES)
    other = virtual_log(75, 200, wind=0.0, spread=1e-12)
    validated = estimate_model(
        logs, method="ls", structure="linear", predictor="basic", validate=other
    )
    assert validated.prediction.logs == (other.name,)
    np.testing.assert_allclose(validated.calibration.misfit, estimate.calibration.misfit)
    assert min(validated.prediction.coverage.values()) > 0.8


@pytest.mark.parametrize("known", [True, False])
def test_what_was_not_measured_has_no_say(known):
    errors = drawn(10, 4)
    if not known:
        for e in errors:
            e[::2, 1] = np.nan
    found = calibrate_bands(runs_of(errors), STATES)
    assert np.isfinite(found.misfit).all()
    np.testing.assert_allclose(found.misfit[:, 1], 1.1, rtol=0.15)
