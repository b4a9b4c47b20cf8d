"""The omnibus test: whether any force at all would explain errors of held-out logs.

A wide set of functions of motion, commands, heading and time pushes each equation; only what
predicts the held-out logs is a fault of the model and not the sea's own noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.evidence.held_out import Pair, Proof, proof_of
from greybox.diagnosis.evidence.remainder import ANYTHING, Use, generic_force
from greybox.numerics.linalg import scaled_inverse

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Omnibus:
    """How much of the held-out error any force could explain.

    Parameters
    ----------
    proof : Proof
        That what it predicts agrees with the held-out errors.
    gain : float
        Fall of the squared innovations of the held-out logs.
    explicable : float
        Share of the squared innovations of the held-out logs that it would take away.
    """

    proof: Proof
    gain: float
    explicable: float


def omnibus(pairs: Sequence[Pair], use: Use = ANYTHING) -> Omnibus:
    """Fit a generic force to a model's errors, and test it on other logs.

    Parameters
    ----------
    pairs : sequence of Pair
        The hypothesis on the estimation and the held-out logs.
    use : Use
        What forces there may be.
    """
    along, size, total = [], 0.0, 0.0
    for pair in pairs:
        if pair.fit.escaped or pair.held_fit.escaped:
            continue
        force = generic_force(pair, use)
        predicted, seen = force.predicted, force.seen
        channels = pair.held_fit.nu[0].shape[1]
        along.append((seen * predicted).reshape(-1, channels).sum(axis=1))
        size += float(predicted @ predicted)
        total += float(seen @ seen)
    if not along:
        return Omnibus(proof_of(np.zeros(1)), 0.0, 0.0)
    joined = np.concatenate(along)
    agreed = max(float(joined.sum()), 0.0) ** 2 / max(size, 1e-300)
    return Omnibus(proof_of(joined), agreed, agreed / max(total, 1e-300))


@dataclass(frozen=True)
class Disagreement:
    """How far the coefficients that fit the held-out logs lie from the estimate.

    Parameters
    ----------
    fall : float
        Of −2 log L of the held-out logs when the coefficients are fitted to them.
    p_value : float
        Of coefficients that are the same (Wald), both covariances robust. Were they the
        same, `fall` would be twice that statistic where both logs tell as much; where it is
        less, covariances are too small, and half of it counts.
    """

    fall: float
    p_value: float


def disagreement(pairs: Sequence[Pair]) -> Disagreement:
    """Compare the coefficients of the estimation with those of the held-out logs.

    References
    ----------
    Wald (1943); Chow (1960) for regressions.
    """
    from scipy.special import chdtrc

    fall, distance, count = 0.0, 0.0, 0
    for pair in pairs:
        if pair.held_fit.escaped or pair.fit.escaped:
            return Disagreement(np.inf, 0.0)
        places = pair.fit.point.places
        point = replace(pair.held_fit.point, places=places)
        own = pair.held.settle(pair.held.fit(point, pair.held_fit.noise))
        fall += max(pair.held_fit.cost - own.cost, 0.0)
        if own.escaped:
            return Disagreement(fall, 0.0)
        _, there = pair.held.covariance(own)
        _, here = pair.problem.covariance(pair.fit)
        m = len(places)
        before = np.concatenate([point.base.theta, point.base.current])[list(places)]
        after = np.concatenate([own.point.base.theta, own.point.base.current])[list(places)]
        count += m
        spread = here[:m, :m] + there[:m, :m]
        if not np.isfinite(spread).all():
            # a run at the edge of stability has no covariance: the fall alone decides
            distance = np.inf
            continue
        away = after - before
        distance += float(away @ scaled_inverse(spread, 1e-10) @ away)
    return Disagreement(fall, float(chdtrc(count, min(distance, fall / 2))))
