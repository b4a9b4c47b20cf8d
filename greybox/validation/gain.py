"""What one model gains over another: the fit of their free runs, with the interval between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from greybox.validation.fit import LogFit, by_log

Array = NDArray[np.float64]

_DRAWS = 1000
# seconds of a block, and blocks at least
_BLOCK, _LEAST_BLOCKS = 60.0, 8
# an error this many times the motion itself counts as no more
_WORST = 100.0


@dataclass(frozen=True)
class Gain:
    """Fit (6.12) of the free run before and after, with a 95 % interval of the difference [%]."""

    before: float
    after: float
    ci: tuple[float, float]

    def to_dict(self) -> dict[str, Any]:
        """Return the gain for JSON."""
        return {"before": self.before, "after": self.after, "ci": list(self.ci)}


def gains(
    before: Sequence[LogFit], after: Sequence[LogFit], sample_time: float, seed: int
) -> dict[str, Gain]:
    """Return the mean fit (6.12) before and after, by state, both of the motion as before.

    The interval of the difference is by a circular block bootstrap over the logs'
    samples (Politis and Romano, 1992).

    Parameters
    ----------
    before, after : sequence of LogFit
        The same logs by both models.
    sample_time : float
        [s]
    seed : int
    """
    rng = np.random.default_rng([seed, 7])
    out = {}
    for i, state in enumerate(before[0].fit):
        draws = np.zeros((2, _DRAWS))
        point = np.zeros(2)
        # segments between the gaps of one log count as one
        whole = by_log(before)
        rest = iter(after)
        for ones in whole:
            twos = [next(rest) for _ in ones]
            sizes = [min(len(a.log), len(b.log)) for a, b in zip(ones, twos, strict=True)]
            (first, spread), (second, _) = (_squares(r, i, state, sizes) for r in (ones, twos))
            start, length = blocks(sum(sizes), sample_time, _DRAWS, rng)
            s = block_sums(spread, start, length)
            # a sensor that is read otherwise changes what was measured, and must not gain by that
            for k, error in enumerate((first, second)):
                e = block_sums(error, start, length)
                draws[k] += _fit(e, s) / len(whole)
                point[k] += float(_fit(error.sum(), spread.sum())) / len(whole)
        low, high = np.quantile(draws[1] - draws[0], [0.025, 0.975])
        out[state] = Gain(float(point[0]), float(point[1]), (float(low), float(high)))
    return out


def stretch_effects(run: LogFit) -> Array:
    """Return what each of some equal stretches of a log does to the fit of its free run.

    Returns
    -------
    ndarray
        (nx, stretches) to first order [%]; the sum over stretches is 0.
    """
    out = np.zeros((len(run.fit), _LEAST_BLOCKS))
    for i, state in enumerate(run.fit):
        error, spread = _squares([run], i, state, [len(run.log)])
        one, two = float(error.sum()), float(spread.sum())
        if one > 0 and two > 0:
            effect = -50 * np.sqrt(one / two) * (error / one - spread / two)
            out[i] = [part.sum() for part in np.array_split(effect, _LEAST_BLOCKS)]
    return out


def gain_over_stretches(before: float, after: float, effects: Sequence[Array]) -> Gain:
    """Return a gain in a mean over logs, its interval by Student's t over stretches of each.

    Few long stretches are nearly independent whatever the memory of the errors, as draws of
    shorter blocks are not.

    Parameters
    ----------
    before, after : float
        [%]
    effects : sequence of ndarray
        (stretches,) of each log: differences between `stretch_effects` of both models.

    References
    ----------
    Ibragimov and Müller (2010); Satterthwaite (1946).
    """
    freedom = _LEAST_BLOCKS - 1
    variances = np.array([_LEAST_BLOCKS * one.var(ddof=1) for one in effects])
    worth = freedom * variances.sum() ** 2 / max(float((variances**2).sum()), 1e-300)
    half = float(stdtrit(max(worth, freedom), 0.975) * np.sqrt(variances.sum()) / len(effects))
    return Gain(before, after, (after - before - half, after - before + half))


def blocks(
    size: int, sample_time: float, draws: int, rng: np.random.Generator
) -> tuple[NDArray[np.intp], int]:
    """Return where the blocks of a circular bootstrap begin (draws, count), and their length.

    Each sample is drawn as often as any other: of blocks that may not reach over the end, few
    would hold the first and the last samples.
    """
    length = int(np.clip(_BLOCK / sample_time, 1, max(size // _LEAST_BLOCKS, 1)))
    count = -(-size // length)
    return rng.integers(0, size, (draws, count)), length


def block_sums(values: Array, starts: NDArray[np.intp], length: int) -> Array:
    """Return the sums (draws, ...) over blocks of values (N, ...), whose end the start follows."""
    sums = np.zeros((len(values) + length + 1, *values.shape[1:]))
    np.cumsum(np.concatenate([values, values[:length]]), axis=0, out=sums[1:])
    return np.asarray((sums[starts + length] - sums[starts]).sum(axis=1))


def _fit(error: Array | float, spread: Array | float) -> Array:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(100 * (1 - np.sqrt(error / np.maximum(spread, 1e-300))))


def _squares(
    runs: Sequence[LogFit], i: int, state: str, sizes: Sequence[int]
) -> tuple[Array, Array]:
    measured, simulated, known = (
        np.concatenate(parts)
        for parts in zip(
            *(
                (run.log[state][:n], run.x[:n, i], run.log.known((state,))[:n])
                for run, n in zip(runs, sizes, strict=True)
            ),
            strict=True,
        )
    )
    # where nothing was measured, nothing counts
    mean = measured[known].mean() if known.any() else 0.0
    spread = (measured - mean) ** 2 * known
    with np.errstate(over="ignore", invalid="ignore"):
        error = (measured - simulated) ** 2 * known
    worst = _WORST**2 * max(float(spread.mean()), 1e-300)
    return np.minimum(np.nan_to_num(error, nan=worst, posinf=worst), worst), spread
