"""Log determinants of matrices that are linear in lifted sums, with exact derivatives."""

from __future__ import annotations

from dataclasses import dataclass, field

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix

Array = NDArray[np.float64]

# smallest pivot of a correlation-scaled matrix that is taken as it is
_GUARD = 1e-11


@dataclass(frozen=True)
class LogDet:
    """weight · log |det X|, vec X = base + slope · ℓ; `positive` pivots come first."""

    weight: float
    slope: csc_matrix
    base: Array
    positive: int

    @property
    def size(self) -> int:
        """Rows of X."""
        return int(np.sqrt(len(self.base)) + 0.5)


@dataclass
class Affine:
    """A symmetric matrix under construction, affine in the lifted sums."""

    size: int
    rows: list[int] = field(default_factory=list)
    columns: list[int] = field(default_factory=list)
    values: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.base = np.zeros((self.size, self.size))

    def add(self, i: int, j: int, entry: int, weight: float) -> None:
        """Add weight · ℓ[entry] at (i, j) and (j, i)."""
        for a, b in {(i, j), (j, i)}:
            self.rows.append(b * self.size + a)
            self.columns.append(entry)
            self.values.append(weight)

    def add_constant(self, i: int, j: int, value: float) -> None:
        """Add a constant at (i, j) and (j, i)."""
        for a, b in {(i, j), (j, i)}:
            self.base[a, b] += value

    def term(self, weight: float, entries: int, positive: int) -> LogDet:
        """Return its weighted log determinant."""
        slope = csc_matrix((self.values, (self.rows, self.columns)), shape=(self.size**2, entries))
        return LogDet(weight, slope, self.base.ravel(order="F"), positive)


def _guarded(pivot: ca.SX) -> ca.SX:
    return (pivot + ca.sqrt(pivot**2 + 4 * _GUARD**2)) / 2


def determinant_factor(size: int, positive: int) -> ca.Function:
    """Return X ↦ (log |det X|, X⁻¹) through L D Lᵀ with guarded pivots of known sign."""
    x = ca.SX.sym("X", size, size)
    signs = [1.0] * positive + [-1.0] * (size - positive)
    low = ca.SX.eye(size)
    d: list[ca.SX] = []
    for j in range(size):
        scaled = ca.SX.zeros(1, j)
        for k in range(j):
            scaled[0, k] = low[j, k] * d[k]
        pivot = x[j, j] - (ca.dot(low[j, :j], scaled) if j else 0)
        d.append(signs[j] * _guarded(signs[j] * pivot))
        for i in range(j + 1, size):
            low[i, j] = (x[i, j] - (ca.dot(low[i, :j], scaled) if j else 0)) / d[j]
    inverse = ca.SX.eye(size)
    for j in range(size):
        for i in range(j + 1, size):
            inverse[i, j] = -ca.dot(low[i, j:i].T, inverse[j:i, j])
    v = ca.mtimes([inverse.T, ca.diag(1 / ca.vertcat(*d)), inverse])
    logdet = sum(ca.log(s * p) for s, p in zip(signs, d, strict=True))
    return ca.Function("factor", [x], [logdet, ca.densify(v)])
