"""Registries: the entries of a kind by name, so that a new one is one file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache
from importlib import import_module, metadata
from pkgutil import iter_modules
from typing import Protocol, TypeVar

from greybox.errors import GreyboxError, UsageError, suggestion


@cache
def entry_points(group: str) -> metadata.EntryPoints:
    """Return the entry points of a group; what is installed is looked through once."""
    return metadata.entry_points(group=group)


class Named(Protocol):
    """What a registry can hold."""

    @property
    def name(self) -> str:
        """Name by which users ask for it."""


T = TypeVar("T", bound=Named)


class Registry(Mapping[str, T]):
    """Entries by name, in the order in which they are shown.

    Parameters
    ----------
    what : str
        What an entry is, in words, for messages.
    entries : tuple
        Those that are known at once.
    package : str
        Package whose modules each hold one entry more, as ``ENTRY``, or several as
        ``ENTRIES``, in the order of their ``order`` where they have one.
    group : str
        Group of entry points by which other distributions add theirs.
    error : type
        Raised where a name is unknown.
    """

    def __init__(
        self,
        what: str,
        *entries: T,
        package: str = "",
        group: str = "",
        error: type[GreyboxError] = UsageError,
    ) -> None:
        self._what, self._package, self._group, self._error = what, package, group, error
        self._entries = {e.name: e for e in entries}
        self._loaded = not (package or group)

    def _known(self) -> dict[str, T]:
        if not self._loaded:
            self._loaded = True
            found: list[T] = []
            if self._package:
                package = import_module(self._package)
                for m in iter_modules(package.__path__):
                    module = import_module(f"{self._package}.{m.name}")
                    found += getattr(module, "ENTRIES", None) or (module.ENTRY,)
                found.sort(key=lambda e: int(getattr(e, "order", 0)))
            if self._group:
                found += [point.load() for point in metadata.entry_points(group=self._group)]
            self._entries = {e.name: e for e in found} | self._entries
        return self._entries

    def add(self, entry: T) -> None:
        """Add an entry.

        Raises
        ------
        GreyboxError
            There is one of that name; of the registry's own type.
        """
        if entry.name in self._known():
            raise self._error(
                f"there is a {self._what} '{entry.name}' already: choose another name."
            )
        self._entries[entry.name] = entry

    def remove(self, name: str) -> None:
        """Remove an entry that was added."""
        del self._known()[name]

    def __getitem__(self, name: str) -> T:
        known = self._known()
        if name not in known:
            raise self._error(
                f"there is no {self._what} '{name}'.{suggestion(name, known)} "
                f"Known: {', '.join(known)}."
            )
        return known[name]

    def __contains__(self, name: object) -> bool:
        return name in self._known()

    def __iter__(self) -> Iterator[str]:
        return iter(self._known())

    def __len__(self) -> int:
        return len(self._known())
