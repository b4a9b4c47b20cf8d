"""A first model of a ship without trials, from its main dimensions.

Forces and moments are those of published semi-empirical formulas, each named where it is used;
they are brought to the parameters of (3.51) by Table 3.1 with the inertias
that couple sway and yaw. The formulas are mean lines through ships that scatter about them: each
parameter has a relative standard error that covers this, so that a design takes the model for
what it is, a guess.

References
----------
Clarke, Gedling and Hine (1983), The application of manoeuvring criteria in hull design using
linear theory, Trans. RINA 125.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import atan, cos, exp, log10, pi, sqrt

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from greybox.errors import VesselError
from greybox.model.catalogue import structure_for
from greybox.model.conversion import SURGE_ADDED_MASS
from greybox.model.model import ManoeuvringModel
from greybox.model.structure import Structure
from greybox.vessel.force import force_inputs
from greybox.vessel.vessel import Thruster, Vessel

Array = NDArray[np.float64]

METHOD = "semi-empirical"
# sea water, and air [kg/m³]; kinematic viscosity [m²/s]; [m/s²]
_WATER, _AIR, _VISCOSITY, _GRAVITY = 1025.0, 1.23, 1.19e-6, 9.81
# service speed as a Froude number where the vessel file states none: merchant ships steered by
# rudders, and smaller craft steered by their thrusters
_FROUDE_RUDDER, _FROUDE_OTHER = 0.2, 0.3
# beyond which a displacement ship makes no speed
_FROUDE_MOST = 0.4
# block coefficient below which the beam is not that of one hull
_BLOCK_LEAST = 0.35
# beam over draught where nothing tells the draught (Watson and Gilfillan, 1977: 2.25 to 3.75)
_BEAM_DRAUGHT = 2.8
# displaced volume over length cubed, below which a mass is one in tonnes; rowing shells have 2e-4
_VOLUME_LENGTH_LEAST = 5e-5
# the formulas of Clarke and others hold for displacement ships; beyond these ratios they are taken
# at the nearest end, where they would turn the sign of damping and added mass
_BEAM_LENGTH_RANGE, _BEAM_DRAUGHT_RANGE = (0.1, 0.2), (2.0, 4.5)
# radius of gyration in yaw over length (Clarke, Gedling and Hine, 1983)
_GYRADIUS = 0.25
# of a vessel whose N thrust is known: what the hull takes of it (thrust deduction)
_DEDUCTION = 0.15
# what a propeller loses of its thrust at rest when the ship makes its service speed: K_T at the
# advance of usual screws is about 0.55 of that at rest (Wageningen B series)
_LOSS = 0.45
# wake at a rudder, share of it in the race, rudder force on hull over that on the rudder and its
# place, what is lost of the rudder's drag: middle values of Yasukawa and Yoshimura (2015)
_WAKE, _RACE, _A_H, _X_H, _T_R = 0.3, 0.6, 0.3, -0.45, 0.3
# propeller diameter over draught, span over chord of a rudder
_DIAMETER, _ASPECT = 0.65, 1.6
# wind: drag ahead, across and the moment of Blendermann (1994) for usual superstructures; areas
# over B² and L²
_WIND_X, _WIND_Y, _WIND_N, _FRONT, _SIDE = 0.6, 0.85, 0.1, 0.4, 0.08
# drag of a two-dimensional section in cross flow by beam over twice the draught: points of
# Hoerner's curve (1965)
_HOERNER = (
    (0.5, 1.25),
    (0.65, 1.0),
    (1.0, 0.83),
    (1.3, 0.76),
    (1.85, 0.66),
    (2.6, 0.6),
    (4.0, 0.56),
)
# of the rate of turn of the bow over the drift, the range that cross flow is fitted in
_TURN_RANGE = 2.0
# motion beside service speed that says how much a term can matter: drift, and rate in U/L
_DRIFT, _RATE = 0.25, 0.5
# share of the service speed at which sway and yaw are linearised: a ship loses about a quarter of
# it, and more, in a turn. Of 1, 0.85 and 0.75 the one whose turns came closest to the ships of
# tests/foreign_ships, as did the single hull that stands for several
_TRIAL_SPEED = 0.75
# floor of a standard error: a share of the largest term of its equation
_FLOOR = 0.05

# relative standard errors, rounded: measured derivatives scatter by about a fifth about the lines
# of Clarke, Gedling and Hine for Y_v, N_v, N_r and by a third for Y_r (of which little is in Yur);
# resistance is known to a tenth where all form parameters are, and less so where they are not;
# the rest is what the middle values above leave open. Orders of magnitude, not printed figures
_SPREAD = {
    "Xu": 0.4, "Xvr": 0.3, "Xuu": 0.3, "Wuu": 0.6, "Xmu": 0.3, "Xkappa": 0.4,
    "Yv": 0.2, "Yur": 0.2, "Yvv": 0.35, "Yvr": 0.5, "Wvv": 0.6, "Ymu": 0.3,
    "Nr": 0.2, "Nuv": 0.2, "Nvv": 0.5, "Nvr": 0.4, "Wuv": 1.0, "Nmu": 0.3,
}  # fmt: skip
_SPREAD_RUDDER = 0.3


@dataclass(frozen=True)
class MainDimensions:
    """The main dimensions that the formulas need.

    Parameters
    ----------
    length, beam, draught : float
        [m]
    mass : float
        [kg]
    speed : float
        With all propellers at their limit ahead [m/s].
    notes : tuple of str
        A sentence for each one that the vessel file does not state.
    several_hulls : bool
        Whether one hull stands for several.
    """

    length: float
    beam: float
    draught: float
    mass: float
    speed: float
    notes: tuple[str, ...] = ()
    several_hulls: bool = False

    @property
    def block(self) -> float:
        """Block coefficient, m / (ρ L B T)."""
        return self.mass / (_WATER * self.length * self.beam * self.draught)

    @property
    def volume(self) -> float:
        """Displaced volume [m³]."""
        return self.mass / _WATER


@dataclass(frozen=True)
class LinearDerivatives:
    """Derivatives in sway and yaw about midship [SI], those of motion at one speed.

    Attributes are named as Clarke, Gedling and Hine name them.
    """

    Y_vdot: float
    Y_rdot: float
    N_vdot: float
    N_rdot: float
    Y_v: float
    Y_r: float
    N_v: float
    N_r: float


def semi_empirical_model(vessel: Vessel) -> ManoeuvringModel:
    """Return a model of structure ``thesis`` from main dimensions and thrusters alone.

    Parameters
    ----------
    vessel : Vessel
        Length, and where known beam, draught (of `conditions`), mass and service speed; the
        places, thrust laws and speed limits of its thrusters.

    Returns
    -------
    ManoeuvringModel
        Sampled by a tenth of the time in which the ship sails its length, as a round number of
        1 s at most. With a covariance that is diagonal: (relative spread × value)² plus a
        floor. Its record says under ``notes`` what was assumed.

    Raises
    ------
    VesselError
        A propeller has no speed limits, no thruster pushes ahead, or the mass does not fit
        into the hull.

    Notes
    -----
    Surge: resistance of `resistance` is fitted by Xu u + Xuu |u|u below the service speed; full
    thrust holds this speed, and a propeller loses part of its thrust with speed (Xkappa). The
    centripetal term is (m − C_m Y_v̇) v r with C_m = 0.6 (Inoue, Hirano and Kijima, 1981: 0.5 to
    0.75).

    Sway and yaw: `clarke_derivatives`, with cross-flow drag
    (`crossflow_drag`), the accelerations by the inverse of the coupled inertia. (3.51) has
    linear damping without and cross terms with the forward speed, so both are exact at one
    speed only: three quarters of the service speed.

    Rudders: `_rudder_terms`. Wind: ½ρ A C with coefficients of Blendermann (1994).

    Straight-line stability is not enforced: full tankers have none.
    """
    hull = main_dimensions(vessel)
    step = _sample_time(hull)
    structure = structure_for("thesis", force_inputs(vessel))
    linear = clarke_derivatives(hull)
    spin = hull.mass * (_GYRADIUS * hull.length) ** 2
    surge = hull.mass * (1 + SURGE_ADDED_MASS)
    inertia = np.array(
        [[hull.mass - linear.Y_vdot, -linear.Y_rdot], [-linear.N_vdot, spin - linear.N_rdot]]
    )
    push = np.linalg.inv(inertia)
    U = _TRIAL_SPEED * hull.speed
    damping = (
        _TRIAL_SPEED
        * push
        @ np.array([[linear.Y_v, linear.Y_r - hull.mass * hull.speed], [linear.N_v, linear.N_r]])
    )
    gain, drag = _thrust_gain(vessel, hull)
    drift, turning = crossflow_drag(hull)
    friction, square = _resistance_terms(hull, drag)
    rates = {
        "Xu": -friction / surge,
        "Xuu": -square / surge,
        "Xvr": (hull.mass - 0.6 * linear.Y_vdot) / surge,
        "Xmu": gain / surge,
        "Xkappa": -gain * _LOSS / hull.speed / surge,
        "Yv": damping[0, 0],
        "Yur": damping[0, 1] / U,
        "Nuv": damping[1, 0] / U,
        "Nr": damping[1, 1],
        "Yvv": -drift / inertia[0, 0],
        "Nvr": -turning / inertia[1, 1],
        "Ymu": gain / inertia[0, 0],
        "Nmu": gain / inertia[1, 1],
        **_wind_terms(hull, surge, inertia),
        **_rudder_terms(vessel, hull, surge, push, gain),
    }
    theta = step * np.array([rates.get(n, 0.0) for n in structure.parameters])
    std = _standard_errors(structure, theta, vessel, hull)
    notes = (
        f"the model comes from length {hull.length:g} m, beam {hull.beam:.3g} m, draught "
        f"{hull.draught:.3g} m, {hull.mass:.3g} kg and service speed {hull.speed:.3g} m/s by the "
        f"formulas of Clarke, Gedling and Hine (1983), ITTC (1957) and Hoerner (1965), each "
        f"coefficient uncertain by a fifth to a half of itself",
        *hull.notes,
    )
    return ManoeuvringModel(
        structure, theta, np.diag(std**2), step, vessel,
        record={"method": METHOD, "notes": list(notes)},
    )  # fmt: skip


def main_dimensions(vessel: Vessel) -> MainDimensions:
    """Return the main dimensions, by usual ratios where the vessel file states none.

    Raises
    ------
    VesselError
        The mass is more than a box of the hull's dimensions displaces.

    Notes
    -----
    Speed: that at which `resistance` takes the full thrust where this is known in newtons; else a
    Froude number of 0.2 for ships with rudders and of 0.3 for others. Length over beam: 4 up to
    30 m, 6.5 from 130 m, linear between (Watson and Gilfillan, 1977). Block coefficient: 0.70 +
    0.125 atan((23 − 100 Fn)/4) (the same). Draught: from the mass where it is known, else B/2.8.
    """
    length, beam, mass = vessel.length, vessel.beam, vessel.mass
    draught = vessel.conditions.draught
    if mass is not None and mass < (least := _VOLUME_LENGTH_LEAST * _WATER * length**3):
        raise VesselError(
            f"the vessel file has the mass {mass:g} kg, and a vessel of length {length:g} m has "
            f"more than {least:.2g} kg: write the mass in kg, or correct the length."
        )
    notes: list[str] = []
    speed = vessel.service_speed
    rudder = any(t.rudder is not None for t in vessel.thrusters)
    froude = _FROUDE_RUDDER if rudder else _FROUDE_OTHER
    guess = froude * sqrt(_GRAVITY * length)
    fullness = 0.70 + 0.125 * atan((23 - 100 * (speed or guess) / sqrt(_GRAVITY * length)) / 4)
    if beam is None:
        ratio = float(np.clip(4 + 0.025 * (length - 30), 4.0, 6.5))
        beam = length / ratio
        if draught is not None and mass is not None:
            beam = mass / (_WATER * length * draught * fullness)
            notes.append(
                f"beam {beam:.3g} m assumed, from mass and draught with a block coefficient of "
                f"{fullness:.2f} (state beam in the vessel file)"
            )
        else:
            notes.append(
                f"beam {beam:.3g} m assumed, length over beam {ratio:.2g} (state beam in the "
                f"vessel file)"
            )
    if draught is None:
        draught = beam / _BEAM_DRAUGHT
        how = f"beam over draught {_BEAM_DRAUGHT:g}"
        if mass is not None:
            draught = mass / (_WATER * length * beam * fullness)
            how = f"from the mass with a block coefficient of {fullness:.2f}"
        notes.append(
            f"draught {draught:.3g} m assumed, {how} (state draught under [conditions] in the "
            f"vessel file)"
        )
    box = _WATER * length * beam * draught
    if mass is None:
        mass = box * fullness
        notes.append(
            f"mass {mass:.3g} kg assumed, block coefficient {fullness:.2f} (state mass in the "
            f"vessel file)"
        )
    if mass > box:
        raise VesselError(
            f"the vessel file has the mass {mass:g} kg, and a box of length {length:g} m, beam "
            f"{beam:.4g} m and draught {draught:.4g} m displaces {box:.4g} kg of sea water: "
            f"correct mass, beam or draught."
        )
    several = mass / box < _BLOCK_LEAST
    if several:
        stated = f"beam {beam:.3g} m and draught {draught:.3g} m"
        draught = sqrt(mass / (_WATER * length * fullness * _BEAM_DRAUGHT))
        beam = _BEAM_DRAUGHT * draught
        notes.append(
            f"with {stated} the block coefficient is {mass / box:.2f}, that of a vessel of more "
            f"than one hull: one hull of the same length and mass with beam {beam:.3g} m and "
            f"draught {draught:.3g} m is taken instead, and coefficients are twice as uncertain "
            f"for it"
        )
    for name, value, (low, high) in (
        ("beam over length", beam / length, _BEAM_LENGTH_RANGE),
        ("beam over draught", beam / draught, _BEAM_DRAUGHT_RANGE),
    ):
        if not low <= value <= high:
            end = low if value < low else high
            notes.append(
                f"{name} is {value:.2f}, and {end:g} is taken in the formulas for sway and yaw, "
                f"which were made for usual displacement ships"
            )
    hull = MainDimensions(length, beam, draught, mass, speed or guess, tuple(notes), several)
    if speed is not None:
        return hull
    how = f"a Froude number of {froude:g}"
    if _in_newtons(vessel):
        hull = _at_thrust(hull, (1 - _DEDUCTION) * (1 - _LOSS) * full_thrust(vessel))
        how = "where the resistance takes the full thrust"
    notes.append(
        f"service speed {hull.speed:.3g} m/s assumed, {how} (state service_speed in the vessel "
        f"file: the speed with all propellers at their limit ahead)"
    )
    return replace(hull, notes=tuple(notes))


def clarke_derivatives(hull: MainDimensions) -> LinearDerivatives:
    """Return the linear derivatives at the service speed.

    With s = π (T/L)², made dimensional by ½ρL³, ½ρL⁴, ½ρL⁵ (accelerations) and
    ½ρL²U, ½ρL³U, ½ρL⁴U (velocities),

        Y_v̇ = −s (1 + 0.16 C_b B/T − 5.1 (B/L)²),   Y_ṙ = −s (0.67 B/L − 0.0033 (B/T)²),
        N_v̇ = −s (1.1 B/L − 0.041 B/T),   N_ṙ = −s (1/12 + 0.017 C_b B/T − 0.33 B/L),
        Y_v = −s (1 + 0.40 C_b B/T),   Y_r = −s (−1/2 + 2.2 B/L − 0.080 B/T),
        N_v = −s (1/2 + 2.4 T/L),   N_r = −s (1/4 + 0.039 B/T − 0.56 B/L).

    Ratios beyond those of displacement ships are taken at the nearest end.

    References
    ----------
    Clarke, Gedling and Hine (1983), the equations of the multiple regression; Fossen (2011),
    section 7.2.
    """
    L, U = hull.length, hull.speed
    wide = float(np.clip(hull.beam / L, *_BEAM_LENGTH_RANGE))
    flat = float(np.clip(hull.beam / hull.draught, *_BEAM_DRAUGHT_RANGE))
    full = float(np.clip(hull.block, 0.3, 0.9)) * flat
    deep = hull.draught / L
    s = pi * deep**2
    base = 0.5 * _WATER
    return LinearDerivatives(
        Y_vdot=-s * (1 + 0.16 * full - 5.1 * wide**2) * base * L**3,
        Y_rdot=-s * (0.67 * wide - 0.0033 * flat**2) * base * L**4,
        N_vdot=-s * (1.1 * wide - 0.041 * flat) * base * L**4,
        N_rdot=-s * (1 / 12 + 0.017 * full - 0.33 * wide) * base * L**5,
        Y_v=-s * (1 + 0.40 * full) * base * L**2 * U,
        Y_r=-s * (-0.5 + 2.2 * wide - 0.080 * flat) * base * L**3 * U,
        N_v=-s * (0.5 + 2.4 * deep) * base * L**3 * U,
        N_r=-s * (0.25 + 0.039 * flat - 0.56 * wide) * base * L**4 * U,
    )


def crossflow_drag(hull: MainDimensions) -> tuple[float, float]:
    """Return the coefficients of |v|v [kg/m] and of |v|r [kg m] in cross-flow drag, positive.

    Y = −½ρ T C_D ∫|v + x r|(v + x r) dx and N = −½ρ T C_D ∫x |v + x r|(v + x r) dx over the
    length, C_D of a section by B/2T (Hoerner, 1965; Faltinsen, 1990, section 6). (3.51) has
    one regressor for each: least squares over |r| L/2|v| from 0 to 2, where ships turn.
    """
    points = np.array(_HOERNER)
    drag = float(np.interp(hull.beam / (2 * hull.draught), points[:, 0], points[:, 1]))
    x = (np.arange(200) + 0.5) / 200 - 0.5
    turn = np.linspace(0.0, _TURN_RANGE, 41)[:, None]
    # of v = 1 and lengths of one: r = 2 turn
    across = 1 + 2 * turn * x
    side = np.mean(np.abs(across) * across, axis=1)
    moment = np.mean(x * np.abs(across) * across, axis=1)
    rate = 2 * turn[:, 0]
    base = 0.5 * _WATER * hull.draught * drag * hull.length
    return float(base * side.mean()), float(base * hull.length**2 * (moment @ rate) / (rate @ rate))


def resistance(hull: MainDimensions, speed: float) -> float:
    """Return the resistance in calm water [N] at a speed [m/s].

    Friction ½ρ S U² (1 + k) C_F with C_F = 0.075/(log₁₀ Re − 2)² (ITTC, 1957), wetted surface
    S = 1.7 L T + ∇/T (Mumford), form factor k = 18.7 (C_b B/L)² with C_b B/L = ∇/(L² T) (Granville,
    1956), the allowance C_A = 0.006 (L + 100)^−0.16 − 0.00205 of hulls as they are, and wave
    resistance ρ g ∇ c₁ exp(m₁ Fn^−0.9), both of Holtrop and Mennen (1982), the latter without its
    interference term, with C_p = C_b/0.98 and a half angle of entrance of 20 degrees.
    """
    L, B, T = hull.length, hull.beam, hull.draught
    reynolds = max(abs(speed) * L / _VISCOSITY, 1e4)
    surface = 1.7 * L * T + hull.volume / T
    form = 1 + 18.7 * (hull.volume / (L * L * T)) ** 2
    line = 0.075 / (log10(reynolds) - 2) ** 2
    rough = 0.006 * (L + 100) ** -0.16 - 0.00205
    friction = 0.5 * _WATER * surface * speed**2 * (form * line + rough)
    froude = abs(speed) / sqrt(_GRAVITY * L)
    if froude < 0.05:
        return float(friction)
    wide = float(np.clip(B / L, 0.11, 0.25))
    fine = float(np.clip(hull.block / 0.98, 0.55, 0.85))
    c16 = 8.07981 * fine - 13.8673 * fine**2 + 6.984388 * fine**3
    if fine > 0.8:
        c16 = 1.73014 - 0.7067 * fine
    m1 = 0.0140407 * L / T - 1.75254 * hull.volume ** (1 / 3) / L - 4.79323 * wide - c16
    c1 = 2223105 * wide**3.78613 * (T / B) ** 1.07961 * (90 - 20) ** -1.37565
    wave = hull.mass * _GRAVITY * c1 * exp(m1 * min(froude, _FROUDE_MOST) ** -0.9)
    return float(friction + wave)


def full_thrust(vessel: Vessel) -> float:
    """Return the thrust along the ship with every propeller at its limit ahead, in its law's unit.

    Azimuths are turned ahead, whatever the limits of their angles in a trial.

    Raises
    ------
    VesselError
        A propeller that could push ahead has no limits, or none pushes ahead.
    """
    total = 0.0
    for t in vessel.thrusters:
        along = _ahead(t)
        if abs(along) < 1e-9:
            continue
        if t.speed_limits.lower is None or t.speed_limits.upper is None:
            raise VesselError(
                f"the thruster driven by '{t.speed}' has no speed_limits, and without a model the "
                f"thrust is known by the speed that full ahead reaches: add them in the vessel "
                f"file."
            )
        ends = (t.speed_limits.lower, t.speed_limits.upper)
        total += max(t.gain * along * _law(t, n) for n in ends)
    if not total > 0:
        raise VesselError(
            "no thruster of the vessel file pushes ahead within its speed_limits, so no speed "
            "can be told without a model: correct them, or design with --model."
        )
    return total


def _ahead(t: Thruster) -> float:
    """Return the share of a thruster's force that can push along the ship."""
    return 1.0 if isinstance(t.angle, str) else round(cos(t.angle), 15)


def _law(t: Thruster, speed: float) -> float:
    return float(ca.evalf(t.thrust.force(ca.SX(speed))))


def _in_newtons(vessel: Vessel) -> bool:
    return all(t.thrust.unit == "N" for t in vessel.thrusters if abs(_ahead(t)) > 1e-9)


def _at_thrust(hull: MainDimensions, thrust: float) -> MainDimensions:
    """Return the hull at the speed where resistance takes a thrust [N]."""
    speeds = np.linspace(0.02, _FROUDE_MOST, 200) * sqrt(_GRAVITY * hull.length)
    taken = np.maximum.accumulate([resistance(hull, u) for u in speeds])
    speed = float(np.interp(thrust, taken, speeds))
    return replace(hull, speed=speed)


def _thrust_gain(vessel: Vessel, hull: MainDimensions) -> tuple[float, float]:
    """Return newtons at rest per unit of the thrust laws, and the resistance at service speed.

    Full thrust less `_LOSS` holds the service speed. Where thrust is known in newtons it says how
    much the resistance is; else the resistance says how much the thrust is.
    """
    full = full_thrust(vessel)
    if _in_newtons(vessel):
        return 1 - _DEDUCTION, (1 - _DEDUCTION) * (1 - _LOSS) * full
    drag = resistance(hull, hull.speed)
    return drag / ((1 - _LOSS) * full), drag


def _resistance_terms(hull: MainDimensions, drag: float) -> tuple[float, float]:
    """Return a and b of a u + b |u|u, fitted below service speed and equal to `drag` at it."""
    U = hull.speed
    speeds = np.linspace(0.1, 1.0, 10) * U
    shape = np.array([resistance(hull, u) for u in speeds])
    shape *= drag / shape[-1]
    # b = (drag − a U) / U²; the linear part is between none and a fifth
    w = speeds / U
    linear = float(np.clip((shape / drag - w**2) @ (w - w**2) / np.sum((w - w**2) ** 2), 0.05, 0.2))
    return linear * drag / U, (1 - linear) * drag / U**2


def _wind_terms(hull: MainDimensions, surge: float, inertia: Array) -> dict[str, float]:
    """Return the terms of still air and wind (Blendermann, 1994), areas assumed."""
    front, side = _FRONT * hull.beam**2, _SIDE * hull.length**2
    base = 0.5 * _AIR
    return {
        "Wuu": -base * _WIND_X * front / surge,
        "Wvv": -base * _WIND_Y * side / inertia[0, 0],
        "Wuv": -base * 2 * _WIND_N * side * hull.length / inertia[1, 1],
    }


def _rudder_terms(
    vessel: Vessel, hull: MainDimensions, surge: float, push: Array, gain: float
) -> dict[str, float]:
    """Return the terms of rudders behind propellers.

    Normal force ½ρ A f U_R² sin δ with f = 6.13 Λ/(Λ + 2.25) (Fujii and Tsuda, 1961) and the area
    A = (T L/100)(1 + 25 (B/L)²) of all rudders together (Det Norske Veritas, 1975); the inflow
    U_R² = (1 − w)² u|u| + η 2T/(ρ A_p) of `greybox.vessel.force`; on the hull it acts
    (1 + a_H)-fold across, with the moment x_R + a_H x_H, and (1 − t_R)-fold along (Yasukawa and
    Yoshimura, 2015, eq. 12).
    """
    rudders = [t for t in vessel.thrusters if t.rudder is not None]
    if not rudders:
        return {}
    L, T = hull.length, hull.draught
    area = T * L / 100 * (1 + 25 * (hull.beam / L) ** 2) / len(rudders)
    slope = 6.13 * _ASPECT / (_ASPECT + 2.25)
    force = 0.5 * _WATER * area * slope
    place = float(np.mean([t.x for t in rudders])) or -L / 2
    disc = pi / 4 * (_DIAMETER * T) ** 2
    inflow = (1 - _WAKE) ** 2
    # thrust of a propeller itself at service speed, per unit of its law
    own = gain * (1 - _LOSS) / (1 - _DEDUCTION)
    race = _RACE * 2 * own / (_WATER * disc)
    side, turn = push @ np.array([-(1 + _A_H), -(place + _A_H * _X_H * L)]) * force
    along = -(1 - _T_R) * force / surge
    return {
        "Y_|u|u*rudder": side * inflow,
        "N_|u|u*rudder": turn * inflow,
        "X_|u|u*rudder_drag": along * inflow,
        "Y_race": side * race,
        "N_race": turn * race,
        "X_race_drag": along * race,
    }


def _standard_errors(
    structure: Structure, theta: Array, vessel: Vessel, hull: MainDimensions
) -> Array:
    """Return a standard error for each parameter, its spread and a floor (p,).

    The floor keeps what formulas have as zero open: it is a share of what the largest term of
    the equation does at service speed with some drift, turning and full thrust.
    """
    full = full_thrust(vessel)
    thrust = dict.fromkeys(("taux", "tauy", "race", "race_drag"), full)
    size = {
        "u": hull.speed, "v": _DRIFT * hull.speed, "r": _RATE * hull.speed / hull.length,
        "uq": hull.speed, "vq": _DRIFT * hull.speed, "rudder": 0.3, "rudder_drag": 0.1,
        "taun": full * hull.length / 4, **thrust,
    }  # fmt: skip
    felt = np.array([np.prod([size[f.signal] for f in t.factors]) for t in structure.terms])
    acting = np.abs(theta) * felt
    most = np.array(
        [max(a for a, o in zip(acting, structure.terms, strict=True) if o.state == t.state)
         for t in structure.terms]
    )  # fmt: skip
    air = np.array([t.of_air for t in structure.terms])
    floor = np.where(air, 0.0, _FLOOR * most / felt)
    spread = np.array([_SPREAD.get(n, _SPREAD_RUDDER) for n in structure.parameters])
    spread *= 2.0 if hull.several_hulls else 1.0
    return np.asarray(np.sqrt((spread * theta) ** 2 + floor**2))


def _sample_time(hull: MainDimensions) -> float:
    """Return a round number of a tenth of the time of one length, 0.05 to 1 s."""
    wanted = hull.length / hull.speed / 10
    return max((t for t in (0.05, 0.1, 0.2, 0.5, 1.0) if t <= wanted), default=0.05)
