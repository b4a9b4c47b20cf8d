"""The likelihood of offsets on one log: quadratic, robust to coloured residuals.

The residuals are whitened by the local-level model of `motion`; what belongs to the log alone
(starts, a current, scales, the gyro's bias) is projected out, Gauss-Newton finds the offsets, and
the scores' long-run covariance (Newey and West) says what they are worth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from greybox.numerics.lagged_moments import bartlett, weighted_lags
from greybox.trial.checks.motion import GAINS, outlier_weights, solve, whiten
from greybox.trial.checks.sensor_offsets.model import BIAS, CLOCKS, SIZE, KinematicModel, Residuals
from greybox.trial.raw_log import Array

# wide enough to see a whole turn, which tells a late compass from a lever arm [s], [deg]
_SCAN = (-8.0, -6.0, -4.5, -3.0, -2.0, -1.0, 1.0, 2.0, 3.0, 4.5, 6.0, 8.0)
_TURNS = (-150, -120, -90, -60, -40, -25, -12, 12, 25, 40, 60, 90, 120, 150, 180)
_TOGETHER = (("psi",), ("u", "v"), ("r",), ("psi", "u", "v", "r"))
_ROUNDS = 15
_SCAN_STEP = 1.4
# a place found by the scan must fit this much better to be preferred, in log-likelihood
_LEAST_GAIN = 8.0
# in log-likelihood: a round that loses less has not gone wrong
_LEAST_LOSS = 1.0
# residuals may be coloured over this time [s]
_MEMORY = 8.0
# columns of what a log has of its own, see `Residuals`, and the place of the velocities' scale
_OWN, _SCALE = 6, 2


@dataclass(frozen=True)
class Evidence:
    """Quadratic log-likelihood of the offsets: −½ (θ − θ̂)ᵀ J (θ − θ̂).

    Parameters
    ----------
    at : ndarray
        (`SIZE`,) where the tie was expanded.
    information : ndarray
        J, (`SIZE`, `SIZE`); nothing where the channels cannot show an offset.
    pull : ndarray
        J θ̂, (`SIZE`,).
    """

    at: Array
    information: Array
    pull: Array


class Likelihood:
    """Whitened residuals of one log, with gains and weights as they fit at some offsets."""

    def __init__(self, tie: KinematicModel) -> None:
        self.tie = tie
        self._blocks: list[tuple[float, float, Array]] = []

    def adapt(self, residuals: Residuals) -> float:
        """Estimate gains, standard deviations and weights of innovations at these residuals.

        Returns
        -------
        float
            Minus the log-likelihood of the residuals, constants left out.
        """
        self._blocks, level = [], 0.0
        for z, _, mine in self._parts(residuals):
            own = np.concatenate([z[:, :, None], mine], axis=2)
            tried = (self._tried(own, float(gain)) for gain in GAINS)
            _, gain, weight = min(tried, key=lambda x: x[0])
            white = self._white(own, gain, 1.0, weight).reshape(-1, own.shape[2])
            rest = white[:, 0] - white[:, 1:] @ solve(white[:, 1:], white[:, 0])
            std = float(np.sqrt(np.mean(rest**2)))
            self._blocks.append((gain, max(std, 1e-150), weight))
            level += rest.size * float(np.log(max(std, 1e-150)))
        return level

    def rows(self, residuals: Residuals, *, scaled: bool = True) -> tuple[Array, Array]:
        """Return whitened residuals (N, c) and columns (N, c, …), a log's own projected out.

        Parameters
        ----------
        residuals : Residuals
        scaled : bool
            Whether the scale of the velocities is free: a negative one would hide half a turn.
        """
        n = len(self.tie.motion)
        parts = self._parts(residuals)
        y, x, own, at = [], [], [], 0
        for (z, columns, mine), (gain, std, weight) in zip(parts, self._blocks, strict=True):
            stack = np.concatenate([z[:, :, None], columns, mine], axis=2)
            white = self._white(stack, gain, std, weight)
            size, count = columns.shape[2], mine.shape[2]
            y.append(white[:, :, 0])
            x.append(white[:, :, 1 : 1 + size])
            room = np.zeros((n, z.shape[1], _OWN))
            room[:, :, at : at + count] = white[:, :, 1 + size :]
            own.append(room)
            at += count
        wide = np.concatenate(own, axis=1).reshape(-1, _OWN)
        if not scaled and self.tie.positioned:
            wide = np.delete(wide, _SCALE, axis=1)
        all_y = np.concatenate(y, axis=1)
        both = np.concatenate([all_y[:, :, None], np.concatenate(x, axis=1)], axis=2)
        flat = both.reshape(-1, both.shape[2])
        flat = flat - wide @ solve(wide, flat)
        out = flat.reshape(both.shape)
        return out[:, :, 0], out[:, :, 1:]

    def misfit(self, offsets: Array, *, scaled: bool = True) -> float:
        """Return half the sum of squared whitened residuals at some offsets."""
        y, _ = self.rows(self.tie.residuals(offsets, derivatives=False), scaled=scaled)
        return 0.5 * float(np.sum(y**2))

    def _parts(self, residuals: Residuals) -> list[tuple[Array, Array, Array]]:
        """Return residuals (N, c), derivatives (N, c, …) and a log's own, of each tie."""
        r, parts = residuals, []
        if self.tie.positioned:
            parts.append((r.position, r.position_columns, r.position_own))
        if self.tie.turned:
            parts.append((r.heading[:, None], r.heading_columns[:, None], r.heading_own[:, None]))
        return parts

    def _white(self, stack: Array, gain: float, std: float, weight: Array) -> Array:
        return whiten(stack, gain, self.tie.motion, weight / std)

    def _tried(self, own: Array, gain: float) -> tuple[float, float, Array]:
        """Return minus the log-likelihood with this gain, the gain, and weights of innovations."""
        white = whiten(own, gain, self.tie.motion)
        flat = white.reshape(-1, own.shape[2])
        rest = flat[:, 0] - flat[:, 1:] @ solve(flat[:, 1:], flat[:, 0])
        each = rest.reshape(own.shape[:2])
        weight = outlier_weights(np.abs(each).max(axis=1))
        variance = max(float(np.mean((each * weight[:, None]) ** 2)), 1e-300)
        return 0.5 * rest.size * float(np.log(variance)), gain, weight


def fit(likelihood: Likelihood, start: Array, prior: Array) -> Array:
    """Return the offsets that fit one log best near `start`, by Gauss-Newton.

    Parameters
    ----------
    likelihood : Likelihood
    start : ndarray
        (`SIZE`,)
    prior : ndarray
        (2, `SIZE`) what is expected, and the inverse variance of that: what the motion cannot
        tell stays there.
    """
    tie, offsets = likelihood.tie, start
    expected, weight = prior
    free = tie.free
    best, least = offsets, np.inf
    for _ in range(_ROUNDS):
        tie.align(offsets)
        residuals = tie.residuals(offsets)
        level = likelihood.adapt(residuals) + _unlikely(offsets, prior)
        if level > least + _LEAST_LOSS:
            # downhill for the weights of the round before only
            return best
        best, least = offsets, level
        y, x = likelihood.rows(residuals)
        flat = x.reshape(-1, SIZE)[:, free]
        normal = flat.T @ flat + np.diag(weight[free])
        pull = flat.T @ y.reshape(-1) - weight[free] * (offsets - expected)[free]
        step = np.zeros(SIZE)
        step[free] = np.clip(np.linalg.solve(normal, pull), -4.0, 4.0)
        now = 0.5 * float(np.sum(y**2)) + _unlikely(offsets, prior)
        for _ in range(4):
            tried = offsets + step
            if likelihood.misfit(tried) + _unlikely(tried, prior) < now + 1e-6:
                break
            step = 0.4 * step
        offsets = offsets + step
        if np.all(np.abs(step) < 2e-3):
            break
    return offsets


def search(tie: KinematicModel, coarse: KinematicModel, prior: Array) -> Array:
    """Return the offsets of one log, large ones too, looked for on a coarse grid of clocks.

    Parameters
    ----------
    tie, coarse : KinematicModel
        Of the log, and of means over longer blocks, on which the scan runs.
    prior : ndarray
        (2, `SIZE`), see `fit`; what is expected is where the search begins.
    """
    rough, fine = Likelihood(coarse), Likelihood(tie)
    start = prior[0]
    best = fit(rough, start, prior)
    # one instrument is wrong more often than several
    gain, alone = _best_place(rough, start)
    starts = [start, alone] if gain > _LEAST_GAIN else [start]
    for _ in range(2):
        gain, place = _best_place(rough, best)
        if gain < _LEAST_GAIN:
            break
        found = fit(rough, place, prior)
        coarse.align(best)
        rough.adapt(coarse.residuals(best, derivatives=False))
        if rough.misfit(found) > rough.misfit(best) - _LEAST_GAIN:
            break
        best = found
    # longer blocks may mislead, and steps from one start may end beside the best place
    ends = [fit(fine, s, prior) for s in (best, *starts)]
    return min(ends, key=lambda s: level(fine, s, prior))


def _best_place(likelihood: Likelihood, offsets: Array) -> tuple[float, Array]:
    """Return the place of a scan around some offsets that fits best, and what it gains."""
    tie = likelihood.tie
    tie.align(offsets)
    likelihood.adapt(tie.residuals(offsets, derivatives=False))
    # half a turn and a negative scale are the same
    tried = [
        (likelihood.misfit(p, scaled=scaled), p, scaled) for p, scaled in _places(tie, offsets)
    ]
    least, place, scaled = min(tried, key=lambda t: t[0])
    return likelihood.misfit(offsets, scaled=scaled) - least, place


def level(likelihood: Likelihood, offsets: Array, prior: Array) -> float:
    """Return minus the log-likelihood at some offsets, with what is expected of them."""
    likelihood.tie.align(offsets)
    residuals = likelihood.tie.residuals(offsets, derivatives=False)
    return likelihood.adapt(residuals) + _unlikely(offsets, prior)


def _unlikely(offsets: Array, prior: Array) -> float:
    """Return minus the log-likelihood of offsets beside what is expected of them."""
    expected, weight = prior
    return 0.5 * float(np.sum(weight * (offsets - expected) ** 2))


def _places(tie: KinematicModel, offsets: Array) -> list[tuple[Array, bool]]:
    found = []
    for names in _TOGETHER:
        rows = [CLOCKS.index(n) for n in names if CLOCKS.index(n) in tie.free]
        if rows:
            for late in _SCAN:
                place = offsets.copy()
                place[rows] = late
                found.append((place, True))
    if BIAS in tie.free:
        for turned in np.radians(_TURNS):
            place = offsets.copy()
            place[BIAS] = turned
            found.append((place, False))
    return found


def expand(tie: KinematicModel, offsets: Array) -> Evidence:
    """Return the quadratic likelihood of one log around some offsets (`SIZE`,)."""
    likelihood = Likelihood(tie)
    tie.align(offsets)
    residuals = tie.residuals(offsets)
    likelihood.adapt(residuals)
    y, x = likelihood.rows(residuals)
    free = tie.free
    x = x[:, :, free]
    flat = x.reshape(-1, len(free))
    rest = (y.reshape(-1) - flat @ solve(flat, y.reshape(-1))).reshape(y.shape)
    variance = max(float(np.mean(rest**2)), 1e-150)
    normal = flat.T @ flat / variance
    pull = flat.T @ y.reshape(-1) / variance
    scores = np.einsum("ncp,nc->np", x, rest) / variance
    information, drawn = _robust(normal, pull, scores, tie.motion.step)
    wide, long = np.zeros((SIZE, SIZE)), np.zeros(SIZE)
    wide[np.ix_(free, free)] = information
    long[free] = drawn + information @ offsets[free]
    return Evidence(offsets, wide, long)


def _robust(normal: Array, pull: Array, scores: Array, step: float) -> tuple[Array, Array]:
    """Return J = A S⁻¹ A and A S⁻¹ g of information A, gradient g, long-run covariance S."""
    n, size = scores.shape
    scale = np.sqrt(np.diag(normal))
    scale[scale == 0] = 1.0
    unit = normal / np.outer(scale, scale) + 1e-9 * np.eye(size)
    root = np.linalg.cholesky(unit)
    white = np.asarray(np.linalg.solve(root, (scores / scale).T), float)
    lags = int(min(max(_MEMORY / step, 4 * (n / 100) ** (2 / 9)), n / 5))
    meat = weighted_lags([white], bartlett(lags))
    # a covariance of few blocks is drawn to its mean, and its inverse is too large by so much
    blocks = 1.5 * n / max(lags, 1)
    drawn = size / (size + blocks)
    meat = (1 - drawn) * meat + drawn * np.trace(meat) / size * np.eye(size)
    value, vector = np.linalg.eigh(meat)
    # never better than white noise would be
    inverse = (vector / np.maximum(value, 1.0)) @ vector.T
    inverse *= max(1.0 - (size + 1) / blocks, 0.2)
    left = root @ inverse
    information = left @ root.T * np.outer(scale, scale)
    return information, scale * (left @ np.linalg.solve(root, pull / scale))


def coarse_tie(tie: KinematicModel) -> KinematicModel:
    """Return the tie of means over longer blocks, to look for large offsets."""
    coarser = tie.motion.coarser(_SCAN_STEP)
    return tie if coarser is tie.motion else KinematicModel(coarser)
