"""Least squares and instrumental variables on logs that are read in passes.

A pass leaves sums of each segment: triangles (`Sums`) that hold all that its samples tell of
each equation. Instruments are simulated segment by segment; estimates, residuals and standard
errors follow from the sums alone.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from greybox.errors import ExcitationError
from greybox.estimation.covariance import allow_for_segments
from greybox.estimation.normal_equations import Solution, Sums
from greybox.estimation.result import Estimate
from greybox.estimation.solve import (
    form_estimate,
    iterate_instruments,
    largest_of,
    samples_kept,
    solve_equations,
)
from greybox.estimation.values import EstimationData, Iteration
from greybox.model.predictor import Predictor
from greybox.numerics.linalg import scaled_inverse
from greybox.regression.problem import RegressionSettings
from greybox.regression.regression import build_experiment
from greybox.trial.log import TrialLog
from greybox.trial.stream import LogStream

Array = NDArray[np.float64]
_log = logging.getLogger(__name__)

# a coefficient has settled when its next move would be less than this share of its standard error
_SETTLED = 1e-2
# share of the samples in segments whose simulation may leave its bound: they take no part
_MAY_DIVERGE = 0.1
# groups of segments whose sums are kept apart, for the spread between them
_GROUPS = 1000


@dataclass(frozen=True)
class LogSums:
    """What one segment, or a group of them, tells.

    Parameters
    ----------
    samples, kept : int
        Rows there are, and rows that take part.
    equations : tuple of Sums
    largest : ndarray
        (2, p) the largest size of each regressor, and of each instrument.
    diverged : str
        Empty, or where the simulation left its bound: there are no sums then.
    """

    samples: int
    kept: int
    equations: tuple[Sums, ...]
    largest: Array
    diverged: str = ""


def sum_log(
    settings: RegressionSettings, theta: Array | None, cut: Array | str | None, log: TrialLog
) -> LogSums:
    """Return the sums of one segment.

    Parameters
    ----------
    settings : RegressionSettings
    theta : ndarray, optional
        (p,) parameters of the structure that simulate the instruments; without them the
        regressors are the instruments.
    cut : ndarray or "measured", optional
        Parameters whose simulated states cut the rows near the margins, or the measured ones;
        by default `theta`.
    log : TrialLog
    """
    predictor = settings.predictor
    own = build_experiment(predictor, log, margins=settings.margins)
    keep: NDArray[np.bool_] = own.keep
    z: Array | None = None
    samples, none = len(keep), np.zeros((2, len(own.phi)))
    if theta is not None:
        rows = [own.keep] if isinstance(cut, str) else None
        if isinstance(cut, np.ndarray) and settings.margins:
            rows = list(settings.simulated([log], cut).keep)
        made = settings.simulated([log], theta, rows or None)
        if made.diverged:
            return LogSums(samples, 0, (), none, made.diverged)
        keep, z = made.keep[0], made.z[0]
    equations = []
    for row, state in enumerate(predictor.structure.states):
        mine = predictor.equation(state)
        phi, y = samples_kept(own.phi[mine], keep), samples_kept(own.y[row], keep)
        equations.append(Sums.of(None if z is None else samples_kept(z[mine], keep), phi, y))
    size = largest_of(own.phi, keep)
    largest = np.stack([size, size if z is None else largest_of(z, keep)])
    return LogSums(samples, int(keep.sum()), tuple(equations), largest)


@dataclass(frozen=True)
class StreamSums:
    """The sums of one pass.

    Parameters
    ----------
    stream : LogStream
        Without what could not be read.
    groups : tuple of LogSums
        Segments, or neighbours together where there are many.
    keep : ndarray
        Parameters whose simulated states cut the rows.
    lost : tuple of str
        Why segments take no part: their simulation left its bound.
    diverged : str
        Empty, or why there is no estimate.
    """

    stream: LogStream
    groups: tuple[LogSums, ...]
    keep: Array | str | None
    lost: tuple[str, ...] = ()
    diverged: str = ""

    @property
    def samples(self) -> int:
        """Rows there are."""
        return sum(g.samples for g in self.groups)

    @property
    def kept(self) -> int:
        """Rows that take part."""
        return sum(g.kept for g in self.groups)

    @cached_property
    def whole(self) -> tuple[Sums, ...]:
        """The sums of all segments, one an equation."""
        return tuple(
            Sums.together(equation)
            for equation in zip(*(g.equations for g in self.groups), strict=True)
        )


@dataclass
class _Passes:
    """Passes over a stream, each without the files that an earlier one could not read."""

    settings: RegressionSettings
    stream: LogStream
    count: int = field(default=0, init=False)

    def sums(self, theta: Array | None, cut: Array | str | None) -> StreamSums:
        """Read the whole stream once."""
        self.count += 1
        self.stream, found = self.stream.run(partial(sum_log, self.settings, theta, cut))
        made = [s for _, s in found]
        lost = tuple(s.diverged for s in made if s.diverged)
        away = sum(s.samples for s in made if s.diverged)
        _log.info("pass %d: %d segments", self.count, len(made))
        bad = lost[0] if away > _MAY_DIVERGE * sum(s.samples for s in made) else ""
        size = -(-len(made) // _GROUPS)
        good = [s for s in made if not s.diverged]
        groups = tuple(_together(good[k : k + size]) for k in range(0, len(good), size))
        own = theta if cut is None else cut
        return StreamSums(self.stream, groups, own, lost, bad)


def _together(group: Sequence[LogSums]) -> LogSums:
    """Add the sums of neighbouring segments."""
    if len(group) == 1:
        return group[0]
    return LogSums(
        sum(g.samples for g in group),
        sum(g.kept for g in group),
        tuple(Sums.together(e) for e in zip(*(g.equations for g in group), strict=True)),
        np.max([g.largest for g in group], axis=0),
    )


def solve_sums(predictor: Predictor, sums: StreamSums) -> list[Solution]:
    """Solve the equations of a pass.

    Raises
    ------
    ExcitationError
        Some direction is not excited; its parameters are named.
    """
    largest = np.max([g.largest for g in sums.groups], axis=0)
    return solve_equations(
        predictor,
        lambda row, mine: sums.whole[row].solve(),
        (largest[0], largest[1]),
        sums.kept,
        sums.samples,
    )


def _covariance(predictor: Predictor, sums: StreamSums, solutions: Sequence[Solution]) -> Array:
    """Return the covariance of the estimate (p, p) by the spread of scores between segments.

    Scores are sums over whole segments, so residuals may have any colour that is forgotten
    over a segment.

    References
    ----------
    Liang and Zeger (1986); Bell and McCaffrey (2002).
    """
    p, groups = len(predictor.columns), len(sums.groups)
    moved, parts, breads = np.zeros((groups, p)), [], []
    for row, (state, solution) in enumerate(
        zip(predictor.structure.states, solutions, strict=True)
    ):
        mine = predictor.equation(state)
        weights = sums.whole[row].combination(solution)
        scores, moments = (
            np.array(a)
            for a in zip(
                *(g.equations[row].scores(weights, solution.theta) for g in sums.groups),
                strict=True,
            )
        )
        bread = scaled_inverse(solution.information)
        moved[:, mine] = scores @ bread.T
        parts.append((scores, moments))
        breads.append(bread)
    if groups < 2:
        raise ExcitationError(
            f"the stream holds {groups} segment, and standard errors need the spread between at "
            f"least 2: give more --memory, so that it is estimated as a whole."
        )
    found = moved.T @ moved * groups / (groups - 1)
    # equations follow each other in `parts`, columns of a predictor need not
    order = np.concatenate([predictor.equation(s) for s in predictor.structure.states])
    place = np.ix_(order, order)
    out = np.zeros((p, p))
    out[place] = allow_for_segments(found[place], parts, breads)
    return out


@dataclass(frozen=True)
class Streamed:
    """An estimate from a stream, with what its passes saw.

    Parameters
    ----------
    estimate : Estimate
        Without tests.
    sums : StreamSums
        Of the last pass.
    solutions : tuple of Solution
        One an equation.
    passes : int
        Over the stream, for the sums.
    """

    estimate: Estimate
    sums: StreamSums
    solutions: tuple[Solution, ...]
    passes: int


def estimate_sums(
    settings: RegressionSettings,
    stream: LogStream,
    data: EstimationData,
    start: Array | None,
    refine: bool | int = True,
) -> Streamed:
    """Estimate by passes over a stream.

    Parameters
    ----------
    settings : RegressionSettings
    stream : LogStream
    data : EstimationData
        What is known of the logs; samples are counted here.
    start : ndarray, optional
        (p,) parameters of the structure that simulate the first instruments; least squares
        without them.
    refine : bool or int
        As `estimate_iv`; it ends once the next move of each coefficient, by the ratio of the
        last two, would be less than a hundredth of its standard error.

    Raises
    ------
    ExcitationError
        Some direction is not excited, or even the first simulation diverges.
    LogError
        No file can be read any more.
    """
    predictor = settings.predictor
    passes = _Passes(settings, stream)
    iteration = Iteration()
    solutions: Sequence[Solution]
    if start is None:
        sums = passes.sums(None, "measured")
        solutions = solve_sums(predictor, sums)
    else:
        before = np.inf

        def settled(
            moved: Array, previous: Array, made: StreamSums, found: Sequence[Solution]
        ) -> bool:
            nonlocal before
            std = np.sqrt(np.maximum(np.diag(_covariance(predictor, made, found)), 0.0))
            move = float((moved / std).max())
            _log.info("pass %d: largest move %.3g standard errors", passes.count, move)
            # moves shrink by about the same factor each time; the first tells of none
            shrinks = min(move / before, 1.0) if np.isfinite(before) else 1.0
            before = move
            return move * shrinks < _SETTLED

        sums, solutions, iteration = iterate_instruments(
            predictor, start, "measured", passes.sums, partial(solve_sums, predictor), refine,
            settled,
        )  # fmt: skip
    centred = settings.zero_mean and start is not None
    left = [
        [g.equations[row].squares(s.theta, centred=centred) for g in sums.groups]
        for row, s in enumerate(solutions)
    ]
    estimate = form_estimate(
        settings,
        "ls" if start is None else "iv",
        solutions,
        _covariance(predictor, sums, solutions),
        np.sum(left, axis=1),
        replace(data, samples=sums.samples, kept=sums.kept),
        stream.vessel,
        sums.stream.interval,
        covariance_kind="cluster",
        iteration=iteration,
    )
    return Streamed(estimate, sums, tuple(solutions), passes.count)
