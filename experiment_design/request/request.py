"""The request for a design as plain data, and the problem that follows from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import NDArray

from experiment_design.constraints.limit_program import LimitProgram
from experiment_design.constraints.limits import (
    LIMITS,
    LimitedTrial,
    PathLimit,
    TrialLimits,
    limits_of,
)
from experiment_design.criteria.covariance import Criterion
from experiment_design.criteria.optimality import CRITERIA
from experiment_design.criteria.t_optimality import Contrast
from experiment_design.excitation.rollout import Misfit, Rollout
from experiment_design.excitation.schedule import Schedule, make_schedule
from experiment_design.information.estimators import ESTIMATORS
from experiment_design.information.moments import Moments
from experiment_design.request.exclusions import require_compatible
from experiment_design.request.problem import Scenario, TrialProblem
from greybox.errors import InfeasibleError, UsageError, suggestion
from greybox.model.model import ManoeuvringModel
from greybox.model.noise import NoiseLevels
from greybox.model.predictor import Column, Predictor, Regime, build_predictor
from greybox.model.predictor_kinds import PREDICTORS
from greybox.model.run.simulation import stationary_disturbance
from greybox.model.run.step import Integrator
from greybox.model.structure import Structure
from greybox.numerics.linalg import scaled_root
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]
Signs = tuple[tuple[str, int], ...]
# memory of the wind's variation [s]
_GUST_SECONDS = 20.0
# options of the command that have another name than their field
_OPTIONS = {"wanted": "want", "combination": "of"}


@dataclass(frozen=True)
class CandidateModel:
    """One explanation of the ship's motion: its structure, parameters and disturbances.

    Parameters
    ----------
    name : str
    structure : Structure
    theta : ndarray
        (p,) discrete parameters at the request's sample time.
    d : ndarray
        (nd,) disturbance means [m/s].
    vessel : Vessel, optional
        How its thrusters act, where that is another than the request's.
    integrator : {"euler", "rk4"}
    """

    name: str
    structure: Structure
    theta: Array
    d: Array
    vessel: Vessel | None = None
    integrator: Integrator = "euler"


@dataclass(frozen=True)
class TrialOptions:
    """Options that only the user decides, the same in a request and in its prepared form.

    Parameters
    ----------
    duration : float
        Of each trial [s].
    limits : TrialLimits
        Those that all trials share: margins, sea room, caps, end state, energy, headings.
    estimator : {"iv", "iv-white", "oe"}
        Whose covariance is predicted: zero-mean IV with its moving-average or white
        equation error, or the Cramér-Rao information of an output-error fit.
    criterion : {"D", "A", "E", "c"}
    wanted : tuple of str
        Parameters that count; empty for all of the undisturbed model.
    combination : mapping of str to float
        Gradient of the function of the parameters that criterion ``c`` looks at.
    robust : int
        Further prior models, drawn from its covariance, that the criterion is expected over.
    worst_case : bool
        Look at the worst of these models instead of the expectation.
    probability : float
        With which the path limits are to be kept under the prior's uncertainty.
    seed : int
    effort : float
        Evaluations of the search, 1 being the usual number.
    """

    duration: float
    limits: TrialLimits = field(default_factory=TrialLimits)
    estimator: str = "iv"
    criterion: str = "D"
    wanted: tuple[str, ...] = ()
    combination: Mapping[str, float] = field(default_factory=dict)
    robust: int = 0
    worst_case: bool = False
    probability: float = 0.9
    seed: int = 0
    effort: float = 1.0

    @property
    def given(self) -> frozenset[str]:
        """Options that differ from their defaults, by the names of `exclusions.RULES`."""
        usual = TrialOptions(self.duration)
        told = {
            _OPTIONS.get(f.name, f.name)
            for f in fields(TrialOptions)
            if f.name != "limits" and getattr(self, f.name) != getattr(usual, f.name)
        }
        limits = {kind.field: getattr(self.limits, kind.field) for kind in LIMITS.values()}
        told |= {n for n, x in limits.items() if x is not None and not isinstance(x, Mapping)}
        if self.limits.clearance:
            told.add("clearance")
        if CRITERIA[self.criterion].combined:
            told.add("criterion c")
        return frozenset(told if any(self.combination.values()) else told - {"of"})


@dataclass(frozen=True)
class DesignRequest(TrialOptions):
    """The options of a design; None leaves a choice to the program.

    Parameters
    ----------
    duration, limits, estimator, criterion, wanted, combination, robust, worst_case, \
    probability, seed, effort
        See `TrialOptions`. A margin that `limits` does not name is chosen.
    hold : float, optional
        Between changes of command [s].
    regime : str
        ``auto``, one regime such as ``u+v-``, or one per trial separated by commas.
    start : sequence of float, optional
        Initial states and heading.
    trials : int
    predictor : str, optional
        ``basic``, ``augmented``, ``wind`` or ``basic+wind``.
    current, wind : (float, float), optional
        Expected means, north and east [m/s].
    gust : float, optional
        Standard deviation of the wind about its mean [m/s]; by default 15 % of it.
    process_noise : ndarray, optional
        (nx,) per sample.
    prior : ManoeuvringModel, optional
        Whose information is added.
    """

    hold: float | None = None
    regime: str = "auto"
    start: Sequence[float] | None = None
    trials: int = 1
    predictor: str | None = None
    current: tuple[float, float] | None = None
    wind: tuple[float, float] | None = None
    gust: float | None = None
    process_noise: Array | None = None
    prior: ManoeuvringModel | None = None

    @property
    def given(self) -> frozenset[str]:
        """Options that differ from their defaults, by the names of `exclusions.RULES`."""
        told = {n for n in ("gust", "prior") if getattr(self, n) is not None}
        told |= {f"margin_{n}" for n in self.limits.margins}
        return super().given | told


@dataclass(frozen=True)
class LeadIn:
    """Commands before a trial, that bring the ship into its regime.

    Parameters
    ----------
    levels : ndarray
        (K, nc), one row a hold.
    seconds : float
        Its length [s].
    start : ndarray
        (nx + 1,) states [m/s, rad/s] and heading [rad] at its start.
    position : (float, float)
        North and east there [m].
    end : ndarray
        (nx + 1,) the same at its end.
    place : (float, float)
        North and east there [m].
    """

    levels: Array
    seconds: float
    start: Array
    position: tuple[float, float]
    end: Array
    place: tuple[float, float]

    def after(self, request: PreparedRequest) -> PreparedRequest:
        """Return the request of the trial that begins where the lead-in ends."""
        return replace(
            request,
            starts=(self.end,),
            start_commands=(),
            limits=replace(request.limits, position=self.place),
            lead_in=self,
        )


@dataclass(frozen=True)
class OutOfReach:
    """Margins that were asked for and cannot be kept, and those that stand in for them.

    Parameters
    ----------
    asked : TrialLimits
    instead : TrialLimits or None
        With the margins nearest to them that leave a trial room; None where none were found.
    sentence : str
        Which limit stops the trial, and what helps.
    """

    asked: TrialLimits
    instead: TrialLimits | None
    sentence: str


class OutOfReachError(InfeasibleError):
    """No motion keeps the margins; `told` says what comes closest."""

    def __init__(self, told: OutOfReach) -> None:
        super().__init__(told.sentence)
        self.told = told


@dataclass(frozen=True, kw_only=True)
class PreparedRequest(TrialOptions):
    """Everything that a design depends on; equal requests give equal designs.

    Parameters
    ----------
    duration, limits, estimator, criterion, wanted, combination, robust, worst_case, \
    probability, seed, effort
        See `TrialOptions`; the signs of `limits` are replaced by each trial's.
    vessel : Vessel
    structure : Structure
    theta : ndarray
        (p,) prior parameters at `sample_time`.
    sample_time : float
        [s]
    noise : NoiseLevels
    hold : float
        Between changes of command [s].
    regimes : tuple of Signs
        Signs that the states keep, one entry a trial, such as ``(("u", 1), ("v", 1))``.
    starts : tuple of ndarray
        (nx + 1,) initial states and heading a trial [m/s, rad/s, rad].
    start_commands : tuple of ndarray or None
        (nc,) constant commands a trial under which its start is a steady motion, None where none
        are known; empty where none are of any.
    predictor : str
        ``basic``, ``augmented``, ``wind`` or ``basic+wind``.
    targets : tuple of float
        Wanted standard errors of `wanted`, the scale of A and E in place of prior values.
    d : ndarray
        (nd,) expected current and wind [m/s].
    gust : float
        Standard deviation of each component of the wind about its mean [m/s].
    known : (tuple of str, ndarray), optional
        Names and information matrix of earlier trials.
    covariance : ndarray, optional
        (p, p) uncertainty of `theta`; None or zero: known exactly.
    misfit : callable, optional
        Moves a run by draws of the forces that the prior does not say; None: it says all.
    backoff : tuple of float
        By how much each path limit is tightened, in its unit, to be kept with `probability`.
    contrasts : tuple of (CandidateModel, CandidateModel)
        Pairs of explanations that the trial is to tell apart in place of
        measuring parameters; the first of the first pair is the prior model.
    integrator : {"euler", "rk4"}
        Of the prior model.
    untried : bool
        Whether the prior model comes from main dimensions, no trial behind it.
    lead_in : LeadIn, optional
        After which the only trial begins: `starts`, `limits` and `duration` are the trial's own.
    out_of_reach : OutOfReach, optional
        What was asked for, where `limits` have other margins for the closest plan.
    notes : tuple of str
        A sentence for each choice that was made for the user.
    of_regime : tuple of str
        Those of `notes` on what one regime needs: its steady start, and its margin of sway. A
        plan of both sides has a start of its own, and crosses zero.
    """

    vessel: Vessel
    structure: Structure
    theta: Array
    sample_time: float
    noise: NoiseLevels
    hold: float
    regimes: tuple[Signs, ...]
    starts: tuple[Array, ...]
    predictor: str = "augmented"
    start_commands: tuple[Array | None, ...] = ()
    targets: tuple[float, ...] = ()
    d: Array = field(default_factory=lambda: np.zeros(4))
    gust: float = 0.0
    known: tuple[tuple[str, ...], Array] | None = None
    covariance: Array | None = None
    misfit: Misfit | None = None
    backoff: tuple[float, ...] = ()
    contrasts: tuple[tuple[CandidateModel, CandidateModel], ...] = ()
    integrator: Integrator = "euler"
    untried: bool = False
    lead_in: LeadIn | None = None
    out_of_reach: OutOfReach | None = None
    notes: tuple[str, ...] = ()
    of_regime: tuple[str, ...] = ()

    @property
    def given(self) -> frozenset[str]:
        """Options that differ from their defaults, by the names of `exclusions.RULES`."""
        return super().given | ({"trials"} if self.trials != 1 else set())

    @property
    def of_both_sides(self) -> tuple[str, ...]:
        """Notes that also hold for a plan of both sides."""
        return tuple(n for n in self.notes if n not in self.of_regime)

    def eased(self, told: OutOfReach) -> PreparedRequest:
        """Return the request of the closest plan to margins that cannot be kept.

        Raises
        ------
        OutOfReachError
            No margins were found that leave a trial room.
        """
        if told.instead is None:
            raise OutOfReachError(told)
        return replace(self, limits=told.instead, out_of_reach=told)

    def as_asked(self) -> PreparedRequest:
        """Return the request with the margins that were asked for."""
        if self.out_of_reach is None:
            return self
        limits = replace(self.out_of_reach.asked, position=self.limits.position)
        return replace(self, limits=limits, backoff=(), out_of_reach=None)

    @property
    def stand_ins(self) -> str:
        """Margins that stand in for those out of reach, as options; empty where none do."""
        if self.out_of_reach is None:
            return ""
        asked, own = self.out_of_reach.asked, self.limits
        told = [f"--margin-{n} {m:g}" for n, m in own.margins.items() if m != asked.margins.get(n)]
        if own.margin_air != asked.margin_air:
            told.append(f"--margin-air {own.margin_air:g}")
        return " ".join(told)

    @property
    def trials(self) -> int:
        """Number of trials of the campaign."""
        return len(self.regimes)

    @property
    def schedule(self) -> Schedule:
        """When and how far commands change."""
        found = make_schedule(self.vessel, self.duration, self.hold, self.sample_time)
        return found if self.lead_in is None else replace(found, before=self.lead_in.levels[-1])

    def from_first_command(self) -> PreparedRequest:
        """Return the request of lead-in and trial as one, which is the request without any."""
        lead = self.lead_in
        if lead is None:
            return self
        return replace(
            self,
            duration=lead.seconds + self.duration,
            starts=(lead.start,),
            limits=replace(self.limits, position=lead.position),
            lead_in=None,
        )

    def commands_at_start(self, trial: int) -> dict[str, float] | None:
        """Return the constant commands that hold the ship at a trial's start, None if unknown."""
        held = self.start_commands[trial] if self.start_commands else None
        if held is None:
            return None
        return dict(zip(self.schedule.commands, held.tolist(), strict=True))

    @property
    def lead_in_samples(self) -> int:
        """Samples of the lead-in, 0 without one."""
        return 0 if self.lead_in is None else round(self.lead_in.seconds / self.sample_time)

    def with_lead_in(self, levels: Array) -> Array:
        """Return the levels (K, nc) of the lead-in followed by those of the trial."""
        return levels if self.lead_in is None else np.concatenate([self.lead_in.levels, levels])

    def build_predictor(self) -> Predictor:
        """Return the predictor over the signs that the trials together take.

        A force without a name moves the ship, and none of its coefficients is a column.
        """
        signs: dict[str, tuple[int, ...]] = {}
        for state in self.structure.states:
            taken = {dict(r).get(state, 0) for r in self.regimes}
            signs[state] = (1, -1) if 0 in taken or len(taken) > 1 else (taken.pop(),)
        regime: Regime = tuple(signs.items())
        found = build_predictor(self.structure.estimable(), self.predictor, regime)
        return replace(found, structure=self.structure)

    def trial_limits(self, trial: int) -> TrialLimits:
        """Return the limits of one trial."""
        return replace(self.limits, signs=dict(self.regimes[trial]))

    @property
    def tells_each(self) -> bool:
        """Whether each wanted parameter is to be told, by no standard error of its own."""
        return not (self.targets or self.contrasts or CRITERIA[self.criterion].combined)

    @property
    def wind_matters(self) -> bool:
        """Whether the wind is captured and not measured, so that margins hold through the air."""
        kind = PREDICTORS[self.predictor]
        return kind.captures and not kind.air_measured

    def rollout(self, start: Array, theta: Array | None = None) -> Rollout:
        """Return the motion from a start, by the prior model or by one with other coefficients."""
        return Rollout(
            self.vessel, self.structure, self.theta if theta is None else theta, self.d, start,
            self.sample_time, self.integrator,
        )  # fmt: skip

    def limit_program(self, rollout: Rollout, trial: int) -> LimitProgram:
        """Return the compiled limits of one trial under its own or another prior model."""
        return LimitProgram(
            rollout,
            self.schedule,
            self.trial_limits(trial),
            wind_matters=self.wind_matters,
            backoff=self.backoff,
        )

    def path_limits(self, trial: int) -> tuple[PathLimit, ...]:
        """Return the limits at each sample of a trial."""
        about = LimitedTrial(self.structure.states, self.d, self.wind_matters)
        every = limits_of(self.trial_limits(trial), about)
        return tuple(x for x in every if isinstance(x, PathLimit))

    def draw_models(self, count: int, seed: int) -> Array:
        """Draw prior models (count, p) from the covariance."""
        rng = np.random.default_rng([13, self.seed, seed])
        theta = np.asarray(self.theta, float)
        if self.covariance is None:
            return np.repeat(theta[None], count, axis=0)
        half = rng.standard_normal((-(-count // 2), theta.size))
        # pairs around the nominal model, so that few draws have its mean
        both = np.stack([half, -half], axis=1).reshape(-1, theta.size)[:count]
        return np.asarray(theta + both @ scaled_root(self.covariance).T)

    @property
    def uncertain(self) -> bool:
        """Whether the motion under the prior model is: it has a covariance, or a misfit."""
        if self.misfit is not None:
            return True
        return self.covariance is not None and bool(np.diag(self.covariance).max(initial=0.0) > 0)

    def thetas(self) -> Array:
        """Return the prior models (S+1, p), the nominal one first."""
        nominal = np.asarray(self.theta, float)[None]
        if not self.robust or not self.uncertain:
            return nominal
        return np.vstack([nominal, self.draw_models(self.robust, 0)])


def full_structure(model: ManoeuvringModel) -> tuple[Structure, Array]:
    """Return a model's structure with the terms that its sums absorbed, and its parameters.

    An estimate without wind measurement keeps Xuu for Xuu + Wuu; the disturbed
    trial needs both terms. The absorbed ones are put back with the value zero.
    """
    absorbed = [n for names in model.sums.values() for n in names if n not in model.names]
    if not absorbed:
        return model.structure, np.asarray(model.theta, float)
    structure = model.structure.with_terms(*absorbed)
    return structure, np.concatenate([model.theta, np.zeros(len(absorbed))])


def wanted_columns(predictor: Predictor, names: tuple[str, ...]) -> tuple[int, ...]:
    """Return the positions of the wanted parameters, all of them where none is named.

    Raises
    ------
    UsageError
        A name is no parameter of the predictor; the nearest is suggested.
    """
    known = {c.name: i for i, c in enumerate(predictor.columns) if not c.is_bias}
    for i, column in enumerate(predictor.columns):
        known |= {t: i for t in column.terms if t not in known}
        if column.terms:
            known.setdefault(column.label, i)
    if not names:
        return tuple(i for i in predictor.parameter_columns if i not in predictor.constants)
    for name in names:
        if name not in known:
            raise UsageError(
                f"'{name}' is no parameter of this model.{suggestion(name, known)} "
                f"It has: {', '.join(predictor.parameter_names)}."
            )
    return tuple(dict.fromkeys(known[n] for n in names))


def build_criterion(request: PreparedRequest, predictor: Predictor) -> Criterion:
    """Return the criterion over the predictor's columns.

    Raises
    ------
    UsageError
        A name is unknown, or options exclude one another.
    """
    require_compatible(request.given)
    chosen = wanted_columns(predictor, request.wanted or tuple(request.combination))
    names = [predictor.columns[i].name for i in chosen]
    scale = np.array(request.targets, float)
    if not request.targets:
        scale = _prior_magnitudes(request, predictor)[list(chosen)]
    combination = np.zeros(len(names))
    for name, slope in request.combination.items():
        combination[chosen.index(wanted_columns(predictor, (name,))[0])] += slope
    prior = None
    if request.known is not None:
        prior = _prior_information(names, *request.known)
    wanted = chosen
    if ESTIMATORS[request.estimator].free_run:
        # sensitivities stand in the order of the parameters, bias-capturing columns left out
        wanted = tuple(predictor.parameter_columns.index(i) for i in chosen)
    return Criterion(request.criterion, wanted, scale, combination, prior)


def _prior_magnitudes(request: PreparedRequest, predictor: Predictor) -> Array:
    """Return the magnitude of each column's prior value, (columns,)."""
    theta, index = request.theta, request.structure.index
    own = np.array([abs(sum(float(theta[index(t)]) for t in c.terms)) for c in predictor.columns])
    out = own.copy()
    # a parameter that is zero a priori is measured by what the others of its equation are
    for i in np.flatnonzero(own == 0):
        others = own[predictor.equation(predictor.columns[i].state)]
        out[i] = others[others > 0].min(initial=1.0)
    return out


def wanted_parameters(request: PreparedRequest, criterion: Criterion) -> tuple[Column, ...]:
    """Return the predictor's columns of the wanted parameters, in the order of the criterion."""
    predictor = request.build_predictor()
    places = predictor.parameter_columns
    if ESTIMATORS[request.estimator].free_run:
        return tuple(predictor.columns[places[i]] for i in criterion.wanted)
    return tuple(predictor.columns[i] for i in criterion.wanted)


def _prior_information(names: list[str], known: tuple[str, ...], information: Array) -> Array:
    """Return the information on `names`, the other parameters unknown."""
    shared = [n for n in names if n in known]
    if not shared:
        raise UsageError(
            f"the prior model knows none of the wanted parameters {', '.join(names)}: it has "
            f"{', '.join(known)}."
        )
    keep = [known.index(n) for n in shared]
    rest = [i for i in range(len(known)) if i not in keep]
    part = information[np.ix_(keep, keep)]
    if rest:
        cross = information[np.ix_(keep, rest)]
        part = part - cross @ np.linalg.pinv(information[np.ix_(rest, rest)]) @ cross.T
    out = np.zeros((len(names), len(names)))
    where = [names.index(n) for n in shared]
    out[np.ix_(where, where)] = (part + part.T) / 2
    return out


def build_problem(
    request: PreparedRequest, trial: int = 0, known: tuple[Moments, ...] = ()
) -> TrialProblem:
    """Return the problem of one trial of a request.

    Parameters
    ----------
    request : PreparedRequest
    trial : int
    known : tuple of Moments
        Sums of the other trials, one a scenario.

    Returns
    -------
    TrialProblem
    """
    predictor = request.build_predictor()
    assumed = ESTIMATORS[request.estimator]
    gust = draw_gusts(request) if predictor.air_measured else None
    criterion = build_criterion(request, predictor)
    schedule = request.schedule
    scenarios = []
    for k, theta in enumerate(request.thetas()):
        rollout = request.rollout(request.starts[trial], theta)
        program = request.limit_program(rollout, trial)
        information = assumed.information(
            predictor,
            theta,
            request.d,
            request.noise,
            request.sample_time,
            request.integrator,
            gust,
        )
        scenarios.append(Scenario(rollout, information, program, 1.0 if k else 2.0))
    contrast = None
    if request.contrasts:
        pairs = [
            (_candidate_rollout(request, a, trial), _candidate_rollout(request, b, trial))
            for a, b in request.contrasts
        ]
        other = pairs[0][1]
        program = LimitProgram(
            other, schedule, request.trial_limits(trial), backoff=request.backoff
        )
        scenarios.append(Scenario(other, scenarios[0].information, program, 0.0))
        contrast = Contrast(pairs, request.noise, schedule)
    return TrialProblem(schedule, tuple(scenarios), criterion, known, request.worst_case, contrast)


def _candidate_rollout(request: PreparedRequest, candidate: CandidateModel, trial: int) -> Rollout:
    # initial states and heading in the candidate's own order
    known = dict(zip((*request.structure.states, "psi"), request.starts[trial], strict=True))
    start = np.array([known[s] for s in (*candidate.structure.states, "psi")])
    vessel = request.vessel if candidate.vessel is None else candidate.vessel
    return Rollout(
        vessel, candidate.structure, candidate.theta, candidate.d, start, request.sample_time,
        candidate.integrator,
    )  # fmt: skip


def draw_gusts(request: PreparedRequest) -> Array:
    """Draw what the wind adds to its mean, (N, 2) [m/s]; the same for every sequence."""
    rng = np.random.default_rng([31, request.seed])
    drawn = stationary_disturbance(
        rng,
        np.zeros(2),
        request.gust,
        request.schedule.samples,
        correlation_time=_GUST_SECONDS,
        sample_time=request.sample_time,
    )
    return np.asarray(drawn[0], float)
