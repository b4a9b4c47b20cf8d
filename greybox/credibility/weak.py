"""Weak instruments, judged for all parameters of an equation together.

A first-stage F looks at one regressor at a time: it is large for u and for |u|u
alike, although instruments that hardly leave one speed cannot tell them apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.credibility.evidence import Equation
from greybox.credibility.excitation import combination
from greybox.estimation.covariance import correlation_lags
from greybox.estimation.verdict import TestResult, not_applicable
from greybox.numerics.lagged_moments import autocovariance, weighted_lags
from greybox.numerics.linalg import quadratic_form, scaled_inverse

Array = NDArray[np.float64]

# share of its worst case that the bias may reach (Montiel Olea and Pflueger's τ)
BIAS_SHARE = 0.10
_EXACT = 1e-12
_NAMED = 0.3


@dataclass(frozen=True)
class Strength:
    """How well instruments determine each direction of an equation.

    Parameters
    ----------
    partial_f : ndarray
        (p,) ordinary first-stage F; infinite for regressors without noise.
    shea : ndarray
        (p,) Shea's partial R².
    own : ndarray
        (p,) effective F of the part of a regressor that no other one has.
    cragg_donald : float
        Smallest eigenvalue, over the number of instruments for noisy regressors.
    rank : float
        Kleibergen-Paap rk statistic, robust to memory of the noise.
    rank_freedom : int
    direction : ndarray
        (p,) the weakest combination, each regressor in its standard deviation.
    """

    partial_f: Array
    shea: Array
    own: Array
    cragg_donald: float
    rank: float
    rank_freedom: int
    direction: Array


def threshold(freedom: int = 1) -> float:
    """Return the 95 % point of χ²(ν; ν/τ)/ν: what weak instruments hardly exceed.

    τ is the bias relative to its worst case, 10 %; for ν = 1 this is 23.1.

    References
    ----------
    Montiel Olea and Pflueger (2013), theorem 1; Lewis and Mertens (2022).
    """
    from scipy.stats import ncx2

    return float(ncx2.ppf(0.95, freedom, freedom / BIAS_SHARE) / freedom)


def measure_strength(equation: Equation) -> Strength:
    """Measure the relevance of the instruments of one equation.

    References
    ----------
    Shea (1997); Cragg and Donald (1993); Kleibergen and Paap (2006); Montiel
    Olea and Pflueger (2013) for the effective F.
    """
    solution = equation.solution
    explained = solution.projected
    noise = [f - h for f, h in zip(equation.phi, explained, strict=True)]
    bases = [orthonormal(z) for z in equation.z]
    q = sum(len(b) for b in bases)
    p = len(equation.labels)
    freedom = max(equation.freedom - q, 1)
    gram = solution.information
    inverse = scaled_inverse(gram)
    moments = np.asarray(sum(f @ f.T for f in equation.phi))
    covariance = np.asarray(sum(v @ v.T for v in noise)) / freedom
    noisy = np.diag(covariance) * freedom > _EXACT * np.diag(moments)
    own, first = np.full(p, np.inf), np.full(p, np.inf)
    for i in np.flatnonzero(noisy):
        # (p,) combination of the explained regressors that is orthogonal to all others
        part = [(inverse[i] / inverse[i, i] @ h)[None] for h in explained]
        size = float(sum((w**2).sum() for w in part))
        own[i] = size**2 / _noise_variance(part, [v[i : i + 1] for v in noise], equation, q)
        first[i] = gram[i, i] / covariance[i, i] / q
    shea = np.diag(scaled_inverse(moments)) / np.diag(inverse)
    donald, rank, rank_freedom, direction = _joint(equation, bases, noise, covariance, noisy, q)
    # the noise of a sample is that of all, and what the instruments move adds up
    gain = equation.gain
    least = float(gain.min())
    return Strength(
        first * gain, shea, own * gain, donald * least, rank * least, rank_freedom, direction
    )


def orthonormal(z: Array) -> Array:
    """Return rows that span those of z (q, N) and are orthonormal."""
    size = np.linalg.norm(z, axis=1)
    if not (size > 0).any():
        return np.zeros((0, z.shape[1]))
    _, values, vt = np.linalg.svd(z[size > 0] / size[size > 0, None], full_matrices=False)
    return np.asarray(vt[values > 1e-12 * values[0]])


def _noise_variance(
    weights: list[Array], noise: list[Array], equation: Equation, lost: int
) -> float:
    """Return the variance of Σ w v for one noise v with memory."""
    lags = correlation_lags([v[0][k] for v, k in zip(noise, equation.keep, strict=True)])
    gamma = autocovariance(noise, equation.keep, lags, lost)
    value = weighted_lags(weights, gamma).item()
    # a truncated autocovariance need not be positive: then memory is left out
    return value if value > 0 else gamma[0].item() * float(sum((w**2).sum() for w in weights))


def _joint(
    equation: Equation,
    bases: list[Array],
    noise: list[Array],
    covariance: Array,
    noisy: NDArray[np.bool_],
    q: int,
) -> tuple[float, float, int, Array]:
    """Return Cragg-Donald, Kleibergen-Paap, its degrees of freedom, and the direction."""
    p = len(noisy)
    if not noisy.any():
        return np.inf, np.inf, 0, np.zeros(p)
    coordinates = np.vstack([b @ f.T for b, f in zip(bases, equation.phi, strict=True)])
    rest = np.eye(q)
    exact = int((~noisy).sum())
    if exact:
        u = np.linalg.svd(coordinates[:, ~noisy])[0]
        rest = u[:, exact:]
    scale = np.sqrt(np.diag(covariance)[noisy])
    root = np.linalg.cholesky(
        covariance[np.ix_(noisy, noisy)] / np.outer(scale, scale) + 1e-13 * np.eye(noisy.sum())
    )
    whiten = np.linalg.inv(root).T / scale[:, None]
    u, values, vt = np.linalg.svd(rest.T @ coordinates[:, noisy] @ whiten)
    m = int(noisy.sum())
    weak = np.zeros(p)
    weak[noisy] = whiten @ vt[m - 1]
    left = rest @ u[:, m - 1 :]
    error = [(weak @ v)[None] for v in noise]
    lags = correlation_lags([e[0][k] for e, k in zip(error, equation.keep, strict=True)])
    gamma = autocovariance(error, equation.keep, lags, q)
    blocks = np.zeros((q, q))
    start = 0
    for b in bases:
        stop = start + len(b)
        blocks[start:stop, start:stop] = weighted_lags([b], gamma)
        start = stop
    rank, freedom, _ = quadratic_form(left.T @ coordinates @ weak, left.T @ blocks @ left)
    spread = np.sqrt(np.asarray(sum((f**2).sum(axis=1) for f in equation.phi)))
    direction = weak * spread
    return (
        float(values[m - 1] ** 2 / rest.shape[1]),
        rank,
        freedom,
        direction / np.abs(direction).max(),
    )


def weak_instruments(equation: Equation, biases: frozenset[str]) -> list[TestResult]:
    """Test whether the instruments determine every parameter of an equation.

    Parameters
    ----------
    equation : Equation
    biases : frozenset of str
        Labels that are no parameters; they are judged but not held against any.

    Returns
    -------
    list of TestResult
        ``relevance_<state>``: the weakest direction (Kleibergen-Paap);
        ``weak_instruments_<state>``: each parameter by what only it has.
    """
    state = equation.state
    kinds = "relevance", "weak_instruments"
    nulls = (
        "some combination of the regressors is hardly moved by the instruments",
        "the part of a regressor that no other has is hardly moved by the instruments",
    )
    if equation.obstacle:
        return [
            not_applicable(k, h, equation.obstacle, state)
            for k, h in zip(kinds, nulls, strict=True)
        ]
    s = measure_strength(equation)
    if not np.isfinite(s.own).any():
        reason = "no regressor of this equation is noisy"
        return [not_applicable(k, h, reason, state) for k, h in zip(kinds, nulls, strict=True)]
    labels = equation.labels
    freedom = max(s.rank_freedom, 1)
    needed = threshold(freedom)
    joint = s.rank / freedom
    size = np.abs(s.direction)
    involved = tuple(
        labels[i] for i in np.argsort(-size) if size[i] > _NAMED and labels[i] not in biases
    )
    shown = combination(labels, s.direction, _NAMED)
    relevance = TestResult(
        kinds[0],
        nulls[0],
        joint,
        None,
        f"Kleibergen-Paap rk {joint:.3g} ({needed:.3g} needed), Cragg-Donald "
        f"{s.cragg_donald:.3g}; the weakest direction is {shown}"
        + (": weak." if joint < needed else "."),
        needed,
        bool(joint >= needed),
        involved if joint < needed else (),
        {
            "cragg_donald": s.cragg_donald,
            "kleibergen_paap": s.rank,
            "degrees_of_freedom": s.rank_freedom,
            "direction": dict(zip(labels, s.direction.tolist(), strict=True)),
        },
        state=state,
    )
    judged = [i for i in range(len(labels)) if np.isfinite(s.own[i])]
    needed = threshold()
    weakest = min(judged, key=lambda i: s.own[i])
    weak = tuple(labels[i] for i in judged if s.own[i] < needed and labels[i] not in biases)
    rest = s.partial_f[weakest]
    sentence = (
        f"weak: what only {', '.join(weak)} can explain moves too little against the noise "
        f"(effective F {s.own[weakest]:.3g} at {labels[weakest]}, {needed:.3g} needed, though its "
        f"first-stage F is {rest:.3g}): move the ship over a wider range."
        if weak
        else f"the least effective F is {s.own[weakest]:.3g} at {labels[weakest]} "
        f"({needed:.3g} needed; its first-stage F is {rest:.3g})."
    )
    own = TestResult(
        kinds[1],
        nulls[1],
        float(s.own[weakest]),
        None,
        sentence,
        needed,
        not weak,
        weak,
        {
            "effective_f": _finite(labels, s.own),
            "shea_partial_r2": _finite(labels, s.shea),
            "first_stage_f": _finite(labels, s.partial_f),
        },
        state=state,
    )
    return [relevance, own]


def _finite(labels: tuple[str, ...], values: Array) -> dict[str, float | None]:
    """Return values by label, None where infinite: a regressor without noise."""
    return {n: float(v) if np.isfinite(v) else None for n, v in zip(labels, values, strict=True)}
