"""Where the ship is a sample later, under a heading and wind that are chosen or left open."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import product
from typing import Literal

import casadi as ca

from greybox.export.ports import Port, channel_port
from greybox.model.disturbances import WIND
from greybox.model.model import ManoeuvringModel
from greybox.model.run.actuators import column
from greybox.model.run.step import StepModel, next_position
from greybox.rotation import body_to_ned, ned_to_body

Heading = Literal["simulated", "measured", "either"]
Wind = Literal["earth", "relative", "either"]


@dataclass(frozen=True)
class Motion:
    """Symbols of the motion and of what drives it.

    Parameters
    ----------
    model : ManoeuvringModel
    heading : {"simulated", "measured", "either"}
    wind : {"earth", "relative", "either"}
    states, inputs, switches : mapping of str to SX
        By name.
    current : list of SX
        North and east [m/s].
    theta : SX
        (p,) coefficients at this sample.
    """

    model: ManoeuvringModel
    heading: Heading
    wind: Wind
    states: Mapping[str, ca.SX]
    inputs: Mapping[str, ca.SX]
    switches: Mapping[str, ca.SX]
    current: list[ca.SX]
    theta: ca.SX

    @property
    def psi(self) -> ca.SX:
        """The heading that acts."""
        if self.heading == "either":
            on = self.switches["heading_measured"] > 0.5
            return ca.if_else(on, self._psi(True), self._psi(False))
        return self._psi(self.heading == "measured")

    def moved(self, forces: Mapping[str, ca.SX]) -> list[ca.SX]:
        """Return the states one sample later, under generalised inputs that are held.

        Positions follow as in `greybox.model.run.simulation.positions`, by Euler.
        """
        ts = self.model.sample_time

        def of(measured: bool, relative: bool) -> list[ca.SX]:
            psi = self._psi(measured)
            step = self._step(forces, measured, relative, self.model.integrator)
            found = ca.vertsplit(step)
            if "psi" in self.states and measured:
                found.append(psi)
            if "x_n" in self.states:
                place = ca.vertcat(self.states["x_n"], self.states["y_n"])
                u, v = self.states["u"], self.states["v"]
                found += ca.vertsplit(next_position(place, u, v, psi, ts))
            return found

        return self._chosen(of)

    def rate(self, forces: Mapping[str, ca.SX]) -> list[ca.SX]:
        """Return the change of the states [1/s] under generalised inputs."""
        ts = self.model.sample_time

        def of(measured: bool, relative: bool) -> list[ca.SX]:
            # an Euler step is the rate times the sample time that the parameters hold
            step = self._step(forces, measured, relative, "euler")
            found = ca.vertsplit((step[: self._x.numel()] - self._x) / ts)
            if "psi" in self.states:
                found.append(ca.SX(0) if measured else self.states["r"])
            if "x_n" in self.states:
                found += self.over_ground(self._psi(measured))
            return found

        return self._chosen(of)

    def over_ground(self, psi: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Return the velocity over ground, north and east."""
        return body_to_ned(self.states["u"], self.states["v"], psi)

    def outputs(self) -> tuple[list[Port], list[ca.SX]]:
        """Return motion, and velocities over ground and through the water."""
        psi = self.psi
        body = [n for n in self.states if n not in ("psi", "x_n", "y_n")]
        ports = [channel_port(n) for n in body]
        values = [self.states[n] for n in body]
        ports.append(channel_port("psi"))
        values.append(psi)
        if "x_n" in self.states:
            north, east = self.over_ground(psi)
            ports += [channel_port(n) for n in ("x_n", "y_n", "v_n", "v_e")]
            values += [self.states["x_n"], self.states["y_n"], north, east]
        along, across = ned_to_body(self.current[0], self.current[1], psi)
        for name, flow, words in (("u", along, "forward"), ("v", across, "to starboard")):
            if name in self.states:
                ports.append(Port(f"{name}_r", "m/s", f"velocity through the water, {words}"))
                values.append(self.states[name] - flow)
        return ports, values

    @property
    def _x(self) -> ca.SX:
        return column(self.states[n] for n in self.model.structure.states)

    def _psi(self, measured: bool) -> ca.SX:
        if not measured:
            return self.states["psi"]
        return self.inputs["psi_measured" if "psi_measured" in self.inputs else "psi"]

    def _step(
        self,
        forces: Mapping[str, ca.SX],
        measured: bool,
        relative: bool,
        integrator: Literal["euler", "rk4"],
    ) -> ca.SX:
        structure, none = self.model.structure, ca.SX(0)
        wind = [none if relative else self.inputs.get(n, none) for n in WIND]
        air = [self.inputs.get(n, none) if relative else none for n in ("u_q", "v_q")]
        step = StepModel(
            structure,
            integrator,
            "measured" if measured else "simulated",
            relative and structure.uses_air,
        )
        tau = column(forces[n] for n in structure.inputs)
        d = ca.vertcat(*self.current, *wind)
        ts = self.model.sample_time
        return step(self._x, self._psi(measured), tau, d, column(air), self.theta, ts)

    def _chosen(self, of: Callable[[bool, bool], list[ca.SX]]) -> list[ca.SX]:
        """Return expressions under the heading and wind that are chosen, by switches where open."""
        either = [False, True]
        headings = either if self.heading == "either" else [self.heading == "measured"]
        winds = either if self.wind == "either" else [self.wind == "relative"]
        found = {(h, w): of(h, w) for h, w in product(headings, winds)}

        def choose(name: str, a: list[ca.SX], b: list[ca.SX]) -> list[ca.SX]:
            if name not in self.switches:
                return a
            on = self.switches[name] > 0.5
            return [ca.if_else(on, y, x) for x, y in zip(a, b, strict=True)]

        by_heading = [
            choose("wind_measured", found[h, winds[0]], found[h, winds[-1]]) for h in headings
        ]
        return choose("heading_measured", by_heading[0], by_heading[-1])
