"""Forces of the hull that a structure lacks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from greybox.diagnosis.causes.cause import Cause, Context
from greybox.diagnosis.hypothesis import Hypothesis, Parameter
from greybox.model.terms import Term, parameter_unit, parse_term
from greybox.notebook import with_error
from greybox.vessel.vessel import Vessel

_WORDS = {"u": "surge", "v": "sway", "r": "yaw"}


def term_parameters(names: Sequence[str], context: Context) -> tuple[Parameter, ...]:
    """Return coefficients of terms; damping that would drive the ship is none."""
    unit = context.vessel.force_unit
    return tuple(
        Parameter(n, parameter_unit(t, unit), 0.0, high=0.0 if t.dissipates else np.inf)
        for n, t in ((n, parse_term(n)) for n in names)
    )


def term_hypothesis(cause: str, names: Sequence[str], context: Context) -> Hypothesis:
    """Return a hypothesis of terms that enter together."""
    key = f"{cause}:{'+'.join(names)}"
    return Hypothesis(cause, key, term_parameters(names, context), columns=tuple(names))


def listed(values: Mapping[str, tuple[float, float]]) -> str:
    """Return estimates as text: those beyond their standard error, or all where none is."""
    sure = {n: (v, s) for n, (v, s) in values.items() if abs(v) > s} or values
    return ", ".join(f"{n} = {with_error(v, s)}" for n, (v, s) in sure.items())


def equations(values: Mapping[str, tuple[float, float]]) -> str:
    """Return the motions that the named terms belong to."""
    return " and ".join(dict.fromkeys(_WORDS.get(parse_term(n).state, n) for n in values))


def _couplings(vessel: Vessel) -> tuple[str, ...]:
    """Return the linear cross terms of sway and yaw; thrust's where several thrusters tell it."""
    # the force of one rudder, or one thruster, is its moment over a constant arm
    thrust = ("Y_taun", "N_tauy") if len(vessel.thrusters) > 1 else ()
    return ("Y_r", "N_v", *thrust)


def is_coupling(term: Term, vessel: Vessel) -> bool:
    """Whether a term is one of the coupled inertia of sway and yaw on this vessel."""
    return term.key in {parse_term(name).key for name in _couplings(vessel)}


class CubicDamping(Cause):
    """Damping that grows with the third power of a velocity."""

    id = "cubic_damping"
    kind = "force"
    title = "cubic damping"
    signature = "the ship is slower than simulated where it is fastest, by the cube of the velocity"
    extension = "a term in the cube of surge, sway or yaw rate"
    reference = "Abkowitz (1964)"

    def hypotheses(self, context: Context) -> Sequence[Hypothesis]:
        """Return one an equation."""
        return [
            term_hypothesis(self.id, (n,), context)
            for n in context.lacking("X_uuu", "Y_vvv", "N_rrr")
        ]

    def evidence(self, values: Mapping[str, tuple[float, float]]) -> str:
        """Say in which equation."""
        return f"the error of {equations(values)} grows with the cube ({listed(values)})"


class QuadraticYawDamping(Cause):
    """Damping by |r|r."""

    id = "quadratic_yaw_damping"
    kind = "force"
    title = "quadratic yaw damping"
    signature = "fast turns are slower than simulated, slow turns are not"
    extension = "the term N_|r|r"
    reference = "Fedyaevsky and Sobolev (1964); Norrbin (1970)"

    def hypotheses(self, context: Context) -> Sequence[Hypothesis]:
        """Return the term, where the structure lacks it."""
        return [term_hypothesis(self.id, (n,), context) for n in context.lacking("N_|r|r")]

    def evidence(self, values: Mapping[str, tuple[float, float]]) -> str:
        """Say its size."""
        return f"the error of the yaw rate follows |r|r ({listed(values)})"


class Crossflow(Cause):
    """Couplings of sway and yaw by the cross-flow along the hull."""

    id = "crossflow"
    kind = "force"
    title = "cross-flow coupling of sway and yaw"
    signature = "errors of sway and yaw where the ship drifts and turns at once"
    extension = "terms in |r|v, |v|r, |v|v or |r|r"
    reference = "Fossen (2011), section 6.4.3; Hooft (1994)"

    def hypotheses(self, context: Context) -> Sequence[Hypothesis]:
        """Return one a term."""
        names = context.lacking(
            "Y_|v|v", "Y_|v|r", "Y_|r|v", "Y_|r|r", "N_|v|v", "N_|v|r", "N_|r|v"
        )
        return [term_hypothesis(self.id, (n,), context) for n in names]

    def evidence(self, values: Mapping[str, tuple[float, float]]) -> str:
        """Say in which equation."""
        return (
            f"the error of {equations(values)} follows the cross-flow of drift and turn "
            f"({listed(values)})"
        )


class InertiaCoupling(Cause):
    """Inertia, and forces at an arm, that couple sway and yaw."""

    id = "inertia_coupling"
    kind = "force"
    title = "coupled inertia of sway and yaw"
    signature = (
        "sway answers to the yaw rate and yaw to the drift at every speed, and each to the other's "
        "thrust, as where the centre of gravity is not at the origin"
    )
    extension = "the yaw rate and moment in sway, the sway velocity and force in yaw"
    reference = "Fossen (2011), section 3.3"

    def hypotheses(self, context: Context) -> Sequence[Hypothesis]:
        """Return those that the structure lacks, together."""
        lacking = context.lacking(*_couplings(context.vessel))
        return [term_hypothesis(self.id, lacking, context)] if lacking else []

    def evidence(self, values: Mapping[str, tuple[float, float]]) -> str:
        """Say the coefficients."""
        return f"sway and yaw push each other at every speed ({listed(values)})"


class Asymmetry(Cause):
    """Port and starboard that are not alike."""

    id = "asymmetry"
    kind = "force"
    title = "port and starboard not alike"
    signature = (
        "the ship is pushed aside the more the faster it goes or its propeller turns, or steers "
        "better to one side than to the other"
    )
    extension = "terms of sway and yaw that do not change sign from port to starboard"
    reference = "Yasukawa and Yoshimura (2015)"

    def hypotheses(self, context: Context) -> Sequence[Hypothesis]:
        """Return the push of the thrust, that of the hull, and uneven steering."""
        pairs = (
            ("Y_taux", "N_taux"), ("Y_|u|u", "N_|u|u"), ("Y_|tauy|", "N_|taun|"),
            ("Y_|rudder|", "N_|rudder|"),
        )  # fmt: skip
        found = [context.lacking(*pair) for pair in pairs]
        return [term_hypothesis(self.id, names, context) for names in found if names]

    def evidence(self, values: Mapping[str, tuple[float, float]]) -> str:
        """Say in which equations."""
        return f"forces on {equations(values)} differ from port to starboard ({listed(values)})"


class SideForce(Cause):
    """A constant side force and moment."""

    id = "side_force"
    kind = "force"
    title = "constant side force or moment"
    signature = "the ship drifts and turns to one side, whatever its heading and speed"
    extension = "constants in the sway and yaw equations"
    reference = "Fossen (2011), section 10.1"

    def hypotheses(self, context: Context) -> Sequence[Hypothesis]:
        """Return both constants together."""
        names = context.lacking("Y_0", "N_0")
        return [term_hypothesis(self.id, names, context)] if names else []

    def evidence(self, values: Mapping[str, tuple[float, float]]) -> str:
        """Say their sizes."""
        return f"a constant force acts on {equations(values)} at every heading ({listed(values)})"
