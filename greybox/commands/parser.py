"""The parser of the command line: one sentence for what is mistyped, with the nearest name."""

from __future__ import annotations

import argparse
import re
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
