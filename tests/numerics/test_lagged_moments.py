"""Sums with memory, and inverses of scaled and banded matrices, against what defines them."""

import numpy as np
import pytest

from greybox.numerics.banded import factor_band, inverse_band
from greybox.numerics.lagged_moments import convolve, lagged_products, lagged_sums
from greybox.numerics.linalg import (
    known_and_unknown_inverse,
    scaled_inverse,
    scaled_logdet,
    scaled_root,
)


def test_lagged_sums_are_the_diagonal_of_lagged_products():
    rng = np.random.default_rng(0)
    a = [rng.standard_normal((3, n)) for n in (40, 7, 0)]
    b = [rng.standard_normal((3, n)) for n in (40, 7, 0)]
    expected = np.array([np.diag(lagged_products(a, b, lag)) for lag in range(12)]).T
    np.testing.assert_allclose(lagged_sums(a, b, 11), expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(lagged_sums([np.zeros((2, 0))], [np.zeros((2, 0))], 18), 0.0)
    slow = sum(np.outer(x[:, k], y[:, k + 2]) for x, y in zip(a, b, strict=True)
               for k in range(x.shape[1] - 2))  # fmt: skip
    np.testing.assert_allclose(lagged_products(a, b, -2), slow, rtol=1e-12)


@pytest.mark.parametrize("memory", [1, 5, 30])
def test_convolution_equals_that_of_numpy(memory):
    rng = np.random.default_rng(1)
    rows, weights = rng.standard_normal((2, 20)), rng.standard_normal((2, memory))
    expected = [np.convolve(r, w)[:20] for r, w in zip(rows, weights, strict=True)]
    np.testing.assert_allclose(convolve(rows, weights), expected, rtol=1e-12, atol=1e-12)


def test_units_do_not_change_inverses_roots_and_determinants():
    rng = np.random.default_rng(2)
    root = rng.standard_normal((3, 4, 6))
    units = np.diag([1.0, 1e-7, 1e6, 1e-3])
    plain = root @ root.transpose(0, 2, 1)
    stack = units @ plain @ units
    found = scaled_inverse(stack)
    np.testing.assert_allclose(units @ found @ units, np.linalg.inv(plain), rtol=1e-9)
    np.testing.assert_array_equal(scaled_inverse(stack[1]), found[1])
    expected = np.linalg.slogdet(plain)[1] + 2 * np.log(1e-4)
    np.testing.assert_allclose(scaled_logdet(stack), expected, rtol=1e-12)
    assert scaled_logdet(np.array([[1.0, 2.0], [2.0, 1.0]])) == np.inf
    half = np.linalg.inv(units) @ scaled_root(stack[0])
    np.testing.assert_allclose(half @ half.T, plain[0], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("size", "rows"), [(1, 9), (3, 60), (6, 62)])
def test_the_band_of_an_inverse_equals_the_dense_inverse(size, rows):
    rng = np.random.default_rng(3)
    block = np.arange(rows) // size
    tied = np.abs(block[:, None] - block) <= 1
    dense = np.where(tied, rng.standard_normal((rows, rows)), 0.0)
    dense = dense + dense.T + 12 * size * np.eye(rows)
    width = 2 * size
    band = np.array([np.append(np.diag(dense, -d), np.zeros(d)) for d in range(width)])
    inverse = np.linalg.inv(dense)
    found = inverse_band(band, size)
    for d in range(width):
        inside = tied[np.arange(rows - d) + d, np.arange(rows - d)]
        np.testing.assert_allclose(
            found[d, : rows - d][inside], np.diag(inverse, -d)[inside], rtol=1e-9, atol=1e-15
        )
    assert factor_band(-band) is None


def test_what_nothing_determines_has_a_spread_beyond_every_other():
    rows = np.random.default_rng(4).standard_normal((20, 3)) * [1.0, 1e3, 1e-3]
    rows[:, 2] = 1e-6 * rows[:, 1]
    known, unknown = known_and_unknown_inverse(rows.T @ rows, 1e-9)
    assert known[0, 0] == pytest.approx(np.linalg.inv(rows[:, :2].T @ rows[:, :2])[0, 0], rel=1e-6)
    assert unknown[1, 1] > 1e6 * known[1, 1] > 0
    whole, none = known_and_unknown_inverse(rows[:, :2].T @ rows[:, :2], 1e-9)
    np.testing.assert_allclose(whole, np.linalg.inv(rows[:, :2].T @ rows[:, :2]), rtol=1e-9)
    assert (none == 0).all()
