"""Offsets of the logs of one ship together: random effects, and campaigns where logs differ.

The quadratic likelihoods of the logs are added. Where logs scatter by more than their errors allow
(Cochran's Q), the variance between them is estimated (DerSimonian and Laird) and widens the
intervals; where they fall into groups that lie apart, each group has a value of its own, and all
other offsets stay common.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.numerics.robust import variance_between
from greybox.trial.checks.sensor_offsets.evidence import Evidence
from greybox.trial.checks.sensor_offsets.model import ARM, BIAS, CAMPAIGN, CLOCKS, SIGMAS, SIZE
from greybox.trial.raw_log import Array, Mask

# instruments that change between campaigns as one: the positions against all, heading, velocities,
# yaw rate, antenna, compass
_DIRECTIONS = np.zeros((7, SIZE))
_DIRECTIONS[0, : len(CLOCKS)] = 1.0
for _k, _names in enumerate((("psi",), ("u", "v"), ("r",)), start=1):
    for _n in _names:
        _DIRECTIONS[_k, CLOCKS.index(_n)] = 1.0
_DIRECTIONS[4, ARM.start] = _DIRECTIONS[5, ARM.start + 1] = _DIRECTIONS[6, BIAS] = 1.0

_MOST_SPLITS = 3
# standard errors of a log that a difference between campaigns is worth, if the log is to show it
_SEEN = 2.0
# in log-likelihood: a log that prefers the smaller campaign by this belongs to it
_BELONGS = 1.0
_ROUNDS = 4
# by which campaigns must explain the logs better than scatter without a pattern does, in
# log-likelihood, besides the number of places where a row of logs can be cut
_LEAST_GAIN = 2.0


@dataclass(frozen=True)
class Split:
    """Some logs have another value of one instrument.

    Parameters
    ----------
    direction : ndarray
        (`SIZE`,) offsets that differ, by one amount.
    logs : frozenset of int
        Which have it.
    """

    direction: Array
    logs: frozenset[int]


@dataclass(frozen=True)
class Pooled:
    """Offsets of the logs of one campaign.

    Parameters
    ----------
    logs : tuple of int
    offsets : ndarray
        (`SIZE`,)
    covariance : ndarray
        (`SIZE`, `SIZE`); of what no log shows, the prior's.
    scatter : ndarray
        (`SIZE`,) standard deviation from log to log beyond their errors.
    differing : ndarray
        (`SIZE`,) bool: offsets that other campaigns of the ship have another value of.
    """

    logs: tuple[int, ...]
    offsets: Array
    covariance: Array
    scatter: Array
    differing: Mask


def pool(
    logs: Sequence[Evidence], prior: Array, material: Array, splits: Sequence[Split] | None = None
) -> tuple[list[Pooled], list[Split]]:
    """Estimate the offsets of several logs together.

    Parameters
    ----------
    logs : sequence of Evidence
    prior : ndarray
        (2, `SIZE`) what is expected, and the inverse variance of that.
    material : ndarray
        (`SIZE`,) what matters of each offset.
    splits : sequence of Split, optional
        Campaigns as they are known; looked for by default.

    Returns
    -------
    pooled : list of Pooled
        One a campaign.
    splits : list of Split
    """
    found = list(splits or ())
    estimate = _estimate(logs, found, prior)
    while splits is None and len(found) < _MOST_SPLITS and len(logs) > 1:
        split = _split(logs, estimate, material)
        if split is None:
            break
        found.append(split)
        estimate = _estimate(logs, found, prior)
    members: dict[tuple[bool, ...], list[int]] = {}
    for i in range(len(logs)):
        members.setdefault(tuple(i in s.logs for s in found), []).append(i)
    differing = np.zeros(SIZE, bool)
    for s in found:
        differing |= s.direction != 0
    pooled = []
    for rows in members.values():
        chosen = _chosen(found, rows[0])
        pooled.append(
            Pooled(
                tuple(rows),
                chosen @ estimate.value,
                chosen @ estimate.covariance @ chosen.T,
                estimate.scatter,
                differing,
            )
        )
    return pooled, found


@dataclass(frozen=True)
class _Estimate:
    value: Array
    covariance: Array
    scatter: Array
    offsets: list[Array]


def _chosen(splits: Sequence[Split], log: int) -> Array:
    """Return the columns by which common offsets and differences make up those of one log."""
    own = [s.direction if log in s.logs else np.zeros(SIZE) for s in splits]
    return np.column_stack([np.eye(SIZE), *own])


def _estimate(logs: Sequence[Evidence], splits: Sequence[Split], prior: Array) -> _Estimate:
    chosen = [_chosen(splits, i) for i in range(len(logs))]
    size = SIZE + len(splits)
    least = np.concatenate([prior[1], np.full(len(splits), prior[1, 0])])
    scatter = np.zeros(SIZE)
    value = np.zeros(size)
    covariance = np.eye(size)
    for _ in range(_ROUNDS if len(logs) > 2 else 1):
        total = np.diag(least)
        pull = least * np.concatenate([prior[0], np.zeros(len(splits))])
        for log, c in zip(logs, chosen, strict=True):
            information, drawn = _scattered(log, scatter)
            total += c.T @ information @ c
            pull += c.T @ drawn
        covariance = np.linalg.inv(total)
        value = covariance @ pull
        offsets = [c @ value for c in chosen]
        scatter = _scatter(logs, offsets)
    return _Estimate(value, covariance, scatter, [c @ value for c in chosen])


def _scattered(log: Evidence, scatter: Array) -> tuple[Array, Array]:
    """Return J and J θ̂ of a log whose offsets scatter about the common ones."""
    j = log.information
    if not scatter.any():
        return j, log.pull
    # (J⁻¹ + T)⁻¹ = J − J L (I + L J L)⁻¹ L J, which needs no inverse of J
    weigh = np.diag(scatter)
    inner = np.linalg.inv(np.eye(SIZE) + weigh @ j @ weigh)
    left = np.eye(SIZE) - j @ weigh @ inner @ weigh
    return left @ j, left @ log.pull


def _deviations(
    logs: Sequence[Evidence], offsets: Sequence[Array], direction: Array
) -> tuple[Array, Array]:
    """Return by how much each log differs in one direction, and the information on that."""
    weight = np.array([direction @ e.information @ direction for e in logs])
    drawn = np.array(
        [direction @ (e.pull - e.information @ at) for e, at in zip(logs, offsets, strict=True)]
    )
    return drawn / np.maximum(weight, 1e-12), weight


def _scatter(logs: Sequence[Evidence], offsets: Sequence[Array]) -> Array:
    """Return the standard deviation of each offset between logs (DerSimonian and Laird)."""
    out = np.zeros(SIZE)
    for k in range(SIZE):
        apart, weight = _deviations(logs, offsets, np.eye(SIZE)[k])
        told = weight > 0
        if told.sum() >= 3:
            out[k] = np.sqrt(variance_between(apart[told], weight[told]))
    return out


def _split(logs: Sequence[Evidence], estimate: _Estimate, material: Array) -> Split | None:
    """Return the logs that differ most clearly in one instrument; None where none do."""
    best: tuple[float, Split] | None = None
    for direction in _DIRECTIONS:
        if not any(direction @ e.information @ direction > 0 for e in logs):
            continue
        apart, weight = _deviations(logs, estimate.offsets, direction)
        least = CAMPAIGN * float(np.min(material[direction != 0]))
        # a log that can hardly see such a difference shows no campaign, but may belong to one
        told = np.flatnonzero(weight > (_SEEN / least) ** 2)
        if len(told) < 2:
            continue
        order = told[np.argsort(apart[told])]
        a, s = apart[order], 1.0 / np.sqrt(weight[order])
        alike = _scattered_likelihood(a, s, np.zeros(len(a), int))
        for k in range(1, len(a)):
            label = (np.arange(len(a)) >= k).astype(int)
            gain = _scattered_likelihood(a, s, label) - alike
            low, high = (_mean(a[label == g], s[label == g]) for g in (0, 1))
            gap, error = high[0] - low[0], float(np.hypot(low[1], high[1]))
            # two logs cannot tell scatter from campaigns
            proof = _LEAST_GAIN + np.log(len(a) - 1) if len(a) > 2 else 0.0
            apart_by = (gap / error) ** 2
            if gap <= max(least, SIGMAS * error) or gain <= proof:
                continue
            if best is None or apart_by > best[0]:
                small = int((label == 1).sum() <= (label == 0).sum())
                mine, theirs = (high, low) if small else (low, high)
                members = set(order[label == small].tolist())
                nearer = 0.5 * weight * ((apart - theirs[0]) ** 2 - (apart - mine[0]) ** 2)
                vague = np.setdiff1d(np.flatnonzero(nearer > _BELONGS), told)
                best = (apart_by, Split(direction, frozenset(members | set(vague.tolist()))))
    return None if best is None else best[1]


def _mean(value: Array, std: Array) -> tuple[float, float]:
    weight = std**-2
    return float(weight @ value / weight.sum()), float(weight.sum() ** -0.5)


def _scattered_likelihood(value: Array, std: Array, label: NDArray[np.int_]) -> float:
    """Return the log-likelihood of groups with a mean each and one scatter, maximised over it."""
    best = -np.inf
    for scatter in np.concatenate([[0.0], np.geomspace(0.05, 20.0, 25) * np.median(std)]):
        var = std**2 + scatter**2
        loglik = -0.5 * float(np.sum(np.log(var)))
        for g in np.unique(label):
            w = 1.0 / var[label == g]
            v = value[label == g]
            loglik -= 0.5 * float(w @ (v - w @ v / w.sum()) ** 2)
        best = max(best, loglik)
    return best
