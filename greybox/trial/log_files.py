"""Which files a user means: a file, all logs of a folder, a pattern, an address on the net."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from glob import glob, has_magic
from pathlib import Path, PurePosixPath
from typing import Any

from greybox.errors import GreyboxError, LogError, UsageError, so_many

# what the names of logs end in, for which a folder is searched: records and reports stand beside
# them
ENDINGS = (".csv", ".parquet", ".pq")


@dataclass(frozen=True)
class LogFile:
    """A file that is to be read.

    Parameters
    ----------
    path : str
        On this machine, or an address such as ``s3://bucket/log.parquet``.
    found : bool
        Whether a folder or a pattern was named, and not the file itself: it is then left out
        where it is no log.
    """

    path: str
    found: bool = False

    @property
    def name(self) -> str:
        """Name without folders."""
        return PurePosixPath(self.path).name if is_address(self.path) else Path(self.path).name


def is_address(path: str) -> bool:
    """Whether a path is an address that fsspec opens."""
    return "://" in path


def find_logs(paths: Sequence[str]) -> list[LogFile]:
    """Return the files that paths stand for.

    Parameters
    ----------
    paths : sequence of str
        Files, folders, patterns such as ``logs/*.parquet``, and addresses of either. Folders
        are searched with the folders in them; names that start with ``.`` or ``_`` are left out.

    Returns
    -------
    list of LogFile
        In the order of the paths, those of one path by name.

    Raises
    ------
    LogError
        A folder or a pattern stands for no file, or an address cannot be reached.
    UsageError
        The package that opens an address is not installed.
    """
    files: list[LogFile] = []
    for path in paths:
        if is_address(path):
            files += _at_address(path)
        elif Path(path).is_dir():
            folder = Path(path)
            names = [p.as_posix() for p in folder.rglob("*") if p.is_file()]
            files += _found(path, names, folder.as_posix())
        elif has_magic(path) and not Path(path).exists():
            files += _found(path, [p for p in glob(path, recursive=True) if Path(p).is_file()])
        else:
            files.append(LogFile(path))
    return files


def _found(path: str, names: list[str], within: str = "") -> list[LogFile]:
    """Return the logs among the names of the files that a path stands for.

    Of what is `within` a folder, none whose name, or that of a folder below, says to leave it.
    """

    def left(name: str) -> bool:
        below = name[len(within) :].strip("/").split("/") if within else [name.split("/")[-1]]
        return any(part.startswith((".", "_")) for part in below)

    logs = [n for n in sorted(names) if n.lower().endswith(ENDINGS) and not left(n)]
    if not logs:
        raise LogError(
            f"'{path}' holds "
            f"{so_many(len(names), 'file')}{', none of which ends' if names else ' that end'} "
            f"in {', '.join(ENDINGS)}, and at least 1 is needed: name the folder that holds the "
            f"logs."
        )
    return [LogFile(name, found=True) for name in logs]


def _at_address(path: str) -> list[LogFile]:
    """Return the logs at an address, which may be of one file, of a folder, or a pattern."""
    with _reaching(path):
        files, own = _filesystem(path)
        if has_magic(own):
            names = [files.unstrip_protocol(p) for p in files.glob(own) if files.isfile(p)]
            return _found(path, names)
        if files.isdir(own):
            names = [files.unstrip_protocol(p) for p in files.find(own)]
            return _found(path, names, files.unstrip_protocol(own))
    return [LogFile(path)]


def _filesystem(path: str) -> tuple[Any, str]:
    """Return the file system of an address, and the path in it."""
    from fsspec.core import url_to_fs

    files, own = url_to_fs(path)
    return files, str(own)


@contextmanager
def _reaching(path: str) -> Iterator[None]:
    """Say in one sentence what keeps an address out of reach.

    Each file system raises errors of its own kind, such as `ftplib.Error`.
    """
    try:
        yield
    except GreyboxError:
        raise
    except ImportError as error:
        raise UsageError(
            f"the address '{path}' needs a package that is not installed ({error}): install it "
            f"with pip, or copy the files to this machine and name their folder."
        ) from None
    except Exception as error:
        reason = " ".join(str(error).split())[:200].rstrip(".") or type(error).__name__
        raise LogError(
            f"'{path}' cannot be reached: {reason}. Correct the address, or copy the files to this "
            f"machine."
        ) from None


@contextmanager
def local_copy(path: str) -> Iterator[Path]:
    """Give the file on this machine: itself, or a copy that is deleted after the block.

    Raises
    ------
    LogError
        An address cannot be reached any more.
    """
    if not is_address(path):
        yield Path(path)
        return
    with tempfile.TemporaryDirectory(prefix="greybox-") as folder:
        with _reaching(path):
            files, own = _filesystem(path)
            copy = Path(folder) / PurePosixPath(own).name
            files.get_file(own, str(copy))
        yield copy
