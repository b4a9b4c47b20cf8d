"""Seconds that a choice may take: long computations ask between their steps whether time is left.

The limit stands for everything that is computed inside a ``with within(seconds)``. Where there
is none, or where it is ample, nothing that is computed depends on the clock.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from greybox.errors import OutOfTimeError

# seconds that a choice may take by default, ample for all but the longest logs
EFFORT = 600.0

_end: ContextVar[float] = ContextVar("end", default=float("inf"))
# the end that was asked for, also where what must end heeds none
_asked: ContextVar[float] = ContextVar("asked", default=float("inf"))


def seconds_left() -> float:
    """Return the seconds that are left, infinite where there is no limit."""
    return _end.get() - time.monotonic()


def require_time() -> None:
    """Go on only while time is left.

    Raises
    ------
    OutOfTimeError
        The limit is over.
    """
    if seconds_left() <= 0:
        raise OutOfTimeError("time ran out; allow more with --effort.")


@contextmanager
def within(seconds: float) -> Iterator[None]:
    """Limit what follows to some seconds, or to what is left where that is less."""
    end = min(_end.get(), time.monotonic() + seconds)
    token, asked = _end.set(end), _asked.set(end)
    try:
        yield
    finally:
        _end.reset(token)
        _asked.reset(asked)


@contextmanager
def without_limit() -> Iterator[None]:
    """Let what follows end, however long it takes: there must be something to give."""
    token = _end.set(float("inf"))
    try:
        yield
    finally:
        _end.reset(token)


@contextmanager
def optional() -> Iterator[None]:
    """Limit what may be left out of what must end."""
    token = _end.set(min(_end.get(), _asked.get()))
    try:
        yield
    finally:
        _end.reset(token)


class Shares:
    """Equal shares of the time that is left, for tasks one after another.

    What a task does not use goes to those after it.

    Parameters
    ----------
    tasks : int
    """

    def __init__(self, tasks: int) -> None:
        self._tasks = tasks

    @contextmanager
    def next(self) -> Iterator[None]:
        """Limit the next task to its share."""
        with within(seconds_left() / max(self._tasks, 1)):
            self._tasks -= 1
            yield
