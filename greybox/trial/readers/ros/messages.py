"""Decoding ROS messages from their definitions, as data and never as code.

The libraries generate Python source from the definitions inside the file and
execute it; here a definition is interpreted, so a hostile one can at worst
describe a message that does not fit its bytes.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

from greybox.trial.readers.limits import limits
from greybox.trial.readers.ros.storage import Channel

_LAYOUTS = {
    "bool": "?", "byte": "B", "char": "B", "octet": "B",
    "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I",
    "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip

Decoded = dict[str, Any]


class DecodeError(Exception):
    """The definition is unusable, or the bytes do not fit it."""


class Long:
    """Stands for an array that is too long to become signals."""

    def __init__(self, length: int) -> None:
        self.length = length


class _Cursor:
    __slots__ = ("data", "end", "origin", "pos", "steps")

    def __init__(self, data: bytes, pos: int) -> None:
        self.data, self.pos, self.origin, self.end = data, pos, pos, len(data)
        self.steps = 0

    def step(self) -> None:
        # a type without content costs no bytes, so bytes alone bound nothing
        self.steps += 1
        if self.steps > self.end + 1000:
            raise DecodeError("more elements than bytes")


_Read = Callable[[_Cursor], Any]


def decoder(channel: Channel) -> Callable[[bytes], Decoded]:
    """Return the function that decodes the messages of a channel.

    Parameters
    ----------
    channel : Channel

    Returns
    -------
    callable
        Bytes to a nested dictionary of fields; arrays longer than
        `Limits.elements` are `Long`. It raises `DecodeError`.

    Raises
    ------
    DecodeError
        There is no usable definition, with the reason.
    """
    if channel.encoding == "json":
        return _json
    if channel.encoding not in ("ros1", "cdr"):
        raise DecodeError(f"its encoding '{channel.encoding}' is not read")
    types = _definitions(channel)
    if channel.msgtype not in types:
        raise DecodeError(f"there is no definition of '{channel.msgtype}'")
    if channel.encoding == "ros1":
        read = _Compiler(types, "<", cdr=False).message(channel.msgtype)
        return lambda data: _run(read, data, 0)
    little = _Compiler(types, "<", cdr=True).message(channel.msgtype)
    big = _Compiler(types, ">", cdr=True).message(channel.msgtype)

    def decode(data: bytes) -> Decoded:
        if data[:2] not in (b"\0\0", b"\0\1") or len(data) < 4:
            raise DecodeError("its CDR representation is not the plain one")
        return _run(little if data[1] else big, data, 4)

    return decode


def _run(read: _Read, data: bytes, start: int) -> Decoded:
    try:
        message: Decoded = read(_Cursor(data, start))
    except (struct.error, RecursionError) as error:
        raise DecodeError(str(error)) from None
    return message


def _json(data: bytes) -> Decoded:
    try:
        message = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise DecodeError(f"no valid JSON: {error}") from None
    if not isinstance(message, dict):
        raise DecodeError("its JSON is no object")
    return message


def _definitions(channel: Channel) -> dict[str, list[tuple[str, Any]]]:
    store = Stores.ROS1_NOETIC if channel.encoding == "ros1" else Stores.ROS2_HUMBLE
    types = {name: fields for name, (_, fields) in get_typestore(store).fielddefs.items()}
    text = channel.definition
    if not text or channel.definition_format != "msg":
        return types
    if len(text) > limits().definition_bytes:
        raise DecodeError(f"its definition has {len(text)} characters")
    try:
        own = get_types_from_msg(text, channel.msgtype)
    # lists as constants trip an assertion, numbers of thousands of digits Python itself
    except (TypesysError, AssertionError, ValueError) as error:
        raise DecodeError(f"its definition cannot be parsed ({type(error).__name__})") from None
    return types | {name: fields for name, (_, fields) in own.items()}


class _Compiler:
    """Turns definitions into functions that read one value each."""

    def __init__(self, types: dict[str, list[tuple[str, Any]]], order: str, *, cdr: bool) -> None:
        self.types, self.order, self.cdr = types, order, cdr
        self.made: dict[str, _Read] = {}
        self.length = self._scalar("uint32")

    def message(self, name: str, above: tuple[str, ...] = ()) -> _Read:
        if name in self.made:
            return self.made[name]
        if name in above or len(above) > limits().depth:
            raise DecodeError(f"'{name}' contains itself or is nested too deep")
        if name not in self.types:
            raise DecodeError(f"there is no definition of '{name}'")
        fields = [(f, self._field(d, (*above, name))) for f, d in self.types[name]]
        if not fields and self.cdr:
            # CDR has no empty structure: ROS 2 sends one byte
            fields = [("structure_needs_at_least_one_member", self._scalar("uint8"))]

        def read(c: _Cursor) -> Decoded:
            c.step()
            return {f: value(c) for f, value in fields}

        self.made[name] = read
        return read

    def _field(self, description: Any, above: tuple[str, ...]) -> _Read:
        kind, inner = description
        if kind == Nodetype.BASE:
            return self._string() if inner[0] == "string" else self._scalar(inner[0])
        if kind == Nodetype.NAME:
            return self.message(inner, above)
        element, count = inner
        fixed = count if kind == Nodetype.ARRAY else None
        if element[0] == Nodetype.BASE and element[1][0] != "string":
            return self._numbers(element[1][0], fixed)
        return self._sequence(self._field(element, above), fixed)

    def _scalar(self, name: str) -> _Read:
        if name not in _LAYOUTS:
            raise DecodeError(f"the type '{name}' is not read")
        layout = struct.Struct(self.order + _LAYOUTS[name])
        size, unpack = layout.size, layout.unpack_from
        mask = size - 1 if self.cdr else 0

        def read(c: _Cursor) -> Any:
            pos = c.pos + (-(c.pos - c.origin) & mask)
            c.pos = pos + size
            return unpack(c.data, pos)[0]

        return read

    def _string(self) -> _Read:
        length, cdr, most = self.length, self.cdr, limits().text

        def read(c: _Cursor) -> str:
            size = length(c)
            start = c.pos
            if start + size > c.end:
                raise DecodeError(f"a text of {size} bytes where {c.end - start} are left")
            c.pos = start + size
            raw = c.data[start : start + min(size, most)]
            return (raw.rstrip(b"\0") if cdr else raw).decode("utf-8", "replace")

        return read

    def _numbers(self, name: str, fixed: int | None) -> _Read:
        if name not in _LAYOUTS:
            raise DecodeError(f"the type '{name}' is not read")
        size = struct.calcsize("<" + _LAYOUTS[name])
        order, code, length = self.order, _LAYOUTS[name], self.length
        mask = size - 1 if self.cdr else 0
        most = limits().elements

        def read(c: _Cursor) -> Any:
            count = length(c) if fixed is None else fixed
            if not count:
                return []
            start = c.pos + (-(c.pos - c.origin) & mask)
            if start + count * size > c.end:
                raise DecodeError(f"an array of {count} where {c.end - start} bytes are left")
            c.pos = start + count * size
            if count > most:
                return Long(count)
            return list(struct.unpack_from(f"{order}{count}{code}", c.data, start))

        return read

    def _sequence(self, element: _Read, fixed: int | None) -> _Read:
        length, most = self.length, limits().elements

        def read(c: _Cursor) -> Any:
            count = length(c) if fixed is None else fixed
            kept = []
            for k in range(count):
                c.step()
                value = element(c)
                if k < most:
                    kept.append(value)
            return kept if count <= most else Long(count)

        return read


def numbers(value: Any, path: str = "", depth: int = 0) -> Iterator[tuple[str, float | Long]]:
    """Yield the numeric fields of a decoded message by dotted path.

    Parameters
    ----------
    value : Any
        Decoded message or a part of it.
    path : str
        Where it stands; elements of arrays are ``field[0]``.
    depth : int
        How deep it stands; what is nested too deep is left out.

    Yields
    ------
    tuple of str, float or Long
    """
    if isinstance(value, (bool, int, float)):
        try:
            yield path, float(value)
        except OverflowError:
            yield path, float("nan")
    elif isinstance(value, Long):
        yield path, value
    elif depth > limits().depth:
        return
    elif isinstance(value, dict):
        for name, inner in value.items():
            yield from numbers(inner, f"{path}.{name}" if path else str(name), depth + 1)
    elif isinstance(value, list):
        if len(value) > limits().elements:
            yield path, Long(len(value))
            return
        for k, inner in enumerate(value):
            yield from numbers(inner, f"{path}[{k}]", depth + 1)
