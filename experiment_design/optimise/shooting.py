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

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix

from experiment_design.constraints.kinds.whole_trial import EndState, Energy, HeadingRange
from experiment_design.constraints.limits import UNIT_SCALE
from experiment_design.optimise.logdet import Affine, LogDet, determinant_factor
from experiment_design.optimise.sparse_assembly import Gatherer, Index, coordinates, to_dm
from experiment_design.request.problem import TrialProblem

Array = NDArray[np.float64]

# samples a shooting interval has at most: longer holds are cut
_LONGEST = 15
# scaled units by which the limits are kept more strictly than asked
_INSIDE = 2e-3


@dataclass(frozen=True)
class Terminal:
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


@dataclass
class Passed:
    """What one interval has collected on its way, symbolically."""

    vectors: list[list[ca.SX]]
    scores: list[list[ca.SX]]
    squares: list[ca.SX]
    sensitivity: ca.SX


class Shooting(ABC):
    """The nominal scenario of a trial problem as one nonlinear program.

    Only the first scenario is solved for; `solve_ipopt` judges what comes out by
    all of them. What is summed over the samples is the affair of the subclasses.

    Parameters
    ----------
    problem : TrialProblem
        With a D, A or c criterion.
    unit : ndarray
        (K, nc) a typical sequence, which gives the variables their scales.
    """

    exact = False
    wanted: set[int]
    size: Array
    state_scale: Array
    # equation (or 0) and column of each row of the matrices, None for a constant
    order: list[tuple[int, int | None]]
    gram_at: dict[tuple[int, int], int]
    others: int

    def __init__(self, problem: TrialProblem, unit: Array) -> None:
        self.problem = problem
        self.rollout = problem.scenarios[0].rollout
        self.limits = problem.scenarios[0].limits
        self.schedule = problem.schedule
        self.wanted = set(problem.criterion.wanted)
        self.nc = problem.shape[1]
        self._choose_states()
        self._cut()
        self._measure(unit)
        self.headings = self.limits.each(HeadingRange)
        self._heading_pair = self._choose_headings(unit)
        self._index_sums()
        self.grams = len(self.gram_at)
        self.lifted = self.grams + self.others
        self._typical = self._nodes_and_sums(unit)[1]
        # IPOPT objects by their options, so that many starts share one
        self.solvers: dict[str, Any] = {}
        self._build()

    # -- what subclasses say ----------------------------------------------------------------

    @abstractmethod
    def _measure(self, unit: Array) -> None:
        """Take the scales of nodes and columns from the motion of a typical sequence."""

    @abstractmethod
    def _index_sums(self) -> None:
        """Give each lifted sum its place among the variables."""

    @abstractmethod
    def _nodes_and_sums(self, unit: Array) -> tuple[Array, Array]:
        """Return the scaled nodes (I+1, nk) and the lifted sums (L,) of a sequence."""

    @abstractmethod
    def _first_node(self) -> Array:
        """Return the node that a trial starts from, scaled."""

    @abstractmethod
    def _open(self, node: ca.SX) -> Passed:
        """Return what an interval starts from."""

    @abstractmethod
    def _look(self, passed: Passed, state: ca.SX, command: ca.SX, first: ca.SX) -> None:
        """Collect a sample."""

    @abstractmethod
    def _close(self, passed: Passed, state: ca.SX, command: ca.SX, more: ca.SX) -> None:
        """Collect what crosses the border to the next interval."""

    def _carried(self, passed: Passed) -> list[ca.SX]:
        """Return what the next node holds beside the state, scaled."""
        return []

    def _variance(self, equation: int, sums: Any) -> Any:
        """Return the variance of an equation's error by the lifted sums."""
        return 1.0

    def _variance_terms(self, equation: int, count: int) -> tuple[list[LogDet], float]:
        """Return −count · log variance as terms and a constant."""
        return [], 0.0

    def _fixed_gram(self) -> Array | None:
        """Return what adds to the Gram matrix beside the sums, by column."""
        return self.problem.known[0].gram[0] if self.problem.known else None

    def _border(self, nuisance: list[int]) -> list[LogDet]:
        """Return what the exact covariance adds to the terms."""
        return []

    @abstractmethod
    def _score_block(self, matrix: Affine, scale: Array) -> None:
        """Fill the score's matrix M̃ of the exact covariance."""

    def _scaled(self) -> float:
        """Return what the scaling of M̃ adds to the log determinant."""
        return 0.0

    # -- scales and positions ---------------------------------------------------------------

    def _choose_states(self) -> None:
        """Leave positions out of the nodes where no limit looks at them."""
        nx = self.rollout.nx
        state = self.rollout.symbols[0]
        self.ends = self.limits.each(EndState)
        used = {x.place for x in self.ends}
        if self.limits.path.numel():
            where = ca.which_depends(self.limits.path, state, 1, False)
            used |= {i for i, on in enumerate(where) if on}
        places = used & {nx + 1, nx + 2}
        self.kept = [*range(nx + 1), *([nx + 1, nx + 2] if places else [])]

    def _motion(self, unit: Array) -> tuple[Array, Array]:
        motion = self.rollout.run(self.schedule.expand(self.problem.levels(unit))[None])
        state = motion.state[0].copy()
        if not motion.stable[0]:
            state[:] = np.append(self.rollout.start, [0.0, 0.0])
        return state, motion.tau[0]

    def _state_scale(self, state: Array) -> Array:
        """Return the scale of the kept states along a motion (N+1, nx+3)."""
        floor = np.array([1.0] * self.rollout.nx + [1.0, 10.0, 10.0])
        for i, name in enumerate(self.rollout.structure.states):
            floor[i] = 10 * UNIT_SCALE["rad/s" if name == "r" else "m/s"]
        return np.asarray(np.maximum(np.abs(state).max(axis=0), floor)[self.kept])

    def _choose_headings(self, unit: Array) -> tuple[int, int] | None:
        """Return the nodes at which the typical sequence heads furthest apart."""
        if not self.headings:
            return None
        state, _ = self._motion(unit)
        psi = state[self._node_samples(), self.rollout.nx]
        return int(psi.argmax()), int(psi.argmin())

    def _node_samples(self) -> list[int]:
        """Return the sample of each node, the end included."""
        s = self.schedule
        out = [k * s.hold + int(p[0]) for k, p in self.intervals]
        return [*out, s.samples]

    # -- criterion in the lifted sums -------------------------------------------------------

    def _gram_block(self, which: list[int], matrix: Affine, at: list[int]) -> None:
        """Write G̃ of the extended columns `which` at rows `at`."""
        known = self._fixed_gram()
        for b, q in zip(at, which, strict=True):
            for a, p in zip(at, which, strict=True):
                if p > q:
                    continue
                self._gram_entry(matrix, a, b, p, q, 1.0, known)

    def _gram_entry(
        self, matrix: Affine, a: int, b: int, p: int, q: int, weight: float,
        known: Array | None,
    ) -> None:  # fmt: skip
        if p > q:
            p, q = q, p
        (i, c), (j, d) = self.order[p], self.order[q]
        if i != j:
            return
        if (p, q) in self.gram_at:
            matrix.add(a, b, self.gram_at[p, q], weight)
        else:
            matrix.add_constant(a, b, weight)
        if known is not None and c is not None and d is not None:
            value = weight * known[c, d] / (self.size[c] * self.size[d])
            matrix.add_constant(a, b, value)

    def _terms(self) -> tuple[list[LogDet], float]:
        """Return −log det C as weighted log determinants and a constant."""
        terms: list[LogDet] = []
        constant = float(2 * np.log(self.size[sorted(self.wanted)]).sum())
        nuisance_all: list[int] = []
        for i in sorted({e for e, _ in self.order}):
            everything = [p for p, (e, _) in enumerate(self.order) if e == i]
            nuisance = [p for p in everything if self.order[p][1] not in self.wanted]
            nuisance_all += nuisance
            ordered = nuisance + [p for p in everything if p not in nuisance]
            count = len(ordered) - len(nuisance)
            if not count and not self.exact:
                continue
            whole = Affine(len(ordered))
            self._gram_block(ordered, whole, list(range(len(ordered))))
            terms.append(whole.term(2.0 if self.exact else 1.0, self.lifted, len(ordered)))
            if self.exact:
                continue
            # the determinant of a constant alone is 1
            if any(self.order[p][1] is not None for p in nuisance):
                rest = Affine(len(nuisance))
                self._gram_block(nuisance, rest, list(range(len(nuisance))))
                terms.append(rest.term(-1.0, self.lifted, len(nuisance)))
            more, shift = self._variance_terms(i, count)
            terms += more
            constant += shift
        if self.exact:
            terms += self._border(nuisance_all)
        return terms, constant + self._scaled()

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
        self.energy = self.limits.each(Energy)

    def _build(self) -> None:
        self.nk = len(self.state_scale)
        self.levels = self.schedule.holds * self.nc
        self.nodes_at = self.levels
        self.sums_at = self.levels + self.nk * (len(self.intervals) + 1)
        closed = self.problem.criterion.optimality.determinant
        self._terminal = self._terminal_closed() if closed else self._terminal_solved()
        self.variables = self.sums_at + self.lifted + self._terminal.extra
        self._assemble()

    def _interval(self, n: int) -> tuple[ca.Function, ca.Function, ca.Function]:
        """Return value, Jacobian and weighted Hessian of an interval of n samples."""
        s, r = self.schedule, self.rollout
        nx = r.nx
        step = ca.Function("step", list(r.symbols), [r.step])
        path = ca.Function("path", [r.symbols[0]], [self.limits.path])
        node = ca.SX.sym("node", self.nk)
        now, before, after = (ca.SX.sym(name, self.nc) for name in ("now", "before", "after"))
        shares = ca.SX.sym("share", self.nc, n)
        mix, flags = ca.SX.sym("mix", self.nc, 3), ca.SX.sym("flags", 2)
        span = ca.DM(s.upper - s.lower)
        real = [ca.DM(s.lower) + span * level for level in (before, now, after)]
        state = ca.SX.zeros(nx + 3)
        for i, k in enumerate(self.kept):
            state[k] = node[i] * self.state_scale[i]

        passed = self._open(node)
        used, kept_path = ca.SX(0), []
        for t in range(n):
            c = real[0] + shares[:, t] * (real[1] - real[0]) if self.ramped else real[1]
            self._look(passed, state, c, flags[0])
            state = step(state, c)
            if self.limits.path_limits:
                kept_path.append(path(state) / ca.DM(self.limits.path_scale))
            for energy in self.energy:
                used += energy.mean_cube(c) / s.samples
        c = real[1] * mix[:, 1] + real[2] * mix[:, 2]
        if self.ramped:
            c = c + real[0] * mix[:, 0]
        self._close(passed, state, c, flags[1])
        kept = ca.vertcat(*[state[k] for k in self.kept]) / ca.DM(
            self.state_scale[: len(self.kept)]
        )
        ends = [kept, *self._carried(passed), *kept_path]
        single = list(passed.squares)
        single += [used] * len(self.energy)
        first, last = ca.vertcat(*ends), ca.vertcat(*single)
        score_at = {
            (p, q): q * (q + 1) // 2 + p for q in range(len(self.order)) for p in range(q + 1)
        }
        quadratic: list[tuple[dict[tuple[int, int], int], list[list[ca.SX]]]]
        quadratic = [(self.gram_at, passed.vectors)] + [(score_at, passed.scores)] * self.exact
        weights = ca.SX.sym("w", first.numel() + self.lifted + len(self.energy))
        sums: list[ca.SX] = []
        done = first.numel()
        # what is weighted is Σ zᵀ W z, whose slope is 2 W z carried back along z
        seeds, seeded = [weights[:done]], [first]
        for entries, vectors in quadratic:
            total = [ca.SX(0)] * len(entries)
            inner = ca.SX(len(self.order), len(self.order))
            for (p, q), entry in entries.items():
                for v in vectors:
                    total[entry] += v[p] * v[q]
                inner[p, q] += weights[done + entry]
                inner[q, p] += weights[done + entry]
            for v in vectors:
                seeded.append(ca.vertcat(*v))
                seeds.append(ca.mtimes(inner, seeded[-1]))
            sums.extend(total)
            done += len(entries)
        seeds.append(weights[done:])
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
        nk = self.nk
        w = ca.MX.sym("w", self.variables)
        path = len(self.limits.path_limits)
        count = len(self.intervals)
        sums = self.lifted + len(self.energy)
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
        gather = Gatherer(rows, self.variables)
        curve = Gatherer(self.variables, self.variables, upper=True)
        for n, members in groups.items():
            value, jac, hess = self._interval(n)
            index = np.array([self._arguments(k) for k in members]).T
            given = np.array([self._parameters(k) for k in members]).T
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
            shares = value.map(m)(y, given)
            # a tie is lifted − Σ shares; the energy is +Σ
            sign = np.ones(target.shape[0])
            sign[nk + n * path : nk + n * path + self.lifted] = -1.0
            g_rows.append((target, ca.DM(sign) * shares))
            r, c = coordinates(jac.sparsity_out(0))
            places = target[r].ravel(order="F"), index[c].ravel(order="F")
            slopes = ca.vec(ca.MX(jac.map(m)(y, given)).nz[:])
            gather.add(*places, slopes * np.tile(sign[r], m))
            r, c = coordinates(hess.sparsity_out(0))
            weights = multipliers[target.ravel(order="F").tolist()]
            weights = ca.reshape(weights, *target.shape) * ca.DM(sign)
            curves = ca.vec(ca.MX(hess.map(m)(y, given, weights)).nz[:])
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
        r, c = coordinates(extra_jac.sparsity())
        if len(r):
            gather.add(extra_at + r, self.sums_at + c, ca.vec(extra_jac.nz[:]))
        sigma = ca.MX.sym("lam_f")
        end = self._terminal.second(tail, sigma, multipliers[extra_at:])
        r, c = coordinates(end.sparsity())
        curve.add(self.sums_at + r, self.sums_at + c, ca.vec(end.nz[:]))
        into = np.concatenate([t.ravel(order="F") for t, _ in g_rows])
        ones = np.ones(len(into))
        pick = csc_matrix((ones, (into, np.arange(len(into)))), shape=(rates, len(into)))
        g = ca.mtimes(ca.MX(to_dm(pick)), ca.vertcat(*[ca.vec(v) for _, v in g_rows]))
        shift = ca.vertcat(
            w[self.nodes_at + nk : self.sums_at],
            ca.MX.zeros(int(starts[-1])),
            -w[self.sums_at : self.sums_at + self.lifted],
            ca.MX.zeros(len(self.energy)),
        )
        g = ca.vertcat(g - shift, ca.mtimes(ca.MX(to_dm(linear)), w), extra)
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
        energy = [-np.inf] * len(self.energy)
        self.lbg = np.concatenate(
            [np.zeros(nk * count), np.full(int(starts[-1]), -np.inf), np.zeros(self.lifted),
             energy, lower, np.zeros(self._terminal.constraints)]
        )  # fmt: skip
        top = [x.bound - _INSIDE * x.scale for x in self.energy]
        self.ubg = np.concatenate(
            [np.zeros(nk * count), np.full(int(starts[-1]), -_INSIDE), np.zeros(self.lifted),
             top, upper, np.zeros(self._terminal.constraints)]
        )  # fmt: skip
        self.symbols = (w, empty, f, g)

    def _arguments(self, k: int) -> list[int]:
        """Return the variables that interval k looks at."""
        nk, nc = self.nk, self.nc
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
            place = self.kept.index(self.rollout.nx)
            nodes = [self.nodes_at + n * self.nk + place for n in self._heading_pair]
            least = self.headings[0].bound / self.state_scale[place]
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

    def _terminal_closed(self) -> Terminal:
        terms, constant = self._terms()
        factors = [determinant_factor(t.size, t.positive) for t in terms]
        slopes = [ca.MX(to_dm(t.slope)) for t in terms]
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

        return Terminal(0, 0, first, second, lambda _: np.zeros(0))

    def _terminal_solved(self) -> Terminal:
        """Return A or c: log Σ xᵀ M̃ x with lifted G̃ x = h, the sum lifted too."""
        criterion = self.problem.criterion
        place = {c: p for p, (_, c) in enumerate(self.order) if c is not None}
        size = len(self.order)
        wanted = list(criterion.wanted)
        # C = D C' D with the scaled columns, D = 1 / size
        assert criterion.directions is not None
        sides = []
        for along in criterion.directions:
            h = np.zeros(size)
            for weight, c in zip(along, wanted, strict=True):
                h[place[c]] = weight / self.size[c]
            sides.append(h)
        gram = Affine(size)
        self._gram_block(list(range(size)), gram, list(range(size)))
        score = Affine(size)
        if self.exact:
            self._score_block(score, np.ones(size))
        g_term = gram.term(1.0, self.lifted, size)
        m_term = score.term(1.0, self.lifted, size)
        equation = np.array([i for i, _ in self.order])
        active = [np.flatnonzero(np.isin(equation, np.unique(equation[h != 0]))) for h in sides]

        def at(term: LogDet, sums: Array) -> Array:
            return np.asarray((term.base + term.slope @ sums).reshape(size, size, order="F"))

        typical = self._typical
        g0, m0 = at(g_term, typical), at(m_term, typical)
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
                        total = total + self._variance(int(equation[p]), sums) * h[p] * part[row]
            return total

        start = float(worth(x0, m0, typical))
        sums = ca.SX.sym("sums", self.lifted)
        g = ca.reshape(ca.DM(g_term.base) + ca.mtimes(to_dm(g_term.slope), sums), size, size)
        m = ca.reshape(ca.DM(m_term.base) + ca.mtimes(to_dm(m_term.slope), sums), size, size)
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
        return Terminal(extra, constraints.numel(), one, two, begin)

    # -- solving ------------------------------------------------------------------------------

    def begin(self, unit: Array) -> Array:
        """Return the variables that a sequence corresponds to."""
        nodes, sums = self._nodes_and_sums(unit)
        return np.concatenate([unit.ravel(), nodes.ravel(), sums, self._terminal.begin(sums)])

    def bounds(self) -> tuple[Array, Array]:
        """Return the bounds of the variables."""
        lower, upper = np.full(self.variables, -np.inf), np.full(self.variables, np.inf)
        lower[: self.levels], upper[: self.levels] = 0.0, 1.0
        # a command without room stays where it is
        still = np.flatnonzero(self.schedule.upper <= self.schedule.lower)
        for c in still:
            upper[c : self.levels : self.nc] = 0.0
        nk = self.nk
        first = slice(self.nodes_at, self.nodes_at + nk)
        lower[first] = upper[first] = self._first_node()
        for end in self.ends:
            column = self.kept.index(end.place)
            at = self.sums_at - nk + column
            room = max(end.bound - _INSIDE * end.scale, 0.0)
            lower[at] = (end.target - room) / self.state_scale[column]
            upper[at] = (end.target + room) / self.state_scale[column]
        return lower, upper

    def value(self, unit: Array) -> float:
        """Return the criterion that is climbed, at a sequence, in the units of `Criterion`."""
        f = self.functions["nlp"](x=self.begin(unit), p=ca.DM(0, 1))["f"]
        return -float(f) * self.problem.criterion.shared_by
