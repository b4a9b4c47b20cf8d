"""The limits of a trial as compiled functions of its motion, with derivatives.

Each limit is one number h at each sample or one per trial, negative where kept.
Path limits are symbolic in the state, so that the search, IPOPT and the checks
read the same expression.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from experiment_design.constraints.limits import (
    TOLERANCE,
    Limit,
    LimitedTrial,
    PathLimit,
    TrialLimits,
    WholeLimit,
    limits_of,
)
from experiment_design.excitation.rollout import Motion, Rollout
from experiment_design.excitation.schedule import Schedule
from greybox.numerics.vectorised import Vectorised

Array = NDArray[np.float64]
L = TypeVar("L", bound=Limit)


class LimitProgram:
    """Compiled limits of one trial under one prior model.

    Parameters
    ----------
    rollout : Rollout
    schedule : Schedule
    limits : TrialLimits
    wind_matters : bool
        Whether the velocity through the air must keep its sign too (5.7), as it
        must where the wind is not measured.
    backoff : sequence of float
        By how much each path limit is tightened, in its unit, for models that
        are not known exactly.
    on_way : bool
        Keep those limits alone that hold on the way into the regime, too.
    """

    def __init__(
        self,
        rollout: Rollout,
        schedule: Schedule,
        limits: TrialLimits,
        *,
        wind_matters: bool = False,
        backoff: Sequence[float] = (),
        on_way: bool = False,
    ) -> None:
        self.nx = rollout.nx
        full = np.maximum(np.abs(schedule.lower), np.abs(schedule.upper))
        speeds = {t.speed for t in rollout.vessel.thrusters}
        trial = LimitedTrial(
            rollout.structure.states,
            rollout.d,
            wind_matters,
            tuple((i, float(full[i])) for i, n in enumerate(schedule.commands) if n in speeds),
        )
        every = limits_of(limits, trial)
        path = [x for x in every if isinstance(x, PathLimit)]
        self.path_limits = tuple(x for x in path if not (on_way and x.of_regime))
        self.whole_limits = tuple(x for x in every if isinstance(x, WholeLimit) and not on_way)
        self.path_scale = np.array([x.scale for x in self.path_limits])
        self.whole_scale = np.array([x.scale for x in self.whole_limits])
        state = rollout.symbols[0]
        scalars = ca.vertsplit(state)
        at = dict(zip(trial.signals, scalars, strict=True))
        self.backoff = np.zeros(len(self.path_limits))
        self.backoff[: len(backoff)] = backoff
        rows = [x.value(at) + b for x, b in zip(self.path_limits, self.backoff, strict=True)]
        self.path = ca.vertcat(*rows) if rows else ca.SX(0, 1)
        if rows:
            self._path = Vectorised(ca.vertsplit(self.path), scalars)
            w = ca.SX.sym("w", len(rows))
            back = ca.jtimes(self.path, state, w, True)
            self._path_back = Vectorised(ca.vertsplit(back), [*scalars, *ca.vertsplit(w)])

    @property
    def all_limits(self) -> tuple[Limit, ...]:
        """Every limit, path limits first."""
        return (*self.path_limits, *self.whole_limits)

    @property
    def scale(self) -> Array:
        """What counts as one of each limit, (m,)."""
        return np.concatenate([self.path_scale, self.whole_scale])

    @property
    def of_regime(self) -> NDArray[np.bool_]:
        """Which path limits hold in the regime alone, (m,)."""
        return np.array([x.of_regime for x in self.path_limits], bool)

    def each(self, kind: type[L]) -> tuple[L, ...]:
        """Return the limits of a class."""
        return tuple(x for x in self.all_limits if isinstance(x, kind))

    def path_values(self, state: Array) -> Array:
        """Return the path limits (m, ...) of states (..., n)."""
        shape = state.shape[:-1]
        if not self.path_limits:
            return np.empty((0, *shape))
        columns = [np.ascontiguousarray(state[..., i]) for i in range(state.shape[-1])]
        return self._path(columns, np.empty((len(self.path_limits), *shape)))

    def worst(self, state: Array, since: int | NDArray[np.intp] = 0) -> Array:
        """Return by how much runs miss each path limit at worst, (m, R), negative where kept.

        Parameters
        ----------
        state : ndarray
            (R, N+1, n), of which the start is not looked at.
        since : int or ndarray of int
            Sample, or one per run (R,), after which margins count: none does during a lead-in.
        """
        values = self.path_values(state[:, 1:])
        if np.any(since):
            early = np.arange(values.shape[-1]) < np.reshape(since, (-1, 1))
            values = np.where(self.of_regime[:, None, None] & early, -np.inf, values)
        return np.asarray(values.max(axis=-1))

    def path_pull(self, state: Array, weights: Array) -> Array:
        """Carry weights (m, N+1) on the path limits back to states (N+1, n)."""
        if not self.path_limits:
            return np.zeros_like(state)
        out = np.empty((state.shape[1], len(state)))
        self._path_back([*np.ascontiguousarray(state.T), *weights], out)
        return out.T

    def whole_values(self, motion: Motion) -> Array:
        """Return the limits on the whole trial, (m, R)."""
        rows = [x.values(motion) for x in self.whole_limits]
        return np.array(rows).reshape(len(rows), len(motion.state))

    def whole_pull(self, motion: Motion, weights: Array) -> tuple[Array, Array]:
        """Carry weights (m,) on the whole-trial limits back to states and commands."""
        d_state, d_commands = np.zeros_like(motion.state[0]), np.zeros_like(motion.commands[0])
        for limit, weight in zip(self.whole_limits, weights.tolist(), strict=True):
            limit.pull(motion, weight, d_state, d_commands)
        return d_state, d_commands

    def violations(self, motion: Motion) -> Array:
        """Return by how much each limit is missed at worst, (m, R), 0 where kept.

        A run that is unstable misses every limit without bound.
        """
        worst = [self.worst(motion.state), self.whole_values(motion)]
        out = np.maximum(np.concatenate(worst), 0.0)
        out[:, ~motion.stable] = np.inf
        return np.asarray(out)

    def keeps(self, motion: Motion) -> NDArray[np.bool_]:
        """Return which runs keep every limit, (R,)."""
        missed = self.violations(motion)
        return np.asarray((missed <= TOLERANCE).all(axis=0) & motion.stable)
