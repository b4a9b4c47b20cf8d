"""Linear algebra in one thread, and the others given back."""

from __future__ import annotations

import scipy.linalg  # noqa: F401
from threadpoolctl import threadpool_info, threadpool_limits

from greybox.public import one_thread


def threads() -> set[int]:
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


@one_thread
def asked(add: int, *, to: int) -> tuple[int, set[int]]:
    """Say how many threads there are."""
    return add + to, threads()


def test_a_function_has_one_thread_and_its_caller_the_others() -> None:
    with threadpool_limits(2):
        before = threads()
        assert asked(1, to=2) == (3, {1})
        assert threads() == before
    assert asked.__name__ == "asked"
    assert asked.__doc__ == "Say how many threads there are."
