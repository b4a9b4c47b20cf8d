"""How far a designed trial is at most from the best that any admissible input could reach.

Every admissible sequence has an information matrix I = C⁻¹ of the wanted
parameters, from the covariance C of the estimator really used. Each criterion F
is concave in I, so that with any mixture X = Σ wᵢ Iᵢ of sequences

    F(I) ≤ F(X) + ⟨∇F(X), I − X⟩ for every sequence,

the equivalence theorem of optimal design. What remains is to maximise the linear
functional ⟨∇F(X), I⟩ over all sequences; the weights are improved until the
maximum adds little. That maximisation is by many ascents, so that the bound is
numerical. Dynamic programming replaces the ascents for a trial in surge alone, with
one state and one force (`surge_bound`), and for the information of an equation
error, a sum over samples (`trajectory_bound`): that of white residuals, and
G M⁻¹ G ⪯ ΦᵀΦ/q of zero-mean IV with the process noise of variance q as the floor of
the error. Output error has its sensitivities as states of their own, too many for a
grid, and no bound.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiment_design.certificate.mixture import best_weights
from experiment_design.certificate.surge_bound import bound_surge, why_not_surge
from experiment_design.certificate.trajectory_bound import (
    TrajectoryBound,
    bound_trajectory,
    relaxed_value,
    why_not_trajectory,
)
from experiment_design.constraints.limit_program import LimitProgram
from experiment_design.constraints.limits import TrialLimits
from experiment_design.criteria.covariance import Criterion
from experiment_design.information.moments import Moments
from experiment_design.information.sensitivities import SensitivityProgram
from experiment_design.optimise.search import ascend, draw_two_level, perturb
from experiment_design.request.problem import TrialProblem
from greybox.notebook import DisplayMixin, text
from greybox.numerics.linalg import scaled_inverse

Array = NDArray[np.float64]

# evaluations of one ascent of the linear functional
_ASCENT = 60
# random sequences that the mixture starts from, and how many of the best it keeps
_DRAWS = 200
_KEPT = 10
# evaluations of the linear functional in all ascents, usually and at least
_BUDGET = 1200
_LEAST = 150
# a gap that only a search that found nothing leaves
_CONVERGED = 1e-6
# scenarios of an uncertain prior model that are certified one by one
_SCENARIOS = 8
# wanted parameters up to which the information of all columns is mixed: a matrix of
# few entries would leave no room for what the ascents miss
_FEW = 3
# smallest eigenvalue of a correlation-scaled score matrix that is inverted
_FLOOR = 1e-13
_TOLERANCE = 1e-4
# efficiency below which a bound says nothing
INFORMATIVE = 0.1

_HULL = (
    "Equivalence theorem on mixtures of the information matrices of whole sequences; the linear "
    "functional is maximised over sequences by {count} ascents from perturbed and random starts."
)
_HULL_CHECKED = (
    "Numerical: an ascent may miss a better sequence, so every sequence that was met counts and "
    "what the last third of the search still raised is added; compared with exhaustive search on "
    "short trials in the tests."
)
_SURGE = (
    "Mixtures of the summed moments of all sequences, improved from {starts} starts; each step "
    "maximises its linear functional over all sequences by dynamic programming on a grid of speed "
    "and force, which ignores the limits on the motion."
)
_SURGE_CHECKED = (
    "Numerical: the criterion of a mixture is not concave, so that the largest of several starts "
    "stands for the maximum; the starts agree within {spread:.2g}, a grid twice as fine moved the "
    "bound by {grid:.2g}, which is added; compared with exhaustive search in the tests."
)
_GRID = (
    "Equivalence theorem on mixtures of the summed information of whole sequences; each step "
    "maximises its linear functional over all sequences by dynamic programming on a grid of "
    "{points} states with {forces} forces, which keeps limits on the speeds to half a cell and "
    "ignores other limits."
)
_FLOORED = " The process noise alone stands for the error: G M⁻¹ G ⪯ ΦᵀΦ/q."
_GRID_CHECKED = (
    "Numerical: a grid of {points} states with {forces} forces raised the bound by {grid:.2g}, "
    "which is added; the average variance of the error was split into {ranges} ranges, whose "
    "chords add {chord:.2g} at most; compared with exhaustive search in the tests."
)


class Kind(Enum):
    """The kind of a certificate."""

    PROVEN = "proven"
    NUMERICAL = "numerical"
    NOT_INFORMATIVE = "not informative"
    NOT_AVAILABLE = "not available"


@dataclass(frozen=True, repr=False)
class Certificate(DisplayMixin):
    """At least which fraction of the best possible a design reaches.

    Parameters
    ----------
    efficiency_lower_bound : float or None
        (det C_bound / det C)^(1/p) for D, the ratio of the criterion's variances
        for A, E and c; None where not available, or below 0.1 and not informative.
    value, bound : float
        Criterion of the design, and what no admissible input exceeds.
    gap : float
        Part of the bound that the mixture itself did not reach.
    mixture : int
        Sequences, or moments, in the mixture.
    evaluations : int
        Sequences or steps of dynamic programming that were evaluated.
    rigorous : bool
        Whether the bound is proven, rather than numerical.
    method, checked : str
        One sentence each: how it was found, how it was checked.
    reason : str
        Why it is not available; empty where it is.
    wall_s : float
        [s]
    """

    efficiency_lower_bound: float | None
    value: float
    bound: float
    gap: float
    mixture: int
    evaluations: int
    rigorous: bool
    method: str
    checked: str
    reason: str = ""
    wall_s: float = 0.0

    @property
    def kind(self) -> Kind:
        """Whether the bound is proven, numerical, too low to say anything, or missing."""
        if self.efficiency_lower_bound is not None:
            return Kind.PROVEN if self.rigorous else Kind.NUMERICAL
        return Kind.NOT_AVAILABLE if self.reason else Kind.NOT_INFORMATIVE

    def sentence(self) -> str:
        """Return one sentence for the summary of a design."""
        if self.kind is Kind.NOT_INFORMATIVE:
            return (
                "certificate: not informative (how near the plan is to the best one is not known: "
                "the bound is more than 10 times the plan)"
            )
        if self.efficiency_lower_bound is None:
            return f"certificate: not available because {self.reason}"
        kind = "proven" if self.rigorous else "numerical bound"
        percent = int(100 * self.efficiency_lower_bound)
        return f"certificate: at least {percent} % of the best that any input could reach ({kind})"

    def summary(self) -> str:
        """Return the sentence with how the bound was found and checked."""
        return "\n  ".join([self.sentence(), *self._told()])

    def _told(self) -> list[str]:
        """Return how a bound was found and checked that says something."""
        if self.kind is Kind.NOT_INFORMATIVE:
            return []
        return [p for p in (self.method, self.checked) if p]

    def _line(self) -> str:
        return self.sentence()

    def _parts(self) -> tuple[str, ...]:
        return tuple(text(p) for p in self._told())

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON, without the wall time; not finite numbers as None.

        Of a bound that is not informative, only that.
        """
        if self.kind is Kind.NOT_INFORMATIVE:
            return {"kind": self.kind.value}
        out = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "wall_s"}
        return {"kind": self.kind.value} | {
            k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in out.items()
        }


@dataclass(frozen=True)
class _Part:
    """Bound under one scenario, fields as `Certificate`."""

    value: float
    bound: float
    gap: float
    mixture: int
    evaluations: int
    method: str
    checked: str


@dataclass(frozen=True)
class _Tangent(Criterion):
    """The linear functional ⟨weights, I⟩ of one trial's information, in place of a criterion.

    With ``whole`` I = G M⁻¹ G of all columns, otherwise C⁻¹ of the wanted ones.
    """

    weights: Array = field(default_factory=lambda: np.zeros((0, 0)))
    whole: bool = False

    def value(self, moments: Moments) -> Array:
        """Return the functional of each sequence, (R,)."""
        info = _information(self, moments, self.whole)
        found = np.einsum("ij,rji->r", self.weights, np.where(np.isfinite(info), info, 0.0))
        return np.where(np.isfinite(info).all(axis=(1, 2)), found, -np.inf)

    def gradient(self, moments: Moments) -> tuple[float, Array, Array]:
        """Return the functional of one sequence and its derivatives in G and M."""
        size = moments.gram.shape[1]
        none = (-np.inf, np.zeros((size, size)), np.zeros((size, size)))
        if self.whole:
            inverse, good = _pseudo_inverse(moments.score_covariance)
            if not good[0]:
                return none
            ratio = inverse[0] @ moments.gram[0]
            side = ratio @ self.weights
            value = float((self.weights * (moments.gram[0] @ ratio)).sum())
            return value, side + side.T, -side @ ratio.T
        c, rows, g, fit = self._solve(moments)
        if not fit[0]:
            return none
        info = np.linalg.inv(c[0])
        d_score = rows[0].T @ (-info @ self.weights @ info) @ rows[0]
        side = d_score @ moments.score_covariance[0] @ g[0]
        return float((self.weights * info).sum()), -(side + side.T), d_score


def _pseudo_inverse(score: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the inverse (R, p, p) on what is excited, and whether the sums are finite."""
    good = np.asarray(np.isfinite(score).all(axis=(1, 2)))
    score = np.where(good[:, None, None], score, 0.0)
    return scaled_inverse(score, _FLOOR), good


def _information(criterion: Criterion, moments: Moments, whole: bool) -> Array:
    """Return the information of each sequence, infinite where it has none."""
    if whole:
        inverse, good = _pseudo_inverse(moments.score_covariance)
        info = np.asarray(moments.gram @ inverse @ moments.gram)
    else:
        c, _, _, fit = criterion._solve(moments)
        good = fit > 0
        c[~good] = np.eye(c.shape[1])
        info = np.asarray(np.linalg.inv(c))
    info = (info + info.transpose(0, 2, 1)) / 2
    info[~good] = np.inf
    return info


def _concave(criterion: Criterion, info: Array) -> tuple[float, Array]:
    """Return the criterion at an information matrix and its derivative."""
    value, d_gram, d_score = criterion.gradient(Moments(info[None], info[None]))
    return value, d_gram + d_score


def _slack(criterion: Criterion) -> float:
    """Return how much what is climbed may lie below the criterion."""
    return criterion.optimality.slack(len(criterion.wanted))


class _Pool:
    """The sequences of one trial that were met, with their information."""

    def __init__(self, problem: TrialProblem, unit: Array, whole: bool) -> None:
        self.problem = problem
        self.whole = whole
        self.units: list[Array] = [unit]
        self.info = self.information(unit[None])

    def information(self, units: Array) -> Array:
        """Return the information of sequences (R, K, nc)."""
        problem = self.problem
        motion = problem.scenarios[0].rollout.run(problem.commands(units))
        return _information(problem.criterion, problem.moments(motion, 0), self.whole)

    def add(self, units: Array) -> None:
        """Add sequences that excite everything."""
        info = self.information(units)
        good = np.isfinite(info).all(axis=(1, 2))
        self.units += list(units[good])
        self.info = np.concatenate([self.info, info[good]])


def _mixture(pools: list[_Pool], weights: list[Array]) -> Array:
    parts = [np.tensordot(w, p.info, 1) for p, w in zip(pools, weights, strict=True)]
    return np.asarray(sum(parts[1:], parts[0]))


def _best_weights(outer: Criterion, pools: list[_Pool], weights: list[Array]) -> list[Array]:
    """Return the weights that maximise the criterion of the mixture, each trial's sum one."""

    def worth(parts: list[Array]) -> tuple[float, list[Array]]:
        value, slope = _concave(outer, _mixture(pools, parts))
        return value, [np.einsum("ij,rij->r", slope, pool.info) for pool in pools]

    return best_weights(worth, weights, 150)


def _bound_hull(
    problems: Sequence[TrialProblem],
    units: Sequence[Array],
    seed: int,
    budget: int,
) -> tuple[float, float, int, int, int]:
    """Return the bound, its gap, the mixture's size, evaluations and ascents."""
    criterion = problems[0].criterion
    whole = len(problems) > 1 or len(criterion.wanted) <= _FEW
    # of matrices that hold the wanted columns alone
    outer = criterion if whole else replace(criterion, wanted=tuple(range(len(criterion.wanted))))
    rng = np.random.default_rng([13, seed])
    pools = [_Pool(p, u, whole) for p, u in zip(problems, units, strict=True)]
    weights, spent, ascents = [], 0, 0
    for pool in pools:
        draws = draw_two_level(pool.problem, rng, _DRAWS)
        result = pool.problem.evaluate(draws)
        good = np.flatnonzero(result.feasible(_TOLERANCE))
        best = good[np.argsort(-result.value[good])[:_KEPT]]
        if best.size:
            pool.add(draws[best])
        weights.append(np.full(len(pool.units), 1.0 / len(pool.units)))
    history: list[tuple[int, float, Array, float]] = []
    turn = 0
    while spent < budget:
        weights = _best_weights(outer, pools, weights)
        mixed = _mixture(pools, weights)
        value, slope = _concave(outer, mixed)
        history.append((spent, value, slope, float((slope * mixed).sum())))
        for t, pool in enumerate(pools):
            own = {f.name: getattr(criterion, f.name) for f in fields(criterion)}
            tangent = _Tangent(**own, weights=slope, whole=whole)
            linear = replace(pool.problem, criterion=tangent)
            likely = pool.units[int(rng.choice(len(pool.units), p=weights[t]))]
            other = (
                draw_two_level(pool.problem, rng, 1)[0]
                if turn % 2
                else pool.units[int(rng.integers(len(pool.units)))]
            )
            found = [ascend(linear, u, _ASCENT) for u in (perturb(likely, rng), other)]
            spent += sum(c.evaluations for c in found)
            ascents += len(found)
            values = np.einsum("ij,rij->r", slope, pool.info)
            keep = [c for c in found if c.feasible and c.value > weights[t] @ values]
            if keep:
                pool.add(np.array([c.unit for c in keep]))
                more = np.full(len(pool.units) - len(weights[t]), 0.05)
                weights[t] = np.concatenate([0.95 * weights[t], more])
                weights[t] /= weights[t].sum()
        turn += 1
    weights = _best_weights(outer, pools, weights)
    last = _concave(outer, _mixture(pools, weights))[0]
    split = max(i for i, row in enumerate(history) if row[0] <= 2 * spent / 3)
    # every tangent of the last third against every sequence that was met
    tangents = [
        value + sum(float(np.einsum("ij,rij->r", slope, p.info).max()) for p in pools) - base
        for _, value, slope, base in history[split:]
    ]
    drift = max(0.0, last - history[split][1])
    bound = max(min(tangents), last) + drift + _slack(criterion)
    members = sum(int((w > 1e-3).sum()) for w in weights)
    return bound, bound - last, members, spent, ascents


def certify(
    problems: Sequence[TrialProblem],
    units: Sequence[Array],
    seed: int = 0,
    budget: int | None = None,
    effort: float = 1.0,
) -> Certificate:
    """Bound the criterion of all admissible inputs of one or several trials.

    In a campaign the covariance of the summed moments is no smaller than that of
    the summed information G M⁻¹ G, to which each trial adds its own part.

    Parameters
    ----------
    problems : sequence of TrialProblem
        One per trial. Sums of earlier trials in ``known`` count for a single trial;
        in a campaign they are left out.
    units : sequence of ndarray
        (K, nc) unit coordinates of each trial's design.
    seed : int
    budget : int, optional
        Evaluations to spend; a few seconds by default.
    effort : float
        Share of the default budget.

    Returns
    -------
    Certificate

    References
    ----------
    Kiefer and Wolfowitz (1960), the equivalence theorem.
    """
    began = time.perf_counter()
    first = problems[0]
    if any(p.contrast is not None for p in problems):
        return absent("discrimination between models maximises no information matrix", began)
    if any(isinstance(s.information, SensitivityProgram) for p in problems for s in p.scenarios):
        return absent(
            "output error has its sensitivities as states of their own, and no bound is known",
            began,
        )
    count = len(first.scenarios)
    if count > _SCENARIOS:
        return absent(
            f"{count} scenarios of the prior model would need as many bounds, and at most "
            f"{_SCENARIOS} are made",
            began,
        )
    spend = max(_LEAST, round(_BUDGET * effort)) if budget is None else budget
    spend = max(4 * _ASCENT, spend // count)
    parts: list[_Part] = []
    for i in range(count):
        alone = [_single(p, i, len(problems) == 1) for p in problems]
        total = [
            p.moments(p.scenarios[0].rollout.run(p.commands(u[None])), 0)
            for p, u in zip(alone, units, strict=True)
        ]
        value = float(first.criterion.value(sum(total[1:], total[0]))[0])
        if not np.isfinite(value):
            return absent("the design leaves some direction without excitation", began)
        limits = first.scenarios[i].limits
        parts.append(_bound(alone, units, value, seed, spend, limits, 1.0 / count))
    if min(p.gap for p in parts) < _CONVERGED and first.scenarios[0].rollout.nx > 1:
        return absent(
            "its search met no sequence beside the design that tells more, which is too good to be "
            "believed after so few ascents: raise --effort",
            began,
        )
    share = np.array([s.weight for s in first.scenarios])
    values = np.array([p.value for p in parts])
    bounds = np.array([p.bound for p in parts])
    value = float(values.min() if first.worst_case else values @ share / share.sum())
    bound = float(bounds.min() if first.worst_case else bounds @ share / share.sum())
    size = first.criterion.shared_by
    several = f"Each of {count} scenarios by itself. " if count > 1 else ""
    efficiency = float(np.exp(min(value - bound, 0.0) / size))
    return Certificate(
        efficiency if efficiency >= INFORMATIVE else None,
        value,
        bound,
        max(p.gap for p in parts),
        sum(p.mixture for p in parts),
        sum(p.evaluations for p in parts),
        False,
        several + parts[0].method,
        parts[0].checked,
        "",
        time.perf_counter() - began,
    )


def _single(problem: TrialProblem, scenario: int, known: bool) -> TrialProblem:
    """Return the problem under one scenario, with the sums of other trials where wanted.

    Limits on the motion and on the rates are dropped: that only raises the bound,
    and ascents that had to keep them would be spent on keeping them.
    """
    schedule = replace(problem.schedule, reach=np.full(len(problem.schedule.commands), np.inf))
    chosen = problem.scenarios[scenario]
    free = replace(chosen, limits=LimitProgram(chosen.rollout, schedule, TrialLimits()))
    return replace(
        problem,
        schedule=schedule,
        scenarios=(free,),
        known=problem.known[scenario : scenario + 1] if known else (),
    )


def _bound(
    problems: list[TrialProblem],
    units: Sequence[Array],
    value: float,
    seed: int,
    budget: int,
    limits: LimitProgram,
    share: float,
) -> _Part:
    """Bound one scenario, whose own limits the problems have lost."""
    criterion = problems[0].criterion
    if len(problems) == 1 and not why_not_surge(problems[0]):
        found = bound_surge(problems[0], units[0], seed)
        return _Part(
            value,
            max(found.bound + _slack(criterion), value),
            found.gap,
            found.mixture,
            found.evaluations,
            _SURGE.format(starts=found.starts),
            _SURGE_CHECKED.format(spread=found.spread, grid=found.grid),
        )
    if len(problems) == 1 and not why_not_trajectory(problems[0]):
        grid = bound_trajectory(problems[0], units[0], seed, limits=limits, share=share)
        return _of_grid(grid, criterion, value)
    bound, gap, members, spent, ascents = _bound_hull(problems, units, seed, budget)
    part = _Part(
        value, max(bound, value), gap, members, spent, _HULL.format(count=ascents), _HULL_CHECKED
    )
    if len(problems) == 1 and not why_not_trajectory(problems[0], relaxed=True):
        # even if the design had the most information that the floor allows
        least = relaxed_value(problems[0], units[0])
        if least < part.bound and value - least > criterion.shared_by * np.log(INFORMATIVE):
            grid = bound_trajectory(
                problems[0], units[0], seed, limits=limits, relaxed=True, share=share
            )
            floored = _of_grid(grid, criterion, value)
            part = min(part, floored, key=lambda p: p.bound)
    return part


def _of_grid(grid: TrajectoryBound, criterion: Criterion, value: float) -> _Part:
    """Return what dynamic programming on a grid of states found."""
    return _Part(
        value,
        max(grid.bound + _slack(criterion), value),
        grid.gap,
        grid.mixture,
        grid.evaluations,
        _GRID.format(points=int(np.prod(grid.points)), forces=grid.forces[0])
        + _FLOORED * grid.relaxed,
        _GRID_CHECKED.format(
            points=int(np.prod(grid.finer)), forces=grid.forces[1], grid=grid.grid,
            ranges=grid.ranges, chord=grid.chord,
        ),
    )  # fmt: skip


def absent(reason: str, began: float | None = None) -> Certificate:
    """Return a certificate that says why there is none."""
    spent = 0.0 if began is None else time.perf_counter() - began
    return Certificate(None, np.nan, np.nan, np.nan, 0, 0, False, "", "", reason, spent)
