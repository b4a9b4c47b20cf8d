"""Whether errors tell from where the measured wind blew.

What a hull's misfit does knows nothing of the wind: turned by any angle, the wind would explain as
much of it. A wind that pushes the ship explains most where it is as it was measured. The share of
all angles at which it explains as much is the p-value of a test that no misfit of motion and
commands upsets (a randomisation test: Fisher, 1935; Lehmann and Romano, 2005, section 15.2). Each
log's wind is turned by itself; those of logs that set out on about the same angle to the wind, as
crews do, are turned together, since the same manoeuvre would show the same misfit there. All of
the wind's force is turned: the terms that were chosen are those that the same errors asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import cos, pi

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.evidence.held_out import HeldOut, OtherLogs
from greybox.diagnosis.evidence.remainder import MOTION_AND_COMMANDS, Takings, rival
from greybox.diagnosis.fitting import Problem, measured
from greybox.diagnosis.hypothesis import Hypothesis, Parameter
from greybox.diagnosis.point import Fit
from greybox.diagnosis.ship import LogRun
from greybox.model.disturbances import WIND_TERMS
from greybox.model.terms import parse_term
from greybox.numerics.linalg import bounded_step
from greybox.trial.segments import of_one_log

Array = NDArray[np.float64]

# angles by which the wind is turned, and combinations of them that are drawn
_ANGLES, _DRAWN = 36, 999
# angles to the wind that differ by less are about the same [rad]
_SAME = pi / 6
# samples at the beginning of a log that its angle to the wind is the mean of
_FIRST = 10
# iterations of a fit to all logs
_FEW = 10


def wind_direction(
    problem: Problem, hypothesis: Hypothesis, without: Fit, held_out: HeldOut
) -> float:
    """Return the p-value of errors that know nothing of the wind's direction.

    Parameters
    ----------
    problem : Problem
        The estimation logs.
    hypothesis : Hypothesis
        Of the wind's force.
    without : Fit
        Of the model without it.
    held_out : HeldOut
        Other logs count as well.
    """
    if isinstance(held_out, OtherLogs) and all(run.air_measured for run in held_out.problem.runs):
        problem, without = _with_others(problem, without, held_out)
    if without.escaped or not all(run.air_measured for run in problem.runs):
        return 1.0
    beside = rival(problem, without, [MOTION_AND_COMMANDS])
    if beside is None:
        return 1.0
    gains = _gains(problem, _whole(problem, hypothesis, without), without, beside.taking())
    return float((gains >= gains[0]).mean()) if np.isfinite(gains).all() else 1.0


def _whole(problem: Problem, hypothesis: Hypothesis, without: Fit) -> Hypothesis:
    """Return the hypothesis with those terms of a wind that it lacks."""
    there = {*hypothesis.columns, *(problem.names[k] for k in without.point.places)}
    more = [name for name in WIND_TERMS if name in problem.names and name not in there]
    numbers = [
        Parameter(n, "", 0.0, high=0.0 if parse_term(n).dissipates else np.inf) for n in more
    ]
    return replace(
        hypothesis,
        columns=(*hypothesis.columns, *more),
        parameters=(*hypothesis.parameters, *numbers),
    )


def _with_others(problem: Problem, fit: Fit, held_out: OtherLogs) -> tuple[Problem, Fit]:
    """Return all logs and the model fitted to them."""
    every = Problem([*problem.runs, *held_out.problem.runs], problem.metric)
    (pair,) = held_out.pairs(fit)
    point = replace(fit.point, starts=(*fit.point.starts, *pair.held_fit.point.starts))
    return every, every.settle(every.fit(point, fit.noise, most=_FEW), 1)


def _gains(problem: Problem, hypothesis: Hypothesis, fit: Fit, taking: Takings) -> Array:
    """Return falls of the squared errors by the wind, as measured and turned at random, (n,).

    To first order, beside the fit's numbers and a generic force, each of which gives way.
    """
    places = np.array([problem.place(n) for n in hypothesis.columns])
    groups = _set_out_alike(problem.runs)
    rng = np.random.default_rng(0)
    turned = rng.integers(0, _ANGLES, (1 + _DRAWN, max(groups) + 1))
    turned[0] = 0
    m = len(places)
    square = np.zeros((len(turned), m, m))
    toward = np.zeros((len(turned), m))
    shares = np.zeros((len(turned), len(taking.own), m))
    ship = fit.point.ship
    for k, (run, group) in enumerate(zip(problem.runs, groups, strict=True)):
        shown = run.run(ship, fit.point.starts[k])
        for j in range(_ANGLES):
            other = run.in_wind_turned(2 * pi * j / _ANGLES)
            pushed = other.columns(ship, shown, places)[:, :, :m]
            white = measured(fit.noise.whiten(pushed), run.known)
            flat = white.reshape(-1, m)
            here = turned[:, group] == j
            square[here] += flat.T @ flat
            toward[here] += flat.T @ fit.nu[k].ravel()
            shares[here] += taking.shares(k, white)
    square -= shares.transpose(0, 2, 1) @ shares
    toward -= shares.transpose(0, 2, 1) @ taking.own
    low, high = np.array([(p.low, p.high) for p in hypothesis.parameters]).T
    steps = [
        bounded_step(own, along, low, high, 0.0)
        for own, along in zip(square, toward, strict=True)
    ]  # fmt: skip
    return np.array([2 * t @ d - d @ s @ d for s, t, d in zip(square, toward, steps, strict=True)])


def _set_out_alike(runs: Sequence[LogRun]) -> list[int]:
    """Return a number for each log, the same for those that set out on about the same angle."""
    found = [-1] * len(runs)
    of_logs = of_one_log([run.log for run in runs])
    angles = []
    for places in of_logs:
        log = runs[places[0]].log
        first = slice(0, _FIRST)
        air = np.zeros((1, 2)) if log.air is None else log.air[first]
        wind = np.column_stack([log["u"][first], log["v"][first]]) - air
        angles.append(float(np.arctan2(*wind.mean(axis=0)[::-1])))
    groups = list(range(len(of_logs)))
    for i, one in enumerate(angles):
        for k, two in enumerate(angles[:i]):
            if cos(one - two) > cos(_SAME):
                groups = [groups[k] if g == groups[i] else g for g in groups]
    numbers = {g: n for n, g in enumerate(dict.fromkeys(groups))}
    for places, group in zip(of_logs, groups, strict=True):
        for place in places:
            found[place] = numbers[group]
    return found
