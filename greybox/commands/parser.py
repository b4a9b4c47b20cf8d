"""The parser of the command line: one sentence for a mistake, with the nearest name."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from copy import deepcopy
from functools import partial
from typing import Any, NoReturn

from rich_argparse import RawDescriptionRichHelpFormatter, RichHelpFormatter

from greybox.commands.common import OUTPUTS
from greybox.commands.terminal import complain
from greybox.errors import ConfigurationError, suggestion

# the messages of argparse, and what is said in their place
_SENTENCES = {
    r"argument (\S+): not allowed with argument (\S+)$":
        r"\2 and \1 exclude one another: keep one of them",
    r"argument (--\S+): expected (at least )?one argument$":
        r"\1 has no value: write it behind, joined by = where it begins with a minus (\1=-1)",
    r"invalid (.*) value: ('.*'|\".*\")$": r"\2 is no \1",
    "is no float$": "is no number",
    "is no int$": "is no whole number",
    r"unrecognized arguments: ([^- ]\S*).*": r"'\1' is one argument too many",
}  # fmt: skip


# words of the field for an option
_ALSO = {"--rudder": "--angle", "--helm": "--angle"}
_SECONDS = {"s": 1.0, "sec": 1.0, "min": 60.0, "h": 3600.0}


class Formatter(RawDescriptionRichHelpFormatter):
    """Coloured help with examples kept as written, and names beside their explanation."""

    help_markup = text_markup = False  # [m/s] is a unit
    group_name_formatter = str

    def _rich_fill_text(self, text: Any, width: int, indent: Any) -> Any:
        kept = RawDescriptionRichHelpFormatter if "\n" in text.plain else RichHelpFormatter
        return kept._rich_fill_text(self, text, width, indent)


class StoreAction(argparse._StoreAction):
    """Keeps the value of an option; of one that takes several, those of each repetition."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        """Keep what was typed; what was typed later of one value alone replaces it."""
        if isinstance(parser, Parser) and option_string and self.nargs in ("+", "*"):
            before = getattr(namespace, self.dest) if self.dest in parser.given else []
            parser.given.add(self.dest)
            values = [*before, *values]
        setattr(namespace, self.dest, values)


def sub_parsers(parser: argparse.ArgumentParser) -> dict[str, Parser]:
    """Return the parsers of the sub-commands by name."""
    found = [a.choices for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
    return dict(found[0]) if found else {}


class Parser(argparse.ArgumentParser):
    """A parser that suggests the nearest name for a mistyped one."""

    # the place in a configuration file that the words come from, where they are not typed
    place = ""
    # makes the parser of all commands, whose options may be typed at the wrong one
    whole: Callable[[], Parser] | None = None

    def __init__(self, *given: Any, **named: Any) -> None:
        usual = {"formatter_class": partial(Formatter, max_help_position=26)}
        super().__init__(*given, **usual | named)
        # what `add_argument` makes where it is told no action
        self.register("action", None, StoreAction)
        self.given: set[str] = set()

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse as usual; what was given before is forgotten."""
        self.given = set()
        return super().parse_known_args(args, namespace)

    def short_usage(self) -> str:
        """Return how a command is typed, its many options in one word."""
        shape, words = argparse.HelpFormatter(self.prog), [self.prog]
        for action in filter(lambda a: a.required, self._actions):
            words += [*action.option_strings[-1:], shape._format_args(action, action.dest.upper())]
        return " ".join([*words, "[OPTION ...]"]).replace("%", "%%")

    def for_parts(self) -> Parser:
        """Return a copy that takes a part of a command line, and sets no more than it names."""
        # beside a mistyped option the right one would seem missing
        copy = deepcopy(self)
        for action in copy._actions:
            action.required = False
            action.default = argparse.SUPPRESS if action.option_strings else None
        return copy

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in (known := list(action.choices)):
            name = str(argparse._get_action_name(action))
            self.error(
                f"{name.lower() if name.isupper() else name} '{value}' is not known."
                f"{suggestion(value, known)} Known: {', '.join(known)}"
            )

    def _wanting(self, name: str, lacks: str) -> str:
        """Return what an argument lacks, with what it is."""
        action = next(a for a in self._actions if argparse._get_action_name(a) == name)
        told = (action.help or "").replace("%%", "%").split(";")[0]
        known = f" ({', '.join(map(str, action.choices))})" if action.choices else ""
        return f"{name} {lacks}{': ' * bool(told)}{told}{known}"

    def _in_its_place(self, option: str) -> str:
        """Return how what an unknown option names is given."""
        if (meant := _ALSO.get(option, "")) in self._option_string_actions:
            return f". Did you mean '{meant}'?"
        name = option.lstrip("-").rstrip("s")
        bare = {a.dest.rstrip("s") for a in self._actions if not a.option_strings}
        if name in bare and self.usage:
            return f": type '{self.usage}'"
        if name == "vessel" and "model" in bare:
            return ", as MODEL holds its vessel: leave it out"
        of = sub_parsers(self.whole()).items() if self.whole else ()
        others = [f"'greybox {n}'" for n, p in of if option in p._option_string_actions]
        if 0 < len(others) < 3:
            return f", which belongs to {' and '.join(others)}"
        own = [o for o in self._option_string_actions if o[2:] in OUTPUTS]
        if own and name.startswith(OUTPUTS):
            return f": {self.prog} writes with {', '.join(own)}"
        return "." if others else f".{suggestion(option, self._option_string_actions)}"

    def error(self, message: str) -> NoReturn:
        """Exit with status 2 and one sentence, or raise one about the configuration file."""
        for pattern, sentence in _SENTENCES.items():
            message = re.sub(pattern, sentence, message)
        if found := re.match("unrecognized arguments: ([^ =]*)", message):
            message = f"there is no option '{found[1]}'{self._in_its_place(found[1])}"
        if found := re.match("the following arguments are required: (.*)", message):
            message = "; ".join(self._wanting(n, "is missing") for n in found[1].split(", "))
        if found := re.match(r"argument (\S+): expected (\d+) arguments$", message):
            message = self._wanting(found[1], f"needs {found[2]} values")
        if found := re.search(rf"'([0-9.]+) ?({'|'.join(_SECONDS)})' is no .*number$", message):
            message += f", write seconds: {float(found[1]) * _SECONDS[found[2]]:g}"
        message += "." * (not message.endswith((".", "?")))
        if self.place:
            raise ConfigurationError(f"{self.place}: {re.sub('^argument [^:]*: ', '', message)}")
        complain(f"{self.prog}: {message} See '{self.prog} --help'.")
        self.exit(2)
