"""Polish a sequence by direct multiple shooting with CasADi and IPOPT, exact Hessians.

Every stretch of a hold is one scalar-expanded function of its first state and
of the levels: it returns the state at its end, the path limits at its samples
and its share of the sums over samples. The sums are lifted: they are variables
of their own, tied to the sum of the shares. With a constant as one more
nuisance column of each equation the centred sums are a Schur complement, so
that the criterion is made of log determinants of matrices that are *linear* in
the lifted sums (G̃ and M̃ uncentred, n the nuisance columns, constants included):

    white R   −log det C = Σᵢ log det G̃ᵢ − log det G̃ᵢ,ₙₙ − |wᵢ| log σ²ᵢ
    exact R   −log det C = 2 Σᵢ log det G̃ᵢ − log |det [[M̃, G̃ₙ], [G̃ₙᵀ, 0]]|

the latter by the complementary minors of C⁻¹ = G̃ M̃⁻¹ G̃. A log determinant of a
linear X(ℓ) has gradient Tᵀ vec X⁻¹ and Hessian −Tᵀ (X⁻¹ ⊗ X⁻¹) T. For A and c the
solves G̃ x = h are lifted as well.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix

from experiment_design.limits import UNIT_SCALE
from experiment_design.moments import MomentProgram, Moments
from experiment_design.problem import TrialProblem
from experiment_design.rollout import force_vector
from experiment_design.search import Candidate, assess, limit_scale, to_unit
from greybox.errors import UsageError

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# most columns for which M is lifted as well; its entries grow with their square
EXACT_COLUMNS = 20
# samples a shooting interval has at most: longer holds are cut
_LONGEST = 15
# smallest pivot of a correlation-scaled matrix that is taken as it is
_GUARD = 1e-11
# scaled units by which the limits are kept more strictly than asked
_INSIDE = 2e-3


class Outcome(Enum):
    """How a polish ended."""

    CONVERGED = "IPOPT converged to a local optimum."
    ACCEPTABLE = "IPOPT converged to its acceptable tolerance."
    ITERATIONS = "IPOPT used up its iterations; the best iterate was kept."
    TIME = "IPOPT used up its time; the best iterate was kept."
    INTERRUPTED = "IPOPT was interrupted; the best iterate was kept."
    INFEASIBLE = "IPOPT found no sequence near this one that keeps all limits."
    FAILED = "IPOPT stopped early; the best iterate was kept."
    REFUSED = "IPOPT was not tried."


_STATUS = {
    "Solve_Succeeded": Outcome.CONVERGED,
    "Solved_To_Acceptable_Level": Outcome.ACCEPTABLE,
    "Feasible_Point_Found": Outcome.ACCEPTABLE,
    "Maximum_Iterations_Exceeded": Outcome.ITERATIONS,
    "Maximum_CpuTime_Exceeded": Outcome.TIME,
    "Maximum_WallTime_Exceeded": Outcome.TIME,
    "User_Requested_Stop": Outcome.INTERRUPTED,
    # what CasADi makes of Ctrl-C inside IPOPT
    "NonIpopt_Exception_Thrown": Outcome.INTERRUPTED,
    "Infeasible_Problem_Detected": Outcome.INFEASIBLE,
    "Restoration_Failed": Outcome.INFEASIBLE,
}


@dataclass(frozen=True)
class Polished(Candidate):
    """A candidate that IPOPT has looked at.

    Parameters
    ----------
    outcome : Outcome
    status : str
        What happened, one sentence or two.
    iterations : int
        Of IPOPT.
    seconds : float
        Building and solving.
    """

    outcome: Outcome = Outcome.REFUSED
    status: str = ""
    iterations: int = 0
    seconds: float = 0.0

    def __post_init__(self) -> None:
        if not self.status:
            object.__setattr__(self, "status", self.outcome.value)


@dataclass(frozen=True)
class _LogDet:
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
class _Affine:
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

    def term(self, weight: float, entries: int, positive: int) -> _LogDet:
        """Return its weighted log determinant."""
        slope = csc_matrix((self.values, (self.rows, self.columns)), shape=(self.size**2, entries))
        return _LogDet(weight, slope, self.base.ravel(order="F"), positive)


def _guarded(pivot: ca.SX) -> ca.SX:
    return (pivot + ca.sqrt(pivot**2 + 4 * _GUARD**2)) / 2


def _factor(size: int, positive: int) -> ca.Function:
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


def _dm(matrix: csc_matrix) -> ca.DM:
    m = csc_matrix(matrix)
    m.sum_duplicates()
    m.sort_indices()
    sparsity = ca.Sparsity(m.shape[0], m.shape[1], m.indptr.tolist(), m.indices.tolist())
    return ca.DM(sparsity, m.data)


class _Gatherer:
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
        return ca.MX(sparsity, ca.mtimes(ca.MX(_dm(pick)), ca.vertcat(*self._blocks)))


def _coordinates(sparsity: ca.Sparsity) -> tuple[Index, Index]:
    rows, columns = sparsity.get_triplet()
    return np.array(rows, dtype=np.int64), np.array(columns, dtype=np.int64)


@dataclass(frozen=True)
class _Terminal:
    """The criterion as a function of the tail of the variables: lifted sums and what it adds.

    Parameters
    ----------
    extra, constraints : int
        Variables and constraints that it adds.
    first : callable
        tail ↦ value to be minimised, its gradient, constraints, their Jacobian.
    second : callable
        tail, multipliers ↦ Hessian of the Lagrangian.
    begin : callable
        Lifted sums ↦ the added variables.
    """

    extra: int
    constraints: int
    first: Callable[..., Any]
    second: Callable[..., Any]
    begin: Callable[[Array], Array]


class _Iterates(ca.Callback):
    """Keeps the levels of every iterate, so that an interrupt loses nothing."""

    def __init__(self, variables: int, constraints: int, levels: int) -> None:
        ca.Callback.__init__(self)
        self._sizes = {"x": variables, "g": constraints, "f": 1, "lam_x": variables}
        self._sizes["lam_g"] = constraints
        self._levels = levels
        self.seen: list[Array] = []
        self.construct("iterates", {})

    def get_n_in(self) -> int:
        return int(ca.nlpsol_n_out())

    def get_n_out(self) -> int:
        return 1

    def get_name_in(self, i: int) -> str:
        return str(ca.nlpsol_out(i))

    def get_name_out(self, i: int) -> str:
        return "ret"

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        n = self._sizes.get(str(ca.nlpsol_out(i)), 0)
        return ca.Sparsity.dense(n, 1) if n else ca.Sparsity(0, 0)

    def eval(self, arg: Sequence[ca.DM]) -> list[int]:
        self.seen.append(np.array(arg[0][: self._levels], dtype=float).ravel())
        return [0]


class Shooting:
    """The nominal scenario of a trial problem as one nonlinear program.

    Only the first scenario is solved for; `solve_ipopt` judges what comes out by
    all of them.

    Parameters
    ----------
    problem : TrialProblem
        With a `MomentProgram` as its yardstick and a D, A or c criterion.
    unit : ndarray
        (K, nc) a typical sequence, which gives the variables their scales.
    exact : bool, optional
        Climb the exact criterion rather than that of white equation errors; by
        default where the predictor has at most `EXACT_COLUMNS` columns.

    Raises
    ------
    UsageError
        The yardstick or the criterion has no such program.
    """

    def __init__(self, problem: TrialProblem, unit: Array, exact: bool | None = None) -> None:
        scenario = problem.scenarios[0]
        yardstick = scenario.yardstick
        if not isinstance(yardstick, MomentProgram):
            raise UsageError(
                f"IPOPT polishes designs for the zero-mean IV estimate, and this one is judged by "
                f"{type(yardstick).__name__}: use the ascent (search.ascend)."
            )
        if problem.criterion.kind == "E":
            raise UsageError(
                "IPOPT polishes D, A and c designs, and the largest variance (E) is not smooth: "
                "use the ascent (search.ascend), or --criterion A."
            )
        self.problem = problem
        self.yardstick = yardstick
        self.rollout = scenario.rollout
        self.limits = scenario.limits
        self.schedule = problem.schedule
        small = yardstick.columns <= EXACT_COLUMNS
        self.exact = not yardstick.white and (small if exact is None else exact)
        self.nc = problem.shape[1]
        self._choose_states()
        self._cut()
        self._measure(unit)
        self._heading_pair = self._choose_headings(unit)
        self._index_sums()
        self._build()

    # -- scales and positions ---------------------------------------------------------------

    def _choose_states(self) -> None:
        """Leave positions out of the nodes where no limit looks at them."""
        nx = self.rollout.nx
        state = self.rollout.symbols[0]
        self.ends = list(zip(self.limits.end_names, self.limits.end_values, strict=True))
        used = {place for _, (place, _) in self.ends}
        if self.limits.path.numel():
            where = ca.which_depends(self.limits.path, state, 1, False)
            used |= {i for i, on in enumerate(where) if on}
        places = used & {nx + 1, nx + 2}
        self.kept = [*range(nx + 1), *([nx + 1, nx + 2] if places else [])]

    def _measure(self, unit: Array) -> None:
        """Take the scales of states and columns from the motion of a typical sequence."""
        y = self.yardstick
        state, tau = self._motion(unit)
        floor = np.array([1.0] * self.rollout.nx + [1.0, 10.0, 10.0])
        for i, name in enumerate(self.rollout.structure.states):
            floor[i] = 10 * UNIT_SCALE["rad/s" if name == "r" else "m/s"]
        self.state_scale = np.maximum(np.abs(state).max(axis=0), floor)[self.kept]
        z, a = self._columns(state, tau)
        self.shift = z.mean(axis=1)
        size = np.sqrt(((z - self.shift[:, None]) ** 2).sum(axis=1))
        self.size = np.where(size > 1e-9 * np.abs(z).max(axis=1).clip(1e-300), size, 1.0)
        self.spread = np.maximum((a**2).sum(axis=1) @ y.channel_std**2, 1e-300)
        self._start_z, self._start_a = (z - self.shift[:, None]) / self.size[:, None], a

    def _columns(self, state: Array, tau: Array) -> tuple[Array, Array]:
        """Return regressors (p, N) and slopes (nx, N, channels)."""
        y, nx, samples = self.yardstick, self.rollout.nx, self.schedule.samples
        columns = ca.Function("columns", list(y.symbols), list(y.expressions)).map(samples)
        z, a = columns(state[:-1, :nx].T, state[:-1, nx][None], tau.T)
        return np.array(z), np.array(a).reshape(nx, samples, -1)

    def _motion(self, unit: Array) -> tuple[Array, Array]:
        motion = self.rollout.run(self.schedule.expand(self.problem.levels(unit))[None])
        state = motion.state[0].copy()
        if not motion.stable[0]:
            state[:] = np.append(self.rollout.start, [0.0, 0.0])
        return state, motion.tau[0]

    def _choose_headings(self, unit: Array) -> tuple[int, int] | None:
        """Return the nodes at which the typical sequence heads furthest apart."""
        if self.limits.limits.headings is None:
            return None
        state, _ = self._motion(unit)
        psi = state[self._node_samples(), self.rollout.nx]
        return int(psi.argmax()), int(psi.argmin())

    def _node_samples(self) -> list[int]:
        """Return the sample of each node, the end included."""
        s = self.schedule
        out = [k * s.hold + int(p[0]) for k, p in self.intervals]
        return [*out, s.samples]

    def _index_sums(self) -> None:
        """Give each lifted sum its place among the variables."""
        y = self.yardstick
        samples = self.schedule.samples
        self.blocks = [list(e) for e in y.equations]
        # every equation's columns with its constant first
        self.order: list[tuple[int, int | None]] = []
        for i, mine in enumerate(self.blocks):
            self.order += [(i, None), *[(i, c) for c in mine]]
        self.gram_at: dict[tuple[int, int], int] = {}
        first = 0
        for mine in self.blocks:
            for j in range(len(mine) + 1):
                for k in range(j + 1):
                    if j:
                        self.gram_at[first + k, first + j] = len(self.gram_at)
            first += len(mine) + 1
        self.grams = len(self.gram_at)
        all_columns = len(self.order)
        if self.exact:
            s = self._scores(self._start_z, self._start_a)
            self.score_scale = 1 / np.sqrt(np.maximum((s**2).sum(axis=(1, 2)), 1e-300))
            self.others = all_columns * (all_columns + 1) // 2
        else:
            self.others = len(self.blocks)
        self.lifted = self.grams + self.others
        self.wanted = set(self.problem.criterion.wanted)
        process = y.process**2
        self.floor_variance = np.array(
            [
                process[i]
                + sum(
                    std**2
                    for std, own in zip(y.channel_std, y.channel_own, strict=True)
                    if own == i
                )
                for i in range(len(self.blocks))
            ]
        )
        self.mean_spread = self.spread / samples

    def _scores(self, z: Array, a: Array) -> Array:
        """Return the scores of the extended columns at the start, (P, channels, N+1)."""
        y = self.yardstick
        samples = z.shape[1]
        out = np.zeros((len(self.order), len(y.channel_std), samples + 1))
        for p, (i, c) in enumerate(self.order):
            row = np.full(samples, 1 / np.sqrt(samples)) if c is None else z[c]
            for h, (std, own) in enumerate(zip(y.channel_std, y.channel_own, strict=True)):
                out[p, h, :-1] -= std * a[i, :, h] * row
                if own == i:
                    out[p, h, 1:] += std * row
        return out

    def _sums(self, z: Array, a: Array) -> Array:
        """Return the lifted sums (L,) of scaled regressors and slopes."""
        y = self.yardstick
        constant = np.full(z.shape[1], 1 / np.sqrt(z.shape[1]))
        rows = np.array([constant if c is None else z[c] for _, c in self.order])
        gram = rows @ rows.T
        out = [gram[p, q] for p, q in self.gram_at]
        if not self.exact:
            return np.concatenate([out, (a**2).sum(axis=1) @ y.channel_std**2 / self.spread])
        s = self._scores(z, a).reshape(len(rows), -1) * self.score_scale[:, None]
        score = s @ s.T
        return np.array(out + [score[p, q] for q in range(len(rows)) for p in range(q + 1)])

    # -- criterion in the lifted sums -------------------------------------------------------

    def _known(self) -> Moments | None:
        return self.problem.known[0] if self.problem.known else None

    def _gram_block(self, which: list[int], matrix: _Affine, at: list[int]) -> None:
        """Write G̃ of the extended columns `which` at rows `at`."""
        known = self._known()
        for b, q in zip(at, which, strict=True):
            for a, p in zip(at, which, strict=True):
                if p > q:
                    continue
                self._gram_entry(matrix, a, b, p, q, 1.0, known)

    def _gram_entry(
        self, matrix: _Affine, a: int, b: int, p: int, q: int, weight: float,
        known: Moments | None,
    ) -> None:  # fmt: skip
        if p > q:
            p, q = q, p
        (i, c), (j, d) = self.order[p], self.order[q]
        if i != j:
            return
        if (p, q) in self.gram_at:
            matrix.add(a, b, self.gram_at[p, q], weight)
        else:
            matrix.base[a, b] += weight
            if a != b:
                matrix.base[b, a] += weight
        if known is not None and c is not None and d is not None:
            value = weight * known.gram[0, c, d] / (self.size[c] * self.size[d])
            matrix.base[a, b] += value
            if a != b:
                matrix.base[b, a] += value

    def _terms(self) -> tuple[list[_LogDet], float]:
        """Return −log det C as weighted log determinants and a constant."""
        terms: list[_LogDet] = []
        constant = float(2 * np.log(self.size[sorted(self.wanted)]).sum())
        nuisance_all: list[int] = []
        first = 0
        for i, mine in enumerate(self.blocks):
            everything = list(range(first, first + len(mine) + 1))
            first += len(mine) + 1
            nuisance = [p for p in everything if self.order[p][1] not in self.wanted]
            nuisance_all += nuisance
            ordered = nuisance + [p for p in everything if p not in nuisance]
            if len(ordered) == len(nuisance) and not self.exact:
                continue
            whole = _Affine(len(ordered))
            self._gram_block(ordered, whole, list(range(len(ordered))))
            terms.append(whole.term(2.0 if self.exact else 1.0, self.lifted, len(ordered)))
            if self.exact:
                continue
            if len(nuisance) > 1:
                rest = _Affine(len(nuisance))
                self._gram_block(nuisance, rest, list(range(len(nuisance))))
                terms.append(rest.term(-1.0, self.lifted, len(nuisance)))
            variance = _Affine(1)
            variance.base[0, 0] = self.floor_variance[i] / self.mean_spread[i]
            variance.add(0, 0, self.grams + i, 1.0)
            count = len(self.wanted & set(mine))
            terms.append(variance.term(-float(count), self.lifted, 1))
            constant -= count * float(np.log(self.mean_spread[i]))
        if self.exact:
            terms.append(self._border(nuisance_all))
            constant += 2 * float(np.log(self.score_scale).sum())
        return terms, constant

    def _border(self, nuisance: list[int]) -> _LogDet:
        size, known = len(self.order), self._known()
        matrix = _Affine(size + len(nuisance))
        scale = self.score_scale
        self._score_block(matrix, scale)
        for a, n in enumerate(nuisance):
            for p in range(size):
                self._gram_entry(matrix, p, size + a, p, n, float(scale[p]), known)
        return matrix.term(-1.0, self.lifted, size)

    def _score_block(self, matrix: _Affine, scale: Array) -> None:
        """Write M̃, rows and columns scaled, into the leading block."""
        size, known = len(self.order), self._known()
        process = self.yardstick.process**2
        entry = self.grams
        for q in range(size):
            for p in range(q + 1):
                ratio = scale[p] * scale[q] / (self.score_scale[p] * self.score_scale[q])
                matrix.add(p, q, entry, float(ratio))
                entry += 1
                (i, c), (_, d) = self.order[p], self.order[q]
                weight = float(process[i] * scale[p] * scale[q])
                if weight:
                    self._gram_entry(matrix, p, q, p, q, weight, None)
                if known is not None and c is not None and d is not None:
                    value = scale[p] * scale[q] * known.score[0, c, d]
                    value /= self.size[c] * self.size[d]
                    matrix.base[p, q] += value
                    if p != q:
                        matrix.base[q, p] += value

    # -- the nonlinear program --------------------------------------------------------------

    def _cut(self) -> None:
        """Cut the holds into shooting intervals."""
        s = self.schedule
        self._share = np.minimum(1.0, (np.arange(s.hold) + 1)[:, None] / np.array(s.ramp))
        pieces = np.array_split(np.arange(s.hold), -(-s.hold // _LONGEST))
        # hold, and samples of it, of each interval
        self.intervals: list[tuple[int, Index]] = []
        for k in range(s.holds):
            left = s.samples - k * s.hold
            self.intervals += [(k, p[p < left]) for p in pieces if (p < left).any()]
        self.ramped = max(s.ramp) > 1
        self.energy = self.limits.limits.energy is not None

    def _build(self) -> None:
        self.levels = self.schedule.holds * self.nc
        self.nodes_at = self.levels
        self.sums_at = self.levels + len(self.kept) * (len(self.intervals) + 1)
        closed = self.problem.criterion.kind == "D"
        self._terminal = self._terminal_closed() if closed else self._terminal_solved()
        self.variables = self.sums_at + self.lifted + self._terminal.extra
        self._assemble()

    def _interval(self, n: int) -> tuple[ca.Function, ca.Function, ca.Function]:
        """Return value, Jacobian and weighted Hessian of an interval of n samples."""
        s, y, r = self.schedule, self.yardstick, self.rollout
        nx = r.nx
        commands = r.symbols[1]
        columns = ca.Function("columns", list(y.symbols), list(y.expressions))
        step = ca.Function("step", list(r.symbols), [r.step])
        force = ca.Function("force", [commands], [force_vector(r.vessel, r.structure, commands)])
        path = ca.Function("path", [r.symbols[0]], [self.limits.path])
        node = ca.SX.sym("node", len(self.kept))
        now, before, after = (ca.SX.sym(name, self.nc) for name in ("now", "before", "after"))
        shares = ca.SX.sym("share", self.nc, n)
        mix, flags = ca.SX.sym("mix", self.nc, 3), ca.SX.sym("flags", 2)
        span = ca.DM(s.upper - s.lower)
        real = [ca.DM(s.lower) + span * level for level in (before, now, after)]
        state = ca.SX.zeros(nx + 3)
        for i, k in enumerate(self.kept):
            state[k] = node[i] * self.state_scale[i]

        def rows(x: ca.SX, c: ca.SX) -> tuple[list[ca.SX], ca.SX]:
            z, a = columns(x[:nx], x[nx], force(c))
            z = (z - ca.DM(self.shift)) / ca.DM(self.size)
            constant = ca.SX(1 / np.sqrt(s.samples))
            return [constant if p is None else z[p] for _, p in self.order], a

        def score(old: list[ca.SX] | None, new: list[ca.SX] | None, a: ca.SX) -> list[list[ca.SX]]:
            """Return Z(k−1) − Z(k)A(k), each noise by its standard deviation."""
            out = []
            for h, (std, own) in enumerate(zip(y.channel_std, y.channel_own, strict=True)):
                column = []
                for p, (i, _) in enumerate(self.order):
                    value = -a[i, h] * new[p] if new is not None else ca.SX(0)
                    if own == i and old is not None:
                        value = value + old[p]
                    column.append(value * (float(std) * self.score_scale[p]))
                out.append(column)
            return out

        regressors: list[list[ca.SX]] = []
        scores: list[list[ca.SX]] = []
        squares = [ca.SX(0)] * len(self.blocks)
        used, kept_path = ca.SX(0), []
        for t in range(n):
            c = real[0] + shares[:, t] * (real[1] - real[0]) if self.ramped else real[1]
            z, a = rows(state, c)
            if not self.exact:
                for i in range(len(self.blocks)):
                    square = ca.sumsqr(a[i, :].T * ca.DM(y.channel_std))
                    squares[i] += square / float(self.spread[i])
            elif regressors:
                scores += score(regressors[-1], z, a)
            else:
                # the very first sample has no predecessor
                scores += [[flags[0] * e for e in column] for column in score(None, z, a)]
            regressors.append(z)
            state = step(state, c)
            if self.limits.path_names:
                kept_path.append(path(state) / ca.DM(self.limits.path_scale))
            if self.energy:
                for place, full in self.limits.speeds:
                    used += ca.fabs(c[place] / full) ** 3
        if self.exact:
            c = real[1] * mix[:, 1] + real[2] * mix[:, 2]
            if self.ramped:
                c = c + real[0] * mix[:, 0]
            z, a = rows(state, c)
            scores += score(regressors[-1], [flags[1] * e for e in z], a)
        ends = [ca.vertcat(*[state[k] for k in self.kept]) / ca.DM(self.state_scale), *kept_path]
        single = [] if self.exact else squares
        if self.energy:
            single.append(used / (s.samples * len(self.limits.speeds)))
        first, last = ca.vertcat(*ends), ca.vertcat(*single)
        score_at = {
            (p, q): q * (q + 1) // 2 + p for q in range(len(self.order)) for p in range(q + 1)
        }
        quadratic: list[tuple[dict[tuple[int, int], int], list[list[ca.SX]]]]
        quadratic = [(self.gram_at, regressors)] + [(score_at, scores)] * self.exact
        weights = ca.SX.sym("w", first.numel() + self.lifted + self.energy)
        sums: list[ca.SX] = []
        passed = first.numel()
        # what is weighted is Σ zᵀ W z, whose slope is 2 W z carried back along z
        seeds, seeded = [weights[:passed]], [first]
        for entries, vectors in quadratic:
            total = [ca.SX(0)] * len(entries)
            inner = ca.SX(len(self.order), len(self.order))
            for (p, q), entry in entries.items():
                for v in vectors:
                    total[entry] += v[p] * v[q]
                inner[p, q] += weights[passed + entry]
                inner[q, p] += weights[passed + entry]
            for v in vectors:
                seeded.append(ca.vertcat(*v))
                seeds.append(ca.mtimes(inner, seeded[-1]))
            sums.extend(total)
            passed += len(entries)
        seeds.append(weights[passed:])
        seeded.append(last)
        outputs = ca.vertcat(first, *sums, last)
        seen = [node, now] + [before] * self.ramped + [after] * self.exact
        arguments = ca.vertcat(*seen)
        known = ca.vertcat(ca.vec(shares), ca.vec(mix), flags)
        slope = ca.jtimes(ca.vertcat(*seeded), arguments, ca.vertcat(*seeds), True)
        curves = ca.triu(ca.jacobian(slope, arguments))
        return (
            ca.Function("value", [arguments, known], [outputs]),
            ca.Function("slopes", [arguments, known], [ca.jacobian(outputs, arguments)]),
            ca.Function("curves", [arguments, known, weights], [curves]),
        )

    def _assemble(self) -> None:
        """Write objective, constraints, Jacobian and Hessian as MX over mapped intervals."""
        nk = len(self.kept)
        w = ca.MX.sym("w", self.variables)
        path = len(self.limits.path_names)
        count = len(self.intervals)
        sums = self.lifted + self.energy
        starts = np.cumsum([0, *[len(p) * path for _, p in self.intervals]])
        continuity, paths = 0, nk * count
        ties = paths + int(starts[-1])
        linear, lower, upper = self._linear()
        rates = ties + sums
        extra_at = rates + linear.shape[0]
        rows = extra_at + self._terminal.constraints
        groups: dict[int, list[int]] = {}
        for k, (_, p) in enumerate(self.intervals):
            groups.setdefault(len(p), []).append(k)
        g_rows: list[tuple[Index, ca.MX]] = []
        multipliers = ca.MX.sym("lam_g", rows)
        gather = _Gatherer(rows, self.variables)
        curve = _Gatherer(self.variables, self.variables, upper=True)
        for n, members in groups.items():
            value, jac, hess = self._interval(n)
            index = np.array([self._arguments(k) for k in members]).T
            known = np.array([self._parameters(k) for k in members]).T
            m = len(members)
            y = ca.reshape(w[index.ravel(order="F").tolist()], index.shape[0], m)
            target = np.array(
                [
                    np.concatenate(
                        [
                            continuity + k * nk + np.arange(nk),
                            paths + starts[k] + np.arange(n * path),
                            ties + np.arange(sums),
                        ]
                    )
                    for k in members
                ]
            ).T
            shares = value.map(m)(y, known)
            # a tie is lifted − Σ shares; the energy is +Σ
            sign = np.ones(target.shape[0])
            sign[nk + n * path : nk + n * path + self.lifted] = -1.0
            g_rows.append((target, ca.DM(sign) * shares))
            r, c = _coordinates(jac.sparsity_out(0))
            places = target[r].ravel(order="F"), index[c].ravel(order="F")
            slopes = ca.vec(ca.MX(jac.map(m)(y, known)).nz[:])
            gather.add(*places, slopes * np.tile(sign[r], m))
            r, c = _coordinates(hess.sparsity_out(0))
            weights = multipliers[target.ravel(order="F").tolist()]
            weights = ca.reshape(weights, *target.shape) * ca.DM(sign)
            curves = ca.vec(ca.MX(hess.map(m)(y, known, weights)).nz[:])
            i, j = index[r].ravel(order="F"), index[c].ravel(order="F")
            # one entry stands for both halves, which meet where two arguments are one variable
            twice = 1.0 + ((i == j) & np.tile(r != c, m))
            curve.add(np.minimum(i, j), np.maximum(i, j), curves * twice)
        # nodes and lifted sums enter their constraints linearly
        follow = np.arange(nk * count)
        gather.add(continuity + follow, self.nodes_at + nk + follow, ca.MX(-ca.DM.ones(nk * count)))
        lift = np.arange(self.lifted)
        gather.add(ties + lift, self.sums_at + lift, ca.MX(ca.DM.ones(self.lifted)))
        if linear.shape[0]:
            coo = linear.tocoo()
            gather.add(
                rates + coo.row.astype(np.int64), coo.col.astype(np.int64), ca.MX(ca.DM(coo.data))
            )
        tail = w[self.sums_at :]
        f, slope, extra, extra_jac = self._terminal.first(tail)
        r, c = _coordinates(extra_jac.sparsity())
        if len(r):
            gather.add(extra_at + r, self.sums_at + c, ca.vec(extra_jac.nz[:]))
        sigma = ca.MX.sym("lam_f")
        end = self._terminal.second(tail, sigma, multipliers[extra_at:])
        r, c = _coordinates(end.sparsity())
        curve.add(self.sums_at + r, self.sums_at + c, ca.vec(end.nz[:]))
        into = np.concatenate([t.ravel(order="F") for t, _ in g_rows])
        ones = np.ones(len(into))
        pick = csc_matrix((ones, (into, np.arange(len(into)))), shape=(rates, len(into)))
        g = ca.mtimes(ca.MX(_dm(pick)), ca.vertcat(*[ca.vec(v) for _, v in g_rows]))
        shift = ca.vertcat(
            w[self.nodes_at + nk : self.sums_at],
            ca.MX.zeros(int(starts[-1])),
            -w[self.sums_at : self.sums_at + self.lifted],
            ca.MX.zeros(int(self.energy)),
        )
        g = ca.vertcat(g - shift, ca.mtimes(ca.MX(_dm(linear)), w), extra)
        empty = ca.MX.sym("p", 0)
        grad = ca.vertcat(ca.MX.zeros(self.sums_at), slope)
        jac_g = gather.matrix()
        self.functions = {
            "nlp": ca.Function("nlp", [w, empty], [f, g], ["x", "p"], ["f", "g"]),
            "grad_f": ca.Function("grad_f", [w, empty], [f, grad]),
            "jac_g": ca.Function("jac_g", [w, empty], [g, jac_g]),
            "hess_lag": ca.Function("hess_lag", [w, empty, sigma, multipliers], [curve.matrix()]),
        }
        self.rows = rows
        energy = [-np.inf] * self.energy
        energy_bound = self.limits.limits.energy
        self.lbg = np.concatenate(
            [np.zeros(nk * count), np.full(int(starts[-1]), -np.inf), np.zeros(self.lifted),
             energy, lower, np.zeros(self._terminal.constraints)]
        )  # fmt: skip
        top = [] if energy_bound is None else [energy_bound - _INSIDE * UNIT_SCALE[""]]
        self.ubg = np.concatenate(
            [np.zeros(nk * count), np.full(int(starts[-1]), -_INSIDE), np.zeros(self.lifted),
             top, upper, np.zeros(self._terminal.constraints)]
        )  # fmt: skip
        self._symbols = (w, empty, f, g)

    def _arguments(self, k: int) -> list[int]:
        """Return the variables that interval k looks at."""
        nk, nc = len(self.kept), self.nc
        hold = self.intervals[k][0]

        def level(h: int) -> list[int]:
            h = min(max(h, 0), self.schedule.holds - 1)
            return list(range(h * nc, h * nc + nc))

        out = list(range(self.nodes_at + k * nk, self.nodes_at + (k + 1) * nk)) + level(hold)
        if self.ramped:
            out += level(hold - 1)
        if self.exact:
            last = k + 1 == len(self.intervals)
            out += level(hold if last else self.intervals[k + 1][0])
        return out

    def _parameters(self, k: int) -> Array:
        hold, samples = self.intervals[k]
        share = self._share[samples].ravel()
        last = k + 1 == len(self.intervals)
        # the command of the first sample after this interval, in levels before, now, after
        mix = np.zeros((3, self.nc))
        if last:
            mix[1] = 1.0
        elif self.intervals[k + 1][0] == hold:
            mix[1] = self._share[self.intervals[k + 1][1][0]]
            mix[0] = 1.0 - mix[1]
        else:
            mix[2] = self._share[0]
            mix[1] = 1.0 - mix[2]
        return np.concatenate([share, mix.ravel(), [float(k == 0), float(not last)]])

    def _linear(self) -> tuple[csc_matrix, Array, Array]:
        """Return rows, lower and upper bounds of the limits that are linear in the variables."""
        s = self.schedule
        rows: list[tuple[list[int], list[float], float, float]] = []
        span = s.upper - s.lower
        for c in range(self.nc):
            if not np.isfinite(s.reach[c]) or s.reach[c] >= span[c]:
                continue
            reach = float(s.reach[c] / span[c])
            for k in range(1, s.holds):
                pair = [k * self.nc + c, (k - 1) * self.nc + c]
                rows.append((pair, [1.0, -1.0], -reach, reach))
        if self._heading_pair is not None:
            assert self.limits.limits.headings is not None
            place = self.kept.index(self.rollout.nx)
            nodes = [self.nodes_at + n * len(self.kept) + place for n in self._heading_pair]
            least = self.limits.limits.headings / self.state_scale[place]
            rows.append((nodes, [1.0, -1.0], float(least), np.inf))
        matrix = csc_matrix((len(rows), self.variables))
        if rows:
            where = np.repeat(np.arange(len(rows)), [len(r[0]) for r in rows])
            matrix = csc_matrix(
                (
                    np.concatenate([r[1] for r in rows]),
                    (where, np.concatenate([r[0] for r in rows])),
                ),
                shape=(len(rows), self.variables),
            )
        return matrix, np.array([r[2] for r in rows]), np.array([r[3] for r in rows])

    def _terminal_closed(self) -> _Terminal:
        terms, constant = self._terms()
        factors = [_factor(t.size, t.positive) for t in terms]
        slopes = [ca.MX(_dm(t.slope)) for t in terms]
        share = 1.0 / len(self.wanted)

        def matrices(tail: ca.MX) -> list[Any]:
            out = []
            for term, factor, slope in zip(terms, factors, slopes, strict=True):
                x = ca.reshape(ca.DM(term.base) + ca.mtimes(slope, tail), term.size, term.size)
                out.append(factor(x))
            return out

        def first(tail: ca.MX) -> tuple[ca.MX, ca.MX, ca.MX, ca.MX]:
            f, slope = ca.MX(-constant * share), ca.MX.zeros(self.lifted)
            for term, t, (value, inverse) in zip(terms, slopes, matrices(tail), strict=True):
                f -= share * term.weight * value
                slope -= share * term.weight * ca.mtimes(t.T, ca.vec(inverse))
            return f, slope, ca.MX(0, 1), ca.MX(0, self.lifted)

        def second(tail: ca.MX, sigma: ca.MX, _: ca.MX) -> ca.MX:
            total = ca.MX(self.lifted, self.lifted)
            for term, t, (_, inverse) in zip(terms, slopes, matrices(tail), strict=True):
                both = ca.mtimes([t.T, ca.kron(inverse, inverse), t])
                total += sigma * share * term.weight * both
            return total

        return _Terminal(0, 0, first, second, lambda _: np.zeros(0))

    def _terminal_solved(self) -> _Terminal:
        """Return A or c: log Σ xᵀ M̃ x with lifted G̃ x = h, the sum lifted too."""
        criterion = self.problem.criterion
        place = {c: p for p, (_, c) in enumerate(self.order) if c is not None}
        size = len(self.order)
        wanted = list(criterion.wanted)
        # C = D C' D with the scaled columns, D = 1 / size
        if criterion.kind == "c":
            h = np.zeros(size)
            for weight, c in zip(criterion.combination, wanted, strict=True):
                h[place[c]] = weight / self.size[c]
            sides = [h]
        else:
            sides = []
            for unit, c in zip(criterion.scale, wanted, strict=True):
                h = np.zeros(size)
                h[place[c]] = 1 / (self.size[c] * unit * np.sqrt(len(wanted)))
                sides.append(h)
        gram = _Affine(size)
        self._gram_block(list(range(size)), gram, list(range(size)))
        score = _Affine(size)
        if self.exact:
            self._score_block(score, np.ones(size))
        g_term = gram.term(1.0, self.lifted, size)
        m_term = score.term(1.0, self.lifted, size)
        equation = np.array([i for i, _ in self.order])
        active = [np.flatnonzero(np.isin(equation, np.unique(equation[h != 0]))) for h in sides]

        def at(term: _LogDet, sums: Array) -> Array:
            return np.asarray((term.base + term.slope @ sums).reshape(size, size, order="F"))

        def variance(i: int, sums: Any) -> Any:
            return self.floor_variance[i] + self.mean_spread[i] * sums[self.grams + i]

        ones = self._sums(self._start_z, self._start_a)
        g0, m0 = at(g_term, ones), at(m_term, ones)
        x0 = [
            np.linalg.lstsq(g0[np.ix_(a, a)], h[a], rcond=None)[0]
            for h, a in zip(sides, active, strict=True)
        ]
        scale = [max(float(np.abs(x).max()), 1e-300) for x in x0]

        def worth(x: Any, m: Any, sums: Any) -> Any:
            """Return Σ xᵀ M̃ x, symbolic or not."""
            total: Any = 0.0
            for part, h, a in zip(x, sides, active, strict=True):
                if self.exact:
                    for row, p in enumerate(a):
                        for column, q in enumerate(a):
                            total = total + part[row] * part[column] * m[int(p), int(q)]
                    continue
                for row, p in enumerate(a):
                    if h[p]:
                        total = total + variance(int(equation[p]), sums) * h[p] * part[row]
            return total

        start = float(worth(x0, m0, ones))
        sums = ca.SX.sym("sums", self.lifted)
        g = ca.reshape(ca.DM(g_term.base) + ca.mtimes(_dm(g_term.slope), sums), size, size)
        m = ca.reshape(ca.DM(m_term.base) + ca.mtimes(_dm(m_term.slope), sums), size, size)
        symbols = [ca.SX.sym("x", len(a)) for a in active]
        q = ca.SX.sym("q")
        tail = ca.vertcat(sums, *symbols, q)
        rows = []
        for part, h, a, unit in zip(symbols, sides, active, scale, strict=True):
            block = ca.vertcat(*[
                sum((g[int(p), int(c)] * part[k] for k, c in enumerate(a)), ca.SX(0))
                for p in a
            ])  # fmt: skip
            rows.append(block - ca.DM(h[a] / unit))
        scaled = [part * unit for part, unit in zip(symbols, scale, strict=True)]
        rows.append(q - worth(scaled, m, sums) / start)
        constraints = ca.vertcat(*rows)
        f = ca.log(ca.fmax(q, 1e-300)) + float(np.log(start))
        mu, sigma = ca.SX.sym("mu", constraints.numel()), ca.SX.sym("sigma")
        whole = sigma * f + ca.dot(mu, constraints)
        one = ca.Function(
            "first", [tail],
            [f, ca.densify(ca.gradient(f, tail)), constraints, ca.jacobian(constraints, tail)],
        )  # fmt: skip
        two = ca.Function("second", [tail, sigma, mu], [ca.triu(ca.hessian(whole, tail)[0])])

        def begin(at_start: Array) -> Array:
            matrix = at(g_term, at_start)
            found = [
                np.linalg.lstsq(matrix[np.ix_(a, a)], h[a], rcond=None)[0]
                for h, a in zip(sides, active, strict=True)
            ]
            value = worth(found, at(m_term, at_start), at_start)
            parts = [x / unit for x, unit in zip(found, scale, strict=True)]
            return np.concatenate([*parts, [float(value) / start]])

        extra = sum(len(a) for a in active) + 1
        return _Terminal(extra, constraints.numel(), one, two, begin)

    # -- solving ------------------------------------------------------------------------------

    def begin(self, unit: Array) -> Array:
        """Return the variables that a sequence corresponds to."""
        state, tau = self._motion(unit)
        nodes = state[self._node_samples()][:, self.kept] / self.state_scale
        z, a = self._columns(state, tau)
        sums = self._sums((z - self.shift[:, None]) / self.size[:, None], a)
        return np.concatenate([unit.ravel(), nodes.ravel(), sums, self._terminal.begin(sums)])

    def bounds(self) -> tuple[Array, Array]:
        """Return the bounds of the variables."""
        lower, upper = np.full(self.variables, -np.inf), np.full(self.variables, np.inf)
        lower[: self.levels], upper[: self.levels] = 0.0, 1.0
        # a command without room stays where it is
        still = np.flatnonzero(self.schedule.upper <= self.schedule.lower)
        for c in still:
            upper[c : self.levels : self.nc] = 0.0
        nk = len(self.kept)
        first = slice(self.nodes_at, self.nodes_at + nk)
        start = np.append(self.rollout.start, [0.0, 0.0])[self.kept] / self.state_scale
        lower[first] = upper[first] = start
        for name, (place, value) in self.ends:
            column = self.kept.index(place)
            at = self.sums_at - nk + column
            room = max(name.bound - _INSIDE * UNIT_SCALE[name.unit], 0.0)
            lower[at] = (value - room) / self.state_scale[column]
            upper[at] = (value + room) / self.state_scale[column]
        return lower, upper

    def value(self, unit: Array) -> float:
        """Return the criterion that is climbed, at a sequence, in the units of `Criterion`."""
        f = self.functions["nlp"](x=self.begin(unit), p=ca.DM(0, 1))["f"]
        size = len(self.wanted) if self.problem.criterion.kind == "D" else 1
        return -float(f) * size

    def solve(
        self,
        unit: Array,
        *,
        iterations: int = 100,
        seconds: float = 60.0,
        tolerance: float = 1e-6,
        barrier: float = 1e-3,
        limited_memory: bool = False,
        verbose: bool = False,
    ) -> Polished:
        """Run IPOPT from a sequence and return the best of its iterates; see `solve_ipopt`."""
        began = time.perf_counter()
        start = np.clip(np.asarray(unit, float), 0.0, 1.0)
        w, p, f, g = self._symbols
        watch = _Iterates(self.variables, self.rows, self.levels)
        options: dict[str, Any] = {
            "grad_f": self.functions["grad_f"],
            "jac_g": self.functions["jac_g"],
            "iteration_callback": watch,
            "iteration_callback_ignore_errors": True,
            "error_on_fail": False,
            "print_time": False,
            "show_eval_warnings": False,
            "ipopt.sb": "yes",
            "ipopt.print_level": 5 if verbose else 0,
            "ipopt.max_iter": iterations,
            "ipopt.max_wall_time": seconds,
            "ipopt.tol": tolerance,
            "ipopt.acceptable_tol": 100 * tolerance,
            "ipopt.acceptable_iter": 5,
            "ipopt.mu_init": barrier,
            "ipopt.bound_push": barrier,
            "ipopt.bound_frac": barrier,
            "ipopt.slack_bound_push": barrier,
            "ipopt.slack_bound_frac": barrier,
            "ipopt.nlp_scaling_method": "none",
        }
        if limited_memory:
            options["ipopt.hessian_approximation"] = "limited-memory"
        else:
            options["hess_lag"] = self.functions["hess_lag"]
        solver = ca.nlpsol("solver", "ipopt", {"x": w, "p": p, "f": f, "g": g}, options)
        lower, upper = self.bounds()
        status = ""
        try:
            found = solver(x0=self.begin(start), lbx=lower, ubx=upper, lbg=self.lbg, ubg=self.ubg)
            watch.seen.append(np.array(found["x"][: self.levels]).ravel())
            status = str(solver.stats()["return_status"])
            outcome = _STATUS.get(status, Outcome.FAILED)
        except KeyboardInterrupt:
            outcome = Outcome.INTERRUPTED
        return self._judge(start, watch.seen, outcome, status, time.perf_counter() - began)

    def _judge(
        self, start: Array, seen: list[Array], outcome: Outcome, status: str, seconds: float
    ) -> Polished:
        problem = self.problem
        sequences = [start, *[np.clip(u.reshape(problem.shape), 0.0, 1.0) for u in seen]]
        units = np.array(sequences)
        if self.schedule.limited:
            units = to_unit(problem, self.schedule.within_reach(problem.levels(units)))
        scale = limit_scale(problem)
        candidates = assess(problem, units)
        best, place = candidates[0], 0
        for i, candidate in enumerate(candidates):
            if candidate.beats(best, scale):
                best, place = candidate, i
        sentence = outcome.value
        if outcome is Outcome.FAILED:
            sentence += f" Its status: {status.replace('_', ' ').lower()}."
        if place == 0:
            sentence += " The sequence that it started from was better and was kept."
        return Polished(
            best.unit, best.value, best.missed, len(seen), outcome, sentence, len(seen) - 1,
            seconds,
        )  # fmt: skip


def solve_ipopt(
    problem: TrialProblem,
    unit: Array,
    *,
    exact: bool | None = None,
    iterations: int = 100,
    seconds: float = 60.0,
    tolerance: float = 1e-6,
    barrier: float = 1e-3,
    limited_memory: bool = False,
    verbose: bool = False,
    shooting: Shooting | None = None,
) -> Polished:
    """Polish a sequence, feasible or not, by multiple shooting with IPOPT.

    IPOPT climbs the criterion of the first scenario only; every iterate is then
    judged by `assess` (exact criterion, exact motion, all scenarios), and the best
    one is returned, the start included, so that the result is never worse.

    Parameters
    ----------
    problem : TrialProblem
    unit : ndarray
        (K, nc) start, unit coordinates.
    exact : bool, optional
        Climb the exact criterion instead of that of white equation errors; by
        default where the predictor has at most `EXACT_COLUMNS` columns.
    iterations : int
        Most iterations of IPOPT.
    seconds : float
        Most wall time of IPOPT [s].
    tolerance : float
        Of IPOPT, in scaled variables.
    barrier : float
        First barrier parameter, and how far the start is pushed from its limits.
    limited_memory : bool
        Approximate the Hessian by L-BFGS instead of computing it.
    verbose : bool
        Let IPOPT print its iterations.
    shooting : Shooting, optional
        The program of the same problem, to spare building it for each start.

    Returns
    -------
    Polished
        With ``outcome`` and ``status``; refused, with the reason, where the
        criterion or the yardstick has no such program.

    Notes
    -----
    The pair of nodes whose headings cover the required range is taken from the
    start. With white R the sums of earlier trials count as if their errors had
    this trial's variance.
    """
    began = time.perf_counter()
    if shooting is None:
        try:
            shooting = Shooting(problem, np.asarray(unit, float), exact)
        except UsageError as refusal:
            start = assess(problem, np.asarray(unit, float)[None])[0]
            return Polished(
                start.unit, start.value, start.missed, 1, Outcome.REFUSED, str(refusal), 0,
                time.perf_counter() - began,
            )  # fmt: skip
    build = time.perf_counter() - began
    found = shooting.solve(
        unit, iterations=iterations, seconds=seconds, tolerance=tolerance, barrier=barrier,
        limited_memory=limited_memory, verbose=verbose,
    )  # fmt: skip
    return replace(found, seconds=found.seconds + build)
