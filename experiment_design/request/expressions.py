"""A function of the parameters as a user writes it, and its gradient; no code is run."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Mapping

import casadi as ca

from greybox.errors import UsageError, suggestion

_LONGEST = 500


def gradient_of(text: str, values: Mapping[str, float]) -> dict[str, float]:
    """Return the gradient of an expression at the parameters' values.

    Parameters
    ----------
    text : str
        Sums, products, quotients and powers of parameters and numbers, ``sqrt`` and ``abs``.
    values : mapping of str to float

    Returns
    -------
    dict of str to float
        Slope in each parameter that the expression depends on.

    Raises
    ------
    UsageError
        It cannot be read, or names an unknown parameter.
    """
    symbols = {n: ca.SX.sym(n) for n in values}
    try:
        if len(text) > _LONGEST:
            raise SyntaxError
        tree = _parsed(text, values)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise UsageError(
            f"--of '{text[:60]}' cannot be read: write a parameter, or a formula such as Xuu/Xmu."
        ) from error
    expression = _read(tree, symbols, text)
    names = list(symbols)
    x = ca.vertcat(*symbols.values())
    slope = ca.Function("slope", [x], [ca.gradient(expression, x)])
    found = slope([values[n] for n in names]).full().ravel()
    out = {n: float(g) for n, g in zip(names, found, strict=True) if g != 0}
    if not out or not all(abs(g) < 1e300 for g in out.values()):
        raise UsageError(
            f"--of '{text}' has no finite slope at the prior model's parameters: choose a function "
            f"that depends on them there."
        )
    return out


def _parsed(text: str, names: Iterable[str]) -> ast.expr:
    """Return the tree of an expression, in which names such as ``N_|r|r`` are names."""
    places = {f"__{i}__": n for i, n in enumerate(n for n in names if not n.isidentifier())}
    for place, name in places.items():
        text = re.sub(rf"(?<![\w|]){re.escape(name)}(?![\w|])", place, text)
    tree = ast.parse(text, mode="eval")
    for node in ast.walk(tree):
        if isinstance(node, ast.Name):
            node.id = places.get(node.id, node.id)
    return tree.body


def _read(node: ast.expr, symbols: Mapping[str, ca.SX], text: str) -> ca.SX:
    if isinstance(node, ast.Name):
        if node.id not in symbols:
            raise UsageError(
                f"--of names '{node.id}', which is no parameter.{suggestion(node.id, symbols)} "
                f"The model has: {', '.join(symbols)}."
            )
        return symbols[node.id]
    if isinstance(node, ast.Constant) and isinstance(node.value, (int, float)):
        return ca.SX(float(node.value))
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.UAdd)):
        inner = _read(node.operand, symbols, text)
        return -inner if isinstance(node.op, ast.USub) else inner
    if isinstance(node, ast.BinOp):
        a, b = _read(node.left, symbols, text), _read(node.right, symbols, text)
        if isinstance(node.op, ast.Add):
            return a + b
        if isinstance(node.op, ast.Sub):
            return a - b
        if isinstance(node.op, ast.Mult):
            return a * b
        if isinstance(node.op, ast.Div):
            return a / b
        if isinstance(node.op, ast.Pow):
            return a**b
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and len(node.args) == 1:
        call = {"sqrt": ca.sqrt, "abs": ca.fabs}.get(node.func.id)
        if call is not None:
            return call(_read(node.args[0], symbols, text))
    raise UsageError(
        f"--of '{text}' uses what is not understood here: write sums, products, quotients, powers, "
        f"sqrt and abs of parameters."
    )
