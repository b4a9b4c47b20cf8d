"""Choosing method and predictor when the user does not, and saying why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from greybox.errors import DivergenceError, ExcitationError, GreyboxError, LogError, UsageError
from greybox.estimation.credibility import judge
from greybox.estimation.estimate import (
    Covariance,
    UnexcitedBiasError,
    estimate_iv,
    estimate_ls,
)
from greybox.estimation.judging import judge_estimate
from greybox.estimation.limits import limits_of
from greybox.estimation.loop import CLOSED_LOOP_LAG, Loop, assess_loop
from greybox.estimation.output_error import OutputErrorOptions, estimate_oe
from greybox.estimation.output_setup import output_predictor
from greybox.estimation.refined import estimate_refined_iv, with_noise
from greybox.estimation.result import Estimate, Verdict
from greybox.model.catalogue import structure_for
from greybox.model.model import ManoeuvringModel
from greybox.model.predictor import Predictor, Regime, build_predictor
from greybox.model.structure import Structure
from greybox.regression.instruments import WIND_WINDOW
from greybox.regression.regression import common_sample_time
from greybox.trial.log import TrialLog
from greybox.validation.fit import average_fit, run_model
from greybox.validation.held_out import rank, score_runs, spread_of
from greybox.vessel.force import force_inputs

Array = NDArray[np.float64]

# heading range that current north and east need to be told apart; least and advised [rad]
LEAST_HEADING, ADVISED_HEADING = np.deg2rad(20), np.deg2rad(90)
# held-out share of each log when alternatives are compared
_HELD_OUT = 1 / 3
# parts of the held-out runs, for a standard error
_BLOCKS = 6
# refinements of the instruments while alternatives are compared
_RANKING_REFINEMENTS = 4
# refinements of the instruments where a free-run fit starts
_STARTING_REFINEMENTS = 1
# process noise, in deviations of the measurements, from which on it counts
_PUSHED = 0.05
# share of samples that must meet a sign condition
_KEPT = 0.9


@dataclass(frozen=True)
class Alternative:
    """One way to estimate."""

    structure: Structure
    method: str
    kind: str
    reason: str = ""

    @property
    def label(self) -> str:
        """Method, predictor and structure in words."""
        return f"{self.method} with predictor '{self.kind}' of structure '{self.structure.name}'"


@dataclass(frozen=True)
class Request:
    """What to estimate; None leaves the choice to the data.

    ``margins`` are |u|, |v| [m/s] below which samples are cut out; ``nominal``
    simulates the first instruments, or starts output error (least squares does
    without it); ``output_error`` is what only ``oe`` heeds; ``prefilter`` is
    ``noise`` for refined instrumental variables, ``none`` for plain ones; ``judged``
    asks for the tests and the verdict; ``without`` are bias-capturing columns to leave
    out, spelled ``state:function``.
    """

    method: str | None = None
    predictor: str | None = None
    structure: str | None = None
    margins: dict[str, float] | None = None
    covariance: Covariance | None = None
    heading: Literal["measured", "simulated"] = "measured"
    loop: Loop = "auto"
    zero_mean: bool = True
    refine: bool | int = True
    nominal: ManoeuvringModel | None = None
    output_error: OutputErrorOptions = field(default_factory=OutputErrorOptions)
    seed: int = 0
    prefilter: Literal["auto", "noise", "none"] = "auto"
    judged: bool = True
    without: tuple[str, ...] = ()


def heading_range(logs: Sequence[TrialLog]) -> float:
    """Return how much of the circle the headings of all logs cover [rad].

    Whole turns between logs do not count: 2π less the largest gap.
    """
    psi = np.sort(np.concatenate([log["psi"] for log in logs]) % (2 * np.pi))
    gaps = np.append(np.diff(psi), psi[0] + 2 * np.pi - psi[-1])
    return float(2 * np.pi - gaps.max())


def regime_of(logs: Sequence[TrialLog], structure: Structure) -> Regime:
    """Return the signs that each state takes in more than one sample of twenty.

    Rarer ones are noise or short passages, which simulated instruments may not
    repeat; columns for them would have no instrument.
    """
    regime = []
    for state in structure.states:
        value = np.concatenate([log[state] for log in logs])
        signs = tuple(s for s in (1, -1) if float((s * value > 0).mean()) > 0.05)
        regime.append((state, signs or (1, -1)))
    return tuple(regime)


def require_informative(logs: Sequence[TrialLog], predictor: str) -> None:
    """Refuse logs that cannot answer, before any algebra does so obscurely.

    Raises
    ------
    ExcitationError
        No thruster command changes, or the heading does not for a predictor
        that must tell current north from east.
    """
    commands = logs[0].vessel.commands
    moved = {
        c: max(float(np.ptp(log[c])) for log in logs)
        + float(np.ptp([float(log[c][0]) for log in logs]))
        for c in commands
    }
    if all(v == 0.0 for v in moved.values()):
        raise ExcitationError(
            f"every thruster command is constant over the log ({', '.join(commands)}), so its "
            f"effect cannot be told from a constant: change the commands during the trial."
        )
    if predictor in ("augmented", "wind"):
        turned = heading_range(logs)
        if turned < LEAST_HEADING:
            raise ExcitationError(
                f"heading stays within {np.degrees(turned):.0f} deg, so current_north and "
                f"current_east cannot be told apart (needs about "
                f"{np.degrees(ADVISED_HEADING):.0f} deg). Turn during the trial, or use "
                f"--predictor {'basic' if predictor == 'augmented' else 'basic+wind'}."
            )


def _predictor(structure: Structure, kind: str, logs: Sequence[TrialLog], ls: bool) -> Predictor:
    return build_predictor(
        structure,
        kind,
        regime_of(logs, structure),
        intercept=ls and kind in ("augmented", "wind"),
    )


def _less(predictor: Predictor, without: Sequence[str]) -> Predictor:
    """Return the predictor without some bias-capturing columns; those it lacks are none."""
    for name in without:
        for i, c in enumerate(predictor.columns):
            if c.is_bias and f"{c.state}:{c.name}" == name:
                predictor = predictor.without_bias(i)
                break
    return predictor


def _nominal_theta(
    nominal: ManoeuvringModel | None, structure: Structure
) -> NDArray[np.float64] | None:
    """Return a nominal model's parameters in the order of a structure, absent ones zero.

    Of one whose parameters change, those after the last change.
    """
    if nominal is None:
        return None
    nominal = nominal.settled()
    known = dict(zip(nominal.names, nominal.theta, strict=True))
    return np.array([known.get(name, 0.0) for name in structure.parameters])


def estimate_once(
    logs: Sequence[TrialLog], structure: Structure, method: str, kind: str, request: Request
) -> Estimate:
    """Estimate with one method and predictor.

    Raises
    ------
    ExcitationError
        The logs cannot determine the parameters.
    LogError
        A channel is missing.
    """
    require_informative(logs, kind)
    if method == "oe":
        return _estimate_oe(logs, structure, kind, request)
    closed, loop_test = assess_loop(logs, request.loop, method)
    common: dict[str, Any] = {
        "margins": request.margins,
        "seed": request.seed,
        # instruments are judged once, after the prefilter
        "judged": request.judged and method == "ls",
    }
    if request.covariance is not None:
        common["covariance"] = request.covariance
    keep_constant = method == "ls" or not request.zero_mean
    predictor = _less(_predictor(structure, kind, logs, keep_constant), request.without)
    noisy_wind = float(logs[0].vessel.sensors.get("wind_std", 0.0)) > 0
    notes = []
    while True:
        try:
            if method == "ls":
                estimate = estimate_ls(predictor, logs, **common)
            else:
                estimate = estimate_iv(
                    predictor,
                    logs,
                    start=_nominal_theta(request.nominal, predictor.structure),
                    zero_mean=request.zero_mean,
                    refine=request.refine,
                    heading=request.heading,
                    wind="smoothed" if noisy_wind else "measured",
                    lag=CLOSED_LOOP_LAG if closed else 0,
                    **common,
                )
            break
        except UnexcitedBiasError as error:
            label = predictor.columns[error.column].label
            notes.append(f"the bias-capturing regressor {label} does not vary and was left out.")
            predictor = predictor.without_bias(error.column)
    if method == "iv":
        averaged: Literal["smoothed", "measured"] = "smoothed" if noisy_wind else "measured"
        estimate = _prefiltered(estimate, logs, request, averaged, closed, notes)
        if request.judged:
            estimate = judge_estimate(
                estimate,
                logs,
                margins=request.margins,
                zero_mean=request.zero_mean,
                heading=request.heading,
                wind=averaged,
                lag=CLOSED_LOOP_LAG if closed else 0,
            )
    if kind in ("wind", "basic+wind") and method == "iv" and noisy_wind:
        notes.append(
            f"the wind in the instruments is the measured one averaged over {WIND_WINDOW:g} s, "
            f"because its sensor is noisy; terms that only faster gusts could tell stay uncertain."
        )
    elif kind in ("wind", "basic+wind") and method == "iv":
        notes.append(
            "the instruments hold the measured wind as it is: noise of its sensor would move the "
            "wind terms towards zero and, in a nearly steady wind, the current with them. Give "
            "wind_std in [sensors] where there is some; the wind is then averaged."
        )
    coarse = [d for log in logs for d in log.provenance.derived if "3.57" in d or "decimated" in d]
    if coarse:
        notes.append(
            f"the logs were conditioned ({coarse[0]}) and the model steps by Euler: damping and "
            f"current carry a bias of the order of the damping over one sample, which the "
            f"standard errors leave out. Compare with a shorter sample time."
        )
    return replace(estimate, tests=(*estimate.tests, loop_test), notes=tuple(notes))


def _estimate_oe(
    logs: Sequence[TrialLog], structure: Structure, kind: str, request: Request
) -> Estimate:
    """Fit free runs, from the nominal model, else from an estimate by IV or least squares."""
    if request.margins:
        raise UsageError(
            f"margins cut samples out of a regression, and a free run needs every one: leave "
            f"--margin-{min(request.margins)} out, or use --method iv."
        )
    if request.covariance == "bootstrap":
        raise UsageError(
            "the block bootstrap resamples rows of a regression: use --covariance ma, hac or white "
            "with --method oe."
        )
    options = request.output_error
    if request.covariance is not None:
        options = replace(options, covariance=request.covariance)
    predictor = output_predictor(structure, kind, regime_of(logs, structure))
    predictor = _less(predictor, request.without)
    start: Estimate | NDArray[np.float64] | None = _nominal_theta(request.nominal, structure)
    notes = ["it started from the nominal model."]
    if start is None:
        start, said = _quick_start(logs, structure, kind)
        notes = [said]
    while True:
        try:
            estimate = estimate_oe(predictor, logs, start=start, options=options)
            break
        except UnexcitedBiasError as error:
            label = predictor.columns[error.column].label
            notes.append(f"the bias-capturing regressor {label} does not vary and was left out.")
            predictor = predictor.without_bias(error.column)
    if request.judged:
        estimate = judge_estimate(estimate, logs)
    _, loop_test = assess_loop(logs, request.loop, "oe")
    return replace(estimate, tests=(*estimate.tests, loop_test), notes=(*estimate.notes, *notes))


def _quick_start(
    logs: Sequence[TrialLog], structure: Structure, kind: str
) -> tuple[Estimate | None, str]:
    """Return an estimate by IV, else by least squares, that a free-run fit can start from.

    Bias-capturing terms are left out: the fit finds the current by itself.
    """
    plain = "basic+wind" if kind in ("wind", "basic+wind") else "basic"
    predictor = _predictor(structure, plain, logs, ls=True)
    try:
        found = estimate_iv(
            predictor, logs, refine=_STARTING_REFINEMENTS, covariance="white", judged=False
        )
        return found, "it started from an estimate by instrumental variables."
    except (ExcitationError, DivergenceError):
        pass
    try:
        found = estimate_ls(predictor, logs, covariance="white", judged=False)
        return found, "it started from the least-squares estimate."
    except ExcitationError:
        return None, "it started from nothing."


def _prefiltered(
    plain: Estimate,
    logs: Sequence[TrialLog],
    request: Request,
    wind: Literal["smoothed", "measured"],
    closed: bool,
    notes: list[str],
) -> Estimate:
    """Refine a plain IV estimate by its noise, unless something speaks against it.

    Raises
    ------
    UsageError
        The request asks for what zero-mean, undelayed instruments only can do.
    ExcitationError
        The refinement that the request asks for fails.
    """
    common: dict[str, Any] = {
        "heading": request.heading,
        "wind": wind,
        "margins": request.margins,
    }
    against = ""
    if closed:
        against = "instruments are delayed for the closed loop, which a prefilter would undo"
    elif not request.zero_mean:
        against = "instruments keep their mean"
    if request.prefilter == "noise" and against:
        raise UsageError(
            f"--prefilter noise needs open loop and zero-mean instruments, and {against}: "
            f"use --prefilter none."
        )
    if request.prefilter != "none" and not against:
        kind: dict[str, Any] = (
            {} if request.covariance is None else {"covariance": request.covariance}
        )
        try:
            refined = estimate_refined_iv(
                plain.predictor, logs, start=plain, seed=request.seed, **kind, **common
            )
            if request.prefilter == "noise":
                return refined
            runs = [run_model(refined.model(), log) for log in logs]
            mixed = wind == "measured" and _pushed_through_air(refined)
            if all(r.diverged < 0 for r in runs) and not mixed:
                return refined
            against = (
                "something beside the model moves the ship, and the measured wind, which holds "
                "that motion, would be mixed into its neighbours (give wind_std in [sensors])"
                if mixed
                else "the free run of the refined model diverges"
            )
        except ExcitationError as error:
            if request.prefilter == "noise":
                raise
            against = str(error).rstrip(".")
    if against and request.prefilter == "auto":
        notes.append(f"the instruments were not refined by the noise: {against}.")
    return with_noise(plain, logs, **common)


def _pushed_through_air(estimate: Estimate) -> bool:
    """Whether process noise is in the measured velocity through the air of the instruments."""
    noise = estimate.noise
    if noise is None or not estimate.predictor.air_measured:
        return False
    return bool((noise.process > _PUSHED * noise.measurement).any())


def estimate_model(logs: Sequence[TrialLog], request: Request = Request()) -> Estimate:
    """Estimate a model, choosing what the request leaves open.

    Parameters
    ----------
    logs : sequence of TrialLog
        One experiment each, of one vessel and sample time.
    request : Request

    Returns
    -------
    Estimate
        With its free-run fit on `logs` and notes on every choice.

    Raises
    ------
    ExcitationError
        No alternative can be estimated.
    LogError
        Logs differ in sample time, or lack a channel.
    """
    common_sample_time(logs)
    notes: list[str] = []
    inputs = force_inputs(logs[0].vessel)
    wind = all(log.has_wind for log in logs)
    names = [request.structure] if request.structure is not None else _structures(logs, wind)
    structures = [structure_for(name, inputs) for name in names]
    methods = [request.method] if request.method else ["iv", "ls"]
    kinds = (
        [request.predictor] if request.predictor else _plausible(logs, structures[0], wind, notes)
    )
    for kind in kinds:
        if kind in ("wind", "basic+wind") and not wind:
            lacking = next(log.name for log in logs if not log.has_wind)
            raise LogError(
                f"predictor '{kind}' needs the wind, and '{lacking}' has neither u_q, v_q nor "
                f"V_q, gamma_q: use --predictor augmented or basic."
            )
    alternatives = [Alternative(s, m, k) for s in structures for m in methods for k in kinds]
    if request.method == "oe":
        reason = (
            "a free run feels the mean current itself, so it needs no sign condition, and the "
            "first structure whose run stays bounded is kept"
        )
        alternatives = [replace(a, reason=reason) for a in alternatives if a.kind == kinds[0]]
    elif len(alternatives) > 1:
        theory = _theory(logs, structures[0], wind)
        first = [
            a
            for a in alternatives
            if a.structure is structures[0] and a.method == "iv" and a.kind == theory
        ]
        if first:
            first[0] = replace(
                first[0],
                reason="heading turns enough and the states keep their signs, so its estimates "
                "are consistent as long as current and unmeasured wind stay slower than the ship "
                "(chapter 5)",
            )
            alternatives = [*first, *[a for a in alternatives if a.label != first[0].label]]
        else:
            alternatives = _compare(logs, alternatives, request, notes)
    return _first_that_runs(logs, alternatives, request, notes)


def _first_that_runs(
    logs: Sequence[TrialLog],
    alternatives: Sequence[Alternative],
    request: Request,
    notes: list[str],
) -> Estimate:
    """Return the first estimate whose free run stays bounded, else the first one at all."""
    failures: list[GreyboxError] = []
    fallback: Estimate | None = None
    for alternative in alternatives:
        try:
            estimate = estimate_once(
                logs, alternative.structure, alternative.method, alternative.kind, request
            )
        except GreyboxError as error:
            failures.append(error)
            notes.append(f"{alternative.label} was left: {error}")
            continue
        model = estimate.model()
        runs = [run_model(model, log) for log in logs]
        own = list(estimate.notes)
        if alternative.reason:
            own.append(f"{alternative.label} was taken: {alternative.reason}.")
        if estimate.method == "iv":
            own.append(f"instruments: {estimate.status}.")
        elif estimate.method == "oe":
            own.append(f"the fit {estimate.status}.")
        if estimate.predictor.contaminated:
            own.append(
                f"{', '.join(estimate.predictor.contaminated)} also carry a second moment of the "
                f"current, which this structure cannot separate."
            )
        fit = average_fit(runs)
        poor = [s for s, v in fit.items() if v < 0]
        if poor and all(r.diverged < 0 for r in runs):
            own.append(
                f"the free run of {', '.join(poor)} is worse than a constant on the very logs it "
                f"was estimated on: this model does not explain that motion."
            )
        diverged = any(r.diverged >= 0 for r in runs)
        estimate = replace(estimate, notes=(*notes, *own), fit=fit)
        if request.judged:
            found, trouble = limits_of(estimate, logs)
            lacking = (f"bounds: {trouble}",) if trouble else ()
            estimate = replace(
                estimate,
                verdict=_verdict(estimate, diverged),
                limits=found,
                notes=(*estimate.notes, *lacking),
            )
        if not diverged:
            return estimate
        notes.append(f"{alternative.label} was left: its free run diverges.")
        fallback = fallback or estimate
    if fallback is None:
        raise failures[0]
    warning = (
        "the free run of this model diverges on the estimation logs: do not simulate with it. "
        "Use a smaller structure or a longer, more exciting log."
    )
    return replace(fallback, notes=(*fallback.notes, warning))


def _verdict(estimate: Estimate, diverged: bool) -> Verdict:
    """Weigh the tests again, now with the loop and the free run."""
    return judge(
        estimate.tests,
        estimate.labels,
        estimate.method,
        contaminated=estimate.predictor.contaminated,
        fit=estimate.fit,
        diverged=diverged,
    )


def _structures(logs: Sequence[TrialLog], wind: bool) -> list[str]:
    """Return the structures to try where the user names none, the fullest first.

    On a nearly constant heading an unmeasured wind or current is a constant
    force, which the bias-capturing terms cannot be told from.
    """
    if wind:
        return ["thesis", "linear+Wuu+Wvv+Wuv"]
    if heading_range(logs) < ADVISED_HEADING:
        return ["thesis", "linear", "linear+X_0+Y_0+N_0"]
    return ["thesis", "linear"]


def _plausible(
    logs: Sequence[TrialLog], structure: Structure, wind: bool, notes: list[str]
) -> list[str]:
    """Return the predictors that the logs can support."""
    turned = heading_range(logs)
    rows = sum(len(log) for log in logs)
    measured = wind and structure.uses_air
    kinds = ["basic+wind"] if measured else ["basic"]
    most = 20 * 16
    if turned >= ADVISED_HEADING and rows >= most:
        kinds = ["wind", "augmented", *kinds] if measured else ["augmented", *kinds]
    else:
        notes.append(
            f"bias-capturing terms were left out: heading covers {np.degrees(turned):.0f} deg "
            f"(about {np.degrees(ADVISED_HEADING):.0f} are needed) on {rows} samples "
            f"(about {most})."
        )
    return kinds


def _theory(logs: Sequence[TrialLog], structure: Structure, wind: bool) -> str | None:
    """Return the predictor whose consistency conditions the logs meet, if one does.

    Without wind measurement u_r, u_q and u share a sign, likewise in sway (5.7),
    (5.68); with it only u_r and v_r must keep theirs (5.50), (5.77).
    """
    if structure.disturbance != "marine":
        return None
    for log in logs:
        for state in set(structure.states) & {"u", "v"}:
            margin = 3 * (log.vessel.std(state) or 0.0)
            sign = np.sign(np.median(log[state]))
            if float((sign * log[state] > margin).mean()) < _KEPT:
                return None
    if not (wind and structure.uses_air):
        return "augmented"
    same = all(
        float((log[air] * log[state] > 0).mean()) >= _KEPT
        for log in logs
        for state, air in (("u", "u_q"), ("v", "v_q"))
        if state in structure.states
    )
    return "augmented" if same else "wind"


def _compare(
    logs: Sequence[TrialLog],
    alternatives: list[Alternative],
    request: Request,
    notes: list[str],
) -> list[Alternative]:
    """Put first the earliest alternative whose held-out run is within an error of the best."""
    request = ranking_request(request)
    fitting, held = [], []
    for log in logs:
        cut = len(log) - int(len(log) * _HELD_OUT)
        fitting.append(log.window(0, cut, log.name))
        held.append(log.window(cut, len(log), log.name))
    spread = spread_of(logs, alternatives[0].structure.states)
    scores: list[Array | None] = []
    for alternative in alternatives:
        try:
            model = estimate_once(
                fitting, alternative.structure, alternative.method, alternative.kind, request
            ).model()
            runs = [run_model(model, log) for log in held]
            bounded = all(r.diverged < 0 for r in runs)
            scores.append(score_runs(runs, spread, _BLOCKS) if bounded else None)
        except GreyboxError:
            scores.append(None)
    if all(s is None for s in scores):
        notes.append("no alternative could be run on the last third of each log.")
        return alternatives
    found = rank(scores, range(len(alternatives)))
    order = sorted(range(len(alternatives)), key=lambda i: (i != found.chosen, -found.score[i]))
    shown = ", ".join(
        f"{alternatives[i].label} "
        + (
            f"{found.score[i]:.1f} ({found.behind[i]:.1f} ± {found.se[i]:.1f} behind)"
            if np.isfinite(found.score[i])
            else "diverged"
        )
        for i in order
    )
    notes.append(
        f"chosen by the free run on the last third of each log when estimated on the first two "
        f"(mean fit in % of the whole logs' spread, cut at −100; the fullest structure and the "
        f"method least biased by noise that fall behind the best by no more than one standard "
        f"error): {shown}."
    )
    return [alternatives[i] for i in order]


def ranking_request(request: Request) -> Request:
    """Return the request without standard errors, tests and the last digit."""
    return replace(
        request,
        covariance="white",
        refine=_RANKING_REFINEMENTS,
        prefilter="none",
        judged=False,
    )
