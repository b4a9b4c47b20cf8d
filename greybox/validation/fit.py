"""Free-run fit of a model on a log (6.12)."""

from __future__ import annotations

import copy
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from greybox.channels import CHANNELS, MOTION_WORDS
from greybox.errors import LogError, so_many
from greybox.model.model import ManoeuvringModel
from greybox.model.run.changes import Change
from greybox.model.run.inputs import LogInputs
from greybox.model.run.simulation import simulate
from greybox.notebook import DisplayMixin, number, sparkline, table
from greybox.regression.instruments import simulate_log, state_bound
from greybox.trial.kinematics import decimate_segments
from greybox.trial.log import TrialLog
from greybox.trial.segments import (
    LogGaps,
    find_log_gaps,
    join_segments,
    of_one_log,
    split_segments,
)

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]

_HUGE = 1e6
# fit from which on a run has not left the measurements for good [%]
LEFT = -1000.0
# samples that a log has at least
_HEAD = 2


def fit_percent(measured: Array, simulated: Array) -> Array:
    """Return 100 (1 − ‖y − ŷ‖ / ‖y − mean y‖) for each column.

    Parameters
    ----------
    measured, simulated : ndarray
        (N, n) or (N,)

    Returns
    -------
    ndarray
        (n,) or scalar [%]; 100 is perfect, 0 no better than the mean. −inf where
        the measured signal never changes.

    References
    ----------
    Ljungberg (2020), eq. 6.12.
    """
    # beyond this no simulation is a simulation, and its square overflows
    simulated = np.clip(np.nan_to_num(simulated, nan=_HUGE), -_HUGE, _HUGE)
    error = np.linalg.norm(measured - simulated, axis=0)
    spread = np.linalg.norm(measured - measured.mean(axis=0), axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(
            np.where(spread > 0, 100 * (1 - error / spread), np.where(error == 0, 100.0, -np.inf))
        )


def fit_on(log: TrialLog, states: Sequence[str], x: Array) -> dict[str, float]:
    """Return the fit (6.12) of simulated states (N, nx) where a log was measured, a state [%]."""
    fit = {}
    for i, state in enumerate(states):
        known = log.known((state,))
        percent = fit_percent(log[state][known], x[known, i]) if known.any() else np.nan
        fit[state] = float(percent)
    return fit


def noise_fit(measured: Array, std: float) -> float:
    """Return the fit (6.12) [%] of a perfect model, measured with noise of a deviation; 0 least."""
    return max(float(fit_percent(measured, measured - std)), 0.0)


def percent(fit: float, digits: int = 1) -> str:
    """Return a fit (6.12) [%] in words."""
    return f"{fit:.{digits}f} %" if fit > LEFT else "diverged"


def told_fits(fit: Mapping[str, float], digits: int = 1) -> str:
    """Return the fit of each state in words."""
    return ", ".join(f"{MOTION_WORDS.get(s, s)} {percent(v, digits)}" for s, v in fit.items())


_log = logging.getLogger(__name__)


@dataclass(frozen=True, repr=False)
class LogFit(DisplayMixin):
    """A free run beside its log.

    Parameters
    ----------
    log : TrialLog
        At the model's sample time.
    x : ndarray
        (N, nx) simulated states [m/s, rad/s].
    psi : ndarray
        (N,) heading of the simulation [rad].
    fit : dict of str to float
        (6.12) per state [%]; −inf where the run diverged.
    diverged : int
        First sample outside the bound, −1 if none.
    whole : tuple of (int, tuple of LogGaps), optional
        Samples and gaps of the log, where only its first samples are kept.
    """

    log: TrialLog
    x: Array
    psi: Array
    fit: dict[str, float]
    diverged: int
    whole: tuple[int, tuple[LogGaps, ...]] | None = None

    @property
    def samples(self) -> int:
        """Samples of the log, kept or not."""
        return len(self.log) if self.whole is None else self.whole[0]

    @property
    def gaps(self) -> tuple[LogGaps, ...]:
        """Gaps of the log, kept or not."""
        return find_log_gaps(self.log) if self.whole is None else self.whole[1]

    def without_samples(self) -> LogFit:
        """Return what a table tells of the run, without the samples of log and run."""
        # copies: a view would keep all samples
        head = copy.deepcopy(self.log.window(0, _HEAD, self.log.name))
        x, psi = self.x[:_HEAD].copy(), self.psi[:_HEAD].copy()
        return replace(self, log=head, x=x, psi=psi, whole=(self.samples, self.gaps))

    def to_pandas(self) -> pd.DataFrame:
        """Return the run beside its log.

        Returns
        -------
        DataFrame
            Index ``t`` [s]; the simulated states and ``psi`` by name, as measured with
            ``_measured`` behind it. Units and fit in ``attrs``.
        """
        import pandas as pd

        run = dict(zip(self.fit, self.x.T, strict=True)) | {"psi": self.psi}
        measured = {f"{n}_measured": self.log.measured(n) for n in run if n in self.log}
        frame = pd.DataFrame(run | measured, index=pd.Index(self.log.t, name="t"))
        units = {n: CHANNELS[n].unit for n in run if n in CHANNELS}
        units |= {f"{n}_measured": unit for n, unit in units.items() if f"{n}_measured" in measured}
        frame.attrs = {"units": {"t": "s"} | units, "fit": dict(self.fit)}
        return frame

    def summary(self) -> str:
        """Return the fit of each state as text."""
        rows = [f"  {s}: fit {fit} %, rms error {rmse}" for s, fit, rmse, _ in self._rows()]
        return "\n".join([self._line(), *rows])

    def _line(self) -> str:
        end = f", diverged at sample {self.diverged}" if self.diverged >= 0 else ""
        return f"free run on '{self.log.name}', {so_many(len(self.log), 'sample')}{end}"

    def _rows(self) -> list[tuple[str, str, str, str]]:
        rows = []
        for (s, fit), x in zip(self.fit.items(), self.x.T, strict=True):
            known = self.log.known((s,))
            with np.errstate(all="ignore"):
                rmse = float(np.sqrt(np.mean((self.log[s] - x)[known] ** 2)))
            rows.append((s, number(fit, 3), number(rmse, 3), self.picture(s)))
        return rows

    def errors(self) -> Array:
        """Return measured less simulated states where all were measured, (n, nx)."""
        states = tuple(self.fit)
        return (self.log.states(states) - self.x)[self.log.known(states)]

    def picture(self, state: str) -> str:
        """Return a state as measured and as simulated, as one small picture of a notebook."""
        x = self.x[:, list(self.fit).index(state)]
        # a run that escaped would leave nothing else to see
        return sparkline(self.log[state], x[: self.diverged] if self.diverged >= 0 else x)

    def _parts(self) -> tuple[str, ...]:
        return (table(("state", "fit [%]", "rms error", "measured, simulated"), self._rows()),)


def at_model_rate(log: TrialLog, model: ManoeuvringModel) -> TrialLog:
    """Return the log at the model's sample time.

    Raises
    ------
    LogError
        The model's sample time is not a whole multiple of the log's.
    """
    if abs(log.sample_time - model.sample_time) < 1e-6 * model.sample_time:
        return log
    if model.sample_time < log.sample_time:
        raise LogError(
            f"the model's sample time is {model.sample_time:g} s and '{log.name}' has "
            f"{log.sample_time:g} s: use a log sampled at least as fast as the model."
        )
    parts, _ = decimate_segments(split_segments(log), model.sample_time)
    return join_segments(parts, log.name)


def run_model(
    model: ManoeuvringModel,
    log: TrialLog,
    *,
    heading: Literal["measured", "simulated"] = "measured",
    first: float = 0.0,
) -> LogFit:
    """Run a model freely on a log and compare.

    The run starts from the mean of the log's first samples, begins anew after each gap in its
    time, and goes on where a motion was not measured, which the fit does not count. It uses
    the model's current, and the wind where the log has it and the model has wind terms. Its
    parameters change when the model says so.

    Parameters
    ----------
    model : ManoeuvringModel
    log : TrialLog
    heading : {"measured", "simulated"}
    first : float
        Time of the log's first sample on the clock of the model's changes [s].

    Returns
    -------
    LogFit
    """
    log = at_model_rate(log, model)
    runs = [
        simulate_log(
            model.structure,
            model.theta,
            part,
            heading=heading,
            d=model.d if model.disturbances else None,
            use_wind=part.has_wind,
            integrator=model.integrator,
            changes=model.changes,
            first=first + float(part.t[0] - log.t[0]),
        )
        for part in split_segments(log)
    ]
    x, psi = (
        np.concatenate(parts) for parts in zip(*((r.x[0], r.psi[0]) for r in runs), strict=True)
    )
    starts = np.cumsum([0, *(r.x.shape[1] for r in runs)])
    left = [
        int(a + r.diverged[0]) for a, r in zip(starts, runs, strict=False) if r.diverged[0] >= 0
    ]
    diverged = min(left, default=-1)
    states = model.structure.states
    fit = fit_on(log, states, x)
    if diverged >= 0:
        fit = dict.fromkeys(states, -np.inf)
        _log.info("the free run on %s leaves its bound at sample %d", log.name, diverged)
    return LogFit(log, x, psi, fit, diverged)


def run_from(
    model: ManoeuvringModel,
    log: TrialLog,
    starts: NDArray[np.intp],
    steps: int,
    *,
    heading: Literal["measured", "simulated"] = "measured",
    first: float = 0.0,
) -> Array:
    """Run a model from measured states of a log.

    Parameters
    ----------
    model : ManoeuvringModel
    log : TrialLog
        At the model's sample time.
    starts : ndarray of int
        (R,) samples to start from.
    steps : int
        After each; none may leave the log.
    heading : {"measured", "simulated"}
    first : float
        Time of the log's first sample on the clock of the model's changes [s].

    Returns
    -------
    ndarray
        (R, steps + 1, nx) [m/s, rad/s]; infinite from where a run has diverged.
    """
    structure = model.structure
    x, given = log.states(structure.states), LogInputs.of(structure, log)
    psi = given.heading(structure, heading)
    window = starts[:, None] + np.arange(steps + 1)
    air = log.air if log.has_wind and structure.uses_air else None
    out = np.empty((len(starts), steps + 1, x.shape[1]))
    begin = first + log.t[starts] - log.t[0]
    for rows in _alike(model.changes, begin, steps * log.sample_time):
        run = simulate(
            structure,
            model.theta,
            x[starts[rows]],
            given.tau[window[rows, :-1]],
            log.sample_time,
            changes=model.changes,
            first=float(begin[rows[0]]),
            psi=None if psi is None else psi[window[rows]],
            psi0=given.psi[starts[rows]],
            d=model.d if model.disturbances else None,
            air=None if air is None else air[window[rows, :-1]],
            integrator=model.integrator,
            bound=state_bound(log, structure.states),
        )
        left = (run.diverged[:, None] >= 0) & (np.arange(steps + 1) >= run.diverged[:, None])
        out[rows] = np.where(left[:, :, None], np.inf, run.x)
    return out


def _alike(changes: Sequence[Change], starts: Array, horizon: float) -> list[NDArray[np.intp]]:
    """Group runs that start at these times [s]: those with one set of parameters together."""
    times = np.array(sorted({c.time for c in changes}))
    before = np.searchsorted(times, starts, side="right")
    crossing = np.searchsorted(times, starts + horizon, side="right") > before
    groups = [np.flatnonzero(~crossing & (before == k)) for k in range(len(times) + 1)]
    # each of the others meets its change after another number of samples
    return [g for g in groups if len(g)] + [np.array([k]) for k in np.flatnonzero(crossing)]


def mean_fit(fit: Mapping[str, float]) -> float:
    """Return the mean of a run's fits (6.12) [%]; a state that diverged counts as −1000 %."""
    return float(np.mean([max(value, -1000.0) for value in fit.values()]))


def average_fit(fits: Sequence[LogFit]) -> dict[str, float]:
    """Return the mean fit a state over logs, each by its samples [%].

    Segments between the gaps of one log count as one.
    """
    groups = by_log(fits)
    whole = [_joined(runs) for runs in groups]
    samples = [sum(len(r.log) for r in runs) for runs in groups]
    return {s: float(np.average([fit[s] for fit in whole], weights=samples)) for s in whole[0]}


def by_log(fits: Sequence[LogFit]) -> list[list[LogFit]]:
    """Group the runs on neighbouring segments of one log."""
    return [[fits[k] for k in places] for places in of_one_log([run.log for run in fits])]


def _joined(runs: Sequence[LogFit]) -> dict[str, float]:
    """Return the fit of the runs on the segments of one log, against its mean over all."""
    if len(runs) == 1:
        return runs[0].fit
    if any(r.diverged >= 0 for r in runs):
        return dict.fromkeys(runs[0].fit, -np.inf)
    log = join_segments([r.log for r in runs], runs[0].log.name)
    return fit_on(log, tuple(runs[0].fit), np.concatenate([r.x for r in runs]))
