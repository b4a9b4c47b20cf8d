"""A structure without the terms that earn least.

Every further coefficient takes its share of the noise, so a term that the logs hardly
show makes the others worse (chapter 8 of the thesis). Bias-capturing columns are
candidates like terms: (7.1)-(7.3) are what the thesis kept of them.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from greybox.errors import ExcitationError
from greybox.estimation.result import Estimate
from greybox.model.catalogue import structure_for
from greybox.model.disturbances import CURRENT, WIND
from greybox.model.predictor import Column
from greybox.numerics.effort import seconds_left, within
from greybox.numerics.linalg import scaled_inverse
from greybox.numerics.threads import one_thread
from greybox.selection.alternatives import OVER
from greybox.selection.estimate import estimate_requested
from greybox.selection.held_out import rank
from greybox.selection.request import Request
from greybox.selection.structures import (
    CHOOSE,
    FOLDS,
    FOR_COMPARISON,
    CandidateFit,
    CrossValidation,
    Progress,
    StructureChoice,
    criteria_of,
    rank_tried,
    rows_of,
    settle,
    told,
)
from greybox.trial.log import Logs, TrialLog
from greybox.trial.segments import as_segments
from greybox.validation.criteria import independent_samples
from greybox.vessel.force import force_inputs

# joint p-value above which columns are clearly insignificant and are left out at once
_CLEAR = 0.3
# p-value below which a column is not tried
_SIGNIFICANT = 0.01
# share of a derivative below which a column does not carry it
_SHARE = 1e-6
# growth of AIC from which on the smaller structure has no support (Burnham and Anderson, 2002)
_NO_SUPPORT = 10.0


@dataclass(frozen=True)
class Candidate:
    """Columns of a predictor that may be left out together, with their Wald test.

    `absent` where nothing but a disturbance that may not be there asks for them.
    """

    columns: tuple[int, ...]
    p_value: float
    absent: bool = False


def wald(estimate: Estimate, columns: Sequence[int]) -> float:
    """Return the p-value of the null that the coefficients of some columns are all zero."""
    from scipy.special import chdtrc

    c = list(columns)
    theta, inverse = estimate.theta[c], scaled_inverse(estimate.covariance[np.ix_(c, c)])
    return float(chdtrc(len(c), float(theta @ inverse @ theta)))


def least_earning(estimate: Estimate, missed: Collection[str] = ()) -> list[Candidate]:
    """Return the sets of terms to try leaving out next: all insignificant ones, then fewer.

    An equation keeps at least one term; constants stay, and the columns whose labels,
    with their equation, are in `missed`.
    """
    predictor = estimate.predictor
    left = {s: sum(not predictor.columns[i].is_bias for i in predictor.equation(s))
            for s in predictor.structure.states}  # fmt: skip
    constants = set(predictor.constants)
    size = np.where(estimate.std > 0, estimate.std, np.inf)
    order = np.argsort(np.abs(estimate.theta) / size)
    batch: list[int] = []
    for i in map(int, order):
        column = predictor.columns[i]
        if i in constants or estimate.std[i] == 0 or _spelled(column) in missed:
            continue
        if not column.is_bias and left[column.state] == 1:
            continue
        if batch and wald(estimate, [*batch, i]) < _CLEAR:
            break
        batch.append(i)
        left[column.state] -= not column.is_bias
    found = []
    while batch:
        found.append(Candidate(tuple(batch), wald(estimate, batch)))
        batch = batch[: len(batch) // 2]
    return [c for c in found if c.p_value >= _SIGNIFICANT]


def bias_terms_without_current(estimate: Estimate, missed: Collection[str] = ()) -> list[Candidate]:
    """Return the bias-capturing columns that still water, or still air, would leave without use.

    Where there is no current all derivatives in its means are multiplied by zero; what is
    left of (5.61), (5.70), (5.85) are then (7.1)-(7.3), of (5.64), (5.75), (5.88) (7.4)-(7.6).
    Together these columns may be needless where one by one each seems to earn something.
    """
    predictor = estimate.predictor
    found = []
    for means in (CURRENT, WIND):
        gone = {i for i, n in enumerate(predictor.structure.disturbances) if n in means}
        columns: list[int] = []
        for state in predictor.structure.states:
            shares = [b for b in predictor.biases if b.state == state]
            for position, i in enumerate(predictor.equation(state)):
                uses = [b.monomial for b in shares if abs(b.shares[position]) > _SHARE]
                if predictor.columns[i].is_bias and uses and all(gone & set(m) for m in uses):
                    columns.append(i)
        spelled = {_spelled(predictor.columns[i]) for i in columns}
        if len(columns) > 1 and not spelled <= set(missed):
            found.append(Candidate(tuple(columns), wald(estimate, columns), absent=True))
    return [c for c in found if c.p_value >= _SIGNIFICANT]


def _spelled(column: Column) -> str:
    return f"{column.state}:{column.name}" if column.is_bias else column.label


def _without(
    estimate: Estimate, request: Request, candidate: Candidate
) -> tuple[Request, list[str]]:
    name, biases, dropped = str(request.structure), list(request.without), []
    for i in candidate.columns:
        column = estimate.predictor.columns[i]
        if column.is_bias:
            biases.append(_spelled(column))
        else:
            name += "".join(f"-{t}" for t in column.terms)
        dropped.append(_spelled(column))
    return replace(request, structure=name, without=tuple(biases)), dropped


@one_thread()
def reduce_structure(
    logs: Logs,
    request: Request = CHOOSE,
    progress: Progress = lambda done, total: None,
) -> StructureChoice:
    """Leave out the least useful terms step by step while held-out free runs get no worse.

    The column with the smallest robust Wald statistic goes first, several at once where
    they are jointly insignificant; the rest is estimated again. A column stays where the
    held-out score would fall behind the best by more than one standard error, or AIC grow by
    more than 10; it ends when all that is left stays or is significant.

    Parameters
    ----------
    logs : TrialLog or sequence of TrialLog
    request : Request
        What it leaves open is chosen first, for the full structure.
    progress : callable
        Called with how many coefficients were left out of how many.

    Returns
    -------
    StructureChoice
        Rows in the order of the steps, the full structure first.

    Raises
    ------
    UsageError
        The logs are too short to be cut into parts.
    ExcitationError
        The full structure cannot be estimated on the parts.
    """
    logs = as_segments(logs)
    with within(request.effort):
        return _reduced(logs, settle(logs, request), progress)


def _reduced(logs: Sequence[TrialLog], settled: Request, progress: Progress) -> StructureChoice:
    states = structure_for(str(settled.structure), force_inputs(logs[0].vessel)).states
    validation = CrossValidation(logs, states)
    with within(FOR_COMPARISON * seconds_left()):
        tried = _steps(validation, settled, progress)
    accepted = [t if not t.note or t.note == OVER else replace(t, scores=None) for t in tried]
    chosen = rank_tried(accepted).chosen
    found = replace(rank_tried(tried), chosen=chosen)
    estimate = estimate_requested(logs, tried[found.chosen].request)
    rows = rows_of(tried, found)
    return StructureChoice(told(estimate, found, rows), rows)


def _steps(validation: CrossValidation, settled: Request, progress: Progress) -> list[CandidateFit]:
    """Return what was tried in turn, the full structure first, as far as time allows."""
    current: CandidateFit | None = validation.fit(settled, full=True)
    assert current is not None
    full = current
    if full.note == OVER:
        return [full]
    if full.scores is None:
        raise ExcitationError(
            f"'{settled.structure}' cannot be estimated on {FOLDS - 1} of {FOLDS} parts of the "
            f"logs, so held-out runs cannot tell what to leave out: {full.note}"
        )
    tried, missed = [full], set[str]()
    while current is not None:
        progress(full.size - current.size, full.size)
        current = _step(validation, tried, current, missed)
    progress(full.size, full.size)
    return tried


def _candidates(estimate: Estimate, missed: Collection[str]) -> list[Candidate]:
    return [*bias_terms_without_current(estimate, missed), *least_earning(estimate, missed)]


def _step(
    validation: CrossValidation, tried: list[CandidateFit], current: CandidateFit, missed: set[str]
) -> CandidateFit | None:
    """Leave out what the held-out runs do not miss; None where they miss all that is tried.

    A column that they miss is not tried again.
    """
    assert current.estimate is not None
    while candidates := _candidates(current.estimate, missed):
        for candidate in candidates:
            request, dropped = _without(current.estimate, current.request, candidate)
            if candidate.absent and any(t.note and t.dropped == tuple(dropped) for t in tried):
                continue
            found = validation.fit(request, full=True, dropped=tuple(dropped))
            if found.note == OVER:
                tried.append(found)
                return None
            rows = [*(t for t in tried if not t.note), found]
            ranking = rank([t.scores for t in rows], [t.size for t in rows])
            near = found.scores is not None and ranking.behind[-1] <= ranking.se[-1]
            # a joint p above 0.01 is a Wald statistic below 2 k + 10 for every k > 1, which is
            # what AIC asks; free runs of instruments' estimates, which minimise no such sum,
            # blur it where many columns go at once
            if near and (candidate.absent or _supported(rows)):
                tried.append(found)
                return found
            reason = "kept: AIC misses it" if near else "kept: held-out runs miss it"
            tried.append(replace(found, note=found.note or reason))
        missed.update(dropped)
    return None


def _supported(rows: Sequence[CandidateFit]) -> bool:
    """Whether AIC leaves the last row some support against the best of those before."""
    if rows[0].errors is None:
        return True
    worth = independent_samples(rows[0].errors)
    found = [criteria_of(t, worth)[0] for t in rows]
    known = [v for v in found[:-1] if v is not None]
    return found[-1] is not None and found[-1] <= min(known) + _NO_SUPPORT
