"""One trial as the rest of the package sees it: SI, radians, one sample time."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from greybox.channels import CHANNELS, MOTIONS
from greybox.errors import LogError, UsageError, so_many
from greybox.notebook import DisplayMixin, items, number, sparkline, table
from greybox.trial.actuator_estimate import ActuatorEstimate
from greybox.trial.gaps import bridge
from greybox.trial.raw_log import Array, Mask
from greybox.trial.steps import Step
from greybox.vessel.actuation import actuated_force
from greybox.vessel.conditions import Conditions
from greybox.vessel.vessel import Vessel

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

# what a record says of itself, beside a file or within a frame
RECORD_FORMAT = "greybox-log"
RECORD_VERSION = 2
# where a frame or dataset holds the record of the log that it was
FRAME_KEY = "greybox_log"


@dataclass(frozen=True)
class Provenance:
    """Where a log came from and what was done to it.

    Parameters
    ----------
    source, sha256 : str
        File and its hash; several files by name, with the hashes in `files`.
    steps : tuple of Step
        What was done to the channels, in order.
    files : tuple of (name, sha256, format)
    read : tuple of str
        What was guessed, skipped or recovered while reading.
    epoch : float, optional
        UNIX time [s] of ``t = 0``.
    notes : mapping of str to str
        What was noted of the trial, word for word.
    conditions : Conditions
        What the trial states of draught, trim, loading, water depth and sea state, and the
        vessel file where the trial does not.
    actuators : tuple of ActuatorEstimate
        How the feedback of each actuator follows its command, as it was measured on import.
    """

    source: str = ""
    sha256: str = ""
    steps: tuple[Step, ...] = ()
    files: tuple[tuple[str, str, str], ...] = ()
    read: tuple[str, ...] = ()
    epoch: float | None = None
    notes: Mapping[str, str] = field(default_factory=dict)
    conditions: Conditions = field(default_factory=Conditions)
    actuators: tuple[ActuatorEstimate, ...] = ()

    @property
    def derived(self) -> tuple[str, ...]:
        """What was derived, resampled and corrected, one sentence each."""
        return tuple(s.sentence for s in self.steps if s.decided_by != "check")

    @property
    def fixed(self) -> tuple[str, ...]:
        """What findings of the checks mended, one sentence each."""
        return tuple(s.sentence for s in self.steps if s.decided_by == "check")

    @property
    def velocities_derived(self) -> bool:
        """Whether u or v was made of positions, or of velocities north and east, and heading."""
        return any(s.derives_motion and {"u", "v"} & {*s.channels} for s in self.steps)

    def to_dict(self) -> dict[str, Any]:
        """Return the provenance as JSON values: the steps, and beside them their sentences."""
        return {
            "source": self.source,
            "sha256": self.sha256,
            "steps": [s.to_dict() for s in self.steps],
            "derived": list(self.derived),
            "fixed": list(self.fixed),
            "files": [list(f) for f in self.files],
            "read": list(self.read),
            "epoch": self.epoch,
            "notes": dict(self.notes),
            "conditions": self.conditions.to_dict(),
            "actuators": [a.to_dict() for a in self.actuators],
        }


@dataclass(frozen=True, repr=False)
class TrialLog(DisplayMixin):
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
    missing : mapping of str to ndarray of bool
        (N,) of channels with gaps: samples that were not measured, where the channel holds
        what lies between its neighbours.
    """

    name: str
    sample_time: float
    t: Array
    channels: Mapping[str, Array]
    vessel: Vessel
    closed_loop: Mask
    loop_known: bool = False
    provenance: Provenance = field(default_factory=Provenance)
    missing: Mapping[str, Mask] = field(default_factory=dict)

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

    @property
    def units(self) -> dict[str, str]:
        """Unit of ``t`` and of each channel; ``as logged`` where any unit is kept."""
        return {n: self.vessel.unit(n) or "as logged" for n in ("t", *self.channels)}

    @property
    def conditions(self) -> Conditions:
        """Draught, trim, loading, water depth and sea state, as far as they are known."""
        return self.provenance.conditions

    def summary(self) -> str:
        """Return name, duration, channels with units and ranges, and provenance, as text."""
        lines = [self._line()]
        lines += [
            f"  {n:<10}{unit:<10}{low:>12}{mean:>12}{high:>12}"
            for n, unit, low, mean, high, _ in self._rows()
        ]
        return "\n".join([*lines, *(f"  {x}" for x in self._history())])

    def _line(self) -> str:
        span = f", t {self.t[0]:g} to {self.t[-1]:g} s" if len(self) else ""
        return (
            f"log '{self.name}' of {self.vessel.name}: {so_many(len(self), 'sample')} every "
            f"{self.sample_time:g} s{span}, {so_many(len(self.channels), 'channel')}"
        )

    def _rows(self) -> list[tuple[str, ...]]:
        units = self.units
        return [
            (n, units[n], *(number(x) for x in _range(a)), sparkline(a))
            for n, a in self.channels.items()
        ]

    def _history(self) -> list[str]:
        p = self.provenance
        loop = float(np.mean(self.closed_loop)) if self.loop_known and len(self) else 0.0
        closed = [f"a controller moves the thrusters in {100 * loop:.0f} % of it"] if loop else []
        closed += [f"conditions: {self.conditions.sentence}"] if self.conditions else []
        closed += [f"actuator: {a.sentence}" for a in p.actuators]
        return [*closed, *(f"derived: {d}" for d in p.derived), *(f"mended: {f}" for f in p.fixed)]

    def _parts(self) -> tuple[str, ...]:
        head = ("channel", "unit", "least", "mean", "most", "over time")
        return table(head, self._rows()), items("History", self._history())

    def known(self, names: Iterable[str]) -> Mask:
        """Return which samples hold measured values of all the named channels, (N,)."""
        out = np.ones(len(self), bool)
        for name in names:
            if name in self.missing:
                out &= ~self.missing[name]
        return out

    def measured(self, name: str) -> Array:
        """Return a channel as it was measured, (N,), NaN where it was not."""
        return (
            np.where(self.missing[name], np.nan, self[name]) if name in self.missing else self[name]
        )

    def states(self, names: tuple[str, ...]) -> Array:
        """Return the named states as (N, nx)."""
        return np.column_stack([self[n] for n in names])

    def forces(self, inputs: tuple[str, ...]) -> Array:
        """Return the generalised inputs of (3.46) as (N, nu); zero where none can be made.

        They follow the commands as the vessel's `actuation` says.
        """
        made = self._made_forces
        return np.column_stack([made.get(n, np.zeros(len(self))) for n in inputs])

    @cached_property
    def _made_forces(self) -> Mapping[str, Array]:
        """Generalised forces by name, of the commands as the thrusters follow them."""
        commands = {c: self[c] for c in self.vessel.commands}
        return actuated_force(self.vessel, commands, self.sample_time, self.logged_time)

    @property
    def logged_time(self) -> float:
        """Sample time at which the commands were logged, before they were averaged [s]."""
        averaged = (s for s in self.provenance.steps if s.operation == "decimate")
        first = next(averaged, None)
        return self.sample_time if first is None else first.number("measured")

    @property
    def has_wind(self) -> bool:
        """Whether the velocity through the air was measured."""
        return "u_q" in self.channels and "v_q" in self.channels

    @property
    def air(self) -> Array | None:
        """Velocity through the air (N, 2) [m/s], None where it was not measured."""
        return np.column_stack([self["u_q"], self["v_q"]]) if self.has_wind else None

    def to_pandas(self) -> pd.DataFrame:
        """Return the log as a DataFrame.

        Returns
        -------
        DataFrame
            Index ``t`` [s], one column a channel (SI, radians), and the column of the
            controller's mode where the log has it. ``attrs["units"]`` by column.
        """
        import pandas as pd

        channels = {n: self.measured(n) for n in self.channels}
        frame = pd.DataFrame(channels, index=pd.Index(self.t, name="t"))
        for name, words in self._mode().items():
            frame[name] = words
        frame.attrs = {"units": self._stated_units(), FRAME_KEY: self._record()}
        return frame

    def to_xarray(self) -> xr.Dataset:
        """Return the log as a Dataset over ``t``, with units and meaning of each channel.

        Raises
        ------
        UsageError
            xarray is not installed.
        """
        xarray = require_xarray()
        units = self._stated_units()
        meaning = {n: c.meaning for n, c in CHANNELS.items()}

        def attrs(name: str) -> dict[str, str]:
            said = {"units": units.get(name, ""), "long_name": meaning.get(name, "")}
            return {k: v for k, v in said.items() if v}

        variables = {n: ("t", self.measured(n), attrs(n)) for n in self.channels}
        variables |= {n: ("t", words, {}) for n, words in self._mode().items()}
        dataset: xr.Dataset = xarray.Dataset(
            variables,
            {"t": ("t", self.t, attrs("t"))},
            # text, so that it can be written to any file
            {"title": self.name, "vessel": self.vessel.name, FRAME_KEY: json.dumps(self._record())},
        )
        return dataset

    def _mode(self) -> dict[str, Any]:
        """Return the column of the controller's mode as a written log has it, if it has one."""
        loop = self.vessel.closed_loop
        if loop is None or not self.loop_known:
            return {}
        return {loop[0]: np.where(self.closed_loop, loop[1][0], "open").astype(object)}

    def _stated_units(self) -> dict[str, str]:
        return {n: u for n, u in self.units.items() if u != "as logged"}

    def _record(self) -> dict[str, Any]:
        return {
            "format": RECORD_FORMAT,
            "version": RECORD_VERSION,
            "name": self.name,
            "sample_time": self.sample_time,
            **self.provenance.to_dict(),
        }

    def window(self, start: int, stop: int, name: str | None = None) -> TrialLog:
        """Return samples ``start:stop`` as a log of their own."""
        return replace(
            self,
            name=name or f"{self.name}[{start}:{stop}]",
            t=self.t[start:stop],
            channels={k: v[start:stop] for k, v in self.channels.items()},
            closed_loop=self.closed_loop[start:stop],
            missing={k: m for k, v in self.missing.items() if (m := v[start:stop]).any()},
        )


# one experiment, or several
Logs = TrialLog | Sequence[TrialLog]


def as_list(logs: Logs, least: int = 1) -> list[TrialLog]:
    """Return the logs, a single one as a list of its own.

    Raises
    ------
    LogError
        There are fewer than `least`, or something else stands among them.
    """
    given: Any = logs
    several = isinstance(given, Iterable) and not isinstance(given, TrialLog | str)
    found: list[TrialLog] = list(given) if several else [given]
    for log in found:
        if not isinstance(log, TrialLog):
            raise LogError(
                f"{log!r:.60} is no log: read one with read_log(path, vessel), or make one of a "
                f"DataFrame with log_from_pandas(frame, vessel)."
            )
    if len(found) < least:
        raise LogError(f"{len(found)} logs are given, at least {least} is needed.")
    return found


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
    channels : mapping of str to ndarray, or DataFrame
        (N,) each, by canonical name; ``t`` is made when absent. Of a DataFrame its index
        is ``t`` where it is called so; what is to be converted goes to `log_from_pandas`.
        NaN where a motion was not measured, between samples where it was.
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
        Lengths differ, or a value is not finite: an input's, or the first or last of a motion.
    """
    arrays = {k: np.asarray(v, float) for k, v in channels.items()}
    index = getattr(channels, "index", None)
    if getattr(index, "name", None) == "t":
        arrays.setdefault("t", np.asarray(index, float))
    lengths = {k: len(v) for k, v in arrays.items()}
    if len(set(lengths.values())) > 1:
        a, b = min(lengths, key=lengths.__getitem__), max(lengths, key=lengths.__getitem__)
        raise LogError(
            f"'{a}' has {lengths[a]} samples and '{b}' has {lengths[b]}: give arrays of one length."
        )
    missing = {
        k: np.isnan(v) for k, v in arrays.items() if k in MOTIONS and np.isnan(v[1:-1]).any()
    }
    for key, gap in missing.items():
        arrays[key] = bridge(arrays[key], ~gap)
    for key, value in arrays.items():
        if not np.isfinite(value).all():
            k = int(np.flatnonzero(~np.isfinite(value))[0])
            raise LogError(f"'{key}' is not finite at sample {k}: cut or repair the log there.")
    size = next(iter(lengths.values()))
    t = arrays.pop("t", np.arange(size) * sample_time)
    known = Provenance(conditions=vessel.conditions)
    return TrialLog(
        name, sample_time, t, arrays, vessel, np.zeros(size, bool), provenance=known,
        missing=missing,
    )  # fmt: skip


def require_xarray() -> Any:
    """Return xarray.

    Raises
    ------
    UsageError
        It is not installed.
    """
    try:
        import xarray
    except ImportError:
        raise UsageError(
            "xarray is not installed, which Datasets need: install it with "
            "pip install 'greybox-marine[notebook]', or use to_pandas()."
        ) from None
    return xarray


def _range(a: Array) -> tuple[float | None, float | None, float | None]:
    """Return least, mean and largest value, None where there are no samples."""
    return (float(a.min()), float(a.mean()), float(a.max())) if len(a) else (None, None, None)
