"""Thrusters that act late: the state that this needs, and its update from sample to sample.

The same delay, rate limit and lag as `greybox.vessel.actuation` makes of whole logs, with the
commands, limited and lagged values of earlier samples as states.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import casadi as ca

from greybox.vessel.actuation import decay, held_share
from greybox.vessel.force import force_expressions
from greybox.vessel.vessel import Actuation, Vessel


@dataclass(frozen=True)
class Memory:
    """A number that late thrusters carry from sample to sample.

    Parameters
    ----------
    of : str
        A command or a generalised input.
    before : int
        How many samples ago it was commanded; 0 for its lagged or limited value.
    limited : bool
        Whether it is where a command of limited rate was a sample ago.
    """

    of: str
    before: int
    limited: bool = False

    @property
    def name(self) -> str:
        """Such as ``n_before_2``, ``delta_limited`` or ``taux_lagged``."""
        if self.before:
            return f"{self.of}_before_{self.before}"
        return f"{self.of}_{'limited' if self.limited else 'lagged'}"


@dataclass(frozen=True)
class Actuators:
    """How the generalised inputs follow the commands.

    Parameters
    ----------
    memory : tuple of Memory
    symbols : SX
        (m,) the memory.
    forces : mapping of str to SX
        Generalised inputs that act during the sample.
    next_memory, rest : SX
        (m,) the memory one sample later, and at rest on the commands.
    rate : SX or None
        (m,) change of the memory [1/s]; None where there is none, see `without_rate`.
    rate_forces : mapping of str to SX
        Generalised inputs at an instant.
    """

    memory: tuple[Memory, ...]
    symbols: ca.SX
    forces: Mapping[str, ca.SX]
    next_memory: ca.SX
    rest: ca.SX
    rate: ca.SX | None
    rate_forces: Mapping[str, ca.SX]


def actuators(
    vessel: Vessel, commands: ca.SX, inputs: Iterable[str], sample_time: float
) -> Actuators:
    """Return how the generalised inputs follow the commands from sample to sample.

    Parameters
    ----------
    vessel : Vessel
    commands : SX
        (nc,) of one sample, in the order of `Vessel.commands`.
    inputs : iterable of str
        Generalised inputs that the structure uses; zero where no thruster makes them.
    sample_time : float
        [s]
    """
    late = vessel.actuation
    whole, share = late.delay_samples(sample_time)
    remembered: list[tuple[Memory, ca.SX, ca.SX, ca.SX]] = []
    rate: list[ca.SX] = []
    slow: list[ca.SX] = []
    for i, name in enumerate(vessel.commands):
        past = [commands[i]]
        if name not in vessel.delayed_commands:
            slow.append(commands[i])
            continue
        for before in range(1, whole + 1 + (share > 0)):
            symbol = ca.SX.sym("before")
            remembered.append((Memory(name, before), symbol, past[-1], commands[i]))
            past.append(symbol)
        slow.append(share * past[whole + 1] + (1 - share) * past[whole] if share else past[whole])

    if late.rate_on is not None and late.rate_limit is not None:
        i, most = vessel.commands.index(late.rate_on), late.rate_limit * sample_time
        symbol = ca.SX.sym("limited")
        way = ca.fmin(ca.fmax(slow[i] - symbol, -most), most)
        slow[i] = symbol + way - way * ca.fabs(way) / (2 * most)
        limited = Memory(late.rate_on, 0, limited=True)
        remembered.append((limited, symbol, symbol + way, commands[i]))

    def follow(name: str, value: ca.SX, at_rest: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Return what acts during the sample, and at an instant."""
        samples = late.lag / sample_time
        symbol = ca.SX.sym("lagged")
        moved = value + (symbol - value) * decay(samples)
        remembered.append((Memory(name, 0), symbol, moved, at_rest))
        rate.append((value - symbol) / late.lag)
        return value + (symbol - value) * held_share(samples, late.lag_held), symbol

    inputs = tuple(inputs)

    def forces(of: Iterable[ca.SX]) -> dict[str, ca.SX]:
        made = force_expressions(vessel, column(of))
        return {n: made.get(n, ca.SX(0)) for n in inputs}

    acting, instant = list(slow), list(slow)
    for i, name in enumerate(vessel.commands):
        if name in vessel.lagged_commands:
            acting[i], instant[i] = follow(name, slow[i], commands[i])
    made, at_instant = forces(acting), forces(instant)
    if late.lag and late.lag_on == "force":
        for name, at_rest in forces(ca.vertsplit(commands)).items():
            if not made[name].is_constant():
                made[name], at_instant[name] = follow(name, made[name], at_rest)
    memory, symbols, later, rest = zip(*remembered, strict=True) if remembered else ((),) * 4
    return Actuators(
        tuple(memory), column(symbols), made, column(later), column(rest),
        None if without_rate(late) else column(rate), at_instant,
    )  # fmt: skip


def without_rate(late: Actuation) -> str:
    """Return what has no rate in continuous time, as a verb and its object; or nothing."""
    if late.delay:
        return f"delays its commands by {late.delay:g} s"
    if late.rate_limit is not None:
        return f"limits the rate of {late.rate_on} from sample to sample"
    return ""


def column(parts: Iterable[ca.SX]) -> ca.SX:
    """Return expressions below one another, (0, 1) where there are none."""
    return ca.vertcat(ca.SX(0, 1), *parts)
