"""Estimates of clocks, lever arm and heading bias: Gauss-Newton on whitened residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.trial.checks.motion import GAINS, profile, solve, whiten
from greybox.trial.checks.sensor_offsets.model import Candidate, State, Tie, size

Array = NDArray[np.float64]

# wide enough to see a whole turn, which tells a late compass from a lever arm
_SCAN = (-8.0, -6.0, -4.5, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 4.5, 6.0, 8.0)
_ROUNDS = 12


@dataclass(frozen=True)
class Gain:
    """Gains and innovations of both residuals at some parameters."""

    position: tuple[float, float]
    heading: tuple[float, float]
    loglik: float


def estimate_gain(tie: Tie, state: State, near: Gain | None = None) -> Gain:
    """Estimate the gains; around known ones where they are known."""
    pos, head = tie.nuisance(state)
    around = np.array([0.4, 0.7, 1.0, 1.5])
    total = 0.0
    p = h = (1.0, 1.0)
    values = tie.motion.values
    if tie.positioned:
        gains = GAINS if near is None else np.minimum(around * near.position[0], 1.0)
        z = tie.position(state, values)
        found = profile(z, pos, tie.motion, gains, tie.weigh("position"))
        total += found.loglik
        p = (found.gain, found.std)
    if tie.turned:
        gains = GAINS if near is None else np.minimum(around * near.heading[0], 1.0)
        z = tie.heading(state, values)
        found = profile(z, head, tie.motion, gains, tie.weigh("heading"))
        total += found.loglik
        h = (found.gain, found.std)
    return Gain(p, h, total)


def _stack(tie: Tie, gain: Gain, pos: Array, head: Array) -> Array:
    """Whiten both blocks and stack them to rows, (3 N or less, q)."""
    rows = []
    if tie.positioned:
        k, std = gain.position
        white = whiten(pos, k, tie.motion) / std
        white = white * tie.weigh("position")(k).reshape(-1, *[1] * (white.ndim - 1))
        rows.append(white.reshape(-1, *white.shape[2:]))
    if tie.turned:
        k, std = gain.heading
        white = whiten(head, k, tie.motion) / std
        rows.append(white * tie.weigh("heading")(k).reshape(-1, *[1] * (white.ndim - 1)))
    return np.concatenate(rows)


def _residual(tie: Tie, state: State, gain: Gain) -> Array:
    values = tie.motion.values
    n = len(tie.motion)
    pos = tie.position(state, values) if tie.positioned else np.zeros((n, 2))
    head = tie.heading(state, values) if tie.turned else np.zeros(n)
    return _stack(tie, gain, pos, head)


def _columns(tie: Tie, state: State, gain: Gain) -> Array:
    pos, head = tie.nuisance(state)
    n, q = len(tie.motion), pos.shape[2] + head.shape[1]
    wide_pos, wide_head = np.zeros((n, 2, q)), np.zeros((n, q))
    wide_pos[:, :, : pos.shape[2]] = pos
    wide_head[:, pos.shape[2] :] = head
    return _stack(tie, gain, wide_pos, wide_head)


@dataclass(frozen=True)
class Fit:
    """Estimate of the parameters of some candidates together.

    Parameters
    ----------
    state : State
    candidates : tuple of Candidate
    covariance : ndarray
        (k, k) of the candidates' parameters in order, robust to coloured residuals.
    loglik : float
    """

    state: State
    candidates: tuple[Candidate, ...]
    covariance: Array
    loglik: float
    value: Array


def fit(tie: Tie, candidates: tuple[Candidate, ...], start: State, rounds: int = _ROUNDS) -> Fit:
    """Estimate the parameters of some candidates together, by Gauss-Newton.

    Parameters
    ----------
    tie : Tie
    candidates : tuple of Candidate
    start : State
    rounds : int
        Steps at most.

    Returns
    -------
    Fit
    """
    state = start
    sizes = [size(c) for c in candidates]
    edges = np.concatenate([[0], np.cumsum(sizes)]).astype(int)
    total = np.zeros(int(edges[-1]))
    gain = estimate_gain(tie, state)
    x = rest = np.zeros((0, 0))
    for _ in range(rounds):
        blocks = [_stack(tie, gain, *tie.derivative(c, state)) for c in candidates]
        nuisance = _columns(tie, state, gain)
        x = np.hstack([*blocks, nuisance])
        y = _residual(tie, state, gain)
        step = solve(x, y)
        rest = y - x @ step
        step = np.clip(step[: edges[-1]], -4.0, 4.0)
        for c, a, b in zip(candidates, edges[:-1], edges[1:], strict=True):
            state = state.moved(c, step[a:b])
        total += step
        gain = estimate_gain(tie, state, gain)
        if np.all(np.abs(step) < 2e-3):
            break
    covariance = _robust(x, rest, int(edges[-1]), tie)
    return Fit(state, candidates, covariance, gain.loglik, total)


def _robust(x: Array, rest: Array, wanted: int, tie: Tie) -> Array:
    """Return the covariance (wanted, wanted) by Newey and West, components side by side."""
    scale = np.sqrt(np.einsum("ij,ij->j", x, x))
    scale[scale == 0] = 1.0
    xs = x / scale
    bread = np.linalg.pinv(xs.T @ xs, rcond=1e-11)
    scores = xs * rest[:, None]
    n = len(tie.motion)
    lags = int(min(max(8.0 / tie.motion.step, 4 * (n / 100) ** (2 / 9)), n / 5))
    meat = np.zeros_like(bread)
    at = 0
    blocks = ([(2, n)] if tie.positioned else []) + ([(1, n)] if tie.turned else [])
    for width, count in blocks:
        part = scores[at : at + width * count].reshape(count, width, -1).sum(axis=1)
        at += width * count
        meat += part.T @ part
        for lag in range(1, lags + 1):
            cross = part[lag:].T @ part[:-lag]
            meat += (1 - lag / (lags + 1)) * (cross + cross.T)
    full = bread @ meat @ bread
    plain = bread * float(np.mean(rest**2))
    # the robust one has few degrees of freedom: never below what white noise would give
    have, least = np.maximum(np.diag(full), 0.0), np.maximum(np.diag(plain), 1e-300)
    factor = np.sqrt(np.maximum(have, least) / np.maximum(have, 1e-6 * least))
    full = full * np.outer(factor, factor)
    full[np.diag_indices_from(full)] = np.maximum(have, least)
    out = full[:wanted, :wanted] / np.outer(scale[:wanted], scale[:wanted])
    return np.asarray(out)


def scan(tie: Tie, candidate: Candidate, state: State) -> State:
    """Return a start near the best of a coarse scan, so that large offsets are found."""
    if candidate.id == "lever_arm":
        return state
    gain = estimate_gain(tie, state)
    steps = (
        np.array(_SCAN)
        if candidate.id == "clock_offset"
        else np.radians([-150, -120, -90, -60, -40, -25, -12, 0, 12, 25, 40, 60, 90, 120, 150, 180])
    )
    nuisance = _columns(tie, state, gain)
    if candidate.id == "heading_bias":
        # a free scale may be negative, and then half a turn changes nothing
        nuisance = np.delete(nuisance, tie.columns - 1, axis=1)
    scores = []
    for step in steps:
        y = _residual(tie, state.moved(candidate, np.array([step])), gain)
        rest = y - nuisance @ solve(nuisance, y)
        scores.append(float(rest @ rest))
    return state.moved(candidate, np.array([steps[int(np.argmin(scores))]]))
