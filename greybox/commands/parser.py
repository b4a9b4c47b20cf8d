"""The parser of the command line: one sentence for what is mistyped, with the nearest name."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NoReturn

from rich_argparse import RawDescriptionRichHelpFormatter, RichHelpFormatter

from greybox.commands.terminal import complain
from greybox.errors import suggestion

if TYPE_CHECKING:
    from rich.text import Text

OUTPUTS = ("out", "json", "report", "sheet", "legs", "save_model")
FOLDER = "/"
# the files that an argument names, by its metavar: their endings, none where any will do
_ENDINGS: dict[str | tuple[str, ...] | None, tuple[str, ...]] = {
    "V": ("toml",), "LOG": ("csv", "parquet", "pq"), "RAW": (), "MODEL": ("json",),
    ("A", "B"): ("json",), "D": ("json",), "HTML": ("html",), "CSV": ("csv",), "PLAN": ("csv",),
    "F": (), "FILE": (), "DIR": (FOLDER,),
}  # fmt: skip
_CHOICE = re.compile(r"invalid choice: (['\"])(?P<typed>.*)\1 \(choose from (?P<known>.*)\)$")
_VALUE = re.compile(r"invalid (?P<kind>.*) value: (['\"])(?P<typed>.*)\2$")
_PLAIN = {"int": "whole number", "float": "number"}
UNKNOWN = "unrecognized arguments: "


class Formatter(RawDescriptionRichHelpFormatter):
    """Coloured help with examples kept as written, and names beside their explanation."""

    help_markup = text_markup = False  # [m/s] is a unit
    group_name_formatter = str

    def __init__(self, prog: str, **given: Any) -> None:
        super().__init__(prog, max_help_position=26, **given)

    def _rich_fill_text(self, text: Text, width: int, indent: Text) -> Text:
        kept = RawDescriptionRichHelpFormatter if "\n" in text.plain else RichHelpFormatter
        return kept._rich_fill_text(self, text, width, indent)


def endings(action: argparse.Action) -> tuple[str, ...] | None:
    """Return the endings of the files that an argument names, None where it names no file."""
    # with a type it is a number, whatever letter stands for it
    return None if action.type is not None else _ENDINGS.get(action.metavar)


def long_options(parser: argparse.ArgumentParser) -> dict[str, argparse.Action]:
    """Return the long options of a parser, without those of its sub-commands."""
    return {o: a for o, a in parser._option_string_actions.items() if o.startswith("--")}


def sub_parsers(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """Return the parsers of the sub-commands by name."""
    found = [a.choices for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
    return dict(found[0]) if found else {}


def short_usage(parser: argparse.ArgumentParser) -> str:
    """Return how a command is typed, its many options in one word."""
    words = [parser.prog]
    for action in parser._actions:
        if action.required:
            name = action.metavar if isinstance(action.metavar, str) else action.dest.upper()
            several = f"{name} [{name} ...]" if action.nargs == "+" else name
            words.append(" ".join([*action.option_strings[-1:], several]))
    return " ".join([*words, "[OPTION ...]"]).replace("%", "%%")


def require_known(parser: argparse.ArgumentParser, given: Sequence[str]) -> None:
    """End with status 2 at an option that a command does not have.

    Parsed with it, the command line would seem to lack what was mistyped.
    """
    known = long_options(parser)
    for text in given[: given.index("--") if "--" in given else None]:
        option = text.split("=")[0]
        if option.startswith("--") and not any(k.startswith(option) for k in known):
            parser.error(UNKNOWN + text)


def plainly(message: str, known: Sequence[str] = ()) -> str:
    """Return what argparse finds wrong as a sentence, with the nearest of the known names."""
    if found := _CHOICE.search(message):
        choices = found["known"].replace("'", "").split(", ")
        what = message[: found.start()].removeprefix("argument ").rstrip(": ")
        message = (
            f"{what.lower() if what.isupper() else what} '{found['typed']}' is not known."
            f"{suggestion(found['typed'], choices)} Known: {', '.join(choices)}."
        )
    elif found := _VALUE.search(message):
        kind = _PLAIN.get(found["kind"], found["kind"])
        message = f"{message[: found.start()]}'{found['typed']}' is no {kind}"
    elif message.startswith(UNKNOWN):
        option = message.removeprefix(UNKNOWN).split(" ")[0].split("=")[0]
        message = f"there is no option '{option}'.{suggestion(option, known)}"
        if not option.startswith("-"):
            message = f"'{option}' is one argument too many"
    return message.lstrip() + "." * (not message.endswith((".", "?")))


class Parser(argparse.ArgumentParser):
    """A parser that suggests the nearest name for a mistyped one."""

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **{"formatter_class": Formatter} | named)

    def error(self, message: str) -> NoReturn:
        """Exit with status 2 and one sentence."""
        told = plainly(message, list(long_options(self)))
        complain(f"{self.prog}: {told} See '{self.prog} --help'.")
        self.exit(2)
