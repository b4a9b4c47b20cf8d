"""What goes in and out of an exported model: names, units, meanings."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

from greybox.channels import CHANNELS
from greybox.export.names import distinct
from greybox.units import unit_dimension
from greybox.vessel.vessel import Vessel

# SI base units of what units are spelled with
_BASE: dict[str, dict[str, float]] = {
    "1": {},
    "m": {"m": 1},
    "s": {"s": 1},
    "rad": {"rad": 1},
    "N": {"kg": 1, "m": 1, "s": -2},
    "rpm": {"rad": 1, "s": -1},
    "rps": {"rad": 1, "s": -1},
}
FACTORS = {"rpm": 0.10471975511965977, "rps": 6.283185307179586}


@dataclass(frozen=True)
class Port:
    """One number that goes in or out.

    Parameters
    ----------
    name : str
        Channel, column or parameter.
    unit : str or None
        None where it is that of the log, whatever it is.
    meaning : str
    value : float
        Where it starts.
    """

    name: str
    unit: str | None
    meaning: str
    value: float = 0.0

    @property
    def shown_unit(self) -> str:
        """The unit, or that it is the log's own."""
        return "unit of the log" if self.unit is None else self.unit


def channel_port(name: str, label: str | None = None) -> Port:
    """Return the port of a canonical channel, under another name where one is given."""
    channel = CHANNELS[name]
    return Port(label or name, channel.unit, channel.meaning)


def command_ports(vessel: Vessel) -> list[Port]:
    """Return the thruster columns with the units that they have in a log that was read."""
    said = {c.name: c.unit for c in vessel.columns.values()}
    turned = vessel.sensors.get("reversed", ())
    late = vessel.sensors.get("clock", {})
    ports = []
    for name in vessel.commands:
        angle = name in vessel.angle_commands
        written = said.get(name)
        unit = "rad" if angle else None if written is None else unit_dimension(written)
        limits = vessel.limits[name]
        parts = ["thruster angle" if angle else "propeller speed"]
        if limits.lower is not None and limits.upper is not None:
            parts.append(f"the vessel file allows {limits.lower:g} to {limits.upper:g}, not kept")
        if name in turned:
            parts.append("its sign is turned against the log's column")
        if name in late:
            parts.append(f"without the {late[name]:g} s by which the log's column is late")
        ports.append(Port(name, unit, "; ".join(parts)))
    return ports


def distinct_ports(ports: Sequence[Port]) -> tuple[Port, ...]:
    """Return ports with names that are all different."""
    names = distinct(p.name for p in ports)
    return tuple(replace(p, name=n) for n, p in zip(names, ports, strict=True))


def base_units(unit: str) -> dict[str, int] | None:
    """Return the exponents of SI base units in a unit such as ``1/(m s N)``.

    None where some part is no SI unit, such as the unknown one of a propeller speed.
    """
    up, _, down = unit.partition("/")
    total: dict[str, float] = {}
    for text, sign in ((up, 1), (down.strip("()"), -1)):
        for part in text.split():
            match = re.fullmatch(r"([^^]+?)(?:\^(\d+))?", part)
            if match is None or match[1] not in _BASE:
                return None
            for name, power in _BASE[match[1]].items():
                total[name] = total.get(name, 0) + sign * int(match[2] or 1) * power
    return {name: int(power) for name, power in total.items() if power}
