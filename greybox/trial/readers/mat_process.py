"""What MATLAB files hold as plain trees, and those of version 4 to 7.2 by SciPy in a process apart.

SciPy's reader is fast and complete, and ends the whole process on some damaged files. So
it runs in a child with a bound of memory and time, which hands numbers back as raw bytes
and all else as JSON: whatever the file does to it, the parent goes on.
"""

from __future__ import annotations

import io
import json
import os
import struct
import subprocess
import sys
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from greybox.errors import LogError
from greybox.trial.readers.limits import Limits, limits

# dictionaries are structs, lists are cells and struct arrays; arrays as MATLAB shapes them,
# texts, and `Unreadable` in the place of what cannot be had
Tree = dict[str, Any]

COMPLEX = "it is complex: save its real and imaginary parts"

# the child finds what the parent finds, and nothing else
_COMMAND = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from greybox.trial.readers.mat_process import main; main(*sys.argv[2:])"
)
_TREE, _NUMBERS = "tree.json", "numbers"
_DTYPES = frozenset(
    {"|b1", "|i1", "|u1", "<i2", "<u2", "<i4", "<u4", "<i8", "<u8", "<f4", "<f8"}
)  # fmt: skip
_HEADER = 128
_MATRIX, _COMPRESSED = 14, 15


@dataclass(frozen=True)
class Unreadable:
    """A variable that cannot or will not be read, and why."""

    reason: str


class MalformedError(Exception):
    """The file contradicts itself or ends too early."""


class Tally:
    """Counts what a MATLAB file holds while it is read, against the bounds.

    Parameters
    ----------
    name : str
        File, for the messages.
    most : Limits
    """

    def __init__(self, name: str, most: Limits) -> None:
        self.name, self.most = name, most
        self.items = self.values = self.bytes = 0

    def add_items(self, count: int, depth: int) -> None:
        """Count variables, fields and cells that stand so deep in structs.

        Raises
        ------
        LogError
            There are too many, or they are nested too deep.
        """
        self.items += count
        if self.items > self.most.items:
            raise self._error("variables, fields or cells", self.items, self.most.items)
        if depth > self.most.depth:
            raise LogError(
                f"'{self.name}' nests structs deeper than {self.most.depth}: save its columns flat."
            )

    def add_numbers(self, count: int) -> None:
        """Count numbers; raises `LogError` where they are too many."""
        self.values += count
        if self.values > self.most.values:
            raise self._error("numbers", self.values, self.most.values)

    def add_bytes(self, count: int) -> None:
        """Count bytes without compression; raises `LogError` where they are too many."""
        self.bytes += count
        if self.bytes > self.most.held_bytes:
            raise self._error("bytes or more once inflated", self.bytes, self.most.held_bytes)

    def _error(self, what: str, found: int, bound: int) -> LogError:
        return LogError(
            f"'{self.name}' holds {found} {what}, at most {bound} are read: "
            f"save only the columns that are needed, or split the log."
        )


def opaque(name: str) -> Unreadable:
    """Return what stands for an object of a class of MATLAB's own."""
    return Unreadable(
        f"it is a MATLAB '{name or 'object'}' object, which only MATLAB can read: in MATLAB save "
        f"plain columns instead, as in t = seconds(T.Time - T.Time(1)); u = T.u; "
        f"save('log.mat', 't', 'u', '-v7')"
    )


def load_by_scipy(path: Path) -> Tree:
    """Return what a MATLAB file of version 4 to 7.2 holds, read in a process of its own.

    Raises
    ------
    MalformedError
        The file is damaged, or SciPy crashed on it.
    LogError
        It needs more memory or time than the bounds allow, or the process cannot be started.
    """
    bounds = limits()
    # plain or inflated, it is no smaller than this
    Tally(path.name, bounds).add_bytes(path.stat().st_size)
    with tempfile.TemporaryDirectory() as folder:
        status = _run(path, Path(folder), bounds)
        try:
            answer = json.loads((Path(folder) / _TREE).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            raise MalformedError(f"made its reader end with status {status}") from None
        if "refused" in answer:
            raise LogError(str(answer["refused"]))
        if "damaged" in answer:
            raise MalformedError(str(answer["damaged"]))
        with open(Path(folder) / _NUMBERS, "rb") as handle:
            numbers = bytearray(os.fstat(handle.fileno()).st_size)
            handle.readinto(numbers)
        return {name: _unpacked(node, numbers) for name, node in answer["tree"].items()}


def _run(path: Path, folder: Path, bounds: Limits) -> int:
    """Run the child and return its status."""
    where = [p or os.getcwd() for p in sys.path]
    arguments = [json.dumps(where), str(path.resolve()), str(folder), json.dumps(asdict(bounds))]
    try:
        done = subprocess.run(
            [sys.executable, "-I", "-c", _COMMAND, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
            timeout=bounds.process_seconds,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise LogError(
            f"'{path.name}' ({path.stat().st_size} bytes) was not read within "
            f"{bounds.process_seconds} s: save only the columns that are needed."
        ) from None
    except OSError as error:
        raise LogError(
            f"cannot start a process to read '{path.name}' ({error.strerror}): "
            f"save it as CSV, or with save(..., '-v7.3')."
        ) from None
    return done.returncode


def _unpacked(node: Any, numbers: bytearray) -> Any:
    """Return a part of the tree from what the child wrote, checked like the file itself."""
    kind, value = node
    if kind == "text":
        return str(value)
    if kind == "unreadable":
        return Unreadable(str(value))
    if kind == "struct":
        return {str(n): _unpacked(v, numbers) for n, v in value.items()}
    if kind == "list":
        return [_unpacked(v, numbers) for v in value]
    dtype, shape, start = value
    if dtype not in _DTYPES:
        raise MalformedError(f"holds numbers of type {dtype}")
    count = int(np.prod(shape, dtype=np.int64))
    return np.frombuffer(numbers, dtype, count, start).reshape(shape, order="F")


# from here on in the child


def main(source: str, folder: str, bounds: str) -> None:
    """Read one file and write its tree and numbers into a folder, or why it cannot be read."""
    most = Limits(**json.loads(bounds))
    _restrict(most)
    path = Path(source)
    answer: dict[str, Any]
    try:
        with open(Path(folder) / _NUMBERS, "wb") as sink:
            tally = Tally(path.name, most)
            answer = {"tree": _Packer(tally, sink).tree(_variables(path, tally))}
    except MemoryError:
        answer = {
            "refused": f"'{path.name}' needs more than the {most.process_bytes} bytes of memory "
            f"that one log may take: save only the columns that are needed."
        }
    except LogError as error:
        answer = {"refused": str(error)}
    except RecursionError:
        answer = {"refused": f"'{path.name}' is nested too deep: save its columns flat."}
    # whatever SciPy raises on bytes that make no sense: it is the file that is at fault
    except Exception as error:
        reason = " ".join(str(error).split())[:200].rstrip(".") or type(error).__name__
        damaged = reason if isinstance(error, MalformedError) else f"makes no sense ({reason})"
        answer = {"damaged": damaged}
    (Path(folder) / _TREE).write_text(json.dumps(answer), encoding="utf-8")


def _restrict(most: Limits) -> None:
    """Bound memory, time and written bytes of this process, where the system can."""
    if sys.platform == "win32":
        return
    import resource

    for what, bound in (
        (resource.RLIMIT_AS, most.process_bytes),
        (resource.RLIMIT_CPU, max(1, int(most.process_seconds))),
        (resource.RLIMIT_FSIZE, most.process_bytes),
        (resource.RLIMIT_CORE, 0),
    ):
        _, hard = resource.getrlimit(what)
        bound = bound if hard == resource.RLIM_INFINITY else min(bound, hard)
        # some systems know a bound and refuse to set it
        with suppress(ValueError, OSError):
            resource.setrlimit(what, (bound, hard))


def _variables(path: Path, tally: Tally) -> Iterator[tuple[str, Any]]:
    """Yield name and value of each variable, as SciPy has them."""
    with open(path, "rb") as handle:
        head = handle.read(_HEADER)
        if 0 in head[:4]:
            # the tag of a version: 4 has none, only small integers
            yield from _loaded(path.read_bytes())
            return
        order = "<" if head[126:128] == b"IM" else ">"
        while element := _element(handle, order, tally):
            yield from _loaded(head + element)


def _element(handle: IO[bytes], order: str, tally: Tally) -> bytes:
    """Return the next variable without compression, counted before it is unpacked; b"" at the end.

    Raises
    ------
    MalformedError
        It ends too early, or its compressed data are damaged.
    """
    start, size = handle.tell(), os.fstat(handle.fileno()).st_size
    tag = handle.read(8)
    if not tag:
        return b""
    if len(tag) < 8:
        raise MalformedError(f"ends at byte {size} inside a tag")
    kind, length = struct.unpack(order + "II", tag)
    if start + 8 + length > size:
        raise MalformedError(
            f"ends at byte {size}, but a variable reaches to byte {start + 8 + length}"
        )
    if kind not in (_COMPRESSED, _MATRIX):
        raise MalformedError(f"holds an element of type {kind} at byte {start}")
    data = handle.read(length)
    if kind == _MATRIX:
        tally.add_bytes(length)
        return tag + data
    inflater = zlib.decompressobj()
    try:
        # a byte more than there may be tells that there are too many
        data = inflater.decompress(data, tally.most.held_bytes - tally.bytes + 1)
    except zlib.error as error:
        raise MalformedError(f"holds damaged compressed data ({error})") from None
    tally.add_bytes(len(data))
    if not inflater.eof:
        raise MalformedError("holds a variable that ends too early")
    return data


def _loaded(content: bytes) -> Iterator[tuple[str, Any]]:
    from scipy.io import loadmat
    from scipy.io.matlab import MatlabOpaque

    # as they are stored: SciPy's cast to the class of MATLAB drops imaginary parts
    for name, value in loadmat(io.BytesIO(content), mat_dtype=False).items():
        if isinstance(value, MatlabOpaque):
            yield value.ravel()[0]["s0"].decode("ascii", "replace"), value
        # without a name: what MATLAB keeps for its objects
        elif not (name.startswith("__") and name.endswith("__")):
            yield name, value


class _Packer:
    """Turns what SciPy makes of variables into nodes of JSON, numbers apart; counts them."""

    def __init__(self, tally: Tally, sink: IO[bytes]) -> None:
        self.tally, self.most, self.sink = tally, tally.most, sink

    def tree(self, variables: Iterator[tuple[str, Any]]) -> dict[str, Any]:
        """Return the nodes of all variables by name."""
        found = {}
        for name, value in variables:
            if not name:
                raise MalformedError("holds a variable without a name")
            found[name] = self._node(value, 0)
        return found

    def _node(self, value: Any, depth: int) -> Any:
        from scipy.io.matlab import MatlabFunction, MatlabObject, MatlabOpaque
        from scipy.sparse import issparse

        self.tally.add_items(1, depth)
        if issparse(value):
            return self._sparse(value)
        if isinstance(value, MatlabOpaque):
            return "unreadable", opaque(value.ravel()[0]["s2"].decode("ascii", "replace")).reason
        if isinstance(value, MatlabFunction):
            return "unreadable", "it is a function"
        if isinstance(value, MatlabObject):
            return "unreadable", opaque(str(value.classname)).reason
        array = np.asarray(value)
        if array.dtype.names is not None or array.dtype == np.dtype([]):
            return self._structs(array, depth)
        if array.dtype == object and all(v is None for v in array.flat):
            # a struct without fields, or no cell
            return ("struct", {}) if array.size else ("list", [])
        if array.dtype == object:
            return "list", [self._node(v, depth + 1) for v in array.ravel(order="F")]
        if array.dtype.kind == "U":
            return self._texts(array)
        if array.dtype.kind == "c":
            return "unreadable", COMPLEX
        if array.dtype.kind not in "biuf":
            return "unreadable", f"its type is {array.dtype}"
        return self._numbers(array)

    def _structs(self, array: Any, depth: int) -> Any:
        names = array.dtype.names or ()
        items = [
            ("struct", {n: self._node(item[n], depth + 1) for n in names})
            for item in array.ravel(order="F")
        ]
        return items[0] if len(items) == 1 else ("list", items)

    def _texts(self, array: Any) -> Any:
        texts = [("text", str(t)[: self.most.text].rstrip()) for t in array.ravel()]
        if not texts:
            return "text", ""
        return texts[0] if len(texts) == 1 else ("list", texts)

    def _sparse(self, matrix: Any) -> Any:
        size = matrix.shape[0] * matrix.shape[1]
        if size > self.most.dense_elements:
            return "unreadable", f"it is a sparse matrix of {size} elements: save full(x)"
        if matrix.dtype.kind == "c":
            return "unreadable", COMPLEX
        try:
            # C code that makes it dense believes its indices
            if hasattr(matrix, "check_format"):
                matrix.check_format(full_check=True)
            return self._numbers(matrix.toarray())
        except (ValueError, IndexError):
            return "unreadable", "it is sparse and its indices make no sense: save full(x)"

    def _numbers(self, array: Any) -> Any:
        self.tally.add_numbers(array.size)
        array = array.astype(array.dtype.newbyteorder("<"), copy=False)
        start = self.sink.tell()
        # MATLAB counts columns first
        array.ravel(order="F").tofile(self.sink)
        return "array", (array.dtype.str, array.shape, start)
