"""An identified model as one CasADi function, for controllers and other programs.

The whole ship in one step: heading and position beside the states, thrusters from
their commands, their lag and delay as further states, parameters and current of the
model as numbers. Everything is one SX expression, so the function takes numbers, SX
and MX alike and drops into Opti, do-mpc, rockit or acados.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from greybox.errors import StructureError, UsageError
from greybox.model.disturbances import WIND
from greybox.model.run.step import StepModel, next_position
from greybox.rotation import body_to_ned
from greybox.vessel.force import force_expressions, force_inputs

if TYPE_CHECKING:
    from greybox.model.model import ManoeuvringModel

_BODY = ("u", "v", "r")
# a delay this close to whole samples has no share of the next one
_WHOLE = 1e-9


@dataclass(frozen=True)
class _Commands:
    """The commands that act during a sample, and what remembers the earlier ones.

    ``memory`` are the symbols of the past, ``after`` what they are one sample later.
    """

    acting: ca.SX
    memory: ca.SX
    after: ca.SX


def state_names(model: ManoeuvringModel) -> tuple[str, ...]:
    """Return the names of ``x`` of `whole_step`.

    ``u, v, r, psi, x_n, y_n``; then ``…_before_k`` of commands that still are to act and
    ``…_lagged`` of what follows slowly, where the vessel's thrusters are late.
    """
    names = [*model.structure.states, "psi", "x_n", "y_n"]
    count = _held(model)
    names += [f"{c}_before_{k + 1}" for c in model.vessel.commands for k in range(count)]
    if model.vessel.actuation.lag:
        names += [f"{n}_lagged" for n in _slow(model)]
    return tuple(names)


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
    late = _delayed(model, command)
    slow, tau, slow_after = _lagged(model, late.acting)
    d, dt = _disturbance(model, wind), model.sample_time
    step = StepModel(model.structure, model.integrator, "simulated")
    moved = step(s.x, s.psi, tau, d, ca.SX(2, 1), model.theta, dt)
    place = next_position(position, s.x[0], s.x[1], s.psi, dt)
    x = ca.vertcat(s.x, s.psi, position, late.memory, slow)
    after = ca.vertcat(moved, place, late.after, slow_after)
    return _function("step", model, x, command, wind, after, "x_next")


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
        The thrusters have a pure delay, which no ordinary differential equation has.
    """
    model = _checked(model)
    late = model.vessel.actuation
    if late.delay:
        raise UsageError(
            f"the thrusters of '{model.vessel.name}' act {late.delay:g} s late, which no ordinary "
            f"differential equation can hold: use step_function(), or delay the commands outside."
        )
    s = model.structure.symbols
    position = ca.SX.sym("position", 2)
    command = ca.SX.sym("command", len(model.vessel.commands))
    wind = ca.SX.sym("wind", 2)
    slow, tau, slow_after = _lagged(model, command, held=False)
    d, dt = _disturbance(model, wind), model.sample_time
    step = StepModel(model.structure, heading="simulated")
    rate = (step(s.x, s.psi, tau, d, ca.SX(2, 1), model.theta, dt) - step.symbolic.state) / dt
    x = ca.vertcat(s.x, s.psi, position, slow)
    x_dot = ca.vertcat(rate, *body_to_ned(s.x[0], s.x[1], s.psi), slow_after)
    return _function("rhs", model, x, command, wind, x_dot, "x_dot")


def _checked(model: ManoeuvringModel) -> ManoeuvringModel:
    structure = model.structure
    if structure.disturbance != "marine" or structure.states != _BODY:
        raise StructureError(
            f"structure '{structure.name}' has the states {', '.join(structure.states)}, a ship "
            f"that moves in the plane needs {', '.join(_BODY)}: estimate with one that has them, "
            f"such as 'thesis'."
        )
    return model.settled()


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


def _slow(model: ManoeuvringModel) -> tuple[str, ...]:
    """Return the names of what follows its command slowly."""
    vessel = model.vessel
    if vessel.actuation.lag_on == "force":
        return tuple(n for n in force_inputs(vessel) if n in model.structure.inputs)
    if vessel.actuation.lag_on == "command":
        return vessel.commands
    return tuple(dict.fromkeys(t.speed for t in vessel.thrusters))


def _held(model: ManoeuvringModel) -> int:
    """Return how many earlier commands are to be remembered."""
    return int(np.ceil(model.vessel.actuation.delay / model.sample_time - _WHOLE))


def _delayed(model: ManoeuvringModel, command: ca.SX) -> _Commands:
    """Delay the commands as `greybox.vessel.actuation.delayed` does, by a shift register."""
    count = _held(model)
    if not count:
        return _Commands(command, ca.SX(0, 1), ca.SX(0, 1))
    size = command.numel()
    past = ca.SX.sym("past", size, count)
    every = ca.horzcat(command, past)
    share = count - model.vessel.actuation.delay / model.sample_time
    share = 0.0 if share < _WHOLE else share
    acting = share * every[:, count - 1] + (1 - share) * every[:, count]
    return _Commands(acting, ca.vec(past.T), ca.vec(every[:, :count].T))


def _lagged(
    model: ManoeuvringModel, command: ca.SX, *, held: bool = True
) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Return the memory of the lag, the generalised inputs that act, and what the memory becomes.

    With `held` it becomes its value a sample later, else its time derivative.
    """
    vessel, late = model.vessel, model.vessel.actuation

    def inputs(commands: ca.SX) -> dict[str, ca.SX]:
        made = force_expressions(vessel, commands)
        return {n: made.get(n, ca.SX(0)) for n in model.structure.inputs}

    if not late.lag:
        return ca.SX(0, 1), ca.vertcat(*inputs(command).values()), ca.SX(0, 1)
    names = _slow(model)
    wanted = inputs(command) if late.lag_on == "force" else _by_name(vessel.commands, command)
    memory = ca.SX.sym("lagged", len(names))
    goal = ca.vertcat(*[wanted[n] for n in names])
    a = float(np.exp(-model.sample_time / late.lag))
    after = goal + (memory - goal) * a if held else (goal - memory) / late.lag
    value = memory
    if held and late.lag_held != "start":
        share = a if late.lag_held == "end" else (1 - a) * late.lag / model.sample_time
        value = goal + (memory - goal) * share
    acting = wanted | _by_name(names, value)
    if late.lag_on != "force":
        acting = inputs(ca.vertcat(*[acting[c] for c in vessel.commands]))
    return memory, ca.vertcat(*[acting[n] for n in model.structure.inputs]), after


def _by_name(names: tuple[str, ...], values: ca.SX) -> dict[str, ca.SX]:
    return {n: values[i] for i, n in enumerate(names)}
