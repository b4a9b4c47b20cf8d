"""The error budget: which share of the squared error of a held-out free run is whose.

The error of the model without causes is a sum of series: what each cause changes, what a generic
force of motion and commands predicts of the rest, and what is left then, in which sensor noise,
waves and a slow force are told apart by their spectra. A series c of an error e takes the share
Σ c e / Σ e²: of two that go together each takes half of their product, which is the mean over the
orders in which they may be taken away (Shapley, 1953).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.evidence.held_out import Pair
from greybox.diagnosis.evidence.remainder import generic_force
from greybox.diagnosis.fitting import Problem
from greybox.diagnosis.gain import blocks
from greybox.diagnosis.noise import Noise, fit_noise
from greybox.diagnosis.result import BudgetPart
from greybox.diagnosis.thresholds import GUST
from greybox.diagnosis.waves import Waves

Array = NDArray[np.float64]

SENSOR, MOTION, SLOW, WAVES, REST = (
    "sensor noise", "motion and commands", "slow force", "waves", "not split",
)  # fmt: skip
_DRAWS = 1000


@dataclass(frozen=True)
class Taken:
    """A cause whose share is asked for.

    Parameters
    ----------
    id : str
    without : sequence of Pair
        The model with all other causes, its coefficients fitted anew, on what is held out.
    alone : sequence of Pair
        The model with this cause alone, likewise, for the cause that takes most: it takes what
        switching it off would. Empty for the others, which are told beside it.
    relative : float
        Standard error of its size, as a share of the size.
    """

    id: str
    without: Sequence[Pair]
    alone: Sequence[Pair]
    relative: float


def error_budget(
    base: Sequence[Pair],
    final: Sequence[Pair],
    causes: Sequence[Taken],
    waves: Waves | None,
    seed: int,
    nameless: bool = False,
) -> tuple[BudgetPart, ...]:
    """Split the squared error of held-out free runs.

    Parameters
    ----------
    base, final : sequence of Pair
        The model without causes, and with those that stand, on what is held out.
    causes : sequence of Taken
    waves : Waves or None
        A line in what the causes leave.
    seed : int
        Of the bootstrap.
    nameless : bool
        Whether the model has terms of motion and commands beside its causes, to which belongs
        what these do not explain; otherwise that is not split.

    Returns
    -------
    tuple of BudgetPart
        Shares of each state, before and after the causes are mended, both of the squared error
        before, with 95 % intervals by a moving-block bootstrap of the samples (Künsch, 1989) in
        which each cause's size varies by its standard error; empty where a run leaves every
        bound.
    """
    every = [*base, *final, *(p for c in causes for p in c.without)]
    if not base or any(p.fit.escaped or p.held_fit.escaped for p in every):
        return ()
    problem = final[0].held
    names = problem.structure.states
    e0, e1 = _errors(base), _errors(final)
    series = {c.id: np.zeros_like(e0) for c in causes}
    for cause in causes:
        alone = cause.alone and not any(p.held_fit.escaped for p in cause.alone)
        series[cause.id] += e0 - _errors(cause.alone) if alone else _errors(cause.without) - e1
    beside = e0 - e1 - sum(series.values())
    plain, noise = [], []
    for pair in final:
        left = generic_force(pair).errors
        plain.append(np.concatenate(left))
        noise.append((_noise_of(pair, left), sum(map(len, left))))
    rest = np.concatenate(plain)[:, : len(names)]
    series[MOTION] = e1 - rest + (beside if nameless else 0.0)
    moments = _moments(noise, problem, names, waves, rest)
    rng = np.random.default_rng([seed, 11])
    starts, length = blocks(len(e0), problem.sample_time, _DRAWS, rng)
    wide = {c.id: 1 + c.relative * rng.standard_normal(_DRAWS) for c in causes}

    def shares(of: Array, parts: Mapping[str, Array]) -> tuple[dict[str, Array], dict[str, Array]]:
        """Return the shares (nx,) and their draws (draws, nx) of the products with an error."""
        whole, drawn = (e0**2).sum(axis=0), _drawn(e0**2, starts, length)
        point, draws = {}, {}
        for name, part in parts.items():
            point[name] = (part * of).sum(axis=0) / whole
            draws[name] = _drawn(part * of, starts, length) / drawn
            if name in wide:
                draws[name] *= wide[name][:, None]
        for name, moment in moments.items():
            point[name] = len(e0) * moment / whole
            draws[name] = starts.shape[1] * length * moment / drawn
        total = (of**2).sum(axis=0) / whole, _drawn(of**2, starts, length) / drawn
        point[REST] = total[0] - sum(point.values())
        draws[REST] = total[1] - sum(draws.values())
        return point, draws

    before, drawn = shares(e0, series)
    after, _ = shares(e1, {MOTION: e1 - rest})
    order = [SENSOR, *series, SLOW, WAVES, REST]
    return tuple(
        BudgetPart(
            part,
            {s: float(before[part][i]) for i, s in enumerate(names)},
            {
                s: tuple(map(float, np.quantile(drawn[part][:, i], [0.025, 0.975])))
                for i, s in enumerate(names)
            },
            {s: float(after[part][i]) if part in after else 0.0 for i, s in enumerate(names)},
        )
        for part in order
    )


def _errors(pairs: Sequence[Pair]) -> Array:
    """Return the held-out errors of the states, (N, nx)."""
    count = len(pairs[0].held.structure.states)
    return np.concatenate([e[:, :count] for p in pairs for e in p.held_fit.errors])


def _noise_of(pair: Pair, errors: Sequence[Array]) -> Noise:
    held, fit = pair.held, pair.held_fit
    return fit_noise(errors, held.poles(fit.point), held.sample_time, held.groups, fit.noise)


def _moments(
    noise: Sequence[tuple[Noise, int]],
    problem: Problem,
    names: Sequence[str],
    waves: Waves | None,
    rest: Array,
) -> dict[str, Array]:
    """Return mean squares (nx,) of what only its spectrum tells apart."""
    samples = sum(count for _, count in noise)
    sensor, slow = np.zeros(len(names)), np.zeros(len(names), bool)
    for k, group in enumerate(problem.groups):
        i = group[0]
        sensor[i] = sum(float(n.groups[k].sensor[0] ** 2) * c for n, c in noise) / samples
        remembered = max(n.groups[k].remembered for n, _ in noise)
        slow[i] = remembered * problem.sample_time > GUST
    mean = (rest**2).mean(axis=0)
    sensor = np.minimum(sensor, mean)
    line = np.array([0.0 if waves is None else waves.std.get(s, 0.0) ** 2 for s in names])
    line = np.minimum(line, mean - sensor)
    return {SENSOR: sensor, SLOW: np.where(slow, mean - sensor - line, 0.0), WAVES: line}


def _drawn(values: Array, starts: NDArray[np.intp], length: int) -> Array:
    """Return the sums (draws, nx) of blocks of values (N, nx)."""
    sums = np.vstack([np.zeros(values.shape[1]), np.cumsum(values, axis=0)])
    return np.asarray((sums[starts + length] - sums[starts]).sum(axis=1))
