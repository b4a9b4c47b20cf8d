"""Where a simulated motion, and its measurement, should lie with 95 % probability.

Drawn together are what an estimate leaves uncertain: parameters, current, the start of
the run, the heading and wind that drive it, and what moves the ship beside the model.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from greybox.errors import so_many
from greybox.model.model import ManoeuvringModel
from greybox.model.run.inputs import LogInputs
from greybox.model.run.simulation import simulate
from greybox.numerics.linalg import scaled_root
from greybox.numerics.recursion import recursive
from greybox.regression.instruments import state_bound
from greybox.trial.log import TrialLog
from greybox.trial.segments import split_segments
from greybox.validation.fit import at_model_rate, run_model

Array = NDArray[np.float64]

LEVEL = 0.95
RUNS = 256
_LIMITS = ((1 - LEVEL) / 2, 0.5, (1 + LEVEL) / 2)
# of a normal distribution
Z = 1.959963984540054
# steps simulated at once: bounds the memory, whatever the length of the log
_STEPS = 2048
# share of the draws that must stay bounded for their quantiles to mean something
_LEAST = 0.5


@dataclass(frozen=True)
class Coverage:
    """Share of measured samples inside a band, and what it is where the model holds.

    Parameters
    ----------
    share : float
    usual : tuple of float
        Interval that it lies in with 95 % probability: errors of one log are related,
        because its run has one set of parameters.
    sentence : str
    """

    share: float
    usual: tuple[float, float]
    sentence: str

    @property
    def holds(self) -> bool:
        """Whether the share is a usual one."""
        return self.usual[0] <= self.share <= self.usual[1]

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        return {
            "coverage": self.share,
            "expected": LEVEL,
            "usual": list(self.usual),
            "sentence": self.sentence,
        }


@dataclass(frozen=True)
class Bands:
    """Intervals of 95 % at each sample of a log.

    Parameters
    ----------
    states : tuple of str
    motion : ndarray
        (2, N, nx) lower and upper limit of the true motion [m/s, rad/s]; nan from
        where half of the draws have diverged.
    measurement : ndarray
        (2, N, nx) of its measurement, likewise.
    coverage : dict of str to Coverage
        How many of the log's samples `measurement` holds, by state; empty where the
        log measures nothing, the model has no noise levels, or there is no band.
    runs, diverged : int
        Draws made, and those left out from where their run left its bound.
    missing : tuple of str
        Sources of error that the model says nothing of, each a sentence.
    """

    states: tuple[str, ...]
    motion: Array
    measurement: Array
    coverage: dict[str, Coverage]
    runs: int
    diverged: int
    missing: tuple[str, ...]

    def without_samples(self) -> Bands:
        """Return what a table tells of the bands: their limits at the last sample alone."""
        # limits end where too many draws diverge, so the last ones tell whether they did
        motion, measurement = self.motion[:, -1:].copy(), self.measurement[:, -1:].copy()
        return replace(self, motion=motion, measurement=measurement)

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader of the bands has to know."""
        told = list(self.missing)
        if self.diverged:
            told.append(
                f"{self.diverged} of {so_many(self.runs, 'draw')} of the parameters "
                + ("diverges and was" if self.diverged == 1 else "diverge and were")
                + " left out"
                + (
                    ", too many for a band: estimate with --reduce, or on a longer log."
                    if np.isnan(self.motion).any()
                    else "."
                )
            )
        return tuple(told)


def predict_bands(
    model: ManoeuvringModel,
    log: TrialLog,
    *,
    heading: Literal["measured", "simulated"] = "measured",
    seed: int = 0,
    runs: int = RUNS,
) -> Bands:
    """Draw runs of a model on the inputs of a log, and take their quantiles.

    Parameters
    ----------
    model : ManoeuvringModel
        With its covariance and noise; what it lacks is named in ``missing``.
    log : TrialLog
    heading : {"measured", "simulated"}
        As in the run that the bands belong to.
    seed : int
    runs : int
        Draws.

    Returns
    -------
    Bands
        The motion's limits are quantiles of the draws; the measurement's add its
        noise, root of the sum of squares about the median. Where held-out runs calibrated
        the model, limits lie about its own run, as far off as those runs say.
    """
    from scipy.special import ndtr

    log = at_model_rate(log, model)
    states = model.structure.states
    noise = np.zeros(len(states)) if model.noise is None else model.noise.measurement
    reach = Z * noise
    motion, measurement = (np.full((2, len(log), len(states)), np.nan) for _ in range(2))
    inside, counted = np.zeros((runs, len(states))), 0
    good = np.ones(runs, bool)
    rng = np.random.default_rng([71, seed])
    calibration = model.calibration
    own = None if calibration is None else run_model(model, log, heading=heading).x
    # what the model lacks moves a whole run, so that shares of the runs differ
    misfit = np.zeros((2, len(states))) if calibration is None else calibration.misfit
    off = np.random.default_rng([72, seed]).standard_normal((runs, len(states)))
    off *= np.where(off < 0, *misfit)
    parts = split_segments(log)
    starts = np.cumsum([0, *map(len, parts)])
    drawn = (
        (a + first, x)
        for a, part in zip(starts, parts, strict=False)
        for first, x in _pieces(model, part, heading, rng, runs, float(part.t[0] - log.t[0]))
    )
    for first, x in drawn:
        bound = state_bound(log, states)
        good &= np.asarray((np.abs(x) <= bound).all(axis=(1, 2)))
        if good.mean() <= _LEAST:
            break
        kept = x[good]
        low, middle, high = np.quantile(kept, _LIMITS, axis=0, method="weibull")
        piece = slice(first, first + x.shape[1])
        if calibration is not None and own is not None:
            kept = own[piece] + calibration.factor * (kept - middle) + off[good][:, None]
            drawn = calibration.factor * (high - low) / 2
            middle = own[piece]
            low = middle - np.hypot(drawn, Z * misfit[0])
            high = middle + np.hypot(drawn, Z * misfit[1])
        motion[:, piece] = low, high
        measurement[:, piece] = (
            middle - np.hypot(middle - low, reach),
            middle + np.hypot(high - middle, reach),
        )
        # chance that a measurement of each draw lies inside
        spread = np.maximum(noise, 1e-300)
        lower, upper = measurement[:, piece]
        inside[good] += (ndtr((upper - kept) / spread) - ndtr((lower - kept) / spread)).sum(axis=1)
        counted += x.shape[1]
    coverage = {}
    if (model.noise is not None or calibration is not None) and counted == len(log):
        share = inside[good] / counted
        # which of the measurements lie inside is chance too
        chance = np.sqrt(share * (1 - share) / counted) * rng.standard_normal(share.shape)
        share = np.clip(share + chance, 0.0, 1.0)
        usual = np.quantile(share, [_LIMITS[0], _LIMITS[2]], axis=0)
        for i, state in enumerate(states):
            if np.ptp(log[state]) > 0:
                held = (log[state] >= measurement[0, :, i]) & (log[state] <= measurement[1, :, i])
                held = held[log.known((state,))]
                if len(held):
                    coverage[state] = _coverage(state, float(held.mean()), usual[:, i])
    return Bands(states, motion, measurement, coverage, runs, int((~good).sum()), _missing(model))


def _coverage(state: str, share: float, usual: Array) -> Coverage:
    low, high = float(usual[0]), float(usual[1])
    sentence = (
        f"{100 * share:.1f} % of the measured {state} lie in the band of {100 * LEVEL:.0f} % "
        f"({100 * low:.0f}-{100 * high:.0f} % usual)"
    )
    if share < low:
        sentence += (
            ": the model lacks something that its bands do not allow for, or the ship has changed"
        )
    elif share > high:
        sentence += ": this log is quieter than those that the model was estimated on"
    return Coverage(share, (low, high), sentence + ".")


def _missing(model: ManoeuvringModel) -> tuple[str, ...]:
    told: list[str] = []
    if model.calibration is not None:
        return ()
    if not model.covariance.any():
        told.append("the model has no covariance, so its parameters were taken as exact.")
    if model.noise is None:
        told.append(
            "the model has no noise levels, so its bands hold the uncertainty of its parameters "
            "only: estimate it with --method iv or oe."
        )
    return tuple(told)


def _pieces(
    model: ManoeuvringModel,
    log: TrialLog,
    heading: Literal["measured", "simulated"],
    rng: np.random.Generator,
    runs: int,
    begin: float,
) -> Iterator[tuple[int, Array]]:
    """Yield the draws piece by piece: its first sample, and the states (R, n, nx).

    `begin` is the time of the first sample on the clock of the model's changes [s].
    """
    structure, noise = model.structure, model.noise
    nx = len(structure.states)
    given = LogInputs.of(structure, log)
    theta, d = draw_parameters(model, rng, runs)
    zeros = np.zeros(nx)
    # the run starts from a mean, which a ship that gathers way has not reached yet; a plan
    # holds its start alone, which is stated and not measured
    own = log.states(structure.states)
    start = np.where(np.ptp(own, axis=0) > 0, zeros if noise is None else noise.measurement, 0.0)
    x = own[0] + start * rng.standard_normal((runs, nx))
    process = zeros if noise is None else noise.process
    memory = zeros if noise is None or not noise.memory.size else noise.memory
    drive = process * np.sqrt(1 - memory**2)
    push = process * rng.standard_normal((runs, nx))
    turned = 0.0 if noise is None else noise.heading
    gust = 0.0 if noise is None else noise.wind
    air = log.air if log.has_wind and structure.uses_air else None
    psi = given.heading(structure, heading)
    psi0: Array = given.psi[0] + turned * rng.standard_normal(runs)
    yield 0, x[:, None]
    for first in range(0, len(log) - 1, _STEPS):
        last = min(first + _STEPS, len(log) - 1)
        n = last - first
        if process.any():
            pushes, push = process_noise(rng, push, memory, drive, n)
        run = simulate(
            structure,
            theta,
            x,
            given.tau[first:last],
            log.sample_time,
            changes=model.changes,
            first=begin + first * log.sample_time,
            psi=_noisy(rng, psi[first : last + 1], turned, runs) if psi is not None else None,
            psi0=psi0,
            d=d,
            air=None if air is None else _noisy(rng, air[first:last], gust, runs),
            process_noise=pushes if process.any() else None,
            integrator=model.integrator,
        )
        x, psi0 = run.x[:, -1], run.psi[:, -1]
        yield first + 1, run.x[:, 1:]


def joint_covariance(model: ManoeuvringModel) -> Array:
    """Return the covariance of the parameters, then of the known disturbance means, (p + m, p + m).

    Without a common covariance the two are independent.
    """
    p = len(model.theta)
    joint = np.zeros((p + len(model.disturbances),) * 2)
    joint[:p, :p] = model.covariance
    if model.disturbance_covariance.size:
        joint[:, p:] = model.disturbance_covariance
        joint[p:, :p] = model.disturbance_covariance[:p].T
    else:
        np.fill_diagonal(joint[p:, p:], [std**2 for _, std in model.disturbances.values()])
    return joint


def draw_parameters(
    model: ManoeuvringModel, rng: np.random.Generator, runs: int
) -> tuple[Array, Array | None]:
    """Draw parameters (R, p) and disturbance means (R, 1, nd), errors of both together.

    Parameters
    ----------
    model : ManoeuvringModel
    rng : numpy.random.Generator
    runs : int
        R.

    Returns
    -------
    tuple
        The second is None where the model knows no disturbance [m/s].
    """
    p, known = len(model.theta), list(model.disturbances)
    if not known:
        return _normal(rng, model.theta, model.covariance, runs), None
    joint = joint_covariance(model)
    mean = np.append(model.theta, [value for value, _ in model.disturbances.values()])
    drawn = _normal(rng, mean, joint, runs)
    d = np.zeros((runs, 1, len(model.structure.disturbances)))
    for i, name in enumerate(model.structure.disturbances):
        if name in known:
            d[:, 0, i] = drawn[:, p + known.index(name)]
    return drawn[:, :p], d


def _normal(rng: np.random.Generator, mean: Array, covariance: Array, runs: int) -> Array:
    """Draw (R, p) vectors; a covariance that rounding made indefinite is cut at zero."""
    return np.asarray(mean + rng.standard_normal((runs, len(mean))) @ scaled_root(covariance).T)


def _noisy(rng: np.random.Generator, value: Array, std: float, runs: int) -> Array:
    """Return what may have been where `value` was measured, (R, ...)."""
    if std == 0:
        return value
    return np.asarray(value - std * rng.standard_normal((runs, *value.shape)))


def process_noise(
    rng: np.random.Generator, state: Array, memory: Array, drive: Array, steps: int
) -> tuple[Array, Array]:
    """Draw process noise (R, n, nx) that continues from `state` (R, nx), and its last value."""
    out = drive * rng.standard_normal((len(state), steps, len(memory)))
    for i in np.flatnonzero(memory):
        out[:, :1, i] += (memory[i] * state[:, i])[:, None]
        out[:, :, i] = recursive(np.array([1.0, -memory[i]]), out[:, :, i])
    return out, out[:, -1]
