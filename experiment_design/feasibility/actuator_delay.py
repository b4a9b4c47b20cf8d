"""The effect of actuator lag and delay on a plan that was designed without them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from experiment_design.constraints.limits import LimitReport
from experiment_design.excitation.rollout import Motion
from experiment_design.request.problem import TrialProblem
from experiment_design.request.request import PreparedRequest

Array = NDArray[np.float64]

# change of a standard error that is worth a word
_SLIGHT = 0.02
# share of a limit's bound, or of one unit, by which missing it is rounding
_ROUNDING = 1e-3


def late_notes(
    request: PreparedRequest,
    problems: list[TrialProblem],
    motions: tuple[Motion, ...],
    reports: tuple[LimitReport, ...],
    covariance: Array,
) -> list[str]:
    """Return what a plan has to say of forces that follow its commands late.

    The search moves forces with the commands, which keeps every step a function
    of the state; the plan found is then run with lag and delay.

    Parameters
    ----------
    request : PreparedRequest
    problems : list of TrialProblem
        One per trial.
    motions : tuple of Motion
        Of the plan, with lag and delay.
    reports : tuple of LimitReport
        How far these motions miss each limit.
    covariance : ndarray
        Of the wanted parameters, without lag and delay.
    """
    late = request.vessel.actuation
    if not late:
        return []
    said = [
        f"the search leaves out {late.sentence}; margins, limits and motions that are reported "
        f"are those of the plan with it"
    ]
    missed = [r for r in reports if r.missed > _ROUNDING * max(1.0, abs(r.bound))]
    if missed:
        worst = max(missed, key=lambda r: r.missed / max(1.0, abs(r.bound)))
        said.append(
            f"with it trial {worst.trial + 1} misses the limit of {worst.name} by "
            f"{worst.missed:.2g} {worst.unit}: ask for so much more room there"
        )
    if not request.contrasts and all(m.stable.all() for m in motions):
        total = None
        for problem, motion in zip(problems, motions, strict=True):
            own = problem.with_known(()).moments(motion, 0)
            total = own if total is None else total + own
        assert total is not None
        with_it = problems[0].criterion.covariance(total)[0]
        ratio = np.sqrt(np.diag(with_it) / np.diag(covariance))
        if np.abs(ratio - 1).max() > _SLIGHT:
            said.append(
                f"with it the standard errors of coefficients are {ratio.min():.2f} to "
                f"{ratio.max():.2f} times those predicted without it"
            )
    return said
