"""The least duration of a trial that reaches wanted standard errors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from experiment_design.feasibility.checks import tells_enough
from experiment_design.feasibility.constraint_satisfaction import tightened_campaign
from experiment_design.optimise.campaign import (
    Progress,
    random_campaign,
    search_campaign,
    std_of,
)
from experiment_design.optimise.lead_in import after_lead_in
from experiment_design.request.request import PreparedRequest, build_problem, wanted_columns
from greybox.errors import InfeasibleError, UsageError

# share of the usual search that each tried duration gets
_QUICK = 0.15
# a duration is settled to this share of itself, or to one hold
_SETTLED = 0.03


def least_duration(
    request: PreparedRequest,
    targets: Mapping[str, float],
    *,
    best_effort: bool = False,
    progress: Progress | None = None,
    workers: int | None = None,
) -> PreparedRequest:
    """Return the request with the least duration whose design reaches wanted standard errors.

    Parameters
    ----------
    request : PreparedRequest
        Its duration, behind a lead-in, is the longest that is allowed.
    targets : mapping of str to float
        Wanted standard error of each named parameter, in its unit.
    best_effort : bool
        See `design_trial`.
    progress : callable, optional
        Called with steps done and steps in all.
    workers : int, optional
        Processes.

    Returns
    -------
    PreparedRequest
        Of the least duration, in whole holds, with the A criterion scaled by the targets; of the
        longest where no sequence was found that keeps its limits, so that `design_trial` says
        which one stops it.

    Raises
    ------
    UsageError
        A target is no positive number.
    InfeasibleError
        Even the longest trial does not reach them; says how far it gets.
    """
    for name, value in targets.items():
        if not 0 < value < np.inf:
            raise UsageError(f"the target of {name} is {value:g}, it must be positive.")
    request = after_lead_in(request, tells_enough, best_effort=best_effort)
    predictor = request.build_predictor()
    # of two names of one column the one with the smaller target
    told: dict[int, str] = {}
    for name in targets:
        (column,) = wanted_columns(predictor, (name,))
        told[column] = min(told.get(column, name), name, key=targets.__getitem__)
    goal = np.array([targets[n] for n in told.values()])
    wanted = replace(
        request, criterion="A", wanted=tuple(predictor.columns[i].name for i in told),
        targets=tuple(goal.tolist()),
    )  # fmt: skip
    effort = _QUICK * request.effort
    tried = [0]

    def reached(duration: float) -> tuple[float, int]:
        trial = replace(wanted, duration=duration)
        problems = [build_problem(trial, t) for t in range(trial.trials)]
        start, _ = random_campaign(problems, trial.seed)
        found = search_campaign(trial, problems, start, effort=effort, workers=workers)
        tried[0] += 1
        if progress is not None:
            progress(min(tried[0], 14), 15)
        candidates = list(found.candidates)
        if not all(c.feasible for c in candidates):
            return np.inf, 0
        if trial.uncertain:
            # sequences that keep the limits surely tell less
            _, candidates, _, _ = tightened_campaign(
                trial, problems, candidates, effort=effort, workers=workers
            )
        ratio = std_of(problems, [c.unit for c in candidates]) / goal
        return float(ratio.max()), int(ratio.argmax())

    longest = request.duration
    ratio, worst = reached(longest)
    if ratio == np.inf:
        return replace(wanted, duration=longest)
    if ratio > 1:
        name = list(told.values())[worst]
        raise InfeasibleError(
            f"{longest:g} s do not reach the target: the standard error of {name} would be "
            f"{ratio:.2g} times the {targets[name]:.3g} that is wanted. Allow about "
            f"--duration {float(f'{longest * ratio**2:.2g}'):g}, or a larger --target."
        )
    hold = request.hold
    least = 2 * hold
    low, high = least, longest
    while high - low > max(hold, _SETTLED * high):
        # standard errors fall with the square root of time
        guess = np.clip(
            high * ratio**2 * 1.02, low + 0.15 * (high - low), high - 0.15 * (high - low)
        )
        duration = float(round(guess / hold) * hold)
        if not low < duration < high:
            break
        now, _ = reached(duration)
        if now <= 1:
            high, ratio = duration, now
        else:
            low = duration
    if progress is not None:
        progress(15, 15)
    return replace(wanted, duration=high)
