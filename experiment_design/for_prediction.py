"""The trial after which a model predicts best, over all that the ship is used for."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiment_design.after import log_moments
from experiment_design.certificate.certificate import absent
from experiment_design.constraints.kinds.sea_room import SeaRoom
from experiment_design.constraints.limits import TOLERANCE, Circumstances, Limit
from experiment_design.design import CLOSEST, described
from experiment_design.excitation.rollout import Motion
from experiment_design.feasibility.checks import require_horizon, require_start, smallest_circle
from experiment_design.feasibility.constraint_satisfaction import (
    ConstraintSatisfaction,
    keeps_start,
    tighten,
)
from experiment_design.feasibility.least_violation import least_change
from experiment_design.information.envelope import Envelope, build_envelope
from experiment_design.optimise.envelope_search import (
    PARTS,
    RANDOM,
    EnvelopeSearch,
    search_envelope,
    usual_beginnings,
)
from experiment_design.optimise.lead_in import after_lead_in
from experiment_design.optimise.search import assess
from experiment_design.output.result import Design, PlanPart
from experiment_design.prepare import require_own_commands
from experiment_design.request.exclusions import require_compatible
from experiment_design.request.regimes import STEADY_SECONDS, start_words
from experiment_design.request.request import PreparedRequest, build_problem
from greybox.channels import CHANNELS
from greybox.diagnosis.result import finite
from greybox.errors import InfeasibleError, VesselError, so_many
from greybox.estimation.prediction_verdict import HeldCommandsDiverge
from greybox.model.model import ManoeuvringModel
from greybox.model.predictor import build_predictor
from greybox.model.semi_empirical import METHOD as SEMI_EMPIRICAL
from greybox.model.semi_empirical import semi_empirical_model
from greybox.numerics.threads import one_thread
from greybox.trial.plan_parts import LEAD_IN, TRIAL, VALIDATION
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]

# rounds of tightening limits until they are kept with the wanted probability
_TIGHTENINGS = 3
# misfit of a prior that nothing was held out for, as a share of the spread of each state, and how
# one is called that only its diagnosis held something out for
_UNKNOWN_MISFIT, _DIAGNOSED = 0.3, "diagnosed"
# deviations of its sensor within which the sign of sway is not known (A10)
_CLOSE = 3.0
# share of a trial near zero from which on nothing useful is left when that is cut out
_MOSTLY = 0.5
# what a plan is compared with, in words
RANDOM_SETTINGS = f"the best of {RANDOM} random sequences of settings of the operating envelope"
# of the range of a speed in the prior's trial: what the plan may go beyond; slowest speed
# ahead, as a share of the limit, where no trial has shown one
_BEYOND, _SLOWEST = 0.1, 0.3


@dataclass(frozen=True)
class PredictionDesign:
    """A plan with the error of predictions that its estimate is expected to leave.

    Parameters
    ----------
    design : Design
    noise, misfit : dict of str to float
        Root mean squared error of each state over the envelope [m/s, rad/s]: by noise, and by
        forces beyond the prior's terms that the trial does not tell.
    random : float
        Root mean squared error of the median of random sequences of the same length, over
        that of the plan, of those that keep the limits; nan where none does, and for several
        trials, where it is not known.
    commands : dict of str to (float, float)
        Range of each command in the envelope, in the log's unit, angles in rad.
    crossings : tuple of (float, float)
        When the sign of sway is not known by its sensor, beginning and end [s], of the first
        trial.
    level : str
        Verdict on the prior's predictions, ``diagnosed`` where only its diagnosis held a log out,
        empty where nothing was.
    missed : dict of str to float
        Share of each state's spread by which a diagnosed prior missed what was held out.
    """

    design: Design
    noise: dict[str, float]
    misfit: dict[str, float]
    random: float
    commands: dict[str, tuple[float, float]]
    crossings: tuple[tuple[float, float], ...]
    level: str
    missed: Mapping[str, float] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON: those of the design, and what is expected of predictions."""
        return self.design.to_dict() | {
            "for": "prediction",
            "efficiency_of": f"mean squared error of predictions: that after {RANDOM_SETTINGS}, "
            f"over that after this plan",
            "prediction": {
                "error_by_noise": self.noise,
                "error_by_misfit": self.misfit,
                "random_error_over_this": finite(self.random),
                "envelope": {n: list(r) for n, r in self.commands.items()},
                "validation_share": self.validation_share,
                "crossings": [list(c) for c in self.crossings],
                "prior": self.level,
            },
        }

    @property
    def validation_share(self) -> float:
        """Share of the first trial, lead-in included, that is its validation."""
        return sum(
            self.design.share(p) for p in self.design.parts if p.name == VALIDATION and not p.trial
        )

    def headline(self) -> str:
        """Return in one sentence what the plan is for and what is expected of it."""
        error = ", ".join(
            f"{n} {np.hypot(self.noise[n], self.misfit[n]):.2g} {CHANNELS[n].unit}"
            for n in self.noise
        )
        said = (
            f"After this trial predictions over the operating envelope are expected to be off by "
            f"{error} (rms, where the estimate chooses its terms by this trial)"
        )
        if np.isfinite(self.random):
            often = f"{self.random:.2f} times as much"
            said += (
                f"; of what a trial can tell, random steps of the same length leave {often}"
                if self.missed
                else f"; after random steps of the same length by {often}"
            )
        if self.design.request.untried:
            said += (
                ". No estimated model stands behind these numbers, only the ship's main "
                "dimensions: take them as a guess, and design again after the first part of the "
                "trial"
            )
        elif self.level in ("poor", "limited"):
            said += (
                f". The prior's own predictions are {self.level}: take these numbers as a guess, "
                f"and design again after the first part of the trial"
            )
        elif self.missed:
            shares = ", ".join(f"{n} {100 * share:.0f} %" for n, share in self.missed.items())
            said += (
                f". These errors hold for a ship that the prior's structure fits. Only its "
                f"diagnosis tried the prior on logs that it was not estimated on: what its runs "
                f"missed there ({shares} of the spread) is taken to stay after the trial"
            )
        elif not self.level:
            said += (
                f". These errors hold for a ship that the prior's structure fits. The prior was "
                f"never tried on logs that it was not estimated on: it is assumed to miss "
                f"{100 * _UNKNOWN_MISFIT:.0f} % of each spread, most of which the trial tells, so "
                f"take these numbers as a guess"
            )
        return f"{said}."

    def summary(self) -> str:
        """Return the plan as text."""
        r = self.design.request
        ranges = ", ".join(
            f"{n} {low:.4g} to {high:.4g}{' rad' if n in r.vessel.angle_commands else ''}"
            for n, (low, high) in self.commands.items()
        )
        lines = [
            f"Plan for {r.vessel.name}: {so_many(r.trials, 'trial')} of "
            f"{r.duration:g} s for prediction, both sides, {ranges}",
            *(["planned without an estimated model, from main dimensions"] if r.untried else []),
            self.headline(),
            f"the first {100 * self.validation_share:.0f} % of each trial, a usual zig-zag or "
            f"turn, judges an estimate of the rest, then joins it (--plan of greybox estimate)",
        ]
        if self.crossings:
            lines.append(_crossed(self.crossings, r.duration))
        if self.design.keeping is not None:
            lines.append(self.design.keeping.sentence())
        if (gain := self.design.efficiency_vs_random) is not None:
            lines.append(
                f"{RANDOM_SETTINGS} leaves {gain:.2f} times the mean squared error of predictions"
            )
        lines += self.design.missed()
        return "\n".join([*lines, *[f"Note: {n}" for n in self.design.notes]])


def _crossed(crossings: Sequence[tuple[float, float]], duration: float) -> str:
    """Say how much of a trial sway spends near zero, and what to do about it."""
    part = sum(b - a for a, b in crossings) / duration
    near = f"within {_CLOSE:g} standard deviations of its noise"
    if part > _MOSTLY:
        return (
            f"sway stays {near} for {100 * part:.0f} % of the trial, so it tells little of sway: "
            f"a less noisy velocity would; --margin-v of greybox estimate would cut these samples"
        )
    times = f"{len(crossings)} times" if len(crossings) > 1 else "once"
    return (
        f"sway comes {near} from zero {times}, {100 * part:.0f} % of the trial: --margin-v of "
        f"greybox estimate cuts these samples (Remark 4.2)"
    )


def command_ranges(
    model: ManoeuvringModel, given: Mapping[str, tuple[float, float]]
) -> dict[str, tuple[float, float]]:
    """Return the range in which each command is used, to both sides.

    What is given stands; else what the prior's trial showed, and without one the limits, speeds
    from a third of full ahead.

    Parameters
    ----------
    model : ManoeuvringModel
    given : mapping of str to (float, float)
    """
    shown = model.record.get("ranges")
    shown = shown if isinstance(shown, Mapping) else {}
    two_sided, found = _two_sided(model.vessel), {}
    for name, limits in model.vessel.limits.items():
        low = -np.inf if limits.lower is None else limits.lower
        high = np.inf if limits.upper is None else limits.upper
        if name in given:
            found[name] = given[name]
            continue
        both = name in two_sided
        if name in shown:
            first, last = (float(v) for v in shown[name])
            wide = _BEYOND * (last - first)
            first, last = first - wide, last + wide
            if both:
                last = max(abs(first), abs(last))
                first = -last
        else:
            first, last = (low, high) if both else (max(low, _SLOWEST * high), high)
        found[name] = (max(low, first), min(high, last))
    return found


def prior_misfit(model: ManoeuvringModel) -> tuple[Array, str]:
    """Return the error of a prior's free runs as a share of each spread (nx,), and its verdict.

    A plan allows for no less misfit of a prior that was only diagnosed than of one for which
    nothing was held out: the current of the log held out was estimated on it.
    """
    verdict = model.record.get("verdict")
    prediction = verdict.get("prediction") if isinstance(verdict, Mapping) else None
    if not isinstance(prediction, Mapping):
        missed = diagnosed_misfit(model)
        shares = [missed.get(s, 0.0) for s in model.structure.states]
        return np.maximum(shares, _UNKNOWN_MISFIT), _DIAGNOSED if missed else ""
    fit = prediction.get("fit")
    fit = fit if isinstance(fit, Mapping) else {}
    shares = [
        min(1.0, max(0.0, 1 - float(fit[s]) / 100)) if isinstance(fit.get(s), int | float)
        else _UNKNOWN_MISFIT
        for s in model.structure.states
    ]  # fmt: skip
    return np.array(shares), str(prediction.get("level", ""))


def planning_model(model: ManoeuvringModel, vessel: Vessel) -> tuple[ManoeuvringModel, str]:
    """Return the model that a trial for predictions is planned with, and what is said of it.

    It is the prior, unless its free run diverges with commands of its own logs held: a plan goes
    where its model can be followed, so one made with such a prior stays away from these commands,
    of which least is known, or keeps a straight course. The main dimensions then take its place,
    with the ranges of commands and the level of prediction that the prior has.

    Parameters
    ----------
    model : ManoeuvringModel
        The prior, with what its own trial showed.
    vessel : Vessel
        Whose dimensions are taken; without them the prior stays.

    Raises
    ------
    UsageError
        The prior is of a ship with other commands.
    """
    require_own_commands(model, vessel)
    verdict = model.record.get("verdict")
    prediction = verdict.get("prediction") if isinstance(verdict, Mapping) else None
    prediction = prediction if isinstance(prediction, Mapping) else {}
    because = prediction.get("because")
    reasons = [r for r in because if isinstance(r, Mapping)] if isinstance(because, list) else []
    fatal = [r for r in reasons if r.get("kind") == HeldCommandsDiverge.kind]
    if not fatal or model.record.get("method") == SEMI_EMPIRICAL:
        return model, ""
    shown = model.record.get("ranges")
    shown = shown if isinstance(shown, Mapping) else {}
    if vessel.service_speed is None and "u" in shown and float(shown["u"][1]) > 0:
        vessel = replace(vessel, service_speed=float(shown["u"][1]))
    try:
        found = semi_empirical_model(vessel)
    except VesselError:
        return model, ""
    if found.structure.states != model.structure.states:
        return model, ""
    ranges = {n: shown[n] for n in vessel.commands if n in shown}
    settings = model.record.get("settings", {})
    # how well the prior followed its own log says nothing of main dimensions
    level = {"prediction": {"level": prediction.get("level", "")}}
    record = {**found.record, "ranges": ranges, "settings": settings, "verdict": level}
    said = (
        f"the prior is not planned with: {fatal[0].get('sentence', 'its free run diverges')}; "
        f"the ship's main dimensions take its place"
    )
    return replace(found, record=record), said


def diagnosed_misfit(model: ManoeuvringModel) -> dict[str, float]:
    """Return which share of each spread free runs missed of what a model's diagnosis held out.

    Empty where the model is of no diagnosis.
    """
    diagnosis, remainder = (model.record.get(n) for n in ("diagnosis", "remainder"))
    told = remainder if isinstance(remainder, Mapping) and remainder.get("added") else diagnosis
    gain = told.get("gain") if isinstance(told, Mapping) else None
    fits = {s: g["after"] for s, g in gain.items()} if isinstance(gain, Mapping) else {}
    known = {s: f for s, f in fits.items() if isinstance(f, int | float) and np.isfinite(f)}
    return {s: min(1.0, max(0.0, 1 - f / 100)) for s, f in known.items()}


def ranges_of_ship(
    request: PreparedRequest, model: ManoeuvringModel, given: Mapping[str, tuple[float, float]]
) -> dict[str, tuple[float, float]]:
    """Return the range in which each command of the ship is used: see `command_ranges`.

    Raises
    ------
    UsageError
        The prior is of a ship with other commands.
    """
    require_own_commands(model, request.vessel)
    return command_ranges(model, given)


def shown_settings(
    model: ManoeuvringModel, commands: Sequence[str], given: Mapping[str, tuple[float, float]]
) -> Array | None:
    """Return settings of the commands (K, nc) between which the prior's trial used the ship.

    To both sides, and as far beyond as `command_ranges` goes; nan for a command whose range is
    given. None where the model's record holds none.
    """
    record = model.record.get("settings")
    if not isinstance(record, Mapping) or not all(c in record or c in given for c in commands):
        return None
    count = min((len(record[c]) for c in commands if c not in given), default=0)
    if not count:
        return None
    shown = np.full((count, len(commands)), np.nan)
    for i, c in enumerate(commands):
        if c not in given:
            shown[:, i] = record[c][:count]
    middle = (shown.min(axis=0) + shown.max(axis=0)) / 2
    shown = middle + (1 + 2 * _BEYOND) * (shown - middle)
    sides = np.where([c in _two_sided(model.vessel) for c in commands], -1.0, 1.0)
    return np.concatenate([shown, sides * shown])


def _two_sided(vessel: Vessel) -> set[str]:
    """Return the commands that push to starboard with one sign and to port with the other."""
    angles = {t.angle for t in vessel.thrusters if isinstance(t.angle, str)}
    rudders = {t.rudder for t in vessel.thrusters if isinstance(t.rudder, str)}
    return angles | rudders | {t.speed for t in vessel.thrusters if t.type == "tunnel"}


def operating_envelope(
    request: PreparedRequest, model: ManoeuvringModel, given: Mapping[str, tuple[float, float]]
) -> tuple[Envelope, str]:
    """Return how the ship is used, and the verdict on the prior's predictions.

    Parameters
    ----------
    request : PreparedRequest
    model : ManoeuvringModel
        The prior, with what its own trial showed.
    given : mapping of str to (float, float)
        See `command_ranges`.
    """
    misfit, level = prior_misfit(model)
    shown = model.record.get("ranges")
    speeds = None
    if isinstance(shown, Mapping) and "u" in shown:
        speeds = (float(shown["u"][0]), float(shown["u"][1]))
    named = request.structure.estimable()
    predictor = replace(
        build_predictor(named, "basic", tuple((s, (1, -1)) for s in request.structure.states)),
        structure=request.structure,
    )
    ranges = ranges_of_ship(request, model, given)
    rollout = build_problem(request).scenarios[0].rollout
    found = build_envelope(
        rollout, predictor, request.noise, request.schedule, ranges, speeds, misfit, request.seed,
        shown_settings(model, request.schedule.commands, given),
    )  # fmt: skip
    return found, level


@one_thread()
def design_for_prediction(
    request: PreparedRequest,
    model: ManoeuvringModel,
    *,
    envelope: Mapping[str, tuple[float, float]] | None = None,
    kept_starts: int = 0,
    sailed: Sequence[Motion] = (),
    best_effort: bool = False,
    workers: int | None = None,
) -> PredictionDesign:
    """Design the trial that leaves the least error of predictions over the operating envelope.

    Parameters
    ----------
    request : PreparedRequest
        Of both sides, as `prepare_request` gives it.
    model : ManoeuvringModel
        The prior, with what its own trial showed.
    envelope : mapping of str to (float, float), optional
        Range of commands that the model is wanted for; see `command_ranges`.
    kept_starts : int
        Trials, from the first, that start as the request says; the others on a straight course
        in the envelope.
    sailed : sequence of Motion
        What has been sailed, as `sailed_trial` gives it: the plan covers what it has not.
    best_effort : bool
        Return the closest plan when limits cannot be kept.
    workers : int, optional
        Processes; by default one a processor. The result does not depend on it.

    Returns
    -------
    PredictionDesign

    Raises
    ------
    UsageError
        What is asked does not go with predictions.
    InfeasibleError
        The prior holds the ship under too few commands, or the limits cannot be kept.

    References
    ----------
    Box and Draper (1959); DuMouchel and Jones (1994).
    """
    began = time.perf_counter()
    require_compatible(request.given | {"for prediction"})
    require_horizon(request)
    found, level = operating_envelope(request, model, envelope or {})
    states = request.structure.states
    asked = started_in(replace(request, misfit=found.misled), found, kept_starts)
    if kept_starts:
        asked = after_lead_in(asked, best_effort=best_effort)
    before = log_moments(found, sailed)
    searches, keeping = tightened_search(asked, lambda r: _campaign(r, found, before, workers))
    design = described_plan(
        asked, searches, keeping, kept_starts=kept_starts, began=began, best_effort=best_effort,
        certificate="no bound is known on how well a model of any other trial could predict",
    )  # fmt: skip
    usual = usual_beginnings(found, asked.schedule.holds, asked.hold).shape[1]
    design = replace(design, parts=_parts(asked, design.parts, usual))
    if rivals := random_motions(asked, searches):
        errors = [
            found.error_without_parts(trials[-1], before + log_moments(found, trials[:-1]), PARTS)
            for trials in (rivals, random_motions(asked, searches, plan=True))
        ]
        design = replace(design, efficiency_vs_random=float((errors[0] / errors[1])[0]))
    known = before + log_moments(found, design.motions[1:])
    noise, unknown = found.errors(design.motions[0], known)
    if vague := [s for i, s in enumerate(states) if noise[0, i] + unknown[0, i] >= 1]:
        design = replace(design, notes=(_vague_note(vague, searches[0].kept), *design.notes))
    missed = diagnosed_misfit(model) if level == _DIAGNOSED else {}
    # no cause that a diagnosis knows, and no coefficient, explained it
    unknown = np.maximum(unknown, [missed.get(s, 0.0) ** 2 for s in states])
    kept = searches[0].random
    random = float(np.median(np.exp(-kept))) if len(kept) else float("nan")
    v = states.index("v") if "v" in states else None
    crossings: tuple[tuple[float, float], ...] = ()
    if v is not None:
        margin = _CLOSE * float(asked.noise.measurement[v])
        near = np.abs(design.motions[0].state[0, :-1, v]) < margin
        crossings = _stretches(near, asked.sample_time)
    return PredictionDesign(
        design,
        {s: float(np.sqrt(noise[0, i]) * found.spread[i]) for i, s in enumerate(states)},
        {s: float(np.sqrt(unknown[0, i]) * found.spread[i]) for i, s in enumerate(states)},
        random * np.exp(searches[0].candidate.value) if asked.trials == 1 else float("nan"),
        {n: (float(a), float(b)) for n, a, b in
         zip(asked.schedule.commands, found.lower, found.upper, strict=True)},
        crossings,
        level,
        missed,
    )  # fmt: skip


def _vague_note(states: Sequence[str], kept: int) -> str:
    """Return what helps where a plan leaves some states as unknown as before."""
    said = f"after this trial the mean would predict {', '.join(states)} no worse"
    if kept:
        return f"{said}: lengthen it"
    return (
        f"{said}, for the prior keeps none of {RANDOM} random sequences within the limits: widen "
        f"them, estimate it on a longer trial, or use --prior none"
    )


def started_in(request: PreparedRequest, envelope: Envelope, kept: int) -> PreparedRequest:
    """Return the request whose trials but the first few start on a course in the envelope.

    It is the fastest that keeps the caps with the wanted probability, or else by the prior alone;
    where none does, trials start as they were prepared.
    """
    others = request.trials - kept
    if not others:
        return request
    problem = build_problem(request, request.trials - 1)
    given = request.start_commands or (None,) * request.trials
    fastest = None
    for start, commands in _courses(envelope):
        if (problem.missed_at_start(start) > TOLERANCE).any():
            continue
        begun = replace(
            request,
            starts=(*request.starts[:kept], *(start,) * others),
            start_commands=(*given[:kept], *(commands,) * others),
        )
        if keeps_start(begun, request.trials - 1):
            return begun
        fastest = fastest or begun
    return fastest or request


def _courses(envelope: Envelope) -> Iterator[tuple[Array, Array]]:
    """Yield states with heading (nx + 1,) on courses, and their commands (nc,).

    Those that steer nothing come first, of either kind the fastest.
    """
    yield envelope.rollout.start, envelope.begun
    rollout = envelope.rollout
    samples = round(STEADY_SECONDS / rollout.sample_time)
    kinds = envelope.ahead, envelope.settings[envelope.straight]
    for courses in (k for k in kinds if len(k)):
        motion = rollout.run(np.repeat(courses[:, None], samples, axis=1))
        steady = motion.state[:, -1, : rollout.nx]
        for i in np.argsort(-steady[:, 0], kind="stable"):
            if motion.stable[i]:
                yield np.append(steady[i], 0.0), courses[i]


def random_motions(
    request: PreparedRequest, searches: Sequence[EnvelopeSearch], *, plan: bool = False
) -> list[Motion]:
    """Return how the best random sequence of each search moves the ship, or its plan.

    Empty where no random one keeps the limits.
    """
    if not plan and not all(s.kept for s in searches):
        return []
    motions = []
    for t, search in enumerate(searches):
        problem = build_problem(request, t)
        unit = (search.candidate if plan else search.reference).unit
        motions.append(problem.scenarios[0].rollout.run(problem.commands(unit)[None]))
    return motions


def _of_start(request: PreparedRequest, kept: int) -> tuple[str, ...]:
    if kept >= request.trials:
        return ()
    which = "each trial but the first starts" if kept else "each trial starts"
    return (f"{which} from a steady motion: {start_words(request, -1)} (--start to change)",)


def _parts(request: PreparedRequest, led: tuple[PlanPart, ...], usual: int) -> tuple[PlanPart, ...]:
    """Return what leads in, the first holds, which judge an estimate of the rest, and the rest."""
    if not usual:
        return led
    first = 0.0 if request.lead_in is None else request.lead_in.seconds
    judged = first + usual * request.hold
    spans = ((VALIDATION, first, judged), (TRIAL, judged, first + request.duration))
    return (
        *(part for part in led if part.name == LEAD_IN),
        *(PlanPart(n, t, a, b) for t in range(request.trials) for n, a, b in spans),
    )


def described_plan(
    request: PreparedRequest,
    searches: Sequence[EnvelopeSearch],
    keeping: ConstraintSatisfaction | None,
    *,
    kept_starts: int,
    began: float,
    certificate: str,
    best_effort: bool = False,
) -> Design:
    """Return the design that searches over settings of an envelope found.

    Parameters
    ----------
    request : PreparedRequest
        As asked for.
    searches : sequence of EnvelopeSearch
        One per trial.
    keeping : ConstraintSatisfaction or None
    kept_starts : int
        Trials, from the first, whose start was given.
    began : float
        When the work began, by `time.perf_counter`.
    certificate : str
        Why there is no bound.
    best_effort : bool
        Return a plan that misses a limit too.

    Raises
    ------
    InfeasibleError
        The best plan misses a limit.
    """
    status, notes = "solved: exchange of settings of the operating envelope", []
    problems = [build_problem(request, t) for t in range(request.trials)]
    short = [
        change
        for p, search in zip(problems, searches, strict=True)
        for change in least_change(p, assess(p, search.candidate.unit[None])[0])
    ]
    if short:
        sentence = _lacking(request, *max(short, key=lambda item: item[1] / item[0].scale))
        if not best_effort:
            raise InfeasibleError(sentence)
        notes.append(sentence)
        if request.out_of_reach is not None and all(x.of_regime for x, _ in short):
            # what stands in for a margin is then what the plan keeps
            for limit, amount in sorted(short, key=lambda item: item[1]):
                request = replace(request, limits=limit.eased(request.limits, amount)[0])
    if notes or request.out_of_reach is not None:
        status = CLOSEST
    design = described(
        request, problems, [s.candidate.unit for s in searches], None, 0,
        certificate=absent(certificate), keeping=keeping, status=status,
        notes=(*notes, *_of_start(request, kept_starts)),
        evaluations=sum(s.evaluations for s in searches), began=began,
    )  # fmt: skip
    return replace(design, random_kept=min(s.kept for s in searches))


def _lacking(request: PreparedRequest, limit: Limit, amount: float) -> str:
    """Return which limit no plan was found to keep, and what helps."""
    if limit.of_regime:
        said = (
            f"no plan was found that keeps the {limit.phrase}: the best misses it by {amount:.3g} "
            f"{limit.unit}. {limit.eased(request.limits, amount)[1]}, or shorten the trial."
        )
    else:
        current = float(np.hypot(*request.d[:2]))
        said = limit.advice(amount, Circumstances(current, lambda: smallest_circle(request)))
    return f"{said} A narrower --envelope or a longer search (--effort) may help too."


def tightened_search(
    request: PreparedRequest, campaign: Callable[[PreparedRequest], list[EnvelopeSearch]]
) -> tuple[list[EnvelopeSearch], ConstraintSatisfaction | None]:
    """Search all trials, with limits tightened until they are kept with the wanted probability.

    Parameters
    ----------
    request : PreparedRequest
    campaign : callable
        Searches the trials of a request.

    Returns
    -------
    tuple
        What was found, and how the limits are kept.
    """
    searches = campaign(request)
    if not request.uncertain:
        return searches, None
    _, searches, keeping = tighten(
        request, searches, lambda tighter, _: campaign(tighter),
        lambda found: [s.candidate.unit for s in found], _TIGHTENINGS,
    )  # fmt: skip
    return searches, keeping


def _campaign(
    request: PreparedRequest, envelope: Envelope, before: Array | float, workers: int | None
) -> list[EnvelopeSearch]:
    found: list[EnvelopeSearch] = []
    known = before
    for trial in range(request.trials):
        problem = build_problem(request, trial)
        # no command leads into a room from a start outside it, and a search would take minutes
        require_start(problem, request, trial, SeaRoom.name)
        search = search_envelope(
            problem, envelope, request.seed + 1000 * trial, request.effort, known, workers
        )
        found.append(search)
        commands = problem.commands(search.candidate.unit)
        motion = problem.scenarios[0].rollout.run(commands[None])
        known = known + envelope.information(motion)[0]
    return found


def _stretches(inside: NDArray[np.bool_], sample_time: float) -> tuple[tuple[float, float], ...]:
    """Return beginning and end [s] of each run of true samples."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], inside.astype(int), [0]])))
    return tuple(
        (float(a * sample_time), float(b * sample_time))
        for a, b in zip(edges[::2], edges[1::2], strict=True)
    )
