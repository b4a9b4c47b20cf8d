"""Names of signals: each once, and few of them in a sentence."""

from __future__ import annotations

from collections.abc import Iterable


def free_name(name: str, used: set[str]) -> str:
    """Return a name that is not used yet, numbered where it must be, and mark it as used."""
    free, k = name, 2
    while free in used:
        free, k = f"{name}_{k}", k + 1
    used.add(free)
    return free


def shortened(names: Iterable[str], limit: int) -> str:
    """Return at most `limit` names for a sentence, and how many more there are."""
    names = list(names)
    more = f" and {len(names) - limit} more" if len(names) > limit else ""
    return ", ".join(names[:limit]) + more
