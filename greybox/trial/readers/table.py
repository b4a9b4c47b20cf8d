"""What CSV and Parquet share: a table that is read in batches, never as a whole."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from greybox.trial.steps import Step

Batch = dict[str, NDArray[Any]]


class TableFile(Protocol):
    """A table on disk: its header is known, its rows come in batches."""

    @property
    def path(self) -> Path:
        """The file, or the name by which messages call it."""

    @property
    def columns(self) -> tuple[str, ...]:
        """Names, each once."""

    @property
    def units(self) -> dict[str, str]:
        """Units that the table states beside its names."""

    @property
    def text(self) -> frozenset[str]:
        """Columns of words."""

    @property
    def dates(self) -> frozenset[str]:
        """Columns of dates: UNIX time [s]."""

    @property
    def clocks(self) -> frozenset[str]:
        """Columns of times of day [s]."""

    @property
    def notes(self) -> list[str]:
        """What was recovered."""

    @property
    def format(self) -> str:
        """Format, as a record names it."""

    @property
    def first_row(self) -> int:
        """Number of the first sample's row, as a user counts them."""

    @property
    def steps(self) -> tuple[Step, ...]:
        """What had to be done to read the times, known once the rows have been read."""

    @property
    def cells(self) -> int:
        """How many numbers the table holds at most."""

    def batches(self, columns: Sequence[str]) -> Iterator[Batch]:
        """Yield the named columns: (n,) float each, str where in `text`, UNIX s where in `dates`.

        Raises
        ------
        LogError
            A row cannot be read.
        """


def read_columns(table: TableFile, columns: Sequence[str]) -> Batch:
    """Return whole columns of a table, (N,) each."""
    parts: dict[str, list[NDArray[Any]]] = {c: [] for c in columns}
    for batch in table.batches(columns):
        for name in columns:
            parts[name].append(batch[name])
    whole: Batch = {}
    for name in columns:
        # released one by one, so that a column is never held twice with all the others
        pieces = parts.pop(name)
        empty = np.empty(0, object if name in table.text else float)
        whole[name] = np.concatenate(pieces) if pieces else empty
    return whole
