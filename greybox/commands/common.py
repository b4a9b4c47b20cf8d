"""Shared parts of the sub-commands: options, logs, outputs, the record of a computation."""

from __future__ import annotations

import argparse
import logging
import platform
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from hashlib import file_digest
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from greybox.commands.terminal import complain, counted, progress, say

if TYPE_CHECKING:
    from greybox.commands.time_left import Stage
    from greybox.report.next_steps import NextStep
    from greybox.report.page import Page
    from greybox.trial.log import TrialLog
    from greybox.vessel.vessel import Vessel


__all__ = [
    "VESSEL_HELP", "add_cluster", "add_logs", "add_memory", "add_outputs", "add_seed",
    "at_least_one", "by_name", "complain", "configured", "count", "counted", "drawn", "is_named",
    "leave_to_others", "positive", "progress", "provenance", "publish", "read_logs", "say",
    "show_next", "tell_drawing",
]  # fmt: skip

Value = TypeVar("Value")
_log = logging.getLogger(__name__)
# what is told while pages are made
_DRAWING = "drawing the page"
# endings that name a format
_ENDINGS = (".csv", ".parquet", ".pq", ".json", ".toml", ".html", ".pdf", ".png", ".svg")
# GiB that logs and what is made of them may take by default, those of a usual machine
_MEMORY = 4.0
VESSEL_HELP = "vessel file (TOML), as 'greybox import --help' shows one, or thesis or ferry"
# where a command computes changes no result
SHELL_ONLY = (
    "run", "stages", "typed", "named", "verbose", "more_verbose", "quiet", "no_config",
    "configuration", "cluster",
)  # fmt: skip


def add_logs(parser: argparse.ArgumentParser) -> None:
    """Add the log files as positional arguments, and the vessel."""
    parser.add_argument(
        "logs",
        nargs="+",
        metavar="LOG",
        help="logs, CSV or Parquet: files, folders, patterns in quotes, or addresses such as "
        "s3://bucket/folder",
    )
    parser.add_argument("--vessel", required=True, metavar="V", help=VESSEL_HELP)


def add_outputs(parser: argparse.ArgumentParser, result: str, page: str) -> None:
    """Add --json and --report, with what they write in words."""
    parser.add_argument("--json", metavar="F", help=f"write {result} as JSON; - is stdout")
    parser.add_argument("--report", metavar="HTML", help=f"write a page with {page}")


def publish(
    options: argparse.Namespace,
    result: Mapping[str, Any],
    summary: str,
    page: Callable[[], Page],
    next_steps: Sequence[NextStep],
    written: Sequence[str | None] = (),
) -> None:
    """Write a result where --json and --report ask for it, and show it on the terminal.

    Parameters
    ----------
    result : mapping
        For JSON.
    summary : str
        Shown unless the JSON goes to the terminal, with the files that were `written` before.
    page : callable
        Makes the page.
    next_steps : sequence of NextStep
        Shown behind the files.
    """
    from greybox.files import write_json

    if options.json:
        write_json(result, options.json)
    if options.report:
        from greybox.report.page import write_page

        tell_drawing()
        write_page(page(), options.report)
    if options.json != "-":
        say(summary)
        for path in filter(None, (*written, options.report)):
            say(f"wrote {path}")
        show_next(next_steps)


def tell_drawing() -> None:
    """Tell that a page is being made."""
    _log.info(_DRAWING)


def drawn(options: argparse.Namespace, share: float) -> list[Stage]:
    """Return the stage of making the page, where one is asked for."""
    return [(_DRAWING, share)] if options.report else []


def show_next(steps: Sequence[NextStep]) -> None:
    """Show on the terminal what to do next."""
    for step in steps:
        say(step.line())


def positive(text: str) -> float:
    """Return a positive finite number, as an option's type."""
    value = float(text)
    if not 0 < value < float("inf"):
        raise ValueError(text)
    return value


positive.__name__ = "positive number"


def _whole(least: int) -> Callable[[str], int]:
    """Return an option's type: a whole number of at least so much."""

    def read(text: str) -> int:
        value = int(text)
        if value < least:
            raise ValueError(text)
        return value

    read.__name__ = f"whole number of at least {least}"
    return read


count, at_least_one = _whole(0), _whole(1)


def add_seed(parser: argparse.ArgumentParser) -> None:
    """Add --seed."""
    parser.add_argument(
        "--seed", type=count, default=0, metavar="N", help="seed of the random numbers (0)"
    )


def add_memory(parser: argparse._ActionsContainer, text: str) -> None:
    """Add --memory, whose help begins with `text`."""
    parser.add_argument(
        "--memory", type=positive, default=_MEMORY, metavar="GIB", help=f"{text} ({_MEMORY:g})"
    )


def add_cluster(parser: argparse._ActionsContainer) -> None:
    """Add --cluster, which `greybox.commands.main` heeds for the whole command."""
    parser.add_argument(
        "--cluster",
        metavar="ADDRESS",
        help="compute on the Dask cluster of this scheduler, such as tcp://host:8786; by "
        "default that of GREYBOX_CLUSTER, or else this machine",
    )


def read_logs(
    paths: Sequence[str],
    vessel: Vessel,
    sample_time: float | None = None,
    states: tuple[str, ...] = (),
) -> tuple[list[TrialLog], tuple[str, ...]]:
    """Read logs as the segments between gaps, decimated where a sample time is asked for.

    Parameters
    ----------
    paths : sequence of str
        As `find_logs`. What a folder or a pattern holds beside logs is left out.

    Returns
    -------
    tuple of (list of TrialLog, tuple of str)
        The segments, and a sentence for each column that holds another unit, frame or sign
        than its name, for each gap, and for each file and segment that was left out.
    """
    from greybox.errors import LogError
    from greybox.trial.checks.check import misnamed_columns
    from greybox.trial.convert.read import read_segments
    from greybox.trial.kinematics import decimate_segments
    from greybox.trial.log_files import find_logs, local_copy
    from greybox.trial.segments import find_log_gaps, join_segments

    logs: list[TrialLog] = []
    misnamed: list[str] = []
    told: list[str] = []
    refused: LogError | None = None
    for file in counted("reading logs", find_logs(paths)):
        try:
            with local_copy(file.path) as path:
                segments = read_segments(path, vessel, states=states)
                misnamed += misnamed_columns([path], vessel)
        except LogError as error:
            if not file.found:
                raise
            refused = refused or error
            told.append(f"'{file.name}' was left out: {error}")
            continue
        logs += segments
        told += [g.sentence for g in find_log_gaps(join_segments(segments, path.stem))]
    if refused is not None and not logs:
        raise refused
    if sample_time is None or not logs:
        return logs, (*misnamed, *told)
    logs, left_out = decimate_segments(logs, sample_time)
    return logs, (*misnamed, *told, *left_out)


def require_ending(path: str | None, ending: str, what: str, option: str = "--out") -> None:
    """Raise where what an option writes would have the ending of another format.

    Raises
    ------
    UsageError
        Commands that read files by their endings would take it for another.
    """
    from greybox.errors import UsageError

    if path is not None and Path(path).suffix.casefold() in {*_ENDINGS} - {ending}:
        raise UsageError(
            f"{option} names '{path}', and {what} is {ending[1:].upper()}: name a file that ends "
            f"in {ending}."
        )


def require_log_ending(path: str) -> None:
    """Raise where a log would be written under the ending of another format.

    Raises
    ------
    UsageError
        Commands that read files by their endings would take it for another.
    """
    from greybox.errors import UsageError
    from greybox.trial.log_files import ENDINGS

    if (ending := Path(path).suffix).lower() not in ("", *ENDINGS):
        raise UsageError(
            f"--out {path} ends in '{ending}': name a log that ends in .csv or .parquet."
        )


# options that name files to read, and to write
_INPUTS = (
    "logs", "log", "models", "model", "nominal", "validate", "estimate", "vessel", "prior",
    "between", "area", "raw", "trial", "after", "diagnosis", "plan",
)  # fmt: skip
# those of logs, which folders and patterns may stand for
_LOGS = ("logs", "log", "validate", "estimate")
OUTPUTS = ("out", "json", "report", "sheet", "legs", "save_model")
# raw files are hashed as they are imported
_HASHED = tuple(n for n in _INPUTS if n != "raw")
# what is typed for the terminal's sake, and changes no result
_TALK = ("-v", "-vv", "--verbose", "-q", "--quiet", "--no-config")
_PACKAGES = ("casadi", "numpy", "scipy")


def provenance(options: argparse.Namespace) -> dict[str, Any]:
    """Return how a result was made, without wall time.

    Returns
    -------
    dict
        ``program``, ``versions`` of what computes, the ``command`` by options and as
        the ``line`` that was typed, ``inputs``: the SHA-256 of every file that was read,
        and the ``configuration`` file where one was used.
    """
    shown = {k: v for k, v in vars(options).items() if k not in SHELL_ONLY and v is not None}
    used, typed = getattr(options, "configuration", None), getattr(options, "typed", [])
    return {
        "program": f"greybox-marine {version('greybox-marine')}",
        "versions": {n: version(n) for n in _PACKAGES} | {"Python": platform.python_version()},
        "command": shown,
        "line": shlex.join(["greybox", *(t for t in typed if t not in _TALK)]),
        "inputs": _hashes(shown),
        **({} if used is None else {"configuration": used}),
    }


def _hashes(shown: Mapping[str, Any]) -> dict[str, str]:
    """Return the SHA-256 of each file that options name to be read; built-in names have none."""
    from greybox.trial.log_files import find_logs, is_address

    found: dict[str, str] = {}
    for name in _HASHED:
        paths = [p for p in _paths(shown.get(name)) if not is_address(p)]
        if name in _LOGS:
            paths = [file.path for file in find_logs(paths)]
        for path in paths:
            if Path(path).is_file():
                with open(path, "rb") as handle:
                    found[path] = file_digest(handle, "sha256").hexdigest()
    return found


def _paths(given: Any) -> list[str]:
    """Return what an option names as files."""
    several = given if isinstance(given, (list, tuple)) else [given]
    return [g for g in several if isinstance(g, str) and g != "-"]


def configured(options: argparse.Namespace) -> list[str]:
    """Return the options that the configuration file gives; what is removed is not recorded."""
    record: dict[str, list[str]] = getattr(options, "configuration", None) or {}
    return record.get("options", [])


def by_name(option: str, found: Iterable[tuple[str, Value]]) -> dict[str, Value]:
    """Return what an option gives by name.

    Raises
    ------
    UsageError
        A name stands twice.
    """
    from greybox.errors import UsageError

    values: dict[str, Value] = {}
    for name, value in found:
        if name in values:
            raise UsageError(f"{option} gives '{name}' twice: keep one of them.")
        values[name] = value
    return values


def is_named(options: argparse.Namespace, name: str) -> bool:
    """Return whether an option stands on the command line or in the file, if as its default."""
    return name in getattr(options, "named", ())


def leave_to_others(options: argparse.Namespace, name: str, default: Any) -> bool:
    """Take back an option that only the configuration file gives; return whether it was one.

    What stands there for other uses of a command is no mistake of this one.
    """
    if name not in (given := configured(options)):
        return False
    given.remove(name)
    options.named.discard(name)
    setattr(options, name, default)
    return True


def require_apart(options: argparse.Namespace) -> None:
    """Raise where an output would replace an input or another output, or a file has no name.

    Raises
    ------
    UsageError
        Names the file and both options.
    """
    from greybox.errors import UsageError
    from greybox.files import real_path

    require_ending(getattr(options, "report", None), ".html", "a page", "--report")
    taken: dict[Path, str] = {}
    for name in _INPUTS:
        paths = _paths(getattr(options, name, None))
        if "" in paths:
            raise UsageError(f"a file of {name} has an empty name: name a file.")
        taken |= {real_path(p): name for p in paths}
    for name in OUTPUTS:
        option = name.replace("_", "-")
        # --legs alone names its file itself
        if name != "legs" and getattr(options, name, None) == "":
            raise UsageError(f"--{option} is empty: name what to write, or leave it out.")
        if name != "json" and getattr(options, name, None) == "-":
            raise UsageError(
                f"--{option} is '-', and only --json writes to standard output: name a file."
            )
        for path in _paths(getattr(options, name, None)):
            place = real_path(path)
            # a device takes everything
            if place in taken and (place.is_file() or not place.exists()):
                raise UsageError(
                    f"--{option} would write over '{path}', which {taken[place]} names too: name "
                    f"another file."
                )
            taken[place] = name
