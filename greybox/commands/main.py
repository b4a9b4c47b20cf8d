"""The console script: finds the sub-commands, runs one, turns errors into one sentence."""

from __future__ import annotations

import argparse
import logging
import os
import shlex
import sys
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

from greybox.commands.common import require_apart
from greybox.commands.completion import offer
from greybox.commands.configuration import configure, find_configuration, require_known
from greybox.commands.parser import Parser, sub_parsers
from greybox.commands.terminal import complain, telling
from greybox.errors import GreyboxError, UsageError
from greybox.numerics.memory import keep_freed_memory
from greybox.registry import entry_points

# as the work goes; commands of other packages follow
ORDER = ("demo", "import", "check", "estimate", "simulate", "compare", "diagnose", "design",
         "predict", "export", "fleet", "reproduce", "completion")  # fmt: skip
ABOUT = ("Trustworthy ship models from sea trials: design the trial, read the log, estimate, show "
         "what the simulation gets wrong.")  # fmt: skip
EXAMPLES = """examples:
  greybox check trial.csv --vessel ship.toml
  greybox estimate trial.csv --vessel ship.toml --out model.json
  greybox diagnose trial.csv --vessel ship.toml --model model.json

'greybox help COMMAND' shows the options and examples of one command. Options that you
use often may stand in greybox.toml. Environment variables: NO_COLOR, GREYBOX_CONFIG,
GREYBOX_CLUSTER.
"""
_log = logging.getLogger(__name__)


def _add_shell(parser: argparse._ActionsContainer, verbose: str) -> None:
    """Add what every command takes, before or after its name."""
    parser.add_argument(
        "-v", "--verbose", action="count", dest=verbose, default=argparse.SUPPRESS,
        help="report on stderr what is read, chosen and solved, with times; -vv reports more",
    )  # fmt: skip
    told = "show errors only; files are written as usual"
    for names, text in ((("-q", "--quiet"), told), (("--no-config",), "read no greybox.toml")):
        parser.add_argument(*names, action="store_true", default=argparse.SUPPRESS, help=text)


def build_parser(only: str | None = None) -> Parser:
    """Return the parser with the options of all sub-commands, or of the one that is to run."""
    parser = Parser(prog="greybox", description=ABOUT, epilog=EXAMPLES)
    shown = f"greybox {version('greybox-marine')}"
    parser.add_argument("--version", action="version", version=shown, help="show the version")
    _add_shell(parser, "verbose")
    parser.set_defaults(verbose=0, quiet=False, no_config=False)
    # without `prog` the usage would be rendered to find it, which loads what renders
    commands = parser.add_subparsers(
        dest="command", metavar="COMMAND", required=True, title="commands", prog="greybox"
    )
    found = {e.name: e.value for e in entry_points(group="greybox.commands")}
    known = [*(n for n in ORDER if n in found), *sorted(found.keys() - set(ORDER))]
    for name in known:
        if only in found and name != only:
            commands.add_parser(name)
            continue
        module = import_module(found[name])
        told = {"help": module.HELP, "description": module.HELP, "epilog": module.EXAMPLES}
        sub = commands.add_parser(name, **told)
        module.add_arguments(sub)
        sub.usage, sub.whole = sub.short_usage(), build_parser
        _add_shell(sub.add_argument_group("output and configuration"), "more_verbose")
        sub.set_defaults(run=module.run, stages=getattr(module, "stages", None))
    topic = commands.add_parser("help", help="show the help of a command", add_help=False)
    topic.add_argument("topic", nargs="?", choices=known, metavar="COMMAND")
    return parser


def _parse(given: list[str]) -> argparse.Namespace:
    """Return the options of the command line, with those of the configuration file."""
    command = next((a for a in given if not a.startswith("-")), "")
    at = given.index(command) if command else len(given)
    if command == "help":
        return _parse([*given[at + 1 : at + 2], "--help"])
    parser = build_parser(command)
    if not given:
        parser.print_help(sys.stderr)
        parser.exit(2)
    parsers = sub_parsers(parser)
    before = parser.for_parts().parse_args(given[:at])
    if command not in parsers:
        return parser.parse_args(given)
    typed = vars(parsers[command].for_parts().parse_args(given[at + 1 :]))
    try:
        folder = Path.cwd()
    except FileNotFoundError:
        raise UsageError(
            "the folder that this is run in was deleted, so paths lead nowhere: change to a "
            "folder that exists."
        ) from None
    require_known(os.environ)
    unread = before.no_config or "no_config" in typed
    path = None if unread else find_configuration(folder, os.environ)
    more, record = configure(path, command, parsers, typed, build_parser) if path else ([], None)
    # behind the files, which an option that takes several would take too
    end = given.index("--") if "--" in given else len(given)
    options = parser.parse_args([*given[:end], *more, *given[end:]])
    options.typed, options.configuration = given, record
    options.named = {*typed, *(record["options"] if record else ())}
    return options


def _open_streams() -> None:
    """Give closed streams a place to write, and all a way to show what they cannot encode."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115
        elif reconfigure := getattr(getattr(sys, name), "reconfigure", None):
            reconfigure(errors="backslashreplace")


def _require_utf8(given: Sequence[str]) -> None:
    for word in given:
        try:
            word.encode()
        except UnicodeEncodeError as error:
            raise UsageError(
                f"'{word}' has bytes that are no UTF-8, the first is number {error.start + 1}, so "
                f"no output could name it: give the file another name."
            ) from None


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line, by default that of the process, and return its exit status.

    0 is done, 1 that the input is at fault, 130 that Ctrl-C stopped it; wrong usage is a
    SystemExit with 2.
    """
    if "_ARGCOMPLETE" in os.environ:
        offer(build_parser())
    name, options = "greybox", argparse.Namespace()
    _open_streams()
    try:
        given = list(sys.argv[1:] if arguments is None else arguments)
        try:
            _require_utf8(given)
            options = _parse(given)
            name = f"greybox {options.command}"
            verbose = options.verbose + getattr(options, "more_verbose", 0)
            stages = getattr(options, "stages", None)
            with telling(verbose, options.quiet, stages(options) if stages else ()):
                _run(options)
        finally:
            # what a full disk refuses is told here, and not when the interpreter ends
            sys.stdout.flush()
    except GreyboxError as error:
        told = str(error)
        if "--vessel V " in told:
            told = told.replace("--vessel V ", f"--vessel {_vessel(options)} ")
        complain(f"{name}: {told}")
        return 1
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        if error.filename is None:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        what = f"use '{error.filename}'" if error.filename else "write an output"
        complain(f"{name}: cannot {what}: {error.strerror}. Mend that, or name another place.")
        return 1
    except KeyboardInterrupt:
        complain("greybox: stopped")
        return 130
    return 0


def _vessel(options: argparse.Namespace) -> str:
    """Return the vessel file that a command names, or that its model was estimated with."""
    from greybox.model.model import load_model
    from greybox.report.next_steps import typed

    if given := getattr(options, "vessel", None):
        return shlex.quote(given)
    for model in (getattr(options, "model", None), *getattr(options, "models", ())):
        if model:
            # this is told of another error, and must raise none
            with suppress(GreyboxError):
                return typed(load_model(model).record.get("provenance", {}), "vessel", "V")
    return "V"


def _run(options: argparse.Namespace) -> None:
    keep_freed_memory()
    if used := options.configuration:
        _log.info("configuration %s gives %s", used["file"], ", ".join(used["options"]))
    require_apart(options)
    with ExitStack() as stack:
        if hasattr(options, "cluster"):
            from greybox.numerics.parallel import on_cluster

            stack.enter_context(on_cluster(options.cluster))
        options.run(options)
    _log.info("done")
