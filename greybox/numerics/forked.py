"""One map over a few heavy pieces of one computation, on all processors of this machine."""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any, TypeVar

Piece = TypeVar("Piece")
Result = TypeVar("Result")

# what the processes of a map are to do: they inherit it, so that it need not be sent
_work: tuple[Callable[[Any], Any], Sequence[Any]] | None = None


def processors() -> int:
    """Return how many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def lanes() -> int:
    """Return how many pieces `map_forked` computes at a time: 1 where it does so one by one.

    A copy of a process is safe where no other thread runs in it; one of several that a study
    started leaves the other processors to those.
    """
    alone = len(sys._current_frames()) == 1
    first = multiprocessing.current_process().name == "MainProcess"
    return processors() if sys.platform == "linux" and alone and first else 1


def map_forked(function: Callable[[Piece], Result], pieces: Sequence[Piece]) -> list[Result]:
    """Apply a function to pieces, results in their order, in copies of this process.

    The copies know all that this process knows, so function and pieces may be anything; what
    they change is lost but for the results, which must be picklable.

    Parameters
    ----------
    function : callable
    pieces : sequence

    Raises
    ------
    Exception
        The first one that the function raises.
    """
    global _work
    count = min(lanes(), len(pieces))
    if count < 2:
        return [function(piece) for piece in pieces]
    _work = (function, pieces)
    try:
        context = multiprocessing.get_context("fork")
        with ProcessPoolExecutor(count, mp_context=context) as pool:
            return list(pool.map(_one, range(len(pieces))))
    finally:
        _work = None


def _one(index: int) -> Any:
    assert _work is not None
    function, pieces = _work
    return function(pieces[index])
