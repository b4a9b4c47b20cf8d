"""What the storage formats of bags share: channels, a budget, records cut short, compression.

What bags hold compressed is checked before and after it is inflated, never as a whole unasked.
"""

from __future__ import annotations

import bz2
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO

import lz4.frame
import zstandard

from greybox.errors import LogError
from greybox.trial.readers.limits import limits


@dataclass(frozen=True)
class Channel:
    """One topic as one writer declared it.

    Parameters
    ----------
    topic : str
    msgtype : str
        As ROS 2 spells it: ``sensor_msgs/msg/Imu``.
    encoding : str
        Of the messages: ``ros1``, ``cdr``, ``json`` or another.
    definition : str
        Text of the message definition, empty where the file holds none.
    definition_format : str
        ``msg`` for the language of ROS, else the name of another one.
    """

    topic: str
    msgtype: str
    encoding: str
    definition: str = ""
    definition_format: str = "msg"


@dataclass
class Budget:
    """How much may still be inflated and read, so that no file exhausts the machine.

    Parameters
    ----------
    name : str
        File, for the messages.
    size : int
        Its size [bytes]: large files may hold more.
    """

    name: str
    size: int
    used: int = 0
    messages: int = 0

    @property
    def limit(self) -> int:
        """Bytes that may be inflated in all."""
        return max(limits().unpacked_bytes, limits().unpacked_ratio * self.size)

    def charge(self, count: int) -> None:
        """Count `count` bytes before they are made.

        Raises
        ------
        LogError
            More than a chunk or the whole file may hold.
        """
        if count > (most := limits().held_bytes):
            raise LogError(
                f"'{self.name}' holds a chunk of {count} bytes, at most {most} are read: "
                f"write it again with smaller chunks, or leave out cameras and lidars."
            )
        self.used += count
        if self.used > self.limit:
            raise LogError(
                f"'{self.name}' ({self.size} bytes) inflates to more than {self.limit} bytes: "
                f"filter the topics that are needed into a bag of their own."
            )

    def message(self) -> None:
        """Count one message.

        Raises
        ------
        LogError
            There are more than `Limits.messages`.
        """
        self.messages += 1
        if self.messages > (most := limits().messages):
            raise LogError(
                f"'{self.name}' holds more than {most} messages: "
                f"name the topics that are needed, or split the bag."
            )


Message = tuple[Channel, int, bytes]
Wanted = Callable[[str], bool]


class CutError(Exception):
    """The file ends, or stops making sense, at some byte."""


def take(stream: IO[bytes], count: int, end: int) -> bytes:
    """Return the next bytes of a file.

    Raises
    ------
    CutError
        There are not so many before `end`, or no record may be so large.
    """
    start = stream.tell()
    if start + count > end:
        raise CutError(f"ends at byte {end} inside a record that begins before byte {start}")
    if count > limits().held_bytes:
        raise CutError(f"states a record of {count} bytes at byte {start}")
    data = stream.read(count)
    if len(data) != count:
        raise CutError(f"ends inside the record at byte {start}")
    return data


def file_size(stream: IO[bytes]) -> int:
    """Return the size of a file [bytes] and leave it where it was."""
    position = stream.tell()
    end = stream.seek(0, os.SEEK_END)
    stream.seek(position)
    return end


def skip(stream: IO[bytes], count: int, end: int) -> None:
    """Go past the next bytes of a file.

    Raises
    ------
    CutError
        There are not so many before `end`.
    """
    start = stream.tell()
    if start + count > end:
        raise CutError(f"ends at byte {end} inside a record that begins before byte {start}")
    stream.seek(start + count)


def normal_type(name: str) -> str:
    """Return the name of a message type as ROS 2 spells it."""
    parts = name.split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else name


@dataclass
class Records(ABC):
    """One format's reader of records: what it may read, and what it found damaged.

    Parameters
    ----------
    budget : Budget
        Charged with all that is read.
    notes : list of str
        Receives what was skipped or recovered.
    wanted : callable
        Whether the messages of a topic are needed.
    channels : dict of int to Channel
        Those that were declared so far.
    damaged : int
        Chunks that were read as far as they go.
    """

    budget: Budget
    notes: list[str]
    wanted: Wanted
    channels: dict[int, Channel] = field(default_factory=dict)
    damaged: int = 0

    @abstractmethod
    def records(self, stream: IO[bytes], end: int, *, top: bool) -> Iterator[Message]:
        """Yield the messages from here to the byte `end`, those in chunks too at the top."""

    def read(self, handle: IO[bytes]) -> Iterator[Message]:
        """Yield the messages of a file in its order, and note what was damaged.

        Parameters
        ----------
        handle : file
            Open for reading, past the mark of its format.

        Raises
        ------
        CutError
            The file ends too early, or stops making sense.
        LogError
            It exceeds the budget.
        """
        yield from self.records(handle, file_size(handle), top=True)
        if self.damaged:
            self.notes.append(
                f"{self.damaged} chunks of '{self.budget.name}' are damaged or fail their "
                f"checksum; they were read as far as they go."
            )

    def inside(
        self, content: bytes, start: int, stop: int, end: int, *, sound: bool = True
    ) -> Iterator[Message]:
        """Yield the messages of a chunk at `start` to `stop`, as far as these or the file go."""
        try:
            yield from self.records(BytesIO(content), len(content), top=False)
        except CutError:
            sound = False
        if stop > end:
            raise CutError(f"ends at byte {end} inside the chunk at byte {start}")
        self.damaged += not sound


def inflate_zstd(data: bytes, limit: int) -> bytes:
    """Return at most `limit` bytes; what comes before the damage where there is some."""
    inflater = zstandard.ZstdDecompressor(max_window_size=limits().window_bytes)
    parts: list[bytes] = []
    try:
        with inflater.stream_reader(data, read_across_frames=True) as stream:
            # in blocks, for what is asked for is allocated whether it comes or not
            while limit and (part := stream.read(min(limit, limits().block_bytes))):
                parts.append(part)
                limit -= len(part)
    except zstandard.ZstdError:
        pass
    return b"".join(parts)


def inflate_file(source: IO[bytes], target: Path, budget: Budget) -> None:
    """Inflate a file that zstd compressed as a whole.

    Raises
    ------
    LogError
        It is damaged, or exceeds the budget.
    """
    inflater = zstandard.ZstdDecompressor(max_window_size=limits().window_bytes)
    try:
        with inflater.stream_reader(source, closefd=False) as stream, open(target, "wb") as sink:
            while block := stream.read(limits().block_bytes):
                budget.charge(len(block))
                sink.write(block)
    except zstandard.ZstdError as error:
        raise LogError(
            f"'{budget.name}' is zstd-compressed and damaged ({error}): "
            f"copy the file again, or name another."
        ) from None


def inflate(data: bytes, kind: str, stated: int, budget: Budget) -> bytes:
    """Return a chunk's content: what the file states is checked before and after.

    Parameters
    ----------
    data : bytes
    kind : str
        ``lz4``, ``bz2``, ``zstd``, ``none`` or empty.
    stated : int
        Bytes that the file says it inflates to.
    budget : Budget

    Raises
    ------
    LogError
        The compression is not known, or there is more than stated or allowed.
    """
    if kind in ("none", ""):
        return data
    if kind not in ("lz4", "bz2", "zstd"):
        raise LogError(
            f"'{budget.name}' is compressed with '{kind}', which is not read "
            f"(lz4, bz2, zstd and none are): write it again without compression."
        )
    budget.charge(stated)
    limit = stated + 1
    try:
        if kind == "lz4":
            raw = bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=limit))
        elif kind == "bz2":
            raw = bz2.BZ2Decompressor().decompress(data, max_length=limit)
        else:
            raw = inflate_zstd(data, limit)
    # lz4 and bz2 say damaged data in their own ways
    except (RuntimeError, OSError, ValueError, EOFError):
        return b""
    if len(raw) > stated:
        raise LogError(
            f"'{budget.name}' holds a chunk that inflates to more than the {stated} bytes that "
            f"it states: the file is damaged or hostile, record or copy it again."
        )
    return raw
