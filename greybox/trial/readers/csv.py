"""CSV with any delimiter, decimal mark, encoding and header, in bounded memory."""

from __future__ import annotations

import codecs
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from io import RawIOBase
from pathlib import Path
from typing import Any

import numpy as np

from greybox.errors import LogError, so_many
from greybox.trial.readers import cells as cell_text
from greybox.trial.readers.layout import Layout, find_layout
from greybox.trial.readers.limits import limits
from greybox.trial.readers.table import Batch
from greybox.trial.steps import Step

_BLANKS = re.compile(rb"[ \t]+")


@dataclass
class CsvFile(Layout):
    """A CSV file whose layout has been found out from its first lines."""

    path: Path
    format: str = "CSV"
    first_row: int = 2
    steps: tuple[Step, ...] = ()
    _grouped: set[str] = field(default_factory=set)

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
            broken["quoted"] += (row.text or "").rstrip("\r\n").count("\n")
            return "skip"

        words: Counter[str] = Counter()
        stamps = {
            c: cell_text.Stamps(c, self.path.name, days=c in self.clocks)
            for c in columns
            if c in self.clocks or c in self.dates
        }
        rows = 0
        try:
            clean = _Clean(self.path, self.encoding, blanks=self.delimiter == " ")
            # a reader left open reads ahead, and may outlive the interpreter
            with arrow.open_csv(
                clean,
                read_options=arrow.ReadOptions(
                    block_size=limits().block_bytes,
                    column_names=list(self.columns),
                    skip_rows=self.skip,
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
            ) as reader:
                for batch in reader:
                    rows += batch.num_rows
                    yield {c: self._values(batch.column(c), c, words, stamps) for c in columns}
        except (pa.ArrowException, OSError, UnicodeError, ValueError) as error:
            if isinstance(error, LogError):
                raise
            raise LogError(
                f"cannot read '{self.path.name}' as CSV after {so_many(rows, 'row')}: "
                f"{_reason(error)}. "
                f"Cut the file before that place, or export it again."
            ) from None
        if clean.unfinished:
            self._note("the last line has no end: left out, since it may be cut")
        count, quoted = broken["rows"], broken["quoted"]
        if quoted > rows:
            raise LogError(
                f"{quoted} of {so_many(count + quoted + rows, 'row')} of '{self.path.name}' "
                f"{'stands' if quoted == 1 else 'stand'} inside a "
                f"quoted cell whose quote is never closed: take the quote out, or export it again."
            )
        if count > rows:
            raise LogError(
                f"{count} of {so_many(count + rows, 'row')} of '{self.path.name}' "
                f"{'has' if count == 1 else 'have'} another number of "
                f"fields than the {len(self.columns)} of its header: give every column a name, "
                f"or export it again."
            )
        if quoted:
            self._note(
                f"{so_many(quoted, 'row')} inside a quoted cell whose quote is not "
                f"closed in its row left out"
            )
        if count:
            self._note(
                f"{so_many(count, 'row')} with another number of fields than the "
                f"{len(self.columns)} of the header left out"
            )
        # the file may be read twice
        self.steps = tuple(s for s in (stamp.step for stamp in stamps.values()) if s is not None)
        for step in self.steps:
            self._note(f"{step.source[0]}: {step.sentence}")
        for name, lost in words.items():
            what = "what is no time" if name in stamps else "words"
            self._note(f"column '{name}' holds {what} in {so_many(lost, 'row')}: read as missing")

    def _note(self, note: str) -> None:
        # the file may be read twice
        if note not in self.notes:
            self.notes.append(note)

    def _values(
        self, column: Any, name: str, words: Counter[str], stamps: dict[str, cell_text.Stamps]
    ) -> Any:
        if name in self.text:
            return cell_text.text(column)
        if name in stamps:
            seconds = stamps[name].seconds(column)
            if lost := int(np.isnan(seconds).sum()) - column.null_count:
                words[name] += lost
            return seconds
        if name in self.sides:
            column = cell_text.sided(column)
        return cell_text.numbers(self._without_groups(column, name), self.decimal, name, words)

    def _without_groups(self, column: Any, name: str) -> Any:
        """Return cells without the points between thousands."""
        if self.decimal != ",":
            return column
        from pyarrow import compute

        if name not in self._grouped:
            if not cell_text.grouped(column):
                return column
            self._grouped.add(name)
            self._note(f"column '{name}' has points between thousands: 1.234,5 read as 1234.5")
        return compute.replace_substring(column, ".", "")


def _reason(error: Exception) -> str:
    """Return what Arrow says, in words about the file where it speaks of its blocks."""
    said = " ".join(str(error).split())[:200].rstrip(".")
    if "straddles two block boundaries" in said:
        return f"a line is longer than {limits().block_bytes} bytes"
    if "out of sync with chunker" in said:
        return "a quoted cell holds line ends, or its quote is never closed"
    return said


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
    return CsvFile(**vars(find_layout(path)), path=path)


class _Clean(RawIOBase):
    """A text file as valid UTF-8, line by line.

    Arrow hands rows that it cannot split to Python as text: one damaged byte
    would end there. Runs of blanks become one blank where blanks part the fields.
    """

    def __init__(self, path: Path, encoding: str, *, blanks: bool) -> None:
        self._file = open(path, "rb")  # noqa: SIM115 - closed with the stream
        wide = encoding.startswith("utf-16")
        self._decode = codecs.getincrementaldecoder(encoding)("replace").decode if wide else None
        self._encoding, self._blanks = encoding, blanks
        self._rest = b""
        self._ready = memoryview(b"")
        self.unfinished = False

    def readable(self) -> bool:
        """Whether it can be read, as Arrow asks."""
        return True

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()

    def read(self, size: int = -1) -> bytes:
        """Return up to `size` bytes, none at the end only."""
        while not len(self._ready):
            raw = self._file.read(limits().block_bytes)
            block = raw if self._decode is None else self._decode(raw, not raw).encode()
            if not raw and not block:
                # what has no end may be half a line, and half a number looks like a number
                self.unfinished = bool(self._rest.strip())
                return b""
            cut = max(block.rfind(b"\n"), block.rfind(b"\r")) + 1
            if cut == 0 and len(self._rest) + len(block) < 2 * limits().block_bytes and raw:
                self._rest += block
                continue
            # a line that long fails in the parser, without being held here
            cut = cut or len(block)
            self._ready = memoryview(self._cleaned(self._rest + block[:cut]))
            self._rest = block[cut:]
        taken = self._ready if size < 0 else self._ready[:size]
        self._ready = self._ready[len(taken) :]
        return bytes(taken)

    def _cleaned(self, lines: bytes) -> bytes:
        if not lines.isascii():
            try:
                lines.decode("utf-8")
            except UnicodeDecodeError:
                known = "cp1252" if self._encoding == "cp1252" else "utf-8"
                lines = lines.decode(known, "replace").encode()
        if self._blanks:
            lines = _BLANKS.sub(b" ", lines).removeprefix(b" ")
            lines = lines.replace(b"\n ", b"\n").replace(b" \n", b"\n").replace(b" \r", b"\r")
        return lines
