"""The step that a quadratic model asks for within bounds."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.numerics.linalg import bounded_step


@pytest.mark.parametrize("seed", range(8))
def test_it_is_the_best_within_its_bounds(seed: int) -> None:
    rng = np.random.default_rng(seed)
    # alike columns: where one stops, others go back
    rows = rng.standard_normal((30, 6)) @ (np.eye(6) + 3 * rng.standard_normal((6, 1)))
    target = rows @ rng.standard_normal(6) + rng.standard_normal(30)
    low, high = np.full(6, -0.05), np.full(6, 0.1)
    low[2] = high[2] = 0.02
    found = bounded_step(rows.T @ rows, rows.T @ target, low, high)
    assert (found >= low).all()
    assert (found <= high).all()
    # Karush, Kuhn and Tucker: no number gains by a move that its bounds allow
    slope = rows.T @ (target - rows @ found)
    size = np.linalg.norm(rows, axis=0) * np.linalg.norm(target)
    assert (np.where(found < high - 1e-12, slope, 0.0) < 1e-8 * size).all()
    assert (np.where(found > low + 1e-12, slope, 0.0) > -1e-8 * size).all()


def test_a_direction_that_nothing_determines_stays() -> None:
    normal = np.array([[1.0, 1.0], [1.0, 1.0]])
    found = bounded_step(normal, np.array([1.0, 1.0]), np.full(2, -2.0), np.full(2, 2.0))
    assert found == pytest.approx([0.5, 0.5])
    none = bounded_step(np.zeros((2, 2)), np.ones(2), np.full(2, -1.0), np.ones(2))
    assert (none == 0.0).all()


@pytest.mark.parametrize("size", [np.nan, np.inf, 1e200])
def test_where_squares_overflow_there_is_none(size: float) -> None:
    low, high = np.array([-1.0, 0.5]), np.array([1.0, 2.0])
    for normal, gradient in (
        (np.diag([1.0, size]), np.ones(2)),
        (np.eye(2), np.array([1.0, size])),
    ):
        step = bounded_step(normal, gradient, low, high)
        assert ((low <= step) & (step <= high)).all()
