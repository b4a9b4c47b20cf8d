"""Whether a model stays bounded where commands are held as they once were in the logs.

A regression may follow its own logs and those left out, and run away in the first long turn:
what it lacks is damping where the logs never stayed. Or it slows down in turns until it goes
astern, against thrust ahead. Held commands ask for no measurement.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from greybox.estimation.prediction_verdict import LIMITS, HeldCommandsDiverge, SomeHeldDiverge
from greybox.model.model import ManoeuvringModel
from greybox.regression.instruments import state_bound
from greybox.trial.log import TrialLog
from greybox.trial.validity import ranges, settings_of
from greybox.validation.fit import run_model

Array = NDArray[np.float64]

# of the greatest speed ahead: where a current did not do it in the logs, nothing drives a ship
# astern that pushes ahead. Models of a 7 m tanker and a 105 m ship that did so at 0.08 to 0.19 of
# that speed had fits of surge of -32 to 88 % on other manoeuvres, for which 80 to 93 % are usual
_ASTERN = 0.05
# times what the logs showed that held commands may reach: steady turns go beyond short ones, by 1.0
# to 1.4 times in models that follow other manoeuvres, by 1.5 to 2.6 times in those that do not
_BEYOND = 1.5


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
    least, most = held_bounds(logs, model.structure.states)
    left: list[tuple[float, dict[str, float]]] = []
    for log in settings:
        x = run_model(model, log).x
        outside = ~((x >= least) & (x <= most)).all(axis=1)
        if outside.any():
            held = {n: float(log[n][0]) for n in log.vessel.commands if n in log}
            left.append((float(log.t[outside.argmax()] - log.t[0]), held))
    if not left:
        return None
    after, commands = min(left, key=lambda found: found[0])
    many = len(left) > LIMITS.held * len(settings)
    told = HeldCommandsDiverge if many else SomeHeldDiverge
    return told(commands, after, len(left), len(settings))


def held_bounds(logs: Sequence[TrialLog], states: Sequence[str]) -> tuple[Array, Array]:
    """Return the least and the greatest states (nx,) of runs with commands held.

    Of ships that never pushed or went astern in the logs the least surge is a twentieth of their
    greatest speed, astern.

    Parameters
    ----------
    logs : sequence of TrialLog
    states : sequence of str
    """
    most = state_bound(max(logs, key=len), tuple(states))
    least = -most
    if "u" in states:
        seen = [log["u"][log.known(["u"])] for log in logs]
        slowest = -_ASTERN * max(u.max(initial=0.0) for u in seen)
        pushes = min(log.forces(("taux",)).min(initial=0.0) for log in logs)
        if pushes >= 0 and min(u.min(initial=0.0) for u in seen) > slowest:
            least[list(states).index("u")] = slowest
    return least, most


def known_bounds(logs: Sequence[TrialLog], states: Sequence[str]) -> tuple[Array, Array]:
    """Return the least and the greatest states (nx,) near what the logs showed, to both sides."""
    least, _ = held_bounds(logs, states)
    seen = ranges(logs, states)
    most = _BEYOND * np.array([max(abs(a), abs(b)) for a, b in (seen[s] for s in states)])
    return np.maximum(least, -most), most


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
    longest, settings = max(logs, key=len), settings_of(logs)
    return [
        replace(
            longest,
            channels={**longest.channels}
            | {n: np.full(len(longest), v) for n, v in zip(settings, values, strict=True)},
        )
        for values in zip(*settings.values(), strict=True)
    ]
