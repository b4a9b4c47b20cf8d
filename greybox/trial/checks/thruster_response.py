"""The sign of the answer to the inputs: swapped thrusters, reversed angles and speeds.

Not kinematics: it takes the thrusters' places from the vessel file and asks
whether the ship accelerates the way they push. It names a swap or a reversal
only where that explains the motion far better than the columns as they are.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.trial.checks.finding import Finding, exact_finding, factor_of
from greybox.trial.checks.motion import (
    Motion,
    Profile,
    denoise,
    integrate,
    integrated_damping,
    make_motion,
    orderly,
    profile,
    read_together,
    slope,
    solve,
    whiten,
)
from greybox.trial.convert.resample import clock as make_clock
from greybox.trial.convert.resample import hold
from greybox.trial.gaps import runs
from greybox.trial.raw_log import Array, Recording
from greybox.trial.steps import Step, mend
from greybox.vessel.force import generalised_force
from greybox.vessel.vessel import Vessel

# what an alternative must gain in log-likelihood, and how much more than the columns as they are
_LEAST_GAIN = 20.0
_LEAST_RATIO = 1.5
# one equation may prefer the columns as they are by chance, never by much
_MOST_LOSS = 0.3
_MIN_SAMPLES = 60
# spans over which accelerations are shown [s]
_PICTURE_SECONDS = 2.0
_STATES = ("u", "v", "r")
_INPUT_OF = {"u": "taux", "v": "tauy", "r": "taun"}


@dataclass(frozen=True)
class _Alternative:
    channels: tuple[str, ...]
    words: str
    fix: str
    repair: tuple[Step, ...]


# by state, the log-likelihood that the force adds
Explained = dict[str, float]


@dataclass(frozen=True)
class _Answer:
    """How a ship answers in one log: what the force explains as named, and read otherwise."""

    motion: Motion
    inputs: dict[str, Array]
    as_named: Explained
    read_so: tuple[Explained, ...]

    def explained(self, k: int | None) -> Explained:
        """Return what the force explains under the alternative `k`; None is as named."""
        return self.as_named if k is None else self.read_so[k]

    @property
    def sample_correlation_factor(self) -> float:
        """How many samples of a fast log say the same."""
        return max(1.0, 0.2 / self.motion.step)


def answer_findings(
    recordings: Sequence[Recording], vessel: Vessel, findings: Sequence[Sequence[Finding]]
) -> list[list[Finding]]:
    """Find thruster columns that are swapped or reversed, over all logs of one ship together.

    Each velocity is the integral of damping and force, with a force gain that
    must be positive; what remains is measurement noise on a random walk (see
    `motion`). The readings of the columns are compared by what the force then
    explains, equation by equation, in all logs. A log that refutes what they
    prefer together by as much is read by itself.

    Parameters
    ----------
    recordings : sequence of Recording
        Canonical, mended.
    vessel : Vessel
    findings : sequence of sequence of Finding
        Those made before, log by log.

    Returns
    -------
    list of list of Finding
        Log by log: at most one, in every log in which its channels move.
    """
    commands = list(vessel.commands)
    alternatives = list(_alternatives(vessel, commands))
    answers = [
        None
        if any(f.id == "frame" and not f.safe for f in told)
        else _answer(recording, vessel, alternatives)
        for recording, told in zip(recordings, findings, strict=True)
    ]
    known = {i: a for i, a in enumerate(answers) if a is not None}
    found: list[list[Finding]] = [[] for _ in recordings]
    for n, (k, group) in enumerate(read_together(known, _decide, _contradicts)):
        if k is None:
            continue
        told, alternative = [known[i] for i in group], alternatives[k]
        # a log that cannot tell is read as the others are
        untold = [i for i in range(len(recordings)) if i not in known and n == 0]
        members = sorted([*group, *untold])
        moved = [i for i in members if _moves(recordings[i], alternative.channels)]
        names = tuple(recordings[i].name for i in moved) if len(moved) > 1 else ()
        for i in moved:
            finding = _finding(alternative, _gain(told, k), len(told), names)
            if (answer := known.get(i)) is not None:
                inputs = _as_read(answer.inputs, alternative)
                shown = _picture(answer.motion, vessel, answer.inputs, inputs)
                finding = replace(finding, picture=shown)
            found[i].append(finding)
    return found


def _answer(
    recording: Recording, vessel: Vessel, alternatives: Sequence[_Alternative]
) -> _Answer | None:
    """Return how the ship answers, None where the log has too little to tell."""
    for c in vessel.commands:
        if c not in recording or not np.isfinite(recording[c].value).any():
            return None
    motion = _turning_motion(recording)
    if motion is None:
        return None
    given = {c: orderly(recording[c], angular=False) for c in vessel.commands}
    inputs = {c: hold(make_clock(s.t), s.value, motion.t) for c, s in given.items()}
    motion, inputs = _open_loop(recording, vessel, motion, inputs)
    if len(motion) < _MIN_SAMPLES:
        return None
    problem = _Problem(motion)
    read_so = tuple(problem.explained(vessel, _as_read(inputs, a)) for a in alternatives)
    return _Answer(motion, inputs, problem.explained(vessel, inputs), read_so)


def _decide(answers: Sequence[_Answer]) -> int | None:
    """Return the alternative that these logs prefer together; None where it is as named."""
    gains = [_gain(answers, k) for k in range(len(answers[0].read_so))]
    best = max(range(len(gains)), key=gains.__getitem__, default=None)
    return best if best is not None and gains[best] > 0 else None


def _gain(answers: Sequence[_Answer], one: int | None, other: int | None = None) -> float:
    """Return the log-likelihood by which one reading is better than another; 0 if not by far."""
    found, base = (
        {s: sum(a.explained(k).get(s, 0.0) for a in answers) for s in _STATES} for k in (one, other)
    )
    # a state that no force moves under one reading gains nothing by it
    changes = [found[s] - base[s] for s in _STATES]
    gain = float(sum(changes))
    won, lost = sum(c for c in changes if c > 0), -sum(c for c in changes if c < 0)
    clear = any(found[s] > _LEAST_RATIO * base[s] + _LEAST_GAIN / 2 for s in _STATES)
    least = _LEAST_GAIN * max(a.sample_correlation_factor for a in answers)
    return gain if clear and lost < _MOST_LOSS * won and gain >= least else 0.0


def _contradicts(answer: _Answer, shared: int | None) -> bool:
    """Whether a log by itself refutes what the logs prefer together."""
    if shared is None:
        return _decide([answer]) is not None
    return _gain([answer], None, shared) > 0


def _moves(recording: Recording, channels: Sequence[str]) -> bool:
    """Whether a log has all of these channels, and one of them does not rest at zero."""
    if not all(c in recording for c in channels):
        return False
    return any(np.nanmax(np.abs(recording[c].value), initial=0.0) > 0 for c in channels)


def _finding(a: _Alternative, gain: float, count: int, names: tuple[str, ...]) -> Finding:
    beside = f" in {count} logs together" if count > 1 else ""
    return exact_finding(
        "sign",
        a.channels,
        factor_of(a.repair),
        "1",
        f"the ship answers as if {a.words}: read so, the force explains its motion far better "
        f"(log-likelihood higher by {gain:.0f}{beside}); a check of response, not of kinematics",
        a.fix,
        a.repair,
        logs=names,
    )


def _turning_motion(recording: Recording) -> Motion | None:
    """Return the velocities with their yaw rate, None where nothing tells how the ship turns.

    Sway answers the yaw rate: without it the yaw moment of the thrusters would be taken for a
    side force.
    """
    if "r" in recording or "psi" not in recording:
        motion = make_motion(recording, _STATES)
        return motion if motion is not None and "r" in motion else None
    motion = make_motion(recording, ("u", "v", "psi"))
    if motion is None or "psi" not in motion:
        return None
    values = {s: motion[s] for s in ("u", "v") if s in motion}
    rate = slope(denoise(motion["psi"], motion), motion)
    return replace(motion, values=values | {"r": rate})


def _picture(
    motion: Motion, vessel: Vessel, inputs: dict[str, Array], as_read: dict[str, Array]
) -> dict[str, Any]:
    """Return acceleration beyond damping and the thrusters' push, of the clearest state.

    Differences over two seconds: plainer to look at than the integrals that decide.
    """
    step = max(1, round(_PICTURE_SECONDS / motion.step))
    rows = np.concatenate([np.arange(a, b - 2 * step, step) for a, b in motion.stretches])
    seconds = step * motion.step

    def mean(value: Array, at: NDArray[np.int64]) -> Array:
        total = np.concatenate([[0.0], np.cumsum(value)])
        return np.asarray((total[at + step] - total[at]) / step)

    states = [s for s in _STATES if s in motion]
    before = {s: mean(motion[s], rows) for s in states}
    after = {s: mean(motion[s], rows + step) for s in states}
    middle = {s: 0.5 * (before[s] + after[s]) for s in states}
    damping = np.column_stack(
        [
            np.ones(len(rows)),
            *[middle[s] for s in states],
            *[middle[s] * np.abs(middle[s]) for s in states],
        ]
    )

    def beside(value: Array) -> Array:
        return np.asarray(value - damping @ np.linalg.lstsq(damping, value, rcond=None)[0])

    shown: dict[str, Any] = {}
    for s in states:
        forces = [_force_of(generalised_force(vessel, x), s) for x in (inputs, as_read)]
        if any(f is None for f in forces):
            continue
        rest = beside(after[s] - before[s])
        pushes = [beside(mean(f, rows + step // 2)) for f in forces if f is not None]
        size = float(np.linalg.norm(rest)) or 1.0
        match = [float(p @ rest) / (size * (float(np.linalg.norm(p)) or 1.0)) for p in pushes]
        if not shown or match[1] > shown["match"][1]:
            shown = {
                "state": s,
                "t": motion.t[rows] + seconds,
                "acceleration": rest / seconds,
                "push": pushes[0],
                "push_read": pushes[1],
                "match": tuple(match),
            }
    return shown


def _open_loop(
    recording: Recording, vessel: Vessel, motion: Motion, inputs: dict[str, Array]
) -> tuple[Motion, dict[str, Array]]:
    """Keep what no controller moved: feedback turns cause and answer round."""
    if vessel.closed_loop is None or vessel.closed_loop[0] not in recording.text:
        return motion, inputs
    at, words = recording.text[vessel.closed_loop[0]]
    k = np.clip(np.searchsorted(at, motion.t, side="right") - 1, 0, len(words) - 1)
    free = ~np.isin(words[k], vessel.closed_loop[1])
    kept, rows = motion.only(
        [
            (a + start, a + stop)
            for a, b in motion.stretches
            for start, stop in runs(free[a:b])
            if stop - start >= _MIN_SAMPLES
        ]
    )
    return kept, {n: v[rows] for n, v in inputs.items()}


class _Problem:
    """Velocities as integrals of what damps them and of the force."""

    def __init__(self, motion: Motion) -> None:
        self.motion = motion
        self.states = [s for s in _STATES if s in motion]
        columns = integrated_damping(motion, self.states)
        size = np.sqrt(np.mean(columns**2, axis=0))
        self.columns = columns / np.where(size > 0, size, 1.0)
        self.without: dict[str, Profile] = {}
        self.kept: dict[tuple[str, bytes], float] = {}
        for s in self.states:
            coarse = profile(motion[s], self.columns, motion)
            near = np.minimum(coarse.gain * np.array([0.6, 1.0, 1.6]), 1.0)
            self.without[s] = profile(motion[s], self.columns, motion, near)

    def explained(self, vessel: Vessel, inputs: dict[str, Array]) -> Explained:
        """Return by state the log-likelihood that the force adds; no less than zero."""
        force = generalised_force(vessel, inputs)
        found: Explained = {}
        for s in self.states:
            f = _force_of(force, s)
            if f is None or np.std(f) == 0:
                continue
            key = (s, f.tobytes())
            if key not in self.kept:
                self.kept[key] = self._added(s, f)
            found[s] = self.kept[key]
        return found

    def _added(self, state: str, force: Array) -> float:
        pushed = integrate(force / np.std(force), self.motion)
        alone = self.without[state]
        joint = np.column_stack([self.columns, pushed])
        both = np.column_stack([joint, self.motion[state]])
        white = whiten(both, alone.gain, self.motion)
        # a negative gain is no gain: a thruster that pulls is the other reading
        if float(solve(white[:, :-1], white[:, -1])[-1]) <= 0:
            return 0.0
        near = np.minimum(alone.gain * np.array([0.1, 0.25, 0.5, 1.0]), 1.0)
        with_it = profile(self.motion[state], joint, self.motion, near)
        return max(with_it.loglik - alone.loglik, 0.0)


def _force_of(force: dict[str, Array], state: str) -> Array | None:
    direct = force.get(_INPUT_OF[state])
    rudder = force.get("race")
    if direct is not None and (state == "u" or rudder is None or np.std(direct) > 0):
        return direct
    # a rudder to starboard turns the bow there and pushes the stern to port
    return rudder if state == "r" and rudder is not None else None


def _alternatives(vessel: Vessel, commands: list[str]) -> Iterator[_Alternative]:
    angles = [c for c in commands if c in vessel.angle_commands]
    speeds = [c for c in commands if c not in vessel.angle_commands]
    for name in commands:
        yield _Alternative(
            (name,), f"{name} were reversed",
            f"look at the sign of {name}: map it with sign = -1, or import --fix-also sign",
            (mend("scale", (name,), factor=-1.0),),
        )  # fmt: skip
    if len(angles) > 1:
        yield _Alternative(
            tuple(angles), "all angles were reversed",
            "map the angles with sign = -1, or import --fix-also sign",
            (mend("scale", tuple(angles), factor=-1.0),),
        )  # fmt: skip
    for group in (speeds, angles):
        for a, b in combinations(group, 2):
            yield _Alternative(
                (a, b), f"{a} and {b} were swapped",
                f"look at which column belongs to which thruster: exchange {a} and {b} in the "
                f"vessel file, or import --fix-also sign",
                (mend("exchange", (a, b)),),
            )  # fmt: skip
    for one, two in combinations(vessel.thrusters, 2):
        # a thruster swapped with its angle
        if isinstance(one.angle, str) and isinstance(two.angle, str):
            pairs = ((one.speed, two.speed), (one.angle, two.angle))
            if one.speed != two.speed and one.angle != two.angle:
                yield _Alternative(
                    (one.speed, two.speed, one.angle, two.angle),
                    f"thruster {one.speed}, {one.angle} and {two.speed}, {two.angle} were "
                    f"swapped",
                    "exchange both columns of the two thrusters in the vessel file, or import "
                    "--fix-also sign",
                    tuple(mend("exchange", p) for p in pairs),
                )  # fmt: skip


def _as_read(inputs: dict[str, Array], alternative: _Alternative) -> dict[str, Array]:
    out = dict(inputs)
    for step in alternative.repair:
        if step.operation == "scale":
            out |= {c: out[c] * step.number("factor") for c in step.channels}
        else:
            a, b = step.channels
            out |= {a: out[b], b: out[a]}
    return out
