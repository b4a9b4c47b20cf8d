"""What a command shows, and where: results, errors, progress, what it is doing."""

from __future__ import annotations

import logging
import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TextIO

# back to the first column, and the line erased
CLEAR = "\r\x1b[K"
LOGGERS = ("greybox", "experiment_design")
_QUIET: ContextVar[bool] = ContextVar("quiet", default=False)
_RED, _GREEN, _YELLOW = "31", "32", "33"
_VERDICT = re.compile(
    r"^(?P<label>(?:[Vv]erdict|Prediction|Coefficients): )(?P<word>do not trust|trust except|\w+)",
    re.MULTILINE,
)
_TONES = {"trust": _GREEN, "good": _GREEN, "none": _GREEN, "do not trust": _RED, "poor": _RED,
          "unexplained": _RED}  # fmt: skip


def coloured(stream: TextIO) -> bool:
    """Whether a stream shows colours: a terminal, and neither NO_COLOR nor a dumb one."""
    return stream.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"


def _paint(text: str, colour: str) -> str:
    return f"\x1b[1;{colour}m{text}\x1b[0m"


def clear() -> None:
    """Erase progress that was broken off."""
    if sys.stderr.isatty():
        sys.stderr.write(CLEAR)
        sys.stderr.flush()


def complain(text: str) -> None:
    """Tell the user in one line what stopped a command, whatever names a damaged file holds."""
    clear()
    text = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
    if coloured(sys.stderr):
        who, sign, what = text.partition(": ")
        text = _paint(who + sign.rstrip(), _RED) + " " * bool(sign) + what
    sys.stderr.write(text + "\n")


def say(text: str) -> None:
    """Print a result for the user, unless quiet was asked for."""
    if _QUIET.get():
        return
    clear()
    if coloured(sys.stdout):
        text = _VERDICT.sub(
            lambda m: m["label"] + _paint(m["word"], _TONES.get(m["word"], _YELLOW)), text
        )
    sys.stdout.write(text + "\n")


def shows_progress() -> bool:
    """Whether progress is to be shown: on a terminal, unless quiet was asked for."""
    return sys.stderr.isatty() and not _QUIET.get()


def progress(title: str) -> Callable[[int, int], None]:
    """Return a callback that shows progress on a terminal and is silent elsewhere."""
    if not shows_progress():
        return lambda done, total: None

    def show(done: int, total: int) -> None:
        text = "" if done >= total else f"{title}: {done} of {total}"
        sys.stderr.write(CLEAR + text)
        sys.stderr.flush()

    return show


def activity() -> Callable[[str], None]:
    """Return a callback that shows what is being done on a terminal and is silent elsewhere."""
    if not shows_progress():
        return lambda text: None

    def show(text: str) -> None:
        sys.stderr.write(f"{CLEAR}{text} …")
        sys.stderr.flush()

    return show


class _Teller(logging.Handler):
    """Writes records to standard error, on a line of their own."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write one record."""
        clear()
        sys.stderr.write(self.format(record) + "\n")


class _Elapsed(logging.Formatter):
    """Seconds since the program began, then the message; its logger where all is told."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line of a record."""
        name = f"{record.name}: " if record.levelno < logging.INFO else ""
        return f"[{record.relativeCreated / 1000:7.2f} s] {name}{record.getMessage()}"


@contextmanager
def telling(verbose: int, quiet: bool) -> Iterator[None]:
    """Tell what is done while the block runs: ``verbose`` 1 in few lines, 2 in all.

    Parameters
    ----------
    verbose : int
        0 tells nothing.
    quiet : bool
        Results and progress are not shown either.
    """
    token = _QUIET.set(quiet)
    loggers = [logging.getLogger(name) for name in LOGGERS] if verbose else []
    levels = [logger.level for logger in loggers]
    teller = _Teller()
    teller.setFormatter(_Elapsed())
    for logger in loggers:
        logger.addHandler(teller)
        logger.setLevel(logging.INFO if verbose == 1 else logging.DEBUG)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.removeHandler(teller)
            logger.setLevel(level)
        _QUIET.reset(token)
