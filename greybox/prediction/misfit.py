"""Forces that a structure lacks, of the size that its errors on held-out logs show."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from greybox.estimation.prediction_verdict import JudgedOn
from greybox.model.model import ManoeuvringModel
from greybox.prediction.helm import Helm
from greybox.prediction.orders import Legs, replay
from greybox.prediction.running import DrawnRuns, Push, sail
from greybox.prediction.start import Start

Array = NDArray[np.float64]

# waves of which one misfit is the sum
_WAVES = 24
# of a kernel exp(−t²/2): its integral over both sides
_BOTH_SIDES = math.sqrt(2 * math.pi)
# draws of each state's misfit, and of the parameters, by which its size is found
_DRAWS = 24
# standard deviations of their memory after which errors grow no more
_STATIONARY = 8.0


@dataclass(frozen=True)
class HeldOutErrors:
    """Errors of free runs on held-out logs.

    Parameters
    ----------
    rmse : ndarray
        (nx,) of each state, sensors' noise taken off [m/s, rad/s].
    memory : ndarray
        (nx,) time over which these errors are related [s], infinite where not known.
    logs : int
        Whose runs these are; 0 where not known.
    lasts : float
        Mean length of these runs [s], 0 where not known.
    centre, reach : ndarray
        (nx + nc,) middle and half of the range of each state and command in the logs of
        the estimate, zero among them.
    """

    rmse: Array
    memory: Array
    logs: int
    lasts: float
    centre: Array
    reach: Array


def held_out_errors(model: ManoeuvringModel) -> HeldOutErrors | None:
    """Return what the verdict on the model's predictions holds, None where there is none."""
    verdict = model.record.get("verdict")
    found = verdict.get("prediction") if isinstance(verdict, Mapping) else None
    ranges = model.record.get("ranges")
    states = model.structure.states
    if not isinstance(found, Mapping) or not isinstance(ranges, Mapping):
        return None
    names = (*states, *model.vessel.commands)
    sizes = [found.get("rmse", {}), found.get("spread", {})]
    if not all(s in size for s in states for size in sizes) or not set(names) <= set(ranges):
        return None
    noise, spread, held_out = (
        _sizes(found.get(key), states) for key in ("noise", "spread", "rmse")
    )
    # motions of another kind than the estimate saw
    apart = _sizes(found.get("elsewhere_rmse"), states)
    held_out = np.where(np.isfinite(apart), apart, held_out)
    noise = np.nan_to_num(noise)
    error, own = (
        np.sqrt(np.maximum(e**2 - noise**2, 0.0))
        for e in (
            np.where(np.isfinite(held_out), held_out, spread),
            _sizes(found.get("own_rmse"), states),
        )
    )
    if found.get("judged_on") == JudgedOn.HELD_OUT:
        own = np.where(own < error, own, error)
        error = np.sqrt(own * (2 * error - own))
    memory = _sizes(found.get("memory"), states) / _BOTH_SIDES
    memory = np.where(memory > 0, memory, math.inf)
    low, high = np.array([(min(0.0, *ranges[n]), max(0.0, *ranges[n])) for n in names], float).T
    # what never moved says nothing of how the misfit depends on it
    reach = np.where(high > low, high - low, math.inf) / 2
    logs = len(found.get("logs", ()))
    lasts = found.get("samples", 0) * model.sample_time / max(logs, 1)
    return HeldOutErrors(error, memory, logs, lasts, (low + high) / 2, reach)


def _sizes(of: object, states: tuple[str, ...]) -> Array:
    """Return a figure of each state, nan where none is stored."""
    known = of if isinstance(of, Mapping) else {}
    return np.array([float("nan") if known.get(s) is None else known[s] for s in states], float)


def _mean_of_numbers(power: Array) -> Array:
    """Return the mean of each row over the runs that have one, nan where none has."""
    has = np.isfinite(power).all(axis=0)
    return power[:, has].mean(axis=1) if has.any() else np.full(len(power), np.nan)


@dataclass(frozen=True)
class Misfit:
    """Smooth random functions of motion and commands, one of each state and run.

    Each is a Gaussian process whose covariance falls with the distance between two motions,
    exp(−|z − z'|²/2 − (t − t')²/2T²), where z counts in half ranges of the estimate's logs and
    T is the memory of the errors: a sum of cosine waves of random direction (Rahimi and Recht,
    2007).

    Parameters
    ----------
    errors : HeldOutErrors
    size : ndarray
        (nx, R) standard deviation of what is added to the states in a sample.
    direction : ndarray
        (nx, M, nz, R)
    frequency : ndarray
        (nx, M, R) per sample [rad]
    phase : ndarray
        (nx, M, R)
    grows : bool
        Whether it grows beyond the ranges with the square of the motion, as forces on hulls do.
    """

    errors: HeldOutErrors
    size: Array
    direction: Array
    frequency: Array
    phase: Array
    grows: bool

    @classmethod
    def drawn(
        cls,
        errors: HeldOutErrors,
        size: Array,
        sample_time: float,
        rng: np.random.Generator,
        *,
        grows: bool,
    ) -> Misfit:
        """Draw the functions of runs."""
        nx, runs = size.shape
        direction = rng.standard_normal((nx, _WAVES, len(errors.reach), runs))
        frequency = rng.standard_normal((nx, _WAVES, runs))
        frequency *= sample_time / errors.memory[:, None, None]
        phase = rng.uniform(0, 2 * math.pi, (nx, _WAVES, runs))
        return cls(errors, size, direction, frequency, phase, grows)

    def __call__(self, k: int, state: Array, commands: Array) -> Array:
        """Return what is added to the states (nx, R)."""
        nx = len(self.size)
        seen = np.concatenate([state[:nx], commands])
        z = (seen - self.errors.centre[:, None]) / self.errors.reach[:, None]
        beyond = np.maximum(1.0, np.abs(z).max(axis=0)) ** 2 if self.grows else 1.0
        angle = np.einsum("smzr,zr->smr", self.direction, z) + self.frequency * k + self.phase
        waves = np.cos(angle).sum(axis=1) * math.sqrt(2 / _WAVES)
        return np.asarray(self.size * beyond * waves)


def misfit_of(
    model: ManoeuvringModel,
    helm: Helm,
    errors: HeldOutErrors,
    own: DrawnRuns,
    start: Start,
    theta: Array,
    d: Array,
    course: float,
    wind: Array | None,
    seed: int,
    *,
    goes_on: bool,
) -> Push | None:
    """Return the random forces that a structure lacks, zero in the estimate's own run.

    Its size is such that runs on the commands of the estimate's own run differ from it, by
    misfit and parameters together, as much as those on logs that took no part differed from
    their logs. Errors grow from a measured start, so the commands are given again until these
    runs last as long as those. Each log shows one misfit of all equations: draws hold how
    badly so many of them tell its size, as a multivariate Student distribution does.

    Parameters
    ----------
    model : ManoeuvringModel
    helm : Helm
    errors : HeldOutErrors
    own : DrawnRuns
        Of the estimate alone.
    start : Start
        Of the R runs.
    theta, d : ndarray
        (R, p), (R, nd) those of the estimate first.
    course : float
        [rad]
    wind : ndarray or None
        See `sail`.
    seed : int
    goes_on : bool
        Whether the commands may be given again: a stop ends.
    """
    if own.diverged[0]:
        return None
    rng = np.random.default_rng([140, seed])
    nx, step = len(errors.rmse), model.sample_time
    remembered = np.isfinite(errors.memory)
    # a force that would make the error in the time of one ship length
    unit = errors.rmse * min(1.0, step * float(start.speed[0]) / model.vessel.length)
    drawn = 1 + np.arange(min(_DRAWS, len(theta) - 1))
    rows = np.concatenate([np.zeros(1 + nx * _DRAWS, int), drawn])
    size = np.zeros((nx, len(rows)))
    for i in range(nx):
        size[i, 1 + i * _DRAWS : 1 + (i + 1) * _DRAWS] = unit[i]
    sailed = own.commands[own.order :, :, 0]
    if goes_on:
        known_to = _STATIONARY * float(np.max(errors.memory, initial=0.0, where=remembered))
        wanted_to = min(errors.lasts, known_to) / step
        sailed = np.tile(sailed, (max(1, math.ceil(wanted_to / len(sailed))), 1))
    legs = Legs(np.repeat(sailed[:1, :, None], len(rows), axis=2), sailed)
    free = helm.free()
    runs = sail(
        model, free, start.of(rows), theta[rows], d[rows], course,
        replay(legs, len(sailed) - 1), math.inf,
        [Misfit.drawn(errors, size, step, rng, grows=False)], wind,
    )  # fmt: skip
    where = [("u", "v", "r").index(s) for s in model.structure.states]
    moved = runs.states[runs.order :, where]
    # squares of runs that diverged are no numbers
    kept = ~runs.diverged
    power = np.full(moved.shape[1:], np.nan)
    power[:, kept] = np.mean((moved[:, :, kept] - moved[:, :, :1]) ** 2, axis=0)
    groups = np.split(power[:, 1:], _DRAWS * np.arange(1, nx + 1), axis=1)
    response = np.column_stack([_mean_of_numbers(g) for g in groups[:nx]])
    known = _mean_of_numbers(groups[nx]) if len(drawn) else np.zeros(nx)
    wanted = errors.rmse**2
    scale = np.where(wanted > 0, wanted, 1.0)
    if not np.isfinite(response).all():
        return None
    share, _ = nnls(response / scale[:, None], np.maximum(wanted - known, 0.0) / scale)
    size = np.repeat((unit * np.sqrt(share))[:, None], len(theta), axis=1)
    if errors.logs:
        size *= np.sqrt(errors.logs / rng.chisquare(errors.logs, len(theta)))
    size[:, 0] = 0.0
    return Misfit.drawn(errors, size, step, rng, grows=True)
