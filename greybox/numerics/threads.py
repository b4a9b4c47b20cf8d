"""Threads of linear algebra."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any


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
