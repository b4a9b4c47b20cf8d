"""The error budget: the squared error of held-out free runs, split among its sources.

A cause takes what switching it off at sea would: the extended model says what the logs would show
without it, the model without causes is fitted to that anew, and its held-out error is compared with
what it was, both times with the coefficients whose free runs follow the logs most nearly. Of
thrusters that act late the logs are as they were, and the commands act as the cause says; a lag and
a limited rate do much of what each other does, so that what they take is averaged over their order
(Shapley, 1953). What the
extended model leaves is told apart into what a generic force of motion and commands predicts of it,
and, of the rest, sensor noise, waves and a slow force by their spectra. Causes of which each
lessens the error of the others take more together than there is, or less: the difference is not
split.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import factorial

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.evidence.held_out import Pair, change_scenarios
from greybox.diagnosis.evidence.remainder import generic_force
from greybox.diagnosis.fitting import Problem
from greybox.diagnosis.noise import Noise, fit_noise
from greybox.diagnosis.point import Fit, Point
from greybox.diagnosis.result import BudgetPart
from greybox.diagnosis.ship import LogRun, Ship
from greybox.diagnosis.thresholds import GUST
from greybox.diagnosis.waves import Waves, noise_in
from greybox.trial.log import TrialLog
from greybox.validation.gain import block_sums, blocks

Array = NDArray[np.float64]

SENSOR, MOTION, SLOW, WAVES, REST = (
    "sensor noise", "motion and commands", "slow force", "waves", "not split",
)  # fmt: skip
_DRAWS = 1000
# logs to fit to, logs that are held out, and where to begin
_Part = tuple[Sequence[LogRun], Sequence[LogRun], Sequence[Point]]
# takes a cause, or terms, out of a point of the extended model
Drop = Callable[[Problem, Point], Point]


@dataclass(frozen=True)
class SwitchedOff:
    """Held-out logs as they would be if the ship had everything but one cause.

    Parameters
    ----------
    id : str
    errors : ndarray
        (N, nx) of the model without causes, fitted anew to such logs, on what is held out; empty
        where no run without the cause stays bounded.
    relative : float
        Standard error of the cause's size, as a share of the size.
    taken : ndarray, optional
        (N, nx) what the cause takes of the squared errors; by default all that they fall by.
    """

    id: str
    errors: Array
    relative: float
    taken: Array | None = None


def errors_before(
    pairs: Sequence[Pair], before: Fit, first: Callable[[Sequence[TrialLog]], Mapping[str, float]]
) -> Array:
    """Return the held-out errors of the model without causes.

    Its free runs follow the logs as nearly as they can.

    Parameters
    ----------
    pairs : sequence of Pair
        Of the model without causes.
    before : Fit
        That model on all logs.
    first : callable
        First coefficients of logs.

    Returns
    -------
    ndarray
        (N, nx), of all that is held out; empty where a run leaves every bound.
    """
    return _errors(
        (p.problem.runs, p.held.runs, _starts(p.problem.runs, before, None, first)) for p in pairs
    )


def errors_without(
    final: Sequence[Pair],
    before: Fit,
    drop: Drop,
    first: Callable[[Sequence[TrialLog]], Mapping[str, float]],
) -> Array:
    """Return the held-out errors that the model without causes would have without one of them.

    Parameters
    ----------
    final : sequence of Pair
        The extended model, on what is held out.
    before : Fit
        The model without causes; its free numbers are fitted anew.
    drop : callable
        Takes a cause out of a point of the extended model.
    first : callable
        First coefficients of logs.

    Returns
    -------
    ndarray
        (N, nx), of all that is held out; empty where a run leaves every bound.
    """

    def parts() -> Iterator[_Part]:
        for pair in final:
            point = pair.fit.point
            less = drop(pair.problem, point)
            logs = _runs_without(pair.problem, point, [point.ship], [less.ship])
            held = _runs_without(
                pair.held, pair.held_fit.point, change_scenarios(point), change_scenarios(less)
            )
            yield logs, held, _starts(logs, before, pair.fit, first) if logs else []

    return _errors(parts())


def errors_acting(
    final: Sequence[Pair],
    before: Fit,
    acting: Callable[[Point, Ship], Ship],
    first: Callable[[Sequence[TrialLog]], Mapping[str, float]],
) -> Array:
    """Return the held-out errors of the model without causes where its thrusters act as one says.

    Parameters
    ----------
    final, before, first
        As of `errors_without`.
    acting : callable
        Of a point of the extended model and a ship: the ship whose thrusters act as in that point.

    Returns
    -------
    ndarray
        (N, nx), of all that is held out; empty where a run leaves every bound.
    """

    def parts() -> Iterator[_Part]:
        for pair in final:
            begun = _starts(pair.problem.runs, before, pair.fit, first)
            late = [replace(p, base=acting(pair.fit.point, p.base)) for p in begun]
            yield pair.problem.runs, pair.held.runs, late

    return _errors(parts())


def averaged(base: Array, errors: Mapping[frozenset[str], Array], name: str) -> Array | None:
    """Return what one of several causes takes of squared errors, averaged over their order.

    Parameters
    ----------
    base : ndarray
        (N, nx) errors with all of them.
    errors : mapping
        Of every set of ids, (N, nx) errors where the causes of that set are mended.
    name : str
        The id.

    Returns
    -------
    ndarray or None
        (N, nx); None where the errors of some set are unknown.
    """
    known = {frozenset[str](): base, **errors}
    if not all(len(e) for e in known.values()):
        return None
    every = max(known, key=len)
    out = np.zeros_like(base)
    for some in known:
        if name not in some:
            share = factorial(len(some)) * factorial(len(every) - len(some) - 1)
            fell = known[some] ** 2 - known[some | {name}] ** 2
            out += share / factorial(len(every)) * fell
    return out


def _runs_without(
    problem: Problem, point: Point, ships: Sequence[Ship], without: Sequence[Ship]
) -> list[LogRun]:
    """Return the logs less what a cause changes in the extended model's runs; none without bounds.

    Of the ships, with a change within the log or before it, that one counts that the point has.
    """
    ship = point.ship
    k = next((k for k, s in enumerate(ships) if s.changes == ship.changes), 0)
    other = without[min(k, len(without) - 1)]
    runs = []
    for run, start in zip(problem.runs, point.starts, strict=True):
        changed = run.run(ship, start).y - run.run(other, start).y
        if not np.isfinite(changed).all():
            return []
        runs.append(run.measuring(run.y - changed))
    return runs


def _starts(
    runs: Sequence[LogRun],
    before: Fit,
    final: Fit | None,
    first: Callable[[Sequence[TrialLog]], Mapping[str, float]],
) -> list[Point]:
    """Return the model without causes with its own coefficients and with others to begin from.

    Its own may lie beyond a hill, as they are of logs with the cause, and weighed by colour.
    """
    base = before.point.base
    starts = tuple(run.start() for run in runs)
    begun = [replace(before.point, starts=starts)]
    free = [i for i in before.point.places if i < len(base.theta)]
    if free:
        values = first([run.log for run in runs])
        own = [values.get(n, 0.0) for n in runs[0].structure.parameters]
        for found in (own, *(() if final is None else (final.point.base.theta,))):
            theta = base.theta.copy()
            theta[free] = np.asarray(found)[free]
            begun.append(replace(begun[0], base=replace(base, theta=theta)))
    return begun


def _errors(parts: Iterable[_Part]) -> Array:
    """Return the held-out errors (N, nx) of all parts; empty where a run leaves every bound.

    The parts are of the same logs: where the first one was begun best, the others are begun.
    """
    out: list[Array] = []
    best = None
    for runs, held, begun in parts:
        if not runs or not held:
            return np.zeros((0, 0))
        found = None if best is None else _nearest(runs, held, [begun[best]])
        found = found or _nearest(runs, held, begun)
        if found is None:
            return np.zeros((0, 0))
        pair, place = found
        best = place if best is None else best
        out.append(_states(pair.held, pair.held_fit))
    return np.concatenate(out)


def _nearest(
    runs: Sequence[LogRun], held: Sequence[LogRun], begun: Sequence[Point]
) -> tuple[Pair, int] | None:
    """Return the best predicting of fits from several points, and where it began.

    None where none has bounds.

    Errors are weighed by their size: a fit that is weighed by their colour forgets what is slow
    in them, and where much is missing it may end with runs that are farther off than no motion.
    Where none of them predicts within bounds, the first point's coefficients are kept.
    """
    problem, other = Problem(runs, "free run"), Problem(held, "free run")
    found: list[tuple[Pair, int]] = []

    def add(fit: Fit, k: int) -> None:
        shown = fit if fit.escaped else other.fit_starts(fit.point, fit.noise)
        if not shown.escaped:
            found.append((Pair(problem, fit, other, shown), k))

    def missed(pair: Pair) -> float:
        return float(np.log((_states(pair.held, pair.held_fit) ** 2).sum(axis=0)).sum())

    tried = [(k, point, problem.errors(point)) for k, point in enumerate(begun)]
    bounded = [one for one in tried if all(np.isfinite(e).all() for e in one[-1])]
    for k, point, errors in bounded:
        add(problem.settle(problem.fit(point, problem.noise_of(errors, point)), 2), k)
    if not found and bounded:
        k, point, errors = bounded[0]
        add(problem.fit(point, problem.noise_of(errors, point), most=0), k)
    # a fit may end before a hill beyond which it would predict better
    return min(found, key=lambda one: missed(one[0]), default=None)


def error_budget(
    base: Array,
    final: Sequence[Pair],
    causes: Sequence[SwitchedOff],
    terms: Array | None,
    waves: Waves | None,
    seed: int,
) -> tuple[BudgetPart, ...]:
    """Split the squared error of held-out free runs.

    Parameters
    ----------
    base : ndarray
        (N, nx) errors of the model without causes, as of `errors_before`.
    final : sequence of Pair
        The model with those that stand, on what is held out.
    causes : sequence of SwitchedOff
    terms : ndarray or None
        (N, nx), as `errors_without`, without the extended model's terms that stand for no cause;
        None where it has none, empty where no run without them stays bounded.
    waves : Waves or None
        A line in what the causes leave.
    seed : int
        Of the bootstrap.

    Returns
    -------
    tuple of BudgetPart
        Shares of each state, before and after the causes are mended, both of the squared error
        before, with 95 % intervals by a circular block bootstrap of the samples (Politis and
        Romano, 1992) in which each cause's size varies by its standard error, and what the
        extended model leaves beyond the sensors' noise and waves goes with the error without the
        cause, or against it, as may be; empty where a run leaves every bound.
    """
    if not len(base) or any(p.fit.escaped or p.held_fit.escaped for p in final):
        return ()
    problem = final[0].held
    names = problem.structure.states
    known = _measured([pair.held for pair in final])
    counts = known.sum(axis=0)
    e0, e1 = base, np.concatenate([_states(p.held, p.held_fit) for p in final])
    beside = [generic_force(pair).errors for pair in final]
    rest = np.concatenate([np.concatenate(errors) for errors in beside])[:, : len(names)] * known
    # a force that makes held-out runs worse explains nothing of them
    helps = (rest**2).sum(axis=0) < (e1**2).sum(axis=0)
    rest = np.where(helps, rest, e1)
    noise = []
    for pair, errors in zip(final, beside, strict=True):
        taken = np.append(helps, np.ones(errors[0].shape[1] - len(names), bool))
        left = tuple(
            np.where(taken, e, plain) for e, plain in zip(errors, pair.held_fit.errors, strict=True)
        )
        noise.append((_noise_of(pair, left, waves), sum(map(len, left))))
    left_over = {MOTION: e1**2 - rest**2}
    without = {c.id: c.errors for c in causes if len(c.errors)}
    before = {name: e0**2 - errors**2 for name, errors in without.items()} | left_over
    before |= {c.id: c.taken for c in causes if c.taken is not None}
    if terms is not None and len(terms):
        # what terms do beside causes only is no share of theirs: it cannot be split
        alone = (terms**2).sum(axis=0) < (e0**2).sum(axis=0)
        without[MOTION] = np.where(alone, terms, e0)
        before[MOTION] = before[MOTION] + e0**2 - without[MOTION] ** 2
    mean = (rest**2).sum(axis=0) / np.maximum(counts, 1)
    moments = _moments(noise, problem, names, waves, mean)
    rng = np.random.default_rng([seed, 11])
    starts, length = blocks(len(e0), problem.sample_time, _DRAWS, rng)
    wide = {c.id: 1 + c.relative * rng.standard_normal((_DRAWS, 1)) for c in causes}
    whole, drawn_whole = (e0**2).sum(axis=0), block_sums(e0**2, starts, length)
    # a channel that was measured nowhere has no error
    whole, drawn_whole = np.maximum(whole, 1e-300), np.maximum(drawn_whole, 1e-300)
    # the sea goes with neither
    nobodys = moments[SENSOR] + moments[WAVES]
    left = np.maximum((e1**2).sum(axis=0) - counts * nobodys, 0.0)
    # the ship without the cause is known as well as the extended model follows it
    unsure = {
        name: 2
        * np.sqrt((errors**2).sum(axis=0) * left)
        / whole
        * np.cos(rng.uniform(0, 2 * np.pi, (_DRAWS, len(names))))
        for name, errors in without.items()
    }
    drawn_counts = block_sums(known.astype(float), starts, length)

    def shares(parts: dict[str, Array], of: Array) -> tuple[dict[str, Array], dict[str, Array]]:
        """Return the shares (nx,) and their draws (draws, nx) of parts of a squared error."""
        point = {name: part.sum(axis=0) / whole for name, part in parts.items()}
        draws = {n: block_sums(part, starts, length) / drawn_whole for n, part in parts.items()}
        for name in set(parts) & set(without):
            draws[name] = draws[name] * wide.get(name, 1.0) + unsure[name]
        for name, moment in moments.items():
            point[name] = counts * moment / whole
            draws[name] = drawn_counts * moment / drawn_whole
        point[REST] = of.sum(axis=0) / whole - sum(point.values())
        draws[REST] = block_sums(of, starts, length) / drawn_whole - sum(draws.values())
        return point, draws

    told, drawn = shares(before, e0**2)
    after, _ = shares(left_over, e1**2)
    return tuple(
        BudgetPart(
            part,
            {s: float(told[part][i]) for i, s in enumerate(names)},
            {
                s: tuple(map(float, np.quantile(drawn[part][:, i], [0.025, 0.975])))
                for i, s in enumerate(names)
            },
            {s: float(after[part][i]) if part in after else 0.0 for i, s in enumerate(names)},
        )
        for part in (SENSOR, *before, SLOW, WAVES, REST)
    )


def without_share(budget: Sequence[BudgetPart], causes: Sequence[str]) -> list[str]:
    """Say which causes have no share of the error, and why."""
    told = {part.part for part in budget}
    lacking = [cause for cause in causes if cause not in told]
    if not budget or not lacking:
        return []
    return [
        f"no share of the error is told of {', '.join(lacking)}: where that is left out, no free "
        f"run stays within bounds, so it is part of what is not split."
    ]


def _states(held: Problem, fit: Fit) -> Array:
    """Return the held-out errors of the states, (N, nx), zero where nothing was measured."""
    return np.concatenate(fit.errors)[:, : len(held.structure.states)] * _measured([held])


def _measured(held: Sequence[Problem]) -> NDArray[np.bool_]:
    """Return where the states of held-out logs were measured, (N, nx)."""
    known = np.concatenate([known for problem in held for known in problem.known])
    return known[:, : len(held[0].structure.states)]


def _noise_of(pair: Pair, errors: Sequence[Array], waves: Waves | None) -> Noise:
    held, fit = pair.held, pair.held_fit
    noise = fit_noise(
        errors, held.poles(fit.point), held.sample_time, held.groups, fit.noise, known=held.known
    )
    return noise_in(waves, replace(fit, noise=noise, errors=tuple(errors)))


def _moments(
    noise: Sequence[tuple[Noise, int]],
    problem: Problem,
    names: Sequence[str],
    waves: Waves | None,
    mean: Array,
) -> dict[str, Array]:
    """Return mean squares (nx,) of what only its spectrum tells apart, of those `mean` in all."""
    samples = sum(count for _, count in noise)
    sensor, slow = np.zeros(len(names)), np.zeros(len(names), bool)
    for k, group in enumerate(problem.groups):
        i = group[0]
        sensor[i] = sum(float(n.groups[k].sensor[0] ** 2) * c for n, c in noise) / samples
        remembered = max(n.groups[k].remembered for n, _ in noise)
        slow[i] = remembered * problem.sample_time > GUST
    sensor = np.minimum(sensor, mean)
    line = np.array([0.0 if waves is None else waves.std.get(s, 0.0) ** 2 for s in names])
    line = np.minimum(line, mean - sensor)
    return {SENSOR: sensor, SLOW: np.where(slow, mean - sensor - line, 0.0), WAVES: line}
