"""A diagnosis from beginning to end: the case is set, searched, and told."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.atom import Atom
from greybox.diagnosis.base import Case
from greybox.diagnosis.causes import Cause, Context, known_causes
from greybox.diagnosis.kinematics import causes_of, kinematic_findings, mended
from greybox.diagnosis.result import Diagnosis
from greybox.diagnosis.search import search
from greybox.diagnosis.ship import CURRENTS
from greybox.diagnosis.telling import Report
from greybox.diagnosis.waves import find_waves, found_waves
from greybox.errors import LogError, UsageError, suggestion
from greybox.model.catalogue import for_inputs, get_structure, structure_for
from greybox.model.model import ManoeuvringModel
from greybox.model.structure import Structure
from greybox.regression.regression import common_sample_time
from greybox.trial.correcting import correct_log
from greybox.trial.log import TrialLog
from greybox.vessel.force import force_inputs

Array = NDArray[np.float64]

# samples that a diagnosis needs in every log
_SHORTEST = 120
_WIND_TERMS = ("Wuu", "Wvv", "Wuv")

_log = logging.getLogger(__name__)


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
        Of the bootstrap.
    progress : callable
        Told what is being done.
    """

    structure: str = "thesis"
    causes: Sequence[str] | None = None
    seed: int = 0
    progress: Callable[[str], None] = field(default=lambda _: None)


def diagnose(
    logs: Sequence[TrialLog],
    *,
    model: ManoeuvringModel | None = None,
    validate: Sequence[TrialLog] = (),
    options: DiagnosisOptions = DiagnosisOptions(),
) -> Diagnosis:
    """Find what a simulation gets wrong, name the cause, and extend the model.

    Parameters
    ----------
    logs : sequence of TrialLog
        To estimate on.
    model : ManoeuvringModel, optional
        To diagnose; by default (3.51) in still water and air, estimated on the logs.
        Its coefficients are estimated anew, so that a cause is what they cannot mend.
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
        A log is too short, lacks a channel, or has another sample time.
    UsageError
        A cause does not exist.
    """
    common_sample_time([*logs, *validate])
    short = [log.name for log in (*logs, *validate) if len(log) < _SHORTEST]
    logs = _long_enough(logs)
    validate = _long_enough(validate) if validate else []
    causes = _chosen(options.causes)

    def say(doing: str) -> None:
        _log.info("%s", doing)
        options.progress(doing)

    say("log checks")
    findings = [f for f in kinematic_findings([*logs, *validate]) if f.id in causes]
    vessel = mended(logs[0].vessel if model is None else model.vessel, findings)
    logs = [correct_log(log, vessel) for log in logs]
    validate = [correct_log(log, vessel) for log in validate]
    structure = _structure(options.structure, logs, model)
    context = _context(structure, [*logs, *validate], model)
    atoms = [a for c in causes.values() for a in c.atoms(context)]
    case = _case(structure, atoms, logs, validate)
    tried = len(atoms) + len(findings)
    say("model without causes")
    base = case.base(
        None if model is None else dict(zip(model.names, map(float, model.theta), strict=True)),
        np.zeros(2) if model is None else model.d[:2],
    )
    problem = case.problem(base.integrator)
    found = search(case, base, atoms, progress=options.progress)
    say("what is left")
    names, final = problem.runs[0].outputs, found.final
    lines = [find_waves(f.nu, f.errors, names, problem.sample_time) for f in (base, final)]
    say("gain")
    notes = []
    if short:
        notes.append(f"left out for having fewer than {_SHORTEST} samples: {', '.join(short)}.")
    report = Report(case, structure, causes, found, model, options.seed, notes)
    known = causes_of(findings, causes, tried)
    if lines[1] is not None and "waves" in causes:
        known.append(found_waves(lines[1], causes["waves"], tried))
    return report.made(known, validate, tried, lines)


def _long_enough(logs: Sequence[TrialLog]) -> list[TrialLog]:
    kept = [log for log in logs if len(log) >= _SHORTEST]
    if not kept:
        longest = max(logs, key=len)
        raise LogError(
            f"'{longest.name}' has {len(longest)} samples, a diagnosis needs at least {_SHORTEST}: "
            f"give a longer log."
        )
    return kept


def _chosen(ids: Sequence[str] | None) -> dict[str, Cause]:
    known = known_causes()
    for name in ids or ():
        if name not in known:
            raise UsageError(
                f"there is no cause '{name}'.{suggestion(name, known)} Known: {', '.join(known)}."
            )
    return {k: c for k, c in known.items() if ids is None or k in ids}


def _structure(name: str, logs: Sequence[TrialLog], model: ManoeuvringModel | None) -> Structure:
    if model is not None:
        return model.structure
    inputs = force_inputs(logs[0].vessel)
    # also where a name takes terms away or adds some
    get_structure(name)
    structure = structure_for(name, inputs)
    still = [t for t in _WIND_TERMS if t in structure.parameters]
    return for_inputs(structure.without(*still), inputs) if still else structure


def _context(
    structure: Structure, logs: Sequence[TrialLog], model: ManoeuvringModel | None
) -> Context:
    first = logs[0]
    turns = "r" in structure.states and all("psi" in log for log in logs)
    return Context(
        structure=structure,
        vessel=first.vessel,
        outputs=(*structure.states, "psi") if turns else structure.states,
        has_wind=all(log.has_wind for log in logs),
        duration=min(float(log.t[-1] - log.t[0]) for log in logs),
        sample_time=first.sample_time,
        speeds={t.speed: float(np.median(np.abs(first[t.speed]))) for t in first.vessel.thrusters},
        current_known=model is not None and any(model.d[:2]),
    )


def _case(
    structure: Structure,
    atoms: Sequence[Atom],
    logs: Sequence[TrialLog],
    validate: Sequence[TrialLog],
) -> Case:
    names = dict.fromkeys(n for a in atoms for n in (*a.columns, *a.beside))
    added = [n for n in names if n not in structure.parameters and n not in CURRENTS]
    universe = structure.with_terms(*added)
    wind = universe.uses_air and all(log.has_wind for log in [*logs, *validate])
    both: tuple[int, ...] = (1, -1)
    return Case(
        structure, universe, logs, validate,
        "basic+wind" if wind and structure.uses_air else "basic",
        tuple((s, both) for s in structure.states),
    )  # fmt: skip
