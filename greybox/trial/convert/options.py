"""The options of an import."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import InitVar, dataclass, field

from greybox.vessel.conditions import Conditions


@dataclass(frozen=True)
class ImportOptions:
    """The options of an import.

    Parameters
    ----------
    sample_time : float, optional
        Ts of the log [s]; that of the slowest motion sensor by default.
    max_gap : float, optional
        Longest step that is bridged [s], a longer one is a gap; 2.5 usual steps of the
        sensor by default.
    velocities : {"central", "savgol"}
        How u, v, r are made from positions where nothing measured them.
    window : float
        Window of the Savitzky-Golay filter [s].
    reference_height : float, optional
        Height [m] to which the wind is brought; as measured by default.
    origin : tuple of float, optional
        Latitude and longitude [deg] of ``x_n = y_n = 0``.
    notes : mapping of str to str
        What was noted of the trial; fields of `Conditions` by their names.
    smooth : mapping of str to float
        Window [s] of the local polynomials for each channel of the log that is to be
        smoothed; none by default.
    hole : float, optional
        Deprecated name of `max_gap`.

    Raises
    ------
    LogError
        A note is of a condition, and none that it can be.
    """

    sample_time: float | None = None
    max_gap: float | None = None
    velocities: str = "central"
    window: float = 2.0
    reference_height: float | None = None
    origin: tuple[float, float] | None = None
    notes: Mapping[str, str] = field(default_factory=dict)
    smooth: Mapping[str, float] = field(default_factory=dict)
    hole: InitVar[float | None] = None

    def __post_init__(self, hole: float | None) -> None:
        if hole is not None:
            warnings.warn("'hole' is called 'max_gap'", DeprecationWarning, stacklevel=3)
            object.__setattr__(self, "max_gap", hole)
        # a condition that cannot be read is told before any file is
        Conditions.read(self.notes)

    @property
    def conditions(self) -> Conditions:
        """Conditions among `notes`."""
        return Conditions.read(self.notes)

    @property
    def reach(self) -> float:
        """Time over which filters see their neighbours, at most [s]."""
        return self.window + max(self.smooth.values(), default=0.0)
