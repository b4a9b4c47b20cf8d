"""MCAP files, record by record."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import IO

from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from greybox.trial.readers.ros.storage import (
    Budget,
    Channel,
    CutError,
    Message,
    Records,
    Wanted,
    inflate,
    normal_type,
    skip,
    take,
)

MAGIC = b"\x89MCAP0\r\n"


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


def read_mcap(
    handle: IO[bytes], budget: Budget, notes: list[str], wanted: Wanted
) -> Iterator[Message]:
    """Yield the messages of an MCAP file, as `Records.read` does."""
    handle.seek(len(MAGIC))
    yield from _Mcap(budget, notes, wanted).read(handle)
