"""The page of `greybox demo`: the loop as a story, a picture and a command for each step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from experiment_design.demo.steps import Demo, Step
from experiment_design.output.report import design_page
from experiment_design.output.result import Design
from greybox.diagnosis.causes import known_causes
from greybox.diagnosis.result import Diagnosis
from greybox.model.model import ManoeuvringModel
from greybox.report.chart import chart_of
from greybox.report.comparison import comparison_page
from greybox.report.diagnosed_causes import cause_section
from greybox.report.diagnosis import diagnosis_page, gain_picture, gain_section
from greybox.report.error_budget import noise_sentence, noise_shares
from greybox.report.figures import to_svg
from greybox.report.log import page_figures
from greybox.report.model_difference import marked_equations
from greybox.report.next_steps import NextStep
from greybox.report.page import Marked, Page, Picture, Section, Table, flatten
from greybox.validation.comparison import Comparison
from greybox.validation.fit import told_fits

# share of the squared error from which on noise is all that is left
_NOISE = 0.9


def demo_page(demo: Demo, record: Mapping[str, Any]) -> Page:
    """Return the page, its story first.

    Parameters
    ----------
    demo : Demo
    record : mapping
        How it was computed.
    """
    log = [
        Picture(
            to_svg(figure, f"trial{part}"),
            f"The trial as its log holds it: {part}.",
            f"{part} of {len(demo.trial)} samples of {demo.trial.sample_time:g} s",
            chart=chart_of(figure),
        )
        for part, figure in page_figures(demo.trial).items()
    ]
    diagnosis, model = demo.diagnosis, demo.estimate.model()
    found = cause_section(diagnosis)
    wrong = diagnosis_page(diagnosis, {}).sections[0]
    extended = gain_section(diagnosis).pictures
    gain, *after = [
        *(
            [gain_picture(demo.gain, " on the other log", bounds=diagnosis.noise_bounds())]
            if extended
            else []
        ),
        *_runs(demo.after, model, diagnosis.model),
    ]
    shown: list[tuple[Sequence[Picture], Sequence[Table], Sequence[Marked], Sequence[str]]] = [
        (_plan(demo.design), (), (), ()),
        ((), (), (), ()),
        (log, (), (), ()),
        ((), (_parameters(demo),), (), ()),
        (_runs(demo.before, model), (), (), wrong.points[:4]),
        (
            found.pictures,
            found.tables[:1],
            marked_equations(diagnosis.base, diagnosis.model),
            diagnosis.next_steps,
        ),
        (after, (), (), ()),
        (_plan(demo.next_design), (), (), ()),
    ]
    sections = [
        _section(number, step, *parts)
        for number, (step, parts) in enumerate(zip(demo.steps, shown, strict=True), 1)
    ]
    return Page(
        title="The whole loop on a virtual ship",
        headline=f"{headline(diagnosis, demo)}{_only_noise(diagnosis)}",
        sentences=[
            "Each step below shows the command that does it; the files that it reads and writes "
            "stand beside this page, so that every step can be taken again by hand.",
            *noise_sentence(noise_shares(diagnosis), diagnosis.noise_bounds()),
        ],
        lead=gain,
        next_steps=[
            NextStep(
                "Begin with a log of your own ship",
                "greybox check LOG --vessel V --report check.html",
            ),
            NextStep(
                "Find what a model of your ship gets wrong, and why",
                "greybox diagnose LOG --vessel V --report diagnosis.html",
            ),
        ],
        sections=sections,
        computed=flatten(dict(record)),
    )


def headline(diagnosis: Diagnosis, demo: Demo) -> str:
    """Return the story in a sentence."""
    known = known_causes()
    named = [c.title for c in diagnosis.causes]
    hidden = [known[e.id].title for e in demo.hidden]
    asked = f"A ship sailed with a hidden effect that its model lacked, {' and '.join(hidden)}"
    if named == hidden:
        return f"{asked}: the trial was designed, the cause found and named, the model extended."
    return f"{asked}; the verdict of these logs is '{diagnosis.verdict}'" + (
        f", with {', '.join(named)} named." if named else "."
    )


def _only_noise(diagnosis: Diagnosis) -> str:
    """Return that the sensors, not the model, make the error that is left, where they do."""
    shares, bounds = noise_shares(diagnosis), diagnosis.noise_bounds()
    if not shares or min(shares.values()) < _NOISE:
        return ""
    least, most = (f"{100 * f(shares.values()):.0f}" for f in (min, max))
    told = f" What error is left is sensor noise ({least}{f' to {most}' * (most != least)} % of it)"
    if bounds:
        told += f": a perfect model would fit no better than {told_fits(bounds, 0)}"
    return f"{told}."


def _section(
    number: int,
    step: Step,
    pictures: Sequence[Picture],
    tables: Sequence[Table],
    marked: Sequence[Marked],
    points: Sequence[str],
) -> Section:
    return Section(
        f"{number}. {step.title}", step.told, pictures, tables, (), points, marked, step.command
    )


def _plan(design: Design) -> list[Picture]:
    """Return track and motion of a plan."""
    page = design_page(design, (), {})
    return [p for p in (page.lead, page.pictures[0]) if p is not None]


def _runs(comparison: Comparison, *models: ManoeuvringModel) -> Sequence[Picture]:
    page = comparison_page(comparison, models, {})
    return [p for p in (page.lead, *page.pictures) if p is not None]


def _parameters(demo: Demo) -> Table:
    estimate = demo.estimate
    model = estimate.model()
    return Table(
        "Parameters and their standard errors",
        ["parameter", "value", "std err", "unit"],
        [
            [name, f"{value:.4g}", f"{std:.2g}", unit]
            for name, value, std, unit in zip(
                estimate.labels, model.theta, model.std, model.units, strict=True
            )
        ],
    )
