"""The straight run before a manoeuvre: original heading and test speed."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from greybox.errors import LogError
from greybox.trial.manoeuvres.local import fit_at, regress
from greybox.trial.manoeuvres.quantity import Quantity
from greybox.trial.manoeuvres.track import Track
from greybox.trial.raw_log import Array

_FEWEST = 5


@dataclass(frozen=True)
class Approach:
    """State of the ship when the manoeuvre is ordered.

    Parameters
    ----------
    heading : Quantity
        Original heading [rad].
    speed : Quantity
        Over ground [m/s].
    seen : bool
        Whether the log holds the approach, or starts with the manoeuvre.
    """

    heading: Quantity
    speed: Quantity
    seen: bool

    def duration(self, length: float) -> float:
        """Return the time in which the ship sails its own length [s]."""
        return length / max(self.speed.value, 1e-9)


def first_notes(name: str, approach: Approach, track: Track) -> list[str]:
    """Return what is to be noted of the approach to a manoeuvre and of its track."""
    notes = []
    if not approach.seen:
        notes.append(
            f"no straight approach before the {name}: heading and speed are those at its start"
        )
    if track.integrated:
        notes.append("positions are integrated from u, v and heading, none were measured")
    return notes


def measure_approach(
    t: Array,
    psi: Array,
    u: Array,
    v: Array,
    start: float,
    length: float,
    *,
    heading_std: float | None = None,
) -> Approach:
    """Measure original heading and speed over the last ship length before the order.

    Over the last five samples, where a ship length has fewer.

    Parameters
    ----------
    t, psi, u, v : ndarray
        (N,) [s], [rad], [m/s], body axes over ground.
    start : float
        When the manoeuvre is ordered [s].
    length : float
        Of the ship [m].
    heading_std : float, optional
        Known noise of the heading [rad].

    Raises
    ------
    LogError
        `start` is outside the log, or arrays differ in length.
    """
    if len({len(t), len(psi), len(u), len(v)}) > 1:
        raise LogError(
            f"t, psi, u, v have {len(t)}, {len(psi)}, {len(u)}, {len(v)} samples: "
            f"give arrays of one length."
        )
    if not t[0] <= start < t[-1]:
        raise LogError(
            f"the manoeuvre starts at {start:g} s but the log runs from {t[0]:g} to {t[-1]:g} s: "
            f"give a time inside it."
        )
    k = int(np.searchsorted(t, start, "right"))
    near = slice(max(0, k - _FEWEST), k + _FEWEST)
    rough = float(np.median(np.hypot(u[near], v[near])))
    run = length / max(rough, 1e-9)
    # a short ship sails its length within a few samples
    first = min(int(np.searchsorted(t, start - run)), k - _FEWEST)
    before = np.arange(max(first, 0), k)
    seen = len(before) >= _FEWEST
    if seen:
        ones = np.ones((len(before), 1))
        fits = [regress(ones, y[before]) for y in (u, v)]
        heading, covariance, dof, _ = regress(ones, psi[before], heading_std)
        values = [(float(c[0]), float(p[0, 0])) for c, p, _, _ in fits]
        psi0 = Quantity(float(heading[0]), math.sqrt(float(covariance[0, 0])), "rad", dof)
        free = min(f[2] for f in fits)
    else:
        window = (start, start + run)
        locals_ = [fit_at(t, y, start, run, side="after", bounds=window) for y in (u, v)]
        own = fit_at(t, psi, start, run, std=heading_std, side="after", bounds=window)
        values = [(f.value(start), f.std(start) ** 2) for f in locals_]
        psi0 = Quantity(own.value(start), own.std(start), "rad", own.dof)
        free = min(f.dof for f in locals_)
    (u0, var_u), (v0, var_v) = values
    total = math.hypot(u0, v0)
    share = max(total, 1e-12)
    std = math.sqrt(u0**2 * var_u + v0**2 * var_v) / share
    return Approach(psi0, Quantity(total, std, "m/s", free), seen)
