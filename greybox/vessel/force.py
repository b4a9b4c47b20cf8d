"""From thruster commands to the generalised force, symbolically.

Azimuth, fixed and tunnel thrusters give the force and moment of (3.46),

    taux = Σ T cos α,  tauy = Σ T sin α,  taun = Σ T (Δx sin α − Δy cos α),

with T the thrust law of the propeller speed times the thruster's gain, and α or
the rudder angle δ the logged one plus the thruster's angle offset. A propeller with a rudder gives
its thrust along the bow and a rudder force from the inflow. In MMG form the
normal force of a rudder at angle δ is F_N = ½ρ A f U_R² sin δ, with the force
−F_N sin δ along and −F_N cos δ across the ship (Yasukawa and Yoshimura, 2015).
The inflow over the rudder follows from momentum theory: far behind a propeller
with thrust T in the inflow u_a the race has u_a² + 2T/(ρA_p), and a rudder of
which a share η lies in the race sees U_R² = u_a² + η·2T/(ρA_p); in a
second-order model U_R² = c_u u|u| + c_T T (Norrbin, 1970; Blanke, 1981), the
race only for T > 0, since astern it leaves forward. Sorting by unknown
coefficient gives four inputs, summed over the rudders,

    race = Σ T⁺ sin δ cos δ,       rudder = Σ sin δ cos δ,
    race_drag = Σ T⁺ sin² δ,       rudder_drag = Σ sin² δ,

that enter as Y_race, Y_|u|u*rudder, N_race, N_|u|u*rudder, X_race_drag and
X_|u|u*rudder_drag. Sway and yaw have their own coefficients, because the hull
behind which the rudder works moves the point where its force acts. At small
incidence the inflow angle from v and r adds to terms that hulls have anyway.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from greybox.numerics.vectorised import Vectorised
from greybox.vessel.vessel import Thruster, Vessel

Array = NDArray[np.float64]


def force_inputs(vessel: Vessel) -> tuple[str, ...]:
    """Return the generalised inputs that the thrusters can produce."""
    names = []
    moved = [t for t in vessel.thrusters if t.type != "propeller_rudder"]
    if any(isinstance(t.angle, str) or abs(np.cos(t.angle)) > 1e-9 for t in vessel.thrusters):
        names.append("taux")
    if any(isinstance(t.angle, str) or abs(np.sin(t.angle)) > 1e-9 for t in moved):
        names.append("tauy")
    if moved or any(t.y != 0 for t in vessel.thrusters):
        names.append("taun")
    if len(moved) < len(vessel.thrusters):
        names += ["race", "rudder", "race_drag", "rudder_drag"]
    return tuple(names)


def force_expressions(
    vessel: Vessel, commands: ca.SX, numbers: ca.SX | None = None
) -> dict[str, ca.SX]:
    """Return each generalised input as an expression of the commands (3.46).

    Parameters
    ----------
    vessel : Vessel
    commands : SX
        (nc,) in the order of `Vessel.commands`: speeds in the unit of the log, angles [rad].
    numbers : SX, optional
        (4, thrusters) gains, angle offsets, and the shares of a linear law that go with n and
        with n|n|, in the place of those of the vessel.
    """
    column = {name: commands[i] for i, name in enumerate(vessel.commands)}
    total = {n: ca.SX(0) for n in force_inputs(vessel)}

    def add(name: str, value: ca.SX) -> None:
        if name in total:
            total[name] = total[name] + value

    for k, t in enumerate(vessel.thrusters):
        speed = column[t.speed]
        thrust, offset = t.thrust.force(speed), ca.SX(t.angle_offset)
        if numbers is not None:
            gain, offset, straight, squared = ca.vertsplit(numbers[:, k])
            if t.thrust.kind == "linear":
                thrust = straight * speed + squared * speed * ca.fabs(speed)
            thrust = gain * thrust
        elif t.gain != 1:
            thrust = t.gain * thrust
        c: ca.SX | float
        s: ca.SX | float
        if isinstance(t.angle, str):
            angle = column[t.angle] + offset
            c, s = ca.cos(angle), ca.sin(angle)
        else:  # rounded, so that a tunnel thruster has exactly no force along the ship
            c, s = round(float(np.cos(t.angle)), 15), round(float(np.sin(t.angle)), 15)
        along, across = thrust * c, thrust * s
        add("taux", along)
        add("tauy", across)
        add("taun", t.x * across - t.y * along)
        if t.rudder is not None:
            delta = column[t.rudder] + offset
            race = ca.fmax(thrust, 0)
            add("race", race * ca.sin(delta) * ca.cos(delta))
            add("rudder", ca.sin(delta) * ca.cos(delta))
            add("race_drag", race * ca.sin(delta) ** 2)
            add("rudder_drag", ca.sin(delta) ** 2)
    return total


def generalised_force(vessel: Vessel, commands: dict[str, Array]) -> dict[str, Array]:
    """Evaluate the generalised inputs on logged commands.

    Parameters
    ----------
    vessel : Vessel
    commands : dict of str to ndarray
        Each column of `Vessel.commands`, all of one shape.

    Returns
    -------
    dict of str to ndarray
        Each input of `force_inputs`, of that shape.
    """
    # numbers are given to the program, since an estimation changes them at every step
    plain = tuple(
        replace(t, gain=1.0, angle_offset=0.0, thrust=t.thrust.plain) for t in vessel.thrusters
    )
    program = _compiled(plain)
    arrays = [np.asarray(commands[c], float) for c in vessel.commands]
    numbers = [n for t in vessel.thrusters for n in (t.gain, t.angle_offset, *t.thrust.shares)]
    names = force_inputs(vessel)
    out = program([*arrays, *numbers], np.empty((len(names), *arrays[0].shape)))
    return dict(zip(names, out, strict=True))


def input_movement(vessel: Vessel, commands: dict[str, Array]) -> dict[str, float]:
    """Return how far each generalised input moves beside what its thrusters could make it.

    Parameters
    ----------
    vessel : Vessel
    commands : dict of str to ndarray
        As `generalised_force`.

    Returns
    -------
    dict of str to float
        Root mean square of each input, over that of all thrusts were they its way (a moment: at
        their distance from the origin; the inputs of a rudder: at an angle of one radian, whose
        square enters the drags). It has no unit, and is as small as rounding where thrusts cancel.
    """
    inputs = generalised_force(vessel, commands)
    arrays = [np.asarray(commands[c], float) for c in vessel.commands]
    thrusts = _thrusts(vessel.thrusters)(
        arrays, np.empty((len(vessel.thrusters), *arrays[0].shape))
    )
    steered = np.array([float(t.rudder is not None) for t in vessel.thrusters])
    arms = np.array([float(np.hypot(t.x, t.y)) for t in vessel.thrusters])
    ones = np.ones_like(arms)
    out = {}
    for name, value in inputs.items():
        weights = {"taun": arms, "race": steered, "race_drag": steered}.get(name, ones)
        whole = np.tensordot(weights, thrusts, axes=1)
        if name in ("rudder", "rudder_drag"):
            whole = np.full(value.shape, steered.sum())
        most = float(np.sqrt(np.mean(whole**2)))
        share = float(np.sqrt(np.mean(value**2))) / most if most > 0 else 0.0
        out[name] = share**0.5 if name in ("race_drag", "rudder_drag") else share
    return out


@lru_cache(maxsize=16)
def _thrusts(thrusters: tuple[Thruster, ...]) -> Vectorised:
    vessel = Vessel("", 1.0, thrusters)
    commands = ca.SX.sym("commands", len(vessel.commands))
    column = {name: commands[i] for i, name in enumerate(vessel.commands)}
    made = [ca.fabs(t.gain * t.thrust.force(column[t.speed])) for t in thrusters]
    return Vectorised(made, ca.vertsplit(commands))


@lru_cache(maxsize=16)
def _compiled(thrusters: tuple[Thruster, ...]) -> Vectorised:
    vessel = Vessel("", 1.0, thrusters)
    commands = ca.SX.sym("commands", len(vessel.commands))
    numbers = ca.SX.sym("numbers", 4, len(thrusters))
    expressions = list(force_expressions(vessel, commands, numbers).values())
    return Vectorised(expressions, [*ca.vertsplit(commands), *ca.vertsplit(ca.vec(numbers))])
