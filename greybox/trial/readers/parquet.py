"""Parquet, one row group's batch at a time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from greybox.errors import LogError, so_many
from greybox.trial.readers import cells as cell_text
from greybox.trial.readers.limits import limits
from greybox.trial.readers.table import Batch
from greybox.trial.steps import Step

_READ_BYTES = 1 << 20


@dataclass
class ParquetFile:
    """A Parquet file whose footer has been read."""

    path: Path
    columns: tuple[str, ...]
    units: dict[str, str] = field(default_factory=dict)
    text: frozenset[str] = frozenset()
    dates: frozenset[str] = frozenset()
    notes: list[str] = field(default_factory=list)
    parsed: frozenset[str] = frozenset()
    clocks: frozenset[str] = frozenset()
    rows: int = 0
    format: str = "Parquet"
    first_row: int = 2
    steps: tuple[Step, ...] = ()
    groups: tuple[int, ...] | None = None

    def from_row(self, row: int) -> tuple[ParquetFile, int]:
        """Return the file from the row group on that holds a row, and the rows before it."""
        from pyarrow import parquet

        with parquet.ParquetFile(self.path, memory_map=False) as file:
            found = file.metadata
            sizes = [found.row_group(k).num_rows for k in range(found.num_row_groups)]
        before = 0
        for k, size in enumerate(sizes):
            if row < before + size:
                return replace(self, groups=tuple(range(k, len(sizes)))), before
            before += size
        return replace(self, groups=()), before

    @property
    def cells(self) -> int:
        """How many numbers the file holds."""
        return self.rows * len(self.columns)

    def batches(self, columns: Sequence[str]) -> Iterator[Batch]:
        """Yield the named columns, 131072 rows at a time.

        Raises
        ------
        LogError
            A page is damaged, or a row group is larger than memory allows.
        """
        from pyarrow import parquet

        with _readable(self.path):
            # read in pieces: else whole row groups are held, however large they were written
            texts = [c for c in columns if c in self.text or c in self.parsed]
            # a long text that stands once in the file may stand in every row
            with parquet.ParquetFile(
                self.path, memory_map=False, pre_buffer=False, buffer_size=_READ_BYTES,
                read_dictionary=texts,
            ) as file:  # fmt: skip
                _refuse_bombs(self.path, file.metadata, texts=bool(texts))
                for batch in file.iter_batches(
                    batch_size=limits().block_rows,
                    columns=list(columns),
                    use_threads=True,
                    row_groups=self.groups,
                ):
                    yield {c: column_values(batch.column(c), self.kind(c)) for c in columns}

    def kind(self, name: str) -> str:
        """Return what a column holds: text, parsed (dates written as text), date or number."""
        sets = {"parsed": self.parsed, "text": self.text, "date": self.dates}
        return next((kind for kind, names in sets.items() if name in names), "number")


def column_values(column: Any, kind: str) -> Any:
    """Return an Arrow array as (n,) float, UNIX time [s] of dates, or str of texts.

    Parameters
    ----------
    column : pyarrow.Array
    kind : {"text", "parsed", "date", "number"}
        ``parsed`` are dates that are written as text.
    """
    import pyarrow as pa

    if kind in ("text", "parsed"):
        words = cell_text.text(column)
        if kind == "text":
            return words
        return cell_text.dates(pa.array([w or None for w in words], pa.string()))
    if pa.types.is_dictionary(column.type):
        column = column.dictionary_decode()
    if kind == "date":
        if pa.types.is_date(column.type):
            column = column.cast(pa.timestamp("s"))
        return cell_text.unix_seconds(column.cast(pa.timestamp("ns", column.type.tz)))
    if pa.types.is_duration(column.type):
        parts = {"s": 1, "ms": 1_000, "us": 1_000_000, "ns": 1_000_000_000}
        count = column.cast(pa.int64()).cast(pa.float64(), safe=False)
        return count.to_numpy(zero_copy_only=False) / parts[column.type.unit]
    if pa.types.is_boolean(column.type):
        column = column.cast(pa.int8())
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
    from pyarrow import parquet

    with _readable(path), parquet.ParquetFile(path, memory_map=False) as file:
        schema, rows = file.schema_arrow, file.metadata.num_rows
    size = path.stat().st_size
    if rows > max(limits().sure_rows, limits().rows_per_byte * size):
        raise LogError(
            f"'{path.name}' states {so_many(rows, 'row')} in {so_many(size, 'byte')}, at most "
            f"{limits().rows_per_byte} a "
            f"byte are believed: export it again from the recorder."
        )
    kinds: dict[str, str] = {}
    units: dict[str, str] = {}
    dropped: list[str] = []
    for item in schema:
        kind = column_kind(item.type)
        if kind is None or item.name in kinds:
            dropped.append(item.name)
            continue
        kinds[item.name] = kind
        if kind == "duration":
            units[item.name] = "s"
    twice = sorted(n for n, c in Counter(schema.names).items() if c > 1)
    if twice:
        raise LogError(
            f"'{path.name}' has {schema.names.count(twice[0])} columns called '{twice[0]}': "
            f"export it with a name for each."
        )
    if not kinds or not rows:
        raise LogError(
            f"'{path.name}' holds {so_many(rows, 'row')} and {so_many(len(kinds), 'column')} of "
            f"numbers, times or text: "
            f"name a log with samples."
        )
    notes = [f"column '{n}' is neither number, time nor text: left out" for n in dropped[:5]]
    if len(dropped) > 5:
        notes.append(
            so_many(len(dropped) - 5, "more column", "that is", "that are") + " neither left out"
        )
    text = [n for n, k in kinds.items() if k == "text"]
    parsed = _written_dates(path, text)
    return ParquetFile(
        path,
        tuple(kinds),
        units,
        frozenset(text) - parsed,
        frozenset(n for n, k in kinds.items() if k == "date") | parsed,
        notes,
        parsed,
        rows=rows,
    )


def column_kind(found: Any) -> str | None:
    """Return what an Arrow type holds: number, date, duration or text; None for all else."""
    import pyarrow as pa

    is_a = pa.types
    if is_a.is_dictionary(found):
        found = found.value_type
    if is_a.is_timestamp(found) or is_a.is_date(found):
        return "date"
    if is_a.is_string(found) or is_a.is_large_string(found):
        return "text"
    if is_a.is_duration(found):
        return "duration"
    numeric = (is_a.is_floating, is_a.is_integer, is_a.is_boolean, is_a.is_decimal)
    return "number" if any(test(found) for test in numeric) else None


def _written_dates(path: Path, text: Sequence[str]) -> frozenset[str]:
    """Return those columns of text whose first rows are dates."""
    from pyarrow import parquet

    if not text:
        return frozenset()
    with (
        _readable(path),
        parquet.ParquetFile(
            path, memory_map=False, buffer_size=_READ_BYTES, read_dictionary=list(text)
        ) as file,
    ):
        _refuse_bombs(path, file.metadata, texts=True)
        batch = next(file.iter_batches(batch_size=64, columns=list(text)))
        first = {c: cell_text.text(batch.column(c)).tolist() for c in text}
    return frozenset(c for c in text if cell_text.kind(first[c], comma=False) == "date")


def _refuse_bombs(path: Path, metadata: Any, *, texts: bool) -> None:
    # groups only: asking pyarrow for a damaged column chunk ends the process (26.0)
    size, bounds = path.stat().st_size, limits()
    # a page is decoded as a whole, and a row group may be one page a column
    most = max(bounds.held_bytes, bounds.held_ratio * size)
    for k in range(metadata.num_row_groups):
        group = metadata.row_group(k)
        unpacked, rows = group.total_byte_size, max(group.num_rows, 1)
        # what hardly shrank is as large as its file, and is cut into pages of a megabyte
        if unpacked > most:
            raise LogError(
                f"a row group of '{path.name}' ({size} bytes) unpacks to {unpacked} bytes, at most "
                f"{most} are read at once: write it with smaller row groups."
            )
        # texts that long fill one page, however many rows it holds
        if texts and unpacked > bounds.held_bytes and unpacked > bounds.row_bytes * rows:
            raise LogError(
                f"a row group of '{path.name}' has {unpacked / rows:.0f} bytes a row, more than "
                f"the {bounds.row_bytes} of any log: export it without texts, pictures and clouds, "
                f"or with row groups below {bounds.held_bytes} bytes."
            )


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Say in one sentence that a file cannot be read, whatever a damaged footer or page raises."""
    import pyarrow as pa

    try:
        yield
    except LogError:
        raise
    except (
        pa.ArrowException, OSError, ValueError, KeyError, MemoryError, StopIteration, OverflowError,
    ) as error:  # fmt: skip
        reason = " ".join(str(error).split())[:200].rstrip(".")
        raise LogError(
            f"cannot read '{path.name}' as Parquet: {reason}. "
            f"Export it again, or give the file the ending of its format."
        ) from None
