"""An identified model as one CasADi function, for controllers and other programs.

The whole ship in one step: heading and position beside the states, thrusters from
their commands, their lag and delay as further states, parameters and current of the
model as numbers. Everything is one SX expression, so the function takes numbers, SX
and MX alike and drops into Opti, do-mpc, rockit or acados.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import casadi as ca

from greybox.errors import StructureError, UsageError
from greybox.model.disturbances import WIND
from greybox.model.run.actuators import Actuators, actuators, column
from greybox.model.run.step import StepModel, next_position
from greybox.rotation import body_to_ned
from greybox.vessel.force import force_inputs

if TYPE_CHECKING:
    from greybox.model.model import ManoeuvringModel

_BODY = ("u", "v", "r")


def state_names(model: ManoeuvringModel) -> tuple[str, ...]:
    """Return the names of ``x`` of `whole_step`.

    ``u, v, r, psi, x_n, y_n``; then ``…_before_k`` of commands that still are to act,
    ``…_limited`` of one that moves at a limited rate and ``…_lagged`` of what follows slowly,
    where the vessel's thrusters are late.
    """
    late = _late(model, ca.SX.sym("command", len(model.vessel.commands)))
    return (*model.structure.states, "psi", "x_n", "y_n", *[m.name for m in late.memory])


def whole_step(model: ManoeuvringModel) -> ca.Function:
    """Return the step ``(x, command, wind) -> x_next`` over one sample time.

    Parameters
    ----------
    model : ManoeuvringModel
        As it is after its last change.

    Returns
    -------
    casadi.Function
        ``x`` (n,) by `state_names`: u, v [m/s] and r [rad/s] over ground, ψ [rad],
        north and east [m], then the memory of late thrusters. ``command`` (nc,) in
        the order of ``vessel.commands``: speeds in the unit of the log, angles [rad].
        ``wind`` (2,) velocity of the air to north and east [m/s], there only where the
        structure has wind terms and the model does not know the wind itself.
        Positions follow by p⁺ = p + Ts·R(ψ)(u, v).

    Raises
    ------
    StructureError
        The structure has not the three states u, v, r in a current and wind.
    """
    model = _checked(model)
    s, vessel = model.structure.symbols, model.vessel
    position = ca.SX.sym("position", 2)
    command = ca.SX.sym("command", len(vessel.commands))
    wind = ca.SX.sym("wind", 2)
    late = _late(model, command)
    tau = column(late.forces[n] for n in model.structure.inputs)
    d, dt = _disturbance(model, wind), model.sample_time
    step = StepModel(model.structure, model.integrator, "simulated")
    moved = step(s.x, s.psi, tau, d, ca.SX(2, 1), model.theta, dt)
    place = next_position(position, s.x[0], s.x[1], s.psi, dt)
    x = ca.vertcat(s.x, s.psi, position, late.symbols)
    x_next = ca.vertcat(moved, place, late.next_memory)
    return _function("step", model, x, command, wind, x_next, "x_next")


def whole_rate(model: ManoeuvringModel) -> ca.Function:
    """Return the continuous-time form ``(x, command, wind) -> x_dot``.

    Parameters
    ----------
    model : ManoeuvringModel
        As it is after its last change; inputs as those of `whole_step`.

    Returns
    -------
    casadi.Function
        (n,) time derivatives. What was identified is the discrete model: this is
        its increment over the sample time, f/Ts. One explicit Euler step over Ts
        gives `whole_step` of an ``euler`` model exactly (lags apart, which it
        integrates exactly); any other integrator or step differs from it by
        O(Ts). The rate of an ``rk4`` model is what its rule integrates.

    Raises
    ------
    StructureError
        As `whole_step`.
    UsageError
        The thrusters have a pure delay or a rate limit, of which there is no such form.
    """
    model = _checked(model)
    late = model.vessel.actuation
    if late.delay:
        raise UsageError(
            f"the thrusters of '{model.vessel.name}' act {late.delay:g} s late, which no ordinary "
            f"differential equation can hold: use step_function(), or delay the commands outside."
        )
    if late.rate_limit is not None:
        raise UsageError(
            f"the rate of {late.rate_on} of '{model.vessel.name}' is limited from sample to "
            f"sample, of which there is no continuous-time form: use step_function(), or limit "
            f"the command outside."
        )
    s = model.structure.symbols
    position = ca.SX.sym("position", 2)
    command = ca.SX.sym("command", len(model.vessel.commands))
    wind = ca.SX.sym("wind", 2)
    slow = _late(model, command)
    assert slow.rate is not None
    tau = column(slow.rate_forces[n] for n in model.structure.inputs)
    d, dt = _disturbance(model, wind), model.sample_time
    step = StepModel(model.structure, heading="simulated")
    rate = (step(s.x, s.psi, tau, d, ca.SX(2, 1), model.theta, dt) - step.symbolic.state) / dt
    x = ca.vertcat(s.x, s.psi, position, slow.symbols)
    x_dot = ca.vertcat(rate, *body_to_ned(s.x[0], s.x[1], s.psi), slow.rate)
    return _function("rhs", model, x, command, wind, x_dot, "x_dot")


def _checked(model: ManoeuvringModel) -> ManoeuvringModel:
    structure = model.structure
    if not structure.marine or structure.states != _BODY:
        raise StructureError(
            f"structure '{structure.name}' has the states {', '.join(structure.states)}, a ship "
            f"that moves in the plane needs {', '.join(_BODY)}: estimate with one that has them, "
            f"such as 'thesis'."
        )
    return model.at_final_parameters()


def _function(
    name: str, model: ManoeuvringModel, x: ca.SX, command: ca.SX, wind: ca.SX, out: ca.SX, what: str
) -> ca.Function:
    arguments, names = [x, command], ["x", "command"]
    if _windy(model):
        arguments, names = [*arguments, wind], [*names, "wind"]
    return ca.Function(name, arguments, [out], names, [what], {"cse": True})


def _disturbance(model: ManoeuvringModel, wind: ca.SX) -> ca.SX:
    asked = WIND if _windy(model) else ()
    return ca.vertcat(
        *[
            wind[WIND.index(n)] if n in asked else model.d[i]
            for i, n in enumerate(model.structure.disturbances)
        ]
    )


def _windy(model: ManoeuvringModel) -> bool:
    """Whether the wind is an input."""
    return model.structure.uses_air and not set(WIND) & model.disturbances.keys()


def _late(model: ManoeuvringModel, command: ca.SX) -> Actuators:
    """Return how the forces follow the commands, their memory in the order of `force_inputs`."""
    structure = model.structure
    made = [n for n in force_inputs(model.vessel) if n in structure.inputs]
    inputs = dict.fromkeys([*made, *structure.inputs])
    return actuators(model.vessel, command, inputs, model.sample_time)
