"""Between which values the signals of logs lie."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from greybox.trial.log import TrialLog

# share of the samples left out at either end: single ones are outliers
_TAIL = 1e-3


def ranges(logs: Sequence[TrialLog], states: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Return the least and greatest value of each state and command.

    Parameters
    ----------
    logs : sequence of TrialLog
        Of one vessel.
    states : sequence of str
        Names of the states; commands are the vessel's.

    Returns
    -------
    dict of str to (float, float)
        Quantiles of 0.1 and 99.9 %, as wide as the widest log; channels that no log has are
        left out [SI; propeller speeds in the unit of the log].
    """
    found: dict[str, tuple[float, float]] = {}
    for log in logs:
        for name in (*states, *log.vessel.commands):
            if name not in log:
                continue
            low, high = (float(q) for q in np.quantile(log[name], [_TAIL, 1 - _TAIL]))
            before = found.get(name, (low, high))
            found[name] = min(low, before[0]), max(high, before[1])
    return found
