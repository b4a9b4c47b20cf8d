"""Keywords that a function does not have are refused with the nearest one that it has."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from greybox.errors import KeywordError, suggestion

P = ParamSpec("P")
R = TypeVar("R")


def known_keywords(function: Callable[P, R]) -> Callable[P, R]:
    """Let a function refuse unknown keywords in one sentence that suggests one.

    Raises
    ------
    KeywordError
        When the function is called with a keyword that it does not have.
    """
    names = [p.name for p in inspect.signature(function).parameters.values()]

    @functools.wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> R:
        for name in kwargs:
            if name not in names:
                raise KeywordError(
                    f"{function.__name__}() has no keyword '{name}'.{suggestion(name, names)} "
                    f"It takes {', '.join(names)}."
                )
        return function(*args, **kwargs)

    return checked
