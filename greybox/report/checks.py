"""The page of `greybox check`: every finding shown, each log as a whole, what was looked at."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from greybox.errors import GreyboxError, UsageError, so_many
from greybox.report.chart import chart_of
from greybox.report.check_answers import answer_figure, course_figure, wind_figure
from greybox.report.check_inputs import actuator_figure, force_figure
from greybox.report.check_rows import (
    coarse_figure,
    fractions_figure,
    gap_figure,
    hold_figure,
    jump_figure,
    missing_figure,
    order_figure,
    range_figure,
    signals_figure,
    spike_figure,
    stuck_figure,
    wrap_figure,
)
from greybox.report.check_ties import make_tie, tie_figure
from greybox.report.figures import to_svg
from greybox.report.log import facts, page_figures
from greybox.report.next_steps import after_check
from greybox.report.page import Page, Picture, Section, Table, computed, write_page
from greybox.report.thinning import points_for
from greybox.trial.checks.finding import CheckReport, Finding, shared_findings, size_in_words
from greybox.trial.convert.convert import import_recording
from greybox.trial.log import TrialLog
from greybox.trial.raw_log import Recording
from greybox.trial.segments import join_segments
from greybox.vessel.vessel import Vessel

# by the id of a finding, or by what its picture holds
_OF_LOG: dict[str, Callable[[Finding, Recording], Figure]] = {
    "gap": gap_figure, "nan": missing_figure, "stuck": stuck_figure,
}  # fmt: skip
_ALONE: dict[str, Callable[[Finding], Figure]] = {
    "duplicate_time": order_figure, "time_format": fractions_figure, "outlier": spike_figure,
    "heading_wrap": wrap_figure, "position_hold": hold_figure, "position_jump": jump_figure,
    "quantised": coarse_figure, "actuator": actuator_figure, "external_force": force_figure,
    "limit": range_figure, "air": wind_figure, "push": answer_figure, "drift": course_figure,
}  # fmt: skip
_log = logging.getLogger(__name__)
# pictures of findings on a page: ten logs with their signals then stay below 5 MB
_MOST_DRAWN = 24
# what makes a force model wrong before what it only has to do without
_SERIOUS = (
    "frame", "sign", "unit", "clock_offset", "heading_bias", "lever_arm", "time_format",
    "duplicate_time", "position_jump", "heading_wrap", "external_force", "position_hold",
    "stuck", "nan", "outlier", "gap", "quantised", "actuator",
)  # fmt: skip
_SHOWN = {
    "gap": "The signal with its holes shaded, the longest hole closer, and the time from each "
    "sample to the next.",
    "duplicate_time": "Times by row with the wrong ones marked, closer around the first, and "
    "the time since the row before.",
    "time_format": "How late the times come that lack the leading zeros of their fraction, and "
    "the first of them closer.",
    "nan": "The signal with the samples that hold no number shaded, and the longest stretch "
    "closer.",
    "outlier": "The whole signal with its outliers circled, and the largest one closer.",
    "heading_wrap": "The heading as recorded with the samples between the two sides of its wrap "
    "circled, closer around the first, and the same without them, unwrapped.",
    "position_hold": "A coordinate with its repeated samples circled, the longest hold closer, and "
    "the way from sample to sample.",
    "position_jump": "The coordinate that jumps most, closer around the jump, and the track before "
    "and after it.",
    "stuck": "The whole signal, the time in which it repeats one value closer, and a channel "
    "that moves meanwhile.",
    "quantised": "The whole signal, its steps closer, and how many steps it changes by from "
    "sample to sample.",
    "clock_offset": "Velocities as logged and from positions and heading where they differ "
    "most, above as logged and below shifted; beside them their disagreement against the "
    "shift, with the estimate and its interval.",
    "actuator": "Command, feedback and what was fitted, over the minute in which the command "
    "moves most.",
    "external_force": "The speed that thrusters and damping leave unexplained, and the size of the "
    "thrust, with the stretch shaded.",
    "lever_arm": "Velocities as logged and from positions and heading, above as logged and "
    "below with the positions moved; beside them their disagreement against the rate of turn, "
    "with the slope that the arm makes.",
    "heading_bias": "Velocities as logged and from positions and heading, above as logged and "
    "below with the heading turned; beside them the angle between both against the heading.",
}
_TIE = (
    "Velocities as logged and from positions and heading where they differ most, above as logged "
    "and below mended, with their root mean square disagreement over the log."
)
_DOUBT = (
    " This repair brings the velocities of the whole log no closer together: judge it before you "
    "apply it."
)


def check_page(
    reports: Sequence[CheckReport],
    paths: Sequence[Path],
    vessel: Vessel,
    target: str | Path,
    record: Mapping[str, Any] | None = None,
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write one page on what is wrong with some logs.

    Parameters
    ----------
    reports : sequence of CheckReport
        One per log.
    paths : sequence of Path
        Of the logs, in the same order.
    vessel : Vessel
    target : str or Path
        HTML file, replaced in one step.
    record : mapping, optional
        How it was computed: versions, command, hashes of the files.
    progress : callable
        Called with (done, total) logs.
    """
    signals = sum(len(r.recording.signals) for r in reports if r.recording is not None)
    points = points_for(signals)
    shown: dict[tuple[Any, ...], str] = {}
    for report in reports:
        if report.recording is not None:
            for f in report.findings:
                shown.setdefault(f.key, report.name)
    sections = []
    drawn = _most_telling(reports)
    for k, report in enumerate(reports):
        progress(k, len(reports))
        sections.append(_section(k, report, vessel, points, shown, drawn))
    progress(len(reports), len(reports))
    lead, sections = _apart(reports, sections)
    made = computed(record or {}) | {"vessel": vessel.name}
    for report, path in zip(reports, paths, strict=True):
        files = report.recording.files if report.recording else ()
        formats = ", ".join(dict.fromkeys(f.format for f in files))
        made[f"log {report.name}"] = f"{path} ({formats})" if formats else str(path)
    made["method"] = (
        "kinematics before any force model: single signals first, then which reading of the "
        "columns makes positions, heading, velocities and yaw rate agree (likelihood of a "
        "random walk with sensor noise), then clocks, antenna and heading together; what belongs "
        "to the instruments is estimated over all logs at once"
    )
    made["pictures"] = (
        "velocities from positions are derivatives after a Gaussian smoothing that the logged "
        "ones are given too; what else was found is mended in both rows; a constant velocity of "
        "the water is allowed for"
    )
    page = Page(
        title="Check of the log" if len(reports) == 1 else "Check of the logs",
        headline=headline(reports),
        sections=sections,
        lead=lead,
        next_steps=after_check(reports, vessel, record or {}),
        computed=made,
    )
    write_page(page, target)


def headline(reports: Sequence[CheckReport]) -> str:
    """Return how much was found, and the most serious of it in words."""
    found = [(f, r) for r in reports for f in r.findings]
    logs = so_many(len(reports), "log")
    if not found:
        open_ids = sorted({o.id for r in reports for o in r.outcomes if o.status == "cannot tell"})
        vague = f"; nothing can be said of {', '.join(open_ids)}" if open_ids else ""
        return f"Nothing wrong was found in {logs}{vague}."
    report = reports[_gravest(reports)]
    finding = min(report.findings, key=_seriousness)
    several = {f.key for f in shared_findings(reports)}
    each = sum(f.key not in several for f, _ in found) + len(several)
    count = so_many(each, "finding")
    name = f"{len(finding.logs)} logs together" if finding.key in several else report.name
    where = f" ({name})" if len(reports) > 1 else ""
    lead = "the most serious" if each > 1 else "namely"
    return f"{count} in {logs}; {lead}{where}: {finding.evidence}."


def _gravest(reports: Sequence[CheckReport]) -> int:
    """Return which log has the most serious finding; the first one where none has any."""
    ranks = [min(map(_seriousness, r.findings), default=len(_SERIOUS) + 1) for r in reports]
    return ranks.index(min(ranks))


def _apart(
    reports: Sequence[CheckReport], sections: Sequence[Section]
) -> tuple[Picture | None, list[Section]]:
    """Return the picture of the most serious finding, or of a whole log, and what is left."""
    k, left = _gravest(reports), list(sections)
    if not left[k].pictures:
        return None, left
    first, *others = left[k].pictures
    told = "Its most serious finding" if reports[k].findings else "Its first picture"
    sentences = [*left[k].sentences, f"{told} is drawn at the top of the page."]
    left[k] = replace(left[k], pictures=others, sentences=sentences)
    if len(reports) > 1 and reports[k].findings:
        first = replace(first, caption=f"{reports[k].name}: {first.caption}")
    return first, left


def _most_telling(reports: Sequence[CheckReport]) -> set[tuple[int, int]]:
    """Return the findings that a page has room to draw, by log and place in its order.

    Each kind is drawn once before any is drawn again, the most serious first.
    """
    count: Counter[str] = Counter()
    ranked = []
    for k, report in enumerate(reports):
        for place, f in enumerate(sorted(report.findings, key=_seriousness)):
            ranked.append((count[f.id], _seriousness(f), k, place))
            count[f.id] += 1
    return {(k, place) for _, _, k, place in sorted(ranked)[:_MOST_DRAWN]}


def finding_figure(finding: Finding, report: CheckReport, vessel: Vessel) -> Figure:
    """Draw one finding so that it shows.

    Parameters
    ----------
    finding : Finding
    report : CheckReport
        That has it; its recording is drawn.
    vessel : Vessel

    Returns
    -------
    Figure
        Defects of one signal: the signal with what is wrong marked, and closer.
        Others: before and after the finding's repair.

    Raises
    ------
    UsageError
        The report holds no recording.
    """
    return _drawn(finding, report, vessel)[0]


def _drawn(finding: Finding, report: CheckReport, vessel: Vessel) -> tuple[Figure, str]:
    """Return the picture, and a doubt where it does not bear the finding out."""
    recording = report.recording
    if recording is None:
        raise UsageError(
            f"the report of '{report.name}' holds no recording to draw: make it with "
            f"check_recording or check_files."
        )
    for name in (finding.id, *finding.picture):
        if name in _OF_LOG:
            return _OF_LOG[name](finding, recording), ""
        if name in _ALONE:
            return _ALONE[name](finding), ""
    tie = make_tie(finding, report, vessel)
    if tie is None:
        return signals_figure(finding, recording, vessel), ""
    return tie_figure(finding, tie), "" if tie.helps else _DOUBT


def _section(
    number: int,
    report: CheckReport,
    vessel: Vessel,
    points: int,
    shown: Mapping[tuple[Any, ...], str],
    drawn: Container[tuple[int, int]],
) -> Section:
    """Return the part of the page on one log.

    ``shown`` names the log in which each finding is drawn. One that several logs share is
    drawn again only where its repair does not help. Findings that are not in ``drawn`` are told
    in words.
    """
    _log.info("pictures of %s", report.name)
    pictures: list[Picture] = []
    sentences: list[str] = []
    if not report.findings:
        sentences.append("Nothing was found.")
    for k, f in enumerate(sorted(report.findings, key=_seriousness)):
        said = caption(f)
        if report.recording is None:
            sentences.append(said)
            continue
        if (number, k) not in drawn:
            sentences.append(f"{said} Not drawn, as others like it are: check this log alone.")
            continue
        figure, doubt = _drawn(f, report, vessel)
        if len(f.logs) > 1 and shown[f.key] != report.name and not doubt:
            sentences.append(f"{f.line}; drawn for {shown[f.key]}, where it was found, too.")
            continue
        svg = to_svg(figure, f"log{number}finding{k}")
        pictures.append(Picture(svg, f"{said}{doubt}", f"{alternative(f)}{doubt}", broad=True))
    if report.recording is not None:
        try:
            log = _whole(report.recording, vessel)
        except GreyboxError as error:
            sentences.append(f"The log as a whole cannot be drawn: {error}")
        else:
            text = f"as it would be imported, nothing mended: {facts(log)}."
            for part, figure in page_figures(log, points).items():
                pictures.append(
                    Picture(
                        to_svg(figure, f"log{number}{part}"),
                        f"The {part} of {report.name}, {text}",
                        _seen(log, part),
                        narrow=True,
                        chart=chart_of(figure),
                    )
                )
    table = Table(
        "All checks",
        ["check", "outcome", "what was seen"],
        [[o.id, o.status, o.sentence] for o in report.outcomes],
        sentences=True,
    )
    texts = [("Notes from reading", "\n".join(report.notes))] if report.notes else []
    return Section(report.name, sentences, pictures, [table], texts)


def _seen(log: TrialLog, part: str) -> str:
    """Return the text that stands for a picture of a whole log."""
    if part == "track":
        return (
            f"Map: the track of {log.name} covers {np.ptp(log['x_n']):.0f} m from south to north "
            f"and {np.ptp(log['y_n']):.0f} m from west to east."
        )
    ranges = "; ".join(
        f"{n} from {value.min():.3g} to {value.max():.3g}" for n, value in log.channels.items()
    )
    return f"States, inputs and wind of {log.name} against time, as far as it has them: {ranges}."


def _seriousness(finding: Finding) -> int:
    return _SERIOUS.index(finding.id) if finding.id in _SERIOUS else len(_SERIOUS)


def caption(finding: Finding) -> str:
    """Return what was found, the evidence and the fix."""
    names = ", ".join(finding.channels or (finding.channel,))
    return (
        f"{finding.id} ({names}), {size_in_words(finding)}: {finding.evidence}. Fix: {finding.fix}."
    )


def alternative(finding: Finding) -> str:
    """Return the text that stands for the picture of a finding."""
    if finding.id == "unit" and "limit" in finding.picture:
        shown = "The angle against the range that radians allow, as logged and mended."
    elif "air" in finding.picture:
        shown = "The true wind against heading and as a map, as logged and read otherwise."
    elif "push" in finding.picture:
        shown = (
            "The ship's acceleration and what the thrusters push, against time and against each "
            "other, as logged and read otherwise."
        )
    elif "drift" in finding.picture:
        shown = "Course minus heading against time and around the bow, as logged and mended."
    else:
        shown = _SHOWN.get(finding.id, _TIE)
    return f"{shown} {finding.evidence}."


def _whole(recording: Recording, vessel: Vessel) -> TrialLog:
    """Return all segments of a recording as one log with gaps."""
    return join_segments(import_recording(recording, vessel).segments, recording.name)
