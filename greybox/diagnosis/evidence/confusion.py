"""Which causes explain the logs equally well.

References
----------
Vuong (1989), on the likelihood ratio of rival models.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.evidence.held_out import HeldOut, proof_of
from greybox.diagnosis.fitting import Problem
from greybox.diagnosis.search import Candidate
from greybox.diagnosis.thresholds import CHANCE, DECISIVE
from greybox.model.run.step import Integrator

Array = NDArray[np.float64]


def rivals(
    problem_of: Callable[[Integrator], Problem],
    held_out_of: Callable[[Integrator], HeldOut],
    best: Candidate,
    others: Sequence[Candidate],
) -> list[Candidate]:
    """Return candidates of other causes that do as well as the best one.

    Parameters
    ----------
    problem_of, held_out_of : callable
        Of an integrator.
    best : Candidate
    others : sequence of Candidate
        Fitted from the same logs and earlier causes.
    """
    out: list[Candidate] = []
    for other in others:
        if other.hypothesis.cause == best.hypothesis.cause or not other.holds:
            continue
        if any(o.hypothesis.cause == other.hypothesis.cause for o in out):
            continue
        fitted = [
            np.concatenate(problem_of(c.fit.integrator).contributions(c.fit)) for c in (other, best)
        ]
        tested = [held_out_of(c.fit.integrator).contributions(c.fit) for c in (other, best)]
        with np.errstate(invalid="ignore"):
            here, there = fitted[0] - fitted[1], tested[0] - tested[1]
        held = proof_of(there)
        total = float(here.sum() + there.sum())
        all_logs = proof_of(np.concatenate([here, there]))
        alike_held = held.p_value > CHANCE
        if alike_held and (total < DECISIVE or all_logs.p_value > CHANCE / 2):
            out.append(other)
    return out
