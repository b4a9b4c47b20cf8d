"""The motion that a sequence gives under one prior model, and derivatives carried back to it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_banded

from greybox.errors import StructureError
from greybox.model.run.simulation import positions, simulate
from greybox.model.run.step import Integrator, StepModel, next_position
from greybox.model.structure import Structure
from greybox.numerics.vectorised import Vectorised
from greybox.vessel.actuation import actuated_force
from greybox.vessel.force import force_expressions, generalised_force
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]

# speeds [m/s] and rates [rad/s] past which a free run counts as unstable
_BOUND = {"u": 100.0, "v": 100.0, "r": 10.0}


@dataclass(frozen=True)
class Motion:
    """R runs of N steps.

    Parameters
    ----------
    state : ndarray
        (R, N+1, nx+3) states [m/s, rad/s], heading [rad], north and east [m].
    tau : ndarray
        (R, N, nu) generalised inputs.
    commands : ndarray
        (R, N, nc)
    stable : ndarray of bool
        (R,) whether the run stayed within every plausible bound.
    """

    state: Array
    tau: Array
    commands: Array
    stable: NDArray[np.bool_]


# by how much so many draws of forces that a prior does not say move a run, (D, N+1, nx)
Misfit = Callable[[Motion, int], Array]


class Rollout:
    """A prior model on its way through a trial.

    Parameters
    ----------
    vessel : Vessel
    structure : Structure
        Marine, with surge among its states.
    theta : ndarray
        (p,) parameters.
    d : ndarray
        (nd,) disturbance means [m/s].
    start : ndarray
        (nx + 1,) initial states [m/s, rad/s] and heading [rad].
    sample_time : float
        [s]
    integrator : {"euler", "rk4"}

    Raises
    ------
    StructureError
        The structure is no ship.
    """

    def __init__(
        self,
        vessel: Vessel,
        structure: Structure,
        theta: Array,
        d: Array,
        start: Array,
        sample_time: float,
        integrator: Integrator = "euler",
    ) -> None:
        if not structure.marine or "u" not in structure.states:
            raise StructureError(
                f"structure '{structure.name}' has no surge speed u, so no trial can be designed "
                f"for it: use a manoeuvring structure such as 'thesis' or 'surge'."
            )
        self.vessel = vessel
        self.structure = structure
        self.theta = np.asarray(theta, float)
        self.d = np.asarray(d, float)
        self.start = np.asarray(start, float)
        self.sample_time = sample_time
        self.integrator: Integrator = integrator
        self.nx = len(structure.states)
        self.symbols, self.step = step_expression(
            vessel, structure, self.theta, self.d, sample_time, integrator
        )
        state, commands = self.symbols
        s = structure.symbols
        tau = force_vector(vessel, structure, commands)
        parts = [
            ca.jacobian(self.step, state),
            ca.jacobian(self.step, commands),
            ca.jacobian(tau, commands),
        ]
        self._shapes = [p.shape for p in parts]
        self._slopes = Vectorised(
            ca.vertsplit(ca.vertcat(*[ca.vec(p.T) for p in parts])),
            [*ca.vertsplit(state), *ca.vertsplit(commands)],
        )
        self._names = s.x.numel()

    def run(self, commands: Array, *, late: bool = False) -> Motion:
        """Run freely on commands (R, N, nc), with the vessel's lag and delay where `late`."""
        return self._run(self.theta, commands, late)

    def run_models(
        self, thetas: Array, commands: Array, *, late: bool = False, begun: Array | None = None
    ) -> Motion:
        """Run other parameters (R, p) on the same commands (N, nc), or each on its own.

        From the same initial states, or each from its own, `begun` (R, nx).
        """
        together = np.broadcast_to(commands, (len(thetas), *commands.shape[-2:]))
        return self._run(thetas, together, late, begun)

    def _run(self, theta: Array, commands: Array, late: bool, begun: Array | None = None) -> Motion:
        structure, tau = self.structure, self.forces(commands, late=late)
        samples = commands.shape[1]
        heading = None if "r" in structure.states else np.full(samples + 1, self.start[-1])
        free = simulate(
            structure, theta, self.start[:-1] if begun is None else begun, tau, self.sample_time,
            psi=heading, psi0=float(self.start[-1]),
            d=np.broadcast_to(self.d, (samples, self.d.size)) if self.d.any() else None,
            integrator=self.integrator,
            bound=plausible_bounds(structure.states),
        )  # fmt: skip
        stable = free.diverged < 0
        with np.errstate(invalid="ignore", over="ignore"):
            state = self._with_way(free.x, free.psi)
        state[~stable] = 0.0
        return Motion(state, tau, commands, stable)

    def forces(self, commands: Array, *, late: bool = False) -> Array:
        """Return generalised inputs (..., nu) of commands (..., nc), `late` with lag and delay."""
        columns = {n: commands[..., i] for i, n in enumerate(self.vessel.commands)}
        if late:
            made = actuated_force(self.vessel, columns, self.sample_time)
        else:
            made = generalised_force(self.vessel, columns)
        none = np.zeros(commands.shape[:-1])
        return np.stack([made.get(n, none) for n in self.structure.inputs], axis=-1)

    def moved(self, motion: Motion, by: Array) -> Motion:
        """Return R runs whose states are off (R, N+1, nx), heading and place as they follow."""
        x, psi = self.off(motion.state[..., : self.nx], motion.state[..., self.nx], by)
        state = self._with_way(x, psi)
        state[~motion.stable] = 0.0
        return Motion(state, motion.tau, motion.commands, motion.stable)

    def off(self, x: Array, psi: Array, by: Array) -> tuple[Array, Array]:
        """Return states (R, N+1, nx) and headings (R, N+1) that are off by so much (R, N+1, nx)."""
        if "r" in self.structure.states:
            turned = np.cumsum(by[:, :-1, self.structure.states.index("r")], axis=1)
            psi = psi + self.sample_time * np.pad(turned, ((0, 0), (1, 0)))
        return x + by, psi

    def _with_way(self, x: Array, psi: Array) -> Array:
        """Return states (R, N+1, nx), heading (R, N+1) and the place that they lead to."""
        states = self.structure.states
        pair = np.zeros((*x.shape[:2], 2))
        pair[..., 0] = x[..., states.index("u")]
        if "v" in states:
            pair[..., 1] = x[..., states.index("v")]
        return np.concatenate([x, psi[..., None], positions(pair, psi, self.sample_time)], axis=-1)

    def pull(self, motion: Motion, d_state: Array, d_tau: Array, d_commands: Array) -> Array:
        """Carry the derivatives of a scalar along one run back to its commands.

        Parameters
        ----------
        motion : Motion
            Of one run.
        d_state : ndarray
            (N+1, nx+3)
        d_tau : ndarray
            (N, nu)
        d_commands : ndarray
            (N, nc)

        Returns
        -------
        ndarray
            (N, nc) total derivative.
        """
        in_state, in_command, force = self._derivatives(motion.state[0, :-1], motion.commands[0])
        costate = costates(in_state, d_state[..., None])[..., 0]
        return np.asarray(
            d_commands
            + np.einsum("ian,ni->na", force, d_tau)
            + np.einsum("ian,ni->na", in_command, costate[1:])
        )

    def slopes(self, motion: Motion) -> Array:
        """Return the derivatives of the next state in the state, (n, n, R, N)."""
        return self._derivatives(motion.state[:, :-1], motion.commands)[0]

    def _derivatives(self, state: Array, commands: Array) -> list[Array]:
        """Return derivatives (rows, columns, ...) at states (..., n) and commands (..., nc)."""
        shape = state.shape[:-1]
        signals = [*np.moveaxis(state, -1, 0), *np.moveaxis(commands, -1, 0)]
        out = np.empty((self._slopes.size, *shape))
        self._slopes([np.ascontiguousarray(s) for s in signals], out)
        blocks, first = [], 0
        for rows, columns in self._shapes:
            blocks.append(out[first : first + rows * columns].reshape(rows, columns, *shape))
            first += rows * columns
        return blocks


def costates(slopes: Array, seed: Array) -> Array:
    """Return p(k) = seed(k) + Fᵀ(k) p(k+1), (N+1, n, m), as one upper banded system.

    Parameters
    ----------
    slopes : ndarray
        (n, n, N) F, the derivatives of the next state in the state.
    seed : ndarray
        (N+1, n, m)
    """
    n = len(slopes)
    band = np.zeros((2 * n, n * len(seed)))
    band[-1] = 1.0
    for i in range(n):
        for j in range(n):
            # row kn + i, column (k+1)n + j
            band[n - 1 + i - j, n + j :: n] = -slopes[j, i]
    solved = solve_banded(
        (0, 2 * n - 1), band, seed.reshape(n * len(seed), -1),
        overwrite_ab=True, check_finite=False,
    )  # fmt: skip
    return np.asarray(solved.reshape(seed.shape))


def plausible_bounds(states: tuple[str, ...]) -> Array:
    """Return the size (nx,) of each state past which a run counts as unstable."""
    return np.array([_BOUND.get(n, 1e6) for n in states])


def force_vector(vessel: Vessel, structure: Structure, commands: ca.SX) -> ca.SX:
    """Return the structure's inputs as expressions of the commands (nc,)."""
    made = force_expressions(vessel, commands)
    return ca.vertcat(*[made.get(n, ca.SX(0)) for n in structure.inputs])


def step_expression(
    vessel: Vessel,
    structure: Structure,
    theta: Array | ca.SX,
    d: Array | ca.SX,
    sample_time: float,
    integrator: Integrator,
) -> tuple[tuple[ca.SX, ca.SX], ca.SX]:
    """Return symbols (state (nx+3,), commands (nc,)) and the next state.

    The state holds the structure's states, the heading, and north and east.
    """
    step = StepModel.free(structure, integrator)
    s = step.symbolic
    commands = ca.vertcat(*[ca.SX.sym(c) for c in vessel.commands])
    place = ca.vertcat(ca.SX.sym("north"), ca.SX.sym("east"))
    tau = force_vector(vessel, structure, commands)
    moved = step(s.x, s.psi, tau, d, ca.SX(2, 1), theta, sample_time)
    speed = dict(zip(structure.states, ca.vertsplit(s.x), strict=True))
    place_after = next_position(place, speed["u"], speed.get("v", ca.SX(0)), s.psi, sample_time)
    after = ca.vertcat(moved, *[s.psi] * ("psi" not in step.states), place_after)
    return (ca.vertcat(s.x, s.psi, place), commands), after
