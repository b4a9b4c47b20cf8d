"""What every foreign ship offers: particulars, actuators, and accelerations from forces."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Self

from foreign_ships.environment import Windage


@dataclass(frozen=True)
class Noise:
    """Standard deviations of white sensor noise.

    Attributes
    ----------
    position : float
        Of each component [m], at the body origin.
    heading, u, v, r : float
        [rad], [m/s], [m/s], [rad/s].
    wind : float
        Of each component of the apparent wind [m/s].
    speed, angle : float
        Of the feedback of propeller speeds [as logged] and of rudders and azimuths [rad].
    """

    position: float = 0.02
    heading: float = 0.002
    u: float = 0.01
    v: float = 0.01
    r: float = 0.001
    wind: float = 0.3
    speed: float = 0.0
    angle: float = 0.0


@dataclass(frozen=True)
class Faults:
    """What is wrong with the instruments, not with the ship.

    Attributes
    ----------
    heading_bias : float
        Measured minus true [rad].
    antenna : tuple of float
        Where the positions are measured, though the vessel file has the origin [m].
    late : dict of str to float
        Channels (x_n, y_n, psi, u, v, r, u_q, v_q, actuators' columns) that come late [s].
    offset : dict of str to float
        What is added to a channel, in its unit; an azimuth's zero for instance.
    """

    heading_bias: float = 0.0
    antenna: tuple[float, float] = (0.0, 0.0)
    late: dict[str, float] = field(default_factory=dict)
    offset: dict[str, float] = field(default_factory=dict)


SILENT = Noise(0, 0, 0, 0, 0, 0, 0, 0)


@dataclass(frozen=True)
class Actuator:
    """One command of a ship: a propeller's speed or the angle of a rudder or azimuth.

    `lag` is a first-order time constant [s] and `rate` the fastest change per second; an
    `angle` is in rad.
    """

    column: str
    limits: tuple[float, float]
    rate: float
    lag: float
    angle: bool = False


class Ship(ABC):
    """A ship as the simulator sees it: motion relative to the water, forces from outside added.

    Body axes: x forward, y to starboard, z down; psi clockwise from north, r positive to
    starboard. Everything about the body origin.
    """

    name: str
    length: float  # m
    beam: float  # m
    service_speed: float  # m/s at full ahead
    noise: Noise
    windage: Windage
    mechanisms: Any  # flags of the simulator, all on; see its `Mechanisms`
    rolls = False

    def only(self, *mechanisms: str) -> Self:
        """Return the ship with these mechanisms alone; with none of them it is linear."""
        names = {f.name for f in fields(self.mechanisms)}
        if not names >= set(mechanisms):
            raise ValueError(f"{self.name} has no {set(mechanisms) - names}, only {names}")
        flags = type(self.mechanisms)(**{n: n in mechanisms for n in names})
        return replace(self, mechanisms=flags)  # type: ignore[type-var]

    def without(self, *mechanisms: str) -> Self:
        """Return the ship with these mechanisms switched off."""
        flags = replace(self.mechanisms, **dict.fromkeys(mechanisms, False))
        return replace(self, mechanisms=flags)  # type: ignore[type-var]

    @property
    @abstractmethod
    def actuators(self) -> tuple[Actuator, ...]:
        """Return the commands in their order; with rates and lags switched off they act at once."""

    @property
    @abstractmethod
    def follows_at_once(self) -> bool:
        """Return whether actuators take their commands without lag and rate limit."""

    @property
    @abstractmethod
    def inertia(self) -> tuple[float, float, float]:
        """Return the mass [kg], the x of its centre [m] and the yaw inertia about the origin."""

    @abstractmethod
    def accelerations(
        self, motion: Sequence[float], actuators: Sequence[float], push: Sequence[float]
    ) -> tuple[float, ...]:
        """Return the rates of `motion`.

        Parameters
        ----------
        motion : sequence of float
            u, v [m/s] through the water and r [rad/s]; with roll also its angle [rad] and rate.
        actuators : sequence of float
            Propeller speeds and angles as they are now, in the order of `actuators`.
        push : sequence of float
            Force forward and to starboard [N] and moment to starboard [Nm] from outside.
        """

    @abstractmethod
    def helm(self, ahead: float, turn: float, side: float = 0.0) -> tuple[float, ...]:
        """Return the commands for full ahead (1) to astern (-1), turn and push to starboard."""

    @abstractmethod
    def thruster_toml(self, thrust: str | None) -> list[str]:
        """Return the ``[[thruster]]`` tables as a crew would write them."""

    @property
    def time_scale(self) -> float:
        """Return the time in which the ship sails its own length at service speed [s]."""
        return self.length / self.service_speed

    def vessel_toml(self, thrust: str | None = None, noise: Noise | None = None) -> str:
        """Return the vessel file: what a crew knows, the thrust law only where given."""
        n = self.noise if noise is None else noise
        head = [f'name = "{self.name}"', f"length = {self.length:g}", ""]
        stds = {
            "position_std": n.position,
            "heading_std": n.heading,
            "u_std": n.u,
            "v_std": n.v,
            "r_std": n.r,
            "wind_std": n.wind,
        }
        tail = ["[sensors]", *(f"{k} = {v:g}" for k, v in stds.items() if v > 0)]
        return "\n".join([*head, *self.thruster_toml(thrust), *tail, ""])


def thruster_table(entries: dict[str, object], thrust: str | None) -> list[str]:
    """Return one ``[[thruster]]`` table; tuples become arrays, text is quoted."""
    if thrust is not None:
        entries = {**entries, "thrust": thrust}
    lines = ["[[thruster]]"]
    for key, value in entries.items():
        if isinstance(value, str):
            text = f'"{value}"'
        elif isinstance(value, tuple):
            text = "[" + ", ".join(f"{x:g}" for x in value) + "]"
        else:
            text = f"{value:.6g}"
        lines.append(f"{key} = {text}")
    return [*lines, ""]
