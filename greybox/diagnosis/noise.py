"""Models of coloured free-run errors, and whitening by them.

Between sensor noise, which a sample forgets, and what moves the ship beside the model,
which the ship and the disturbance remember, the error of a free run has a state-space
form of few numbers a channel. Its innovations are nearly white whatever the mixture,
and the same filter applied to sensitivities keeps their sums comparable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from greybox.numerics.linalg import bounded_step
from greybox.numerics.recursion import filtered, recursive
from greybox.numerics.robust import white_noise

Array = NDArray[np.float64]

# share of an error that is left after a sample, beyond which it does not tell from a drift
_LONGEST = 0.999
# process noise that an error always has, in deviations of the sensor
_LEAST = 1e-5
# logarithm of the process noise in deviations of the sensor, memory as a logit: bounds,
# starts, and how strongly memory stays where the log tells nothing of it
_SHARE, _MEMORY, _LEVEL = (-7.0, 3.0), (-4.0, 6.0), (-3.0, 3.0)
_STARTS = ((-3.0, 1.0), (-1.0, 2.5))
_PRIOR, _PRIOR_WEIGHT = 1.0, 0.02
# how often the Riccati equation's horizon is doubled: a filter's memory of 2²⁰ samples is reached
_DOUBLINGS = 20
# share of the sensors' deviation from which on what moves the ship beside the model is seen
SEEN = 0.2
# iterations of a search, and of one that begins near; a fall of −2 log L that ends it
_MOST_STEPS, _NEAR_STEPS, _ENOUGH = 40, 12, 0.02
_DAMPING_LIMIT = 1e6


@dataclass(frozen=True)
class NoiseModel:
    """Innovations form of the errors of one group of channels.

    ``e = C x + v``, ``x⁺ = A x + w``, and the innovations by the stationary Kalman gain K:
    L⁻¹ (I − C (z − A + K C)⁻¹ K) e with L Lᵀ their covariance before.

    Parameters
    ----------
    outputs : tuple of int
    numerators : ndarray
        (k, k, n+1) of that transfer function, in powers of the delay.
    denominator : ndarray
        (n+1,)
    root : ndarray
        (k, k) L.
    sensor : ndarray
        (k,) deviation of v.
    force, memory : float
        Deviation of what moves the ship beside the model, and its share left after a sample.
    """

    outputs: tuple[int, ...]
    numerators: Array
    denominator: Array
    root: Array
    sensor: Array
    force: float = 0.0
    memory: float = 0.0

    def whiten(self, e: Array) -> Array:
        """Return innovations of unit variance.

        Parameters
        ----------
        e : ndarray
            (N, k, m) errors or sensitivities of this group's outputs.
        """
        return np.stack(self.innovations(list(e.transpose(1, 2, 0)))).transpose(2, 0, 1)

    def innovations(self, channels: Sequence[Array]) -> list[Array]:
        """Return innovations of unit variance, (m, N) of each channel, of channels (m, N)."""
        if len(self.denominator) == 1:
            return [self.numerators[i, i, 0] * e for i, e in enumerate(channels)]
        return filtered(self.numerators, self.denominator, channels)

    @property
    def remembered(self) -> float:
        """Samples for which what moves the ship beside the model is remembered."""
        return float(-1 / np.log(self.memory)) if self.memory > 0 else 0.0

    @property
    def share(self) -> float:
        """Deviation of what moves the ship beside the model, in that of the sensor."""
        return self.force / max(float(self.sensor[0]), 1e-300)

    @property
    def log_det(self) -> float:
        """Logarithm of the determinant of the innovations' covariance."""
        return 2 * float(np.log(np.diag(self.root)).sum())


@dataclass(frozen=True)
class Noise:
    """Colours of all channels.

    Parameters
    ----------
    groups : tuple of NoiseModel
        Whose outputs together are all channels.
    parameters : tuple of ndarray
        Logarithms and memory that each was made from; empty where no colour was fitted.
    """

    groups: tuple[NoiseModel, ...]
    parameters: tuple[Array, ...]

    def whiten(self, e: Array) -> Array:
        """Return innovations (N, ny, m) of errors or sensitivities (N, ny, m)."""
        # filters run along time, which is therefore last in memory
        channels = e.transpose(1, 2, 0)
        out = np.empty(channels.shape)
        for group in self.groups:
            found = group.innovations([channels[i] for i in group.outputs])
            for i, nu in zip(group.outputs, found, strict=True):
                out[i] = nu
        return out.transpose(2, 0, 1)

    @property
    def coloured(self) -> bool:
        """Whether errors are weighed by a colour that was fitted, and not by their size alone."""
        return bool(self.parameters)

    def with_sensors(self, deviations: Array) -> Noise:
        """Return it with other deviations (ny,) of the sensors."""
        groups = [replace(g, sensor=deviations[list(g.outputs)]) for g in self.groups]
        return replace(self, groups=tuple(groups))

    @property
    def log_det(self) -> float:
        """Of all groups."""
        return sum(g.log_det for g in self.groups)

    @property
    def log_sizes(self) -> Array:
        """What each channel adds to `log_det`, (ny,)."""
        out = np.zeros(sum(len(g.outputs) for g in self.groups))
        for group in self.groups:
            out[list(group.outputs)] = 2 * np.log(np.diag(group.root))
        return out


def _system(
    k: int, pole: ca.SX, sample_time: ca.SX, x: ca.SX, level: ca.SX
) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
    """Return A, Q, R and the force's variance of a group of k channels.

    The first channel's error decays with `pole` and is pushed by a force with a memory;
    a second one integrates it, as the heading does the yaw rate.
    """
    n = k + 1
    size = level * ca.exp(x[2:])
    rho = _LONGEST / (1 + ca.exp(-x[1]))
    a = ca.SX.zeros(n, n)
    a[0, 0], a[0, n - 1], a[n - 1, n - 1] = pole, 1, rho
    if k == 2:
        a[1, 0], a[1, 1] = sample_time, 1
    force = ca.exp(2 * x[0]) * size[0] ** 2
    q = _LEAST**2 * ca.diag(ca.vertcat(size**2, 0))
    q[n - 1, n - 1] = force * (1 - rho**2)
    return a, q, ca.diag(size**2), force


@lru_cache(maxsize=4)
def _filter(k: int, slopes: bool = False) -> ca.Function:
    """Return ``(x, level, pole, dt) -> transfer, L, memory, force``, or ``∂ transfer`` in x.

    ``transfer`` holds numerators, denominator and the logarithms of L's diagonal. The
    covariance of the prediction solves the Riccati equation by doubling: one function, called
    again and again, since an expression of all doublings takes a second to differentiate.

    References
    ----------
    Anderson (1978); Chu, Fan and Lin (2005), the structure-preserving form.
    """
    given = [ca.MX.sym("x", 2 + k), ca.MX.sym("level", k), ca.MX.sym("pole"), ca.MX.sym("dt")]
    begun, doubled, ended = _riccati(k)
    move, informed, p = begun(*given)
    for _ in range(_DOUBLINGS):
        move, informed, p = doubled(move, informed, p)
    transfer, *rest = ended(p, *given)
    found = [ca.jacobian(transfer, given[0])] if slopes else [transfer, *rest]
    return ca.Function("filter", given, found)


def _riccati(k: int) -> tuple[ca.Function, ca.Function, ca.Function]:
    """Return functions to begin the Riccati equation's doubling, for one, and of its solution."""
    n = k + 1
    x, level = ca.SX.sym("x", 2 + k), ca.SX.sym("level", k)
    pole, dt = ca.SX.sym("pole"), ca.SX.sym("dt")
    given = [x, level, pole, dt]
    a, q, r, force = _system(k, pole, dt, x, level)
    c = ca.horzcat(ca.SX.eye(k), ca.SX.zeros(k, 1))
    begun = [a.T, c.T @ ca.diag(1 / ca.diag(r)) @ c, q]

    move, informed, p = (ca.SX.sym(name, n, n) for name in ("move", "informed", "p"))
    shrunk = ca.inv_minor(ca.densify(ca.SX.eye(n) + informed @ p))
    later = p + move.T @ p @ shrunk @ move
    twice = _symmetric(informed + move @ shrunk @ informed @ move.T)
    doubled = [move @ shrunk @ move, twice, _symmetric(later)]

    s = c @ p @ c.T + r
    gain = a @ p @ c.T @ ca.inv_minor(ca.densify(s))
    root = ca.chol(s).T
    # Faddeev and LeVerrier: the adjugate of z − F by powers of z
    closed, inverse = a - gain @ c, ca.inv_minor(ca.densify(root))
    powers, denominator, term = [inverse], [ca.SX(1)], ca.SX.eye(n)
    for power in range(1, n + 1):
        powers.append(-inverse @ c @ term @ gain)
        moved = closed @ term
        denominator.append(-ca.trace(moved) / power)
        term = moved + denominator[power] * ca.SX.eye(n)
    numerators = [
        powers[power][i, j] + (inverse[i, j] * denominator[power] if power else 0)
        for i in range(k)
        for j in range(k)
        for power in range(n + 1)
    ]
    transfer = ca.vertcat(*numerators, *denominator, ca.log(ca.diag(root)))
    ended = [transfer, root, a[-1, -1], ca.sqrt(force)]

    def function(name: str, of: list[ca.SX], told: list[ca.SX]) -> ca.Function:
        return ca.Function(name, of, list(map(ca.densify, told)), {"cse": True})

    return (
        function("begun", given, begun),
        function("doubled", [move, informed, p], doubled),
        function("ended", [p, *given], ended),
    )


def _symmetric(matrix: ca.SX) -> ca.SX:
    return (matrix + matrix.T) / 2


def _transfer(k: int, values: Array) -> tuple[Array, Array, Array]:
    """Return numerators (k, k, n+1, ...), denominator (n+1, ...) and log diagonal (k, ...)."""
    n = k + 1
    ends = np.cumsum([k * k * (n + 1), n + 1])
    numerators, denominator, logs = np.split(values, ends)
    return numerators.reshape(k, k, n + 1, *values.shape[1:]), denominator, logs


def _colour(group: tuple[int, ...], rest: tuple[Array, float, float], x: Array) -> NoiseModel:
    k = len(group)
    transfer, root, memory, force = (np.array(m) for m in _filter(k)(x, *rest))
    numerators, denominator, _ = _transfer(k, transfer[:, 0])
    sensor = rest[0] * np.exp(x[2:])
    return NoiseModel(
        group, numerators, denominator, root, sensor, float(force[0, 0]), float(memory[0, 0])
    )


class Likelihood:
    """−2 log L of the errors of a group, its gradient and Fisher information.

    Parameters
    ----------
    parts : sequence of ndarray
        (N, k) errors of each log.
    rest : tuple
        Scale of each channel (k,), what is left of its own error after a sample, sample time [s].
    known : sequence of ndarray of bool, optional
        (N, k) samples that count; a filter passes over the others. By default all.
    """

    def __init__(
        self,
        parts: Sequence[Array],
        rest: tuple[Array, float, float],
        known: Sequence[NDArray[np.bool_]] | None = None,
    ) -> None:
        self.rest, self.k = rest, parts[0].shape[1]
        # side by side, the ends together: a filter that rests passes zeros over
        self._errors = np.zeros((self.k, len(parts), max(map(len, parts))))
        for i, part in enumerate(parts):
            self._errors[:, i, -len(part) :] = part.T
        counted = np.zeros(self._errors.shape, bool)
        for i, part in enumerate(parts):
            counted[:, i, -len(part) :] = True if known is None else known[i].T
        self._known = counted.reshape(self.k, -1)
        # numbers of each channel
        self.counts = self._known.sum(axis=1)
        self._last: tuple[Array, _Filtered] | None = None

    def _at(self, x: Array) -> _Filtered:
        # slopes are asked for where a value was found
        if self._last is None or not np.array_equal(self._last[0], x):
            found = _transfer(self.k, np.array(_filter(self.k)(x, *self.rest)[0])[:, 0])
            numerators, denominator, logs = found
            past = self._past(self._errors, denominator)
            nu = numerators.reshape(self.k, -1) @ past.reshape(numerators[0].size, -1)
            self._last = (x, _Filtered(denominator, logs, past, nu))
        return self._last[1]

    def _past(self, series: Array, denominator: Array) -> Array:
        """Return series (k, logs, N) by 1/A as of 0 to n samples earlier, (k, n+1, samples)."""
        made = recursive(denominator, series.reshape(self._errors.shape))
        out = np.zeros((self.k, len(denominator), *made.shape[1:]))
        for j in range(len(denominator)):
            out[:, j, :, j:] = made[:, :, : made.shape[2] - j]
        return out.reshape(self.k, len(denominator), -1)

    def value(self, x: Array) -> float:
        """Return −2 log L at x, and the price of a memory far from what is usual."""
        at = self._at(x)
        price = _PRIOR_WEIGHT * float(x[1] - _PRIOR) ** 2
        squares = float((at.nu**2).sum(where=self._known))
        return price + 2 * float(self.counts @ at.logs) + squares

    def slopes(self, x: Array) -> tuple[Array, Array]:
        """Return the gradient (q,) and the Fisher information (q, q) of −2 log L at x."""
        at = self._at(x)
        slope_n, slope_d, slope_l = _transfer(
            self.k, np.array(_filter(self.k, True)(x, *self.rest))
        )
        gradient = 2 * self.counts @ slope_l
        information = 2 * slope_l.T * self.counts @ slope_l
        past = at.past.reshape(-1, at.past.shape[2])
        own = self._past(at.nu, at.denominator)
        for i, nu in enumerate(at.nu):
            rows = slope_n[i].reshape(len(past), -1).T @ past - slope_d.T @ own[i]
            rows *= self._known[i]
            gradient += 2 * rows @ nu
            information += 2 * rows @ rows.T
        gradient[1] += 2 * _PRIOR_WEIGHT * (x[1] - _PRIOR)
        information[1, 1] += 2 * _PRIOR_WEIGHT
        return gradient, information


@dataclass(frozen=True)
class _Filtered:
    """Errors passed through a filter.

    Parameters
    ----------
    denominator, logs : ndarray
        (n+1,) A of the filter, and (k,) the logarithms of L's diagonal.
    past : ndarray
        (k, n+1, samples) errors by 1/A as of 0 to n samples earlier.
    nu : ndarray
        (k, samples) innovations.
    """

    denominator: Array
    logs: Array
    past: Array
    nu: Array


def fit_noise(
    errors: Sequence[Array],
    poles: Array,
    sample_time: float,
    groups: Sequence[tuple[int, ...]],
    start: Noise | None = None,
    longest: float = np.inf,
    known: Sequence[NDArray[np.bool_]] | None = None,
) -> Noise:
    """Fit the colours by maximum likelihood.

    Parameters
    ----------
    errors : sequence of ndarray
        (N, ny) free-run errors of each log.
    poles : ndarray
        (ny,) how much of a channel's own error is left after a sample.
    sample_time : float
        [s]
    groups : sequence of tuple of int
        Channels that share a state: a yaw rate and its heading, or one alone.
    start : Noise, optional
        From which the search begins.
    longest : float
        Samples that what moves the ship beside the model is remembered at most.
    known : sequence of ndarray of bool, optional
        (N, ny) where each channel was measured; by default everywhere.
    """
    found, chosen = [], []
    begun = () if start is None else start.parameters
    for g, group in enumerate(groups):
        x, colour = _fit_group(
            [e[:, list(group)] for e in errors], group, float(poles[group[0]]), sample_time,
            begun[g] if begun else None, longest,
            None if known is None else [k[:, list(group)] for k in known],
        )  # fmt: skip
        found.append(colour)
        chosen.append(x)
    return Noise(tuple(found), tuple(chosen))


def assumed_noise(
    sensor: Array,
    process: Array,
    poles: Array,
    sample_time: float,
    groups: Sequence[tuple[int, ...]],
    memory: float = 0.0,
) -> Noise:
    """Return the colours that errors of a trial not sailed yet are expected to have.

    Parameters
    ----------
    sensor : ndarray
        (ny,) deviation of each channel's sensor.
    process : ndarray
        (ny,) deviation of what moves each state beside the model, per sample.
    poles : ndarray
        (ny,) as of `fit_noise`.
    sample_time : float
        [s]
    groups : sequence of tuple of int
        As of `fit_noise`.
    memory : float
        Share of what moves the states that is left after a sample.
    """
    kept = float(np.clip(memory, 1e-9, 0.9999 * _LONGEST))
    logit = float(np.clip(np.log(kept / (_LONGEST - kept)), *_MEMORY))
    found, chosen = [], []
    for group in groups:
        first = group[0]
        level = np.maximum(sensor[list(group)], 1e-3 * process[first])
        share = float(np.log(max(process[first] / level[0], np.exp(_SHARE[0]))))
        x = np.array([share, logit, *np.zeros(len(group))])
        rest = (level, float(np.clip(poles[first], 0.0, _LONGEST)), sample_time)
        found.append(_colour(group, rest, x))
        chosen.append(x)
    return Noise(tuple(found), tuple(chosen))


def _known_only(
    errors: Sequence[Array], known: Sequence[NDArray[np.bool_]] | None
) -> Sequence[Array]:
    """Return errors (N, ny) of each log, not a number where nothing was measured."""
    if known is None:
        return errors
    return [np.where(k, e, np.nan) for k, e in zip(known, errors, strict=True)]


def white_deviations(
    errors: Sequence[Array], known: Sequence[NDArray[np.bool_]] | None = None
) -> Array:
    """Return the deviations of the sensors that third differences of errors tell, (ny,).

    Parameters
    ----------
    errors, known
        As of `fit_noise`.
    """
    measured = _known_only(errors, known)

    def deviation(i: int) -> float:
        # where no neighbours were measured, of the lines between those that were
        found = (white_noise([e[:, i] for e in every]) for every in (measured, errors))
        return max(next((f for f in found if f), 0.0), 1e-12)

    return np.array([deviation(i) for i in range(errors[0].shape[1])])


def free_run_noise(
    errors: Sequence[Array],
    groups: Sequence[tuple[int, ...]],
    start: Noise | None = None,
    known: Sequence[NDArray[np.bool_]] | None = None,
) -> Noise:
    """Return the metric of least squares: each state's errors in their own deviation.

    What a misfit leaves is slow, and a colour that takes it for the sea's own hides every slow
    cause. Here nothing is hidden; tests and standard errors must count the errors' memory. A
    heading tells what its rate does, and does not count twice.

    Parameters
    ----------
    errors : sequence of ndarray
        (N, ny) free-run errors of each log.
    groups : sequence of tuple of int
        As of `fit_noise`.
    start : Noise, optional
        Whose sensors' deviations are kept; by default those of third differences.
    known : sequence of ndarray of bool, optional
        (N, ny) where each channel was measured; by default everywhere.
    """
    every = np.concatenate(_known_only(errors, known))
    counts = np.maximum((~np.isnan(every)).sum(axis=0), 1)
    size = np.maximum(np.sqrt(np.nansum(every**2, axis=0) / counts), 1e-12)
    white = np.zeros(len(size)) if start is not None else white_deviations(errors, known)
    made = []
    for g, group in enumerate(groups):
        k = len(group)
        own = np.ones(k)
        own[0] = size[group[0]]
        sensor = white[list(group)] if start is None else start.groups[g].sensor
        numerators = np.zeros((k, k, 1))
        numerators[0, 0, 0] = 1 / own[0]
        made.append(NoiseModel(group, numerators, np.ones(1), np.diag(own), sensor))
    return Noise(tuple(made), ())


def _fit_group(
    parts: Sequence[Array],
    group: tuple[int, ...],
    pole: float,
    sample_time: float,
    start: Array | None,
    longest: float,
    known: Sequence[NDArray[np.bool_]] | None,
) -> tuple[Array, NoiseModel]:
    """Return the logarithms and memory of one group, and its innovations form."""
    k = len(group)
    change = np.sqrt(np.mean(np.vstack([np.diff(p, axis=0) ** 2 for p in parts]), axis=0) / 2)
    # a channel without noise still needs a scale
    level = np.maximum(change, 1e-12)
    rest = (level, float(np.clip(pole, 0.0, _LONGEST)), sample_time)
    memory = _MEMORY
    if np.isfinite(longest):
        rho = float(np.exp(-1 / longest))
        memory = (_MEMORY[0], min(_MEMORY[1], float(np.log(rho / (_LONGEST - rho)))))
    bounds = np.array([_SHARE, memory, *[_LEVEL] * k])
    firsts = [np.array([*s, *np.zeros(k)]) for s in _STARTS] if start is None else [start]
    most = _MOST_STEPS if start is None else _NEAR_STEPS
    likelihood = Likelihood(parts, rest, known)
    found = [_minimised(likelihood, x0, bounds, most) for x0 in firsts]
    x = min(found, key=lambda item: item[0])[1]
    return x, _colour(group, rest, x)


def _minimised(
    likelihood: Likelihood, start: Array, bounds: Array, most: int
) -> tuple[float, Array]:
    """Return the least −2 log L and where it is, by damped Fisher scoring within bounds."""
    x = np.clip(start, bounds[:, 0], bounds[:, 1])
    cost, damping = likelihood.value(x), 1e-3
    for _ in range(most):
        gradient, information = likelihood.slopes(x)
        if not (np.isfinite(information).all() and np.isfinite(gradient).all()):
            break
        fall = 0.0
        while damping <= _DAMPING_LIMIT:
            low, high = (bounds - x[:, None]).T
            step = bounded_step(information, -gradient, low, high, damping)
            trial = likelihood.value(x + step)
            if trial < cost:
                fall, cost, x = cost - trial, trial, x + step
                damping = max(damping / 10, 1e-6)
                break
            damping *= 10
        if fall < _ENOUGH:
            break
    return cost, x
