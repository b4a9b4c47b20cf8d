"""The parser of the command line: one sentence for what is mistyped, with the nearest name."""

from __future__ import annotations

import argparse
import re
from copy import deepcopy
from functools import partial
from typing import Any, NoReturn

from rich_argparse import RawDescriptionRichHelpFormatter, RichHelpFormatter

from greybox.commands.terminal import complain
from greybox.errors import ConfigurationError, suggestion

_CHOICE = re.compile(r"invalid choice: (['\"])(?P<typed>.*)\1 \(choose from (?P<known>.*)\)$")
_VALUE = re.compile(r"invalid (?P<kind>.*) value: (['\"])(?P<typed>.*)\2$")
_BOTH = re.compile(r"argument (?P<one>\S+): not allowed with argument (?P<other>\S+)$")


class Formatter(RawDescriptionRichHelpFormatter):
    """Coloured help with examples kept as written, and names beside their explanation."""

    help_markup = text_markup = False  # [m/s] is a unit
    group_name_formatter = str

    def _rich_fill_text(self, text: Any, width: int, indent: Any) -> Any:
        kept = RawDescriptionRichHelpFormatter if "\n" in text.plain else RichHelpFormatter
        return kept._rich_fill_text(self, text, width, indent)


def sub_parsers(parser: argparse.ArgumentParser) -> dict[str, Parser]:
    """Return the parsers of the sub-commands by name."""
    found = [a.choices for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
    return dict(found[0]) if found else {}


class Parser(argparse.ArgumentParser):
    """A parser that suggests the nearest name for a mistyped one."""

    # the place in a configuration file that the words come from, where they are not typed
    place = ""

    def __init__(self, *given: Any, **named: Any) -> None:
        usual = {"formatter_class": partial(Formatter, max_help_position=26)}
        super().__init__(*given, **usual | named)

    def short_usage(self) -> str:
        """Return how a command is typed, its many options in one word."""
        shape, words = argparse.HelpFormatter(self.prog), [self.prog]
        for action in filter(lambda a: a.required, self._actions):
            words += [*action.option_strings[-1:], shape._format_args(action, action.dest.upper())]
        return " ".join([*words, "[OPTION ...]"]).replace("%", "%%")

    def for_parts(self) -> Parser:
        """Return a copy that takes a part of a command line, and sets no more than it names.

        Beside a mistyped option the right one would seem missing.
        """
        copy = deepcopy(self)
        for action in copy._actions:
            action.required = False
            action.default = argparse.SUPPRESS if action.option_strings else None
        return copy

    def error(self, message: str) -> NoReturn:
        """Exit with status 2 and one sentence, or raise one about the configuration file."""
        unknown = message.removeprefix("unrecognized arguments: ")
        if found := _CHOICE.search(message):
            known = found["known"].replace("'", "").split(", ")
            what = message[: found.start()].removeprefix("argument ").rstrip(": ")
            what = what.lower() if what.isupper() else what
            near = suggestion(found["typed"], known)
            message = f"{what} '{found['typed']}' is not known.{near} Known: {', '.join(known)}"
        elif found := _VALUE.search(message):
            kind = {"int": "whole number", "float": "number"}.get(found["kind"], found["kind"])
            message = f"{message[: found.start()]}'{found['typed']}' is no {kind}"
        elif found := _BOTH.search(message):
            message = f"{found['other']} and {found['one']} exclude one another: keep one of them"
        elif unknown != message:
            option = re.split("[ =]", unknown)[0]
            message = f"'{option}' is one argument too many"
            if option.startswith("-"):
                near = suggestion(option, self._option_string_actions)
                message = f"there is no option '{option}'.{near}"
        message += "." * (not message.endswith((".", "?")))
        if self.place:
            raise ConfigurationError(f"{self.place}: {re.sub('^argument [^:]*: ', '', message)}")
        complain(f"{self.prog}: {message} See '{self.prog} --help'.")
        self.exit(2)
