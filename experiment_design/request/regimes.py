"""Where a trial can be held: steady motions, the signs that they keep, and starts of trials."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from experiment_design.request.request import PreparedRequest
from greybox.channels import CHANNELS
from greybox.errors import UsageError

Array = NDArray[np.float64]
Signs = tuple[tuple[str, int], ...]

# in which a ship settles to constant commands [s]
STEADY_SECONDS = 400.0
_MOST = 729


@dataclass(frozen=True)
class Steady:
    """Motions that constant commands settle to.

    Parameters
    ----------
    unit : ndarray
        (S, nc) commands in unit coordinates.
    commands : ndarray
        (S, nc) the same in the log's unit, angles [rad].
    x : ndarray
        (S, nx) states [m/s, rad/s].
    diameter : ndarray
        (S,) diameter of the circle that is run, inf on a straight course [m].
    unstable : int
        Commands that the model did not settle under.
    """

    unit: Array
    commands: Array
    x: Array
    diameter: Array
    unstable: int


@dataclass(frozen=True)
class Start:
    """Where a trial begins, and the constant commands that hold the ship there.

    Parameters
    ----------
    state : ndarray
        (nx + 1,) states [m/s, rad/s] and heading [rad].
    commands : ndarray or None
        (nc,) in the log's unit, angles [rad]; None where none are known.
    """

    state: Array
    commands: Array | None = None


def steady_motions(request: PreparedRequest, start: Array | None = None) -> Steady:
    """Run constant commands on a grid of the limits until the motion has settled.

    Parameters
    ----------
    request : PreparedRequest
    start : ndarray, optional
        (nx + 1,) initial states and heading; by default nearly at rest.
    """
    schedule, structure = request.schedule, request.structure
    commands = len(schedule.commands)
    levels = next((n for n in (5, 3, 2) if n**commands <= _MOST), 2)
    grid = np.array(list(product(np.linspace(0, 1, levels), repeat=min(commands, 9))))[:_MOST]
    if commands > 9:
        grid = np.hstack([grid, np.full((len(grid), commands - 9), 0.5)])
    samples = round(STEADY_SECONDS / schedule.sample_time)
    values = schedule.lower + (schedule.upper - schedule.lower) * grid
    rest = np.zeros(len(structure.states) + 1)
    rest[0] = 0.1
    rollout = request.rollout(rest if start is None else start)
    motion = rollout.run(np.repeat(values[:, None], samples, axis=1))
    nx = rollout.nx
    x = motion.state[:, -1, :nx]
    good = motion.stable
    speed = np.hypot(x[:, 0], x[:, 1] if nx > 1 else 0.0)
    rate = np.abs(x[:, structure.states.index("r")]) if "r" in structure.states else 0 * speed
    with np.errstate(divide="ignore"):
        diameter = np.where(rate > 1e-6, 2 * speed / np.maximum(rate, 1e-12), np.inf)
    return Steady(grid[good], values[good], x[good], diameter[good], int((~good).sum()))


def parse_regime(text: str, states: tuple[str, ...]) -> Signs:
    """Return the signs that a text such as ``u+v-`` names.

    Raises
    ------
    UsageError
        It cannot be read, or names a state that the model lacks.
    """
    signs: list[tuple[str, int]] = []
    rest = text.replace(" ", "")
    if not rest:
        raise UsageError("the regime is empty: write states and signs such as u+v+, or auto.")
    while rest:
        if len(rest) < 2 or rest[1] not in "+-":
            raise UsageError(
                f"the regime '{text}' cannot be read at '{rest}': write states and signs such as "
                f"u+v+, or auto."
            )
        if rest[0] not in states:
            raise UsageError(
                f"the regime '{text}' names '{rest[0]}', and this model has {', '.join(states)}: "
                f"write their signs, such as u+v+, or auto."
            )
        if rest[0] in dict(signs):
            raise UsageError(f"the regime '{text}' names '{rest[0]}' twice: name it once.")
        signs.append((rest[0], 1 if rest[1] == "+" else -1))
        rest = rest[2:]
    return tuple(signs)


def spell_regime(signs: Signs) -> str:
    """Return a regime as text, such as ``u+v-``."""
    return "".join(f"{s}{'+' if v > 0 else '-'}" for s, v in signs) or "any"


def candidate_regimes(states: tuple[str, ...]) -> list[Signs]:
    """Return the sign regimes of the velocities whose moduli the thesis keeps from zero."""
    named = [s for s in ("u", "v") if s in states]
    return [tuple(zip(named, signs, strict=True)) for signs in product((1, -1), repeat=len(named))]


def steady_start(
    steady: Steady,
    states: tuple[str, ...],
    signs: Signs,
    margins: dict[str, float],
    caps: tuple[float | None, float | None] = (None, None),
) -> Start | None:
    """Return a steady motion well inside a regime, with heading 0; None where none is.

    Of those a fifth beyond the margins and a tenth below the caps the one of the
    most moderate commands; else the one that lies deepest in the regime.

    Parameters
    ----------
    caps : (float, float)
        Largest speed [m/s] and rate of turn [rad/s], None where there is none.
    """
    if not len(steady.x):
        return None
    depth = np.full(len(steady.x), np.inf)
    for s, v in signs:
        reached = steady.x[:, states.index(s)] * v / max(margins.get(s, 0.0), 0.05)
        depth = np.minimum(depth, reached)
    speed = np.hypot(steady.x[:, 0], steady.x[:, states.index("v")] if "v" in states else 0.0)
    below = np.ones(len(steady.x), bool)
    if caps[0] is not None:
        below &= speed <= 0.9 * caps[0]
    if caps[1] is not None and "r" in states:
        below &= np.abs(steady.x[:, states.index("r")]) <= 0.9 * caps[1]
    moderate = np.abs(steady.unit - 0.5).sum(axis=1)
    inside = below & (depth >= 1.2)
    if inside.any():
        best = int(np.where(inside, moderate, np.inf).argmin())
        return Start(np.append(steady.x[best], 0.0), steady.commands[best])
    if below.any():
        depth = np.where(below, depth, -np.inf)
    best = int(depth.argmax())
    if depth[best] <= 0:
        return None
    return Start(np.append(steady.x[best], 0.0), steady.commands[best])


def state_words(states: tuple[str, ...], start: Array) -> str:
    """Return initial states and heading (nx + 1,) with their units."""
    # what rounding leaves of zero is no motion
    return ", ".join(
        f"{n} {round(float(x), 4) + 0.0:.3g} {CHANNELS[n].unit}"
        for n, x in zip((*states, "psi"), start, strict=True)
    )


def start_words(request: PreparedRequest, trial: int) -> str:
    """Return the start of a trial, and the commands that hold the ship there, where known."""
    said = state_words(request.structure.states, request.starts[trial])
    held = request.commands_at_start(trial)
    if held is None:
        return said
    angles = request.vessel.angle_commands
    shown = ", ".join(f"{n} {x:.4g}{' rad' if n in angles else ''}" for n, x in held.items())
    return f"{said}, held by {shown}"
