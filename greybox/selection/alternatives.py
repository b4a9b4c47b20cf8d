"""Ways to estimate that logs and request leave open, and which one comes first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from greybox.errors import DivergenceError, GreyboxError, LogError, OutOfTimeError
from greybox.estimation.informative import ADVISED_HEADING, cancelled, heading_range, movements
from greybox.estimation.registry import ESTIMATORS, automatic_estimators
from greybox.estimation.tried import Comparison, TriedModel
from greybox.model.catalogue import structure_for
from greybox.model.predictor_kinds import PREDICTORS
from greybox.model.structure import Structure
from greybox.numerics.effort import seconds_left, within
from greybox.selection.fit_single import estimate_once
from greybox.selection.held_out import Ranking, rank, score_runs, spread_of
from greybox.selection.request import Request
from greybox.selection.term_selection import law_in_words
from greybox.trial.log import TrialLog
from greybox.validation.fit import run_model
from greybox.vessel.force import force_inputs

Array = NDArray[np.float64]

# held-out share of each log when alternatives are compared
_HELD_OUT = 1 / 3
# parts of the held-out runs, for a standard error
_BLOCKS = 6
# said of what could not be tried
OVER = "not tried: time ran out (--effort)"
# share of the time that is left that the comparison may take
_OF_ALL = 0.3
# refinements of the instruments while alternatives are compared
_RANKING_REFINEMENTS = 4
# length of the last step of a free run's fit, in standard errors, while alternatives are compared
_RANKING_TOLERANCE = 0.01
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


def alternatives_for(
    logs: Sequence[TrialLog], request: Request, notes: list[str], tried: list[Comparison]
) -> list[Alternative]:
    """Return the ways to estimate, the preferred one first.

    Where the conditions of consistency hold that is the one that theory names,
    elsewhere the one whose held-out run is best; `notes` and `tried` are told.

    Raises
    ------
    LogError
        A predictor needs a wind that a log lacks.
    """
    inputs = force_inputs(logs[0].vessel)
    wind = all(log.has_wind for log in logs)
    names = [request.structure] if request.structure is not None else structures_to_try(logs, wind)
    structures = [structure_for(name, inputs) for name in names]
    estimators = (
        [ESTIMATORS[request.method]]
        if request.method
        else [e for e in automatic_estimators() if not e.free_run]
    )
    kinds = (
        [request.predictor] if request.predictor else _plausible(logs, structures[0], wind, notes)
    )
    for kind in kinds:
        if PREDICTORS[kind].air_measured and not wind:
            lacking = next(log.name for log in logs if not log.has_wind)
            raise LogError(
                f"predictor '{kind}' needs the wind, and '{lacking}' has neither u_q, v_q nor "
                f"V_q, gamma_q: use --predictor augmented or basic."
            )
    alternatives = [
        Alternative(s, e.name, k) for s in structures for e in estimators for k in kinds
    ]
    if all(e.free_run for e in estimators):
        reasons = []
        if request.predictor is None:
            reasons.append(
                "a free run feels the mean current itself, so it needs no sign condition"
            )
        if request.structure is None:
            reasons.append("the first structure whose run stays bounded is kept")
        reason = ", and ".join(reasons)
        alternatives = [replace(a, reason=reason) for a in alternatives if a.kind == kinds[0]]
    elif len(alternatives) > 1:
        theory = _theory(logs, structures[0], wind)
        first = [
            a
            for a in alternatives
            if a.structure is structures[0]
            and ESTIMATORS[a.method].instruments
            and a.kind == theory
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
            alternatives = _compare(logs, alternatives, request, notes, tried)
    return alternatives


def structures_to_try(logs: Sequence[TrialLog], wind: bool) -> list[str]:
    """Return the structures to try where the user names none, the largest first.

    On a nearly constant heading an unmeasured wind or current is a constant
    force, which the bias-capturing terms cannot be told from.
    """
    if wind:
        names = ["thesis", "linear+Wuu+Wvv+Wuv"]
    elif heading_range(logs) < ADVISED_HEADING:
        names = ["thesis", "linear", "linear+X_0+Y_0+N_0"]
    else:
        names = ["thesis", "linear"]
    vessel = logs[0].vessel
    if any(t.type != "propeller_rudder" for t in vessel.thrusters):
        return names
    # propellers to both sides that turned alike have no moment, and rudders steer without one
    thesis = structure_for(names[0], force_inputs(vessel))
    still, lost = cancelled(thesis, movements(logs, thesis))
    return [n + "".join(f"-{t}" for t in lost) for n in names] if still == ["taun"] else names


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
        lacking = []
        if turned < ADVISED_HEADING:
            lacking.append(
                f"the heading covers {np.degrees(turned):.0f} deg, and about "
                f"{np.degrees(ADVISED_HEADING):.0f} are needed"
            )
        if rows < most:
            lacking.append(f"there are {rows} samples, and about {most} are needed")
        notes.append(f"bias-capturing terms were left out: {'; '.join(lacking)}.")
    return kinds


def _theory(logs: Sequence[TrialLog], structure: Structure, wind: bool) -> str | None:
    """Return the predictor whose consistency conditions the logs meet, if one does.

    Without wind measurement u_r, u_q and u share a sign, likewise in sway (5.7),
    (5.68); with it only u_r and v_r must keep theirs (5.50), (5.77).
    """
    if not structure.marine:
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
    tried: list[Comparison],
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
    without = ["its run diverges"] * len(alternatives)
    with within(_OF_ALL * seconds_left()):
        for i, alternative in enumerate(alternatives):
            try:
                model = estimate_once(
                    fitting, alternative.structure, alternative.method, alternative.kind, request
                ).model()
                runs = [run_model(model, log) for log in held]
                bounded = all(r.diverged < 0 for r in runs)
                scores.append(score_runs(runs, spread, _BLOCKS) if bounded else None)
            except GreyboxError as error:
                scores.append(None)
                if isinstance(error, OutOfTimeError):
                    without[i] = OVER
                elif not isinstance(error, DivergenceError):
                    without[i] = str(error)
    if all(s is None for s in scores):
        notes.append("no alternative could be run on the last third of each log.")
        return alternatives
    found = rank(scores, range(len(alternatives)))
    order = sorted(range(len(alternatives)), key=lambda i: (i != found.chosen, -found.score[i]))
    rule = (
        "the fullest structure and the method least biased by noise that fall behind the best by "
        "no more than one standard error"
    )
    on = "the free run on the last third of each log when estimated on the first two"
    rows = []
    for i, a in enumerate(alternatives):
        row = tried_model(a, logs, chosen=i == found.chosen)
        rows.append(replace(row, note=without[i]) if scores[i] is None else scored(row, found, i))
    tried.append(Comparison("published structures", on, rule, tuple(rows)))
    notes.append(f"chosen by {on}: {rule}.")
    return [alternatives[i] for i in order]


def tried_model(
    alternative: Alternative, logs: Sequence[TrialLog], *, chosen: bool = False, note: str = ""
) -> TriedModel:
    """Return an alternative as the table of what was tried has it, without a score."""
    return TriedModel(
        alternative.structure.name,
        alternative.kind,
        alternative.method,
        logs[0].sample_time,
        law_in_words(logs[0].vessel.thrusters[0].thrust),
        len(alternative.structure.parameters),
        chosen=chosen,
        note=note,
    )


def scored(row: TriedModel, found: Ranking, i: int) -> TriedModel:
    """Return a row with what a ranking says of its place `i`."""
    score, behind, se = (float(x[i]) for x in (found.score, found.behind, found.se))
    return replace(row, score=score, behind=behind, se=se)


def ranking_request(request: Request) -> Request:
    """Return the request without standard errors, tests and the last digit."""
    return replace(
        request,
        covariance="white",
        refine=_RANKING_REFINEMENTS,
        prefilter="none",
        judged=False,
        output_error=replace(request.output_error, tolerance=_RANKING_TOLERANCE),
    )
