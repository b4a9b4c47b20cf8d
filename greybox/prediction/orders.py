"""What is ordered during a manoeuvre, draw by draw, and when it is complete."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# heading change after which a turn has been steady for a full circle [rad]
TURNED = 4 * math.pi
# executes of a zig-zag: the last one ends what is measured
EXECUTES = 5
# share of the stop that is sailed beyond it, so that its end is inside the run
_BEYOND = 0.1
_FEWEST = 12


class Orders(Protocol):
    """Orders that may follow the motion.

    ``complete`` (R,) is the sample at which a draw's manoeuvre was complete, −1 before.
    """

    complete: NDArray[np.int64]

    def targets(self, k: int, psi: Array, u: Array) -> tuple[Array, Array]:
        """Return steering orders (R,) and throttles (R,) at sample `k` from the order on.

        Parameters
        ----------
        k : int
            Samples since the manoeuvre was ordered.
        psi : ndarray
            (R,) heading from the original one [rad].
        u : ndarray
            (R,) surge velocity [m/s].
        """
        ...

    def react(self, k: int, psi: Array, ahead: Array) -> Array | None:
        """Change orders on the way from sample `k` to the next.

        Parameters
        ----------
        k : int
        psi, ahead : ndarray
            (R,) heading from the original one at both samples [rad].

        Returns
        -------
        ndarray or None
            (R,) share of the sample that passes before, 1 where nothing changes.
        """
        ...


@dataclass
class Turn:
    """One steering order, held until the ship has turned twice around."""

    order: float
    throttle: Array
    complete: NDArray[np.int64] = field(init=False)

    def __post_init__(self) -> None:
        self.complete = np.full(len(self.throttle), -1)

    def targets(self, k: int, psi: Array, u: Array) -> tuple[Array, Array]:
        """Return the one order; see `Orders`."""
        self.complete[(self.complete < 0) & (np.abs(psi) >= TURNED)] = k
        return np.full(len(psi), self.order), self.throttle

    def react(self, k: int, psi: Array, ahead: Array) -> None:
        """Nothing changes."""
        return


@dataclass
class ZigZagOrders:
    """Steering orders to alternate sides, reversed at a heading."""

    order: float
    heading: float
    throttle: Array
    complete: NDArray[np.int64] = field(init=False)
    executes: Array = field(init=False)

    def __post_init__(self) -> None:
        runs = len(self.throttle)
        self.complete = np.full(runs, -1)
        # (R, executes) samples since the first, between samples, −1 for those to come
        self.executes = np.full((runs, EXECUTES), -1.0)
        self.executes[:, 0] = 0
        self._side = np.full(runs, math.copysign(1.0, self.order))
        self._count = np.ones(runs, int)

    def targets(self, k: int, psi: Array, u: Array) -> tuple[Array, Array]:
        """Return the order of the moment; see `Orders`."""
        return abs(self.order) * self._side, self.throttle

    def react(self, k: int, psi: Array, ahead: Array) -> Array | None:
        """Reverse where the heading is reached, at the time between samples when it is."""
        before, after = self._side * psi, self._side * ahead
        now = np.flatnonzero((after >= self.heading) & (self.complete < 0))
        if len(now) == 0:
            return None
        share = np.ones(len(psi))
        gained = np.maximum(after[now] - before[now], 1e-12)
        share[now] = np.clip((self.heading - before[now]) / gained, 0.0, 1.0)
        self.executes[now, self._count[now]] = k + share[now]
        self._side[now] *= -1
        self._count[now] += 1
        self.complete[now[self._count[now] == EXECUTES]] = k + 1
        return share


@dataclass
class Stop:
    """Another throttle, held until the ship is slow enough."""

    throttle: Array
    until: Array
    complete: NDArray[np.int64] = field(init=False)

    def __post_init__(self) -> None:
        self.complete = np.full(len(self.throttle), -1)
        self._slow = np.full(len(self.throttle), -1)

    def targets(self, k: int, psi: Array, u: Array) -> tuple[Array, Array]:
        """Return the one order; see `Orders`."""
        self._slow[(self._slow < 0) & (u <= self.until)] = k
        beyond = np.maximum(_FEWEST, np.ceil(_BEYOND * self._slow))
        done = (self.complete < 0) & (self._slow >= 0) & (k >= self._slow + beyond)
        self.complete[done] = k
        return np.zeros(len(u)), self.throttle

    def react(self, k: int, psi: Array, ahead: Array) -> None:
        """Nothing changes."""
        return
