"""Vessels with azimuth and tunnel thrusters, and with roll.

Surge, sway, roll and yaw with one symmetric inertia of ship and water (Kirchhoff's equations,
so that Coriolis forces do no work), Hoerner-like cross-flow drag in strips, azimuths that turn
at a limited rate, blow on each other and under the hull, and take a side force from the water
that they turn round (ram drag), and a tunnel that fails with speed. The forms are those of
Fossen (2021), Handbook of Marine Craft Hydrodynamics and Motion Control, ch. 6 and 9, and of
Faltinsen (1990), Sea Loads, ch. 8; magnitudes are those of small research, work and passenger
vessels. No set belongs to one real ship.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np

from foreign_ships.environment import GRAVITY, Windage
from foreign_ships.ship import Actuator, Noise, Ship, thruster_table


@dataclass(frozen=True)
class Mechanisms:
    """What of the model acts; with all of it off the ship is linear but for azimuth angles.

    Attributes
    ----------
    quadratic_drag : bool
        Resistance by speed squared; else linear.
    crossflow : bool
        Strips of cross-flow drag.
    lift : bool
        Damping of sway and yaw that grows with forward speed; else that of service speed.
    coriolis : bool
        Products of velocities from a turning frame, Munk moment included.
    coupled_inertia : bool
        Sway acceleration turns the ship and yaw acceleration shifts it.
    roll : bool
        The ship heels, and heel pushes and turns it.
    quadratic_thrust : bool
        Thrust by n|n| and weaker astern; else by n.
    advance : bool
        Thrust falls with the inflow along the thruster.
    interaction : bool
        Azimuths lose thrust in each other's wash and when they blow under the hull.
    ram_drag : bool
        Turning the inflow into the thruster's direction costs a force across.
    tunnel_loss : bool
        Tunnels lose thrust with forward speed.
    asymmetry : bool
        One azimuth is weaker, and the hull has a side force by u|u|.
    actuator_dynamics : bool
        Lags and rate limits of motors and azimuths.
    """

    quadratic_drag: bool = True
    crossflow: bool = True
    lift: bool = True
    coriolis: bool = True
    coupled_inertia: bool = True
    roll: bool = True
    quadratic_thrust: bool = True
    advance: bool = True
    interaction: bool = True
    ram_drag: bool = True
    tunnel_loss: bool = True
    asymmetry: bool = True
    actuator_dynamics: bool = True


@dataclass(frozen=True)
class Unit:
    """One thruster: its place [m], depth [m] and share of the service thrust at rest.

    An azimuth at the stern turns the ship to starboard by a negative angle, at the bow by a
    positive one; `turn` is its angle at full turn and `side` that at full push [rad].
    """

    label: str
    x: float
    y: float
    depth: float
    share: float
    tunnel: bool = False
    turn: float = -math.radians(35)
    side: float = math.radians(50)


@dataclass(frozen=True)
class AzimuthVessel(Ship):
    """A hull with azimuths and tunnels.

    Attributes are those of the catamaran where they share a name; further

    Attributes
    ----------
    units : tuple of Unit
    z_G, z_A : float
        Depth of the centre of gravity and of the added mass in sway below the origin, which lies
        in the water line [m].
    metacentric : float
        Metacentric height [m].
    roll_gyradius : float
        In beams, water included.
    roll_damping : float
        Share of the critical one.
    heel_push, heel_turn : float
        Side force of heel over mass U2/L per rad, and its x in lengths.
    wash, wash_width : float
        Largest loss in another thruster's wash, and the width of that wash [rad].
    under_hull : float
        Largest loss of an azimuth that blows forward under the hull.
    ram : float
        Force across over bollard thrust, at service revolutions and service speed across.
    tunnel_speed, tunnel_loss : float
        Forward speed of the loss, in service speeds, and the largest loss.
    azimuth_rate, azimuth_lag : float
        [rad/s], [s].
    """

    name: str
    length: float
    beam: float
    draught: float
    service_speed: float
    service_revolutions: float
    mass: float
    x_G: float
    x_A: float
    z_G: float
    z_A: float
    metacentric: float
    units: tuple[Unit, ...]
    windage: Windage
    gyradius: float = 0.26
    added: tuple[float, float, float] = (0.06, 0.8, 0.6)
    resistance: float = 0.03
    linear_drag: float = 0.12
    sway_damping: float = 2.0
    yaw_damping: float = 2.4
    sway_by_yaw: float = 0.15
    yaw_by_sway: float = 0.45
    standing_damping: float = 0.12
    cross_drag: float = 0.9
    loss: float = 0.40
    reverse: float = 0.65
    roll_gyradius: float = 0.38
    roll_damping: float = 0.07
    heel_push: float = 0.25
    heel_turn: float = -0.15
    wash: float = 0.25
    wash_width: float = 0.4
    under_hull: float = 0.15
    ram: float = 0.25
    tunnel_speed: float = 0.3
    tunnel_loss: float = 0.75
    weaker: float = 0.95
    heel_force: float = 0.03
    motor_lag: float = 1.0
    motor_rate: float = 0.4
    azimuth_rate: float = math.radians(12)
    azimuth_lag: float = 0.5
    rho: float = 1025.0
    noise: Noise = field(default_factory=Noise)
    mechanisms: Mechanisms = field(default_factory=Mechanisms)

    @property
    def rolls(self) -> bool:  # type: ignore[override]
        """Return whether heel is part of the motion."""
        return self.mechanisms.roll

    @cached_property
    def inertia(self) -> tuple[float, float, float]:
        centre = self.x_G if self.mechanisms.coupled_inertia else 0.0
        return self.mass, centre, self.mass * ((self.gyradius * self.length) ** 2 + centre**2)

    @cached_property
    def masses(self) -> tuple[float, list[list[float]], list[list[float]], float]:
        """Return surge, sway-roll-yaw and its inverse, and surge by pitch (which roll needs)."""
        m, centre, inertia = self.inertia
        surge, sway, yaw = (a * m for a in self.added)
        arm = self.x_A if self.mechanisms.coupled_inertia else 0.0
        z, w = self.z_G, self.z_A
        heel = m * (self.roll_gyradius * self.beam) ** 2
        matrix = np.array(
            [
                [m + sway, -m * z - sway * w, m * centre + sway * arm],
                [0.0, heel + m * z**2 + sway * w**2, -m * centre * z - sway * arm * w],
                [0.0, 0.0, inertia + yaw * (self.gyradius * self.length) ** 2 + sway * arm**2],
            ]
        )
        matrix += np.triu(matrix, 1).T
        if not self.rolls:
            matrix[1, :] = matrix[:, 1] = 0.0
            matrix[1, 1] = heel
        return m + surge, matrix.tolist(), np.linalg.inv(matrix).tolist(), m * z + surge * w

    @cached_property
    def _strips(self) -> tuple[tuple[float, float], ...]:
        """Return the place of each strip and its drag over w|w|, larger towards the ends."""
        count = 14
        out = []
        for i in range(count):
            x = (i + 0.5) / count - 0.5
            depth = self.draught * (1.0 if x < 0.15 else 1 - 0.5 * ((x - 0.15) / 0.35) ** 2)
            drag = self.cross_drag * (0.7 + 1.2 * abs(2 * x) ** 3)
            out.append((x * self.length, self.rho / 2 * drag * depth * self.length / count))
        return tuple(out)

    @cached_property
    def service_drag(self) -> float:
        """Return the resistance at service speed [N]."""
        return self.resistance * self.mass * GRAVITY

    @cached_property
    def _wash_directions(self) -> tuple[tuple[int, int, float], ...]:
        """Return which azimuth blows on which, and in what direction that one lies."""
        azimuths = [i for i, t in enumerate(self.units) if not t.tunnel]
        return tuple(
            (i, j, math.atan2(b.y - a.y, b.x - a.x))
            for i in azimuths
            for j in azimuths
            if i != j
            for a, b in [(self.units[i], self.units[j])]
        )

    @cached_property
    def actuators(self) -> tuple[Actuator, ...]:
        n = self.service_revolutions
        out = []
        for t in self.units:
            motor = (self.motor_rate * n, self.motor_lag)
            out.append(Actuator(f"n_{t.label}", (-n, n if t.tunnel else 1.2 * n), *motor))
            if not t.tunnel:
                turning = (self.azimuth_rate, self.azimuth_lag)
                out.append(Actuator(f"alpha_{t.label}", (-math.pi, math.pi), *turning, angle=True))
        return tuple(out)

    @property
    def follows_at_once(self) -> bool:
        return not self.mechanisms.actuator_dynamics

    def helm(self, ahead: float, turn: float, side: float = 0.0) -> tuple[float, ...]:
        n = self.service_revolutions
        out = []
        for t in self.units:
            if t.tunnel:
                out.append(n * max(-1.0, min(1.0, side)))
                continue
            pace = math.copysign(max(abs(ahead), 0.6 * abs(side)), ahead)
            # astern the force is turned round, and the push to the side with it
            out += [n * pace, turn * t.turn + side * t.side * math.copysign(1.0, ahead)]
        return tuple(out)

    def thruster_toml(self, thrust: str | None) -> list[str]:
        columns = {a.column: a for a in self.actuators}
        lines = []
        for t in self.units:
            motor = columns[f"n_{t.label}"]
            entries: dict[str, object] = {
                "type": "tunnel" if t.tunnel else "azimuth",
                "x": t.x,
                "y": t.y,
                "speed": motor.column,
                "speed_limits": motor.limits,
                "speed_rate": motor.rate,
            }
            if not t.tunnel:
                turning = columns[f"alpha_{t.label}"]
                entries |= {
                    "angle": turning.column,
                    "angle_limits": turning.limits,
                    "angle_rate": turning.rate,
                }
            lines += thruster_table(entries, thrust)
        return lines

    def thrusters(
        self, motion: Sequence[float], actuators: Sequence[float]
    ) -> tuple[float, float, float, float]:
        """Return the forces forward and to starboard [N] and the moments of roll and yaw [Nm]."""
        u, v, r = motion[0], motion[1], motion[-1]
        flags = self.mechanisms
        speed = self.service_speed
        bollard = self.service_drag / (1 - self.loss)
        at = 0
        settings: list[tuple[float, float]] = []
        for t in self.units:
            turns = actuators[at] / self.service_revolutions
            angle = math.pi / 2 if t.tunnel else actuators[at + 1]
            settings.append((turns, angle))
            at += 1 if t.tunnel else 2
        kept = [1.0] * len(settings)
        if flags.interaction:
            for i, j, direction in self._wash_directions:
                turns, angle = settings[i]
                astern = angle if turns < 0 else angle + math.pi
                off = math.remainder(astern - direction, 2 * math.pi) / self.wash_width
                if abs(off) < 4:
                    kept[j] -= self.wash * min(1.0, abs(turns)) * math.exp(-off * off)
        x = y = k = n = 0.0
        for i, (t, (turns, angle)) in enumerate(zip(self.units, settings, strict=True)):
            c, s = math.cos(angle), math.sin(angle)
            full = bollard * t.share * kept[i]
            pace = abs(turns) if flags.quadratic_thrust else 1.0
            weaker = self.reverse if turns < 0 and flags.quadratic_thrust and not t.tunnel else 1.0
            water, across = u - t.y * r, v + t.x * r
            force = weaker * turns * pace
            if t.tunnel:
                if flags.tunnel_loss:
                    w = u / (self.tunnel_speed * speed)
                    force *= 1 - self.tunnel_loss * (1 - math.exp(-w * w))
            elif flags.advance:
                force -= self.loss * pace * (water * c + across * s) / speed
            else:
                force *= 1 - self.loss
            if flags.interaction and not t.tunnel:
                forward = c if turns < 0 else -c  # how far the wash goes to the bow
                force *= 1 - self.under_hull * (1 + forward) / 2
            if flags.asymmetry and i == 0:
                force *= self.weaker
            ram = 0.0
            if flags.ram_drag:
                ram = -self.ram * abs(turns) * (across * c - water * s) / speed
            if t.tunnel:
                ram = 0.0
            fx, fy = full * (force * c - ram * s), full * (force * s + ram * c)
            x += fx
            y += fy
            k -= t.depth * fy
            n += t.x * fy - t.y * fx
        return x, y, k, n

    def hull(self, u: float, v: float, r: float) -> tuple[float, float, float]:
        """Return the hull's forces [N] and its moment of yaw [Nm], upright."""
        flags = self.mechanisms
        speed, length, m = self.service_speed, self.length, self.mass
        w = u / speed
        square = w * abs(w) if flags.quadratic_drag else w
        x = -self.service_drag * (self.linear_drag * w + (1 - self.linear_drag) * square)
        pace = speed
        if flags.lift:
            pace = self.standing_damping * speed + (1 - self.standing_damping) * abs(u)
        spin = m * (self.gyradius * length) ** 2
        y = m * pace * (-self.sway_damping * v / length + self.sway_by_yaw * r)
        n = pace * (m * self.yaw_by_sway * v - self.yaw_damping * spin * r / length)
        if flags.crossflow:
            for place, area in self._strips:
                w = v + place * r
                d = area * w * abs(w)
                y -= d
                n -= place * d
        if flags.asymmetry:
            side = self.heel_force * self.service_drag * u * abs(u) / speed**2
            y += side
            n += 0.1 * length * side
        return x, y, n

    def accelerations(
        self, motion: Sequence[float], actuators: Sequence[float], push: Sequence[float]
    ) -> tuple[float, ...]:
        flags = self.mechanisms
        u, v = motion[0], motion[1]
        phi, p, r = 0.0, 0.0, motion[2]
        if flags.roll:
            phi, p = motion[3], motion[4]
        x, y, n = self.hull(u, v, r)
        k = -self.z_A * y
        fx, fy, fk, fn = self.thrusters((u, v, r), actuators)
        x, y, k, n = x + fx + push[0], y + fy + push[1], k + fk, n + fn + push[2]
        surge, matrix, inverse, pitch = self.masses
        if flags.coriolis:
            a = matrix[0]
            across = a[0] * v + a[1] * p + a[2] * r
            x += across * r
            y -= surge * u * r
            k += pitch * u * r
            n += surge * u * v - across * u - pitch * u * p
        if not flags.roll:
            a, b = inverse[0], inverse[2]
            return x / surge, a[0] * y + a[2] * n, b[0] * y + b[2] * n
        stiffness = self.mass * GRAVITY * self.metacentric
        k -= stiffness * math.sin(phi)
        k -= 2 * self.roll_damping * math.sqrt(stiffness * matrix[1][1]) * p * (1 + 2 * abs(p))
        heel = self.heel_push * self.mass * u * abs(u) / self.length * phi
        y += heel
        n += self.heel_turn * self.length * heel
        rates = [a[0] * y + a[1] * k + a[2] * n for a in inverse]
        return x / surge, rates[0], rates[2], p, rates[1]


def research_vessel(**changes: object) -> AzimuthVessel:
    """Return a research vessel of 29 m: two azimuths aft and a tunnel in the bow."""
    entries: dict[str, object] = {
        "name": "Research vessel 29 m",
        "length": 29.0,
        "beam": 9.6,
        "draught": 2.7,
        "service_speed": 5.5,
        "service_revolutions": 360.0,
        "mass": 410e3,
        "x_G": -1.0,
        "x_A": 0.8,
        "z_G": -0.6,
        "z_A": 1.1,
        "metacentric": 1.1,
        "units": (
            Unit("port", -12.0, -2.7, 2.0, 0.5),
            Unit("starboard", -12.0, 2.7, 2.0, 0.5),
            Unit("bow", 10.5, 0.0, 1.6, 0.18, tunnel=True),
        ),
        "windage": Windage(78.0, 175.0, arm=1.8),
        "motor_lag": 2.0,
        "motor_rate": 0.12,
    }
    return AzimuthVessel(**(entries | changes))  # type: ignore[arg-type]


def workboat(**changes: object) -> AzimuthVessel:
    """Return a workboat of 12 m: two azimuths aft and a tunnel in the bow, lively in roll."""
    entries: dict[str, object] = {
        "name": "Workboat 12 m",
        "length": 12.0,
        "beam": 4.6,
        "draught": 1.2,
        "service_speed": 4.2,
        "service_revolutions": 700.0,
        "mass": 26e3,
        "x_G": -0.5,
        "x_A": 0.3,
        "z_G": -0.35,
        "z_A": 0.5,
        "metacentric": 0.9,
        "units": (
            Unit("port", -5.0, -1.3, 0.9, 0.5),
            Unit("starboard", -5.0, 1.3, 0.9, 0.5),
            Unit("bow", 4.3, 0.0, 0.7, 0.2, tunnel=True),
        ),
        "windage": Windage(12.0, 26.0, arm=0.5),
        "resistance": 0.05,
        "azimuth_rate": math.radians(20),
        "motor_lag": 0.8,
        "motor_rate": 0.4,
    }
    return AzimuthVessel(**(entries | changes))  # type: ignore[arg-type]


def ferry(**changes: object) -> AzimuthVessel:
    """Return a passenger ferry of 18 m with an azimuth at each corner."""
    side = math.radians(55)
    bow = partial(Unit, depth=1.1, share=0.25, turn=math.radians(20), side=side)
    stern = partial(Unit, depth=1.1, share=0.25, turn=-math.radians(30), side=side)
    entries: dict[str, object] = {
        "name": "Four-azimuth ferry 18 m",
        "length": 18.0,
        "beam": 6.5,
        "draught": 1.3,
        "service_speed": 3.2,
        "service_revolutions": 500.0,
        "mass": 72e3,
        "x_G": 0.3,
        "x_A": -0.2,
        "z_G": -0.7,
        "z_A": 0.55,
        "metacentric": 1.6,
        "units": (
            bow("1", 6.6, -2.1),
            bow("2", 6.6, 2.1),
            stern("3", -6.6, 2.1),
            stern("4", -6.6, -2.1),
        ),
        "windage": Windage(34.0, 78.0, arm=0.6),
        "sway_damping": 2.3,
        "yaw_damping": 3.0,
        "resistance": 0.035,
        "wash": 0.15,
        "azimuth_rate": math.radians(25),
        "motor_lag": 0.6,
        "motor_rate": 0.6,
    }
    return AzimuthVessel(**(entries | changes))  # type: ignore[arg-type]
