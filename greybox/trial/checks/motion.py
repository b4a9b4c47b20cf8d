"""Positions, heading and velocities of a log on one grid, and the likelihood of what ties them.

Positions are the integral of the velocity, turned by the heading; the heading
is the integral of the yaw rate. What remains of either is white noise of the
position (or heading) sensor on top of a random walk, the integrated noise of
the velocity (or rate) sensor: a local-level model. Its innovations are white,
come from one recursive filter with gain K, and weigh slow and fast
disagreement as the noises demand; K is estimated by maximum likelihood.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from greybox.numerics.recursion import recursive
from greybox.numerics.robust import robust_deviation
from greybox.rotation import body_to_ned
from greybox.trial.convert.derived_signals import continuous
from greybox.trial.convert.resample import clock, stretches
from greybox.trial.raw_log import Array, Recording, Signal

T = TypeVar("T")
Key = TypeVar("Key")

NAMES = ("x_n", "y_n", "psi", "u", "v", "r")
_MAX_SAMPLES = 40_000
_MAX_STRETCHES = 30
_MIN_STRETCH = 20
# of an excerpt
_PIECES = 8
_ROBUST = 4.0
# reach of the kernels that are tried against noise, and samples left out beside each
_MOST_TAPS = 90
_LEFT_OUT = 2
# gains of the local-level filter; 1 is a pure random walk
GAINS = np.geomspace(0.003, 1.0, 9)


@dataclass(frozen=True)
class Motion:
    """Motion channels on a uniform grid, stretches without a gap one after another.

    Parameters
    ----------
    t : ndarray
        (N,) [s].
    step : float
        [s]
    values : dict of str to ndarray
        (N,) of those of ``NAMES`` that the log has; ψ continuous.
    stretches : tuple of (start, stop)
    """

    t: Array
    step: float
    values: dict[str, Array]
    stretches: tuple[tuple[int, int], ...]

    def __contains__(self, name: object) -> bool:
        return name in self.values

    def __getitem__(self, name: str) -> Array:
        return self.values[name]

    def __len__(self) -> int:
        return len(self.t)

    def excerpt(self, samples: int) -> Motion:
        """Return at most about `samples` samples, in pieces spread over the log."""
        if len(self) <= samples:
            return self
        size = samples // _PIECES
        parts = []
        for k in range(_PIECES):
            start = round(k * (len(self) - size) / (_PIECES - 1))
            a, b = next((s for s in self.stretches if s[0] <= start < s[1]), self.stretches[-1])
            a, b = max(start, a), min(start + size, b)
            if b - a >= _MIN_STRETCH:
                parts.append((a, b))
        return self.only(parts)[0]

    def only(self, parts: Sequence[tuple[int, int]]) -> tuple[Motion, NDArray[np.int64]]:
        """Return the motion in parts (start, stop) alone, and their rows."""
        rows, stretches = end_to_end(parts)
        values = {n: v[rows] for n, v in self.values.items()}
        return Motion(self.t[rows], self.step, values, stretches), rows

    def coarser(self, step: float) -> Motion:
        """Return means over blocks of at most `step` [s]."""
        size = int(step / self.step + 1e-6)
        if size < 2:
            return self
        blocks = [(a, (b - a) // size) for a, b in self.stretches if b - a >= _MIN_STRETCH * size]
        if not blocks:
            return self
        index = end_to_end([(a, a + n * size) for a, n in blocks])[0].reshape(-1, size)
        values = {n: v[index].mean(axis=1) for n, v in self.values.items()}
        stretches = end_to_end([(0, n) for _, n in blocks])[1]
        return Motion(self.t[index].mean(axis=1), size * self.step, values, stretches)

    @property
    def positioned(self) -> bool:
        """Whether positions, heading and velocities are all there."""
        return all(n in self.values for n in ("x_n", "y_n", "psi", "u", "v"))

    @property
    def turned(self) -> bool:
        """Whether heading and yaw rate are there."""
        return "psi" in self.values and "r" in self.values


def make_motion(recording: Recording, names: tuple[str, ...] = NAMES) -> Motion | None:
    """Bring the motion channels of a recording to one grid; None where too few overlap.

    The grid has the step of the slowest channel; long logs are cut to their
    first 40000 samples.
    """
    signals = {}
    for name in names:
        if name in recording:
            s = orderly(recording[name], angular=name == "psi")
            if len(s) >= _MIN_STRETCH:
                signals[name] = s
    if not signals:
        return None
    clocks = {n: clock(s.t, cuts=recording.cuts) for n, s in signals.items()}
    step = max(c.period for c in clocks.values())
    start = max(float(c.t[0]) for c in clocks.values())
    stop = min(float(c.t[-1]) for c in clocks.values())
    if step <= 0 or stop - start < _MIN_STRETCH * step:
        return None
    count = min(int((stop - start) / step + 1e-6) + 1, _MAX_SAMPLES)
    grid = start + step * np.arange(count, dtype=np.float64)
    whole = stretches(grid, clocks.values(), recording.cuts)
    longest = sorted((r for r in whole if r[1] - r[0] >= _MIN_STRETCH), key=lambda r: r[1] - r[0])
    kept = sorted(longest[-_MAX_STRETCHES:])
    if not kept:
        return None
    rows, one_after_another = end_to_end(kept)
    values = {n: np.interp(grid[rows], s.t, s.value) for n, s in signals.items()}
    return Motion(grid[rows], step, values, one_after_another)


def end_to_end(
    parts: Sequence[tuple[int, int]],
) -> tuple[NDArray[np.int64], tuple[tuple[int, int], ...]]:
    """Return the rows of parts (start, stop), and where each stands among these rows."""
    rows = [np.arange(a, b) for a, b in parts]
    edges = np.cumsum([0, *map(len, rows)]).tolist()
    return np.concatenate([np.empty(0, np.int64), *rows]), tuple(pairwise(edges))


def orderly(s: Signal, *, angular: bool) -> Signal:
    """Return a signal in the order of its times, each once and finite; an angle continuous."""
    keep = s.known
    t, once = np.unique(s.t[keep], return_index=True)
    value = s.value[keep][once]
    return Signal(s.name, t, continuous(value) if angular else value, s.unit)


def read_together(
    logs: Mapping[int, T],
    decide: Callable[[Sequence[T]], Key],
    contradicts: Callable[[T, Key], bool],
) -> list[tuple[Key, tuple[int, ...]]]:
    """Return what logs prefer together and which do, then each that contradicts it by itself.

    Where all contradict what they prefer together, it stands.
    """
    together, alone = list(logs), list[int]()
    while together:
        shared = decide([logs[i] for i in together])
        against = [i for i in together if len(together) > 1 and contradicts(logs[i], shared)]
        if not against or len(against) == len(together):
            break
        alone += against
        together = [i for i in together if i not in against]
    groups = [(shared, tuple(together))] if logs else []
    return groups + [(decide([logs[i]]), (i,)) for i in alone]


def integrate(rate: Array, motion: Motion) -> Array:
    """Integrate (N,) or (N, m) over time within each stretch, from zero.

    Fourth-order rule on the two samples beside each step, so that a turn
    between samples is not cut short.
    """
    out = np.zeros_like(rate)
    for a, b in motion.stretches:
        out[a + 1 : b] = motion.step * np.cumsum(means_between(rate[a:b]), axis=0)
    return out


def means_between(value: Array) -> Array:
    """Return means between neighbours along axis 0, by the cubic through four samples."""
    means = 0.5 * (value[1:] + value[:-1])
    if len(value) > 3:
        means[1:-1] = (13 * (value[1:-2] + value[2:-1]) - value[:-3] - value[3:]) / 24
    return np.asarray(means)


def slope(value: Array, motion: Motion) -> Array:
    """Return the rate of change of a channel by central differences within each stretch."""
    return np.concatenate([np.gradient(value[a:b], motion.step) for a, b in motion.stretches])


def whiten(z: Array, gain: float, motion: Motion, weight: Array | None = None) -> Array:
    """Return innovations of the local-level model, less what each stretch's start explains.

    A start is an unknown level; whitened it dies out by ``1 - gain`` a sample.

    Parameters
    ----------
    z : ndarray
        (N, …) series along axis 0.
    gain : float
    motion : Motion
    weight : ndarray, optional
        (N,) of the innovations.

    Returns
    -------
    ndarray
        (N, …)
    """
    white = _whitened(z.reshape(len(z), -1).T, gain, motion, weight)
    return np.moveaxis(white.reshape(*z.shape[1:], len(z)), -1, 0)


def _whitened(rows: Array, gain: float, motion: Motion, weight: Array | None = None) -> Array:
    """Return what `whiten` does, of series (m, N) with time last."""
    out = np.empty(rows.shape)
    for a, b in motion.stretches:
        part = out[:, a:b]
        part[:] = rows[:, a:b]
        part[:, 1:] -= rows[:, a : b - 1]
        part[:] = recursive(np.array([1.0, gain - 1.0]), part)
        died = (1.0 - gain) ** np.arange(b - a)
        if weight is not None:
            part *= weight[a:b]
            died *= weight[a:b]
        part -= np.outer(part @ died / (died @ died), died)
    return out


@dataclass(frozen=True)
class Profile:
    """Best gain of one residual.

    Parameters
    ----------
    loglik : float
        Concentrated Gaussian log-likelihood, constants left out.
    gain : float
    std : float
        Standard deviation of the innovations.
    """

    loglik: float
    gain: float
    std: float


def profile(z: Array, nuisance: Array, motion: Motion, gains: Array = GAINS) -> Profile:
    """Return the likelihood of a residual, starts and nuisance fitted, over the gains.

    Parameters
    ----------
    z : ndarray
        (N,) or (N, m) residual, m components that share the nuisance's columns.
    nuisance : ndarray
        (N, q).
    """
    return profiles(z.reshape(len(z), 1, -1), nuisance, motion, gains)[0]


def profiles(z: Array, nuisance: Array, motion: Motion, gains: Array = GAINS) -> list[Profile]:
    """Return the likelihood of each of several residuals (N, k, m); see `profile`."""
    size, (count, components) = len(z), z.shape[1:]
    both = np.ascontiguousarray(np.column_stack([z.reshape(size, -1), nuisance]).T)
    logliks, stds = np.empty((len(gains), count)), np.empty((len(gains), count))
    for i, gain in enumerate(gains):
        white = _whitened(both, float(gain), motion)
        e, x = white[: count * components], white[count * components :]
        rest = e - solve(x.T, e.T).T @ x
        variance = np.einsum("ij,ij->i", rest, rest).reshape(count, components).mean(axis=1) / size
        logliks[i] = -0.5 * size * components * np.log(np.maximum(variance, 1e-300))
        stds[i] = np.sqrt(variance)
    best = logliks.argmax(axis=0)
    return [
        Profile(float(logliks[i, k]), float(gains[i]), float(stds[i, k]))
        for k, i in enumerate(best)
    ]


def outlier_weights(size: Array) -> Array:
    """Return weights (N,) that let no innovation count for more than four robust deviations.

    Satellite positions jump now and then; one jump would outweigh minutes.

    Parameters
    ----------
    size : ndarray
        (N,) absolute innovations, of several components the largest.
    """
    scale = robust_deviation(size)
    if scale <= 0:
        return np.ones(len(size))
    return np.asarray(np.minimum(1.0, _ROBUST * scale / np.maximum(size, 1e-300)))


def solve(x: Array, y: Array) -> Array:
    """Return least squares coefficients; directions that are not there get none."""
    scale = np.sqrt(np.einsum("ij,ij->j", x, x))
    scale[scale == 0] = 1.0
    xs = x / scale
    gram = xs.T @ xs
    found = np.linalg.lstsq(gram, xs.T @ y, rcond=1e-11)[0]
    return np.asarray((found.T / scale).T)


def smooth(value: Array, motion: Motion, seconds: float) -> Array:
    """Return a channel low-passed by a Gaussian of this standard deviation [s]."""
    from scipy.ndimage import gaussian_filter1d

    width = max(seconds / motion.step, 0.3)
    out = np.empty_like(value)
    for a, b in motion.stretches:
        # mirrored through the end values, so that a steady course stays one
        pad = min(int(3 * width) + 1, b - a - 1)
        wide = np.pad(value[a:b], pad, mode="reflect", reflect_type="odd")
        out[a:b] = gaussian_filter1d(wide, width, mode="nearest", truncate=3.0)[pad : pad + b - a]
    return out


def denoise(value: Array, motion: Motion) -> Array:
    """Return a channel without its noise, for derivatives and regressors only.

    The width of the low-pass is chosen by leave-one-out prediction: wide for a
    noisy rate gyro on a slow ship, narrow for a clean signal. What it takes from
    the signal itself is given back by smoothing the rest once more (Tukey's twicing).
    """
    best, chosen = np.inf, 2.0
    taps = np.arange(-_MOST_TAPS, _MOST_TAPS + 1)
    for width in (1.5, 2.0, 3.0, 4.5, 7.0, 10.0, 15.0, 22.0, 32.0, 45.0):
        # neighbours are left out too: their noise may go along with that of the sample
        weight = np.where(np.abs(taps) > _LEFT_OUT, np.exp(-0.5 * (taps / width) ** 2), 0.0)
        error, count = 0.0, 0
        for a, b in motion.stretches:
            if b - a > 2 * _MOST_TAPS:
                said = np.convolve(value[a:b], weight / weight.sum(), "valid")
                error += float(np.sum((value[a + _MOST_TAPS : b - _MOST_TAPS] - said) ** 2))
                count += len(said)
        if not count:
            break
        if error / count < best:
            best, chosen = error / count, width
    slow = smooth(value, motion, chosen * motion.step)
    return slow + smooth(value - slow, motion, chosen * motion.step)


def integrated_damping(motion: Motion, states: Sequence[str]) -> Array:
    """Return what damps a ship, integrated (N, q): 1, x, x|x| and products of the states x."""
    x = {s: denoise(motion[s], motion) for s in states}
    rates = [np.ones(len(motion))]
    rates += [x[s] for s in states]
    rates += [x[s] * np.abs(x[s]) for s in states]
    rates += [x[a] * x[b] for a, b in combinations(states, 2)]
    return integrate(np.column_stack(rates), motion)


def to_ned(psi: Array, forward: Array, starboard: Array) -> Array:
    """Return north and east (N, 2) of body components."""
    return np.column_stack(body_to_ned(forward, starboard, psi))
