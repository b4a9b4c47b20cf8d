"""Linear algebra in one thread, and the others given back."""

from __future__ import annotations

import scipy.linalg  # noqa: F401
from threadpoolctl import ThreadpoolController, threadpool_info, threadpool_limits

from greybox.numerics.threads import limit_to_one_thread, one_thread


def threads() -> set[int]:
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


@one_thread()
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


def test_where_one_is_all_nothing_is_set(monkeypatch) -> None:
    """OpenBLAS would begin its threads anew in a copy of a process."""
    with threadpool_limits(1):
        monkeypatch.setattr(ThreadpoolController, "limit", None)
        with limit_to_one_thread():
            assert asked(1, to=2) == (3, {1})
