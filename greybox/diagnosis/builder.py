"""Turn a finished search into a diagnosis: causes, groups, the extended model, its gain."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.budget import (
    Drop,
    SwitchedOff,
    averaged,
    error_budget,
    errors_acting,
    errors_before,
    errors_without,
    without_share,
)
from greybox.diagnosis.causes import Cause
from greybox.diagnosis.causes.sensors import turned_alike
from greybox.diagnosis.evidence.confusion import rivals
from greybox.diagnosis.evidence.held_out import Pair
from greybox.diagnosis.evidence.kinematics import denied
from greybox.diagnosis.evidence.standing import standing
from greybox.diagnosis.extension import extended_model
from greybox.diagnosis.fitting import Problem
from greybox.diagnosis.hypothesis import Hypothesis
from greybox.diagnosis.null_model import FOLDS, DiagnosisProblem, run_on, runs_on
from greybox.diagnosis.point import Fit, Point
from greybox.diagnosis.quantities import quantities_of
from greybox.diagnosis.residuals import residual_tests
from greybox.diagnosis.result import (
    BudgetPart,
    Diagnosis,
    Found,
    Quantity,
    Ranked,
    Runs,
    Symptom,
    finite,
)
from greybox.diagnosis.ruling import rule
from greybox.diagnosis.search import Candidate, Search, backwards, instead
from greybox.diagnosis.ship import CURRENTS, Ship
from greybox.diagnosis.symptoms import find_symptoms
from greybox.diagnosis.thresholds import PROVEN, WORTH
from greybox.diagnosis.waves import Waves
from greybox.model.model import ManoeuvringModel
from greybox.model.structure import Structure
from greybox.numerics.linalg import scaled_inverse, sizes
from greybox.numerics.parallel import map_forked
from greybox.trial.convert.sensor_corrections import correct_log
from greybox.trial.log import TrialLog
from greybox.trial.validity import ranges, settings_of
from greybox.validation.bands import LEVEL, Z, predict_bands
from greybox.validation.fit import LogFit, fit_on
from greybox.validation.gain import Gain, gains

Array = NDArray[np.float64]

# models drawn from the covariance of the extended one, to see whether they stay bounded
_DRAWS = 64
# the terms of the extended model that stand for no cause, as a set of ids
_NAMELESS = frozenset({"terms without a name"})


class DiagnosisBuilder:
    """Turns a finished search into a diagnosis."""

    def __init__(
        self,
        case: DiagnosisProblem,
        structure: Structure,
        causes: Mapping[str, Cause],
        found: Search,
        given: ManoeuvringModel | None,
        seed: int,
        notes: Sequence[str],
        agreeing: frozenset[str] = frozenset(),
    ) -> None:
        self.notes, self.agreeing = list(notes), agreeing
        self.case, self.structure, self.causes = case, structure, causes
        self.found, self.given, self.seed = found, given, seed
        # the hypothesis that the extended model is
        self.final = found.final
        self.current: dict[str, tuple[float, float]] = {}
        if given is not None:
            self.current = {n: v for n, v in given.disturbances.items() if n in CURRENTS}

    def model(self, fit: Fit, record: Mapping[str, Any]) -> ManoeuvringModel:
        """Return a hypothesis as a model."""
        problem = self.case.problem(fit.integrator)
        if self.found.base is fit and self.given is not None:
            return self.given
        misfit = self._misfit(fit) if fit is self.found.final else 0.0
        return extended_model(
            self.structure, problem, fit, self.case.logs, record, self.current, misfit
        )

    def _misfit(self, fit: Fit) -> Array:
        """Return the covariance (q, q) of the final fit's numbers by what a generic force moves.

        With it the standard errors of a cause in the model are those that are told of it. The
        other numbers come along as the logs ask for: moved alone, or together with a force that
        the model does not have, they would be those of another ship.
        """
        problem = self.case.problem(fit.integrator)
        covariance = problem.covariance(fit)[1]
        moved: dict[int, float] = {}
        for cause in self.found.causes:
            # the fit holds those that stand already
            if cause.standing is not None and cause.told is None:
                where = problem.numbers_of(fit.point, cause.hypothesis)
                moved |= zip(where, cause.standing.moved, strict=False)
        mine = list(moved)
        if not mine or not np.isfinite(covariance).all():
            return np.zeros_like(covariance)
        own = covariance[np.ix_(mine, mine)]
        by = np.array(list(moved.values())) / sizes(own)
        along = covariance[:, mine] @ scaled_inverse(own)
        return np.asarray(along @ (own * np.outer(by, by)) @ along.T)

    @property
    def fit_told(self) -> Fit:
        """The fit that the extended model is: the given one's own where nothing extends it."""
        return self.found.before if self.final is self.found.base else self.final

    def cause(self, candidate: Candidate, fit: Fit) -> Found:
        """Return a candidate as it stands in a fit."""
        cause = self.causes[candidate.hypothesis.cause]
        quantities = quantities_of(self.case.problem(fit.integrator), candidate, fit)
        told = {k: (q.value, q.std) for k, q in quantities.items()}
        evidence = cause.evidence_of(candidate.hypothesis, told)
        if candidate.hypothesis.cause == "current":
            if not all(log.has_wind for log in self.case.logs):
                evidence += ", or in a steady wind that was not measured"
        elif self.case.metric == "free run" and not denied("lever_arm", self.agreeing):
            evidence += _or_alike(candidate.hypothesis)
        weighed = candidate.standing
        if weighed is not None and weighed.direction < PROVEN:
            less = 100 * (1 - weighed.direction)
            evidence += f", and {less:.1f} % of winds turned at random would explain less"
        if weighed is not None and weighed.stands and weighed.told >= PROVEN:
            evidence += ", its size not proven"
        return Found(
            candidate.hypothesis.id, candidate.hypothesis.key, cause.title, quantities,
            candidate.p_value, candidate.p_adjusted, evidence, cause.extension,
            cause.reference, candidate.gain, candidate.proof.gain, candidate.proof.std,
        )  # fmt: skip

    def made(
        self,
        known: Sequence[Found],
        validate: Sequence[TrialLog],
        tried: int,
        lines: Sequence[Waves | None],
    ) -> Diagnosis:
        """Return the diagnosis."""
        found, case = self.found, self.case
        groups = self._groups()
        before = self.model(found.without, self.record(()))
        changed = found.final is not found.base
        after = self.model(found.final, self.record(found.causes)) if changed else before
        gain, runs, after = self.gain(before, after, validate, found.final)
        speed = max(float(np.max(log["u"])) for log in case.logs)
        seconds = case.logs[0].vessel.trial_seconds(speed)
        ruling = rule(found, case.held_out, groups, known, gain, lines[1], seconds)
        final = self.final = ruling.final
        if final is not found.final:
            gain, runs, after = self.gain(before, before, validate, final)
        over_chosen: dict[str, Gain] = {}
        if found.chosen is not None and final is found.final and final is not found.chosen:
            chosen = self.model(found.chosen, self.record(()))
            over_chosen = self.gain(chosen, after, validate, final, found.chosen)[0]
        members = [c for pair in groups for c in pair]
        alternatives = {c.hypothesis.id: self.model(c.fit, self.record((c,))) for c in members}
        told = after if final is found.final else before
        budget = self._budget(final, ruling.named, lines[1])
        notes = [
            *self._notes(after),
            *ruling.notes,
            *without_share(budget, list(by_name(ruling.named))),
            *diverging(told, validate or case.logs),
        ]
        return Diagnosis(
            verdict=ruling.verdict,
            causes=(*known, *(self.cause(c, final) for c in ruling.named)),
            groups=tuple(tuple(c.hypothesis.id for c in pair) for pair in groups),
            gain=gain,
            gain_over_chosen=over_chosen,
            wrong=_symptoms(case.problem(found.before.integrator), found, lines[0]),
            residuals={
                "before": residual_tests(
                    case.problem(found.before.integrator), found.before, ruling.before, lines[0]
                ),
                "after": residual_tests(
                    case.problem(final.integrator), final, ruling.omnibus, lines[1]
                ),
            },
            partial=tuple(self.cause(c, c.fit) for c in ruling.leaning),
            candidates=tuple(self.cause(c, c.fit) for c in members),
            base=before,
            model=after,
            alternatives=alternatives,
            remaining=ruling.remaining,
            validated_on=self.where(validate),
            next_steps=tuple(ruling.next_steps),
            steps=tuple(_ranked(s.scores, s.candidates) for s in found.steps),
            runs=tuple(runs),
            notes=tuple(notes),
            tried=tried,
            record=self.record(found.causes),
            budget=budget,
        )

    def _budget(
        self, final: Fit, named: Sequence[Candidate], waves: Waves | None
    ) -> tuple[BudgetPart, ...]:
        """Return whose the held-out error is; what stands for several causes is not split."""
        found, held_out = self.found, self.case.held_out
        problem = self.case.problem(final.integrator)
        pairs = held_out(final.integrator).pairs(final)
        diagnosed = held_out(found.before.integrator).pairs(found.before)
        if any(p.fit.escaped or p.held_fit.escaped for p in pairs):
            return ()

        alike = by_name(named)
        late = [k for k, causes in alike.items() if all(c.hypothesis.past for c in causes)]
        before, first = found.before, self.case.first
        # those whose logs the extended model has to say, one by one, and those that act late
        asked: dict[frozenset[str], Callable[[], Array]] = {
            frozenset(): partial(errors_before, diagnosed, before, first)
        }
        for name in [k for k in alike if k not in late]:
            drop: Drop = partial(leave_out, [c.hypothesis for c in alike[name]])
            asked[frozenset({name})] = partial(errors_without, pairs, before, drop, first)
        together = [frozenset(s) for n in range(len(late)) for s in combinations(late, n + 1)]
        for some in together:
            acting = partial(_acting, [c.hypothesis for name in some for c in alike[name]])
            asked[some] = partial(errors_acting, pairs, before, acting, first)
        nameless = self._nameless(final)
        if nameless:
            drop = partial(_at_zero, nameless)
            asked[_NAMELESS] = partial(errors_without, pairs, before, drop, first)
        made = map_forked(lambda work: work(), list(asked.values()))
        errors = dict(zip(asked, made, strict=True))
        base, acting_late = errors[frozenset()], {some: errors[some] for some in together}
        parts = [
            SwitchedOff(
                name,
                errors[frozenset({name})],
                min(_relative(quantities_of(problem, c, final)) for c in causes),
                averaged(base, acting_late, name) if name in late and len(base) else None,
            )
            for name, causes in alike.items()
        ]
        return error_budget(base, pairs, parts, errors.get(_NAMELESS), waves, self.seed)

    def _nameless(self, final: Fit) -> frozenset[int]:
        """Return the places of terms of the extended model that stand for no cause."""
        problem = self.case.problem(final.integrator)
        own = {i for h in final.point.hypotheses for i in problem.numbers_at(h)}
        return frozenset({*final.point.places} - {*self.found.base.point.places} - own)

    def record(self, causes: Sequence[Candidate]) -> dict[str, Any]:
        """Return what a model file tells beside."""
        logs = self.case.logs
        return {
            "method": "diagnosis",
            "causes": [c.hypothesis.key for c in causes],
            "logs": [
                {"name": log.name, "sha256": log.provenance.sha256, "samples": len(log)}
                for log in logs
            ],
            "ranges": ranges(logs, self.structure.states),
            "settings": settings_of(logs),
        }

    def _groups(self) -> list[list[Candidate]]:
        asked = [*self._asked()]
        self.case.held_out(self.found.final.integrator).contributions(self.found.final)
        # candidates hold functions, which no other process can send: the few groups are made here
        many = map_forked(lambda way: len(self._group(*way)) > 1, asked)
        return [self._group(*way) for way, several in zip(asked, many, strict=True) if several]

    def _asked(self) -> Iterator[tuple[Candidate, Sequence[Candidate], Fit | None]]:
        """Yield causes, others that may do as well, and the fit that all of these began from.

        None where they are to be fitted beside the remaining causes.
        """
        causes, taken = self.found.causes, set()
        ids, keys = {c.hypothesis.cause for c in causes}, {c.hypothesis.key for c in causes}
        alone = len(causes) == 1 and not self.found.leaning
        for step in self.found.steps:
            if step.taken is None or step.taken.hypothesis.key not in keys:
                continue
            taken.add(step.taken.hypothesis.key)
            best = next(c for c in step.candidates if c.hypothesis.key == step.taken.hypothesis.key)
            others = [c for c in step.candidates if c.hypothesis.cause not in ids]
            yield best, others, step.before if alone else None
        for cause in causes:
            # those that the search began with, and what fell because they stand in its place
            if cause.hypothesis.key not in taken:
                like = [
                    c for c in self.found.leaning if turned_alike(c.hypothesis, cause.hypothesis)
                ]
                if like:
                    yield cause, like, None

    def _group(
        self, best: Candidate, others: Sequence[Candidate], without: Fit | None
    ) -> list[Candidate]:
        """Return a cause, and the candidates that do as well in its place."""
        if without is None:
            without, best, others = instead(self.case, self.found.final, best, others)
        like = rivals(self.case.problem, self.case.held_out, best, others)
        like = [
            c for c in like
            if not denied(c.hypothesis.key, self.agreeing) and self._stands(c, without)
        ]  # fmt: skip
        return [best, *like]

    def _stands(self, rival: Candidate, without: Fit) -> bool:
        """Whether a rival, too, does more than a generic force."""
        integrator = rival.fit.integrator
        problem, held_out = self.case.problem(integrator), self.case.held_out(integrator)
        return standing(
            problem, rival.hypothesis, rival.fit, without, held_out, self.found.tried
        ).stands

    def gain(
        self,
        before: ManoeuvringModel,
        after: ManoeuvringModel,
        validate: Sequence[TrialLog],
        final: Fit,
        first: Fit | None = None,
    ) -> tuple[dict[str, Gain], list[Runs], ManoeuvringModel]:
        """Return the gain on what is held out, all runs, and the model as those logs saw it.

        From a first fit on, by default that of the model without causes.
        """
        first = self.found.without if first is None else first
        logs = list(validate)
        if logs:
            later = _likelier_story(after, logs)
            one = runs_on(before, logs)
            seen = zip(runs_on(later, logs), logs, strict=True)
            two = [self._as_seen(run, log, final) for run, log in seen]
        else:
            later, pairs = after, self.case.held_out(first.integrator).pairs(first)
            one = held_runs(pairs)
            if before is self.given:
                one = [run_on(before, run.log) for pair in pairs for run in pair.held.runs]
            two = held_runs(self.case.held_out(final.integrator).pairs(final))
        runs = [
            Runs(
                a.log, held,
                {s: a.log[s] for s in a.fit},
                {s: a.x[:, i] for i, s in enumerate(a.fit)},
                _as_shown(a, b),
            )
            for held, ones, twos in (
                (False, runs_on(before, self.case.logs), runs_on(after, self.case.logs)),
                (True, one, two),
            )
            for a, b in zip(ones, twos, strict=True)
        ]  # fmt: skip
        return gains(one, two, self.case.logs[0].sample_time, self.seed), runs, later

    def _as_seen(self, run: LogFit, log: TrialLog, final: Fit) -> LogFit:
        """Return a run as sensors away from the origin show it, beside the log as it is.

        A log that is carried to the origin has the noise of the yaw rate, times the lever,
        in its velocities; a run that is carried to the sensors has none.
        """
        sensors = final.point.ship.sensors
        if not any(sensors.lever) or len(run.log) != len(log):
            return run
        seen = self.case.problem(final.integrator).runs[0]
        outputs = np.column_stack([run.x, run.psi])[:, : len(seen.outputs)]
        x = seen.sense(sensors, outputs[..., None])[:, : len(seen.states), 0]
        return replace(run, log=log, x=x, fit=fit_on(log, seen.states, x))

    def where(self, validate: Sequence[TrialLog]) -> str:
        """Say what is held out."""
        if validate:
            return f"on {', '.join(log.name for log in validate)}, held out from the fit"
        return (
            f"on {FOLDS} parts of the logs, each predicted by a fit to the others, because no "
            f"validation log was given"
        )

    def _notes(self, after: ManoeuvringModel) -> list[str]:
        out = list(self.notes)
        if self.given is not None:
            out.append(
                "'before' is the model as it was given; with a cause its coefficients are "
                "estimated again, so a cause is only what other coefficients cannot explain."
            )
        sure = {
            n for n, value, std in zip(after.names, after.theta, after.std, strict=True)
            if abs(value) > Z * std
        }  # fmt: skip
        turned = [
            n for n in backwards(self.found.final, self.case.universe.parameters) if n in sure
        ]
        if turned:
            out.append(
                f"{', '.join(turned)} came out negative: some thruster's column has the wrong sign "
                f"or stands in another's place; greybox check may tell which."
            )
        final = self.found.final
        limited = at_limit(self.case.problem(final.integrator), final.point)
        if limited:
            out.append(
                f"{', '.join(limited)} ended at the most damping that a step can take: it, and the "
                f"coefficients and causes that make up for it, say little by themselves."
            )
        sensors = final.point.ship.sensors
        if any(sensors.lever):
            out.append(
                "the gain is measured on the log as its sensors show it; greybox compare moves "
                "the velocities to the origin, which adds the noise of the yaw rate, times the "
                "lever arm, to u and v."
            )
        elif sensors.turned or sensors.late:
            out.append(
                "the gain is of the motion as the log shows it; greybox compare measures the fit "
                "of the motion that the corrected sensors show."
            )
        kept = kept_without_name(self.found)
        if kept:
            out.append(
                f"the extended model keeps {', '.join(kept)}, no better than a generic force: "
                f"without it held-out free runs are worse by more than {100 * WORTH:g} % of the "
                f"squared error."
            )
        for change in after.changes:
            out.append(f"the extended model tells the log's own clock: {change.sentence}.")
        return out


def _or_alike(hypothesis: Hypothesis) -> str:
    """Return what else a cause may be where only forces tell, to stand behind its evidence."""
    if hypothesis.cause == "inertia_coupling":
        return ", or an antenna ahead or abaft of where the vessel file has it, which looks alike"
    if any(p.name == "lever_arm_x" for p in hypothesis.parameters):
        return ", or coupled inertia of sway and yaw, which looks alike"
    return ""


def at_limit(problem: Problem, point: Point) -> list[str]:
    """Return coefficients of damping that ended at the most that a step can take."""
    least, values = problem.bounds(point)[0], point.vector()
    return [
        problem.names[i]
        for i, low, value in zip(point.places, least, values, strict=False)
        if np.isfinite(low) and np.isclose(value, low)
    ]


def kept_without_name(found: Search) -> list[str]:
    """Return what is in force in the end though it does not stand: ids of causes."""
    named = {c.hypothesis.key for c in found.causes}
    left = {h.key for h in found.final.point.hypotheses} - named
    return list(dict.fromkeys(c.hypothesis.id for c in found.leaning if c.hypothesis.key in left))


def diverging(model: ManoeuvringModel, logs: Sequence[TrialLog]) -> list[str]:
    """Say how many models drawn from a model's covariance diverge, where they are many.

    Parameters
    ----------
    model : ManoeuvringModel
    logs : sequence of TrialLog
        The longest is run.

    Returns
    -------
    list of str
        One sentence, or none where the draws that diverge are fewer than those that 95 %
        limits leave out.
    """
    longest = correct_log(max(logs, key=len), model.vessel)
    bands = predict_bands(model, longest, runs=_DRAWS)
    if bands.diverged <= (1 - LEVEL) * bands.runs:
        return []
    return [
        f"of {bands.runs} models drawn from the covariance of the model that --out writes, "
        f"{bands.diverged} diverge on {longest.name}: its coefficients are too uncertain for the "
        f"intervals of greybox predict and simulate. Diagnose longer logs, or begin from a "
        f"smaller --structure."
    ]


def by_name(causes: Sequence[Candidate]) -> dict[str, list[Candidate]]:
    """Return causes by the id that tells them: two asymmetries are one part of an error."""
    found: dict[str, list[Candidate]] = {}
    for cause in causes:
        found.setdefault(cause.hypothesis.id, []).append(cause)
    return found


def leave_out(hypotheses: Sequence[Hypothesis], problem: Problem, point: Point) -> Point:
    """Return a point of the extended model without some of its hypotheses."""
    for hypothesis in hypotheses:
        point = problem.drop(point, hypothesis)
    return point


def _acting(hypotheses: Sequence[Hypothesis], point: Point, ship: Ship) -> Ship:
    """Return a ship with some hypotheses as they are in a point of the extended model."""
    keys = {h.key for h in hypotheses}
    for hypothesis, value in zip(point.hypotheses, point.values, strict=True):
        if hypothesis.key in keys and hypothesis.apply is not None:
            ship = hypothesis.apply(ship, value)
    return ship


def _at_zero(terms: frozenset[int], problem: Problem, point: Point) -> Point:
    base = point.base
    for i in terms:
        base = base.with_value(i, 0.0)
    return replace(point, base=base, places=tuple(i for i in point.places if i not in terms))


def _relative(quantities: Mapping[str, Quantity]) -> float:
    """Return the standard error of a cause's size as a share of it, of its surest number."""
    known = [q.std / abs(q.value) for q in quantities.values() if q.value]
    return min([1.0, *known])


def _ranked(scores: Sequence[Any], candidates: Sequence[Candidate]) -> tuple[Ranked, ...]:
    # a cause whose run leaves every bound at first promises nothing that can be drawn
    promised = {s.hypothesis.key: max(float(s.gain), 0.0) for s in scores}
    fitted = {c.hypothesis.key: c for c in candidates}
    keys = dict.fromkeys([*fitted, *promised])
    return tuple(
        Ranked(
            key, float(promised.get(key, 0.0)), fitted[key].gain,
            finite(fitted[key].proof.gain), finite(fitted[key].proof.std),
        )
        if key in fitted
        else Ranked(key, float(promised[key]))
        for key in keys
    )  # fmt: skip


def _likelier_story(model: ManoeuvringModel, logs: Sequence[TrialLog]) -> ManoeuvringModel:
    """Return the model with its changes within logs, or made before: whichever fits better."""
    if not model.changes:
        return model
    settled = model.at_final_parameters()

    def missed(candidate: ManoeuvringModel) -> float:
        return sum(
            float(np.nansum((run.log.measured(s) - run.x[:, i]) ** 2))
            / max(float(np.var(run.log[s])), 1e-12)
            for run in runs_on(candidate, logs)
            for i, s in enumerate(run.fit)
        )

    return settled if missed(settled) < missed(model) else model


def _as_shown(before: LogFit, after: LogFit) -> dict[str, Array]:
    """Return a run on a corrected log as its sensors would show it on the log as it is."""
    if all(np.array_equal(before.log[s], after.log[s]) for s in after.fit):
        # to the last digit: a model that stays as it is has one run
        return {s: after.x[:, i] for i, s in enumerate(after.fit)}
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


def _symptoms(problem: Problem, found: Search, waves: Waves | None) -> tuple[Symptom, ...]:
    told = find_symptoms(problem, found.before, waves)
    if not told and found.causes:
        told = [
            Symptom(
                "at single samples the errors are no larger than the sensors' noise; they show "
                "only over all samples together",
                "", 0.0,
            )
        ]  # fmt: skip
    return tuple(told)


def held_runs(pairs: Sequence[Pair]) -> list[LogFit]:
    """Return the free runs on what is held out."""
    out = []
    for pair in pairs:
        ship = pair.held_fit.point.ship
        for run, start in zip(pair.held.runs, pair.held_fit.point.starts, strict=True):
            x = run.run(ship, start).y[:, : len(run.states)]
            out.append(
                LogFit(
                    run.log, x, run.log["psi"] if "psi" in run.log else np.zeros(len(x)),
                    fit_on(run.log, run.states, x), -1,
                )
            )  # fmt: skip
    return out
