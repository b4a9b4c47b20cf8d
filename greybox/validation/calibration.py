"""Bands that allow for what a model lacks, from free runs on held-out logs.

What a model lacks depends on the motion and is no independent noise, so draws of parameters
and noise say too little of it. Errors of held-out runs say how much: a calibrated band
reaches √((f h)² + (z b)² + (z n)²) to either side of the run, with h the half width of the
draws, n the noise of the sensors, b the misfit to that side, and f one of a few factors, 0
among them, where draws tell nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from greybox.model.model import ManoeuvringModel
from greybox.model.noise import BandCalibration
from greybox.validation.bands import LEVEL, Z, predict_bands
from greybox.validation.fit import LogFit

Array = NDArray[np.float64]

# factors on the half width of the draws that are tried beside 1, and the share of the interval
# score that they must save: where noise hides the motion, its draws are believed
_FACTORS, _SAVED = (0.0, 0.5, 2.0, 4.0), 0.02
# draws of a band that only calibrates
_DRAWS = 64
# independent errors that a run is worth: what it is off by, and how that changes
_FREEDOM = 2


@dataclass(frozen=True)
class RunErrors:
    """Errors of a free run on a held-out log, with their standard deviation by the draws.

    Parameters
    ----------
    error : ndarray
        (N, nx) measured less simulated, nan where nothing was measured [m/s, rad/s].
    half : ndarray
        (N, nx) half width of the band of 95 % that draws give the motion.
    noise : ndarray
        (nx,) standard deviation of the sensors as the estimate found it, 0 where it did not.
    """

    error: Array
    half: Array
    noise: Array


def run_errors(model: ManoeuvringModel, run: LogFit, seed: int) -> RunErrors | None:
    """Return the errors of a held-out run; None where it, or half of the draws, diverge."""
    if run.diverged >= 0:
        return None
    states = tuple(run.fit)
    low, high = predict_bands(model, run.log, seed=seed, runs=_DRAWS).motion
    if np.isnan(low).any():
        return None
    known = np.stack([run.log.known((s,)) for s in states], axis=1)
    noise = np.zeros(len(states)) if model.noise is None else model.noise.measurement
    error = np.where(known, run.log.states(states) - run.x, np.nan)
    return RunErrors(error, (high - low) / 2, noise)


def reach(errors: RunErrors, calibration: BandCalibration) -> Array:
    """Return how far the calibrated band of the measurements reaches, (2, N, nx) down and up."""
    drawn = (calibration.factor * errors.half) ** 2
    beside = Z**2 * (calibration.misfit**2 + errors.noise**2)
    return np.asarray(np.sqrt(drawn + beside[:, None]))


def calibrate_bands(
    runs: Sequence[RunErrors], states: tuple[str, ...], kinds: Sequence[str] = ()
) -> BandCalibration | None:
    """Return how far bands must reach to hold the errors of held-out runs.

    For each factor on the draws the misfit is the one with which 2.5 % of the errors lie
    beyond either side; of the factors, that of the least interval score is taken. Few runs
    know misfit and factor badly: these are larger by the ratio of Student's quantile to the
    normal one.

    Parameters
    ----------
    runs : sequence of RunErrors
    states : tuple of str
    kinds : sequence of str
        Of manoeuvres that were left out in turn.

    Returns
    -------
    BandCalibration or None
        None without runs.

    References
    ----------
    Gneiting and Raftery (2007), eq. 43: the interval score.
    """
    if not runs:
        return None
    wider = float(stdtrit(_FREEDOM * len(runs), (1 + LEVEL) / 2)) / Z
    factor, misfit = np.ones(len(states)), np.zeros((2, len(states)))
    for i in range(len(states)):
        error = np.concatenate([r.error[:, i] for r in runs])
        known = np.isfinite(error)
        if not known.any():
            continue
        error = error[known]
        drawn = np.concatenate([r.half[:, i] for r in runs])[known]
        noise = np.concatenate([np.full(len(r.error), r.noise[i]) for r in runs])[known]
        best, first = np.inf, np.inf
        for f in (1.0, *_FACTORS):
            own = (f * drawn) ** 2 + (Z * noise) ** 2
            lack = _lacking(error, own)
            half = np.sqrt(own + lack[:, None])
            beyond = np.maximum(np.maximum(-error - half[0], error - half[1]), 0.0)
            score = float((half.sum(axis=0) + 2 / (1 - LEVEL) * beyond).mean())
            if score < best * (1.0 if best < first else 1.0 - _SAVED):
                best, factor[i] = score, f if f == 1.0 else wider * f
                misfit[:, i] = wider * np.sqrt(lack) / Z
            first = score if f == 1.0 else first
    return BandCalibration(states, factor, misfit, len(runs), tuple(kinds))


def _lacking(error: Array, own: Array) -> Array:
    """Return the squares (2,) that (N,) squared half widths lack to reach as far as errors do."""
    missing = np.sign(error) * np.sqrt(np.maximum(error**2 - own, 0.0))
    low, high = np.quantile(missing, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return np.array([min(low, 0.0), max(high, 0.0)]) ** 2


def cross_calibrated(runs: Sequence[RunErrors], states: tuple[str, ...]) -> list[Array]:
    """Return for each run the `reach` of bands that all other runs calibrate.

    Nothing where there is a single run.
    """
    out = []
    for i, run in enumerate(runs):
        found = calibrate_bands([*runs[:i], *runs[i + 1 :]], states)
        if found is not None:
            out.append(reach(run, found))
    return out
