"""Files: written whole or not at all, small ones read within bounds."""

from __future__ import annotations

import csv
import hashlib
import json
import logging
import math
import os
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from io import StringIO
from itertools import islice
from pathlib import Path
from typing import IO, Any

import numpy as np

from greybox.errors import LogError, nearest

_MOST_NAMES = 10_000
# largest file that is read as a whole
_MOST_BYTES = 50_000_000

_log = logging.getLogger(__name__)


def check_targets(*paths: str | Path | None) -> None:
    """Refuse targets that cannot be written, before anything is computed.

    Raises
    ------
    LogError
        A path is empty, a folder, or in a folder that does not exist.
    """
    for path in paths:
        if path is None or str(path) == "-":
            continue
        if not str(path):
            raise LogError("an output file has an empty name: name a file.")
        target = Path(path)
        if target.is_dir():
            raise LogError(f"cannot write '{path}': it is a folder. Name a file in it.")
        if not target.parent.is_dir() or not os.access(target.parent, os.W_OK):
            why = "you may not write in" if target.parent.is_dir() else "there is no"
            raise LogError(
                f"cannot write '{path}': {why} folder '{target.parent}'. Name a file in a folder "
                f"that exists and is yours to write in."
            )


def nearest_file(path: str | Path, known: Iterable[str] = ()) -> str:
    """Return `` Did you mean 'x'?`` for what stands beside a missing `path`, or ``""``.

    Parameters
    ----------
    path : str or Path
    known : iterable of str
        Names that would do too.
    """
    path = Path(path)
    try:
        beside = [p.name for p in islice(path.parent.iterdir(), _MOST_NAMES) if p != path]
    except (OSError, ValueError):
        beside = []
    names = [*known, *beside]
    # an ending that they share makes no names alike
    stems = {Path(n).stem: n for n in names if Path(n).suffix == path.suffix}
    others = [n for n in names if n not in stems.values()]
    found = stems.get(nearest(path.stem, stems), "") or nearest(path.name, others)
    return f" Did you mean '{found}'?" if found else ""


def real_path(path: str | Path) -> Path:
    """Return a path without links, as far as they lead; those that lead round stay."""
    return Path(os.path.realpath(path))


def make_folder(path: str | Path) -> Path:
    """Make a folder, and those that it stands in, where they do not exist.

    Raises
    ------
    LogError
        The folder cannot be made.
    """
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LogError(
            f"cannot make the folder '{folder}': {error.strerror}. Name another with --out."
        ) from error
    return folder


@contextmanager
def replacing(path: str | Path, mode: str = "w") -> Iterator[IO[Any]]:
    """Open a file beside `path` and rename it over `path` when the block ends well.

    A device or a pipe is written directly, never replaced.

    Raises
    ------
    LogError
        As `check_targets`.
    """
    check_targets(path)
    path = Path(path)
    options: dict[str, Any] = {} if "b" in mode else {"encoding": "utf-8", "newline": "\n"}
    if path.exists() and not path.is_file():
        with open(path, mode, **options) as handle:
            yield handle
        return
    named, path = path, real_path(path)
    try:
        handle = tempfile.NamedTemporaryFile(  # noqa: SIM115 - closed below
            mode, dir=path.parent, prefix=f".{path.name}.", delete=False, **options
        )
    except OSError as error:
        raise LogError(
            f"cannot write '{path}': {error.strerror}. Name a file in a folder that exists."
        ) from error
    try:
        with handle:
            yield handle
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(handle.name, 0o666 & ~umask)
        os.replace(handle.name, path)
        _log.info("wrote %s: %d bytes", named, path.stat().st_size)
    except BaseException:
        Path(handle.name).unlink(missing_ok=True)
        raise


def plain(value: Any) -> Any:
    """Return `value` as JSON types; a number that is not finite becomes ``None``."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (np.bool_, bool)):
        return bool(value)
    if isinstance(value, np.integer):
        return int(value)
    if isinstance(value, (float, np.floating)):
        number = float(value)
        return number if math.isfinite(number) else None
    return value


def to_json(value: Any) -> str:
    """Return `value` as indented JSON that ends in a newline."""
    return json.dumps(plain(value), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def read_json(path: str | Path, what: str, advice: str) -> Any:
    """Read a JSON file of bounded size.

    Parameters
    ----------
    path : str or Path
    what : str
        What the file should be, such as ``the diagnosis``.
    advice : str
        A sentence on what to give instead.

    Raises
    ------
    LogError
        It is missing, too large, or no JSON.
    """
    text = _bounded_text(path, what, advice)
    try:
        return json.loads(text)
    except (json.JSONDecodeError, RecursionError) as error:
        raise LogError(f"{what} '{path}' is no JSON: {error}. {advice}") from error


def read_csv_rows(
    path: str | Path, what: str, advice: str, most: int = _MOST_BYTES
) -> tuple[list[str], list[list[str]]]:
    """Read a small CSV file of bounded size: its header, and the rows that hold anything.

    Parameters
    ----------
    path : str or Path
    what : str
        What the file should be, such as ``the sea room``.
    advice : str
        A sentence on what to give instead.
    most : int
        Bytes that are read at most.

    Raises
    ------
    LogError
        It is missing, too large, or no text.
    """
    text = _bounded_text(path, what, advice, most)
    try:
        rows = [r for r in csv.reader(StringIO(text, newline="")) if any(c.strip() for c in r)]
    except csv.Error as error:
        raise LogError(f"cannot read {what} '{path}': {error}. {advice}") from error
    return [c.strip() for c in rows[0]] if rows else [], rows[1:]


def _bounded_text(path: str | Path, what: str, advice: str, most: int = _MOST_BYTES) -> str:
    path = Path(path)
    try:
        size = path.stat().st_size
        if size > most:
            raise LogError(
                f"{what} '{path}' has {size / 1e6:.0f} MB, at most {most / 1e6:.0f} MB are read. "
                f"{advice}"
            )
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise LogError(
            f"cannot read {what} '{path}': {error.strerror}.{nearest_file(path)} {advice}"
        ) from error
    except UnicodeDecodeError as error:
        raise LogError(f"cannot read {what} '{path}': {error}. {advice}") from error


def write_json(value: Any, path: str | Path) -> None:
    """Write `value` as JSON to `path`; ``-`` means standard output."""
    if str(path) == "-":
        sys.stdout.write(to_json(value))
        return
    with replacing(path) as handle:
        handle.write(to_json(value))


def write_text(text: str, path: str | Path) -> None:
    """Write `text` to `path`, replacing it in one step."""
    with replacing(path) as handle:
        handle.write(text)


def sha256(path: str | Path) -> str:
    """Return the SHA-256 digest of a file in hexadecimal."""
    with open(path, "rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()
