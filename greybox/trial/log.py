"""One trial as the rest of the package sees it: SI, radians, one sample time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from greybox.errors import LogError
from greybox.vessel.actuation import actuated_force
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Provenance:
    """Where a log came from and what was done to it.

    Parameters
    ----------
    source, sha256 : str
        File and its hash; several files by name, with the hashes in `files`.
    derived, fixed : tuple of str
        What was derived and what was mended, one sentence each.
    files : tuple of (name, sha256, format)
    read : tuple of str
        What was guessed, skipped or recovered while reading.
    epoch : float, optional
        UNIX time [s] of ``t = 0``.
    notes : mapping of str to str
        Draught, loading, depth, sea state and what else was noted of the trial.
    """

    source: str = ""
    sha256: str = ""
    derived: tuple[str, ...] = ()
    fixed: tuple[str, ...] = ()
    files: tuple[tuple[str, str, str], ...] = ()
    read: tuple[str, ...] = ()
    epoch: float | None = None
    notes: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class TrialLog:
    """Signals of one trial on a uniform clock.

    Parameters
    ----------
    name : str
    sample_time : float
        Ts [s].
    t : ndarray
        (N,) time [s].
    channels : mapping of str to ndarray
        (N,) each: states and wind by canonical name [SI], thruster columns in
        their own unit, angles [rad], ψ unwrapped.
    vessel : Vessel
    closed_loop : ndarray of bool
        (N,) whether a controller moves the thrusters at that sample.
    loop_known : bool
        Whether the log itself tells so.
    provenance : Provenance
    """

    name: str
    sample_time: float
    t: Array
    channels: Mapping[str, Array]
    vessel: Vessel
    closed_loop: NDArray[np.bool_]
    loop_known: bool = False
    provenance: Provenance = field(default_factory=Provenance)

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, name: str) -> Array:
        if name not in self.channels:
            raise LogError(
                f"log '{self.name}' has no channel '{name}'. It has: {', '.join(self.channels)}."
            )
        return self.channels[name]

    def __contains__(self, name: object) -> bool:
        return name in self.channels

    def states(self, names: tuple[str, ...]) -> Array:
        """Return the named states as (N, nx)."""
        return np.column_stack([self[n] for n in names])

    def forces(self, inputs: tuple[str, ...]) -> Array:
        """Return the generalised inputs of (3.46) as (N, nu); zero where none can be made.

        They follow the commands as late as the vessel's `actuation` says.
        """
        commands = {c: self[c] for c in self.vessel.commands}
        made = actuated_force(self.vessel, commands, self.sample_time)
        return np.column_stack([made.get(n, np.zeros(len(self))) for n in inputs])

    @property
    def has_wind(self) -> bool:
        """Whether the velocity through the air was measured."""
        return "u_q" in self.channels and "v_q" in self.channels

    @property
    def air(self) -> Array | None:
        """Velocity through the air (N, 2) [m/s], None where it was not measured."""
        return np.column_stack([self["u_q"], self["v_q"]]) if self.has_wind else None

    def window(self, start: int, stop: int, name: str | None = None) -> TrialLog:
        """Return samples ``start:stop`` as a log of their own."""
        return replace(
            self,
            name=name or f"{self.name}[{start}:{stop}]",
            t=self.t[start:stop],
            channels={k: v[start:stop] for k, v in self.channels.items()},
            closed_loop=self.closed_loop[start:stop],
        )


def make_log(
    vessel: Vessel,
    channels: Mapping[str, Array],
    sample_time: float,
    name: str = "log",
) -> TrialLog:
    """Build a log from arrays that are already canonical.

    Parameters
    ----------
    vessel : Vessel
    channels : mapping of str to ndarray
        (N,) each, by canonical name; ``t`` is made when absent.
    sample_time : float
        [s]
    name : str

    Returns
    -------
    TrialLog
        In open loop as far as it tells.

    Raises
    ------
    LogError
        Lengths differ, or a value is not finite.
    """
    arrays = {k: np.asarray(v, float) for k, v in channels.items()}
    lengths = {k: len(v) for k, v in arrays.items()}
    if len(set(lengths.values())) > 1:
        (a, na), (b, nb) = min(lengths.items(), key=_second), max(lengths.items(), key=_second)
        raise LogError(f"'{a}' has {na} samples and '{b}' has {nb}: give arrays of one length.")
    for key, value in arrays.items():
        if not np.isfinite(value).all():
            k = int(np.flatnonzero(~np.isfinite(value))[0])
            raise LogError(f"'{key}' is not finite at sample {k}: cut or repair the log there.")
    size = next(iter(lengths.values()))
    t = arrays.pop("t", np.arange(size) * sample_time)
    return TrialLog(name, sample_time, t, arrays, vessel, np.zeros(size, bool))


def _second(item: tuple[str, int]) -> int:
    return item[1]
