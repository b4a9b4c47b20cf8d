"""ROS 1 bags, format 2.0, record by record."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import IO

from greybox.errors import LogError
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


def read_bag1(
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
