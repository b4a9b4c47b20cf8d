"""Results, errors and progress of a command, on a terminal and in a pipe."""

from __future__ import annotations

import logging
import os
import re
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from datetime import timedelta
from typing import TYPE_CHECKING, TextIO, TypeVar

from greybox.commands.time_left import Stage, TimeLeft, in_words
from greybox.numerics.effort import seconds_left

if TYPE_CHECKING:
    from rich.progress import Progress

Item = TypeVar("Item")

LOGGERS = ("greybox", "experiment_design")
_log = logging.getLogger(__name__)
_QUIET: ContextVar[bool] = ContextVar("quiet", default=False)
_VERDICT = (
    r"(?m)^((?:[Vv]erdict|Prediction|Coefficients): )"
    r"([Dd]o not (?:trust|predict)|You can predict|trust except|\w+)"
)
# red and green; other verdicts are yellow
_TONES = {"do not trust": 31, "Do not predict": 31, "poor": 31, "unexplained": 31,
          "You can predict": 32, "trust": 32, "good": 32, "none": 32}  # fmt: skip
# the bar that is on the screen: one at most, and drawn by the first process, not by its copies
_shown: list[Progress] = []
_FIRST = os.getpid()
_left: ContextVar[TimeLeft | None] = ContextVar("left", default=None)
# seconds between two pictures of the bar, columns of the bar and of the time beside it
_AGAIN, _BAR, _TIME = 0.25, 16, 18


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
    _draw_again(0)
    while _shown:
        _shown.pop().stop()


def _show(text: str, done: int = 0, total: int | None = None) -> None:
    """Show what is being done: of some steps how many, with the time that is left."""
    if _QUIET.get() or not sys.stderr.isatty() or os.environ.get("TERM") == "dumb":
        return
    if os.getpid() != _FIRST:
        return
    counting = bool(_shown) and _shown[0].tasks[0].fields["counting"]
    # steps that are counted stay on the screen while parts of one are told
    if total is None and counting:
        return
    left = _left.get()
    if left is None:
        _left.set(left := TimeLeft())
    left.tell(text, done, total)
    if done == total:
        clear()
        return
    _draw_again(0)
    if not _shown:
        from rich import progress as rich
        from rich.console import Console
        from rich.table import Column

        console = Console(stderr=True)
        # what is said may be long: the time beside it stays on the line
        room = Column(no_wrap=True, max_width=max(console.width - _BAR - _TIME - 5, 1))
        what = rich.TextColumn("{task.description}", markup=False, table_column=room)
        when = rich.TextColumn("{task.fields[time]}", table_column=Column(no_wrap=True))
        # a thread that draws would keep the work from being shared with copies of this process
        bar = rich.Progress(
            rich.SpinnerColumn(), what, rich.BarColumn(_BAR), when, console=console,
            transient=True, auto_refresh=False, redirect_stdout=False, redirect_stderr=False,
        )  # fmt: skip
        bar.add_task("", total=None, time="", counting=False)
        bar.start()
        _shown.append(bar)
    _shown[0].update(
        _shown[0].task_ids[0], description=_printable(text), counting=total is not None
    )
    _draw()


def _draw(*_: object) -> None:
    """Draw the bar with the time that is left by now, and again in a while."""
    left = _left.get()
    if not _shown or left is None:
        return
    bar, limit = _shown[0], seconds_left()
    seconds, share = left.seconds(), left.share()
    if seconds is not None:
        when = in_words(min(seconds, max(limit, 0)))
    elif limit < float("inf"):
        when = f"at most {timedelta(0, int(max(limit, 0)))} left"
    else:
        when = str(timedelta(0, int(bar.tasks[0].elapsed or 0)))
    total = None if share is None else 1.0
    bar.update(bar.task_ids[0], time=when, completed=share or 0.0, total=total)
    bar.refresh()
    _draw_again(_AGAIN)


def _draw_again(seconds: float) -> None:
    """Let the bar be drawn after some seconds, 0 for never, where the system can wake a process."""
    if hasattr(signal, "setitimer") and signal.getsignal(signal.SIGALRM) is _draw:
        signal.setitimer(signal.ITIMER_REAL, seconds)


def progress(title: str) -> Callable[[int, int], None]:
    """Return a callback that shows progress on a terminal and is silent elsewhere."""
    return lambda done, total: _show(f"{title}: {done} of {total}", done, total)


def counted(title: str, items: Sequence[Item]) -> Iterator[Item]:
    """Yield items, and show on a terminal how many of them are done."""
    show = progress(title)
    for k, item in enumerate(items):
        show(k, len(items))
        yield item
    show(len(items), len(items))


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
            _show(text)


@contextmanager
def telling(verbose: int, quiet: bool, stages: Sequence[Stage] = ()) -> Iterator[None]:
    """Tell what is done while the block runs: ``verbose`` 1 in few lines, 2 in all, 0 by a bar.

    Results and the bar are not shown where ``quiet`` is asked for. The bar tells the time that is
    left by the ``stages`` that are to come, see `TimeLeft`.
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
        # of a warning the user would see a line of this program
        undo.enter_context(warnings.catch_warnings())
        warnings.showwarning = lambda message, *_, **__: _log.info("%s", message)
        undo.callback(_QUIET.reset, _QUIET.set(quiet))
        undo.callback(_left.reset, _left.set(TimeLeft(stages)))
        main = threading.current_thread() is threading.main_thread()
        if main and hasattr(signal, "setitimer") and sys.stderr.isatty():
            undo.callback(signal.signal, signal.SIGALRM, signal.signal(signal.SIGALRM, _draw))
            # reading and writing go on where they were
            signal.siginterrupt(signal.SIGALRM, False)
        undo.callback(clear)
        yield
