"""How a run begins: motion and commands up to the order, steady or as a trial had them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.model.model import ManoeuvringModel
from greybox.prediction.steady import Steady
from greybox.trial.log import TrialLog
from greybox.trial.manoeuvres.finding import Manoeuvre
from greybox.trial.manoeuvres.local import regress

Array = NDArray[np.float64]

# ship lengths sailed before the order, and samples at least
_LENGTHS, _FEWEST = 2.5, 16
# ship lengths over which the motion at the order is a line, and samples at least
_FITTED, _LINE = 0.5, 4
_MOTION = ("u", "v", "r")


@dataclass(frozen=True)
class Start:
    """Motion and commands of R ships up to the order.

    Parameters
    ----------
    x : ndarray
        (nx, R) states of the structure when the order is given [m/s, rad/s].
    psi : ndarray
        (R,) heading then [rad].
    motion : ndarray
        (B, 3, R) u, v, r at the samples before [m/s, rad/s].
    heading : ndarray
        (B, R) [rad]
    commands : ndarray
        (B, nc, R) in the unit of the log, angles [rad].
    trim : float
        Steering order that keeps the estimate straight.
    current : ndarray or None
        (2, R) velocity north and east of the water that they sail in [m/s], beyond the current
        among their disturbances.
    """

    x: Array
    psi: Array
    motion: Array
    heading: Array
    commands: Array
    trim: float = 0.0
    current: Array | None = None

    @property
    def speed(self) -> Array:
        """Speed over ground before the order (R,) [m/s]."""
        return np.asarray(np.hypot(self.motion[-1, 0], self.motion[-1, 1]))

    def of(self, runs: NDArray[np.intp]) -> Start:
        """Return the start of some of the ships."""
        return Start(
            self.x[:, runs],
            self.psi[runs],
            self.motion[..., runs],
            self.heading[:, runs],
            self.commands[..., runs],
            self.trim,
            None if self.current is None else self.current[:, runs],
        )


def _samples(model: ManoeuvringModel, speed: float) -> int:
    """Return how many samples before the order are kept."""
    return max(_FEWEST, math.ceil(_LENGTHS * model.vessel.length / (speed * model.sample_time)))


def steady_start(model: ManoeuvringModel, steady: Steady, heading: float) -> Start:
    """Return the start from straight runs at a heading [rad]."""
    runs, before = steady.x.shape[1], _samples(model, float(steady.speed[0]))
    states = model.structure.states
    now = np.stack([steady.x[states.index(n)] if n in states else np.zeros(runs) for n in _MOTION])
    psi = np.full(runs, heading)
    return Start(
        steady.x,
        psi,
        np.tile(now, (before, 1, 1)),
        np.tile(psi, (before, 1)),
        np.tile(steady.commands, (before, 1, 1)),
        float(steady.trim[0]),
    )


def trial_start(
    model: ManoeuvringModel,
    found: Manoeuvre,
    log: TrialLog,
    columns: tuple[str, ...],
    runs: int,
    rng: np.random.Generator,
) -> Start:
    """Return the start from the state that a trial had, whether steady or not.

    States at the order are those of lines through the samples before it, or after it where
    the log holds none; draws hold their errors, the first of them none.

    Parameters
    ----------
    model : ManoeuvringModel
    found : TurningCircle, ZigZag or Stopping
    log : TrialLog
    columns : tuple of str
        The commands, in their order.
    runs : int
        R.
    rng : numpy.random.Generator
    """
    length, speed = model.vessel.length, max(found.approach_speed.value, 1e-9)
    span, start = length / speed, found.start
    own = log.t - start
    near = np.flatnonzero((own < 0) & (own >= -_FITTED * span))
    if len(near) < _LINE:
        near = np.flatnonzero(own < 0)[-_LINE:]
    if len(near) < _LINE or own[near[0]] < -span:
        near = np.flatnonzero(own >= 0)[: max(_LINE, int((np.abs(own) <= _FITTED * span).sum()))]

    def at_order(name: str) -> Array:
        line = np.column_stack([np.ones(len(near)), own[near]])
        (value, _), covariance, _, _ = regress(line, log[name][near])
        drawn = rng.standard_normal(runs)
        drawn[0] = 0.0
        return np.asarray(value + math.sqrt(covariance[0, 0]) * drawn)

    # of the same noise whatever the states of the structure
    begun = {name: at_order(name) for name in (*_MOTION, "psi")}
    samples = _samples(model, speed)
    times = np.asarray(start + model.sample_time * np.arange(-samples, 0), float)
    motion = np.stack([_history(log, name, times, begun[name]) for name in _MOTION], axis=1)
    commands = np.stack([np.interp(times, log.t, log[n]) for n in columns], axis=1)
    return Start(
        np.stack([begun[n] for n in model.structure.states]),
        begun["psi"],
        motion,
        _history(log, "psi", times, begun["psi"]),
        np.repeat(commands[:, :, None], runs, axis=2),
    )


def _history(log: TrialLog, name: str, times: Array, begun: Array) -> Array:
    """Return what a channel was before the order (B, R): its value there where the log has none."""
    own = np.interp(times, log.t, log[name])[:, None]
    return np.where(times[:, None] >= log.t[0], own, begun)
