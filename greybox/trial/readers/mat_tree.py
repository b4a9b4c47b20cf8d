"""What MATLAB files hold, as plain trees, whichever library reads them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from greybox.errors import LogError
from greybox.trial.readers.limits import Limits

# dictionaries are structs, lists are cells and struct arrays; arrays as MATLAB shapes them,
# texts, and `Unreadable` in the place of what cannot be had
Tree = dict[str, Any]

COMPLEX = "it is complex: save its real and imaginary parts"


@dataclass(frozen=True)
class Unreadable:
    """A variable that cannot or will not be read, and why."""

    reason: str


class MalformedError(Exception):
    """The file contradicts itself or ends too early."""


class Tally:
    """Counts what a MATLAB file holds while it is read, against the bounds.

    Parameters
    ----------
    name : str
        File, for the messages.
    most : Limits
    """

    def __init__(self, name: str, most: Limits) -> None:
        self.name, self.most = name, most
        self.items = self.values = self.bytes = 0

    def add_items(self, count: int, depth: int) -> None:
        """Count variables, fields and cells that stand so deep in structs.

        Raises
        ------
        LogError
            There are too many, or they are nested too deep.
        """
        self.items += count
        if self.items > self.most.items:
            raise self._error("variables, fields or cells", self.items, self.most.items)
        if depth > self.most.depth:
            raise LogError(
                f"'{self.name}' nests structs deeper than {self.most.depth}: save its columns flat."
            )

    def add_numbers(self, count: int) -> None:
        """Count numbers; raises `LogError` where they are too many."""
        self.values += count
        if self.values > self.most.values:
            raise self._error("numbers", self.values, self.most.values)

    def add_bytes(self, count: int) -> None:
        """Count bytes without compression; raises `LogError` where they are too many."""
        self.bytes += count
        if self.bytes > self.most.held_bytes:
            raise self._error("bytes or more once inflated", self.bytes, self.most.held_bytes)

    def _error(self, what: str, found: int, bound: int) -> LogError:
        return LogError(
            f"'{self.name}' holds {found} {what}, at most {bound} are read: "
            f"save only the columns that are needed, or split the log."
        )


def opaque(name: str) -> Unreadable:
    """Return what stands for an object of a class of MATLAB's own."""
    return Unreadable(
        f"it is a MATLAB '{name or 'object'}' object, which only MATLAB can read: in MATLAB save "
        f"plain columns instead, as in t = seconds(T.Time - T.Time(1)); u = T.u; "
        f"save('log.mat', 't', 'u', '-v7')"
    )
