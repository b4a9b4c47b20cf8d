"""Refined instrumental variables: one solve of all equations with the error made white.

The error of (4.3) is a moving average, so a sum over unfiltered samples weighs
what nearly cancels as if it did not. With Ω its covariance, the optimal
instruments are Ω⁻¹ times the noise-free regressors, θ̂ = (Zᵀ Ω⁻¹ Φ)⁻¹ Zᵀ Ω⁻¹ y
(Söderström and Stoica, 1983; Young, 2008).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from greybox.errors import ExcitationError
from greybox.estimation.banded_covariance import ErrorBand
from greybox.estimation.covariance import Covariance
from greybox.estimation.disturbance import estimate_current
from greybox.estimation.gls_regression import (
    WhiteEquations,
    WhiteRows,
    own_constants,
    solve_white,
    spread_columns,
    white_covariance,
    white_rows,
)
from greybox.estimation.noise import (
    ErrorLikelihood,
    NoiseFit,
    first_levels,
    fit_noise,
    noise_levels_of,
    on_stretches,
    stated_levels,
)
from greybox.estimation.registry import ESTIMATORS
from greybox.estimation.result import Estimate
from greybox.estimation.solve import solve_iv, solve_ls
from greybox.estimation.values import Iteration
from greybox.estimation.verdict import UNJUDGED
from greybox.model.predictor import Predictor
from greybox.numerics.banded import factor_band
from greybox.numerics.effort import require_time
from greybox.numerics.threads import one_thread
from greybox.public import known_keywords
from greybox.regression.motion import Motion, further_channels, predicted_motion, smoothed_heading
from greybox.regression.problem import RegressionProblem
from greybox.regression.regression import measured_rows, within_margins
from greybox.trial.log import Logs, TrialLog
from greybox.trial.segments import as_segments

Array = NDArray[np.float64]

# a coefficient has settled when it moves by less than this share of its standard error
_SETTLED = 1e-2
_RELATIVE = 1e-6
_MOST = 30
# share of the increments' spread below which errors are rounding
_EXACT = 1e-6
# memory of process noise over a sample where the other kind is tried
_SLOW = 0.9
# standard errors over which derivatives of the motion are taken
_STEP = 0.1
# rounds after which the noise is settled at the latest
_NOISE_ROUNDS = 6

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Point:
    """Coefficients (p,), the constants (nx,) of each log, and the motions that they predict."""

    theta: Array
    constants: tuple[Array, ...]
    motions: tuple[Motion, ...]

    @property
    def diverged(self) -> int:
        """Position of the first log whose motion left its bound, −1 where none did."""
        return next((i for i, m in enumerate(self.motions) if m.diverged >= 0), -1)


class _Refinement:
    """What the rounds share: the regression, and how a motion is predicted."""

    def __init__(self, problem: RegressionProblem) -> None:
        self.predictor = problem.predictor
        self.logs = problem.logs
        self._heading, self._wind = problem.heading, problem.wind
        self.phi = [e.phi for e in problem.regression.experiments]
        self.y = [e.y for e in problem.regression.experiments]

    def point(self, theta: Array, constants: Sequence[Array]) -> _Point:
        motions = [
            self._motion(log, theta, own) for log, own in zip(self.logs, constants, strict=True)
        ]
        return _Point(theta, tuple(constants), tuple(motions))

    def _motion(self, log: TrialLog, theta: Array, constants: Array) -> Motion:
        structure = self.predictor.structure
        states = structure.states
        smoothed = structure.turns and self._heading == "measured"
        found = predicted_motion(
            self.predictor, log, theta, constants, heading=self._heading, wind=self._wind,
            states_only=smoothed,
        )  # fmt: skip
        if not smoothed or found.diverged >= 0:
            return found
        # a measured heading is no instrument for itself: its noise is the regressors' too
        turning = found.x[:, states.index("r")]
        course = smoothed_heading(log["psi"][:-1], turning, log.sample_time)
        return predicted_motion(
            self.predictor, log, theta, constants, heading="measured", wind=self._wind,
            course=course,
        )  # fmt: skip

    def errors(self, theta: Array) -> list[Array]:
        """Return y − Φᵀθ of each log, (N, nx)."""
        equations = [self.predictor.equation(s) for s in self.predictor.structure.states]
        return [
            np.stack([y[i] - theta[mine] @ phi[mine] for i, mine in enumerate(equations)], axis=1)
            for phi, y in zip(self.phi, self.y, strict=True)
        ]

    def constants(self, theta: Array, keep: Sequence[NDArray[np.bool_]]) -> list[Array]:
        """Return the mean error of each equation and log where it has a constant of its own."""
        own = np.array(own_constants(self.predictor))
        return [
            np.where(own, e[k].mean(axis=0), 0.0) if k.any() else np.zeros(len(own))
            for e, k in zip(self.errors(theta), keep, strict=True)
        ]

    def towards(self, target: Array, constants: Sequence[Array], bounded: _Point) -> _Point:
        """Return the point at `target`, or one halfway to it whose motions stay bounded."""
        point = self.point(target, constants)
        for _ in range(4):
            if point.diverged < 0:
                break
            means = [(a + b) / 2 for a, b in zip(point.constants, bounded.constants, strict=True)]
            point = self.point((point.theta + bounded.theta) / 2, means)
        return point

    def start(self, theta: Array, keep: Sequence[NDArray[np.bool_]]) -> _Point:
        """Return the point of coefficients, or one between it and their model in still water."""
        bias = np.array([c.is_bias for c in self.predictor.columns])
        none = [np.zeros(len(self.predictor.structure.states))] * len(self.logs)
        still = self.point(np.where(bias, 0.0, theta), none)
        return self.towards(theta, self.constants(theta, keep), still)

    def rows(self, bands: Sequence[ErrorBand], fit: NoiseFit, point: _Point) -> list[WhiteRows]:
        return [
            white_rows(self.predictor, band, fit.noise, motion.z, phi, y)
            for band, motion, phi, y in zip(bands, point.motions, self.phi, self.y, strict=True)
        ]

    def bands(self, point: _Point, keep: Sequence[NDArray[np.bool_]]) -> list[ErrorBand]:
        return [ErrorBand(m.slopes, k) for m, k in zip(point.motions, keep, strict=True)]

    def first_levels(
        self, point: _Point, keep: Sequence[NDArray[np.bool_]], theta: Array
    ) -> NoiseFit:
        stated, further = stated_levels(
            self.logs[0].vessel, self.predictor.structure.states, further_channels(self.predictor)
        )
        return first_levels(self.likelihood(point, keep, theta), stated, further)

    def likelihood(
        self,
        point: _Point,
        keep: Sequence[NDArray[np.bool_]],
        theta: Array,
        *,
        restricted: bool = False,
    ) -> ErrorLikelihood:
        spread = np.concatenate(self.y, axis=1).std(axis=1)
        regressors = None
        if restricted:
            regressors = [spread_columns(self.predictor, m.z) for m in point.motions]
        return ErrorLikelihood(
            self.bands(point, on_stretches(keep)),
            self.errors(theta),
            own_constants(self.predictor),
            _EXACT * spread,
            regressors,
        )


@known_keywords
@one_thread()
def estimate_refined_iv(
    predictor: Predictor,
    logs: Logs,
    *,
    start: Array | Estimate | None = None,
    heading: Literal["measured", "simulated"] = "measured",
    wind: Literal["smoothed", "measured"] = "smoothed",
    margins: dict[str, float] | None = None,
    covariance: Covariance = "cluster",
    seed: int = 0,
) -> Estimate:
    """Estimate the parameters by refined instrumental variables, all equations jointly.

    Instruments, noise levels and coefficients are found in turn, from the plain
    estimate with zero-mean instruments. The instruments are the regressors of the
    motion that the predictor itself predicts, with its bias-capturing terms and
    the constants of each log.

    Parameters
    ----------
    predictor : Predictor
    logs : TrialLog or sequence of TrialLog
        One experiment each, in open loop.
    start : ndarray or Estimate, optional
        A plain IV estimate of the same predictor and logs, or (p,) parameters of the
        structure where that one starts.
    heading, wind, margins, seed
        As `estimate_iv`; a measured heading is smoothed along the predicted yaw rate, so that
        its noise does not stand in the instruments too.
    covariance : {"cluster", "ma", "hac", "white", "bootstrap"}
        ``white`` believes the noise model, which is then as efficient as it says;
        the others allow for innovations that keep some colour.

    Returns
    -------
    Estimate
        ``prefilter`` is ``noise`` and ``noise`` holds the levels. Where a motion
        diverges, the step is halved. Where the rounds do not converge, the estimate of the
        round before their moves grew is given, or the last one with bounded motions, and
        ``status`` says which.

    Raises
    ------
    ExcitationError
        The plain estimate fails, its own prediction diverges, or some direction
        is not excited.

    References
    ----------
    Söderström and Stoica (1983); Young (2008).
    """
    problem = RegressionProblem(
        predictor, tuple(as_segments(logs)), margins=margins, heading=heading, wind=wind
    )
    own = isinstance(start, Estimate) and ESTIMATORS[start.method].instruments
    plain = start if isinstance(start, Estimate) and own else None
    if plain is None:
        plain = solve_iv(problem, start=start).estimate(None)
    return refine_by_noise(problem, plain, covariance, seed)[0]


def refine_by_noise(
    problem: RegressionProblem, plain: Estimate, covariance: Covariance = "cluster", seed: int = 0
) -> tuple[Estimate, WhiteEquations]:
    """Refine a plain estimate of a problem, whose standard errors may be left out.

    Parameters and errors are those of `estimate_refined_iv`; the equations that the refined
    estimate solves are returned with it.
    """
    logs, regression = problem.logs, problem.regression
    work = _Refinement(problem)
    states = problem.predictor.structure.states
    # plain instruments may fail on a short log where refined ones do not
    starts = [lambda: plain.theta, lambda: solve_ls(problem).theta]
    found = _from_a_start(work, starts, problem.keep, problem.margins)
    theta, kept = found.theta, sum(b.rows for b in found.bands)
    matrix, lags = white_covariance(
        found.rows,
        found.bands,
        theta,
        found.inverse,
        covariance,
        samples=[len(k) for k in found.keep],
        seed=seed,
        change=_change(work, found) if covariance == "cluster" else None,
    )
    if covariance == "cluster":
        # of two ways to weigh that would agree if the model held, either might have been taken
        half = (_by_other_memory(work, found) - theta) / 2
        factor = np.sqrt(1 + half**2 / np.diag(matrix))
        matrix = matrix * np.outer(factor, factor)
    vessel = logs[0].vessel
    estimate = replace(
        plain,
        theta=theta,
        covariance=matrix,
        residual_std=_spread(work.errors(theta), found.keep),
        data=replace(plain.data, kept=kept),
        covariance_kind=covariance,
        lags=lags,
        iteration=Iteration(
            plain.iterations + found.rounds,
            found.status,
            found.converged,
            "prefiltered by the noise, ",
        ),
        current=estimate_current(
            problem.predictor,
            theta,
            matrix,
            heading_std=vessel.std("psi") or 0.0,
            heading_measured=problem.heading == "measured",
        ),
        # those of the plain estimate say nothing of this one
        tests=(),
        verdict=UNJUDGED,
        prefilter="noise",
        noise=noise_levels_of(found.fit, states, vessel, regression.sample_time),
    )
    return estimate, WhiteEquations(tuple(found.rows), found.inverse, len(states))


@dataclass(frozen=True)
class _Refined:
    """Where the rounds ended."""

    theta: Array
    inverse: Array
    rows: list[WhiteRows]
    bands: list[ErrorBand]
    fit: NoiseFit
    rounds: int
    status: str
    converged: bool
    keep: Sequence[NDArray[np.bool_]]


def _from_a_start(
    work: _Refinement,
    starts: Sequence[Callable[[], Array]],
    keep: Sequence[NDArray[np.bool_]],
    margins: Mapping[str, float] | None,
) -> _Refined:
    """Return where the rounds ended from the first start that they converge from.

    Where they converge from none, that of the first whose motion stays bounded.

    Raises
    ------
    ExcitationError
        No start predicts a bounded motion, or some direction is not excited.
    """
    states = work.predictor.structure.states
    unfinished: _Refined | None = None
    point: _Point | None = None
    for start in starts:
        theta = start()
        point = work.start(theta, keep)
        if point.diverged >= 0:
            continue
        # rows are cut once, by simulated states, which do not select on the noise
        cut = [
            within_margins(m.x, states, margins) & measured_rows(work.predictor, log)
            for m, log in zip(point.motions, work.logs, strict=True)
        ]
        found = _refine(work, point, theta, cut)
        if found.converged:
            return found
        unfinished = unfinished or found
    if unfinished is not None:
        return unfinished
    assert point is not None
    log, motion = work.logs[point.diverged], point.motions[point.diverged]
    raise ExcitationError(
        f"the motion that the estimate predicts for '{log.name}' left its bound at sample "
        f"{motion.diverged} of {len(log)}: estimate without --prefilter."
    )


def _refine(
    work: _Refinement, point: _Point, theta: Array, keep: Sequence[NDArray[np.bool_]]
) -> _Refined:
    """Find noise, coefficients and motions in turn until the coefficients settle."""
    status, given = f"had not converged after {_MOST} rounds", ""
    fit = work.first_levels(point, keep, theta)
    settling, settled, converged = False, False, False
    nearest: tuple[float, _Refined] | None = None
    apart = False
    for rounds in range(1, _MOST + 1):
        require_time()
        bands = work.bands(point, keep)
        if settling:
            # errors of coefficients that are still far off would decide wrongly, and were the
            # noise sought in every round the two would chase each other
            fit, settled = fit_noise(work.likelihood(point, keep, theta), fit), True
            if fit.remembers:
                # slow noise looks like slow regressors, which take much of it
                fit = work.likelihood(point, keep, theta, restricted=True).fit(fit)[0]
        elif rounds > 1 and not settled:
            fit = work.likelihood(point, keep, theta).fit(fit)[0]
        rows = work.rows(bands, fit, point)
        new, inverse = solve_white(rows)
        if not np.isfinite(new).all():
            raise ExcitationError(
                f"the prefiltered instruments of {len(new)} coefficients are singular on "
                f"{sum(b.rows for b in bands)} samples: estimate without --prefilter, or leave "
                f"out what is weakly determined."
            )
        spread = inverse @ np.sum([r.z @ r.z.T for r in rows], axis=0) @ inverse.T
        std = np.sqrt(np.maximum(np.diag(spread), 0.0))
        moved, rounding = np.abs(new - theta), _RELATIVE * np.abs(theta)
        # a halfway motion settles too, but is not that of an estimate
        halfway = point.theta is not theta
        theta = new
        move = float((moved / np.maximum(std, 1e-300)).max())
        _log.debug("refinement %d: largest move %.3g standard errors", rounds, move)
        if settled and not apart:
            apart = nearest is not None and move > nearest[0]
            if not apart:
                nearest = move, _Refined(theta, inverse, rows, bands, fit, rounds, "", False, keep)
        near = not halfway and bool((moved < std + rounding).all())
        settling = not settled and (near or rounds >= _NOISE_ROUNDS)
        if settled and not halfway and (moved < _SETTLED * std + rounding).all():
            status, converged = f"converged after {rounds} rounds", True
            break
        following = work.towards(theta, work.constants(theta, keep), point)
        if following.diverged >= 0:
            status = (
                f"stopped after {rounds} rounds: the motion predicted for "
                f"'{work.logs[following.diverged].name}' diverges"
            )
            given = "; the last estimate with bounded instruments is given"
            break
        point = following
    if apart and not converged and nearest is not None:
        # what follows once the moves grow hangs on the last digit of the logs
        given = f"; the estimate of round {nearest[1].rounds}, before the moves grew, is given"
        return replace(nearest[1], rounds=rounds, status=status + given)
    return _Refined(theta, inverse, rows, bands, fit, rounds, status + given, converged, keep)


def _change(work: _Refinement, found: _Refined) -> Array:
    """Return Σ (∂z/∂θ_j) Ω⁻¹ e in column j, (p, p), by finite differences of the motion."""
    theta, noise = found.theta, found.fit.noise
    equations = [work.predictor.equation(s) for s in work.predictor.structure.states]
    errors = []
    for row, band in zip(found.rows, found.bands, strict=True):
        factor = factor_band(band.covariance(noise))
        assert factor is not None
        errors.append(band.adjoint(factor, noise, row.y - theta @ row.phi))

    def scores(at: Array) -> Array:
        point = work.point(at, work.constants(at, found.keep))
        out = np.zeros(len(at))
        if point.diverged >= 0:
            return out * np.nan
        for motion, band, error in zip(point.motions, found.bands, errors, strict=True):
            for i, mine in enumerate(equations):
                out[mine] += motion.z[mine][:, band.keep] @ error[:, i]
        return out

    still = scores(theta)
    change = np.zeros((len(theta), len(theta)))
    moments = found.inverse @ np.sum([r.z @ r.z.T for r in found.rows], axis=0) @ found.inverse.T
    for j, step in enumerate(_STEP * np.sqrt(np.maximum(np.diag(moments), 0.0))):
        moved = theta.copy()
        moved[j] += step
        slope = (scores(moved) - still) / step if step > 0 else np.zeros(len(theta))
        change[:, j] = np.where(np.isfinite(slope), slope, 0.0)
    return change


def _by_other_memory(work: _Refinement, found: _Refined) -> Array:
    """Return the coefficients with process noise that remembers where it did not, or the reverse.

    Those found where these cannot be solved.
    """
    point = work.point(found.theta, work.constants(found.theta, found.keep))
    if point.diverged >= 0:
        return found.theta
    noise = found.fit.noise
    memory = np.full(len(noise.memory), 0.0 if found.fit.remembers else _SLOW)
    start = replace(
        found.fit, noise=replace(noise, memory=memory), remembers=not found.fit.remembers
    )
    likelihood = work.likelihood(point, found.keep, found.theta)
    if likelihood.exact:
        return found.theta
    other = likelihood.fit(start)[0]
    theta = solve_white(work.rows(found.bands, other, point))[0]
    return theta if np.isfinite(theta).all() else found.theta


def _spread(errors: Sequence[Array], keep: Sequence[NDArray[np.bool_]]) -> Array:
    """Return the standard deviation (nx,) of errors (N, nx) about the mean of each log."""
    kept = [e[k] - e[k].mean(axis=0) for e, k in zip(errors, keep, strict=True) if k.any()]
    return np.asarray(np.concatenate(kept).std(axis=0))


def add_noise(problem: RegressionProblem, estimate: Estimate) -> Estimate:
    """Return a plain estimate of a problem with the noise levels that its equation errors tell.

    Sensors are taken as stated and the process noise as white: errors of plain
    coefficients are too far off to decide more. Without change where the motion
    that the estimate predicts diverges.
    """
    work = _Refinement(problem)
    point = work.start(estimate.theta, problem.keep)
    if point.diverged >= 0:
        return estimate
    fit = work.first_levels(point, problem.keep, estimate.theta)
    levels = noise_levels_of(
        fit,
        estimate.predictor.structure.states,
        problem.logs[0].vessel,
        problem.regression.sample_time,
    )
    return replace(estimate, noise=levels)
