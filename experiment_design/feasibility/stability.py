"""Why a prior model runs away, and the least damping with which it would not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from experiment_design.request.regimes import steady_motions
from experiment_design.request.request import PreparedRequest

Array = NDArray[np.float64]

# linear damping of each state
_DAMPING = {"u": "Xu", "v": "Yv", "r": "Nr"}
# values between the present one and the strongest damping that are tried first
_TRIED = 8
# to what share of the change its end is settled
_SETTLED = 0.01


@dataclass(frozen=True)
class Damping:
    """A linear damping, its value, and the highest value found under which motions settle."""

    name: str
    value: float
    needed: float


def unstable_sentence(request: PreparedRequest, start: Array | None = None) -> str:
    """Return why no steady motion exists, empty where one does.

    Parameters
    ----------
    request : PreparedRequest
    start : ndarray, optional
        (nx + 1,) initial states and heading; by default nearly at rest.
    """
    steady = steady_motions(request, start)
    if len(steady.x):
        return ""
    least = least_damping(request, start)
    names = [n for n in _DAMPING.values() if n in request.structure.parameters]
    change = f"Lowering one of {', '.join(names)} alone does not help."
    if not names:
        change = "It has no linear damping that could be lowered."
    if least is not None:
        change = (
            f"Of the linear damping alone, {least.name} would have to fall from {least.value:g} to "
            f"{least.needed:g} for steady motions to exist."
        )
    return (
        f"the prior model is unstable in free run: under each of {steady.unstable} constant "
        f"commands a state passes 100 m/s or 10 rad/s within 400 s. {change} Design with a stable "
        f"model: estimate it with fewer terms (--structure linear), or on more data."
    )


def least_damping(request: PreparedRequest, start: Array | None = None) -> Damping | None:
    """Return the linear damping that falls least before some constant command is settled under.

    Values down to the one that stops a motion within one sample are tried, one
    parameter at a time; None where none helps.
    """
    structure, theta = request.structure, request.theta
    strongest = -1.0 if structure.increment else 0.0

    def settles(place: int, value: float) -> bool:
        changed = np.array(theta, float)
        changed[place] = value
        return len(steady_motions(replace(request, theta=changed), start).x) > 0

    found: list[Damping] = []
    for name in _DAMPING.values():
        if name not in structure.parameters:
            continue
        place = structure.index(name)
        value = float(theta[place])
        bad = value
        for good in np.linspace(value, strongest, _TRIED + 1)[1:].tolist():
            if good < value and settles(place, good):
                found.append(Damping(name, value, _highest(place, good, bad, value, settles)))
                break
            bad = good
    return min(found, key=lambda f: f.value - f.needed, default=None)


def _highest(
    place: int, good: float, bad: float, value: float, settles: Callable[[int, float], bool]
) -> float:
    """Bisect between a value that settles and one that does not, in round steps."""
    step = 10.0 ** np.floor(np.log10(_SETTLED * (value - good)))
    low, high = int(np.floor(good / step)), int(np.ceil(bad / step))
    if not settles(place, low * step):
        return good
    while high - low > 1:
        middle = (low + high) // 2
        if settles(place, middle * step):
            low = middle
        else:
            high = middle
    return float(low * step)
