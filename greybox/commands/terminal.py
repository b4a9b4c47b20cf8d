"""Results, errors and progress of a command, on a terminal and in a pipe."""

from __future__ import annotations

import logging
import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from datetime import timedelta
from typing import TYPE_CHECKING, TextIO

from greybox.numerics.effort import seconds_left

if TYPE_CHECKING:
    from rich.progress import Progress

LOGGERS = ("greybox", "experiment_design")
_QUIET: ContextVar[bool] = ContextVar("quiet", default=False)
_VERDICT = r"(?m)^((?:[Vv]erdict|Prediction|Coefficients): )(do not trust|trust except|\w+)"
# red and green; other verdicts are yellow
_TONES = {"do not trust": 31, "poor": 31, "unexplained": 31, "trust": 32, "good": 32, "none": 32}
# the bar that is on the screen: one at most
_shown: list[Progress] = []


def coloured(stream: TextIO) -> bool:
    """Whether a stream shows colours: a terminal, and neither NO_COLOR nor a dumb one."""
    return stream.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def complain(text: str) -> None:
    """Tell the user in one line what stopped a command, whatever names a damaged file holds."""
    clear()
    text = _printable(text)
    if coloured(sys.stderr):
        text = re.sub("^[^:]*:?", "\x1b[1;31m\\g<0>\x1b[0m", text)
    sys.stderr.write(text + "\n")


def say(text: str) -> None:
    """Print a result for the user, unless quiet was asked for."""
    if _QUIET.get():
        return
    clear()
    if coloured(sys.stdout):
        tone = "{}\x1b[1;{}m{}\x1b[0m".format
        text = re.sub(_VERDICT, lambda m: tone(m[1], _TONES.get(m[2], 33), m[2]), text)
    sys.stdout.write(text + "\n")


def clear() -> None:
    """Take the bar off the screen."""
    while _shown:
        _shown.pop().stop()


def _show(text: str, done: int = 0, total: int | None = None) -> None:
    """Show what is being done: of some steps how many, with the time that is left."""
    if _QUIET.get() or not sys.stderr.isatty() or os.environ.get("TERM") == "dumb":
        return
    counting = bool(_shown) and _shown[0].tasks[0].total is not None
    if done == total or (total is not None and not counting):
        clear()
    # steps that are counted stay on the screen while parts of one are told
    if done == total or (total is None and counting):
        return
    if not _shown:
        from rich import progress as rich
        from rich.console import Console
        from rich.table import Column

        console = Console(stderr=True)
        # what is said may be long: the time beside it stays on the line
        room = Column(no_wrap=True, max_width=max(console.width - 12, 1))
        what = rich.TextColumn("{task.description}", markup=False, table_column=room)
        left = (rich.BarColumn(), rich.TimeRemainingColumn(), "left")
        # steps may take minutes, so the time left is told by all of them
        bar = rich.Progress(
            rich.SpinnerColumn(), what, *(left if total else [rich.TimeElapsedColumn()]),
            console=console, transient=True, speed_estimate_period=float("inf"),
            redirect_stdout=False, redirect_stderr=False,
        )  # fmt: skip
        bar.add_task("", total=total)
        bar.start()
        _shown.append(bar)
    task = _shown[0].task_ids[0]
    _shown[0].update(task, description=_printable(text), completed=done, total=total, refresh=True)


def progress(title: str) -> Callable[[int, int], None]:
    """Return a callback that shows progress on a terminal and is silent elsewhere."""
    return lambda done, total: _show(f"{title}: {done} of {total}", done, total)


class _Teller(logging.Handler):
    """Writes records to standard error as lines, or shows the last one while it holds."""

    lines = False

    def emit(self, record: logging.LogRecord) -> None:
        """Write or show one record; its logger where all is told."""
        text = record.getMessage()
        if self.lines:
            clear()
            name = f"{record.name}: " if record.levelno < logging.INFO else ""
            # seconds since the program began
            sys.stderr.write(f"[{record.relativeCreated / 1000:7.2f} s] {name}{text}\n")
        else:
            left = seconds_left()
            limit = "" if left == float("inf") else f" (at most {timedelta(0, int(left))} left)"
            _show(text + limit)


@contextmanager
def telling(verbose: int, quiet: bool) -> Iterator[None]:
    """Tell what is done while the block runs: ``verbose`` 1 in few lines, 2 in all, 0 by a bar.

    Results and the bar are not shown where ``quiet`` is asked for.
    """
    teller = _Teller()
    teller.lines = verbose > 0
    with ExitStack() as undo:
        # where it keeps its fonts is nothing that a user asked for
        logging.getLogger("matplotlib").setLevel(logging.ERROR)
        for logger in map(logging.getLogger, LOGGERS if verbose or sys.stderr.isatty() else ()):
            undo.callback(logger.setLevel, logger.level)
            undo.callback(logger.removeHandler, teller)
            logger.addHandler(teller)
            logger.setLevel(logging.DEBUG if verbose > 1 else logging.INFO)
        undo.callback(_QUIET.reset, _QUIET.set(quiet))
        undo.callback(clear)
        yield
