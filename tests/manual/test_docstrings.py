"""What the reference says of every public name: complete, with shapes and errors."""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from collections.abc import Callable, Iterator
from enum import Enum
from functools import cache
from typing import Any

import pytest

import experiment_design
import greybox
from greybox.errors import GreyboxError

PUBLIC = {
    f"{p.__name__}.{n}": getattr(p, n) for p in (greybox, experiment_design) for n in p.__all__
}
_HEAD = re.compile(r"^([A-Z]\w+(?: \w+)?)\n-{3,}$", re.M)
_SHAPE = re.compile(r"\(.*?(?:,|…|\.\.\.).*?\)|scalar", re.IGNORECASE)


def sections(documented: Any) -> dict[str, str]:
    """Return the sections of a numpydoc docstring, the text before them under ''."""
    parts = _HEAD.split(inspect.getdoc(documented) or "")
    return {"": parts[0]} | dict(zip(parts[1::2], parts[2::2], strict=True))


def entries(text: str) -> dict[str, str]:
    """Return name -> type and description of a Parameters or Attributes section."""
    found: dict[str, str] = {}
    names: list[str] = []
    for line in text.strip("\n").splitlines():
        if line and not line.startswith(" "):
            head, _, kind = line.partition(" : ")
            names = [n.strip().lstrip("*") for n in head.split(",")]
            found |= dict.fromkeys(names, kind)
        else:
            found |= {n: f"{found[n]} {line.strip()}" for n in names}
    return found


def own_methods(cls: type) -> Iterator[tuple[str, Callable[..., Any]]]:
    for name, member in vars(cls).items():
        target = (
            member.fget if isinstance(member, property) else getattr(member, "__func__", member)
        )
        field = name in getattr(cls, "__dataclass_fields__", ())
        if not name.startswith("_") and not field and inspect.isfunction(target):
            yield name, target


CALLABLE = {
    name: value
    for name, value in PUBLIC.items()
    if callable(value)
    and not (inspect.isclass(value) and (inspect.isabstract(value) or issubclass(value, Enum)))
}
DOCUMENTED = PUBLIC | {
    f"{name}.{method}": target
    for name, value in PUBLIC.items()
    if inspect.isclass(value)
    for method, target in own_methods(value)
}


@pytest.mark.parametrize("name", DOCUMENTED)
def test_every_public_name_says_what_it_is(name):
    text = inspect.getdoc(DOCUMENTED[name])
    assert text, f"{name} has no docstring"
    first = text.splitlines()[0]
    assert first.endswith((".", ":")), (name, first)


@pytest.mark.parametrize("name", CALLABLE)
def test_every_parameter_is_described(name):
    value = CALLABLE[name]
    asked = [p for p in inspect.signature(value).parameters if not p.startswith("_")]
    parts = sections(value)
    told = list(entries(parts.get("Parameters", ""))) + list(entries(parts.get("Attributes", "")))
    assert set(told) == set(asked), f"{name}: {sorted(set(told) ^ set(asked))}"


@pytest.mark.parametrize("name", PUBLIC)
def test_arrays_have_shapes(name):
    parts = sections(PUBLIC[name])
    for title in ("Parameters", "Attributes", "Returns"):
        for entry, text in entries(parts.get(title, "")).items():
            if "ndarray" in text or entry.startswith("ndarray"):
                assert _SHAPE.search(text), f"{name}: {entry} has no shape"


@pytest.mark.parametrize("name", [n for n, v in CALLABLE.items() if not inspect.isclass(v)])
def test_what_is_returned_is_described(name):
    value = CALLABLE[name]
    returned = inspect.signature(value).return_annotation
    assert returned in (None, "None") or "Returns" in sections(value), name


@cache
def raised(target: Callable[..., Any]) -> frozenset[str]:
    """Return the errors of this package that a function raises itself."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(inspect.unwrap(target))))
    calls = (n.exc for n in ast.walk(tree) if isinstance(n, ast.Raise) and n.exc is not None)
    names = {c.func.id for c in calls if isinstance(c, ast.Call) and isinstance(c.func, ast.Name)}
    known = {c.__name__ for c in GreyboxError.__subclasses__()}
    return frozenset(names & known)


@pytest.mark.parametrize("name", [n for n, v in DOCUMENTED.items() if not inspect.isclass(v)])
def test_errors_are_described(name):
    told = sections(DOCUMENTED[name]).get("Raises", "")
    missing = [e for e in raised(DOCUMENTED[name]) if e not in told]
    assert not missing, f"{name} raises {missing}"
