"""Options that stand in a file: ``greybox.toml``, a table a command, and ``[all]``."""

from __future__ import annotations

import argparse
import hashlib
import os
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from greybox.commands.completion import VESSELS
from greybox.commands.parser import OUTPUTS, endings, long_options, plainly, sub_parsers
from greybox.errors import ConfigurationError, suggestion

NAME = "greybox.toml"
VARIABLE = "GREYBOX_CONFIG"
EVERYWHERE = "all"
MOST_BYTES = 64_000
_NEVER = ("--help", "--version", "--verbose", "--quiet", "--no-config")


@dataclass(frozen=True)
class Configuration:
    """A configuration file as it was read.

    Parameters
    ----------
    path : Path
        Paths in it are relative to its folder.
    sha256 : str
    tables : mapping of str to mapping
        Options of each command, and of ``all``.
    """

    path: Path
    sha256: str
    tables: Mapping[str, Mapping[str, Any]]

    @property
    def name(self) -> str:
        """The path as seen from the working folder."""
        return _from_here(self.path)


def find_configuration(folder: Path, environment: Mapping[str, str]) -> Path | None:
    """Return the configuration file that holds in a folder.

    The one of ``$GREYBOX_CONFIG``, or else the nearest ``greybox.toml`` in the
    folder and those above it, as far as the repository or the home folder. Where
    neither is above it, only the folder itself is looked at: what strangers leave
    in a shared folder, such as ``/tmp``, decides nothing.

    Raises
    ------
    ConfigurationError
        The variable names no file.
    """
    if named := environment.get(VARIABLE):
        path = Path(named).expanduser()
        if not path.is_file():
            raise ConfigurationError(
                f"{VARIABLE} names '{named}', which is no file: correct or unset the variable."
            )
        return path
    home = environment.get("HOME") or environment.get("USERPROFILE")
    places = [folder, *folder.parents]
    last = next((i for i, p in enumerate(places) if str(p) == home or (p / ".git").exists()), 0)
    found = (p / NAME for p in places[: last + 1])
    return next((p for p in found if os.access(p, os.R_OK) and p.is_file()), None)


def read_configuration(path: Path) -> Configuration:
    """Read a configuration file.

    Raises
    ------
    ConfigurationError
        It is too large, no TOML, or holds an option outside a table.
    """
    name = _from_here(path)
    try:
        with open(path, "rb") as handle:
            data = handle.read(MOST_BYTES + 1)
    except OSError as error:
        raise ConfigurationError(f"cannot read '{name}': {error.strerror}.") from error
    if len(data) > MOST_BYTES:
        raise ConfigurationError(
            f"'{name}' has more than {MOST_BYTES} bytes, which no configuration needs: is it a log?"
        )
    try:
        tables = tomllib.loads(data.decode("utf-8"))
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise ConfigurationError(f"'{name}' is not TOML: {error}. Correct that line.") from error
    for key, table in tables.items():
        if not isinstance(table, dict):
            raise ConfigurationError(
                f"'{name}' gives '{key}' outside a table: put it under [{EVERYWHERE}], or under "
                f"the command that it is for, such as [estimate]."
            )
    return Configuration(path, hashlib.sha256(data).hexdigest(), tables)


def configurable(parser: argparse.ArgumentParser) -> dict[str, argparse.Action]:
    """Return the options that may stand in a file, by their names there."""
    return {o[2:]: a for o, a in long_options(parser).items() if o not in _NEVER}


def parse_configured(
    configuration: Configuration,
    command: str,
    given: list[str],
    parser: argparse.ArgumentParser,
    everything: Callable[[], argparse.ArgumentParser],
) -> tuple[argparse.Namespace, list[str]]:
    """Parse a command line, with what a configuration gives where it says nothing.

    Parameters
    ----------
    configuration : Configuration
    command : str
    given : list of str
        The command line.
    parser : ArgumentParser
        Of the program, with the options of `command`; it is of no use afterwards.
    everything : callable
        Returns the parser with the options of all commands.

    Returns
    -------
    tuple of (Namespace, list of str)
        As ``parse_known_args`` returns them, with the record of the file that was used.

    Raises
    ------
    ConfigurationError
        A table, option or value is not known; the nearest is suggested.
    """
    own = sub_parsers(parser)[command]
    values = _values(configuration, command, parser, everything)
    usual = {}
    for action in own._actions:
        if action.dest in values:
            # so that it is seen what the command line itself gives
            usual[action.dest], action.default = action.default, argparse.SUPPRESS
            action.required = False
    options, left = parser.parse_known_args(given)
    typed = {
        a.dest
        for a in own._actions
        if hasattr(options, a.dest) and (a.dest in values or getattr(options, a.dest) != a.default)
    }
    for group in own._mutually_exclusive_groups:
        members = {a.dest for a in group._group_actions}
        typed |= members if members & typed else set()
    used = [dest for dest in values if dest not in typed]
    vars(options).update(usual | vars(options) | {d: values[d] for d in used})
    if used:
        options.configuration = {
            "file": configuration.name,
            "sha256": configuration.sha256,
            "options": used,
        }
    return options, left


def _values(
    configuration: Configuration,
    command: str,
    parser: argparse.ArgumentParser,
    everything: Callable[[], argparse.ArgumentParser],
) -> dict[str, Any]:
    """Return what a configuration gives for a command, by the names of its namespace."""
    name, parsers = configuration.name, sub_parsers(parser)
    allowed = (EVERYWHERE, *(n for n in parsers if n != "help"))
    for table in configuration.tables:
        if table not in allowed:
            raise ConfigurationError(
                f"'{name}' has the table [{table}], and there is no such command."
                f"{suggestion(table, allowed)} Tables: {', '.join(allowed)}."
            )
    own, values = parsers[command], {}
    known = configurable(own)
    for table in (EVERYWHERE, command):
        for key, value in configuration.tables.get(table, {}).items():
            where = f"'{name}', [{table}], {key}"
            if key in known:
                folder = configuration.path.parent.resolve()
                values[known[key].dest] = _converted(own, known[key], value, where, folder)
                continue
            others = sub_parsers(everything()).values() if table == EVERYWHERE else ()
            names = sorted({*known, *(k for p in others for k in configurable(p))})
            if key not in names:
                raise ConfigurationError(
                    f"{where}: there is no option '{key}'.{suggestion(key, names)} "
                    f"Correct the name, or leave it out."
                )
    for group in own._mutually_exclusive_groups:
        both = [a.option_strings[-1] for a in group._group_actions if values.get(a.dest)]
        if len(both) > 1:
            raise ConfigurationError(
                f"'{name}' gives {' and '.join(both)}, which exclude one another: keep one of them."
            )
    return values


def _converted(
    parser: argparse.ArgumentParser, action: argparse.Action, value: Any, where: str, folder: Path
) -> Any:
    """Return a value of the file as the command line would have it."""
    if action.nargs == 0:
        if not isinstance(value, bool):
            raise ConfigurationError(f"{where} is {value!r}: write true or false.")
        return action.const if value else False
    many = isinstance(action, argparse._AppendAction) or action.nargs not in (None, "?")
    if isinstance(value, list) and not many and action.type is not None:
        value = ",".join(str(v) for v in value)
    values = value if isinstance(value, list) and many else [value]
    if isinstance(action.nargs, int) and len(values) != action.nargs:
        raise ConfigurationError(
            f"{where} has {len(values)} values, {action.nargs} are needed: write a list of them."
        )
    if not values:
        raise ConfigurationError(f"{where} is an empty list: name a value, or leave it out.")
    made = [_one(parser, action, v, where, folder) for v in values]
    return made if many else made[0]


def _one(
    parser: argparse.ArgumentParser, action: argparse.Action, value: Any, where: str, folder: Path
) -> Any:
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise ConfigurationError(f"{where} is {value!r}, a word or a number is needed: correct it.")
    text, output = str(value), action.dest in OUTPUTS
    if endings(action) is None:
        try:
            made = parser._get_value(action, text)
            parser._check_value(action, made)
        except argparse.ArgumentError as error:
            raise ConfigurationError(f"{where}: {plainly(error.message)}") from None
        return made
    target = folder / Path(text).expanduser()
    if (output and text == "-") or (text in VESSELS and not target.exists()):
        return text
    if output and not target.resolve().is_relative_to(folder):
        raise ConfigurationError(
            f"{where} is '{text}', outside the file's own folder: a configuration names outputs "
            f"in its folder only. Give this one on the command line."
        )
    return _from_here(target)


def _from_here(path: Path) -> str:
    """Return a path as one would type it in the working folder."""
    shown = os.path.relpath(path.absolute())
    return str(path.absolute()) if shown.startswith(os.path.join("..", "..", "..")) else shown
