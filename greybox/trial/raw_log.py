"""Raw recordings: signals, each on its own clock, before they become a log.

Readers return a `Recording`: nothing has been resampled, mended or judged.
Values are in the units that the source states; names are the source's own,
or canonical where the format itself says what they are (NMEA 0183, ROS).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from greybox.errors import so_many
from greybox.notebook import DisplayMixin, items, number, sparkline, table
from greybox.trial.steps import Step, on_zero
from greybox.vessel.conditions import Conditions

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, repr=False)
class Signal:
    """One measured quantity on its own clock.

    Parameters
    ----------
    name : str
        Name in the source, or a canonical name where the format defines it.
    t : ndarray
        (N,) time [s], as recorded: it may repeat, go back or have holes.
    value : ndarray
        (N,), in `unit`; NaN where the source holds no number.
    unit : str or None
        Unit as `greybox.channels` spells it; None where the source states none.
    source : str
        Where it stands: column, sentence, topic and field, variable.
    canonical : bool
        Whether `name` is canonical because the format says so.
    """

    name: str
    t: Array
    value: Array
    unit: str | None = None
    source: str = ""
    canonical: bool = False

    def __len__(self) -> int:
        return len(self.t)

    def __repr__(self) -> str:
        return f"<Signal: {self.name} [{self.unit or 'no unit'}], {so_many(len(self), 'value')}>"

    @property
    def known(self) -> Mask:
        """Which samples have a time and a value that are numbers, (N,)."""
        return np.isfinite(self.t) & np.isfinite(self.value)

    def with_value(self, value: Array) -> Signal:
        """Return the signal with other values on the same clock."""
        return replace(self, value=value)


@dataclass(frozen=True)
class SourceFile:
    """One file that was read."""

    name: str
    sha256: str
    format: str


@dataclass(frozen=True, repr=False)
class Recording(DisplayMixin):
    """All that was read from the files of one trial.

    Parameters
    ----------
    name : str
    signals : tuple of Signal
    text : mapping of str to tuple of (t, values)
        Columns that hold words, such as the mode of a controller: (N,) time [s]
        and (N,) str.
    epoch : float, optional
        UNIX time [s] of ``t = 0``, None where the file holds relative times only.
    files : tuple of SourceFile
    notes : tuple of str
        What was guessed, skipped or recovered while reading, one sentence each.
    guessed : frozenset of str
        Signals whose meaning was guessed: another file that states it is preferred.
    steps : tuple of Step
        What was done to the signals, in order; also before, where the file is a log that
        greybox wrote.
    mapped : mapping of str to str
        Signal or column of words -> column that ``[columns]`` takes for it.
    conditions : Conditions
        As stated before, where the file is a log that greybox wrote.
    ahead : float, optional
        How far the clock of the program that wrote the file is ahead of the times of the
        samples [s], where the file holds both.
    unsure : frozenset of str
        Signals of which the file does not tell the axes: read as REP 103 has it.
    unused : tuple of str
        Columns of a table that nothing was made of.
    """

    name: str
    signals: tuple[Signal, ...]
    text: Mapping[str, tuple[Array, NDArray[np.str_]]] = field(default_factory=dict)
    epoch: float | None = None
    files: tuple[SourceFile, ...] = ()
    notes: tuple[str, ...] = ()
    guessed: frozenset[str] = frozenset()
    steps: tuple[Step, ...] = ()
    mapped: Mapping[str, str] = field(default_factory=dict)
    conditions: Conditions = field(default_factory=Conditions)
    ahead: float | None = None
    unsure: frozenset[str] = frozenset()
    unused: tuple[str, ...] = ()

    def __contains__(self, name: object) -> bool:
        return any(s.name == name for s in self.signals)

    def __getitem__(self, name: str) -> Signal:
        for signal in self.signals:
            if signal.name == name:
                return signal
        raise KeyError(name)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the signals, in the order of the source."""
        return tuple(s.name for s in self.signals)

    @property
    def cuts(self) -> tuple[float, ...]:
        """Times [s] at which positions begin anew: no stretch of the log reaches over them."""
        return tuple(sorted({t for step in self.cut_steps for t in step.numbers("times")}))

    @property
    def cut_steps(self) -> tuple[Step, ...]:
        """The steps that cut the log, at the times to which positions were moved since."""
        found: list[Step] = []
        for step in self.steps:
            if step.operation == "cut":
                found.append(step)
            elif step.operation == "shift" and "x_n" in step.channels:
                found = [on_zero(cut, -step.number("late")) for cut in found]
        return tuple(found)

    def summary(self) -> str:
        """Return the signals with units, times and ranges, and the notes, as text."""
        rows = [
            f"  {n:<12}{unit:<8}{count:>9} values, {times} s, {low} to {high}"
            for n, unit, count, times, low, high, _, _ in self._rows()
        ]
        return "\n".join([self._line(), *rows, *(f"  note: {n}" for n in self.notes)])

    def _line(self) -> str:
        spans = [s.t[np.isfinite(s.t)] for s in self.signals]
        spans = [t for t in spans if len(t)]
        long = max(t.max() for t in spans) - min(t.min() for t in spans) if spans else 0.0
        return f"recording '{self.name}': {so_many(len(self.signals), 'signal')} over {long:.6g} s"

    def _rows(self) -> list[tuple[str, str, int, str, str, str, str, str]]:
        rows = []
        for s in self.signals:
            t, value = s.t[np.isfinite(s.t)], s.value[np.isfinite(s.value)]
            times = f"{t.min():.6g} to {t.max():.6g}" if len(t) else number(None)
            low, high = (value.min(), value.max()) if len(value) else (None, None)
            picture = sparkline(s.value)
            rows.append(
                (s.name, s.unit or "", len(s), times, number(low), number(high), picture, s.source)
            )
        return rows

    def _parts(self) -> tuple[str, ...]:
        head = ("signal", "unit", "values", "time [s]", "least", "most", "over time", "from")
        return table(head, self._rows()), items("Notes", self.notes)

    def with_signals(self, signals: Iterable[Signal], *notes: str) -> Recording:
        """Return the recording with other signals and more notes."""
        return replace(self, signals=tuple(signals), notes=(*self.notes, *notes))

    def with_steps(self, *steps: Step) -> Recording:
        """Return the recording with more steps done."""
        return replace(self, steps=(*self.steps, *steps))


def free_name(name: str, used: set[str]) -> str:
    """Return a name that is not used yet, numbered where it must be, and mark it as used."""
    free, k = name, 2
    while free in used:
        free, k = f"{name}_{k}", k + 1
    used.add(free)
    return free


def shortened(names: Iterable[str], limit: int) -> str:
    """Return at most `limit` names for a sentence, and how many more there are."""
    names = list(names)
    more = f" and {len(names) - limit} more" if len(names) > limit else ""
    return ", ".join(names[:limit]) + more
