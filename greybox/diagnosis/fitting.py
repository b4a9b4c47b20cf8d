"""Fitting a ship under a hypothesis to logs: free runs, whitened errors, Gauss-Newton."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.hypothesis import Hypothesis, Parameter
from greybox.diagnosis.linear import NOWHERE
from greybox.diagnosis.noise import Noise, fit_noise, free_run_noise
from greybox.diagnosis.point import Fit, Point
from greybox.diagnosis.ship import CURRENTS, LogRun, Ship
from greybox.diagnosis.thresholds import DECIDED
from greybox.model.run.step import MONOTONE
from greybox.numerics.lagged_moments import automatic_lags, bartlett_sums
from greybox.numerics.linalg import bounded_step, known_and_unknown_inverse

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Metric = Literal["coloured", "free run"]

# a step that promises less than this of −2 log L ends the search
_ENOUGH = 0.02
MOST = 25
# share of the largest eigenvalue below which a covariance tells nothing of a direction
_UNKNOWN = 1e-9
# a point that −2 log L tells from another by less than this has its derivatives
_NEAR = 1.0
# a fall of −2 log L that differs from what its step promised by less than this share shows that
# the derivatives of the last step serve the next one, too
_AS_PROMISED = 0.2
_DAMPING_LIMIT = 1e6
# mean square of a log's errors, in that of all logs, that has a logarithm
_LEAST_SIZE = 1e-12
# points and fits whose derivatives and covariances are kept at hand: one, and one beside it
_KEPT = 2
# values at which hills of a likelihood are looked for
_HILLS = 25


def groups_of(run: LogRun) -> list[tuple[int, ...]]:
    """Return channels that share a state of the noise: the yaw rate with the heading."""
    names = run.outputs
    out: list[tuple[int, ...]] = []
    for i, name in enumerate(names):
        if name == "r" and "psi" in names:
            out.append((i, names.index("psi")))
        elif name != "psi":
            out.append((i,))
    return out


# derivatives (N, ny, m) of a log's outputs in those of the free numbers that move them, and
# where these m stand among all
_Own = tuple[Array, NDArray[np.int_]]


@dataclass(frozen=True)
class _Normal:
    """Whitened derivatives of each log at a vector (q,) of free numbers, their squares (q, q)."""

    at: Array
    rows: tuple[_Own, ...]
    matrix: Array

    @classmethod
    def of(cls, at: Array, rows: tuple[_Own, ...]) -> _Normal:
        matrix = np.zeros((len(at), len(at)))
        # of a run at the edge of stability the derivatives may leave every number's range
        with np.errstate(over="ignore", invalid="ignore"):
            for own, where in rows:
                by_channel = own.transpose(1, 2, 0)
                matrix[np.ix_(where, where)] += sum(r @ r.T for r in by_channel)
        return cls(at, rows, matrix)

    def gradient(self, nu: Sequence[Array]) -> Array:
        """Return what innovations (N, ny) of each log lie along the derivatives, (q,)."""
        out = np.zeros(len(self.at))
        for (own, where), seen in zip(self.rows, nu, strict=True):
            by_channel = zip(own.transpose(1, 2, 0), seen.T, strict=True)
            out[where] += sum(r @ n for r, n in by_channel)
        return out

    def near(self, vector: Array) -> bool:
        """Whether these derivatives do for a vector, too."""
        away = vector - self.at
        with np.errstate(over="ignore", invalid="ignore"):
            return bool(away @ self.matrix @ away < _NEAR)


def stacked(parts: Sequence[Array]) -> Array:
    """Return columns (N, ny, m) of logs, or innovations (N, ny), as one (sum of N·ny, ...)."""
    return np.concatenate([p.reshape(-1, *p.shape[2:]) for p in parts])


def measured(e: Array, known: Mask) -> Array:
    """Return innovations (N, ny, m), zero where nothing was measured."""
    return e if known.all() else np.where(known[:, :, None], e, 0.0)


class Problem:
    """Logs, ready to be explained.

    Parameters
    ----------
    runs : sequence of LogRun
        Of one structure and sample time.
    metric : {"coloured", "free run"}
        What errors are weighed by: their colour, by maximum likelihood, or their size alone, by
        least squares, where a misfit would pass for colour.
    """

    def __init__(self, runs: Sequence[LogRun], metric: Metric = "coloured") -> None:
        self.runs, self.metric = tuple(runs), metric
        # where each output was measured, (N, ny) of each log: nothing else counts
        self.known = tuple(run.known for run in runs)
        self.structure = runs[0].structure
        self.sample_time = runs[0].sample_time
        self.groups = groups_of(runs[0])
        self.names = (*self.structure.parameters, *CURRENTS)
        self._known: tuple[Point, list[_Own]] | None = None
        # of the last points and fits that were asked for: several tests ask for the same
        self._rows: deque[tuple[Point, Noise, list[Array]]] = deque(maxlen=_KEPT)
        self._covariances: deque[tuple[Fit, tuple[Array, Array]]] = deque(maxlen=_KEPT)

    def place(self, name: str) -> int:
        """Return the index of a coefficient or current."""
        return self.names.index(name)

    def add(self, point: Point, hypothesis: Hypothesis, value: Array | None = None) -> Point:
        """Return the point with one more hypothesis in force."""
        value = hypothesis.start if value is None else value
        if hypothesis.apply is not None:
            return replace(
                point,
                hypotheses=(*point.hypotheses, hypothesis),
                values=(*point.values, np.array(value, float)),
            )
        places = self.numbers_at(hypothesis)
        new = [i for i in places if i not in point.places]
        return replace(
            point,
            hypotheses=(*point.hypotheses, hypothesis),
            values=(*point.values, np.zeros(0)),
            places=(*point.places, *new),
        )

    def numbers_at(self, hypothesis: Hypothesis) -> list[int]:
        """Return the coefficients and currents that a hypothesis frees."""
        return [self.place(n) for n in (*hypothesis.columns, *hypothesis.co_freed)]

    def numbers_of(self, point: Point, hypothesis: Hypothesis) -> list[int]:
        """Return where the numbers of a hypothesis stand among the free ones of a point."""
        if hypothesis.apply is None:
            return [point.places.index(i) for i in self.numbers_at(hypothesis)]
        k = [a.key for a in point.hypotheses].index(hypothesis.key)
        first = len(point.places) + sum(map(len, point.values[:k]))
        return list(range(first, first + len(point.values[k])))

    @cached_property
    def _least(self) -> Array:
        """Least coefficients (p,): more damping would look like less, as steps alternate."""
        limit = MONOTONE[self.runs[0].integrator]
        found = np.full(len(self.structure.terms), -np.inf)
        motion = np.abs(np.concatenate([run.y for run in self.runs])).T
        moved = dict(zip(self.runs[0].outputs, motion, strict=True))
        for i, term in enumerate(self.structure.terms):
            if term.dissipates and {f.signal for f in term.factors} <= set(self.structure.states):
                # of what acts as linear damping that takes as much energy out
                own = moved[term.state]
                force = np.prod([moved[f.signal] for f in term.factors if not f.bump], axis=0)
                if (taken := float((force * own).sum())) > 0:
                    found[i] = limit * float((own**2).sum()) / taken
        return found

    def bounds(self, point: Point) -> tuple[Array, Array]:
        """Return least and largest values of the free numbers of a point."""
        size = len(point.vector())
        low, high = np.full(size, -np.inf), np.full(size, np.inf)
        full = np.concatenate([self._least, np.full(len(CURRENTS), -np.inf)])
        low[: len(point.places)] = full[list(point.places)]
        if self.metric == "free run":
            # chosen damping takes energy out, as its choice had it
            terms = self.structure.terms
            high[
                [k for k, i in enumerate(point.places) if i < len(terms) and terms[i].dissipates]
            ] = 0.0
        for hypothesis in point.hypotheses:
            # coefficients that only become free beside it have no bounds
            for k, parameter in zip(
                self.numbers_of(point, hypothesis), hypothesis.parameters, strict=False
            ):
                low[k], high[k] = parameter.low, parameter.high
        return low, high

    def drop(self, point: Point, hypothesis: Hypothesis) -> Point:
        """Return the point without a hypothesis, its coefficients at zero."""
        k = [a.key for a in point.hypotheses].index(hypothesis.key)
        base = point.base
        places = point.places
        if hypothesis.apply is None:
            gone = self.numbers_at(hypothesis)
            for i in gone:
                base = base.with_value(i, 0.0)
            places = tuple(i for i in places if i not in gone)
        return replace(
            point,
            base=base,
            places=places,
            hypotheses=point.hypotheses[:k] + point.hypotheses[k + 1 :],
            values=point.values[:k] + point.values[k + 1 :],
        )

    def squares(self, errors: Sequence[Array]) -> Array:
        """Return the sums of squared errors (N, ny) of each log where measured, (ny,)."""
        parts = zip(errors, self.known, strict=True)
        return np.asarray(np.sum([(e**2).sum(axis=0, where=known) for e, known in parts], axis=0))

    @property
    def counts(self) -> NDArray[np.int_]:
        """How many samples of each output were measured, (ny,)."""
        return np.asarray(np.concatenate(self.known).sum(axis=0))

    def errors(self, point: Point) -> list[Array]:
        """Return measured less simulated of each log, infinite where a run escaped."""
        ship = point.ship
        return [
            run.y - run.run(ship, start).y
            for run, start in zip(self.runs, point.starts, strict=True)
        ]

    def whitened(self, noise: Noise, errors: Sequence[Array]) -> tuple[list[Array], float]:
        """Return innovations, zero where nothing was measured, and −2 log L of errors."""
        if not all(np.isfinite(e).all() for e in errors):
            return [], np.inf
        nu = [n[:, :, 0] for n in self.whiten(noise, [e[:, :, None] for e in errors])]
        with np.errstate(over="ignore"):
            cost = sum(float((n**2).sum()) for n in nu)
        return nu, cost + float(self.counts @ noise.log_sizes)

    def whiten(self, noise: Noise, columns: Sequence[Array]) -> list[Array]:
        """Return columns (N, ny, m) of each log whitened, zero where nothing was measured."""
        # of a run at the edge of stability the derivatives may leave every number's range
        with np.errstate(over="ignore", invalid="ignore"):
            return [
                measured(noise.whiten(c), known)
                for c, known in zip(columns, self.known, strict=True)
            ]

    def rows(self, point: Point, noise: Noise) -> list[Array]:
        """Return whitened derivatives of the outputs in the free numbers, (N, ny, q) per log."""
        for at, weighed_by, found in self._rows:
            if at is point and weighed_by is noise:
                return found
        made = self.whiten(noise, self.slopes(point))
        self._rows.append((point, noise, made))
        return made

    def slopes(self, point: Point) -> list[Array]:
        """Return derivatives of the outputs in the free numbers, (N, ny, q) per log."""
        q = len(point.vector())
        out = []
        for own, where in self.own_slopes(point):
            samples, outputs, _ = own.shape
            full = np.zeros((outputs, q, samples)).transpose(2, 0, 1)
            full[:, :, where] = own
            out.append(full)
        return out

    def own_slopes(self, point: Point) -> list[_Own]:
        """Return the derivatives of each log that may not be zero, and where in `slopes` they are.

        Those in the starts of other logs are left out.
        """
        ship = point.ship
        places = np.array(point.places, int)
        vector = point.vector()
        first = len(places)
        ways: list[tuple[Ship, Ship]] = []
        lengths = []
        for hypothesis, value in zip(point.hypotheses, point.values, strict=True):
            for parameter in hypothesis.parameters[: len(value)]:
                k = first + len(ways)
                step = parameter.step * np.array([-1, 1])
                ends = np.clip(vector[k] + step, parameter.low, parameter.high)
                one, two = (point.at(_with(vector, k, end)).ship for end in ends)
                ways.append((one, two))
                lengths.append(ends[1] - ends[0])
        inner = slice(first, first + len(ways))
        before = inner.stop
        out = []
        for run, start in zip(self.runs, point.starts, strict=True):
            slopes = run.columns(ship, run.run(ship, start), places, ways)
            slopes[:, :, inner] /= np.array(lengths)
            starts = np.arange(before, before + len(start))
            out.append((slopes, np.concatenate([np.arange(inner.stop), starts])))
            before += len(start)
        return out

    def fit(self, point: Point, noise: Noise, most: int = MOST, than: float | None = None) -> Fit:
        """Minimise −2 log L over the free numbers at a given noise.

        Parameters
        ----------
        point : Point
            Where it begins.
        noise : Noise
        most : int
            Iterations at most.
        than : float, optional
            −2 log L of a fit that this one is only compared with: it ends once a step is small
            beside the difference.
        """
        low, high = self.bounds(point)
        vector = np.clip(point.vector(), low, high)
        point = point.at(vector)
        errors = self.errors(point)
        nu, cost = self.whitened(noise, errors)
        converged = not np.isfinite(cost)
        damping = 0.0
        normal: _Normal | None = None
        for _ in range(most):
            if converged:
                break
            if normal is None:
                normal = self._normal(point, vector, noise)
            if not np.isfinite(normal.matrix).all():
                break
            gradient = normal.gradient(nu)
            accepted, fresh = False, normal.near(vector)
            while damping <= _DAMPING_LIMIT:
                step = bounded_step(normal.matrix, gradient, low - vector, high - vector, damping)
                promise = float(2 * gradient @ step - step @ normal.matrix @ step)
                if promise < _ENOUGH and damping < 1:
                    converged = fresh
                    break
                trial = point.at(vector + step)
                trial_errors = self.errors(trial)
                trial_nu, trial_cost = self.whitened(noise, trial_errors)
                if trial_cost < cost:
                    accepted = True
                    break
                damping = max(10 * damping, 1e-3)
            if not accepted:
                if fresh:
                    break
                # derivatives made elsewhere decide nothing
                normal, damping = None, 0.0
                continue
            fell = cost - trial_cost
            little = fell < max(_ENOUGH, _decided(trial_cost, than))
            point, vector, errors, nu, cost = (
                trial, vector + step, trial_errors, trial_nu, trial_cost,
            )  # fmt: skip
            damping = damping / 10 if damping > 1e-5 else 0.0
            converged = little and fresh
            # as long as −2 log L falls as promised, the derivatives serve
            if not (normal.near(vector) or (abs(fell / promise - 1) < _AS_PROMISED and not little)):
                normal = None
        return Fit(
            point, noise, cost, tuple(nu), tuple(errors), converged, self.runs[0].integrator,
            self.known,
        )  # fmt: skip

    def _normal(self, point: Point, vector: Array, noise: Noise) -> _Normal:
        """Return the normal equations at a point, by derivatives made at it or near to it."""
        known = self._known
        if known is not None and known[0].alike(point):
            at = known[0].vector()
            if self._moved_little(vector - at, noise, known[1]):
                return _Normal.of(at, self._own_rows(noise, known[1]))
        self._known = (point, self.own_slopes(point))
        return _Normal.of(vector, self._own_rows(noise, self._known[1]))

    def _own_rows(self, noise: Noise, slopes: Sequence[_Own]) -> tuple[_Own, ...]:
        white = self.whiten(noise, [own for own, _ in slopes])
        return tuple((own, where) for own, (_, where) in zip(white, slopes, strict=True))

    def _moved_little(self, away: Array, noise: Noise, slopes: Sequence[_Own]) -> bool:
        """Whether derivatives do for a vector so far away: `_Normal.near` without a matrix."""
        with np.errstate(over="ignore", invalid="ignore"):
            moved = [np.matmul(away[where], own.transpose(1, 2, 0)).T for own, where in slopes]
            white = self.whiten(noise, [m[:, :, None] for m in moved])
            return bool(sum((w**2).sum() for w in white) < _NEAR)

    def profile(self, fit: Fit, k: int, values: Array) -> Array:
        """Return −2 log L at values (m,) of the free number k, the others following to first order.

        Constants apart; infinite where a run escapes.
        """
        parts = self.rows(fit.point, fit.noise)
        rows = stacked(parts)
        basis = np.linalg.qr(np.delete(rows, k, axis=1))[0]
        vector = fit.point.vector()
        out = np.full(len(values), np.inf)
        for i, value in enumerate(values):
            vector[k] = value
            nu, cost = self.whitened(fit.noise, self.errors(fit.point.at(vector)))
            if np.isfinite(cost):
                seen = stacked(nu)
                own = basis.T @ seen
                out[i] = float(seen @ seen - own @ own)
        return out

    def scan(self, fit: Fit, hypothesis: Hypothesis) -> Fit:
        """Return the fit with a hypothesis moved over the hills of its likelihood."""
        for k, parameter in self._hilly(fit, hypothesis):
            vector = fit.point.vector()
            tried = np.linspace(-parameter.reach, parameter.reach, _HILLS) + vector[k]
            tried = np.clip(tried, parameter.low, parameter.high)
            vector[k] = tried[int(np.argmin(self.profile(fit, k, tried)))]
            found = self.fit(fit.point.at(vector), fit.noise)
            fit = found if found.cost < fit.cost else fit
        return fit

    def spread(self, fit: Fit, hypothesis: Hypothesis) -> dict[str, float]:
        """Return standard errors of a hypothesis's numbers whose likelihood has hills.

        A third of the distance within which −2 log L rises by nine.
        """
        out = {}
        for k, parameter in self._hilly(fit, hypothesis):
            now = fit.point.vector()[k]
            tried = now + np.linspace(-parameter.reach, parameter.reach, 2 * _HILLS - 1)
            inside = (tried >= parameter.low) & (tried <= parameter.high)
            rise = self.profile(fit, k, tried[inside])
            near = tried[inside][rise < rise.min() + 9.0]
            out[parameter.name] = float(np.abs(near - now).max()) / 3
        return out

    def _hilly(self, fit: Fit, hypothesis: Hypothesis) -> list[tuple[int, Parameter]]:
        places = self.numbers_of(fit.point, hypothesis)
        found = zip(places, hypothesis.parameters, strict=False)
        return [] if fit.escaped else [(k, p) for k, p in found if p.reach > 0]

    def fit_starts(self, point: Point, noise: Noise) -> Fit:
        """Fit the starts alone, as a held-out log asks."""
        frozen = replace(
            point,
            base=replace(point.base),
            places=(),
            hypotheses=(),
            values=(),
            starts=tuple(run.start() for run in self.runs),
        )
        return self.fit(replace(frozen, base=point.ship), noise, most=8)

    def contributions(self, fit: Fit) -> list[Array]:
        """Return what each sample adds to −2 log L, (N,) per log."""
        return self.added(fit.nu, fit.noise)

    def added(self, nu: Sequence[Array], noise: Noise) -> list[Array]:
        """Return what each sample of innovations adds to −2 log L, (N,) per log.

        What a misfit leaves differs from log to log: by its size alone each log's errors have a
        deviation of their own, lest the worst one speak for all.
        """
        if noise.coloured:
            return [
                (n**2).sum(axis=1) + known @ noise.log_sizes
                for n, known in zip(nu, self.known, strict=True)
            ]
        counts = [np.maximum(known.sum(axis=0), 1) for known in self.known]
        sizes = [
            np.maximum((n**2).sum(axis=0) / count, _LEAST_SIZE)
            for n, count in zip(nu, counts, strict=True)
        ]
        return [
            (n**2 / size).sum(axis=1) + known @ (np.log(size) + noise.log_sizes)
            for n, size, known in zip(nu, sizes, self.known, strict=True)
        ]

    def costs(self, fit: Fit) -> Array:
        """Return −2 log L of each group of channels, (groups,)."""
        squares = (np.concatenate(fit.nu) ** 2).sum(axis=0)
        of_channels = squares + self.counts * fit.noise.log_sizes
        return np.array(
            [float(of_channels[list(group.outputs)].sum()) for group in fit.noise.groups]
        )

    def covariance(self, fit: Fit) -> tuple[Array, Array]:
        """Return the estimate's free numbers but the starts, and their covariance.

        Robust to what memory the innovations have left (Newey and West, 1987), and
        never less than what white innovations would give; infinite where the derivatives of a
        run at the edge of stability leave every number's range.
        """
        for of, found in self._covariances:
            if of is fit:
                return found
        made = self._robust_covariance(fit)
        self._covariances.append((fit, made))
        return made

    def _robust_covariance(self, fit: Fit) -> tuple[Array, Array]:
        rows = np.concatenate(self.rows(fit.point, fit.noise))
        nu = np.concatenate(fit.nu)
        samples, q = int(np.concatenate(self.known).any(axis=1).sum()), rows.shape[2]
        free = len(fit.point.places) + sum(map(len, fit.point.values))
        with np.errstate(over="ignore", invalid="ignore"):
            normal = np.einsum("kic,kid->cd", rows, rows)
            scores = np.einsum("kic,ki->kc", rows, nu)
        if not (np.isfinite(normal).all() and np.isfinite(scores).all()):
            return fit.point.vector()[:free], np.full((free, free), np.inf)
        lags = max(round(samples ** (1 / 3)), automatic_lags(nu))
        middle = bartlett_sums(scores, lags)
        # of columns that are alike only the sum is known, and scores tell nothing of the rest
        spread, unknown = known_and_unknown_inverse(normal, _UNKNOWN)
        robust = spread @ middle @ spread * samples / max(samples - q, 1)
        # rounding may leave nothing of a variance beside numbers that are hardly known
        lost = np.diag(robust) <= 0
        robust[lost], robust[:, lost] = 0.0, 0.0
        robust[lost, lost] = np.diag(spread)[lost]
        widen = np.sqrt(np.maximum(np.diag(spread) / np.maximum(np.diag(robust), 1e-300), 1.0))
        full = robust * np.outer(widen, widen) + unknown
        return fit.point.vector()[:free], full[:free, :free]

    def effect(self, fit: Fit, hypothesis: Hypothesis) -> tuple[Array, Array, Array]:
        """Return how far a hypothesis is from its null, how surely, and what moves it.

        Numbers with many hills have no null, and are left out.

        Returns
        -------
        tuple of ndarray
            (k,) numbers less their null, (k, k) their covariance, and (k, q) derivatives in the
            free numbers but the starts.
        """
        point = fit.point
        where = self.numbers_of(point, hypothesis)
        free = len(point.places) + sum(map(len, point.values))
        away, along = point.vector()[where], np.eye(free)[where]
        if hypothesis.apply is not None:
            away = away - [p.null for p in hypothesis.parameters]
            tested = [p.reach == 0 for p in hypothesis.parameters]
        if hypothesis.multiplied:
            place = self.place(hypothesis.multiplied)
            along[0] *= point.base.theta[place]
            if place in point.places:
                along[0, point.places.index(place)] = away[0]
            away[0] *= point.base.theta[place]
        if hypothesis.apply is not None:
            away, along = away[tested], along[tested]
        covariance = self.covariance(fit)[1]
        if not np.isfinite(covariance).all():
            return away, np.full((len(away),) * 2, np.inf), along
        return away, along @ covariance @ along.T, along

    def poles(self, point: Point) -> Array:
        """Return what is left of each channel's own error after a sample, on average."""
        ship = point.ship
        nx = len(self.structure.states)
        found = []
        for run, start in zip(self.runs, point.starts, strict=True):
            shown = run.run(ship, start)
            found.append(run.linearise(ship, shown, NOWHERE).a.mean(axis=0))
        mean = np.mean(found, axis=0)
        return np.array([mean[i, i] if i < nx else 1.0 for i in range(len(self.runs[0].outputs))])

    def noise_of(self, errors: Sequence[Array], point: Point, start: Noise | None = None) -> Noise:
        """Return what errors are weighed by."""
        if self.metric == "free run":
            return free_run_noise(errors, self.groups, start, self.known)
        poles = self.poles(point)
        return fit_noise(errors, poles, self.sample_time, self.groups, start, known=self.known)

    def forgetful(self, fit: Fit, longest: float) -> Fit:
        """Return the fit with the colour of its errors, which forgets after so many samples."""
        noise = fit_noise(
            fit.errors, self.poles(fit.point), self.sample_time, self.groups, longest=longest,
            known=self.known,
        )  # fmt: skip
        nu, cost = self.whitened(noise, fit.errors)
        return replace(fit, noise=noise, nu=tuple(nu), cost=cost)

    def settle(self, fit: Fit, rounds: int = 2, than: float | None = None) -> Fit:
        """Alternate between the noise and the fit; `than` as in `fit`."""
        for _ in range(rounds):
            if fit.escaped:
                return fit
            noise = self.noise_of(fit.errors, fit.point, fit.noise)
            before = self.whitened(noise, fit.errors)[1]
            fit = self.fit(fit.point, noise, than=than)
            if before - fit.cost < max(0.5, _decided(fit.cost, than)):
                break
        return fit


def _decided(cost: float, than: float | None) -> float:
    """Return the fall of −2 log L that decides nothing in a comparison with another fit's."""
    if than is None:
        return 0.0
    beyond = DECIDED * (cost - than)
    return beyond if beyond > 0 else min(-beyond, _NEAR)


def _with(vector: Array, k: int, value: float) -> Array:
    moved = vector.copy()
    moved[k] = value
    return moved
