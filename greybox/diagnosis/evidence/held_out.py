"""How much a cause improves the prediction of logs that it was not fitted to."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.fitting import MOST, Problem
from greybox.diagnosis.point import Fit, Point
from greybox.diagnosis.ship import Ship
from greybox.model.run.step import Integrator
from greybox.numerics.lagged_moments import correlation_factor
from greybox.trial.segments import of_one_log

Array = NDArray[np.float64]

# blocks at least, of samples with a long memory
_FEWEST = 12


@dataclass(frozen=True)
class Proof:
    """Fall of −2 log L of held-out logs.

    Parameters
    ----------
    gain : float
        Infinite where one of the two runs leaves every bound.
    std : float
        Its standard error, the errors' memory counted; not a number with such a gain.
    p_value : float
        One-sided, of no gain.
    samples : ndarray
        (N,) what each held-out sample adds to the gain.
    """

    gain: float
    std: float
    p_value: float
    samples: Array


@dataclass(frozen=True)
class Pair:
    """One hypothesis on the logs that it was fitted to and on the held-out ones.

    `known` holds what was computed of it already.
    """

    problem: Problem
    fit: Fit
    held: Problem
    held_fit: Fit
    known: dict[object, Any] = field(default_factory=dict, init=False, compare=False, repr=False)


class HeldOut(ABC):
    """The logs, or parts of logs, on which causes must predict better."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[Fit, list[Pair]]] = {}

    @abstractmethod
    def _pairs(self, fit: Fit) -> list[Pair]:
        """Return the hypothesis on everything that is held out."""

    def pairs(self, fit: Fit) -> list[Pair]:
        """Return the hypothesis on everything that is held out; computed once a fit.

        The colour of the held-out errors is estimated on them: gusts and seas differ from day
        to day, which is no fault of a model, and where another cause still acts a better
        model with smaller errors must not pay more for it than a worse one.
        """
        known = self._known.get(id(fit))
        if known is None or known[0] is not fit:
            pairs = [
                pair if pair.held_fit.escaped
                else replace(pair, held_fit=pair.held.settle(pair.held_fit))
                for pair in self._pairs(fit)
            ]  # fmt: skip
            self._known[id(fit)] = known = (fit, pairs)
        return known[1]

    def contributions(self, fit: Fit) -> Array:
        """Return what each held-out sample adds to −2 log L of a fitted hypothesis, (N,)."""
        out = []
        for pair in self.pairs(fit):
            if pair.held_fit.escaped:
                out.append(np.full(sum(len(r.y) for r in pair.held.runs), np.inf))
            else:
                out += pair.held.contributions(pair.held_fit)
        return np.concatenate(out)

    def squares(self, fit: Fit) -> Array:
        """Return the squared error of each log and state, (logs, nx).

        Infinite where a run has no bound.
        """
        out = []
        for pair in self.pairs(fit):
            count = len(pair.held.structure.states)
            each = np.array([(e[:, :count] ** 2).sum(axis=0) for e in pair.held_fit.errors])
            places = of_one_log([run.log for run in pair.held.runs])
            out += [each[of_one].sum(axis=0) for of_one in places]
        total = np.array(out)
        return np.maximum(np.where(np.isfinite(total), total, np.inf), 1e-300)

    def prove(self, before: Fit, after: Fit) -> Proof:
        """Return what the second hypothesis gains on the first."""
        one, two = self.contributions(before), self.contributions(after)
        with np.errstate(invalid="ignore"):
            proof = proof_of(one - two)
        return replace(proof, p_value=min(1.0, proof.p_value * self._ways(after)))

    def _ways(self, fit: Fit) -> int:
        """Return among how many readings of a hypothesis the likeliest was taken."""
        return 1

    def exchanged(self) -> HeldOut | None:
        """Return the same with the logs' roles exchanged; None where all were held out already."""
        return None


def worse(held_out: Callable[[Integrator], HeldOut], fit: Fit, than: Fit) -> float:
    """Return the mean logarithm of the ratio of squared held-out errors of two fits.

    Each is run as it was fitted. Each log counts alike, as in the fit that is told: the squares of
    the roughest would outweigh those of all others.
    """
    one, two = (held_out(f.integrator).squares(f) for f in (fit, than))
    if not np.isfinite(two).all():
        return -np.inf if np.isfinite(one).all() else 0.0
    return float(np.log(one / two).mean())


def proof_of(difference: Array) -> Proof:
    """Return the proof that differences of each sample (N,) give."""
    from scipy.special import stdtr

    if not np.isfinite(difference).all():
        # one of the two runs away: no sum tells more than which
        better = bool((difference > 0).all())
        return Proof(np.inf if better else -np.inf, np.nan, float(not better), difference)
    gain = float(difference.sum())
    std = float(np.sqrt(long_run_variance(difference) * len(difference)))
    blocks = len(difference) // _block(difference)
    p = float(stdtr(max(blocks - 1, 1), -gain / std)) if std > 0 else float(gain <= 0)
    return Proof(gain, std, p, difference)


def _block(series: Array) -> int:
    """Return how many samples a block has: N^(1/2), or four times their memory."""
    memory = 4 * correlation_factor(series[:, None])
    return int(min(max(5, round(len(series) ** 0.5), memory), max(len(series) // _FEWEST, 5)))


def long_run_variance(series: Array) -> float:
    """Return the variance per sample of a sum, by blocks.

    References
    ----------
    Carlstein (1986), non-overlapping blocks.
    """
    size = _block(series)
    count = len(series) // size
    if count < 2:
        return float(np.var(series)) if len(series) > 1 else 0.0
    sums = series[: count * size].reshape(count, size).sum(axis=1)
    return float(np.var(sums, ddof=1) / size)


class OtherLogs(HeldOut):
    """Validation logs.

    Parameters
    ----------
    fitting, problem : Problem
        Of the estimation and the validation logs, same structure and integrator.
    """

    def __init__(self, fitting: Problem, problem: Problem) -> None:
        super().__init__()
        self.fitting, self.problem = fitting, problem

    def _pairs(self, fit: Fit) -> list[Pair]:
        # a coefficient that changed during the estimation may have changed before these
        # logs, or within them: the likelier counts
        points = [
            replace(fit.point, base=ship, hypotheses=(), values=())
            for ship in change_scenarios(fit.point)
        ]
        best = min(
            (self.problem.fit_starts(p, fit.noise) for p in points), key=lambda found: found.cost
        )
        return [Pair(self.fitting, fit, self.problem, best)]

    def _ways(self, fit: Fit) -> int:
        return len(change_scenarios(fit.point))

    def exchanged(self) -> HeldOut | None:
        """Return the logs that the model was fitted to, each fit made anew on the others."""
        return Folds([(self.problem, self.fitting)], MOST)


def change_scenarios(point: Point) -> list[Ship]:
    """Return the ship with its changes within the log, and with them made before."""
    ship = point.ship
    if not ship.changes:
        return [ship]
    theta = ship.theta.copy()
    for change in ship.changes:
        theta[change.index] *= change.factor
    return [ship, replace(ship, theta=theta, changes=())]


class Folds(HeldOut):
    """Parts of the estimation logs, each predicted from a fit to the others.

    Parameters
    ----------
    parts : sequence of (Problem, Problem)
        To fit on, and held out.
    most : int
        Iterations of a fit at most: few change what differs little from the fit to all.
    """

    def __init__(self, parts: Sequence[tuple[Problem, Problem]], most: int = 10) -> None:
        super().__init__()
        self.parts, self.most = tuple(parts), most

    def _pairs(self, fit: Fit) -> list[Pair]:
        out = []
        for fitting, held in self.parts:
            starts = tuple(run.start() for run in fitting.runs)
            refitted = fitting.fit(replace(fit.point, starts=starts), fit.noise, self.most)
            out.append(Pair(fitting, refitted, held, held.fit_starts(refitted.point, fit.noise)))
        return out
