"""Linear recursions over samples against a loop."""

import numpy as np
import pytest
from scipy.signal import lfilter

from greybox.numerics import recursion
from greybox.numerics.recursion import filtered, propagate


@pytest.fixture(params=["machine code", "no compiler"], autouse=True)
def way(request, monkeypatch):
    """Each way to compute the same."""
    if request.param == "no compiler":
        monkeypatch.setattr(recursion, "_compiled", lambda name: None)


def looped(a, b, start):
    out = [start]
    for k in range(len(a)):
        out.append(a[k] @ out[-1] + b[k])
    return np.array(out)


@pytest.mark.parametrize("steps", [1, 2, 40, 121])
@pytest.mark.parametrize("columns", [0, 1, 5, 23])
@pytest.mark.parametrize("runs", [1, 3, 70])
def test_equals_a_loop(steps, columns, runs):
    rng = np.random.default_rng(1)
    a = 0.5 * rng.standard_normal((runs, steps, 3, 3))
    b, start = (
        rng.standard_normal((runs, steps, 3, columns)),
        rng.standard_normal((runs, 3, columns)),
    )
    expected = np.array([looped(*each) for each in zip(a, b, start, strict=True)])
    found = propagate(a, b, start)
    assert found.shape == (runs, steps + 1, 3, columns)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(
        propagate(a[0], b[0], start[0]), propagate(a[:1], b[:1], start[:1])[0]
    )


def test_of_no_steps_is_the_start():
    start = np.ones((2, 3))
    np.testing.assert_array_equal(
        propagate(np.zeros((0, 2, 2)), np.zeros((0, 2, 3)), start), start[None]
    )


@pytest.mark.parametrize("columns", [2, 20])
def test_an_unstable_one_is_as_exact_as_its_loop(columns):
    """It grows by 1e60 over the run; what a stretch begins with is not lost beside that."""
    rng = np.random.default_rng(2)
    a = np.tile(np.array([[1.02, 0.3], [0.0, 0.4]]), (7000, 1, 1))
    b = rng.standard_normal((7000, 2, columns))
    expected = looped(a, b, np.ones((2, columns)))
    np.testing.assert_allclose(propagate(a, b, np.ones((2, columns))), expected, rtol=1e-9)


@pytest.mark.parametrize("columns", [2, 20])
def test_beyond_the_numbers_it_is_infinite(columns):
    found = propagate(
        np.full((3000, 1, 1), 2.0), np.ones((3000, 1, columns)), np.ones((1, columns))
    )
    assert np.isfinite(found[:1000]).all()
    assert np.isposinf(found[1100:]).all()
    assert not np.isnan(found).any()


@pytest.mark.parametrize("channels", [1, 2])
@pytest.mark.parametrize("samples", [20, 64, 333])
def test_a_filter_by_blocks_equals_sample_by_sample(channels, samples):
    rng = np.random.default_rng(3)
    denominator = np.poly([0.995, 0.98, 0.3])
    numerators = rng.standard_normal((channels, channels, 4))
    numerators[0, -1] = 0.0 if channels == 2 else numerators[0, -1]
    given = rng.standard_normal((channels, 7, samples))
    expected = [
        sum(lfilter(b, denominator, e) for b, e in zip(row, given, strict=True))
        for row in numerators
    ]
    found = filtered(numerators, denominator, list(given))
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def test_a_filter_keeps_what_was_before_a_number_out_of_range():
    given = np.ones((5, 100))
    given[:, 90] = np.inf
    (found,) = filtered(np.array([[[1.0, 0.5]]]), np.array([1.0, -0.9]), [given])
    np.testing.assert_allclose(found[:, :90], lfilter([1.0, 0.5], [1.0, -0.9], given[:, :90]))
