"""The conditions of a blind trial, and its vessel."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass

from greybox.errors import UsageError, suggestion
from greybox.study.blind_inputs import KINDS
from greybox.vessel.toml import vessel_from_dict
from greybox.vessel.vessel import Vessel

_THRUSTER = """
[[thruster]]
type = "azimuth"
x = {x}
y = 0.0
speed = "{speed}"
angle = "{angle}"
speed_limits = [-20.0, 20.0]
angle_limits = [-3.1416, 3.1416]
"""
_SENSORS = """
[sensors]
u_std = 0.014142
v_std = 0.014142
r_std = 0.014142
heading_std = 0.01
position_std = 0.1
wind_std = 0.2
"""


@dataclass(frozen=True)
class Conditions:
    """Everything about a trial but what is wrong with it.

    Parameters
    ----------
    kind : {"manoeuvres", "pulses", "zigzag"}
        Of the inputs.
    colour : {"white", "memory"}
        Of the process noise; its memory is drawn from 10-30 s.
    gusts : bool
        Wind of zero mean that nobody measures: 3-5 m/s, 10-30 s.
    positions : bool
        Whether the log holds positions.
    anemometer : bool, optional
        Whether it holds the velocity through the air; by default where wind is wrong.
    single : bool
        Both propellers run at one speed, in one column ``n``.
    change_inside : bool
        The validation log too has the change of a parameter inside.
    linear : bool
        Commands go linearly from one second to the next, instead of being held.
    euler : bool
        Steps of a second as (3.51) instead of Runge-Kutta.
    noise, process : float
        Factors on the noises of the sensors and on the process noise.
    samples : int
        Of each log, one a second.
    """

    kind: str = "manoeuvres"
    colour: str = "white"
    gusts: bool = False
    positions: bool = True
    anemometer: bool | None = None
    single: bool = False
    change_inside: bool = False
    linear: bool = False
    euler: bool = False
    noise: float = 1.0
    process: float = 1.0
    samples: int = 1200

    def __post_init__(self) -> None:
        for what, value, known in (
            ("kind of inputs", self.kind, tuple(KINDS)),
            ("colour", self.colour, ("white", "memory")),
        ):
            if value not in known:
                raise UsageError(
                    f"there is no {what} '{value}'.{suggestion(value, known)} "
                    f"Known: {', '.join(known)}."
                )


def vessel_text(single: bool = False) -> str:
    """Return the vessel file of the blind trials: thrusters at x = ±9, linear law."""
    speeds = ("n", "n") if single else ("n1", "n2")
    head = 'name = "Blind ship"\nlength = 30.0\n'
    thrusters = [
        _THRUSTER.format(x=x, speed=speed, angle=angle)
        for x, speed, angle in ((9.0, speeds[0], "alpha1"), (-9.0, speeds[1], "alpha2"))
    ]
    return "".join([head, *thrusters, _SENSORS])


def blind_vessel(single: bool = False) -> Vessel:
    """Return the vessel of the blind trials, with speed columns n1, n2 or one column n."""
    return vessel_from_dict(tomllib.loads(vessel_text(single)))
