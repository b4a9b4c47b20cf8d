"""What is ordered during a manoeuvre, draw by draw, and when it is complete."""

from __future__ import annotations

import math
from collections.abc import Callable
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


@dataclass(frozen=True)
class Legs:
    """Commands of the legs of a manoeuvre.

    Parameters
    ----------
    held : ndarray
        (K, nc, R) commands that each leg asks for; the last two go on in turn.
    logged : ndarray
        (N, nc) commands of each sample from the order on, whatever the leg: nan where those
        of the leg hold. The last row stands.
    """

    held: Array
    logged: Array

    @classmethod
    def of(cls, *held: Array) -> Legs:
        """Return legs without anything logged."""
        return cls(np.stack(held), np.full((1, held[0].shape[0]), math.nan))

    @property
    def runs(self) -> int:
        """R."""
        return int(self.held.shape[2])

    def at(self, k: int, leg: NDArray[np.int64]) -> Array:
        """Return the commands (nc, R) at sample `k`, for runs that are on leg (R,)."""
        last = len(self.held) - 1
        beyond = np.where((leg - last) % 2 == 0, last, max(last - 1, 0))
        which = np.where(leg <= last, leg, beyond)
        wanted = self.held[which, :, np.arange(self.runs)].T
        known = self.logged[min(k, len(self.logged) - 1)][:, None]
        return np.where(np.isnan(known), wanted, known)


class Orders(Protocol):
    """Orders that may follow the motion.

    ``complete`` (R,) is the sample at which a draw's manoeuvre was complete, −1 before.
    """

    complete: NDArray[np.int64]

    def targets(self, k: int, psi: Array, u: Array) -> Array:
        """Return the commands (nc, R) that are asked for at sample `k` from the order on.

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


# the orders of chosen runs, new each time
Ordered = Callable[[NDArray[np.intp]], Orders]


@dataclass
class OneLeg:
    """One leg, held until the run ends it.

    Parameters
    ----------
    legs : Legs
    ended : callable
        ``(k, psi, u)`` as `Orders.targets` has them: which runs have come to the end (R,).
    """

    legs: Legs
    ended: Callable[[int, Array, Array], NDArray[np.bool_]]
    complete: NDArray[np.int64] = field(init=False)

    def __post_init__(self) -> None:
        self.complete = np.full(self.legs.runs, -1)

    def targets(self, k: int, psi: Array, u: Array) -> Array:
        """Return the one order; see `Orders`."""
        self.complete[(self.complete < 0) & self.ended(k, psi, u)] = k
        return self.legs.at(k, np.zeros(len(psi), int))

    def react(self, k: int, psi: Array, ahead: Array) -> None:
        """Nothing changes."""
        return


def turn(legs: Legs) -> OneLeg:
    """Return one leg, held until the ship has turned twice around."""
    return OneLeg(legs, lambda k, psi, u: np.abs(psi) >= TURNED)


def replay(legs: Legs, samples: int) -> OneLeg:
    """Return commands for so many samples, whatever the motion."""
    return OneLeg(legs, lambda k, psi, u: np.full(len(psi), k >= samples))


def stop(legs: Legs, until: Array) -> OneLeg:
    """Return one leg, held until the surge velocity is down to `until` (R,) [m/s], and beyond."""
    slow = np.full(legs.runs, -1)

    def ended(k: int, psi: Array, u: Array) -> NDArray[np.bool_]:
        slow[(slow < 0) & (u <= until)] = k
        beyond = np.maximum(_FEWEST, np.ceil(_BEYOND * slow))
        return np.asarray((slow >= 0) & (k >= slow + beyond))

    return OneLeg(legs, ended)


@dataclass
class ZigZagOrders:
    """Legs to alternate sides, each reversed at its heading.

    Parameters
    ----------
    side : {1, -1}
        Of the first leg, 1 to starboard.
    headings : ndarray
        (EXECUTES − 1,) heading at which each leg ends, positive to its side [rad].
    legs : Legs
    """

    side: float
    headings: Array
    legs: Legs
    complete: NDArray[np.int64] = field(init=False)
    executes: Array = field(init=False)

    def __post_init__(self) -> None:
        runs = self.legs.runs
        self.complete = np.full(runs, -1)
        # (R, executes) samples since the first, between samples, −1 for those to come
        self.executes = np.full((runs, EXECUTES), -1.0)
        self.executes[:, 0] = 0
        self._side = np.full(runs, self.side)
        self._count = np.ones(runs, int)

    def targets(self, k: int, psi: Array, u: Array) -> Array:
        """Return the order of the moment; see `Orders`."""
        return self.legs.at(k, self._count - 1)

    def react(self, k: int, psi: Array, ahead: Array) -> Array | None:
        """Reverse where the heading is reached, at the time between samples when it is."""
        before, after = self._side * psi, self._side * ahead
        limit = self.headings[np.minimum(self._count, EXECUTES - 1) - 1]
        now = np.flatnonzero((after >= limit) & (self.complete < 0))
        if len(now) == 0:
            return None
        share = np.ones(len(psi))
        gained = np.maximum(after[now] - before[now], 1e-12)
        share[now] = np.clip((limit[now] - before[now]) / gained, 0.0, 1.0)
        self.executes[now, self._count[now]] = k + share[now]
        self._side[now] *= -1
        self._count[now] += 1
        self.complete[now[self._count[now] == EXECUTES]] = k + 1
        return share
