"""Optimality criteria: D, A, E and c, of the covariance of the wanted parameters.

Every criterion is written as a number that grows with the information, in
logarithms, so that they share one scale: −log det C; −log of the mean and of the
largest relative variance; −log of the variance of one combination.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from experiment_design.criteria.objective import Objective, Slope
from experiment_design.criteria.optimality import CRITERIA, Optimality
from experiment_design.excitation.rollout import Motion
from experiment_design.information.moments import InformationModel, Moments, moments_of

Array = NDArray[np.float64]
# smallest eigenvalue of a correlation-scaled Gram matrix that counts as excited
_FLOOR = 1e-12


@dataclass(frozen=True)
class Criterion(Objective):
    """A scalar of the covariance C of the wanted parameters.

    Parameters
    ----------
    kind : str
        Name of the optimality: {"D", "A", "E", "c"}.
    wanted : tuple of int
        Positions of the wanted columns among all columns of the predictor.
    scale : ndarray
        (p_w,) unit of each wanted parameter in A and E, its prior magnitude.
    combination : ndarray
        (p_w,) gradient of the function of the parameters that ``c`` looks at.
    prior : ndarray, optional
        (p_w, p_w) information on the wanted parameters from earlier trials.
    """

    kind: str
    wanted: tuple[int, ...]
    scale: Array
    combination: Array
    prior: Array | None = None

    def __post_init__(self) -> None:
        # an unknown one is refused at once
        self.optimality  # noqa: B018

    @property
    def optimality(self) -> Optimality:
        """The scalar itself."""
        return CRITERIA[self.kind]

    @property
    def size(self) -> int:
        """Number of wanted parameters."""
        return len(self.wanted)

    @property
    def shared_by(self) -> int:
        """How many variances it counts together."""
        return self.optimality.shared_by(self.size)

    @property
    def directions(self) -> Array | None:
        """Directions (k, p_w) whose variances it adds up, None where it is no such sum."""
        return self.optimality.directions(self.scale, self.combination)

    def of_motion(
        self, motion: Motion, information: InformationModel, known: Moments | None
    ) -> Array:
        """Return the criterion of R motions, (R,)."""
        return self.value(moments_of(information, motion, known))

    def slope(self, motion: Motion, information: InformationModel, known: Moments | None) -> Slope:
        """Return the criterion of one motion, with its derivatives."""
        value, d_gram, d_score = self.gradient(moments_of(information, motion, known))
        state, tau = motion.state[0, :-1], motion.tau[0]
        nx = state.shape[1] - 3

        def pull() -> tuple[Array, Array, Array]:
            d_x, d_tau = information.gradient(state[:, :nx], state[:, nx], tau, d_gram, d_score)
            return d_x, d_tau, np.zeros_like(motion.commands[0])

        return Slope(value, pull)

    def covariance(self, moments: Moments) -> Array:
        """Return C, (R, p_w, p_w), prior included; infinite where a direction is not excited."""
        c, _, _, good = self._solve(moments)
        if good.any():
            c[good] = self._posterior(c[good])
        return c

    def _posterior(self, c: Array) -> Array:
        """Return (C⁻¹ + prior)⁻¹, as C (I + prior C)⁻¹."""
        if self.prior is None:
            return c
        d = np.sqrt(np.diagonal(c, axis1=1, axis2=2))
        outer = d[:, :, None] * d[:, None, :]
        unit, known = c / outer, self.prior * outer
        both = unit @ np.linalg.inv(np.eye(c.shape[1]) + known @ unit)
        return np.asarray((both + both.transpose(0, 2, 1)) / 2 * outer)

    def _solve(self, moments: Moments) -> tuple[Array, Array, Array, Array]:
        """Return C, the wanted rows W of G⁻¹, G⁻¹, and whether G could be inverted."""
        gram, score = moments.gram, moments.score_covariance
        size = np.sqrt(np.maximum(np.diagonal(gram, axis1=1, axis2=2), 0.0))
        safe = np.where(size > 0, size, 1.0)
        outer = safe[:, :, None] * safe[:, None, :]
        unit = gram / outer
        bad = ~np.isfinite(unit).all(axis=(1, 2)) | (size <= 0).any(axis=1)
        unit[bad] = np.eye(gram.shape[1])
        bad |= np.linalg.eigvalsh(unit)[:, 0] < _FLOOR
        unit[bad] = np.eye(gram.shape[1])
        inverse = np.linalg.inv(unit) / outer
        rows = inverse[:, list(self.wanted)]
        c = rows @ score @ rows.transpose(0, 2, 1)
        c = (c + c.transpose(0, 2, 1)) / 2
        c[bad] = np.inf
        return c, rows, inverse, ~bad

    def value(self, moments: Moments) -> Array:
        """Return the criterion of each sequence, (R,); −inf where a direction is not excited."""
        c, _, _, good = self._solve(moments)
        out = np.full(len(c), -np.inf)
        if good.any():
            out[good] = self.of_covariance(self._posterior(c[good]))
        return out

    def of_covariance(self, c: Array) -> Array:
        """Return the criterion of covariances (R, p_w, p_w)."""
        return self.optimality.of_covariance(c, self.scale, self.combination)

    def gradient(self, moments: Moments) -> tuple[float, Array, Array]:
        """Return the criterion of one sequence and its derivatives in G and M.

        Of what is climbed: a smooth stand-in where the criterion itself has kinks.
        """
        c, rows, inverse, good = self._solve(moments)
        p = moments.gram.shape[1]
        if not good[0]:
            return -np.inf, np.zeros((p, p)), np.zeros((p, p))
        own, w, g = c[0], rows[0], inverse[0]
        cov = self._posterior(c)[0]
        value = self.optimality.climbed(cov, self.scale, self.combination)
        gamma = self.optimality.slope(cov, self.scale, self.combination)
        if self.prior is not None:
            # d C_post = T dC Tᵀ with T = C_post C⁻¹ = (I + C prior)⁻¹
            carried = np.linalg.inv(np.eye(len(own)) + own @ self.prior)
            gamma = carried.T @ gamma @ carried
        d_score = w.T @ gamma @ w
        side = d_score @ moments.score_covariance[0] @ g
        return value, -(side + side.T), d_score
