"""Estimates with causes that the user knows to be present, whether or not the logs confirm them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.builder import DiagnosisBuilder
from greybox.diagnosis.hypothesis import Hypothesis
from greybox.diagnosis.null_model import DiagnosisProblem
from greybox.diagnosis.point import Fit
from greybox.diagnosis.preparing import prepare
from greybox.diagnosis.refitting import final_refit, likelier, promises, refits
from greybox.diagnosis.result import Given
from greybox.diagnosis.search import Search, freed
from greybox.numerics.threads import one_thread
from greybox.public import known_keywords
from greybox.trial.log import Logs
from greybox.trial.segments import as_segments

Array = NDArray[np.float64]

# forms of a cause that are fitted: moments, thrusters, coefficients
_FORMS = 3


@known_keywords
@one_thread()
def fit_given(
    logs: Logs,
    ids: Sequence[str],
    *,
    validate: Logs = (),
    structure: str = "thesis",
    seed: int = 0,
) -> Given:
    """Estimate the model with causes that are known to act, each in its likeliest form.

    Parameters
    ----------
    logs : TrialLog or sequence of TrialLog
    ids : sequence of str
        Causes; those that these logs cannot show, or that kinematics have mended, change
        nothing.
    validate : sequence of TrialLog
        Where the gain is measured; parts of `logs` held out in turn by default.
    structure : str
    seed : int
        Of the bootstrap.

    Returns
    -------
    Given

    Raises
    ------
    ExcitationError
        The logs do not determine the model.
    LogError
        A log is too short, lacks a channel, or has another sample time.
    UsageError
        A cause does not exist.
    """
    logs, validate = as_segments(logs), as_segments(validate, 0)
    ready = prepare(logs, validate, None, structure, ids)
    case, base = ready.case, ready.base()
    final = base
    left = {a.cause for a in ready.hypotheses}
    while left:
        found = _likeliest(case, final, [a for a in ready.hypotheses if a.cause in left])
        if found is None:
            break
        final = found[1]
        left.discard(found[0].cause)
    search = Search(base, final, (), (), ready.tried)
    report = DiagnosisBuilder(case, ready.structure, ready.causes, search, None, seed, ())
    record = {"method": "given causes", "causes": list(ids)}
    before, after = (report.model(f, record) for f in (base, final))
    gain, _, after = report.gain(before, after, ready.validate, final)
    one, two = (float(f.in_sensors()[0].sum()) for f in (base, final))
    fall = 1.0 - two / max(one, 1e-300)
    return Given(tuple(ids), before, after, fall, gain, report.where(ready.validate))


def _likeliest(
    case: DiagnosisProblem, fit: Fit, hypotheses: Sequence[Hypothesis]
) -> tuple[Hypothesis, Fit] | None:
    problem = case.problem(fit.integrator)
    near = [a for a in hypotheses if not a.refit_from_scratch]
    scores, forgetful = promises(problem, fit, near)
    asked = [*((fit, score) for score in scores[:_FORMS]), *forgetful]
    fits = likelier(refits(problem, asked))
    if not fit.point.hypotheses:
        # coefficients of their own forget the causes before: only the first can have them
        fits += case.restart(fit, hypotheses, [s.hypothesis for s in scores if s.gain == -np.inf])
    fits = [(a, f) for a, f in fits if not f.escaped]
    if not fits:
        return None
    samples = sum(len(e) for e in fit.errors)

    def merit(found: tuple[Hypothesis, Fit]) -> tuple[bool, float]:
        hypothesis, its = found
        price = freed(fit, its, hypothesis) * float(np.log(samples))
        return not hypothesis.refit_from_scratch, its.cost + price

    hypothesis, best = min(fits, key=merit)
    return hypothesis, final_refit(case, best, hypothesis)
