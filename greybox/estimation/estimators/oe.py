"""Output error: the free run fitted to the log, as ``--method oe``."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from greybox.estimation.registry import Estimator

if TYPE_CHECKING:
    from greybox.estimation.problem import EstimationProblem, Fitted
    from greybox.estimation.result import Estimate

# refinements of the instruments where a free-run fit starts
_STARTING_REFINEMENTS = 1


def _fit(problem: EstimationProblem) -> Fitted:
    """Fit free runs, from the nominal model, else from an estimate by IV or least squares."""
    from greybox.errors import UsageError
    from greybox.estimation.output_error import estimate_oe
    from greybox.estimation.output_setup import output_predictor
    from greybox.estimation.problem import Fitted
    from greybox.model.predictor import build_predictor
    from greybox.regression.problem import RegressionProblem

    if problem.margins:
        raise UsageError(
            f"margins cut samples out of a regression, and a free run needs every one: leave "
            f"--margin-{min(problem.margins)} out, or use --method iv."
        )
    options = problem.output_error
    if problem.covariance is not None:
        options = replace(options, covariance=problem.covariance, seed=problem.seed)
    start = problem.nominal_theta if problem.start is None else problem.start
    notes: list[str] = []
    if problem.nominal is not None and problem.nominal_theta is not None:
        start = problem.nominal_theta
        # what an earlier step found has no record
        given = "from the model that was given (--nominal)"
        found = "from where the selection of terms ended"
        notes = [f"the fit started {given if problem.nominal.record else found}."]
    elif problem.start is not None:
        notes = [f"the fit started from the estimate by {problem.start.method}."]
    else:
        start, said = _quick_start(problem)
        notes = [said]
    predictor = problem.less(output_predictor(problem.structure, problem.kind.name, problem.regime))
    estimate, dropped = problem.drop_unexcited(
        predictor, lambda p: estimate_oe(p, problem.logs, start=start, options=options)
    )
    # a free run has the current in the model; a regression captures it by columns
    own = estimate.predictor
    captured = build_predictor(own.structure.estimable(), own.kind, own.regime)
    fitted = Fitted(estimate, RegressionProblem(captured, problem.logs))
    _, loop_test = problem.loop_test("oe")
    return fitted.with_more(loop_test, [*notes, *dropped])


def _quick_start(problem: EstimationProblem) -> tuple[Estimate | None, str]:
    """Return an estimate by IV, else by least squares, that a free-run fit can start from.

    Bias-capturing terms are left out: the fit finds the current by itself.
    """
    from greybox.errors import DivergenceError, ExcitationError
    from greybox.estimation.solve import solve_iv, solve_ls
    from greybox.model.predictor import build_predictor
    from greybox.regression.problem import RegressionProblem

    predictor = build_predictor(problem.structure.estimable(), problem.kind.plain, problem.regime)
    regression = RegressionProblem(predictor, problem.logs)
    try:
        found = solve_iv(regression, refine=_STARTING_REFINEMENTS).estimate("white")
        return found, "the fit started from an estimate by instrumental variables."
    except (ExcitationError, DivergenceError):
        pass
    try:
        return solve_ls(regression).estimate(
            "white"
        ), "the fit started from the least-squares estimate."
    except ExcitationError:
        return None, "the fit had no estimate to start from."


ENTRY = Estimator(
    "oe",
    "output error",
    _fit,
    free_run=True,
    weights=("noise", "deviation"),
    detail="the free run fitted to the log",
    ended="the fit {status}.",
    unconverged="so a better fit may be near: start elsewhere (--nominal), or take a smaller "
    "structure",
    closed_loop="which a free run that is driven by the commands feels only through process "
    "noise. ",
    order=2,
)
