"""Where a predicted run leaves what the model was estimated on."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from greybox.model.model import ManoeuvringModel
from greybox.trial.log import TrialLog

_NAMES = {"u": "surge", "v": "sway", "r": "yaw rate"}
# shares of a range's width, and of its values, by which one may be outside it
_SLACK, _NEAR = 0.05, 0.01


def extrapolation(model: ManoeuvringModel, log: TrialLog) -> tuple[str, ...]:
    """Return a sentence for each signal that leaves its range in the estimation logs.

    Parameters
    ----------
    model : ManoeuvringModel
        Its record holds the ranges where `estimate` wrote them.
    log : TrialLog
        Of the predicted run.

    Returns
    -------
    tuple of str
        One sentence that says so where the model holds no ranges.
    """
    known = model.record.get("ranges")
    if not isinstance(known, Mapping) or not known:
        return (
            "the MODEL does not say on what motions it was estimated, so whether this prediction "
            "extrapolates cannot be told: estimate it again.",
        )
    told = []
    angles = {*model.vessel.angle_commands, "r"}
    for name, (low, high) in known.items():
        if name not in log:
            continue
        least, most = float(np.min(log[name])), float(np.max(log[name]))
        slack = max(_SLACK * (high - low), _NEAR * max(abs(low), abs(high)))
        if least >= low - slack and most <= high + slack:
            continue
        factor = 180 / math.pi if name in angles else 1.0
        unit = {"u": " m/s", "v": " m/s", "r": " deg/s"}.get(name, " deg" if factor != 1 else "")
        spread = f"is {least * factor:.3g}{unit}"
        if most > least:
            spread = f"goes from {least * factor:.3g} to {most * factor:.3g}{unit}"
        seen = f"{low * factor:.3g} to {high * factor:.3g}{unit}"
        told.append(
            f"extrapolated: {_NAMES.get(name, name)} {spread}, and the model was "
            f"estimated on {seen}."
        )
    return tuple(told)
