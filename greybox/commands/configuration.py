"""Options that stand in a file: ``greybox.toml``, a table a command, and ``[all]``."""

from __future__ import annotations

import argparse
import hashlib
import os
import tomllib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from greybox.commands.common import OUTPUTS
from greybox.commands.completion import VESSELS, endings
from greybox.commands.parser import Parser, sub_parsers
from greybox.errors import ConfigurationError, nearest, so_many, suggestion

EVERYWHERE = "all"
PREFIX = "GREYBOX_"
VARIABLES = ("GREYBOX_CONFIG", "GREYBOX_CLUSTER")
MOST_BYTES = 64_000
_NEVER = ("--help", "--version", "--verbose", "--quiet", "--no-config")


def require_known(environment: Mapping[str, str]) -> None:
    """Raise where a variable has nearly the name of one that this program reads."""
    for name in environment.keys() - {*VARIABLES}:
        # the prefix that all share makes no names alike
        word = name.removeprefix(PREFIX)
        near = nearest(word, (v.removeprefix(PREFIX) for v in VARIABLES)) if word != name else ""
        if near:
            raise ConfigurationError(
                f"the environment gives {name}, which no program reads. Did you mean "
                f"'{PREFIX}{near}'? Correct or unset the variable."
            )


def find_configuration(folder: Path, environment: Mapping[str, str]) -> Path | None:
    """Return the file that ``$GREYBOX_CONFIG`` names, or the ``greybox.toml`` of a folder.

    That is the nearest in the folder and those above it, as far as the repository or
    the home folder. Where neither is above it, only the folder itself is looked at: what
    strangers leave in a shared folder, such as ``/tmp``, decides nothing.
    """
    if named := environment.get("GREYBOX_CONFIG"):
        if Path(named).expanduser().is_file():
            return Path(named).expanduser()
        raise ConfigurationError(
            f"GREYBOX_CONFIG names '{named}', which is no file: correct or unset the variable."
        )
    home = environment.get("HOME") or environment.get("USERPROFILE")
    places = [folder, *folder.parents]
    last = next((i for i, p in enumerate(places) if str(p) == home or (p / ".git").exists()), 0)
    found = (p / "greybox.toml" for p in places[: last + 1])
    return next((p for p in found if os.access(p, os.R_OK) and p.is_file()), None)


def configure(
    path: Path,
    command: str,
    parsers: Mapping[str, Parser],
    typed: Iterable[str],
    everything: Callable[[], argparse.ArgumentParser],
) -> tuple[list[str], dict[str, Any] | None]:
    """Return what a configuration file adds to a command line, and the record of it.

    The command line wins: over the same option, and over one that it excludes. `typed` are its
    options as the namespace names them, and `everything` makes the parser of all commands.
    """
    name, digest, tables = _read(path)
    parser, folder, words = parsers[command].for_parts(), path.parent.resolve(), {}
    known = configurable(parser)
    allowed = (EVERYWHERE, *(n for n in parsers if n != "help"))
    for table in tables:
        if table not in allowed:
            raise ConfigurationError(
                f"'{name}' has the table [{table}], and there is no such command."
                f"{suggestion(table, allowed)} Tables: {', '.join(allowed)}."
            )
    for table in (EVERYWHERE, command):
        for key, value in tables.get(table, {}).items():
            parser.place = f"'{name}', [{table}], {key}"
            if action := known.get(key):
                words[action.dest] = _words(action, value, parser.place, folder)
                parser.parse_args(words[action.dest])
                continue
            others = sub_parsers(everything()).values() if table == EVERYWHERE else ()
            names = {*known, *(k for p in others for k in configurable(p))}
            if key not in names:
                raise ConfigurationError(
                    f"{parser.place}: there is no option '{key}'.{suggestion(key, sorted(names))} "
                    f"Correct the name, or leave it out."
                )
    parser.place = f"'{name}'"
    parser.parse_args([w for some in words.values() for w in some])
    given = set(typed)
    for group in parser._mutually_exclusive_groups:
        if given & (members := {a.dest for a in group._group_actions}):
            given |= members
    used = [dest for dest in words if dest not in given]
    record = {"file": name, "sha256": digest, "options": used} if used else None
    return [w for dest in used for w in words[dest]], record


def _read(path: Path) -> tuple[str, str, Mapping[str, Mapping[str, Any]]]:
    """Return the name of a configuration file, its SHA-256 and its tables."""
    name = _from_here(path)
    try:
        with open(path, "rb") as handle:
            data = handle.read(MOST_BYTES + 1)
        if len(data) > MOST_BYTES:
            raise ConfigurationError(f"'{name}' has more than {MOST_BYTES} bytes: is it a log?")
        tables = tomllib.loads(data.decode("utf-8"))
    except OSError as error:
        raise ConfigurationError(f"cannot read '{name}': {error.strerror}.") from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise ConfigurationError(f"'{name}' is not TOML: {error}. Correct that line.") from error
    for key in (k for k, table in tables.items() if not isinstance(table, dict)):
        raise ConfigurationError(
            f"'{name}' gives '{key}' outside a table: put it under [{EVERYWHERE}], or under the "
            f"command that it is for, such as [estimate]."
        )
    return name, hashlib.sha256(data).hexdigest(), tables


def configurable(parser: argparse.ArgumentParser) -> dict[str, argparse.Action]:
    """Return the options that may stand in a file, by their names there."""
    found = parser._option_string_actions.items()
    return {o[2:]: a for o, a in found if o.startswith("--") and o not in _NEVER}


def _words(action: argparse.Action, value: Any, where: str, folder: Path) -> list[str]:
    """Return an option with its value as one would type it in the working folder."""
    option, single, files = action.option_strings[-1], action.nargs in (None, "?"), endings(action)
    if action.nargs == 0:
        if not isinstance(value, bool):
            raise ConfigurationError(f"{where} is {value!r}: write true or false.")
        return [option] * value
    joined = single and not isinstance(action, argparse._AppendAction)
    values = value if isinstance(value, list) and not (joined and files) else [value]
    if not values:
        raise ConfigurationError(f"{where} is an empty list: name a value, or leave it out.")
    if isinstance(action.nargs, int) and len(values) != action.nargs:
        raise ConfigurationError(
            f"{where} has {so_many(len(values), 'value')}, {action.nargs} are needed: write a "
            f"list of them."
        )
    if odd := [v for v in values if isinstance(v, bool) or not isinstance(v, str | int | float)]:
        raise ConfigurationError(
            f"{where} is {odd[0]!r}, a word or a number is needed: correct it."
        )
    texts = [str(v) if files is None else _path(action, str(v), where, folder) for v in values]
    texts = [",".join(texts)] if joined else texts
    # a value of its own may begin with a minus
    return [f"{option}={t}" for t in texts] if single else [option, *texts]


def _path(action: argparse.Action, text: str, where: str, folder: Path) -> str:
    target, output = folder / Path(text).expanduser(), action.dest in OUTPUTS
    if text == "-" if output else text in VESSELS and not target.exists():
        return text
    if output and not Path(os.path.realpath(target)).is_relative_to(folder):
        raise ConfigurationError(
            f"{where} is '{text}', outside the file's own folder: a configuration names outputs "
            f"in its folder only. Give this one on the command line."
        )
    return _from_here(target)


def _from_here(path: Path) -> str:
    """Return a path as one would type it in the working folder."""
    shown = os.path.relpath(path.absolute())
    return str(path.absolute()) if shown.startswith(os.path.join("..", "..", "..")) else shown
