"""The page of `greybox diagnose`: what is wrong, why, how the model changes, what it gains."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from greybox.channels import CHANNELS, MOTION_WORDS
from greybox.diagnosis.result import Diagnosis, DiagnosisVerdict, Runs, hardly_split, is_split
from greybox.report.chart import chart_of
from greybox.report.diagnosed_causes import cause_section, probability
from greybox.report.diagnosis_figures import (
    LOWEST_FIT,
    command_figure,
    gain_figure,
    heading_figure,
    leaves_picture,
    most_followed,
    regime_figure,
    run_figure,
    speed_figure,
)
from greybox.report.error_budget import (
    budget_figure,
    budget_in_words,
    budget_table,
    cut_off,
    largest,
    noise_sentence,
    noise_shares,
    tells,
)
from greybox.report.figures import narrow
from greybox.report.free_run_errors import REGIMES, Errors, gather, simulations
from greybox.report.model_difference import (
    coefficient_table,
    marked_equations,
    other_changes,
)
from greybox.report.next_steps import NextStep
from greybox.report.page import Page, Picture, Section, Table, capital, computed
from greybox.report.thinning import points_for
from greybox.validation.comparison_verdict import use_sentence
from greybox.validation.fit import fit_percent, mean_fit, percent
from greybox.validation.gain import Gain

# logs of each kind that are drawn: with more the page grows and tells nothing new
_MOST_LOGS = 3
# characters of a verdict that leave room for the next step on the first screen
_LONGEST = 330


def diagnosis_page(diagnosis: Diagnosis, record: Mapping[str, Any]) -> Page:
    """Return the page, its story first.

    Parameters
    ----------
    diagnosis : Diagnosis
    record : mapping
        How it was computed: versions, command, hashes of the logs, seed.
    """
    if not _changed(diagnosis):
        # parts that are predicted by fits to the others are no other model
        alike = tuple(replace(run, after=run.before) for run in diagnosis.runs)
        diagnosis = replace(diagnosis, runs=alike)
    wrong, gain = _wrong(diagnosis), gain_section(diagnosis)
    # whose the error is says most; without it, what was gained; without that, the run itself
    budget = list(_budget(diagnosis))
    first = [*gain.pictures, *wrong.pictures[_telling(diagnosis.runs) :][:1]]
    # a picture of shares that the logs do not tell is empty
    lead = next(iter([*budget, *first] if tells(diagnosis.budget) else [*first, *budget]), None)
    sections = [
        replace(wrong, pictures=[p for p in [*wrong.pictures, *budget] if p is not lead]),
        cause_section(diagnosis),
        _equations(diagnosis),
        replace(gain, pictures=[p for p in gain.pictures if p is not lead]),
        _remains(diagnosis),
    ]
    if diagnosis.notes:
        sections.append(Section("Notes", points=diagnosis.notes))
    headline = " ".join(filter(None, [_headline(diagnosis), _use(diagnosis)]))
    return Page(
        title="What the simulation gets wrong, and why",
        headline=capital(headline),
        sentences=_summary(diagnosis),
        sections=sections,
        lead=lead,
        next_steps=[_step(step) for step in diagnosis.next_steps],
        computed=computed(dict(diagnosis.record) | dict(record))
        | {
            "causes scored": str(diagnosis.tried),
            "fall of −2 log L": "of the free run's errors, their noise coloured; a cause counts "
            "when it is significant after correction for all that were tried (Holm) and "
            "predicts logs, or parts of logs, that it was not fitted to",
            "intervals of mean errors": "95 %, from blocks of samples longer than the errors' "
            "memory (Liang and Zeger, 1986)",
        },
    )


def _headline(diagnosis: Diagnosis) -> str:
    """Return the verdict, causes by their titles alone where all of it would fill the screen."""
    # why it is not only noise is enough here: what remains has a section of its own
    first = diagnosis.remaining.split(". ")[0].rstrip(".")
    told = diagnosis.headline.replace(diagnosis.remaining, f"{first}.")
    if len(diagnosis.causes) < 2 or len(told) <= _LONGEST:
        return told
    count = Counter(c.title for c in diagnosis.causes)
    titles = "; ".join(
        # causes of one title are told apart by what they estimate
        f"{c.title} ({', '.join(c.parameters)})" if count[c.title] > 1 else c.title
        for c in diagnosis.causes
    )
    rest = " They do not explain all of it." if diagnosis.verdict == "partly" else ""
    return f"{len(diagnosis.causes)} causes stand: {titles}.{rest}"


def _use(diagnosis: Diagnosis) -> str:
    """Return whether the model predicts what it was not fitted to, beside what noise allows."""
    if not diagnosis.gain:
        return ""
    which = "the extended model" if diagnosis.extended else "the model"
    if diagnosis.verdict == DiagnosisVerdict.CONFUSED:
        held = ", ".join(diagnosis.model.record.get("causes", ())) or diagnosis.groups[0][0]
        which = f"the model with {held}"
    fit = diagnosis.held_out_fit
    return use_sentence(which, "data held out from the fit", fit, diagnosis.noise_bounds())


def _step(told: str) -> NextStep:
    """Return a step with its command, or options of one, apart from the words before it."""
    purpose, *command = re.split(r": (?=greybox |--)", told.rstrip("."), maxsplit=1)
    return NextStep(capital(purpose), *command)


def _summary(diagnosis: Diagnosis) -> list[str]:
    told = [f"Verdict: {diagnosis.verdict}, after {diagnosis.tried} causes were tried."]
    if diagnosis.gain and _changed(diagnosis):
        gains = ", ".join(
            f"{MOTION_WORDS.get(s, s)} from {percent(g.before)} to {percent(g.after)}"
            for s, g in diagnosis.gain.items()
        )
        told.append(f"The fit of the free run (100 % is perfect) changes: {gains}.")
    if diagnosis.budget:
        told += noise_sentence(noise_shares(diagnosis), diagnosis.noise_bounds())
    return told


def _remains(diagnosis: Diagnosis) -> Section:
    """Show what is left, and the force without a name where one was asked for."""
    told, tables = [diagnosis.remaining], _tests(diagnosis, "after")
    remainder = diagnosis.remainder
    if remainder is not None:
        told.append(remainder.reason)
        if remainder.gain:
            caption = f"Fit of the free run (6.12) {remainder.validated_on}"
            without = ("without that force", "with it")
            tables = [_gain_table(caption, remainder.gain, without), *tables]
    return Section("5. What remains", told, tables=tables)


def _changed(diagnosis: Diagnosis) -> bool:
    """Whether there is another model to show: extended, or with coefficients that fit better."""
    gains = diagnosis.gain.values()
    found = diagnosis.verdict != DiagnosisVerdict.NONE and any(g.before != g.after for g in gains)
    return diagnosis.extended or found


def _wrong(diagnosis: Diagnosis) -> Section:
    """Show what the simulation gets wrong, in sentences and pictures."""
    sentences = [] if diagnosis.wrong else ["Nothing beyond noise."]
    pictures: list[Picture] = []
    if diagnosis.runs:
        errors = gather(diagnosis.runs)
        pictures = [*_run_pictures(diagnosis.runs), *_followed(errors)]
        left_out = len(diagnosis.runs) - len(_drawn(diagnosis.runs))
        if left_out:
            sentences.append(
                f"Of {len(diagnosis.runs)} logs the first {_MOST_LOGS} of each kind are drawn "
                f"against time; all are in the means."
            )
        if len(errors.regimes) == 1:
            sentences.append(
                f"All samples lie in one regime of signs, {REGIMES[errors.regimes[0]]}."
            )
        if errors.lost:
            sentences.append(
                f"The free run has ended or runs away at {errors.lost} of {errors.samples} "
                f"samples; mean errors leave these out."
            )
    return Section(
        "1. What the simulation gets wrong",
        sentences,
        pictures,
        [
            *_tests(diagnosis, "before"),
            *([budget_table(b)] if (b := budget_in_words(diagnosis)) else []),
        ],
        points=[s.sentence for s in diagnosis.wrong],
    )


def _budget(diagnosis: Diagnosis) -> Iterator[Picture]:
    """Yield whose the squared error is."""
    if budget := budget_in_words(diagnosis):
        caption = "Sources of the squared error of the held-out free run"
        caption += (
            ", before and after the model is extended; the part of a cause is how much smaller "
            "the error would be without it."
            if _changed(diagnosis)
            else "."
        )
        if not all(is_split(p, state) for p in budget for state in p.share):
            caption += " Shares that the logs do not determine are not drawn."
        if cut_off(budget):
            caption += " Shares beyond the picture's edge stand in the table of the budget."
        caption += f" {told}" if (told := hardly_split(budget)) else ""
        told = f"{caption} Largest part of {largest(budget)}."
        yield narrow(budget_figure(budget, _changed(diagnosis)), "budget", caption, told)


def _tests(diagnosis: Diagnosis, when: str) -> list[Table]:
    """Show the tests of the free run's errors, where there are any."""
    rows = [
        [t.null, "" if t.p_value is None else probability(t.p_value), t.sentence]
        for t in diagnosis.residuals.get(when, ())
    ]
    caption = f"Tests of the free run's errors, {when}"
    return (
        [Table(caption, ["null hypothesis", "p", "result"], rows, sentences=True)] if rows else []
    )


def _followed(errors: Errors) -> Iterator[Picture]:
    """Yield what the error goes with: heading, speed, a command, signs."""
    means = (
        "Mean of measured − simulated with its 95 % interval (none where too little of the logs "
        "is there to say)"
    )
    told = _rms_sentence(errors)
    if errors.heading is not None:
        yield narrow(
            heading_figure(errors), "heading", f"{means}, by heading.",
            f"Mean error of each state against the heading. {told}",
        )  # fmt: skip
    if errors.speed is not None:
        yield narrow(
            speed_figure(errors), "speed", f"{means}, by speed.",
            f"Mean error of each state against the speed. {told}",
        )  # fmt: skip
    command = most_followed(errors)
    if command is not None:
        yield narrow(
            command_figure(errors, command), "command",
            f"{means}, by the command that it goes with most, {command}.",
            f"Mean error of each state against the command {command}. {told}",
        )  # fmt: skip
    if len(errors.regimes) > 1:
        yield narrow(
            regime_figure(errors), "regime",
            "Root mean square error with its 95 % interval, by the signs of surge and sway.",
            f"Bars of the root mean square error by the signs of surge and sway. {told}",
        )  # fmt: skip


def _rms_sentence(errors: Errors) -> str:
    parts = []
    for state in errors.states:
        sizes = ", ".join(f"{errors.rms(name, state):.3g} {name}" for name in errors.error)
        parts.append(f"{MOTION_WORDS.get(state, state)} [{CHANNELS[state].unit}] {sizes}")
    return f"Root mean square errors: {'; '.join(parts)}."


def _drawn(runs: Sequence[Runs]) -> list[Runs]:
    kinds = ([r for r in runs if r.held_out is held] for held in (False, True))
    return [r for kind in kinds for r in kind[:_MOST_LOGS]]


def _telling(runs: Sequence[Runs]) -> int:
    """Return which of the runs that are drawn is followed worst, of those held out if any are."""
    drawn = _drawn(runs)
    held = [i for i, run in enumerate(drawn) if run.held_out] or range(len(drawn))

    def followed(i: int) -> float:
        run = drawn[i]
        return mean_fit({s: float(fit_percent(y, run.before[s])) for s, y in run.measured.items()})

    return min(held, key=followed, default=0)


def _run_pictures(runs: Sequence[Runs]) -> Iterator[Picture]:
    drawn = _drawn(runs)
    curves = sum(len(r.measured) * (1 + 2 * len(simulations(r))) for r in drawn)
    points = points_for(curves, most=10_000, room=120_000)
    for i, run in enumerate(drawn):
        kind = "held out from the fit" if run.held_out else "estimated on"
        changed = len(simulations(run)) > 1
        shown = "measured, before and after" if changed else "measured and simulated"
        caption = (
            f"Free run on {run.log.name} ({kind}; {len(run.log)} samples of "
            f"{run.log.sample_time:g} s): {shown}; below, measured − simulated."
        )
        if leaves_picture(run):
            caption += " What leaves the picture is drawn at its edge."
        yield narrow(
            run_figure(run), f"run{i}", caption, f"{caption} {_rms_sentence(gather([run]))}",
            chart_of(run_figure(run, points)),
        )  # fmt: skip


def _equations(diagnosis: Diagnosis) -> Section:
    """Show how the model changes."""
    marked = marked_equations(diagnosis.base, diagnosis.model)
    changes = other_changes(diagnosis.base, diagnosis.model)
    same = len(marked) == 1 and not changes
    sentences = ["The model stays as it is."] if same else []
    if len(marked) == 1 and changes:
        sentences = ["The equations keep their terms. What changes:"]
    elif changes:
        sentences = ["Beside the terms that are marked below, what changes:"]
    extended = [
        f"Extension for {c.key}: {c.extension}. Reference: {c.reference}." for c in diagnosis.causes
    ]
    return Section(
        "3. The equations before and after",
        sentences,
        tables=[coefficient_table(diagnosis.base, diagnosis.model)],
        points=[*changes, *extended],
        marked=marked,
    )


def gain_section(diagnosis: Diagnosis) -> Section:
    """Show what the extended model gains on logs it was not fitted to."""
    if not diagnosis.gain:
        return Section("4. The gain", ["No gain was measured."])
    tables = [_gain_table("Fit (6.12) of the free run [%]", diagnosis.gain, ("before", "after"))]
    if diagnosis.gain_over_chosen:
        heads = ("with these terms", "after")
        caption = "Fit against the terms that the data chose, which belong to no cause [%]"
        tables.append(_gain_table(caption, diagnosis.gain_over_chosen, heads))
    on = diagnosis.validated_on
    return Section(
        "4. The gain", [capital(on).rstrip(".") + "."] if on else [],
        [gain_picture(diagnosis.gain, bounds=diagnosis.noise_bounds())]
        if _changed(diagnosis) else [], tables,
    )  # fmt: skip


def gain_picture(
    gain: Mapping[str, Gain], where: str = "", *, bounds: Mapping[str, float] | None = None
) -> Picture:
    """Return fits before and after, with the intervals of their gains and what noise allows."""
    caption = f"Fit of the free run before and after{where}, with the 95 % interval of the gain."
    if any(min(g.before, g.after) < LOWEST_FIT for g in gain.values()):
        caption += f" Below {LOWEST_FIT:.0f} % it is drawn at the edge."
    if any(percent(g.before) == "diverged" for g in gain.values()):
        caption += " A run that diverged has no interval."
    if bounds:
        caption += " A bar marks the fit that a perfect model would have, for the sensors' noise."
    rows = _gain_table("", gain, ("before", "after")).rows
    told = "; ".join(f"{r[0]} {r[1]} to {r[2]}" for r in rows)
    return narrow(gain_figure(gain, bounds), "gain", caption, f"{caption} {told}.")


def _gain_table(caption: str, gain: Mapping[str, Gain], heads: tuple[str, str]) -> Table:
    rows = [
        [
            MOTION_WORDS.get(s, s), percent(g.before), percent(g.after),
            *((f"{g.after - g.before:+.1f}", f"{g.ci[0]:.1f} to {g.ci[1]:.1f}")
              if percent(g.before) != "diverged" else ("", "")),
        ]
        for s, g in gain.items()
    ]  # fmt: skip
    return Table(caption, ["state", *heads, "gain", "95 % interval"], rows)
