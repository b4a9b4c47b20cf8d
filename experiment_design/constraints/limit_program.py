"""The limits of a trial as compiled functions of its motion, with derivatives.

Each limit is one number h at each sample or one per trial, negative where kept.
Path limits are symbolic in the state, so that the search, IPOPT and the checks
read the same expression.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from experiment_design.constraints.limits import (
    TOLERANCE,
    UNIT_SCALE,
    Circle,
    LimitKind,
    LimitName,
    TrialLimits,
)
from experiment_design.excitation.rollout import Motion, Rollout
from experiment_design.excitation.schedule import Schedule
from greybox.errors import UsageError, suggestion
from greybox.numerics.vectorised import Vectorised
from greybox.rotation import ned_to_body

Array = NDArray[np.float64]

_NAMES = {"u": "surge", "v": "sway", "r": "yaw rate"}


def _polygon_distance(corners: Array, north: ca.SX, east: ca.SX) -> ca.SX:
    """Return the signed distance to a polygon, positive outside [m]."""
    nearest = ca.SX(1e300)
    parity = ca.SX(1)
    for (n0, e0), (n1, e1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        dn, de = n1 - n0, e1 - e0
        t = ca.fmin(1, ca.fmax(0, ((north - n0) * dn + (east - e0) * de) / (dn**2 + de**2)))
        square = (north - n0 - t * dn) ** 2 + (east - e0 - t * de) ** 2
        nearest = ca.fmin(nearest, square)
        if e0 != e1:
            # a ray to the north crosses this edge once for a point inside
            between = ca.logic_and(ca.fmin(e0, e1) <= east, east < ca.fmax(e0, e1))
            above = n0 + (east - e0) * dn / de > north
            parity = parity * (1 - 2 * ca.logic_and(between, above))
    return parity * ca.sqrt(nearest + 1e-12)


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
    """

    def __init__(
        self,
        rollout: Rollout,
        schedule: Schedule,
        limits: TrialLimits,
        *,
        wind_matters: bool = False,
        backoff: Sequence[float] = (),
    ) -> None:
        self.limits = limits
        self.schedule = schedule
        self.nx = rollout.nx
        self._states = rollout.structure.states
        state = rollout.symbols[0]
        x, psi = state[: self.nx], state[self.nx]
        where = {n: x[i] for i, n in enumerate(self._states)}
        names: list[LimitName] = []
        rows: list[ca.SX] = []
        d = rollout.d
        for name, sign in limits.signs.items():
            margin = limits.margins.get(name, 0.0)
            seen = [where[name]]
            if name in ("u", "v"):
                for pair, matters in ((d[:2], True), (d[2:], wind_matters)):
                    if matters and np.any(pair):
                        moved = ned_to_body(ca.SX(pair[0]), ca.SX(pair[1]), psi)
                        seen.append(where[name] - moved[name == "v"])
            least = seen[0] * sign
            for other in seen[1:]:
                least = ca.fmin(least, other * sign)
            names.append(
                LimitName(LimitKind.MARGIN, margin, "rad/s" if name == "r" else "m/s",
                          f"--margin-{name}", _NAMES.get(name, name), name)
            )  # fmt: skip
            rows.append(margin - least)
        u, v = where["u"], where.get("v", ca.SX(0))
        if limits.margin_air is not None:
            blown = ned_to_body(ca.SX(float(d[2])), ca.SX(float(d[3])), psi)
            for name, wind in zip(("u", "v"), blown, strict=True):
                if name in where:
                    names.append(
                        LimitName(LimitKind.MARGIN, limits.margin_air, "m/s", "--margin-air",
                                  f"{_NAMES[name]} through the air", "air")
                    )  # fmt: skip
                    rows.append(limits.margin_air - ca.fabs(where[name] - wind))
        if limits.speed_cap is not None:
            names.append(LimitName(LimitKind.SPEED, limits.speed_cap, "m/s", "--speed-cap"))
            rows.append(ca.sqrt(u**2 + v**2 + 1e-12) - limits.speed_cap)
        if limits.yaw_cap is not None and "r" in where:
            names.append(LimitName(LimitKind.YAW_RATE, limits.yaw_cap, "rad/s", "--yaw-cap"))
            rows.append(ca.fabs(where["r"]) - limits.yaw_cap)
        if limits.area is not None:
            north = state[self.nx + 1] + limits.position[0]
            east = state[self.nx + 2] + limits.position[1]
            names.append(LimitName(LimitKind.SEA_ROOM, limits.clearance, "m", "--area"))
            if isinstance(limits.area, Circle):
                circle = limits.area
                distance = (
                    ca.sqrt((north - circle.north) ** 2 + (east - circle.east) ** 2 + 1e-12)
                    - circle.radius
                )
            else:
                distance = _polygon_distance(np.asarray(limits.area, float), north, east)
            rows.append(distance + limits.clearance)
        self.path_names = tuple(names)
        self.backoff = np.zeros(len(rows))
        self.backoff[: len(backoff)] = backoff
        rows = [row + more for row, more in zip(rows, self.backoff.tolist(), strict=True)]
        self.path = ca.vertcat(*rows) if rows else ca.SX(0, 1)
        self.path_scale = np.array([UNIT_SCALE[n.unit] for n in names])
        self.end_names, self._ends = self._end_limits(limits)
        self.end_values = tuple(self._ends)
        self.whole_names = tuple(self._whole_names(limits))
        self.whole_scale = np.array([UNIT_SCALE[n.unit] for n in self.whole_names])
        scalars = ca.vertsplit(state)
        if rows:
            self._path = Vectorised(ca.vertsplit(self.path), scalars)
            w = ca.SX.sym("w", len(rows))
            back = ca.jtimes(self.path, state, w, True)
            self._path_back = Vectorised(ca.vertsplit(back), [*scalars, *ca.vertsplit(w)])
        self._full = np.maximum(np.abs(schedule.lower), np.abs(schedule.upper))
        speeds = {t.speed for t in rollout.vessel.thrusters}
        self._speeds = [i for i, n in enumerate(schedule.commands) if n in speeds]
        # what the energy is the mean cube of: places among the commands, and full speeds
        self.speeds = tuple((i, float(self._full[i])) for i in self._speeds)

    @property
    def names(self) -> tuple[LimitName, ...]:
        """Every limit, path limits first."""
        return (*self.path_names, *self.whole_names)

    def _end_limits(self, limits: TrialLimits) -> tuple[list[LimitName], list[tuple[int, float]]]:
        place = {n: i for i, n in enumerate(self._states)}
        place |= {"psi": self.nx, "x_n": self.nx + 1, "y_n": self.nx + 2}
        units = {"u": "m/s", "v": "m/s", "r": "rad/s", "psi": "rad", "x_n": "m", "y_n": "m"}
        names, ends = [], []
        for name, (value, tolerance) in limits.end.items():
            if name not in place:
                raise UsageError(
                    f"the end state names '{name}'.{suggestion(name, place)} It can name "
                    f"{', '.join(place)}."
                )
            if not (np.isfinite(value) and 0 < tolerance < np.inf):
                raise UsageError(
                    f"the end state {name} = {value:g} has the tolerance {tolerance:g}, it must be "
                    f"positive: write --end {name}=VALUE:TOLERANCE."
                )
            names.append(
                LimitName(
                    LimitKind.END_STATE, tolerance, units[name], "--end", f"{name} = {value:g}"
                )
            )
            shift = {"x_n": limits.position[0], "y_n": limits.position[1]}.get(name, 0.0)
            ends.append((place[name], value - shift))
        return names, ends

    def _whole_names(self, limits: TrialLimits) -> list[LimitName]:
        names = list(self.end_names)
        if limits.energy is not None:
            names.append(LimitName(LimitKind.ENERGY, limits.energy, "", "--energy"))
        if limits.headings is not None:
            names.append(LimitName(LimitKind.HEADINGS, limits.headings, "rad", "--headings"))
        return names

    def path_values(self, state: Array) -> Array:
        """Return the path limits (m, ...) of states (..., n)."""
        shape = state.shape[:-1]
        if not self.path_names:
            return np.empty((0, *shape))
        columns = [np.ascontiguousarray(state[..., i]) for i in range(state.shape[-1])]
        return self._path(columns, np.empty((len(self.path_names), *shape)))

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
            margin = np.array([n.kind is LimitKind.MARGIN for n in self.path_names], bool)
            values = np.where(margin[:, None, None] & early, -np.inf, values)
        return np.asarray(values.max(axis=-1))

    def path_pull(self, state: Array, weights: Array) -> Array:
        """Carry weights (m, N+1) on the path limits back to states (N+1, n)."""
        if not self.path_names:
            return np.zeros_like(state)
        out = np.empty((state.shape[1], len(state)))
        self._path_back([*np.ascontiguousarray(state.T), *weights], out)
        return out.T

    def whole_values(self, motion: Motion) -> Array:
        """Return the limits on the whole trial, (m, R)."""
        rows: list[Array] = []
        limits = self.limits
        for (place, value), name in zip(self._ends, self.end_names, strict=True):
            rows.append(np.abs(motion.state[:, -1, place] - value) - name.bound)
        if limits.energy is not None:
            share = np.abs(motion.commands[..., self._speeds] / self._full[self._speeds]) ** 3
            rows.append(share.mean(axis=(1, 2)) - limits.energy)
        if limits.headings is not None:
            psi = motion.state[..., self.nx]
            rows.append(limits.headings - (psi.max(axis=1) - psi.min(axis=1)))
        return np.array(rows).reshape(len(rows), len(motion.state))

    def whole_pull(self, motion: Motion, weights: Array) -> tuple[Array, Array]:
        """Carry weights (m,) on the whole-trial limits back to states and commands."""
        state, commands = motion.state[0], motion.commands[0]
        d_state, d_commands = np.zeros_like(state), np.zeros_like(commands)
        k = 0
        for place, value in self._ends:
            d_state[-1, place] += weights[k] * np.sign(state[-1, place] - value)
            k += 1
        if self.limits.energy is not None:
            part = commands[:, self._speeds] / self._full[self._speeds]
            slope = 3 * part * np.abs(part) / self._full[self._speeds] / part.size
            d_commands[:, self._speeds] += weights[k] * slope
            k += 1
        if self.limits.headings is not None:
            psi = state[:, self.nx]
            d_state[int(psi.argmax()), self.nx] -= weights[k]
            d_state[int(psi.argmin()), self.nx] += weights[k]
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
