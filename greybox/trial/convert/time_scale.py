"""How a column of times becomes seconds from the start of a recording."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from greybox.errors import LogError
from greybox.trial.convert.column_names import Assigned
from greybox.trial.raw_log import Array
from greybox.trial.readers.table import TableFile
from greybox.trial.readers.topic_files import STAMP
from greybox.units import is_unix_time, time_unit, unit_factor, unix_unit

_HEAD = 10_000
# largest number of a time: those in UNIX nanoseconds are below 2e18
LATEST = 1e19


@dataclass(frozen=True)
class TimeScale:
    """How a time column becomes relative seconds.

    Parameters
    ----------
    factor : float
        To seconds.
    zero : float
        Value of the column where the time is zero.
    epoch : float, optional
        UNIX time [s] of zero, None where the column counts from a moment of its own.
    notes : tuple of str
    """

    factor: float
    zero: float
    epoch: float | None
    notes: tuple[str, ...] = ()

    def seconds(self, raw: Array) -> Array:
        """Return relative times [s], (N,)."""
        if (np.abs(raw) > LATEST).any():
            raw = np.where(np.abs(raw) > LATEST, np.nan, raw)
        # the difference first: UNIX nanoseconds do not fit a double
        return (raw - self.zero) * self.factor if self.zero else raw * self.factor


def time_scale(raw: Array, time: Assigned, table: TableFile) -> TimeScale:
    """Find out from its first values in what unit a time column is.

    Raises
    ------
    LogError
        It holds no number.
    """
    finite = raw[np.abs(raw) <= LATEST]
    if not len(finite):
        raise LogError(
            f"column '{time.raw}' of '{table.path.name}' holds no number among its {len(raw)} "
            f"rows, it cannot be the time: map another column to 't' in [columns]."
        )
    head = finite[:_HEAD]
    size = float(np.median(np.abs(head)))
    date, clock, unit = time.raw in table.dates, time.raw in table.clocks, time.unit
    notes: list[str] = []
    # the name 't' alone promises seconds, which numbers of that size cannot be
    stated = unit is not None and not (unit == "s" and time.how == "exact" and unix_unit(size))
    if not stated and not date:
        unit = time_unit(head)
    if time.raw == STAMP:
        notes.append("times are the header stamps")
    elif time.how == "guessed" or not stated:
        how = "by its dates" if date else "by its times of day" if clock else f"in {unit or 's'}"
        notes.append(f"column '{time.raw}' taken for time {how}")
    if date or clock:
        unit = "s"
    factor = unit_factor(unit or "s", "s", time.raw)
    first = float(finite[0])
    if not is_unix_time(size * factor) and not date:
        return TimeScale(factor, 0.0, None, tuple(notes))
    return TimeScale(factor, first, first * factor, tuple(notes))
