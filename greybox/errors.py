"""Every error that a user can meet.

Each class is also a built-in exception, so callers that know nothing of this
package can still catch it. A message says what happened with both numbers,
names the channel or parameter, and ends with the next step.
"""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


class GreyboxError(Exception):
    """Base of every error that this package raises on purpose."""


class VesselError(GreyboxError, ValueError):
    """The vessel file is malformed or contradicts itself."""


class LogError(GreyboxError, ValueError):
    """The trial log lacks something, or what it holds cannot be a log."""


class StructureError(GreyboxError, ValueError):
    """A model structure names a term, state or signal that does not exist."""


class ExcitationError(GreyboxError, ValueError):
    """The data do not determine some direction of the parameters."""


class DivergenceError(GreyboxError, ArithmeticError):
    """A free run left every plausible bound."""


class ModelFileError(GreyboxError, ValueError):
    """The file is not a model of this package, or of a version it cannot read."""


class InfeasibleError(GreyboxError, ValueError):
    """What is asked of a trial cannot be met; the message names the limit and the least change."""


class ExportError(GreyboxError, RuntimeError):
    """A model cannot be written for another program; a compiler failed."""


class OutOfTimeError(GreyboxError, TimeoutError):
    """What was to be tried did not end within the seconds that it was given."""


class ClusterError(GreyboxError, ConnectionError):
    """The cluster that is to compute is not there, has no workers, or was lost."""


class WorkerError(GreyboxError, RuntimeError):
    """Processes that computed a part of the work died again and again."""


class UsageError(GreyboxError, ValueError):
    """Options that exclude one another, or that need another one beside them."""


class KeywordError(UsageError, TypeError):
    """A function has no such keyword."""


class UnknownParameterError(UsageError, KeyError):
    """An estimate has no such parameter."""

    # that of KeyError quotes the message
    __str__ = Exception.__str__


class ConfigurationError(GreyboxError, ValueError):
    """The configuration file names what does not exist, or gives it a value it cannot have."""


def so_many(count: int, noun: str, one: str = "", many: str = "") -> str:
    """Return a number with its noun, in the plural but for 1, and a verb for one or for many.

    ``so_many(1, "row", "repeats", "repeat")`` is ``1 row repeats``.
    """
    several = count != 1
    ending = "es" if noun.endswith(("s", "x", "ch", "sh")) else "s"
    verb = many if several else one
    return f"{count} {noun}{ending * several}{f' {verb}' if verb else ''}"


def suggestion(name: str, known: Iterable[str]) -> str:
    """Return `` Did you mean 'x'?`` for the known name nearest to `name`, or ``""``."""
    found = nearest(name, known)
    return f" Did you mean '{found}'?" if found else ""


def nearest(name: str, known: Iterable[str]) -> str:
    """Return the known name nearest to `name`, or ``""`` where none is near."""
    folded = {k.casefold(): k for k in known}
    near = get_close_matches(name.casefold(), list(folded), n=1, cutoff=0.6)
    # a unit behind the name is the usual difference, as in 'psi [deg]', or a word before it
    own = name.casefold()
    longer = [k for k in folded if k.startswith((f"{own} ", f"{own}_")) or k.endswith(f"_{own}")]
    found = near or longer[:1]
    return folded[found[0]] if found else ""
