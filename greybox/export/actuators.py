"""Thrusters that act late, one sample at a time: what must be remembered, and how it moves on.

The same delay and lag as `greybox.vessel.actuation` makes of whole logs, with the
commands and lagged values of earlier samples as states.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import ceil, exp, floor

import casadi as ca

from greybox.errors import UsageError
from greybox.export.ports import Port
from greybox.vessel.force import force_expressions
from greybox.vessel.vessel import Vessel

_MOST = 1000


@dataclass(frozen=True)
class Actuators:
    """States of the actuators and what they give.

    Parameters
    ----------
    memory : tuple of Port
    symbols : SX
        (m,) the memory.
    forces : mapping of str to SX
        Generalised inputs that act during the sample.
    after, rest : SX
        (m,) the memory one sample later, and at rest on the commands.
    rate : SX or None
        (m,) change of the memory [1/s]; None where there is a pure delay.
    rate_forces : mapping of str to SX
        Generalised inputs at an instant.
    """

    memory: tuple[Port, ...]
    symbols: ca.SX
    forces: Mapping[str, ca.SX]
    after: ca.SX
    rest: ca.SX
    rate: ca.SX | None
    rate_forces: Mapping[str, ca.SX]


def actuators(
    vessel: Vessel, commands: ca.SX, ports: list[Port], inputs: tuple[str, ...], sample_time: float
) -> Actuators:
    """Return how the generalised inputs follow the commands.

    Parameters
    ----------
    vessel : Vessel
    commands : SX
        (nc,) of one sample, in the order of `Vessel.commands`.
    ports : list of Port
        Of the commands.
    inputs : tuple of str
        Generalised inputs that the structure uses; zero where no thruster makes them.
    sample_time : float
        [s]

    Raises
    ------
    UsageError
        The delay needs more memory than a step can carry.
    """
    late = vessel.actuation
    samples = late.delay / sample_time
    length = ceil(samples)
    if length * len(ports) > _MOST:
        raise UsageError(
            f"the delay of {late.delay:g} s is {length} samples of {sample_time:g} s of "
            f"{len(ports)} commands, and a step carries at most {_MOST} of them: correct the "
            f"delay in the model, or delay the commands outside."
        )
    memory: list[Port] = []
    before: list[ca.SX] = []
    after: list[ca.SX] = []
    rest: list[ca.SX] = []
    moved = []
    share = samples - floor(samples)
    for i, port in enumerate(ports):
        past = [commands[i]]
        for j in range(1, length + 1):
            name = f"{port.name}_before_{j}"
            memory.append(Port(name, port.unit, f"{port.name} {j} samples ago"))
            symbol = ca.SX.sym("before")
            before.append(symbol)
            after.append(past[-1])
            rest.append(commands[i])
            past.append(symbol)
        n = floor(samples)
        moved.append(share * past[n + 1] + (1 - share) * past[n] if share else past[n])
    slow = column(moved)
    rate: list[ca.SX] = []

    def follow(value: ca.SX, at_rest: ca.SX, name: str, unit: str | None) -> tuple[ca.SX, ca.SX]:
        a = exp(-sample_time / late.lag)
        symbol = ca.SX.sym("lagged")
        memory.append(Port(f"{name}_lagged", unit, f"{name} behind a lag of {late.lag:g} s"))
        before.append(symbol)
        after.append(a * symbol + (1 - a) * value)
        rest.append(at_rest)
        rate.append((value - symbol) / late.lag)
        held = {
            "start": symbol,
            "mean": value + (symbol - value) * (1 - a) * late.lag / sample_time,
            "end": value + (symbol - value) * a,
        }
        return held[late.lag_held], symbol

    zero = {name: ca.SX(0) for name in inputs}

    def forces(of: ca.SX) -> dict[str, ca.SX]:
        made = force_expressions(vessel, of)
        return zero | {n: made[n] for n in inputs if n in made}

    acting = instant = slow
    if late.lag and late.lag_on != "force":
        speeds = {t.speed for t in vessel.thrusters}
        pairs = [
            follow(slow[i], commands[i], p.name, p.unit)
            if late.lag_on == "command" or p.name in speeds
            else (slow[i], slow[i])
            for i, p in enumerate(ports)
        ]
        acting, instant = (column(pair[k] for pair in pairs) for k in (0, 1))
    made, at_instant = forces(acting), forces(instant)
    if late.lag and late.lag_on == "force":
        at_rest = forces(commands)
        unit = vessel.force_unit
        for name, value in list(made.items()):
            if not value.is_constant():
                newtons = {"taun": "m N"}.get(name, "N") if unit == "N" else None
                of = "1" if name in ("rudder", "rudder_drag") else newtons
                made[name], at_instant[name] = follow(value, at_rest[name], name, of)
    return Actuators(
        tuple(memory), column(before), made, column(after), column(rest),
        None if length else column(rate), at_instant,
    )  # fmt: skip


def column(parts: Iterable[ca.SX]) -> ca.SX:
    """Return expressions below one another, (0, 1) where there are none."""
    return ca.vertcat(ca.SX(0, 1), *parts)
