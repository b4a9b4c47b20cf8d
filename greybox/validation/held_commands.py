"""Whether a model stays bounded where commands are held at what the logs reached.

A regression may follow its own logs and those left out, and run away in the first long turn:
what it lacks is damping where the logs never stayed. Held commands ask for no measurement.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from greybox.estimation.prediction_verdict import HeldCommandsDiverge
from greybox.model.model import ManoeuvringModel
from greybox.trial.log import TrialLog
from greybox.validation.fit import run_model

# share of the samples beyond a command's usual range, to either side
_RARE = 0.01
# combinations of outermost commands that are run at most, else commands go one at a time
_MOST = 16


def held_commands_diverge(
    model: ManoeuvringModel, logs: Sequence[TrialLog]
) -> HeldCommandsDiverge | None:
    """Return with which commands held a free run leaves its bound, the first to do so.

    Each command is held at the low or the high end of what the logs reached (1 and 99 % of
    the samples), all in all combinations, for as long as the longest log.

    Parameters
    ----------
    model : ManoeuvringModel
    logs : sequence of TrialLog
        Those of the estimate, at its sample time.

    Returns
    -------
    HeldCommandsDiverge or None
        None where all runs stay bounded.
    """
    longest = max(logs, key=len)
    ends: dict[str, tuple[float, float]] = {}
    for name in longest.vessel.commands:
        if all(name in log for log in logs):
            low, high = np.quantile(np.concatenate([log[name] for log in logs]), [_RARE, 1 - _RARE])
            ends[name] = (float(low), float(high))
    worst: HeldCommandsDiverge | None = None
    for held in _combinations(ends, logs):
        constant = {name: np.full(len(longest), value) for name, value in held.items()}
        run = run_model(model, replace(longest, channels={**longest.channels, **constant}))
        if run.diverged >= 0:
            after = float(run.log.t[run.diverged] - run.log.t[0])
            if worst is None or after < worst.after:
                worst = HeldCommandsDiverge(held, after)
    return worst


def _combinations(
    ends: Mapping[str, tuple[float, float]], logs: Sequence[TrialLog]
) -> list[dict[str, float]]:
    """Return what each run holds its commands at."""
    if not ends:
        return []
    if 2 ** len(ends) <= _MOST:
        return [dict(zip(ends, values, strict=True)) for values in product(*ends.values())]
    usual = {n: float(np.median(np.concatenate([log[n] for log in logs]))) for n in ends}
    return [{**usual, name: end} for name, both in ends.items() for end in both]
