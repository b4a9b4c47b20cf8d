"""CSV with any delimiter, decimal mark, encoding and header, in bounded memory."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from io import RawIOBase
from pathlib import Path
from typing import IO, Any

from greybox.errors import LogError
from greybox.trial.readers import cells as cell_text
from greybox.trial.readers.layout import find_layout
from greybox.trial.readers.table import Batch

_BLOCK_BYTES = 1 << 23
_BLANKS = re.compile(rb"[ \t]+")


@dataclass
class CsvFile:
    """A CSV file whose layout has been found out from its first lines."""

    path: Path
    columns: tuple[str, ...]
    delimiter: str
    decimal: str
    encoding: str
    skip: int
    units: dict[str, str] = field(default_factory=dict)
    text: frozenset[str] = frozenset()
    dates: frozenset[str] = frozenset()
    clocks: frozenset[str] = frozenset()
    notes: list[str] = field(default_factory=list)
    format: str = "CSV"

    @property
    def cells(self) -> int:
        """How many numbers the file may hold at most: a digit and a delimiter each."""
        return self.path.stat().st_size // 2

    def batches(self, columns: Sequence[str]) -> Iterator[Batch]:
        """Yield the named columns in blocks of a few megabytes.

        Raises
        ------
        LogError
            A line is longer than a block, no row fits the header, or the file
            is no text.
        """
        import pyarrow as pa
        from pyarrow import csv as arrow

        broken: Counter[str] = Counter()

        def skip_row(row: Any) -> str:
            # the half line at the end is no reason to look at the file again
            broken["rows"] += 1
            return "skip"

        words: Counter[str] = Counter()
        days = {c: cell_text.DayClock() for c in columns if c in self.clocks}
        rows = 0
        blanks, wide = self.delimiter == " ", self.encoding.startswith("utf-16")
        try:
            reader = arrow.open_csv(
                _Blanks(self.path, self.encoding) if blanks else self.path,
                read_options=arrow.ReadOptions(
                    block_size=_BLOCK_BYTES,
                    column_names=list(self.columns),
                    skip_rows=self.skip,
                    # one-byte encodings differ in words only: transcoding them is slow
                    encoding=self.encoding if wide and not blanks else "utf8",
                ),
                parse_options=arrow.ParseOptions(
                    delimiter=self.delimiter, invalid_row_handler=skip_row
                ),
                convert_options=arrow.ConvertOptions(
                    include_columns=list(columns),
                    column_types={c: pa.string() for c in columns},
                    null_values=cell_text.NULLS,
                    strings_can_be_null=True,
                    check_utf8=False,
                ),
            )
            for batch in reader:
                rows += batch.num_rows
                yield {c: self._values(batch.column(c), c, words, days) for c in columns}
        except (pa.ArrowException, OSError, UnicodeError, ValueError) as error:
            if isinstance(error, LogError):
                raise
            reason = " ".join(str(error).split())[:200]
            raise LogError(
                f"cannot read '{self.path.name}' as CSV after {rows} rows: {reason}. "
                f"Cut the file before that place, or export it again."
            ) from None
        count = broken["rows"]
        if count > rows:
            raise LogError(
                f"{count} of {count + rows} rows of '{self.path.name}' have another number of "
                f"fields than the {len(self.columns)} of its header: give every column a name, "
                f"or export it again."
            )
        if count:
            self._note(
                f"{count} row{'s' if count > 1 else ''} with another number of fields than the "
                f"{len(self.columns)} of the header left out"
            )
        for name, lost in words.items():
            self._note(
                f"column '{name}' holds words in {lost} row{'s' if lost > 1 else ''}: "
                f"read as missing"
            )

    def _note(self, note: str) -> None:
        # the file may be read twice
        if note not in self.notes:
            self.notes.append(note)

    def _values(
        self, column: Any, name: str, words: Counter[str], days: dict[str, cell_text.DayClock]
    ) -> Any:
        if name in self.text:
            return cell_text.text(column, "cp1252" if self.encoding == "cp1252" else "utf-8")
        if name in self.dates:
            return cell_text.dates(column)
        if name in days:
            return days[name].seconds(column)
        return cell_text.numbers(column, self.decimal, name, words)


def open_csv(path: Path) -> CsvFile:
    """Find out how a CSV file is written, from its first lines.

    Parameters
    ----------
    path : Path

    Returns
    -------
    CsvFile

    Raises
    ------
    LogError
        The file is empty, is no text, has no header line or no rows, or a line
        is longer than 4 MiB.
    """
    found = find_layout(path)
    by_kind = {
        kind: frozenset(n for n, k in found.kinds.items() if k == kind)
        for kind in ("text", "date", "clock")
    }
    return CsvFile(
        path,
        found.columns,
        found.delimiter,
        found.decimal,
        found.encoding,
        found.skip,
        found.units,
        by_kind["text"],
        by_kind["date"],
        by_kind["clock"],
        found.notes,
    )


class _Blanks(RawIOBase):
    """A file whose runs of blanks and tabs are one blank each, and none at the ends of lines."""

    def __init__(self, path: Path, encoding: str) -> None:
        self._text = encoding if encoding.startswith("utf-16") else None
        mode = "r" if self._text else "rb"
        newline = "" if self._text else None
        self._file: IO[Any] = open(  # noqa: SIM115 - closed with the stream
            path, mode, encoding=self._text, newline=newline
        )
        self._rest = b""
        self._ready = b""

    def readable(self) -> bool:
        """Whether it can be read, as Arrow asks."""
        return True

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()

    def read(self, size: int = -1) -> bytes:
        """Return up to `size` bytes, fewer at the end only."""
        while len(self._ready) < max(size, 1):
            block = self._file.read(_BLOCK_BYTES)
            block = block.encode() if self._text else block
            whole = self._rest + block
            cut = max(whole.rfind(b"\n"), whole.rfind(b"\r")) + 1 if block else len(whole)
            if not whole or (cut == 0 and len(whole) > 2 * _BLOCK_BYTES):
                # a line that long fails in the parser, without being held here
                cut = len(whole)
            self._rest = whole[cut:]
            lines = _BLANKS.sub(b" ", whole[:cut])
            lines = lines.replace(b"\n ", b"\n").replace(b" \n", b"\n").replace(b" \r", b"\r")
            self._ready += lines.removeprefix(b" ")
            if not block:
                break
        if size < 0:
            size = len(self._ready)
        out, self._ready = self._ready[:size], self._ready[size:]
        return out
