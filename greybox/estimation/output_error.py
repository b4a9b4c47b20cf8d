"""Output error and maximum likelihood: the free run itself is fitted to the log.

Unknown besides the parameters are each log's initial state, the mean current, and
what an unmeasured wind does (its moments are coefficients, as in chapter 5).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from greybox.errors import ExcitationError, UsageError, so_many, suggestion
from greybox.estimation.covariance import (
    LEFT,
    Covariance,
    allow_for_segments,
    block_bootstrap,
    correlation_lags,
    segment_length,
    segment_sums,
)
from greybox.estimation.free_run import Shooting, changes, fit_free_runs, in_doubt
from greybox.estimation.free_run_errors import (
    memory_correction,
    noise_of_run,
    noise_of_sensors,
    residual_noise,
    shared_score_covariance,
    slow_errors,
)
from greybox.estimation.informative import unexcited
from greybox.estimation.innovations import FilterRuns, fit_innovations
from greybox.estimation.output_setup import deviations, measured, output_model, turns
from greybox.estimation.result import Estimate
from greybox.estimation.shooting import (
    TOLERANCE,
    FreeRuns,
    Linearised,
    Loss,
    Measured,
    Restrictions,
    Segments,
    ShootingFit,
    loss_weights,
)
from greybox.estimation.solve import UnexcitedBiasError
from greybox.estimation.values import Iteration, estimation_data
from greybox.estimation.verdict import TestResult
from greybox.model.disturbances import CURRENT, WIND, turn_bounds, turn_of_water
from greybox.model.noise import NoiseLevels
from greybox.model.output import OutputModel, Role
from greybox.model.predictor import Predictor
from greybox.model.run.output_runs import Simulator
from greybox.model.run.step import Integrator
from greybox.numerics.linalg import UNKNOWN, scaled, scaled_inverse
from greybox.numerics.threads import one_thread
from greybox.public import known_keywords
from greybox.regression.regression import common_sample_time
from greybox.trial.log import Logs, TrialLog
from greybox.trial.segments import as_segments

Array = NDArray[np.float64]
Damping = Literal["warn", "enforce"]
Weights = Literal["noise", "deviation"]

# sensitivities beyond this are no numbers to compute with
_LARGEST = 1e100
# no current is stronger, and no mean wind [m/s]
_STRONGEST = (5.0, 60.0)
# weight in an unknown direction from which on a bias-capturing column can be left out
_SHARES = 0.2
# standard errors to both sides over which the Hessian of a run's likelihood is taken
_BESIDE = 0.5
# coefficient of a parameter at its bound has no spread
_AT_BOUND = 1e-9
# samples per unknown that a fit needs
_ROWS = 2
# relative singular value below which a direction counts as weak, and the weight from
# which a parameter is named in it
_WEAK, _SHOWN = 1e-3, 0.3
# p-value up to which a free-run error counts as wandering
_WANDERS = 0.01
# deviations above what a fit to white noise leaves, from which on the heading drifts
_DRIFTS = 5.0


@dataclass(frozen=True)
class OutputErrorOptions:
    """How an output-error estimate is made.

    Parameters
    ----------
    process_noise : bool
        Maximise the likelihood of the innovations instead of fitting free runs.
    heading : {"auto", "input", "output"}
        The measured heading drives the run, or is simulated and compared. ``auto``
        compares it unless its error wanders, as it does where something beside
        the model turns the ship.
    wind : {"input", "output"}
        Likewise the measured wind; as an output it follows from a constant wind.
    loss : {"gaussian", "huber"}
        ``huber`` limits what single outliers can do.
    shooting : {"auto", "single", "multiple"}
    bounds : mapping of str to (float, float)
        Limits of a parameter, by name.
    priors : mapping of str to (float, float)
        Mean and standard deviation known before, by name.
    damping : {"warn", "enforce"}
        Whether damping terms are kept from driving the ship.
    covariance : {"cluster", "ma", "hac", "white", "bootstrap"}
        ``ma``: residuals with a memory of their own, independent of the inputs;
        ``cluster``: as ``ma``, or more where scores differ more between segments of the
        logs, as they do where the residuals depend on the motion; ``hac``: robust to a
        variance that changes; ``white``: none; ``bootstrap``: one step from resampled
        blocks of the logs.
    weights : {"noise", "deviation"}
        What an output's error is measured in: its noise, as found with the fit, which is
        the likelihood; or its own deviation over the logs, as the fit (6.12) does. The
        latter is for a model that leaves more than noise; the measured heading then
        drives the run unless it is asked for as an output.
    search : bool
        Whether other ways are tried where errors stay large; without, the fit ends at the
        optimum that is nearest to its start.
    starts : {"free", "measured"}
        Whether first states are estimated too, or runs begin with the mean of the first
        samples, as predictions do. Free ones are right where the model leaves no more than
        noise; of a model that leaves more they make up for what it lacks.
    levels : bool
        Whether the noise levels of sensors and process are sought once the fit has ended.
    tolerance : float
        Length of the last step in standard errors.
    seed : int
        For the bootstrap.
    integrator : {"euler", "rk4"}
        Of the runs, and of the model that is estimated.
    """

    process_noise: bool = False
    heading: Literal["auto", "input", "output"] = "auto"
    wind: Role = "input"
    loss: Loss = "gaussian"
    shooting: Shooting = "auto"
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    priors: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    damping: Damping = "warn"
    covariance: Covariance = "cluster"
    weights: Weights = "noise"
    search: bool = True
    starts: Literal["free", "measured"] = "free"
    levels: bool = True
    tolerance: float = TOLERANCE
    seed: int = 0
    integrator: Integrator = "euler"


@known_keywords
@one_thread()
def estimate_oe(
    predictor: Predictor,
    logs: Logs,
    *,
    start: Array | Estimate | None = None,
    options: OutputErrorOptions = OutputErrorOptions(),
) -> Estimate:
    """Fit free runs to logs, or maximise the likelihood of their innovations.

    Parameters
    ----------
    predictor : Predictor
        Of `output_predictor`.
    logs : TrialLog or sequence of TrialLog
        One experiment each, with an initial state of its own.
    start : ndarray or Estimate, optional
        (p,) parameters of the structure, or an estimate such as that of IV. By
        default zero: a filter finds the way from there.
    options : OutputErrorOptions

    Returns
    -------
    Estimate
        ``status`` says how the iteration ended; ``current`` holds the means.

    Raises
    ------
    ExcitationError
        A combination of parameters leaves the run unchanged, or the log is too
        short for the unknowns.
    LogError
        A channel is missing, or sample times differ.
    UsageError
        A bound or prior names no parameter, or cannot hold.

    References
    ----------
    Ljung (1999), sections 7.2-7.4 and 9.4; Åström (1980).
    """
    logs = as_segments(logs)
    fitted = _fit(predictor, logs, start, options)
    if not (np.isfinite(fitted.fit.cost) and fitted.bounded):
        raise ExcitationError(
            f"the free run of {predictor.structure.name} diverges from this start: give "
            f"a stable model with --nominal, a smaller structure, or --method iv."
        )
    return _result(fitted, logs, options)


@dataclass(frozen=True)
class _Fitted:
    """A model with its data and where its fit ended."""

    model: OutputModel
    data: Sequence[Measured]
    fit: ShootingFit
    runs: FreeRuns | FilterRuns
    restrictions: Restrictions
    loss: Loss

    @property
    def sigma(self) -> Array:
        """Noise of each output that weighs the free run, (ny,)."""
        runs = self.runs
        return (
            runs.sigma
            if isinstance(runs, FreeRuns)
            else np.sqrt(runs.noise[: len(self.model.outputs)])
        )

    @property
    def bounded(self) -> bool:
        """Whether the run and all its derivatives are finite numbers."""
        at = self.runs.linearise(self.fit.p, self.fit.nodes)
        return bool(np.isfinite(at.r).all() and (np.abs(at.rows) < _LARGEST).all())

    @cached_property
    def rows(self) -> list[tuple[Array, Array]]:
        """Derivatives (q, N, ny) without the first state's, and residuals (N, ny), a log."""
        q, ny = len(self.fit.p), len(self.model.outputs)
        whole = log_rows(self.runs.linearise(self.fit.p, self.fit.nodes), self.runs.segments, q)
        return [(without_start(e, q).reshape(q, -1, ny), r.reshape(-1, ny)) for e, r in whole]

    @cached_property
    def hessian(self) -> Array:
        """Σ E Eᵀ over the samples whose loss is quadratic, with the priors, (q, q)."""
        total = np.diag(self.restrictions.precision)
        for e, r in self.rows:
            counted = e * (loss_weights(r, self.loss) >= 1.0)
            total = total + counted.reshape(len(e), -1) @ e.reshape(len(e), -1).T
        return total

    @cached_property
    def slow(self) -> dict[str, tuple[float, float]]:
        """How much errors wander and with which p-value, by output."""
        z, p = slow_errors([e for e, _ in self.rows], self.hessian, [r for _, r in self.rows])
        pairs = [(float(a), float(b)) for a, b in zip(z, p, strict=True)]
        return dict(zip(self.model.outputs, pairs, strict=True))


def _fit(
    predictor: Predictor,
    logs: Sequence[TrialLog],
    start: Array | Estimate | None,
    options: OutputErrorOptions,
) -> _Fitted:
    sample_time = common_sample_time(logs)

    # other optima are sought by likelihood
    near = not options.search or (options.weights == "deviation" and start is not None)

    def free_run(heading: Role, p: Array | None = None, *, once: bool = False) -> _Fitted:
        model = output_model(predictor, sample_time, heading, options.wind, options.integrator)
        data = [measured(model, log) for log in logs]
        _require_rows(model, data)
        restrictions = _restrictions(model, options)
        fit, runs = fit_free_runs(
            model, data, _first(model, start) if p is None else p,
            restrictions=restrictions, loss=options.loss, shooting=options.shooting,
            sigma=deviations(data) if options.weights == "deviation" else None,
            near=p is not None or near, once=once, fixed=options.starts == "measured",
            tolerance=options.tolerance,
        )  # fmt: skip
        return _Fitted(model, data, fit, runs, restrictions, options.loss)

    def holds(compared: _Fitted) -> bool:
        if not (compared.fit.converged and np.isfinite(compared.fit.cost)):
            return False
        return options.process_noise or all(compared.slow[n][0] < _DRIFTS for n in ("r", "psi"))

    def suited() -> _Fitted:
        compare = turns(predictor.structure, logs)
        if compare and options.shooting != "multiple":
            # a run that leaves what sensors leave, heading and all, needs no other beside it
            found = free_run("output", once=True)
            if holds(found) and not in_doubt(found.fit, found.sigma, changes(found.data)):
                return found
        found = free_run("input")
        if compare and found.fit.converged:
            compared = free_run("output", found.fit.p)
            if holds(compared):
                return compared
        return found

    if options.heading != "auto":
        found = free_run(options.heading)
    elif options.weights == "deviation" or not options.search:
        found = free_run("input")
    else:
        found = suited()
    if not options.process_noise:
        return found
    fit, runs = fit_innovations(
        found.model, found.data, found.fit.p, restrictions=found.restrictions
    )
    return _Fitted(found.model, found.data, fit, runs, found.restrictions, "gaussian")


def _require_rows(model: OutputModel, data: Sequence[Measured]) -> None:
    rows = sum(int(d.known.sum()) for d in data)
    unknown = len(model.parameters) + len(data) * len(model.states)
    most = _ROWS * unknown
    if rows <= most or min(int(d.known.sum()) for d in data) < 3:
        raise ExcitationError(
            f"{so_many(rows, 'sample')} and {so_many(unknown, 'unknown')} (parameters, "
            f"disturbance means and initial "
            f"states): more than {most} samples, and 3 in each log, are needed. Use a longer log "
            f"or a smaller structure."
        )


def _first(model: OutputModel, start: Array | Estimate | None) -> Array:
    predictor = model.predictor
    p = np.zeros(len(model.parameters))
    if start is None:
        return p
    known: dict[str, float] = {}
    values: dict[str, float] = {}
    if isinstance(start, Estimate):
        values = turn_of_water(model.sample_time)
        theta = start.structure_theta()
        names = start.predictor.structure.parameters
        known = {n: value for n, value, _ in start.current}
    else:
        theta, names = np.asarray(start, float), predictor.structure.parameters
    values |= dict(zip(names, theta, strict=True))
    for i in predictor.parameter_columns:
        p[i] = values.get(predictor.columns[i].terms[0], 0.0)
    for i, name in enumerate(model.means):
        p[len(predictor.columns) + i] = known.get(name, 0.0)
    return p


def _restrictions(model: OutputModel, options: OutputErrorOptions) -> Restrictions:
    predictor = model.predictor
    q = len(model.parameters)
    names = {predictor.columns[i].name: i for i in predictor.parameter_columns}
    names |= {n: len(predictor.columns) + i for i, n in enumerate(model.means)}
    low, high = np.full(q, -np.inf), np.full(q, np.inf)
    for i, name in enumerate(model.means):
        most = _STRONGEST[name in WIND]
        low[len(predictor.columns) + i], high[len(predictor.columns) + i] = -most, most
    for name, (least, most) in turn_bounds(model.sample_time).items():
        if name in names:
            low[names[name]], high[names[name]] = least, most
    mean, precision = np.zeros(q), np.zeros(q)

    def place(name: str, what: str) -> int:
        if name not in names:
            raise UsageError(
                f"the {what} names '{name}', which is not estimated."
                f"{suggestion(name, names)} Estimated are: {', '.join(names)}."
            )
        return names[name]

    if options.damping == "enforce":
        structure = predictor.structure
        for i in predictor.parameter_columns:
            if all(structure.terms[structure.index(t)].dissipates
                   for t in predictor.columns[i].terms):  # fmt: skip
                high[i] = 0.0
    for name, (least, most) in options.bounds.items():
        if not least < most:
            raise UsageError(
                f"the bounds of {name} are {least:g} and {most:g}: the first must be the smaller."
            )
        low[place(name, "bound")], high[place(name, "bound")] = least, most
    for name, (value, std) in options.priors.items():
        if not std > 0:
            raise UsageError(f"the prior of {name} has the deviation {std:g}, it must be positive.")
        i = place(name, "prior")
        mean[i], precision[i] = value, 1 / std**2
    return Restrictions(low, high, mean, precision)


def log_rows(at: Linearised, segments: Segments, q: int) -> list[tuple[Array, Array]]:
    """Return derivatives and residuals of each whole log, segments chained.

    Returns
    -------
    list of tuple
        (q + nz, N·ny) derivatives in the parameters and the log's first state,
        and (N·ny,) residuals, channels of one sample together.
    """
    found = []
    nz = at.rows.shape[2] - q
    link = np.zeros((q + nz, nz))
    rows: list[Array] = []
    residuals: list[Array] = []
    for j in range(len(at.r)):
        if not rows:
            link = np.vstack([np.zeros((q, nz)), np.eye(nz)])
        samples = int(np.flatnonzero(segments.use[j])[-1]) + 1 if segments.use[j].any() else 0
        width = at.r.shape[2]
        used = at.rows[j, : samples * width].T
        own = link @ used[q:]
        own[:q] += used[:q]
        rows.append(own)
        residuals.append(at.r[j, :samples].ravel())
        if segments.joined[j]:
            slope = link @ at.slope[j, :, q:].T
            slope[:q] += at.slope[j, :, :q].T
            link = slope
        else:
            found.append((np.hstack(rows), np.concatenate(residuals)))
            rows, residuals = [], []
    return found


def without_start(rows: Array, q: int) -> Array:
    """Return the part of the parameters' derivatives that the first state cannot imitate.

    Parameters
    ----------
    rows : ndarray
        (q + nz, n) of one log.

    Returns
    -------
    ndarray
        (q, n)
    """
    basis = rows[q:]
    scale = np.sqrt((basis**2).sum(axis=1, keepdims=True))
    left, values, _ = np.linalg.svd(basis / np.where(scale > 0, scale, 1.0), full_matrices=False)
    known = values > 1e-10 * values.max(initial=0.0)
    unit = (left[:, known] / values[known]).T @ (basis / np.where(scale > 0, scale, 1.0))
    return np.asarray(rows[:q] - (rows[:q] @ unit.T) @ unit)


def _result(fitted: _Fitted, logs: Sequence[TrialLog], options: OutputErrorOptions) -> Estimate:
    model, data, fit, runs = fitted.model, fitted.data, fitted.fit, fitted.runs
    predictor, restrictions = model.predictor, fitted.restrictions
    q, ny, nz = len(fit.p), len(model.outputs), len(model.states)
    bound = (fit.p <= restrictions.low + _AT_BOUND) | (fit.p >= restrictions.high - _AT_BOUND)
    _require_known(model, fitted.hessian, bound)
    rows = [e for e, _ in fitted.rows]
    residuals = [loss_weights(r, fitted.loss) * r for _, r in fitted.rows]
    lags = 0
    if options.covariance != "white":
        lags = max(correlation_lags([r[:, i] for r in residuals]) for i in range(ny))
        if not options.process_noise:
            # a weak but long memory stays below every single lag's limit
            lags = max(lags, round(min(len(r) for r in residuals) ** (1 / 3)))
    samples = sum(int(d.known.sum()) for d in data)
    # degrees of freedom, as a regression counts them
    lost = samples * ny / max(samples * ny - q - nz * len(data), 1)
    covariance = _covariance(fitted, rows, residuals, options, lags, bound, lost)
    count = len(predictor.columns)
    means = {n: (fit.p[count + i], covariance[count + i, count + i] ** 0.5)
             for i, n in enumerate(model.means)}  # fmt: skip
    flow = [count + i for i, n in enumerate(model.means) if n in CURRENT]
    status = (
        f"converged after {fit.iterations} iterations"
        if fit.converged
        else f"no longer improved after {fit.iterations} iterations"
    )
    if options.weights == "deviation":
        status += ", errors weighed by the deviation of each output"
    if len(runs.segments.use) > len(data):
        status += (
            f", {len(runs.segments.use)} segments joined within {fit.gap:.1g} noise deviations"
        )
    own = predictor.structure.states
    errors = np.vstack([one_step_errors(model, log, fit.p) for log in data])
    # bridged samples are no errors of a step
    measured_both = np.concatenate([d.known[:-1] & d.known[1:] for d in data])
    errors = errors[measured_both] if measured_both.any() else errors
    notes = []
    ended = zip(model.parameters, fit.p, bound, strict=True)
    held = [f"{name} at {value:.3g}" for name, value, at_bound in ended if at_bound]
    if held:
        notes.append(f"ended at a bound, where no standard error is known: {', '.join(held)}.")
    if "psi" in model.outputs:
        notes.append("the heading was simulated and compared with the measured one.")
    return Estimate(
        predictor=predictor,
        method="oe",
        theta=fit.p[:count],
        covariance=covariance[:count, :count],
        residual_std=np.sqrt((errors**2).mean(axis=0))[: len(own)],
        vessel=logs[0].vessel,
        sample_time=model.sample_time,
        data=estimation_data(logs, own, sum(len(d.y) for d in data), samples),
        covariance_kind=options.covariance,
        lags=lags,
        iteration=Iteration(fit.iterations, status, fit.converged),
        current=tuple((n, float(v), float(s)) for n, (v, s) in means.items() if n in CURRENT),
        current_covariance=covariance[np.ix_([*range(count), *flow], flow)],
        noise=_noise_levels(fitted, logs, options.weights) if options.levels else None,
        notes=tuple(notes),
        integrator=options.integrator,
        tests=(
            *_excitation_tests(model, fitted.hessian, bound),
            *(_slow_tests(fitted.slow) if options.levels and not options.process_noise else ()),
        ),
    )


def _covariance(
    fitted: _Fitted,
    rows: Sequence[Array],
    residuals: Sequence[Array],
    options: OutputErrorOptions,
    lags: int,
    bound: NDArray[np.bool_],
    lost: float,
) -> Array:
    """Return the covariance of parameters and means, (q, q), zero at bounds.

    Parameters
    ----------
    rows, residuals : sequence of ndarray
        (q, N, ny) and (N, ny) per log.
    lags : int
        Memory of the residuals in samples.
    bound : ndarray of bool
        (q,)
    lost : float
        Values over values less what was estimated.
    """
    kind, free = options.covariance, np.flatnonzero(~bound)
    own = [e[free] for e in rows]
    if kind == "bootstrap":
        flat = [e.reshape(len(free), -1) for e in own]
        draws = block_bootstrap(
            [(flat, flat, [r.ravel() for r in residuals])], np.random.default_rng(options.seed),
            block=residuals[0].shape[1] * segment_length([len(r) for r in residuals], lags),
        )  # fmt: skip
        out = np.zeros_like(fitted.hessian)
        out[np.ix_(free, free)] = np.cov(draws.T).reshape(len(free), len(free))
        return out
    base = "ma" if kind == "cluster" else kind
    middle = shared_score_covariance(list(zip(rows, residuals, strict=True)), base, lags) * lost
    prior = np.diag(fitted.restrictions.precision)
    covariance = _sandwich(fitted.hessian, middle + prior, bound)
    if base == "ma" and lags:
        factor = memory_correction(rows, fitted.hessian, residuals, lags)
        covariance *= np.outer(factor, factor)
    if kind == "cluster":
        part = np.ix_(free, free)
        bread = _inverse_hessian(fitted, free, concentrated=options.weights == "noise")
        sums = segment_sums(own, residuals, lags)
        covariance[part] = allow_for_segments(covariance[part], [sums], [bread])
    return covariance


def _inverse_hessian(fitted: _Fitted, free: NDArray[np.intp], *, concentrated: bool) -> Array:
    """Return the inverse Hessian of −log L in the free parameters, (p, p).

    Where residuals hold what the model lacks, their product with the second derivatives of the
    run does not average out, and the information of Gauss and Newton tells too much. The
    Hessian is the change of the score, starts fitted again, over half a standard error to both
    sides: over so much the likelihood of a run is not quadratic either. Of each direction at
    least a fifth of that information stays. For other losses, filtered runs and segments that
    are joined it is that information.

    Parameters
    ----------
    fitted : _Fitted
    free : ndarray of int
        (p,)
    concentrated : bool
        Whether the noise of each output is estimated too.

    References
    ----------
    White (1982), the sandwich of an M-estimate.
    """
    information = fitted.hessian[np.ix_(free, free)]
    plain = scaled_inverse(information)
    runs, fit = fitted.runs, fitted.fit
    if not isinstance(runs, FreeRuns) or fitted.loss != "gaussian" or runs.segments.joined.any():
        return plain
    size = np.sqrt(np.diag(information))
    values, vectors = np.linalg.eigh(information / np.outer(size, size))
    # columns are directions of one standard error
    root = vectors / np.sqrt(np.maximum(values, values[-1] * 1e-15)) / size[:, None]

    def score(step: Array) -> Array:
        p = fit.p.copy()
        p[free] += step
        return _score(runs, p, fit.nodes, concentrated=concentrated)[free]

    steps = _BESIDE * root.T
    ends = np.array([score(step) for step in (*steps, *-steps)])
    change = ((ends[len(steps) :] - ends[: len(steps)]) / (2 * _BESIDE)).T
    hessian = root.T @ change + root.T @ (fitted.restrictions.precision[free, None] * root)
    if not np.isfinite(hessian).all():
        return plain
    curves, axes = np.linalg.eigh((hessian + hessian.T) / 2)
    out = root @ axes
    return np.asarray(out / np.maximum(curves, LEFT) @ out.T)


def _score(runs: FreeRuns, p: Array, nodes: Array, *, concentrated: bool) -> Array:
    """Return the derivatives of log L (q,) at parameters, with the likeliest starts."""
    q = len(p)
    at = runs.linearise(p, nodes)
    if not runs.fixed and np.isfinite(at.r).all():
        residuals = at.r.reshape(len(nodes), -1)
        starts = [
            np.linalg.lstsq(e[:, q:], r, rcond=1e-10)[0]
            for e, r in zip(at.rows, residuals, strict=True)
        ]
        at = runs.linearise(p, nodes + np.array(starts))
    if not np.isfinite(at.r).all():
        return np.full(q, np.nan)
    level = (at.r**2).sum(axis=(0, 1)) / runs.segments.use.sum() if concentrated else 1.0
    weighted = (at.r / level).reshape(len(nodes), -1)
    return np.asarray(np.einsum("gkq,gk->q", at.rows[:, :, :q], weighted))


def _excitation_tests(
    model: OutputModel, hessian: Array, bound: NDArray[np.bool_]
) -> Iterator[TestResult]:
    """Tell, equation by equation, how well the run determines its weakest parameter and direction.

    The share of a parameter's sensitivity that no other unknown imitates is
    1/(Hᵢᵢ (H⁻¹)ᵢᵢ), the inverse of its variance inflation.
    """
    free = np.flatnonzero(~bound)
    unit, _ = scaled(hessian[np.ix_(free, free)])
    share = 1 / np.diag(scaled_inverse(unit))
    columns = model.predictor.columns
    for state in model.predictor.structure.states:
        mine = [i for i, k in enumerate(free) if k < len(columns) and columns[k].state == state]
        if not mine:
            continue
        values, vectors = np.linalg.eigh(unit[np.ix_(mine, mine)])
        ratio = float(np.sqrt(max(values[0] / values[-1], 0.0)))
        size = np.abs(vectors[:, 0])
        names = [model.parameters[free[mine[i]]] for i in np.argsort(-size) if size[i] > _SHOWN]
        least = mine[int(np.argmin(share[mine]))]
        passed = ratio >= _WEAK
        found = (
            f"every combination of the parameters is determined, the weakest is of "
            f"{', '.join(names)}"
            if passed
            else f"the combination of {', '.join(names)} is weakly determined: change what "
            f"these parameters multiply separately"
        )
        yield TestResult(
            "excitation",
            "the sensitivities of the run are independent",
            ratio,
            None,
            f"smallest relative singular value {ratio:.1e} ({_WEAK:.0e} is needed): {found}. "
            f"The sensitivity to {model.parameters[free[least]]} is imitated best by those to the "
            f"others, all of it but {float(share[least]):.1e}.",
            _WEAK,
            passed,
            tuple(names),
            {"own_share": {model.parameters[free[i]]: float(share[i]) for i in mine}},
            state=state,
        )


def _slow_tests(slow: Mapping[str, tuple[float, float]]) -> Iterator[TestResult]:
    for name, (z, p) in slow.items():
        found = (
            "wanders more than a fit to white noise would: something that the model lacks moves "
            "the ship; the standard errors allow for it, and --process-noise estimates with it."
            if p <= _WANDERS
            else "shows no slow part beyond noise."
        )
        yield TestResult(
            "slow_errors",
            f"the free-run error of {name} is white: nothing that the model lacks moves it",
            z,
            p,
            f"the free-run error of {name} {found}",
            state=name,
        )


def _require_known(model: OutputModel, hessian: Array, bound: NDArray[np.bool_]) -> None:
    free = np.flatnonzero(~bound)
    scale = np.sqrt(np.maximum(np.diag(hessian)[free], 0.0))
    names = [model.parameters[i] for i in free]

    def require_parameter(column: int) -> None:
        columns = model.predictor.columns
        if column < len(columns) and columns[column].is_bias:
            raise UnexcitedBiasError(column, model.parameters[column])

    if not (scale > 0).all():
        lost = [
            model.predictor.columns[i].name if i < len(model.predictor.columns) else n
            for i, n, s in zip(free, names, scale, strict=True)
            if not s > 0
        ]
        require_parameter(int(free[np.argmin(scale)]))
        raise ExcitationError(
            unexcited(
                model.predictor.structure,
                lost,
                f"without {'them' if len(lost) > 1 else 'it'} the run of the whole log is the same",
            )
        )
    unit, _ = scaled(hessian[np.ix_(free, free)])
    values, vectors = np.linalg.eigh((unit + unit.T) / 2)
    if values[0] > UNKNOWN * values[-1]:
        return
    size = np.abs(vectors[:, 0])
    involved = [names[i] for i in np.argsort(-size) if size[i] > 0.2]
    for i in np.argsort(-size):
        if size[i] > _SHARES:
            require_parameter(int(free[i]))
    raise ExcitationError(
        f"{', '.join(involved)} cannot be told apart by the free run (relative eigenvalue "
        f"{max(values[0] / values[-1], 0):.1e}, needs {UNKNOWN:.0e}): excite them separately, "
        f"leave one out, or give one a prior (--prior NAME=VALUE:STD)."
    )


def _sandwich(hessian: Array, middle: Array, bound: NDArray[np.bool_]) -> Array:
    free = np.flatnonzero(~bound)
    part = np.ix_(free, free)
    inverse = scaled_inverse(hessian[part])
    out = np.zeros_like(hessian)
    out[part] = inverse @ middle[part] @ inverse
    return (out + out.T) / 2


def one_step_errors(model: OutputModel, log: Measured, p: Array) -> Array:
    """Return the measured next states less those predicted from measured ones, (N−1, nz)."""
    nz = len(model.states)
    _, end = Simulator(model, log.w[:-1, None])(log.y[:-1, :nz], p)
    return np.asarray(log.y[1:, :nz] - end)


def _noise_levels(fitted: _Fitted, logs: Sequence[TrialLog], weights: Weights) -> NoiseLevels:
    model, runs = fitted.model, fitted.runs
    states = model.predictor.structure.states
    if isinstance(runs, FilterRuns):
        variances, source = runs.noise, "likelihood of the innovations"
    else:
        if weights == "deviation":
            runs = residual_noise(runs, fitted.fit.p, fitted.fit.nodes, fitted.loss)
        found = (
            noise_of_run(runs, fitted.fit.p, fitted.fit.nodes, logs)
            if fitted.loss == "gaussian"
            else noise_of_sensors(runs)
        )
        model, variances, source = found
    ny = len(model.outputs)
    sigma, process = np.sqrt(variances[:ny]), np.sqrt(variances[ny:])
    seen = dict(zip(model.outputs, sigma, strict=True))
    return NoiseLevels(
        states,
        np.array([seen[s] for s in states]),
        process[: len(states)],
        float(seen.get("psi", 0.0)),
        float(seen.get("u_q", 0.0)),
        source,
    )
