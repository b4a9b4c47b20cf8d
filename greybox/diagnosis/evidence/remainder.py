"""A generic force beside the structure: smooth functions that push each equation.

Ridge regression fits them to the innovations of the estimation logs, their strength by
marginal likelihood: one of forces that keep the ship's symmetry of port and starboard, and one of
those that break it, which hulls hardly do. What it then predicts on held-out logs is a fault of
the model and not the sea's own noise. Of motion through the water and of present commands it is
the rival of every cause: what it explains as well has no name yet. Heading, time and past
commands are for the test whether anything is left at all.

References
----------
Tikhonov and Arsenin (1977); MacKay (1992), section 4, on the evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.evidence.features import (
    AIR,
    HEADING,
    PAST,
    TIME,
    Features,
    features,
    knots_of,
)
from greybox.diagnosis.evidence.held_out import Pair
from greybox.diagnosis.fitting import Problem, stacked
from greybox.diagnosis.linear import NOWHERE
from greybox.diagnosis.point import Fit
from greybox.model.terms import mirror_sign
from greybox.numerics.lagged_moments import correlation_factor
from greybox.numerics.linalg import tall_svd
from greybox.numerics.recursion import propagate

Array = NDArray[np.float64]
# of a state and the signals that a feature is a function of: whether it takes part
Takes = Callable[[str, frozenset[str]], bool]

# prior deviations of a direction's share, in innovations' deviations, that are tried
_STRENGTHS = np.geomspace(0.05, 100.0, 24)
# those of forces that break the symmetry of port and starboard, as a share of those that keep it
_BROKEN = (0.01, 0.1, 0.3, 1.0, 3.0)
# singular values of the nuisance, and squares of the force's, as a share of the largest, below
# which a direction is not known
_UNKNOWN = 1e-8
# what no smooth force of motion and present commands is a function of
_OTHERS = frozenset({HEADING, TIME, PAST, AIR})


@dataclass(frozen=True)
class Use:
    """Which features push which equation.

    Parameters
    ----------
    takes : callable
        Of a state and a feature's arguments: whether it takes part.
    parity : {0, 1, -1}
        Forces that keep the symmetry of port and starboard alone (1), those that break it alone
        (-1), or both (0).
    """

    takes: Takes
    parity: int = 0


# every feature but those of the air in every equation
ANYTHING = Use(lambda state, arguments: AIR not in arguments)
# functions of motion through the water and of present commands
MOTION_AND_COMMANDS = Use(lambda state, arguments: not arguments & _OTHERS)
# those, and of the velocity through the air: a steady wind pushes as a current does
MOTION_AIR_AND_COMMANDS = Use(lambda state, arguments: not arguments & (_OTHERS - {AIR}))


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


def generic_force(pair: Pair, use: Use = MOTION_AND_COMMANDS) -> GenericForce:
    """Fit a generic force to what a hypothesis leaves, and run it on the held-out logs.

    Parameters
    ----------
    pair : Pair
        Whose runs stay bounded; computed once for each use.
    use : Use
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
    uses : sequence of Use
    """
    asked = [use for use in uses if use not in pair.known]
    if asked:
        pair.known.update(zip(asked, _generic_forces(pair, asked), strict=True))


@dataclass(frozen=True)
class Rival:
    """What stands beside a generic force, and that force, along the logs of a fit.

    Parameters
    ----------
    rows : tuple of ndarray
        (N, ny, m) whitened, what each force alone does to the errors of each log.
    pushers : _Pushers
        What these m are.
    knots : ndarray
        See `knots_of`.
    left, values, right, scale : ndarray
        Directions (n, q) of the fit's free numbers in whitened errors, starts counted, and how
        they are made of them.
    size : ndarray
        (m,) that each force is divided by.
    square, along, toward : ndarray
        (m, m), (q, m) and (m,) products of the forces with each other, with those directions, and
        with the errors; the first and the last without what the directions take.
    alike : float
        Samples of errors that tell as much as one: those products are divided by it.
    errors : ndarray
        (n,) whitened.
    """

    rows: tuple[Array, ...]
    pushers: _Pushers
    knots: Array
    left: Array
    values: Array
    right: Array
    scale: Array
    size: Array
    square: Array
    along: Array
    toward: Array
    alike: float
    errors: Array

    def likeliest(self, use: Use) -> tuple[Array, Array]:
        """Return prior deviations (m, k) and shares (m,) of forces, as likely as can be."""
        mine = self.pushers.used(use)
        deviations, shares = np.zeros((len(self.size), len(mine))), np.zeros(len(self.size))
        square = self.square[np.ix_(mine, mine)]
        deviations[mine], shares[mine] = _likeliest(square, self.toward[mine], self.pushers, use)
        return deviations, shares

    def taking(self, use: Use = MOTION_AND_COMMANDS) -> Takings:
        """Return what the free numbers and a generic force take of errors."""
        deviations, _ = self.likeliest(use)
        inner = np.eye(deviations.shape[1]) + deviations.T @ self.square @ deviations
        root = np.linalg.solve(np.linalg.cholesky(inner), deviations.T) / np.sqrt(self.alike)
        ends = np.cumsum([0, *(part.shape[0] * part.shape[1] for part in self.rows)])
        lefts = tuple(self.left[one:two] for one, two in pairwise(ends))
        own = np.concatenate([self.left.T @ self.errors, root @ self.toward * self.alike])
        return Takings(self.rows, lefts, root / self.size, self.along.T * self.size[:, None], own)


@dataclass(frozen=True)
class Takings:
    """What a fit's free numbers and a generic force take of whitened errors, log by log.

    Of a product of two columns is left what the product of their shares does not take.

    Parameters
    ----------
    rows, lefts : tuple of ndarray
        (N, ny, m) and (n, q) of each log, see `Rival`.
    root : ndarray
        (k, m) of the force's prior.
    along : ndarray
        (m, q) products of forces and directions, of all logs.
    own : ndarray
        (q + k,) shares of the errors.
    """

    rows: tuple[Array, ...]
    lefts: tuple[Array, ...]
    root: Array
    along: Array
    own: Array

    def shares(self, log: int, columns: Array) -> Array:
        """Return the shares (q + k, c) of whitened columns (N, ny, c) of one log."""
        flat = columns.reshape(-1, columns.shape[2])
        free = self.lefts[log].T @ flat
        by_channel = zip(self.rows[log].transpose(1, 2, 0), columns.transpose(1, 0, 2), strict=True)
        force = sum(f @ c for f, c in by_channel) - self.along @ free
        return np.vstack([free, self.root @ force])


def rival(problem: Problem, fit: Fit, uses: Sequence[Use]) -> Rival | None:
    """Return what a generic force does along the logs of a fit.

    None at the edge of stability, where a run has no derivatives.
    """
    nuisance = stacked(problem.rows(fit.point, fit.noise))
    with np.errstate(over="ignore", invalid="ignore"):
        scale = np.sqrt((nuisance**2).sum(axis=0))
    scale[scale == 0] = 1.0
    if not np.isfinite(scale).all():
        return None
    left, values, right = tall_svd(nuisance / scale, _UNKNOWN)

    def any_of(state: str, arguments: frozenset[str]) -> bool:
        return any(use.takes(state, arguments) for use in uses)

    knots = knots_of(problem)
    nx, made = len(problem.structure.states), _features(problem, fit, knots)
    pushers = _Pushers.of(made, problem.structure.states, any_of)
    errors = stacked(fit.nu)
    nu = errors - left @ (left.T @ errors)
    pushed = _pushed(problem, fit, [pushers.alone(m, nx) for m in made])
    whitened = problem.whiten(fit.noise, pushed)
    square, across = _products(whitened, np.column_stack([left, nu]))
    if not np.isfinite(square).all():
        return None
    size = np.sqrt(np.diag(square))
    size[size == 0] = 1.0
    size = np.sqrt((size**2 + size[pushers.images] ** 2) / 2)
    along, toward = (across[:, :-1] / size[:, None]).T, across[:, -1] / size
    # of errors with a memory fewer tell anything new
    alike = correlation_factor(np.concatenate(fit.nu))
    square = (square / np.outer(size, size) - along.T @ along) / alike
    return Rival(
        tuple(whitened), pushers, knots, left, values, right, scale, size, square, along,
        toward / alike, alike, errors,
    )  # fmt: skip


def _generic_forces(pair: Pair, uses: Sequence[Use]) -> list[GenericForce]:
    problem, fit, held, held_fit = pair.problem, pair.fit, pair.held, pair.held_fit
    free = len(fit.point.vector()) - sum(map(len, fit.point.starts))
    seen = stacked(held_fit.nu)
    none = GenericForce(np.zeros_like(seen), seen, held_fit.errors, np.zeros(free))
    beside = rival(problem, fit, uses)
    if beside is None:
        return [none for _ in uses]
    pushers, knots, size, nx = beside.pushers, beside.knots, beside.size, len(held.structure.states)
    deltas = np.column_stack([beside.likeliest(use)[1] for use in uses])
    there = _features(held, held_fit, knots)
    moved = _pushed(
        held, held_fit, [pushers.together(m, nx, deltas / size[:, None]) for m in there]
    )
    point = replace(fit.point, starts=held_fit.point.starts)
    noise = held_fit.noise
    with np.errstate(over="ignore", invalid="ignore"):
        shown = held.slopes(point)
        begun = held.slopes(held_fit.point)
        starts = stacked(held.whiten(noise, begun))
    out = []
    for k, delta in enumerate(deltas.T):
        # what the coefficients give back, where they can imitate
        back = (-((beside.right.T / beside.values) @ (beside.along @ delta)) / beside.scale)[:free]
        with np.errstate(over="ignore", invalid="ignore"):
            parts = [
                columns[:, :, k] + slopes[:, :, :free] @ back
                for columns, slopes in zip(moved, shown, strict=True)
            ]
            predicted = stacked(held.whiten(noise, [p[:, :, None] for p in parts]))[:, 0]
        if not (np.isfinite(predicted).all() and np.isfinite(starts).all()):
            out.append(none)
            continue
        taken = np.linalg.lstsq(starts, predicted, rcond=_UNKNOWN)[0]
        errors = tuple(
            e - (part - slopes @ taken)
            for e, part, slopes in zip(held_fit.errors, parts, begun, strict=True)
        )
        out.append(GenericForce(predicted - starts @ taken, seen, errors, back))
    return out


def contributions_beside(pair: Pair, use: Use = MOTION_AND_COMMANDS) -> Array:
    """Return what each held-out sample adds to −2 log L with a generic force beside, (N,)."""
    held, held_fit = pair.held, pair.held_fit
    errors = generic_force(pair, use).errors
    noise = held.noise_of(errors, held_fit.point, held_fit.noise)
    nu, _ = held.whitened(noise, errors)
    return np.concatenate(held.added(nu, noise))


@dataclass(frozen=True)
class _Pushers:
    """What pushes: features in equations, m of them.

    Parameters
    ----------
    scales : ndarray
        (G,) sizes of the features.
    columns : tuple of (int, int)
        (m,) the equation's and the feature's index.
    pushing : tuple of (str, frozenset of str)
        (m,) the equation, and the signals that the feature is a function of.
    signs, images : ndarray
        (m,) in the mirror each column becomes the one at its index here, times its sign; the sign
        is 0 where it has no image.
    """

    scales: Array
    columns: tuple[tuple[int, int], ...]
    pushing: tuple[tuple[str, frozenset[str]], ...]
    signs: Array
    images: NDArray[np.intp]

    @classmethod
    def of(cls, made: Sequence[Features], states: Sequence[str], takes: Takes) -> _Pushers:
        """Return all features of logs in every equation that they push."""
        scales = np.sqrt(np.mean(np.concatenate([m.values**2 for m in made]), axis=0))
        arguments = made[0].arguments
        columns = [
            (i, k)
            for i, state in enumerate(states)
            for k, of in enumerate(arguments)
            if takes(state, of)
        ]
        place = {column: at for at, column in enumerate(columns)}
        images = [place.get((i, int(made[0].images[k])), -1) for i, k in columns]
        signs = [
            mirror_sign(states[i]) * made[0].signs[k] if image >= 0 else 0.0
            for (i, k), image in zip(columns, images, strict=True)
        ]
        images = [at if image < 0 else image for at, image in enumerate(images)]
        pushing = tuple((states[i], arguments[k]) for i, k in columns)
        return cls(
            np.where(scales > 0, scales, 1.0), tuple(columns), pushing, np.array(signs),
            np.array(images, np.intp),
        )  # fmt: skip

    def alone(self, made: Features, equations: int) -> Array:
        """Return how each column alone pushes the equations along a log, (N−1, nx, m)."""
        unit = made.values[:-1] / self.scales
        out = np.zeros((len(unit), equations, len(self.columns)))
        for i in range(equations):
            mine = [(at, k) for at, (of, k) in enumerate(self.columns) if of == i]
            if mine:
                # those of an equation stand side by side
                out[:, i, mine[0][0] : mine[-1][0] + 1] = unit[:, [k for _, k in mine]]
        return out

    def together(self, made: Features, equations: int, shares: Array) -> Array:
        """Return how shares (m, c) of the columns push the equations, (N−1, nx, c)."""
        of_features = np.zeros((len(self.scales), equations, shares.shape[1]))
        for (i, k), share in zip(self.columns, shares, strict=True):
            of_features[k, i] = share / self.scales[k]
        return np.tensordot(made.values[:-1], of_features, 1)

    def used(self, use: Use) -> NDArray[np.intp]:
        """Return the indices of those that take part."""
        return np.array([k for k, of in enumerate(self.pushing) if use.takes(*of)], np.intp)

    def deviations(self, mine: NDArray[np.intp], kept: float, broken: float) -> Array:
        """Return a square root (k, k) of a prior covariance.

        Parameters
        ----------
        mine : ndarray of int
            (k,) those that take part.
        kept, broken : float
            Prior deviations of forces that keep the symmetry of port and starboard, and of those
            that break it.
        """
        place = np.full(len(self.signs), -1)
        place[mine] = np.arange(len(mine))
        image, sign = place[self.images[mine]], self.signs[mine]
        paired = (sign != 0) & (image >= 0)
        alone = np.sqrt((kept**2 + broken**2) / 2)
        root = np.diag(np.where(paired, (kept + broken) / 2, alone))
        where = np.flatnonzero(paired)
        root[where, image[where]] += sign[where] * (kept - broken) / 2
        return root


def _features(problem: Problem, fit: Fit, knots: Array) -> list[Features]:
    runs = zip(problem.runs, fit.point.starts, strict=True)
    return [features(run, fit, start, knots) for run, start in runs]


def _pushed(problem: Problem, fit: Fit, drives: Sequence[Array]) -> list[Array]:
    """Return ∂y (N, ny, m) of each log by what pushes its equations, (N−1, nx, m)."""
    ship, out = fit.point.ship, []
    for run, start, driven in zip(problem.runs, fit.point.starts, drives, strict=True):
        shown = run.run(ship, start)
        linear = run.linearise(ship, shown, NOWHERE)
        slope = propagate(linear.a, driven, np.zeros(driven.shape[1:]))
        out.append(run.seen(ship, slope)[:, :, : driven.shape[2]])
    return out


def _products(parts: Sequence[Array], others: Array) -> tuple[Array, Array]:
    """Return products of columns (N, ny, m) of logs with each other, and with others.

    Parameters
    ----------
    parts : sequence of ndarray
    others : ndarray
        (n, k), the rows of all logs one after another.

    Returns
    -------
    tuple of ndarray
        (m, m) and (m, k)
    """
    size = parts[0].shape[2]
    square, across, first = np.zeros((size, size)), np.zeros((size, others.shape[1])), 0
    with np.errstate(over="ignore", invalid="ignore"):
        for part in parts:
            samples, channels, _ = part.shape
            beside = others[first : first + samples * channels].reshape(samples, channels, -1)
            first += samples * channels
            # time is last in memory
            for i, channel in enumerate(part.transpose(1, 2, 0)):
                square += channel @ channel.T
                across += channel @ beside[:, i]
    return square, across


def _likeliest(square: Array, along: Array, pushers: _Pushers, use: Use) -> tuple[Array, Array]:
    """Return prior deviations (k, k) that make the innovations likeliest, and coefficients (k,).

    Parameters
    ----------
    square, along : ndarray
        (k, k), (k,) products of the rows, and of the rows with the innovations.
    pushers : _Pushers
    use : Use
        Which of them the rows are of.
    """
    ways = [(float(use.parity > 0), float(use.parity < 0))]
    if not use.parity:
        ways = [(1.0, broken) for broken in _BROKEN]
    mine = pushers.used(use)
    tried = [pushers.deviations(mine, *way) for way in ways]
    found = [(_ridge(root.T @ square @ root, root.T @ along), root) for root in tried]
    (_, strength, best), root = min(found, key=lambda f: f[0][0])
    return strength * root, np.asarray(root @ best)


def _ridge(square: Array, along: Array) -> tuple[float, float, Array]:
    """Return −2 log of the marginal likelihood, constants apart, the strength, coefficients (k,).

    Parameters
    ----------
    square, along : ndarray
        (k, k), (k,) products of the rows, and of the rows with the innovations.
    """
    squares, vectors = np.linalg.eigh(square)
    known = squares > _UNKNOWN * squares[-1]
    values, right = np.sqrt(squares[known]), vectors[:, known].T
    share = right @ along / values
    grown = 1 + (_STRENGTHS[:, None] * values) ** 2
    costs = (share**2 / grown + np.log(grown)).sum(axis=1)
    best = int(np.argmin(costs))
    shrunk = _STRENGTHS[best] ** 2 * values / grown[best]
    return float(costs[best]), float(_STRENGTHS[best]), right.T @ (shrunk * share)
