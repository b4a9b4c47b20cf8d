"""MATLAB files as plain trees, measured before they are loaded.

A tree holds dictionaries (structs), lists (cells and struct arrays), arrays as
MATLAB shapes them, texts, and `Unreadable` in the place of what cannot be had.
SciPy and h5py do the reading; before that the file is walked once without
keeping anything, so that sizes, nesting and counts are known to be sane.
"""

from __future__ import annotations

import math
import os
import struct
import warnings
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from greybox.errors import LogError

GIB = 2**30
# bytes after decompression, over all variables
MAX_BYTES = 2 * GIB
# numbers over all variables: as float64 they fill the same 2 GiB
MAX_VALUES = MAX_BYTES // 8
# variables, fields and cells: each costs far more memory than bytes in the file
MAX_ITEMS = 500_000
MAX_DEPTH = 16
# a sparse matrix is made dense up to this many elements
MAX_DENSE = 1_000_000
_BLOCK = 2**20

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
            _measure_four(path)
            return _load_scipy(path), "MAT 4"
        if head[126:128] not in (b"IM", b"MI"):
            raise _MalformedError("does not begin like a MATLAB file")
        _Five(path).measure()
        return _load_scipy(path), "MAT 5"
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
_CELL, _STRUCT, _OBJECT, _CHAR, _SPARSE, _OPAQUE = 1, 2, 3, 4, 5, 17
_FIRST_NUMERIC, _LAST_NUMERIC = 6, 15


class _Flow:
    """Reads one element's bytes, inflated or plain, and keeps count of them."""

    def __init__(self, handle: IO[bytes], size: int, owner: _Five, *, packed: bool) -> None:
        self.handle, self.left, self.owner = handle, size, owner
        self.inflater = zlib.decompressobj() if packed else None
        self.pending = b""

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

    def _some(self, limit: int) -> bytes:
        if self.inflater is None:
            part = self._raw(limit)
        else:
            part = b""
            while not part:
                if self.inflater.eof:
                    raise _MalformedError("holds a variable that ends too early")
                feed = self.pending or self._raw(_BLOCK)
                try:
                    part = self.inflater.decompress(feed, limit)
                except zlib.error as error:
                    raise _MalformedError(f"holds damaged compressed data ({error})") from None
                self.pending = self.inflater.unconsumed_tail
        self.owner.count(len(part))
        return part

    def _raw(self, limit: int) -> bytes:
        part = self.handle.read(min(limit, self.left))
        if not part:
            raise _MalformedError(f"ends at byte {self.handle.tell()} inside a variable")
        self.left -= len(part)
        return part


class _Five:
    """Walks the elements of a file of version 5 to 7.2 without keeping them."""

    def __init__(self, path: Path) -> None:
        self.path, self.bytes, self.items, self.values = path, 0, 0, 0

    def count(self, count: int) -> None:
        self.bytes += count
        if self.bytes > MAX_BYTES:
            raise _too_large(self.path.name, "bytes or more once inflated", self.bytes, MAX_BYTES)

    def measure(self) -> None:
        """Raise unless every element is whole and within the bounds."""
        size = self.path.stat().st_size
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
                if kind == _COMPRESSED:
                    flow = _Flow(handle, length, self, packed=True)
                    inner, inside = struct.unpack(self.order + "II", flow.read(8))
                    if inner != _MATRIX:
                        raise _MalformedError(f"holds a variable of type {inner}")
                    self._matrix(flow, inside, 0)
                elif kind == _MATRIX:
                    self._matrix(_Flow(handle, length, self, packed=False), length, 0)
                else:
                    raise _MalformedError(f"holds an element of type {kind} at byte {start}")
                handle.seek(start + 8 + length)

    def _matrix(self, flow: _Flow, size: int, depth: int) -> None:
        """Walk one matrix of `size` bytes and those inside it."""
        self.items += 1
        if self.items > MAX_ITEMS:
            raise _too_large(self.path.name, "variables, fields or cells", self.items, MAX_ITEMS)
        if depth > MAX_DEPTH:
            raise LogError(
                f"'{self.path.name}' nests structs deeper than {MAX_DEPTH}: save its columns flat."
            )
        if size == 0:
            return
        position = place = 0
        kind, numel = _OPAQUE, 0
        while position < size:
            code, length, head = self._tag(flow, size - position)
            position += head
            if code == _MATRIX:
                self._matrix(flow, length, depth + 1)
                position += length
                place += 1
                continue
            padded = length + (-length % 8 if head == 8 else 0)
            # MATLAB leaves out the padding where nothing follows
            padded = min(padded, size - position)
            if place == 0:
                if length < 8:
                    raise _MalformedError("holds a variable without flags")
                content = flow.read(padded)
                kind = content[0] if self.order == "<" else content[3]
            elif place == 1 and kind != _OPAQUE:
                if length > 4 * 64:
                    raise _MalformedError(f"holds a variable of {length // 4} dimensions")
                content = flow.read(padded)
                lengths = struct.unpack(f"{self.order}{length // 4}i", content[: length // 4 * 4])
                numel = self._extent(kind, lengths, size)
            else:
                if place == 3 and kind == _CHAR and numel > length:
                    raise _MalformedError(f"states a text of {numel} characters in {length} bytes")
                flow.skip(padded)
            position += padded
            place += 1

    def _tag(self, flow: _Flow, left: int) -> tuple[int, int, int]:
        """Return type, bytes of data and bytes of the tag; a small element's data are skipped."""
        if left < 8:
            raise _MalformedError("holds a variable that ends inside a tag")
        first = struct.unpack(self.order + "I", flow.read(4))[0]
        if first >> 16:
            return self._small(first)
        (length,) = struct.unpack(self.order + "I", flow.read(4))
        if length > left - 8:
            raise _MalformedError(f"holds an element of {length} bytes where {left - 8} are left")
        return int(first), int(length), 8

    def _small(self, first: int) -> tuple[int, int, int]:
        if first >> 16 > 4:
            raise _MalformedError(f"holds a small element of {first >> 16} bytes")
        # its data fill the second half of the tag, whatever their length
        return int(first & 0xFFFF), 4, 4

    def _extent(self, kind: int, lengths: tuple[int, ...], size: int) -> int:
        if any(n < 0 for n in lengths):
            raise _MalformedError(f"holds a variable of size {lengths}")
        numel = math.prod(lengths)
        if kind in (_CELL, _STRUCT, _OBJECT) and numel > size // 8:
            raise _MalformedError(f"states {numel} cells or structs in {size} bytes")
        if _FIRST_NUMERIC <= kind <= _LAST_NUMERIC:
            if numel > size:
                raise _MalformedError(f"states {numel} numbers in {size} bytes")
            self.values += numel
            if self.values > MAX_VALUES:
                raise _too_large(self.path.name, "numbers", self.values, MAX_VALUES)
        return numel


# version 4: a header of five integers before each matrix

_FOUR_SIZES = {0: 8, 1: 4, 2: 4, 3: 2, 4: 2, 5: 1}


def _measure_four(path: Path) -> None:
    size = path.stat().st_size
    position = 0
    with open(path, "rb") as handle:
        while position < size:
            handle.seek(position)
            head = handle.read(20)
            if len(head) < 20:
                raise _MalformedError(f"ends at byte {size} inside a header")
            order = "<" if 0 <= struct.unpack("<i", head[:4])[0] <= 5000 else ">"
            kind, rows, columns, imaginary, named = struct.unpack(order + "5i", head)
            width = _FOUR_SIZES.get(kind // 10 % 10)
            known = 0 <= kind < 5000 and kind // 100 % 10 == 0 and kind % 10 <= 2
            if not known or width is None or min(rows, columns) < 0 or not 0 < named <= 1024:
                raise _MalformedError(f"holds no header of a variable at byte {position}")
            held = rows * columns * width * (2 if imaginary else 1)
            if held > MAX_BYTES:
                raise _too_large(path.name, "bytes in one variable", held, MAX_BYTES)
            position += 20 + named + held
            if position > size:
                raise _MalformedError(
                    f"ends at byte {size}, but a variable reaches to byte {position}"
                )


def _load_scipy(path: Path) -> Tree:
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadWarning

    try:
        with warnings.catch_warnings():
            # duplicate names and old functions: neither is a signal
            warnings.simplefilter("ignore", MatReadWarning)
            warnings.simplefilter("ignore", UserWarning)
            found = loadmat(path, mat_dtype=False, squeeze_me=False, chars_as_strings=True)
    except (LogError, MemoryError, RecursionError):
        raise
    # SciPy fails in many ways on a damaged file
    except Exception as error:
        raise _MalformedError(f"cannot be read ({type(error).__name__}: {error})") from None
    tree: Tree = {}
    for name, value in found.items():
        if name.startswith("__"):
            continue
        plain = _plain(value, 0)
        if name == "None" and isinstance(plain, Unreadable):
            name = _opaque_name(value)
        tree[name] = plain
    return tree


def _opaque_name(value: Any) -> str:
    try:
        return bytes(value[0]["s0"]).decode("ascii", "replace") or "None"
    except (IndexError, KeyError, ValueError, TypeError):
        return "None"


def _plain(value: Any, depth: int) -> Any:
    """Return SciPy's value as a tree."""
    from scipy import sparse
    from scipy.io.matlab import MatlabFunction, MatlabObject, MatlabOpaque

    if depth > 2 * MAX_DEPTH:
        return Unreadable("it is nested too deep")
    if isinstance(value, MatlabOpaque):
        return _opaque(_class_name(value))
    if isinstance(value, MatlabFunction):
        return Unreadable("it is a function")
    if isinstance(value, MatlabObject):
        return _opaque(str(value.classname))
    if sparse.issparse(value):
        if math.prod(value.shape) > MAX_DENSE:
            return Unreadable(f"it is a sparse matrix of {math.prod(value.shape)} elements")
        return _numeric(value.toarray())
    if not isinstance(value, np.ndarray):
        return Unreadable(f"it is a {type(value).__name__}")
    if value.dtype.names is not None:
        items = [
            {n: _plain(item[n], depth + 1) for n in value.dtype.names}
            for item in value.ravel(order="F")
        ]
        return items[0] if len(items) == 1 else items
    if value.dtype == object:
        return [_plain(item, depth + 1) for item in value.ravel(order="F")]
    if value.dtype.kind in "US":
        texts = [str(s).rstrip() for s in value.ravel()]
        return texts[0] if len(texts) == 1 else (texts or "")
    return _numeric(value)


def _numeric(value: Any) -> Any:
    if value.dtype.kind == "c":
        return Unreadable("it is complex: save its real and imaginary parts")
    if value.dtype.kind not in "fiub":
        return Unreadable(f"its type is {value.dtype}")
    return value


def _class_name(value: Any) -> str:
    try:
        return bytes(value[0]["s2"]).decode("ascii", "replace")
    except (IndexError, KeyError, ValueError, TypeError):
        return "object"


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
    # HDF5 reports damage as whatever its layers raise
    except Exception as error:
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
            cells = [self._cell(r, depth, above) for r in item[()].ravel()]
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
    if value.dtype.kind not in "iu":
        return Unreadable("its characters are no integers")
    rows = np.atleast_2d(value)
    rows = rows.reshape(len(rows), -1).astype(np.uint16)
    texts = [r.astype("<u2").tobytes().decode("utf-16-le", "replace").rstrip() for r in rows]
    return texts[0] if len(texts) == 1 else (texts or "")
