"""What a trial must keep: margins from the origin, sea room, caps, end state, energy, headings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from greybox.errors import UsageError

Array = NDArray[np.float64]

# how much of each quantity counts as one in the solvers
UNIT_SCALE = {"m/s": 0.1, "rad/s": 0.01, "m": 10.0, "rad": 0.1, "": 0.01}
# what a plan may miss a limit by, in its unit, and still count as keeping it
TOLERANCE = 1e-4


@dataclass(frozen=True)
class Circle:
    """A round sea room.

    Parameters
    ----------
    north, east : float
        Centre [m].
    radius : float
        [m]
    """

    north: float
    east: float
    radius: float


@dataclass(frozen=True)
class TrialLimits:
    """Limits that a trial must keep; None where there is no limit.

    Parameters
    ----------
    signs : mapping of str to int
        Sign that each named state keeps, such as ``{"u": 1, "v": 1}``.
    margins : mapping of str to float
        Least magnitude of each of them [m/s] (A10).
    margin_air : float, optional
        Least magnitude of each component of the velocity through the air, of either
        sign, under the expected mean wind [m/s] (A15; (5.50), (5.54)-(5.56),
        (5.77)-(5.80)).
    area : ndarray or Circle, optional
        (m, 2) corners of the sea room, north and east [m], or a circle.
    position : (float, float)
        Where the trial starts, north and east [m].
    clearance : float
        Kept from the edge of the sea room [m].
    speed_cap, yaw_cap : float, optional
        Largest speed over ground [m/s] and rate of turn [rad/s].
    end : mapping of str to (float, float)
        Wanted final value and tolerance of ``u, v, r, psi, x_n, y_n``.
    energy : float, optional
        Largest mean of the cube of the propeller speeds over that of full speed.
    headings : float, optional
        Least range of headings that the trial covers [rad].
    """

    signs: Mapping[str, int] = field(default_factory=dict)
    margins: Mapping[str, float] = field(default_factory=dict)
    margin_air: float | None = None
    area: Array | Circle | None = None
    position: tuple[float, float] = (0.0, 0.0)
    clearance: float = 0.0
    speed_cap: float | None = None
    yaw_cap: float | None = None
    end: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    energy: float | None = None
    headings: float | None = None

    def __post_init__(self) -> None:
        for name, value in self.margins.items():
            if not 0 <= value < np.inf:
                raise UsageError(f"the margin of {name} is {value:g} m/s, it must be 0 or more.")
        if self.margin_air is not None and not 0 <= self.margin_air < np.inf:
            raise UsageError(
                f"the margin of the velocity through the air is {self.margin_air:g} m/s, it must "
                f"be 0 or more."
            )
        for what, cap in (("speed", self.speed_cap), ("yaw-rate", self.yaw_cap)):
            if cap is not None and not 0 < cap < np.inf:
                raise UsageError(f"the {what} cap is {cap:g}, it must be positive.")
        if self.energy is not None and not 0 < self.energy <= 1:
            raise UsageError(
                f"the energy share is {self.energy:g}, it must lie between 0 and 1, full speed."
            )
        if self.headings is not None and not self.headings > 0:
            raise UsageError(
                f"the heading coverage is {self.headings:g} rad, it must be positive: leave "
                f"--headings out where any will do."
            )
        kept = [self.margins.get(s, 0.0) for s in ("u", "v") if s in self.signs]
        floor = float(np.linalg.norm(kept))
        if self.speed_cap is not None and self.speed_cap <= floor:
            raise UsageError(
                f"the limits contradict: margins of {self.margins.get('u', 0.0):g} and "
                f"{self.margins.get('v', 0.0):g} m/s in surge and sway need a speed of at least "
                f"{floor:.3g} m/s, the cap is {self.speed_cap:g} m/s. Raise the cap above "
                f"{floor:.3g}, or lower the margins."
            )


class LimitKind(Enum):
    """What a limit bounds."""

    MARGIN = "margin of"
    SPEED = "speed cap"
    YAW_RATE = "yaw-rate cap"
    SEA_ROOM = "sea room"
    END_STATE = "end state of"
    ENERGY = "energy"
    HEADINGS = "heading coverage"


@dataclass(frozen=True)
class LimitName:
    """One limit: what it bounds, in words too, its bound and unit, and the option that sets it.

    Parameters
    ----------
    kind : LimitKind
    bound : float
    unit : str
    option : str
    of : str
        What a margin or an end state is of, in words.
    margin : str
        Key of a margin: a state, or ``air``; empty for other limits.
    """

    kind: LimitKind
    bound: float
    unit: str
    option: str
    of: str = ""
    margin: str = ""

    @property
    def name(self) -> str:
        """The limit in words."""
        return f"{self.kind.value} {self.of}".rstrip()


@dataclass(frozen=True)
class LimitReport:
    """One limit and how the plan stands to it.

    ``missed`` is 0 where it is kept, else by how much it is not, in `unit`.
    """

    trial: int
    name: str
    bound: float
    unit: str
    missed: float
