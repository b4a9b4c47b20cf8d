"""Local polynomials: exact on polynomials, their noise by Monte Carlo, their limits."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import savgol_coeffs

from greybox.errors import LogError
from greybox.trial.kinematics import velocities_from_positions
from greybox.trial.smoothing import savgol_velocities, smooth, window_samples

TS = 0.1


def path(n=400, antenna=(0.0, 0.0)):
    """Return t, antenna positions, heading and the exact u, v, r of a weaving ship."""
    t = np.arange(n) * TS
    psi, r = 0.5 * np.sin(0.2 * t), 0.1 * np.cos(0.2 * t)
    north, east = 2 * t + 0.3 * np.sin(0.3 * t), np.cos(0.25 * t)
    north_rate, east_rate = 2 + 0.09 * np.cos(0.3 * t), -0.25 * np.sin(0.25 * t)
    c, s = np.cos(psi), np.sin(psi)
    u, v = c * north_rate + s * east_rate, -s * north_rate + c * east_rate
    x, y = antenna
    return t, north + c * x - s * y, east + s * x + c * y, psi, (u, v, r)


def test_order_one_over_two_sample_times_is_the_central_difference():
    """The oracle is (3.57) itself, on a straight course where no heading is averaged."""
    _, north, east, _, _ = path()
    psi = np.full(len(north), 0.4)
    got = savgol_velocities(north, east, psi, TS, 2 * TS, 1)
    expected = velocities_from_positions(north, east, psi, TS)
    for a, b in zip(got, expected, strict=True):
        np.testing.assert_allclose(a[1:-1], b[1:-1], atol=1e-11)


def test_a_polynomial_is_returned_exactly_to_the_ends():
    t = np.arange(60) * TS
    north, east = 1 + 2 * t - 0.3 * t**2, -2 * t + 0.1 * t**2
    u, v, r = savgol_velocities(north, east, np.zeros(60), TS, 1.0, 2)
    np.testing.assert_allclose(u, 2 - 0.6 * t, atol=1e-9)
    np.testing.assert_allclose(v, -2 + 0.2 * t, atol=1e-9)
    np.testing.assert_allclose(r, 0, atol=1e-9)
    np.testing.assert_allclose(smooth(north, TS, 1.0, 2), north, atol=1e-9)


def test_velocities_of_the_body_origin():
    antenna = (1.2, -0.4)
    _, north, east, psi, truth = path(antenna=antenna)
    got = savgol_velocities(north, east, psi, TS, 1.0, 2, antenna=antenna)
    for a, b in zip(got, truth, strict=True):
        np.testing.assert_allclose(a, b, atol=3e-3)
    off = savgol_velocities(north, east, psi, TS, 1.0, 2)
    assert np.abs(off[1] - truth[1]).max() > 0.1


def test_a_heading_that_wraps_changes_nothing():
    _, north, east, psi, _ = path()
    psi = psi + np.pi
    wrapped = (psi + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(np.diff(wrapped)).max() > 6
    np.testing.assert_allclose(
        savgol_velocities(north, east, wrapped, TS, 1.0),
        savgol_velocities(north, east, psi, TS, 1.0),
        atol=1e-10,
    )


def test_remaining_heading_noise_is_divided_out():
    """(3.64) with the noise that the fitted heading keeps, at the ends too."""
    rng = np.random.default_rng(3)
    n, std, runs = 13, 0.5, 800
    north = 2.0 * TS * np.arange(n)
    u = np.array(
        [
            savgol_velocities(
                north, 0 * north, std * rng.standard_normal(n), TS, 0.6, 2, heading_std=std
            )[0]
            for _ in range(runs)
        ]
    )
    error = u.std(axis=0) / np.sqrt(runs)
    assert (np.abs(u.mean(axis=0) - 2) < 4 * error).all()
    # undivided, the ends would keep most of the noise and be off by more than that
    assert 2 * (1 - np.exp(-0.7 * std**2 / 2)) > 4 * error.max()


@pytest.mark.parametrize(("window_s", "order"), [(0.2, 1), (0.6, 2), (2.0, 2), (2.0, 3), (3.0, 4)])
def test_noise_of_the_derivative_by_monte_carlo(window_s, order):
    rng = np.random.default_rng(4)
    n, std = 40000, 0.02
    noise = std * rng.standard_normal(n)
    u, _, _ = savgol_velocities(noise, np.zeros(n), np.zeros(n), TS, window_s, order)
    inner = u[100:-100]
    # neighbours within a window are correlated: fewer independent samples than n
    independent = len(inner) / (window_s / TS + 1)
    weights = savgol_coeffs(window_samples(n, TS, window_s, order), order, deriv=1, delta=TS)
    expected = std * np.linalg.norm(weights)
    assert inner.std() == pytest.approx(expected, rel=4 / np.sqrt(2 * independent))


def test_smoothing_is_a_moving_average_at_order_zero():
    rng = np.random.default_rng(5)
    value = rng.standard_normal(50)
    expected = np.convolve(value, np.full(5, 0.2), mode="valid")
    np.testing.assert_allclose(smooth(value, TS, 0.4, 0)[2:-2], expected, atol=1e-12)


def test_a_window_that_binary_numbers_miss_by_a_hair():
    # 0.6 / 0.1 is 5.999…: still seven samples
    assert window_samples(None, 0.1, 0.6) == 7
    # an even number of steps is cut to an odd number of samples
    assert window_samples(None, 0.1, 0.7) == 7


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda x: savgol_velocities(x, x, x, TS, 0.2, 2),
            r"holds 3 samples of 0\.1 s, order 2 needs 4: use a window of at least 0\.4 s",
        ),
        (lambda x: smooth(x, TS, 0.4, 4), r"order 4 needs 6: use a window of at least 0\.6 s"),
        (lambda x: smooth(x, TS, 0.0, 1), r"holds 1 sample .* at least 0\.2 s"),
        (
            lambda x: savgol_velocities(x, x, x, TS, 9.0, 2),
            r"holds 91 samples, the log has 20: use a window of at most 1\.8 s",
        ),
        (lambda x: smooth(x, TS, 2.0, 2), "holds 21 samples, the log has 20"),
        (lambda x: smooth(x, TS, np.inf, 2), "a window of inf s"),
        (lambda x: smooth(x, TS, -1.0, 2), "a window of -1 s"),
        (lambda x: smooth(x, TS, 1.0, -1), "order -1: the order is a whole number of at least 0"),
        (lambda x: savgol_velocities(x, x, x, TS, 1.0, 0), "at least 1"),
        (
            lambda x: savgol_velocities(x, x[1:], x, TS, 1.0, 2),
            "have 20, 19 and 20 samples: give arrays of one length",
        ),
        (lambda x: smooth(np.where(x == 3, np.nan, x), TS, 1.0, 2), "not finite at sample 3"),
        (
            lambda x: savgol_velocities(x, x, np.where(x == 3, np.nan, x), TS, 1.0, 2),
            "psi is not finite at sample 3",
        ),
    ],
)
def test_limits(call, message):
    with pytest.raises(LogError, match=message):
        call(np.arange(20.0))
