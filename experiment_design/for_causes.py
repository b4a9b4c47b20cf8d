"""The design of a trial that separates the causes that the last diagnosis left open."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiment_design.criteria.cause_power import (
    WANTED,
    CausePower,
    OpenCause,
    PowerReport,
)
from experiment_design.feasibility.checks import require_horizon
from experiment_design.for_prediction import (
    RANDOM_SETTINGS,
    described_plan,
    operating_envelope,
    random_motions,
    ranges_of_ship,
    started_in,
    tightened_search,
)
from experiment_design.optimise.envelope_search import (
    EnvelopeSearch,
    exchange_settings,
    usual_manoeuvres,
)
from experiment_design.output.result import Design
from experiment_design.request.exclusions import require_compatible
from experiment_design.request.request import PreparedRequest, build_problem
from greybox.diagnosis.causes import Context, known_causes
from greybox.diagnosis.hypothesis import Hypothesis, Parameter
from greybox.diagnosis.result import finite
from greybox.diagnosis.ship import CURRENTS
from greybox.diagnosis.thresholds import SIGNIFICANT
from greybox.errors import UsageError, suggestion
from greybox.files import read_json
from greybox.model.model import ManoeuvringModel
from greybox.numerics.threads import one_thread
from greybox.vessel.actuation import with_actuators_of
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]

# sequences that each round of a chain tries: a free run for each parameter of each cause
_TRIES = 12


@dataclass(frozen=True)
class AskedCauses:
    """Causes that a trial is to tell apart, as they were asked for.

    Parameters
    ----------
    estimates : mapping of str to mapping
        Key or id of each cause -> its parameters as the JSON of a diagnosis has them; empty
        where no diagnosis estimated them.
    tried : int
        Hypotheses that the last diagnosis tried; 0 where there is none.
    named : bool
        Whether a user named them: one that cannot be at work is an error then, and else left out.
    """

    estimates: Mapping[str, Mapping[str, Any]]
    tried: int = 0
    named: bool = False


def read_diagnosis(path: str) -> Any:
    """Read the JSON of `greybox diagnose`.

    Raises
    ------
    LogError
        It cannot be read, or is too large.
    """
    return read_json(path, "the diagnosis", "Give the JSON of greybox diagnose --json.")


def causes_left_open(diagnosis: Any, name: str = "diagnosis") -> AskedCauses:
    """Return what a diagnosis left open: members of its groups, and causes that do not stand.

    Parameters
    ----------
    diagnosis : object
        The JSON of `greybox diagnose`.
    name : str
        Of its file.

    Raises
    ------
    UsageError
        It is no diagnosis, or leaves no cause open.
    """
    own = diagnosis if isinstance(diagnosis, Mapping) else {}
    verdict, tried = own.get("verdict"), own.get("tried", 0)
    lists = own.get("candidates"), own.get("partial", [])
    found = [c for known in lists if isinstance(known, list) for c in known]
    told = [
        isinstance(c, Mapping)
        and isinstance(c.get("id"), str)
        and isinstance(c.get("parameters"), Mapping)
        for c in found
    ]
    whole = all(isinstance(known, list) for known in lists) and isinstance(tried, int)
    if not (isinstance(verdict, str) and whole and all(told)):
        raise UsageError(f"'{name}' is no diagnosis: give the JSON of greybox diagnose --json.")
    if not found:
        raise UsageError(
            f"the diagnosis '{name}' leaves no cause open (its verdict is {verdict}): name those "
            f"to be told apart, such as --causes current heading_bias."
        )
    return AskedCauses({str(c.get("place") or c["id"]): c["parameters"] for c in found}, tried)


# causes that a model holds in when its thrusters act, and in how they push
_WHEN = ("thruster_lag", "input_delay", "rate_limit", "feedback_sampling")
_HOW = ("thruster_gain", "quadratic_thrust", "angle_offset")


def without_open_causes(
    model: ManoeuvringModel, asked: AskedCauses, vessel: Vessel
) -> tuple[ManoeuvringModel, tuple[str, ...]]:
    """Return a model without what it holds of open causes, and notes.

    A diagnosis that ends with several causes writes the model with the first of them, whose size
    is an estimate from none: it can be tested again only beside a ship that does not have it.

    Parameters
    ----------
    model : ManoeuvringModel
    asked : AskedCauses
    vessel : Vessel
        Whose thrusters act as they did before the diagnosis.
    """
    known = model.record.get("causes")
    keys = [k for k in known if isinstance(k, str)] if isinstance(known, list | tuple) else []
    ids = {k: k.partition(":")[0] for k in keys}
    held = [k for k in keys if k in asked.estimates or ids[k] in asked.estimates]
    before = with_actuators_of(model.vessel, vessel)
    out = []
    for key in held:
        changed = model
        if ids[key] in _WHEN:
            acting = replace(model.vessel, actuation=before.actuation)
            changed = replace(model, vessel=acting)
        elif ids[key] in _HOW:
            acting = replace(model.vessel, thrusters=before.thrusters)
            changed = replace(model, vessel=acting)
        elif ids[key] == "current" and model.disturbances:
            kept = {n: v for n, v in model.disturbances.items() if n not in CURRENTS}
            changed = replace(model, disturbances=kept, disturbance_covariance=np.zeros((0, 0)))
        if changed is not model:
            model = changed
            out.append(key)
    if not out:
        return model, ()
    said = f"the model holds {', '.join(out)}, which is open: the trial is planned without it"
    return model, (said,)


def open_causes(
    request: PreparedRequest, model: ManoeuvringModel, asked: AskedCauses
) -> tuple[tuple[OpenCause, ...], int, tuple[str, ...]]:
    """Return the causes beside a model, how many hypotheses a diagnosis tries, and notes.

    Terms of a cause that the model has already count as the cause's, not as the model's.

    Parameters
    ----------
    request : PreparedRequest
    model : ManoeuvringModel
    asked : AskedCauses

    Raises
    ------
    UsageError
        A name is none of this ship's causes or stands for several places, or none is left; or
        the model is of a ship with other commands.
    """
    terms = {n for k, e in asked.estimates.items() for n in (*e, *k.partition(":")[2].split("+"))}
    own = [n for n in request.structure.parameters if n in terms]
    structure = request.structure.without(*own) if own else request.structure
    used = ranges_of_ship(request, model, {})
    steps = zip(request.schedule.commands, request.schedule.ramp, strict=True)
    context = Context(
        structure=structure,
        vessel=request.vessel,
        outputs=(*structure.states, "psi") if "r" in structure.states else structure.states,
        has_wind=bool(request.d[2:].any()),
        duration=request.duration,
        sample_time=request.sample_time,
        speeds={t.speed: float(np.abs(used[t.speed]).mean()) for t in request.vessel.thrusters},
        current_known=bool(request.d[:2].any()),
        ranges={n: high - low for n, (low, high) in used.items()},
        fastest={n: (used[n][1] - used[n][0]) / (k * request.sample_time) for n, k in steps},
    )
    known = [h for cause in known_causes().values() for h in cause.hypotheses(context)]
    found, notes = [], []
    for name, estimate in asked.estimates.items():
        try:
            hypothesis = _named(name, known)
        except UsageError as error:
            if asked.named:
                raise
            # a diagnosis named it: no list of other causes helps
            notes.append(f"{name} is left out: {str(error).partition('. ')[0].rstrip('.')}.")
            continue
        found.append(_sized(hypothesis, estimate))
    if not found:
        raise UsageError(f"no open cause can be designed for: {' '.join(notes)}")
    return tuple(found), asked.tried or len(known), tuple(notes)


def _named(name: str, known: Sequence[Hypothesis]) -> Hypothesis:
    """Return the hypothesis of a key or an id."""
    exact = [h for h in known if h.key == name]
    like = exact or [h for h in known if h.id == name]
    if len(like) == 1:
        return like[0]
    if like:
        raise UsageError(
            f"'{name}' may be at work in {len(like)} places: name one of "
            f"{', '.join(h.key for h in like)}."
        )
    ids = list(dict.fromkeys(h.id for h in known))
    raise UsageError(
        f"'{name}' is no cause that a trial of this ship with this model could show."
        f"{suggestion(name, ids)} There are {', '.join(ids)}."
    )


def _sized(hypothesis: Hypothesis, estimate: Mapping[str, Any]) -> OpenCause:
    """Return a cause with the sizes that a diagnosis estimated, zero where it did not."""
    tested = [p for p in hypothesis.parameters if not p.reach]
    away = np.array([_away(p, estimate.get(p.name)) for p in tested])
    estimated = not tested or bool(away.any())
    return OpenCause(hypothesis, away, estimated)


def _away(parameter: Parameter, estimate: Any) -> float:
    """Return how far an estimate, as it is told, lies from the null value."""
    value = estimate.get("value") if isinstance(estimate, Mapping) else None
    if not isinstance(value, int | float) or not np.isfinite(value):
        return 0.0
    if parameter.over:
        value = parameter.over / value if value else parameter.null
    return float(np.clip(value, parameter.low, parameter.high)) - parameter.null


@dataclass(frozen=True)
class CauseDesign:
    """A plan with how surely the diagnosis of its trial will find and tell the open causes.

    Parameters
    ----------
    design : Design
    causes : tuple of OpenCause
    plan, random, usual : PowerReport or None
        Of the plan, of the best of 200 random sequences of steps, and of usual manoeuvres (an
        approach, a two-sided zig-zag, a turn), all of one length; None where the ship leaves
        every bound.
    level : float
        Significance that the diagnosis will ask for, corrected for what it tries.
    """

    design: Design
    causes: tuple[OpenCause, ...]
    plan: PowerReport
    random: PowerReport | None
    usual: PowerReport | None
    level: float

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON: those of the design, and the power of causes and pairs."""
        named = (("", self.plan), ("_random", self.random), ("_usual", self.usual))

        def each(name: str, numbers: str, place: int | tuple[int, int]) -> dict[str, float | None]:
            return {
                f"{name}{of}": None if r is None else finite(getattr(r, numbers)[place])
                for of, r in named
            }

        return self.design.to_dict() | {
            "for": "causes",
            "efficiency_of": f"noncentrality of the cause that is hardest to tell: that of this "
            f"plan, over that of {RANDOM_SETTINGS}",
            "level": self.level,
            "causes": [
                {
                    "id": c.id,
                    "place": c.hypothesis.key,
                    "parameters": {
                        c.hypothesis.parameters[i].name: {
                            "away_from_null": float(s),
                            "unit": _searched_unit(c.hypothesis.parameters[i]),
                            "estimated": c.estimated,
                        }
                        for i, s in zip(c.tested, c.size, strict=True)
                    },
                    **each("power", "power", i),
                    **each("detectable_share", "detectable_share", i),
                }
                for i, c in enumerate(self.causes)
            ],
            "pairs": [
                {
                    "ids": [self.causes[i].id, self.causes[j].id],
                    **each("power", "pairs", (i, j)),
                }
                for i in range(len(self.causes))
                for j in range(i)
            ],
        }

    def headline(self) -> str:
        """Return in one sentence what the plan is for and how surely it will do it."""
        k = int(self.plan.detectable_share.argmax())
        said = (
            f"A diagnosis of this trial would find {self.causes[k].id}, the hardest of the open "
            f"causes, beside the others with probability {self.plan.power[k]:.2f}, and with "
            f"probability {WANTED:g} if it were {self.plan.detectable_share[k]:.2g} times as large "
            f"as expected"
        )
        for r, what in ((self.random, "the best random steps"), (self.usual, "a usual zig-zag")):
            if r is not None:
                said += (
                    f"; after {what}: {r.power.min():.2f}, and {r.detectable_share.max():.2g} times"
                )
        return f"{said}."

    def summary(self) -> str:
        """Return the plan as text."""
        r = self.design.request
        m = len(self.causes)
        lines = [
            f"Plan for {r.vessel.name}: {r.duration:g} s to tell the causes apart that are open",
            self.headline(),
            f"{'power':<44}{'plan':>8}{'random':>8}{'usual':>8}",
        ]
        every = (self.plan, self.random, self.usual)
        for i, c in enumerate(self.causes):
            cells = ["-" if p is None else f"{p.power[i]:.2f}" for p in every]
            lines.append(f"  {c.hypothesis.key:<42}" + "".join(f"{x:>8}" for x in cells))
        for i in range(m if m > 2 else 0):
            for j in range(i):
                cells = ["-" if p is None else f"{p.pairs[i, j]:.2f}" for p in every]
                name = f"{self.causes[j].id} or {self.causes[i].id}"
                lines.append(f"  {name:<42}" + "".join(f"{x:>8}" for x in cells))
        lines += [f"expected: {_sizes(c)}" for c in self.causes if c.tested]
        if (gain := self.design.efficiency_vs_random) is not None:
            lines.append(
                f"{gain:.2f} times the information on the cause that is hardest to tell that "
                f"{RANDOM_SETTINGS} gives"
            )
        if self.plan.power.min() < WANTED:
            lines.append(
                f"Note: below {WANTED:g} the trial may leave the question open: lengthen it, widen "
                f"the limits, or measure what tells the causes apart by itself"
            )
        if self.design.keeping is not None:
            lines.append(self.design.keeping.sentence())
        return "\n".join([*lines, *[f"Note: {n}" for n in self.design.notes]])


def _searched_unit(parameter: Parameter) -> str:
    """Return the unit of the number that is searched: of a rate, the time of the whole way."""
    return "s" if parameter.over else parameter.unit


def _sizes(cause: OpenCause) -> str:
    told = []
    for i, s in zip(cause.tested, cause.size, strict=True):
        p = cause.hypothesis.parameters[i]
        value, _ = p.told(p.null + s, 0.0)
        told.append(f"{p.name} {value:.3g} {p.unit}")
    return f"{', '.join(told)} ({'as estimated' if cause.estimated else 'a typical size'})"


@one_thread()
def design_for_causes(
    request: PreparedRequest,
    model: ManoeuvringModel,
    asked: AskedCauses,
    *,
    envelope: Mapping[str, tuple[float, float]] | None = None,
    kept_start: bool = False,
    best_effort: bool = False,
    workers: int | None = None,
) -> CauseDesign:
    """Design the trial that makes the least power over open causes largest.

    The power is that of the chi-square test of each cause's parameters, at the significance of
    the diagnosis, with the coefficients, the start and all other open causes projected out.

    Parameters
    ----------
    request : PreparedRequest
        Of both sides and one trial, as `prepare_request` gives it.
    model : ManoeuvringModel
        The prior, with what its own trial showed.
    asked : AskedCauses
    envelope : mapping of str to (float, float), optional
        Range of commands that the trial may use; see `command_ranges`.
    kept_start : bool
        Whether the trial starts as the request says; else on a straight course in the envelope.
    best_effort : bool
        Return the closest plan when limits cannot be kept.
    workers : int, optional
        Processes; by default one a processor. The result does not depend on it.

    Raises
    ------
    UsageError
        What is asked does not go with causes, or a cause is unknown.
    InfeasibleError
        The prior holds the ship under too few commands, or the limits cannot be kept.

    References
    ----------
    Atkinson, Donev and Tobias (2007), section 20.3; Ljung (1999), section 16.4.
    """
    require_compatible(request.given | {"for causes"})
    began = time.perf_counter()
    require_horizon(request)
    causes, tried, notes = open_causes(request, model, asked)
    found, _ = operating_envelope(request, model, envelope or {})
    request = started_in(replace(request, misfit=found.misled), found, int(kept_start))
    problem = build_problem(request)
    rollout, schedule = problem.scenarios[0].rollout, problem.schedule
    usual = rollout.run(
        schedule.expand(
            schedule.within_reach(usual_manoeuvres(found, schedule.holds, request.hold))
        )[None]
    )
    first = (
        usual if usual.stable[0] else rollout.run(found.draw(schedule.samples, _rng(request))[None])
    )
    power = CausePower(rollout, causes, request.noise, SIGNIFICANT, tried).with_typical_sizes(first)

    def campaign(r: PreparedRequest) -> list[EnvelopeSearch]:
        return [
            exchange_settings(
                build_problem(r),
                found,
                power.values,
                r.seed,
                effort=r.effort,
                tries=_TRIES,
                workers=workers,
            )
        ]

    searches, keeping = tightened_search(request, campaign)
    design = described_plan(
        request, searches, keeping, kept_starts=int(kept_start), began=began,
        best_effort=best_effort,
        certificate="no bound is known on the power that any other trial could reach",
    )  # fmt: skip

    def reported(motion: Any) -> PowerReport | None:
        return power.report(motion) if motion.stable[0] else None

    best = searches[0].reference
    random = rollout.run(schedule.expand(problem.levels(best.unit))[None])
    gain = float(np.exp(searches[0].candidate.value - best.value))
    design = replace(
        design,
        notes=(*notes, *design.notes),
        efficiency_vs_random=gain if random_motions(request, searches) else None,
    )
    plan = power.report(rollout.run(design.commands[0][None]))
    return CauseDesign(design, power.causes, plan, reported(random), reported(usual), power.level)


def _rng(request: PreparedRequest) -> np.random.Generator:
    return np.random.default_rng([47, request.seed])
