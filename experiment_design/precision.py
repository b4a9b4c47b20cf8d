"""The predicted standard errors of any given sequence, before the trial."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from experiment_design.constraints.limits import Limit
from experiment_design.information.moments import Moments
from experiment_design.optimise.campaign import add_up
from experiment_design.request.request import PreparedRequest, build_problem, wanted_parameters
from greybox.errors import ExcitationError, UsageError, so_many
from greybox.notebook import DisplayMixin, items, number, table
from greybox.numerics.linalg import scaled_logdet

Array = NDArray[np.float64]


@dataclass(frozen=True, repr=False)
class PredictedPrecision(DisplayMixin):
    """Predicted precision of given sequences.

    Parameters
    ----------
    names : tuple of str
        The wanted parameters.
    covariance : ndarray
        (p_w, p_w) of their estimates.
    missed : tuple of (Limit, float)
        By how much each limit of the request is missed at worst, 0 where kept.
    """

    names: tuple[str, ...]
    covariance: Array
    missed: tuple[tuple[Limit, float], ...]

    @property
    def std(self) -> Array:
        """Predicted standard errors (p_w,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def logdet(self) -> float:
        """−log det of the covariance; larger is better."""
        return -float(scaled_logdet(self.covariance))

    def summary(self) -> str:
        """Return the predicted standard errors as text."""
        lines = [f"{n:<12}{s:>12.3g}" for n, s in zip(self.names, self.std, strict=True)]
        lines.append(f"{'−log det':<12}{self.logdet:>12.2f}")
        return "\n".join([*lines, *self._missed()])

    def _missed(self) -> list[str]:
        return [f"{n.words} missed by {m:.3g} {n.unit}" for n, m in self.missed if m > 0]

    def _line(self) -> str:
        missed = len(self._missed())
        kept = f"{missed} limits missed" if missed else "all limits kept"
        return f"predicted precision of {so_many(len(self.names), 'parameter')}, {kept}"

    def _parts(self) -> tuple[str, ...]:
        rows = [(n, number(s, 3)) for n, s in zip(self.names, self.std, strict=True)]
        return table(("parameter", "predicted std err"), rows), items("Limits", self._missed())


def predict_precision(
    request: PreparedRequest, plans: Sequence[Mapping[str, Array]]
) -> PredictedPrecision:
    """Predict the standard errors that sequences of commands would give.

    Parameters
    ----------
    request : PreparedRequest
        The prior model, the start of each trial and the criterion.
    plans : sequence of mapping of str to ndarray
        (N,) each command of each trial, at the sample time: speeds in the unit of
        the log, angles [rad].

    Returns
    -------
    PredictedPrecision

    Raises
    ------
    UsageError
        There is not one plan a trial, or one has not the request's length.
    ExcitationError
        The model diverges on a plan, or some direction is not excited.

    References
    ----------
    Ljungberg (2020), eqs. 2.21 and 4.63.
    """
    if len(plans) != request.trials:
        raise UsageError(
            f"{so_many(len(plans), 'plan')} for {so_many(request.trials, 'trial')}: give one "
            f"per trial."
        )
    names = request.schedule.commands
    samples = request.schedule.samples
    sums: list[tuple[Moments, ...]] = []
    worst = []
    for t, plan in enumerate(plans):
        problem = build_problem(request, t)
        commands = np.column_stack([np.asarray(plan[n], float) for n in names])
        if len(commands) != samples:
            raise UsageError(
                f"the plan of trial {t + 1} has {len(commands)} samples, the request {samples}: "
                f"give the duration of the plan."
            )
        motion = problem.scenarios[0].rollout.run(commands[None])
        if not motion.stable[0]:
            raise ExcitationError(
                f"the prior model diverges on the plan of trial {t + 1}: use a stable one."
            )
        sums.append((problem.moments(motion, 0),))
        worst.append(problem.scenarios[0].limits.violations(motion)[:, 0])
    criterion = problem.criterion
    total = add_up(sums)[0]
    covariance = criterion.covariance(total)[0]
    if not np.isfinite(covariance).all():
        predictor = request.build_predictor()
        size = np.sqrt(np.diag(total.gram[0]))
        weakest = predictor.columns[int(size[: len(predictor.columns)].argmin())].label
        raise ExcitationError(
            f"these plans do not excite every direction: the regressor of {weakest} varies by "
            f"{size.min():.2g} over {samples} samples. Move what it multiplies."
        )
    limits = problem.scenarios[0].limits.all_limits
    missed = np.max(worst, axis=0) if limits else np.zeros(0)
    return PredictedPrecision(
        tuple(c.name for c in wanted_parameters(request, criterion)),
        covariance,
        tuple(zip(limits, missed.tolist(), strict=True)),
    )
