"""The parser of the command line: one sentence for what is mistyped, with the nearest name."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

from greybox.commands.terminal import complain
from greybox.errors import suggestion

WIDEST_NAME = 26
_CHOICE = re.compile(r"invalid choice: (['\"])(?P<typed>.*)\1 \(choose from (?P<known>.*)\)$")
_VALUE = re.compile(r"invalid (?P<kind>.*) value: (['\"])(?P<typed>.*)\2$")
_WHAT = {"COMMAND": "command", "study": "study"}
_PLAIN = {"int": "whole number", "float": "number"}


class Formatter(argparse.RawDescriptionHelpFormatter):
    """Help with examples kept as written, and names beside their explanation."""

    def __init__(self, prog: str, **given: Any) -> None:
        super().__init__(prog, max_help_position=WIDEST_NAME, **given)

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        wrapped = argparse.HelpFormatter._fill_text
        lines = super()._fill_text
        return lines(text, width, indent) if "\n" in text else wrapped(self, text, width, indent)


def long_options(parser: argparse.ArgumentParser) -> list[str]:
    """Return the long options of a parser, without those of its sub-commands."""
    return [o for a in parser._actions for o in a.option_strings if o.startswith("--")]


def short_usage(parser: argparse.ArgumentParser) -> str:
    """Return how a command is typed, its many options in one word."""
    needed = [a for a in parser._actions if a.required and a.option_strings]
    words = [parser.prog, *(_typed(a) for a in parser._get_positional_actions())]
    words += [f"{a.option_strings[-1]} {_typed(a)}" for a in needed]
    return " ".join([*words, "[OPTION ...]"]).replace("%", "%%")


def _typed(action: argparse.Action) -> str:
    name = action.metavar if isinstance(action.metavar, str) else action.dest.upper()
    return f"{name} [{name} ...]" if action.nargs == "+" else name


def sub_parsers(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """Return the parsers of the sub-commands by name."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            return dict(action.choices)
    return {}


class Parser(argparse.ArgumentParser):
    """A parser that suggests the nearest name for a mistyped one."""

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **{"formatter_class": Formatter} | named)

    _given: Sequence[str] = ()

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """Parse, and keep what was given: a mistyped option looks like a missing one."""
        self._given = tuple(sys.argv[1:] if args is None else args)
        return super().parse_known_args(args, namespace)

    def parse_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> argparse.Namespace:
        """Parse, and let the sub-command tell what it does not know."""
        options, left = self.parse_known_args(args, namespace)
        if left:
            asked = sub_parsers(self).get(getattr(options, "command", ""), self)
            asked.error(_unknown(left[0], long_options(asked)))
        return options

    def error(self, message: str) -> NoReturn:
        """Exit with status 2 and one sentence."""
        if message.startswith("the following arguments are required"):
            known = long_options(self)
            typed = [g.split("=")[0] for g in self._given if g.startswith("--") and g != "--"]
            strange = [t for t in typed if not any(k.startswith(t) for k in known)]
            message = _unknown(strange[0], known) if strange else message
        if found := _CHOICE.search(message):
            known = found["known"].replace("'", "").split(", ")
            what = message[: found.start()].removeprefix("argument ").rstrip(": ")
            message = (
                f"{_WHAT.get(what, what)} '{found['typed']}' is not known."
                f"{suggestion(found['typed'], known)} Known: {', '.join(known)}."
            )
        elif found := _VALUE.search(message):
            kind = _PLAIN.get(found["kind"], found["kind"])
            message = f"{message[: found.start()]}'{found['typed']}' is no {kind}."
        if not message.endswith((".", "?")):
            message += "."
        complain(f"{self.prog}: {message} See '{self.prog} --help'.")
        self.exit(2)


def _unknown(text: str, known: Sequence[str]) -> str:
    if not text.startswith("-"):
        return f"'{text}' is one argument too many."
    option = text.split("=")[0]
    return f"there is no option '{option}'.{suggestion(option, known)}"
