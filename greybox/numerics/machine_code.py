"""Small C sources as machine code, compiled once and kept in a folder of the user's."""

from __future__ import annotations

import ctypes
import logging
import os
import platform
import stat
import sys
from collections.abc import Callable
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any

from greybox.errors import GreyboxError
from greybox.files import replacing
from greybox.numerics.compiler import FLAGS, find_compiler, shared_library

# to stand before what a library shows
SHOWN = '__attribute__((visibility("default")))\n'
# libraries that are kept, 16 to 40 kB each
_MOST = 500
_log = logging.getLogger(__name__)


def cache_folder() -> Path | None:
    """Return the folder of the user's own in which libraries are kept, made where it is not there.

    None where there is none, or others may write to it: what it holds is run.
    """
    if not hasattr(os, "getuid"):
        return None
    try:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(base) / "greybox"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        about = folder.lstat()
    except (OSError, RuntimeError):
        return None
    own = stat.S_ISDIR(about.st_mode) and about.st_uid == os.getuid()
    return folder if own and stat.S_IMODE(about.st_mode) == 0o700 else None


class Library:
    """One function of a C source.

    Parameters
    ----------
    source : callable
        Returns the C source; only asked for where it is compiled.
    symbol : str
        Of the function, which returns nothing.
    arguments : sequence of type
        Its arguments, as ctypes names them.
    key : str
        What the source follows from; with compiler flags and machine, the file is named by it.
    """

    def __init__(
        self, source: Callable[[], str], symbol: str, arguments: list[Any], key: str
    ) -> None:
        self._source, self._symbol, self._arguments, self._key = source, symbol, arguments, key

    @cached_property
    def _place(self) -> Path | None:
        """The file of the library, named by all that it follows from."""
        folder = cache_folder()
        if folder is None:
            return None
        all_of_it = (self._key, *FLAGS, sys.platform, platform.machine())
        return folder / f"{sha256(repr(all_of_it).encode()).hexdigest()}.so"

    def found(self) -> Callable[..., None] | None:
        """Return the function of a library that was compiled before; None where there is none."""
        if self._place is None or not self._place.is_file():
            return None
        try:
            os.utime(self._place)
            run = ctypes.CDLL(str(self._place))[self._symbol]
        except (OSError, AttributeError) as error:
            _log.info("%s cannot be opened: %s", self._place, error)
            return None
        run.argtypes, run.restype = self._arguments, None
        return run

    def made(self) -> Callable[..., None] | None:
        """Compile, keep, and return the function; None without a compiler or a folder."""
        if self._place is None:
            return None
        try:
            compiler = find_compiler()
            if compiler is None:
                return None
            library = shared_library(compiler, {"source.c": self._source()}, ())
            with replacing(self._place, "wb") as handle:
                handle.write(library)
            kept = sorted(self._place.parent.glob("*.so"), key=lambda p: p.stat().st_mtime)
            for old in kept[:-_MOST]:
                old.unlink(missing_ok=True)
        except (GreyboxError, OSError) as error:
            _log.info("%s is not compiled: %s", self._symbol, error)
            return None
        return self.found()
