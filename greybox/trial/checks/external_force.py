"""Motion that the thrusters cannot have caused: towed, pushed, moored, aground.

A response model of the logs themselves leaves a remainder: the rate of change of surge and of
sway is regressed on damping, thrust, wind and current (equations linear in their coefficients),
and a force from outside is one more regressor, constant for 15 to 120 s in body axes or fixed to
the earth. Model and force are fitted together, so a force costs no more certainty than it has in
common with the regressors. Hull and thrusters feel velocities through the water: the steady
current of each log is found with the coefficients. These have a normal prior, one variance for
each kind of term, and what remains is coloured noise (an ARMA process: misfit and gusts, and
sensor noise that differences of velocities hold); variances and colour are those of the greatest
evidence, so that nothing has to be known of the model's errors but that they are alike throughout
the logs. Where they are not, in motion that is like no other in the logs, a smooth function of
motion and thrust (a Gaussian process) stands beside model and force.

References
----------
Fossen (2011), Handbook of Marine Craft Hydrodynamics and Motion Control, 8.3: relative velocity.
MacKay (1992), Bayesian interpolation: evidence and number of well-determined parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.numerics.recursion import decay
from greybox.numerics.robust import robust_deviation
from greybox.rotation import ned_to_body
from greybox.trial.checks.finding import Finding, Outcome
from greybox.trial.checks.motion import (
    Motion,
    denoise,
    make_motion,
    means_between,
    orderly,
    slope,
)
from greybox.trial.convert.derived_signals import BODY, EARTH
from greybox.trial.convert.resample import clock as make_clock
from greybox.trial.convert.resample import hold_mean
from greybox.trial.gaps import runs
from greybox.trial.raw_log import Array, Mask, Recording
from greybox.trial.steps import Step
from greybox.vessel.force import generalised_force
from greybox.vessel.vessel import Vessel

_AIR = ("u_q", "v_q")
# time over which a rate of change is taken [s], and most of them, beyond which it is longer
_STEP, _MOST_STEPS = 2.0, 1500
# how long a force acts [s], and the part of a log beyond which it cannot be told from a steady one
_LENGTHS, _LONGEST_SHARE = (30.0, 60.0, 120.0), 1 / 3
# least length of all logs together [s]
_LEAST_SECONDS = 240.0
# chance of a false finding if the tail of usual stretches goes on as it begins, small because that
# of ships of another kind does not (see the manual); stretches that count for one of a scan
_LEVEL, _OVERLAP = 1e-7, 3.0
# what matters: force over thrust at half speed
_LEAST_SHARE = 0.08
# the same of a ship that stands, of which the stretches in which it sails tell less
_LEAST_HELD = 0.5
# thrust at half speed over its standard error, below which no share of it can be told
_KNOWN = 3.0
# speed that is left where a ship with thrust is held, over the top speed
_STANDING = 0.1
# steps beside such a stretch in which the ship is stopped or let go
_BESIDE = 3
# no log has more stretches of this kind that are told one by one
_MOST_EVENTS = 5
# coefficients that are tried: of autoregression (misfit) and moving average (differenced noise)
_MEMORY = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98)
_DIFFERENCED = (0.0, 0.4, 0.7, 0.85, 0.93, 0.97)
# kinds of terms: of a ship alike to port and starboard, what such a ship has not, finer terms of
# hull and thrusters, current and wind, their products; and with a prior that is not estimated:
# turning, starts of stretches, steps and forces of their own
_SHIP, _ASKEW, _FINE, _FLOW, _FLOW_FINE, _MISFIT, _TURN, _START, _FREE = range(9)
_FITTED = 6
# mass that accelerates in sway over that in surge (Coriolis forces of rigid body and added mass)
_MASSES, _MASSES_STD = 1.4, 0.4
# prior standard deviation of a free coefficient, over that of the noise
_VAGUE = 1e3
# prior standard deviation of a current and a small change of one, over the top speed
_CURRENT, _CURRENT_STEP = 0.2, 0.02
# places of motion and thrust at which a smooth remainder of the model is told, and the distance
# over which it is alike, over the standard deviation of each
_PLACES, _SMOOTH = 60, 1.0
# robust deviations from the steps around at which a step is one of the sensor, and steps around
_JUMP, _AROUND, _ROUNDS_OF_JUMPS = 6.0, 9, 4
# time over which wind and waves are alike [s]
_ALIKE = 60.0
# rounds in which the variances of the prior settle
_ROUNDS = 8
# part of the stretches below which lies the usual, logarithm of that beyond, and the shape of a
# Weibull tail by its mean excess over that size: (log 4 · excess)^-0.76 within 1 % from 1 to 2
_TAIL, _SHAPE = 0.75, 0.76
_LOG_TAIL = float(-np.log(1 - _TAIL))
# that size of normal noise, of two degrees of freedom
_OF_NOISE = float(np.sqrt(2 * _LOG_TAIL))
# shifts by which stretches overlap, stretches that are judged at once, and steps after which
# an innovation is forgotten
_SHIFTS, _CHUNK, _REACH = 4, 200, 100


def force_findings(
    recordings: Sequence[Recording], vessel: Vessel
) -> tuple[list[list[Finding]], list[Outcome | None]]:
    """Find stretches in which something else than its thrusters moved or held the ship.

    Parameters
    ----------
    recordings : sequence of Recording
        Canonical, mended, of one ship.
    vessel : Vessel

    Returns
    -------
    findings : list of list of Finding
        Of each recording.
    outcomes : list of Outcome or None
        Of each recording, why nothing can be said; None where something can.
    """
    found: list[list[Finding]] = [[] for _ in recordings]
    read = [_read(recording, vessel) for recording in recordings]
    if any(not isinstance(x, str) and _wind_measured(x) for x in read):
        read = [x if isinstance(x, str) or _wind_measured(x) else _without_wind(x) for x in read]
    seconds = sum(len(x.motion) * x.motion.step for x in read if not isinstance(x, str))
    step = max(_STEP, seconds / _MOST_STEPS)
    told: list[Outcome | None] = []
    logs: list[_Log] = []
    for k, x in enumerate(read):
        log = x if isinstance(x, str) else _make_log(k, x, vessel, step)
        if isinstance(log, str):
            told.append(Outcome("external_force", "cannot tell", log))
        else:
            logs.append(log)
            told.append(None)
    if not logs:
        return found, told
    seconds = sum(len(x.t) * x.step for x in logs)
    if seconds < _LEAST_SECONDS:
        short = (
            f"{seconds:.0f} s of motion with thrusters, at least {_LEAST_SECONDS:.0f} s are "
            f"needed to know what is usual"
        )
        untold = Outcome("external_force", "cannot tell", short)
        return found, [t or untold for t in told]
    scan = _Scan(logs, _mover(read, vessel, step))
    half, spread = scan.half_thrust()
    if half < _KNOWN * spread:
        vague = (
            f"the thrust for half of the top speed is uncertain by {100 * spread / half:.0f} %, "
            f"at most {100 / _KNOWN:.0f} % are allowed: add logs with changes of thrust"
        )
        untold = Outcome("external_force", "cannot tell", vague)
        return found, [t or untold for t in told]
    for event in scan.events():
        log = scan.logs[event.log]
        found[log.number].append(_finding(event, log, recordings[log.number], scan))
    return found, told


@dataclass(frozen=True)
class _Read:
    """Motion in body axes and commands of one recording on one grid."""

    motion: Motion
    commands: dict[str, Array]


def _read(recording: Recording, vessel: Vessel) -> _Read | str:
    """Return motion and commands of a recording, or why it has none."""
    earth = not all(c in recording for c in BODY)
    names = (*(EARTH if earth else BODY), "psi")
    missing = [c for c in (*names, *vessel.commands) if c not in recording]
    if missing:
        return f"the log has no {', '.join(missing)}"
    motion = make_motion(recording, (*names, *(n for n in _AIR if n in recording)))
    if motion is None or not all(n in motion for n in names):
        return f"too few samples of {', '.join(names)} overlap"
    values = dict(motion.values)
    if earth:
        values["u"], values["v"] = ned_to_body(motion["v_n"], motion["v_e"], motion["psi"])
    # of slow turning the heading tells more than a rate gyro, whose noise adds up
    values["psi"] = denoise(motion["psi"], motion)
    values["r"] = slope(values["psi"], motion)
    commands = {}
    for c in vessel.commands:
        s = orderly(recording[c], angular=False)
        if not len(s):
            return f"the log has no value of {c}"
        commands[c] = hold_mean(make_clock(s.t), s.value, motion.t, motion.step)
    return _Read(replace(motion, values=values), commands)


def _wind_measured(x: _Read) -> bool:
    return all(n in x.motion for n in _AIR)


def _without_wind(x: _Read) -> _Read:
    """Return a recording whose wind, measured in others of the ship, explains nothing."""
    none = {n: np.zeros(len(x.motion)) for n in _AIR}
    return replace(x, motion=replace(x.motion, values={**x.motion.values, **none}))


def _drifted(x: _Read, current: Array) -> _Read:
    """Return a recording with its velocities through water that flows north and east [m/s]."""
    motion = x.motion
    along, across = ned_to_body(float(current[0]), float(current[1]), motion["psi"])
    values = motion.values | {"u": motion["u"] - along, "v": motion["v"] - across}
    return replace(x, motion=replace(motion, values=values))


def _mean_after(value: Array, motion: Motion) -> Array:
    """Return means over the sample that follows each time, by the cubic through four samples."""
    mean = value.copy()
    for a, b in motion.stretches:
        mean[a : b - 1] = means_between(value[a:b])
    return mean


def _terms(x: _Read, vessel: Vessel) -> tuple[NDArray[np.int64], Array]:
    """Return the kinds of terms (p,), and what may explain surge and sway (N, 2, p).

    Means over the sample that follows each time, as forces of held commands are.
    """
    motion = x.motion
    # as measured: a low-pass takes more from a turning ship than noise does from products
    u, v, r = (motion[s] for s in (*BODY, "r"))
    fast, aside, turn = np.abs(u), np.abs(v), np.abs(r)
    along = [u, u * fast, u**3, v * v, r * r]
    across = [v, r, u * v, v * aside, r * turn, aside * r, turn * v]
    fine = [u * v * v, u * r * r, u * v * r, fast * v * r]
    fine_across = [v**3, r**3, u * u * v, u * u * r, v * r * r, v * v * r]
    along, across, fine, fine_across = (
        [_mean_after(f, motion) for f in terms] for terms in (along, across, fine, fine_across)
    )
    ahead_mean, beside_mean, bend = (_mean_after(f, motion) for f in (u, v, u * fast))
    # thrust falls with the advance of the ship, its law may be another than the vessel file's, it
    # may come late, and each thruster may have a gain of its own
    for name, f in generalised_force(vessel, x.commands).items():
        ahead = name in ("taux", "race_drag", "rudder_drag")
        bent = f * bend if name.startswith("rudder") else f * np.abs(f)
        (along if ahead else across).append(f)
        (fine if ahead else fine_across).extend((f * ahead_mean, bent, slope(f, motion)))
    for thruster in vessel.thrusters:
        own = {c: x.commands[c] for c in thruster.columns}
        force = generalised_force(replace(vessel, thrusters=(thruster,)), own)
        parts = [force.get(name, np.zeros_like(u)) for name in ("taux", "tauy")]
        size = np.maximum(np.hypot(*parts), 1e-12)
        advance = (ahead_mean * parts[0] + beside_mean * parts[1]) / size
        for f, some in zip(parts, (fine, fine_across), strict=True):
            some.extend((f, f * advance, f * advance / np.sqrt(size), f / np.sqrt(size)))
    if _wind_measured(x):
        head, beam = motion["u_q"], motion["v_q"]
        air = np.hypot(head, beam)
        along += [_mean_after(f, motion) for f in (air * head, head * np.abs(head))]
        across += [_mean_after(f, motion) for f in (air * beam, head * beam)]
    c, s, one = np.cos(motion["psi"]), np.sin(motion["psi"]), np.ones_like(u)
    twice = [c * c - s * s, 2 * s * c]
    flow = [r * c, r * s, fast * c, fast * s, v * c, v * s, *twice]
    flow_across = [-r * s, r * c, -aside * s, aside * c, u * s, u * c, *twice]
    more = len(fine) - len(fine_across)
    fine_across += [np.zeros_like(u)] * more
    fine += [np.zeros_like(u)] * -more
    kinds = {_TURN: 1, _SHIP: 0, _ASKEW: 0, _FINE: len(fine), _FLOW: 3, _FLOW_FINE: len(flow)}
    turned, drifted, *shared = (_mean_after(f, motion) for f in (v * r, u * r, c, s))
    surge = [turned, *along, *across, *fine, one, *shared]
    surge += [_mean_after(f, motion) for f in flow]
    sway = [drifted, *along, *across, *fine_across, one, -shared[1], shared[0]]
    sway += [_mean_after(f, motion) for f in flow_across]
    kind = np.repeat(list(kinds), [kinds[k] for k in kinds])
    ship = np.repeat([_SHIP, _ASKEW], [len(along), len(across)])
    kind = np.insert(kind, 1, ship)
    return kind, np.stack([np.column_stack(surge), np.column_stack(sway)], axis=1)


@dataclass(frozen=True)
class _Log:
    """Rates of change of one log and what may explain them.

    Parameters
    ----------
    number : int
        Which of the recordings.
    t : ndarray
        (K,) middle of each step [s].
    step : float
        [s]
    stretches : tuple of (start, stop)
        Steps that follow each other without a gap.
    rate : ndarray
        (K, 2) rate of change of u and v [m/s²].
    kind : ndarray
        (p,) kinds of terms, of surge; of sway port and starboard change their places.
    terms : ndarray
        (K, 2, p)
    psi, speed : ndarray
        (K,) heading [rad] and surge [m/s].
    thrust : ndarray
        (K, q) generalised forces.
    motion : ndarray
        (K, 3) surge and sway [m/s] and rate of turn [rad/s].
    """

    number: int
    t: Array
    step: float
    stretches: tuple[tuple[int, int], ...]
    rate: Array
    kind: NDArray[np.int64]
    terms: Array
    psi: Array
    speed: Array
    thrust: Array
    motion: Array

    def of(self, s: int) -> tuple[NDArray[np.int64], Mask]:
        """Return the kinds of terms (p,) in surge or sway, and which are of this log alone."""
        swapped = np.array([_ASKEW, _SHIP, *range(_FINE, _FREE + 1)])
        kind = swapped[self.kind] if s else self.kind
        return kind, np.isin(kind, (_FLOW, _FLOW_FINE))

    def rate_beside_turning(self, s: int) -> Array:
        """Return the rate (K,) of surge or sway beside the usual force of turning [m/s²]."""
        return np.asarray(self.rate[:, s] - (_MASSES, -1 / _MASSES)[s] * self.terms[:, s, 0])


def _make_log(number: int, x: _Read, vessel: Vessel, step: float) -> _Log | str:
    """Return the rates of a recording, or why it has none."""
    motion = x.motion
    kind, terms = _terms(x, vessel)
    count = max(1, round(step / motion.step))
    measured = np.column_stack([motion["u"], motion["v"]])
    force = np.column_stack(list(generalised_force(vessel, x.commands).values()))
    states = np.column_stack([motion[n] for n in ("psi", *BODY, "r")])
    beside = np.column_stack([states, force, terms.reshape(len(motion), -1)])
    rate, times, means, stretches, at = [], [], [], [], 0
    for a, b in motion.stretches:
        m = (b - a) // count
        if m < 4:
            continue
        edges = a + count * np.arange(m)
        mean = measured[a : a + m * count].reshape(m, count, 2).mean(axis=1)
        rate.append(np.diff(mean, axis=0) / (count * motion.step))
        times.append(motion.t[edges[1:]] - 0.5 * motion.step)
        means.append(_between(beside[a:b], edges - a, count))
        stretches.append((at, at + m - 1))
        at += m - 1
    if not rate:
        return "no stretch without a gap is long enough"
    made = np.concatenate(means)
    return _Log(
        number,
        np.concatenate(times),
        count * motion.step,
        tuple(stretches),
        np.concatenate(rate),
        kind,
        made[:, 4 + force.shape[1] :].reshape(-1, 2, len(kind)),
        made[:, 0],
        made[:, 1],
        made[:, 4 : 4 + force.shape[1]],
        made[:, 1:4],
    )


def _mover(
    read: Sequence[_Read | str], vessel: Vessel, step: float
) -> Callable[[_Log, Array], _Log]:
    """Return what makes a log anew with velocities through water that flows."""

    def moved(log: _Log, current: Array) -> _Log:
        x = read[log.number]
        assert not isinstance(x, str)
        made = _make_log(log.number, _drifted(x, current), vessel, step)
        assert not isinstance(made, str)
        # a ship stands by its speed over ground
        return replace(made, speed=log.speed, stretches=log.stretches)

    return moved


def _between(x: Array, edges: NDArray[np.int64], count: int) -> Array:
    """Return what a rate from the mean of one block to that of the next is the mean of."""
    # a difference of block means weighs the time between by a triangle
    sums = np.vstack([np.zeros((1, x.shape[1])), np.cumsum(x, axis=0)])
    low = edges[:-1, None] + np.arange(count)
    return np.asarray((sums[np.minimum(low + count, len(x))] - sums[low]).mean(axis=1) / count)


@dataclass(frozen=True)
class _Noise:
    """An ARMA(1, 1) process: coefficients of its past value and of its past innovation."""

    memory: float
    differenced: float

    def whiten(self, z: Array) -> Array:
        """Return innovations of rows that follow each other, along axis 0."""
        return decay(self.differenced, z - self.memory * np.vstack([0.0 * z[:1], z[:-1]]))


@dataclass(frozen=True)
class _Fit:
    """Posterior of the coefficients of one equation, for columns of unit size.

    Parameters
    ----------
    noise : _Noise
    white : ndarray
        (N, p) innovations of the columns.
    rest : ndarray
        (N,) innovations that remain.
    theta : ndarray
        (p,)
    covariance : ndarray
        (p, p), over the variance of the innovations.
    variance : float
        Of the innovations.
    prior : ndarray
        Variances of the kinds that are fitted, over that of the innovations.
    evidence : float
        Logarithm, constants left out.
    """

    noise: _Noise
    white: Array
    rest: Array
    theta: Array
    covariance: Array
    variance: float
    prior: Array
    evidence: float


class _Equation:
    """Rate of change of surge or sway of all logs, and the columns that may explain it."""

    def __init__(self, rate: Array, stretches: Sequence[tuple[int, int]]) -> None:
        self.rate, self.stretches = rate, stretches
        self.kind = np.empty(0, np.int64)
        self.columns = np.empty((len(rate), 0))
        self.size = np.empty(0)
        self.weight = np.ones(len(rate))
        self.inside = np.zeros(len(rate), bool)
        for a, b in stretches:
            self.inside[a:b] = True
        self.starts: tuple[tuple[int, int], ...] = ((0, 3), (3, 2))
        self.prior = np.full(_FITTED, 10.0)
        self.fit: _Fit

    def add(self, kind: NDArray[np.int64], columns: Array) -> None:
        """Add columns (N, k) of some kinds."""
        size = np.sqrt(np.mean(columns**2, axis=0))
        size[size == 0] = 1.0
        self.kind = np.concatenate([self.kind, kind])
        self.columns = np.hstack([self.columns, columns / size])
        self.size = np.concatenate([self.size, size])

    def estimate(self) -> None:
        """Fit coefficients, variances and the colour of the noise by the evidence."""
        tried: dict[tuple[int, int], _Fit] = {}
        starts, prior = self.starts, self.prior

        def at(place: tuple[int, int]) -> float:
            if not all(0 <= k < len(_MEMORY) for k in place):
                return -np.inf
            if place not in tried:
                noise = _Noise(_MEMORY[place[0]], _DIFFERENCED[place[1]])
                tried[place] = self._posterior(noise, prior)
            return tried[place].evidence

        for start in starts:
            now, best = None, start
            while best != now:
                now = best
                prior = tried[now].prior if now in tried else prior
                near = [(now[0] + a, now[1] + b) for a, b in product((-1, 0, 1), repeat=2)]
                best = max(near, key=at)
        best = max(tried, key=lambda place: tried[place].evidence)
        self.fit = tried[best]
        # more columns or other weights change little
        self.starts, self.prior = (best,), self.fit.prior

    def _posterior(self, noise: _Noise, prior: Array) -> _Fit:
        white = np.zeros((len(self.rate), 1 + self.columns.shape[1]))
        both = np.column_stack([self.rate, self.columns])
        begun = []
        for a, b in self.stretches:
            white[a:b] = noise.whiten(both[a:b])
            # what happened before a stretch is not known
            column = np.zeros(len(self.rate))
            column[a:b] = (noise.memory - noise.differenced) * noise.differenced ** np.arange(b - a)
            begun.append(column)
        white = np.column_stack([white, *begun]) * self.weight[:, None]
        y, x = white[:, 0], white[:, 1:]
        kind = np.concatenate([self.kind, np.full(len(begun), _START)])
        gram, moment, power, n = x.T @ x, x.T @ y, float(y @ y), self.inside.sum()
        count = np.maximum(np.bincount(kind, minlength=_FREE + 1)[:_FITTED], 1)
        variance = power / n / 4
        turn = np.concatenate([self.size, np.ones(len(begun))])[kind == _TURN] * _MASSES_STD
        scale = np.empty(len(kind))
        for _ in range(_ROUNDS):
            scale[kind < _FITTED] = np.sqrt(prior[kind[kind < _FITTED]])
            scale[kind == _TURN] = turn / np.sqrt(variance)
            scale[kind == _START], scale[kind == _FREE] = 1.0, _VAGUE
            inner = np.eye(len(kind)) + scale[:, None] * gram * scale
            inverse = np.linalg.inv(inner)
            covariance = scale[:, None] * inverse * scale
            weights = inverse @ (scale * moment)
            theta = scale * weights
            # no difference of large numbers, which well-known coefficients make less than nothing
            variance = float(np.sum((y - x @ theta) ** 2) + np.sum(weights**2)) / n
            variance = max(variance, 1e-12 * power / n)
            lost = np.bincount(kind, np.diag(inverse), _FREE + 1)[:_FITTED]
            own = np.bincount(kind, theta**2, _FREE + 1)[:_FITTED] / variance
            last, prior = prior, np.clip(own / np.maximum(count - lost, 1e-6), 1e-8, 1e6)
            if np.all(np.abs(np.log(prior / last)) < 0.1):
                break
        evidence = -0.5 * (n * np.log(variance) + float(np.linalg.slogdet(inner)[1]))
        return _Fit(noise, x, y - x @ theta, theta, covariance, variance, prior, evidence)

    def of(self, rate: Array, columns: Array) -> _Equation:
        """Return the equation with other rates and first columns, its noise and prior kept."""
        other, first = copy(self), slice(columns.shape[1])
        other.rate = rate
        other.columns = self.columns.copy()
        other.columns[:, first] = columns / self.size[first]
        other.fit = other._posterior(self.fit.noise, self.prior)
        return other

    def whiten(self, columns: Array) -> Array:
        """Return the innovations of columns (N, k), weighed."""
        white = np.zeros_like(columns)
        for a, b in self.stretches:
            white[a:b] = self.fit.noise.whiten(columns[a:b])
        return np.asarray(white * self.weight[:, None])

    def settle(self, width: float) -> None:
        """Fit all; single steps that stand out from those around them are of the sensor.

        Steps are weighed by how large innovations are around them, within a width in steps.
        """
        from scipy.ndimage import gaussian_filter1d, median_filter

        self.estimate()
        for _ in range(_ROUNDS_OF_JUMPS):
            rest = self.rate - self.columns @ self.fit.theta[: len(self.kind)]
            apart = np.abs(rest - median_filter(rest, _AROUND, mode="nearest"))
            usual = robust_deviation(rest[self.inside])
            jumps = np.flatnonzero(self.inside & (apart > _JUMP * usual))
            if not len(jumps):
                break
            self.add(np.full(len(jumps), _FREE), np.eye(len(rest))[:, jumps])
            self.estimate()
        power = (self.fit.rest / self.weight) ** 2
        around = np.ones_like(power)
        for a, b in self.stretches:
            around[a:b] = gaussian_filter1d(power[a:b], width, mode="reflect")
        mean = power[self.inside].mean()
        self.weight = np.sqrt(mean / np.maximum(around, 1e-3 * mean))
        self.estimate()

    def without(self, part: slice, old: _Equation) -> _Equation:
        """Return an older equation, without some columns, fitted with these steps and weights."""
        less = copy(self)
        less.kind = np.delete(self.kind, part)
        less.columns = np.delete(self.columns, part, axis=1)
        less.size = np.delete(self.size, part)
        less.rate, less.columns[:, : part.start] = old.rate, old.columns[:, : part.start]
        less.starts = self.starts + old.starts
        less.estimate()
        return less

    def unexplained(self) -> Array:
        """Return the rate (N,) [m/s²] less all but steps and forces of their own."""
        kept = self.kind < _FREE
        return np.asarray(
            self.rate - self.columns[:, kept] @ self.fit.theta[: len(self.kind)][kept]
        )


@dataclass(frozen=True)
class _Event:
    """A stretch with a force of its own.

    Parameters
    ----------
    log, first, last : int
        Which of the logs, and the steps at whose middle the force begins and ends.
    fixed : bool
        To the earth; else to the ship.
    at : (int, int), optional
        Of each equation, the first of its two columns; None where the stretch is left out.
    """

    log: int
    first: int
    last: int
    fixed: bool
    at: tuple[int, int] | None


class _Scan:
    """The response model of all logs, and the stretches in which another force acts.

    Parameters
    ----------
    logs : sequence of _Log
    moved : callable
        (log, current (2,) north and east [m/s]) -> log with velocities through that water.
    """

    def __init__(self, logs: Sequence[_Log], moved: Callable[[_Log, Array], _Log]) -> None:
        self.moved, self.current = moved, np.zeros((len(logs), 2))
        self.top = float(np.quantile(np.abs(np.concatenate([x.speed for x in logs])), 0.95))
        self.standing = [_standing(x, _STANDING * self.top) for x in logs]
        # what holds a ship is not constant: it takes up all that the model says
        self.logs = logs = [_without(x, s) for x, s in zip(logs, self.standing, strict=True)]
        self.ends = np.cumsum([0, *(len(x.t) for x in logs)])
        self.psi = np.concatenate([x.psi for x in logs])
        self.free = np.ones(len(self.psi), bool)
        self._fit()
        self._follow_currents()
        self._fit()

    def _fit(self) -> None:
        """Fit both equations to the logs in their currents."""
        starts = zip(self.logs, self.ends[:-1], strict=True)
        spans = [(a + at, b + at) for x, at in starts for a, b in x.stretches]
        self.equations = []
        for s in range(2):
            rate, kind, columns = self._regression(s)
            equation = _Equation(rate, spans)
            equation.add(kind, columns)
            equation.settle(_ALIKE / self.logs[0].step)
            self.equations.append(equation)

    def _regression(self, s: int) -> tuple[Array, NDArray[np.int64], Array]:
        """Return rates (N,) of surge or sway, and kinds and columns (N, p) of all logs."""
        kind, own = self.logs[0].of(s)
        terms = np.concatenate([x.terms[:, s] for x in self.logs])
        rate = np.concatenate([x.rate_beside_turning(s) for x in self.logs])
        log = np.repeat(np.arange(len(self.logs)), np.diff(self.ends))[:, None]
        each = [terms[:, own] * (log == k) for k in range(len(self.logs))]
        kinds = np.concatenate([kind[~own], *[kind[own]] * len(each)])
        return rate, kinds, np.hstack([terms[:, ~own], *each])

    def _follow_currents(self) -> None:
        """Find the current of each log in which all explain most, noise and priors as they are.

        Products of velocities of hull and thrusters hold products with a steady current that
        terms linear in it do not. Gauss-Newton steps on the posterior of all currents.
        """
        spread, delta = _CURRENT * self.top, _CURRENT_STEP * self.top
        for _ in range(_ROUNDS):
            information = np.eye(self.current.size) / spread**2
            score = -self.current.ravel() / spread**2
            near = [
                [self.moved(log, current + delta * towards) for towards in np.eye(2)]
                for log, current in zip(self.logs, self.current, strict=True)
            ]
            for s, equation in enumerate(self.equations):
                fit, white = equation.fit, equation.whiten(self._slopes(s, near) / delta)
                shared = white.T @ fit.white
                information += (white.T @ white - shared @ fit.covariance @ shared.T) / fit.variance
                score -= white.T @ fit.rest / fit.variance
            move = np.linalg.solve(information, score).reshape(-1, 2)
            move *= np.minimum(1.0, spread / np.maximum(np.hypot(*move.T), 1e-12))[:, None]
            self.current = self.current + move
            pairs = zip(self.logs, self.current, strict=True)
            self.logs = [self.moved(log, current) for log, current in pairs]
            self.equations = [
                equation.of(*self._regression(s)[::2]) for s, equation in enumerate(self.equations)
            ]
            if np.abs(move).max() < delta:
                break

    def _slopes(self, s: int, near: Sequence[Sequence[_Log]]) -> Array:
        """Return how logs in currents near their own change what is left of rates (N, 2 K)."""
        slopes = np.zeros((len(self.psi), self.current.size))
        for k, (log, others) in enumerate(zip(self.logs, near, strict=True)):
            rows, left = slice(self.ends[k], self.ends[k + 1]), self._left(s, k, log)
            for i, other in enumerate(others):
                slopes[rows, 2 * k + i] = self._left(s, k, other) - left
        return slopes

    def _left(self, s: int, k: int, log: _Log) -> Array:
        """Return what of the rates of a log, in the place of the k-th, coefficients leave (K,)."""
        fit, size = self.equations[s].fit, self.equations[s].size
        _, own = log.of(s)
        theta = fit.theta[: len(size)] / size
        many, each = int(np.sum(~own)), int(np.sum(own))
        flow = theta[many + k * each :][:each]
        rate, terms = log.rate_beside_turning(s), log.terms[:, s]
        return np.asarray(rate - terms[:, ~own] @ theta[:many] - terms[:, own] @ flow)

    def half_thrust(self) -> tuple[float, float]:
        """Return the thrust per mass that half of the top speed needs [m/s²], and its error."""
        surge, half = self.equations[0], 0.5 * self.top
        drag = np.zeros(len(surge.fit.theta))
        drag[1:4] = -np.array([half, half**2, half**3]) / surge.size[1:4]
        spread = np.sqrt(surge.fit.variance * float(drag @ surge.fit.covariance @ drag))
        return max(float(drag @ surge.fit.theta), float(spread)), float(spread)

    def events(self) -> list[_Event]:
        """Return the stretches with a force of their own, the clearest first."""
        stood = [
            _Event(k, a, b - 1, False, None) for k, s in enumerate(self.standing) for a, b in s
        ]
        found = [e for e in stood if self.share(e)[1] > _LEAST_HELD]
        for _ in range(_MOST_EVENTS - len(found)):
            event = self._clearest()
            if event is None:
                break
            before = copy(self)
            self._allow(event)
            likely = self.share(event)[1] > _LEAST_SHARE and not self._by_chance(event, before)
            if likely and not self._lacking(event, before):
                found.append(event)
                continue
            self.equations = before.equations
            self.logs, self.current = before.logs, before.current
            if not likely:
                self.free = before.free
                break
        return found

    def _allow(self, event: _Event) -> None:
        """Fit a force of its own to a stretch, and all else anew."""
        at = self.ends[event.log]
        box = _boxes(len(self.psi), np.array([event.first + at]), np.array([event.last + at]))
        self.equations = [copy(equation) for equation in self.equations]
        for s, equation in enumerate(self.equations):
            equation.add(np.full(2, _FREE), box * self._directions(s, event.fixed))
            equation.settle(_ALIKE / self.logs[0].step)
        self._follow_currents()
        for equation in self.equations:
            equation.estimate()
        # what its begin and end leave beside it is not usual
        beside = event.last - event.first
        first = max(at, at + event.first - beside)
        self.free = self.free.copy()
        self.free[first : min(self.ends[event.log + 1], at + event.last + beside + 1)] = False

    def _by_chance(self, event: _Event, before: _Scan) -> bool:
        """Whether logs without other forces have one that explains as much."""
        return self._chance(self._added(event, before), event.fixed) > _LEVEL

    def _lacking(self, event: _Event, before: _Scan) -> bool:
        """Whether the force may be what the model lacks in motion that is like no other.

        A smooth function of motion and thrust stands beside the model: where a ship does a
        thing once, such as begin a hard turn, it explains what the model does not.
        """
        wide = copy(self)
        places = _places(np.concatenate([np.hstack([x.motion, x.thrust]) for x in self.logs]))
        wide.equations = [copy(equation) for equation in self.equations]
        for equation in wide.equations:
            equation.add(np.full(places.shape[1], _MISFIT), places)
            equation.estimate()
        return wide._by_chance(event, before)

    def _added(self, event: _Event, before: _Scan) -> float:
        """Return twice the log-likelihood that a force adds: 0 where all else explains as much.

        Currents, variances and the colour of the noise are fitted anew without it too: the force
        over its standard error would take what is left beside the force for known.
        """
        none, added = copy(before), 0.0
        assert event.at is not None
        none.equations = [
            equation.without(slice(at, at + 2), old)
            for equation, old, at in zip(self.equations, before.equations, event.at, strict=True)
        ]
        none._follow_currents()
        for equation, less, at in zip(self.equations, none.equations, event.at, strict=True):
            less.estimate()
            own = equation.fit.covariance[at : at + 2, at : at + 2] / _VAGUE**2
            added += 2 * (equation.fit.evidence - less.fit.evidence)
            added -= float(np.linalg.slogdet(own)[1])
        return max(added, 0.0)

    def force(self, event: _Event) -> tuple[Array, Array]:
        """Return the force per mass of an event (2,) [m/s²], and its covariance (2, 2)."""
        if event.at is None:
            return self._left_out(event)
        information, weighed = np.zeros((2, 2)), np.zeros(2)
        for equation, at in zip(self.equations, event.at, strict=True):
            fit, part = equation.fit, slice(at, at + 2)
            size = equation.size[part]
            prior = np.diag((size / _VAGUE) ** 2) / fit.variance
            own = fit.variance * fit.covariance[part, part] / np.outer(size, size)
            precision = np.asarray(np.linalg.inv(own))
            information += precision - prior
            weighed += precision @ (fit.theta[part] / size)
        spread = np.asarray(np.linalg.inv(information))
        return np.asarray(spread @ weighed), spread

    def _left_out(self, event: _Event) -> tuple[Array, Array]:
        """Return the mean of what the model, fitted elsewhere, leaves of a stretch."""
        rows = slice(*(self.ends[event.log] + np.array([event.first, event.last + 1])))
        force, variance = np.empty(2), np.empty(2)
        for s, equation in enumerate(self.equations):
            fit, count = equation.fit, len(equation.kind)
            mean = equation.columns[rows].mean(axis=0)
            force[s] = equation.rate[rows].mean() - mean @ fit.theta[:count]
            colour = (1 - fit.noise.differenced) / (1 - fit.noise.memory)
            own = mean @ fit.covariance[:count, :count] @ mean
            variance[s] = fit.variance * (own + colour**2 / (event.last + 1 - event.first))
        return force, np.diag(variance)

    def share(self, event: _Event) -> tuple[float, float, float]:
        """Return the force of an event over the thrust at half speed, with its interval."""
        force, covariance = self.force(event)
        half, spread = self.half_thrust()
        size = float(np.hypot(*force))
        error = float(np.sqrt(force @ covariance @ force)) / size
        # both are uncertain by a factor
        factor = float(np.exp(1.96 * np.hypot(error / size, spread / half)))
        return size / half, size / half / factor, size / half * factor

    def _directions(self, equation: int, fixed: bool) -> Array:
        """Return what of a force forward and starboard, or north and east, an equation feels."""
        if not fixed:
            return np.tile(np.eye(2)[equation], (len(self.psi), 1))
        c, s = np.cos(self.psi), np.sin(self.psi)
        return np.column_stack([-s, c] if equation else [c, s])

    def _clearest(self) -> _Event | None:
        """Return the force that explains most, of what is usual for its frame; None of none."""
        least = _LEAST_SHARE * self.half_thrust()[0]
        best, largest = None, 0.0
        at = (len(self.equations[0].kind), len(self.equations[1].kind))
        for fixed in (False, True):
            place, force, gain = self._scanned(fixed)
            matters = np.where(np.hypot(*force.T) > least, gain, 0.0)
            if not matters.any():
                continue
            k = int(np.argmax(matters))
            size = gain[k] / float(np.quantile(gain, _TAIL) + 1)
            if size > largest:
                log, first, last = (int(x) for x in place[k])
                best, largest = _Event(log, first, last, fixed, at), size
        return self._refined(best) if best is not None else None

    def _chance(self, gain: float, fixed: bool) -> float:
        """Return how often logs without other forces have one anywhere that explains so much."""
        excess, tails = [], {}
        for frame in (False, True):
            usual = np.sqrt(self._scanned(frame)[2])
            if not len(usual):
                return 1.0
            own = float(np.quantile(usual, _TAIL))
            excess.append(usual[usual > own] / own - 1)
            # noise alone explains as much, though few stretches may happen to explain less
            tails[frame] = max(own, _OF_NOISE)
        # a Weibull tail: of normal noise of shape 2, of gusts and misfit longer
        beyond = _LOG_TAIL * float(np.concatenate(excess).mean())
        shape = min(2.0, float(beyond**-_SHAPE))
        seconds = sum(len(x.t) * x.step for x in self.logs)
        many = _OVERLAP * len(tails) * sum(seconds / length for length in _LENGTHS)
        return many * float(np.exp(-_LOG_TAIL * (np.sqrt(gain) / tails[fixed]) ** shape))

    def _scanned(self, fixed: bool) -> tuple[NDArray[np.int64], Array, Array]:
        parts = [self._gains(length, fixed) for length in _LENGTHS]
        place, force, gain = (np.concatenate(x) for x in zip(*parts, strict=True))
        return place, force, gain

    def _gains(self, length: float, fixed: bool) -> tuple[NDArray[np.int64], Array, Array]:
        """Return place (W, 3), force (W, 2) and gain (W,) of stretches of a length."""
        places = [np.empty((0, 3), np.int64)]
        forces, gains = [np.empty((0, 2))], [np.empty(0)]
        taken = np.concatenate([[0], np.cumsum(~self.free)])
        for k, log in enumerate(self.logs):
            size, at = max(round(length / log.step), 2), self.ends[k]
            if size > _LONGEST_SHARE * len(log.t):
                continue
            for a, b in log.stretches:
                first = np.arange(a, b - size, max(1, size // _SHIFTS)) + at
                first = first[taken[first + size + 1] == taken[first]]
                for part in np.split(first, np.arange(_CHUNK, len(first), _CHUNK)):
                    if len(part):
                        force, gain = self._explained(part, part + size, b + at, fixed)
                        forces.append(force)
                        gains.append(gain)
                        place = part[:, None] - at + np.array([0, size])
                        places.append(np.insert(place, 0, k, axis=1))
        return np.concatenate(places), np.concatenate(forces), np.concatenate(gains)

    def _refined(self, event: _Event) -> _Event:
        """Return the event with begin and end where it explains most."""
        at, size = int(self.ends[event.log]), event.last - event.first
        stretches = self.logs[event.log].stretches
        low, high = next((a, b) for a, b in stretches if a <= event.first < b)
        moves = np.unique(np.round(size * np.linspace(-0.5, 0.5, 11)).astype(np.int64))
        ends = [
            (event.first + m, event.last + n)
            for m, n in product(moves, moves)
            if low <= event.first + m
            and event.last + n < high
            and n - m >= -size / 2
            and self.free[at + event.first + m : at + event.last + n + 1].all()
        ]
        first, last = np.array(ends, np.int64).T
        _, gain = self._explained(first + at, last + at, high + at, event.fixed)
        best = int(np.argmax(gain))
        return replace(event, first=int(first[best]), last=int(last[best]))

    def _explained(
        self, first: NDArray[np.int64], last: NDArray[np.int64], stop: int, fixed: bool
    ) -> tuple[Array, Array]:
        """Return the forces (W, 2) of stretches before a step, and what they add to the fit (W,).

        Twice the log-likelihood, all else fitted too: of two degrees of freedom.
        """
        rows = slice(int(first.min()), min(stop, int(last.max()) + _REACH))
        box = _boxes(rows.stop - rows.start, first - rows.start, last - rows.start)
        information, score = np.zeros((len(first), 2, 2)), np.zeros((len(first), 2))
        for s, equation in enumerate(self.equations):
            fit, towards = equation.fit, self._directions(s, fixed)[rows]
            weight = equation.weight[rows, None]
            white = [fit.noise.whiten(box * towards[:, i : i + 1]) * weight for i in range(2)]
            shared = [w.T @ fit.white[rows] for w in white]
            for i, j in product(range(2), repeat=2):
                alone = np.einsum("nw,nw->w", white[i], white[j])
                known = np.einsum("wp,wp->w", shared[i] @ fit.covariance, shared[j])
                information[:, i, j] += (alone - known) / fit.variance
            for i in range(2):
                score[:, i] += white[i].T @ fit.rest[rows] / fit.variance
        force = np.asarray(np.linalg.solve(information, score[:, :, None])[:, :, 0])
        return force, np.sum(force * score, axis=1)


def _places(states: Array) -> Array:
    """Return the columns (N, M) of a smooth function of states (N, q): a Gaussian process.

    By its values at places as far from each other as there are (Nyström).
    """
    scale = states.std(axis=0)
    x = (states - states.mean(axis=0))[:, scale > 0] / scale[scale > 0] / _SMOOTH
    apart = np.sum((x - x.mean(axis=0)) ** 2, axis=1)
    chosen: list[int] = []
    for _ in range(min(_PLACES, len(x))):
        chosen.append(int(np.argmax(apart if chosen else -apart)))
        from_it = np.sum((x - x[chosen[-1]]) ** 2, axis=1)
        apart = np.minimum(apart, from_it) if len(chosen) > 1 else from_it
    places = x[chosen]
    squares = np.sum(x**2, axis=1)[:, None] + np.sum(places**2, axis=1) - 2 * x @ places.T
    alike = np.exp(-0.5 * np.maximum(squares, 0.0))
    root = np.linalg.cholesky(alike[chosen] + 1e-6 * np.eye(len(chosen)))
    return np.asarray(np.linalg.solve(root, alike.T).T)


def _standing(log: _Log, slow: float) -> list[tuple[int, int]]:
    """Return the steps in which a ship stands, in a log in which it mostly sails."""
    least = _LENGTHS[0] / log.step
    found = [(a, b) for a, b in runs(np.abs(log.speed) < slow) if b - a >= least]
    whole = sum(b - a for a, b in found) <= _LONGEST_SHARE * len(log.t)
    within = [s for s in found if any(a <= s[0] and s[1] <= b for a, b in log.stretches)]
    return within if whole else []


def _without(log: _Log, standing: Sequence[tuple[int, int]]) -> _Log:
    """Return the log with its stretches cut around those in which the ship stands."""
    kept = np.zeros(len(log.t), np.int64)
    for k, (a, b) in enumerate(log.stretches):
        kept[a:b] = k + 1
    for a, b in standing:
        kept[max(a - _BESIDE, 0) : b + _BESIDE] = 0
    parts = [p for k in range(len(log.stretches)) for p in runs(kept == k + 1)]
    return replace(log, stretches=tuple((a, b) for a, b in parts if b - a >= 4))


def _boxes(rows: int, first: NDArray[np.int64], last: NDArray[np.int64]) -> Array:
    """Return forces (rows, W) of one from the middle of one step to that of another."""
    step = np.arange(rows)[:, None]
    return 0.5 * ((step >= first) & (step < last)) + 0.5 * ((step > first) & (step <= last))


def _finding(event: _Event, log: _Log, recording: Recording, scan: _Scan) -> Finding:
    (x, y), _ = scan.force(event)
    share, low, high = scan.share(event)
    begin, end = float(log.t[event.first]), float(log.t[event.last])
    towards = float(np.degrees(np.arctan2(y, x)))
    if event.fixed:
        where = f"towards {towards % 360:.0f} deg from north"
    else:
        where = f"towards {abs(towards):.0f} deg to {'starboard' if y > 0 else 'port'} of the bow"
    speed = float(np.median(np.abs(log.speed[event.first : event.last])))
    standing = speed < _STANDING * scan.top and (event.fixed or x < 0)
    what = "held, moored or aground" if standing else "towed or pushed"
    return Finding(
        "external_force",
        "u" if abs(x) >= abs(y) else "v",
        share,
        (low, high),
        "1",
        f"from t = {begin:.6g} to {end:.6g} s the ship moves as if {what}: a force of "
        f"{100 * share:.0f} % of the thrust at half speed acts {where}, which its thrusters "
        f"cannot have caused",
        f"ask what happened from t = {begin:.6g} to {end:.6g} s; leave it out of estimates, or "
        f"import --fix-also external_force",
        BODY,
        (Step("drop", recording.names, interval=(begin, end), decided_by="check"),),
        False,
        _picture((begin, end), log, scan),
    )


def _picture(interval: tuple[float, float], log: _Log, scan: _Scan) -> dict[str, Any]:
    """Return the motion that thrusters and damping leave, as a speed that it adds up to."""
    k = scan.logs.index(log)
    rows = slice(scan.ends[k], scan.ends[k + 1])
    rest = np.column_stack([e.unexplained()[rows] for e in scan.equations])
    gathered = np.zeros_like(rest)
    for a, b in log.stretches:
        gathered[a:b] = np.cumsum(rest[a:b], axis=0) * log.step
    return {"t": log.t, "gathered": gathered, "interval": interval, "thrust": log.thrust}
