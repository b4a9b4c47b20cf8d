"""Confidence sets that stay valid however weak the instruments are.

Under θ_i = θ_i0 the sum Σ w (y − φᵀθ(θ_i0)) has mean zero, w being the
combination of instruments that the other regressors do not see. Its variance
follows from the residuals at θ_i0, so the set of values not rejected is the
solution of one quadratic inequality: an interval, two rays, or the whole line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.credibility.evidence import Equation, Evidence
from greybox.estimation.covariance import correlation_lags
from greybox.estimation.gls_regression import WhiteEquations
from greybox.estimation.verdict import TestResult, not_applicable
from greybox.numerics.lagged_moments import lagged_sums, pairs
from greybox.numerics.linalg import scaled_inverse

Array = NDArray[np.float64]

_LEVEL = 0.95
# a set this many times as wide as the ordinary interval contradicts it
_WIDER = 1.5
# share of a standard error by which the instruments of an iteration's end may move an estimate
_SAME = 0.02
_PLAIN = "plain instrumental variables"


@dataclass(frozen=True)
class ConfidenceSet:
    """Values of a parameter that are not rejected.

    ``pieces`` are closed intervals, with infinite ends where unbounded; none
    where every value is rejected.
    """

    pieces: tuple[tuple[float, float], ...]

    @property
    def bounded(self) -> bool:
        """Whether the set is an interval of finite length."""
        return all(np.isfinite(a) and np.isfinite(b) for a, b in self.pieces)

    def __contains__(self, value: float) -> bool:
        return any(a <= value <= b for a, b in self.pieces)

    def words(self) -> str:
        """Return the set in words."""
        if not self.pieces:
            return "no value"
        if self.bounded:
            return f"{self.pieces[0][0]:.3g} to {self.pieces[0][1]:.3g}"
        if len(self.pieces) == 2:
            return f"below {self.pieces[0][1]:.3g} or above {self.pieces[1][0]:.3g}"
        low, high = self.pieces[0]
        if np.isfinite(low):
            return f"above {low:.3g}"
        if np.isfinite(high):
            return f"below {high:.3g}"
        return "any value"

    def to_list(self) -> list[list[float | None]]:
        """Return the pieces for JSON, None for an infinite end."""
        return [[float(v) if np.isfinite(v) else None for v in piece] for piece in self.pieces]


def solve_quadratic(estimate: float, v00: float, v01: float, v11: float, c: float) -> ConfidenceSet:
    """Return {θ : δ² ≤ c (v00 + 2 v01 δ + v11 δ²)}, δ = estimate − θ.

    References
    ----------
    Anderson and Rubin (1949); Dufour and Taamouti (2005).
    """
    a, b = 1.0 - c * v11, -c * v01
    d = b * b + a * c * v00
    if abs(a) < 1e-14:
        if abs(b) < 1e-300:
            return ConfidenceSet(((-np.inf, np.inf),))
        edge = estimate - c * v00 / (2 * b)
        # 2 b δ ≤ c v00
        return ConfidenceSet(((edge, np.inf),) if b > 0 else ((-np.inf, edge),))
    if d < 0:
        # only where a < 0: the estimate itself always belongs to the set
        return ConfidenceSet(((-np.inf, np.inf),))
    root = np.sqrt(d)
    ends = sorted((float(estimate - (-b - root) / a), float(estimate - (-b + root) / a)))
    if a > 0:
        return ConfidenceSet(((ends[0], ends[1]),))
    return ConfidenceSet(((-np.inf, ends[0]), (ends[1], np.inf)))


def confidence_sets(equation: Equation, std: Array | None = None) -> list[ConfidenceSet]:
    """Return the 95 % set of each parameter of an equation, robust to the moving average.

    Parameters
    ----------
    equation : Equation
    std : ndarray, optional
        (p,) standard errors of its estimate that allow for more than the noise model, and by
        as much the sets do.

    Returns
    -------
    list of ConfidenceSet

    References
    ----------
    Anderson and Rubin (1949); Dufour and Taamouti (2005), for subsets of the parameters.
    """
    from scipy.special import fdtri

    solution = equation.solution
    p = len(equation.labels)
    explained = solution.projected
    inverse = scaled_inverse(solution.information)
    # w with Σ w_i φ_j = 1 where i = j, else 0
    weights = [inverse @ h for h in explained]
    follow = inverse / np.diag(inverse)
    # residuals move by δ·b as θ_i is held off its estimate and the others follow
    shift = [follow.T @ (f - h) for f, h in zip(equation.phi, explained, strict=True)]
    noise_model = equation.noise_model
    errors = [noise_model.innovations(e, log) for log, e in enumerate(_unexplained(equation))]
    shift = [noise_model.innovations(b, log) for log, b in enumerate(shift)]
    freedom = max(equation.freedom - p * len(equation.phi), 1)
    known = np.minimum(noise_model.freedom_of(weights), freedom)
    weights = [noise_model.adjoint(w, log) for log, w in enumerate(weights)]
    lost = equation.rows / freedom
    v00 = lost * sum(((w * e) ** 2).sum(axis=1) for w, e in zip(weights, errors, strict=True))
    v01, v11 = _of_shift(equation.keep, weights, errors, shift, lost)
    v11 = np.maximum(v11, v01**2 / np.where(v00 > 0, v00, np.inf))
    c = fdtri(1, known, _LEVEL)
    if std is not None:
        c = c * np.maximum(std**2 / np.where(v00 > 0, v00, np.inf), 1.0)
    return [
        solve_quadratic(float(solution.theta[i]), v00[i], v01[i], v11[i], float(c[i]))
        for i in range(p)
    ]


def refined_confidence_sets(white: WhiteEquations, theta: Array, std: Array) -> list[ConfidenceSet]:
    """Return the 95 % set of each parameter of a refined estimate, all equations together.

    Where instruments are strong it is the interval of `std`.

    Parameters
    ----------
    white : WhiteEquations
    theta, std : ndarray
        (p,) the refined estimate and its standard errors.
    """
    from scipy.special import chdtri

    follow = white.inverse / np.diag(white.inverse)
    v01, v11 = np.zeros(len(theta)), np.zeros(len(theta))
    for i in range(white.equations):
        every = slice(i, None, white.equations)
        weights = [white.inverse @ r.z[:, every] for r in white.rows]
        errors = [(r.y - theta @ r.phi)[every] for r in white.rows]
        shift = [follow.T @ (r.phi - r.z)[:, every] for r in white.rows]
        keep = [np.ones(len(e), bool) for e in errors]
        both, own = _of_shift(keep, weights, errors, shift, 1.0)
        v01, v11 = v01 + both, v11 + own
    v00 = std**2
    v11 = np.maximum(v11, v01**2 / np.where(v00 > 0, v00, np.inf))
    c = float(chdtri(1, 1 - _LEVEL))
    return [
        solve_quadratic(float(t), float(a), float(b), float(d), c)
        for t, a, b, d in zip(theta, v00, v01, v11, strict=True)
    ]


def _of_shift(
    keep: Sequence[NDArray[np.bool_]],
    weights: list[Array],
    errors: list[Array],
    shift: list[Array],
    lost: float,
) -> tuple[Array, Array]:
    """Return Σ Σ w w E(e b) and Σ Σ w w E(b b), after whitening by the residuals' model."""
    lags = max(
        correlation_lags([b[i, k] for b, k in zip(shift, keep, strict=True)])
        for i in range(len(shift[0]))
    )
    memory = lagged_sums(weights, weights, lags) * lost
    memory[:, 1:] *= 2.0
    memory /= np.maximum([pairs(keep, lag) for lag in range(lags + 1)], 1)
    single = [e[None] for e in errors]
    both = (lagged_sums(shift, single, lags) + lagged_sums(single, shift, lags)) / 2
    return (memory * both).sum(axis=1), (memory * lagged_sums(shift, shift, lags)).sum(axis=1)


def _unexplained(equation: Equation) -> list[Array]:
    """Return the residuals without what the instruments explain of them."""
    if len(equation.z) == 1:
        return list(equation.residuals)
    out = []
    for e, z in zip(equation.residuals, equation.z, strict=True):
        size = np.linalg.norm(z, axis=1)
        basis = np.linalg.svd(z[size > 0] / size[size > 0, None], full_matrices=False)[2]
        out.append(e - (basis @ e) @ basis)
    return out


def anderson_rubin(evidence: Evidence, equation: Equation, biases: frozenset[str]) -> TestResult:
    """Compare the sets with the ordinary intervals of instrumental variables.

    The sets are those of the estimate itself where it comes from instruments; of another
    one they are those of the plain instrumental variables beside it, and the detail says so.

    Parameters
    ----------
    evidence : Evidence
    equation : Equation
    biases : frozenset of str
    """
    null = "intervals that hold under weak instruments are as wide as the ordinary ones"
    if equation.obstacle:
        return not_applicable("anderson_rubin", null, equation.obstacle, equation.state)
    mine = list(equation.columns)
    theta, std = equation.solution.theta, equation.std
    own = evidence.white is not None or _is_solution(evidence, equation)
    if evidence.white is not None:
        theta, std = evidence.theta[mine], evidence.std[mine]
        every = refined_confidence_sets(evidence.white, evidence.theta, evidence.std)
        found_sets = [every[i] for i in mine]
    elif own:
        std = np.maximum(std, evidence.std[mine])
        found_sets = confidence_sets(equation, std=std)
    else:
        found_sets = confidence_sets(equation)
    sets = dict(zip(equation.labels, found_sets, strict=True))
    wide, ratios = [], []
    for label, s in zip(equation.labels, std, strict=True):
        if label in biases:
            continue
        found = sets[label]
        ratio = np.inf
        if found.bounded and found.pieces:
            ratio = (found.pieces[0][1] - found.pieces[0][0]) / (2 * 1.96 * s) if s > 0 else 1.0
        ratios.append(ratio)
        if ratio > _WIDER:
            wide.append(label)
    shown = "; ".join(f"{n}: {sets[n].words()}" for n in wide)
    worst = max(ratios, default=1.0)
    told = (
        f"sets that hold under weak instruments (95 %) are at most {worst:.2f} times as wide."
        if not wide
        else f"under weak instruments only these sets are safe (95 %): {shown}."
    )
    return TestResult(
        "anderson_rubin",
        null,
        worst if np.isfinite(worst) else None,
        None,
        told if own else f"of {_PLAIN} beside this estimate: {told}",
        _WIDER,
        not wide,
        tuple(wide),
        {
            "sets": {n: s.to_list() for n, s in sets.items() if n not in biases},
            "of": "estimate" if own else _PLAIN,
            "estimates": {
                n: float(v) for n, v in zip(equation.labels, theta, strict=True) if n not in biases
            },
        },
        state=equation.state,
    )


def _is_solution(evidence: Evidence, equation: Equation) -> bool:
    """Whether the estimate is the plain instrumental-variable solution of an equation."""
    if not evidence.estimator.instruments:
        return False
    away = np.abs(evidence.theta[list(equation.columns)] - equation.solution.theta)
    return bool((away <= _SAME * equation.std).all())
