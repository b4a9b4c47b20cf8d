"""One estimate: by a given method, predictor and structure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from greybox.errors import DivergenceError, ExcitationError, UsageError
from greybox.estimation.estimate import UnexcitedBiasError, estimate_iv, estimate_ls
from greybox.estimation.judging import judge_estimate
from greybox.estimation.loop import CLOSED_LOOP_LAG, assess_loop
from greybox.estimation.output_error import estimate_oe
from greybox.estimation.output_setup import output_predictor
from greybox.estimation.refined import estimate_refined_iv, with_noise
from greybox.estimation.result import Estimate
from greybox.model.model import ManoeuvringModel
from greybox.model.predictor import Predictor, build_predictor
from greybox.model.structure import Structure
from greybox.regression.instruments import WIND_WINDOW
from greybox.trial.log import TrialLog
from greybox.validation.fit import run_model
from greybox.validation.informative import regime_of, require_informative
from greybox.validation.request import Request

# refinements of the instruments where a free-run fit starts
_STARTING_REFINEMENTS = 1
# process noise, in deviations of the measurements, from which on it counts
_PUSHED = 0.05


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
    logs: Sequence[TrialLog],
    structure: Structure,
    method: str,
    kind: str,
    request: Request,
    start: Estimate | None = None,
) -> Estimate:
    """Estimate with one method and predictor; output error from `start` where it is given.

    Raises
    ------
    ExcitationError
        The logs cannot determine the parameters.
    LogError
        A channel is missing.
    """
    require_informative(logs, kind)
    if method == "oe":
        return _estimate_oe(logs, structure, kind, request, start)
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
    coarse = [
        s for log in logs for s in log.provenance.steps if s.operation in ("difference", "decimate")
    ]
    if coarse:
        notes.append(
            f"the logs were conditioned ({coarse[0].sentence}) and the model steps by Euler: "
            f"damping and current carry a bias of the order of the damping over one sample, which "
            f"the standard errors leave out. Compare with a shorter sample time."
        )
    return replace(estimate, tests=(*estimate.tests, loop_test), notes=tuple(notes))


def _estimate_oe(
    logs: Sequence[TrialLog],
    structure: Structure,
    kind: str,
    request: Request,
    given: Estimate | None = None,
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
    if start is None and given is not None:
        start, notes = given, [f"it started from the estimate by {given.method}."]
    elif start is None:
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
    return with_noise(plain, logs, **common) if request.judged else plain


def _pushed_through_air(estimate: Estimate) -> bool:
    """Whether process noise is in the measured velocity through the air of the instruments."""
    noise = estimate.noise
    if noise is None or not estimate.predictor.air_measured:
        return False
    return bool((noise.process > _PUSHED * noise.measurement).any())
