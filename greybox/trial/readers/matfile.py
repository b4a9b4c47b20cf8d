"""MATLAB files as plain trees: version 4 to 7.2 by SciPy, 7.3 by h5py with every size checked."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from greybox.errors import LogError, so_many
from greybox.trial.readers.limits import limits
from greybox.trial.readers.mat_process import (
    COMPLEX,
    MalformedError,
    Tally,
    Tree,
    Unreadable,
    load_by_scipy,
    opaque,
)

_HDF = b"\x89HDF\r\n\x1a\n"


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
    try:
        if head.startswith(_HDF) or head[512:] == _HDF:
            return _load_hdf(path), "MAT 7.3"
        if len(head) < 20:
            raise MalformedError(f"has only {so_many(len(head), 'byte')}")
        four = 0 in head[:4]
        if not four and head[126:128] not in (b"IM", b"MI"):
            raise MalformedError("does not begin like a MATLAB file")
        return load_by_scipy(path), "MAT 4" if four else "MAT 5"
    except MalformedError as error:
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


def _load_hdf(path: Path) -> Tree:
    import h5py

    try:
        with h5py.File(path, "r", locking=False) as file:
            return _Hdf(path, file).tree()
    except (LogError, MalformedError, MemoryError, RecursionError):
        raise
    # what h5py makes of the errors of HDF5, and of names and types that it cannot turn to Python's
    except (OSError, KeyError, RuntimeError, ValueError, TypeError) as error:
        reason = " ".join(str(error).split())
        size = os.path.getsize(path)
        raise MalformedError(f"({size} bytes) cannot be read as HDF5 ({reason})") from None


class _Hdf:
    """Turns an HDF5 file into a tree, every dataset counted before it is read."""

    def __init__(self, path: Path, file: Any) -> None:
        self.file = file
        self.tally = Tally(path.name, limits())

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

        self.tally.add_items(1, depth)
        if item in above:
            return Unreadable("it contains itself")
        above = (*above, item)
        kind = self._attribute(item, "MATLAB_class")
        if "MATLAB_object_decode" in item.attrs:
            return opaque(kind)
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
        self.tally.add_numbers(numel)
        self.tally.add_bytes(numel * item.dtype.itemsize)
        if "MATLAB_empty" in item.attrs:
            return "" if kind == "char" else np.empty((0, 0))
        if h5py.check_ref_dtype(item.dtype) is h5py.Reference:
            self.tally.add_items(numel, depth)
            cells = [self._cell(r, depth, above) for r in np.ravel(np.asarray(item[()], object))]
            return _Cells(cells) if kind != "cell" else cells
        if item.dtype.kind == "V" and item.dtype.names == ("real", "imag"):
            return Unreadable(COMPLEX)
        if item.dtype.kind not in "fiub":
            return Unreadable(f"its type is {item.dtype}")
        if item.chunks is not None and math.prod(item.chunks) > limits().values:
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
