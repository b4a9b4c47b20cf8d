"""Where a predicted run leaves the range that the model was estimated on."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from greybox.channels import MOTION_WORDS
from greybox.model.model import ManoeuvringModel
from greybox.trial.log import TrialLog

# shares of a range's width, and of its values, by which one may be outside it
_SLACK, _NEAR = 0.05, 0.01


@dataclass(frozen=True)
class Extrapolation:
    """One signal of a predicted run that leaves its range in the estimation logs.

    Parameters
    ----------
    signal : str
    run, known : tuple of float
        Least and greatest value in the run, and in the logs [m/s, rad, rad/s, as logged].
    angle : bool
        Whether it is an angle or its rate.
    since : float
        When it first left its range, from the order on [s]; negative in the approach.
    """

    signal: str
    run: tuple[float, float]
    known: tuple[float, float]
    angle: bool
    since: float = 0.0

    @property
    def shown(self) -> tuple[float, str]:
        """What its values are multiplied by where they are shown, and the unit."""
        unit = {"u": " m/s", "v": " m/s", "r": " deg/s"}.get(
            self.signal, " deg" if self.angle else ""
        )
        return 180 / math.pi if self.angle else 1.0, unit

    @property
    def sentence(self) -> str:
        """Both ranges in words."""
        factor, unit = self.shown
        (least, most), (low, high) = self.run, self.known
        spread = f"is {least * factor:z.3g}{unit}"
        if most > least:
            spread = f"goes from {least * factor:z.3g} to {most * factor:z.3g}{unit}"
        said = MOTION_WORDS.get(self.signal, self.signal)
        return (
            f"extrapolated: {said} {spread}, and the model was "
            f"estimated on {low * factor:z.3g} to {high * factor:z.3g}{unit}."
        )


def extrapolations(
    model: ManoeuvringModel, log: TrialLog, order_time: float
) -> tuple[Extrapolation, ...] | None:
    """Return the signals that leave their ranges in the estimation logs.

    Parameters
    ----------
    model : ManoeuvringModel
        Its record holds the ranges where `estimate` wrote them.
    log : TrialLog
        Of the predicted run.
    order_time : float
        When its manoeuvre was ordered [s].

    Returns
    -------
    tuple of Extrapolation or None
        None where the model holds no ranges.
    """
    known = model.record.get("ranges")
    if not isinstance(known, Mapping) or not known:
        return None
    found = []
    angles = {*model.vessel.angle_commands, "r"}
    for name, (low, high) in known.items():
        if name not in log:
            continue
        least, most = float(np.min(log[name])), float(np.max(log[name]))
        slack = max(_SLACK * (high - low), _NEAR * max(abs(low), abs(high)))
        outside = (log[name] < low - slack) | (log[name] > high + slack)
        if outside.any():
            since = float(log.t[np.argmax(outside)]) - order_time
            known_to = low, high
            found.append(Extrapolation(name, (least, most), known_to, name in angles, since))
    return tuple(found)


def of_all(found: Sequence[Extrapolation]) -> tuple[Extrapolation, ...]:
    """Return one extrapolation a signal, from the least to the greatest value of all runs."""
    made: dict[str, Extrapolation] = {}
    for one in found:
        other = made.get(one.signal, one)
        run = min(one.run[0], other.run[0]), max(one.run[1], other.run[1])
        made[one.signal] = replace(one, run=run, since=min(one.since, other.since))
    return tuple(made.values())


def extrapolation_notes(found: Sequence[Extrapolation] | None) -> tuple[str, ...]:
    """Return a sentence for each signal beyond its range, or that the ranges are not known."""
    if found is None:
        return (
            "the MODEL does not say on what motions it was estimated, so whether this prediction "
            "extrapolates cannot be told: estimate it again.",
        )
    return tuple(e.sentence for e in found)
