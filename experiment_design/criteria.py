"""What is to be small: D, A, E and c criteria of the covariance of the wanted parameters.

Every criterion is written as a number that grows with the information, in
logarithms, so that they share one scale: −log det C; −log of the mean and of the
largest relative variance; −log of the variance of one combination.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from experiment_design.moments import Moments
from greybox.errors import UsageError

Array = NDArray[np.float64]
CriterionKind = Literal["D", "A", "E", "c"]
CRITERIA: tuple[CriterionKind, ...] = ("D", "A", "E", "c")
# smallest eigenvalue of a correlation-scaled Gram matrix that counts as excited
_FLOOR = 1e-12
# exponent of the norm that stands for the largest eigenvalue while climbing
_SHARP = 8


@dataclass(frozen=True)
class Criterion:
    """A scalar of the covariance C of the wanted parameters.

    Parameters
    ----------
    kind : {"D", "A", "E", "c"}
    wanted : tuple of int
        Positions of the wanted columns among all columns of the predictor.
    scale : ndarray
        (p_w,) unit of each wanted parameter in A and E, its prior magnitude.
    combination : ndarray
        (p_w,) gradient of the function of the parameters that ``c`` looks at.
    prior : ndarray, optional
        (p_w, p_w) information on the wanted parameters from earlier trials.
    """

    kind: CriterionKind
    wanted: tuple[int, ...]
    scale: Array
    combination: Array
    prior: Array | None = None

    def __post_init__(self) -> None:
        if self.kind not in CRITERIA:
            raise UsageError(
                f"there is no criterion '{self.kind}': use one of {', '.join(CRITERIA)}."
            )

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
        gram, score = moments.gram, moments.score
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
        if self.kind == "D":
            d = np.sqrt(np.diagonal(c, axis1=1, axis2=2))
            unit = c / (d[:, :, None] * d[:, None, :])
            sign, logdet = np.linalg.slogdet(unit)
            value = -logdet - 2 * np.log(d).sum(axis=1)
            return np.where(sign > 0, value, -np.inf)
        if self.kind == "c":
            h = self.combination
            return np.asarray(-np.log(np.einsum("i,rij,j->r", h, c, h)))
        relative = c / np.outer(self.scale, self.scale)
        if self.kind == "A":
            return np.asarray(-np.log(np.trace(relative, axis1=1, axis2=2) / len(self.scale)))
        return np.asarray(-np.log(np.linalg.eigvalsh(relative)[:, -1]))

    def gradient(self, moments: Moments) -> tuple[float, Array, Array]:
        """Return the criterion of one sequence and its derivatives in G and M.

        E is climbed as −log of the 8-norm of the eigenvalues, which is smooth.
        """
        c, rows, inverse, good = self._solve(moments)
        p = moments.gram.shape[1]
        if not good[0]:
            return -np.inf, np.zeros((p, p)), np.zeros((p, p))
        own, w, g = c[0], rows[0], inverse[0]
        cov = self._posterior(c)[0]
        value = float(self.of_covariance(cov[None])[0])
        if self.kind == "D":
            d = np.sqrt(np.diag(cov))
            gamma = -np.linalg.inv(cov / np.outer(d, d)) / np.outer(d, d)
        elif self.kind == "c":
            h = self.combination
            gamma = -np.outer(h, h) / float(h @ cov @ h)
        else:
            outer = np.outer(self.scale, self.scale)
            if self.kind == "A":
                gamma = -np.diag(1 / self.scale**2) / float(np.trace(cov / outer))
            else:
                values, vectors = np.linalg.eigh(cov / outer)
                share = values / values[-1]
                power = share ** (_SHARP - 1) / (share**_SHARP).sum() / values[-1]
                gamma = -(vectors * power) @ vectors.T / outer
                value = float(-np.log(values[-1]) - np.log((share**_SHARP).sum()) / _SHARP)
        if self.prior is not None:
            # d C_post = T dC Tᵀ with T = C_post C⁻¹ = (I + C prior)⁻¹
            carried = np.linalg.inv(np.eye(len(own)) + own @ self.prior)
            gamma = carried.T @ gamma @ carried
        d_score = w.T @ gamma @ w
        side = d_score @ moments.score[0] @ g
        return value, -(side + side.T), d_score
