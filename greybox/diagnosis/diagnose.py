"""A diagnosis from beginning to end: the case is set, searched, and told."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from math import inf

import numpy as np

from greybox.diagnosis.black_box import with_remainder
from greybox.diagnosis.builder import DiagnosisBuilder
from greybox.diagnosis.chosen import Choosing, from_chosen
from greybox.diagnosis.evidence.kinematics import causes_of, denied
from greybox.diagnosis.point import Fit
from greybox.diagnosis.preparing import SHORTEST, prepare, with_own_sensors
from greybox.diagnosis.result import Diagnosis
from greybox.diagnosis.ruling import leaves_more
from greybox.diagnosis.search import search, weighed
from greybox.diagnosis.waves import find_waves, found_waves
from greybox.model.model import ManoeuvringModel
from greybox.numerics.threads import one_thread
from greybox.public import known_keywords
from greybox.regression.regression import common_sample_time
from greybox.selection.estimate import at_own_pace
from greybox.selection.prediction import require_distinct, require_others
from greybox.trial.kinematics import decimate_segments
from greybox.trial.log import Logs, TrialLog, as_list
from greybox.trial.segments import as_segments
from greybox.trial.validity import (
    extrapolation_note,
    other_conditions,
    pooled_conditions,
    ranges,
)
from greybox.validation.fit import at_model_rate

_log = logging.getLogger(__name__)

# share of length over speed, and seconds, that a sample may take beyond the pace of an estimate: a
# diagnosis fits many models, and what actuators do shows within a second
_PACE, _FINE = 0.1, 0.5


@dataclass(frozen=True)
class DiagnosisOptions:
    """How a diagnosis is made.

    Parameters
    ----------
    structure : str
        Published structure to begin from where no model is given; without its wind terms.
    causes : sequence of str, optional
        Ids to look for; all that are known by default.
    seed : int
        Of the bootstrap, and of where the bumps of a black-box part stand.
    remainder : bool
        Whether a smooth force without a name is added to the extended model where it makes
        held-out free runs better: see `greybox.diagnosis.black_box`.
    own_pace : bool
        Whether logs that are sampled faster than the ship moves are taken at a longer sample
        time, a tenth of length over speed up to half a second, a twentieth beyond; not where a
        model has its own.
    progress : callable
        Told what is being done.
    """

    structure: str = "thesis"
    causes: Sequence[str] | None = None
    seed: int = 0
    remainder: bool = False
    own_pace: bool = True
    progress: Callable[[str], None] = field(default=lambda _: None)


@known_keywords
@one_thread()
# runs of ships that a hypothesis makes unstable leave every number's range, and are judged by that
@np.errstate(over="ignore", invalid="ignore")
def diagnose(
    logs: Logs,
    *,
    model: ManoeuvringModel | None = None,
    validate: Logs = (),
    options: DiagnosisOptions = DiagnosisOptions(),
) -> Diagnosis:
    """Find what a simulation gets wrong, name the cause, and extend the model.

    Parameters
    ----------
    logs : TrialLog or sequence of TrialLog
        To estimate on.
    model : ManoeuvringModel, optional
        To diagnose; by default (3.51) in still water and air, estimated on the logs. These are
        taken at its sample time.
        It is judged as it is; beside a cause its coefficients are estimated anew, so that a
        cause is what they cannot mend.
    validate : sequence of TrialLog
        Where causes prove themselves and the gain is measured; parts of `logs` held out
        in turn by default.
    options : DiagnosisOptions

    Returns
    -------
    Diagnosis

    Raises
    ------
    ExcitationError
        The logs do not determine the model.
    LogError
        A log is too short, lacks a channel, or has another sample time than the others, or one
        that the model's is no whole multiple of.
    UsageError
        A cause does not exist.
    """

    def say(doing: str) -> None:
        _log.info("%s", doing)
        options.progress(doing)

    say("log checks")
    paced: list[str] = []
    if model is not None:
        logs = _at_rate_of(model, as_list(logs), paced)
        validate = _at_rate_of(model, as_list(validate, 0), paced)
    logs, validate = as_segments(logs), as_segments(validate, 0)
    require_distinct(logs)
    require_others(logs, validate)
    if model is None and options.own_pace:
        logs, validate = _at_own_pace(logs, validate, paced)
    with ExitStack() as begun:
        choosing = Choosing(begun) if model is None else None
        if choosing is not None:
            # most models turn out to need it, and not all before keeps all processors busy
            choosing.begin(with_own_sensors(logs))
        ready = prepare(logs, validate, model, options.structure, options.causes)
        case = ready.case
        if ready.findings and choosing is not None:
            # the checks mended the logs that it began with
            choosing.begin(case.logs)

        def choose_late(fit: Fit) -> None:
            """Begin anew where commands act later than the logs say."""
            if choosing is not None and any(h.past for h in fit.point.hypotheses):
                choosing.begin(case.acting(fit.point.ship.vessel).logs)

        say("model without causes")
        base = ready.base()
        problem = case.problem(base.integrator)
        searched = search(
            case,
            base,
            ready.hypotheses,
            progress=options.progress,
            alone=model is not None,
            unexplained=choose_late,
        )
        say("a generic force beside the causes")
        found = weighed(case, searched)
        keys = [c.hypothesis.key for c in found.causes]
        apart = sorted(key for key in keys if denied(key, ready.agreeing))
        more = leaves_more(found, case.held_out)
        if apart and more:
            # a defect that all sensors share would leave nothing; this one imitates what forces do
            say("causes without those that the sensors deny")
            searched = search(
                case, base, ready.of_forces, progress=options.progress, alone=model is not None
            )
            found = weighed(case, searched)
            more = leaves_more(found, case.held_out)
        found = replace(found, given=ready.as_given())
        if choosing is not None and more:
            chosen = from_chosen(ready, searched, found, choosing, say)
            if chosen is not None:
                wider, mine = chosen
                mine = weighed(wider, mine)
                # many a cause keeps a run within bounds: that alone outweighs no better model
                if mine.causes or not any(c.proof.gain < inf for c in found.causes):
                    case, found = wider, mine
                    problem = case.problem(found.base.integrator)
    say("what is left")
    names, final = problem.runs[0].outputs, found.final
    lines = []
    for fit in (found.before, final):
        # narrow bands are looked for in innovations, whatever the fit was weighed by
        white = problem.forgetful(fit, np.inf)
        lines.append(find_waves(white.nu, white.errors, names, problem.sample_time))
    say("gain")
    notes = paced
    if options.causes and (idle := ready.untried()):
        notes.append(
            f"{', '.join(idle)} {'were' if len(idle) > 1 else 'was'} asked for and not tried, "
            f"since these logs cannot show it or the model has it: a wind, for one, must have been "
            f"measured."
        )
    if apart and not any(c.hypothesis.key in apart for c in found.causes):
        notes.append(
            f"{', '.join(apart)} would help, but positions, heading and velocities of these logs "
            f"agree without it, and with it more than noise is left: it was not taken."
        )
    if ready.short:
        left_out = ", ".join(ready.short)
        notes.append(f"left out for having fewer than {SHORTEST} samples: {left_out}.")
    pooled = pooled_conditions(case.logs)
    conditions = (*pooled.differences, *other_conditions(pooled.values, ready.validate))
    if model is not None:
        conditions = (*conditions, *other_conditions(model.conditions, case.logs))
    notes += [d.sentence for d in conditions]
    if ready.validate:
        seen = ranges(case.logs, ready.structure.states)
        said = extrapolation_note(seen, ready.validate)
        notes += [said] if said else []
    causes = causes_of(ready.findings, ready.causes, ready.tried)
    if causes:
        notes.append(
            f"{', '.join(dict.fromkeys(c.id for c in causes))}: sensors show it among themselves, "
            f"and the logs were corrected before any model was fitted, so no share of the error "
            f"and no gain is told of it."
        )
    report = DiagnosisBuilder(
        case, ready.structure, ready.causes, found, model, options.seed, notes, ready.agreeing
    )
    if lines[1] is not None and "waves" in ready.causes:
        causes.append(found_waves(lines[1], ready.causes["waves"], ready.tried))
    made = report.made(causes, ready.validate, ready.tried, lines)
    if options.remainder:
        say("a black-box part")
        made = with_remainder(case, report.fit_told, made, ready.validate, options.seed)
    return replace(made, conditions=conditions)


def _at_rate_of(
    model: ManoeuvringModel, logs: Sequence[TrialLog], notes: list[str]
) -> list[TrialLog]:
    """Return logs at the sample time of a model, whose coefficients are of its steps."""
    out = [at_model_rate(log, model) for log in logs]
    notes += [
        f"'{log.name}' was taken at {made.sample_time:g} s, the sample time of the model, instead "
        f"of {log.sample_time:g} s."
        for log, made in zip(logs, out, strict=True)
        if made is not log
    ]
    return out


def _at_own_pace(
    logs: Sequence[TrialLog], validate: Sequence[TrialLog], notes: list[str]
) -> tuple[list[TrialLog], list[TrialLog]]:
    """Return all logs at the sample time that suits how fast the ship of the first ones moves."""
    common_sample_time([*logs, *validate])
    said: list[str] = []
    slower = list(at_own_pace(logs, said, _PACE))
    if slower[0].sample_time > _FINE:
        said = []
        slower = list(at_own_pace(logs, said))
    notes += said
    step = slower[0].sample_time
    if step == logs[0].sample_time or not validate:
        return slower, list(validate)
    held, left_out = decimate_segments(validate, step)
    notes += left_out
    return slower, held
