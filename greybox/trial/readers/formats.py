"""Which reader reads a file: by its ending, then by its first bytes."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, cast

from greybox.errors import LogError
from greybox.files import nearest_file
from greybox.registry import entry_points
from greybox.trial.raw_log import Recording
from greybox.trial.readers.table import TableFile
from greybox.trial.readers.topic_files import as_topic

# third parties add theirs: an entry point named after the ending, without the dot
GROUP = "greybox.readers"

_KINDS = {
    ".csv": "csv", ".txt": "csv", ".tsv": "csv", ".dat": "csv", "": "csv",
    ".parquet": "parquet", ".pq": "parquet",
    ".nmea": "nmea", ".nmea0183": "nmea", ".log": "nmea", ".mat": "mat", ".bag": "ros",
    ".mcap": "ros", ".db3": "ros",
}  # fmt: skip
_READ = {"nmea": "nmea.read_nmea", "mat": "mat.read_mat", "ros": "ros.read.read_bag"}
# packages of the extra 'ros', by the name that they are imported by
_ROS_PACKAGES = {
    "rosbags": "rosbags", "mcap": "mcap", "lz4": "lz4", "zstandard": "zstandard",
    "ruamel": "ruamel.yaml",
}  # fmt: skip
_MAGIC = (
    (b"PAR1", "parquet"),
    (b"#ROSBAG", "ros"),
    (b"\x89MCAP", "ros"),
    (b"MATLAB 5.0 MAT-file", "mat"),
    (b"MATLAB 7.3 MAT-file", "mat"),
    (b"\x89HDF\r\n\x1a\n", "mat"),
    (b"SQLite format 3", "ros"),
)
_ZSTD = b"\x28\xb5\x2f\xfd"
_REFUSED = (
    (b"PK\x03\x04", "a zip archive (a spreadsheet?)"),
    (b"PK\x05\x06", "an empty zip archive"),
    (b"\x1f\x8b", "compressed by gzip"),
    (b"BZh", "compressed by bzip2"),
    (b"\xfd7zXZ", "compressed by xz"),
    (_ZSTD, "compressed by zstd"),
    (b"7z\xbc\xaf", "a 7z archive"),
    (b"Rar!", "a RAR archive"),
    (b"\xd0\xcf\x11\xe0", "an old spreadsheet or document"),
    (b"\x93NUMPY", "a NumPy array"),
    (b"%PDF", "a PDF"),
)
# what may run code when it is opened, or holds none of the formats whatever its first bytes
_REFUSED_ENDINGS = {
    ".pkl": "a Python pickle", ".pickle": "a Python pickle", ".p": "a Python pickle",
    ".joblib": "a Python pickle", ".npy": "a NumPy array", ".npz": "a NumPy archive",
    ".xls": "a spreadsheet", ".xlsx": "a spreadsheet", ".ods": "a spreadsheet",
    ".zip": "a zip archive", ".gz": "compressed by gzip",
}  # fmt: skip


# protocols 0 and 1 are text: a mark and a list, a dictionary, or a name to import
_OLD_PICKLE = re.compile(rb"\((dp|lp|i|c)\w|[\]}]q\0|c[\w.]+\n[\w.]+\n")


def open_raw(path: str | Path, **options: Any) -> Recording | TableFile:
    """Open a raw file with the reader for its format.

    Parameters
    ----------
    path : str or Path
        CSV, Parquet, MATLAB, NMEA 0183, ROS 1 or 2 bag, MCAP.
    **options
        Handed to the reader, such as ``topics`` of a bag.

    Returns
    -------
    Recording or TableFile
        A table where the format is one, so that its rows may be streamed.

    Raises
    ------
    LogError
        There is no such file, it is empty, or of no known format; or its format is that
        of an extra that is not installed.
    """
    path = Path(path)
    kind = _kind(path)
    if kind in ("csv", "parquet"):
        module = import_module(f"greybox.trial.readers.{kind}")
        return as_topic(cast(TableFile, getattr(module, f"open_{kind}")(path)))
    if kind in _READ:
        given = options if kind == "ros" else {}
        return cast(Recording, _reader(kind, path)(path, **given))
    found = {e.name: e for e in entry_points(group=GROUP)}
    return cast(Recording, found[kind].load()(path))


def _reader(kind: str, path: Path) -> Callable[..., Any]:
    """Return the function that reads a kind of file; its packages may not be installed."""
    module, _, function = _READ[kind].rpartition(".")
    try:
        found = import_module(f"greybox.trial.readers.{module}")
    except ModuleNotFoundError as error:
        package = _ROS_PACKAGES.get((error.name or "").partition(".")[0])
        if kind != "ros" or package is None:
            raise
        raise LogError(
            f"'{path.name}' is a ROS bag or MCAP file, and the package '{package}' that such files "
            f"need is not installed: run pip install 'greybox-marine[ros]'."
        ) from None
    return cast(Callable[..., Any], getattr(found, function))


def is_bag(folder: Path) -> bool:
    """Whether a folder is a bag of ROS 2."""
    return (folder / "metadata.yaml").exists()


def has_topics(path: str | Path) -> bool:
    """Whether a raw file is a bag, or an MCAP file, whose topics can be chosen.

    Raises
    ------
    LogError
        As `open_raw`.
    """
    return _kind(Path(path)) == "ros"


def _kind(path: Path) -> str:
    try:
        there = path.exists()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise LogError(f"cannot read '{str(path)[:80]}': {reason}. Name an existing log.") from None
    if not there:
        if all(Path(part).is_file() for part in str(path).split(",")):
            raise LogError(f"there is no file '{path}': separate the files with spaces.")
        raise LogError(f"there is no file '{path}'.{nearest_file(path)} Name an existing log.")
    if path.is_dir():
        if is_bag(path):
            return "ros"
        raise LogError(f"'{path}' is a folder without a ROS 2 bag: name the files in it.")
    if not stat.S_ISREG(os.stat(path).st_mode):
        raise LogError(f"'{path}' is a device or a pipe: save the log to a file first.")
    try:
        with open(path, "rb") as handle:
            head = handle.read(4096)
    except OSError as error:
        raise LogError(f"cannot read '{path.name}': {error.strerror}. Check its rights.") from None
    if not head:
        raise LogError(f"'{path.name}' is empty (0 bytes): name a log with samples.")
    suffix = path.suffix.lower()
    if suffix.lstrip(".") in {e.name for e in entry_points(group=GROUP)}:
        return suffix.lstrip(".")
    for magic, kind in _MAGIC:
        if head.startswith(magic):
            return kind
    if head.startswith(_ZSTD) and {".db3", ".mcap"} & set(path.suffixes):
        return "ros"
    refused = next((what for magic, what in _REFUSED if head.startswith(magic)), None)
    if refused is None and _is_pickle(head):
        refused = "a Python pickle"
    refused = refused or _REFUSED_ENDINGS.get(suffix)
    if refused is not None:
        raise LogError(
            f"'{path.name}' is {refused}, not a log: unpack or export it as CSV, Parquet, MAT, "
            f"NMEA 0183, a ROS bag or MCAP."
        )
    from greybox.trial.readers.nmea import looks_like_nmea

    if looks_like_nmea(head):
        return "nmea"
    kind = _KINDS.get(suffix, "")
    if kind in ("parquet", "ros", "mat") and (kind != "mat" or b"\0" not in head[:4]):
        # a version 4 MATLAB file has no magic, only small integers
        return kind
    if kind == "nmea" and b"$" not in head:
        kind = "csv"
    if not kind and suffix == ".json" and path.with_suffix("").is_file():
        raise LogError(
            f"'{path.name}' is the record of '{path.stem}', not a log: name the logs alone, such "
            f"as *{path.with_suffix('').suffix}."
        )
    if not kind:
        known = sorted(filter(None, _KINDS))
        raise LogError(
            f"'{path.name}' ends in '{suffix}', which is no known format of logs: "
            f"use one of {', '.join(known)}."
        )
    return kind


def _is_pickle(head: bytes) -> bool:
    return (head[0] == 0x80 and head[1:2] in (b"\2", b"\3", b"\4", b"\5")) or bool(
        _OLD_PICKLE.match(head)
    )
