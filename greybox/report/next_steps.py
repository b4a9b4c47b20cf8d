"""What to do after a command, as its page and the terminal tell it."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from greybox.channels import MOTION_WORDS
from greybox.estimation.prediction_verdict import PredictionLevel
from greybox.estimation.verdict import TrustLevel

if TYPE_CHECKING:
    from greybox.estimation.result import Estimate
    from greybox.fleet.fleet import Fleet
    from greybox.model.model import ManoeuvringModel
    from greybox.prediction.result import ManoeuvrePrediction
    from greybox.trial.checks.finding import CheckReport
    from greybox.trial.raw_log import Recording
    from greybox.validation.comparison import Comparison
    from greybox.vessel.vessel import Vessel

# files that a command line is still read with
_MOST_TYPED = 3
# what logs are files of
_TABLES = {"CSV", "Parquet"}
# angle from which on next steps round it [deg]
_WHOLE = 10.0
_DOUBTED = (PredictionLevel.LIMITED, PredictionLevel.POOR)


@dataclass(frozen=True)
class NextStep:
    """What to do next: what for, and the command for it, if there is one."""

    purpose: str
    command: str = ""

    def line(self) -> str:
        """Return it as the terminal shows it."""
        told = self.purpose[:1].lower() + self.purpose[1:]
        return f"next: {told}{': ' * bool(self.command)}{self.command}"


def typed(record: Mapping[str, Any], option: str, stand_in: str) -> str:
    """Return what a command was given for an option, as it is typed in the next one.

    Parameters
    ----------
    record : mapping
        As a command records it.
    option : str
        Its name in ``record["command"]``.
    stand_in : str
        What stands for it where it was not given, or where it is a long list.
    """
    given = record.get("command", {}).get(option)
    several = [str(g) for g in (given if isinstance(given, (list, tuple)) else [given]) if g]
    if not 0 < len(several) <= _MOST_TYPED or "-" in several:
        return stand_in
    return shlex.join(several)


def after_import(out: str, vessel: str, lacking: Sequence[str] = ()) -> NextStep:
    """Return what to do with the log, or the folder of logs, which lacks these columns."""
    if lacking:
        why = {"psi": "sway and yaw need the heading"}.get(
            lacking[0], "a model needs what moves the thrusters"
        )
        columns, unit = ("columns", "their units") if len(lacking) > 1 else ("column", "its unit")
        return NextStep(
            f"Name the raw {columns} of {', '.join(lacking)}, with {unit}, in the vessel file's "
            f"[columns], and import again: {why}"
        )
    return NextStep(
        "See whether sensors and the vessel file are right",
        f"greybox check {shlex.quote(out)} --vessel {shlex.quote(vessel)} --report check.html",
    )


def after_estimate(estimate: Estimate, record: Mapping[str, Any]) -> list[NextStep]:
    """Return what the verdicts ask for next."""
    from greybox.diagnosis.preparing import SHORTEST

    vessel, model = typed(record, "vessel", "V"), typed(record, "out", "MODEL")
    logs, validate = typed(record, "logs", "LOG…"), typed(record, "validate", "")
    level = estimate.prediction.level if estimate.prediction else PredictionLevel.NOT_JUDGED
    trust = estimate.meant.verdict.level
    structure = estimate.predictor.structure
    turns = "r" in structure.states
    steps = []
    short = max((log["samples"] for log in estimate.logs), default=SHORTEST) < SHORTEST
    doubtful = level in _DOUBTED or trust is TrustLevel.DO_NOT_TRUST
    if doubtful and short:
        steps.append(_sail_longer(vessel, model))
    elif doubtful:
        held = f" --validate {validate}" if validate else ""
        held += "" if turns else f" --structure {shlex.quote(structure.name)}"
        steps.append(
            NextStep(
                "Find what the simulation gets wrong, and why",
                f"greybox diagnose {logs} --vessel {vessel}{held} --report diagnosis.html",
            )
        )
    if level is PredictionLevel.GOOD:
        steps += predict_step(model, estimate.vessel, turns)
    if level is PredictionLevel.NOT_JUDGED:
        steps.append(
            NextStep(
                "See how well it predicts a log that it was not estimated on",
                f"greybox compare {model} --log LOG --report compare.html",
            )
        )
    if trust is TrustLevel.TRUST_EXCEPT:
        steps.append(
            NextStep(
                "Plan a trial that narrows the intervals of the coefficients",
                f"greybox design --vessel {vessel} --model {model} --for coefficients "
                f"--duration 900 --out plan.csv",
            )
        )
    return steps or [_use(model)]


def _sail_longer(vessel: str, model: str) -> NextStep:
    from greybox.diagnosis.preparing import SHORTEST

    return NextStep(
        f"Sail a longer trial, since a diagnosis needs {SHORTEST} samples; plan it with this model",
        f"greybox design --vessel {vessel} --model {model} --duration 900 --out plan.csv",
    )


def predict_step(model: str, vessel: Vessel, turns: bool) -> list[NextStep]:
    """Return the manoeuvre that a model predicts, of a ship that can be steered for it."""
    from greybox.prediction.helm import find_helm
    from greybox.prediction.steady import kept_from_straight

    helm = find_helm(vessel)
    if turns and helm.kind == "none":
        return []
    kind = "zigzag" if turns else "stopping"
    free = " --no-limits" if turns and kept_from_straight(helm) else ""
    return [
        NextStep(
            "Predict manoeuvres of the ship",
            f"greybox predict {model} {kind}{free} --report {kind}.html",
        )
    ]


def _use(model: str) -> NextStep:
    """Return what a model is for, where nothing has to be done for it."""
    return NextStep(
        "Use it in a program of your own", f"greybox export {model} --to c --out model.c"
    )


def _is_log(recording: Recording) -> bool:
    """Whether a file is read as a log is: a table that states what each column is."""
    tables = {f.format for f in recording.files} <= _TABLES
    return tables and not recording.guessed


def after_check(
    reports: Sequence[CheckReport], ship: Vessel, record: Mapping[str, Any]
) -> list[NextStep]:
    """Return what to do with the logs as they were found."""
    logs, vessel = typed(record, "logs", "LOG…"), typed(record, "vessel", "V")
    found = [f for r in reports for f in r.findings]
    target = "mended.csv" if len(reports) == 1 else "mended"
    mend = f"greybox import {logs} --vessel {vessel} --out {target} --fix"
    steps = []
    if any(f.safe for f in found):
        steps.append(NextStep("Mend what needs no judgement", mend))
    judged = dict.fromkeys(f.id for f in found if f.repair and not f.safe)
    if judged:
        also = " ".join(f"--fix-also {i}" for i in judged)
        what = "these too where their pictures" if steps else "what needs judgement where pictures"
        steps.append(NextStep(f"Mend {what} convince you", f"{mend} {also}"))
    lacking = [
        f"Name the raw column of '{r.name}' that holds {what}, with its unit, in the vessel file's "
        f"[columns], and import again: {why}"
        for r in reports
        for name, what, why in (
            ("psi", "the heading as psi", "models of sway and yaw need it"),
            *((n, n, f"it moves the thrusters of '{ship.name}'") for n in ship.commands),
        )
        if r.recording is not None and name not in r.recording
    ]
    raw = any(r.recording is not None and not _is_log(r.recording) for r in reports)
    if lacking:
        # what is mended before lacks the column too
        steps.insert(0, NextStep(lacking[0]))
    elif not steps and raw:
        target = "log.csv" if len(reports) == 1 else "imported"
        steps.append(
            NextStep(
                "Read raw files into logs, which models are estimated on",
                f"greybox import {logs} --vessel {vessel} --out {target}",
            )
        )
    elif not steps:
        steps.append(
            NextStep(
                "Estimate a model",
                f"greybox estimate {logs} --vessel {vessel} --out model.json --report model.html",
            )
        )
    return steps


def after_comparison(
    comparison: Comparison, models: Sequence[ManoeuvringModel], record: Mapping[str, Any]
) -> list[NextStep]:
    """Return what the verdict asks for next, of the best model."""
    given = [shlex.quote(str(path)) for path in record.get("command", {}).get("models", ())]
    best, verdict = comparison.best(), comparison.verdict
    name, model = verdict.best, given[best] if best < len(given) else "MODEL"
    again = f"greybox compare {' '.join(given) or 'MODEL…'} --log LOG --report compare.html"
    if verdict.in_sample:
        logs = "a log that it was not" if len(models) == 1 else "a log that none of them was"
        return [NextStep(f"Compare on {logs} estimated on", again)]
    if verdict.untested:
        return [NextStep("Compare on a log in which the ship moves more", again)]
    # a model that states no vessel file is of the same ship as those beside it
    stated = (typed(m.record.get("provenance", {}), "vessel", "") for m in (models[best], *models))
    vessel = next(filter(None, stated), "V")
    logs = typed(record, "log", "LOG…")
    fewer = fewer_terms(models[best])
    if verdict.diverging and fewer:
        return [NextStep(f"Estimate fewer terms than '{name}' has, and compare again", fewer)]
    from greybox.diagnosis.preparing import SHORTEST

    wrong = NextStep(
        f"Find what '{name}' gets wrong in these logs, and why",
        f"greybox diagnose {logs} --vessel {vessel} --model {model} --report diagnosis.html",
    )
    if max(run.samples for run in comparison.runs[best]) < SHORTEST:
        wrong = _sail_longer(vessel, model)
    if verdict.diverging or verdict.weak:
        return [wrong]
    turns = "r" in models[best].structure.states
    steps = predict_step(model, models[best].vessel, turns) or [_use(model)]
    if verdict.rivals:
        steps.append(NextStep("Tell these models apart on further logs", again))
    elif verdict.beyond_noise:
        steps.append(wrong)
    return steps


def _within_the_logs(made: ManoeuvrePrediction, model: str) -> list[NextStep]:
    """Return what to do where a prediction goes beyond the logs of its model."""
    import math

    ship = made.manoeuvres[0].log.vessel
    orders = [abs(m.order) for m in made.manoeuvres if m.order is not None and m.extrapolated]
    beyond = made.extrapolated
    steered = [e for e in beyond if e.signal in ship.angle_commands] if orders else []
    for e in steered:
        known = math.degrees(min(abs(bound) for bound in e.known))
        # a whole degree may lie as far beyond as counts as known
        angle = f"{round(known) if known >= _WHOLE else math.floor(10 * known) / 10:g}"
        asked = f"{math.degrees(max(orders)):.3g}"
        turn = {"turning": "turn", "zigzag": "zig-zag"}[made.kind]
        if 0 < float(angle) < float(asked):
            return [
                NextStep(
                    f"Your logs go to {angle} deg of {e.signal}: sail a {asked} deg {turn} and "
                    f"estimate with its log too, or predict what they hold",
                    f"greybox predict {model} {made.kind} --angle {angle}",
                )
            ]
    told = []
    for e in beyond:
        factor, unit = e.shown
        low, high = (f"{bound * factor:.3g}" for bound in e.known)
        told.append(f"{low} to {high}{unit} of {MOTION_WORDS.get(e.signal, e.signal)}")
    return [
        NextStep(
            f"Your logs hold {' and '.join(told)}: sail this manoeuvre, or another that goes as "
            f"far, and estimate with its log too"
        )
    ] * bool(told)


def fewer_terms(model: ManoeuvringModel) -> str:
    """Return the command that estimates a model of fewer terms on the same logs."""
    record = model.record.get("provenance", {})
    if record.get("command", {}).get("reduce"):
        return ""
    validate = typed(record, "validate", "")
    held = f" --validate {validate}" if validate else ""
    return (
        f"greybox estimate {typed(record, 'logs', 'LOG…')} --vessel {typed(record, 'vessel', 'V')}"
        f"{held} --reduce --out reduced.json"
    )


def after_prediction(
    made: ManoeuvrePrediction, record: dict[str, Any], vessel: str, fewer: str = ""
) -> list[NextStep]:
    """Return what makes the prediction surer, or puts it to the test.

    `fewer` is the command that estimates fewer terms, for a model whose draws diverge.
    """
    from greybox.prediction.result import CRITERIA
    from greybox.trial.manoeuvres import Compliance

    model = typed(record, "model", "MODEL")
    agreements = [m.agreement for m in made.manoeuvres if m.agreement is not None]
    steps = _within_the_logs(made, model)
    if fewer and any(m.diverged for m in made.manoeuvres):
        steps.append(
            NextStep(
                "Estimate fewer terms, as some draws of this model diverge, and predict", fewer
            )
        )
    if made.instant:
        ship = made.manoeuvres[0].log.vessel
        rates = dict.fromkeys(
            f"{kind}_rate"
            for t in ship.thrusters
            for kind, column, _, _ in t.movements
            if column in made.instant
        )
        steps.append(
            NextStep(
                f"State {' and '.join(rates)} in the vessel file, estimate again, and predict with "
                f"that model: orders of {', '.join(made.instant)} act at once in this one (where "
                f"they do on board, state a high rate)"
            )
        )
    speeds = [q.value for m in made.manoeuvres if (q := m.quantities["approach_speed"])]
    seconds = made.manoeuvres[0].log.vessel.trial_seconds(max(speeds, default=0.0))
    if any(
        c.verdict is Compliance.OPEN and CRITERIA.get(c.name) not in m.resting
        for m in made.manoeuvres
        for c in m.criteria
    ):
        steps.append(
            NextStep(
                "Plan a trial that narrows these intervals",
                f"greybox design --vessel {vessel} --model {model} --duration {seconds:g} "
                f"--out plan.csv",
            )
        )
    if made.prediction in _DOUBTED or not all(r.agrees for a in agreements for r in a.rows):
        steps.append(
            NextStep(
                "Find what the model gets wrong, and why",
                f"greybox diagnose {typed(record, 'trial', 'LOG')} --vessel {vessel} "
                f"--model {model} --report diagnosis.html",
            )
        )
    if not agreements:
        steps.append(
            NextStep(
                "Compare it with the manoeuvre once that has been sailed",
                f"greybox predict {model} {made.kind} --trial LOG --report beside.html",
            )
        )
    return steps or [_use(model)]


def after_fleet(fleet: Fleet, record: Mapping[str, Any]) -> list[NextStep]:
    """Return what the verdict asks for next."""
    folder = typed(record, "fleet", "DIR")

    def files(ship: str) -> str:
        # quoted but for the star, which the shell expands
        place = f"{folder}/{shlex.quote(ship)}"
        return f"{place}/*.csv --vessel {place}/*.toml"

    odd = [fleet.ships[c.unit].name for c in fleet.differing]
    changing = list(dict.fromkeys(c.ship for c in fleet.changes()))
    out = [one.ship for one in fleet.left_out]
    causes = "before hull or propeller are blamed"
    steps = [
        NextStep(purpose.format(ships[0]), f"greybox check {files(ships[0])} --report check.html")
        for purpose, ships in (
            ("See whether sensors or the vessel file make '{}' differ", odd),
            (f"See whether a sensor of '{{}}' changed, {causes}", changing),
            ("See what is wrong with the logs of '{}', which was left out", out),
        )
        if ships and not (ships is changing and ships[0] in odd)
    ]
    first = (odd or [fleet.ships[0].name])[0]
    steps.append(
        NextStep(
            f"See how far to trust the model of '{first}' alone",
            f"greybox estimate {files(first)} --report {shlex.quote(first)}.html",
        )
    )
    return steps
