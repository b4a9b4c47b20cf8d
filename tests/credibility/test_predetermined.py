"""Moments of least-squares residuals where regressors hold earlier noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from greybox.credibility.predetermined import moments_mean, noise_after_error

DECAY, SAMPLES = 0.95, 300


def draw(rng, centred):
    """A state that feels input and noise: instrument and input, regressors, errors."""
    z = np.repeat(rng.standard_normal(SAMPLES // 10), 10)
    e = rng.standard_normal(SAMPLES)
    z0 = lfilter([0, 1], [1, -DECAY], z)
    phi = np.vstack([z0 + lfilter([0, 1], [1, -DECAY], e), z])
    xi = z0[None]
    if centred:
        phi, xi, e = (a - a.mean(axis=-1, keepdims=True) for a in (phi, xi, e))
    return xi, phi, e


@pytest.mark.long
@pytest.mark.parametrize(("centred", "relative"), [(False, 0.0), (True, 0.1)])
def test_the_mean_is_that_of_many_draws(centred, relative):
    rng = np.random.default_rng(3)
    after = np.column_stack([DECAY ** np.arange(120), np.zeros(120)])
    seen, known, estimated = [], [], []
    for _ in range(1500):
        xi, phi, e = draw(rng, centred)
        left = e - np.linalg.solve(phi @ phi.T, phi @ e) @ phi
        seen.append(float((xi @ left)[0]))
        known.append(moments_mean([xi], [phi], after, centred=centred)[0])
        found = noise_after_error([phi - np.vstack([xi, phi[1:]])], [left])
        estimated.append(moments_mean([xi], [phi], found, centred=centred)[0])
    se = np.std(seen) / np.sqrt(len(seen))
    # what is neglected is a term of the next order in 1/N
    assert abs(np.mean(seen) - np.mean(known)) < 4 * se + relative * np.mean(known)
    # residuals show less of the noise than errors would
    assert 0.6 * np.mean(known) < np.mean(estimated) < np.mean(known)
    assert np.std(estimated) < 0.2 * np.std(seen)


def test_regressors_without_noise_leave_nothing():
    rng = np.random.default_rng(4)
    _, phi, e = draw(rng, centred=False)
    after = noise_after_error([0 * phi], [e])
    assert after.shape == (int(2 * np.sqrt(SAMPLES)), 2)
    assert moments_mean([phi], [phi], after, centred=True) == pytest.approx(0.0)


def test_rescaled_regressors_change_nothing():
    rng = np.random.default_rng(5)
    xi, phi, e = draw(rng, centred=True)
    scale = np.array([[1e3], [1e-2]])
    noise = phi - np.vstack([xi, phi[1:]])
    one = moments_mean([xi], [phi], noise_after_error([noise], [e]), centred=True)
    two = moments_mean([xi], [scale * phi], noise_after_error([scale * noise], [e]), centred=True)
    np.testing.assert_allclose(two, one, rtol=1e-9)
