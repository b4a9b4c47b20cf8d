"""Samples near a sign change, and the bias that they cause."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from greybox.credibility.evidence import Evidence
from greybox.errors import GreyboxError
from greybox.estimation.verdict import TestResult, not_applicable
from greybox.model.run.inputs import LogInputs
from greybox.numerics.linalg import scaled_inverse
from greybox.regression.instruments import simulate_log
from greybox.trial.log import TrialLog

Array = NDArray[np.float64]

# standard errors of bias from which a parameter is not to be relied on
TOLERATED_BIAS = 1.0
# nodes of the noise, ±4 standard deviations: |x| has a kink, which defeats Gauss-Hermite
_NODES = 41
_ROWS = 1500


def sign_margins(
    logs: Sequence[TrialLog], states: tuple[str, ...], margins: Mapping[str, float] | None, cut: int
) -> list[TestResult]:
    """Report how many samples come closer to the origin than three noise deviations (A10)."""
    out = []
    for state in ("u", "v"):
        if state not in states:
            continue
        std = logs[0].vessel.std(state)
        null = f"|{state}| stays beyond its margin, so that |{state}| is differentiable there"
        margin = (margins or {}).get(state)
        if margin is None and std is not None:
            margin = 3 * std
        if margin is None:
            reason = f"the vessel file gives no {state}_std and no margin was set"
            out.append(not_applicable("margin", null, reason, state))
            continue
        value = np.concatenate([log[state] for log in logs])
        share = float((np.abs(value) <= margin).mean())
        advice = (
            f"; {cut} samples were cut out for their margins"
            if margins
            else ""
            if share < 0.01
            else f", which biases modulus terms: cut them with --margin-{state}"
        )
        out.append(
            TestResult(
                "margin",
                null,
                share,
                None,
                f"{100 * share:.1f} % of the samples have |{state}| below {margin:.3g} m/s"
                f"{advice}.",
                detail={"margin": margin},
                state=state,
            )
        )
    return out


def noise_bias(evidence: Evidence) -> Array | None:
    """Return the bias that measurement noise causes through the regressors, (p,).

    E φ(x + e) − φ(x) along the simulated states, mapped by the estimator's
    −G⁻¹ Σ ẑ (·)ᵀθ. Beyond its margin a modulus is linear and squares only add
    a constant, which zero-mean instruments remove: then it is zero.

    Returns
    -------
    ndarray or None
        None where a noise level is unknown or the model cannot be simulated.

    References
    ----------
    Ljungberg (2020), A10 and section 4.2.
    """
    predictor = evidence.predictor
    states = predictor.structure.states
    stds = [evidence.logs[0].vessel.std(s) for s in states]
    if any(s is None for s in stds) or not evidence.equations:
        return None
    noise = np.array([float(s) for s in stds if s is not None])
    nodes = np.linspace(-4, 4, _NODES)
    weights = np.exp(-(nodes**2) / 2)
    weights /= weights.sum()
    p = len(predictor.columns)
    right = np.zeros(p)
    stride = max(1, sum(len(log) for log in evidence.logs) // _ROWS)
    rows = {i: (k, j) for k, e in enumerate(evidence.equations) for j, i in enumerate(e.columns)}
    theta = _structure_theta(evidence)
    for index, log in enumerate(evidence.logs):
        try:
            run = simulate_log(
                predictor.structure,
                theta,
                log,
                use_wind=predictor.air_measured,
                integrator=evidence.integrator,
            )
        except GreyboxError:
            return None
        if run.diverged[0] >= 0:
            return None
        at = slice(0, len(log) - 1, stride)
        x = run.x[0][:-1][at]
        given = LogInputs.of(predictor.structure, log)
        tau, psi = given.tau[:-1][at], given.psi[:-1][at]
        air = None
        if predictor.air_measured:
            air = (log["u_q"][:-1][at], log["v_q"][:-1][at])
        clean = [np.ascontiguousarray(c) for c in x.T]
        known = predictor.prepare(psi, [np.ascontiguousarray(c) for c in tau.T], air)
        base = predictor.evaluate_prepared(clean, known, np.empty((p, len(x))))
        change = np.zeros_like(base)
        buffer = np.empty_like(base)
        for s, level in enumerate(noise):
            for node, weight in zip(nodes, weights, strict=True):
                noisy = [c + level * node if j == s else c for j, c in enumerate(clean)]
                change += weight * (predictor.evaluate_prepared(noisy, known, buffer) - base)
        for i, (k, j) in rows.items():
            equation = evidence.equations[k]
            mine = list(equation.columns)
            part = equation.solution.projected[index][j, at]
            right[i] -= stride * float(part @ (evidence.theta[mine] @ change[mine]))
    bias = np.zeros(p)
    for equation in evidence.equations:
        mine = list(equation.columns)
        bias[mine] = scaled_inverse(equation.solution.information) @ right[mine]
    return bias


def _structure_theta(evidence: Evidence) -> Array:
    predictor = evidence.predictor
    theta = np.zeros(len(predictor.structure.terms))
    for i in predictor.parameter_columns:
        theta[predictor.structure.index(predictor.columns[i].terms[0])] = evidence.theta[i]
    return theta


def margin_bias(evidence: Evidence) -> TestResult:
    """Say in standard errors what the samples near a sign change can bias."""
    name, null = "margin_bias", "measurement noise near sign changes biases no parameter"
    predictor = evidence.predictor
    if not predictor.structure.marine:
        return not_applicable(name, null, "the structure has no modulus of measured velocities")
    if evidence.estimator.biased_by_noise:
        reason = "least squares is biased by noise in every regressor, see endogeneity"
        return not_applicable(name, null, reason)
    bias = noise_bias(evidence)
    if bias is None:
        reason = "a noise level is unknown, or the model cannot be simulated on the logs"
        return not_applicable(name, null, reason)
    std = evidence.std
    wanted = predictor.parameter_columns
    ratio = {
        predictor.columns[i].label: float(bias[i] / std[i]) if std[i] > 0 else 0.0 for i in wanted
    }
    worst = max(ratio, key=lambda n: abs(ratio[n]))
    hit = tuple(n for n, v in ratio.items() if abs(v) > TOLERATED_BIAS)
    return TestResult(
        name,
        null,
        abs(ratio[worst]),
        None,
        f"noise near sign changes biases the parameters, most {worst}, by {ratio[worst]:+.2f} "
        f"standard errors"
        + ("." if not hit else ": cut samples with --margin-u, --margin-v, or avoid sign changes."),
        TOLERATED_BIAS,
        not hit,
        hit,
        {"standard_errors": ratio},
    )
