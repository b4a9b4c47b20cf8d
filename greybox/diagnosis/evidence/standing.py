"""Whether a cause explains more than a generic force of motion and commands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.evidence.held_out import HeldOut, Pair, Proof, proof_of
from greybox.diagnosis.evidence.remainder import (
    MOTION_AIR_AND_COMMANDS,
    MOTION_AND_COMMANDS,
    Use,
    contributions_beside,
    fit_generic_forces,
    generic_force,
)
from greybox.diagnosis.evidence.wind_direction import wind_direction
from greybox.diagnosis.fitting import Problem
from greybox.diagnosis.hypothesis import Hypothesis
from greybox.diagnosis.point import Fit, Point
from greybox.diagnosis.scores import MOMENTS
from greybox.diagnosis.ship import CURRENTS
from greybox.diagnosis.thresholds import (
    AS_CHOSEN,
    LEAST_SHARE,
    OWN_SHARE,
    PROVEN,
    SAME,
    SIGNIFICANT,
)
from greybox.model.terms import mirror_sign, parse_term
from greybox.numerics.robust import variance_between

Array = NDArray[np.float64]

# iterations of a fit of a cause's numbers alone
_FEW = 6


@dataclass(frozen=True)
class Standing:
    """What a cause adds to a generic force, and how it compares with one of the same arguments.

    Parameters
    ----------
    beyond : Proof
        Fall of −2 log L of held-out logs by the cause where a generic force stands beside the
        model with it and the model without it.
    share : float or None
        What the cause alone takes of the fall that a generic force of its own arguments brings;
        None where it is no function of motion and present commands.
    half : float
        One-sided p-value of a share no larger than `LEAST_SHARE`.
    moved : ndarray
        How far each of its numbers moves when the generic force joins, and how far it differs
        between logs beyond what chance explains, together.
    clear : float
        p-value of the null (Wald) where it is likeliest on the way that the generic force moves
        the numbers.
    told : float
        That of the surest of its numbers with its movement counted as a standard error, corrected
        for how many there are.
    level : float
        Significance that a gain on held-out logs must have.
    known : float
        Significance that its surest number must have.
    tried : int
        Causes that were scored, of which this is one, each as often as a moment was sought for it.
    sought : bool
        Whether it is the best of many moments.
    direction : float
        p-value of errors that know nothing of the direction of a measured wind.
    """

    beyond: Proof
    share: float | None
    half: float
    moved: Array
    clear: float
    told: float
    level: float = PROVEN
    known: float = PROVEN
    tried: int = 1
    sought: bool = False
    direction: float = 1.0

    @property
    def stands(self) -> bool:
        """Whether the cause explains what no generic force explains as well."""
        beside = self._explains and self.clear < PROVEN
        # no force of motion and commands knows from where the wind blows
        return (beside or self.direction < PROVEN) and self._sure

    @property
    def open(self) -> bool:
        """Whether more logs may yet tell that the cause stands."""
        lacks = not self._explains and self.beyond.gain > 0
        return lacks and not self.stands and self.clear < PROVEN and self._sure

    @property
    def _explains(self) -> bool:
        """Whether it gains beyond a generic force, or takes what one of its arguments gains."""
        gains = self.beyond.gain > 0 and self.beyond.p_value < self.level
        own = self.share is not None and self.share >= OWN_SHARE and self.half < self.level
        return gains or own

    @property
    def _sure(self) -> bool:
        """Whether one of its numbers is known well enough."""
        if self.sought or np.isinf(self.beyond.gain):
            # many a cause keeps a run within bounds, and many a moment follows a misfit: its number
            # alone speaks for it, and was the best of all that were tried
            return self.tried * self.told < SIGNIFICANT
        return self.told < self.known


def standing(problem: Problem, hypothesis: Hypothesis, with_it: Fit, without_it: Fit,
             held_out: HeldOut, tried: int) -> Standing:  # fmt: skip
    """Weigh a cause against a generic force.

    Parameters
    ----------
    problem : Problem
    hypothesis : Hypothesis
    with_it, without_it : Fit
        With the cause in force, and without it.
    held_out : HeldOut
    tried : int
        Causes that were scored.
    """
    pairs, without = held_out.pairs(with_it), held_out.pairs(without_it)
    rival = _rival(problem, hypothesis)
    moved, clear, told = _moved(problem, hypothesis, with_it, pairs, rival)
    level = level_of(with_it)
    sought = any(p.reach > 0 for p in hypothesis.parameters)
    tried *= MOMENTS if sought else 1
    if any(p.held_fit.escaped or p.fit.escaped for p in (*pairs, *without)):
        better = not any(p.held_fit.escaped for p in pairs)
        proof = proof_of(np.array([np.inf if better else -np.inf]))
        return Standing(proof, None, 1.0, moved, clear, told, level, PROVEN, tried, sought)
    use = _own_arguments(problem, hypothesis)
    gains = _gains(pairs, without, rival, use)
    direction = 1.0
    if any(parse_term(n).of_air for n in hypothesis.columns if n not in CURRENTS):
        direction = wind_direction(problem, hypothesis, without_it, held_out)
    # every ship has such terms; that a log or the vessel file is wrong, or what heading, time and
    # earlier commands do, must be surer
    of_hull = hypothesis.apply is None and use is not None
    known = SAME if of_hull or direction < PROVEN else PROVEN
    weight = Standing(
        *_told(gains), moved, clear, told, level, known, tried, sought, direction
    )  # fmt: skip
    other = held_out.exchanged() if weight.open and not with_it.noise.coloured else None
    if other is None or with_it.point.ship.changes:
        return weight
    # few samples are independent: the logs that the model was fitted to are asked in turn
    pairs, without = other.pairs(with_it), other.pairs(without_it)
    if any(p.held_fit.escaped or p.fit.escaped for p in (*pairs, *without)):
        return weight
    both = np.hstack([gains, _gains(pairs, without, rival, use)])
    beyond, share, half = _told(both)
    return replace(weight, beyond=beyond, share=share, half=half)


def _gains(pairs: Sequence[Pair], without: Sequence[Pair], rival: Use, use: Use | None) -> Array:
    """Return what each held-out sample adds to falls of −2 log L, (1 or 3, N).

    By a cause where a generic force stands beside both models; by the cause alone, and by a generic
    force of its own arguments alone, where it has such.
    """
    for pair in without:
        fit_generic_forces(pair, [rival, *([] if use is None else [use])])

    def plain(of: Sequence[Pair]) -> Array:
        return np.concatenate([np.concatenate(p.held.contributions(p.held_fit)) for p in of])

    def beside(of: Sequence[Pair], force: Use) -> Array:
        return np.concatenate([contributions_beside(p, force) for p in of])

    beyond = beside(without, rival) - beside(pairs, rival)
    if use is None:
        return beyond[None]
    alone = plain(without)
    return np.stack([beyond, alone - plain(pairs), alone - beside(without, use)])


def _told(gains: Array) -> tuple[Proof, float | None, float]:
    """Return what gains, see `_gains`, say: proof beyond the generic force, share, its p-value."""
    beyond = proof_of(gains[0])
    if len(gains) == 1:
        return beyond, None, 1.0
    gained, possible = gains[1:]
    share = float(gained.sum() / possible.sum()) if possible.sum() > 0 else np.inf
    return beyond, share, proof_of(gained - LEAST_SHARE * possible).p_value


def _rival(problem: Problem, hypothesis: Hypothesis) -> Use:
    """Return what a hypothesis is weighed against."""
    measured = all(run.air_measured for run in problem.runs)
    return (
        MOTION_AIR_AND_COMMANDS if measured and set(hypothesis.columns) & {*CURRENTS}
        else MOTION_AND_COMMANDS
    )  # fmt: skip


def level_of(fit: Fit) -> float:
    """Return the significance that a gain on held-out logs must have."""
    return PROVEN if fit.noise.coloured else AS_CHOSEN


def _moved(
    problem: Problem, hypothesis: Hypothesis, fit: Fit, pairs: Sequence[Pair], rival: Use
) -> tuple[Array, float, float]:
    """Return how far a hypothesis's numbers move, and two p-values of their null."""
    from scipy.special import chdtr, chdtrc

    where = problem.numbers_of(fit.point, hypothesis)
    bounded = [p for p in pairs if not (p.fit.escaped or p.held_fit.escaped)]
    if not where or not bounded:
        return np.zeros(len(where)), 0.0, 0.0
    every = np.mean([generic_force(p, rival).moved for p in bounded], axis=0)
    scatter = np.sqrt(np.mean([_scatter(p, hypothesis) for p in bounded], axis=0))
    whole = np.hypot(every[where], scatter)
    away, own, along = problem.effect(fit, hypothesis)
    if hypothesis.apply is None:
        # what becomes free with a cause says nothing of it
        mine = len(hypothesis.columns)
        away, own, along = away[:mine], own[:mine, :mine], along[:mine]
    if not np.isfinite(own).all() or not len(away):
        return whole, *[1.0 if len(away) else 0.0] * 2
    coarse = np.zeros(len(where))
    if hypothesis.apply is not None:
        coarse = np.array([p.coarse for p in hypothesis.parameters])
    far, apart = along @ every, along[:, where] @ np.diag(np.hypot(scatter, coarse))
    inverse = np.linalg.pinv(own)
    # the null must not lie on the way, either
    size = float(far @ inverse @ far)
    share = float(np.clip(-(away @ inverse @ far) / size, 0.0, 1.0)) if size > 0 else 0.0
    near = away + share * far
    passed = float(chdtrc(len(away), float(near @ inverse @ near)))
    told = away**2 / np.maximum(np.diag(own) + far**2 + (apart**2).sum(axis=1), 1e-300)
    # the surest of several is sure by chance as often as there are numbers (Šidák, 1967)
    return whole, passed, float(1 - chdtr(1, told.max()) ** len(told))


def _scatter(pair: Pair, hypothesis: Hypothesis) -> Array:
    """Return the variance of a hypothesis's numbers by what differs from log to log.

    Its numbers alone are fitted to each log, the rest of the model as it is. What their variance
    exceeds that of chance by is shared by the logs that the model was fitted to; of few logs it is
    hardly known, as the variance of Student's t tells. An actuator is the same in all logs and
    shows in few: what is late counts by what each log tells of it (DerSimonian and Laird, 1986).
    Where a current or a wind is wrong, the log that tells most of it is wrong, too.
    """
    point = pair.fit.point
    k = [h.key for h in point.hypotheses].index(hypothesis.key)
    base = point.base
    for i, (other, value) in enumerate(zip(point.hypotheses, point.values, strict=True)):
        if i != k and other.apply is not None:
            base = other.apply(base, value)
    places = () if hypothesis.apply is not None else tuple(pair.held.numbers_at(hypothesis))
    numbers, chance = [], []
    for problem, fit in ((pair.problem, pair.fit), (pair.held, pair.held_fit)):
        for run, start in zip(problem.runs, fit.point.starts, strict=True):
            one = Problem([run], problem.metric)
            its = Point(base, (start,), places, (hypothesis,), (point.values[k],))
            found = one.fit(its, fit.noise, most=_FEW)
            if not found.escaped:
                value, own = one.covariance(found)
                numbers.append(value)
                chance.append(np.diag(own))
    count = len(pair.problem.numbers_of(point, hypothesis))
    if len(numbers) < 2 or not np.isfinite(chance).all():
        return np.zeros(count)
    values, by_chance = np.array(numbers), np.array(chance)
    excess = np.maximum(np.var(values, axis=0, ddof=1) - by_chance.mean(axis=0), 0.0)
    if hypothesis.past:
        weights = np.divide(1.0, by_chance, out=np.zeros_like(by_chance), where=by_chance > 0)
        mean = (weights * values).sum(axis=0) / np.maximum(weights.sum(axis=0), 1e-300)
        excess = variance_between(values - mean, weights)
    wider = (len(numbers) - 1) / max(len(numbers) - 3, 1)
    reached = np.array([p.reach for p in hypothesis.parameters][:count])
    reached = np.pad(reached, (0, count - len(reached)))
    shared = excess * wider / len(pair.problem.runs)
    return np.where(reached > 0, 0.0, shared)


def _own_arguments(problem: Problem, hypothesis: Hypothesis) -> Use | None:
    """Return generic forces of a hypothesis's arguments and symmetry; None where there are none."""
    if hypothesis.apply is not None:
        if not hypothesis.arguments:
            return None
        columns = frozenset(hypothesis.arguments)
        return Use(
            lambda state, arguments: bool(arguments) and arguments <= columns, hypothesis.parity
        )
    if set(hypothesis.columns) & {*CURRENTS}:
        return None
    commands = frozenset(problem.runs[0].log.vessel.commands)
    known = {*problem.structure.states}
    own: dict[str, frozenset[str]] = {}
    signs = set()
    for name in hypothesis.columns:
        term = parse_term(name)
        signals: set[str] = set()
        sign = mirror_sign(term.state)
        for factor in term.factors:
            # a bump on one side only has parts of both
            sign *= 0 if factor.bump else 1 if factor.modulus else mirror_sign(factor.signal)
            if factor.signal in known:
                signals.add(factor.signal)
            elif factor.signal in problem.structure.inputs:
                signals |= commands
            else:
                return None
        own[term.state] = own.get(term.state, frozenset()) | signals
        signs.add(sign)
    return Use(
        lambda state, arguments: state in own and arguments <= own[state],
        signs.pop() if len(signs) == 1 else 0,
    )
