"""MATLAB files as plain trees, every size checked before it is believed.

A tree holds dictionaries (structs), lists (cells and struct arrays), arrays as
MATLAB shapes them, texts, and `Unreadable` in the place of what cannot be had.
Versions 4 to 7.2 are read here and not by SciPy, whose reader ends the whole
process on some damaged files; 7.3 is read by h5py.
"""

from __future__ import annotations

import math
import os
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from greybox.errors import LogError

GIB = 2**30
# bytes after decompression, over all variables: three copies of them must fit beside the rest
MAX_BYTES = GIB // 2
# numbers over all variables: as float64 they fill the same space
MAX_VALUES = MAX_BYTES // 8
# variables, fields and cells: each costs far more memory than bytes in the file
MAX_ITEMS = 500_000
MAX_DEPTH = 16
# a sparse matrix is made dense up to this many elements
MAX_DENSE = 1_000_000
_BLOCK = 2**20
_PADDED = 4096

_HOW = (
    "in MATLAB save plain columns instead, as in "
    "t = seconds(T.Time - T.Time(1)); u = T.u; save('log.mat', 't', 'u', '-v7')"
)


@dataclass(frozen=True)
class Unreadable:
    """A variable that this reader cannot or will not read, and why."""

    reason: str


Tree = dict[str, Any]


class _MalformedError(Exception):
    """The file contradicts itself or ends too early."""


def load_tree(path: Path) -> tuple[Tree, str]:
    """Return what a MATLAB file holds, and the name of its format.

    Parameters
    ----------
    path : Path
        Version 4, 5 to 7.2, or 7.3 (HDF5).

    Returns
    -------
    tuple of dict, str
        Variables by name; ``"MAT 4"``, ``"MAT 5"`` or ``"MAT 7.3"``.

    Raises
    ------
    LogError
        There is no such file; it is no MATLAB file, damaged, cut, or larger than
        the bounds, with both numbers.
    """
    if not path.is_file():
        raise LogError(f"there is no file '{path}': name an existing .mat file.")
    with open(path, "rb") as handle:
        head = handle.read(520)
    hdf = b"\x89HDF\r\n\x1a\n"
    try:
        if head.startswith(hdf) or head[512:] == hdf:
            return _load_hdf(path), "MAT 7.3"
        if len(head) < 20:
            raise _MalformedError(f"has only {len(head)} bytes")
        if 0 in head[:4]:
            return _load_four(path), "MAT 4"
        if head[126:128] not in (b"IM", b"MI"):
            raise _MalformedError("does not begin like a MATLAB file")
        return _Five(path).tree(), "MAT 5"
    except _MalformedError as error:
        raise LogError(
            f"'{path.name}' {error}: it is damaged or no MATLAB file. "
            f"Copy it again, or save it again with save(..., '-v7')."
        ) from None
    except RecursionError:
        raise LogError(f"'{path.name}' is nested too deep: save its columns flat.") from None
    except MemoryError:
        raise LogError(
            f"'{path.name}' needs more memory than there is: save only the columns needed."
        ) from None


def _too_large(name: str, what: str, found: int, bound: int) -> LogError:
    return LogError(
        f"'{name}' holds {found} {what}, at most {bound} are read: "
        f"save only the columns that are needed, or split the log."
    )


# version 5: tagged elements, each variable compressed by itself

_MATRIX, _COMPRESSED = 14, 15
_CELL, _STRUCT, _OBJECT, _CHAR, _SPARSE, _FUNCTION, _OPAQUE = 1, 2, 3, 4, 5, 16, 17
_COMPLEX = 0x08

# types of elements, and the classes that MATLAB makes of them
_STORED = {
    1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8",
}  # fmt: skip
_CLASSES = {
    6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8",
}  # fmt: skip
_ENCODED = {16: "utf-8", 17: "utf-16", 18: "utf-32"}


class _Flow:
    """Hands out one element's bytes, inflated or plain, never more than it has."""

    def __init__(self, handle: IO[bytes], size: int, owner: _Five, *, packed: bool) -> None:
        self.handle, self.left, self.owner = handle, size, owner
        self.inflater = zlib.decompressobj() if packed else None
        self.pending = b""
        self.used = 0
        self.finishing = False

    def read(self, count: int) -> bytes:
        """Return exactly `count` bytes."""
        parts = []
        while count:
            part = self._some(min(count, _BLOCK))
            parts.append(part)
            count -= len(part)
        return b"".join(parts)

    def skip(self, count: int) -> None:
        """Pass over `count` bytes, a block at a time."""
        while count:
            count -= len(self._some(min(count, _BLOCK)))

    def finish(self) -> None:
        """Inflate what is left, for the checksum stands behind it."""
        self.finishing = True
        while self.inflater is not None and not self.inflater.eof:
            self._some(_BLOCK)

    def _some(self, limit: int) -> bytes:
        part = self._raw(limit) if self.inflater is None else self._inflated(limit)
        self.used += len(part)
        self.owner.count(len(part))
        return part

    def _inflated(self, limit: int) -> bytes:
        assert self.inflater is not None
        part = b""
        while not part:
            if self.inflater.eof:
                if self.finishing:
                    break
                raise _MalformedError("holds a variable that ends too early")
            feed = self.pending or self._raw(_BLOCK)
            try:
                part = self.inflater.decompress(feed, limit)
            except zlib.error as error:
                raise _MalformedError(f"holds damaged compressed data ({error})") from None
            self.pending = self.inflater.unconsumed_tail
        return part

    def _raw(self, limit: int) -> bytes:
        part = self.handle.read(min(limit, self.left))
        if not part:
            raise _MalformedError(f"ends at byte {self.handle.tell()} inside a variable")
        self.left -= len(part)
        return part


class _Five:
    """Reads a file of version 5 to 7.2, as its format description has it."""

    def __init__(self, path: Path) -> None:
        self.path, self.bytes, self.items, self.values = path, 0, 0, 0
        self.order = "<"

    def count(self, count: int) -> None:
        self.bytes += count
        if self.bytes > MAX_BYTES:
            raise _too_large(self.path.name, "bytes or more once inflated", self.bytes, MAX_BYTES)

    def tree(self) -> Tree:
        size = self.path.stat().st_size
        tree: Tree = {}
        with open(self.path, "rb") as handle:
            self.order = "<" if handle.read(128)[126:128] == b"IM" else ">"
            while (start := handle.tell()) < size:
                tag = handle.read(8)
                if len(tag) < 8:
                    raise _MalformedError(f"ends at byte {size} inside a tag")
                kind, length = struct.unpack(self.order + "II", tag)
                if start + 8 + length > size:
                    raise _MalformedError(
                        f"ends at byte {size}, but a variable reaches to byte {start + 8 + length}"
                    )
                if kind not in (_COMPRESSED, _MATRIX):
                    raise _MalformedError(f"holds an element of type {kind} at byte {start}")
                flow = _Flow(handle, length, self, packed=kind == _COMPRESSED)
                if kind == _COMPRESSED:
                    kind, length = struct.unpack(self.order + "II", flow.read(8))
                    if kind != _MATRIX:
                        raise _MalformedError(f"holds a variable of type {kind}")
                name, value = self._matrix(flow, length, 0)
                flow.finish()
                # without a name: what MATLAB keeps for its objects
                if name:
                    tree[name] = value
                handle.seek(start + 8 + struct.unpack(self.order + "I", tag[4:])[0])
        return tree

    def _matrix(self, flow: _Flow, size: int, depth: int) -> tuple[str, Any]:
        """Return name and value of one matrix, `size` bytes long."""
        self.items += 1
        if self.items > MAX_ITEMS:
            raise _too_large(self.path.name, "variables, fields or cells", self.items, MAX_ITEMS)
        if depth > MAX_DEPTH:
            raise LogError(
                f"'{self.path.name}' nests structs deeper than {MAX_DEPTH}: save its columns flat."
            )
        if size == 0:
            return "", np.empty((0, 0))
        end = flow.used + size
        _, flags = self._element(flow, end)
        if len(flags) != 8:
            raise _MalformedError("holds a variable without flags")
        (word,) = struct.unpack(self.order + "I", flags[:4])
        kind, marks = word & 0xFF, word >> 8 & 0xFF
        if kind == _OPAQUE:
            name, _, made = (self._text(flow, end) for _ in range(3))
            value: Any = _opaque(made)
        else:
            _, raw = self._element(flow, end, 4 * 64)
            lengths = struct.unpack(f"{self.order}{len(raw) // 4}i", raw[: len(raw) // 4 * 4])
            if len(lengths) < 2 or min(lengths) < 0:
                raise _MalformedError(f"holds a variable of size {lengths}")
            name = self._text(flow, end)
            value = self._value(flow, end, kind, marks, lengths, depth)
        if flow.used > end:
            raise _MalformedError("holds a variable that is longer than it states")
        flow.skip(end - flow.used)
        return name, value

    def _value(
        self, flow: _Flow, end: int, kind: int, marks: int, lengths: tuple[int, ...], depth: int
    ) -> Any:
        numel = math.prod(lengths)
        if kind in _CLASSES:
            if marks & _COMPLEX:
                return Unreadable("it is complex: save its real and imaginary parts")
            numbers = self._numbers(flow, end, numel)
            return numbers.astype(_CLASSES[kind], copy=False).reshape(lengths, order="F")
        if kind == _CHAR:
            return self._characters(flow, end, numel, lengths[0])
        if kind == _CELL:
            self._check_cells(numel, end - flow.used)
            return [self._inner(flow, end, depth) for _ in range(numel)]
        if kind == _STRUCT:
            return self._structs(flow, end, numel, depth)
        if kind == _SPARSE:
            return self._sparse(flow, end, marks, lengths)
        if kind == _OBJECT:
            return _opaque(self._text(flow, end))
        return Unreadable("it is a function" if kind == _FUNCTION else f"its class is {kind}")

    def _element(self, flow: _Flow, end: int, most: int = MAX_BYTES) -> tuple[int, bytes]:
        """Return type and data of the next element."""
        if end - flow.used < 8:
            raise _MalformedError("holds a variable that ends inside a tag")
        (first,) = struct.unpack(self.order + "I", flow.read(4))
        if first >> 16:
            # a small element: its data stand in the tag itself
            data = flow.read(4)
            if first >> 16 > 4:
                raise _MalformedError(f"holds a small element of {first >> 16} bytes")
            return first & 0xFFFF, data[: first >> 16]
        (length,) = struct.unpack(self.order + "I", flow.read(4))
        if length > min(end - flow.used, most):
            raise _MalformedError(
                f"holds an element of {length} bytes where {min(end - flow.used, most)} are left"
            )
        data = flow.read(length)
        # some writers leave out the padding where nothing follows
        flow.skip(min(-length % 8, end - flow.used))
        return first, data

    def _text(self, flow: _Flow, end: int) -> str:
        _, data = self._element(flow, end, 4096)
        return data.rstrip(b"\0").decode("ascii", "replace")

    def _numbers(self, flow: _Flow, end: int, numel: int) -> Any:
        self.values += numel
        if self.values > MAX_VALUES:
            raise _too_large(self.path.name, "numbers", self.values, MAX_VALUES)
        kind, data = self._element(flow, end)
        if kind not in _STORED:
            raise _MalformedError(f"holds numbers of type {kind}")
        stored = np.dtype(self.order + _STORED[kind])
        if len(data) != numel * stored.itemsize:
            raise _MalformedError(f"states {numel} numbers in {len(data)} bytes")
        return np.frombuffer(data, stored).astype(stored.newbyteorder("="))

    def _characters(self, flow: _Flow, end: int, numel: int, rows: int) -> Any:
        kind, data = self._element(flow, end)
        if kind in _ENCODED:
            order = {"utf-8": ""}.get(_ENCODED[kind], "-le" if self.order == "<" else "-be")
            letters = data.decode(_ENCODED[kind] + order, "replace")
        elif kind in (1, 2):
            letters = data.decode("latin-1")
        elif kind in (3, 4):
            letters = data.decode("utf-16-le" if self.order == "<" else "utf-16-be", "replace")
        else:
            raise _MalformedError(f"holds text of type {kind}")
        if len(letters) < numel <= _PADDED:
            # MATLAB itself writes texts of blanks without their bytes
            letters = letters.ljust(numel)
        elif numel > max(len(letters), len(data)):
            raise _MalformedError(f"states a text of {numel} characters in {len(data)} bytes")
        if rows <= 1:
            return letters.rstrip()
        # columns first
        return [letters[k::rows].rstrip() for k in range(min(rows, len(letters)))]

    def _check_cells(self, count: int, left: int) -> None:
        # each takes at least a tag
        if count > left // 8:
            raise _MalformedError(f"states {count} cells or structs in {left} bytes")

    def _inner(self, flow: _Flow, end: int, depth: int) -> Any:
        if end - flow.used < 8:
            raise _MalformedError("holds fewer cells or fields than it states")
        kind, length = struct.unpack(self.order + "II", flow.read(8))
        if kind != _MATRIX or length > end - flow.used:
            raise _MalformedError(f"holds a cell or field of type {kind}")
        return self._matrix(flow, length, depth + 1)[1]

    def _structs(self, flow: _Flow, end: int, numel: int, depth: int) -> Any:
        _, raw = self._element(flow, end, 8)
        if len(raw) != 4:
            raise _MalformedError("holds a struct without the length of its names")
        (width,) = struct.unpack(self.order + "i", raw)
        _, data = self._element(flow, end)
        if not 0 < width <= 4096:
            raise _MalformedError(f"holds a struct with names of {width} characters")
        names = [
            data[k : k + width].split(b"\0")[0].decode("utf-8", "replace")
            for k in range(0, len(data) - width + 1, width)
        ]
        if not names:
            return {}
        self._check_cells(numel * len(names), end - flow.used)
        items = [{n: self._inner(flow, end, depth) for n in names} for _ in range(numel)]
        return items[0] if len(items) == 1 else items

    def _sparse(self, flow: _Flow, end: int, marks: int, lengths: tuple[int, ...]) -> Any:
        numel = math.prod(lengths)
        if marks & _COMPLEX or len(lengths) != 2 or numel > MAX_DENSE:
            return Unreadable(f"it is a sparse matrix of {numel} elements: save full(x)")
        rows, starts = (self._integers(flow, end) for _ in range(2))
        kind, data = self._element(flow, end)
        stored = np.dtype(self.order + _STORED.get(kind, "f8"))
        values = np.frombuffer(data[: len(data) // stored.itemsize * stored.itemsize], stored)
        used = int(starts[-1]) if len(starts) == lengths[1] + 1 else -1
        rows, values = rows[: max(used, 0)], values[: max(used, 0)]
        if (
            not len(rows) == len(values) == used
            or np.any(np.diff(starts) < 0)
            or np.any((rows < 0) | (rows >= lengths[0]))
        ):
            return Unreadable("it is sparse and its indices make no sense: save full(x)")
        dense = np.zeros(lengths)
        dense[rows, np.repeat(np.arange(lengths[1]), np.diff(starts))] = values
        return dense

    def _integers(self, flow: _Flow, end: int) -> Any:
        _, data = self._element(flow, end)
        return np.frombuffer(data[: len(data) // 4 * 4], self.order + "i4").astype(np.int64)


# version 4: a header of five integers before each matrix

_FOUR_TYPES = {0: "f8", 1: "f4", 2: "i4", 3: "i2", 4: "u2", 5: "u1"}


def _load_four(path: Path) -> Tree:
    size = path.stat().st_size
    tree: Tree = {}
    with open(path, "rb") as handle:
        while (position := handle.tell()) < size:
            head = handle.read(20)
            if len(head) < 20:
                raise _MalformedError(f"ends at byte {size} inside a header")
            order = "<" if 0 <= struct.unpack("<i", head[:4])[0] <= 5000 else ">"
            kind, rows, columns, imaginary, named = struct.unpack(order + "5i", head)
            stored = _FOUR_TYPES.get(kind // 10 % 10)
            known = kind in range(2000) and kind // 100 % 10 == 0 and kind % 10 <= 2
            if not known or stored is None or min(rows, columns) < 0 or not 0 < named <= 1024:
                raise _MalformedError(f"holds no header of a variable at byte {position}")
            parts = 2 if imaginary else 1
            held = rows * columns * np.dtype(stored).itemsize * parts
            if held > MAX_BYTES:
                raise _too_large(path.name, "bytes in one variable", held, MAX_BYTES)
            if position + 20 + named + held > size:
                raise _MalformedError(
                    f"ends at byte {size}, but a variable reaches to byte "
                    f"{position + 20 + named + held}"
                )
            name = handle.read(named).rstrip(b"\0").decode("ascii", "replace")
            values = np.frombuffer(handle.read(held), np.dtype(order + stored))
            if imaginary:
                tree[name] = Unreadable("it is complex: save its real and imaginary parts")
            elif kind % 10 == 2:
                tree[name] = Unreadable("it is sparse: save full(x)")
            else:
                table = values.astype(values.dtype.newbyteorder("="))
                table = table.reshape((rows, columns), order="F")
                tree[name] = _characters(table) if kind % 10 == 1 else table
    return tree


def _opaque(name: str) -> Unreadable:
    name = name or "object"
    return Unreadable(f"it is a MATLAB '{name}' object, which only MATLAB can read: {_HOW}")


# version 7.3: HDF5


def _load_hdf(path: Path) -> Tree:
    import h5py

    try:
        with h5py.File(path, "r", locking=False) as file:
            return _Hdf(path, file).tree()
    except (LogError, _MalformedError, MemoryError, RecursionError):
        raise
    # what h5py makes of the errors of HDF5, and of names and types that it cannot turn to Python's
    except (OSError, KeyError, RuntimeError, ValueError, TypeError) as error:
        reason = " ".join(str(error).split())
        size = os.path.getsize(path)
        raise _MalformedError(f"({size} bytes) cannot be read as HDF5 ({reason})") from None


class _Hdf:
    """Turns an HDF5 file into a tree, every dataset counted before it is read."""

    def __init__(self, path: Path, file: Any) -> None:
        self.path, self.file = path, file
        self.bytes = self.values = self.items = 0

    def tree(self) -> Tree:
        return {
            name: value
            for name, value in self._group(self.file, 0, ()).items()
            if not name.startswith("#")
        }

    def _group(self, group: Any, depth: int, above: tuple[Any, ...]) -> Tree:
        import h5py

        tree: Tree = {}
        for name in group:
            if name in ("#refs#", "#subsystem#"):
                continue
            link = group.get(name, getlink=True)
            if not isinstance(link, h5py.HardLink):
                # a soft or external link may point at any file of this machine
                tree[name] = Unreadable("it is a link, and links are not followed")
                continue
            tree[name] = self._item(group[name], depth + 1, above)
        return tree

    def _item(self, item: Any, depth: int, above: tuple[Any, ...]) -> Any:
        import h5py

        self.items += 1
        if self.items > MAX_ITEMS:
            raise _too_large(self.path.name, "variables, fields or cells", self.items, MAX_ITEMS)
        if depth > MAX_DEPTH:
            raise LogError(
                f"'{self.path.name}' nests structs deeper than {MAX_DEPTH}: save its columns flat."
            )
        if item in above:
            return Unreadable("it contains itself")
        above = (*above, item)
        kind = self._attribute(item, "MATLAB_class")
        if "MATLAB_object_decode" in item.attrs:
            return _opaque(kind)
        if isinstance(item, h5py.Group):
            if "MATLAB_sparse" in item.attrs:
                return Unreadable("it is sparse: save full(x)")
            fields = self._group(item, depth, above)
            return _struct_array(fields)
        if not isinstance(item, h5py.Dataset):
            return Unreadable("it is no dataset")
        return self._dataset(item, kind, depth, above)

    def _attribute(self, item: Any, name: str) -> str:
        if name not in item.attrs:
            return ""
        stored = item.attrs.get_id(name)
        if stored.shape != () or stored.dtype.kind != "S" or stored.dtype.itemsize > 64:
            return ""
        return bytes(item.attrs[name]).decode("ascii", "replace")

    def _dataset(self, item: Any, kind: str, depth: int, above: tuple[Any, ...]) -> Any:
        import h5py

        if item.external or item.is_virtual:
            return Unreadable("its data stand in another file")
        if item.shape is None:
            return np.empty((0, 0))
        numel = math.prod(item.shape)
        self.values += numel
        self.bytes += numel * item.dtype.itemsize
        if self.values > MAX_VALUES:
            raise _too_large(self.path.name, "numbers", self.values, MAX_VALUES)
        if self.bytes > MAX_BYTES:
            raise _too_large(self.path.name, "bytes once inflated", self.bytes, MAX_BYTES)
        if "MATLAB_empty" in item.attrs:
            return "" if kind == "char" else np.empty((0, 0))
        if h5py.check_ref_dtype(item.dtype) is h5py.Reference:
            if numel > MAX_ITEMS - self.items:
                raise _too_large(
                    self.path.name, "variables, fields or cells", self.items + numel, MAX_ITEMS
                )
            cells = [self._cell(r, depth, above) for r in np.ravel(np.asarray(item[()], object))]
            return _Cells(cells) if kind != "cell" else cells
        if item.dtype.kind == "V" and item.dtype.names == ("real", "imag"):
            return Unreadable("it is complex: save its real and imaginary parts")
        if item.dtype.kind not in "fiub":
            return Unreadable(f"its type is {item.dtype}")
        if item.chunks is not None and math.prod(item.chunks) > MAX_VALUES:
            return Unreadable(f"its chunks hold {math.prod(item.chunks)} numbers")
        try:
            value = item[()]
        except OSError as error:
            return Unreadable(f"its data are damaged ({error})")
        if kind:
            # MATLAB counts columns first
            value = np.transpose(value)
        if kind == "char":
            return _characters(value)
        return np.atleast_2d(value) if kind else value

    def _cell(self, reference: Any, depth: int, above: tuple[Any, ...]) -> Any:
        if not reference:
            return np.empty((0, 0))
        return self._item(self.file[reference], depth + 1, above)


class _Cells(list[Any]):
    """The values of one field over a struct array, as HDF5 stores them."""


def _struct_array(fields: Tree) -> Any:
    """Return the struct, or the list of structs where each field is a list of references."""
    lengths = {len(v) if isinstance(v, _Cells) else -1 for v in fields.values()}
    if len(lengths) == 1 and (count := lengths.pop()) >= 0:
        return [{n: v[k] for n, v in fields.items()} for k in range(count)]
    return {n: list(v) if isinstance(v, _Cells) else v for n, v in fields.items()}


def _characters(value: Any) -> Any:
    """Return codes of characters, one text a row."""
    rows = np.atleast_2d(value)
    rows = rows.reshape(len(rows), -1).astype(np.uint16)
    texts = [r.astype("<u2").tobytes().decode("utf-16-le", "replace").rstrip() for r in rows]
    return texts[0] if len(texts) == 1 else (texts or "")
