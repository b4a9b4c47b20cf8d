"""One trial to be designed: prior models, limits and information, as functions of the levels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from experiment_design.constraints.limit_program import LimitProgram
from experiment_design.criteria.covariance import Criterion
from experiment_design.criteria.objective import Objective, Slope
from experiment_design.excitation.rollout import Motion, Rollout
from experiment_design.excitation.schedule import Schedule
from experiment_design.information.moments import InformationModel, Moments, moments_of

Array = NDArray[np.float64]

# sequences that are evaluated together
_TOGETHER = 64
# by how many scaled units the solvers stay inside a limit
_INSIDE = 0.01


@dataclass(frozen=True)
class Scenario:
    """One possible truth: a prior model, its information model, its limits, and its weight.

    Of one without weight only the limits count.
    """

    rollout: Rollout
    information: InformationModel
    limits: LimitProgram
    weight: float = 1.0


@dataclass(frozen=True)
class Evaluation:
    """The evaluation of one batch of sequences.

    Parameters
    ----------
    value : ndarray
        (R,) criterion, expected over the scenarios; −inf where not excited.
    missed : ndarray
        (m, R) by how much each limit is missed at worst over the scenarios.
    """

    value: Array
    missed: Array

    def feasible(self, tolerance: float) -> NDArray[np.bool_]:
        """Return which sequences keep all limits and excite all directions."""
        return np.asarray((self.missed <= tolerance).all(axis=0) & np.isfinite(self.value))


@dataclass(frozen=True)
class TrialProblem:
    """A trial to be designed.

    Parameters
    ----------
    schedule : Schedule
    scenarios : tuple of Scenario
        The nominal prior model first.
    criterion : Criterion
    known : tuple of Moments, optional
        Sums of other trials of the campaign, one a scenario.
    worst_case : bool
        Look at the worst scenario instead of the expectation.
    contrast : Objective, optional
        Takes the place of the criterion, such as a distance of models.
    """

    schedule: Schedule
    scenarios: tuple[Scenario, ...]
    criterion: Criterion
    known: tuple[Moments, ...] = ()
    worst_case: bool = False
    contrast: Objective | None = None

    @property
    def objective(self) -> Objective:
        """What is to be made large."""
        return self.contrast or self.criterion

    @cached_property
    def shape(self) -> tuple[int, int]:
        """Holds and commands of the levels."""
        return self.schedule.holds, len(self.schedule.commands)

    def with_known(self, known: tuple[Moments, ...]) -> TrialProblem:
        """Return the problem with the sums of other trials added."""
        return replace(self, known=known)

    def levels(self, unit: Array) -> Array:
        """Return levels of unit coordinates in [0, 1]."""
        s = self.schedule
        return np.asarray(s.lower + (s.upper - s.lower) * unit)

    def commands(self, unit: Array) -> Array:
        """Return the commands at each sample, (..., N, nc), of unit coordinates (..., K, nc)."""
        return self.schedule.expand(self.levels(unit))

    def missed_at_start(self, begun: Array) -> Array:
        """Return what states and heading (nx + 1,) miss each path limit by, negative if kept."""
        program = self.scenarios[0].limits
        start = np.zeros(program.nx + 3)
        start[: program.nx + 1] = begun
        return np.asarray(program.path_values(start[None])[:, 0])

    def moments(self, motion: Motion, scenario: int) -> Moments:
        """Return the sums of a scenario's motion, the known ones included."""
        return moments_of(self.scenarios[scenario].information, motion, self._known_to(scenario))

    def _known_to(self, scenario: int) -> Moments | None:
        return self.known[scenario] if self.known else None

    def evaluate(self, unit: Array) -> Evaluation:
        """Evaluate sequences (R, K, nc) of unit coordinates."""
        values, missed = [], []
        for first in range(0, len(unit), _TOGETHER):
            commands = self.commands(unit[first : first + _TOGETHER])
            each, worst = [], None
            for i, scenario in enumerate(self.scenarios):
                motion = scenario.rollout.run(commands)
                value = np.zeros(len(commands))
                if scenario.weight:
                    value = self.objective.of_motion(
                        motion, scenario.information, self._known_to(i)
                    )
                value[~motion.stable] = -np.inf
                each.append(value)
                v = scenario.limits.violations(motion)
                worst = v if worst is None else np.maximum(worst, v)
            values.append(self._combine(np.array(each))[0])
            missed.append(worst)
        return Evaluation(np.concatenate(values), np.concatenate(missed, axis=1))  # type: ignore[arg-type]

    def _combine(self, each: Array) -> tuple[Array, Array]:
        """Return the value over scenarios (S, R) and the weight of each."""
        weights = np.array([s.weight for s in self.scenarios])
        weights = weights / weights.sum()
        if not self.worst_case or len(each) == 1:
            with np.errstate(invalid="ignore"):
                return weights @ each, np.broadcast_to(weights[:, None], each.shape)
        chosen = np.zeros_like(each)
        chosen[each.argmin(axis=0), np.arange(each.shape[1])] = 1.0
        return each.min(axis=0), chosen

    def gradient(
        self, unit: Array, multipliers: Array | None = None, penalty: float = 0.0
    ) -> tuple[float, float, Array, Array]:
        """Return the value, the augmented Lagrangian, its gradient, and the scaled limits.

        Parameters
        ----------
        unit : ndarray
            (K, nc) unit coordinates.
        multipliers : ndarray, optional
            (n_h,) of every limit at every sample of every scenario, rates last.
        penalty : float

        Returns
        -------
        tuple
            Criterion; criterion a wanted parameter minus the penalty terms; its
            gradient (K, nc); the limits h (n_h,), negative where kept.
        """
        s = self.schedule
        commands = self.commands(unit)
        motions = [sc.rollout.run(commands[None]) for sc in self.scenarios]
        parts: list[Slope | None] = [
            self.objective.slope(m, sc.information, self._known_to(i))
            if sc.weight and m.stable[0]
            else None
            for i, (sc, m) in enumerate(zip(self.scenarios, motions, strict=True))
        ]
        each = np.array([[p.value if p else 0.0] for p in parts])
        span = s.upper - s.lower
        if not (np.isfinite(each).all() and all(m.stable[0] for m in motions)):
            return -np.inf, -np.inf, np.zeros(self.shape), np.zeros(0)
        value, weights = self._combine(each)
        size = self.objective.size
        total = np.zeros_like(commands)
        terms, rows, first = 0.0, [], 0
        for (sc, motion), part, weight in zip(
            zip(self.scenarios, motions, strict=True), parts, weights[:, 0], strict=True
        ):
            state = motion.state[0]
            d_state = np.zeros_like(state)
            d_tau, d_commands = np.zeros_like(motion.tau[0]), np.zeros_like(commands)
            if part is not None and weight > 0:
                d_x, d_tau, d_commands = (d * weight / size for d in part.pull())
                d_state[:-1, : sc.rollout.nx + 1] = d_x
            path = sc.limits.path_values(state) / sc.limits.path_scale[:, None]
            path[:, 0] = np.minimum(path[:, 0], 0.0)
            whole = sc.limits.whole_values(motion)[:, 0] / sc.limits.whole_scale
            # a little inside, so that what the solvers leave open is no violation
            h = np.concatenate([path.ravel(), whole]) + _INSIDE
            rows.append(h)
            if h.size:
                slope, cost = _augmented(h, multipliers, first, penalty)
                terms += cost
                if slope.any():
                    weighted = slope[: path.size].reshape(path.shape)
                    weighted = weighted / sc.limits.path_scale[:, None]
                    d_state -= sc.limits.path_pull(state, weighted)
                    more = sc.limits.whole_pull(motion, slope[path.size :] / sc.limits.whole_scale)
                    d_state -= more[0]
                    d_commands -= more[1]
                first += h.size
            total += sc.rollout.pull(motion, d_state, d_tau, d_commands)
        gradient = s.gather(total) * span
        if s.limited:
            step = np.diff(unit, axis=0)
            with np.errstate(divide="ignore", invalid="ignore"):
                reach = np.where(span > 0, s.reach / span, np.inf)
            finite = np.isfinite(reach)
            h = (np.abs(step[:, finite]) - reach[finite]).ravel()
            rows.append(h)
            slope, cost = _augmented(h, multipliers, first, penalty)
            terms += cost
            pull = slope.reshape(-1, int(finite.sum())) * np.sign(step[:, finite])
            part_gradient = np.zeros(self.shape)
            part_gradient[1:, finite] += pull
            part_gradient[:-1, finite] -= pull
            gradient -= part_gradient
        h_all = np.concatenate(rows) if rows else np.zeros(0)
        return float(value[0]), float(value[0]) / size - terms, gradient, h_all


def _augmented(
    h: Array, multipliers: Array | None, first: int, penalty: float
) -> tuple[Array, float]:
    """Return the slope in h and the value of (max(0, λ + ρh)² − λ²) / 2ρ."""
    if penalty <= 0:
        return np.zeros_like(h), 0.0
    known = np.zeros_like(h) if multipliers is None else multipliers[first : first + h.size]
    slope = np.maximum(0.0, known + penalty * h)
    return slope, float(((slope**2 - known**2) / (2 * penalty)).sum())
