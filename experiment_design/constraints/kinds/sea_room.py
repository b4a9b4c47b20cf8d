"""The sea room and the clearance from its edge: ``--area``, ``--circle``, ``--clearance``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from experiment_design.constraints.limits import (
    Circle,
    Circumstances,
    Limit,
    LimitedTrial,
    PathLimit,
    TrialLimits,
)
from greybox.numerics.vectorised import Vectorised

Array = NDArray[np.float64]

# by which squared distances are rounded off where they are zero: a micrometre [m²]
_ROUND = 1e-12


@dataclass(frozen=True, eq=False)
class SeaRoom(PathLimit):
    """A clearance from the edge of the sea room [m].

    Parameters
    ----------
    area : ndarray or Circle
        (m, 2) corners, north and east [m], or a circle.
    position : (float, float)
        Where the trial starts, north and east [m].
    """

    area: Array | Circle
    position: tuple[float, float]
    name = "sea room"
    order = 4
    field = "area"
    option = "--area"
    unit = "m"
    signal = "edge"

    @classmethod
    def of(cls, limits: TrialLimits, trial: LimitedTrial) -> Sequence[Limit]:
        """Return the clearance from the room's edge."""
        if limits.area is None:
            return []
        return [cls(limits.clearance, limits.area, limits.position)]

    @property
    def size(self) -> float:
        """Its bound is a clearance, often none: a room of a hundred metres [m]."""
        return 100.0

    @property
    def phrase(self) -> str:
        """The limit in words: what is set is the room, and its bound is a clearance."""
        return self.words

    def value(self, at: Mapping[str, ca.SX]) -> ca.SX:
        """Return h."""
        north, east = at["x_n"] + self.position[0], at["y_n"] + self.position[1]
        return _outside(self.area, north, east, _ROUND) + self.bound

    def reach(self, side: Mapping[str, float]) -> float:
        """Return by how much h may rise: where speeds are the same, places may be any."""
        return np.inf

    def start_advice(self, missed: float) -> str:
        """Return why a trial cannot start where it does."""
        if self.bound:
            return (
                f"the trial starts {missed:.1f} m short of the clearance of {self.bound:g} m from "
                f"the edge of the sea room: move it by --position, or lower --clearance."
            )
        return (
            f"the trial starts {missed:.1f} m outside the sea room: move it by --position, or the "
            f"sea room."
        )

    def with_bound(self, limits: TrialLimits, bound: float) -> TrialLimits:
        """Return limits with another clearance."""
        return replace(limits, clearance=bound)

    def eased(self, limits: TrialLimits, more: float) -> tuple[TrialLimits, str]:
        """Return limits with a larger room."""
        more = float(np.ceil(more))
        # a clearance below zero is a room that is wider on every side
        eased = self.with_bound(limits, self.bound - more)
        return eased, f"Enlarge it by {more:g} m on every side"

    def advice(self, amount: float, circumstances: Circumstances) -> str:
        """Return by how much the room is too small."""
        said = (
            f"the sea room is too small: the best sequence leaves it by {amount:.1f} m. Enlarge "
            f"it by {np.ceil(amount):.0f} m on every side, or shorten the trial."
        )
        smallest = circumstances.smallest_circle()
        if smallest is None:
            return said
        if not np.isfinite(smallest):
            return f"{said} No constant command within the limits turns the vessel."
        return (
            f"{said} The sea room is {self._width:.0f} m across; the smallest circle that the "
            f"vessel turns within these limits is {smallest:.0f} m."
        )

    @property
    def _width(self) -> float:
        if isinstance(self.area, Circle):
            return 2 * self.area.radius
        return float(np.ptp(np.asarray(self.area, float), axis=0).min())


def _outside(area: Array | Circle, north: ca.SX, east: ca.SX, rounded: float = 0.0) -> ca.SX:
    """Return the signed distance to the edge of a sea room, positive outside [m].

    With `rounded` [m²] the distance has a derivative where it is zero, too.
    """
    if isinstance(area, Circle):
        away = ca.sqrt((north - area.north) ** 2 + (east - area.east) ** 2 + rounded)
        return away - area.radius
    corners = np.asarray(area, float)
    nearest = ca.SX(1e300)
    parity = ca.SX(1)
    for (n0, e0), (n1, e1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        dn, de = n1 - n0, e1 - e0
        length = dn**2 + de**2
        if length == 0:
            continue
        t = ca.fmin(1, ca.fmax(0, ((north - n0) * dn + (east - e0) * de) / length))
        square = (north - n0 - t * dn) ** 2 + (east - e0 - t * de) ** 2
        nearest = ca.fmin(nearest, square)
        if e0 != e1:
            # a ray to the north crosses this edge once for a point inside
            between = ca.logic_and(ca.fmin(e0, e1) <= east, east < ca.fmax(e0, e1))
            above = n0 + (east - e0) * dn / de > north
            parity = parity * (1 - 2 * ca.logic_and(between, above))
    return parity * ca.sqrt(nearest + rounded)


def edge_distance(area: Array | Circle, north: Array, east: Array) -> Array:
    """Return how far places are from the edge of a sea room, negative outside [m].

    Parameters
    ----------
    area : ndarray or Circle
        (m, 2) corners, north and east [m], or a circle.
    north, east : ndarray
        Of one shape [m].
    """
    n, e = ca.SX.sym("n"), ca.SX.sym("e")
    inside = Vectorised([-_outside(area, n, e)], [n, e])
    shape = np.shape(north)
    pair = [np.ascontiguousarray(x, dtype=float) for x in (north, east)]
    return np.asarray(inside(pair, np.empty((1, *shape)))[0])


ENTRIES = (SeaRoom,)
