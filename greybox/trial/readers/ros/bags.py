"""Messages out of ROS bags and MCAP files, in bounded memory, read from the start.

The indices of the files are not used: a bag whose recorder was killed has
none, and an index is one more thing that a hostile file can lie about. Chunks
are inflated here and not by the libraries, which inflate whatever comes. A database
of a ROS 2 bag is a stranger's SQLite file, of which only plain tables are read.
"""

from __future__ import annotations

import re
import sqlite3
import struct
import tempfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path, PurePath
from typing import IO, Any
from urllib.parse import quote

from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from greybox.errors import LogError
from greybox.trial.readers.limits import limits
from greybox.trial.readers.ros.storage import (
    Budget,
    Channel,
    CutError,
    Message,
    Records,
    Wanted,
    inflate,
    inflate_file,
    inflate_zstd,
    normal_type,
    skip,
    take,
)

_MCAP_MAGIC = b"\x89MCAP0\r\n"
_SQLITE_MAGIC = b"SQLite format 3\0"


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
            key=lambda p: [
                (int(x), "") if x.isdigit() else (-1, x) for x in re.split(r"(\d+)", p.name)
            ],
        )
        if not information:
            notes.append("metadata.yaml is missing or unreadable: its files were found by name.")
    if not files:
        raise LogError(
            f"the directory '{path.name}' holds no .db3 or .mcap file: "
            f"name the directory of a ROS 2 bag, the one with metadata.yaml."
        )
    return files, mode, notes


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
                yield from _read_bag1(handle, budget, notes, wanted)
            elif magic.startswith(_MCAP_MAGIC):
                yield from _counted(_read_mcap(handle, budget, notes, wanted), mode, budget, notes)
            elif magic == _SQLITE_MAGIC:
                yield from _counted(_read_database(path, budget, wanted), mode, budget, notes)
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


def _fields(header: bytes) -> dict[str, bytes]:
    fields: dict[str, bytes] = {}
    position = 0
    while position + 4 <= len(header):
        (size,) = struct.unpack_from("<I", header, position)
        name, equals, value = header[position + 4 : position + 4 + size].partition(b"=")
        if not equals or position + 4 + size > len(header):
            raise CutError("holds a record header that makes no sense")
        fields[name.decode("ascii", "replace")] = value
        position += 4 + size
    return fields


def _number(fields: dict[str, bytes], name: str, layout: str = "<I") -> int:
    value = fields.get(name, b"")
    if len(value) != struct.calcsize(layout):
        raise CutError(f"holds a record without '{name}'")
    return int(struct.unpack(layout, value)[0])


def _read_bag1(
    handle: IO[bytes], budget: Budget, notes: list[str], wanted: Wanted
) -> Iterator[Message]:
    """Yield the messages of a ROS 1 bag, as `Records.read` does.

    Raises
    ------
    LogError
        It is of another version, or encrypted.
    """
    line = handle.readline(32)
    if line.strip() != b"#ROSBAG V2.0":
        raise LogError(
            f"'{budget.name}' is a bag of format {line.strip().decode('ascii', 'replace')!r}, "
            f"only 2.0 is read: convert it with 'rosbag migrate'."
        )
    yield from _Bag(budget, notes, wanted).read(handle)


class _Bag(Records):
    def records(self, stream: IO[bytes], end: int, *, top: bool) -> Iterator[Message]:
        while stream.tell() < end:
            (size,) = struct.unpack("<I", take(stream, 4, end))
            fields = _fields(take(stream, size, end))
            (length,) = struct.unpack("<I", take(stream, 4, end))
            kind = fields.get("op", b"")[:1]
            if kind == b"\x02":
                channel = self.channels.get(_number(fields, "conn"))
                seconds, nanos = divmod(_number(fields, "time", "<Q"), 2**32)[::-1]
                data = take(stream, length, end)
                if channel is not None and self.wanted(channel.topic):
                    self.budget.message()
                    yield channel, seconds * 10**9 + nanos, data
            elif kind == b"\x07":
                self._connection(fields, take(stream, length, end))
            elif kind == b"\x05" and top:
                yield from self._chunk(stream, fields, length, end)
            elif kind == b"\x03" and fields.get("encryptor"):
                raise LogError(
                    f"'{self.budget.name}' is encrypted: decrypt it with 'rosbag decrypt' first."
                )
            elif kind in (b"\x03", b"\x04", b"\x06"):
                skip(stream, length, end)
            else:
                raise CutError(f"holds a record of no known kind at byte {stream.tell()}")

    def _chunk(
        self, stream: IO[bytes], fields: dict[str, bytes], length: int, end: int
    ) -> Iterator[Message]:
        start = stream.tell()
        data = take(stream, min(length, end - start), end)
        compression = fields.get("compression", b"none").decode("ascii", "replace")
        content = inflate(data, compression, _number(fields, "size"), self.budget)
        yield from self.inside(content, start, start + length, end)

    def _connection(self, fields: dict[str, bytes], data: bytes) -> None:
        number = _number(fields, "conn")
        if number in self.channels:
            return
        inner = _fields(data)
        self.channels[number] = Channel(
            fields.get("topic", b"").decode("utf-8", "replace"),
            normal_type(inner.get("type", b"").decode("utf-8", "replace")),
            "ros1",
            inner.get("message_definition", b"").decode("utf-8", "replace"),
        )


@dataclass
class _Mcap(Records):
    schemas: dict[int, tuple[str, str, str]] = field(default_factory=dict)

    def records(self, stream: IO[bytes], end: int, *, top: bool) -> Iterator[Message]:
        while stream.tell() < end:
            kind, length = struct.unpack("<BQ", take(stream, 9, end))
            if kind == Opcode.MESSAGE:
                if length < 22:
                    raise CutError(f"holds a message record of {length} bytes")
                number, _, time, _ = struct.unpack("<HIQQ", take(stream, 22, end))
                channel = self.channels.get(number)
                if channel is None or not self.wanted(channel.topic):
                    skip(stream, length - 22, end)
                    continue
                data = take(stream, length - 22, end)
                self.budget.message()
                yield channel, min(time, 2**63 - 1), data
            elif kind in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._declare(kind == Opcode.SCHEMA, take(stream, length, end))
            elif kind == Opcode.CHUNK and top:
                yield from self._chunk(stream, length, end)
            elif kind == Opcode.DATA_END:
                return
            elif kind == 0:
                raise CutError(f"holds a record of no known kind at byte {stream.tell()}")
            else:
                skip(stream, length, end)
        if top:
            raise CutError(f"ends at byte {end} without an end record")

    def _declare(self, schema: bool, content: bytes) -> None:
        stream = ReadDataStream(BytesIO(content))
        try:
            if schema:
                s = records.Schema.read(stream)
                text = s.data.decode("utf-8", "replace")
                self.schemas.setdefault(s.id, (s.name, s.encoding, text))
                return
            c = records.Channel.read(stream)
        except (McapError, struct.error, ValueError) as error:
            raise CutError(f"holds a damaged declaration ({error})") from None
        name, language, text = self.schemas.get(c.schema_id, ("", "", ""))
        language = "msg" if language in ("ros1msg", "ros2msg") else language
        self.channels.setdefault(
            c.id, Channel(c.topic, normal_type(name), c.message_encoding, text, language)
        )

    def _chunk(self, stream: IO[bytes], length: int, end: int) -> Iterator[Message]:
        start = stream.tell()
        whole = start + length <= end
        content = take(stream, min(length, end - start), end)
        if len(content) < 32:
            raise CutError(f"ends inside the chunk at byte {start}")
        stated, crc, named = struct.unpack_from("<QII", content, 16)
        data = content[32 + named + 8 :]
        kind = content[32 : 32 + named].decode("ascii", "replace")
        if whole:
            (held,) = struct.unpack_from("<Q", content.ljust(40 + named, b"\0"), 32 + named)
            data = data[:held]
        raw = inflate(data, kind, stated, self.budget)
        sound = whole and len(raw) == stated and (not crc or zlib.crc32(raw) == crc)
        yield from self.inside(raw, start, start + length, end, sound=sound)


def _read_mcap(
    handle: IO[bytes], budget: Budget, notes: list[str], wanted: Wanted
) -> Iterator[Message]:
    """Yield the messages of an MCAP file, as `Records.read` does."""
    handle.seek(len(_MCAP_MAGIC))
    yield from _Mcap(budget, notes, wanted).read(handle)


def _read_database(path: Path, budget: Budget, wanted: Wanted) -> Iterator[Message]:
    """Yield the messages of a database in the order of its table.

    Parameters
    ----------
    path : Path
    budget : Budget
        Charged with all that is read.
    wanted : callable
        Whether the messages of a topic are needed.

    Raises
    ------
    CutError
        The database is damaged.
    LogError
        It cannot be opened, holds no plain tables of a bag, or exceeds the budget.
    """
    try:
        database = sqlite3.connect(
            f"file:{quote(str(path.resolve()))}?mode=ro&immutable=1", uri=True
        )
    except sqlite3.Error as error:
        raise LogError(f"cannot open '{budget.name}' ({error}): copy the file again.") from None
    try:
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, limits().held_bytes)
        database.text_factory = lambda raw: raw.decode("utf-8", "replace")
        channels = _tables(database, budget)
        chosen = [n for n, c in channels.items() if wanted(c.topic)]
        marks = ",".join("?" * len(chosen))
        rows = database.execute(
            f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks})", chosen
        )
        for number, time, data in rows:
            if isinstance(time, int) and isinstance(data, bytes):
                budget.charge(len(data))
                budget.message()
                yield channels[number], time, data
    except (sqlite3.Error, TypeError, ValueError) as error:
        if isinstance(error, LogError):
            raise
        raise CutError(f"is a damaged database ({error})") from None
    finally:
        database.close()


def _tables(database: sqlite3.Connection, budget: Budget) -> dict[int, Channel]:
    """Return the channels by number, once the tables are known to be plain tables."""
    database.execute("PRAGMA trusted_schema=OFF")
    database.execute("PRAGMA cell_size_check=ON")
    made = dict(database.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'"))
    # a view, a virtual table or a computed column runs the stranger's SQL
    for name in ("topics", "messages", "message_definitions"):
        sql = made.get(name)
        if sql is None and name == "message_definitions":
            continue
        if sql is None or re.search(r"\bVIRTUAL\b|\bAS\b", str(sql), re.IGNORECASE):
            raise LogError(
                f"'{budget.name}' is a database without a plain table '{name}', so it is no "
                f"rosbag2 storage: name a .db3 file of a bag."
            )
    definitions: dict[str, tuple[str, str]] = {}
    if "message_definitions" in made:
        for kind, language, text in database.execute(
            "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        ):
            definitions[str(kind)] = (str(text), "msg" if language == "ros2msg" else str(language))
    return {
        int(number): Channel(
            str(topic), normal_type(str(kind)), str(encoding), *definitions.get(str(kind), ("",))
        )
        for number, topic, kind, encoding in database.execute(
            "SELECT id, name, type, serialization_format FROM topics"
        )
    }
