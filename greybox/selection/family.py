"""The terms that a real ship's forces may need, as one large structure to select from.

Hull forces of second order with and without moduli, the cubic ones that published models
of tankers and catamarans use, constant forces, the cross terms of sway and yaw, thrust that
speed takes from and that pushes beside its own axis, flow through propellers that damps
whichever way they turn, a rudder in the race and beside it, the wind where it was measured,
and the turn of a current in body axes. Inertia that couples sway and yaw multiplies the
forces of both equations by one matrix, so each force may push each of the two.

References
----------
Abkowitz (1964); Norrbin (1970); Blanke (1981); Yasukawa and Yoshimura (2015).
"""

from __future__ import annotations

from functools import lru_cache

from greybox.model.catalogue import structure_for
from greybox.model.disturbances import TURNING
from greybox.model.structure import Structure
from greybox.model.terms import parse_term

_HULL = (
    "X_0 Xu Xuu X_uu X_uuu Xvr X_uvr X_vv X_rr X_|v|r "
    "Y_0 Yv Y_r Yur Y_uv Y_|u|v Y_|u|r Yvv Yvr Y_|r|v Y_|r|r Y_vvv Y_rrr Y_vvr Y_vrr Y_uuv Y_uur "
    "N_0 N_v Nr Nuv N_ur N_|u|v N_|u|r Nvv Nvr N_|r|v N_|r|r N_vvv N_rrr N_vvr N_vrr N_uuv N_uur"
).split()
_WIND = "Wuu Wvv Wuv X_uq Y_vq N_vq X_|vq|uq Y_|uq|vq N_|uq|vq".split()
# those of each generalised input
_FORCE = {
    "taux": "Xmu Xkappa X_|taux|u Y_taux Y_|taux|v Y_|taux|r N_taux N_|taux|v N_|taux|r".split(),
    "tauy": "Ymu Y_u*tauy N_tauy".split(),
    "taun": "Nmu N_u*taun Y_taun".split(),
    "race": "Y_race Y_u*race N_race N_u*race".split(),
    "rudder": "Y_rudder Y_u*rudder Y_|u|u*rudder N_rudder N_u*rudder N_|u|u*rudder".split(),
    "race_drag": ["X_race_drag"],
    "rudder_drag": ["X_rudder_drag", "X_|u|u*rudder_drag"],
}
# what every ship has, and what selection never takes away: without thrust a constant speed is a
# trap, since neither it nor resistance alone explains anything
_CORE = "Xu Xmu Yv Nr".split()


@lru_cache
def family_for(inputs: tuple[str, ...], wind: bool, current: bool) -> Structure:
    """Return all terms that selection may take.

    Parameters
    ----------
    inputs : tuple of str
        Generalised inputs that the vessel's thrusters produce.
    wind : bool
        Whether the velocity through the air was measured.
    current : bool
        Whether the logs can show a current.

    Returns
    -------
    Structure
        Without two terms that are one function.
    """
    names = [*_HULL, *(_WIND if wind else ()), *(TURNING if current else ())]
    for name in inputs:
        names += _FORCE[name]
    terms = {term.key: term for term in map(parse_term, names)}
    return Structure("family", ()).with_terms(*terms.values())


def first_terms(inputs: tuple[str, ...]) -> tuple[tuple[tuple[str, ...], ...], tuple[str, ...]]:
    """Return the sets of terms that selection may begin with, and the terms that always stay.

    The smaller set has each velocity's own damping and the forces of the commands, none of
    which grows with the motion: of its terms none drives the ship where the logs did not.
    """
    linear = structure_for("linear", inputs)
    alone = tuple(t.name for t in linear.terms if len(t.factors) == 1)
    return (alone, linear.parameters), tuple(_CORE)


def spell_structure(terms: tuple[str, ...], inputs: tuple[str, ...]) -> str:
    """Return the name by which `structure_for` gives a structure of these terms.

    Parameters
    ----------
    terms, inputs : tuple of str
    """
    base = structure_for("linear", inputs).parameters
    more = "".join(f"+{t}" for t in terms if t not in base)
    return "linear" + more + "".join(f"-{t}" for t in base if t not in terms)
