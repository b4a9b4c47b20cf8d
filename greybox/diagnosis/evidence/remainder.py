"""A generic force beside the structure: smooth functions that push each equation.

Ridge regression fits them to the innovations of the estimation logs, their strength by
marginal likelihood; what it then predicts on held-out logs is a fault of the model and not
the sea's own noise. Of motion through the water and of present commands it is the rival of
every cause: what it explains as well has no name yet. Heading, time and past commands are for
the test whether anything is left at all.

References
----------
Tikhonov and Arsenin (1977); MacKay (1992), section 4, on the evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.evidence.held_out import Pair
from greybox.diagnosis.fitting import Problem
from greybox.diagnosis.linear import NOWHERE, sensitivities
from greybox.diagnosis.point import Fit
from greybox.diagnosis.ship import LogRun, shifted, wired
from greybox.numerics.lagged_moments import correlation_factor
from greybox.numerics.linalg import tall_svd
from greybox.rotation import ned_to_body

Array = NDArray[np.float64]
# of a state and the signals that a feature is a function of: whether it takes part
Use = Callable[[str, frozenset[str]], bool]

# prior deviations of a direction's share, in innovations' deviations, that are tried
_STRENGTHS = np.geomspace(0.05, 100.0, 24)
# seconds by which past commands are late
_LAGS = (2.0, 5.0, 10.0)
# quantiles of a state's size from which on a force may begin
_KNOTS = (0.3, 0.6, 0.85)
# singular values of the nuisance, and squares of the force's, as a share of the largest, below
# which a direction is not known
_UNKNOWN = 1e-8
# what no smooth force of motion and present commands is a function of
HEADING, TIME, PAST = "heading", "time", "past commands"
_OTHERS = frozenset({HEADING, TIME, PAST})


@dataclass(frozen=True)
class Features:
    """Functions of what is simulated and commanded.

    Parameters
    ----------
    values : ndarray
        (N, G)
    arguments : tuple of frozenset of str
        (G,) signals that each is a function of: states, columns of commands, and `HEADING`,
        `TIME`, `PAST`.
    """

    values: Array
    arguments: tuple[frozenset[str], ...]


def anything(state: str, arguments: frozenset[str]) -> bool:
    """Take every feature in every equation."""
    return True


def motion_and_commands(state: str, arguments: frozenset[str]) -> bool:
    """Take functions of motion through the water and of present commands."""
    return not arguments & _OTHERS


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

    def add(value: Array, *of: str) -> None:
        columns.append(value)
        arguments.append(frozenset(of))

    names = run.states
    add(np.ones(len(x)))
    states = list(x.T)
    for i, one in enumerate(states):
        add(one, names[i])
        for j, two in enumerate(states[i:], i):
            add(one * two, names[i], names[j])
            add(np.abs(one) * two, names[i], names[j])
            if two is not one:
                add(one * np.abs(two), names[i], names[j])
        add(one**3, names[i])
        for knot in knots[i]:
            beyond = np.maximum(np.abs(one) - knot, 0.0)
            add(beyond, names[i])
            add(beyond * np.sign(one), names[i])
    commands = wired({c: log[c] for c in log.vessel.commands}, ship.wires)
    for thruster in log.vessel.thrusters:
        n = commands[thruster.speed]
        angle = thruster.angle if isinstance(thruster.angle, str) else thruster.rudder
        turned = commands[angle] if angle is not None else np.zeros(len(x))
        own = (thruster.speed,) if angle is None else (thruster.speed, angle)
        for push in (np.ones(len(x)), n, n * np.abs(n)):
            add(push * np.cos(turned), *own)
            add(push * np.sin(turned), *own)
        add(np.sign(n), thruster.speed)
    for force in tau.T:
        for name, state in zip(names, states, strict=True):
            add(force * state, name, *commands)
        for lag in _LAGS:
            add(shifted(force, lag / run.sample_time), PAST)
    psi = log["psi"] if "psi" in log else np.zeros(len(x))
    for k in (1, 2):
        add(np.cos(k * psi), HEADING)
        add(np.sin(k * psi), HEADING)
    add(states[0] * np.cos(psi), HEADING)
    add(states[0] * np.sin(psi), HEADING)
    later = run.time > run.time[-1] / 2
    for column in (*states, *tau.T):
        add(later * column, TIME)
    return Features(np.column_stack(columns), tuple(arguments))


@dataclass(frozen=True)
class GenericForce:
    """A generic force fitted beside a hypothesis, and what it says of the held-out logs.

    Parameters
    ----------
    predicted : ndarray
        Whitened held-out errors that it predicts, raveled; what the starts can imitate taken out.
    seen : ndarray
        Those that are there.
    errors : tuple of ndarray
        (N, ny) held-out errors without what it predicts.
    moved : ndarray
        How far the hypothesis's free numbers move when it joins, starts apart.
    """

    predicted: Array
    seen: Array
    errors: tuple[Array, ...]
    moved: Array


def generic_force(pair: Pair, use: Use = motion_and_commands) -> GenericForce:
    """Fit a generic force to what a hypothesis leaves, and run it on the held-out logs.

    Parameters
    ----------
    pair : Pair
        Whose runs stay bounded; computed once for each use.
    use : callable
        Which features push which equation.
    """
    fit_generic_forces(pair, [use])
    found: GenericForce = pair.known[use]
    return found


def fit_generic_forces(pair: Pair, uses: Sequence[Use]) -> None:
    """Fit several generic forces at once, which share what they stand beside.

    Parameters
    ----------
    pair : Pair
        Whose runs stay bounded; `generic_force` returns what was found.
    uses : sequence of callable
        Which features push which equation, in each of them.
    """
    asked = [use for use in uses if use not in pair.known]
    if asked:
        pair.known.update(zip(asked, _generic_forces(pair, asked), strict=True))


def _generic_forces(pair: Pair, uses: Sequence[Use]) -> list[GenericForce]:
    problem, fit, held, held_fit = pair.problem, pair.fit, pair.held, pair.held_fit
    nuisance = _stacked(problem.rows(fit.point, fit.noise))
    free = nuisance.shape[1] - sum(map(len, fit.point.starts))
    with np.errstate(over="ignore", invalid="ignore"):
        scale = np.sqrt((nuisance**2).sum(axis=0))
    scale[scale == 0] = 1.0
    seen = np.concatenate([n.ravel() for n in held_fit.nu])
    # a run at the edge of stability has no derivatives
    none = GenericForce(np.zeros_like(seen), seen, held_fit.errors, np.zeros(free))
    if not np.isfinite(scale).all():
        return [none for _ in uses]
    left, values, right = tall_svd(nuisance / scale, _UNKNOWN)

    def any_of(state: str, arguments: frozenset[str]) -> bool:
        return any(use(state, arguments) for use in uses)

    knots = knots_of(problem)
    pushed, scales, pushing = _pushed(problem, fit, knots, any_of, None)
    raw = _stacked([fit.noise.whiten(c) for c in pushed])
    with np.errstate(over="ignore"):
        size = np.sqrt((raw**2).sum(axis=0))
    if not np.isfinite(size).all():
        return [none for _ in uses]
    size[size == 0] = 1.0
    raw /= size
    along = left.T @ raw
    nu = np.concatenate([n.ravel() for n in fit.nu])
    # of errors with a memory fewer tell anything new
    alike = np.sqrt(correlation_factor(np.concatenate(fit.nu)))
    raw -= left @ along
    raw /= alike
    nu = (nu - left @ (left.T @ nu)) / alike
    moved, _, _ = _pushed(held, held_fit, knots, any_of, scales)
    point = replace(fit.point, starts=held_fit.point.starts)
    noise = held_fit.noise
    with np.errstate(over="ignore", invalid="ignore"):
        shown = held.slopes(point)
        begun = held.slopes(held_fit.point)
        starts = _stacked([noise.whiten(s) for s in begun])
    out = []
    for use in uses:
        mine = [k for k, of in enumerate(pushing) if use(*of)]
        delta = np.zeros(len(pushing))
        delta[mine] = _ridge(raw[:, mine], nu)
        # what the coefficients give back, where they can imitate
        back = (-((right.T / values) @ (along @ delta)) / scale)[:free]
        with np.errstate(over="ignore", invalid="ignore"):
            parts = [
                columns @ (delta / size) + slopes[:, :, :free] @ back
                for columns, slopes in zip(moved, shown, strict=True)
            ]
            whitened = _stacked([noise.whiten(p[:, :, None]) for p in parts])[:, 0]
        if not (np.isfinite(whitened).all() and np.isfinite(starts).all()):
            out.append(none)
            continue
        taken = np.linalg.lstsq(starts, whitened, rcond=_UNKNOWN)[0]
        errors = tuple(
            e - (part - slopes @ taken)
            for e, part, slopes in zip(held_fit.errors, parts, begun, strict=True)
        )
        out.append(GenericForce(whitened - starts @ taken, seen, errors, back))
    return out


def contributions_beside(pair: Pair, use: Use = motion_and_commands) -> Array:
    """Return what each held-out sample adds to −2 log L with a generic force beside, (N,)."""
    held, held_fit = pair.held, pair.held_fit
    errors = generic_force(pair, use).errors
    noise = held.noise_of(errors, held_fit.point, held_fit.noise)
    nu, _ = held.whitened(noise, errors)
    return np.concatenate(held.added(nu, noise))


def _pushed(
    problem: Problem, fit: Fit, knots: Array, use: Use, scales: Array | None
) -> tuple[list[Array], Array, list[tuple[str, frozenset[str]]]]:
    """Return ∂y of every feature in every equation that it pushes, and the features' sizes.

    And of each derivative the equation, and the signals that its feature is a function of.
    """
    point = fit.point
    ship = point.ship
    made = [features(r, fit, s, knots) for r, s in zip(problem.runs, point.starts, strict=True)]
    if scales is None:
        scales = np.sqrt(np.mean(np.concatenate([m.values**2 for m in made]), axis=0))
        scales = np.where(scales > 0, scales, 1.0)
    states, arguments = problem.structure.states, made[0].arguments
    wanted = [[k for k, of in enumerate(arguments) if use(state, of)] for state in states]
    pushing = [
        (state, arguments[k]) for state, mine in zip(states, wanted, strict=True) for k in mine
    ]
    out = []
    for run, start, g in zip(problem.runs, point.starts, made, strict=True):
        shown = run.run(ship, start)
        linear = run.linearise(ship, shown, NOWHERE)
        unit = g.values[:-1] / scales
        driven = np.zeros((len(unit), shown.x.shape[1], sum(map(len, wanted))))
        first = 0
        for i, mine in enumerate(wanted):
            driven[:, i, first : first + len(mine)] = unit[:, mine]
            first += len(mine)
        slope = sensitivities(replace(linear, driven=driven))
        out.append(run.seen(ship, slope)[:, :, : driven.shape[2]])
    return out, scales, pushing


def _stacked(parts: Sequence[Array]) -> Array:
    return np.concatenate([p.reshape(-1, p.shape[2]) for p in parts])


def _ridge(rows: Array, nu: Array) -> Array:
    """Return coefficients (m,) by the strength that makes the innovations likeliest."""
    squares, vectors = np.linalg.eigh(rows.T @ rows)
    known = squares > _UNKNOWN * squares[-1]
    values, right = np.sqrt(squares[known]), vectors[:, known].T
    share = right @ (rows.T @ nu) / values
    best, chosen = np.inf, _STRENGTHS[0]
    for strength in _STRENGTHS:
        grown = 1 + (strength * values) ** 2
        # −2 log of the marginal likelihood, constants apart
        cost = float((share**2 / grown).sum() + np.log(grown).sum())
        if cost < best:
            best, chosen = cost, strength
    shrunk = chosen**2 * values / (1 + (chosen * values) ** 2)
    return np.asarray(right.T @ (shrunk * share))
