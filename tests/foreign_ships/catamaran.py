"""Twin-screw catamarans that steer by their propellers alone.

Two slender hulls, each with its own resistance at its own speed through the water, strips of
cross-flow drag along them, added mass that couples sway and yaw (neither the centre of gravity
nor that of the added mass lies at the origin), and a fixed propeller behind each hull whose
thrust goes with n|n| and falls with its own speed of advance.

The inertia of the water is symmetric, so its Coriolis forces are those of potential flow
(Lamb; Fossen, 2021, Handbook of Marine Craft Hydrodynamics and Motion Control, ch. 6) and do
no work. Magnitudes are those of small survey craft and of a catamaran ferry; no set belongs to
one real ship.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

from foreign_ships.environment import GRAVITY, Windage
from foreign_ships.ship import Actuator, Noise, Ship, thruster_table


@dataclass(frozen=True)
class Mechanisms:
    """What of the model acts; with all of it off the ship is a linear system.

    Attributes
    ----------
    quadratic_drag : bool
        Resistance by speed squared; else linear.
    separate_hulls : bool
        Each hull's resistance at its own speed, which damps yaw.
    crossflow : bool
        Strips of cross-flow drag.
    lift : bool
        Sway damping that grows with forward speed; else that of service speed.
    coriolis : bool
        Products of velocities from a turning frame, Munk moment included.
    coupled_inertia : bool
        Sway acceleration turns the ship and yaw acceleration shifts it.
    quadratic_thrust : bool
        Thrust by n|n| and weaker astern; else by n.
    advance : bool
        Thrust falls with the propeller's speed of advance, which turning changes.
    asymmetry : bool
        A weaker port propeller, and a side force and moment of the hulls by u|u|.
    actuator_dynamics : bool
        Lags and rate limits of the motors.
    """

    quadratic_drag: bool = True
    separate_hulls: bool = True
    crossflow: bool = True
    lift: bool = True
    coriolis: bool = True
    coupled_inertia: bool = True
    quadratic_thrust: bool = True
    advance: bool = True
    asymmetry: bool = True
    actuator_dynamics: bool = True


@dataclass(frozen=True)
class Catamaran(Ship):
    """Two hulls, two fixed propellers.

    Attributes
    ----------
    name : str
    length, beam, draught, spacing : float
        [m]; `spacing` between the middles of the hulls.
    service_speed : float
        [m/s] at service revolutions.
    service_revolutions : float
        As logged (rpm).
    mass : float
        [kg].
    x_G, x_A : float
        Of the centre of gravity and of the added mass in sway [m].
    propeller : tuple of float
        x and y of the starboard propeller [m].
    gyradius : float
        In lengths.
    added : tuple of float
        Added mass in surge and sway over mass, added yaw inertia over that of the ship.
    resistance : float
        At service speed over weight.
    linear_drag : float
        Share of the resistance at service speed that is linear.
    sway_damping, yaw_damping : float
        Linear, at service speed, over mass (inertia) and U/L.
    sway_by_yaw, yaw_by_sway : float
        Y_r over mass U and N_v over mass U, at service speed.
    standing_damping : float
        Share of the linear damping that is left at rest.
    cross_drag : float
        Coefficient of cross-flow drag of one hull, the other one's shelter included.
    loss : float
        Share of the thrust at rest that is lost at service speed.
    reverse : float
        Thrust astern over that ahead, at rest.
    weaker_port, heel_force, heel_arm : float
        The asymmetry: gain of the port propeller, side force over resistance, its x in lengths.
    motor_lag, motor_rate : float
        [s], and service revolutions per second.
    """

    name: str
    length: float
    beam: float
    draught: float
    spacing: float
    service_speed: float
    service_revolutions: float
    mass: float
    x_G: float
    x_A: float
    propeller: tuple[float, float]
    windage: Windage
    gyradius: float = 0.27
    added: tuple[float, float, float] = (0.08, 0.9, 0.7)
    resistance: float = 0.04
    linear_drag: float = 0.15
    sway_damping: float = 2.4
    yaw_damping: float = 2.3
    sway_by_yaw: float = 0.15
    yaw_by_sway: float = 0.55
    standing_damping: float = 0.15
    cross_drag: float = 0.8
    loss: float = 0.35
    reverse: float = 0.7
    weaker_port: float = 0.94
    heel_force: float = 0.05
    heel_arm: float = 0.1
    motor_lag: float = 0.4
    motor_rate: float = 1.0
    rho: float = 1025.0
    noise: Noise = field(default_factory=Noise)
    mechanisms: Mechanisms = field(default_factory=Mechanisms)

    @cached_property
    def inertia(self) -> tuple[float, float, float]:
        centre = self.x_G if self.mechanisms.coupled_inertia else 0.0
        return self.mass, centre, self.mass * ((self.gyradius * self.length) ** 2 + centre**2)

    @cached_property
    def masses(self) -> tuple[float, float, float, float]:
        """Return the inertias of surge, sway, yaw and that which couples the last two."""
        m, centre, inertia = self.inertia
        surge, sway, yaw = self.added
        arm = self.x_A if self.mechanisms.coupled_inertia else 0.0
        return (
            m * (1 + surge),
            m * (1 + sway),
            inertia + yaw * m * (self.gyradius * self.length) ** 2 + m * sway * arm**2,
            m * centre + m * sway * arm,
        )

    @cached_property
    def _strips(self) -> tuple[tuple[float, float], ...]:
        """Return the place of each strip of one hull and its drag over w|w|; fine at the bow."""
        count = 12
        out = []
        for i in range(count):
            x = (i + 0.5) / count - 0.5
            depth = self.draught * (1.0 if x < 0.2 else 1 - 0.6 * ((x - 0.2) / 0.3) ** 2)
            area = depth * self.length / count
            out.append((x * self.length, self.rho / 2 * self.cross_drag * 2 * area))
        return tuple(out)

    @cached_property
    def service_drag(self) -> float:
        """Return the resistance at service speed [N]."""
        return self.resistance * self.mass * GRAVITY

    @cached_property
    def actuators(self) -> tuple[Actuator, ...]:
        n = self.service_revolutions
        return tuple(
            Actuator(column, (-n, 1.2 * n), self.motor_rate * n, self.motor_lag)
            for column in ("n_port", "n_starboard")
        )

    @property
    def follows_at_once(self) -> bool:
        return not self.mechanisms.actuator_dynamics

    def helm(self, ahead: float, turn: float, side: float = 0.0) -> tuple[float, ...]:
        n = self.service_revolutions
        return (ahead + 0.8 * turn) * n, (ahead - 0.8 * turn) * n

    def thruster_toml(self, thrust: str | None) -> list[str]:
        x, y = self.propeller
        lines = []
        for side, actuator in zip((-y, y), self.actuators, strict=True):
            entries: dict[str, object] = {
                "type": "fixed",
                "x": x,
                "y": side,
                "speed": actuator.column,
                "speed_limits": actuator.limits,
                "speed_rate": actuator.rate,
            }
            lines += thruster_table(entries, thrust)
        return lines

    def drag(self, u: float) -> float:
        """Return the resistance of both hulls [N]."""
        w = u / self.service_speed
        if not self.mechanisms.quadratic_drag:
            return self.service_drag * w
        return self.service_drag * (self.linear_drag * w + (1 - self.linear_drag) * w * abs(w))

    def thrust(self, n: float, inflow: float) -> float:
        """Return the thrust of one propeller [N], at a speed of advance [m/s]."""
        flags = self.mechanisms
        bollard = self.service_drag / 2 / (1 - self.loss)
        turns = n / self.service_revolutions
        pace = abs(turns) if flags.quadratic_thrust else 1.0
        weaker = self.reverse if turns < 0 and flags.quadratic_thrust else 1.0
        if not flags.advance:
            return bollard * (1 - self.loss) * weaker * turns * pace
        return bollard * pace * (weaker * turns - self.loss * inflow / self.service_speed)

    def forces(
        self, motion: Sequence[float], actuators: Sequence[float]
    ) -> tuple[float, float, float]:
        """Return the force forward and to starboard [N] and the moment [Nm]."""
        u, v, r = motion
        flags = self.mechanisms
        speed, length, m = self.service_speed, self.length, self.mass
        if flags.separate_hulls:
            half = self.spacing / 2
            port, starboard = self.drag(u + half * r) / 2, self.drag(u - half * r) / 2
            x, n = -port - starboard, half * (starboard - port)
        else:
            x, n = -self.drag(u), 0.0
        pace = speed
        if flags.lift:
            pace = self.standing_damping * speed + (1 - self.standing_damping) * abs(u)
        spin = m * (self.gyradius * length) ** 2
        y = m * pace * (-self.sway_damping * v / length + self.sway_by_yaw * r)
        n += pace * (m * self.yaw_by_sway * v - self.yaw_damping * spin * r / length)
        if flags.crossflow:
            for place, area in self._strips:
                w = v + place * r
                d = area * w * abs(w)
                y -= d
                n -= place * d
        # the stern of the origin's axes: a propeller at (x, y) meets the water at u - y r
        arm = self.propeller[1]
        left = self.thrust(actuators[0], u + arm * r)
        right = self.thrust(actuators[1], u - arm * r)
        if flags.asymmetry:
            left *= self.weaker_port
            side = self.heel_force * self.service_drag * u * abs(u) / speed**2
            y += side
            n += side * self.heel_arm * length
        return x + left + right, y, n + arm * (left - right)

    def accelerations(
        self, motion: Sequence[float], actuators: Sequence[float], push: Sequence[float]
    ) -> tuple[float, ...]:
        u, v, r = motion
        x, y, n = self.forces(motion, actuators)
        x, y, n = x + push[0], y + push[1], n + push[2]
        surge, sway, yaw, coupling = self.masses
        if self.mechanisms.coriolis:
            across = sway * v + coupling * r
            x += across * r
            y -= surge * u * r
            n -= across * u - surge * u * v
        determinant = sway * yaw - coupling * coupling
        return (
            x / surge,
            (yaw * y - coupling * n) / determinant,
            (sway * n - coupling * y) / determinant,
        )


def survey_craft(length: float = 2.0, **changes: object) -> Catamaran:
    """Return a battery-driven survey catamaran of 1 to 3 m (2 m: 60 kg, 1.6 m/s)."""
    scale = length / 2.0
    entries: dict[str, object] = {
        "name": f"Survey catamaran {length:g} m",
        "length": length,
        "beam": 1.08 * scale,
        "draught": 0.18 * scale,
        "spacing": 0.82 * scale,
        "service_speed": 1.6 * math.sqrt(scale),
        "service_revolutions": 900.0 / math.sqrt(scale),
        "mass": 60.0 * scale**3,
        "x_G": 0.10 * scale,
        "x_A": -0.06 * scale,
        "propeller": (-0.85 * scale, 0.41 * scale),
        "windage": Windage(0.22 * scale**2, 0.45 * scale**2, arm=0.08 * scale),
        "motor_lag": 0.35,
        "motor_rate": 1.2,
        "rho": 1000.0,
    }
    return Catamaran(**(entries | changes))  # type: ignore[arg-type]


def research_catamaran(**changes: object) -> Catamaran:
    """Return a research catamaran of 29 m and 165 t that makes 10 knots."""
    entries: dict[str, object] = {
        "name": "Research catamaran 29 m",
        "length": 29.0,
        "beam": 10.5,
        "draught": 1.9,
        "spacing": 7.6,
        "service_speed": 5.2,
        "service_revolutions": 420.0,
        "mass": 165e3,
        "x_G": -1.1,
        "x_A": 0.9,
        "propeller": (-12.5, 3.8),
        "windage": Windage(62.0, 118.0, arm=1.5),
        "resistance": 0.05,
        "sway_damping": 2.2,
        "yaw_damping": 3.0,
        "added": (0.06, 1.1, 0.8),
        "cross_drag": 0.6,
        "motor_lag": 2.0,
        "motor_rate": 0.15,
        "weaker_port": 0.97,
    }
    return Catamaran(**(entries | changes))  # type: ignore[arg-type]
