"""Writing files so that nothing half-written is ever left behind."""

from __future__ import annotations

import hashlib
import json
import math
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np

from greybox.errors import LogError


@contextmanager
def replacing(path: str | Path, mode: str = "w") -> Iterator[IO[Any]]:
    """Open a file beside `path` and rename it over `path` when the block ends well.

    Raises
    ------
    LogError
        The folder does not exist or cannot be written.
    """
    path = Path(path)
    try:
        handle = tempfile.NamedTemporaryFile(  # noqa: SIM115 - closed below
            mode,
            dir=path.parent,
            prefix=f".{path.name}.",
            delete=False,
            encoding=None if "b" in mode else "utf-8",
            newline=None if "b" in mode else "\n",
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
