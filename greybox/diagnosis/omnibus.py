"""Whether anything is wrong at all: what any force could explain, proved on other logs.

A wide set of functions of motion, commands, heading and time pushes each equation. Ridge
regression (its strength by marginal likelihood) fits them to the innovations of the
estimation logs; only what then predicts the held-out logs is a fault of the model and
not the sea's own noise.

References
----------
Tikhonov and Arsenin (1977); MacKay (1992), section 4, on the evidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.fitting import Problem
from greybox.diagnosis.held_out import Pair, Proof, proof_of
from greybox.diagnosis.linear import NOWHERE, sensitivities
from greybox.diagnosis.point import Fit
from greybox.diagnosis.ship import LogRun, shifted, wired
from greybox.numerics.linalg import scaled_inverse

Array = NDArray[np.float64]

# prior deviations of a direction's share, in innovations' deviations, that are tried
_STRENGTHS = np.geomspace(0.05, 100.0, 24)
_LAGS = (2.0, 5.0, 10.0)
# quantiles of a state's size from which on a force may begin
_KNOTS = (0.3, 0.6, 0.85)


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


def knots_of(problem: Problem) -> Array:
    """Return sizes of each state from which on a force may begin, (nx, K)."""
    nx = len(problem.runs[0].states)
    size = np.abs(np.concatenate([run.y[:, :nx] for run in problem.runs]))
    return np.asarray(np.quantile(size, _KNOTS, axis=0).T)


def features(run: LogRun, fit: Fit, start: Array, knots: Array) -> Array:
    """Return functions of what is simulated and commanded, (N, G)."""
    ship = fit.point.ship
    x = run.run(ship, start).x
    tau = run.forces(ship.vessel, ship.wires)
    log = run.log
    columns: list[Array] = [np.ones(len(x))]
    states = list(x.T)
    columns += states
    for i, one in enumerate(states):
        for two in states[i:]:
            columns += [one * two, np.abs(one) * two]
            if two is not one:
                columns.append(one * np.abs(two))
        columns.append(one**3)
        for knot in knots[i]:
            beyond = np.maximum(np.abs(one) - knot, 0.0)
            columns += [beyond, beyond * np.sign(one)]
    commands = wired({c: log[c] for c in log.vessel.commands}, ship.wires)
    for thruster in log.vessel.thrusters:
        n = commands[thruster.speed]
        angle = thruster.angle if isinstance(thruster.angle, str) else thruster.rudder
        turned = commands[angle] if angle is not None else np.zeros(len(x))
        for push in (np.ones(len(x)), n, n * np.abs(n)):
            columns += [push * np.cos(turned), push * np.sin(turned)]
        columns.append(np.sign(n))
    for force in tau.T:
        columns += [force * state for state in states]
        columns += [shifted(force, lag / run.sample_time) for lag in _LAGS]
    psi = log["psi"] if "psi" in log else np.zeros(len(x))
    for k in (1, 2):
        columns += [np.cos(k * psi), np.sin(k * psi)]
    columns += [states[0] * np.cos(psi), states[0] * np.sin(psi)]
    later = run.time > run.time[-1] / 2
    columns += [later * column for column in (*states, *tau.T)]
    return np.column_stack(columns)


def _pushed(
    problem: Problem, fit: Fit, knots: Array, scales: Array | None
) -> tuple[list[Array], Array]:
    """Return ∂y of every feature in every equation, and the features' sizes."""
    point = fit.point
    ship = point.ship
    made = [features(r, fit, s, knots) for r, s in zip(problem.runs, point.starts, strict=True)]
    if scales is None:
        scales = np.sqrt(np.mean(np.concatenate([m**2 for m in made]), axis=0))
        scales = np.where(scales > 0, scales, 1.0)
    out = []
    for run, start, g in zip(problem.runs, point.starts, made, strict=True):
        shown = run.run(ship, start)
        linear = run.linearise(ship, shown, NOWHERE)
        nx = shown.x.shape[1]
        unit = g[:-1] / scales
        driven = np.zeros((len(unit), nx, nx * unit.shape[1]))
        for i in range(nx):
            driven[:, i, i * unit.shape[1] : (i + 1) * unit.shape[1]] = unit
        out.append(
            run.seen(ship, sensitivities(replace(linear, driven=driven)))[:, :, : driven.shape[2]]
        )
    return out, scales


def _rows(problem: Problem, fit: Fit, columns: Sequence[Array]) -> Array:
    rows = [fit.noise.whiten(c) for c in columns]
    return np.concatenate([r.reshape(-1, r.shape[2]) for r in rows])


def omnibus(pairs: Sequence[Pair]) -> Omnibus:
    """Fit any force to what a model leaves, and prove it on other logs.

    Parameters
    ----------
    pairs : sequence of Pair
        The hypothesis on the estimation and the held-out logs.
    """
    along, size, total = [], 0.0, 0.0
    for pair in pairs:
        if pair.fit.escaped or pair.held_fit.escaped:
            continue
        predicted, seen = _predicted(pair)
        channels = pair.held_fit.nu[0].shape[1]
        along.append((seen * predicted).reshape(-1, channels).sum(axis=1))
        size += float(predicted @ predicted)
        total += float(seen @ seen)
    if not along:
        return Omnibus(proof_of(np.zeros(1)), 0.0, 0.0)
    joined = np.concatenate(along)
    agreed = max(float(joined.sum()), 0.0) ** 2 / max(size, 1e-300)
    return Omnibus(proof_of(joined), agreed, agreed / max(total, 1e-300))


def _predicted(pair: Pair) -> tuple[Array, Array]:
    """Return the held-out innovations that any force predicts, and the true ones."""
    problem, fit, held, held_fit = pair.problem, pair.fit, pair.held, pair.held_fit
    nuisance = np.concatenate(
        [r.reshape(-1, r.shape[2]) for r in problem.rows(fit.point, fit.noise)]
    )
    free = len(fit.point.places) + sum(map(len, fit.point.values))
    scale = np.sqrt((nuisance**2).sum(axis=0))
    scale[scale == 0] = 1.0
    left, values, right = np.linalg.svd(nuisance / scale, full_matrices=False)
    kept = values > 1e-8 * values[0]
    left = left[:, kept]
    knots = knots_of(problem)
    pushed, scales = _pushed(problem, fit, knots, None)
    raw = _rows(problem, fit, pushed)
    size = np.sqrt((raw**2).sum(axis=0))
    size[size == 0] = 1.0
    raw /= size
    along = left.T @ raw
    cleared = raw - left @ along
    nu = np.concatenate([n.ravel() for n in fit.nu])
    nu = nu - left @ (left.T @ nu)
    delta = _ridge(cleared, nu)
    # what the coefficients give back, where they can imitate
    back = -((right[kept].T / values[kept]) @ (along @ delta)) / scale
    moved, _ = _pushed(held, held_fit, knots, scales)
    predicted = _rows(held, held_fit, moved) / size @ delta
    predicted = predicted + _coefficients(held, fit, held_fit) @ back[:free]
    starts = np.concatenate(
        [r.reshape(-1, r.shape[2]) for r in held.rows(held_fit.point, held_fit.noise)]
    )
    basis = np.linalg.qr(starts)[0]
    predicted -= basis @ (basis.T @ predicted)
    seen = np.concatenate([n.ravel() for n in held_fit.nu])
    return predicted, seen


@dataclass(frozen=True)
class Disagreement:
    """How far the coefficients that held-out logs ask for lie from the estimate.

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
    from scipy.stats import chi2

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
    return Disagreement(fall, float(chi2.sf(min(distance, fall / 2), count)))


def _ridge(rows: Array, nu: Array) -> Array:
    """Return coefficients (m,) by the strength that makes the innovations likeliest."""
    left, values, right = np.linalg.svd(rows, full_matrices=False)
    known = values > 1e-8 * values[0]
    left, values, right = left[:, known], values[known], right[known]
    share = left.T @ nu
    best, chosen = np.inf, _STRENGTHS[0]
    for strength in _STRENGTHS:
        grown = 1 + (strength * values) ** 2
        # −2 log of the marginal likelihood, constants apart
        cost = float((share**2 / grown).sum() + np.log(grown).sum())
        if cost < best:
            best, chosen = cost, strength
    shrunk = chosen**2 * values / (1 + (chosen * values) ** 2)
    return np.asarray(right.T @ (shrunk * share))


def _coefficients(held: Problem, fit: Fit, held_fit: Fit) -> Array:
    """Return whitened rows of the estimation fit's free numbers on the held-out logs."""
    point = replace(fit.point, starts=held_fit.point.starts)
    free = len(point.places) + sum(map(len, point.values))
    rows = held.rows(point, held_fit.noise)
    return np.concatenate([r.reshape(-1, r.shape[2]) for r in rows])[:, :free]
