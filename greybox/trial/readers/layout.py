"""How a text table is written: encoding, delimiter, decimal mark, header, units."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from greybox.errors import LogError, so_many
from greybox.trial.readers import cells
from greybox.trial.readers.limits import limits
from greybox.units import spelled_unit

_FIRST_BYTES = 1 << 16
_HEAD_LINES = 60
_MAX_NOTED = 5
_DELIMITERS = (",", ";", "\t", "|", " ")
_END = re.compile(r"\r\n|\r|\n")
# control characters beside tab, ends of lines and pages
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0e-\x1f]")
_MARKS = "#%"


@dataclass
class Layout:
    """What the first lines of a table tell.

    Parameters
    ----------
    columns : tuple of str
        Names, each once.
    delimiter : str
        A blank stands for any run of blanks and tabs.
    decimal, encoding : str
    skip : int
        Lines before the first row.
    units : dict of str to str
        Where a line of units stands below the names.
    text, dates, clocks, sides : frozenset of str
        Columns of words, of dates, of times of day and of angles to port or starboard.
    notes : list of str
        What was recovered.
    """

    columns: tuple[str, ...]
    delimiter: str
    decimal: str
    encoding: str
    skip: int
    units: dict[str, str]
    text: frozenset[str]
    dates: frozenset[str]
    clocks: frozenset[str]
    sides: frozenset[str]
    notes: list[str]


@dataclass(frozen=True)
class _Split:
    """The first lines, split at one delimiter."""

    delimiter: str
    rows: list[list[str]]
    width: int
    share: list[float]
    typical: float

    def header_like(self, k: int) -> bool:
        row = self.rows[k]
        filled = [c for c in row if not cells.is_blank(c)]
        return bool(filled) and self.share[k] < max(0.5 * self.typical, 1e-9)

    def wide(self, k: int) -> bool:
        return len(self.rows[k]) == self.width or len(_bare(self.rows[k])) == self.width

    @property
    def header(self) -> int | None:
        """First line that may hold names, above the first row."""
        likely = [k for k in range(self.first_row) if self.header_like(k) and self._named(k)]
        full = [k for k in likely if not any(cells.is_blank(c) for c in _bare(self.rows[k]))]
        return next(iter(full or likely), None)

    def _named(self, k: int) -> bool:
        # rows may end in a delimiter that the header lacks
        return self.wide(k) or (len(self.rows[k]) == self.width - 1 and self.trailing)

    @property
    def trailing(self) -> bool:
        """Whether every row ends in a delimiter."""
        rows = [r for k, r in enumerate(self.rows) if k >= self.first_row and len(r) == self.width]
        return self.width > 1 and bool(rows) and all(not r[-1].strip() for r in rows)

    @property
    def first_row(self) -> int:
        for k, row in enumerate(self.rows):
            if len(row) == self.width and not self.header_like(k):
                return k
        return len(self.rows)

    def score(self) -> tuple[float, ...]:
        same = sum(len(r) == self.width for r in self.rows) / len(self.rows)
        return (
            float(self.width > 1 and same >= 0.6),
            float(self.header is not None),
            round(self.typical, 1),
            float(self.delimiter in (";", "\t", "|")),
            self.width,
        )


def find_layout(path: Path) -> Layout:
    """Find out how a text table is written, from its first lines.

    Parameters
    ----------
    path : Path

    Returns
    -------
    Layout

    Raises
    ------
    LogError
        The file is empty, is no text, has no header line or no rows, or a line
        is longer than 4 MiB.
    """
    lines, encoding = _head(path)
    at = [k for k, line in enumerate(lines) if not _comment(line)][:_HEAD_LINES]
    if not at:
        raise LogError(f"'{path.name}' holds no rows: name a log with a header line and samples.")
    body = [lines[k] for k in at]
    split = max((_split(body, d) for d in _DELIMITERS), key=_Split.score)
    notes: list[str] = []
    header, names, units_at = split.header, [], []
    if header is None:
        names = _commented_names(lines[: at[min(split.first_row, len(at) - 1)]], split)
        if not names:
            raise _no_header(path, split)
        notes.append("names of the columns read from a comment")
    else:
        names = split.rows[header]
        units_at = [k for k in range(header + 1, split.first_row) if split.header_like(k)]
        if at[header]:
            count = sum(bool(line.strip()) for line in lines[: at[header]])
            if count:
                notes.append(f"{so_many(count, 'line')} before the header skipped")
    if split.first_row >= len(split.rows):
        raise LogError(
            f"'{path.name}' has a header line of {so_many(len(names), 'name')} but no rows "
            f"below it: "
            f"name a log with samples."
        )
    names = names + [""] * (split.width - len(names))
    columns = _unique([n.strip().strip('"').strip() for n in names], notes)
    units = _units(columns, [split.rows[k] for k in units_at], notes)
    data = [r for k, r in enumerate(split.rows) if k >= split.first_row and len(r) == split.width]
    decimal = "," if split.delimiter != "," and _decimal_commas(data) else "."
    if decimal == ",":
        notes.append("decimal commas read as points")
    if encoding != "utf-8":
        notes.append(f"text in {encoding}")
    kinds = {
        name: cells.kind((row[k] for row in data), comma=split.delimiter != ",", name=name)
        for k, name in enumerate(columns)
    }
    text, dates, clocks, sides = (
        frozenset(n for n, kind in kinds.items() if kind == wanted)
        for wanted in ("text", "date", "clock", "side")
    )
    notes += [
        f"column '{n}' names sides: starboard is positive, port negative"
        for n in kinds
        if n in sides
    ]
    skip = at[split.first_row]
    return Layout(
        columns, split.delimiter, decimal, encoding, skip, units, text, dates, clocks, sides, notes
    )


def fields(line: str, delimiter: str) -> list[str]:
    """Return the fields of a line."""
    if delimiter == " ":
        return [c.strip('"') for c in line.split()]
    try:
        return next(iter(csv.reader([line], delimiter=delimiter)), [])
    except csv.Error:
        return line.split(delimiter)


def _head(path: Path) -> tuple[list[str], str]:
    """Return the first lines, and the encoding; a last line that may be cut is left out."""
    with open(path, "rb") as handle:
        raw = handle.read(_FIRST_BYTES)
        while raw.count(b"\n") <= _HEAD_LINES and len(raw) < limits().head_bytes:
            if raw.count(b"\0") == len(raw) or not (block := handle.read(_FIRST_BYTES)):
                break
            raw += block
        more = bool(handle.read(1))
    if not raw.strip():
        raise LogError(f"'{path.name}' is empty: name a log with a header line and samples.")
    encoding = _encoding(path, raw)
    text = raw.decode(encoding, errors="replace").removeprefix("\ufeff")
    control = len(_CONTROL.findall(text[:_FIRST_BYTES]))
    if control > 0.01 * min(len(text), _FIRST_BYTES):
        raise LogError(
            f"'{path.name}' holds {control} control characters in its first "
            f"{min(len(text), _FIRST_BYTES)}, it is not text: name a CSV file, or give the file "
            f"the ending of its format."
        )
    lines = _END.split(text)
    if more and len(lines) < 3:
        raise LogError(
            f"'{path.name}' has no end of line in its first {len(raw)} bytes: "
            f"name a table with one sample a line."
        )
    return (lines[:-1] if more else lines), encoding


def _encoding(path: Path, raw: bytes) -> str:
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16"
    zeros = np.flatnonzero(np.frombuffer(raw[:4096], np.uint8) == 0)
    if len(zeros):
        odd = float(np.mean(zeros % 2))
        if len(zeros) > 0.35 * len(raw[:4096]) and odd in (0.0, 1.0):
            return "utf-16-le" if odd else "utf-16-be"
    if b"\0" in raw:
        raise LogError(
            f"'{path.name}' holds binary data (a zero byte at {raw.index(0)}), not text: "
            f"name a CSV file, or give the file the ending of its format."
        )
    try:
        # up to three bytes of a last character may be missing
        raw[: raw.rfind(b"\n") + 1 or None].decode("utf-8")
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


def _comment(line: str) -> bool:
    bare = line.strip()
    return not bare or bare[0] in _MARKS or bare.startswith("//")


def _bare(row: Sequence[str]) -> list[str]:
    """Return a row without the empty field that a delimiter at its end leaves."""
    return list(row[:-1] if len(row) > 1 and not row[-1].strip() else row)


def _split(body: list[str], delimiter: str) -> _Split:
    rows = [fields(line, delimiter) for line in body]
    comma = delimiter != ","
    share = [_share(row, comma=comma) for row in rows]
    widths = Counter(len(r) for r, s in zip(rows, share, strict=True) if s > 0)
    widths = widths or Counter(len(r) for r in rows)
    width = widths.most_common(1)[0][0]
    full = [s for r, s in zip(rows, share, strict=True) if len(r) == width]
    typical = float(np.median([s for s in full if s > 0] or [0.0]))
    return _Split(delimiter, rows, width, share, typical)


def _share(row: list[str], *, comma: bool) -> float:
    filled = [c for c in row if not cells.is_blank(c)]
    hits = sum(
        cells.is_number(c, comma=comma) or cells.is_date(c) or cells.is_clock(c) for c in filled
    )
    return hits / max(len(filled), 1)


def _decimal_commas(rows: list[list[str]]) -> bool:
    flat = [c.strip() for row in rows for c in row]
    comma = sum(map(cells.has_comma, flat))
    point = sum("." in c and cells.is_number(c, comma=False) for c in flat)
    return comma > point


def _commented_names(above: list[str], split: _Split) -> list[str]:
    """Return the names in the comment just above the first row, as numpy writes them."""
    for line in reversed(above):
        bare = line.strip().lstrip(_MARKS + "/").strip()
        if bare:
            names = fields(bare, split.delimiter)
            return names if len(names) == split.width and _share(names, comma=False) == 0 else []
    return []


def _no_header(path: Path, split: _Split) -> LogError:
    first = split.rows[0]
    if len(first) == split.width and not split.header_like(0):
        shown = ", ".join(c[:20] for c in first[:4])
        return LogError(
            f"'{path.name}' begins with numbers ({shown}{', …' if len(first) > 4 else ''}) and "
            f"has no header line: add one that names the {so_many(len(first), 'column')}."
        )
    names = next((r for k, r in enumerate(split.rows) if split.header_like(k)), first)
    more = ""
    if split.delimiter == "," and split.width in (2 * len(names), 2 * len(names) - 1):
        more = ", or part the fields with semicolons if the commas are decimal ones"
    return LogError(
        f"'{path.name}' has {so_many(len(names), 'name')} in its header and "
        f"{so_many(split.width, 'field')} in its "
        f"rows: give every column a name{more}."
    )


def _unique(names: list[str], notes: list[str]) -> tuple[str, ...]:
    if len(names) > (most := limits().columns):
        raise LogError(
            f"the header names {len(names)} columns, at most {most} are read: export fewer."
        )
    taken: set[str] = set()
    found, renamed = [], []
    for k, name in enumerate(names):
        name = name or f"column_{k + 1}"
        new, count = name, 1
        while new in taken or (new != name and new in names):
            count += 1
            new = f"{name}.{count}"
        if new != name:
            renamed.append(f"{count} columns are called '{name}': the last is taken as '{new}'")
        taken.add(new)
        found.append(new)
    notes += renamed[:_MAX_NOTED]
    if len(renamed) > _MAX_NOTED:
        notes.append(
            so_many(len(renamed) - _MAX_NOTED, "more column", "has", "have")
            + " the name of another"
        )
    return tuple(found)


def _units(columns: tuple[str, ...], below: list[list[str]], notes: list[str]) -> dict[str, str]:
    units: dict[str, str] = {}
    for row in below:
        found = {}
        for name, cell in zip(columns, row, strict=False):
            unit = spelled_unit(cell.strip().strip("[]()"))
            if unit is not None:
                found[name] = unit
        units = units or found
    if below:
        count = f"{len(below)} more header lines" if len(below) > 1 else "second header line"
        notes.append(f"{count} {'read as units' if units else 'skipped'}")
    return units
