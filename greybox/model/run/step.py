"""One sample of a model: the only place where its states are moved on.

A structure, or a predictor with estimated coefficients, gives what its equations add in
a sample, f (3.51). Around it stand the integrator and the kinematics of heading and
position. Free runs, output error, instruments, diagnosis, design, prediction and export
all take this step; the fast forms of `greybox.model.run.kernels` are compiled from it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from greybox.errors import StructureError
from greybox.model.predictor import Predictor
from greybox.model.structure import Structure
from greybox.rotation import body_to_ned

Array = NDArray[np.float64]
Integrator = Literal["euler", "rk4"]
# rate of decay times the sample time, below zero, beyond which a step decays less, or alternates:
# the two sides of it are twins that a log of samples hardly tells apart
MONOTONE: dict[Integrator, float] = {"euler": -1.0, "rk4": -1.596}
Heading = Literal["measured", "simulated"]
Rule = Literal["euler", "trapezoid"]

# the classical Runge-Kutta rule: the share of a stage's slope at which the next one looks,
# and what each counts
AHEAD = (0.5, 0.5, 1.0)
WEIGHTS = (1 / 6, 1 / 3, 1 / 3, 1 / 6)

_State = TypeVar("_State", ca.SX, Array)


@dataclass(frozen=True)
class SymbolicStep:
    """A step in symbols, to be differentiated or filled in.

    Parameters
    ----------
    x, psi, tau, d, air, theta, dt : SX
        States (nx,) [m/s, rad/s], heading [rad], generalised inputs (nu,), disturbance
        means (nd,) and velocity through the air (2,) [m/s], coefficients (p,), and the
        sample time [s].
    next_state : SX
        (nx,) next states, and the next heading below them where it is simulated.
    """

    x: ca.SX
    psi: ca.SX
    tau: ca.SX
    d: ca.SX
    air: ca.SX
    theta: ca.SX
    dt: ca.SX
    next_state: ca.SX

    @property
    def state(self) -> ca.SX:
        """What a step hands to the next one: `x`, and `psi` where it is simulated."""
        simulated = self.next_state.numel() > self.x.numel()
        return ca.vertcat(self.x, self.psi) if simulated else self.x

    def at(self, expression: ca.SX, d: Array, theta: Array, dt: float) -> ca.SX:
        """Return an expression, dense, at known means, coefficients and sample time."""
        symbols = ca.vertcat(self.d, self.theta, self.dt)
        return ca.substitute(ca.densify(expression), symbols, ca.vertcat(ca.DM(d), theta, dt))


@dataclass(frozen=True)
class StepModel:
    """The step of a model over one sample.

    Parameters
    ----------
    structure : Structure
    integrator : {"euler", "rk4"}
    heading : {"measured", "simulated"}
        Held over the sample, or integrated with the states.
    air_measured : bool
        Whether the velocity through the air is an input, held over the sample; else the
        wind's mean forms it.
    predictor : Predictor, optional
        Its columns and their coefficients take the place of the structure's terms and
        parameters; biases capture what the means do not.

    Raises
    ------
    StructureError
        The heading is to be simulated but the structure has no yaw rate, or a map that
        is not an increment is to be integrated by RK4.
    """

    structure: Structure
    integrator: Integrator = "euler"
    heading: Heading = "measured"
    air_measured: bool = False
    predictor: Predictor | None = None

    def __post_init__(self) -> None:
        if self.heading == "simulated" and "r" not in self.structure.states:
            raise StructureError(
                f"structure '{self.structure.name}' has no yaw rate to integrate: use the "
                f"measured heading."
            )
        if self.integrator != "euler" and not self.structure.increment:
            raise StructureError(
                f"structure '{self.structure.name}' is a map, not a rate: use euler."
            )

    @classmethod
    def of_predictor(
        cls,
        predictor: Predictor,
        heading: Heading = "measured",
        integrator: Integrator = "euler",
    ) -> StepModel:
        """Return the step of a predictor with its own coefficients."""
        return cls(
            predictor.structure,
            integrator,
            heading,
            air_measured=predictor.air_measured,
            predictor=predictor,
        )

    @classmethod
    def free(
        cls, structure: Structure, integrator: Integrator, *, air_measured: bool = False
    ) -> StepModel:
        """Return the step of a ship whose heading is simulated if she has a yaw rate."""
        heading: Heading = "simulated" if "r" in structure.states else "measured"
        return cls(structure, integrator, heading, air_measured)

    @property
    def states(self) -> tuple[str, ...]:
        """What a step hands to the next one, the heading last where it is simulated."""
        own = self.structure.states
        return (*own, "psi") if self.heading == "simulated" else own

    def moved(self, slope: Callable[[_State], _State], start: _State) -> _State:
        """Return a state one sample later, inputs held.

        Parameters
        ----------
        slope : callable
            What the terms give at a state, f; called once a stage, in their order.
        start : SX or ndarray
            The state. Since the rule is linear in the slopes, a derivative of the state is
            moved on by it as well, with the chain rule as its slope.
        """
        now = slope(start)
        if not self.structure.increment:
            return now
        if self.integrator == "euler":
            return start + now
        total = WEIGHTS[0] * now
        for share, weight in zip(AHEAD, WEIGHTS[1:], strict=True):
            now = slope(start + share * now)
            total = total + weight * now
        return start + total

    @property
    def increment(self) -> ca.Function:
        """What the terms give at a state, f: ``(x, psi, tau, d, air, theta) -> f``."""
        return _increment(self)

    @property
    def symbolic(self) -> SymbolicStep:
        """The step as expressions of its symbols."""
        return _symbolic(self)

    @property
    def function(self) -> ca.Function:
        """The step, ``(x, psi, tau, d, air, theta, dt) -> next state``; see `SymbolicStep`."""
        return _function(self)

    def __call__(
        self,
        x: ca.SX,
        psi: ca.SX | float,
        tau: ca.SX,
        d: ca.SX | Array,
        air: ca.SX | Array,
        theta: ca.SX | Array,
        dt: ca.SX | float,
    ) -> ca.SX:
        """Return the next states as an expression of others; see `SymbolicStep`."""
        found = _function(self).call([ca.SX(a) for a in (x, psi, tau, d, air, theta, dt)])
        return ca.SX(found[0])

    @property
    def jacobians(self) -> ca.Function:
        """Derivatives of the next states, ``(x, psi, tau, d, air, theta, dt) -> A, B, P, E``.

        ``A`` (nx, nx) in the states, ``B`` (nx, nu) in the inputs, ``P`` (nx, p) in the
        coefficients, ``E`` (nx, nd) in the disturbance means.
        """
        return _jacobians(self)


@lru_cache(maxsize=128)
def _increment(step: StepModel) -> ca.Function:
    structure, predictor = step.structure, step.predictor
    s = structure.symbols
    theta, f = s.theta, structure.increment_expression(air_measured=step.air_measured)
    if predictor is not None:
        theta = ca.SX.sym("c", len(predictor.columns))
        f = predictor.increment_expression(theta)
    return ca.Function("increment", [s.x, s.psi, s.tau, s.d, s.air, theta], [f])


@lru_cache(maxsize=128)
def _symbolic(step: StepModel) -> SymbolicStep:
    s, f = step.structure.symbols, step.increment
    nx, theta, dt = s.x.numel(), ca.SX.sym("theta", f.size1_in(5)), ca.SX.sym("dt")
    theta = s.theta if step.predictor is None else theta
    held = (s.tau, s.d, s.air, theta)
    if step.heading == "measured":
        next_state = step.moved(lambda x: f(x, s.psi, *held), s.x)
    else:
        turn = step.structure.states.index("r")
        next_state = step.moved(
            lambda z: ca.vertcat(f(z[:nx], z[nx], *held), dt * z[turn]), ca.vertcat(s.x, s.psi)
        )
    return SymbolicStep(s.x, s.psi, s.tau, s.d, s.air, theta, dt, ca.densify(next_state))


@lru_cache(maxsize=128)
def _function(step: StepModel) -> ca.Function:
    s = _symbolic(step)
    return ca.Function("step", [s.x, s.psi, s.tau, s.d, s.air, s.theta, s.dt], [s.next_state])


@lru_cache(maxsize=64)
def _jacobians(step: StepModel) -> ca.Function:
    s = _symbolic(step)
    return ca.Function(
        "jacobians",
        [s.x, s.psi, s.tau, s.d, s.air, s.theta, s.dt],
        [ca.jacobian(s.next_state, v) for v in (s.x, s.tau, s.theta, s.d)],
        ["x", "psi", "tau", "d", "air", "theta", "dt"],
        ["A", "B", "P", "E"],
    )


def next_position(place: ca.SX, u: ca.SX, v: ca.SX, psi: ca.SX, dt: ca.SX | float) -> ca.SX:
    """Return north and east a sample later by Euler, p⁺ = p + Ts·R(ψ)(u, v), of either integrator.

    Parameters
    ----------
    place : SX
        (2,) [m]
    u, v, psi, dt : SX
        At the sample [m/s, rad], and its length [s].
    """
    return place + dt * ca.vertcat(*body_to_ned(u, v, psi))


def held(value: Array, integrator: Integrator, axis: int = 0) -> Array:
    """Return what a step reads of a signal that is measured at the samples.

    Euler's rule reads it at the start of the step. The classical Runge-Kutta rule, during
    which the ship turns, reads the mean of both ends; the last value stands, since no next
    one is known.

    Parameters
    ----------
    value : ndarray
        (..., N, ...)
    integrator : {"euler", "rk4"}
    axis : int
        Of time.
    """
    if integrator == "euler":
        return value
    out = np.moveaxis(np.array(value, float), axis, -1)
    out[..., :-1] = (out[..., :-1] + out[..., 1:]) / 2
    return np.moveaxis(out, -1, axis)


def integrated(rate: Array, steps: Array | float, rule: Rule, axis: int = 0) -> Array:
    """Integrate a rate that was run already, from zero.

    Parameters
    ----------
    rate : ndarray
        (..., N, ...)
    steps : ndarray or float
        (N−1,) or one: lengths of the samples [s].
    rule : {"euler", "trapezoid"}
        By the rate at the start of each sample, as a step moves positions, or by the mean
        of both ends.
    axis : int
        Of time.

    Returns
    -------
    ndarray
        As `rate`.
    """
    moved = np.moveaxis(rate, axis, -1)
    out = np.zeros_like(moved)
    mean = moved[..., :-1] if rule == "euler" else (moved[..., 1:] + moved[..., :-1]) / 2
    np.cumsum(mean * steps, axis=-1, out=out[..., 1:])
    return np.moveaxis(out, -1, axis)
