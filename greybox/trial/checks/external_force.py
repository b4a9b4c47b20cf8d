"""Motion that the thrusters cannot have caused: towed, pushed, moored, aground.

A response model of the logs themselves (the rate of change of surge and sway as damping,
thrust and a constant flow; equations linear in their coefficients, as `thruster_response`)
leaves a remainder. A constant force that acts for a while, in body axes or fixed to the
earth, shifts its sum over that while. All stretches of 15 to 120 s are scanned; what such
sums amount to elsewhere in the same logs (misfit, gusts, waves, current) is their yardstick, so
nothing has to be known of the model's errors but that they are alike throughout the logs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.rotation import body_to_ned, ned_to_body
from greybox.trial.checks.finding import Finding, Outcome
from greybox.trial.checks.motion import Motion, denoise, make_motion, smooth
from greybox.trial.convert.resample import clock as make_clock
from greybox.trial.convert.resample import hold_mean
from greybox.trial.raw_log import Recording
from greybox.trial.steps import Step
from greybox.vessel.force import generalised_force
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]

_STATES = ("u", "v")
_EARTH = ("v_n", "v_e")
_AIR = ("u_q", "v_q")
# time over which a rate of change is taken, and how long a force acts [s]
_STEP = 2.0
_LENGTHS = (15.0, 30.0, 60.0, 120.0)
# least length of all logs together [s], and least number of stretches of a length that must be
# left to compare with
_LEAST_SECONDS, _LEAST_STRETCHES = 240.0, 6.0
# chance of a false finding that is aimed at, and stretches that count for one of a scan
_LEVEL, _OVERLAP = 1e-3, 3.0
# part of the stretches below which lies the usual, and mean excess over it of two normal deviates
_TAIL, _NORMAL_EXCESS = 0.75, 0.5
# a remainder has longer tails than a normal one: its size is not taken for smaller than this
# share of what the thrusters do at half speed
_MISFIT = 0.005
# what matters: force over thrust at half speed
_LEAST_SHARE = 0.08
# of all speeds, those that count as half of the top speed
_HALF = (0.35, 0.65)
# how much speed is left where a ship with thrust is held, over the top speed
_STANDING = 0.1
_RIDGE = 1e-6
# columns that belong to one log
_OWN = 7
# variance that the fit may add to that of a stretch: beyond, the rest of the logs does not tell
# how the ship moves there
_EXTRAPOLATION = 2.0
# time beside a force within which a jump of a sensor goes back [s], and which share of it
_TAKEN_BACK, _TAKEN_SHARE = 16.0, 0.15
# a force that acts in more than this share of a log cannot be told from a steady one
_LONGEST_SHARE = 1 / 3


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
    told: list[Outcome | None] = []
    logs: list[_Log] = []
    for k, recording in enumerate(recordings):
        log = _make_log(k, recording, vessel)
        if isinstance(log, str):
            told.append(Outcome("external_force", "cannot tell", log))
        else:
            logs.append(log)
            told.append(None)
    if not logs:
        return found, told
    scan = _Scan(logs)
    if scan.seconds < _LEAST_SECONDS:
        short = (
            f"{scan.seconds:.0f} s of motion with thrusters, at least {_LEAST_SECONDS:.0f} s are "
            f"needed to know what is usual"
        )
        untold = Outcome("external_force", "cannot tell", short)
        return found, [t or untold for t in told]
    for event in scan.events():
        log = logs[event.log]
        found[log.number].append(_finding(event, log, recordings[log.number], scan))
    return found, told


@dataclass(frozen=True)
class _Log:
    """Rates of change of one log and what may explain them, over steps of two seconds.

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
    known : ndarray
        (K, p) damping and wind, the same of every log of the ship.
    thrust : ndarray
        (K, q) generalised forces.
    own : ndarray
        (K, 2, 7) of this log: a constant; a force fixed north and east, in body axes; and that
        times the yaw rate and the speed, what a current adds to turning and to square damping.
    psi : ndarray
        (K,) heading [rad].
    speed : ndarray
        (K,) surge [m/s].
    """

    number: int
    t: Array
    step: float
    stretches: tuple[tuple[int, int], ...]
    rate: Array
    known: Array
    thrust: Array
    own: Array
    psi: Array
    speed: Array


def _make_log(number: int, recording: Recording, vessel: Vessel) -> _Log | str:
    """Return the rates of a recording, or why it has none."""
    earth = not all(c in recording for c in _STATES)
    names = (*(_EARTH if earth else _STATES), "psi", *("r",) * ("r" in recording))
    missing = [c for c in (*names, *vessel.commands) if c not in recording]
    if missing:
        return f"there is no {', '.join(missing)}"
    motion = make_motion(recording, (*names, *(n for n in _AIR if n in recording)))
    if motion is None or not all(n in motion for n in names):
        return f"too few samples of {', '.join(names)} overlap"
    motion = _body_motion(motion)
    inputs = {}
    for c in vessel.commands:
        signal = recording[c]
        keep = np.isfinite(signal.value) & np.isfinite(signal.t)
        t, first = np.unique(signal.t[keep], return_index=True)
        if not len(t):
            return f"there is no {c}"
        inputs[c] = hold_mean(make_clock(t), signal.value[keep][first], motion.t, motion.step)
    forces = list(generalised_force(vessel, inputs).values())
    count = max(1, round(_STEP / motion.step))
    # noise within products of velocities would weaken their coefficients
    u, v, r = (denoise(motion[s], motion) for s in ("u", "v", "r"))
    known = [u, v, r, *(a * b for a, b in combinations((u, v, r), 2))]
    known += [x * np.abs(x) for x in (u, v, r)]
    known += [np.abs(v) * r, np.abs(r) * v]
    if all(n in motion for n in _AIR):
        along, across = motion["u_q"], motion["v_q"]
        known += [along * np.abs(along), across * np.abs(across), along * across]
    north, east = np.cos(motion["psi"]), np.sin(motion["psi"])
    one = np.ones_like(north)
    # thrust falls with the advance of the ship, and its law may be another than the vessel file's
    forces += [f * motion["u"] for f in forces] + [f * np.abs(f) for f in forces]
    parts = {
        "known": np.column_stack(known),
        "thrust": np.column_stack(forces),
        "own": np.stack(
            [
                np.column_stack(
                    [one, north, east, r * north, r * east, abs(u) * north, abs(u) * east]
                ),
                np.column_stack(
                    [one, -east, north, -r * east, r * north, -abs(v) * east, abs(v) * north]
                ),
            ],
            axis=1,
        ).reshape(len(one), -1),
        "psi": motion["psi"][:, None],
        "speed": u[:, None],
    }
    rate: list[Array] = []
    times: list[Array] = []
    blocks: dict[str, list[Array]] = {n: [] for n in parts}
    stretches: list[tuple[int, int]] = []
    at = 0
    measured = np.column_stack([motion["u"], motion["v"]])
    for a, b in motion.stretches:
        m = (b - a) // count
        if m < 4:
            continue
        edges = a + count * np.arange(m)
        sums = np.vstack([np.zeros((1, 2)), np.cumsum(measured[a:b], axis=0)])
        mean = (sums[edges - a + count] - sums[edges - a]) / count
        rate.append(np.diff(mean, axis=0) / (count * motion.step))
        times.append(motion.t[edges[1:]] - 0.5 * motion.step)
        for n, x in parts.items():
            blocks[n].append(_between(x[a:b], edges - a, count))
        stretches.append((at, at + m - 1))
        at += m - 1
    if not rate:
        return "no stretch without a gap is long enough"
    made = {n: np.concatenate(x) for n, x in blocks.items()}
    return _Log(
        number,
        np.concatenate(times),
        count * motion.step,
        tuple(stretches),
        np.concatenate(rate),
        made["known"],
        made["thrust"],
        made["own"].reshape(-1, 2, _OWN),
        made["psi"][:, 0],
        made["speed"][:, 0],
    )


def _body_motion(motion: Motion) -> Motion:
    """Return the motion with u, v and r, made of what is there."""
    values = dict(motion.values)
    if "u" not in motion:
        values["u"], values["v"] = ned_to_body(motion["v_n"], motion["v_e"], motion["psi"])
    if "r" not in motion:
        psi = smooth(motion["psi"], motion, 1.0)
        values["r"] = np.concatenate(
            [np.gradient(psi[a:b], motion.step) for a, b in motion.stretches]
        )
    return replace(motion, values=values)


def _between(x: Array, edges: NDArray[np.int64], count: int) -> Array:
    """Return what a rate from the mean of one block to that of the next is the mean of."""
    sums = np.vstack([np.zeros((1, x.shape[1])), np.cumsum(x, axis=0)])
    last = len(x)

    def mean(shift: int) -> Array:
        low, high = edges[:-1] + shift, np.minimum(edges[:-1] + shift + count, last)
        return np.asarray((sums[high] - sums[low]) / count)

    # a difference of block means weighs the time between by a triangle
    return np.asarray(np.mean([mean(k) for k in range(count)], axis=0)) if count > 1 else mean(0)


@dataclass(frozen=True)
class _Event:
    """A stretch with a force of its own.

    Parameters
    ----------
    log, start, stop : int
        Which of the logs, and its steps.
    fixed : bool
        To the earth; else to the ship.
    force : ndarray
        (2,) mean force per mass [m/s²], forward and starboard or north and east.
    spread : ndarray
        (2,) standard errors.
    chance : float
        Of so large a force anywhere in logs that have none.
    """

    log: int
    start: int
    stop: int
    fixed: bool
    force: Array
    spread: Array
    chance: float


class _Scan:
    """The response model of all logs, and the remainders of every stretch."""

    def __init__(self, logs: Sequence[_Log]) -> None:
        self.logs = logs
        self.ends = np.cumsum([0, *(len(x.t) for x in logs)])
        self.seconds = float(sum(len(x.t) * x.step for x in logs))
        self.rate = np.concatenate([x.rate for x in logs])
        shared = np.concatenate([np.hstack([x.known, x.thrust]) for x in logs])
        rows, own = len(shared), _OWN * len(logs)
        self.phi = np.zeros((2, rows, shared.shape[1] + own))
        for s in range(2):
            self.phi[s, :, : shared.shape[1]] = shared
            for k, log in enumerate(logs):
                part = slice(self.ends[k], self.ends[k + 1])
                at = shared.shape[1] + _OWN * k
                self.phi[s, part, at : at + _OWN] = log.own[:, s]
        size = np.sqrt(np.mean(self.phi**2, axis=1, keepdims=True))
        self.phi /= np.where(size > 0, size, 1.0)
        self.thrust = slice(logs[0].known.shape[1], shared.shape[1])
        self.psi = np.concatenate([x.psi for x in logs])
        self.used = np.ones(rows, bool)
        self.half = self._half_thrust()

    def _fit(self, used: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Return remainders (N, 2) of the fit to some rows, and the inverse moments (2, p, p)."""
        rest, inverse = np.empty_like(self.rate), []
        for s in range(2):
            x = self.phi[s, used]
            gram = x.T @ x + _RIDGE * used.sum() * np.eye(x.shape[1])
            inverse.append(np.linalg.inv(gram))
            rest[:, s] = self.rate[:, s] - self.phi[s] @ (inverse[s] @ (x.T @ self.rate[used, s]))
        return rest, np.stack(inverse)

    def _half_thrust(self) -> float:
        """Return what the thrusters do to the surge at half speed [m/s²]."""
        _, inverse = self._fit(self.used)
        theta = inverse[0] @ (self.phi[0].T @ self.rate[:, 0])
        # what a thrust that never changes does stands in the constant
        parts = [*range(self.thrust.start, self.thrust.stop)]
        parts += range(self.thrust.stop, self.phi.shape[2], _OWN)
        push = np.abs(self.phi[0][:, parts] @ theta[parts])
        speed = np.abs(np.concatenate([x.speed for x in self.logs]))
        share = speed / max(float(np.quantile(speed, 0.95)), 1e-9)
        half = (share > _HALF[0]) & (share < _HALF[1])
        # a ship that speeds up has more thrust than that speed needs
        half &= np.abs(self.rate[:, 0]) < 0.3 * push
        if half.sum() < 10:
            # thrust goes with the square of speed
            half = np.ones_like(half)
            push = push * 0.25 / np.maximum(share, 0.5) ** 2
        return float(np.median(push[half]))

    def events(self) -> list[_Event]:
        """Return the stretches with a force of their own, the clearest first."""
        found: list[_Event] = []
        for _ in range(2 * _MOST_EVENTS):
            event = self._clearest()
            if event is None or len(found) == _MOST_EVENTS:
                break
            if not self._taken_back(event):
                found.append(event)
            at = self.ends[event.log]
            margin = 2
            self.used[max(at + event.start - margin, at) : at + event.stop + margin] = False
        return found

    def _taken_back(self, event: _Event) -> bool:
        """Whether speed that was gained is lost at once: so jump sensors, not ships."""
        at = self.ends[event.log]
        a, b = at + event.start, at + event.stop
        used = self.used.copy()
        used[a:b] = False
        rest, _ = self._fit(used)
        own = self._sums(rest, np.array([a]), np.array([b]), event.fixed)[0]
        begin, end = next(
            (at + p, at + q) for p, q in self.logs[event.log].stretches if p <= event.start < q
        )
        reach = np.arange(1, max(2, round(_TAKEN_BACK / self.logs[event.log].step)) + 1)
        after = reach[b + reach <= end]
        before = reach[a - reach >= begin]
        first = np.concatenate([np.full(len(after), b), a - before])
        last = np.concatenate([b + after, np.full(len(before), a)])
        beside = self._sums(rest, first, last, event.fixed) @ own / float(own @ own)
        return bool(len(beside)) and float(beside.min()) < -_TAKEN_SHARE

    def _windows(self, length: float) -> tuple[Array, Array, Array]:
        """Return log, first and one-past-last row of each stretch of a length."""
        found = []
        for k, log in enumerate(self.logs):
            m = max(round(length / log.step), 2)
            if m > _LONGEST_SHARE * len(log.t):
                continue
            for a, b in log.stretches:
                first = np.arange(a, b - m + 1, max(1, m // 6)) + self.ends[k]
                found.append(np.column_stack([np.full(len(first), k), first, first + m]))
        table = np.concatenate(found).astype(np.int64) if found else np.empty((0, 3), np.int64)
        clear = np.concatenate([[0], np.cumsum(~self.used)])
        table = table[clear[table[:, 2]] == clear[table[:, 1]]]
        return table[:, 0], table[:, 1], table[:, 2]

    def _clearest(self) -> _Event | None:
        rest, _ = self._fit(self.used)
        candidates = []
        for length in _LENGTHS:
            which, first, last = self._windows(length)
            if len(first) < _LEAST_STRETCHES:
                continue
            for fixed in (False, True):
                size = self._sums(rest, first, last, fixed)
                best = int(np.argmax((size**2).sum(axis=1)))
                candidates.append((int(which[best]), int(first[best]), int(last[best]), fixed))
        events = [e for c in candidates if (e := self._judge(*c)) is not None]
        return min(events, key=lambda e: e.chance, default=None)

    def _sums(self, rest: Array, first: Array, last: Array, fixed: bool) -> Array:
        """Return the sums of the remainders (W, 2) over stretches, forward, starboard or n, e."""
        if fixed:
            rest = np.column_stack(body_to_ned(rest[:, 0], rest[:, 1], self.psi))
        total = np.vstack([np.zeros((1, 2)), np.cumsum(rest, axis=0)])
        return np.asarray(total[last] - total[first])

    def _judge(self, log: int, first: int, last: int, fixed: bool) -> _Event | None:
        """Compare one stretch with all others of its length, its own rows left out of the fit."""
        used = self.used.copy()
        used[first:last] = False
        rest, inverse = self._fit(used)
        step = self.logs[log].step
        length = (last - first) * step
        a, b = first, last
        _, begin, end = self._windows(length)
        others = (end <= a) | (begin >= b)
        begin, end = begin[others], end[others]
        clear = float(np.sum(used)) * step / length
        if clear < _LEAST_STRETCHES or len(begin) < _LEAST_STRETCHES:
            return None
        size = last - first
        yardstick = self._sums(rest, begin, end, fixed)
        lost = self._leverage(inverse, begin, end, fixed) / size
        variance = np.mean(yardstick**2, axis=0) / max(1 - float(np.mean(lost)), 0.1)
        own = self._leverage(inverse, np.array([a]), np.array([b]), fixed)[0] / size
        if own > _EXTRAPOLATION:
            return None
        floor = (_MISFIT * self.half * size) ** 2
        spread = np.sqrt(np.maximum(variance, floor) * (1 + own)) / size
        force = self._sums(rest, np.array([a]), np.array([b]), fixed)[0] / size
        size_of = float(np.hypot(*(force / spread)))
        usual = np.hypot(*(yardstick / size / spread).T)
        tail = float(np.quantile(usual, _TAIL))
        independent = (1 - _TAIL) * clear
        # tails of misfit and gusts fall off exponentially at best, and few stretches tell how fast
        excess = max(float(np.mean(usual[usual > tail] - tail)), _NORMAL_EXCESS)
        excess *= 1 + 1 / np.sqrt(max(independent, 1.0))
        chance = _OVERLAP * independent * float(np.exp(-(size_of - tail) / excess))
        if chance > _LEVEL or np.hypot(*force) < _LEAST_SHARE * self.half:
            return None
        at = self.ends[log]
        return _Event(log, int(a - at), int(b - at), fixed, force, spread, chance)

    def _leverage(self, inverse: Array, first: Array, last: Array, fixed: bool) -> Array:
        """Return how much the fit adds to the variance of each sum (W,), in rows."""
        found = np.zeros(len(first))
        for s in range(2):
            total = np.vstack([np.zeros((1, self.phi.shape[2])), np.cumsum(self.phi[s], axis=0)])
            x = total[last] - total[first]
            found += 0.5 * np.einsum("ij,jk,ik->i", x, inverse[s], x)
        return found


# no log has more stretches of this kind that are told one by one
_MOST_EVENTS = 5


def _finding(event: _Event, log: _Log, recording: Recording, scan: _Scan) -> Finding:
    size = float(np.hypot(*event.force))
    spread = float(np.hypot(*(event.force * event.spread)) / size)
    share, error = size / scan.half, spread / scan.half
    begin = float(log.t[event.start] - 0.5 * log.step)
    end = float(log.t[event.stop - 1] + 0.5 * log.step)
    x, y = event.force
    towards = float(np.degrees(np.arctan2(y, x)))
    if event.fixed:
        where = f"towards {towards % 360:.0f} deg from north"
    else:
        where = f"towards {abs(towards):.0f} deg to {'starboard' if y > 0 else 'port'} of the bow"
    part = slice(event.start, event.stop)
    top = float(np.quantile(np.abs(log.speed), 0.95))
    standing = float(np.median(np.abs(log.speed[part]))) < _STANDING * top and x < 0
    what = "held, moored or aground" if standing else "towed or pushed"
    return Finding(
        "external_force",
        "u" if abs(x) >= abs(y) else "v",
        share,
        (max(share - 1.96 * error, 0.0), share + 1.96 * error),
        "1",
        f"from t = {begin:.6g} to {end:.6g} s the ship moves as if {what}: a force of "
        f"{100 * share:.0f} % of the thrust at half speed acts {where}, which its thrusters "
        f"cannot have caused",
        f"ask what happened from t = {begin:.6g} to {end:.6g} s; leave it out of estimates, or "
        f"import --fix-also external_force",
        _STATES,
        (Step("drop", recording.names, interval=(begin, end), decided_by="check"),),
        False,
        _picture(event, log, scan),
    )


def _picture(event: _Event, log: _Log, scan: _Scan) -> dict[str, Any]:
    """Return the motion that thrusters and damping leave, as a speed that it adds up to."""
    at = scan.ends[event.log]
    used = scan.used.copy()
    used[at + event.start : at + event.stop] = False
    rest, _ = scan._fit(used)
    rest = rest[at : scan.ends[event.log + 1]]
    gathered = np.zeros_like(rest)
    for a, b in log.stretches:
        gathered[a:b] = np.cumsum(rest[a:b], axis=0) * log.step
    return {
        "t": log.t,
        "gathered": gathered,
        "interval": (
            float(log.t[event.start] - 0.5 * log.step),
            float(log.t[event.stop - 1] + 0.5 * log.step),
        ),
        "thrust": log.thrust,
    }
