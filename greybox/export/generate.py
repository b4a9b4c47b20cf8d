"""C code of expressions, as CasADi generates it, and the texts that go around it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

import casadi as ca

from greybox.export.names import comment
from greybox.export.ports import Port


def c_functions(unit: str, arguments: Sequence[ca.SX], expressions: Mapping[str, ca.SX]) -> str:
    """Return C functions of the same arguments, one an expression.

    Each has the signature ``int name(const double **, double **, int *, double *, int)``
    with the arguments, the one result, and no work memory.

    Parameters
    ----------
    unit : str
        C identifier that all helpers begin with.
    arguments : sequence of SX
    expressions : mapping of str to SX
        By the name of the function.
    """
    options: dict[str, Any] = {"with_header": False, "casadi_int": "int", "casadi_real": "double"}
    generator = ca.CodeGenerator(unit, options)
    for name, expression in expressions.items():
        generator.add(ca.Function(name, list(arguments), [ca.densify(expression)], {"cse": True}))
    return str(generator.dump()).strip() + "\n"


def template(name: str) -> str:
    """Return the text of a file in `templates`."""
    return (resources.files("greybox.export") / "templates" / name).read_text(encoding="utf-8")


def filled(name: str, values: Mapping[str, Any]) -> str:
    """Return a template with its values."""
    from jinja2 import Environment, StrictUndefined

    # C is no markup; what goes in is made safe by `greybox.export.names`
    environment = Environment(
        undefined=StrictUndefined, trim_blocks=True, keep_trailing_newline=True, autoescape=False
    )
    return environment.from_string(template(name)).render(**values)


def described(port: Port) -> str:
    """Return name, unit and meaning of a port for a C comment."""
    return comment(f"{port.name} [{port.shown_unit}]: {port.meaning}")
