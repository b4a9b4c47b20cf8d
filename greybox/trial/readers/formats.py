"""Which reader reads a file: by its ending, then by its first bytes."""

from __future__ import annotations

import os
import stat
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, cast

from greybox.errors import LogError, suggestion
from greybox.trial.readers.table import TableFile
from greybox.trial.recording import Recording

# third parties add theirs: an entry point named after the ending, without the dot
GROUP = "greybox.readers"

_TABLES = {
    ".csv": "csv", ".txt": "csv", ".tsv": "csv", ".dat": "csv", "": "csv",
    ".parquet": "parquet", ".pq": "parquet",
}  # fmt: skip
_RECORDINGS = {
    ".nmea": "nmea", ".nmea0183": "nmea", ".log": "nmea", ".mat": "mat", ".bag": "ros",
    ".mcap": "ros", ".db3": "ros",
}  # fmt: skip
_READ = {"nmea": "read_nmea", "mat": "read_mat", "ros": "read_bag"}
_MAGIC = (
    (b"PAR1", "parquet", "Parquet"),
    (b"#ROSBAG", "ros", "a ROS bag"),
    (b"\x89MCAP", "ros", "MCAP"),
    (b"MATLAB 5.0 MAT-file", "mat", "a MATLAB file"),
    (b"MATLAB 7.3 MAT-file", "mat", "a MATLAB file"),
    (b"\x89HDF\r\n\x1a\n", "mat", "a MATLAB 7.3 file"),
    (b"SQLite format 3", "ros", "a ROS 2 database"),
)
_REFUSED = (
    (b"PK\x03\x04", "a zip archive (a spreadsheet?)"),
    (b"\x1f\x8b", "compressed by gzip"),
    (b"\x80\x04\x95", "a Python pickle"),
    (b"\x80\x05\x95", "a Python pickle"),
    (b"\x80\x03", "a Python pickle"),
    (b"%PDF", "a PDF"),
)


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
        There is no such file, it is empty, or of no known format.
    """
    path = Path(path)
    kind = _kind(path)
    if kind in ("csv", "parquet"):
        module = import_module(f"greybox.trial.readers.{kind}")
        return cast(TableFile, getattr(module, f"open_{kind}")(path))
    if kind in _READ:
        module = import_module(f"greybox.trial.readers.{kind}")
        given = options if kind == "ros" else {}
        return cast(Recording, getattr(module, _READ[kind])(path, **given))
    found = {e.name: e for e in entry_points(group=GROUP)}
    return cast(Recording, found[kind].load()(path))


def _kind(path: Path) -> str:
    if not path.exists():
        beside = [p.name for p in path.parent.iterdir()] if path.parent.is_dir() else []
        raise LogError(
            f"there is no file '{path}'.{suggestion(path.name, beside)} Name an existing log."
        )
    if path.is_dir():
        if (path / "metadata.yaml").exists():
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
    for magic, kind, _ in _MAGIC:
        if head.startswith(magic):
            return kind
    for magic, what in _REFUSED:
        if head.startswith(magic):
            raise LogError(
                f"'{path.name}' is {what}, not a log: unpack or export it as CSV, Parquet, MAT, "
                f"NMEA 0183, a ROS bag or MCAP."
            )
    from greybox.trial.readers.nmea import looks_like_nmea

    if looks_like_nmea(head):
        return "nmea"
    kind = {**_TABLES, **_RECORDINGS}.get(suffix, "")
    if kind in ("parquet", "ros", "mat") and (kind != "mat" or b"\0" not in head[:4]):
        # a version 4 MATLAB file has no magic, only small integers
        return kind
    if kind == "nmea" and b"$" not in head:
        kind = "csv"
    if not kind:
        known = sorted(e for e in {**_TABLES, **_RECORDINGS} if e)
        raise LogError(
            f"'{path.name}' ends in '{suffix}', which is no known format of logs: "
            f"use one of {', '.join(known)}."
        )
    return kind
