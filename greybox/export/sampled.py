"""A model as one step from sample to sample, with everything that it depends on named.

What the free run of a log does with whole signals stands here as states: where the
ship is, what the thrusters remember, and how many samples have passed.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from greybox.errors import StructureError, UsageError
from greybox.export.coefficients import coefficients, current, parameter_ports
from greybox.export.motion import Heading, Motion, Wind
from greybox.export.names import line
from greybox.export.ports import Port, channel_port, command_ports, distinct_ports
from greybox.model.disturbances import WIND
from greybox.model.model import ManoeuvringModel
from greybox.model.run.actuators import Memory, actuators, column, without_rate

# earlier commands that a step carries at most
_MOST = 1000
_WINDS = {
    "wind_north": "wind velocity towards north",
    "wind_east": "wind velocity towards east",
}


@dataclass(frozen=True)
class Switch:
    """A choice that is made when the model starts."""

    name: str
    meaning: str


@dataclass(frozen=True)
class SampledModel:
    """One step of a model as expressions.

    Parameters
    ----------
    sample_time : float
        [s]
    integrator : str
    states : tuple of Port
        Motion, then the memory of the thrusters and the count of samples.
    motion : int
        How many of the states are motion.
    inputs : tuple of Port
        Held over the step: commands, wind, heading.
    switches : tuple of Switch
        Choices that are left open, 0 or 1 each.
    parameters, outputs : tuple of Port
    x, u, s, p : SX
        Symbols of states, inputs, switches and parameters.
    x_next : SX
        States one sample later.
    rest : SX
        States at the start: motion as given, thrusters at rest on the commands.
    y : SX
        Outputs at the sample.
    rate : SX or None
        Change of the states [1/s] in continuous time.
    no_rate : str
        Why there is none.
    notes : tuple of str
        What a user of the ports must know.
    """

    sample_time: float
    integrator: str
    states: tuple[Port, ...]
    motion: int
    inputs: tuple[Port, ...]
    switches: tuple[Switch, ...]
    parameters: tuple[Port, ...]
    outputs: tuple[Port, ...]
    x: ca.SX
    u: ca.SX
    s: ca.SX
    p: ca.SX
    x_next: ca.SX
    rest: ca.SX
    y: ca.SX
    rate: ca.SX | None
    no_rate: str
    notes: tuple[str, ...]

    def baked(self, expression: ca.SX) -> ca.SX:
        """Return an expression with the parameters at their values."""
        values = ca.DM([p.value for p in self.parameters])
        return ca.densify(ca.substitute(ca.densify(expression), self.p, values))


def sampled_model(
    model: ManoeuvringModel, *, heading: Heading | None = None, wind: Wind = "earth"
) -> SampledModel:
    """Return one step of a model.

    Parameters
    ----------
    model : ManoeuvringModel
    heading : {"simulated", "measured", "either"}, optional
        Simulated where the structure has a yaw rate. ``either`` leaves it to a switch.
    wind : {"earth", "relative", "either"}
        Wind over ground in north and east, or velocity of the ship through the air
        in body axes; where the model has wind terms.

    Raises
    ------
    StructureError
        The structure is of no ship, has no yaw rate to simulate the heading with,
        or the model holds numbers that are not finite.
    UsageError
        The thrusters' delay needs more memory than a step can carry.
    """
    _require_ship(model)
    structure = model.structure
    turns = "r" in structure.states
    if heading == "simulated" and not turns:
        raise StructureError(
            f"structure '{structure.name}' has no yaw rate, so its heading cannot be simulated: "
            f"export it with the measured heading."
        )
    # an FMU has the heading among its outputs as well
    label = "psi_measured" if heading == "either" else "psi"
    if heading is None or not turns:
        heading = "simulated" if turns else "measured"
    commands = command_ports(model.vessel)
    outside, switches = _outside(model, heading, wind, label)
    inputs = [*commands, *outside]
    parameters = parameter_ports(model)
    u, s, p = (
        ca.SX.sym(n, len(of)) for n, of in (("u", inputs), ("s", switches), ("p", parameters))
    )
    _require_memory(model)
    late = actuators(model.vessel, u[: len(commands)], structure.inputs, model.sample_time)
    memory = [_memory_port(m, model, commands) for m in late.memory]
    ports = [channel_port(n) for n in structure.states]
    ports += [channel_port("psi")] if heading != "measured" else []
    if {"u", "v"} <= set(structure.states):
        ports += [channel_port("x_n"), channel_port("y_n")]
    count = [Port("sample", "1", "samples since the start")] if model.changes else []
    sample = ca.SX.sym("sample", len(count))
    motion = Motion(
        model,
        heading,
        wind,
        {port.name: ca.SX.sym(port.name) for port in ports},
        {port.name: u[len(commands) + i] for i, port in enumerate(outside)},
        {switch.name: s[i] for i, switch in enumerate(switches)},
        current(model, p),
        coefficients(model, p, sample),
    )
    place = column(motion.states.values())
    outputs, values = motion.outputs()
    rate, no_rate = None, ""
    if late.rate is None:
        no_rate = (
            f"the model {without_rate(model.vessel.actuation)}, which a rate of finitely many "
            f"states cannot"
        )
    else:
        clock = ca.SX.ones(len(count)) / model.sample_time
        rate = column([*motion.rate(late.rate_forces), late.rate, clock])
    return SampledModel(
        sample_time=model.sample_time,
        integrator=model.integrator,
        states=distinct_ports([*ports, *memory, *count]),
        motion=len(ports),
        inputs=distinct_ports(inputs),
        switches=tuple(switches),
        parameters=parameters,
        outputs=tuple(outputs),
        x=column([place, late.symbols, sample]),
        u=u,
        s=s,
        p=p,
        x_next=ca.densify(column([*motion.moved(late.forces), late.next_memory, sample + 1])),
        rest=ca.densify(column([place, late.rest, ca.SX.zeros(len(count))])),
        y=ca.densify(column(values)),
        rate=rate,
        no_rate=no_rate,
        notes=_notes(model, heading, wind),
    )


def _outside(
    model: ManoeuvringModel, heading: Heading, wind: Wind, label: str
) -> tuple[list[Port], list[Switch]]:
    """Return what acts on the ship beside its thrusters, and what is left open of it."""
    known = dict(zip(model.structure.disturbances, model.d, strict=True))
    ports: list[Port] = []
    switches: list[Switch] = []
    if model.structure.uses_air:
        if wind != "relative":
            ports += [Port(n, "m/s", _WINDS[n], float(known[n])) for n in WIND]
        if wind != "earth":
            ports += [channel_port("u_q"), channel_port("v_q")]
        if wind == "either":
            text = "true: u_q, v_q drive the wind terms; false: wind_north, wind_east do"
            switches.append(Switch("wind_measured", text))
    if heading != "simulated":
        ports.append(channel_port("psi", label=label))
    if heading == "either":
        text = "true: psi_measured is the heading; false: it is simulated"
        switches.append(Switch("heading_measured", text))
    return ports, switches


def _require_ship(model: ManoeuvringModel) -> None:
    structure = model.structure
    odd = set(structure.states) - {"u", "v", "r"}
    if not structure.marine or not structure.increment or odd:
        raise StructureError(
            f"structure '{structure.name}' is a map of {', '.join(structure.inputs)} and not the "
            f"motion of a ship with thrusters, so it has no ports to export: export a model of "
            f"thesis, linear, blanke, modulus, abkowitz or surge."
        )
    held: dict[str, NDArray[np.float64] | float] = {
        "theta": model.theta,
        "disturbances": model.d,
        "sample_time": model.sample_time,
    }
    for name, value in held.items():
        if not np.isfinite(value).all():
            raise StructureError(
                f"{name} of the model holds a number that is not finite, which no program could "
                f"run: estimate the model again."
            )


def _require_memory(model: ManoeuvringModel) -> None:
    delay, commands = model.vessel.actuation.delay, len(model.vessel.delayed_commands)
    whole, share = model.vessel.actuation.delay_samples(model.sample_time)
    length = whole + (share > 0)
    if length * commands > _MOST:
        raise UsageError(
            f"the delay of {delay:g} s is {length} samples of {model.sample_time:g} s of "
            f"{commands} commands, and a step carries at most {_MOST} of them: correct the "
            f"delay in the model, or delay the commands outside."
        )


def _memory_port(memory: Memory, model: ManoeuvringModel, commands: list[Port]) -> Port:
    late, unit = model.vessel.actuation, model.vessel.force_unit
    newtons = {"taun": "m N"}.get(memory.of, "N") if unit == "N" else None
    units = {port.name: port.unit for port in commands}
    own = "1" if memory.of in ("rudder", "rudder_drag") else units.get(memory.of, newtons)
    if memory.before:
        meaning = f"{memory.of} {memory.before} samples ago"
    elif memory.limited:
        meaning = f"{memory.of} as it moved by at most {late.rate_limit:g} per second"
    else:
        meaning = f"{memory.of} behind a lag of {late.lag:g} s"
    return Port(memory.name, own, meaning)


def _notes(model: ManoeuvringModel, heading: Heading, wind: Wind) -> tuple[str, ...]:
    sensors, notes = model.vessel.sensors, []
    turned = [c for c in model.vessel.commands if c in sensors.get("reversed", ())]
    if turned:
        notes.append(
            f"the vessel file turns the sign of the log's {', '.join(turned)}: give the turned sign"
        )
    late = {c: s for c, s in sensors.get("clock", {}).items() if c in model.vessel.commands}
    for name, seconds in late.items():
        notes.append(f"the log's {name} is {seconds:g} s late: give it as it acts")
    if heading != "simulated" and sensors.get("heading_bias"):
        notes.append(
            f"the compass shows {sensors['heading_bias']:g} rad more than the true heading: give "
            f"the true one"
        )
    if model.integrator == "rk4" and (heading != "simulated" or wind != "earth"):
        notes.append(
            "a measured heading or wind is held over the step; greybox simulate takes the mean "
            "of this sample and the next"
        )
    if model.vessel.actuation.between == "interpolated":
        notes.append(
            "a command is held over the step; greybox simulate moves those of a log on a straight "
            "line: give the mean of this sample and the next where they are measured"
        )
    if model.changes:
        notes.append(
            f"{'; '.join(c.sentence for c in model.changes)}: the time counts from the start of "
            f"the run. --settled exports the model as it is after the last change"
        )
    return tuple(line(n) for n in notes)
