"""A model as one step from sample to sample, with everything that it depends on named.

What the free run of a log does with whole signals stands here as states: where the
ship is, what the thrusters remember, and how many samples have passed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import Literal

import casadi as ca
import numpy as np

from greybox.errors import StructureError
from greybox.export.actuators import Actuators, actuators, column
from greybox.export.names import distinct, line
from greybox.export.ports import Port, channel_port, command_ports
from greybox.model.disturbances import CURRENT, WIND, rotate_to_body
from greybox.model.functions import step_function
from greybox.model.model import ManoeuvringModel

Heading = Literal["simulated", "measured", "either"]
Wind = Literal["earth", "relative", "either"]
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
    after : SX
        States one sample later.
    rest : SX
        States at the start: motion as given, thrusters at rest on the commands.
    seen : SX
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
    after: ca.SX
    rest: ca.SX
    seen: ca.SX
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
    """
    _require_ship(model)
    structure = model.structure
    turns = "r" in structure.states
    if heading == "simulated" and not turns:
        raise StructureError(
            f"structure '{structure.name}' has no yaw rate, so its heading cannot be simulated: "
            f"export it with the measured heading."
        )
    if heading is None or not turns:
        heading = "simulated" if turns else "measured"
    way = {"u", "v"} <= set(structure.states)
    values = dict(zip(structure.disturbances, model.d, strict=True))

    motion = [channel_port(n) if n in "uvr" else Port(n, None, n) for n in structure.states]
    motion += [channel_port("psi")] if heading != "measured" else []
    motion += [channel_port("x_n"), channel_port("y_n")] if way else []
    commands = command_ports(model.vessel)
    inputs, switches = list(commands), []
    if structure.uses_air:
        if wind != "relative":
            inputs += [Port(n, "m/s", _WINDS[n], float(values[n])) for n in WIND]
        if wind != "earth":
            inputs += [channel_port("u_q"), channel_port("v_q")]
        if wind == "either":
            text = "true: u_q, v_q drive the wind terms; false: wind_north, wind_east do"
            switches.append(Switch("wind_measured", text))
    if heading == "measured":
        inputs.append(channel_port("psi"))
    elif heading == "either":
        inputs.append(channel_port("psi", label="psi_measured"))
        text = "true: psi_measured is the heading; false: it is simulated"
        switches.append(Switch("heading_measured", text))
    parameters = _parameters(model, {n: float(values[n]) for n in CURRENT})
    u, s, p = (ca.SX.sym(n, len(of)) for n, of in (("u", inputs), ("s", switches), ("p", parameters)))
    moving = actuators(
        model.vessel, u[: len(commands)], commands, structure.inputs, model.sample_time
    )
    count = [Port("sample", "1", "samples since the start")] if model.changes else []
    ports = distinct_ports([*motion, *moving.memory, *count])
    symbols = _Symbols(
        {m.name: ca.SX.sym(m.name) for m in motion},
        {port.name: u[i] for i, port in enumerate(inputs)},
        {switch.name: s[i] for i, switch in enumerate(switches)},
        ca.vertsplit(p)[len(model.names) :][: len(CURRENT)],
        ca.SX.sym("sample"),
    )
    x = column([*symbols.motion.values(), moving.symbols, *[symbols.sample] * len(count)])
    theta = _theta(model, p, symbols.sample)
    step = _motion_after(model, symbols, moving, theta, heading, wind)
    after = column([*step, moving.after, *[symbols.sample + 1] * len(count)])
    rest = column([*symbols.motion.values(), moving.rest, *[ca.SX(0)] * len(count)])
    outputs, seen = _outputs(symbols, motion, heading, way)
    rate, no_rate = None, ""
    if moving.rate is None:
        no_rate = (
            f"the model delays its commands by {model.vessel.actuation.delay:g} s, which a rate "
            f"of finitely many states cannot"
        )
    else:
        change = _motion_rate(model, symbols, moving, theta, heading, wind)
        clock = [ca.SX(1 / model.sample_time)] * len(count)
        rate = column([*change, moving.rate, *clock])
    return SampledModel(
        model.sample_time, model.integrator, ports, len(motion), distinct_ports(inputs),
        tuple(switches), tuple(parameters), tuple(outputs), x, u, s, p, ca.densify(after),
        ca.densify(rest), ca.densify(column(seen)), rate, no_rate, _notes(model, heading, wind),
    )  # fmt: skip


def distinct_ports(ports: list[Port]) -> tuple[Port, ...]:
    """Return ports with names that are all different."""
    names = distinct(p.name for p in ports)
    return tuple(
        Port(n, p.unit, p.meaning, p.value) for n, p in zip(names, ports, strict=True)
    )


@dataclass(frozen=True)
class _Symbols:
    motion: dict[str, ca.SX]
    inputs: dict[str, ca.SX]
    switches: dict[str, ca.SX]
    current: list[ca.SX]
    sample: ca.SX


def _require_ship(model: ManoeuvringModel) -> None:
    structure = model.structure
    if structure.disturbance != "marine" or not structure.increment:
        raise StructureError(
            f"structure '{structure.name}' is a map of {', '.join(structure.inputs)} and not the "
            f"motion of a ship with thrusters, so it has no ports to export: export a model of "
            f"thesis, linear, blanke, modulus, abkowitz or surge."
        )
    held = {"theta": model.theta, "disturbances": model.d, "sample_time": model.sample_time}
    for name, value in held.items():
        if not np.isfinite(value).all():
            raise StructureError(
                f"{name} of the model holds a number that is not finite, which no program could "
                f"run: estimate the model again."
            )


def _parameters(model: ManoeuvringModel, current: dict[str, float]) -> list[Port]:
    ts = model.sample_time
    ports = [
        Port(name, unit, f"coefficient of {term}, per sample of {ts:g} s", float(value))
        for name, term, unit, value in zip(
            model.names, model.structure.terms, model.units, model.theta, strict=True
        )
    ]
    for name, value in current.items():
        towards = name.removeprefix("current_")
        ports.append(Port(name, "m/s", f"current velocity towards {towards}", value))
    for c in model.changes:
        ports.append(Port(f"{c.parameter}_factor", "1", f"factor on {c.parameter}", c.factor))
        ports.append(
            Port(f"{c.parameter}_time", "s", f"when the factor begins, from the start", c.time)
        )
    return list(distinct_ports(ports))


def _theta(model: ManoeuvringModel, p: ca.SX, sample: ca.SX) -> ca.SX:
    """Return the coefficients as they are at a sample."""
    theta = ca.vertsplit(p[: len(model.names)]) if model.names else []
    factors = [ca.SX(1)] * len(theta)
    place = {id(c): len(theta) + len(CURRENT) + 2 * k for k, c in enumerate(model.changes)}
    for change in sorted(model.changes, key=lambda c: c.time):
        k = place[id(change)]
        i = model.names.index(change.parameter)
        # as `simulate_changing`: a whole number of samples may be a rounding error more
        begun = sample >= p[k + 1] / model.sample_time - 1e-6
        factors[i] = ca.if_else(begun, p[k], factors[i])
    return column(t * f for t, f in zip(theta, factors, strict=True))


def _chosen(
    symbols: _Symbols, heading: Heading, wind: Wind, of: Callable[[bool, bool], list[ca.SX]]
) -> list[ca.SX]:
    """Return expressions under whichever heading and wind are chosen, by switches where open."""
    headings = {"simulated": [False], "measured": [True], "either": [False, True]}[heading]
    winds = {"earth": [False], "relative": [True], "either": [False, True]}[wind]
    found = {(h, w): of(h, w) for h, w in product(headings, winds)}

    def choose(name: str, a: list[ca.SX], b: list[ca.SX]) -> list[ca.SX]:
        if name not in symbols.switches:
            return a
        on = symbols.switches[name] > 0.5
        return [ca.if_else(on, y, x) for x, y in zip(a, b, strict=True)]

    by_heading = [
        choose("wind_measured", found[h, winds[0]], found[h, winds[-1]]) for h in headings
    ]
    return choose("heading_measured", by_heading[0], by_heading[-1])


def _drivers(
    symbols: _Symbols, measured: bool, relative: bool
) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Return heading, disturbance means and velocity through the air."""
    given = symbols.inputs
    psi = given.get("psi_measured", given.get("psi")) if measured else symbols.motion["psi"]
    none = ca.SX(0)
    wind = [given.get(n, none) if not relative else none for n in WIND]
    air = [given.get(n, none) if relative else none for n in ("u_q", "v_q")]
    return psi, ca.vertcat(*symbols.current, *wind), ca.vertcat(*air)


def _motion_after(
    model: ManoeuvringModel,
    symbols: _Symbols,
    moving: Actuators,
    theta: ca.SX,
    heading: Heading,
    wind: Wind,
) -> list[ca.SX]:
    structure, ts = model.structure, model.sample_time
    nx = len(structure.states)
    x = column(list(symbols.motion.values())[:nx])
    tau = column(moving.forces[n] for n in structure.inputs)

    def after(measured: bool, relative: bool) -> list[ca.SX]:
        psi, d, air = _drivers(symbols, measured, relative)
        step = step_function(
            structure,
            air_measured=relative and structure.uses_air,
            integrator=model.integrator,
            heading="measured" if measured else "simulated",
        )
        out = step.call([x, psi, tau, d, air, theta, ca.SX(ts)])
        found = ca.vertsplit(out[0])
        if "psi" in symbols.motion:
            found.append(psi if measured else out[1])
        if "x_n" in symbols.motion:
            north, east = _over_ground(symbols, psi)
            found += [symbols.motion["x_n"] + ts * north, symbols.motion["y_n"] + ts * east]
        return found

    return _chosen(symbols, heading, wind, after)


def _motion_rate(
    model: ManoeuvringModel,
    symbols: _Symbols,
    moving: Actuators,
    theta: ca.SX,
    heading: Heading,
    wind: Wind,
) -> list[ca.SX]:
    structure, ts = model.structure, model.sample_time
    nx = len(structure.states)
    x = column(list(symbols.motion.values())[:nx])
    tau = column(moving.rate_forces[n] for n in structure.inputs)

    def rate(measured: bool, relative: bool) -> list[ca.SX]:
        psi, d, air = _drivers(symbols, measured, relative)
        step = step_function(structure, air_measured=relative and structure.uses_air)
        # parameters hold the sample time
        after = step.call([x, psi, tau, d, air, theta, ca.SX(ts)])[0]
        found = ca.vertsplit((after - x) / ts)
        if "psi" in symbols.motion:
            found.append(ca.SX(0) if measured else symbols.motion["r"])
        if "x_n" in symbols.motion:
            found += _over_ground(symbols, psi)
        return found

    return _chosen(symbols, heading, wind, rate)


def _over_ground(symbols: _Symbols, psi: ca.SX) -> tuple[ca.SX, ca.SX]:
    c, s = ca.cos(psi), ca.sin(psi)
    u, v = symbols.motion["u"], symbols.motion["v"]
    return c * u - s * v, s * u + c * v


def _outputs(
    symbols: _Symbols, motion: list[Port], heading: Heading, way: bool
) -> tuple[list[Port], list[ca.SX]]:
    """Return motion, and velocities over ground and through the water."""
    given = symbols.inputs
    psi = symbols.motion.get("psi")
    if heading == "measured":
        psi = given["psi"]
    elif heading == "either":
        psi = ca.if_else(symbols.switches["heading_measured"] > 0.5, given["psi_measured"], psi)
    ports = [m for m in motion if m.name != "psi"]
    seen = [symbols.motion[m.name] for m in ports]
    after = sum(m.name in "uvr" for m in ports)
    ports.insert(after, channel_port("psi"))
    seen.insert(after, psi)
    if way:
        north, east = _over_ground(symbols, psi)
        ports += [channel_port("v_n"), channel_port("v_e")]
        seen += [north, east]
    along, across = rotate_to_body(psi, *symbols.current)
    for name, flow, words in (("u", along, "forward"), ("v", across, "to starboard")):
        if name in symbols.motion:
            ports.append(Port(f"{name}_r", "m/s", f"velocity through the water, {words}"))
            seen.append(symbols.motion[name] - flow)
    return ports, seen


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
    if model.changes:
        notes.append(
            f"{'; '.join(c.sentence for c in model.changes)}: the time counts from the start of "
            f"the run. --settled exports the model as it is after the last change"
        )
    return tuple(line(n) for n in notes)
