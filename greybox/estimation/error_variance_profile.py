"""How the variance of an equation error, and its covariance at lag one, change along a log.

To first order the error of (4.3) is e(k+1) − A(k) e(k) − S(k) n(k) with the slopes A, S of
the next state in what is measured. Where A is near one, what a slow instrument sums of it
is (1 − A(k)) e(k): small, and several times larger in some manoeuvres than in others. A
noise model that is alike everywhere takes the average and misses what an instrument that is
large in those manoeuvres sums.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from greybox.estimation.arma_noise import ARMANoise, NoiseFactor, fit_arma_noise
from greybox.model.predictor import Predictor
from greybox.regression.motion import further_channels, measured_slopes
from greybox.trial.log import TrialLog

Array = NDArray[np.float64]

# share of the measurement noise that steady noise has: where it is sought
_SHARES = (1e-7, 1e2)


class ErrorVarianceProfile:
    """The part of one equation's error on one log that measurement noise causes.

    Parameters
    ----------
    same, tie : ndarray
        (N,) variance, and covariance with the sample before.
    """

    def __init__(self, same: Array, tie: Array) -> None:
        self.same, self.tie = same, tie

    def factor(self, share: float) -> NoiseFactor | None:
        """Return the factor with steady noise of a share of the mean variance added."""
        from scipy.linalg.lapack import dpttrf

        whole = self.same + share * self.same.mean()
        if len(whole) < 2:
            return NoiseFactor(np.sqrt(whole), np.zeros(len(whole)))
        d, low, info = dpttrf(whole, self.tie[1:])
        return NoiseFactor(np.sqrt(d), np.append(0.0, low)) if info == 0 else None


def error_variance_profiles(
    predictor: Predictor,
    logs: Sequence[TrialLog],
    theta: Array,
    residuals: Sequence[Sequence[Array]],
    keep: Sequence[NDArray[np.bool_]],
) -> tuple[tuple[ErrorVarianceProfile, ...], ...]:
    """Return the variance profile of each equation's error on each log; empty where none is known.

    Parameters
    ----------
    predictor : Predictor
    logs : sequence of TrialLog
    theta : ndarray
        (p,) coefficients of all columns, which the slopes depend on.
    residuals : sequence over equations of sequence over logs of ndarray
        (N,), zero in rows that do not take part.
    keep : sequence of ndarray of bool
        (N,) per log.
    """
    nx = len(predictor.structure.states)
    slopes = [measured_slopes(predictor, log, theta) for log in logs]
    if not all(np.isfinite(s).all() for s in slopes):
        return tuple(() for _ in range(nx))
    follows = [np.append(False, k[1:] & k[:-1]) for k in keep]
    variances = np.zeros(slopes[0].shape[2])
    vessel = logs[0].vessel
    for i, state in enumerate(predictor.structure.states):
        stated = vessel.std(state)
        # neighbouring errors share a measurement, and nothing else that is white
        shared = -sum(float(e[1:] @ e[:-1]) for e in residuals[i])
        slope = sum(float(s[f, i, i].sum()) for s, f in zip(slopes, follows, strict=True))
        variances[i] = stated**2 if stated else max(shared / slope if slope > 0 else 0.0, 0.0)
    for j, name in enumerate(further_channels(predictor)):
        variances[nx + j] = (vessel.std("psi" if name == "psi" else "wind") or 0.0) ** 2
    found = []
    for i in range(nx):
        shapes = []
        for s, k, follow in zip(slopes, keep, follows, strict=True):
            same = variances[i] + s[:, i] ** 2 @ variances
            typical = float(same[k].mean()) if k.any() else 1.0
            same = np.where(k, same, typical)
            tie = np.where(follow, -s[:, i, i] * variances[i], 0.0)
            shapes.append(ErrorVarianceProfile(same, tie))
        found.append(tuple(shapes) if variances[i] > 0 else ())
    return tuple(found)


def fit_scaled_arma_noise(
    residuals: Sequence[Array],
    keep: Sequence[NDArray[np.bool_]],
    shapes: Sequence[ErrorVarianceProfile],
    regressors: Sequence[Array],
) -> ARMANoise:
    """Fit a noise model whose measurement noise has a shape along the log.

    How much steady noise there is beside follows from the restricted likelihood, which
    allows for what the coefficients took of the errors; what colour that leaves, from
    `fit_arma_noise`. Where the errors contradict the shape, the steady noise drowns it.

    Parameters
    ----------
    residuals : sequence of ndarray
        (N,) per log, zero in rows that do not take part.
    keep : sequence of ndarray of bool
    shapes : sequence of ErrorVarianceProfile
        Empty where none is told.
    regressors : sequence of ndarray
        (p, N) what the coefficients stand beside, without noise.

    References
    ----------
    Patterson and Thompson (1971).
    """
    if not shapes:
        return fit_arma_noise(residuals, keep)
    likelihood = _Restricted(residuals, keep, shapes, regressors)
    share, more = likelihood.fit()
    factors = likelihood.factors(share)
    if factors is None:
        return fit_arma_noise(residuals, keep)
    found = fit_arma_noise(residuals, keep, factors)
    further = likelihood.factors(more)
    if further is None:
        return found
    # a factor's scale means nothing: innovations of one size make the two models comparable
    left = [
        sum(float((f.solve(e) ** 2).sum()) for f, e in zip(each, residuals, strict=True))
        for each in (factors, further)
    ]
    scale = np.sqrt(left[1] / left[0])
    return found.beside(tuple(replace(f, root=f.root * scale) for f in further))


class _Restricted:
    """The likelihood of the share of steady noise, coefficients and constants integrated out."""

    def __init__(
        self,
        residuals: Sequence[Array],
        keep: Sequence[NDArray[np.bool_]],
        shapes: Sequence[ErrorVarianceProfile],
        regressors: Sequence[Array],
    ) -> None:
        self.shapes = shapes
        self.keep = keep
        size = np.sqrt(sum((z**2).sum(axis=1) for z in regressors))
        used = size > 0
        self.values = [
            np.vstack([k.astype(float), e, z[used] / size[used, None]])
            for e, k, z in zip(residuals, keep, regressors, strict=True)
        ]
        self.rows = sum(int(k.sum()) for k in keep)

    def factors(self, share: float) -> tuple[NoiseFactor, ...] | None:
        found = [s.factor(share) for s in self.shapes]
        return None if any(f is None for f in found) else tuple(f for f in found if f)

    def loss(self, share: float) -> float:
        factors = self.factors(share)
        if factors is None:
            return 1e100
        total, freedom = 0.0, self.rows
        q = len(self.values[0]) - 1
        gram = np.zeros((q, q))
        for factor, values, keep in zip(factors, self.values, self.keep, strict=True):
            if not keep.any():
                continue
            white = factor.solve(values)
            own = white @ white.T
            total += float(np.log(factor.root[keep]).sum()) + 0.5 * float(np.log(own[0, 0]))
            gram += own[1:, 1:] - np.outer(own[1:, 0], own[0, 1:]) / own[0, 0]
            freedom -= 1
        values, vectors = np.linalg.eigh(gram[1:, 1:])
        good = values > 1e-10 * values[-1] if len(values) else np.zeros(0, bool)
        taken = (vectors[:, good].T @ gram[1:, 0]) ** 2 / values[good]
        left = gram[0, 0] - float(taken.sum())
        freedom -= int(good.sum())
        total += 0.5 * float(np.log(values[good]).sum())
        return total + 0.5 * freedom * float(np.log(max(left, 1e-300)))

    def fit(self) -> tuple[float, float]:
        """Return the likeliest share, and the one a standard error above."""
        from scipy.optimize import brentq, minimize_scalar

        low, high = np.log(_SHARES)
        best = minimize_scalar(
            lambda p: self.loss(np.exp(p)), bounds=(low, high), method="bounded",
            options={"xatol": 0.02},
        )  # fmt: skip

        def above(p: float) -> float:
            return self.loss(float(np.exp(p))) - float(best.fun) - 0.5

        if above(high) <= 0:
            return float(np.exp(best.x)), float(np.exp(high))
        return float(np.exp(best.x)), float(np.exp(brentq(above, best.x, high, xtol=0.02)))
