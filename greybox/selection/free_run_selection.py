"""Selection of terms by free runs, forward and backward, judged on held-out parts.

At a free run of the terms that are in, one set of sensitivities tells of every term that
is out how much the squared error would fall (the score test of its coefficient, the other
coefficients adjusted). The best one enters and the run is fitted again; a term that earns
less than the one that came last leaves. A core that no run follows is first fitted, and
added to, while an observer holds the run near the log. Runs begin where the log was
measured to begin, as a prediction does: first states that are free to move would make up
for forces that are missing.

References
----------
Billings (2013), chapter 3, on forward selection in simulation; Pudil, Novovičová and
Kittler (1994), on letting terms leave again.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from greybox.errors import ExcitationError, so_many
from greybox.estimation.free_run import changes
from greybox.estimation.innovations import ObservedRuns
from greybox.estimation.output_setup import deviations, measured, output_model, output_predictor
from greybox.estimation.shooting import (
    FreeRuns,
    cut,
    measured_starts,
)
from greybox.model.disturbances import turn_bounds
from greybox.model.run.step import Integrator
from greybox.model.structure import Structure
from greybox.numerics.effort import require_time, seconds_left
from greybox.numerics.linalg import UNKNOWN, bounded_step, scaled_inverse
from greybox.regression.regression import common_sample_time
from greybox.trial.log import TrialLog

Array = NDArray[np.float64]
_Runs = FreeRuns | ObservedRuns

# process over measurement variance of the observers before the free run
_RATIOS = (0.3, 0.03, 3e-3, 3e-4)
# terms that may come at each of them where no free run follows
_AHEAD = 3
# iterations of a first fit, and the share of the error below which a step ends it
_FIRST, _SETTLED = 12, 3e-3
# share of the squared error that a term must take away, and that its own direction must hold
_EARNS, OWN = 4e-3, 1e-3
# gain by which a term that may drive the ship must exceed that of one that only takes energy out:
# u r and |u| r are one on logs ahead, and astern the one drives what the other brakes
_BRAKES = 1.25
# squared error of a run without any, in deviations
_LEAST = 1e-12
# candidates that are tried, the most promising first
_TRIED = 4
# share of the last term's gain below which another one leaves
_LEAVES = 0.5


@dataclass(frozen=True)
class _Point:
    """Parameters with the cost and its quadratic model there, in those that are `known`.

    `rows` are the derivatives (n, ny, known) that it was made of.
    """

    p: Array
    cost: float
    known: Sequence[int]
    hessian: Array
    gradient: Array
    bounds: tuple[Array, Array]
    rows: Array

    def solution(self, hessian: Array, gradient: Array, active: Array) -> Array:
        """Return the step (q,) that minimises the quadratic model over the active parameters."""
        step = np.zeros_like(self.p)
        low, high = (bound[active] - self.p[active] for bound in self.bounds)
        part = np.ix_(active, active)
        step[active] = bounded_step(
            hessian[part], gradient[active], np.minimum(low, 0.0), np.maximum(high, 0.0)
        )
        return step


@dataclass(frozen=True)
class Selected:
    """A set of terms with its fit.

    Parameters
    ----------
    terms : tuple of str
        Parameters that are in, disturbance means among them.
    p : ndarray
        (q,) all parameters of the family, zero where they are out.
    cost : float
        Mean squared error of the free runs in deviations of each output.
    change : str
        The term that came, ``+name``, or went, ``-name``.
    """

    terms: tuple[str, ...]
    p: Array
    cost: float
    change: str = ""


class FreeRunSelection:
    """Free runs of a family of terms on logs, and the path of sets that selection takes.

    Parameters
    ----------
    logs : sequence of TrialLog
        Of one vessel and sample time.
    family : Structure
    kind : str
        Predictor whose disturbance means may be selected too.
    integrator : {"euler", "rk4"}
    """

    def __init__(
        self,
        logs: Sequence[TrialLog],
        family: Structure,
        kind: str,
        integrator: Integrator = "euler",
    ) -> None:
        predictor, step = output_predictor(family, kind, ()), common_sample_time(logs)
        self.model = output_model(predictor, step, integrator=integrator)
        data = [measured(self.model, log) for log in logs]
        self.deviation = deviations(data)
        # a channel that rests shows no size by which its errors were small: its unit stands for one
        rests = np.ptp(np.concatenate([d.y for d in data]), axis=0) == 0
        self._floor = np.where(rests, 1.0, _LEAST)
        self._whole = cut(data, max(len(d.y) for d in data))
        self._change = np.maximum(changes(data), 1e-9 * self.deviation)
        self.runs = FreeRuns(self.model, self._whole, self.deviation)
        self.starts = measured_starts(self._whole, len(self.model.states))
        self.names = self.model.parameters
        self._used = self._whole.use.ravel() > 0
        self._samples = float(self._used.sum())
        self._least, self._most = (np.full(len(self.names), b) for b in (-np.inf, np.inf))
        for name, bounds in turn_bounds(step).items():
            if name in self.names:
                i = self.names.index(name)
                self._least[i], self._most[i] = bounds
        for i in self.model.predictor.parameter_columns:
            terms = [family.terms[family.index(t)] for t in self.model.columns[i].terms]
            if all(t.dissipates for t in terms):
                # damping takes energy out
                self._most[i] = 0.0

    def path(
        self,
        first: Sequence[str],
        stay: Sequence[str],
        most: int,
        *,
        earns: float = _EARNS,
        passed: Sequence[Selected] = (),
    ) -> list[Selected]:
        """Return the sets that selection passes through, each with its fit.

        Parameters
        ----------
        first : sequence of str
            Terms that it begins with.
        stay : sequence of str
            Those of them that never leave.
        most : int
            Terms at most.
        earns : float
            Share of the squared error that a term must take away.
        passed : sequence of Selected
            Where the same path, to fewer terms at most, has led already.

        Raises
        ------
        ExcitationError
            No set of terms follows the logs.
        OutOfTimeError
            Time was over before the first set; later the sets so far are returned.
        """
        kept = {self.names.index(n) for n in stay if n in self.names}
        active, at = self._first(first, most, earns) if not passed else self._last(passed)
        sets = [*passed] or [self._selected(active, at)]
        seen = {frozenset(map(self.names.index, s.terms)) for s in sets}
        while len(active) < most and seconds_left() > 0:
            found = self._with_one_more(self.runs, at, active, earns, seen)
            if found is None:
                break
            came, moved = found
            gain = at.cost - moved.cost
            active, at = sorted([*active, came]), moved
            left = self._without_one(at, active, kept | {came}, _LEAVES * gain, seen)
            while left is not None:
                gone, at = left
                active = [i for i in active if i != gone]
                seen.add(frozenset(active))
                sets.append(self._selected(active, at, "-" + self.names[gone]))
                left = self._without_one(at, active, kept | {came}, _LEAVES * gain, seen)
            seen.add(frozenset(active))
            sets.append(self._selected(active, at, "+" + self.names[came]))
        return sets

    def _first(self, first: Sequence[str], most: int, earns: float) -> tuple[list[int], _Point]:
        """Return the terms that a path begins with, and their fit.

        Raises
        ------
        ExcitationError
            No run of them stays bounded.
        """
        active = sorted(self.names.index(n) for n in first if n in self.names)
        active, p = self._begun(active, most, earns)
        at = self._fitted(self.runs, p, active)
        if not np.isfinite(at.cost):
            raise ExcitationError(
                f"no free run of {so_many(len(active), 'term')} stays bounded on the "
                f"{len(self.starts)} "
                f"logs: use longer logs, or name a structure with --structure."
            )
        return active, at

    def _last(self, passed: Sequence[Selected]) -> tuple[list[int], _Point]:
        """Return the terms that a path came to, and their fit."""
        active, p = sorted(map(self.names.index, passed[-1].terms)), passed[-1].p
        return active, self._at(self.runs, p, self._value(self.runs, p), active)

    def fitted(self, found: Selected) -> Selected:
        """Return a set of terms with the parameters that fit these logs, from those that it has."""
        active = [i for i, name in enumerate(self.names) if name in found.terms]
        return self._selected(active, self._fitted(self.runs, found.p, active), found.change)

    def errors(self, p: Array) -> list[Array]:
        """Return what a free run from each log's first samples leaves, (N, ny) per log.

        Infinite where it escapes.
        """
        y = self.runs.outputs(p, self.starts)
        return [
            (log - run)[used > 0]
            for log, run, used in zip(self._whole.y, y, self._whole.use, strict=True)
        ]

    def escapes(self, p: Array, bounds: tuple[Array, Array]) -> bool:
        """Whether a free run on one of the logs leaves its least or greatest states, (nx,) each."""
        least, most = bounds
        runs = self.runs.outputs(p, self.starts)
        return not all(
            ((y[:, : len(most)] >= least) & (y[:, : len(most)] <= most)).all() for y in runs
        )

    def _begun(self, active: list[int], most: int, earns: float) -> tuple[list[int], Array]:
        """Return terms, and parameters near those of a free run."""
        p = np.zeros(len(self.names))
        for ratio in _RATIOS:
            runs = ObservedRuns(self.model, self._whole, self._change**2 / 2, ratio)
            at = self._fitted(runs, p, active)
            if not self._value(self.runs, at.p) < 0:
                # no run of these terms follows: what the observer's errors ask for comes first
                for _ in range(_AHEAD):
                    found = self._with_one_more(runs, at, active, earns, set())
                    if found is None or len(active) >= most:
                        break
                    active, at = sorted([*active, found[0]]), found[1]
            p = at.p
        return active, p

    def _selected(self, active: Sequence[int], at: _Point, change: str = "") -> Selected:
        terms = tuple(self.names[i] for i in active)
        return Selected(terms, at.p, self._share(at.cost), change)

    def _share(self, cost: float) -> float:
        """Return the mean squared error that a change of −log L stands for, as a share."""
        return float(np.exp(2 * cost / (self._samples * len(self.model.outputs))))

    def _noise(self, r: Array) -> Array:
        """Return the mean squared residual of each output, (ny,)."""
        return np.asarray((r**2).sum(axis=(0, 1)) / self._samples + self._floor)

    def _value(self, runs: _Runs, p: Array) -> float:
        """Return −log L, the noise of each output concentrated, infinite where a run escapes."""
        r, _, _ = runs.value(p, self.starts)
        if not np.isfinite(r).all():
            return np.inf
        with np.errstate(over="ignore"):
            return 0.5 * self._samples * float(np.log(self._noise(r)).sum())

    def _rows(self, runs: _Runs, p: Array, only: Sequence[int]) -> Array:
        """Return derivatives of the used samples' outputs in some parameters, (n, ny, only)."""
        slopes = runs.by_parameters(p, self.starts, only)
        rows = slopes.reshape(-1, slopes.shape[2], len(only))
        return rows if self._used.all() else rows[self._used]

    def _by_output(self, runs: _Runs, p: Array) -> tuple[Array, Array]:
        """Return residuals of the used samples in noise deviations (ny, n), and weights (ny,).

        A weight takes a derivative into the same deviations.
        """
        weighted, _, _ = runs.value(p, self.starts)
        with np.errstate(over="ignore", invalid="ignore"):
            root = np.sqrt(self._noise(weighted))
            r = weighted.reshape(-1, weighted.shape[-1])[self._used] / root
        return r.T, 1 / (root * runs.sigma)

    def _at(self, runs: _Runs, p: Array, cost: float, known: Sequence[int]) -> _Point:
        """Return the quadratic model in some of the parameters, which takes a share of the time."""
        rows = self._rows(runs, p, known)
        normal, right = np.zeros((len(known), len(known))), np.zeros(len(known))
        with np.errstate(over="ignore", invalid="ignore"):
            # one output at a time: the rows of all are large
            for own, r, weight in zip(rows.swapaxes(0, 1), *self._by_output(runs, p), strict=True):
                normal += weight**2 * (own.T @ own)
                right += weight * (own.T @ r)
        hessian, gradient = np.zeros((len(p), len(p))), np.zeros(len(p))
        hessian[np.ix_(known, known)], gradient[known] = normal, right
        bounds = (self._least, self._most)
        return _Point(p, cost, known, hessian, gradient, bounds, rows)

    def _widened(self, runs: _Runs, at: _Point) -> _Point:
        """Return the quadratic model in all parameters, but without those that are out together."""
        known, out = np.array(at.known), np.setdiff1d(np.arange(len(at.p)), at.known)
        rows = self._rows(runs, at.p, out.tolist())
        cross, own, right = np.zeros((len(known), len(out))), np.zeros(len(out)), np.zeros(len(out))
        with np.errstate(over="ignore", invalid="ignore"):
            for mine, new, r, weight in zip(
                at.rows.swapaxes(0, 1), rows.swapaxes(0, 1), *self._by_output(runs, at.p),
                strict=True,
            ):  # fmt: skip
                cross += weight**2 * (mine.T @ new)
                own += weight**2 * np.einsum("ij,ij->j", new, new)
                right += weight * (new.T @ r)
        hessian, gradient = at.hessian.copy(), at.gradient.copy()
        hessian[np.ix_(known, out)], hessian[np.ix_(out, known)] = cross, cross.T
        hessian[out, out], gradient[out] = own, right
        return replace(at, hessian=hessian, gradient=gradient)

    def _moved(self, runs: _Runs, at: _Point, step: Array, known: Sequence[int]) -> _Point | None:
        """Return where a step or a part of it leads downhill, None where it does not."""
        for share in (1.0, 0.5, 0.2):
            p = at.p + share * step
            cost = self._value(runs, p)
            if cost < at.cost:
                return self._at(runs, p, cost, known)
        return None

    def _fitted(self, runs: _Runs, p: Array, active: Sequence[int]) -> _Point:
        """Return the fit of the active parameters, Levenberg-Marquardt where steps fail."""
        index = np.array(active)
        out = np.setdiff1d(np.arange(len(p)), index)
        p = p.copy()
        p[out] = 0.0
        cost = self._value(runs, p)
        if not np.isfinite(cost):
            p = np.zeros_like(p)
            cost = self._value(runs, p)
        at = self._at(runs, p, cost, index.tolist())
        for _ in range(_FIRST):
            require_time()
            moved = self._damped(runs, at, index)
            if moved is None:
                break
            done = self._share(moved.cost - at.cost) > 1 - _SETTLED
            at = moved
            if done:
                break
        return at

    def _damped(self, runs: _Runs, at: _Point, active: Array) -> _Point | None:
        for damping in (0.0, 1e-3, 1e-1, 10.0):
            hessian = at.hessian * (1 + damping * np.eye(len(at.p)))
            moved = self._moved(
                runs, at, at.solution(hessian, at.gradient, active), active.tolist()
            )
            if moved is not None:
                return moved
        return None

    def _with_one_more(
        self,
        runs: _Runs,
        at: _Point,
        active: Sequence[int],
        earns: float,
        seen: Set[frozenset[int]],
    ) -> tuple[int, _Point] | None:
        """Return the term that lowers the error most and the fit with it, None if none earns."""
        index = np.array(active)
        at = self._widened(runs, at)
        hessian, gradient = at.hessian, at.gradient
        inverse = scaled_inverse(hessian[np.ix_(index, index)], UNKNOWN)
        out = np.setdiff1d(np.arange(len(at.p)), index)
        cross = hessian[np.ix_(out, index)]
        own = np.diag(hessian)[out]
        left = own - np.einsum("ij,jk,ik->i", cross, inverse, cross)
        slope = gradient[out] - cross @ (inverse @ gradient[index])
        known = left > OWN * np.maximum(own, 0.0)
        least, most = self._least[out], self._most[out]
        known &= np.where(slope > 0, most > 0, least < 0)
        gains = np.where(known, 0.5 * slope**2 / np.where(known, left, 1.0), 0.0)
        brakes = (most == 0) & np.isneginf(least)
        for i in np.argsort(-gains * np.where(brakes, _BRAKES, 1.0))[:_TRIED]:
            tried = np.append(index, out[i])
            if self._share(-gains[i]) > 1 - earns or frozenset(tried.tolist()) in seen:
                continue
            moved = self._moved(runs, at, at.solution(hessian, gradient, tried), tried.tolist())
            if moved is None or self._share(moved.cost - at.cost) > 1 - earns:
                continue
            return int(out[i]), self._damped(runs, moved, tried) or moved
        return None

    def _without_one(
        self,
        at: _Point,
        active: Sequence[int],
        kept: Set[int],
        allowed: float,
        seen: Set[frozenset[int]],
    ) -> tuple[int, _Point] | None:
        """Return the term that earns least and the fit without it, None where all earn enough."""
        index = np.array(active)
        hessian, gradient = at.hessian, at.gradient
        variance = np.diag(scaled_inverse(hessian[np.ix_(index, index)], UNKNOWN))
        # what moves nothing earns nothing
        loss = np.divide(
            0.5 * at.p[index] ** 2, variance, out=np.zeros(len(index)), where=variance > 0
        )
        for i in np.argsort(loss):
            gone = int(index[i])
            if loss[i] > allowed:
                return None
            if gone in kept or frozenset(active) - {gone} in seen:
                continue
            rest = np.delete(index, i)
            away = at.solution(hessian, gradient + hessian[:, gone] * at.p[gone], rest)
            away[gone] = -at.p[gone]
            p = at.p + away
            p[gone] = 0.0
            cost = self._value(self.runs, p)
            if not cost < at.cost + allowed:
                return None
            after = self._at(self.runs, p, cost, rest.tolist())
            return gone, self._damped(self.runs, after, rest) or after
        return None
