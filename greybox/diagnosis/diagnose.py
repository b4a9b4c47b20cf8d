"""A diagnosis from beginning to end."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.atom import Atom
from greybox.diagnosis.base import FOLDS, Case
from greybox.diagnosis.causes import Cause, Context, known_causes
from greybox.diagnosis.confusion import rivals
from greybox.diagnosis.extension import extended_model
from greybox.diagnosis.fitting import Fit, Problem
from greybox.diagnosis.gain import gains, run_on
from greybox.diagnosis.held_out import Pair
from greybox.diagnosis.kinematics import causes_of, kinematic_findings, mended
from greybox.diagnosis.result import Diagnosis, Found, Gain, Quantity, Ranked, Runs, Symptom
from greybox.diagnosis.search import Candidate, Search, backwards, instead, search
from greybox.diagnosis.ship import CURRENTS
from greybox.diagnosis.symptoms import find_symptoms
from greybox.diagnosis.verdict import rule
from greybox.diagnosis.waves import find_waves, found_waves
from greybox.errors import LogError, UsageError, suggestion
from greybox.model.catalogue import for_inputs, get_structure, structure_for
from greybox.model.model import ManoeuvringModel
from greybox.model.structure import Structure
from greybox.regression.regression import common_sample_time
from greybox.trial.correcting import correct_log
from greybox.trial.log import TrialLog
from greybox.validation.fit import LogFit, fit_percent
from greybox.vessel.force import force_inputs

Array = NDArray[np.float64]

# samples that a diagnosis needs in every log
_SHORTEST = 120
_WIND_TERMS = ("Wuu", "Wvv", "Wuv")


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
    say = options.progress
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
    found = search(case, base, atoms, progress=say)
    say("what is left")
    waves = None
    if "waves" in causes:
        final = found.final
        waves = find_waves(final.nu, final.errors, problem.runs[0].outputs, problem.sample_time)
    say("gain")
    report = _Report(case, structure, causes, found, model, options.seed, short)
    known = causes_of(findings, causes, tried)
    if waves is not None:
        known.append(found_waves(waves, causes["waves"], tried))
    return report.made(known, validate, tried)


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


class _Report:
    """Turns a search into what the user gets."""

    def __init__(
        self,
        case: Case,
        structure: Structure,
        causes: Mapping[str, Cause],
        found: Search,
        given: ManoeuvringModel | None,
        seed: int,
        short: Sequence[str],
    ) -> None:
        self.short = short
        self.case, self.structure, self.causes = case, structure, causes
        self.found, self.given, self.seed = found, given, seed
        self.current: dict[str, tuple[float, float]] = {}
        if given is not None:
            self.current = {n: v for n, v in given.disturbances.items() if n in CURRENTS}

    def model(self, fit: Fit, record: Mapping[str, Any]) -> ManoeuvringModel:
        """Return a hypothesis as a model."""
        problem = self.case.problem(fit.integrator)
        made = extended_model(self.structure, problem, fit, self.case.logs, record, self.current)
        if self.found.base is fit and self.given is not None:
            return self.given
        return made

    def cause(self, candidate: Candidate, fit: Fit, tried: int) -> Found:
        """Return a candidate as it stands in a fit."""
        cause = self.causes[candidate.atom.cause]
        quantities = self.quantities(candidate, fit)
        told = {k: (q.value, q.std) for k, q in quantities.items()}
        return Found(
            candidate.atom.cause, candidate.atom.key, cause.title, quantities,
            candidate.p_value, candidate.p_adjusted, cause.evidence(told), cause.extension,
            cause.reference, candidate.gain, candidate.proof.gain, candidate.proof.std,
        )  # fmt: skip

    def quantities(self, candidate: Candidate, fit: Fit) -> dict[str, Quantity]:
        """Return a cause's parameters with standard errors."""
        problem = self.case.problem(fit.integrator)
        values, covariance = problem.covariance(fit)
        std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        atom = candidate.atom
        if atom.apply is None:
            index = [fit.point.places.index(problem.place(n)) for n in atom.columns]
        else:
            k = [a.key for a in fit.point.atoms].index(atom.key)
            first = len(fit.point.places) + sum(map(len, fit.point.values[:k]))
            index = list(range(first, first + len(fit.point.values[k])))
        if not index:
            return {atom.key.split(":", 1)[1]: Quantity(-1.0, 0.0, "1")}
        return {
            p.name: Quantity(float(values[i]), float(np.hypot(std[i], p.coarse)), p.unit)
            for p, i in zip(atom.parameters, index, strict=True)
        }

    def made(self, known: Sequence[Found], validate: Sequence[TrialLog], tried: int) -> Diagnosis:
        """Return the diagnosis."""
        found, case = self.found, self.case
        held = case.held_out(found.final.integrator)
        groups = self._groups()
        ruling = rule(found, held, groups, known)
        named = [c for c in found.causes if not _grouped(c, groups)]
        members = [c for pair in groups for c in pair]
        record = {
            "method": "diagnosis",
            "causes": [c.atom.key for c in found.causes],
            "logs": [
                {"name": log.name, "sha256": log.provenance.sha256, "samples": len(log)}
                for log in case.logs
            ],
        }
        before = self.model(found.base, record | {"causes": []})
        after = self.model(found.final, record) if found.causes else before
        alternatives = {c.atom.cause: self.model(c.fit, record) for c in members}
        shown = [self.cause(c, found.final, tried) for c in named]
        gain, runs, after = self._gain(before, after, validate, held.pairs(found.final))
        notes = self._notes(after)
        verdict = ruling.verdict
        if found.causes and sum(g.after - g.before for g in gain.values()) < 0:
            # likelier errors are no better simulation: nothing is extended by them
            helped = ", ".join(c.atom.cause for c in found.causes)
            notes.append(
                f"{helped} made the held-out errors likelier but the free run no better, so the "
                f"model was not extended."
            )
            gain, runs, after = self._gain(before, before, validate, held.pairs(found.base))
            verdict = "unexplained"
        unexplained = verdict == "unexplained"
        problem = case.problem(found.base.integrator)
        return Diagnosis(
            verdict=verdict,
            causes=(*known, *([] if unexplained else shown)),
            groups=tuple(tuple(c.atom.cause for c in pair) for pair in groups),
            gain=gain,
            wrong=_symptoms(problem, found),
            partial=tuple(shown if unexplained else ()),
            candidates=tuple(self.cause(c, c.fit, tried) for c in members),
            base=before,
            model=after,
            alternatives=alternatives,
            remaining=ruling.remaining,
            validated_on=self._where(validate),
            next_steps=tuple(ruling.next_steps),
            steps=tuple(_ranked(s.scores, s.candidates) for s in found.steps),
            runs=tuple(runs),
            notes=tuple(notes),
            tried=tried,
            record=record,
        )

    def _groups(self) -> list[list[Candidate]]:
        out = []
        causes = self.found.causes
        ids = {c.atom.cause for c in causes}
        for step in self.found.steps:
            if step.taken is None or not any(c.atom.key == step.taken.atom.key for c in causes):
                continue
            best = next(c for c in step.candidates if c.atom.key == step.taken.atom.key)
            others = [c for c in step.candidates if c.atom.cause not in ids]
            if len(causes) > 1:
                best, others = instead(self.case, self.found.final, best, others)
            like = rivals(self.case.problem, self.case.held_out, best, others)
            if like:
                out.append([best, *like])
        return out

    def _gain(
        self,
        before: ManoeuvringModel,
        after: ManoeuvringModel,
        validate: Sequence[TrialLog],
        pairs: Sequence[Pair],
    ) -> tuple[dict[str, Gain], list[Runs], ManoeuvringModel]:
        logs = list(validate)
        if logs:
            after = _likelier_story(after, logs)
            one = [run_on(before, log) for log in logs]
            two = [run_on(after, log) for log in logs]
        else:
            one = _held_runs(self.case.held_out(self.found.base.integrator).pairs(self.found.base))
            two = _held_runs(pairs)
        runs = [
            Runs(
                a.log, held,
                {s: a.log[s] for s in a.fit},
                {s: a.x[:, i] for i, s in enumerate(a.fit)},
                _as_shown(a, b),
            )
            for held, ones, twos in (
                (False, [run_on(before, log) for log in self.case.logs],
                 [run_on(after, log) for log in self.case.logs]),
                (True, one, two),
            )
            for a, b in zip(ones, twos, strict=True)
        ]  # fmt: skip
        return gains(one, two, self.case.logs[0].sample_time, self.seed), runs, after

    def _where(self, validate: Sequence[TrialLog]) -> str:
        if validate:
            return f"on {', '.join(log.name for log in validate)}, which took no part in the fit"
        return (
            f"on {FOLDS} parts of the logs, each predicted by a fit to the others, for no "
            f"validation log was given"
        )

    def _notes(self, after: ManoeuvringModel) -> list[str]:
        out = []
        if self.short:
            out.append(
                f"left out for having fewer than {_SHORTEST} samples: {', '.join(self.short)}."
            )
        if self.given is not None:
            out.append(
                "the coefficients of the model were estimated anew on these logs before causes "
                "were judged; 'before' is the model as it was given."
            )
        turned = backwards(self.found.final, self.case.universe.parameters)
        if turned:
            out.append(
                f"{', '.join(turned)} came out negative: some thruster's column has the wrong sign "
                f"or stands in another's place; greybox check tells which."
            )
        for change in after.changes:
            out.append(f"the extended model tells the log's own clock: {change.sentence}.")
        return out


def _grouped(candidate: Candidate, groups: Sequence[Sequence[Candidate]]) -> bool:
    return any(c.atom.key == candidate.atom.key for pair in groups for c in pair)


def _ranked(scores: Sequence[Any], candidates: Sequence[Candidate]) -> tuple[Ranked, ...]:
    promised = {s.atom.key: s.gain for s in scores}
    fitted = {c.atom.key: c for c in candidates}
    keys = dict.fromkeys([*fitted, *promised])
    return tuple(
        Ranked(
            key, float(promised.get(key, 0.0)), fitted[key].gain, fitted[key].proof.gain,
            fitted[key].proof.std,
        )
        if key in fitted
        else Ranked(key, float(promised[key]))
        for key in keys
    )  # fmt: skip


def _likelier_story(model: ManoeuvringModel, logs: Sequence[TrialLog]) -> ManoeuvringModel:
    """Return the model with its changes within logs, or made before: whichever fits better."""
    if not model.changes:
        return model
    settled = model.settled()

    def missed(candidate: ManoeuvringModel) -> float:
        return sum(
            float(np.square(run.log[s] - run.x[:, i]).sum() / max(np.var(run.log[s]), 1e-12))
            for run in (run_on(candidate, log) for log in logs)
            for i, s in enumerate(run.fit)
        )

    return settled if missed(settled) < missed(model) else model


def _as_shown(before: LogFit, after: LogFit) -> dict[str, Array]:
    """Return a run on a corrected log as its sensors would show it on the log as it is."""
    if before.log.t[0] == after.log.t[0] and len(before.log) == len(after.log):
        place = np.arange(len(after.log))
    else:
        place = np.searchsorted(before.log.t, after.log.t)
    out = {}
    for i, state in enumerate(after.fit):
        shown = np.full(len(before.log), np.nan)
        shown[place] = before.log[state][place] - (after.log[state] - after.x[:, i])
        out[state] = shown
    return out


def _symptoms(problem: Problem, found: Search) -> tuple[Symptom, ...]:
    told = find_symptoms(problem, found.base)
    if not told and found.causes:
        told = [
            Symptom(
                "at no sample are the errors larger than the noise of the sensors; only all "
                "samples together show them",
                "", 0.0,
            )
        ]  # fmt: skip
    return tuple(told)


def _held_runs(pairs: Sequence[Pair]) -> list[LogFit]:
    out = []
    for pair in pairs:
        ship = pair.held_fit.point.ship
        for run, start in zip(pair.held.runs, pair.held_fit.point.starts, strict=True):
            x = run.run(ship, start).y[:, : len(run.states)]
            percent = fit_percent(run.log.states(run.states), x)
            out.append(
                LogFit(
                    run.log, x, run.log["psi"] if "psi" in run.log else np.zeros(len(x)),
                    {s: float(f) for s, f in zip(run.states, percent, strict=True)}, -1,
                )
            )  # fmt: skip
    return out
