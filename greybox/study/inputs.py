"""Input sequences of the thesis's studies."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def smoothed_pulses(
    rng: np.random.Generator,
    samples: int,
    lower: float,
    upper: float,
    *,
    widths: tuple[int, int] = (40, 150),
    smoothing: int = 20,
) -> Array:
    """Draw smoothed pulses of varying width.

    Levels are uniform between the limits, widths uniform, and edges rounded by
    a Hann window.

    Parameters
    ----------
    rng : numpy.random.Generator
    samples : int
        N
    lower, upper : float
        Range of the levels.
    widths : (int, int)
        Shortest and longest pulse, in samples.
    smoothing : int
        Length of the window, in samples.

    Returns
    -------
    ndarray
        (N,)

    References
    ----------
    Ljungberg (2020), section 6.1: "smoothed pulses of varying width", not
    specified further.
    """
    shortest, longest = widths
    count = (samples + smoothing) // shortest + 1
    lengths = rng.integers(shortest, longest + 1, count)
    levels = rng.uniform(lower, upper, count)
    return smooth(lengths, levels, samples, smoothing)


def smooth(
    lengths: Sequence[int] | NDArray[np.int64],
    levels: Sequence[float] | Array,
    samples: int,
    smoothing: int,
) -> Array:
    """Return pulses of given lengths and levels with edges rounded by a Hann window.

    Parameters
    ----------
    lengths : sequence of int
        In samples; the sequence is repeated where it is too short.
    levels : sequence of float
    samples : int
        N
    smoothing : int
        Length of the window, in samples.

    Returns
    -------
    ndarray
        (N,)
    """
    once = np.repeat(np.asarray(levels, float), lengths)
    raw = np.resize(once, samples + smoothing - 1)
    window = np.hanning(smoothing + 2)[1:-1]
    return np.asarray(np.convolve(raw, window / window.sum(), "valid"))


def offset_gaussian(rng: np.random.Generator, samples: int, floor: float | None = 0.6) -> Array:
    """Draw the input of chapter 4: N(0, 1), or max(|N(0, 1)|, floor) as (4.65).

    Parameters
    ----------
    floor : float or None
        None gives the zero-mean input of the first set.
    """
    white = rng.standard_normal(samples)
    return white if floor is None else np.maximum(np.abs(white), floor)


def zig_zag(
    samples: int,
    sample_time: float,
    *,
    amplitude: float,
    period: float,
    centre: float = 0.0,
) -> Array:
    """Return a square wave of ±amplitude around a centre, each half `period`/2 long [s]."""
    t = np.arange(samples) * sample_time
    return np.asarray(centre + amplitude * np.where((t % period) < period / 2, 1.0, -1.0))
