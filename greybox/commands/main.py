"""The console script: finds the sub-commands, runs one, turns errors into one sentence."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import entry_points, version

from greybox.commands.common import complain
from greybox.errors import GreyboxError, suggestion

GROUP = "greybox.commands"


def _options(parser: argparse.ArgumentParser) -> list[str]:
    """Return the option strings of a parser and of its sub-commands."""
    found: list[str] = []
    for action in parser._actions:
        found += action.option_strings
        if isinstance(action, argparse._SubParsersAction):
            found += [o for sub in action.choices.values() for o in _options(sub)]
    return found


class _Parser(argparse.ArgumentParser):
    """A parser that suggests the nearest name for a mistyped one."""

    def error(self, message: str) -> None:  # type: ignore[override]
        if "invalid choice: " in message:
            typed = message.split("invalid choice: ")[1].split("'")[1]
            known = message.split("(choose from ")[-1].rstrip(")").replace("'", "").split(", ")
            message += suggestion(typed, known)
        if message.startswith("unrecognized arguments: "):
            typed = message.split(": ")[1].split()[0]
            known = _options(self)
            message += suggestion(typed, known)
        self.print_usage(sys.stderr)
        self.exit(2, f"{self.prog}: {message}\n")


def build_parser(only: str | None = None) -> argparse.ArgumentParser:
    """Return the parser; modules of sub-commands are imported for their options only.

    Parameters
    ----------
    only : str, optional
        The sub-command that is going to run: the others are then not imported.
    """
    parser = _Parser(
        prog="greybox",
        description="Trustworthy ship models from sea trials: design the trial, read the log, "
        "estimate, show what the simulation gets wrong.",
        epilog="greybox COMMAND --help tells the options of one command.",
    )
    parser.add_argument(
        "--version", action="version", version=f"greybox {version('greybox-marine')}"
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    found = {e.name: e.value for e in entry_points(group=GROUP)}
    for name in sorted(found):
        if only in found and name != only:
            commands.add_parser(name)
            continue
        module = import_module(found[name])
        sub = commands.add_parser(
            name,
            help=module.HELP,
            description=module.HELP,
            epilog=module.EXAMPLES,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        module.add_arguments(sub)
        sub.set_defaults(run=module.run)
    return parser


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
    given = list(sys.argv[1:] if arguments is None else arguments)
    parser = build_parser(given[0] if given and not given[0].startswith("-") else None)
    options = parser.parse_args(given)
    options.typed = given
    try:
        options.run(options)
    except GreyboxError as error:
        complain(f"greybox {options.command}: {error}")
        return 1
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except KeyboardInterrupt:
        complain("greybox: stopped")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
