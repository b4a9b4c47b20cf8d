"""Many draws of one ship, stepped together by thruster commands that may follow their motion."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from greybox.model.disturbances import CURRENT, WIND, disturbance_names
from greybox.model.run.actuators import Actuators, actuators, column
from greybox.model.run.kernels import bind, over_runs
from greybox.model.run.step import Integrator, StepModel
from greybox.model.structure import Structure
from greybox.vessel.vessel import Actuation, Thruster, Vessel

Array = NDArray[np.float64]

# where current and wind stand among the disturbances of a ship at sea
WHERE_CURRENT, WHERE_WIND = (
    np.array([disturbance_names("marine", ()).index(n) for n in names]) for names in (CURRENT, WIND)
)


class ShipDraws:
    """The model's own step, with its actuators, for many parameters at once.

    Parameters
    ----------
    structure : Structure
    vessel : Vessel
        Its `actuation` says how late forces follow; its delay is left to the caller.
    sample_time : float
        [s]
    integrator : {"euler", "rk4"}
    theta : ndarray
        (R, p) parameters.
    d : ndarray
        (R, nd) disturbance means [m/s].
    lagged : bool
        Whether forces follow late.

    Notes
    -----
    The state of one ship is u, v, … of the structure, its heading, and what its lag remembers.
    """

    def __init__(
        self,
        structure: Structure,
        vessel: Vessel,
        sample_time: float,
        integrator: Integrator,
        theta: Array,
        d: Array,
        *,
        lagged: bool = True,
    ) -> None:
        late = replace(vessel.actuation, delay=0.0) if lagged else Actuation()
        runs = len(theta)
        step = _ship(structure, vessel.thrusters, late, float(sample_time), integrator)
        self._step = over_runs(step, runs)
        self._rest = _rest(structure, vessel.thrusters, late, float(sample_time))
        self.states = structure.states
        self.runs = runs
        self.commands = len(vessel.commands)
        self.size = self._step.size2_in(0)
        self._theta = np.ascontiguousarray(theta.T)
        self._dt = np.array([float(sample_time)])
        self._before = np.zeros((self.size, runs))
        self._after = np.zeros((self.size, runs))
        self._w = np.zeros((self.commands + d.shape[1], runs))
        self._w[self.commands :] = d.T
        buffer, self._trigger = self._step.buffer()
        arguments = (self._before, self._w, self._theta, self._dt)
        for i, argument in enumerate(arguments):
            bind(buffer.set_arg, i, argument)
        bind(buffer.set_res, 0, self._after)
        self._buffer = buffer

    def start(self, x: Array, psi: Array | float, commands: Array) -> Array:
        """Return the state (n, R) of ships that have long run at their commands.

        Parameters
        ----------
        x : ndarray
            (nx, R) states [m/s, rad/s].
        psi : ndarray
            (R,) [rad]
        commands : ndarray
            (nc, R)
        """
        nx = len(self.states)
        state = np.zeros((self.size, self.runs))
        state[:nx] = x
        state[nx] = psi
        if late := len(state) - nx - 1:
            state[nx + 1 :] = np.asarray(self._rest.map(self.runs)(commands)).reshape(late, -1)
        return state

    def blow(self, wind: Array) -> None:
        """Take another wind from now on, north and east (2, R) [m/s]."""
        self._w[self.commands + WHERE_WIND] = wind

    def __call__(self, state: Array, commands: Array) -> Array:
        """Return the state (n, R) one sample later.

        Parameters
        ----------
        state : ndarray
            (n, R)
        commands : ndarray
            (nc, R) held over the sample.
        """
        self._before[:] = state
        self._w[: self.commands] = commands
        self._trigger()
        return self._after.copy()


def _actuators(
    structure: Structure, thrusters: tuple[Thruster, ...], late: Actuation, sample_time: float
) -> tuple[ca.SX, Actuators]:
    vessel = Vessel("", 1.0, thrusters, actuation=late)
    commands = ca.SX.sym("c", len(vessel.commands))
    return commands, actuators(vessel, commands, structure.inputs, sample_time)


@lru_cache(maxsize=32)
def _rest(
    structure: Structure, thrusters: tuple[Thruster, ...], late: Actuation, sample_time: float
) -> ca.Function:
    """Return what a lag remembers after commands were held for long, ``commands -> memory``."""
    commands, made = _actuators(structure, thrusters, late, sample_time)
    return ca.Function("rest", [commands], [ca.densify(made.rest)])


@lru_cache(maxsize=32)
def _ship(
    structure: Structure,
    thrusters: tuple[Thruster, ...],
    late: Actuation,
    sample_time: float,
    integrator: Integrator,
) -> ca.Function:
    """Return the step of one ship, ``(state, commands and d, theta, dt) -> state``."""
    commands, made = _actuators(structure, thrusters, late, sample_time)
    step = StepModel.free(structure, integrator)
    s = step.symbolic
    tau = column(made.forces[n] for n in structure.inputs)
    moved = step(s.x, s.psi, tau, s.d, ca.SX(2, 1), s.theta, s.dt)
    return ca.Function(
        "ship",
        [ca.vertcat(s.x, s.psi, made.symbols), ca.vertcat(commands, s.d), s.theta, s.dt],
        [ca.vertcat(moved, *[s.psi] * ("psi" not in step.states), made.next_memory)],
        {"cse": True},
    )
