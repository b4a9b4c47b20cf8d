"""The thesis's studies at a size that fits; the full figures behind the long mark."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.study.chapter4 import reproduce_chapter4
from greybox.study.chapter6 import ESTIMATORS, pulse_commands, pulse_forces, reproduce_chapter6
from greybox.study.chapter7 import (
    estimation_sets,
    predictors,
    reproduce_chapter7,
    virtual_day,
)
from greybox.study.inputs import offset_gaussian, smoothed_pulses, zig_zag
from greybox.study.tables import published, summarise, to_csv


def chapter4_holds(rows, runs):
    for r in rows:
        # a smaller study has a wider standard error of its own
        error = r.published_sd * np.sqrt(1 / 500 + 1 / runs) * 3 + 0.015
        assert abs(r.mean - r.published_mean) < error, r
        assert abs(r.sd / r.published_sd - 1) < 0.2 + 3 / np.sqrt(2 * runs), r


def test_chapter4_in_small():
    study = reproduce_chapter4(60, seed=3, workers=1)
    assert study.unconverged == 0
    chapter4_holds(study.rows(), 60)


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, 11])
def test_chapter4(seed):
    study = reproduce_chapter4(500, seed=seed)
    for r in study.rows():
        assert abs(r.mean - r.published_mean) < 3 * r.published_sd / np.sqrt(500) + 0.015, r
        assert 0.8 < r.sd / r.published_sd < 1.2, r


def consistent(r):
    return (r.set, r.estimator) in (("1 m/s", "IV2"), ("1 m/s", "IV3"), ("10 m/s", "IV3"))


def test_chapter6_in_small():
    study = reproduce_chapter6(16, seed=5, fit_runs=0, workers=1)
    rows = study.rows()
    assert len(rows) == 2 * (2 * 15 + 2 * 15 + 2 * 18)
    assert all(r.published_mean is not None for r in rows)
    for r in rows:
        if consistent(r) and r.sd < 1:
            assert abs(r.mean) < 4 * r.sd / np.sqrt(16) + 0.05, r


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, 11])
def test_chapter6(seed):
    for r in reproduce_chapter6(500, seed=seed, fit_runs=0).rows():
        if consistent(r):
            if r.sd < 1:
                assert abs(r.mean) < min(r.sd, 4 * r.sd / np.sqrt(500) + 0.05), r
        elif abs(r.published_mean) > 3 * r.published_sd:
            assert np.sign(r.mean) == np.sign(r.published_mean), r
        if r.estimator in ("IV2", "IV3"):
            assert 0.5 < r.sd / r.published_sd < 2, r


@pytest.mark.long
def test_chapter6_gives_the_same_bytes_for_the_same_seed():
    one = reproduce_chapter6(3, seed=7, samples=600, fit_runs=0, workers=1)
    two = reproduce_chapter6(3, seed=7, samples=600, fit_runs=0, workers=2)
    assert to_csv(one.rows()) == to_csv(two.rows())


def test_the_input_belongs_to_the_study_not_to_the_seed():
    commands = pulse_commands(5000)
    assert commands["n"].min() >= 10 - 1e-9
    assert commands["n"].max() <= 20 + 1e-9
    assert commands["alpha1"].min() >= 0.7 - 1e-9
    assert commands["alpha2"].max() <= 1.1 + 1e-9
    np.testing.assert_allclose(pulse_forces(800), pulse_forces(5000)[:800], rtol=1e-12)
    assert set(ESTIMATORS.values()) == {"basic", "augmented", "wind"}


def test_chapter7_on_virtual_days():
    windy = virtual_day(1, 10.0, "windy")
    calm = virtual_day(1001, 2.0, "calm", batches=3)
    assert min(map(len, windy)) >= 358
    study = reproduce_chapter7(windy, calm)
    assert len(study.sets) == 9
    assert all(len(s) == 4 for s in study.sets)
    fits = {n: np.clip(f, -100, 100).mean() for n, f in study.fits.items()}
    # measuring the wind on the windy day pays on the calm one
    assert fits["LS3"] > fits["LS1"]
    assert fits["IV3"] > fits["IV1"] > fits["LS1"]
    tests = {(t.model, t.state): t for t in study.sign_tests()}
    assert tests["IV3", "u"].wins == 9
    assert tests["IV3", "u"].p_value == pytest.approx(2 * 0.5**9)
    assert {r.table for r in study.rows()} == {"7.1", "7.3", "7.4"}


def test_reduced_predictors_are_those_of_the_chapter(thesis):
    found = predictors(thesis, wind=True)
    assert [len(found["2"].equation(s)) for s in "uvr"] == [9, 9, 11]  # (7.1)-(7.3)
    assert [len(found["3"].equation(s)) for s in "uvr"] == [6, 6, 6]  # (7.4)-(7.6)


def test_estimation_sets_of_few_logs():
    logs = virtual_day(2, 2.0, "d", batches=3)
    assert [len(s) for s in estimation_sets(logs)] == [2, 2, 2]
    assert estimation_sets(logs[:1]) == [logs[:1]]


def test_inputs():
    rng = np.random.default_rng(0)
    x = smoothed_pulses(rng, 500, 10, 20)
    assert x.shape == (500,)
    assert x.min() >= 10
    assert x.max() <= 20
    assert np.abs(np.diff(x)).max() < 2  # smoothed
    assert offset_gaussian(rng, 1000).min() == 0.6  # (4.65)
    assert offset_gaussian(rng, 1000, None).min() < 0
    np.testing.assert_allclose(zig_zag(4, 1.0, amplitude=2, period=2, centre=1), [3, -1, 3, -1])


def test_tables():
    assert len(published("chapter4")) == 12
    mean, sd, count = summarise(np.array([1.0, 3.0, np.nan]))
    assert (mean, count) == (2.0, 2)
    assert sd == pytest.approx(np.sqrt(2))
