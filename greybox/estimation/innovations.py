"""Innovations of a filter: maximum likelihood with process noise, and runs at a fixed gain.

Parameters and initial states move by Gauss-Newton steps on the innovations of an extended
Kalman filter, with the exact gradient of the likelihood; the variances of the measurements and
of the process noise maximise the same likelihood in between. Runs that an observer of one gain
corrects towards the log are nearly linear in the parameters.

References
----------
Åström (1980), Maximum likelihood and prediction error methods, eq. 4.6; Ljung
(1999), section 7.4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from greybox.estimation.shooting import (
    Linearised,
    Measured,
    Restrictions,
    Segments,
    ShootingFit,
    by_sample,
    cut,
    fit_segments,
)
from greybox.model.output import OutputModel
from greybox.model.run.output_runs import Filter, Observer
from greybox.numerics.linalg import bounded_step

Array = NDArray[np.float64]

_ROUNDS = 12
_NOISE_STEPS = 4
# largest change of a logarithm in a step
_LARGEST = 3.0
# change of every noise deviation, and of the cost, below which the alternation ends
_SETTLED, _COST = 0.02, 1e-3
# variances between these shares of a step's mean square
_LOW, _HIGH = 1e-8, 10.0


class FilterRuns:
    """Innovations of logs side by side at given noise variances.

    Parameters
    ----------
    model : OutputModel
    segments : Segments
        One per log, none joined.
    noise : ndarray
        (ny + nz,) variances of the measurements and of what is added a step.
    kalman : Filter, optional
        Of the same logs.
    """

    def __init__(
        self, model: OutputModel, segments: Segments, noise: Array, kalman: Filter | None = None
    ) -> None:
        self.model = model
        self.segments = segments
        self.noise = noise
        logs = segments.w, segments.y, segments.use
        self._filter = Filter(model, *logs) if kalman is None else kalman

    def linearise(self, p: Array, nodes: Array) -> Linearised:
        """Return innovations, their derivatives at fixed gains, and the exact gradient."""
        found = self.rows(p, nodes)
        _, by_start, by_p = self._filter.likelihood(nodes, p, self.noise)
        downhill = np.zeros((len(nodes), found.rows.shape[2]))
        # the parameters are common to all logs: their gradient is counted once
        downhill[0, : len(p)] = -by_p
        downhill[:, len(p) :] = -by_start
        return replace(found, downhill=downhill)

    def rows(self, p: Array, nodes: Array) -> Linearised:
        """Return innovations and their derivatives at fixed gains alone."""
        r, rows, levels = self._filter(nodes, p, self.noise)
        none = np.zeros((*nodes.shape, rows.shape[3]))
        level = float(levels.sum()) / 2
        return Linearised(r, by_sample(rows), np.zeros_like(nodes), none, level)

    def value(self, p: Array, nodes: Array) -> tuple[Array, Array, float]:
        """Return the innovations and half the sum of the logarithms of their variances."""
        r, levels = self.filtered(p, nodes, self.noise)
        return r, np.zeros_like(nodes), float(levels.sum()) / 2

    def filtered(self, p: Array, nodes: Array, noise: Array) -> tuple[Array, Array]:
        """Return innovations of unit variance and the logarithms of their variances."""
        r, _, levels = self._filter(nodes, p, noise, sensitivities=False)
        return r, levels

    def by_noise(self, p: Array, nodes: Array, noise: Array) -> tuple[Array, Array]:
        """Return the derivatives of what is `filtered` in the logarithms of the variances."""
        by_r, by_level = self._filter.by_noise(nodes, p, noise)
        return by_r * noise, by_level * noise

    def with_noise(self, noise: Array) -> FilterRuns:
        """Return the same logs with other variances."""
        return FilterRuns(self.model, self.segments, noise, self._filter)


def fit_noise(runs: FilterRuns, p: Array, nodes: Array) -> Array:
    """Maximise the likelihood over the variances, by scoring.

    Parameters
    ----------
    runs : FilterRuns
        Whose ``noise`` is the start.
    p, nodes : ndarray
        (q,) and (M, nz), held.

    Returns
    -------
    ndarray
        (ny + nz,)
    """
    scale = _scale(runs.segments, nodes.shape[1])
    low, high = np.log(_LOW * scale), np.log(_HIGH * scale)

    def at(logs: Array) -> tuple[float, Array]:
        r, levels = runs.filtered(p, nodes, np.exp(logs))
        value = (float((r**2).sum()) + float(levels.sum())) / 2
        return (value if np.isfinite(value) else np.inf), r.ravel()

    logs = np.clip(np.log(runs.noise), low, high)
    value, r = at(logs)
    for _ in range(_NOISE_STEPS):
        by_r, by_level = (x.reshape(-1, len(logs)) for x in runs.by_noise(p, nodes, np.exp(logs)))
        # of the innovation itself, its deviation held
        by_r += r[:, None] * by_level / 2
        # scoring: the expected second derivatives of the Gaussian likelihood
        information = by_level.T @ by_level / 2 + by_r.T @ by_r
        downhill = -((1 - r**2) @ by_level / 2 + r @ by_r)
        step = bounded_step(
            information,
            downhill,
            np.maximum(low - logs, -_LARGEST),
            np.minimum(high - logs, _LARGEST),
        )
        for share in (1.0, 0.3, 0.1):
            found = at(logs + share * step)
            if found[0] < value:
                break
        else:
            break
        gained = value - found[0]
        logs = logs + share * step
        value, r = found
        if gained < _COST:
            break
    return np.asarray(np.exp(logs))


def _scale(segments: Segments, nz: int) -> Array:
    """Return the mean square of a step of each output, for outputs and for states."""
    steps = np.diff(segments.y, axis=1)
    both = segments.use[:, 1:, None]
    size = (steps**2 * both).sum(axis=(0, 1)) / max(float(both.sum()), 1.0)
    level = (segments.y**2).mean(axis=(0, 1))
    size = np.maximum(size, np.maximum(1e-12 * level, 1e-300))
    return np.concatenate([size, size[:nz]])


def first_noise(logs: Sequence[Measured], nz: int) -> Array:
    """Return variances to start from: a step's mean square, half and a tenth of it."""
    scale = _scale(cut(logs, max(len(log.y) for log in logs)), nz)
    share = np.full(len(scale), 0.5)
    share[len(scale) - nz :] = 0.1
    return np.asarray(share * scale)


def fit_innovations(
    model: OutputModel,
    logs: Sequence[Measured],
    p: Array,
    *,
    restrictions: Restrictions,
) -> tuple[ShootingFit, FilterRuns]:
    """Maximise the likelihood of the innovations over parameters, starts and variances.

    Parameters
    ----------
    model : OutputModel
    logs : sequence of Measured
    p : ndarray
        (q,) start.
    restrictions : Restrictions

    Returns
    -------
    tuple of (ShootingFit, FilterRuns)
    """
    nz = len(model.states)
    whole = cut(logs, max(len(log.y) for log in logs))
    runs = FilterRuns(model, whole, first_noise(logs, nz))
    count = min(5, whole.y.shape[1])
    nodes = np.asarray(whole.y[:, :count, :nz].mean(axis=1))
    fit = ShootingFit(p, nodes, np.zeros((len(p), len(p))), np.inf, 0.0, 0, False)
    total, before = 0, np.inf
    for _ in range(_ROUNDS):
        fit = fit_segments(runs, fit.p, fit.nodes, restrictions, most=3)
        total += fit.iterations
        again = fit_noise(runs, fit.p, fit.nodes)
        moved = np.abs(np.log(again / runs.noise)) * _weight(again, runs.noise)
        runs = runs.with_noise(again)
        if (fit.converged and (moved < _SETTLED).all()) or abs(before - fit.cost) < _COST:
            break
        before = fit.cost
    fit = fit_segments(runs, fit.p, fit.nodes, restrictions, most=8, tolerance=1e-3)
    return replace(fit, iterations=total + fit.iterations), runs


def _weight(noise: Array, before: Array) -> Array:
    """Return how much each variance counts: one that is nearly nothing may move."""
    return np.asarray(np.maximum(noise, before) > 1e-4 * np.maximum(noise, before).max(), float)


class ObservedRuns:
    """Errors of runs whose measured states are corrected at every step.

    Parameters
    ----------
    model : OutputModel
    segments : Segments
        One per log, none joined.
    variance : ndarray
        (ny,) of the measurements.
    ratio : float
        Variance of what moves a state each step over that of its measurement. The gain
        is that of the steady Kalman filter of a random walk so moved; the errors are in
        the deviations that it expects.
    """

    def __init__(
        self, model: OutputModel, segments: Segments, variance: Array, ratio: float
    ) -> None:
        self.segments = segments
        before = (ratio + np.sqrt(ratio**2 + 4 * ratio)) / 2
        self.gain = before / (1 + before)
        self.sigma = np.sqrt(variance * (1 + before))
        self._observer = Observer(model, segments.w, segments.y, segments.use)

    def linearise(self, p: Array, nodes: Array) -> Linearised:
        """Return errors and their derivatives at parameters (q,) and starts (M, nz)."""
        error, rows = self._observer(nodes, p, self.gain)
        none = np.zeros((*nodes.shape, rows.shape[3]))
        with np.errstate(over="ignore", invalid="ignore"):
            weighted = by_sample(rows / self.sigma[:, None])
            return Linearised(error / self.sigma, weighted, np.zeros_like(nodes), none)

    def by_parameters(self, p: Array, nodes: Array, only: Sequence[int]) -> Array:
        """Return derivatives of what is expected in some parameters, (M, m, ny, len(only))."""
        return self._observer.by_parameters(nodes, p, self.gain, only)

    def value(self, p: Array, nodes: Array) -> tuple[Array, Array, float]:
        """Return errors, without ends and level."""
        error, _ = self._observer(nodes, p, self.gain, sensitivities=False)
        with np.errstate(over="ignore", invalid="ignore"):
            return error / self.sigma, np.zeros_like(nodes), 0.0
