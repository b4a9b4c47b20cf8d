"""What promised names share: loaded at first use, keywords checked."""

from __future__ import annotations

import ast
import functools
import inspect
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from greybox.errors import KeywordError, suggestion

P = ParamSpec("P")
R = TypeVar("R")


def lazy_names(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return ``__getattr__``, ``__dir__`` and ``__all__`` of a package.

    Parameters
    ----------
    package : str
        Beside its ``__init__.py`` lies ``__init__.pyi``, which imports every promised name
        from where it is: one list for programs, type checkers and the manual.
    """
    module = import_module(package)
    stub = Path(str(module.__file__)).with_suffix(".pyi")
    where = {
        alias.name: str(node.module)
        for node in ast.parse(stub.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }

    def load(name: str) -> Any:
        if name not in where:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        value = getattr(import_module(where[name]), name)
        setattr(module, name, value)
        return value

    return load, lambda: sorted(where), sorted(where)


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
