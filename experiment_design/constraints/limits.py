"""The limits of a trial as plain data, and the base class of a limit; each kind is one file.

A limit is one number h at each sample or one a trial, negative where it is kept.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from experiment_design.excitation.rollout import Motion
from greybox.errors import UsageError
from greybox.registry import Registry

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
        for kind in LIMITS.values():
            kind.check(self)


@dataclass(frozen=True)
class LimitedTrial:
    """What a limit has to know of the trial that it is set to.

    Parameters
    ----------
    states : tuple of str
    d : ndarray
        (nd,) means of current and wind, north and east [m/s].
    wind_matters : bool
        Whether the velocity through the air must keep its sign too (5.7), as it
        must where the wind is not measured.
    speeds : tuple of (int, float)
        Place of each propeller speed among the commands, and its full speed.
    """

    states: tuple[str, ...]
    d: Array
    wind_matters: bool = False
    speeds: tuple[tuple[int, float], ...] = ()

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of the entries of a motion's state."""
        return (*self.states, "psi", "x_n", "y_n")


@dataclass(frozen=True)
class Circumstances:
    """Circumstances that may explain why a limit cannot be kept.

    Parameters
    ----------
    current : float
        Speed of the expected current [m/s].
    smallest_circle : callable
        Returns the diameter of the smallest circle that the vessel turns within the limits [m],
        inf where she turns in none, None where no steady motion keeps them.
    lower : str
        Margins that were found to help, as options.
    """

    current: float
    smallest_circle: Callable[[], float | None]
    lower: str = ""


@dataclass(frozen=True)
class Limit(ABC):
    """One limit of one trial.

    Parameters
    ----------
    bound : float
        In `unit`.
    """

    bound: float

    # whether it holds in the regime alone, and not on the way into it
    of_regime: ClassVar[bool] = False
    # of the kind; its place among limits, and the field of `TrialLimits` that sets it
    name: ClassVar[str]
    order: ClassVar[int]
    field: ClassVar[str]

    @classmethod
    def of(cls, limits: TrialLimits, trial: LimitedTrial) -> Sequence[Limit]:
        """Return the limits of this kind that a trial has."""
        bound = getattr(limits, cls.field)
        return [] if bound is None else [cls(bound)]

    @classmethod
    def check(cls, limits: TrialLimits) -> None:
        """Refuse what cannot be asked for."""
        bound = getattr(limits, cls.field)
        if isinstance(bound, int | float) and not 0 < bound < np.inf:
            raise UsageError(f"the {cls.name} is {bound:g}, it must be positive.")

    @property
    def words(self) -> str:
        """The limit in words."""
        return self.name

    @property
    @abstractmethod
    def unit(self) -> str:
        """Unit of the bound and of what it is missed by."""

    @property
    @abstractmethod
    def option(self) -> str:
        """Option of `greybox design` that sets it."""

    @property
    def scale(self) -> float:
        """What counts as one in the solvers, in its unit."""
        return UNIT_SCALE[self.unit]

    @property
    def size(self) -> float:
        """A size of which a small share is worth a try when it is relaxed, in its unit."""
        return self.bound

    @property
    def phrase(self) -> str:
        """The limit in words, with its bound."""
        return f"{self.words} of {self.bound:g} {self.unit}".rstrip()

    def with_bound(self, limits: TrialLimits, bound: float) -> TrialLimits:
        """Return the limits of a trial with another bound for this one."""
        changes: dict[str, Any] = {self.field: bound}
        return replace(limits, **changes)

    def eased(self, limits: TrialLimits, more: float) -> tuple[TrialLimits, str]:
        """Return the limits of a trial with this one relaxed, and in words what to do for it."""
        value = float(f"{self.bound + more:.3g}")
        return self.with_bound(limits, value), f"Use {self.option} {value:g}"

    def advice(self, amount: float, circumstances: Circumstances) -> str:
        """Return why a trial cannot be, and the least change that was found to help.

        Parameters
        ----------
        amount : float
            By how much it is missed at best, in its unit.
        circumstances : Circumstances
        """
        unit = f" {self.unit}".rstrip()
        return (
            f"the {self.phrase} cannot be kept: it is missed by {amount:.3g}{unit} at best. Raise "
            f"{self.option} to {self.bound + rounded_up(amount):.4g}{unit}."
        )


class PathLimit(Limit):
    """A limit at each sample of a trial."""

    @property
    @abstractmethod
    def signal(self) -> str:
        """Signal of a predicted motion that it bounds, empty where it is none of those shown."""

    @abstractmethod
    def value(self, at: Mapping[str, ca.SX]) -> ca.SX:
        """Return h of states, heading, and north and east by their names."""

    def reach(self, side: Mapping[str, float]) -> float:
        """Return by how much h may rise where each speed differs by up to `side`."""
        return float(np.hypot(side.get("u", 0.0), side.get("v", 0.0)))

    def start_advice(self, missed: float) -> str:
        """Return why a trial cannot start where it does, by what it misses the limit."""
        # a start on the limit itself could be left on one side only
        return (
            f"the trial starts {missed:.3g} {self.unit} beyond the {self.phrase}: change --start, "
            f"or relax {self.option} by {1.2 * missed:.2g}."
        )

    def edges(self, psi: Array) -> list[tuple[Array, int]]:
        """Return what its signal must not pass on headings (N,) [rad], and the side of it, ±1."""
        return []


class WholeLimit(Limit):
    """A limit on a trial as a whole."""

    @abstractmethod
    def values(self, motion: Motion) -> Array:
        """Return h of R motions, (R,)."""

    @abstractmethod
    def pull(self, motion: Motion, weight: float, d_state: Array, d_commands: Array) -> None:
        """Add the derivatives of weight · h of one motion in states and commands."""


def rounded_up(amount: float) -> float:
    """Return an amount to three decimals, not less than it is."""
    return float(np.ceil(amount * 1e3) / 1e3)


LIMITS: Registry[type[Limit]] = Registry("limit", package="experiment_design.constraints.kinds")


def limits_of(limits: TrialLimits, trial: LimitedTrial) -> tuple[Limit, ...]:
    """Return every limit of a trial, those on its path first."""
    return tuple(x for kind in LIMITS.values() for x in kind.of(limits, trial))


@dataclass(frozen=True)
class LimitReport:
    """One limit and how the plan stands to it.

    ``missed`` is 0 where it is kept, else by how much it is not, in `unit`; ``phrase`` is the
    limit in words, with its bound.
    """

    trial: int
    name: str
    bound: float
    unit: str
    missed: float
    phrase: str = ""
