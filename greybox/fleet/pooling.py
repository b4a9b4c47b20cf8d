"""Partial pooling of several estimates of the same coefficients, by a hierarchical model.

Each of k units, the ships of a class or the trials of one ship, gives an estimate with its
covariance,

    y_i ~ N(θ_i, C_i),    θ_i ~ N(X_i β, Ω),

where X_i = I for a class, whose mean is then β, or [I, t_i I] for what changes with time. Ω is
found by restricted maximum likelihood, θ_i by its posterior mean: the empirical Bayes estimate
of Efron and Morris (1975) with a covariance for every unit.

Ω is diagonal. A full one has p(p + 1)/2 unknowns, 171 for 18 coefficients, and k units give
p(k − 1) numbers to find them from, so it would be singular for every fleet of fewer ships than
coefficients. A diagonal one says that knowing in which coefficient a ship differs says nothing of
the others, keeps zero where the data show no spread, and changes with units as it should.

What Ω is uncertain by is not left out: standard errors of θ_i follow Prasad and Rao (1990) with
the term of Datta and Lahiri (2000), which generalises that of Morris (1983) to unequal covariances,
and intervals use Student's t with degrees of freedom after Satterthwaite (1946).

References
----------
Efron and Morris (1975), Data analysis using Stein's estimator, JASA 70; Morris (1983), Parametric
empirical Bayes inference, JASA 78; Prasad and Rao (1990), The estimation of the mean squared error
of small-area estimators, JASA 85; Datta and Lahiri (2000), Statistica Sinica 10; Gelman et al.
(2013), Bayesian Data Analysis, ch. 5; Harville (1977), Maximum likelihood approaches to variance
component estimation, JASA 72.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.stats import t as student

from greybox.errors import UsageError
from greybox.numerics.linalg import scaled_inverse

Array = NDArray[np.float64]

# change of the restricted log-likelihood, and its slope in coefficients of unit spread, at which
# the search ends: far below what any interval shows
_CHANGE, _SLOPE = 1e-12, 1e-7
# probability that an interval holds what it is of
LEVEL = 0.95


@dataclass(frozen=True)
class Pooled:
    """Several estimates of the same p coefficients, partially pooled.

    Parameters
    ----------
    estimates, covariances : ndarray
        (k, p) and (k, p, p) of each unit alone.
    design : ndarray
        (k, p, q) X_i.
    beta, beta_covariance : ndarray
        (q,) and (q, q) of the mean, what Ω is uncertain by left to `df`.
    omega : ndarray
        (p,) variances between the units.
    omega_covariance : ndarray
        (p, p) of `omega`, the inverse of its restricted information.
    theta, theta_covariance : ndarray
        (k, p) posterior means, and (k, p, p) their mean squared error, which holds what β and Ω
        are uncertain by.
    """

    estimates: Array
    covariances: Array
    design: Array
    beta: Array
    beta_covariance: Array
    omega: Array
    omega_covariance: Array
    theta: Array
    theta_covariance: Array

    @property
    def shrinkage(self) -> Array:
        """How far each estimate is drawn towards the mean, (k, p), from 0 (not) to 1 (wholly).

        C_jj/(C_jj + Ω_jj), coefficient by coefficient.
        """
        own = np.diagonal(self.covariances, axis1=1, axis2=2)
        return np.asarray(own / (own + self.omega))

    @property
    def theta_std(self) -> Array:
        """Standard errors of `theta`, (k, p)."""
        return np.asarray(np.sqrt(np.diagonal(self.theta_covariance, axis1=1, axis2=2)))

    @property
    def beta_std(self) -> Array:
        """Standard errors of `beta`, (q,)."""
        return np.asarray(np.sqrt(np.diag(self.beta_covariance)))

    @property
    def beta_slopes(self) -> Array:
        """Slope in each ω of the covariance that `beta` has with its present weights, (p, q, q)."""
        weights = np.linalg.inv(self.covariances + np.diag(self.omega))
        moves = np.einsum("qr,kjr,kjl->klq", self.beta_covariance, self.design, weights)
        return np.asarray(np.einsum("klq,klr->lqr", moves, moves))

    def beta_df(self) -> Array:
        """Return the degrees of freedom of each standard error in `beta`, (q,).

        Those of Satterthwaite: twice the square of a variance over the variance of its estimate.
        """
        slopes = np.einsum("jqq->qj", self.beta_slopes)
        variance = np.einsum("qj,jl,ql->q", slopes, self.omega_covariance, slopes)
        return degrees_of_freedom(np.diag(self.beta_covariance), variance)

    def beta_interval(self, level: float = LEVEL) -> Array:
        """Return the confidence interval of each of `beta`, (q, 2)."""
        reach = student.ppf((1 + level) / 2, self.beta_df()) * self.beta_std
        return np.column_stack([self.beta - reach, self.beta + reach])


def degrees_of_freedom(value: Array, variance: Array) -> Array:
    """Return Satterthwaite's degrees of freedom of estimated variances (...), at least 1.

    Parameters
    ----------
    value, variance : ndarray
        The estimated variances, and the variances of these.
    """
    # as many as make Student's t the normal distribution in every digit that is shown
    most = 1e6
    found = 2 * value**2 / np.maximum(variance, 2 * value**2 / most)
    return np.clip(found, 1.0, most)


def pool(estimates: Array, covariances: Array, design: Array | None = None) -> Pooled:
    """Pool estimates of the same coefficients partially, each as far as the others agree with it.

    Parameters
    ----------
    estimates : ndarray
        (k, p) of the units.
    covariances : ndarray
        (k, p, p) of the estimates, positive definite.
    design : ndarray, optional
        (k, p, q) regressors of the mean, q < kp; by default the same mean for all units.

    Returns
    -------
    Pooled

    Raises
    ------
    UsageError
        There are too few units for a variance between them, or shapes do not match.

    References
    ----------
    See the module.
    """
    estimates, covariances = np.asarray(estimates, float), np.asarray(covariances, float)
    units, size = estimates.shape
    x = np.broadcast_to(np.eye(size), (units, size, size)) if design is None else design
    if covariances.shape != (units, size, size) or x.shape[:2] != (units, size):
        raise UsageError(
            f"{units} estimates of {size} coefficients have covariances of shape "
            f"{covariances.shape}: give one ({size}, {size}) covariance for each."
        )
    if units * size <= x.shape[2]:
        raise UsageError(
            f"{units} estimates of {size} coefficients cannot tell {x.shape[2]} of their mean from "
            f"what differs between them: give at least {x.shape[2] // size + 1} estimates."
        )
    # coefficients of unit size, so that the search is the same in any units
    scale = np.sqrt(
        np.diagonal(covariances, axis1=1, axis2=2).mean(axis=0)
        + (estimates.var(axis=0, ddof=1) if units > 1 else 0.0)
    )
    ends = _ends(x, scale)
    y, c = estimates / scale, covariances / np.outer(scale, scale)
    x = x / scale[:, None] * ends
    omega = _restricted_likelihood(y, c, x)
    fit = _Fit(y, c, x, omega)
    omega_covariance = scaled_inverse(fit.information())
    theta, covariance = fit.posterior(omega_covariance)
    outer = np.outer(scale, scale)
    return Pooled(
        estimates,
        covariances,
        np.asarray(x * scale[:, None] / ends),
        fit.beta * ends,
        fit.beta_covariance * np.outer(ends, ends),
        omega * scale**2,
        omega_covariance * np.outer(scale**2, scale**2),
        theta * scale,
        covariance * outer,
    )


def _ends(x: Array, scale: Array) -> Array:
    """Return what each of β is measured in, (q,), so that its regressors have unit size."""
    size = np.sqrt(((x / scale[:, None]) ** 2).sum(axis=1).mean(axis=0))
    return np.asarray(1 / np.where(size > 0, size, 1.0))


class _Fit:
    """The generalised least-squares mean at a given Ω, and what follows from it."""

    def __init__(self, y: Array, c: Array, x: Array, omega: Array) -> None:
        self.c, self.x, self.omega = c, x, omega
        total = c + np.diag(omega)
        self.weights = np.linalg.inv(total)
        self._xw = x.transpose(0, 2, 1) @ self.weights
        gram = np.tensordot(self._xw, x, ((0, 2), (0, 1)))
        self.beta_covariance = np.linalg.inv(gram)
        self.beta = self.beta_covariance @ np.einsum("kql,kl->q", self._xw, y)
        self.residual = y - x @ self.beta
        self.score = np.einsum("kjl,kl->kj", self.weights, self.residual)
        self.loglik = -0.5 * float(
            np.linalg.slogdet(total)[1].sum()
            + np.linalg.slogdet(gram)[1]
            + (self.score * self.residual).sum()
        )

    def slope(self) -> Array:
        """Return the slope of the restricted log-likelihood in each ω, (p,)."""
        own = np.diagonal(self.weights, axis1=1, axis2=2)
        shared = ((self.beta_covariance @ self._xw) * self._xw).sum(axis=1)
        return np.asarray(0.5 * ((self.score**2) - own + shared).sum(axis=0))

    def information(self) -> Array:
        """Return the restricted information of the ω, (p, p): Harville (1977)."""
        w, b = self.weights, self.beta_covariance
        shared = self._xw.transpose(0, 2, 1) @ b @ self._xw
        # Σ over pairs of units of (W_i X_i B X_hᵀ W_h)²_jl, from sums over each unit
        moments = np.einsum("kqj,krj->jqr", self._xw, self._xw) @ b
        pairs = np.einsum("jqr,lrq->jl", moments, moments)
        return np.asarray(0.5 * ((w**2 - 2 * w * shared).sum(axis=0) + pairs))

    def posterior(self, omega_covariance: Array) -> tuple[Array, Array]:
        """Return θ (k, p) and its mean squared error (k, p, p)."""
        gain = self.omega[:, None] * self.weights
        rest = np.eye(len(self.omega)) - gain
        theta = self.x @ self.beta + np.einsum("kjl,kl->kj", gain, self.residual)
        known = rest * self.omega
        mean = rest @ self.x
        shared = mean @ self.beta_covariance @ mean.transpose(0, 2, 1)
        # the last term twice: once for the estimate, once for the bias of the first term
        spread = rest @ (omega_covariance * self.weights) @ rest.transpose(0, 2, 1)
        return theta, known + shared + 2 * spread


def _restricted_likelihood(y: Array, c: Array, x: Array) -> Array:
    """Return the variances between units (p,) of largest restricted likelihood."""

    def loss(omega: Array) -> tuple[float, Array]:
        fit = _Fit(y, c, x, omega)
        return -fit.loglik, -fit.slope()

    own = np.diagonal(c, axis1=1, axis2=2).mean(axis=0)
    start = np.maximum(y.var(axis=0, ddof=1) - own, own / len(y))
    found = minimize(
        loss, start, jac=True, method="L-BFGS-B", bounds=[(0.0, None)] * len(own),
        options={"ftol": _CHANGE, "gtol": _SLOPE, "maxiter": 1000},
    )  # fmt: skip
    return np.asarray(found.x)
