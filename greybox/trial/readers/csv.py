"""CSV with any delimiter, decimal mark, encoding and header, in bounded memory."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.errors import LogError
from greybox.trial.names import spelled_unit
from greybox.trial.readers.table import Batch

_HEAD_BYTES = 1 << 16
_BLOCK_BYTES = 1 << 23
_HEAD_LINES = 60
_MAX_COLUMNS = 4096
_DELIMITERS = (",", ";", "\t", "|", " ")
_NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eEdD][+-]?\d+)?")
_NOTHING = {"", "nan", "na", "n/a", "null", "none", "-", "--", "inf", "-inf", "#n/a", "nat"}
_DATE = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d")
_NULLS = ["", "NaN", "nan", "NAN", "NA", "N/A", "null", "NULL", "None", "-", "--", "#N/A"]


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
    notes: list[str] = field(default_factory=list)
    format: str = "CSV"

    def batches(self, columns: Sequence[str]) -> Iterator[Batch]:
        """Yield the named columns in blocks of a few megabytes.

        Raises
        ------
        LogError
            A line is longer than a block, or the file is no text.
        """
        import pyarrow as pa
        from pyarrow import csv as arrow

        broken: list[int] = []

        def skip_row(row: Any) -> str:
            broken.append(row.number or 0)
            return "skip"

        words: Counter[str] = Counter()
        try:
            reader = arrow.open_csv(
                self.path,
                read_options=arrow.ReadOptions(
                    block_size=_BLOCK_BYTES,
                    column_names=list(self.columns),
                    skip_rows=self.skip,
                    encoding=self.encoding,
                ),
                parse_options=arrow.ParseOptions(
                    delimiter=self.delimiter, invalid_row_handler=skip_row
                ),
                convert_options=arrow.ConvertOptions(
                    include_columns=list(columns),
                    column_types={c: pa.string() for c in columns},
                    null_values=_NULLS,
                    strings_can_be_null=True,
                    check_utf8=False,
                ),
            )
            for batch in reader:
                found: Batch = {}
                for name in columns:
                    column = batch.column(name)
                    if name in self.text:
                        found[name] = _words(column)
                    elif name in self.dates:
                        found[name] = _dates(column)
                    else:
                        found[name] = _numbers(column, self.decimal, name, words)
                yield found
        except (pa.ArrowException, OSError, UnicodeError, ValueError) as error:
            reason = " ".join(str(error).split())[:200]
            raise LogError(
                f"cannot read '{self.path.name}' as CSV beyond its first lines: {reason}. "
                f"Cut the file before that place, or export it again."
            ) from None
        if broken:
            self.notes.append(
                f"{len(broken)} row{'s' if len(broken) > 1 else ''} with another number of "
                f"fields than the {len(self.columns)} of the header left out"
                + (f" (first: row {broken[0]})" if broken[0] else "")
            )
        for name, count in words.items():
            self.notes.append(
                f"column '{name}' holds words in {count} row{'s' if count > 1 else ''}: "
                f"read as missing"
            )


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
        is longer than 65536 bytes.
    """
    lines, encoding = _head(path)
    at = next((k for k, line in enumerate(lines) if not _comment(line)), len(lines))
    body = [line for line in lines[at:] if line.strip()][:_HEAD_LINES]
    if not body:
        raise LogError(f"'{path.name}' holds no rows: name a log with a header line and samples.")
    delimiter = _delimiter(body)
    rows = [_fields(line, delimiter) for line in body]
    decimal = "," if delimiter != "," and _decimal_commas(rows) else "."
    numeric = [_share_of_numbers(row) for row in rows]
    header = _header_row(path, rows, numeric)
    notes: list[str] = []
    skipped = lines.index(body[header]) if header else at
    if header:
        notes.append(f"{skipped - at} lines before the header skipped")
    names, start = rows[header], header + 1
    units: dict[str, str] = {}
    columns = _unique([n.strip().strip('"').strip() for n in names], notes)
    if start < len(rows) and numeric[start] < 0.5 and _is_second_header(rows, numeric, start):
        for name, cell in zip(columns, rows[start], strict=False):
            unit = spelled_unit(cell.strip().strip("[]()"))
            if unit is not None:
                units[name] = unit
        notes.append("second header line " + ("read as units" if units else "skipped"))
        start += 1
    if decimal == ",":
        notes.append("decimal commas read as points")
    if encoding not in ("utf-8", "utf-8-sig"):
        notes.append(f"text in {encoding}")
    sample = [row for row in rows[start:] if len(row) == len(columns)]
    if len(rows) > start and not sample:
        raise LogError(
            f"'{path.name}' has {len(columns)} names in its header and "
            f"{len(rows[start])} fields in its first row: give every column a name."
        )
    text, dates = _kinds(columns, sample)
    last = body[start - 1]
    skip = len(lines) - 1 - lines[::-1].index(last) if last not in lines[at:] else (
        lines.index(last, at) + 1
    )
    return CsvFile(
        path, columns, delimiter, decimal, encoding, skip, units, text, dates, notes
    )


def _head(path: Path) -> tuple[list[str], str]:
    with open(path, "rb") as handle:
        raw = handle.read(_HEAD_BYTES)
        more = bool(handle.read(1))
    if not raw.strip():
        raise LogError(f"'{path.name}' is empty: name a log with a header line and samples.")
    encoding = "utf-8"
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        encoding = "utf-16"
    elif raw[:3] == b"\xef\xbb\xbf":
        encoding = "utf-8-sig"
    elif b"\0" in raw:
        raise LogError(
            f"'{path.name}' holds binary data (a zero byte at {raw.index(0)}), not text: "
            f"name a CSV file, or give the file the ending of its format."
        )
    try:
        # a character may be cut at the end of what was read
        text = raw.decode(encoding, errors="strict" if not more else "ignore")
        if more and encoding.startswith("utf-8"):
            raw[:-4].decode(encoding)
    except UnicodeDecodeError:
        encoding = "cp1252"
        text = raw.decode(encoding, errors="replace")
    control = sum(c < " " and c not in "\t\r\n\f" for c in text)
    if control > 0.01 * len(text):
        raise LogError(
            f"'{path.name}' holds {control} control characters in its first {len(text)}, it is "
            f"not text: name a CSV file, or give the file the ending of its format."
        )
    lines = text.splitlines()
    if more and len(lines) < 2:
        raise LogError(
            f"'{path.name}' has no end of line in its first {_HEAD_BYTES} bytes: "
            f"name a table with one sample a line."
        )
    return (lines[:-1] if more else lines), encoding


def _comment(line: str) -> bool:
    bare = line.strip()
    return not bare or bare[0] in "#%" or bare.startswith("//")


def _fields(line: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        return line.split()
    return next(iter(csv.reader([line], delimiter=delimiter)), [])


def _delimiter(lines: list[str]) -> str:
    def score(delimiter: str) -> tuple[float, int]:
        counts = Counter(len(_fields(line, delimiter)) for line in lines)
        count, times = counts.most_common(1)[0]
        return (times / len(lines) if count > 1 else 0.0, count)

    # a decimal comma parts numbers only where no other delimiter parts the fields
    found = {d: score(d) for d in _DELIMITERS}
    strong = [d for d in (";", "\t", "|") if found[d][0] >= 0.8]
    return strong[0] if strong else max(found, key=lambda d: (found[d][0] >= 0.6, found[d][1]))


def _is_number(cell: str) -> bool:
    bare = cell.strip().strip('"')
    return bool(_NUMBER.fullmatch(bare)) or bare.lower() in _NOTHING or bool(_DATE.match(bare))


def _share_of_numbers(row: list[str]) -> float:
    return sum(map(_is_number, row)) / max(len(row), 1)


def _decimal_commas(rows: list[list[str]]) -> bool:
    cells = [c.strip() for row in rows for c in row]
    comma = sum(bool(re.fullmatch(r"[+-]?\d+,\d+([eE][+-]?\d+)?", c)) for c in cells)
    point = sum(bool(re.fullmatch(r"[+-]?\d+\.\d+([eE][+-]?\d+)?", c)) for c in cells)
    return comma > point


def _header_row(path: Path, rows: list[list[str]], numeric: list[float]) -> int:
    if numeric[0] > 0.9 and any(c.strip() for c in rows[0]):
        raise LogError(
            f"'{path.name}' begins with numbers ({', '.join(rows[0][:4])}, …) and has no header "
            f"line: add one that names the {len(rows[0])} columns."
        )
    width = Counter(len(row) for row in rows).most_common(1)[0][0]
    for k, row in enumerate(rows):
        if len(row) == width and numeric[k] < 0.5:
            return k
    if len(rows) == 1:
        return 0
    raise LogError(
        f"'{path.name}' has no header line whose fields ({len(rows[0])} in the first line) match "
        f"its rows ({width}): add one that names every column."
    )


def _is_second_header(rows: list[list[str]], numeric: list[float], at: int) -> bool:
    after = numeric[at + 1 : at + 6]
    return bool(after) and float(np.median(after)) > numeric[at] + 0.3


def _unique(names: list[str], notes: list[str]) -> tuple[str, ...]:
    if len(names) > _MAX_COLUMNS:
        raise LogError(
            f"the header names {len(names)} columns, at most {_MAX_COLUMNS} are read: "
            f"export fewer."
        )
    seen: Counter[str] = Counter()
    found = []
    for k, name in enumerate(names):
        name = name or f"column_{k + 1}"
        seen[name] += 1
        if seen[name] > 1:
            notes.append(f"column '{name}' stands twice: the second is called '{name}.2'")
            name = f"{name}.{seen[name]}"
        found.append(name)
    return tuple(found)


def _kinds(
    columns: tuple[str, ...], rows: list[list[str]]
) -> tuple[frozenset[str], frozenset[str]]:
    text, dates = set(), set()
    for k, name in enumerate(columns):
        cells = [row[k].strip().strip('"') for row in rows]
        filled = [c for c in cells if c.lower() not in _NOTHING]
        if filled and sum(bool(_DATE.match(c)) for c in filled) > 0.5 * len(filled):
            dates.add(name)
        elif filled and sum(map(_is_number, filled)) < 0.5 * len(filled):
            text.add(name)
    return frozenset(text), frozenset(dates)


def _numbers(
    column: Any, decimal: str, name: str, words: Counter[str]
) -> NDArray[np.float64]:
    import pandas as pd
    import pyarrow as pa
    from pyarrow import compute

    if decimal == ",":
        column = compute.replace_substring(column, ",", ".")
    try:
        return np.asarray(column.cast(pa.float64()).to_numpy(zero_copy_only=False))
    except pa.ArrowInvalid:
        bare = pd.Series(_words(column)).str.strip()
        values = pd.to_numeric(bare, errors="coerce").to_numpy(dtype=float)
        lost = int((np.isnan(values) & ~bare.str.lower().isin(_NOTHING).to_numpy()).sum())
        if lost:
            words[name] += lost
        return np.asarray(values)


def _words(column: Any) -> NDArray[Any]:
    import pyarrow as pa

    raw = column.cast(pa.binary()).to_pylist()
    return np.array(["" if c is None else c.decode("utf-8", "replace") for c in raw], dtype=object)


def _dates(column: Any) -> NDArray[np.float64]:
    import pandas as pd

    stamps = pd.to_datetime(
        pd.Series(_words(column)), utc=True, errors="coerce", format="ISO8601"
    )
    ns = stamps.astype("datetime64[ns, UTC]").astype("int64").to_numpy().astype(float)
    return np.where(stamps.isna().to_numpy(), np.nan, ns * 1e-9)
