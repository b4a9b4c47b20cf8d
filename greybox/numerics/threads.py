"""What a process computes with: threads of linear algebra, and memory."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

# of glibc, by its numbers for them: size from which on memory is asked of the system for one array
# alone, and free memory from which on it is given back [bytes]
_MEMORY = {-3: 64 << 20, -1: 256 << 20}


def limit_to_one_thread() -> AbstractContextManager[Any]:
    """Let linear algebra run in one thread from now on.

    Where one is all that there is nothing is set: in a copy of a process, OpenBLAS would begin its
    threads anew to be told so, and they spin for a tenth of a second before they sleep.

    Returns
    -------
    context manager
        Gives the others back at its end.
    """
    # only loaded libraries can be told so
    import scipy.linalg  # noqa: F401
    from threadpoolctl import ThreadpoolController

    pools = ThreadpoolController()
    if all(pool["num_threads"] == 1 for pool in pools.info()):
        return nullcontext()
    limits: AbstractContextManager[Any] = pools.limit(limits=1)
    return limits


@contextmanager
def one_thread() -> Iterator[None]:
    """Let linear algebra run in one thread inside a block or a function.

    On small matrices several threads would only wait for one another.
    """
    with limit_to_one_thread():
        yield


def keep_memory() -> None:
    """Keep what arrays free for the next ones, where the C library can be told so.

    By default it gives the system back what is larger than some 100 kB, which then has to clear it
    for each new array: a fifth of the time of a design. To be called once, by who owns the process.
    """
    tell = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if tell is not None:
        for setting, size in _MEMORY.items():
            tell(setting, size)
