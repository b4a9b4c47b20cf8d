"""The tie between position, heading, velocity and yaw rate, and what may be wrong with it.

Residuals and their derivatives for given clocks, lever arm and heading bias.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from greybox.trial.checks.motion import (
    Motion,
    denoise,
    integrate,
    levels,
    outlier_weights,
    smooth,
    turn,
)

Array = NDArray[np.float64]

# beyond this time the heading's own noise is averaged out
_HEADING_WINDOW = 5.0


@dataclass(frozen=True)
class Candidate:
    """One defect as directions of the parameters.

    Parameters
    ----------
    id : {"clock_offset", "lever_arm", "heading_bias"}
    channels : tuple of str
    parameters : tuple of str
        Names among ``clock`` (its channels late together), ``arm_x``, ``arm_y``, ``bias``.
    cost : float
        In log-likelihood: what many columns together must explain more than one.
    """

    id: str
    channels: tuple[str, ...]
    cost: float = 0.0


@dataclass(frozen=True)
class State:
    """Parameters of the tie.

    Parameters
    ----------
    late : dict of str to float
        By channel: seconds by which it is late.
    bias : float
        Measured minus true heading [rad].
    arm : tuple of float
        Antenna, forward and starboard of the body origin [m].
    """

    late: dict[str, float] = field(default_factory=dict)
    bias: float = 0.0
    arm: tuple[float, float] = (0.0, 0.0)

    @property
    def common(self) -> float:
        """Lateness of both positions: the same as all others being early, and easier to move."""
        x, y = self.late.get("x_n", 0.0), self.late.get("y_n", 0.0)
        return x if x == y else 0.0

    def moved(self, candidate: Candidate, step: Array) -> State:
        """Return the state with a candidate's parameters moved."""
        if candidate.id == "clock_offset":
            late = dict(self.late)
            for c in candidate.channels:
                late[c] = late.get(c, 0.0) + float(step[0])
            return replace(self, late=late)
        if candidate.id == "heading_bias":
            return replace(self, bias=self.bias + float(step[0]))
        return replace(self, arm=(self.arm[0] + float(step[0]), self.arm[1] + float(step[1])))


def size(candidate: Candidate) -> int:
    """Return the number of parameters of a candidate."""
    return 2 if candidate.id == "lever_arm" else 1


class Tie:
    """Residuals of positions and heading for given parameters, and their derivatives."""

    def __init__(self, motion: Motion, start: State | None = None) -> None:
        self.motion = motion
        self.start = start or State()
        self._weights: dict[tuple[str, int], Array] = {}
        self.smooth = {
            n: denoise(v, motion) for n, v in motion.values.items() if n not in ("x_n", "y_n")
        }
        self.level = levels(motion)
        n, s = self.level.shape
        self.drift = (motion.t - motion.t[0]) / max(float(np.ptp(motion.t)), 1e-9)
        self.columns = 2 * s + 3
        self.calm = self.smooth.get("psi", np.zeros(len(motion)))
        self.positioned, self.turned = motion.positioned, motion.turned
        if self.turned:
            self.align(self.start)
        if self.positioned:
            # what is moved in time must not know the positions' own noise, or moving it would
            # seem to explain that noise: the way by the other sensors stands in for them
            way = self.walked(State(), self.smooth)
            self.smooth["x_n"], self.smooth["y_n"] = way[:, 0], way[:, 1]
        self.samples = (2 * n if self.positioned else 0) + (n if self.turned else 0)

    def align(self, state: State) -> None:
        """Take the fast part of the noise-free heading from the rate, as late as the heading is.

        As for the positions: what is moved in time must not know its own noise.
        """
        if not self.turned:
            return
        behind = state.late.get("psi", 0.0) - state.late.get("r", 0.0)
        swept = integrate(self.smooth["r"], self.motion)
        for a, b in self.motion.stretches:
            t = self.motion.t[a:b]
            swept[a:b] = _beyond(t - behind, t, swept[a:b])
        seconds = max(_HEADING_WINDOW, 5 * self.motion.step)
        self.smooth["psi"] = swept + smooth(self.motion["psi"] - swept, self.motion, seconds)
        self.calm = self.smooth["psi"]

    def weigh(self, what: str) -> Callable[[float], Array]:
        """Return gain -> weights of the innovations of ``position`` or ``heading``.

        They are taken once, from the log as it is: were they to change from one
        candidate to the next, their likelihoods could not be compared.
        """

        def weight(gain: float) -> Array:
            key = (what, round(10 * float(np.log(gain))))
            if key not in self._weights:
                pos, head = self.nuisance(self.start)
                values = self.motion.values
                if what == "position":
                    z, x = self.position(self.start, values), pos
                else:
                    z, x = self.heading(self.start, values), head
                self._weights[key] = outlier_weights(z, x, gain, self.motion)
            return self._weights[key]

        return weight

    def _at(self, name: str, state: State, values: dict[str, Array]) -> Array:
        late = state.late.get(name, 0.0) - state.common
        if late == 0.0:
            return values[name]
        # what is true now is recorded `late` seconds later; only the smooth part is moved,
        # since interpolation between samples would shrink the noise and so seem to explain it
        out = values[name].copy()
        for a, b in self.motion.stretches:
            t, slow = self.motion.t[a:b], self.smooth[name][a:b]
            out[a:b] += _beyond(t + late, t, slow) - slow
        return out

    def _late(self, value: Array, name: str, state: State) -> Array:
        """Return a noise-free channel as it would be were it not late."""
        late = state.late.get(name, 0.0) - state.common
        if late == 0.0:
            return value
        out = np.empty_like(value)
        for a, b in self.motion.stretches:
            t = self.motion.t[a:b]
            out[a:b] = _beyond(t + late, t, value[a:b])
        return out

    def walked(self, state: State, values: dict[str, Array]) -> Array:
        """Return the way made by velocities and heading (N, 2) [m]."""
        psi = self._at("psi", state, values) - state.bias
        return integrate(
            turn(psi, self._at("u", state, values), self._at("v", state, values)), self.motion
        )

    def position(
        self, state: State, values: dict[str, Array], walked: Array | None = None
    ) -> Array:
        """Return measured position minus that of velocity, heading and lever arm (N, 2) [m]."""
        if walked is None:
            walked = self.walked(state, values)
        # the heading's noise, a lever long, would count as noise of the positions
        psi = self._late(self.calm, "psi", state) - state.bias
        arm = turn(psi, np.full(len(psi), state.arm[0]), np.full(len(psi), state.arm[1]))
        measured = np.column_stack([self._at("x_n", state, values), self._at("y_n", state, values)])
        return measured - walked - arm

    def heading(self, state: State, values: dict[str, Array]) -> Array:
        """Return measured heading minus that of the yaw rate (N,) [rad]."""
        return self._at("psi", state, values) - integrate(self._at("r", state, values), self.motion)

    def nuisance(self, state: State) -> tuple[Array, Array]:
        """Return the columns for starts, a constant velocity, and scales, (N, 2, q) and (N, q)."""
        n, s = self.level.shape
        pos = np.zeros((n, 2, 2 * s + 3))
        if self.positioned:
            pos[:, 0, :s] = self.level
            pos[:, 1, s : 2 * s] = self.level
            pos[:, 0, 2 * s] = self.drift
            pos[:, 1, 2 * s + 1] = self.drift
            pos[:, :, 2 * s + 2] = self.walked(state, self.smooth)
        head = np.zeros((n, s + 2))
        if self.turned:
            head[:, :s] = self.level
            head[:, s] = self.drift
            head[:, s + 1] = integrate(self._at("r", state, self.smooth), self.motion)
        return pos, head

    def derivative(self, candidate: Candidate, state: State) -> tuple[Array, Array]:
        """Return minus the derivatives of both residuals, (N, 2, k) and (N, k)."""
        n, k = len(self.motion), size(candidate)
        pos, head = np.zeros((n, 2, k)), np.zeros((n, k))
        for j in range(k):
            unit = np.zeros(k)
            unit[j] = 0.5 * {"clock_offset": max(0.2, self.motion.step)}.get(candidate.id, 0.02)
            plus, minus = state.moved(candidate, unit), state.moved(candidate, -unit)
            if self.positioned:
                change = self.position(plus, self.smooth) - self.position(minus, self.smooth)
                pos[:, :, j] = -change / (2 * unit[j])
            if self.turned and candidate.id == "clock_offset":
                turned = self.heading(plus, self.smooth) - self.heading(minus, self.smooth)
                head[:, j] = -turned / (2 * unit[j])
        return pos, head


def _beyond(at: Array, t: Array, value: Array) -> Array:
    """Interpolate, and go on straight beyond the ends."""
    out = np.interp(at, t, value)
    reach = min(5, len(t) - 1)
    for inside, k, j in ((at < t[0], 0, reach), (at > t[-1], -1, -1 - reach)):
        slope = (value[k] - value[j]) / (t[k] - t[j])
        out[inside] = value[k] + slope * (at[inside] - t[k])
    return np.asarray(out)
