"""What an extension gains: the fit of the free run before and after, with its interval."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.null_model import clocks_of
from greybox.diagnosis.result import Gain
from greybox.model.model import ManoeuvringModel
from greybox.trial.convert.sensor_corrections import correct_log
from greybox.trial.log import TrialLog
from greybox.validation.fit import LogFit, by_log, run_model

Array = NDArray[np.float64]

_DRAWS = 1000
# seconds of a block, and blocks at least
_BLOCK, _LEAST_BLOCKS = 60.0, 8
# an error this many times the motion itself counts as no more
_WORST = 100.0


def run_on(model: ManoeuvringModel, log: TrialLog) -> LogFit:
    """Run a model on a log as its vessel file reads it."""
    return runs_on(model, [log])[0]


def runs_on(model: ManoeuvringModel, logs: Sequence[TrialLog]) -> list[LogFit]:
    """Run a model on each log, its changes by the clock of the log that each is a segment of."""
    return [
        run_model(model, correct_log(log, model.vessel), first=float(log.t[0]) - origin)
        for log, (origin, _) in zip(logs, clocks_of(logs), strict=True)
    ]


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
    spread = (measured - measured[known].mean()) ** 2 * known
    with np.errstate(over="ignore", invalid="ignore"):
        error = (measured - simulated) ** 2 * known
    worst = _WORST**2 * max(float(spread.mean()), 1e-300)
    return np.minimum(np.nan_to_num(error, nan=worst, posinf=worst), worst), spread
