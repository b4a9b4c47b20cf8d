"""What is usually run at sea, on the same yardstick: PRBS, multisine, zig-zag, random pulses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from experiment_design.limits import TOLERANCE
from experiment_design.problem import TrialProblem
from experiment_design.search import assess, draw_prbs, to_unit

Array = NDArray[np.float64]

_DRAWS = 50


@dataclass(frozen=True)
class Alternative:
    """The best of a kind of sequence: of those that keep the limits, if any does.

    Parameters
    ----------
    name : str
    tried : int
        Sequences of the kind that were tried.
    kept : int
        Those that keep the limits.
    value : float
        Criterion of the best of them, else of the best of those that break the
        limits; −inf where a direction is not excited.
    unit : ndarray
        (K, nc) that one.
    """

    name: str
    tried: int
    kept: int
    value: float
    unit: Array


def random_pulses(problem: TrialProblem, rng: np.random.Generator, count: int) -> Array:
    """Draw levels uniformly between the limits, (count, K, nc)."""
    return rng.random((count, *problem.shape))


def multisines(problem: TrialProblem, rng: np.random.Generator, count: int) -> Array:
    """Return sums of sines sampled at the holds, with random phases, (count, K, nc).

    Each command has its own harmonics of the trial, so that they do not overlap
    (Pintelon and Schoukens, 2012, section 5.3), scaled to its limits.
    """
    holds, commands = problem.shape
    k = np.arange(holds)
    highest = max(commands, min(holds // 2, 12 * commands))
    out = np.empty((count, holds, commands))
    for c in range(commands):
        harmonics = np.arange(c + 1, highest + 1, commands)
        phase = rng.uniform(0, 2 * np.pi, (count, len(harmonics)))
        wave = np.cos(2 * np.pi * harmonics[None, :, None] * k / holds + phase[..., None]).sum(
            axis=1
        )
        low, high = wave.min(axis=1, keepdims=True), wave.max(axis=1, keepdims=True)
        out[..., c] = (wave - low) / np.maximum(high - low, 1e-12)
    return out


def zig_zags(problem: TrialProblem) -> Array:
    """Return square waves of the steering commands at steady speed, (count, K, nc).

    Thrusters ahead and astern of the midship steer against each other; half
    periods from one hold to a quarter of the trial, at half and full speed.
    """
    holds, commands = problem.shape
    vessel = problem.scenarios[0].rollout.vessel
    names = problem.schedule.commands
    side = {}
    for t in vessel.thrusters:
        if isinstance(t.angle, str):
            side[t.angle] = 1.0 if t.x >= 0 else -1.0
        if t.rudder is not None:
            side[t.rudder] = 1.0
        if t.type == "tunnel":
            side[t.speed] = 1.0 if t.x >= 0 else -1.0
    k = np.arange(holds)
    found = []
    for half in sorted({h for h in (1, 2, 3, 4, 6, 8, 12, holds // 4) if 1 <= h <= holds // 2}):
        wave = np.where((k // half) % 2 == 0, 1.0, -1.0)
        for speed in (1.0, 0.5):
            for share in (1.0, 0.5):
                unit = np.full((holds, commands), speed)
                for i, name in enumerate(names):
                    if name in side:
                        unit[:, i] = 0.5 + 0.5 * share * side[name] * wave
                found.append(unit)
    return np.array(found)


def compare_classical(problem: TrialProblem, seed: int) -> tuple[Alternative, ...]:
    """Evaluate the best of each classical kind by the problem's own yardstick."""
    rng = np.random.default_rng([17, seed])
    kinds = {
        "random pulses": random_pulses(problem, rng, _DRAWS),
        "PRBS": draw_prbs(problem, 7),
        "multisine": multisines(problem, rng, _DRAWS),
        "zig-zag": zig_zags(problem),
    }
    found = []
    for name, unit in kinds.items():
        unit = to_unit(problem, problem.schedule.within_reach(problem.levels(unit)))
        tried = assess(problem, unit)
        kept = [c for c in tried if (c.missed <= TOLERANCE).all()]
        best = max(kept or tried, key=lambda c: c.value)
        found.append(Alternative(name, len(unit), len(kept), best.value, best.unit))
    return tuple(found)
