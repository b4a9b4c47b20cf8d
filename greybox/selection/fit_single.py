"""One estimate by a given method, predictor and structure, with its tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from greybox.credibility.judge import run_tests
from greybox.credibility.verdict import weigh
from greybox.estimation.covariance import Covariance
from greybox.estimation.informative import require_informative
from greybox.estimation.problem import EstimationOptions, EstimationProblem, Fitted
from greybox.estimation.registry import ESTIMATORS
from greybox.estimation.result import Estimate
from greybox.estimation.solve import Solved, solve_iv, solve_ls
from greybox.model.predictor import Predictor
from greybox.model.predictor_kinds import PREDICTORS
from greybox.model.structure import Structure
from greybox.numerics.effort import require_time
from greybox.numerics.threads import one_thread
from greybox.public import known_keywords
from greybox.regression.problem import RegressionProblem
from greybox.selection.request import Request
from greybox.trial.log import Logs, TrialLog
from greybox.trial.segments import as_segments

Array = NDArray[np.float64]


@known_keywords
@one_thread()
def estimate_ls(
    predictor: Predictor,
    logs: Logs,
    *,
    margins: dict[str, float] | None = None,
    covariance: Covariance = "cluster",
    seed: int = 0,
    judged: bool = True,
) -> Estimate:
    """Estimate the parameters by least squares, experiments pooled.

    Parameters
    ----------
    predictor : Predictor
        With an intercept where it is augmented: only zero-mean instruments
        remove the constants that its derivation leaves out.
    logs : TrialLog or sequence of TrialLog
        One experiment each.
    margins : dict of str to float, optional
        Rows with |state| below are left out (Remark 4.2) [m/s, rad/s].
    covariance : {"cluster", "hac", "ma", "white", "bootstrap"}
        ``cluster``: the larger of ``hac`` and of the spread of the scores between segments
        of the logs (CR2, Student's t). Regressors that hold the noise rule ``ma`` out.
    seed : int
        For the bootstrap.
    judged : bool
        Test the estimate and give a verdict; an estimate among many does without.

    Returns
    -------
    Estimate
        Biased by measurement noise in the regressors, however long the log.

    Raises
    ------
    ExcitationError
        Some direction is not excited; its parameters are named.

    References
    ----------
    Ljungberg (2020), eq. 2.17.
    """
    problem = RegressionProblem(
        predictor, tuple(as_segments(logs)), margins=margins, zero_mean=False
    )
    return _estimate(solve_ls(problem), covariance, seed, judged)


@known_keywords
@one_thread()
def estimate_iv(
    predictor: Predictor,
    logs: Logs,
    *,
    start: Array | Estimate | None = None,
    zero_mean: bool = True,
    refine: bool | int = True,
    heading: Literal["measured", "simulated"] = "measured",
    wind: Literal["smoothed", "measured"] = "smoothed",
    lag: int = 0,
    margins: dict[str, float] | None = None,
    covariance: Covariance = "cluster",
    metric: str = "moments",
    seed: int = 0,
    judged: bool = True,
) -> Estimate:
    """Estimate the parameters by instrumental variables, experiments stacked (4.5).

    Parameters
    ----------
    predictor : Predictor
    logs : sequence of TrialLog
        One experiment each.
    start : ndarray or Estimate, optional
        (p,) parameters of the structure that simulate the first instruments: a
        nominal model. By default the least-squares estimate (4.60).
    zero_mean : bool
        Remove each instrument's mean in each experiment (4.63): IV2. Kept: IV1.
    refine : bool or int
        Simulate the instruments again from each estimate until it stops moving,
        or as many times at most.
    heading : {"measured", "simulated"}
        Heading in the instruments.
    wind : {"smoothed", "measured"}
        Wind in the instruments, as `build_instruments`.
    lag : int
        Delay of the instruments in samples, for logs in closed loop.
    covariance : {"cluster", "ma", "hac", "white", "bootstrap"}
        ``ma``, C = G⁻¹ (Σ Z R Zᵀ) G⁻ᵀ: the equation error is a moving average and the
        instruments are independent of it. ``cluster`` is that, or more where the scores
        differ more between segments of the logs, as they do where the structure is only
        nearly right. ``hac`` where the noise changes its size along the log.
    margins, seed, judged
        As `estimate_ls`.
    metric : {"moments", "identity"}
        How the stacked equations of several experiments are weighted.

    Returns
    -------
    Estimate
        ``status`` says whether the refinement converged. Where an instrument
        simulation diverges, the step is halved. Where that does not help, or the
        estimates never settle, an estimate spoils the model of the next instruments:
        the one whose instruments explain most of the regressors is returned.

    Raises
    ------
    ExcitationError
        Some direction is not excited, or even the first simulation diverges.
    UsageError
        Instruments keep their mean and the augmented predictor has no constant.

    References
    ----------
    Ljungberg (2020), eqs. 2.21, 4.5, 4.60-4.63; Young (2008).
    """
    problem = RegressionProblem(
        predictor, tuple(as_segments(logs)), margins=margins, zero_mean=zero_mean,
        heading=heading, wind=wind, lag=lag,
    )  # fmt: skip
    solved = solve_iv(problem, start=start, refine=refine, metric=metric)
    return _estimate(solved, covariance, seed, judged)


def _estimate(solved: Solved, covariance: Covariance, seed: int, judged: bool) -> Estimate:
    """Return the estimate of solved equations, with tests and verdict where they are asked for."""
    estimate = solved.estimate(covariance, seed)
    if not judged:
        return estimate
    estimate = run_tests(Fitted(estimate, solved.problem, solved))
    verdict = weigh(
        estimate.tests, estimate.labels, estimate.method,
        contaminated=estimate.predictor.contaminated,
    )  # fmt: skip
    return replace(estimate, verdict=verdict)


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
    OutOfTimeError
        The seconds that it was given are over.
    UsageError
        There is no such method.
    """
    require_time()
    estimator, predictor = ESTIMATORS[method], PREDICTORS[kind]
    require_informative(logs, predictor, structure)
    asked = {f.name: getattr(request, f.name) for f in fields(EstimationOptions)}
    fitted = estimator.fit(EstimationProblem(tuple(logs), structure, predictor, start, **asked))
    return run_tests(fitted) if request.judged else fitted.estimate
