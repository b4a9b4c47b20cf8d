"""Bias-capturing functions by name, such as ``|u|*cos(psi)``."""

from __future__ import annotations

from functools import lru_cache

import casadi as ca

from greybox.errors import StructureError, suggestion
from greybox.model.structure import Structure


@lru_cache(maxsize=64)
def atoms(structure: Structure) -> dict[str, ca.SX]:
    """Return the functions that spelled regressors are products of."""
    s = structure.symbols
    named = {n: s.x[i] for i, n in enumerate(structure.states)}
    named |= {n: s.tau[i] for i, n in enumerate(structure.inputs)}
    found = {
        "1": ca.SX(1),
        "cos(psi)": ca.cos(s.psi),
        "sin(psi)": ca.sin(s.psi),
        "cos²(psi)": ca.cos(s.psi) ** 2,
        "sin(2psi)": ca.sin(2 * s.psi),
    }
    for n, x in named.items():
        found |= {n: x, f"|{n}|": ca.fabs(x), f"sgn({n})": ca.sign(x)}
    return found


def spelled_expression(structure: Structure, name: str) -> ca.SX:
    """Return a bias-capturing function from its spelling, such as ``|u|*cos(psi)``."""
    known = atoms(structure)
    product = ca.SX(1)
    for factor in name.split("*"):
        if factor not in known:
            raise StructureError(
                f"'{factor}' in the bias regressor '{name}' is not known."
                f"{suggestion(factor, known)}"
            )
        product = product * known[factor]
    return product


def spellings(structure: Structure) -> list[str]:
    """Return the names that a derivative is recognised by, simplest first."""
    signals = [*structure.states, *structure.inputs]
    single = [f(n) for n in signals for f in ("{}".format, "|{}|".format, "sgn({})".format)]
    pairs = [
        f"{a}*{b}"
        for i, a in enumerate(single)
        for b in single[i + 1 :]
        if a.strip("|") not in b and b.strip("|") not in a
    ]
    trig = ["cos(psi)", "sin(psi)", "cos²(psi)", "sin(2psi)"]
    plain = ["1", *single, *pairs]
    return trig + [f"{a}*{t}" for t in trig for a in [*single, *pairs]] + plain
