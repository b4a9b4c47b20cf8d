"""Options that stand in a file: ``greybox.toml``, a table a command, and ``[all]``."""

from __future__ import annotations

import hashlib
import os
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from greybox.errors import ConfigurationError

NAME = "greybox.toml"
VARIABLE = "GREYBOX_CONFIG"
EVERYWHERE = "all"
MOST_BYTES = 64_000


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
        return from_here(self.path)


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
    for place in places[: last + 1]:
        if os.access(place / NAME, os.R_OK) and (place / NAME).is_file():
            return place / NAME
    return None


def read_configuration(path: Path) -> Configuration:
    """Read a configuration file.

    Raises
    ------
    ConfigurationError
        It is too large, no TOML, or holds an option outside a table.
    """
    name = from_here(path)
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


def from_here(path: Path) -> str:
    """Return a path as one would type it in the working folder."""
    shown = os.path.relpath(path.absolute())
    return str(path.absolute()) if shown.startswith(os.path.join("..", "..", "..")) else shown
