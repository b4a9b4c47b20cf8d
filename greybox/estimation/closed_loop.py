"""Detection of a closed loop, where a controller makes inputs depend on the noise (A4)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from greybox.estimation.registry import ESTIMATORS
from greybox.estimation.verdict import TestResult
from greybox.trial.log import TrialLog

Array = NDArray[np.float64]
Loop = Literal["open", "closed", "auto"]

# share of samples under control from which a log counts as closed loop
_SHARE = 0.1
# the equation error at k holds measurement noise of k and k+1; commands given this
# many samples earlier cannot depend on it
CLOSED_LOOP_LAG = 2


def closed_loop_share(logs: Sequence[TrialLog]) -> float | None:
    """Return the share of samples that the logs mark as controlled, None if no log marks any."""
    known = [log for log in logs if log.loop_known]
    if not known:
        return None
    return float(np.concatenate([log.closed_loop for log in known]).mean())


def assess_loop(
    logs: Sequence[TrialLog], loop: Loop = "auto", method: str = "iv"
) -> tuple[bool, TestResult]:
    """Decide whether to treat the logs as closed loop.

    Parameters
    ----------
    logs : sequence of TrialLog
    method : str
        Name of the estimator.
    loop : {"open", "closed", "auto"}
        ``auto`` follows the mode column that the vessel file names in
        ``[closed_loop]``; without one the logs count as open loop.

    Returns
    -------
    tuple of (bool, TestResult)
    """
    null = "the inputs do not depend on the measured states (A4)"
    share = closed_loop_share(logs)
    unknown = share is None and loop == "auto"
    closed = loop == "closed" or (loop == "auto" and share is not None and share > _SHARE)
    if closed:
        amount = "the user says so" if share is None else f"{100 * share:.0f} % of the samples"
        sentence = (
            f"closed loop ({amount}): a controller moved the thrusters, "
            + ESTIMATORS[method].closed_loop.format(lag=CLOSED_LOOP_LAG)
            + "Prefer a trial with open-loop commands."
        )
    elif unknown:
        sentence = (
            "not known: the vessel file names no mode column in [closed_loop]; "
            "the log is taken as open loop."
        )
    else:
        sentence = "open loop."
    return closed, TestResult(
        "closed_loop", null, share, None, sentence, passed=None if unknown else not closed
    )
