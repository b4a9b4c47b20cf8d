"""A virtual ship one of whose coefficients changes during the trial, and fits to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from greybox.diagnosis.causes import Context, known_causes
from greybox.diagnosis.evidence.held_out import proof_of
from greybox.diagnosis.fitting import Problem
from greybox.diagnosis.hypothesis import Hypothesis
from greybox.diagnosis.noise import fit_noise
from greybox.diagnosis.point import Fit, Point
from greybox.diagnosis.search import Candidate
from greybox.diagnosis.ship import LogRun, Ship
from greybox.model.catalogue import get_structure
from greybox.study.blind import draw
from greybox.study.chapter6 import TRUE
from greybox.trial.log import TrialLog

BASE = get_structure("thesis").without("Wuu", "Wvv", "Wuv")
MOMENT, FACTOR = 210.0, 1.8


def changed_log() -> TrialLog:
    """A pulse trial whose sway damping grows at a moment, as the model itself would run it."""
    log = draw(np.random.default_rng([9, 1]), kind="pulses", samples=400).estimation
    run = LogRun(BASE, log, "rk4")
    theta = np.array([TRUE[n] for n in BASE.parameters])
    ship = change_of(log).apply(
        Ship(theta, np.zeros(2), log.vessel), np.array([FACTOR, MOMENT])
    )  # fmt: skip
    shown = run.run(ship, run.start()).y
    noise = np.array([0.014, 0.014, 0.014, 0.01]) * np.random.default_rng(3).standard_normal(
        shown.shape
    )
    return replace(
        log, channels=log.channels | dict(zip(run.outputs, (shown + noise).T, strict=True))
    )


def change_of(log: TrialLog) -> Hypothesis:
    """Return the cause that the sway damping changes."""
    context = Context(
        BASE, log.vessel, ("u", "v", "r", "psi"), False, float(log.t[-1]), 1.0,
        dict.fromkeys(("n1", "n2"), 15.0),
    )  # fmt: skip
    hypotheses = known_causes()["parameter_change"].hypotheses(context)
    return next(a for a in hypotheses if a.key.endswith(":Yv"))


def fitted(log: TrialLog, moment: float) -> tuple[Problem, Hypothesis, Fit]:
    """Return the log's problem, the cause, and a fit whose change began at a moment."""
    problem = Problem([LogRun(BASE, log, "rk4")])
    hypothesis = change_of(log)
    theta = np.array([TRUE[n] for n in BASE.parameters])
    point = Point(
        Ship(theta, np.zeros(2), log.vessel), (problem.runs[0].start(),), tuple(range(len(theta)))
    )
    point = problem.add(point, hypothesis, np.array([1.4, moment]))
    noise = fit_noise(problem.errors(point), problem.poles(point), 1.0, problem.groups, longest=3.0)
    return problem, hypothesis, problem.fit(point, noise, most=12)


class OneProblem:
    """A case that knows one problem."""

    metric = "coloured"

    def __init__(self, problem: Problem) -> None:
        self._problem = problem

    def problem(self, integrator: str) -> Problem:
        return self._problem


def candidate(problem: Problem, hypothesis: Hypothesis, fit: Fit, tried: int = 50) -> Candidate:
    """Return a fitted cause that nothing speaks against yet."""
    proof = proof_of(np.full(100, 1.0) + 0.1 * np.sin(np.arange(100)))
    return Candidate(hypothesis, fit, 400.0, 1e-80, 1e-78, proof, problem.names, tried)
