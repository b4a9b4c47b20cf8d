"""The part of a trial that has been sailed, for the design of its rest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiment_design.excitation.rollout import Motion
from experiment_design.information.envelope import Envelope
from experiment_design.request.request import PreparedRequest
from greybox.errors import LogError, so_many
from greybox.model.model import ManoeuvringModel
from greybox.trial.log import TrialLog
from greybox.validation.fit import run_model
from greybox.vessel.force import generalised_force

Array = NDArray[np.float64]

# samples at the end of the last log that tell where it ended
_LAST = 5
# by how much a start may fall short of a margin [m/s]
_SHORT = 1e-6


@dataclass(frozen=True)
class Sailed:
    """The part of a trial that has been sailed.

    Parameters
    ----------
    motions : tuple of Motion
        One for each segment between gaps, at the model's sample time.
    seconds : float
        Time that they hold [s].
    logs : int
        Files that they come from.
    end : ndarray
        (nx + 1,) states [m/s, rad/s] and heading [rad] where the last log ended.
    place : (float, float) or None
        North and east there [m], None where the logs hold no positions.
    """

    motions: tuple[Motion, ...]
    seconds: float
    logs: int
    end: Array
    place: tuple[float, float] | None

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON, motions left out."""
        return {
            "seconds": self.seconds,
            "logs": self.logs,
            "end": self.end.tolist(),
            "place": None if self.place is None else list(self.place),
        }

    def as_inputs_of(self, model: ManoeuvringModel, prior: ManoeuvringModel) -> Sailed:
        """Return the same motions at the sample time of another model, with its inputs.

        Parameters
        ----------
        model : ManoeuvringModel
            With the same states, and no other commands.
        prior : ManoeuvringModel
            That the motions are of.
        """
        return replace(self, motions=tuple(_resampled(m, model, prior) for m in self.motions))

    def sentence(self) -> str:
        """Return how much has been sailed."""
        return f"{self.seconds:.0f} s of {so_many(self.logs, 'log')}"


def sailed_trial(model: ManoeuvringModel, segments: Sequence[TrialLog], logs: int) -> Sailed:
    """Return what has been sailed, moved as the model says.

    Parameters
    ----------
    model : ManoeuvringModel
        Estimated on these logs, or before.
    segments : sequence of TrialLog
        Between the gaps of the logs, in the order sailed, with the model's vessel and at its
        sample time.
    logs : int
        How many files they come from.

    Raises
    ------
    LogError
        There are none.
    """
    if not segments:
        raise LogError("nothing is left of the logs of --after: name logs that hold samples.")
    last, states = segments[-1], model.structure.states
    psi = last["psi"] if "psi" in last else np.zeros(len(last))
    end = _at_end(np.column_stack([last.states(states), psi]))
    place = None
    if "x_n" in last and "y_n" in last:
        north, east = _at_end(last.states(("x_n", "y_n")))
        place = (float(north), float(east))
    return Sailed(
        tuple(log_motion(model, log) for log in segments),
        sum(len(log) * log.sample_time for log in segments),
        logs,
        end,
        place,
    )


def _at_end(values: Array) -> Array:
    """Return signals (N, n) at their last sample, by a straight line through the last few."""
    few = values[-_LAST:]
    if len(few) < 3:
        return np.asarray(few.mean(axis=0))
    k = np.arange(len(few)) - (len(few) - 1.0)
    return np.asarray(np.polyfit(k, few, 1)[1])


def log_motion(model: ManoeuvringModel, log: TrialLog) -> Motion:
    """Return the motion of one segment on its commands, where its states were measured.

    The states are those of the model's free run, which has no noise that would pass for
    information; where the run escapes they are the measured ones.

    Parameters
    ----------
    model : ManoeuvringModel
    log : TrialLog
        Without gaps in time, at the model's sample time.
    """
    states = model.structure.states
    run = run_model(model, log)
    x, psi = run.x, run.psi
    if run.diverged >= 0:
        x = log.states(states)
        psi = log["psi"] if "psi" in log else np.zeros(len(log))
    known = log.known(states)
    state = np.zeros((1, int(known.sum()) + 1, len(states) + 3))
    state[0, :-1, : len(states)] = x[known]
    state[0, :-1, len(states)] = psi[known]
    state[0, -1] = state[0, -2]
    commands = np.column_stack([log[c] for c in log.vessel.commands])
    tau = log.forces(model.structure.inputs)
    return Motion(state, tau[known][None], commands[known][None], np.ones(1, bool))


def _resampled(motion: Motion, model: ManoeuvringModel, prior: ManoeuvringModel) -> Motion:
    from scipy.interpolate import make_interp_spline

    samples, step, vessel = motion.tau.shape[1], prior.sample_time, model.vessel
    count = int(samples * step / model.sample_time + 1e-9)
    t = model.sample_time * np.arange(count + 1)
    known = step * np.arange(samples + 1)
    state = make_interp_spline(known, motion.state[0], k=1)(t) if count else motion.state[0, :1]
    held = np.minimum((t[:-1] / step + 1e-9).astype(int), samples - 1)
    columns = [prior.vessel.commands.index(n) for n in vessel.commands]
    commands = motion.commands[0][held][:, columns]
    made = generalised_force(vessel, dict(zip(vessel.commands, commands.T, strict=True)))
    tau = np.stack([made.get(n, np.zeros(count)) for n in model.structure.inputs], axis=-1)
    return Motion(state[None], tau[None], commands[None], motion.stable)


def log_moments(envelope: Envelope, motions: Sequence[Motion]) -> Array | float:
    """Return the moments of what has been sailed, (p + q, p + q), 0 where nothing was.

    Parameters
    ----------
    envelope : Envelope
    motions : sequence of Motion
        Such as those of `sailed_trial`, of one run each.
    """
    told = [envelope.information(m)[0] for m in motions if m.tau.shape[1]]
    return sum(told, start=np.zeros(()))


def lacking_margin(request: PreparedRequest) -> str:
    """Return the name of a state whose margin the first trial's start does not keep, or ``""``."""
    start = dict(zip(request.structure.states, request.starts[0], strict=False))
    margins: Mapping[str, float] = request.limits.margins
    for name, sign in request.regimes[0]:
        if sign * float(start[name]) < margins.get(name, 0.0) - _SHORT:
            return name
    return ""
