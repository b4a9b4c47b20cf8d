"""Many draws of one ship, stepped together by thruster commands that may follow their motion."""

from __future__ import annotations

import math
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from greybox.model.run.kernels import bind, over_runs
from greybox.model.run.step import Integrator, StepModel
from greybox.model.structure import Structure
from greybox.vessel.force import force_expressions
from greybox.vessel.vessel import Actuation, Thruster, Vessel

Array = NDArray[np.float64]


class Ship:
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
        late = vessel.actuation if lagged else Actuation()
        lag = late.lag / sample_time
        runs = len(theta)
        key = (structure, vessel.thrusters, lag, late.lag_on, late.lag_held, integrator)
        self._step = _many(*key, runs)
        self._remember = _memory(*key) if lag else None
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
        if self._remember is not None:
            state[nx + 1 :] = np.asarray(self._remember.map(self.runs)(commands))
        return state

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


def _forces(structure: Structure, vessel: Vessel, commands: ca.SX) -> ca.SX:
    made = force_expressions(vessel, commands)
    return ca.vertcat(*[made.get(n, ca.SX(0)) for n in structure.inputs])


@lru_cache(maxsize=32)
def _memory(
    structure: Structure,
    thrusters: tuple[Thruster, ...],
    lag: float,
    lag_on: str,
    lag_held: str,
    integrator: Integrator,
) -> ca.Function:
    """Return what a lag remembers after commands were held for long, ``commands -> z``."""
    vessel = Vessel("", 1.0, thrusters)
    c = ca.SX.sym("c", len(vessel.commands))
    return ca.Function("z", [c], [_forces(structure, vessel, c) if lag_on == "force" else c])


@lru_cache(maxsize=32)
def _many(
    structure: Structure,
    thrusters: tuple[Thruster, ...],
    lag: float,
    lag_on: str,
    lag_held: str,
    integrator: Integrator,
    runs: int,
) -> ca.Function:
    """Return the step of `runs` ships, ``(state, commands and d, theta, dt) -> state⁺``."""
    vessel = Vessel("", 1.0, thrusters)
    s = structure.symbols
    turns = "r" in structure.states
    step = StepModel(structure, integrator, "simulated" if turns else "measured")
    columns = vessel.commands
    c = ca.SX.sym("c", len(columns))
    dt = ca.SX.sym("dt")
    share = 1 - math.exp(-1 / lag) if lag else 1.0

    def follow(old: ca.SX, new: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Return what acts during the sample, and what is remembered after it."""
        weight = {"start": 1.0, "mean": share * lag, "end": 1 - share}[lag_held]
        return new + (old - new) * weight, old + (new - old) * share

    z: ca.SX = ca.SX(0, 1)
    after: ca.SX = ca.SX(0, 1)
    if lag and lag_on == "force":
        made = _forces(structure, vessel, c)
        z = ca.SX.sym("z", made.numel())
        tau, after = follow(z, made)
    elif lag:
        z = ca.SX.sym("z", len(columns))
        acting, after = follow(z, c)
        speeds = {t.speed for t in thrusters}
        moved = [
            acting[i] if lag_on == "command" or n in speeds else c[i] for i, n in enumerate(columns)
        ]
        tau = _forces(structure, vessel, ca.vertcat(*moved))
    else:
        tau = _forces(structure, vessel, c)
    after_step = step(s.x, s.psi, tau, s.d, ca.SX(2, 1), s.theta, dt)
    one = ca.Function(
        "ship",
        [ca.vertcat(s.x, s.psi, z), ca.vertcat(c, s.d), s.theta, dt],
        [ca.vertcat(after_step, *[s.psi] * (not turns), after)],
        {"cse": True},
    )
    return over_runs(one, runs)
