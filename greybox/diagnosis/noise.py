"""The colour of free-run errors, and its removal.

Between sensor noise, which a sample forgets, and what moves the ship beside the model,
which the ship and the disturbance remember, the error of a free run has a state-space
form of few numbers a channel. Its innovations are nearly white whatever the mixture,
and the same filter applied to sensitivities keeps their sums comparable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_discrete_are, solve_triangular

from greybox.model.run.kernels import accumulate

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
_UNROLLED = 10
# how far each number of a colour commonly moves in a search, which makes its hills round
_SCALE, _LEVEL_SCALE = (0.1, 0.3), 0.02
# share of the sensors' deviation from which on what moves the ship beside the model is seen
SEEN = 0.2
# iterations of a search, and of one that begins near
_MOST_STEPS, _NEAR_STEPS = 40, 20


@dataclass(frozen=True)
class NoiseModel:
    """Innovations form of the errors of one group of channels.

    ``e = C x + v``, ``x⁺ = A x + w``: ``closed`` = A − K C, ``gain`` = K and
    ``root`` with root·rootᵀ the covariance of the innovations; ``sensor`` (k,) deviation
    of v, ``force`` of w, and its ``memory`` from sample to sample.
    """

    outputs: tuple[int, ...]
    c: Array
    closed: Array
    gain: Array
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
        from scipy.signal import lfilter

        numerators, denominator = self._transfer
        out = np.zeros(e.shape)
        for i, row in enumerate(numerators):
            for j, numerator in enumerate(row):
                if numerator.any():
                    out[:, i] += lfilter(numerator, denominator, e[:, j], axis=0)
        return out

    @cached_property
    def _transfer(self) -> tuple[Array, Array]:
        """Numerators (k, k, n+1) and denominator (n+1,) of root⁻¹ (I − C (z − A + K C)⁻¹ K)."""
        k, n = self.c.shape
        inverse = solve_triangular(self.root, np.eye(k), lower=True)
        # Faddeev and LeVerrier: the adjugate of z − F by powers of z
        denominator = np.ones(n + 1)
        term = np.eye(n)
        numerators = np.zeros((k, k, n + 1))
        for power in range(1, n + 1):
            numerators[:, :, power] = -inverse @ self.c @ term @ self.gain
            moved = self.closed @ term
            denominator[power] = -np.trace(moved) / power
            term = moved + denominator[power] * np.eye(n)
        return numerators + inverse[:, :, None] * denominator, denominator

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
        Logarithms and memory that each was made from.
    """

    groups: tuple[NoiseModel, ...]
    parameters: tuple[Array, ...]

    def whiten(self, e: Array) -> Array:
        """Return innovations (N, ny, m) of errors or sensitivities (N, ny, m)."""
        out = np.empty_like(e)
        for group in self.groups:
            out[:, group.outputs] = group.whiten(e[:, group.outputs])
        return out

    @property
    def log_det(self) -> float:
        """Of all groups."""
        return sum(g.log_det for g in self.groups)


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
def _matrices(k: int) -> ca.Function:
    pole, sample_time = ca.SX.sym("pole"), ca.SX.sym("dt")
    x, level = ca.SX.sym("x", 2 + k), ca.SX.sym("level", k)
    parts = [ca.densify(m) for m in _system(k, pole, sample_time, x, level)[:3]]
    return ca.Function("system", [pole, sample_time, x, level], parts)


@lru_cache(maxsize=32)
def _likelihood(k: int, blocks: int) -> ca.Function:
    """Return ``(x, pole, dt, level, [e; use]) -> −2 log L, gradient in x`` by a Kalman filter."""
    n = k + 1
    x, level = ca.SX.sym("x", 2 + k), ca.SX.sym("level", k)
    pole, dt = ca.SX.sym("pole"), ca.SX.sym("dt")
    constants = ca.vertcat(x, level, pole, dt)
    a, q, r, force = _system(k, pole, dt, x, level)
    # a covariance is carried by its lower triangle: half of what follows is never computed
    half = ca.Sparsity.lower(n)
    state = ca.SX.sym("state", n + half.nnz() + 1)
    data = ca.SX.sym("data", k + 1, _UNROLLED)
    now = state
    for j in range(_UNROLLED):
        z, cov, total = now[:n], ca.tril2symm(ca.SX(half, now[n:-1])), now[-1]
        use = data[k, j]
        for i in range(k):
            column = cov[:, i]
            variance = column[i] + r[i, i]
            error = data[i, j] - z[i]
            total += use * (error**2 / variance + ca.log(variance))
            gain = use * column / variance
            z = z + gain * error
            cov = ca.tril2symm(ca.tril(cov - gain @ column.T))
        cov = a @ cov @ a.T + q
        now = ca.vertcat(a @ z, ca.tril(ca.densify(cov)).nz[:], total)
    step = ca.Function("step", [state, data, constants], [ca.densify(now)], {"cse": True})
    run = accumulate(step, blocks)
    first = ca.SX.zeros(n + half.nnz() + 1)
    first[n + half.nnz() - 1] = force
    begin = ca.Function("begin", [constants], [ca.densify(first)])
    given = ca.MX.sym("x", 2 + k)
    rest = ca.MX.sym("rest", k + 2)
    series = ca.MX.sym("e", k + 1, _UNROLLED * blocks)
    constant = ca.vertcat(given, rest)
    end = run(begin(constant), series, ca.repmat(constant, 1, blocks))
    value = end[-1, -1]
    return ca.Function("likelihood", [given, rest, series], [value, ca.gradient(value, given)])


def _innovations_form(
    group: tuple[int, ...], pole: float, sample_time: float, level: Array, x: Array
) -> NoiseModel:
    k = len(group)
    a, q, r = (np.array(m) for m in _matrices(k)(pole, sample_time, x, level))
    c = np.eye(k, k + 1)
    p = solve_discrete_are(a.T, c.T, q, r, balanced=True)
    s = c @ p @ c.T + r
    gain = np.linalg.solve(s, c @ p @ a.T).T
    sensor = level * np.exp(x[2:])
    return NoiseModel(
        group, c, a - gain @ c, gain, cholesky(s, lower=True), sensor,
        float(np.exp(x[0]) * sensor[0]), float(a[-1, -1]),
    )  # fmt: skip


def fit_noise(
    errors: Sequence[Array],
    poles: Array,
    sample_time: float,
    groups: Sequence[tuple[int, ...]],
    start: Noise | None = None,
    longest: float = np.inf,
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
    """
    found, chosen = [], []
    for g, group in enumerate(groups):
        x, colour = _fit_group(
            [e[:, list(group)] for e in errors], group, float(poles[group[0]]), sample_time,
            None if start is None else start.parameters[g], longest,
        )  # fmt: skip
        found.append(colour)
        chosen.append(x)
    return Noise(tuple(found), tuple(chosen))


def _fit_group(
    parts: Sequence[Array],
    group: tuple[int, ...],
    pole: float,
    sample_time: float,
    start: Array | None,
    longest: float,
) -> tuple[Array, NoiseModel]:
    """Return the logarithms and memory of one group, and its innovations form."""
    from scipy.optimize import minimize

    k = len(group)
    change = np.sqrt(np.mean(np.vstack([np.diff(p, axis=0) ** 2 for p in parts]), axis=0) / 2)
    # a channel without noise still needs a scale
    level = np.maximum(change, 1e-12)
    pole = float(np.clip(pole, 0.0, _LONGEST))
    rest = np.concatenate([level, [pole, sample_time]])
    padded = []
    for part in parts:
        blocks = -(-len(part) // _UNROLLED)
        series = np.zeros((k + 1, blocks * _UNROLLED))
        series[:k, : len(part)] = part.T
        series[k, : len(part)] = 1.0
        padded.append((_likelihood(k, blocks), series))

    scale = np.array([*_SCALE, *[_LEVEL_SCALE] * k])

    def loss(scaled: Array) -> tuple[float, Array]:
        x = scaled * scale
        value = _PRIOR_WEIGHT * float(x[1] - _PRIOR) ** 2
        slope = np.zeros(len(x))
        slope[1] = 2 * _PRIOR_WEIGHT * (x[1] - _PRIOR)
        for function, series in padded:
            v, s = function(x, rest, series)
            value += float(v)
            slope += np.array(s).ravel()
        return value, slope * scale

    memory = _MEMORY
    if np.isfinite(longest):
        rho = float(np.exp(-1 / longest))
        memory = (_MEMORY[0], min(_MEMORY[1], float(np.log(rho / (_LONGEST - rho)))))
    bounds = np.array([_SHARE, memory, *[_LEVEL] * k]) / scale[:, None]
    firsts = [np.array([*s, *np.zeros(k)]) for s in _STARTS] if start is None else [start]
    results = [
        minimize(
            loss, x0 / scale, jac=True, method="L-BFGS-B", bounds=bounds,
            options={"maxiter": _MOST_STEPS if start is None else _NEAR_STEPS, "ftol": 1e-6},
        )
        for x0 in firsts
    ]  # fmt: skip
    best = scale * np.asarray(min(results, key=lambda result: float(result.fun)).x, float)
    return best, _innovations_form(group, pole, sample_time, level, best)
