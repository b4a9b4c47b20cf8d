"""The kind of manoeuvre that a log holds, from the motion of the ship and its helm."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from greybox.registry import Registry
from greybox.trial.log import TrialLog
from greybox.trial.manoeuvres.finding import Manoeuvre, find_manoeuvres
from greybox.trial.manoeuvres.stopping import Stopping
from greybox.trial.manoeuvres.turning_circle import TurningCircle
from greybox.trial.manoeuvres.zig_zag import ZigZag

# share of a log that manoeuvres must take to be what it is about
_MOST = 0.5
# heading within which a ship keeps its course, standard deviation [rad]
_STRAIGHT = np.radians(5)


@dataclass(frozen=True)
class _Seen:
    """What a log shows."""

    log: TrialLog

    @cached_property
    def found(self) -> tuple[Manoeuvre, ...]:
        return find_manoeuvres(self.log) if {"psi", "u", "v"} <= self.log.channels.keys() else ()

    def mostly(self, what: type[Manoeuvre]) -> bool:
        """Whether manoeuvres of one class take most of the log."""
        taken = sum(m.stop - m.start for m in self.found if isinstance(m, what))
        return bool(taken > _MOST * (self.log.t[-1] - self.log.t[0]))

    @property
    def straight(self) -> bool:
        """Whether the ship kept its course."""
        if "psi" not in self.log:
            return False
        return bool(np.std(np.unwrap(self.log["psi"])) < _STRAIGHT)


@dataclass(frozen=True)
class ManoeuvreKind:
    """A kind of manoeuvre that whole logs are of.

    Parameters
    ----------
    name : str
        In words.
    shown : callable
        Whether a log is of it; the first kind in the registry that says so is a log's.
    alike : bool
        Whether two logs of it show much the same motion.
    """

    name: str
    shown: Callable[[_Seen], bool]
    alike: bool = True


# from the narrowest kind to the one that takes whatever is left
KINDS: Registry[ManoeuvreKind] = Registry(
    "kind of manoeuvre",
    ManoeuvreKind("zig-zag", lambda seen: seen.mostly(ZigZag)),
    ManoeuvreKind("turn", lambda seen: seen.mostly(TurningCircle)),
    ManoeuvreKind("stop", lambda seen: seen.mostly(Stopping)),
    ManoeuvreKind("straight course", lambda seen: seen.straight),
    ManoeuvreKind("varied", lambda seen: True, alike=False),
)


def kind_of(log: TrialLog) -> ManoeuvreKind:
    """Return the kind of manoeuvre that a log shows most of the time."""
    seen = _Seen(log)
    return next(kind for kind in KINDS.values() if kind.shown(seen))


def alike(logs: Sequence[TrialLog]) -> list[tuple[ManoeuvreKind, list[int]]]:
    """Return groups of logs that show much the same motion, each with its kind.

    Logs of one kind of manoeuvre are a group; a log that is like no other is one by itself.
    """
    groups: list[tuple[ManoeuvreKind, list[int]]] = []
    for i, log in enumerate(logs):
        kind = kind_of(log)
        known = next((own for k, own in groups if k is kind and kind.alike), None)
        if known is None:
            groups.append((kind, [i]))
        else:
            known.append(i)
    return groups
