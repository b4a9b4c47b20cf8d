"""Design of trials: from a request to sequences with what they are worth."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiment_design.campaign import (
    Progress,
    add_up,
    own_moments,
    random_campaign,
    search_campaign,
)
from experiment_design.certificate import Certificate, certify
from experiment_design.classical import Alternative, compare_classical
from experiment_design.criteria import Criterion
from experiment_design.feasible import closest, in_words, least_change
from experiment_design.limits import TOLERANCE, Circle
from experiment_design.moments import MomentProgram, Moments
from experiment_design.problem import TrialProblem
from experiment_design.regimes import spell_regime, steady_motions
from experiment_design.request import DesignRequest, build_problem, wanted_parameters
from experiment_design.robust import Keeping, keep_probability
from experiment_design.rollout import Motion
from experiment_design.search import REFERENCE, Candidate, assess, limit_scale
from experiment_design.solve import EXACT_COLUMNS, Outcome, solve_ipopt
from experiment_design.timing import telling_duration
from greybox.errors import InfeasibleError

Array = NDArray[np.float64]

# rounds of tightening limits until they are kept with the wanted probability
_TIGHTENINGS = 5
# scaled units from which a limit counts as active; iterations and seconds of the polish
_NEAR, _POLISH, _PATIENCE = 0.1, 40, 3600.0
# share of the effort that a design after a tightening gets
_AGAIN = 0.4
# relative standard error from which nothing was learnt of a parameter
_VAGUE = 10.0


@dataclass(frozen=True)
class LimitReport:
    """One limit and how the plan stands to it.

    ``missed`` is 0 where it is kept, else by how much it is not, in `unit`.
    """

    trial: int
    name: str
    bound: float
    unit: str
    missed: float


@dataclass(frozen=True)
class Design:
    """Sequences for the next trials and what they are worth.

    Parameters
    ----------
    request : DesignRequest
    commands : tuple of ndarray
        (N, nc) a trial: speeds in the log's unit, angles [rad].
    levels : tuple of ndarray
        (K, nc) a trial, one row a hold.
    motions : tuple of Motion
        Predicted motion of each trial under the nominal model.
    names : tuple of str
        The wanted parameters.
    values : ndarray
        (p_w,) their prior values.
    covariance : ndarray
        (p_w, p_w) predicted covariance of their estimates.
    criterion_value : float
        On the scale of `Criterion`.
    efficiency_vs_random : float or None
        Against the best of 200 random two-level sequences that keep the limits;
        None where none of them does.
    random_value : float
        Criterion of that one, nan where there is none.
    random_kept : int
        How many were found that keep the limits.
    certificate : Certificate
    margins : dict of str to float
        Least |u_r| and |v_r| (or |r|) over all trials.
    limits : tuple of LimitReport
    keeping : Keeping or None
        Probability of keeping the limits under models drawn from the prior.
    alternatives : tuple of Alternative
        Classical sequences by the same yardstick, for the first trial of one.
    status : str
        A sentence on how the design ended.
    notes : tuple of str
    evaluations : int
    seconds : float
    """

    request: DesignRequest
    commands: tuple[Array, ...]
    levels: tuple[Array, ...]
    motions: tuple[Motion, ...]
    names: tuple[str, ...]
    values: Array
    covariance: Array
    criterion_value: float
    efficiency_vs_random: float | None
    random_value: float
    random_kept: int
    certificate: Certificate
    margins: dict[str, float]
    limits: tuple[LimitReport, ...]
    keeping: Keeping | None
    alternatives: tuple[Alternative, ...]
    status: str
    notes: tuple[str, ...]
    evaluations: int
    seconds: float

    @property
    def std(self) -> Array:
        """Predicted standard errors (p_w,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def logdet(self) -> float:
        """−log det of the predicted covariance."""
        return logdet_information(self.covariance)

    def efficiency(self, covariance: Array) -> float:
        """Return (det C_other / det C)^(1/p) of another covariance (p_w, p_w)."""
        gain = self.logdet - logdet_information(covariance)
        return float(np.exp(gain / len(self.names)))

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON, those of the contract first."""
        r = self.request
        return {
            "status": self.status,
            "criterion": r.criterion,
            "logdet": self.logdet,
            "efficiency_vs_random": self.efficiency_vs_random,
            "efficiency_lower_bound": self.certificate.efficiency_lower_bound,
            "predicted_std": dict(zip(self.names, self.std, strict=True)),
            "margins": self.margins,
            "wall_s": self.seconds,
            "parameters": dict(zip(self.names, self.values, strict=True)),
            "predictor": r.predictor,
            "estimator": r.estimator,
            "trials": r.trials,
            "duration": r.duration,
            "hold": r.hold,
            "regimes": [spell_regime(s) for s in r.regimes],
            "starts": [dict(zip((*r.structure.states, "psi"), s, strict=True)) for s in r.starts],
            "random_kept": self.random_kept,
            "certificate": self.certificate.to_dict(),
            "limits": [
                {
                    "trial": x.trial + 1,
                    "name": x.name,
                    "bound": x.bound,
                    "unit": x.unit,
                    "missed": x.missed,
                }
                for x in self.limits
            ],
            "keeps_limits": None if self.keeping is None else self.keeping.to_dict(),
            "alternatives": [
                {
                    "name": a.name,
                    "tried": a.tried,
                    "kept": a.kept,
                    "efficiency_of_design": self._gain(a),
                }
                for a in self.alternatives
            ],
            "noise": {
                "measurement": dict(zip(r.structure.states, r.noise.measurement, strict=True)),
                "process": dict(zip(r.structure.states, r.noise.process, strict=True)),
                "source": r.noise.source,
            },
            "evaluations": self.evaluations,
            "notes": list(self.notes),
        }

    def _gain(self, alternative: Alternative) -> float | None:
        if not np.isfinite(alternative.value):
            return None
        size = len(self.names) if self.request.criterion == "D" else 1
        return float(np.exp((self.criterion_value - alternative.value) / size))

    def summary(self) -> str:
        """Return the design as text."""
        r = self.request
        lines = [
            f"Plan for {r.vessel.name}: {r.trials} trial{'s' if r.trials > 1 else ''} of "
            f"{r.duration:g} s, commands change every {r.hold:g} s, regime "
            f"{', '.join(spell_regime(s) for s in r.regimes)}",
            f"{self.status}",
        ]
        if self.efficiency_vs_random is not None:
            lines.append(
                f"{self.efficiency_vs_random:.2f} times the information of the best of "
                f"{min(self.random_kept, REFERENCE)} random two-level sequences, which would need "
                f"{self.efficiency_vs_random * r.duration * r.trials:.0f} s for the same precision"
            )
        else:
            lines.append("no random two-level sequence keeps the limits, so there is none to beat")
        lines.append(self.certificate.sentence())
        margins = ", ".join(f"{k} {v:.3g}" for k, v in self.margins.items())
        if margins:
            lines.append(f"least distance from zero: {margins} (m/s, rad/s)")
        if self.keeping is not None:
            lines.append(self.keeping.sentence())
        lines += ["", f"{'parameter':<14}{'prior':>12}{'std err':>12}{'relative':>11}"]
        for name, value, std in zip(self.names, self.values, self.std, strict=True):
            share = f"{abs(std / value):.1%}" if value else "-"
            lines.append(f"{name:<14}{value:>12.4g}{std:>12.2g}{share:>11}")
        if self.alternatives:
            lines += ["", f"{'instead of':<28}{'tried':>7}{'kept':>7}  this plan gives"]
            for a in self.alternatives:
                gain = self._gain(a)
                shown = "-" if gain is None else f"{gain:.2f} times"
                if gain is None or gain > 1000:
                    shown = "tells nothing"
                if not a.kept:
                    shown += " (breaks limits)"
                lines.append(f"{a.name:<28}{a.tried:>7}{a.kept:>7}  {shown}")
        lines += [f"Note: {n}" for n in self.notes]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        from html import escape

        return f"<pre>{escape(self.summary())}</pre>"


def logdet_information(covariance: Array) -> float:
    """Return −log det of a covariance, scaled so that units cost no digits."""
    d = np.sqrt(np.diag(covariance))
    if not np.isfinite(d).all() or not (d > 0).all():
        return float("-inf")
    return -float(np.linalg.slogdet(covariance / np.outer(d, d))[1] + 2 * np.log(d).sum())


def design_trial(
    request: DesignRequest,
    *,
    best_effort: bool = False,
    progress: Progress | None = None,
    workers: int | None = None,
    first: tuple[Array, ...] | None = None,
    alternatives: bool = True,
) -> Design:
    """Design the next trial, or the trials of a campaign.

    Parameters
    ----------
    request : DesignRequest
    best_effort : bool
        Return the closest plan when limits cannot be kept.
    progress : callable, optional
        Called with the pieces of work done and to be done.
    workers : int, optional
        Processes; by default as the work asks for. The result does not depend on it.
    first : tuple of ndarray, optional
        (K, nc) levels a trial to start from, feasible or not.
    alternatives : bool
        Evaluate the classical sequences too.

    Returns
    -------
    Design

    Raises
    ------
    InfeasibleError
        Limits contradict or cannot be kept, the trial is too short for its
        parameters, or the prior model is unstable.

    References
    ----------
    Ljungberg (2020), A10, A15 and section 5.2 for the margins; Atkinson, Donev and
    Tobias (2007) for the criteria.
    """
    began = time.perf_counter()
    _require_horizon(request)
    problems = [build_problem(request, t) for t in range(request.trials)]
    for t, problem in enumerate(problems):
        _require_start(problem, request, t)
    reference, kept = random_campaign(problems, request.seed)
    if reference is None:
        _require_stable(problems[0], request)
    else:
        _require_informative(request, problems, reference, hopeless=10.0)
    initial = reference
    if first is not None:
        initial = [
            np.clip((v - p.schedule.lower) / _span(p), 0, 1)
            for v, p in zip(first, problems, strict=True)
        ]
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
    if found.stopped:
        status = "stopped by the user: the best plan found so far"
    if not found.stopped:
        candidates, more, polished = _polish(problems, candidates)
        evaluations += more
        if polished:
            status = f"solved: many ascents, then multiple shooting; {polished}"
    missing = [t for t, c in enumerate(candidates) if not c.feasible]
    if missing:
        t = missing[0]
        nearest = closest(problems[t], candidates[t].unit[None], request.seed)
        candidates[t], sentence = _feasible_or_reason(problems[t], request, candidates[t], nearest)
        if sentence:
            if not best_effort:
                raise InfeasibleError(sentence)
            status = "limits not kept: the closest plan that was found"
            notes.append(sentence)
    keeping = None
    if request.uncertain and not found.stopped:
        request, problems, candidates, keeping, more = _tighten(
            request, problems, candidates, workers
        )
        evaluations += more
        if keeping.probability < request.probability:
            notes.append(
                f"the limits are kept with probability {keeping.probability:.2f}, "
                f"{request.probability:g} was asked for: lower the margins, or trust the prior "
                f"model less by a first short trial."
            )
    units = [c.unit for c in candidates]
    criterion = problems[0].criterion
    sums = add_up([own_moments(p, u) for p, u in zip(problems, units, strict=True)])
    covariance = criterion.covariance(sums[0])[0]
    if not np.isfinite(covariance).all() and not request.contrasts:
        raise InfeasibleError(_unexcited(problems, units, request))
    columns = wanted_parameters(request, criterion)
    names = tuple(c.name for c in columns)
    if not missing or not best_effort:
        notes += _require_informative(request, problems, units)
    versus, random_value = None, float("nan")
    if reference is not None:
        other = add_up([own_moments(p, u) for p, u in zip(problems, reference, strict=True)])
        gain = logdet_information(covariance) - logdet_information(
            criterion.covariance(other[0])[0]
        )
        versus = float(np.exp(gain / len(covariance)))
        random_value = float(criterion.value(other[0])[0])
        if request.contrasts:
            random_value = float(problems[0].evaluate(reference[0][None]).value[0])
            versus = float(
                np.exp(_criterion_value(problems, units, criterion, covariance) - random_value)
            )
    certificate = certify(problems, units)
    values = np.array(
        [sum(float(request.theta[request.structure.index(n)]) for n in c.terms) for c in columns]
    )
    levels = tuple(p.levels(u) for p, u in zip(problems, units, strict=True))
    commands = tuple(p.schedule.expand(v) for p, v in zip(problems, levels, strict=True))
    motions = tuple(
        p.scenarios[0].rollout.run(c[None]) for p, c in zip(problems, commands, strict=True)
    )
    classical: tuple[Alternative, ...] = ()
    if alternatives and request.trials == 1:
        classical = compare_classical(problems[0], request.seed)
        if reference is not None:
            value = float(problems[0].evaluate(reference[0][None]).value[0])
            two = Alternative("random two-level", kept, kept, value, reference[0])
            classical = (two, *classical)
    return Design(
        request,
        commands,
        levels,
        motions,
        names,
        values,
        covariance,
        _criterion_value(problems, units, criterion, covariance),
        versus,
        random_value,
        kept,
        certificate,
        _margins(problems, motions),
        _limit_reports(problems, motions),
        keeping,
        classical,
        status,
        tuple(notes),
        evaluations,
        time.perf_counter() - began,
    )


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
        known: tuple[Moments, ...] = ()
        if len(problems) > 1:
            pairs = enumerate(zip(problems, out, strict=True))
            known = add_up([own_moments(p, c.unit) for o, (p, c) in pairs if o != t])
        here = problem.with_known(known)
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
    yardstick = problem.scenarios[0].yardstick
    if isinstance(yardstick, MomentProgram) and (
        not yardstick.white and yardstick.columns > EXACT_COLUMNS
    ):
        return False
    if len(problem.scenarios) > 1 or problem.criterion.prior is not None:
        return False
    program = problem.scenarios[0].limits
    commands = problem.schedule.expand(problem.levels(candidate.unit))
    motion = problem.scenarios[0].rollout.run(commands[None])
    path = program.path_values(motion.state[0]).max(axis=1, initial=-np.inf) / program.path_scale
    whole = program.whole_values(motion)[:, 0] / program.whole_scale
    return bool((np.concatenate([path, whole]) > -_NEAR).any())


def _criterion_value(
    problems: list[TrialProblem], units: list[Array], criterion: Criterion, covariance: Array
) -> float:
    if problems[0].contrast is not None:
        return float(problems[0].evaluate(units[0][None]).value[0])
    return float(criterion.of_covariance(covariance[None])[0])


def _span(problem: TrialProblem) -> Array:
    s = problem.schedule
    return np.where(s.upper > s.lower, s.upper - s.lower, 1.0)


def _require_horizon(request: DesignRequest) -> None:
    """Raise where the trial has fewer samples than an equation has unknowns."""
    predictor = request.build_predictor()
    samples = request.schedule.samples
    most = max(len(predictor.equation(s)) + 1 for s in request.structure.states)
    if samples * request.trials <= most:
        raise InfeasibleError(
            f"a trial of {request.duration:g} s has {samples} samples, too few for the {most} "
            f"unknowns of one equation: use --duration {2 * most * request.sample_time:g} or "
            f"more, or --predictor basic."
        )


def _require_informative(
    request: DesignRequest,
    problems: list[TrialProblem],
    units: list[Array],
    hopeless: float = 1.0,
) -> list[str]:
    """Raise where the trial is too short to tell most parameters; return notes on doubtful ones.

    `hopeless` is how many times vaguer random sequences may be than the design.
    """
    if request.targets or request.contrasts or request.criterion == "c":
        return []
    criterion = problems[0].criterion
    names = [c.name for c in wanted_parameters(request, criterion)]
    sums = add_up([own_moments(p, u) for p, u in zip(problems, units, strict=True)])
    covariance = criterion.covariance(sums[0])[0]
    if hopeless > 1 and not np.isfinite(covariance).all():
        return []
    share = np.sqrt(np.diag(covariance)) / criterion.scale
    vague = [n for n, s in zip(names, share, strict=True) if s > hopeless * _VAGUE]
    if 2 * len(vague) > len(names):
        longer = telling_duration(request, _VAGUE)
        advice = "Use --predictor basic, or --want fewer parameters"
        if longer is not None:
            advice = f"Use --duration {longer:g}, or --predictor basic"
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


def _require_start(problem: TrialProblem, request: DesignRequest, trial: int) -> None:
    """Raise where the start itself breaks a limit."""
    program = problem.scenarios[0].limits
    start = np.zeros(program.nx + 3)
    start[: program.nx + 1] = request.starts[trial]
    missed = program.path_values(start[None])[:, 0]
    for name, m, more in zip(
        program.path_names, missed, [*request.backoff, *[0.0] * len(missed)], strict=False
    ):
        if m - more > TOLERANCE:
            where = (
                f"{m:.1f} m outside the sea room"
                if name.name == "sea room"
                else f"{m:.3g} {name.unit} beyond the {name.name} of {name.bound:g} {name.unit}"
            )
            option = "--position" if name.name == "sea room" else "--start"
            raise InfeasibleError(
                f"the trial starts {where}: change {option}, or relax {name.option} by {m:.3g}."
            )


def _require_stable(problem: TrialProblem, request: DesignRequest) -> None:
    """Raise where the prior model runs away under any constant command."""
    steady = steady_motions(
        request.vessel,
        request.structure,
        request.theta,
        request.d,
        problem.schedule,
        request.starts[0],
    )
    if len(steady.x) == 0:
        raise InfeasibleError(
            f"the prior model is unstable in free run: under each of {steady.unstable} constant "
            f"commands a state passes 100 m/s or 10 rad/s within 400 s. Design with a stable "
            f"model: estimate it with fewer terms (--structure linear), or start elsewhere."
        )


def _feasible_or_reason(
    problem: TrialProblem, request: DesignRequest, best: Candidate, nearest: Candidate
) -> tuple[Candidate, str]:
    """Return the better of two candidates, and why limits cannot be kept, empty if they can."""
    chosen = nearest if nearest.missed.max(initial=0) < best.missed.max(initial=0) else best
    if (chosen.missed <= TOLERANCE).all():
        if np.isfinite(chosen.value):
            return chosen, ""
        return chosen, _unexcited([problem], [chosen.unit], request)
    name, amount = least_change(problem, chosen)[0]
    return chosen, in_words(name, amount, _turning(problem, request, name.name))


def _turning(problem: TrialProblem, request: DesignRequest, name: str) -> str:
    """Return what the turning circle has to do with it, where it has."""
    if name != "sea room":
        return ""
    steady = steady_motions(
        request.vessel, request.structure, request.theta, request.d, problem.schedule
    )
    signs = np.ones(len(steady.x), bool)
    for state, sign in request.regimes[0]:
        column = steady.x[:, request.structure.states.index(state)]
        signs &= column * sign >= request.limits.margins.get(state, 0.0)
    if not signs.any():
        return ""
    smallest = float(steady.diameter[signs].min())
    area = request.limits.area
    if isinstance(area, Circle):
        width = 2 * area.radius
    else:
        corners = np.asarray(area, float)
        width = float(np.ptp(corners, axis=0).min())
    if not np.isfinite(smallest):
        return " No constant command within the limits turns the vessel."
    return (
        f" The sea room is {width:.0f} m across; the smallest circle that the vessel turns within "
        f"these limits is {smallest:.0f} m."
    )


def _unexcited(problems: list[TrialProblem], units: list[Array], request: DesignRequest) -> str:
    """Return which regressor no sequence moves enough to be told from the others."""
    if request.estimator == "oe":
        return (
            "this trial cannot tell the parameters of an output-error fit apart: lengthen it, widen "
            "the limits, or use --predictor basic."
        )
    sums = add_up([own_moments(p, u) for p, u in zip(problems, units, strict=True)])[0]
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
                f"Widen the limits, or leave it out of the structure."
            )
        values, vectors = np.linalg.eigh(gram / np.outer(size, size))
        if values[0] < worst:
            worst, state = float(values[0]), name
            label = predictor.columns[mine[int(np.abs(vectors[:, 0]).argmax())]].label
    return (
        f"this trial cannot tell the regressors of {state} apart: along {label} their smallest "
        f"eigenvalue is {max(worst, 0):.1e} of the largest, 1e-12 is needed. Lengthen the trial, "
        f"widen the limits, use --predictor basic, or plan --trials 2 in other regimes."
    )


def _tighten(
    request: DesignRequest,
    problems: list[TrialProblem],
    candidates: list[Candidate],
    workers: int | None,
) -> tuple[DesignRequest, list[TrialProblem], list[Candidate], Keeping, int]:
    """Tighten the path limits until they are kept with the wanted probability."""
    spent = 0
    plain = replace(request, backoff=())
    keeping = keep_probability(plain, [c.unit for c in candidates])
    best = (request, problems, candidates, keeping)
    backoff = np.zeros(len(keeping.shortfall))
    previous, shortfall = candidates, keeping.shortfall
    for _ in range(_TIGHTENINGS):
        if best[3].probability >= request.probability or not shortfall.any():
            break
        backoff = backoff + 1.1 * shortfall
        tighter = replace(request, backoff=tuple(backoff))
        again = [build_problem(tighter, t) for t in range(request.trials)]
        found = search_campaign(
            tighter,
            again,
            [c.unit for c in previous],
            effort=_AGAIN * request.effort,
            workers=workers,
            quick=True,
        )
        spent += found.evaluations
        if not all(np.isfinite(c.value) for c in found.candidates):
            break
        now = keep_probability(plain, [c.unit for c in found.candidates])
        previous, shortfall = list(found.candidates), now.shortfall
        if now.probability > best[3].probability:
            # what is reported is measured against the limits as they were asked for
            renewed = [
                assess(p, c.unit[None])[0] for p, c in zip(problems, found.candidates, strict=True)
            ]
            best = (tighter, problems, renewed, now)
    return (*best, spent)


def _margins(problems: list[TrialProblem], motions: tuple[Motion, ...]) -> dict[str, float]:
    """Return the least distance of each sign-keeping state from zero, currents included."""
    found: dict[str, float] = {}
    for problem, motion in zip(problems, motions, strict=True):
        program = problem.scenarios[0].limits
        values = program.path_values(motion.state[0])
        states = problem.scenarios[0].rollout.structure.states
        backoff = program.backoff
        for i, (name, _) in enumerate(program.limits.signs.items()):
            least = float((program.path_names[i].bound + backoff[i] - values[i]).min())
            found[name] = min(found.get(name, np.inf), least)
        for i, name in enumerate(states):
            if name in ("u", "v") and name not in program.limits.signs:
                least = float(np.abs(motion.state[0, :, i]).min())
                found[name] = min(found.get(name, np.inf), least)
    return found


def _limit_reports(
    problems: list[TrialProblem], motions: tuple[Motion, ...]
) -> tuple[LimitReport, ...]:
    found = []
    for t, (problem, motion) in enumerate(zip(problems, motions, strict=True)):
        program = problem.scenarios[0].limits
        missed = program.violations(motion)[:, 0]
        for name, m in zip(program.names, missed, strict=True):
            found.append(LimitReport(t, name.name, name.bound, name.unit, float(m)))
    return tuple(found)
