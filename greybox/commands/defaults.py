"""The options of a configuration file as the defaults of one command."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from greybox.commands.argument_types import EXAMPLE_VESSELS, Kind, is_output, is_path, kind_of
from greybox.commands.configuration import EVERYWHERE, Configuration, from_here
from greybox.commands.parser import long_options, sub_parsers
from greybox.errors import ConfigurationError, suggestion

_NEVER = ("--help", "--version", "--verbose", "--quiet", "--no-config")


class Defaults:
    """The options of a configuration that hold for one command.

    Parameters
    ----------
    configuration : Configuration
    command : str
    parser : ArgumentParser
        That of the command; what the file gives is no longer required there.
    everything : callable
        Makes the parser of all commands, to tell which names they know.

    Raises
    ------
    ConfigurationError
        A table, option or value is not known; the nearest is suggested.
    """

    def __init__(
        self,
        configuration: Configuration,
        command: str,
        parser: argparse.ArgumentParser,
        commands: tuple[str, ...],
        everything: Callable[[], argparse.ArgumentParser],
    ) -> None:
        self.configuration = configuration
        self._usual: dict[str, Any] = {}
        self._values: dict[str, Any] = {}
        self._parser = parser
        name = configuration.name
        for table in configuration.tables:
            if table not in (EVERYWHERE, *commands):
                raise ConfigurationError(
                    f"'{name}' has the table [{table}], and there is no such command."
                    f"{suggestion(table, (EVERYWHERE, *commands))} "
                    f"Tables: {', '.join((EVERYWHERE, *commands))}."
                )
        for table in (EVERYWHERE, command):
            for key, value in configuration.tables.get(table, {}).items():
                self._add(table, key, value, everything)
        self._refuse_exclusive()

    def _add(
        self, table: str, key: str, value: Any, everything: Callable[[], argparse.ArgumentParser]
    ) -> None:
        known = _configurable(self._parser)
        where = f"'{self.configuration.name}', [{table}], {key}"
        if key not in known:
            elsewhere = sub_parsers(everything()).values() if table == EVERYWHERE else ()
            others = {k for p in elsewhere for k in _configurable(p)}
            if key in others:
                return
            names = others or set(known)
            raise ConfigurationError(
                f"{where}: there is no option '{key}'.{suggestion(key, sorted(names))} "
                f"Correct the name, or leave it out."
            )
        action = known[key]
        if action.dest not in self._usual:
            self._usual[action.dest] = action.default
        self._values[action.dest] = _converted(action, value, where, self.configuration.path)
        # so that it is seen what the command line itself gives
        action.default = argparse.SUPPRESS
        action.required = False

    def _refuse_exclusive(self) -> None:
        for group in self._parser._mutually_exclusive_groups:
            both = [a for a in group._group_actions if self._values.get(a.dest)]
            if len(both) > 1:
                names = " and ".join(a.option_strings[-1] for a in both)
                raise ConfigurationError(
                    f"'{self.configuration.name}' gives {names}, which exclude one another: "
                    f"keep one of them."
                )

    def fill(self, options: argparse.Namespace) -> argparse.Namespace:
        """Return `options` with what the command line left out, and the record of it."""
        given = {d for d in self._values if hasattr(options, d)}
        for group in self._parser._mutually_exclusive_groups:
            members = [a.dest for a in group._group_actions]
            typed = [
                a.dest
                for a in group._group_actions
                if (a.dest in given if a.dest in self._values else
                    getattr(options, a.dest, a.default) != a.default)
            ]  # fmt: skip
            if typed:
                given.update(members)
        used = []
        for dest, value in self._values.items():
            if dest not in given:
                setattr(options, dest, value)
                used.append(dest)
            elif not hasattr(options, dest):
                setattr(options, dest, self._usual[dest])
        if used:
            options.configuration = {
                "file": self.configuration.name,
                "sha256": self.configuration.sha256,
                "options": used,
            }
        return options


def _configurable(parser: argparse.ArgumentParser) -> dict[str, argparse.Action]:
    options = [o for o in long_options(parser) if o not in _NEVER]
    return {o.removeprefix("--"): parser._option_string_actions[o] for o in options}


def _converted(action: argparse.Action, value: Any, where: str, path: Path) -> Any:
    """Return a value of the file as the command line would have it."""
    if action.nargs == 0:
        if not isinstance(value, bool):
            raise ConfigurationError(f"{where} is {value!r}: write true or false.")
        return action.const if value else False
    many = isinstance(action, argparse._AppendAction) or action.nargs not in (None, "?")
    if not many:
        if isinstance(value, list) and action.type is not None:
            value = ",".join(str(v) for v in value)
        return _one(action, value, where, path)
    values = value if isinstance(value, list) else [value]
    if isinstance(action.nargs, int) and len(values) != action.nargs:
        raise ConfigurationError(
            f"{where} has {len(values)} values, {action.nargs} are needed: write a list of them."
        )
    if not values:
        raise ConfigurationError(f"{where} is an empty list: name a value, or leave it out.")
    return [_one(action, v, where, path) for v in values]


def _one(action: argparse.Action, value: Any, where: str, path: Path) -> Any:
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise ConfigurationError(f"{where} is {value!r}, a word or a number is needed: correct it.")
    text = str(value)
    if is_path(action):
        return _path(action, text, where, path)
    made: Any = text
    if callable(action.type):
        try:
            made = action.type(text)
        except (TypeError, ValueError, argparse.ArgumentTypeError):
            kind = getattr(action.type, "__name__", "value")
            raise ConfigurationError(
                f"{where} is '{text}', which is no {kind}: correct it."
            ) from None
    if action.choices is not None and made not in action.choices:
        known = [str(c) for c in action.choices]
        raise ConfigurationError(
            f"{where} is '{text}', it must be one of {', '.join(known)}.{suggestion(text, known)}"
        )
    return made


def _path(action: argparse.Action, text: str, where: str, path: Path) -> str:
    if text == "-" and is_output(action):
        return text
    folder = path.parent.resolve()
    target = folder / Path(text).expanduser()
    if is_output(action) and not target.resolve().is_relative_to(folder):
        raise ConfigurationError(
            f"{where} is '{text}', outside the file's own folder: a configuration names outputs "
            f"in its folder only. Give this one on the command line."
        )
    if kind_of(action) is Kind.VESSEL and text in EXAMPLE_VESSELS and not target.exists():
        return text
    return from_here(target)
