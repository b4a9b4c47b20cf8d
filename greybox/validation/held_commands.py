"""Whether a model stays bounded where commands are held as they once were in the logs.

A regression may follow its own logs and those left out, and run away in the first long turn:
what it lacks is damping where the logs never stayed. Held commands ask for no measurement.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from greybox.estimation.prediction_verdict import LIMITS, HeldCommandsDiverge, SomeHeldDiverge
from greybox.model.model import ManoeuvringModel
from greybox.trial.log import TrialLog
from greybox.validation.fit import run_model

# settings that are held
_SETTINGS = 16


def held_commands_diverge(
    model: ManoeuvringModel, logs: Sequence[TrialLog]
) -> HeldCommandsDiverge | None:
    """Return how many free runs with commands held leave their bound, and the first to do so.

    Held are settings of all commands that the logs had at one time, 16 of them as unlike one
    another as the logs allow, for as long as the longest log.

    Parameters
    ----------
    model : ManoeuvringModel
    logs : sequence of TrialLog
        Those of the estimate, at its sample time.

    Returns
    -------
    HeldCommandsDiverge or None
        None where all runs stay bounded; `SomeHeldDiverge` where few do not.
    """
    settings = held_commands(logs)
    left: list[tuple[float, dict[str, float]]] = []
    for log in settings:
        run = run_model(model, log)
        if run.diverged >= 0:
            held = {n: float(log[n][0]) for n in log.vessel.commands if n in log}
            left.append((float(log.t[run.diverged] - log.t[0]), held))
    if not left:
        return None
    after, commands = min(left, key=lambda found: found[0])
    many = len(left) > LIMITS.held * len(settings)
    told = HeldCommandsDiverge if many else SomeHeldDiverge
    return told(commands, after, len(left), len(settings))


def held_commands(logs: Sequence[TrialLog]) -> list[TrialLog]:
    """Return the longest log with commands held at settings that the logs had at one time.

    Parameters
    ----------
    logs : sequence of TrialLog

    Returns
    -------
    list of TrialLog
        Up to 16, the settings as unlike one another as the logs allow; none without commands.
    """
    longest = max(logs, key=len)
    names = [n for n in longest.vessel.commands if all(n in log for log in logs)]
    if not names:
        return []
    settings = _unlike(np.concatenate([np.stack([g[n] for n in names], 1) for g in logs]))
    return [
        replace(
            longest,
            channels={**longest.channels}
            | {n: np.full(len(longest), v) for n, v in zip(names, values, strict=True)},
        )
        for values in settings
    ]


def _unlike(settings: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return those of the (N, nc) settings that are farthest from one another, in deviations."""
    scaled = (settings - settings.mean(axis=0)) / np.maximum(settings.std(axis=0), 1e-12)
    chosen = [int(np.argmax((scaled**2).sum(axis=1)))]
    away = ((scaled - scaled[chosen[0]]) ** 2).sum(axis=1)
    while len(chosen) < _SETTINGS and away.max() > 0:
        chosen.append(int(np.argmax(away)))
        away = np.minimum(away, ((scaled - scaled[chosen[-1]]) ** 2).sum(axis=1))
    return settings[chosen]
