"""Which clock the thrusters' columns share, by how late the ship answers to their force.

Kinematics give clocks against each other only. A force moves the ship at once and never before it
acts: the delay of the response against each clock says on which of them the inputs stand.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from greybox.trial.checks.motion import (
    GAINS,
    Motion,
    integrate,
    integrated_damping,
    make_motion,
    orderly,
    solve,
    whiten,
)
from greybox.trial.raw_log import Array, Recording
from greybox.vessel.force import generalised_force
from greybox.vessel.vessel import Vessel

# delays that are tried [s]
_DELAYS = np.round(np.arange(-3.0, 6.01, 0.1), 10)
# means over so many seconds, of so much of a log, are looked at
_STEP, _SECONDS = 0.5, 900.0
# a force that no column stands for (wind, current, hull) is slower than this period [s]
_SLOW = 20.0
# quick differences tell a delay: no slower gain than this
_LEAST_LEVEL = 0.3
# force must explain so much of the motion, in log-likelihood, and its delay be known so well [s]
_LEAST_GAIN = 30.0
_MOST_VAGUE = 0.5
# how far below the best the likelihood of a delay may lie: 99 %, twice for coloured noise
_DROP = 2 * 0.5 * 6.63
# measured thrusters act within this time: the build-up of thrust and inflow [s]
_BUILD_UP = 0.2
# step of the delays that are tried, and what the ship's quadratic damping model blurs [s]
_RESOLUTION = 0.2
_INPUTS = {"u": ("taux",), "v": ("tauy", "race"), "r": ("taun", "race")}


@dataclass(frozen=True)
class Delay:
    """How late one velocity answers to the thrusters, as both are stamped.

    Parameters
    ----------
    value : float
        [s]
    ci : tuple of float
        99 % interval [s].
    """

    value: float
    ci: tuple[float, float]


def response_delays(recordings: Sequence[Recording], vessel: Vessel) -> dict[str, Delay]:
    """Return the delay of u, v and r against the thrusters' force, of those that show it.

    Parameters
    ----------
    recordings : sequence of Recording
        Of one ship, on the same clocks.
    vessel : Vessel
    """
    total: dict[str, Array] = {}
    gain: dict[str, float] = {}
    for recording in recordings:
        motion = make_motion(recording, ("u", "v", "r"))
        if motion is None or not all(c in recording for c in vessel.commands):
            continue
        motion = motion.coarser(_STEP)
        found = _profiles(recording, vessel, motion.excerpt(int(_SECONDS / motion.step)))
        for state, (profile, none) in found.items():
            total[state] = total.get(state, np.zeros(len(_DELAYS))) + profile
            gain[state] = gain.get(state, 0.0) + float(profile.max()) - none
    delays = {}
    for state, profile in total.items():
        inside = np.flatnonzero(profile >= profile.max() - _DROP)
        low, high = float(_DELAYS[inside[0]]), float(_DELAYS[inside[-1]])
        at_end = inside[0] == 0 or inside[-1] == len(_DELAYS) - 1
        if gain[state] >= _LEAST_GAIN and not at_end and high - low <= 2 * _MOST_VAGUE:
            delays[state] = Delay(float(_DELAYS[int(np.argmax(profile))]), (low, high))
    return delays


def input_clocks(
    delays: Mapping[str, Delay],
    clocks: Sequence[tuple[tuple[str, ...], float]],
    vessel: Vessel,
) -> list[int]:
    """Return which clocks the inputs may share.

    Parameters
    ----------
    delays : mapping of str to Delay
        Of u, v, r, as `response_delays` returns them.
    clocks : sequence of (channels, late)
        Channels of each clock, and its lateness [s] against any one of them.
    vessel : Vessel
        Its thrusters follow a command some time later, a measured value at once.
    """
    of_state = {s: late for channels, late in clocks for s in delays if s in channels}
    commanded = any(t.drive == "command" for t in vessel.thrusters)
    possible = []
    for k, (_, late) in enumerate(clocks):
        # the delay that would be left, were the inputs on this clock
        low = [d.ci[0] + late - of_state[s] for s, d in delays.items() if s in of_state]
        high = [d.ci[1] + late - of_state[s] for s, d in delays.items() if s in of_state]
        # no force acts before its command; what is measured acts at once on one velocity at least
        if high and min(high) >= -_RESOLUTION and (commanded or min(low) <= _BUILD_UP):
            possible.append(k)
    return possible


def _profiles(
    recording: Recording, vessel: Vessel, motion: Motion
) -> dict[str, tuple[Array, float]]:
    """Return by state the log-likelihood of each delay, and that of no force at all."""
    states = [s for s in ("u", "v", "r") if s in motion]
    damping = np.column_stack([integrated_damping(motion, states), *_slow(motion)])
    start, stop = motion.t[0] + _DELAYS[0] - 7.0, motion.t[-1] - _DELAYS[0] + 1.0
    fine = np.arange(start, stop, 0.1)
    held = {}
    for c in vessel.commands:
        s = orderly(recording[c], angular=False)
        if len(s) < 2:
            return {}
        # between samples, not held: a sample says nothing of when the value was taken up
        held[c] = np.interp(fine, s.t, s.value)
    force = generalised_force(vessel, held)
    found = {}
    for state in states:
        pushes = [force[i] for i in _INPUTS[state] if i in force and np.std(force[i]) > 0]
        if not pushes:
            continue
        delayed = []
        for delay in _DELAYS:
            at = [np.interp(motion.t - delay, fine, p / np.std(p)) for p in pushes]
            delayed.append(integrate(np.column_stack(at), motion))
        found[state] = _likelihoods(motion, motion[state], damping, delayed)
    return found


def _slow(motion: Motion) -> list[Array]:
    """Return cosines of each stretch with periods longer than `_SLOW`."""
    found = []
    for a, b in motion.stretches:
        at = (np.arange(b - a) + 0.5) / (b - a)
        for k in range(1, int(2 * (b - a) * motion.step / _SLOW) + 1):
            column = np.zeros(len(motion))
            column[a:b] = np.cos(np.pi * k * at)
            found.append(column)
    return found


def _likelihoods(
    motion: Motion, z: Array, damping: Array, delayed: list[Array]
) -> tuple[Array, float]:
    count = delayed[0].shape[1]
    stack = np.column_stack([z, damping, *delayed])
    best: tuple[Array, float] | None = None
    for gain in GAINS[GAINS >= _LEAST_LEVEL]:
        white = whiten(stack, float(gain), motion)
        base = white[:, 1 : 1 + damping.shape[1]]
        rest = np.column_stack([white[:, 0], white[:, 1 + damping.shape[1] :]])
        rest = rest - base @ solve(base, rest)
        y, x = rest[:, 0], rest[:, 1:].reshape(len(rest), len(delayed), count)
        none = -0.5 * len(y) * float(np.log(np.mean(y**2)))
        found = np.empty(len(delayed))
        for k in range(len(delayed)):
            left = y - x[:, k] @ solve(x[:, k], y)
            found[k] = -0.5 * len(y) * np.log(np.mean(left**2))
        if best is None or found.max() > best[0].max():
            best = (found, none)
    assert best is not None
    return best
