"""Scores: what each cause could explain of the errors, computed together without refitting.

The sensitivity of the free run to a cause, less what the coefficients and the start can
imitate, is what its error would look like. How much of the squared innovations lies
along it ranks the causes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.fitting import Problem, measured, stacked
from greybox.diagnosis.hypothesis import Hypothesis
from greybox.diagnosis.noise import Noise
from greybox.diagnosis.point import Fit, Point
from greybox.numerics.linalg import bounded_step, tall_svd
from greybox.numerics.recursion import propagate

Array = NDArray[np.float64]

CHANGE = "parameter_change"
# moments at which a change is tried
MOMENTS = 19
# share of a direction that must be left when the nuisance is taken out
_OWN = 1e-6
# factor at which a change's search begins, at least so far from one
_LEAST_FACTOR, _MOST_FACTOR = 0.3, 3.0


@dataclass(frozen=True)
class Score:
    """The improvement that a cause promises before it is fitted.

    Parameters
    ----------
    hypothesis : Hypothesis
    value : ndarray
        Where its fit should begin.
    gain : float
        Predicted fall of −2 log L.
    """

    hypothesis: Hypothesis
    value: Array
    gain: float


class ProjectedScores:
    """Innovations and directions with the nuisance taken out.

    Parameters
    ----------
    problem : Problem
    fit : Fit
    noise : Noise
        Metric; by default that of the fit.
    """

    def __init__(self, problem: Problem, fit: Fit, noise: Noise | None = None) -> None:
        self.problem, self.fit = problem, fit
        self.noise = fit.noise if noise is None else noise
        # a run at the edge of stability has derivatives beyond numbers' range, which tell nothing
        nuisance = np.nan_to_num(stacked(problem.rows(fit.point, self.noise)), posinf=0, neginf=0)
        scale = np.sqrt((nuisance**2).sum(axis=0))
        scale[scale == 0] = 1.0
        self.basis = tall_svd(nuisance / scale, 1e-8)[0]
        self.nu = self._clear(stacked(problem.whitened(self.noise, fit.errors)[0]))

    def _clear(self, rows: Array) -> Array:
        return np.asarray(rows - self.basis @ (self.basis.T @ rows))

    def clear(self, columns: Sequence[Array]) -> tuple[Array, Array]:
        """Return whitened columns (n, m) without nuisance, and their squares before (m,).

        Parameters
        ----------
        columns : sequence of ndarray
            (N, ny, m) of each log.
        """
        rows = stacked(self.problem.whiten(self.noise, columns))
        return self._clear(rows), (rows**2).sum(axis=0)

    def alone(self, columns: Sequence[Array]) -> tuple[Array, Array, Array]:
        """Return of whitened columns, each by itself, what `clear` leaves to tell.

        Parameters
        ----------
        columns : sequence of ndarray
            (N, ny, m) of each log.

        Returns
        -------
        tuple of ndarray
            (m,) products with the innovations, and squares without and with nuisance.
        """
        others = np.column_stack([self.basis, self.nu])
        size, first = columns[0].shape[2], 0
        across, before = np.zeros((size, others.shape[1])), np.zeros(size)
        with np.errstate(over="ignore", invalid="ignore"):
            for part, known in zip(columns, self.problem.known, strict=True):
                samples, channels, _ = part.shape
                beside = others[first : first + samples * channels].reshape(samples, channels, -1)
                first += samples * channels
                # time is last in memory
                white = measured(self.noise.whiten(part), known)
                for i, channel in enumerate(white.transpose(1, 2, 0)):
                    across += channel @ beside[:, i]
                    before += np.einsum("mt,mt->m", channel, channel)
            return across[:, -1], before - (across[:, :-1] ** 2).sum(axis=1), before

    def gain(
        self, cleared: Array, before: Array, bounds: Array | None = None
    ) -> tuple[float, Array]:
        """Return the fall of −2 log L and the coefficients of directions taken together.

        Parameters
        ----------
        cleared, before : ndarray
            (n, m) and (m,), see `clear`.
        bounds : ndarray, optional
            (m, 2) least and largest coefficient.
        """
        own = (cleared**2).sum(axis=0) > _OWN * before
        coefficients = np.zeros(cleared.shape[1])
        if not own.any() or not np.isfinite(cleared[:, own]).all():
            return 0.0, coefficients
        rows = cleared[:, own]
        if bounds is None:
            found = np.linalg.lstsq(rows, self.nu, rcond=1e-8)[0]
        else:
            # a cause whose bounds exclude what the errors ask for promises nothing
            low, high = np.minimum(bounds[own, 0], 0.0), np.maximum(bounds[own, 1], 0.0)
            found = bounded_step(rows.T @ rows, rows.T @ self.nu, low, high, 0.0)
        coefficients[own] = found
        taken = rows @ found
        return float(2 * self.nu @ taken - taken @ taken), coefficients


def score_hypotheses(directions: ProjectedScores, hypotheses: Sequence[Hypothesis]) -> list[Score]:
    """Score every hypothesis at a fit, the most promising first.

    Parameters
    ----------
    directions : ProjectedScores
    hypotheses : sequence of Hypothesis
        Not in force yet.
    """
    out = [
        *_score_columns(directions, [a for a in hypotheses if a.apply is None]),
        *_score_moves(directions, [a for a in hypotheses if a.apply and a.cause != CHANGE]),
        *_score_changes(directions, [a for a in hypotheses if a.cause == CHANGE]),
    ]
    return sorted(out, key=lambda s: -s.gain)


def _score_columns(directions: ProjectedScores, hypotheses: Sequence[Hypothesis]) -> list[Score]:
    problem, point = directions.problem, directions.fit.point
    names = list(dict.fromkeys(n for a in hypotheses for n in a.columns))
    if not names:
        return []
    places = np.array([problem.place(n) for n in names])
    ship = point.ship
    slopes = []
    for run, start in zip(problem.runs, point.starts, strict=True):
        shown = run.run(ship, start)
        slopes.append(run.columns(ship, shown, places)[:, :, : len(names)])
    cleared, before = directions.clear(slopes)
    out = []
    for hypothesis in hypotheses:
        index = [names.index(n) for n in hypothesis.columns]
        free = [(-np.inf, np.inf)] * len(index)
        # those that are freed with it have no bounds
        bounds = np.array([*((p.low, p.high) for p in hypothesis.parameters), *free][: len(index)])
        gain, _ = directions.gain(cleared[:, index], before[index], bounds)
        out.append(Score(hypothesis, np.zeros(0), gain))
    return out


def _score_moves(directions: ProjectedScores, hypotheses: Sequence[Hypothesis]) -> list[Score]:
    """Score hypotheses by how the run moves from the null to where their search begins."""
    problem, point = directions.problem, directions.fit.point
    now = [r.run(point.ship, s).y for r, s in zip(problem.runs, point.starts, strict=True)]

    def moved(ship_of: Point) -> list[Array] | None:
        ship = ship_of.ship
        parts = [
            r.run(ship, s).y - y for r, s, y in zip(problem.runs, point.starts, now, strict=True)
        ]
        return parts if all(np.isfinite(p).all() for p in parts) else None

    out = []
    for hypothesis in hypotheses:
        best = Score(hypothesis, hypothesis.start, -np.inf)
        for value in (hypothesis.start, *(np.array(s) for s in hypothesis.starts)):
            parts, bounds = [], []
            if not len(value):
                one = moved(problem.add(point, hypothesis, value))
                parts = [one] if one is not None else []
            for i, parameter in enumerate(hypothesis.parameters):
                trial = np.array([p.null for p in hypothesis.parameters])
                off = value[i] != parameter.null
                trial[i] = value[i] if off else parameter.null + parameter.step
                one = moved(problem.add(point, hypothesis, trial))
                if one is not None:
                    parts.append([p / (1.0 if off else parameter.step) for p in one])
                    size = value[i] - parameter.null if off else parameter.step
                    ends = (parameter.low - parameter.null, parameter.high - parameter.null)
                    bounds.append(sorted(end / size for end in ends))
            if not parts:
                continue
            columns = [np.stack([p[k] for p in parts], axis=2) for k in range(len(now))]
            cleared, before = directions.clear(columns)
            if len(value):
                gain, _ = directions.gain(cleared, before, np.array(bounds))
            else:
                # a channel is reversed or it is not
                gain = float(2 * cleared[:, 0] @ directions.nu - cleared[:, 0] @ cleared[:, 0])
            if gain > best.gain:
                best = Score(hypothesis, value, gain)
        out.append(best)
    return out


def _score_changes(directions: ProjectedScores, hypotheses: Sequence[Hypothesis]) -> list[Score]:
    """Score changes of coefficients at many moments at once."""
    problem, point = directions.problem, directions.fit.point
    if not hypotheses:
        return []
    ship = point.ship
    least = min(run.duration for run in problem.runs)
    moments = np.linspace(0.05, 0.95, MOMENTS) * least
    names = [a.parameters[0].name.removesuffix("_factor") for a in hypotheses]
    index = np.array([problem.structure.index(n) for n in names])
    columns = []
    for run, start in zip(problem.runs, point.starts, strict=True):
        shown = run.run(ship, start)
        linear = run.linearise(ship, shown, index)
        after = run.time[:-1, None] >= moments
        driven = linear.driven * ship.theta[index]
        both = (driven[:, :, :, None] * after[:, None, None, :]).reshape(*driven.shape[:2], -1)
        slope = propagate(linear.a, both, np.zeros(both.shape[1:]))
        columns.append(run.seen(ship, slope)[:, :, : both.shape[2]])
    along, squares, before = directions.alone(columns)
    # a run at the edge of stability has derivatives beyond numbers' range, which tell nothing
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        factor = along / squares
        gain = along * factor
        told = (squares > _OWN * before) & np.isfinite(gain)
    gain, factor = np.where(told, gain, 0.0), np.where(told, factor, 0.0)
    gain, factor = gain.reshape(len(hypotheses), -1), factor.reshape(len(hypotheses), -1)
    out = []
    for k, hypothesis in enumerate(hypotheses):
        j = int(np.argmax(gain[k]))
        first = float(np.clip(1 + factor[k, j], _LEAST_FACTOR, _MOST_FACTOR))
        out.append(Score(hypothesis, np.array([first, moments[j]]), float(gain[k, j])))
    return out
