"""Single-screw ships by the MMG standard model.

The model is that of Yasukawa and Yoshimura (2015), J Mar Sci Technol 20, 37-52: hull
derivatives about midship, a propeller by K_T(J) in a wake that the drift angle changes, and a
rudder's normal force in the propeller race with flow straightening. Two hulls are known: the
polynomial one of that paper, and Yoshimura's for low speed with a cross-flow integral. Both
are continued to stopped ships and to propellers that turn astern, where the paper is silent.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

from scipy.optimize import brentq

from foreign_ships.environment import Windage
from foreign_ships.ship import Actuator, Noise, Ship, thruster_table


@dataclass(frozen=True)
class Mechanisms:
    """What of the model acts; with all of it off the ship is a linear system.

    Attributes
    ----------
    nonlinear_hull : bool
        Hull forces beyond the linear damping at service speed.
    coriolis : bool
        Products of velocities from a turning frame, Munk moment included.
    coupled_inertia : bool
        The centre of gravity off midship couples sway and yaw.
    quadratic_thrust : bool
        Thrust by n|n| and weaker astern; else by n.
    advance : bool
        Thrust falls with the speed of advance.
    wake_drift : bool
        Drift and turning change the wake.
    rudder_inflow : bool
        Rudder force by the square of the inflow, its drag; else by the angle alone.
    race : bool
        The propeller's race raises the inflow.
    straightening : bool
        Drift and turning change the angle of the inflow.
    asymmetry : bool
        Port and starboard differ in wake and flow straightening.
    propeller_walk : bool
        Side force of the propeller.
    actuator_dynamics : bool
        Lags and rate limits of propeller and rudder.
    """

    nonlinear_hull: bool = True
    coriolis: bool = True
    coupled_inertia: bool = True
    quadratic_thrust: bool = True
    advance: bool = True
    wake_drift: bool = True
    rudder_inflow: bool = True
    race: bool = True
    straightening: bool = True
    asymmetry: bool = True
    propeller_walk: bool = True
    actuator_dynamics: bool = True


@dataclass(frozen=True)
class PolynomialHull:
    """Third-order derivatives in v' and r', forces over rho/2 L d U2 (moment L more)."""

    X_vv: float
    X_vr: float
    X_rr: float
    X_vvvv: float
    Y_v: float
    Y_r: float
    Y_vvv: float
    Y_vvr: float
    Y_vrr: float
    Y_rrr: float
    N_v: float
    N_r: float
    N_vvv: float
    N_vvr: float
    N_vrr: float
    N_rrr: float

    def forces(self, u: float, v: float, r: float) -> tuple[float, float, float]:
        """Return X, Y, N of velocities with r in lengths, divided by rho/2 L d."""
        # a ship that turns on the spot has no v' and r': the speed is kept from vanishing beside r
        U = max(math.sqrt(u * u + v * v), 0.7 * abs(r), 1e-9)
        vp, rp, U2 = v / U, r / U, U * U
        v2, r2 = vp * vp, rp * rp
        return (
            U2 * (self.X_vv * v2 + self.X_vr * vp * rp + self.X_rr * r2 + self.X_vvvv * v2 * v2),
            U2
            * (
                vp * (self.Y_v + self.Y_vvv * v2 + self.Y_vrr * r2)
                + rp * (self.Y_r + self.Y_vvr * v2 + self.Y_rrr * r2)
            ),
            U2
            * (
                vp * (self.N_v + self.N_vvv * v2 + self.N_vrr * r2)
                + rp * (self.N_r + self.N_vvr * v2 + self.N_rrr * r2)
            ),
        )


@dataclass(frozen=True)
class CrossflowHull:
    """Linear derivatives by |u| and the drag of cross-flow along the hull (Yoshimura, 2009)."""

    X_vr: float
    Y_v: float
    Y_r: float
    N_v: float
    N_r: float
    drag: float
    reach_y: float  # how much of the rate of turn the drag sees, in sway and in yaw
    reach_n: float

    def forces(self, u: float, v: float, r: float) -> tuple[float, float, float]:
        """Return X, Y, N of velocities with r in lengths, divided by rho/2 L d."""
        side, _ = crossflow(v, self.reach_y * r)
        _, moment = crossflow(v, self.reach_n * r)
        return (
            self.X_vr * v * r,
            self.Y_v * v * abs(u) + self.Y_r * r * u - self.drag * side,
            self.N_v * v * u + self.N_r * r * abs(u) - self.drag * moment,
        )


def crossflow(v: float, r: float) -> tuple[float, float]:
    """Return the integrals of w|w| and of x w|w| with w = v + r x, x from -1/2 to 1/2."""
    if abs(r) < 1e-4 * abs(v) or abs(r) < 1e-12:
        return v * abs(v), abs(v) * r / 6
    fore, aft = v + r / 2, v - r / 2
    a, b = abs(fore) ** 3, abs(aft) ** 3
    return (a - b) / (3 * r), ((fore * a - aft * b) / 4 - v * (a - b) / 3) / (r * r)


@dataclass(frozen=True)
class MMG(Ship):
    """One propeller, one rudder; lengths in m, masses and derivatives without dimension.

    Attributes are named as in the paper; `wake` is either "exponential" (w exp(-4 beta_P^2)) or
    the paper's, with C_1 and C_2 of either side. Masses are over rho/2 L2 d, inertias over
    rho/2 L4 d, the positions x_P, x_R, x_H and l_R in lengths.
    """

    name: str
    length: float
    beam: float
    draught: float
    service_speed: float
    volume: float
    x_G: float
    D_p: float
    A_R: float
    eta: float
    hull: PolynomialHull | CrossflowHull
    R_0: float
    m_x: float
    m_y: float
    J_z: float
    t_P: float
    w_P0: float
    k: tuple[float, float, float]
    t_R: float
    a_H: float
    x_H: float
    epsilon: float
    kappa: float
    l_R: float
    f_alpha: float
    gamma_minus: float
    gamma_plus: float
    windage: Windage
    gyradius: float = 0.25
    x_R: float = -0.5
    x_P: float = -0.48
    wake: str = "paper"
    C_1: float = 2.0
    C_2_plus: float = 1.6
    C_2_minus: float = 1.1
    reverse: float = 0.65  # thrust astern over that ahead, at rest
    walk: float = 0.03  # side force over thrust: to port ahead and to starboard astern, at -L/2
    rho: float = 1000.0
    rudder_rate: float = math.radians(2.34)
    rudder_lag: float = 0.3
    propeller_lag: float = 1.0
    rudder_limit: float = math.radians(35)
    noise: Noise = field(default_factory=Noise)
    mechanisms: Mechanisms = field(default_factory=Mechanisms)

    @cached_property
    def service_revolutions(self) -> float:
        """Return the revolutions [1/s] at which thrust balances resistance at service speed."""
        u, d = self.service_speed, self.D_p
        inflow = (1 - self.w_P0) * u
        drag = self._unit * self.R_0 * u**2 / (1 - self.t_P) / (self.rho * d**2)
        k0, k1, k2 = self.k

        def excess(n: float) -> float:
            return k0 * (n * d) ** 2 + k1 * n * d * inflow + k2 * inflow**2 - drag

        return float(brentq(excess, 0.05 * u / d, 10 * u / d))

    @cached_property
    def _unit(self) -> float:
        return self.rho / 2 * self.length * self.draught

    @cached_property
    def inertia(self) -> tuple[float, float, float]:
        m = self.rho * self.volume
        centre = self.x_G if self.mechanisms.coupled_inertia else 0.0
        return m, centre, m * ((self.gyradius * self.length) ** 2 + centre**2)

    @cached_property
    def _masses(self) -> tuple[float, float, float, float]:
        """Return the inertias of surge, sway, yaw and that which couples the last two."""
        m, centre, inertia = self.inertia
        unit = self._unit * self.length
        return (
            m + self.m_x * unit,
            m + self.m_y * unit,
            inertia + self.J_z * unit * self.length**2,
            m * centre,
        )

    @cached_property
    def actuators(self) -> tuple[Actuator, ...]:
        n = self.service_revolutions
        return (
            Actuator("n", (-0.7 * n, 1.2 * n), 0.5 * n / self.propeller_lag, self.propeller_lag),
            Actuator(
                "delta",
                (-self.rudder_limit, self.rudder_limit),
                self.rudder_rate,
                self.rudder_lag,
                angle=True,
            ),
        )

    @property
    def follows_at_once(self) -> bool:
        return not self.mechanisms.actuator_dynamics

    def helm(self, ahead: float, turn: float, side: float = 0.0) -> tuple[float, ...]:
        return ahead * self.service_revolutions, turn * math.radians(35)

    def thruster_toml(self, thrust: str | None) -> list[str]:
        n, delta = self.actuators
        entries: dict[str, object] = {
            "type": "propeller_rudder",
            "x": self.x_R * self.length,
            "y": 0.0,
            "speed": n.column,
            "rudder": delta.column,
            "speed_limits": n.limits,
            "rudder_limits": delta.limits,
            "rudder_rate": delta.rate,
        }
        return thruster_table(entries, thrust)

    def propeller(self, n: float, inflow: float) -> float:
        """Return the thrust of the open propeller [N], in any direction of turning."""
        k0, k1, k2 = self.k
        d = self.D_p
        flags = self.mechanisms
        service = self.service_revolutions
        pace = abs(n) if flags.quadratic_thrust else service
        if not flags.advance:
            fixed = (1 - self.w_P0) * self.service_speed / (service * d)
            force = (k0 + k1 * fixed + k2 * fixed**2) * pace * n * d * d
            return self.rho * d * d * force * self._astern(n)
        slope = k1 * pace * d * inflow if n > 0 or not flags.quadratic_thrust else 0.0
        force = k0 * pace * n * d * d * self._astern(n) + slope + k2 * inflow * abs(inflow)
        return self.rho * d * d * force

    def _astern(self, n: float) -> float:
        return self.reverse if n < 0 and self.mechanisms.quadratic_thrust else 1.0

    def _wake(self, beta: float, r: float) -> float:
        """Return 1 - w_P."""
        base = 1 - self.w_P0
        if not self.mechanisms.wake_drift:
            return base
        angle = beta - self.x_P * r
        if self.wake == "exponential":
            return 1 - self.w_P0 * math.exp(-4 * angle * angle)
        plus, minus = self.C_2_plus, self.C_2_minus
        if not self.mechanisms.asymmetry:
            plus = minus = (plus + minus) / 2
        rise = (plus if angle > 0 else minus) - 1
        return base * (1 + rise * (1 - math.exp(-self.C_1 * abs(angle))))

    def rudder(self, delta: float, inflow: float, thrust: float, across: float) -> float:
        """Return the normal force [N] of the rudder in an inflow along and across [m/s]."""
        area = self.rho / 2 * self.A_R * self.f_alpha
        if not self.mechanisms.rudder_inflow:
            return area * ((1 - self.w_P0) * self.epsilon * self.service_speed) ** 2 * delta
        if self.mechanisms.race and thrust > 0:
            jet = math.sqrt(inflow * inflow + 8 * thrust / (math.pi * self.rho * self.D_p**2))
            faster = inflow + self.kappa * (jet - abs(inflow))
            along = self.eta * faster * abs(faster) + (1 - self.eta) * inflow * abs(inflow)
            along = self.epsilon * math.copysign(math.sqrt(abs(along)), along)
        else:
            along = self.epsilon * inflow
        angle = delta - math.atan2(across, along)
        return area * (along * along + across * across) * math.sin(angle)

    def forces(
        self, motion: Sequence[float], actuators: Sequence[float]
    ) -> tuple[float, float, float]:
        """Return the force forward and to starboard [N] and the moment [Nm] about midship."""
        u, v, r = motion
        n, delta = actuators
        flags = self.mechanisms
        length = self.length
        turning = r * length
        if flags.nonlinear_hull:
            x, y, z = self.hull.forces(u, v, turning)
            # the published drag by U2 acts against u; it fades where the ship drifts sideways
            square = u * u + v * v
            x -= self.R_0 * square * min(1.0, max(-1.0, 3 * u / (math.sqrt(square) + 1e-9)))
        else:
            speed = self.service_speed
            x = -self.R_0 * speed * u
            y = speed * (self.hull.Y_v * v + self.hull.Y_r * turning)
            z = speed * (self.hull.N_v * v + self.hull.N_r * turning)
        x, y, z = x * self._unit, y * self._unit, z * self._unit * length

        # the angles of the flow lose their meaning at rest: the speed beside them does not vanish
        U = max(math.sqrt(u * u + v * v), 0.3 * abs(turning), 1e-9)
        beta = math.atan2(-v, abs(u)) if U > 1e-9 else 0.0
        advance = u * (self._wake(beta, turning / U) if u > 0 else 1.0)
        thrust = self.propeller(n, advance)
        x += (1 - self.t_P) * thrust
        if flags.propeller_walk:
            side = -self.walk * thrust
            y += side
            z -= side * length / 2
        across = 0.0
        if flags.straightening:
            flow = beta - self.l_R * turning / U
            plus, minus = self.gamma_plus, self.gamma_minus
            if not flags.asymmetry:
                plus = minus = (plus + minus) / 2
            across = U * flow * (plus if flow > 0 else minus)
        normal = self.rudder(delta, advance, thrust, across)
        if flags.rudder_inflow:
            x -= (1 - self.t_R) * normal * math.sin(delta)
            normal *= math.cos(delta)
        y -= (1 + self.a_H) * normal
        z -= (self.x_R + self.a_H * self.x_H) * length * normal
        return x, y, z

    def accelerations(
        self, motion: Sequence[float], actuators: Sequence[float], push: Sequence[float]
    ) -> tuple[float, ...]:
        u, v, r = motion
        x, y, z = self.forces(motion, actuators)
        x, y, z = x + push[0], y + push[1], z + push[2]
        surge, sway, yaw, coupling = self._masses
        if self.mechanisms.coriolis:
            x += sway * v * r + coupling * r * r
            y -= surge * u * r
            z -= coupling * u * r
        determinant = sway * yaw - coupling * coupling
        return (
            x / surge,
            (yaw * y - coupling * z) / determinant,
            (sway * z - coupling * y) / determinant,
        )


KVLCC2_HULL = PolynomialHull(
    X_vv=-0.040,
    X_vr=0.002,
    X_rr=0.011,
    X_vvvv=0.771,
    Y_v=-0.315,
    Y_r=0.083,
    Y_vvv=-1.607,
    Y_vvr=0.379,
    Y_vrr=-0.391,
    Y_rrr=0.008,
    N_v=-0.137,
    N_r=-0.049,
    N_vvv=-0.030,
    N_vvr=-0.294,
    N_vrr=0.055,
    N_rrr=-0.013,
)


def kvlcc2(length: float = 7.0, **changes: object) -> MMG:
    """Return the tanker of Yasukawa and Yoshimura (2015), as a model of 7 m or another length.

    Beyond 100 m the wake fraction is the paper's of the full-scale ship. Rates of actuators and
    windage (loaded tanker) go by Froude's law from the ship of 320 m.
    """
    scale = length / 7.0
    full = length / 320.0
    sea = length > 100
    entries: dict[str, object] = {
        "name": f"KVLCC2 {length:g} m",
        "length": length,
        "beam": 1.27 * scale,
        "draught": 0.46 * scale,
        "service_speed": 1.179 * math.sqrt(scale),
        "volume": 3.27 * scale**3,
        "x_G": 0.25 * scale,
        "D_p": 0.216 * scale,
        "A_R": 0.0539 * scale**2,
        "eta": 0.626,
        "hull": KVLCC2_HULL,
        "R_0": 0.022,
        "m_x": 0.022,
        "m_y": 0.223,
        "J_z": 0.011,
        "t_P": 0.220,
        "w_P0": 0.35 if sea else 0.40,
        "k": (0.2931, -0.2753, -0.1385),
        "t_R": 0.387,
        "a_H": 0.312,
        "x_H": -0.464,
        "epsilon": 1.09,
        "kappa": 0.50,
        "l_R": -0.710,
        "f_alpha": 2.747,
        "gamma_minus": 0.395,
        "gamma_plus": 0.640,
        "windage": Windage(1160 * full**2, 3200 * full**2, arm=-0.05 * length),
        "rho": 1025.0 if sea else 1000.0,
        "rudder_rate": math.radians(2.34) / math.sqrt(full),
        "rudder_lag": 2.0 * math.sqrt(full),
        "propeller_lag": 8.0 * math.sqrt(full),
    }
    return MMG(**(entries | changes))  # type: ignore[arg-type]


def training_ship(**changes: object) -> MMG:
    """Return a training ship of 105 m, slender and stable on its course.

    Derivatives after Yoshimura and Masumoto (2012), MARSIM, as collected for the Seiun Maru in
    mmgdynamics (nikpau/mmgdynamics, calibrated_vessels.py).
    """
    hull = PolynomialHull(
        X_vv=-0.0804,
        X_vr=0.072,
        X_rr=0.022,
        X_vvvv=0.439,
        Y_v=-0.317,
        Y_r=0.052,
        Y_vvv=-1.604,
        Y_vvr=-0.75,
        Y_vrr=-0.8599,
        Y_rrr=-0.051,
        N_v=-0.1136,
        N_r=-0.0795,
        N_vvv=-0.3095,
        N_vvr=-0.6257,
        N_vrr=-0.3143,
        N_rrr=-0.0502,
    )
    entries: dict[str, object] = {
        "name": "Training ship 105 m",
        "length": 105.0,
        "beam": 17.91,
        "draught": 5.966,
        "service_speed": 7.2,
        "volume": 5701.6,
        "x_G": -2.249,
        "D_p": 4.7,
        "A_R": 13.405,
        "eta": 0.960,
        "hull": hull,
        "R_0": 0.016,
        "m_x": 0.0167,
        "m_y": 0.1576,
        "J_z": 0.009,
        "t_P": 0.21,
        "w_P0": 0.204,
        "k": (0.4, -0.4, 0.0),
        "t_R": 0.341,
        "a_H": 0.236,
        "x_H": -0.4,
        "epsilon": 1.033,
        "kappa": 0.676,
        "l_R": -0.947,
        "f_alpha": 2.88,
        "gamma_minus": 0.312,
        "gamma_plus": 0.394,
        "windage": Windage(260.0, 1050.0, arm=-2.0),
        "wake": "exponential",
        "x_P": -0.5,
        "rudder_rate": math.radians(3.0),
        "rudder_lag": 1.0,
        "propeller_lag": 4.0,
        "rho": 1025.0,
    }
    return MMG(**(entries | changes))  # type: ignore[arg-type]


def esso_osaka(**changes: object) -> MMG:
    """Return the Esso Osaka as a model of 3 m: a tanker with a hull for low speed.

    Towing-tank values as listed beside the trials of the same model (Miyauchi et al., 2022; the
    list of AmaneSakanashi/1216-Baysian-SI-MMG, where Y_r and N_v stand in each other's row), with
    two exceptions: X_vr is the value identified from free running, since the tank's 0.4535
    exceeds the added mass that acts beside it, and the wake falls exponentially with drift. It
    turns wider than the model on the pond does (r' 0.7 against 1.0 at full rudder).
    """
    hull = CrossflowHull(
        X_vr=-0.0769,
        Y_v=-0.3728,
        Y_r=0.116,
        N_v=-0.1458,
        N_r=-0.04849,
        drag=0.9665,
        reach_y=2.217,
        reach_n=0.8097,
    )
    length, draught = 3.0, 0.20114
    entries: dict[str, object] = {
        "name": "Esso Osaka 3 m",
        "length": length,
        "beam": 0.48925,
        "draught": draught,
        "service_speed": 0.38,
        "volume": 0.27078 * length**2 * draught / 2,
        "x_G": 0.0936,
        "D_p": 0.084,
        "A_R": 0.01063,
        "eta": 0.084 / math.sqrt(0.01063 * 1.539),
        "hull": hull,
        "R_0": 0.02139,
        "m_x": 0.0467,
        "m_y": 0.2579,
        # the list gives the inertia of ship and water together
        "J_z": 0.0286 - 0.27078 * (0.2**2 + 0.03119**2),
        "gyradius": 0.2,
        "t_P": 0.22,
        "w_P0": 0.614,
        "k": (0.3278, -0.3323, -0.156),
        "t_R": 0.19,
        "a_H": 0.393,
        "x_H": -0.45,
        "epsilon": 1.42,
        "kappa": 0.288 / 1.42,
        "l_R": -1.08,
        "f_alpha": 6.13 * 1.539 / (2.25 + 1.539),
        "gamma_minus": 0.3506,
        "gamma_plus": 0.4406,
        "windage": Windage(0.13544, 0.52038, arm=-0.013),
        "wake": "exponential",
        "x_P": -0.517,
        "rudder_rate": math.radians(20.0),
        "rudder_lag": 0.1,
        "propeller_lag": 0.5,
    }
    return MMG(**(entries | changes))  # type: ignore[arg-type]
