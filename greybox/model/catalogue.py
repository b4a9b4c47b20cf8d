"""Structures that were published, and the two small ones of the thesis's theory."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

from greybox.errors import StructureError
from greybox.model.structure import Structure
from greybox.model.terms import THESIS_TERMS, Factor, Term, parse_term
from greybox.registry import Registry

RUDDER_TERMS = (
    "X_race_drag",
    "X_|u|u*rudder_drag",
    "Y_race",
    "Y_|u|u*rudder",
    "N_race",
    "N_|u|u*rudder",
)


def _thesis() -> Structure:
    return Structure(
        "thesis",
        tuple(THESIS_TERMS.values()),
        reference="Ljungberg (2020), eq. 3.51",
    )


def _surge() -> Structure:
    return Structure(
        "surge",
        tuple(THESIS_TERMS[n] for n in ("Xu", "Xuu", "Wuu", "Xmu")),
        states=("u",),
        inputs=("taux",),
        reference="Ljungberg (2020), eq. 3.56",
    )


def _linear() -> Structure:
    names = "Xu Xvr Xmu Yv Yur Ymu Nr Nuv Nmu".split()
    return Structure(
        "linear",
        tuple(THESIS_TERMS[n] for n in names),
        reference="Fossen (2011): linear damping with the Coriolis terms of (3.51)",
    )


def _blanke() -> Structure:
    names = ("Xvr Xuu Wuu Xmu Xkappa Yur Y_uv Yvv Yvr Wvv Ymu N_ur Nuv Nvv Nvr Wuv Nmu").split()
    return Structure(
        "blanke",
        tuple(parse_term(n) for n in names),
        reference="Norrbin (1970); Blanke (1981): quadratic damping, no linear friction; "
        "azimuth and wind terms as Ljungberg (2020)",
    )


def _modulus() -> Structure:
    more = ("X_vv X_rr Y_r Y_|r|r Y_|r|v Y_|u|v Y_|u|r N_v N_|r|r N_|r|v N_|u|v N_|u|r").split()
    return Structure(
        "modulus",
        tuple(THESIS_TERMS.values()),
        reference="Fedyaevsky and Sobolev (1964), Norrbin (1970): fuller second-order modulus set",
    ).with_terms(*more)


def _abkowitz() -> Structure:
    names = (
        "Xu X_uu X_uuu X_vv X_rr Xvr X_uvv X_urr X_uvr Xmu Xkappa "
        "Yv Y_r Y_uv Yur Y_uuv Y_uur Y_vvv Y_rrr Y_vvr Y_vrr Ymu "
        "N_v Nr Nuv N_ur N_uuv N_uur N_vvv N_rrr N_vvr N_vrr Nmu"
    ).split()
    return Structure(
        "abkowitz",
        tuple(parse_term(n) for n in names),
        reference="Abkowitz (1964): Taylor expansion to third order with port-starboard symmetry",
    )


def _siso() -> Structure:
    return Structure(
        "siso",
        (
            Term("n", "x", (Factor("x", True), Factor("x"))),
            Term("f", "x", (Factor("input"),)),
        ),
        states=("x",),
        inputs=("input",),
        disturbance="additive",
        increment=False,
        reference="Ljungberg (2020), eq. 4.58",
    )


STRUCTURES: Registry[Structure] = Registry(
    "structure",
    _thesis(),
    _surge(),
    _linear(),
    _blanke(),
    _modulus(),
    _abkowitz(),
    _siso(),
    group="greybox.structures",
    error=StructureError,
)


def structure_names() -> tuple[str, ...]:
    """Return the names of the published structures.

    Returns
    -------
    tuple of str
        As `get_structure` takes them.
    """
    return tuple(STRUCTURES)


@lru_cache
def get_structure(name: str) -> Structure:
    """Return a published structure, with terms added or removed in the name itself.

    Parameters
    ----------
    name : str
        ``thesis`` (3.51), ``surge`` (3.56), ``linear``, ``blanke``, ``modulus``,
        ``abkowitz`` or ``siso`` (4.58); ``thesis+N_|r|r-Xkappa`` adds and
        removes terms.

    Returns
    -------
    Structure

    Raises
    ------
    StructureError
        There is no such structure or term; the nearest name is suggested.
    """
    base, changes = _split(name)
    return _changed(STRUCTURES[base], changes)


def _split(name: str) -> tuple[str, list[str]]:
    parts = [p.strip() for p in name.replace("+", "\n+").replace("-", "\n-").split("\n")]
    return parts[0], parts[1:]


def _changed(structure: Structure, changes: list[str]) -> Structure:
    name = structure.name + "".join(changes)
    for part in changes:
        change, term = part[0], part[1:].strip()
        structure = structure.with_terms(term) if change == "+" else structure.without(term)
    return replace(structure, name=name)


def structure_for(name: str, inputs: tuple[str, ...]) -> Structure:
    """Return a published structure for a vessel, then with the changes in the name.

    Parameters
    ----------
    name : str
        As `get_structure`.
    inputs : tuple of str
        Generalised inputs that the vessel's thrusters produce.

    Raises
    ------
    StructureError
        As `get_structure`.
    """
    base, changes = _split(name)
    return _changed(for_inputs(get_structure(base), inputs), changes)


def for_inputs(structure: Structure, inputs: tuple[str, ...]) -> Structure:
    """Return `structure` for a vessel that produces `inputs`.

    A propeller with a rudder adds its terms (their derivation stands in
    `greybox.vessel.force`); a force component that no thruster can produce
    takes its terms away.
    """
    if not structure.marine:
        return structure
    gone = [
        t.name
        for t in structure.terms
        if any(f.signal in structure.inputs and f.signal not in inputs for f in t.factors)
    ]
    if "rudder" in inputs and not any(
        f.signal in ("race", "rudder") for t in structure.terms for f in t.factors
    ):
        wanted = [n for n in RUDDER_TERMS if parse_term(n).state in structure.states]
        structure = structure.with_terms(*wanted)
    return structure.without(*gone) if gone else structure
