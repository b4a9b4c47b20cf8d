"""The probability that a plan keeps its limits under the prior's uncertainty."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from experiment_design.constraints.kinds.margin import Margin
from experiment_design.constraints.limits import TOLERANCE
from experiment_design.optimise.campaign import search_campaign
from experiment_design.optimise.search import Candidate, assess
from experiment_design.request.problem import TrialProblem
from experiment_design.request.request import PreparedRequest, build_problem
from greybox.numerics.binomial import wilson_interval

Array = NDArray[np.float64]

Found = TypeVar("Found")

_DRAWS = 400
# rounds of tightening the limits of a campaign, and the share of the effort that each gets
_TIGHTENINGS, _AGAIN = 5, 0.4


@dataclass(frozen=True)
class ConstraintSatisfaction:
    """Probability of keeping the limits under models drawn from the prior.

    Parameters
    ----------
    probability : float
        Share of the draws under which every path limit is kept all the time.
    lower, upper : float
        95 % Wilson interval.
    draws : int
    shortfall : ndarray
        (m,) by how much each path limit is missed at the wanted quantile, in its unit.
    margins : dict of str to float
        The margins that are kept with the wanted probability.
    misled : bool
        Whether forces that the prior's misfit leaves open moved them too.
    """

    probability: float
    lower: float
    upper: float
    draws: int
    shortfall: Array
    margins: dict[str, float]
    misled: bool = False

    def sentence(self) -> str:
        """Return one sentence for the summary."""
        return (
            f"limits are kept with probability {self.probability:.2f} "
            f"({self.lower:.2f} to {self.upper:.2f}) under {self.draws} models drawn from the prior"
            + (" and its misfit" if self.misled else "")
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        return {
            "probability": self.probability,
            "ci": [self.lower, self.upper],
            "draws": self.draws,
        }


def keep_probability(
    request: PreparedRequest, units: list[Array], draws: int = _DRAWS
) -> ConstraintSatisfaction:
    """Run the plan under models drawn from the prior and count which keep every limit.

    A lead-in is run too; margins count after it.

    Parameters
    ----------
    request : PreparedRequest
        With a covariance.
    units : list of ndarray
        (K, nc) unit coordinates a trial.
    draws : int
    """
    since, own = request.lead_in_samples, request.schedule
    levels = [request.with_lead_in(own.lower + (own.upper - own.lower) * u) for u in units]
    request = request.from_first_command()
    schedule = request.schedule
    commands = [schedule.expand(v) for v in levels]
    kept = np.ones(draws, bool)
    missed: list[Array] = []
    thetas = request.draw_models(draws, 1)
    plain = replace(request, backoff=())
    for t, c in enumerate(commands):
        nominal = plain.rollout(plain.starts[t])
        program = plain.limit_program(nominal, t)
        motion = nominal.run_models(thetas, c, late=True)
        if plain.misfit is not None:
            motion = nominal.moved(motion, plain.misfit(nominal.run(c[None]), draws))
        over = program.worst(motion.state, since)
        over[:, ~motion.stable] = np.inf
        kept &= (over <= 1e-3).all(axis=0) & motion.stable
        missed.append(over)
    worst = np.max(missed, axis=0)
    quantile = min(0.995, request.probability + 0.5 * (1 - request.probability))
    # no limit that is tightened helps models that all run away
    shortfall = np.array([_quantile(w, quantile, 0.0) for w in worst])
    hits = int(kept.sum())
    low, high = wilson_interval(hits / draws, draws)
    margins = {}
    for limit, w in zip(program.path_limits, worst, strict=True):
        if isinstance(limit, Margin):
            margins[limit.state] = limit.bound - _quantile(w, request.probability, np.inf)
    return ConstraintSatisfaction(
        hits / draws, low, high, draws, np.maximum(shortfall, 0.0), margins,
        plain.misfit is not None,
    )  # fmt: skip


def tighten(
    request: PreparedRequest,
    first: Found,
    again: Callable[[PreparedRequest, Found], Found | None],
    units: Callable[[Found], list[Array]],
    rounds: int,
) -> tuple[PreparedRequest, Found, ConstraintSatisfaction]:
    """Search again with tighter path limits until they are kept with the wanted probability.

    What is found then keeps all limits as they were asked for, or ends it.

    Parameters
    ----------
    request : PreparedRequest
        With the limits as they were asked for.
    first : object
        What was found with them.
    again : callable
        Searches with tighter limits, given what was found last; None ends it.
    units : callable
        Unit coordinates of what was found, one a trial.
    rounds : int

    Returns
    -------
    tuple
        The request of the search that keeps the limits best, what it found, and how it keeps them.
    """
    problems = [build_problem(request, t) for t in range(request.trials)]
    keeping = keep_probability(request, units(first))
    best = (request, first, keeping)
    last, shortfall = first, keeping.shortfall
    backoff = np.zeros(len(shortfall))
    for _ in range(rounds):
        if best[2].probability >= request.probability or not shortfall.any():
            break
        backoff = backoff + 1.1 * shortfall
        tighter = replace(request, backoff=tuple(backoff))
        found = again(tighter, last)
        if found is None or any(
            (assess(p, u[None])[0].missed > TOLERANCE).any()
            for p, u in zip(problems, units(found), strict=True)
        ):
            break
        now = keep_probability(request, units(found))
        last, shortfall = found, now.shortfall
        if now.probability > best[2].probability:
            best = (tighter, found, now)
    return best


def tightened_campaign(
    request: PreparedRequest,
    problems: list[TrialProblem],
    candidates: list[Candidate],
    *,
    effort: float,
    workers: int | None = None,
) -> tuple[PreparedRequest, list[Candidate], ConstraintSatisfaction, int]:
    """Search a campaign again with tighter path limits; see `tighten`.

    Parameters
    ----------
    request : PreparedRequest
    problems : list of TrialProblem
        One per trial, with the limits as they were asked for.
    candidates : list of Candidate
        What was found with them.
    effort : float
        Of the search that found them.
    workers : int, optional
        Processes.

    Returns
    -------
    tuple
        The request of the search that keeps the limits best, what it found, measured against the
        limits as they were asked for, how it keeps them, and the evaluations.
    """
    spent = 0

    def again(tighter: PreparedRequest, last: list[Candidate]) -> list[Candidate] | None:
        nonlocal spent
        found = search_campaign(
            tighter,
            [build_problem(tighter, t) for t in range(request.trials)],
            [c.unit for c in last],
            effort=_AGAIN * effort,
            workers=workers,
            quick=True,
        )
        spent += found.evaluations
        kept = all(np.isfinite(c.value) for c in found.candidates)
        return list(found.candidates) if kept else None

    tighter, found, keeping = tighten(
        request, candidates, again, lambda found: [c.unit for c in found], _TIGHTENINGS
    )
    if found is not candidates:
        candidates = [assess(p, c.unit[None])[0] for p, c in zip(problems, found, strict=True)]
    return tighter, candidates, keeping, spent


def _quantile(values: Array, share: float, otherwise: float) -> float:
    """Return a quantile of the finite values, or another number where there are none."""
    finite = values[np.isfinite(values)]
    return float(np.quantile(finite, share)) if finite.size else otherwise
