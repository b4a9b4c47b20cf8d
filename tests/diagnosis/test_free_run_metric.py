"""Errors that are weighed by their size alone, and the memory that is counted instead."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from foreign_ships import Current, presets
from foreign_ships.manoeuvres import kinds
from scipy.signal import lfilter

from greybox import load_vessel, read_log
from greybox.diagnosis.diagnose import diagnose
from greybox.diagnosis.fitting import Problem
from greybox.diagnosis.noise import free_run_noise
from greybox.numerics.lagged_moments import (
    automatic_lags,
    bartlett,
    bartlett_sums,
    correlation_factor,
    weighted_lags,
)
from greybox.numerics.linalg import tall_svd

GROUPS = ((0,), (1,), (2, 3))


def remembering(rho: float, size: int = 20_000) -> np.ndarray:
    """A first-order autoregression (N, 1)."""
    white = np.random.default_rng(3).standard_normal((size, 1))
    return lfilter([1.0], [1.0, -rho], white, axis=0)


@pytest.mark.parametrize("lags", [0, 1, 7, 199, 500])
def test_windows_give_the_bartlett_kernel(lags: int) -> None:
    rows = np.random.default_rng(0).standard_normal((200, 3))
    expected = weighted_lags([rows.T], bartlett(min(lags, 199)))
    np.testing.assert_allclose(bartlett_sums(rows, lags), expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9])
def test_memory_raises_the_variance_of_a_mean(rho: float) -> None:
    series = remembering(rho)
    # five standard errors of the lag-one correlation
    wide = 5 * np.sqrt((1 - rho**2) / len(series))
    low, high = ((1 + r) / (1 - r) for r in (max(rho - wide, 0.0), rho + wide))
    assert low <= correlation_factor(series) <= high
    # Andrews (1991), eq. 6.2 and 6.4
    expected = 1.1447 * (4 * rho**2 / (1 - rho**2) ** 2 * len(series)) ** (1 / 3)
    assert automatic_lags(series) == pytest.approx(expected, rel=0.1, abs=4)


def test_a_tall_decomposition_is_that_of_scipy() -> None:
    rows = np.random.default_rng(1).standard_normal((300, 6))
    rows[:, 5] = rows[:, 0] + rows[:, 1]
    left, values, right = tall_svd(rows, 1e-8)
    assert values == pytest.approx(np.linalg.svd(rows, compute_uv=False)[:5])
    np.testing.assert_allclose((left * values) @ right, rows, atol=1e-12)


def test_states_weigh_alike_and_a_heading_nothing() -> None:
    rng = np.random.default_rng(2)
    errors = [rng.standard_normal((n, 4)) * [3.0, 0.2, 1e-3, 5.0] for n in (400, 700)]
    noise = free_run_noise(errors, GROUPS)
    nu = np.concatenate([noise.whiten(e[:, :, None])[:, :, 0] for e in errors])
    np.testing.assert_allclose((nu**2).mean(axis=0), [1, 1, 1, 0], rtol=1e-12)
    assert not noise.coloured
    # the sensors' deviations are those of third differences: white here
    assert noise.groups[0].sensor[0] == pytest.approx(3.0, rel=0.1)
    assert noise.log_det == pytest.approx(2 * np.log((3.0, 0.2, 1e-3)).sum(), abs=0.3)


def test_no_log_speaks_for_all() -> None:
    rng = np.random.default_rng(4)
    errors = [size * rng.standard_normal((500, 4)) for size in (1.0, 20.0)]
    noise = free_run_noise(errors, GROUPS)
    nu = [noise.whiten(e[:, :, None])[:, :, 0] for e in errors]
    problem = object.__new__(Problem)
    problem.known = [np.ones(n.shape, bool) for n in nu]
    added = problem.added(nu, noise)
    worse = [1.1 * n for n in nu]
    apart = [float((b - a).sum()) for a, b in zip(added, problem.added(worse, noise), strict=True)]
    # a tenth more error costs as much in the quiet log as in the loud one
    assert apart == pytest.approx([500 * 3 * 2 * np.log(1.1)] * 2, rel=1e-9)


@pytest.mark.long
def test_a_current_is_named_in_a_ship_of_no_family(tmp_path: Path) -> None:
    preset = presets()["kvlcc2-7m"]
    (tmp_path / "vessel.toml").write_text(preset.ship.vessel_toml())
    vessel = load_vessel(tmp_path / "vessel.toml")
    current = Current(0.16, 1.8)
    logs = []
    for i, kind in enumerate(("random", "zigzag-20", "turn-port-15", "random")):
        trial = preset.sail(kinds()[kind], seed=1000 + i, current=current)
        logs.append(read_log(trial.write_csv(tmp_path / f"{i}.csv", 5), vessel))
    found = diagnose(logs[:2], validate=logs[2:])
    assert found.verdict in ("named", "partly")
    (named,) = (c for c in found.causes if c.id == "current")
    true = {"current_north": 0.16 * np.cos(1.8), "current_east": 0.16 * np.sin(1.8)}
    for name, value in true.items():
        quantity = named.parameters[name]
        assert abs(quantity.value - value) < 4 * quantity.std, name
    assert all(found.gain[s].after > found.gain[s].before for s in ("u", "v"))
    assert found.budget
