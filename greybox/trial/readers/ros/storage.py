"""What the storage formats of bags share: channels, a budget, records cut short."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import IO, Protocol

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


class Records(Protocol):
    """One format's reader of records: what it may read, and what it found damaged.

    Parameters
    ----------
    budget : Budget
        Charged with all that is read.
    notes : list of str
        Receives what was skipped or recovered.
    damaged : int
        Chunks that were read as far as they go.
    """

    budget: Budget
    notes: list[str]
    damaged: int

    def records(self, stream: IO[bytes], end: int, *, top: bool) -> Iterator[Message]:
        """Yield the messages from here to the byte `end`, those in chunks too at the top."""
        ...


def read_records(reader: Records, handle: IO[bytes]) -> Iterator[Message]:
    """Yield the messages of a file in its order, and note what was damaged.

    Parameters
    ----------
    reader : Records
        Of the file's format.
    handle : file
        Open for reading, past the mark of its format.

    Raises
    ------
    CutError
        The file ends too early, or stops making sense.
    LogError
        It exceeds the budget.
    """
    yield from reader.records(handle, file_size(handle), top=True)
    if reader.damaged:
        reader.notes.append(
            f"{reader.damaged} chunks of '{reader.budget.name}' are damaged or fail their "
            f"checksum; they were read as far as they go."
        )
