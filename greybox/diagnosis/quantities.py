"""The numbers of a cause, with standard errors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.fitting import Problem
from greybox.diagnosis.point import Fit
from greybox.diagnosis.result import Quantity
from greybox.diagnosis.search import Candidate
from greybox.diagnosis.ship import CURRENTS
from greybox.model.terms import parameter_unit, parse_term
from greybox.rotation import ned_to_body

Array = NDArray[np.float64]


def numbers_by_true_north(problem: Problem, fit: Fit) -> tuple[Array, Array]:
    """Return the free numbers of a fit but the starts, and their covariance.

    Simulated ships follow the logged heading: where its compass is biased, the current is
    estimated in the compass's frame, and is turned from there.
    """
    values, covariance = problem.covariance(fit)
    names = [problem.names[i] for i in fit.point.places]
    bias = fit.point.ship.sensors.turned
    if not bias or not set(CURRENTS) <= set(names):
        return values, covariance
    where = [names.index(n) for n in CURRENTS]
    turn = np.eye(len(values))
    north, east = np.eye(2)
    turn[np.ix_(where, where)] = np.array(ned_to_body(north, east, bias))
    return turn @ values, turn @ covariance @ turn.T


def quantities_of(problem: Problem, candidate: Candidate, fit: Fit) -> dict[str, Quantity]:
    """Return a cause's parameters with standard errors, by name."""
    hypothesis, weighed = candidate.hypothesis, candidate.standing
    if candidate.told is not None:
        return dict(candidate.told)
    values, covariance = numbers_by_true_north(problem, fit)
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    if hypothesis.apply is None:
        index = [fit.point.places.index(problem.place(n)) for n in hypothesis.columns]
    else:
        index = problem.numbers_of(fit.point, hypothesis)
    if not index:
        one = -1.0 if hypothesis.refit_from_scratch else 1.0
        return {hypothesis.key.split(":", 1)[1]: Quantity(one, 0.0, "1")}
    wide = problem.spread(fit, hypothesis)
    # what a generic force would move a number by is a part of what is not known of it
    moved = np.zeros(len(index)) if weighed is None else weighed.moved[: len(index)]
    found = {
        p.name: Quantity(
            *p.told(
                float(values[i]),
                float(np.linalg.norm([max(std[i], wide.get(p.name, 0.0)), p.coarse, by])),
            ),
            p.unit,
        )
        for p, i, by in zip(hypothesis.parameters, index, moved, strict=True)
    }
    if hypothesis.multiplied:
        found |= _change(problem, candidate, fit)
    return found


def _change(problem: Problem, candidate: Candidate, fit: Fit) -> dict[str, Quantity]:
    """Return by how much a coefficient changes: its factor may be known far less surely."""
    from scipy.special import chdtri

    name = candidate.hypothesis.multiplied
    away, own, _ = problem.effect(fit, candidate.hypothesis)
    std = float(np.sqrt(max(own[0, 0], 0.0)))
    if candidate.standing is not None:
        # with what a generic force moves it by
        std = max(std, abs(away[0]) / np.sqrt(chdtri(1, max(candidate.standing.told, 1e-300))))
    unit = parameter_unit(parse_term(name), problem.runs[0].log.vessel.force_unit)
    return {f"{name}_change": Quantity(float(away[0]), std, unit)}
