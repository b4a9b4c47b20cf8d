"""The sign of the answer to the inputs: swapped thrusters, reversed angles and speeds.

Not kinematics: it takes the thrusters' places from the vessel file and asks
whether the ship accelerates the way they push. It names a swap or a reversal
only where that explains the motion far better than the columns as they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.trial.checks.finding import Finding, Repair
from greybox.trial.checks.motion import Motion, make_motion
from greybox.trial.recording import Recording
from greybox.trial.resampling import hold
from greybox.trial.resampling import clock as make_clock
from greybox.vessel.force import generalised_force
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]

# accelerations are taken over this time: shorter is noise, longer is drag
_SPAN = 2.0
_LEAST_GAIN = 25.0
_LEAST_SHARE = 0.03
_MIN_ROWS = 60
_STATES = ("u", "v", "r")
_INPUT_OF = {"u": "taux", "v": "tauy", "r": "taun"}


@dataclass(frozen=True)
class _Alternative:
    channels: tuple[str, ...]
    words: str
    fix: str
    repair: tuple[Repair, ...]


def response_findings(
    recording: Recording, vessel: Vessel, findings: list[Finding]
) -> list[Finding]:
    """Find thruster columns that are swapped or reversed.

    Accelerations over two seconds are regressed on velocities, their moduli and
    the generalised force, with gains that must be positive; each alternative
    reading of the columns is compared by the likelihood.

    Parameters
    ----------
    recording : Recording
        Canonical, mended.
    vessel : Vessel
    findings : list of Finding
        Those made before.
    """
    if any(f.id == "frame" and not f.safe for f in findings):
        return []
    commands = [c for c in vessel.commands if c in recording]
    if len(commands) < len(vessel.commands):
        return []
    motion = make_motion(recording, _STATES)
    if motion is None:
        return []
    states = [s for s in _STATES if s in motion]
    inputs = {c: _held(recording, c, motion.t) for c in commands}
    loop = _open_rows(recording, vessel, motion.t)
    rows, step = _rows(motion, loop)
    if len(rows) < _MIN_ROWS:
        return []
    problem = _Problem(motion, states, rows, step)
    base = problem.loglik(vessel, inputs)
    if base is None:
        return []
    best: tuple[float, _Alternative] | None = None
    for alternative in _alternatives(vessel, commands):
        score = problem.loglik(vessel, _as_read(inputs, alternative))
        if score is not None and (best is None or score > best[0]):
            best = (score, alternative)
    if best is None:
        return []
    gain = best[0] - base
    share = 1 - np.exp(-2 * gain / (len(rows) * len(states)))
    if gain < _LEAST_GAIN or share < _LEAST_SHARE:
        return []
    a = best[1]
    return [
        Finding(
            "sign",
            a.channels[0],
            -1.0 if len(a.repair[0].channels) == 1 else 0.0,
            (-1.0, -1.0) if len(a.repair[0].channels) == 1 else (0.0, 0.0),
            "1",
            f"the ship answers as if {a.words}: so read, the thrusters explain its accelerations "
            f"better by {100 * share:.0f} % of the variance (log-likelihood higher by {gain:.0f})",
            a.fix,
            a.channels,
            a.repair,
            False,
            problem.picture(vessel, inputs, _as_read(inputs, a)),
        )
    ]


def _held(recording: Recording, name: str, t: Array) -> Array:
    s = recording[name]
    keep = np.isfinite(s.value) & np.isfinite(s.t)
    order = np.argsort(s.t[keep], kind="stable")
    return hold(make_clock(s.t[keep][order]), s.value[keep][order], t)


def _open_rows(recording: Recording, vessel: Vessel, t: Array) -> NDArray[np.bool_]:
    """Whether no controller moves the thrusters: feedback turns cause and answer round."""
    if vessel.closed_loop is None or vessel.closed_loop[0] not in recording.text:
        return np.ones(len(t), bool)
    at, words = recording.text[vessel.closed_loop[0]]
    k = np.clip(np.searchsorted(at, t, side="right") - 1, 0, len(words) - 1)
    return ~np.isin(words[k], vessel.closed_loop[1])


def _rows(motion: Motion, keep: NDArray[np.bool_]) -> tuple[NDArray[np.int64], int]:
    step = max(1, round(_SPAN / motion.step))
    rows = []
    for a, b in motion.stretches:
        start = np.arange(a, b - 2 * step, step)
        rows.append(start[[bool(keep[k : k + step].all()) for k in start]])
    return np.concatenate(rows).astype(np.int64), step


class _Problem:
    """Accelerations between the means of neighbouring spans, and what damps them."""

    def __init__(
        self, motion: Motion, states: list[str], rows: NDArray[np.int64], step: int
    ) -> None:
        self.motion, self.states, self.rows, self.step = motion, states, rows, step
        means = {s: self._mean(motion[s], rows) for s in states}
        after = {s: self._mean(motion[s], rows + step) for s in states}
        self.change = {s: after[s] - means[s] for s in states}
        middle = {s: 0.5 * (after[s] + means[s]) for s in states}
        columns = [np.ones(len(rows))]
        columns += [middle[s] for s in states]
        columns += [middle[s] * np.abs(middle[s]) for s in states]
        columns += [middle[a] * middle[b] for a, b in combinations(states, 2)]
        self.damping = np.column_stack(columns)

    def _mean(self, value: Array, rows: NDArray[np.int64]) -> Array:
        total = np.concatenate([[0.0], np.cumsum(value)])
        return np.asarray((total[rows + self.step] - total[rows]) / self.step)

    def picture(
        self, vessel: Vessel, inputs: dict[str, Array], as_read: dict[str, Array]
    ) -> dict[str, Any]:
        """Return acceleration beyond damping and the thrusters' push, of the clearest state."""
        shown: dict[str, Any] = {}
        seconds = self.step * self.motion.step
        for s in self.states:
            logged, read = (self._pushed(vessel, x, s) for x in (inputs, as_read))
            if logged is None or read is None:
                continue
            rest = self._beside(self.change[s])
            pushes = [self._beside(logged), self._beside(read)]
            size = float(np.linalg.norm(rest)) or 1.0
            match = [float(p @ rest) / (size * (float(np.linalg.norm(p)) or 1.0)) for p in pushes]
            if not shown or match[1] > shown["match"][1]:
                shown = {
                    "state": s, "t": self.motion.t[self.rows] + seconds,
                    "acceleration": rest / seconds, "push": pushes[0], "push_read": pushes[1],
                    "match": tuple(match),
                }  # fmt: skip
        return shown

    def _pushed(self, vessel: Vessel, inputs: dict[str, Array], state: str) -> Array | None:
        force = _force_of(generalised_force(vessel, inputs), state)
        return None if force is None else self._mean(force, self.rows + self.step // 2)

    def _beside(self, value: Array) -> Array:
        """Return what velocities do not explain of a column."""
        return np.asarray(
            value - self.damping @ np.linalg.lstsq(self.damping, value, rcond=None)[0]
        )

    def loglik(self, vessel: Vessel, inputs: dict[str, Array]) -> float | None:
        """Return the likelihood with gains that push the right way; None without force."""
        force = generalised_force(vessel, inputs)
        total, used = 0.0, False
        rows = self.rows + self.step // 2
        for s in self.states:
            columns = self.damping
            f = _force_of(force, s)
            y = self.change[s]
            rest = y - columns @ np.linalg.lstsq(columns, y, rcond=None)[0]
            variance = float(np.mean(rest**2))
            if f is not None and np.std(f) > 0:
                used = True
                pushed = self._mean(f, rows)
                other = pushed - columns @ np.linalg.lstsq(columns, pushed, rcond=None)[0]
                power = float(other @ other)
                gain = float(other @ rest) / power if power > 0 else 0.0
                # a negative gain is no gain: the thruster cannot pull
                if gain > 0:
                    variance = float(np.mean((rest - gain * other) ** 2))
            total -= 0.5 * len(y) * np.log(max(variance, 1e-300))
        return total if used else None


def _force_of(force: dict[str, Array], state: str) -> Array | None:
    direct = force.get(_INPUT_OF[state])
    rudder = force.get("race")
    if direct is not None and (state == "u" or rudder is None or np.std(direct) > 0):
        return direct
    # a rudder to starboard turns the bow there and pushes the stern to port
    return rudder if state == "r" and rudder is not None else None


def _alternatives(vessel: Vessel, commands: list[str]) -> list[_Alternative]:
    found = []
    angles = [c for c in commands if c in vessel.angle_commands]
    speeds = [c for c in commands if c not in vessel.angle_commands]
    for name in commands:
        found.append(
            _Alternative(
                (name,), f"{name} were reversed",
                f"look at the sign of {name}: map it with sign = -1, or import --fix-also sign",
                (Repair("scale", (name,), (-1.0,)),),
            )
        )  # fmt: skip
    if len(angles) > 1:
        found.append(
            _Alternative(
                tuple(angles), "all angles were reversed",
                "map the angles with sign = -1, or import --fix-also sign",
                (Repair("scale", tuple(angles), (-1.0,)),),
            )
        )  # fmt: skip
    for group in (speeds, angles):
        for a, b in combinations(group, 2):
            found.append(
                _Alternative(
                    (a, b), f"{a} and {b} were swapped",
                    f"look at which column belongs to which thruster: exchange {a} and {b} in the "
                    f"vessel file, or import --fix-also sign",
                    (Repair("move", (a, b)),),
                )
            )  # fmt: skip
    for one, two in combinations(vessel.thrusters, 2):
        # a thruster swapped with its angle
        if isinstance(one.angle, str) and isinstance(two.angle, str):
            pairs = ((one.speed, two.speed), (one.angle, two.angle))
            if one.speed != two.speed and one.angle != two.angle:
                found.append(
                    _Alternative(
                        (one.speed, two.speed, one.angle, two.angle),
                        f"thruster {one.speed}, {one.angle} and {two.speed}, {two.angle} were "
                        f"swapped",
                        "exchange both columns of the two thrusters in the vessel file, or import "
                        "--fix-also sign",
                        tuple(Repair("move", p) for p in pairs),
                    )
                )  # fmt: skip
    return found


def _as_read(inputs: dict[str, Array], alternative: _Alternative) -> dict[str, Array]:
    out = dict(inputs)
    for step in alternative.repair:
        if step.kind == "scale":
            out |= {c: out[c] * step.values[0] for c in step.channels}
        else:
            a, b = step.channels
            out |= {a: out[b], b: out[a]}
    return out
