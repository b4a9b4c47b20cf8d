"""Messages out of ROS bags and MCAP files, in bounded memory, read from the start.

The indices of the files are not used: a bag whose recorder was killed has
none, and an index is one more thing that a hostile file can lie about. Chunks
are inflated here and not by the libraries, which inflate whatever comes.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator
from pathlib import Path, PurePath
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from greybox.errors import LogError
from greybox.trial.readers.limits import limits
from greybox.trial.readers.ros.formats import (
    MCAP_MAGIC,
    SQLITE_MAGIC,
    read_bag1,
    read_database,
    read_mcap,
)
from greybox.trial.readers.ros.storage import (
    Budget,
    CutError,
    Message,
    Wanted,
    inflate_file,
    inflate_zstd,
)


def storage_files(path: Path) -> tuple[list[Path], str, list[str]]:
    """Return the files of a bag in their order, the compression mode, and notes.

    Parameters
    ----------
    path : Path
        A file, or the directory of a ROS 2 bag.

    Returns
    -------
    tuple of list of Path, str, list of str
        The mode is ``""``, ``"file"`` or ``"message"``.

    Raises
    ------
    LogError
        There is nothing there, or no storage file in the directory.
    """
    if not path.exists():
        raise LogError(f"there is no file '{path}': name an existing bag.")
    if not path.is_dir():
        return [path], "file" if path.suffix in (".zstd", ".zst") else "", []
    notes: list[str] = []
    metadata = path / "metadata.yaml"
    information = _metadata(metadata) if metadata.is_file() else {}
    mode = str(information.get("compression_mode") or "").lower()
    mode = mode if mode in ("file", "message") else ""
    listed = information.get("relative_file_paths")
    # names only: the file of a stranger must not point outside its directory
    names = [PurePath(str(n)).name for n in listed] if isinstance(listed, list) else []
    files = [path / n for n in names if (path / n).is_file()]
    if len(files) < len(names):
        missing = next(n for n in names if not (path / n).is_file())
        notes.append(
            f"{len(names) - len(files)} of the {len(names)} files that metadata.yaml names are "
            f"missing, '{missing}' first; the others were read."
        )
    if not files:
        found = [
            p
            for p in path.iterdir()
            if re.fullmatch(r".*\.(db3|mcap)(\.zstd?)?", p.name) and p.is_file()
        ]
        files = sorted(
            found,
            key=lambda p: [(int(x), "") if x.isdigit() else (-1, x) for x in _digits(p.name)],
        )
        if not information:
            notes.append("metadata.yaml is missing or unreadable: its files were found by name.")
    if not files:
        raise LogError(
            f"the directory '{path.name}' holds no .db3 or .mcap file: "
            f"name the directory of a ROS 2 bag, the one with metadata.yaml."
        )
    return files, mode, notes


def _digits(name: str) -> list[str]:
    return re.split(r"(\d+)", name)


def _metadata(path: Path) -> dict[str, Any]:
    if path.stat().st_size > limits().sidecar_bytes:
        return {}
    try:
        tree = YAML(typ="safe", pure=True).load(path.read_text(encoding="utf-8"))
        information = tree["rosbag2_bagfile_information"]
    # values that their tags or spelling promise and that do not convert raise Python's own;
    # whatever is wrong with it, the files can be found without it
    except (
        YAMLError, OSError, ValueError, LookupError, TypeError, ArithmeticError, AssertionError,
        RecursionError,
    ):  # fmt: skip
        return {}
    return information if isinstance(information, dict) else {}


def read_messages(
    path: Path, mode: str, budget: Budget, notes: list[str], wanted: Wanted
) -> Iterator[Message]:
    """Yield the messages of one storage file in the order of the file.

    Parameters
    ----------
    path : Path
        ROS 1 bag, SQLite database of a ROS 2 bag, or MCAP, told apart by content.
    mode : str
        Compression of the ROS 2 bag: ``""``, ``"file"`` or ``"message"``.
    budget : Budget
        Charged with all that is read.
    notes : list of str
        Receives what was skipped or recovered.
    wanted : callable
        Whether the messages of a topic are needed.

    Yields
    ------
    tuple of Channel, int, bytes
        Channel, time of the recorder [ns], serialized message.

    Raises
    ------
    LogError
        The file is none of these, is encrypted, or exceeds the budget.
    """
    before = budget.messages
    with open(path, "rb") as handle:
        magic = handle.read(16)
        handle.seek(0)
        if mode == "file" and magic[:4] == b"\x28\xb5\x2f\xfd":
            with tempfile.TemporaryDirectory() as folder:
                plain = Path(folder) / "storage"
                inflate_file(handle, plain, budget)
                yield from read_messages(plain, "", budget, notes, wanted)
            return
        try:
            if magic.startswith(b"#ROSBAG V"):
                yield from read_bag1(handle, budget, notes, wanted)
            elif magic.startswith(MCAP_MAGIC):
                yield from _counted(read_mcap(handle, budget, notes, wanted), mode, budget, notes)
            elif magic == SQLITE_MAGIC:
                yield from _counted(read_database(path, budget, wanted), mode, budget, notes)
            else:
                raise LogError(
                    f"'{budget.name}' is no ROS bag, MCAP or rosbag2 database "
                    f"(it begins with {magic[:8]!r}): name another file, or record it again."
                )
        except CutError as cut:
            if not budget.messages:
                raise LogError(
                    f"'{budget.name}' {cut} and no message stands before that: "
                    f"copy the file again, or name another."
                ) from None
            notes.append(
                f"'{budget.name}' {cut}: the {budget.messages - before} messages before it "
                f"were recovered."
            )


def _counted(
    messages: Iterator[Message], mode: str, budget: Budget, notes: list[str]
) -> Iterator[Message]:
    bad = 0
    for channel, time, data in messages:
        if mode == "message":
            inflated = inflate_zstd(data, min(limits().held_bytes, budget.limit - budget.used) + 1)
            budget.charge(len(inflated))
            bad += not inflated
            yield channel, time, inflated
        else:
            yield channel, time, data
    if bad:
        notes.append(f"{bad} compressed messages of '{budget.name}' could not be inflated.")
