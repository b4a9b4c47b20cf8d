"""The probability that a plan keeps its limits under the prior's uncertainty."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from experiment_design.constraints.kinds.margin import Margin
from experiment_design.constraints.limits import TOLERANCE
from experiment_design.excitation.rollout import Motion, Rollout
from experiment_design.optimise.campaign import search_campaign
from experiment_design.optimise.search import Candidate, assess
from experiment_design.request.problem import TrialProblem
from experiment_design.request.regimes import STEADY_SECONDS
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

    Each begins in the motion that the commands at the start hold it in. A lead-in is run too;
    margins count after it.

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
        over, keep = _missed(plain, t, thetas, c, since)
        kept &= keep
        missed.append(over)
    program = plain.limit_program(plain.rollout(plain.starts[0]), 0)
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


def keeps_start(request: PreparedRequest, trial: int, draws: int = _DRAWS) -> bool:
    """Return whether a trial begins within its path limits with the wanted probability."""
    held = request.start_commands[trial] if request.start_commands else None
    if held is None or not request.uncertain:
        return True
    plain, thetas = replace(request, backoff=()), request.draw_models(draws, 1)
    return bool(_missed(plain, trial, thetas, held[None])[1].mean() >= request.probability)


def _missed(
    request: PreparedRequest, trial: int, thetas: Array, commands: Array, since: int = 0
) -> tuple[Array, NDArray[np.bool_]]:
    """Return by how much models (R, p) miss each path limit at worst (m, R), and which keep all.

    It is inf where a model is unstable.
    """
    nominal = request.rollout(request.starts[trial])
    held = request.start_commands[trial] if request.start_commands else None
    begun, settled = None, np.ones(len(thetas), bool)
    # in a current no motion is steady on all headings
    if held is not None and not request.d.any():
        samples = round(STEADY_SECONDS / request.sample_time)
        steady = _drawn(request, nominal, thetas, np.repeat(held[None], samples, axis=0))
        begun, settled = steady.state[:, -1, : nominal.nx], steady.stable
    motion = _drawn(request, nominal, thetas, commands, begun)
    over = request.limit_program(nominal, trial).worst(motion.state, since)
    stable = motion.stable & settled
    over[:, ~stable] = np.inf
    return over, (over <= 1e-3).all(axis=0) & stable


def _drawn(
    request: PreparedRequest,
    nominal: Rollout,
    thetas: Array,
    commands: Array,
    begun: Array | None = None,
) -> Motion:
    """Run models (R, p), with forces drawn from the prior's misfit, from their own states or one.

    What the forces do adds up from nothing, and what is left of the states' own difference dies
    out, so that both together stay what a model settled to.
    """
    motion = nominal.run_models(thetas, commands, late=True, begun=begun)
    if request.misfit is None:
        return motion
    return nominal.moved(motion, request.misfit(nominal.run(commands[None]), len(thetas)))


def tighten(
    request: PreparedRequest,
    first: Found,
    again: Callable[[PreparedRequest, Found], Found | None],
    units: Callable[[Found], list[Array]],
    rounds: int,
) -> tuple[PreparedRequest, Found, ConstraintSatisfaction]:
    """Search again with tighter path limits until they are kept with the wanted probability.

    Where what is found misses limits as they were asked for, they are tightened half as much.

    Parameters
    ----------
    request : PreparedRequest
        With the limits as they were asked for.
    first : object
        What was found with them.
    again : callable
        Searches with tighter limits, given what was found last; None where nothing was.
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
    last, more = first, 1.1 * keeping.shortfall
    backoff = np.zeros(len(more))
    for _ in range(rounds):
        if best[2].probability >= request.probability or not more.any():
            break
        tighter = replace(request, backoff=tuple(backoff + more))
        found = again(tighter, last)
        if found is None or any(
            (assess(p, u[None])[0].missed > TOLERANCE).any()
            for p, u in zip(problems, units(found), strict=True)
        ):
            more = 0.5 * more
            continue
        now = keep_probability(request, units(found))
        last, backoff, more = found, backoff + more, 1.1 * now.shortfall
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
