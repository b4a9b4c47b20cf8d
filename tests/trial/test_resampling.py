"""Clocks, holes, holds and filters, against brute force and SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import firwin

from greybox.trial.convert.resample import (
    clock,
    covered,
    hold,
    hold_mean,
    interpolate,
    nice_period,
)
from greybox.trial.gaps import runs, usual_step


def test_stretches_end_at_holes():
    t = np.concatenate([np.arange(10) * 0.1, 2 + np.arange(5) * 0.1, 9 + np.arange(3) * 0.1])
    of = clock(t)
    assert of.period == pytest.approx(0.1)
    assert of.starts.tolist() == [0, 10, 15]
    assert of.stops.tolist() == [10, 15, 18]
    assert of.covered == pytest.approx(0.9 + 0.4 + 0.2)
    assert of.mean == pytest.approx(0.1)
    assert of.irregular == 0
    grid = np.arange(0, 95) * 0.1
    inside = covered(grid, of)
    wanted = [any(t[a] - 1e-9 <= g <= t[b - 1] + 1e-9
                  for a, b in zip(of.starts, of.stops, strict=True)) for g in grid]  # fmt: skip
    assert inside.tolist() == wanted


def test_one_lost_sample_is_no_hole_and_three_are():
    t = np.delete(np.arange(100) * 0.1, [20, 50, 51, 52])
    assert len(clock(t).starts) == 2
    assert len(clock(t, max_gap=10).starts) == 1
    assert len(clock(t, max_gap=0.15).starts) == 3


@pytest.mark.parametrize("holes", [1, 3, 10])
def test_holes_do_not_change_the_usual_step(holes):
    """Also where they hold most of the time."""
    t = np.concatenate([k * 1000 + np.arange(60) * 0.1 for k in range(holes + 1)])
    assert usual_step(t) == pytest.approx(0.1)
    assert len(clock(t).starts) == holes + 1


def test_the_usual_step_of_bursts_is_that_of_the_bursts():
    t = np.sort(np.concatenate([np.arange(100), np.arange(100) + 0.02]))
    assert usual_step(t) == pytest.approx(0.98)
    assert len(clock(t).starts) == 1


def test_hold_is_the_last_value():
    rng = np.random.default_rng(0)
    t = np.sort(rng.uniform(0, 10, 30))
    value = rng.normal(size=30)
    grid = np.linspace(t[0], 11, 200)
    wanted = [value[np.flatnonzero(t <= g)[-1]] for g in grid]
    np.testing.assert_array_equal(hold(clock(t), value, grid), wanted)


def test_the_mean_of_a_held_input():
    rng = np.random.default_rng(0)
    t = np.sort(rng.uniform(0, 100, 1000))
    value = rng.normal(size=1000)
    grid = np.arange(1, 90.0)
    fine = np.arange(0, 100, 1e-3)
    held = value[np.clip(np.searchsorted(t, fine, side="right") - 1, 0, None)]
    wanted = [held[(fine >= g) & (fine < g + 1)].mean() for g in grid]
    np.testing.assert_allclose(hold_mean(clock(t), value, grid, 1.0), wanted, atol=1e-2)
    slow = clock(np.arange(0, 100, 5.0))
    step = np.arange(20.0)
    np.testing.assert_array_equal(hold_mean(slow, step, grid, 1.0), np.floor(grid / 5))


def test_slow_sensors_are_held_and_equal_ones_interpolated():
    slow = clock(np.arange(0, 50, 1.0))
    grid = np.arange(0, 490) * 0.1
    np.testing.assert_array_equal(
        interpolate(slow, slow.t * 2, grid, 0.1), 2 * np.floor(grid + 1e-9)
    )
    late = clock(np.arange(0, 500) * 0.1 + 0.03)
    np.testing.assert_allclose(interpolate(late, 3 * late.t, grid[1:], 0.1), 3 * grid[1:])


def test_fast_sensors_are_filtered_as_scipy_does():
    rng = np.random.default_rng(0)
    t = np.arange(2000) * 0.1
    value = rng.normal(size=2000)
    grid = np.arange(20, 180, 1.0)
    taps = firwin(81, 0.8 / 10)
    wanted = np.convolve(value, taps / taps.sum(), mode="same")[(grid * 10).astype(int)]
    np.testing.assert_allclose(interpolate(clock(t), value, grid, 1.0), wanted, atol=1e-12)


def test_what_the_grid_cannot_show_does_not_fold_back():
    t = np.arange(20000) * 0.05
    grid = np.arange(10, 990, 1.0)
    alias = interpolate(clock(t), np.sin(2 * np.pi * 0.9 * t), grid, 1.0)
    kept = interpolate(clock(t), np.sin(2 * np.pi * 0.1 * t), grid, 1.0)
    assert np.abs(alias).max() < 0.01
    np.testing.assert_allclose(kept, np.sin(2 * np.pi * 0.1 * grid), atol=0.01)


def test_ramps_and_constants_pass_the_filter_to_their_ends():
    t = np.arange(300) * 0.1
    grid = np.arange(0, 30, 1.0)
    np.testing.assert_allclose(interpolate(clock(t), 2 * t + 1, grid, 1.0), 2 * grid + 1)
    np.testing.assert_allclose(interpolate(clock(t), 0 * t + 7, grid, 1.0), 7)


def test_no_stretch_sees_another():
    t = np.concatenate([np.arange(300) * 0.1, 60 + np.arange(300) * 0.1])
    value = np.where(t < 50, 1.0, -1.0)
    grid = np.concatenate([np.arange(0, 30, 1.0), np.arange(60, 90, 1.0)])
    out = interpolate(clock(t), value, grid, 1.0)
    np.testing.assert_allclose(out, np.where(grid < 50, 1, -1), atol=1e-12)


def test_noise_loses_what_the_filter_takes():
    rng = np.random.default_rng(2)
    t = np.arange(200_000) * 0.1
    out = interpolate(clock(t), rng.normal(size=len(t)), np.arange(10, 19900, 1.0), 1.0)
    taps = firwin(81, 0.08)
    taps /= taps.sum()
    wanted = np.sum(taps**2)
    # neighbours hardly correlate: the spread of a variance of n values is √(2/n)
    assert abs(out.var() / wanted - 1) < 5 * np.sqrt(2 / len(out))


@pytest.mark.parametrize(
    ("measured", "wanted"),
    [(0.0998, 0.1), (0.2003, 0.2), (1.0001, 1.0), (0.04, 0.04), (0.333, 0.333), (0, 0)],
)
def test_periods_as_people_write_them(measured, wanted):
    assert nice_period(measured) == wanted


def test_runs():
    assert runs(np.array([True, True, False, True, False])) == [(0, 2), (3, 4)]
    assert runs(np.zeros(3, bool)) == []
