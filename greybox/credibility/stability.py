"""Whether the identified model is stable and its damping dissipates."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from greybox.credibility.evidence import Evidence
from greybox.estimation.verdict import TestResult, not_applicable
from greybox.model.run.inputs import LogInputs
from greybox.model.run.step import Integrator, StepModel
from greybox.numerics.linalg import scaled_root

Array = NDArray[np.float64]

LEVEL = 0.05
# probability of an unstable model from which a user is warned
UNSTABLE = 0.05
_POINTS, _DRAWS = 60, 200


def stability(evidence: Evidence) -> TestResult:
    """Report the largest eigenvalue of ∂x⁺/∂x, and how likely the model is unstable.

    The Jacobian of a forward Euler step is affine in the parameters, so draws from their
    covariance cost an eigenvalue each; for steady inputs that of a Runge-Kutta step is a
    polynomial of it. A draw counts as unstable where its median along the motion is.

    References
    ----------
    Hairer and Wanner (1996), section IV.2, stability function of order 4.
    """
    name, null = "stability", "the identified model is stable along the motion"
    predictor = evidence.predictor
    structure = predictor.structure
    columns = predictor.parameter_columns
    terms = [structure.index(predictor.columns[i].terms[0]) for i in columns]
    constant, slopes, states = _affine_jacobian(evidence, terms)
    theta = evidence.theta[columns]
    covariance = evidence.covariance[np.ix_(columns, columns)]
    if not (np.isfinite(theta).all() and np.isfinite(covariance).all()):
        return not_applicable(name, null, "the covariance of the estimate is not known")
    normal = np.random.default_rng(0).standard_normal((_DRAWS, len(theta)))
    draws = theta + normal @ scaled_root(covariance).T
    largest = _spectral_radius(constant, slopes, np.vstack([theta, draws]), evidence.integrator)
    here = largest[0]
    share = float((np.median(largest[1:], axis=1) > 1).mean())
    at = int(np.argmax(here))
    point = ", ".join(f"{n} = {v:.2g}" for n, v in zip(structure.states, states[at], strict=True))
    unstable = float((here > 1).mean())
    fine = share <= UNSTABLE and unstable < 0.5
    return TestResult(
        name,
        null,
        float(here.max()),
        None,
        f"the largest eigenvalue along the motion is {here.max():.3f} (at {point})"
        + (f", above 1 on {100 * unstable:.0f} % of it" if unstable else "")
        + f"; {100 * share:.0f} % of models drawn from the covariance are unstable.",
        UNSTABLE,
        fine,
        (),
        {
            "largest": float(here.max()),
            "median": float(np.median(here)),
            "unstable_draws": share,
            "unstable_samples": unstable,
        },
    )


def _affine_jacobian(evidence: Evidence, terms: list[int]) -> tuple[Array, Array, Array]:
    """Return A at θ = 0 (K, n, n), its slopes (p, K, n, n), and the states (K, n)."""
    predictor = evidence.predictor
    structure = predictor.structure
    n = len(structure.states)
    function = StepModel(structure, air_measured=predictor.air_measured).jacobians
    rows = []
    for log, keep in zip(evidence.logs, evidence.keep, strict=True):
        kept = np.flatnonzero(keep)
        at = kept[:: max(1, len(kept) * len(evidence.logs) // _POINTS)]
        given = LogInputs.of(structure, log)
        air = np.zeros((len(log), 2))
        if predictor.air_measured and log.air is not None:
            air = log.air
        rows.append(np.column_stack([log.states(structure.states), given.psi, given.tau, air])[at])
    table = np.vstack(rows)
    x, psi = table[:, :n].T, table[:, n][None]
    tau, air = table[:, n + 1 : -2].T, table[:, -2:].T
    d = np.zeros((len(structure.disturbances), len(table)))

    def evaluate(theta: Array) -> Array:
        a = function(x, psi, tau, d, air, np.repeat(theta[:, None], len(table), axis=1), 1.0)[0]
        return np.asarray(a.full()).reshape(n, len(table), n).transpose(1, 0, 2)

    zero = np.zeros(len(structure.terms))
    base = evaluate(zero)
    slopes = []
    for t in terms:
        unit = zero.copy()
        unit[t] = 1.0
        slopes.append(evaluate(unit) - base)
    return base, np.array(slopes), x.T


def _spectral_radius(constant: Array, slopes: Array, theta: Array, integrator: Integrator) -> Array:
    """Return the largest modulus of the eigenvalues of a step, (draws, K)."""
    matrices = constant + np.tensordot(theta, slopes, axes=1)
    one = matrices.shape[-1] == 1
    eigenvalues = matrices[..., 0] if one else np.linalg.eigvals(matrices)
    if integrator == "rk4":
        # a forward Euler step has 1 + z
        z = eigenvalues - 1
        eigenvalues = 1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24
    return np.asarray(np.abs(eigenvalues).max(axis=-1))


def damping_signs(evidence: Evidence) -> TestResult:
    """Test each damping parameter for the wrong sign, one-sided.

    One significant violation in twenty tested parameters is chance; the least
    p-value is reported, with Holm's correction for how many were looked at.

    References
    ----------
    Holm (1979); Fossen (2011), section 6.4 (damping is dissipative).
    """
    from scipy.special import ndtr

    name, null = "damping_signs", "every damping term takes energy out of the motion"
    predictor = evidence.predictor
    structure = predictor.structure
    found: list[tuple[str, float]] = []
    for i in predictor.parameter_columns:
        column = predictor.columns[i]
        owned = [structure.terms[structure.index(t)] for t in column.terms]
        if not structure.increment or not all(t.dissipates for t in owned):
            continue
        std = evidence.std[i]
        p = float(ndtr(-evidence.theta[i] / std)) if std > 0 else float(evidence.theta[i] <= 0)
        found.append((column.label, p))
    if not found:
        return not_applicable(name, null, "the structure has no damping term of its own states")
    found.sort(key=lambda f: f[1])
    wrong, p = [], 1.0
    for rank, (label, raw) in enumerate(found):
        adjusted = min(1.0, raw * (len(found) - rank))
        if rank == 0:
            p = adjusted
        if adjusted >= LEVEL:
            break
        wrong.append(label)
    return TestResult(
        name,
        null,
        float(len(wrong)),
        p,
        f"{', '.join(wrong)} {'is' if len(wrong) == 1 else 'are'} positive, which feeds energy "
        f"into the motion: the structure lacks a term, or the log does not show the damping."
        if wrong
        else f"none of {len(found)} damping terms has the wrong sign beyond chance.",
        LEVEL,
        not wrong,
        tuple(wrong),
        {"p_values": dict(found)},
    )
