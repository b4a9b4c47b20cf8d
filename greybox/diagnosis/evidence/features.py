"""Functions of motion, commands, heading and time that a generic force is made of.

In the mirror of port and starboard each becomes itself or another, with its sign or the opposite:
that of a thruster becomes that of the one on the other side.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.fitting import Problem
from greybox.diagnosis.point import Fit
from greybox.diagnosis.ship import LogRun, shifted, wired
from greybox.model.terms import mirror_sign
from greybox.rotation import ned_to_body
from greybox.vessel.vessel import Thruster, Vessel

Array = NDArray[np.float64]

# seconds by which past commands are late
_LAGS = (2.0, 5.0, 10.0)
# quantiles of a state's size from which on a force may begin
_KNOTS = (0.3, 0.6, 0.85)
# cosine of an angle that counts as sideways
_SIDEWAYS = 1e-9
# what no smooth force of motion and present commands is a function of
HEADING, TIME, PAST, AIR = "heading", "time", "past commands", "air"


@dataclass(frozen=True)
class Features:
    """Functions of what is simulated and commanded.

    Parameters
    ----------
    values : ndarray
        (N, G)
    arguments : tuple of frozenset of str
        (G,) signals that each is a function of: states, columns of commands, and `HEADING`,
        `TIME`, `PAST`, and `AIR` where the velocity through it was measured.
    signs, images : ndarray
        (G,) in the mirror each becomes the one at its index here, times its sign; the sign is 0
        where it has no image.
    """

    values: Array
    arguments: tuple[frozenset[str], ...]
    signs: Array
    images: NDArray[np.intp]


def knots_of(problem: Problem) -> Array:
    """Return sizes of each state from which on a force may begin, (nx, K)."""
    nx = len(problem.runs[0].states)
    size = np.abs(np.concatenate([run.y[:, :nx] for run in problem.runs]))
    return np.asarray(np.quantile(size, _KNOTS, axis=0).T)


def through_water(run: LogRun, fit: Fit, x: Array) -> Array:
    """Return states (N, nx) with the velocities through the water in the place of those over it."""
    current = fit.point.ship.current
    names = run.states
    if not current.any() or "u" not in names or "v" not in names:
        return x
    moved = x.copy()
    along, across = ned_to_body(float(current[0]), float(current[1]), run.heading)
    moved[:, names.index("u")] -= along
    moved[:, names.index("v")] -= across
    return moved


def features(run: LogRun, fit: Fit, start: Array, knots: Array) -> Features:
    """Return the functions that a generic force is made of, along a free run."""
    ship = fit.point.ship
    x = through_water(run, fit, run.run(ship, start).x)
    tau = run.forces(ship.vessel, ship.wires)
    log = run.log
    columns: list[Array] = []
    arguments: list[frozenset[str]] = []
    signs: list[int] = []
    images: dict[int, int] = {}

    def add(value: Array, sign: int, *of: str) -> None:
        columns.append(value)
        signs.append(sign)
        arguments.append(frozenset(of))

    names = run.states
    add(np.ones(len(x)), 1)
    states = list(x.T)
    own_signs = [mirror_sign(name) for name in names]
    for i, one in enumerate(states):
        add(one, own_signs[i], names[i])
        for j, two in enumerate(states[i:], i):
            add(one * two, own_signs[i] * own_signs[j], names[i], names[j])
            add(np.abs(one) * two, own_signs[j], names[i], names[j])
            if two is not one:
                add(one * np.abs(two), own_signs[i], names[i], names[j])
        add(one**3, own_signs[i], names[i])
        for knot in knots[i]:
            beyond = np.maximum(np.abs(one) - knot, 0.0)
            add(beyond, 1, names[i])
            add(beyond * np.sign(one), own_signs[i], names[i])
    commands = wired({c: log[c] for c in log.vessel.commands}, ship.wires)
    mirrored, spans = _images(log.vessel), []
    for thruster, image in zip(log.vessel.thrusters, mirrored, strict=True):
        begins = len(columns)
        n = commands[thruster.speed]
        angle = thruster.steered_by
        turned = commands[angle] if angle is not None else np.zeros(len(x))
        own = thruster.columns
        # in the mirror a tunnel's propeller turns the other way
        turns, there = (-1 if _across(thruster) else 1), int(image is not None)
        for push, sign in ((np.ones(len(x)), 1), (n, turns), (n * np.abs(n), turns)):
            add(push * np.cos(turned), there * sign, *own)
            add(push * np.sin(turned), -there * sign, *own)
        add(np.sign(n), there * turns, thruster.speed)
        spans.append(range(begins, len(columns)))
    for span, image in zip(spans, mirrored, strict=True):
        if image is not None:
            images |= zip(span, spans[image], strict=True)
    forces = [mirror_sign(name) for name in run.structure.inputs]
    for force, sign in zip(tau.T, forces, strict=True):
        for name, state in zip(names, states, strict=True):
            add(force * state, sign * mirror_sign(name), name, *commands)
        for lag in _LAGS:
            add(shifted(force, lag / run.sample_time), sign, PAST)
    psi = log["psi"] if "psi" in log else np.zeros(len(x))
    for k in (1, 2):
        add(np.cos(k * psi), 0, HEADING)
        add(np.sin(k * psi), 0, HEADING)
    add(states[0] * np.cos(psi), 0, HEADING)
    add(states[0] * np.sin(psi), 0, HEADING)
    air = log.air if run.air_measured else None
    if air is not None:
        ahead, abeam = air.T
        for value, sign in (
            (ahead, 1), (abeam, -1), (np.abs(ahead) * ahead, 1), (np.abs(abeam) * abeam, -1),
            (np.abs(ahead) * abeam, -1), (ahead * abeam, -1), (np.abs(abeam) * ahead, 1),
        ):  # fmt: skip
            add(value, sign, AIR)
    later = run.time > run.duration / 2
    for column, sign in zip((*states, *tau.T), (*own_signs, *forces), strict=True):
        add(later * column, sign, TIME)
    return Features(
        np.column_stack(columns), tuple(arguments), np.array(signs, float),
        np.array([images.get(k, k) for k in range(len(columns))]),
    )  # fmt: skip


def _across(thruster: Thruster) -> bool:
    """Return whether a thruster that cannot be steered pushes sideways."""
    if thruster.type == "tunnel":
        return True
    return isinstance(thruster.angle, float) and abs(cos(thruster.angle)) < _SIDEWAYS


def _images(vessel: Vessel) -> list[int | None]:
    """Return the index of each thruster's image in the mirror: its own on the centreline."""
    places = [(t.type, round(t.x, 6), round(t.y, 6) + 0.0) for t in vessel.thrusters]
    mirrored = [(kind, x, -y + 0.0) for kind, x, y in places]
    # of two at one place neither has an image of its own
    return [places.index(m) if places.count(m) == 1 else None for m in mirrored]
