"""The lead-in of a trial: commands that bring the ship from where she is into the regime.

Margins are no limits on the way; sea room and caps are. Levels are drawn, and the best of them
descend along the exact gradient of what the limits are missed by (single shooting).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from experiment_design.constraints.limit_program import LimitProgram
from experiment_design.constraints.limits import TOLERANCE, Limit, PathLimit
from experiment_design.excitation.rollout import Motion, Rollout
from experiment_design.excitation.schedule import Schedule
from experiment_design.request.regimes import state_words
from experiment_design.request.request import (
    LeadIn,
    OutOfReach,
    OutOfReachError,
    PreparedRequest,
    build_problem,
)
from greybox.errors import InfeasibleError

Array = NDArray[np.float64]
Enough = Callable[[PreparedRequest], bool]

# longest lead-in [s]: a ship of 30 m has forgotten her start by then, and one of 300 m has begun
# to move; a crew that needs longer steadies her better by hand. In a refusal it is told as time
# constants of the ship at hand
LONGEST = 120.0
# of each margin: what the end of a lead-in aims at, as a steady start does, and what it must reach;
# a start on the margin itself could be left to one side only. Least margin that these are of [m/s]
_AIM, _ENOUGH, _LEAST = 1.2, 1.05, 0.05
# sequences drawn, those that descend, and iterations of each
_DRAWN, _DESCENTS, _ITERATIONS = 128, 6, 60
# scaled units by which a descent stays inside a limit
_INSIDE = 0.01
# holds over which the last commands are kept on, to see whether the ship stays in the regime
_KEPT_ON = 3
# what a limit is relaxed by, in what it is missed by, until a lead-in is found; shares of a margin
# that are tried
_RELAXED, _SHARES = (1.1, 1.5, 2.0, 3.0, 5.0), (0.95, 0.9, 0.8, 0.65, 0.4, 0.2)


def short_of_margin(request: PreparedRequest) -> bool:
    """Whether the first trial's start misses margins and nothing else."""
    problem = build_problem(replace(request, backoff=()))
    missed = problem.missed_at_start(request.starts[0]) > TOLERANCE
    margins = problem.scenarios[0].limits.of_regime
    return bool((missed & margins).any() and not (missed & ~margins).any())


def find_lead_in(request: PreparedRequest, enough: Enough | None = None) -> LeadIn | None:
    """Return the shortest lead-in into the regime, None where the start keeps its margins.

    Parameters
    ----------
    request : PreparedRequest
        Several trials begin as they are asked to.
    enough : callable, optional
        Whether a trial behind lower margins, which a refusal names, tells enough.

    Raises
    ------
    InfeasibleError
        There is none of at most 120 s; says which limit stops it and what helps.
    OutOfReachError
        That limit is a margin.
    """
    if request.trials > 1 or request.contrasts or not short_of_margin(request):
        return None
    most = int(LONGEST / request.hold + 1e-9)
    if not most:
        raise InfeasibleError(
            f"the start does not keep its margins, and a lead-in of at most {LONGEST:g} s has no "
            f"room for commands that are held {request.hold:g} s: use --hold {LONGEST:g} or less, "
            f"or change --start."
        )
    for holds in range(1, most + 1):
        found = _Shooting(request, holds).search()
        if found is not None:
            return found
    raise _refusal(request, most, enough)


def after_lead_in(
    request: PreparedRequest, enough: Enough | None = None, *, best_effort: bool = False
) -> PreparedRequest:
    """Return the request of the trial behind the lead-in that `find_lead_in` finds, if any.

    Parameters
    ----------
    request : PreparedRequest
    enough : callable, optional
        See `find_lead_in`.
    best_effort : bool
        Margins that one leads to take the place of those out of reach.
    """
    try:
        found = find_lead_in(request, enough)
    except OutOfReachError as error:
        if not best_effort:
            raise
        request = request.eased(error.told)
        found = find_lead_in(request)
    return request if found is None else found.after(request)


class _Shooting:
    """Levels of a lead-in of some holds, and by how much they miss the limits."""

    def __init__(self, request: PreparedRequest, holds: int) -> None:
        self.request = request
        problem = build_problem(replace(request, backoff=()))
        self.rollout: Rollout = problem.scenarios[0].rollout
        schedule = request.schedule
        self.schedule: Schedule = replace(schedule, samples=holds * schedule.hold, before=None)
        self.wanted = problem.scenarios[0].limits
        self.way = LimitProgram(self.rollout, self.schedule, request.limits, on_way=True)
        bound = np.array(
            [max(x.bound, _LEAST) if x.of_regime else 0.0 for x in self.wanted.path_limits]
        )
        self.aim, self.enough = (_AIM - 1) * bound, (_ENOUGH - 1) * bound

    @property
    def limits(self) -> tuple[PathLimit, ...]:
        """Limits of the way, then those at its end."""
        return (*self.way.path_limits, *self.wanted.path_limits)

    def missed(self, motion: Motion, *, aim: bool = False) -> Array:
        """Return by how much R runs miss each limit at worst, (m, R), negative where kept."""
        end = self.aim if aim else self.enough
        way = self.way.path_values(motion.state[:, 1:]).max(axis=-1)
        goal = self.wanted.path_values(motion.state[:, -1]) + end[:, None]
        out = np.concatenate([way, goal])
        out[:, ~motion.stable] = np.inf
        return np.asarray(out)

    def scale(self) -> Array:
        """Return what counts as one of each limit, (m,)."""
        return np.concatenate([self.way.path_scale, self.wanted.path_scale])

    def levels(self, unit: Array) -> Array:
        """Return levels (..., K, nc) of unit coordinates, within the rates."""
        s = self.schedule
        return s.within_reach(s.lower + (s.upper - s.lower) * unit)

    def run(self, levels: Array) -> Motion:
        """Run on levels (R, K, nc)."""
        return self.rollout.run(self.schedule.expand(levels))

    def candidates(self) -> Iterator[Array]:
        """Yield levels (K, nc) that descents end at, from the most promising start on."""
        rng = np.random.default_rng([53, self.request.seed])
        shape = (self.schedule.holds, len(self.schedule.commands))
        constant = np.repeat(rng.random((_DRAWN // 2, 1, shape[1])), shape[0], axis=1)
        steps = rng.integers(0, 2, (_DRAWN // 2, *shape)).astype(float)
        drawn = self.levels(np.concatenate([constant, steps]))
        missed = self.missed(self.run(drawn), aim=True) / self.scale()[:, None]
        cost = (np.maximum(missed, 0.0) ** 2).sum(axis=0)
        s = self.schedule
        span = np.where(s.upper > s.lower, s.upper - s.lower, 1.0)
        for i in np.argsort(cost, kind="stable")[:_DESCENTS]:
            unit = (drawn[i] - s.lower) / span
            result = minimize(
                self._cost, unit.ravel(), jac=True, method="L-BFGS-B",
                bounds=[(0.0, 1.0)] * unit.size, options={"maxiter": _ITERATIONS},
            )  # fmt: skip
            yield self.levels(np.asarray(result.x).reshape(shape))

    def _cost(self, flat: Array) -> tuple[float, Array]:
        """Return the squares of what the limits are missed by, and the gradient."""
        s = self.schedule
        unit = flat.reshape(s.holds, len(s.commands))
        span = s.upper - s.lower
        motion = self.rollout.run(s.expand(s.lower + span * unit)[None])
        if not motion.stable[0]:
            return 1e9, np.zeros(flat.size)
        state = motion.state[0]
        on_way, at_end = self.way.path_scale[:, None], self.wanted.path_scale[:, None]
        way = np.maximum(self.way.path_values(state) / on_way + _INSIDE, 0.0)
        way[:, 0] = 0.0
        goal = self.wanted.path_values(state[-1:]) + self.aim[:, None]
        goal = np.maximum(goal / at_end + _INSIDE, 0.0)
        d_state = self.way.path_pull(state, 2 * way / on_way)
        d_state[-1] += self.wanted.path_pull(state[-1:], 2 * goal / at_end)[0]
        back = self.rollout.pull(
            motion, d_state, np.zeros_like(motion.tau[0]), np.zeros_like(motion.commands[0])
        )
        return float((way**2).sum() + (goal**2).sum()), (s.gather(back) * span).ravel()

    def search(self) -> LeadIn | None:
        """Return the lead-in after which the ship stays in the regime best, None without any."""
        found = [
            levels
            for levels in self.candidates()
            if (self.missed(self.run(levels[None])) <= TOLERANCE).all()
        ]
        return min(map(self._lead_in, found), key=self._leaving, default=None)

    def _lead_in(self, levels: Array) -> LeadIn:
        state = self.run(levels[None]).state[0, -1]
        north, east = state[-2:] + np.asarray(self.request.limits.position, float)
        return LeadIn(
            levels,
            self.schedule.samples * self.schedule.sample_time,
            self.request.starts[0],
            self.request.limits.position,
            state[: self.rollout.nx + 1],
            (float(north), float(east)),
        )

    def _leaving(self, found: LeadIn) -> float:
        """Return by how much the ship misses the trial's limits where she goes on as she is."""
        on = np.repeat(found.levels[-1:], _KEPT_ON, axis=0)
        more = replace(self.schedule, samples=self.schedule.samples + _KEPT_ON * self.schedule.hold)
        motion = self.rollout.run(more.expand(np.concatenate([found.levels, on]))[None])
        if not motion.stable[0]:
            return np.inf
        after = self.wanted.path_values(motion.state[0, self.schedule.samples :])
        return float((np.maximum(after.max(axis=1), 0.0) / self.wanted.path_scale).sum())

    def nearest(self) -> Array:
        """Return by how much the candidate that misses least misses each limit, (m,)."""
        missed = [self.missed(self.run(levels[None]))[:, 0] for levels in self.candidates()]
        scale = self.scale()
        return min(missed, key=lambda m: float((np.maximum(m, 0.0) / scale).sum()))

    def time_constant(self) -> float:
        """Return the time in which the slowest part of the motion decays to 1/e [s]."""
        middle = self.levels(np.full((self.schedule.holds, len(self.schedule.commands)), 0.5))
        nx = self.rollout.nx
        slopes = self.rollout.slopes(self.run(middle[None]))[:nx, :nx, 0, -1]
        slowest = float(np.abs(np.linalg.eigvals(slopes)).max())
        return -self.schedule.sample_time / np.log(slowest) if 0 < slowest < 1 else np.inf


def _refusal(request: PreparedRequest, holds: int, enough: Enough | None) -> InfeasibleError:
    """Return the error on which limit stops a lead-in, and the least change found to help."""
    shooting = _Shooting(request, holds)
    missed = shooting.nearest()
    start = state_words(request.structure.states, request.starts[0])
    constant = shooting.time_constant()
    told = f" ({LONGEST / constant:.2g} time constants of this ship)" if constant < np.inf else ""
    said = (
        f"the start {start} does not keep the margins, and no lead-in of at most {LONGEST:g} s"
        f"{told} brings the ship into the regime"
    )
    order = np.argsort(-np.maximum(missed, 0.0) / shooting.scale(), kind="stable")
    stopping = [(shooting.limits[i], float(missed[i])) for i in order if missed[i] > TOLERANCE]
    on_way = shooting.way.path_limits
    nothing: dict[str, Any] = dict.fromkeys(x.field for x in on_way)
    free = replace(request.limits, **nothing)
    if on_way and _Shooting(replace(request, limits=free), holds).search() is not None:
        # without the limits on the way there is one, so that one of them stops it
        for limit in on_way:
            amount = max((m for x, m in stopping if type(x) is type(limit)), default=0.0)
            helps = _relaxed(request, holds, limit, max(amount, 0.05 * limit.size))
            if helps:
                return InfeasibleError(f"{said}: the {limit.phrase} stops it. {helps}")
        names = ", ".join(x.words for x in on_way)
        return InfeasibleError(
            f"{said}: the {names} together stop it. Widen them, or change --start."
        )
    limit, amount = next((item for item in stopping if item[0].of_regime), stopping[0])
    reached = limit.bound - max(amount - (_ENOUGH - 1) * max(limit.bound, _LEAST), 0.0)
    said += f": the {limit.phrase} stops it, {reached:.3g} is reached"
    for share in _SHARES if reached > 0 and limit.of_regime else ():
        lower = float(np.floor(1e3 * share * reached) / 1e3)
        eased = replace(request, limits=limit.with_bound(request.limits, lower))
        found = _Shooting(eased, holds).search()
        if found is not None and (enough is None or enough(found.after(eased))):
            said += f". Use {limit.option} {lower:g}, or a --start nearer to the regime."
            return OutOfReachError(OutOfReach(request.limits, eased.limits, said))
    return InfeasibleError(f"{said}. Choose another --regime, or a --start nearer to it.")


def _relaxed(request: PreparedRequest, holds: int, limit: Limit, amount: float) -> str:
    """Return the least relaxation of a limit on the way that lets a lead-in be found."""
    for times in _RELAXED:
        eased, helps = limit.eased(request.limits, times * amount)
        if _Shooting(replace(request, limits=eased), holds).search() is not None:
            return f"{helps}, or start elsewhere (--start, --position)."
    return ""
