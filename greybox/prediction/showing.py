"""Storage of the runs: that of the estimate as a log, all of them for pictures."""

from __future__ import annotations

import numpy as np

from greybox.model.model import ManoeuvringModel
from greybox.prediction.helm import Helm
from greybox.prediction.result import Bundle
from greybox.prediction.running import DrawnRuns
from greybox.rotation import ned_to_body
from greybox.trial.log import TrialLog, make_log

# samples and tracks that pictures hold
_SHOWN_SAMPLES, _SHOWN_TRACKS = 400, 40


def log_of(runs: DrawnRuns, run: int, model: ManoeuvringModel, helm: Helm) -> TrialLog:
    """Return one run as a log."""
    stop = int(runs.complete[run]) + 1 if runs.complete[run] >= 0 else len(runs.t)
    x_n, y_n = runs.track(run, stop)
    channels = {"t": runs.t[:stop], "x_n": x_n, "y_n": y_n, "psi": runs.psi[:stop, run]}
    channels |= {n: runs.states[:stop, i, run] for i, n in enumerate(("u", "v", "r"))}
    channels |= {n: runs.commands[:stop, i, run] for i, n in enumerate(helm.columns)}
    return make_log(model.vessel, channels, model.sample_time, "prediction")


def bundle_of(runs: DrawnRuns, helm: Helm, course: float, length: float) -> Bundle:
    """Return what pictures need of all runs; the course is that of the approach [rad]."""
    stop = int(runs.complete[0]) + 1 if runs.complete[0] >= 0 else len(runs.t)
    sailed = length / float(np.hypot(*runs.states[0, :2, 0]))
    near = int(np.searchsorted(runs.t, runs.t[runs.order] - sailed))
    k = np.arange(near, stop, max(1, stop // _SHOWN_SAMPLES))
    good = np.flatnonzero(~runs.diverged)
    signals = {
        "heading": runs.psi[k][:, good] - course,
        "r": runs.states[k][:, 2, good],
        "speed": np.hypot(runs.states[k][:, 0, good], runs.states[k][:, 1, good]),
    }
    propeller = int(np.flatnonzero(helm.drive)[0])
    signals["propeller"] = runs.commands[k][:, propeller][:, good]
    if helm.angular:
        helms = int(np.flatnonzero(helm.steer)[0])
        signals["steering"] = np.sign(helm.steer[helms]) * runs.commands[k][:, helms][:, good]
    complete = runs.complete[good]
    # what a draw does after its manoeuvre is no part of it
    under_way = (complete < 0) | (k[:, None] <= complete)
    few = under_way.mean(axis=1) < 0.5
    tail = {}
    for name, value in signals.items():
        ends = np.nanquantile(np.where(under_way, value, np.nan), [0.025, 0.975], axis=1)
        tail[name] = np.where(few, np.nan, ends)
    tracks = []
    for run in good[:_SHOWN_TRACKS]:
        last = int(runs.complete[run]) + 1 if runs.complete[run] >= 0 else stop
        north, east = runs.track(int(run), last)
        north, east = north - north[runs.order], east - east[runs.order]
        thin = slice(near, None, max(1, last // _SHOWN_SAMPLES))
        ahead, across = ned_to_body(north, east, course)
        tracks.append((ahead[thin], across[thin]))
    return Bundle(
        runs.t[k] - runs.t[runs.order],
        {n: v[:, 0] for n, v in signals.items()},
        {n: v[0] for n, v in tail.items()},
        {n: v[1] for n, v in tail.items()},
        tuple(tracks),
    )
