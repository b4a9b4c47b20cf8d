"""Classical sequences by the same criterion: PRBS, multisine, zig-zag, random pulses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from experiment_design.constraints.limits import TOLERANCE
from experiment_design.excitation.inputs import multisines, prbs, random_pulses, zig_zags
from experiment_design.optimise.search import assess, within_reach
from experiment_design.request.problem import TrialProblem

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


def compare_classical(problem: TrialProblem, seed: int) -> tuple[Alternative, ...]:
    """Evaluate the best of each classical kind by the problem's own criterion."""
    rng = np.random.default_rng([17, seed])
    holds, commands = problem.shape
    kinds = {
        "random pulses": random_pulses(holds, commands, _DRAWS, rng),
        "PRBS": prbs(holds, commands),
        "multisine": multisines(holds, commands, _DRAWS, rng),
        "zig-zag": zig_zags(holds, problem.scenarios[0].rollout.vessel),
    }
    found = []
    for name, unit in kinds.items():
        tried = assess(problem, within_reach(problem, unit))
        kept = [c for c in tried if (c.missed <= TOLERANCE).all()]
        best = max(kept or tried, key=lambda c: c.value)
        found.append(Alternative(name, len(unit), len(kept), best.value, best.unit))
    return tuple(found)
