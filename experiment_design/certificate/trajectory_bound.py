"""The best that a trial in several states could reach, by dynamic programming on their grid.

The regressors φ of an equation error are functions of the state and of the forces.
With a constant added, φ̃ = (φ, 1), the centred sums of an equation are

    Gᵢ = Σ φφᵀ − (Σ φ)(Σ φ)ᵀ / N,

the Schur complement of N in Σ φ̃φ̃ᵀ, and log det Gᵢ is concave in those sums. For
the sums S of any sequence and those M of any mixture of sequences therefore

    F(S) ≤ F(M) + ⟨∇F(M), S − M⟩,

the equivalence theorem of Kiefer and Wolfowitz (1960). The linear functional is a
sum over samples of φ̃ᵀ W φ̃, so that its maximum over all sequences is a problem of
optimal control (Bellman, 1957): a value function on a grid of the states (and of
the heading where it acts), a sample of the forces that the commands can make, and
one stage a hold. The sequence that attains it joins the mixture, whose weights are
renewed (column generation), and the least bound counts.

The average variance of the error, s, varies from sequence to sequence where it is
that of white residuals. −log s is convex, so that its chord between the least and
the largest s that any sequence has takes its place; both are found by the same
programme.

The bound is numerical, not proven: values between points are interpolated, and some
forces stand for all. What a finer grid with more forces raises is added, and so is
what a rich choice of forces adds along the best sequence.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.sparse import csr_matrix
from scipy.spatial import ConvexHull

from experiment_design.certificate.mixture import best_weights
from experiment_design.constraints.limit_program import LimitProgram
from experiment_design.excitation.rollout import Rollout
from experiment_design.information.moments import MomentProgram, Moments
from experiment_design.optimise.search import draw_two_level
from experiment_design.request.problem import TrialProblem
from greybox.model.run.simulation import simulate

Array = NDArray[np.float64]
Whole = NDArray[np.int64]

# of the first and of the finer grid: points of an axis, forces that are tried at each
# point, bytes of the table of sums, and samples that are simulated for it
_POINTS, _FORCES = (16, 22), (27, 48)
_BYTES, _SAMPLES = (60e6, 180e6), (2e6, 6e6)
_FEWEST = 5
# share of the forces that are extreme; forces that are tried along the best sequence
_CORNERS, _RICH = 0.75, 300
# combinations of commands that forces are chosen from, and levels of each
_COMBINATIONS = 20_000
_LEVELS = 9
# transitions that are evaluated together
_TOGETHER = 8_000
# random sequences that tell how far the states reach
_PROBES = 300
# by how much of its span the range of a state is widened
_WIDER = 0.06
# most steps of the mixture on each grid, and the gap a parameter that ends them
_STEPS = (40, 6)
_ENOUGH = 0.01
# ranges of the variance on the first grid, and how many of them the finer one looks at
_RANGES, _FINER = 9, 4
# by how much the range of the variance is widened, and the part of a cell by which a
# limit may be missed: the nearest point of the grid lies no farther
_SPREAD, _MISSED = 1.03, 0.5
# share of the points around a state that must lead on, for it to do so; and to be preferred
_ALIVE, _SAFE = 0.1, (0.5, 0.99)
# random two-level sequences that the mixture starts from
_DRAWS = 64
_KEPT = 12
_MOST_AXES = 4
_UNSTABLE = 1e3


@dataclass(frozen=True)
class TrajectoryBound:
    """Upper bound of the criterion over all sequences.

    Parameters
    ----------
    bound, gap : float
        Bound, and its part that the best mixture did not reach.
    mixture_value : float
        Criterion of the best mixture, the chord of the variance included.
    grid : float
        By how much the finer grid raised the bound; part of it.
    chord : float
        Most that the chord of the variance may have added to the bound.
    points, finer : tuple of int
        Points of each axis of both grids.
    forces : tuple of int
        Forces that were tried at each point of both.
    mixture, ranges, evaluations : int
        Sequences in the mixture, ranges of the variance, programmes solved.
    relaxed : bool
        Whether the error was given the variance of the process noise alone.
    """

    bound: float
    gap: float
    mixture_value: float
    grid: float
    chord: float
    points: tuple[int, ...]
    finer: tuple[int, ...]
    forces: tuple[int, ...]
    mixture: int
    ranges: int
    evaluations: int
    relaxed: bool


def why_not_trajectory(problem: TrialProblem, *, relaxed: bool = False) -> str:
    """Return why dynamic programming does not apply, empty where it does.

    Parameters
    ----------
    problem : TrialProblem
        One scenario.
    relaxed : bool
        Give the error the variance of the process noise alone: C ⪰ G⁻¹ q.
    """
    scenario = problem.scenarios[0]
    information = scenario.information
    if not isinstance(information, MomentProgram):
        return "the sensitivities of output error are states of their own"
    if problem.known:
        return "earlier trials add to the sums"
    if information.gust is not None:
        return "the measured wind makes the regressors depend on time"
    if max(problem.schedule.ramp) > 1:
        return "commands are ramped"
    if not relaxed and not information.white:
        return "measurement noise correlates the errors of neighbouring samples"
    if relaxed and not (information.process_std > 0).all():
        return "without process noise the error has no floor"
    if scenario.rollout.nx + _heading_acts(scenario.rollout, information) > _MOST_AXES:
        return "the model has too many states for a grid"
    return ""


def relaxed_value(problem: TrialProblem, unit: Array) -> float:
    """Return the criterion of a design if its error were the process noise alone."""
    motion = problem.scenarios[0].rollout.run(problem.commands(unit[None]))
    information = problem.scenarios[0].information
    assert isinstance(information, MomentProgram)
    gram = problem.moments(motion, 0).gram
    score = np.zeros_like(gram)
    for rows, std in zip(information.equations, information.process_std, strict=True):
        block = np.ix_(rows, rows)
        score[0][block] = std**2 * gram[0][block]
    return float(problem.criterion.value(Moments(gram, score))[0])


def bound_trajectory(
    problem: TrialProblem,
    unit: Array,
    seed: int = 0,
    *,
    limits: LimitProgram | None = None,
    relaxed: bool = False,
    share: float = 1.0,
) -> TrajectoryBound:
    """Bound the criterion of a trial over all sequences within the limits.

    Parameters
    ----------
    problem : TrialProblem
        For which `why_not_trajectory` is empty.
    unit : ndarray
        (K, nc) unit coordinates of a design, in the mixture from the start.
    seed : int
        Of the sequences that the mixture starts from.
    limits : LimitProgram, optional
        A hold that misses one of its limits on the speeds by more than a cell of
        the grid is left out; limits on place, end, energy and headings are ignored.
    relaxed : bool
        Give the error the variance of the process noise alone.
    share : float
        Of the points and forces of the grids, for a bound that is one of several.

    References
    ----------
    Kiefer and Wolfowitz (1960), "The equivalence of two extremum problems";
    Bellman (1957), "Dynamic Programming".
    """
    rng = np.random.default_rng([23, seed])
    trial = _Trial(problem, unit, rng, limits, relaxed)
    coarse = _programme(trial, 0, share)
    value = trial.true_value(trial.known[0])
    ranges = _branch(trial, coarse, value)
    fine = _programme(trial, 1, share)
    raised, looked = 0.0, set[int]()
    while True:
        bounds = [m.least + (0.0 if i in looked else raised) for i, m in enumerate(ranges)]
        worst = int(np.argmax(bounds))
        if worst in looked or len(looked) == _FINER:
            break
        before = ranges[worst]
        ranges[worst] = mixture = _Mixture(trial, before.chord, before)
        mixture.improve(fine, _STEPS[1], value)
        weights = mixture.tangent()[1]
        more = max(0.0, fine.maximise(weights)[0] - coarse.maximise(weights)[0])
        mixture.least += more
        raised = max(raised, more)
        looked.add(worst)
    mixture, bound = ranges[worst], max(bounds[worst], value)
    reached = mixture.tangent()[0]
    return TrajectoryBound(
        bound, bound - reached, reached, raised, float(mixture.chord.gap.sum()), coarse.grid.shape,
        fine.grid.shape, (len(coarse.tau), len(fine.tau)), mixture.members, len(ranges),
        coarse.solved + fine.solved, relaxed,
    )  # fmt: skip


def _branch(trial: _Trial, programme: _Programme, value: float) -> list[_Mixture]:
    """Split the ranges of the variances where the bound is largest; a mixture for each.

    Outside its range a chord lies below −log s, so that each mixture may hold any
    sequence and still bounds those whose variances lie inside.
    """
    low, high = programme.variances()
    ranges = [_Mixture(trial, _Chord.between(low, high, trial))]
    ranges[0].improve(programme, _STEPS[0], value)
    enough = _ENOUGH * len(trial.problem.criterion.wanted)
    while len(ranges) < _RANGES:
        worst = max(range(len(ranges)), key=lambda i: ranges[i].least)
        before = ranges[worst]
        if before.chord.gap.sum() < enough or before.least < value + enough:
            break
        ranges.pop(worst)
        for chord in before.chord.halves(trial):
            part = _Mixture(trial, chord, before)
            part.improve(programme, _STEPS[0], value)
            part.least = min(part.least, before.least)
            ranges.append(part)
    return ranges


def _heading_acts(rollout: Rollout, information: MomentProgram) -> bool:
    """Whether the motion or the regressors depend on the heading."""
    if "r" not in rollout.structure.states:
        return False
    psi = information.symbols[1]
    seen = any(ca.depends_on(e, psi) for e in information.expressions)
    return seen or bool(rollout.d.any())


def _draw_forces(candidates: Array, count: int) -> Array:
    """Choose forces (at most count, nu): most of them extreme, far from one another.

    The sums are convex in the forces of a hold but for the bends of the motion, so
    that the best is nearly always a corner of their convex hull.
    """
    span = np.ptp(candidates, axis=0)
    scaled = (candidates - candidates.mean(axis=0)) / np.where(span > 0, span, 1.0)
    values, axes = np.linalg.svd(scaled, full_matrices=False)[1:]
    flat = scaled @ axes[values > 1e-9 * max(values[0], 1e-300)].T
    if not flat.shape[1]:
        return candidates[:1]
    corners = np.array([flat[:, 0].argmin(), flat[:, 0].argmax()])
    if flat.shape[1] > 1:
        corners = ConvexHull(flat).vertices
    chosen = _spread(flat, list(corners), [], max(2, round(_CORNERS * count)))
    return candidates[_spread(flat, list(range(len(flat))), chosen, count)]


def _spread(points: Array, among: list[int], chosen: list[int], count: int) -> list[int]:
    """Add those points that lie farthest from all chosen, until there are so many."""
    chosen = list(chosen) or [max(among, key=lambda i: float((points[i] ** 2).sum()))]
    part = points[among]
    distance = np.min([((part - points[i]) ** 2).sum(axis=1) for i in chosen], axis=0)
    while len(chosen) < count:
        j = int(np.argmax(distance))
        if distance[j] < 1e-12:
            break
        chosen.append(among[j])
        distance = np.minimum(distance, ((part - part[j]) ** 2).sum(axis=1))
    return chosen


class _Trial:
    """One trial as a function of its forces, and the sums of its samples.

    The sums of a sequence are one vector: of each equation the upper triangle of
    Σ φ̃φ̃ᵀ in coordinates in which the design's own is the unit matrix, then the
    sum of each equation's variance.
    """

    def __init__(
        self,
        problem: TrialProblem,
        unit: Array,
        rng: np.random.Generator,
        limits: LimitProgram | None,
        relaxed: bool,
    ) -> None:
        scenario = problem.scenarios[0]
        information = scenario.information
        assert isinstance(information, MomentProgram)
        self.problem, self.rng, self.limits, self.relaxed = problem, rng, limits, relaxed
        self.rollout, self.information = scenario.rollout, information
        self.nx = self.rollout.nx
        self.hold, self.samples = problem.schedule.hold, problem.schedule.samples
        self.heading = _heading_acts(self.rollout, information)
        self.axes = self.nx + self.heading
        wanted = set(problem.criterion.wanted)
        self.rows = [np.array(e) for e in information.equations]
        self.wanted = np.array([sum(i in wanted for i in e) for e in information.equations], float)
        self.corner = [np.triu_indices(len(e) + 1) for e in self.rows]
        self.root = [np.eye(len(e) + 1) for e in self.rows]
        self.entries = sum(len(c[0]) for c in self.corner)
        self.own = np.zeros(self.nx)
        for std, o in zip(information.channel_std, information.channel_own, strict=True):
            if o is not None:
                self.own[o] += std**2
        s = problem.schedule
        levels = min(_LEVELS, int(_COMBINATIONS ** (1 / len(s.commands))))
        levels = max(2, levels - (levels % 2 == 0) * (levels > 2))
        if levels ** len(s.commands) <= _COMBINATIONS:
            levels_of = np.array(list(product(np.linspace(0, 1, levels), repeat=len(s.commands))))
        else:
            levels_of = rng.integers(0, 2, (_COMBINATIONS, len(s.commands))).astype(float)
        self.candidates = self.rollout.forces(problem.levels(levels_of))
        kept = draw_two_level(problem, rng, _DRAWS)
        self.first = self._run_whole(np.concatenate([unit[None], kept]))
        self._scale(self.first[0])
        self.known = self.sums(*self.first)
        self.low, self.high = self._reach()

    def _run_whole(self, units: Array) -> tuple[Array, Array, Array]:
        motion = self.rollout.run(self.problem.commands(units))
        good = motion.stable
        state = motion.state[good]
        return state[..., : self.nx], state[..., self.nx], motion.tau[good]

    def _scale(self, x: Array) -> None:
        """Choose coordinates in which the sums of the mean of some runs are of one size."""
        _, psi, tau = self.first
        z = self.information.regressors(x[:, :-1], psi[:, :-1], tau)[0]
        for i, rows in enumerate(self.rows):
            full = np.concatenate([z[rows], np.ones((1, *z.shape[1:]))]).reshape(len(rows) + 1, -1)
            gram = full @ full.T / len(x)
            size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
            values, vectors = np.linalg.eigh(gram / np.outer(size, size))
            values = np.maximum(values, 1e-12 * values[-1])
            self.root[i] = size[:, None] * np.linalg.cholesky((vectors * values) @ vectors.T)

    def run(self, point: Array, tau: Array, samples: int) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Run from points (R, axes) under held forces (R, nu): states, headings, sound ones."""
        r = self.rollout
        structure = r.structure
        turns = "r" in structure.states
        held = np.broadcast_to(tau[:, None], (len(tau), samples, tau.shape[1]))
        psi0 = point[:, self.nx] if self.heading else np.full(len(point), r.start[-1])
        with np.errstate(all="ignore"):
            free = simulate(
                structure, r.theta, point[:, : self.nx], held, r.sample_time,
                psi=None if turns else np.full(samples + 1, r.start[-1]), psi0=psi0,
                d=np.broadcast_to(r.d, (samples, r.d.size)) if r.d.any() else None,
                integrator=r.integrator, bound=np.full(self.nx, _UNSTABLE),
            )  # fmt: skip
        good = np.asarray(np.isfinite(free.x).all(axis=(1, 2)) & (free.diverged < 0))
        x = np.where(good[:, None, None], free.x, 0.0)
        psi = np.broadcast_to(free.psi, x.shape[:2])
        return x, np.where(good[:, None], psi, 0.0), good

    def sums(self, x: Array, psi: Array, tau: Array) -> Array:
        """Return the sums (R, F) of runs (R, n+1, nx), (R, n+1) under (R, n, nu)."""
        z, a = self.information.regressors(x[:, :-1], psi[:, :-1], tau)
        out = np.empty((len(x), self.entries + self.nx))
        first = 0
        for i, rows in enumerate(self.rows):
            full = np.concatenate([z[rows], np.ones((1, *z.shape[1:]))])
            unit = solve_triangular(self.root[i], full.reshape(len(full), -1), lower=True)
            unit = np.ascontiguousarray(unit.reshape(full.shape).transpose(1, 0, 2))
            gram = unit @ unit.transpose(0, 2, 1)
            upper = self.corner[i]
            out[:, first : first + len(upper[0])] = gram[:, upper[0], upper[1]]
            first += len(upper[0])
        if self.relaxed:
            out[:, first:] = self.information.process_std**2 * tau.shape[1]
        else:
            spread = np.einsum("icrn,c->ri", a**2, self.information.channel_std**2)
            fixed = self.own + self.information.process_std**2
            out[:, first:] = spread + fixed * tau.shape[1]
        return out

    def value(self, sums: Array, chord: _Chord) -> tuple[float, Array]:
        """Return F of sums (F,) and its derivative in them."""
        size = sum(len(r) for r in self.rows)
        gram, first = np.zeros((size, size)), 0
        score, turns = np.zeros_like(gram), []
        for rows, corner, root, low in zip(
            self.rows, self.corner, self.root, chord.low, strict=True
        ):
            n = len(rows) + 1
            part = np.zeros((n, n))
            part[corner] = sums[first : first + len(corner[0])]
            part = root @ (part + np.triu(part, 1).T) @ root.T
            turn = np.hstack([np.eye(n - 1), -(part[:-1, -1] / part[-1, -1])[:, None]])
            centred = turn @ part @ turn.T
            block = np.ix_(rows, rows)
            gram[block], score[block] = centred, low * centred
            turns.append(turn)
            first += len(corner[0])
        value, d_gram, d_score = self.problem.criterion.gradient(Moments(gram[None], score[None]))
        slope, first = np.zeros(len(sums)), 0
        for i, (rows, corner) in enumerate(zip(self.rows, self.corner, strict=True)):
            block = np.ix_(rows, rows)
            inner = turns[i].T @ (d_gram[block] + chord.low[i] * d_score[block]) @ turns[i]
            inner = self.root[i].T @ inner @ self.root[i]
            inner += np.triu(inner, 1) + np.tril(inner, -1)
            slope[first : first + len(corner[0])] = inner[corner]
            first += len(corner[0])
        slope[first:] = -chord.slope / self.samples
        value -= float(chord.slope @ (sums[first:] / self.samples - chord.low))
        return value, slope

    def true_value(self, sums: Array) -> float:
        """Return the criterion of one sequence, its own variance in place of any range."""
        own = sums[self.entries :] / self.samples
        return self.value(sums, _Chord(own, own, np.zeros(self.nx), np.zeros(self.nx)))[0]

    def _reach(self) -> tuple[Array, Array]:
        """Return the range of the states (axes,) that many sequences reach."""
        rng, holds = self.rng, self.problem.schedule.holds
        pick = _draw_forces(self.candidates, _FORCES[0])
        which = rng.integers(0, len(pick), (_PROBES, holds))
        # constant forces, and pairs that alternate every one to six holds
        which[: len(pick)] = np.arange(len(pick))[:, None]
        pairs = rng.integers(0, len(pick), (_PROBES // 2, 2))
        period = rng.integers(1, 7, _PROBES // 2)
        turn = (np.arange(holds) // period[:, None]) % 2
        which[-len(pairs) :] = np.take_along_axis(pairs, turn, axis=1)
        point = np.broadcast_to(self.start, (_PROBES, self.axes))
        found = [np.array(self.rollout.start[None, : self.nx])]
        x, psi, _ = self.first
        found.append(x[~self.misses(x, psi, 0.0)].reshape(-1, self.nx))
        for k in range(holds):
            x, psi, good = self.run(point, pick[which[:, k]], self.hold)
            good &= ~self.misses(x, psi, 0.0)
            point = self.place(x, psi)
            found.append(x[good, -1])
            if not good.any():
                break
            # what left the limits goes on from what has not
            stay = np.flatnonzero(good)
            point = np.where(good[:, None], point, point[rng.choice(stay, len(point))])
        every = np.concatenate(found)
        low, high = every.min(axis=0), every.max(axis=0)
        wider = _WIDER * np.maximum(high - low, 1e-9)
        low, high = low - wider, high + wider
        if self.heading:
            low, high = np.append(low, 0.0), np.append(high, 2 * np.pi)
        return low, high

    @property
    def start(self) -> Array:
        """Where the trial starts, (axes,)."""
        return np.array(self.rollout.start[: self.axes])

    def place(self, x: Array, psi: Array) -> Array:
        """Return the points (R, axes) where runs end."""
        end = x[:, -1]
        return np.column_stack([end, psi[:, -1] % (2 * np.pi)]) if self.heading else end

    def misses(self, x: Array, psi: Array, room: Array | float) -> NDArray[np.bool_]:
        """Return which runs miss a limit on the speeds by more than `room` of each axis, (R,)."""
        if self.limits is None or not self.limits.path_limits:
            return np.zeros(len(x), bool)
        state = np.zeros((*psi.shape, self.nx + 3))
        state[..., : self.nx], state[..., self.nx] = x, psi
        missed = self.limits.path_values(state[:, 1:]).max(axis=-1)
        names = self.rollout.structure.states
        sides = np.broadcast_to(room, (self.axes,))
        side = {n: float(sides[i]) for i, n in enumerate(names)}
        most = np.array([limit.reach(side) for limit in self.limits.path_limits])
        return np.asarray((missed > most[:, None]).any(axis=0))


@dataclass(frozen=True)
class _Chord:
    """Straight lines above −log s between the least and the largest variance, (nx,).

    ``counted`` says how many wanted parameters each equation has, ``slope`` how steep
    the line is for all of them.
    """

    low: Array
    high: Array
    slope: Array
    counted: Array

    @classmethod
    def between(cls, low: Array, high: Array, trial: _Trial) -> _Chord:
        """Return the chords, or the value at the least variance for more than a determinant."""
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = np.where(high > low * (1 + 1e-9), np.log(high / low) / (high - low), 1 / low)
        criterion = trial.problem.criterion
        plain = criterion.optimality.determinant and criterion.prior is None
        counted = trial.wanted if plain else np.zeros(trial.nx)
        return cls(low, high, slope * counted, counted)

    @property
    def gap(self) -> Array:
        """By how much the chords lie above −log s at most, all parameters together, (nx,)."""
        ratio = np.maximum(self.high / self.low, 1 + 1e-9)
        rise = np.log(ratio) / (ratio - 1)
        return np.asarray(np.maximum(rise - 1 - np.log(rise), 0.0) * self.counted)

    def halves(self, trial: _Trial) -> tuple[_Chord, _Chord]:
        """Return the chords of both halves of the range that is farthest from −log s."""
        i = int(np.argmax(self.gap))
        low, high = self.low.copy(), self.high.copy()
        low[i] = high[i] = np.sqrt(self.low[i] * self.high[i])
        return _Chord.between(self.low, high, trial), _Chord.between(low, self.high, trial)


@dataclass(frozen=True)
class _Grid:
    """Points at equal steps along each axis, the last one periodic where it is the heading."""

    low: Array
    step: Array
    shape: tuple[int, ...]
    periodic: bool

    def points(self) -> Array:
        """Return all points, (S, axes)."""
        axes = [
            a + h * np.arange(n) for a, h, n in zip(self.low, self.step, self.shape, strict=True)
        ]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))

    def weights(self, point: Array) -> csr_matrix:
        """Return the matrix (R, S) that interpolates linearly at points (R, axes)."""
        count = int(np.prod(self.shape))
        place = np.zeros((len(point), 1), int)
        share = np.ones((len(point), 1))
        for i, n in enumerate(self.shape):
            at = (point[:, i] - self.low[i]) / self.step[i]
            wraps = self.periodic and i == len(self.shape) - 1
            if not wraps:
                at = np.clip(at, 0, n - 1)
            cell = np.floor(at).astype(int) if wraps else np.minimum(at.astype(int), n - 2)
            part = at - cell
            both = np.stack([cell % n, (cell + 1) % n], axis=1)
            place = (place[:, :, None] * n + both[:, None, :]).reshape(len(point), -1)
            share = share[:, :, None] * np.stack([1 - part, part], axis=1)[:, None, :]
            share = share.reshape(len(point), -1)
        rows = np.arange(len(point) + 1) * place.shape[1]
        data = (share.ravel().astype(np.float32), place.ravel().astype(np.int32), rows)
        return csr_matrix(data, shape=(len(point), count))


class _Programme:
    """Maximises linear functionals of the sums on a grid, each stage a hold."""

    def __init__(self, trial: _Trial, tau: Array, shape: tuple[int, ...]) -> None:
        self.trial, self.tau = trial, tau
        # along a sequence more forces are tried than at each point
        self.rich = np.concatenate([tau, _draw_forces(trial.candidates, _RICH)])
        entries = trial.entries + trial.nx
        intervals = np.array(shape) - 1
        if trial.heading:
            intervals[-1] += 1
        self.grid = _Grid(trial.low, (trial.high - trial.low) / intervals, shape, trial.heading)
        start = self.grid.points()
        holds = trial.problem.schedule.holds
        self.last = trial.samples - (holds - 1) * trial.hold
        number = len(start) * len(self.tau)
        self.table = np.empty((number, entries), np.float32)
        self.final = self.table
        if self.last != trial.hold:
            self.final = np.empty_like(self.table)
        ends = np.empty((number, trial.axes))
        barred = np.empty(number, bool)
        for first in range(0, number, _TOGETHER):
            k = np.arange(first, min(first + _TOGETHER, number))
            self._fill(start[k // len(self.tau)], self.tau[k % len(self.tau)], k, ends, barred)
        self.bar = barred.reshape(-1, len(self.tau))
        self.next = self.grid.weights(ends)
        self.solved = 0

    def _fill(
        self, point: Array, tau: Array, k: Whole, ends: Array, barred: NDArray[np.bool_]
    ) -> None:
        trial = self.trial
        x, psi, good = trial.run(point, tau, trial.hold)
        held = np.broadcast_to(tau[:, None], (len(k), trial.hold, tau.shape[1]))
        self.table[k] = trial.sums(x, psi, held)
        if self.last != trial.hold:
            n = self.last
            self.final[k] = trial.sums(x[:, : n + 1], psi[:, : n + 1], held[:, :n])
        barred[k] = ~good | trial.misses(x, psi, _MISSED * self.grid.step)
        ends[k] = trial.place(x, psi)

    def maximise(self, weights: Array) -> tuple[float, Array | None]:
        """Return the largest ⟨weights, sums⟩ over all sequences, and the sums of one near it.

        None in place of the latter where it comes to a state that no force leads on from.
        What a richer choice of forces adds along that sequence is added: by the identity
        of the difference of two policies (Kakade and Langford, 2002) that is the whole
        difference where the value of the grid is right.

        Points from which every force misses a limit count for nothing where the
        value is interpolated, unless all around are such.
        """
        trial = self.trial
        self.solved += 1
        w = weights.astype(np.float32)
        whole, end = self.table @ w, self.final @ w
        holds, width = trial.problem.schedule.holds, len(self.tau)
        value = np.zeros(self.next.shape[1], np.float32)
        ahead: list[tuple[Array, Array]] = [(value, np.ones_like(value))]
        for k in range(holds - 1, -1, -1):
            now = (end if k == holds - 1 else whole).reshape(-1, width)
            value, alive = ahead[-1]
            future = self.next @ value
            bar = self.bar
            if not alive.all():
                weight = self.next @ alive
                future = future / np.maximum(weight, 1e-6)
                bar = bar | (weight < _ALIVE).reshape(-1, width)
            total = np.where(bar, -np.inf, now + future.reshape(-1, width)).max(axis=1)
            good = np.isfinite(total)
            ahead.append((np.where(good, total, 0.0).astype(np.float32), good.astype(np.float32)))
            if k == 1:
                break
        ahead.reverse()
        # where the limits leave no way on, once more with a wider berth
        bound, sums = self._forward(weights, ahead[:holds], _SAFE[0])
        if sums is None:
            sums = self._forward(weights, ahead[:holds], _SAFE[1])[1]
        return bound, sums

    def _forward(
        self, weights: Array, ahead: list[tuple[Array, Array]], berth: float
    ) -> tuple[float, Array | None]:
        """Take the best force at each hold from the true state, as long as one is allowed."""
        trial = self.trial
        point, bound, total = trial.start, -np.inf, np.zeros(len(weights))
        for k, (value, alive) in enumerate(ahead):
            n = self.last if k == len(ahead) - 1 else trial.hold
            x, psi, good = trial.run(np.tile(point, (len(self.rich), 1)), self.rich, n)
            held = np.broadcast_to(self.rich[:, None], (len(self.rich), n, self.rich.shape[1]))
            sums = trial.sums(x, psi, held)
            ends = trial.place(x, psi)
            step = self.grid.weights(ends)
            weight = step @ alive
            found = sums @ weights + step @ value / np.maximum(weight, 1e-6)
            allowed = good & ~trial.misses(x, psi, _MISSED * self.grid.step) & (weight >= _ALIVE)
            if k == 0 and not allowed.any():
                # limits that no force keeps from the start say nothing
                return float(np.where(good, found, -np.inf).max()), None
            if not allowed.any():
                return bound, None
            found = np.where(allowed, found, -np.inf)
            known = found[: len(self.tau)].max()
            if k == 0:
                bound = float(found.max())
            elif np.isfinite(known):
                # what more forces add at this hold, hold by hold the whole difference of values
                bound += float(found.max() - known)
            safe = allowed & (weight >= berth)
            j = int(np.argmax(np.where(safe if safe.any() else allowed, found, -np.inf)))
            total += sums[j]
            point = ends[j]
            if not trial.heading:
                trial.low, trial.high = np.minimum(trial.low, point), np.maximum(trial.high, point)
        return bound, total

    def variances(self) -> tuple[Array, Array]:
        """Return the least and the largest average variance of any sequence, (nx,) each."""
        trial = self.trial
        low, high = np.empty(trial.nx), np.empty(trial.nx)
        for i in range(trial.nx):
            weights = np.zeros(trial.entries + trial.nx)
            weights[trial.entries + i] = 1.0 / trial.samples
            if trial.relaxed:
                low[i] = high[i] = trial.information.process_std[i] ** 2
                continue
            scale = trial.samples / float(self.table[:, trial.entries + i].mean())
            high[i] = self.maximise(scale * weights)[0] / scale
            low[i] = -self.maximise(-scale * weights)[0] / scale
        met = trial.known[:, trial.entries :] / trial.samples
        low, high = np.minimum(low, met.min(axis=0)), np.maximum(high, met.max(axis=0))
        return (low, high) if trial.relaxed else (low / _SPREAD, high * _SPREAD)


def _programme(trial: _Trial, level: int, share: float) -> _Programme:
    """Return the programme of the first or of the finer grid, as fine as time and memory allow."""
    tau = _draw_forces(trial.candidates, _FORCES[level])
    room = share * min(
        _BYTES[level] / (4.0 * (trial.entries + trial.nx) * len(tau)),
        _SAMPLES[level] / (trial.hold * len(tau)),
    )
    points = max(_FEWEST, min(_POINTS[level], int(room ** (1 / trial.axes))))
    return _Programme(trial, tau, (points,) * trial.axes)


class _Mixture:
    """A mixture of sequences whose criterion is raised by what the programme finds."""

    def __init__(self, trial: _Trial, chord: _Chord, before: _Mixture | None = None) -> None:
        self.trial, self.chord = trial, chord
        if before is None:
            values = [trial.value(s, chord)[0] for s in trial.known]
            order = np.argsort(-np.nan_to_num(np.array(values), neginf=-1e300))
            keep = np.unique(np.append(0, order[:_KEPT]))
            self.sums = trial.known[keep]
            self.weights = np.full(len(keep), 1.0 / len(keep))
        else:
            self.sums, self.weights = before.sums, before.weights
        self.least = np.inf
        self._renew()

    @property
    def members(self) -> int:
        """Sequences of some weight."""
        return int((self.weights > 1e-3).sum())

    def tangent(self) -> tuple[float, Array, float]:
        """Return the criterion of the mixture, its derivative, and its product with the sums."""
        mixed = self.weights @ self.sums
        value, slope = self.trial.value(mixed, self.chord)
        return value, slope, float(slope @ mixed)

    def improve(self, programme: _Programme, steps: int, floor: float) -> None:
        """Add sequences until the gap is small, or the bound no higher than a floor."""
        enough = _ENOUGH * len(self.trial.problem.criterion.wanted)
        for _ in range(steps):
            value, slope, base = self.tangent()
            best, sums = programme.maximise(slope)
            self.least = min(self.least, value + max(best - base, 0.0))
            if sums is None:
                break
            gain = float(slope @ sums) - base
            if self.least < max(value, floor) + enough or gain <= enough / 20:
                break
            self.sums = np.concatenate([self.sums, sums[None]])
            self.weights = np.append(0.9 * self.weights, 0.1)
            self._renew()

    def _renew(self) -> None:
        """Give the sequences the weights that maximise the criterion."""

        def worth(parts: list[Array]) -> tuple[float, list[Array]]:
            value, slope = self.trial.value(parts[0] @ self.sums, self.chord)
            return value, [self.sums @ slope]

        weights = best_weights(worth, [self.weights], 100, least=1e-5)[0]
        keep = weights > 1e-7
        self.sums, self.weights = self.sums[keep], weights[keep] / weights[keep].sum()
