"""Linear algebra in one thread, the others given back; memory kept for the next array."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest
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


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the C library is not glibc")
def test_memory_of_a_large_array_is_kept_for_the_next() -> None:
    text = """
import resource
import numpy as np
from greybox.numerics.memory import keep_freed_memory

def cleared():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(3):
        np.ones(6_000_000)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

first = cleared()
keep_freed_memory()
np.ones(6_000_000)
print(first, cleared())
"""
    out = subprocess.run([sys.executable, "-c", text], capture_output=True, check=True, text=True)
    before, after = map(int, out.stdout.split())
    assert after < before / 10
