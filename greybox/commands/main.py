"""The console script: finds the sub-commands, runs one, turns errors into one sentence."""

from __future__ import annotations

import argparse
import logging
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

from greybox.commands.common import require_apart
from greybox.commands.configuration import (
    find_configuration,
    parse_configured,
    read_configuration,
)
from greybox.commands.parser import UNKNOWN, Parser, require_known, short_usage, sub_parsers
from greybox.commands.terminal import complain, telling
from greybox.errors import GreyboxError, UsageError
from greybox.registry import entry_points

GROUP = "greybox.commands"
# as the work goes; commands of other packages follow
ORDER = ("demo", "import", "check", "estimate", "simulate", "compare", "diagnose", "design",
         "predict", "export", "reproduce", "completion")  # fmt: skip
EXAMPLES = """examples:
  greybox check trial.csv --vessel ship.toml
  greybox estimate trial.csv --vessel ship.toml --out model.json
  greybox diagnose trial.csv --vessel ship.toml --model model.json

'greybox help COMMAND' shows the options and examples of one command. Options that you
repeat may stand in greybox.toml; NO_COLOR, GREYBOX_CONFIG and GREYBOX_CLUSTER are heeded.
"""
_log = logging.getLogger(__name__)


def _add_shell(parser: argparse.ArgumentParser, *, after: bool) -> None:
    """Add what every command takes, before or after its name."""
    default = argparse.SUPPRESS if after else False
    group = parser.add_argument_group("what is shown, and what is read") if after else parser
    group.add_argument(
        "-v", "--verbose", action="count", dest="more_verbose" if after else "verbose",
        default=argparse.SUPPRESS if after else 0,
        help="tell on stderr what is read, chosen and solved, and when; -vv tells more",
    )  # fmt: skip
    for names, told in (
        (("-q", "--quiet"),
         "show no results and no progress, errors only; files are written as always"),
        (("--no-config",), "read no greybox.toml"),
    ):  # fmt: skip
        group.add_argument(*names, action="store_true", default=default, help=told)


def build_parser(only: str | None = None) -> argparse.ArgumentParser:
    """Return the parser; modules of sub-commands are imported for their options only.

    Parameters
    ----------
    only : str, optional
        The sub-command that is going to run: the others are then not imported.
    """
    parser = Parser(
        prog="greybox",
        description="Trustworthy ship models from sea trials: design the trial, read the log, "
        "estimate, show what the simulation gets wrong.",
        epilog=EXAMPLES,
    )
    parser.add_argument(
        "--version", action="version", version=f"greybox {version('greybox-marine')}",
        help="show the version",
    )  # fmt: skip
    _add_shell(parser, after=False)
    # without `prog` the usage would be rendered to find it, which loads what renders
    commands = parser.add_subparsers(
        dest="command", metavar="COMMAND", required=True, title="commands", prog="greybox"
    )
    found = {e.name: e.value for e in entry_points(group=GROUP)}
    known = [*(n for n in ORDER if n in found), *sorted(found.keys() - set(ORDER))]
    for name in known:
        if only in found and name != only:
            commands.add_parser(name)
            continue
        module = import_module(found[name])
        sub = commands.add_parser(
            name, help=module.HELP, description=module.HELP, epilog=module.EXAMPLES
        )
        module.add_arguments(sub)
        sub.usage = short_usage(sub)
        _add_shell(sub, after=True)
        sub.set_defaults(run=module.run)
    topic = commands.add_parser("help", help="show the help of a command", add_help=False)
    topic.add_argument("topic", nargs="?", choices=known, metavar="COMMAND")
    return parser


def _parse(given: list[str]) -> argparse.Namespace:
    """Return the options of the command line, with those of the configuration file.

    Raises
    ------
    ConfigurationError
        The configuration file is at fault.
    UsageError
        The folder that the command is run in does not exist.
    """
    command = next((a for a in given if not a.startswith("-")), "")
    if command == "help":
        at = given.index(command)
        given = [*given[at + 1 : at + 2], "--help"]
        command = given[0]
    parser = build_parser(command)
    if not given:
        parser.print_help(sys.stderr)
        parser.exit(2)
    own = sub_parsers(parser).get(command)
    if own is None or {"-h", "--help", "--version"} & set(given):
        return parser.parse_args(given)
    at = given.index(command)
    require_known(parser, given[:at])
    require_known(own, given[at:])
    # options may be abbreviated
    unread = any(g.startswith("--no-c") and "--no-config".startswith(g) for g in given)
    path = None if unread else find_configuration(_folder(), os.environ)
    options, left = (
        parser.parse_known_args(given)
        if path is None
        else parse_configured(read_configuration(path), command, given, parser, build_parser)
    )
    if left:
        own.error(UNKNOWN + " ".join(left))
    return options


def _folder() -> Path:
    """Return the folder that the command is run in."""
    try:
        return Path.cwd()
    except FileNotFoundError:
        raise UsageError(
            "the folder that this is run in was deleted, so paths lead nowhere: change to a "
            "folder that exists."
        ) from None


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status.

    Parameters
    ----------
    arguments : sequence of str, optional
        By default those of the process.

    Returns
    -------
    int
        0 done, 1 the input is at fault, 2 wrong usage (by SystemExit).
    """
    if "_ARGCOMPLETE" in os.environ:
        from greybox.commands.completion import offer

        offer(build_parser())
    name = "greybox"
    try:
        given = list(sys.argv[1:] if arguments is None else arguments)
        options = _parse(given)
        options.typed = given
        name = f"greybox {options.command}"
        verbose = options.verbose + getattr(options, "more_verbose", 0)
        with telling(verbose, options.quiet):
            _run(options)
    except GreyboxError as error:
        complain(f"{name}: {error}")
        return 1
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except KeyboardInterrupt:
        complain("greybox: stopped")
        return 1
    return 0


def _run(options: argparse.Namespace) -> None:
    _folder()
    used = getattr(options, "configuration", None)
    if used is not None:
        _log.info("configuration %s gives %s", used["file"], ", ".join(used["options"]))
    require_apart(options)
    if hasattr(options, "cluster"):
        from greybox.numerics.parallel import on_cluster

        with on_cluster(options.cluster):
            options.run(options)
    else:
        options.run(options)
    _log.info("done")


if __name__ == "__main__":
    sys.exit(main())
