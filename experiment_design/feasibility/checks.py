"""Feasibility checks before and after the search, and their messages."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from experiment_design.constraints.kinds.margin import FromZero
from experiment_design.constraints.limits import TOLERANCE, Circumstances, Limit
from experiment_design.excitation.schedule import MOST_SAMPLES
from experiment_design.feasibility.least_violation import (
    least_change,
    moved_constant,
    perturbed,
)
from experiment_design.feasibility.stability import unstable_sentence
from experiment_design.information.estimators import ESTIMATORS
from experiment_design.optimise.campaign import (
    random_campaign,
    std_of,
    sums_of_all,
    sums_of_others,
)
from experiment_design.optimise.search import Candidate, ascend, assess
from experiment_design.request.problem import TrialProblem
from experiment_design.request.regimes import steady_motions
from experiment_design.request.request import PreparedRequest, build_problem, wanted_parameters
from greybox.errors import InfeasibleError
from greybox.model.predictor_kinds import PREDICTORS
from greybox.numerics.linalg import scaled

Array = NDArray[np.float64]

# relative standard error from which nothing was learnt of a parameter
_VAGUE = 2.0
# times that a duration is doubled until random sequences tell enough
_DOUBLINGS = 8
# evaluations by which it is found out whether a trial tells enough
_BRIEF = 200
# shares of what is reached at best that are tried as margins
ROOM = (0.95, 0.9, 0.8, 0.65, 0.4, 0.2)


def require_horizon(request: PreparedRequest) -> None:
    """Raise where the trial has fewer samples than an equation has unknowns."""
    predictor = request.build_predictor()
    samples = request.schedule.samples
    most = max(len(predictor.equation(s)) + 1 for s in request.structure.states)
    if samples * request.trials <= most:
        longer = max(2 * most * request.sample_time, 6 * request.hold)
        fewer = PREDICTORS[request.predictor].plain
        other = "." if fewer == request.predictor else f", or --predictor {fewer}."
        raise InfeasibleError(
            f"a trial of {request.duration:g} s has {samples} samples, too few for the {most} "
            f"unknowns of one equation: use --duration {longer:g} or more{other}"
        )


def require_informative(
    request: PreparedRequest,
    problems: list[TrialProblem],
    units: list[Array],
    hopeless: float = 1.0,
) -> list[str]:
    """Raise where the trial is too short to tell most parameters; return notes on doubtful ones.

    `hopeless` is how many times vaguer random sequences may be than the design.
    """
    if not request.tells_each:
        return []
    names = [c.name for c in wanted_parameters(request, problems[0].criterion)]
    share = std_of(problems, units) / problems[0].criterion.scale
    if hopeless > 1 and not np.isfinite(share).all():
        return []
    vague = [n for n, s in zip(names, share, strict=True) if s > hopeless * _VAGUE]
    if 2 * len(vague) > len(names):
        longer = _telling_duration(request)
        other = "--want fewer parameters"
        fewer = PREDICTORS[request.predictor].plain
        if request.predictor != fewer:
            other = f"--predictor {fewer}"
        if request.limits.margin_air:
            other = "a lower --margin-air"
        advice = f"Use {other}" if longer is None else f"Use --duration {longer:g}, or {other}"
        raise InfeasibleError(
            f"a trial of {request.duration:g} s is too short: the predicted standard error of "
            f"{', '.join(vague)} is more than {_VAGUE:g} times the prior value "
            f"({share.max():.2g} times at worst). {advice}."
        )
    doubtful = [n for n, s in zip(names, share, strict=True) if s > 1]
    if not doubtful:
        return []
    one = len(doubtful) == 1
    return [
        f"{', '.join(doubtful)} will stay unknown by more than {'its' if one else 'their'} prior "
        f"value: lengthen the trial, or leave {'it' if one else 'them'} out with --want"
    ]


def _telling_duration(request: PreparedRequest) -> float | None:
    """Return a duration at which random sequences tell at least half of the parameters.

    None where they never do, or keep no limits.
    """
    duration = request.duration
    for _ in range(_DOUBLINGS):
        duration *= 2
        if duration > MOST_SAMPLES * request.sample_time:
            return None
        longer = replace(request, duration=duration)
        problems = [build_problem(longer, t) for t in range(request.trials)]
        units, _ = random_campaign(problems, request.seed)
        if units is None:
            # limits that no random sequence keeps are kept no longer
            return None
        share = std_of(problems, units) / problems[0].criterion.scale
        if 2 * (share > _VAGUE).sum() <= len(share):
            return duration
    return None


def missed_targets(
    request: PreparedRequest, problems: list[TrialProblem], units: list[Array]
) -> list[str]:
    """Return a note on each wanted standard error that sequences do not reach."""
    if not request.targets:
        return []
    reached = zip(request.wanted, std_of(problems, units), request.targets, strict=True)
    return [
        f"the standard error of {n} is {s:.3g} and {target:.3g} was wanted: ask for --target "
        f"{n}={target**2 / s:.2g}, or for limits that leave more room"
        for n, s, target in reached
        if s > target
    ]


def require_start(
    problem: TrialProblem, request: PreparedRequest, trial: int, only: str = ""
) -> None:
    """Raise where the start itself breaks a limit, or the one of that name only."""
    program = problem.scenarios[0].limits
    missed = problem.missed_at_start(request.starts[trial])
    for limit, m, more in zip(program.path_limits, missed, program.backoff, strict=True):
        if m - more > TOLERANCE and only in ("", limit.name):
            raise InfeasibleError(limit.start_advice(float(m)))


def require_stable(request: PreparedRequest) -> None:
    """Raise where the prior model runs away under any constant command."""
    sentence = unstable_sentence(request, request.starts[0])
    if sentence:
        raise InfeasibleError(sentence)


def feasible_or_reason(
    problem: TrialProblem, request: PreparedRequest, trial: int, best: Candidate, nearest: Candidate
) -> tuple[Candidate, str]:
    """Return the better of two candidates, and why limits cannot be kept, empty if they can."""
    chosen = nearest if nearest.missed.max(initial=0) < best.missed.max(initial=0) else best
    if (chosen.missed <= TOLERANCE).all():
        if np.isfinite(chosen.value):
            return chosen, ""
        if not np.isfinite(best.value):
            return chosen, unexcited([problem], [chosen.unit], request)
        # what keeps the limits tells nothing, so that the limits are what stops the trial
        chosen = best
    changes = least_change(problem, chosen)
    circumstances = Circumstances(
        float(np.hypot(*request.d[:2])),
        lambda: smallest_circle(request),
        _margins_within_reach(request, trial, chosen, changes),
    )
    limit, amount = changes[0]
    return chosen, limit.advice(amount, circumstances)


def _margins_within_reach(
    request: PreparedRequest, trial: int, chosen: Candidate, changes: list[tuple[Limit, float]]
) -> str:
    """Return the margins, as options, under which sequences around one keep every limit.

    Empty where margins are not all that is missed. What the sequence reaches itself leaves no
    room to move in, so that shares of it are tried.
    """
    if not all(isinstance(x, FromZero) for x, _ in changes):
        return ""
    for share in ROOM:
        limits, told = request.limits, {}
        for limit, missed in changes:
            bound = float(np.floor(1e3 * share * (limit.bound - missed)) / 1e3)
            if bound < 0:
                return ""
            limits, told[limit.option] = limit.with_bound(limits, bound), bound
        problem = build_problem(replace(request, limits=limits), trial)
        if perturbed(problem, assess(problem, chosen.unit[None])[0], request.seed).feasible:
            return " ".join(f"{option} {bound:g}" for option, bound in told.items())
    return ""


def tells_enough(request: PreparedRequest) -> bool:
    """Whether one ascent a trial finds sequences that keep the limits and tell enough."""
    problems = [build_problem(request, t) for t in range(request.trials)]
    units, _ = random_campaign(problems, request.seed)
    if units is None:
        moved = [moved_constant(p, request.seed) for p in problems]
        units = [c.unit for c in moved if c is not None]
    if len(units) < len(problems):
        return False
    for t, problem in enumerate(problems):
        here = problem.with_known(sums_of_others(problems, units, t))
        found = ascend(here, units[t], _BRIEF)
        if found.feasible:
            units[t] = found.unit
    if not request.tells_each:
        return True
    share = std_of(problems, units) / problems[0].criterion.scale
    return bool(2 * (share > _VAGUE).sum() <= share.size)


def smallest_circle(request: PreparedRequest) -> float | None:
    """Return the diameter of the smallest circle that keeps the regime [m], None without any."""
    steady = steady_motions(request)
    signs = np.ones(len(steady.x), bool)
    for state, sign in request.regimes[0]:
        column = steady.x[:, request.structure.states.index(state)]
        signs &= column * sign >= request.limits.margins.get(state, 0.0)
    return float(steady.diameter[signs].min()) if signs.any() else None


def unexcited(problems: list[TrialProblem], units: list[Array], request: PreparedRequest) -> str:
    """Return which regressor no sequence moves enough to be told from the others."""
    if ESTIMATORS[request.estimator].free_run:
        return (
            "this trial cannot tell the parameters of an output-error fit apart: lengthen it, "
            "widen the limits, or use --predictor basic."
        )
    sums = sums_of_all(problems, units)
    predictor = request.build_predictor()
    worst, label, state = np.inf, "", ""
    for name in request.structure.states:
        mine = predictor.equation(name)
        gram = sums.gram[0][np.ix_(mine, mine)]
        size = np.sqrt(np.maximum(np.diag(gram), 0.0))
        if (size <= 0).any():
            still = predictor.columns[mine[int(size.argmin())]].label
            return (
                f"no sequence within these limits moves {still}: its regressor varies by 0. "
                f"Widen the limits, leave it out of the structure, or use --estimator oe, which "
                f"needs no variation to tell a constant force."
            )
        values, vectors = np.linalg.eigh(scaled(gram)[0])
        if values[0] < worst:
            worst, state = float(values[0]), name
            label = predictor.columns[mine[int(np.abs(vectors[:, 0]).argmax())]].label
    return (
        f"this trial cannot tell the regressors of {state} apart: along {label} their smallest "
        f"eigenvalue is {max(worst, 0):.1e} of the largest, 1e-12 is needed. Lengthen the trial, "
        f"widen the limits, use --predictor basic, or plan --trials 2 in other regimes."
    )
