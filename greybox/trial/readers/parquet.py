"""Parquet, one row group's batch at a time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from greybox.errors import LogError
from greybox.trial.readers.table import Batch

_BATCH_ROWS = 1 << 17
# a page is decoded as a whole: refuse groups that would not fit beside the rest
_MAX_GROUP_BYTES = 3 << 29


@dataclass
class ParquetFile:
    """A Parquet file whose footer has been read."""

    path: Path
    columns: tuple[str, ...]
    units: dict[str, str] = field(default_factory=dict)
    text: frozenset[str] = frozenset()
    dates: frozenset[str] = frozenset()
    notes: list[str] = field(default_factory=list)
    metadata: dict[str, str] = field(default_factory=dict)
    format: str = "Parquet"

    def batches(self, columns: Sequence[str]) -> Iterator[Batch]:
        """Yield the named columns, 131072 rows at a time.

        Raises
        ------
        LogError
            A page is damaged, or a row group is larger than memory allows.
        """
        import pyarrow as pa
        from pyarrow import parquet

        try:
            with parquet.ParquetFile(self.path, memory_map=False, pre_buffer=False) as file:
                _refuse_bombs(self.path, file.metadata, columns)
                for batch in file.iter_batches(
                    batch_size=_BATCH_ROWS, columns=list(columns), use_threads=True
                ):
                    yield {c: self._values(batch.column(c), c) for c in columns}
        except (pa.ArrowException, OSError, ValueError, KeyError) as error:
            raise _unreadable(self.path, error) from None

    def _values(self, column: Any, name: str) -> Any:
        import pyarrow as pa

        if name in self.text:
            return np.array([str(v or "") for v in column.to_pylist()], dtype=object)
        if name in self.dates:
            ns = column.cast(pa.timestamp("ns")).cast(pa.int64())
            return ns.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False) * 1e-9
        return column.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False)


def open_parquet(path: Path) -> ParquetFile:
    """Read the footer of a Parquet file.

    Parameters
    ----------
    path : Path

    Returns
    -------
    ParquetFile

    Raises
    ------
    LogError
        The file is empty, truncated or no Parquet.
    """
    import pyarrow as pa
    from pyarrow import parquet

    try:
        schema = parquet.read_schema(path, memory_map=False)
    except (pa.ArrowException, OSError, ValueError) as error:
        raise _unreadable(path, error) from None
    columns, text, dates, dropped = [], set(), set(), []
    for item in schema:
        kind = item.type
        if pa.types.is_dictionary(kind):
            kind = kind.value_type
        if pa.types.is_timestamp(kind) or pa.types.is_date(kind):
            dates.add(item.name)
        elif pa.types.is_string(kind) or pa.types.is_large_string(kind):
            text.add(item.name)
        elif not (
            pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_boolean(kind)
        ):
            dropped.append(item.name)
            continue
        columns.append(item.name)
    notes = [f"column '{n}' is neither number, time nor text: left out" for n in dropped[:5]]
    metadata = {
        k.decode("utf-8", "replace"): v.decode("utf-8", "replace")
        for k, v in (schema.metadata or {}).items()
        if k == b"greybox"
    }
    return ParquetFile(
        path,
        tuple(columns),
        text=frozenset(text),
        dates=frozenset(dates),
        notes=notes,
        metadata=metadata,
    )


def _refuse_bombs(path: Path, metadata: Any, columns: Sequence[str]) -> None:
    wanted = set(columns)
    for k in range(metadata.num_row_groups):
        group = metadata.row_group(k)
        size = sum(
            group.column(j).total_uncompressed_size
            for j in range(group.num_columns)
            if group.column(j).path_in_schema in wanted
        )
        if size > _MAX_GROUP_BYTES:
            raise LogError(
                f"'{path.name}' has a row group of {size / 2**30:.1f} GiB when unpacked, at most "
                f"{_MAX_GROUP_BYTES / 2**30:.1f} GiB are read at once: write it with smaller ones."
            )


def _unreadable(path: Path, error: Exception) -> LogError:
    if isinstance(error, LogError):
        return error
    reason = " ".join(str(error).split())[:200]
    return LogError(
        f"cannot read '{path.name}' as Parquet: {reason}. "
        f"Export it again, or give the file the ending of its format."
    )
