"""Sparse CasADi matrices put together from blocks at given places."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def to_dm(matrix: csc_matrix) -> ca.DM:
    """Return a SciPy matrix as a sparse CasADi one."""
    m = csc_matrix(matrix)
    m.sum_duplicates()
    m.sort_indices()
    sparsity = ca.Sparsity(m.shape[0], m.shape[1], m.indptr.tolist(), m.indices.tolist())
    return ca.DM(sparsity, m.data)


class Gatherer:
    """Nonzeros of a large sparse matrix as sums of nonzeros of small blocks."""

    def __init__(self, rows: int, columns: int, *, upper: bool = False) -> None:
        self.shape = (rows, columns)
        self.upper = upper
        self._places: list[Index] = []
        self._blocks: list[ca.MX] = []

    def add(self, rows: Index, columns: Index, values: ca.MX) -> None:
        """Add values (n,) at the positions given."""
        place = columns.astype(np.int64) * self.shape[0] + rows
        self._places.append(np.where(rows <= columns, place, -1) if self.upper else place)
        self._blocks.append(values)

    def matrix(self) -> ca.MX:
        """Return the matrix."""
        places = np.concatenate(self._places)
        sources = np.flatnonzero(places >= 0)
        unique, target = np.unique(places[sources], return_inverse=True)
        pick = csc_matrix(
            (np.ones(len(sources)), (target, sources)), shape=(len(unique), len(places))
        )
        rows, columns = unique % self.shape[0], unique // self.shape[0]
        sparsity = ca.Sparsity.triplet(*self.shape, rows.tolist(), columns.tolist())
        return ca.MX(sparsity, ca.mtimes(ca.MX(to_dm(pick)), ca.vertcat(*self._blocks)))


def coordinates(sparsity: ca.Sparsity) -> tuple[Index, Index]:
    """Return the rows and columns of the entries, in CasADi's order."""
    rows, columns = sparsity.get_triplet()
    return np.array(rows, dtype=np.int64), np.array(columns, dtype=np.int64)
