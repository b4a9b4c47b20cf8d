"""The Cramér-Rao bound, and how far an estimate is from it and from the best instruments.

The information of the free run at given noises is that of the innovations of a
Kalman filter along the noise-free motion,

    F = Σ Ψ(k)ᵀ V(k)⁻¹ Ψ(k),

Ψ the sensitivities of the predicted outputs and V their covariance; without
process noise the filter's gain is 0 and Ψ are the sensitivities of the free run.
Initial states, mean currents and the moments of an unmeasured wind are nuisance.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from greybox.errors import DivergenceError, ExcitationError, GreyboxError
from greybox.estimation.bound import iv_bound
from greybox.estimation.innovations import FilterRuns
from greybox.estimation.output_error import log_rows, without_start
from greybox.estimation.output_setup import measured, output_model, output_predictor
from greybox.estimation.registry import ESTIMATORS
from greybox.estimation.result import Estimate
from greybox.estimation.shooting import Measured, Segments, cut
from greybox.estimation.values import EfficiencyBound
from greybox.model.noise import NoiseLevels
from greybox.model.output import OutputModel, Role
from greybox.model.run.output_runs import Simulator
from greybox.numerics.linalg import scaled, scaled_inverse, scaled_logdet
from greybox.trial.log import TrialLog

Array = NDArray[np.float64]

# an output that is measured without error would be known exactly
_LEAST = 1e-6
# relative eigenvalue below which the bound of a direction is no number
_RANK = 1e-13


def noise_variances(model: OutputModel, noise: NoiseLevels) -> Array:
    """Return the variances of the outputs and of what is added to each state a step.

    Returns
    -------
    ndarray
        (ny + nz,)
    """
    known = dict(zip(noise.states, noise.measurement, strict=True))
    known |= {"psi": noise.heading, "u_q": noise.wind, "v_q": noise.wind}
    pushed = dict(zip(noise.states, noise.process, strict=True))
    sigma = np.array([known[n] for n in model.outputs])
    return np.concatenate(
        [np.maximum(sigma, _LEAST) ** 2, np.array([pushed.get(n, 0.0) for n in model.states]) ** 2]
    )


def information(
    model: OutputModel, logs: Sequence[Measured], p: Array, starts: Array, noise: Array
) -> Array:
    """Return the information on the parameters, initial states being unknown.

    Parameters
    ----------
    model : OutputModel
    logs : sequence of Measured
        Their drivers and lengths are used; the motion is the model's own.
    p : ndarray
        (q,)
    starts : ndarray
        (M, nz) initial states.
    noise : ndarray
        (ny + nz,) variances of `noise_variances`.

    Returns
    -------
    ndarray
        (q, q)

    Raises
    ------
    DivergenceError
        The model's run leaves every bound.

    References
    ----------
    Ljung (1999), eqs. 7.91 and 9.24; Goodwin and Payne (1977), chapter 6.
    """
    whole = cut(logs, max(len(log.y) for log in logs))
    y, _ = Simulator(model, whole.w)(starts, p)
    if not np.isfinite(y).all() or np.abs(y).max() > 1e6:
        raise DivergenceError(
            "the free run of the estimate leaves every bound, so no Cramér-Rao bound can be "
            "computed there: use a smaller structure."
        )
    runs = FilterRuns(model, Segments(whole.w, y, whole.use, whole.joined), noise)
    total = np.zeros((len(p), len(p)))
    for rows, _ in log_rows(runs.rows(p, starts), runs.segments, len(p)):
        own = without_start(rows, len(p))
        total += own @ own.T
    return total


def cramer_rao(
    model: OutputModel, logs: Sequence[Measured], p: Array, starts: Array, noise: Array
) -> Array:
    """Return the Cramér-Rao bound on the covariance of unbiased estimates, (q, q).

    Parameters
    ----------
    model, logs, p, starts, noise
        As `information`.

    Raises
    ------
    ExcitationError
        Some direction of the parameters leaves the outputs unchanged.
    """
    f = information(model, logs, p, starts, noise)
    if not (np.diag(f) > 0).all():
        lost = [n for n, s in zip(model.parameters, np.diag(f), strict=True) if not s > 0]
        raise ExcitationError(
            f"{', '.join(lost)} leaves the run unchanged, so its bound is infinite: leave it out."
        )
    values, vectors = np.linalg.eigh(scaled(f)[0])
    if values[0] <= _RANK * values[-1]:
        worst = model.parameters[int(np.argmax(np.abs(vectors[:, 0])))]
        raise ExcitationError(
            f"the information is singular in {worst} (relative eigenvalue "
            f"{max(values[0] / values[-1], 0):.1e}, needs {_RANK:.0e}): leave it out."
        )
    return scaled_inverse(f)


def _limit(names: Sequence[str], bound: Array, covariance: Array) -> EfficiencyBound:
    free = np.diag(covariance) > 0
    if free.any() and not free.all():
        # what ended at its bound was not estimated
        names = [n for n, f in zip(names, free, strict=True) if f]
        bound = scaled_inverse(scaled_inverse(bound)[np.ix_(free, free)])
        covariance = covariance[np.ix_(free, free)]
    std = np.sqrt(np.diag(bound))
    reported = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    efficiency = np.where(reported > 0, (std / np.where(reported > 0, reported, 1.0)) ** 2, 0.0)
    determinant = 0.0
    if (reported > 0).all():
        logs = scaled_logdet(np.array([bound, covariance]))
        if np.isfinite(logs).all():
            determinant = float(np.exp((logs[0] - logs[1]) / len(names)))
    return EfficiencyBound(
        dict(zip(names, map(float, std), strict=True)),
        dict(zip(names, map(float, efficiency), strict=True)),
        determinant,
    )


def limits_of(
    estimate: Estimate, logs: Sequence[TrialLog]
) -> tuple[dict[str, EfficiencyBound], str]:
    """Compare an estimate's standard errors with the bounds at its own model and noises.

    Parameters
    ----------
    estimate : Estimate
        With its ``noise``.
    logs : sequence of TrialLog
        Those it was estimated on.

    Returns
    -------
    tuple
        ``cramer_rao`` and ``optimal_iv`` where they could be computed, and a
        sentence on what could not.
    """
    if estimate.noise is None:
        return {}, "no bounds: the estimate has no noise levels."
    names = estimate.predictor.parameter_names
    wanted = estimate.predictor.parameter_columns
    covariance = estimate.covariance[np.ix_(wanted, wanted)]
    found: dict[str, EfficiencyBound] = {}
    trouble = []
    try:
        bound = _parameter_bound(estimate, logs, estimate.noise)
        found["cramer_rao"] = _limit(names, bound, covariance)
    except GreyboxError as error:
        trouble.append(str(error))
    if not ESTIMATORS[estimate.method].free_run:
        try:
            theta = estimate.structure_theta()
            whole = iv_bound(estimate.predictor, logs, theta, estimate.noise)
            found["optimal_iv"] = _limit(names, whole[np.ix_(wanted, wanted)], covariance)
        except GreyboxError as error:
            trouble.append(str(error))
    return found, " ".join(trouble)


def _parameter_bound(estimate: Estimate, logs: Sequence[TrialLog], noise: NoiseLevels) -> Array:
    """Return the Cramér-Rao bound of the estimate's parameters, in their order."""
    own = estimate.predictor
    predictor = own
    free_run = ESTIMATORS[estimate.method].free_run
    if not free_run:
        predictor = output_predictor(own.structure, own.kind, own.regime)
    turns = own.structure.turns
    seen = turns and noise.heading > 0 and all("psi" in log for log in logs)
    heading: Role = "output" if seen else "input"
    model = output_model(predictor, estimate.sample_time, heading, integrator=estimate.integrator)
    p = np.zeros(len(model.parameters))
    theta = dict(zip(own.structure.parameters, estimate.structure_theta(), strict=True))
    for i in predictor.parameter_columns:
        p[i] = theta[predictor.columns[i].terms[0]]
    if free_run:
        p[: len(predictor.columns)] = estimate.theta
    current = {n: value for n, value, _ in estimate.current}
    for i, name in enumerate(model.means):
        p[len(predictor.columns) + i] = current.get(name, 0.0)
    data = [measured(model, log) for log in logs]
    nz = len(model.states)
    starts = np.array([log.y[:5, :nz].mean(axis=0) for log in data])
    bound = cramer_rao(model, data, p, starts, noise_variances(model, noise))
    place = {predictor.columns[i].name: i for i in predictor.parameter_columns}
    order = [place[n] for n in own.parameter_names]
    return bound[np.ix_(order, order)]
