"""Design of trials: from a request to sequences, with their information and limits."""

from __future__ import annotations

import logging
import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from experiment_design.certificate.certificate import Certificate, absent, certify
from experiment_design.constraints.kinds.margin import Margin
from experiment_design.constraints.limits import LimitReport
from experiment_design.criteria.covariance import Criterion
from experiment_design.excitation.rollout import Motion
from experiment_design.feasibility.actuator_delay import late_notes
from experiment_design.feasibility.checks import (
    feasible_or_reason,
    missed_targets,
    require_horizon,
    require_informative,
    require_stable,
    require_start,
    tells_enough,
    unexcited,
)
from experiment_design.feasibility.constraint_satisfaction import (
    ConstraintSatisfaction,
    keep_probability,
    tightened_campaign,
)
from experiment_design.feasibility.least_violation import closest, moved_constant, perturbed
from experiment_design.information.moments import MomentProgram
from experiment_design.optimise.campaign import (
    Found,
    Progress,
    covariance_of,
    random_campaign,
    search_campaign,
    sums_of_others,
)
from experiment_design.optimise.classical import Alternative, compare_classical
from experiment_design.optimise.lead_in import after_lead_in
from experiment_design.optimise.search import Candidate, assess, limit_scale, to_unit, within_reach
from experiment_design.optimise.solve import EXACT_COLUMNS, Outcome, solve_ipopt
from experiment_design.output.result import Design, PlanPart, logdet_information, run_through
from experiment_design.output.sheet_contents import turned_notes
from experiment_design.request.apparent_wind import air_notes
from experiment_design.request.problem import TrialProblem
from experiment_design.request.request import (
    LeadIn,
    PreparedRequest,
    build_problem,
    wanted_parameters,
)
from greybox.errors import InfeasibleError
from greybox.numerics.threads import one_thread
from greybox.trial.plan_parts import LEAD_IN, TRIAL

Array = NDArray[np.float64]

# scaled units from which a limit counts as active; iterations and seconds of the polish
_NEAR, _POLISH, _PATIENCE = 0.1, 40, 3600.0
# how a design ended that keeps not all of its limits
CLOSEST = "limits not kept: the closest plan that was found"
STOPPED = "stopped by the user: the best plan found so far"

_log = logging.getLogger(__name__)


@one_thread()
def design_trial(
    request: PreparedRequest,
    *,
    best_effort: bool = False,
    progress: Progress | None = None,
    workers: int | None = None,
    first: tuple[Array, ...] | None = None,
    alternatives: bool = True,
) -> Design:
    """Design the next trial, or the trials of a campaign.

    A single trial whose start misses its margins begins behind the shortest lead-in that brings
    the ship into the regime; what the plan is worth is said of the trial alone.

    Parameters
    ----------
    request : PreparedRequest
    best_effort : bool
        Return the closest plan when limits cannot be kept.
    progress : callable, optional
        Called with the pieces of work done and to be done.
    workers : int, optional
        Processes; by default as the work asks for. The result does not depend on it.
    first : tuple of ndarray, optional
        (K, nc) levels a trial to start from; brought within range and rates, whatever else.
    alternatives : bool
        Evaluate the classical sequences too.

    Returns
    -------
    Design

    Raises
    ------
    InfeasibleError
        Limits contradict or cannot be kept, no lead-in leads into the regime, the trial is
        too short for its parameters, or the prior model is unstable.

    References
    ----------
    Ljungberg (2020), A10, A15 and section 5.2 for the margins; Atkinson, Donev and
    Tobias (2007) for the criteria.
    """
    began = time.perf_counter()
    require_horizon(request)
    request = after_lead_in(request, tells_enough, best_effort=best_effort)
    problems = [build_problem(request, t) for t in range(request.trials)]
    _log.info(
        "%d trial(s) of %g s, %d levels each, criterion %s", len(problems), request.duration,
        problems[0].shape[0] * problems[0].shape[1], request.criterion,
    )  # fmt: skip
    for t, problem in enumerate(problems):
        require_start(problem, request, t)
    reference, kept = random_campaign(problems, request.seed)
    _log.info("%d random two-level sequences keep the limits", kept)
    if reference is None:
        require_stable(request)
    elif request.out_of_reach is None:
        require_informative(request, problems, reference, hopeless=10.0)
    initial = reference
    if reference is None:
        moved = [moved_constant(p, request.seed) for p in problems]
        if all(c is not None for c in moved):
            initial = [c.unit for c in moved if c is not None]
    if first is not None:
        initial = [within_reach(p, to_unit(p, v)) for v, p in zip(first, problems, strict=True)]
    found = search_campaign(
        request,
        problems,
        initial,
        effort=request.effort,
        progress=progress,
        workers=workers,
    )
    candidates, evaluations = list(found.candidates), found.evaluations
    notes: list[str] = []
    status = "solved: local optimum of many ascents"
    stopped = found.stopped
    if not stopped:
        try:
            candidates, more, polished = _polish(problems, candidates)
            evaluations += more
            if polished:
                status = f"solved: many ascents, then multiple shooting; {polished}"
        except KeyboardInterrupt:
            stopped = True
    if not all(c.feasible for c in candidates):
        nearest = tuple(
            c if c.feasible else closest(p, c.unit[None], request.seed)
            for p, c in zip(problems, candidates, strict=True)
        )
        again = _from_closest(request, problems, nearest, workers)
        if again is not None:
            candidates, evaluations = list(again.candidates), evaluations + again.evaluations
            stopped = stopped or again.stopped
    _log.info("%s; %d evaluations", status, evaluations)
    missing = [t for t, c in enumerate(candidates) if not c.feasible]
    if missing:
        t = missing[0]
        candidates[t], sentence = feasible_or_reason(
            problems[t], request, t, candidates[t], nearest[t]
        )
        if sentence:
            if not best_effort:
                raise InfeasibleError(sentence)
            status = CLOSEST
            notes.append(sentence)
    if request.out_of_reach is not None:
        status = CLOSEST
    keeping: ConstraintSatisfaction | None = None
    if request.uncertain and not stopped:
        try:
            request, candidates, keeping, more = tightened_campaign(
                request, problems, candidates, effort=request.effort, workers=workers
            )
            evaluations += more
        except KeyboardInterrupt:
            stopped = True
    units = [c.unit for c in candidates]
    covariance = covariance_of(problems, units)
    if not np.isfinite(covariance).all() and not request.contrasts:
        raise InfeasibleError(unexcited(problems, units, request))
    try:
        notes += require_informative(request, problems, units)
    except InfeasibleError as error:
        if not best_effort or status != CLOSEST:
            raise
        notes.append(str(error))
    notes += missed_targets(request, problems, units)
    certificate = absent("the user stopped the design")
    if not stopped:
        try:
            certificate = certify(problems, units, effort=min(1.0, request.effort))
        except KeyboardInterrupt:
            stopped = True
    design = described(
        request, problems, units, reference, kept, certificate=certificate, keeping=keeping,
        status=STOPPED if stopped else status,
        notes=tuple(notes), evaluations=evaluations, began=began,
    )  # fmt: skip
    if not alternatives or request.trials > 1 or stopped:
        return design
    classical = compare_classical(problems[0], request.seed)
    if reference is not None:
        value = float(problems[0].evaluate(reference[0][None]).value[0])
        two = Alternative("random two-level", kept, kept, value, reference[0])
        classical = (two, *classical)
    return replace(design, alternatives=classical, seconds=time.perf_counter() - began)


def described(
    request: PreparedRequest,
    problems: list[TrialProblem],
    units: list[Array],
    reference: list[Array] | None,
    kept: int,
    *,
    certificate: Certificate,
    keeping: ConstraintSatisfaction | None,
    status: str,
    notes: tuple[str, ...],
    evaluations: int,
    began: float,
) -> Design:
    """Return what sequences are worth, and how they stand to the limits.

    Parameters
    ----------
    request : PreparedRequest
    problems : list of TrialProblem
        One per trial.
    units : list of ndarray
        (K, nc) unit coordinates a trial.
    reference : list of ndarray or None
        The best random two-level sequences, and `kept`, how many of them keep the limits.
    kept : int
    certificate : Certificate
    keeping : ConstraintSatisfaction or None
    status : str
    notes : tuple of str
    evaluations : int
    began : float
        When the work began, by `time.perf_counter`.
    """
    criterion = problems[0].criterion
    covariance = covariance_of(problems, units)
    columns = wanted_parameters(request, criterion)
    value = _criterion_value(problems, units, criterion, covariance)
    versus, random_value, random_std = None, float("nan"), None
    if reference is not None:
        other = covariance_of(problems, reference)
        random_value = _criterion_value(problems, reference, criterion, other)
        gain = (logdet_information(covariance) - logdet_information(other)) / len(covariance)
        versus = float(np.exp(value - random_value if request.contrasts else gain))
        with np.errstate(invalid="ignore"):
            random_std = np.asarray(np.sqrt(np.diag(other)))
    values = np.array(
        [sum(float(request.theta[request.structure.index(n)]) for n in c.terms) for c in columns]
    )
    levels = tuple(p.levels(u) for p, u in zip(problems, units, strict=True))
    commands = tuple(p.schedule.expand(v) for p, v in zip(problems, levels, strict=True))
    motions = tuple(
        p.scenarios[0].rollout.run(c[None], late=True)
        for p, c in zip(problems, commands, strict=True)
    )
    parts: tuple[PlanPart, ...] = ()
    led: tuple[str, ...] = ()
    if request.lead_in is not None:
        parts, led = _parts(request.lead_in, request), (_led(request.lead_in),)
        motions = (_behind(request, run_through(request, levels[0])),)
    reports = _limit_reports(request, problems, motions, levels)
    late = late_notes(request, problems, motions, reports, covariance)
    if (told := request.out_of_reach) is not None:
        notes = (told.sentence, *notes, f"this plan was designed for {request.stand_ins} instead")
        asked = request.as_asked()
        reports = _limit_reports(
            asked, [build_problem(asked, t) for t in range(asked.trials)], motions, levels
        )
        keeping = None if keeping is None else keep_probability(asked, units)
    design = Design(
        request,
        commands,
        levels,
        motions,
        tuple(c.name for c in columns),
        values,
        covariance,
        value,
        versus,
        random_value,
        kept,
        certificate,
        _margins(problems, motions),
        reports,
        keeping,
        (),
        status,
        (*led, *notes, *late, *air_notes(request, motions), *turned_notes(request.vessel)),
        evaluations,
        time.perf_counter() - began,
        parts,
        random_std,
    )
    if keeping is None or not design.doubtful:
        return design
    doubt = (
        f"the limits are kept with probability {keeping.probability:.2f}, {request.probability:g} "
        f"was asked for: do not sail this plan as it is, but {design.remedy}"
    )
    return replace(design, notes=(doubt, *design.notes))


def _parts(lead: LeadIn, request: PreparedRequest) -> tuple[PlanPart, ...]:
    return (
        PlanPart(LEAD_IN, 0, 0.0, lead.seconds),
        PlanPart(TRIAL, 0, lead.seconds, lead.seconds + request.duration),
    )


def _led(lead: LeadIn) -> str:
    return (
        f"a lead-in of {lead.seconds:g} s brings the ship from her start into the regime: sea room "
        f"and caps hold in it and margins do not, and what the plan is worth counts the trial "
        f"behind it alone"
    )


def _behind(request: PreparedRequest, motion: Motion) -> Motion:
    """Return the motion of the trial itself, its place counted from where the lead-in ends."""
    n = request.lead_in_samples
    state = motion.state[:, n:].copy()
    moved = np.array(request.limits.position) - request.from_first_command().limits.position
    state[..., -2:] -= moved
    return Motion(state, motion.tau[:, n:], motion.commands[:, n:], motion.stable)


def _from_closest(
    request: PreparedRequest,
    problems: list[TrialProblem],
    nearest: tuple[Candidate, ...],
    workers: int | None,
) -> Found | None:
    """Search once more around the sequences that miss the limits least, None where they do.

    An ascent from outside may be stopped by a limit that no path crosses, such as
    a component of the velocity through the air that keeps either sign.
    """
    lively = [perturbed(p, c, request.seed) for p, c in zip(problems, nearest, strict=True)]
    if not all(c.feasible for c in lively):
        return None
    first = [c.unit for c in lively]
    return search_campaign(request, problems, first, effort=request.effort, workers=workers)


def _polish(
    problems: list[TrialProblem], candidates: list[Candidate]
) -> tuple[list[Candidate], int, str]:
    """Let IPOPT polish the trials whose limits on the motion are active.

    Returns
    -------
    tuple
        Candidates, the iterations, and what IPOPT said last, empty where it was not asked.
    """
    out, spent, said = list(candidates), 0, ""
    for t, problem in enumerate(problems):
        if problem.contrast is not None or not _active(problem, out[t]):
            continue
        here = problem.with_known(sums_of_others(problems, [c.unit for c in out], t))
        result = solve_ipopt(here, out[t].unit, iterations=_POLISH, seconds=_PATIENCE)
        if result.outcome is Outcome.REFUSED:
            continue
        spent += result.iterations
        said = result.status
        if result.beats(assess(here, out[t].unit[None])[0], limit_scale(problem)):
            out[t] = assess(here, result.unit[None])[0]
    return out, spent, said


def _active(problem: TrialProblem, candidate: Candidate) -> bool:
    """Whether some limit on the motion is missed or nearly reached, and IPOPT can weigh it."""
    information = problem.scenarios[0].information
    if isinstance(information, MomentProgram) and (
        not information.white and information.columns > EXACT_COLUMNS
    ):
        return False
    if len(problem.scenarios) > 1 or problem.criterion.prior is not None:
        return False
    program = problem.scenarios[0].limits
    commands = problem.commands(candidate.unit)
    motion = problem.scenarios[0].rollout.run(commands[None])
    path = program.path_values(motion.state[0]).max(axis=1, initial=-np.inf) / program.path_scale
    whole = program.whole_values(motion)[:, 0] / program.whole_scale
    return bool((np.concatenate([path, whole]) > -_NEAR).any())


def _criterion_value(
    problems: list[TrialProblem], units: list[Array], criterion: Criterion, covariance: Array
) -> float:
    if problems[0].contrast is not None:
        return float(problems[0].evaluate(units[0][None]).value[0])
    # of a parameter that the trial does not tell the covariance is infinite
    with np.errstate(invalid="ignore"):
        return float(criterion.of_covariance(covariance[None])[0])


def _margins(problems: list[TrialProblem], motions: tuple[Motion, ...]) -> dict[str, float]:
    """Return the least distance of each sign-keeping state from zero, currents included."""
    found: dict[str, float] = {}
    for problem, motion in zip(problems, motions, strict=True):
        program = problem.scenarios[0].limits
        values = program.path_values(motion.state[0])
        states = problem.scenarios[0].rollout.structure.states
        kept = {}
        for limit, back, value in zip(program.path_limits, program.backoff, values, strict=True):
            if isinstance(limit, Margin):
                kept[limit.state] = float((limit.bound + back - value).min())
        for i, name in enumerate(states):
            if name in ("u", "v") and name not in kept:
                kept[name] = float(np.abs(motion.state[0, :, i]).min())
        found |= {n: min(found.get(n, np.inf), least) for n, least in kept.items()}
    return found


def _limit_reports(
    request: PreparedRequest,
    problems: list[TrialProblem],
    motions: tuple[Motion, ...],
    levels: tuple[Array, ...],
) -> tuple[LimitReport, ...]:
    found = []
    for t, (problem, motion) in enumerate(zip(problems, motions, strict=True)):
        program = problem.scenarios[0].limits
        missed = program.violations(motion)[:, 0]
        if request.lead_in is not None and motion.stable[0]:
            whole = run_through(request, levels[t])
            plain = replace(request.from_first_command(), backoff=())
            way = build_problem(plain, t).scenarios[0].limits
            worst = way.worst(whole.state, request.lead_in_samples)[:, 0]
            missed[: len(worst)] = np.maximum(missed[: len(worst)], worst)
        for limit, m in zip(program.all_limits, missed, strict=True):
            found.append(
                LimitReport(t, limit.words, limit.bound, limit.unit, float(m), limit.phrase)
            )
    return tuple(found)
