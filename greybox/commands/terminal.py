"""What a command shows, and where: results, errors, progress, what it is doing."""

from __future__ import annotations

import logging
import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import timedelta
from typing import TYPE_CHECKING, TextIO

from greybox.numerics.effort import seconds_left

if TYPE_CHECKING:
    from rich.progress import Progress

LOGGERS = ("greybox", "experiment_design")
_QUIET: ContextVar[bool] = ContextVar("quiet", default=False)
_RED, _GREEN, _YELLOW = "31", "32", "33"
_VERDICT = re.compile(
    r"^(?P<label>(?:[Vv]erdict|Prediction|Coefficients): )(?P<word>do not trust|trust except|\w+)",
    re.MULTILINE,
)
_TONES = {"trust": _GREEN, "good": _GREEN, "none": _GREEN, "do not trust": _RED, "poor": _RED,
          "unexplained": _RED}  # fmt: skip
# the bar that is on the screen: one at most
_shown: list[Progress] = []


def coloured(stream: TextIO) -> bool:
    """Whether a stream shows colours: a terminal, and neither NO_COLOR nor a dumb one."""
    return stream.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"


def _paint(text: str, colour: str) -> str:
    return f"\x1b[1;{colour}m{text}\x1b[0m"


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def complain(text: str) -> None:
    """Tell the user in one line what stopped a command, whatever names a damaged file holds."""
    clear()
    text = _printable(text)
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


def clear() -> None:
    """Take the bar off the screen."""
    while _shown:
        _shown.pop().stop()


def _bar(counted: bool) -> Progress:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        SpinnerColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.table import Column

    one_line = Column(no_wrap=True, overflow="ellipsis")
    text = TextColumn("{task.description}", markup=False, table_column=one_line)
    time = (BarColumn(), TimeRemainingColumn(), "left") if counted else (TimeElapsedColumn(),)
    # steps may take minutes, so the time left is told by all of them
    return Progress(
        SpinnerColumn(), text, *time, console=Console(stderr=True), transient=True,
        speed_estimate_period=float("inf"), redirect_stdout=False, redirect_stderr=False,
    )  # fmt: skip


def _show(text: str, done: int = 0, total: int | None = None) -> None:
    """Show what is being done: of some steps how many, with the time that is left."""
    if _QUIET.get() or not sys.stderr.isatty() or os.environ.get("TERM") == "dumb":
        return
    counting = bool(_shown) and _shown[0].tasks[0].total is not None
    if total is None and counting:
        return
    if total is not None and (done >= total or not counting):
        clear()
    if total is None or done < total:
        text = _printable(text)
        if not _shown:
            _shown.append(_bar(total is not None))
            _shown[0].add_task(text, total=total, completed=done)
            _shown[0].start()
        _shown[0].update(
            _shown[0].task_ids[0], description=text, completed=done, total=total, refresh=True
        )


def progress(title: str) -> Callable[[int, int], None]:
    """Return a callback that shows progress on a terminal and is silent elsewhere."""
    return lambda done, total: _show(f"{title}: {done} of {total}", done, total)


class _Teller(logging.Handler):
    """Writes records to standard error as lines, or shows the last one while it holds."""

    def __init__(self, lines: bool) -> None:
        super().__init__()
        self._lines = lines

    def emit(self, record: logging.LogRecord) -> None:
        """Write or show one record; its logger where all is told."""
        text = record.getMessage()
        if self._lines:
            clear()
            name = f"{record.name}: " if record.levelno < logging.INFO else ""
            # seconds since the program began
            sys.stderr.write(f"[{record.relativeCreated / 1000:7.2f} s] {name}{text}\n")
            return
        left = seconds_left()
        limit = "" if left == float("inf") else f" (at most {timedelta(seconds=int(left))} left)"
        _show(text + limit)


@contextmanager
def telling(verbose: int, quiet: bool) -> Iterator[None]:
    """Tell what is done while the block runs: ``verbose`` 1 in few lines, 2 in all.

    Parameters
    ----------
    verbose : int
        0 shows on a terminal what is being done, and leaves no line of it.
    quiet : bool
        Results and progress are not shown either.
    """
    token = _QUIET.set(quiet)
    loggers = [logging.getLogger(name) for name in LOGGERS]
    if not (verbose or sys.stderr.isatty()):
        loggers = []
    levels = [logger.level for logger in loggers]
    teller = _Teller(lines=verbose > 0)
    for logger in loggers:
        logger.addHandler(teller)
        logger.setLevel(logging.DEBUG if verbose > 1 else logging.INFO)
    try:
        yield
    finally:
        clear()
        for logger, level in zip(loggers, levels, strict=True):
            logger.removeHandler(teller)
            logger.setLevel(level)
        _QUIET.reset(token)
