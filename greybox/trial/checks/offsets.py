"""Clock offsets, lever arm and heading bias, estimated together and named one by one.

Each candidate is one or two parameters of the tie between position, heading,
velocity and yaw rate; the one that explains most is taken first, the others
are then judged beside it, so that a late compass is not called a lever arm
unless the motion cannot tell them apart.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from greybox.trial.checks.finding import Finding, Outcome, Repair
from greybox.trial.checks.motion import (
    GAINS,
    Motion,
    denoise,
    integrate,
    levels,
    outlier_weights,
    profile,
    smooth,
    solve,
    turn,
    whiten,
)
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]

_CLOCKS = ("x_n", "y_n", "psi", "u", "v", "r")
# what is too small to matter, and how many standard errors prove it
_LEAST_CLOCK = 0.1
_LEAST_HEADING = np.radians(0.75)
_LEAST_ARM = (0.1, 0.02)
_SIGMAS = 3.3
_LEAST_GAIN = 5.5
# wide enough to see a whole turn, which tells a late compass from a lever arm
_SCAN = (-8.0, -6.0, -4.5, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 4.5, 6.0, 8.0)
_MOST_LATE = 9.0
# in log-likelihood: what differs by less explains alike
_NEARLY = 10.0
_FAR_COST = 12.0
_EARLY_COST = 3.0
# an antenna stands on the ship, or hardly beyond it [ship lengths]
_MOST_ARM = 0.8
_ROUNDS = 12
_MOST = 3
# beyond this time the heading's own noise is averaged out
_HEADING_WINDOW = 5.0
# beyond these nothing can be said
_VAGUE_HEADING = np.radians(1.0)
_VAGUE_CLOCK = 0.3
_OWN_CLOCKS = (("psi",), ("r",), ("x_n", "y_n"), ("u", "v"))


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


_CANDIDATES = (
    Candidate("clock_offset", ("psi",)),
    # a rate gyro is noisy against what a slow ship turns: the least certain of all
    Candidate("clock_offset", ("r",), 2.5),
    Candidate("clock_offset", ("x_n", "y_n")),
    Candidate("clock_offset", ("u", "v")),
    Candidate("clock_offset", ("psi", "r"), 8.0),
    Candidate("clock_offset", ("u", "v", "r"), 6.0),
    Candidate("clock_offset", ("u",), 3.0),
    Candidate("clock_offset", ("v",), 3.0),
    Candidate("clock_offset", ("x_n",), 30.0),
    Candidate("clock_offset", ("y_n",), 30.0),
    Candidate("lever_arm", ("x_n", "y_n"), 3.0),
    Candidate("heading_bias", ("psi",)),
)


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


@dataclass(frozen=True)
class Gain:
    """Gains and innovations of both residuals at some parameters."""

    position: tuple[float, float]
    heading: tuple[float, float]
    loglik: float


def _gain(tie: Tie, state: State, near: Gain | None = None) -> Gain:
    """Estimate the gains; around known ones where they are known."""
    pos, head = tie.nuisance(state)
    around = np.array([0.4, 0.7, 1.0, 1.5])
    total = 0.0
    p = h = (1.0, 1.0)
    values = tie.motion.values
    if tie.positioned:
        gains = GAINS if near is None else np.minimum(around * near.position[0], 1.0)
        z = tie.position(state, values)
        found = profile(z, pos, tie.motion, gains, tie.weigh("position"))
        total += found.loglik
        p = (found.gain, found.std)
    if tie.turned:
        gains = GAINS if near is None else np.minimum(around * near.heading[0], 1.0)
        z = tie.heading(state, values)
        found = profile(z, head, tie.motion, gains, tie.weigh("heading"))
        total += found.loglik
        h = (found.gain, found.std)
    return Gain(p, h, total)


def _stack(tie: Tie, gain: Gain, pos: Array, head: Array) -> Array:
    """Whiten both blocks and stack them to rows, (3 N or less, q)."""
    rows = []
    if tie.positioned:
        k, std = gain.position
        white = whiten(pos, k, tie.motion) / std
        white = white * tie.weigh("position")(k).reshape(-1, *[1] * (white.ndim - 1))
        rows.append(white.reshape(-1, *white.shape[2:]))
    if tie.turned:
        k, std = gain.heading
        white = whiten(head, k, tie.motion) / std
        rows.append(white * tie.weigh("heading")(k).reshape(-1, *[1] * (white.ndim - 1)))
    return np.concatenate(rows)


def _residual(tie: Tie, state: State, gain: Gain) -> Array:
    values = tie.motion.values
    n = len(tie.motion)
    pos = tie.position(state, values) if tie.positioned else np.zeros((n, 2))
    head = tie.heading(state, values) if tie.turned else np.zeros(n)
    return _stack(tie, gain, pos, head)


def _columns(tie: Tie, state: State, gain: Gain) -> Array:
    pos, head = tie.nuisance(state)
    n, q = len(tie.motion), pos.shape[2] + head.shape[1]
    wide_pos, wide_head = np.zeros((n, 2, q)), np.zeros((n, q))
    wide_pos[:, :, : pos.shape[2]] = pos
    wide_head[:, pos.shape[2] :] = head
    return _stack(tie, gain, wide_pos, wide_head)


@dataclass(frozen=True)
class Fit:
    """Estimate of the parameters of some candidates together.

    Parameters
    ----------
    state : State
    candidates : tuple of Candidate
    covariance : ndarray
        (k, k) of the candidates' parameters in order, robust to coloured residuals.
    loglik : float
    """

    state: State
    candidates: tuple[Candidate, ...]
    covariance: Array
    loglik: float
    value: Array


def fit(tie: Tie, candidates: tuple[Candidate, ...], start: State, rounds: int = _ROUNDS) -> Fit:
    """Estimate the parameters of some candidates together, by Gauss-Newton.

    Parameters
    ----------
    tie : Tie
    candidates : tuple of Candidate
    start : State
    rounds : int
        Steps at most.

    Returns
    -------
    Fit
    """
    state = start
    sizes = [size(c) for c in candidates]
    edges = np.concatenate([[0], np.cumsum(sizes)]).astype(int)
    total = np.zeros(int(edges[-1]))
    gain = _gain(tie, state)
    x = rest = np.zeros((0, 0))
    for _ in range(rounds):
        blocks = [_stack(tie, gain, *tie.derivative(c, state)) for c in candidates]
        nuisance = _columns(tie, state, gain)
        x = np.hstack([*blocks, nuisance])
        y = _residual(tie, state, gain)
        step = solve(x, y)
        rest = y - x @ step
        step = np.clip(step[: edges[-1]], -4.0, 4.0)
        for c, a, b in zip(candidates, edges[:-1], edges[1:], strict=True):
            state = state.moved(c, step[a:b])
        total += step
        gain = _gain(tie, state, gain)
        if np.all(np.abs(step) < 2e-3):
            break
    covariance = _robust(x, rest, int(edges[-1]), tie)
    return Fit(state, candidates, covariance, gain.loglik, total)


def _robust(x: Array, rest: Array, wanted: int, tie: Tie) -> Array:
    """Return the covariance (wanted, wanted) by Newey and West, components side by side."""
    scale = np.sqrt(np.einsum("ij,ij->j", x, x))
    scale[scale == 0] = 1.0
    xs = x / scale
    bread = np.linalg.pinv(xs.T @ xs, rcond=1e-11)
    scores = xs * rest[:, None]
    n = len(tie.motion)
    lags = int(min(max(8.0 / tie.motion.step, 4 * (n / 100) ** (2 / 9)), n / 5))
    meat = np.zeros_like(bread)
    at = 0
    blocks = ([(2, n)] if tie.positioned else []) + ([(1, n)] if tie.turned else [])
    for width, count in blocks:
        part = scores[at : at + width * count].reshape(count, width, -1).sum(axis=1)
        at += width * count
        meat += part.T @ part
        for lag in range(1, lags + 1):
            cross = part[lag:].T @ part[:-lag]
            meat += (1 - lag / (lags + 1)) * (cross + cross.T)
    full = bread @ meat @ bread
    plain = bread * float(np.mean(rest**2))
    # the robust one has few degrees of freedom: never below what white noise would give
    have, least = np.maximum(np.diag(full), 0.0), np.maximum(np.diag(plain), 1e-300)
    factor = np.sqrt(np.maximum(have, least) / np.maximum(have, 1e-6 * least))
    full = full * np.outer(factor, factor)
    full[np.diag_indices_from(full)] = np.maximum(have, least)
    out = full[:wanted, :wanted] / np.outer(scale[:wanted], scale[:wanted])
    return np.asarray(out)


def find_offsets(motion: Motion, vessel: Vessel) -> tuple[list[Finding], list[Outcome]]:
    """Find clock offsets, lever arm and heading bias.

    Parameters
    ----------
    motion : Motion
        Columns read as they are meant (see `find_reading`).
    vessel : Vessel
        Its antenna is where the positions are taken to be measured.

    Returns
    -------
    findings : list of Finding
    outcomes : list of Outcome
        What was compared, or why nothing in the log can show it.
    """
    antenna = tuple(float(a) for a in vessel.sensors.get("antenna", (0.0, 0.0))[:2])
    if not (motion.positioned or motion.turned):
        why = "needs heading and yaw rate, or positions, heading and velocities of their own sensor"
        return [], [Outcome(i, "cannot tell", why) for i in _IDS]
    tie = Tie(motion, State(arm=(antenna[0], antenna[1])))
    usable = [c for c in _CANDIDATES if _usable(c, motion)]
    chosen: tuple[Candidate, ...] = ()
    start = State(arm=(antenna[0], antenna[1]))
    plain = _gain(tie, start, _gain(tie, start))
    best = Fit(start, (), np.zeros((0, 0)), plain.loglik, np.zeros(0))
    inflation = max(1.0, 0.1 / motion.step)
    first: list[tuple[float, Fit]] = []
    for _ in range(_MOST):
        trials: list[tuple[float, Fit]] = []
        for c in usable:
            if any(c.id == k.id and set(c.channels) & set(k.channels) for k in chosen):
                continue
            trial = fit(tie, (*chosen, c), _scan(tie, c, best.state))
            if max(map(abs, trial.state.late.values()), default=0.0) > _MOST_LATE:
                continue
            # a scan over many seconds finds more by chance than a search around zero
            late = trial.state.late[c.channels[0]] if c.id == "clock_offset" else 0.0
            if c.id == "lever_arm" and np.hypot(*trial.state.arm) > _MOST_ARM * vessel.length:
                continue
            cost = c.cost + (_FAR_COST if abs(late) > 2.0 else 0.0)
            # a sensor is late, not early; only all the others can be, and then the positions are
            cost = cost + (_EARLY_COST if late < 0 and "x_n" not in c.channels else 0.0)
            cost *= inflation
            trials.append((trial.loglik - cost, trial))
        if not trials:
            break
        first = first or trials
        worth, trial = _preferred(trials, vessel, antenna, inflation)
        if worth - best.loglik < _LEAST_GAIN * inflation:
            break
        chosen = trial.candidates
        tie.align(trial.state)
        best = fit(tie, chosen, trial.state)
    best = _without_one(tie, _pruned(tie, best, start, vessel, antenna), start, inflation)
    best = _exchanged(tie, best, usable, inflation)
    best = _simplest(tie, best, usable, start, inflation)
    final = _pruned(tie, best, start, vessel, antenna)
    rivals = _rivals(first, final, vessel, antenna, inflation)
    findings = _findings(final, motion, vessel, antenna)
    if rivals:
        findings = [replace(f, evidence=f"{f.evidence}; {rivals}") for f in findings]
    return findings, _outcomes(tie, final, usable)


def _preferred(
    trials: list[tuple[float, Fit]], vessel: Vessel, antenna: tuple[float, ...], inflation: float
) -> tuple[float, Fit]:
    """Return the best trial; of those nearly as good, one that is large enough to report."""
    best = max(trials, key=_first)
    large = [
        t
        for t in trials
        if _worth(t[1], len(t[1].candidates) - 1, vessel, antenna) >= 1.0
        and t[0] > best[0] - _NEARLY * inflation
    ]
    return max(large, key=_first) if large else best


def _rivals(
    first: list[tuple[float, Fit]],
    found: Fit,
    vessel: Vessel,
    antenna: tuple[float, ...],
    inflation: float,
) -> str:
    """Say what else would explain as much, where one defect was found."""
    if len(found.candidates) != 1:
        return ""
    mine = _net(found, inflation)
    said = []
    for worth, trial in sorted(first, key=_first, reverse=True):
        c = trial.candidates[0]
        alike = set(c.channels) & set(found.candidates[0].channels) and c.id == "clock_offset"
        if c == found.candidates[0] or (alike and found.candidates[0].id == c.id):
            continue
        if worth < mine - _NEARLY * inflation or _worth(trial, 0, vessel, antenna) < 1.0:
            continue
        if c.id == "clock_offset":
            late = trial.state.late[c.channels[0]]
            said.append(f"{' and '.join(c.channels)} {late:+.2f} s late")
        elif c.id == "lever_arm":
            said.append(f"an antenna at ({trial.state.arm[0]:.2f}, {trial.state.arm[1]:.2f}) m")
        else:
            said.append(f"a heading bias of {np.degrees(trial.state.bias):.1f} deg")
    if not said:
        return ""
    return f"{' or '.join(said[:2])} would explain nearly as much of this motion"


def _exchanged(tie: Tie, found: Fit, usable: list[Candidate], inflation: float) -> Fit:
    """Exchange one late channel for another where that explains more beside the rest.

    What was taken first was taken alone, and may stand for two defects together.
    """
    if len(found.candidates) < 2:
        return found
    best, worth = found, _net(found, inflation)
    for k, old in enumerate(found.candidates):
        if old.id != "clock_offset":
            continue
        for new in usable:
            if new.id != "clock_offset" or new in found.candidates:
                continue
            others = tuple(c for j, c in enumerate(found.candidates) if j != k)
            state = _restored(found.state, old, found.state)
            trial = fit(tie, (*others, new), state)
            if _net(trial, inflation) > worth + 2.0 * inflation:
                best, worth = trial, _net(trial, inflation)
    return best


def _simplest(tie: Tie, found: Fit, usable: list[Candidate], start: State, inflation: float) -> Fit:
    """Return one late sensor in place of several defects where it explains nearly as much."""
    extra = len(found.candidates) - 1
    if extra < 1:
        return found
    best, worth = found, _net(found, inflation) - extra * _NEARLY * inflation
    for c in usable:
        if c.id == "clock_offset":
            trial = fit(tie, (c,), _scan(tie, c, start))
            if _net(trial, inflation) > worth:
                best, worth = trial, _net(trial, inflation)
    return best


def _without_one(tie: Tie, found: Fit, start: State, inflation: float) -> Fit:
    """Drop a candidate that another, looked for anew, makes needless."""
    for old in found.candidates if len(found.candidates) > 1 else ():
        others = tuple(c for c in found.candidates if c is not old)
        state = _restored(found.state, old, start)
        begins = [state]
        if len(others) == 1:
            begins.append(_scan(tie, others[0], start))
        for begin in begins:
            trial = fit(tie, others, begin)
            if _net(trial, inflation) > _net(found, inflation) - _LEAST_GAIN * inflation:
                return _without_one(tie, trial, start, inflation)
    return found


def _net(found: Fit, inflation: float) -> float:
    return found.loglik - inflation * sum(c.cost for c in found.candidates)


def _pruned(tie: Tie, found: Fit, start: State, vessel: Vessel, antenna: tuple[float, ...]) -> Fit:
    """Drop what is too small or too uncertain, least certain first, and fit the rest anew."""
    while found.candidates:
        worth = [_worth(found, k, vessel, antenna) for k in range(len(found.candidates))]
        weakest = int(np.argmin(worth))
        if worth[weakest] >= 1.0:
            break
        kept = tuple(c for k, c in enumerate(found.candidates) if k != weakest)
        state = _restored(found.state, found.candidates[weakest], start)
        found = (
            fit(tie, kept, state)
            if kept
            else Fit(start, (), np.zeros((0, 0)), found.loglik, np.zeros(0))
        )
    return found


def _restored(state: State, candidate: Candidate, start: State) -> State:
    if candidate.id == "clock_offset":
        return replace(
            state, late={k: v for k, v in state.late.items() if k not in candidate.channels}
        )
    if candidate.id == "heading_bias":
        return replace(state, bias=start.bias)
    return replace(state, arm=start.arm)


def _worth(found: Fit, k: int, vessel: Vessel, antenna: tuple[float, ...]) -> float:
    """Return how far a candidate passes both thresholds; below one it is no finding."""
    c = found.candidates[k]
    at = sum(size(o) for o in found.candidates[:k])
    cov = found.covariance[at : at + size(c), at : at + size(c)]
    if c.id == "lever_arm":
        off = np.array(found.state.arm) - np.array(antenna)
        least = _LEAST_ARM[0] + _LEAST_ARM[1] * vessel.length
        wald = float(off @ np.linalg.solve(cov + 1e-12 * np.eye(2), off))
        return float(min(np.hypot(*off) / least, np.sqrt(wald / (_SIGMAS**2 + 4))))
    std = float(np.sqrt(cov[0, 0]))
    if c.id == "clock_offset":
        value, least = found.state.late.get(c.channels[0], 0.0), _LEAST_CLOCK
    else:
        value, least = float(np.angle(np.exp(1j * found.state.bias))), float(_LEAST_HEADING)
    return min(abs(value) / least, abs(value) / (_SIGMAS * std))


_IDS = ("clock_offset", "lever_arm", "heading_bias")


def _first(pair: tuple[float, Fit]) -> float:
    return pair[0]


def _usable(c: Candidate, motion: Motion) -> bool:
    if not all(n in motion for n in c.channels):
        return False
    if c.id != "clock_offset":
        return motion.positioned
    if not motion.positioned:
        # heading against yaw rate alone: which of the two is late cannot be told
        return c.channels == ("r",)
    if c.channels in (("psi", "r"), ("u", "v", "r")):
        return motion.turned
    return motion.turned or "r" not in c.channels


def _scan(tie: Tie, candidate: Candidate, state: State) -> State:
    """Return a start near the best of a coarse scan, so that large offsets are found."""
    if candidate.id == "lever_arm":
        return state
    gain = _gain(tie, state)
    steps = (
        np.array(_SCAN)
        if candidate.id == "clock_offset"
        else np.radians([-150, -120, -90, -60, -40, -25, -12, 0, 12, 25, 40, 60, 90, 120, 150, 180])
    )
    nuisance = _columns(tie, state, gain)
    if candidate.id == "heading_bias":
        # a free scale may be negative, and then half a turn changes nothing
        nuisance = np.delete(nuisance, tie.columns - 1, axis=1)
    scores = []
    for step in steps:
        y = _residual(tie, state.moved(candidate, np.array([step])), gain)
        rest = y - nuisance @ solve(nuisance, y)
        scores.append(float(rest @ rest))
    return state.moved(candidate, np.array([steps[int(np.argmin(scores))]]))


def _findings(
    found: Fit, motion: Motion, vessel: Vessel, antenna: tuple[float, ...]
) -> list[Finding]:
    findings = []
    at = 0
    for c in found.candidates:
        k = size(c)
        std = np.sqrt(np.diag(found.covariance[at : at + k, at : at + k]))
        at += k
        if c.id == "clock_offset":
            late = found.state.late.get(c.channels[0], 0.0)
            findings.append(_clock_finding(c, late, float(std[0]), motion))
        elif c.id == "heading_bias":
            bias = float(np.angle(np.exp(1j * found.state.bias)))
            findings.append(_heading_finding(bias, float(std[0])))
        else:
            findings.append(_arm_finding(np.array(found.state.arm), std, antenna))
    return findings


def _clock_finding(c: Candidate, value: float, std: float, motion: Motion) -> Finding:
    channels = c.channels
    if channels == ("x_n", "y_n") and value < 0:
        # a sensor can be late, not early: then all the others are
        channels, value = tuple(n for n in ("u", "v", "psi", "r") if n in motion), -value
    names = ", ".join(channels[:-1]) + " and " + channels[-1] if len(channels) > 1 else channels[0]
    late = "late" if value > 0 else "early"
    against = [n for n in ("x_n", "psi", "u", "r") if n in motion and n not in channels]
    half = ""
    if "x_n" in channels and abs(value - 0.5 * motion.step) < max(2.5 * std, 0.02):
        half = " (half a sample: a simulation by Euler's rule at this step looks the same)"
    return Finding(
        "clock_offset",
        channels[0],
        value,
        (value - 1.96 * std, value + 1.96 * std),
        "s",
        f"{names} {'comes' if len(channels) == 1 else 'come'} {abs(value):.2f} s {late} against "
        f"{_words(against)}: shifted so, positions, velocities and heading agree{half}",
        f"shift {names} by {-value:+.2f} s (import --fix does), and look for the delay in the "
        f"logger or a filter",
        channels,
        (Repair("shift", channels, (value,)),),
        True,
    )


def _words(names: list[str]) -> str:
    said = {"x_n": "the positions", "psi": "the heading", "u": "the velocities", "r": "the rate"}
    return " and ".join(said[n] for n in names) or "the rest"


def _heading_finding(value: float, std: float) -> Finding:
    return Finding(
        "heading_bias",
        "psi",
        value,
        (value - 1.96 * std, value + 1.96 * std),
        "rad",
        f"the heading is {np.degrees(abs(value)):.1f} deg "
        f"{'clockwise' if value > 0 else 'anticlockwise'} of the direction in which u and v carry "
        f"the positions ({np.degrees(std) * 1.96:.1f} deg at 95 %); a constant velocity of the "
        f"water is allowed for",
        f"subtract {value:.4f} rad from psi if the compass is misaligned (import --fix-also "
        f"heading_bias does), or turn u, v by as much if the velocity sensor is",
        ("psi",),
        (Repair("turn", ("psi",), (value,)),),
        False,
    )


def _arm_finding(arm: Array, std: Array, antenna: tuple[float, ...]) -> Finding:
    ci = tuple((float(a - 1.96 * s), float(a + 1.96 * s)) for a, s in zip(arm, std, strict=True))
    said = f"({antenna[0]:g}, {antenna[1]:g})"
    return Finding(
        "lever_arm",
        "x_n",
        (float(arm[0]), float(arm[1])),
        ci,
        "m",
        f"the positions are those of a point {arm[0]:+.2f} m forward and {arm[1]:+.2f} m to "
        f"starboard of where u and v hold (the vessel file says {said}): they swing by so much "
        f"when the ship turns",
        f"write antenna = [{arm[0]:.2f}, {arm[1]:.2f}] in [sensors], or import --fix, which moves "
        f"the positions to where the vessel file has them",
        ("x_n", "y_n"),
        (
            Repair(
                "lever",
                ("x_n", "y_n"),
                tuple(float(a - d) for a, d in zip(arm, antenna, strict=True)),
            ),
        ),
        True,
    )


def _outcomes(tie: Tie, found: Fit, usable: list[Candidate]) -> list[Outcome]:
    """Say for each id what its standard error would allow to see."""
    outcomes = []
    m = tie.motion
    for kind in _IDS:
        members = [c for c in usable if c.id == kind and c not in found.candidates]
        if not any(c.id == kind for c in usable):
            outcomes.append(
                Outcome(
                    kind, "cannot tell",
                    "needs positions, heading and velocities of a sensor of their own",
                )
            )  # fmt: skip
            continue
        if kind == "clock_offset" and not m.positioned:
            outcomes.append(
                Outcome(kind, "clean", "heading against yaw rate; no positions to tell which")
            )
            continue
        if kind == "clock_offset":
            outcomes.append(_clock_outcome(tie, found, usable))
            continue
        if not members:
            outcomes.append(Outcome(kind, "clean", "positions, velocities and heading compared"))
            continue
        with_it = fit(tie, (*found.candidates, members[0]), found.state, rounds=1)
        k = size(members[0])
        std = np.sqrt(np.diag(with_it.covariance))[-k:]
        span = np.degrees(np.ptp(m["psi"]))
        if kind == "heading_bias" and std[0] > _VAGUE_HEADING:
            outcomes.append(
                Outcome(
                    kind, "cannot tell",
                    f"the heading stays within {span:.0f} deg and the speed nearly constant: a "
                    f"bias cannot be told from a current (standard error "
                    f"{np.degrees(std[0]):.1f} deg)",
                )
            )  # fmt: skip
        elif kind == "lever_arm" and float(np.max(std)) > 0.5:
            outcomes.append(
                Outcome(
                    kind, "cannot tell",
                    f"the heading turns too little ({span:.0f} deg): standard error "
                    f"{float(np.max(std)):.2g} m",
                )
            )  # fmt: skip
        else:
            error = (
                f"{np.degrees(std[0]):.2f} deg"
                if kind == "heading_bias"
                else f"{std[0]:.2g} and {std[1]:.2g} m"
            )
            outcomes.append(Outcome(kind, "clean", f"standard error {error}"))
    return outcomes


def _clock_outcome(tie: Tie, found: Fit, usable: list[Candidate]) -> Outcome:
    """Say how well each clock is known, and which cannot be told."""
    known: list[str] = []
    vague: list[str] = []
    for c in usable:
        if c.id != "clock_offset" or c.channels not in _OWN_CLOCKS or c in found.candidates:
            continue
        fitted = fit(tie, (*found.candidates, c), found.state, rounds=1)
        std = float(np.sqrt(fitted.covariance[-1, -1]))
        words = f"{', '.join(c.channels)} {std:.2g} s"
        (vague if std > _VAGUE_CLOCK else known).append(words)
    if not known:
        said = f"this motion tells no clock apart (standard errors: {'; '.join(vague)})"
        return Outcome("clock_offset", "cannot tell", said)
    said = f"standard errors: {'; '.join(known)}"
    if vague:
        said += f"; cannot tell: {'; '.join(vague)}"
    return Outcome("clock_offset", "clean", said)
