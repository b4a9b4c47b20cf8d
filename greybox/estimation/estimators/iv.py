"""Instrumental variables, refined by a noise model where the tests allow it: ``--method iv``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from greybox.estimation.registry import Estimator

if TYPE_CHECKING:
    from greybox.estimation.gls_regression import WhiteEquations
    from greybox.estimation.problem import EstimationProblem, Fitted
    from greybox.estimation.result import Estimate
    from greybox.estimation.solve import Solved
    from greybox.model.predictor import Predictor

# process noise, in deviations of the measurements, from which on it counts
_PUSHED = 0.05


def _fit(problem: EstimationProblem) -> Fitted:
    from greybox.estimation.closed_loop import CLOSED_LOOP_LAG
    from greybox.estimation.problem import Fitted
    from greybox.estimation.solve import solve_iv
    from greybox.regression.instruments import WIND_WINDOW
    from greybox.regression.problem import RegressionProblem

    closed, _ = problem.loop_test("iv")
    lag = CLOSED_LOOP_LAG if closed else 0
    wind = problem.instrument_wind

    def plain(predictor: Predictor) -> Solved:
        regression = RegressionProblem(
            predictor, problem.logs, margins=problem.margins, zero_mean=problem.zero_mean,
            heading=problem.heading, wind=wind, lag=lag,
        )  # fmt: skip
        return solve_iv(regression, start=problem.nominal_theta, refine=problem.refine)

    def finish(solved: Solved, notes: list[str]) -> Fitted:
        estimate, white = _prefiltered(solved, problem, closed, notes)
        if problem.kind.air_measured:
            notes.append(
                f"the wind in the instruments is the measured one averaged over {WIND_WINDOW:g} s, "
                f"because its sensor is noisy; terms that only faster gusts would "
                f"determine stay uncertain."
                if wind == "smoothed"
                else "the instruments hold the measured wind as it is: if its sensor is noisy, the "
                "wind terms are biased towards zero and, in a nearly steady wind, the current with "
                "them. State wind_std in [sensors], and the wind is averaged."
            )
        return Fitted(estimate, solved.problem, white=white)

    predictor = problem.predictor(intercept=not problem.zero_mean)
    return problem.fit_regression("iv", predictor, plain, finish)


def _prefiltered(
    solved: Solved,
    problem: EstimationProblem,
    closed: bool,
    notes: list[str],
) -> tuple[Estimate, WhiteEquations | None]:
    """Refine a plain IV estimate by its noise, unless something speaks against it.

    Raises
    ------
    UsageError
        The problem asks for what zero-mean, undelayed instruments only can do.
    ExcitationError
        The refinement that the problem asks for fails.
    """
    from greybox.errors import ExcitationError, OutOfTimeError, UsageError
    from greybox.estimation.refined import add_noise, refine_by_noise
    from greybox.numerics.effort import optional

    kind = problem.covariance or "cluster"
    against = ""
    if closed:
        against = "instruments are delayed for the closed loop, which a prefilter would undo"
    elif not problem.zero_mean:
        against = "instruments keep their mean"
    if problem.prefilter == "noise" and against:
        raise UsageError(
            f"--prefilter noise needs open loop and zero-mean instruments, and {against}: "
            f"use --prefilter none."
        )
    if problem.prefilter != "none" and not against:
        try:
            # standard errors of the plain estimate would be those of another one
            plain = solved.estimate(None)
            with optional():
                refined, white = refine_by_noise(solved.problem, plain, kind, problem.seed)
            if problem.prefilter == "noise":
                return refined, white
            mixed = solved.problem.wind == "measured" and _pushed_through_air(refined)
            if problem.stays_bounded(refined) and not mixed:
                return refined, white
            against = (
                "something that the model lacks moves the ship, and the measured wind, which holds "
                "that motion, would be mixed into its neighbours (give wind_std in [sensors])"
                if mixed
                else "the free run of the refined model diverges"
            )
        except ExcitationError as error:
            if problem.prefilter == "noise":
                raise
            against = str(error).rstrip(".")
        except OutOfTimeError:
            if problem.prefilter == "noise" or not problem.judged:
                raise
            against = "time was too short for it (--effort)"
    if against and problem.prefilter == "auto":
        notes.append(f"the instruments were not refined by the noise: {against}.")
    plain = solved.estimate(kind, problem.seed)
    return add_noise(solved.problem, plain) if problem.judged else plain, None


def _pushed_through_air(estimate: Estimate) -> bool:
    """Whether process noise is in the measured velocity through the air of the instruments."""
    noise = estimate.noise
    if noise is None or not estimate.predictor.air_measured:
        return False
    return bool((noise.process > _PUSHED * noise.measurement).any())


ENTRY = Estimator(
    "iv",
    "instrumental variables",
    _fit,
    instruments=True,
    ended="instruments: {status}.",
    unconverged="so the standard errors may be too small: 95 % intervals of such estimates held "
    "91 % of the true values in simulated trials",
    closed_loop="so instruments are delayed by {lag} samples; that removes the dependence on "
    "measurement noise, not on slow gusts. ",
    order=1,
)
