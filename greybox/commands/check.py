"""`greybox check`: defects of a log, found by kinematics before any force model."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from greybox.commands.common import (
    VESSEL_HELP,
    add_memory,
    counted,
    progress,
    provenance,
    say,
    show_next,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from greybox.commands.time_left import Stage
    from greybox.trial.checks.finding import CheckReport
    from greybox.trial.log_files import LogFile

# what the checks hold in memory for each row of a log: 0.4 kB were measured of three files
_BYTES = 512

HELP = "find what is wrong with logs by kinematics: gaps, frames, signs, units, clocks, lever arm"
EXAMPLES = """examples:
  greybox check trial.csv --vessel ship.toml
  greybox check raw.nmea --vessel ship.toml --json findings.json
  greybox check *.csv --vessel ship.toml --report check.html
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "logs", nargs="+", metavar="LOG",
        help="logs, or raw files of any format; folders and patterns stand for the logs in them; "
        "those of one ship are judged together",
    )  # fmt: skip
    parser.add_argument("--vessel", required=True, metavar="V", help=VESSEL_HELP)
    parser.add_argument("--json", metavar="F", help="write the findings as JSON; - is stdout")
    parser.add_argument("--report", metavar="HTML", help="write a page with a picture per finding")
    add_memory(
        parser,
        "memory limit [GiB]; larger sets of logs are judged in groups of neighbours instead of all "
        "together, and no pictures are drawn",
    )


def _groups(files: Sequence[LogFile], memory: float) -> list[list[LogFile]]:
    """Return files in groups that a memory [GiB] holds, at least one file each."""
    from greybox.trial.stream import estimated_rows

    groups: list[list[LogFile]] = []
    held = 0.0
    for file in files:
        size = estimated_rows([file]) * _BYTES / 2**30
        if not groups or held + size > memory:
            groups.append([])
            held = 0.0
        groups[-1].append(file)
        held += size
    return groups


def stages(options: argparse.Namespace) -> list[Stage]:
    """Return the shares of the time that each stage usually takes."""
    found = [("reading", 4.0), ("samples of", 8.0), ("axes", 35.0), ("wind", 33.0)]
    return [*found, ("manoeuvres", 8.0), *([("pictures", 80.0)] if options.report else [])]


def run(options: argparse.Namespace) -> None:
    """Run the command: read the logs, check them, show the findings."""
    from dataclasses import replace
    from pathlib import Path
    from textwrap import indent

    from greybox.files import check_targets, write_json
    from greybox.report.next_steps import after_check
    from greybox.trial.checks.check import check_recordings, require_each_once
    from greybox.trial.checks.finding import shared_findings, shared_remarks
    from greybox.trial.convert.channel_mapping import read_recording
    from greybox.trial.log_files import find_logs
    from greybox.trial.repair import apply_repairs
    from greybox.trial.trial_summary import Contents, describe_recording
    from greybox.vessel.toml import load_vessel

    check_targets(options.json, options.report)
    vessel = load_vessel(options.vessel)
    files = find_logs(options.logs)
    paths = [Path(file.path) for file in files]
    require_each_once(paths)
    groups = _groups(files, options.memory)
    reports: list[CheckReport] = []
    contents: list[Contents] = []
    for group in groups:
        found = check_recordings(
            [read_recording(file.path, vessel) for file in counted("reading logs", group)], vessel
        )
        contents += [
            describe_recording(
                apply_repairs(r.recording, [f for f in r.findings if f.safe]), vessel
            )
            if r.recording is not None
            else Contents()
            for r in counted("manoeuvres in logs", found)
        ]
        reports += [replace(r, recording=None) for r in found] if len(groups) > 1 else found
    record = provenance(options)
    if len(groups) > 1:
        record["judged_together"] = [[file.name for file in group] for group in groups]
    if options.json:
        told = [r.to_dict() | s.to_dict() for r, s in zip(reports, contents, strict=True)]
        if len(told) == 1:
            result = told[0]
        else:
            result = {
                "findings": [{**f, "log": r["log"]} for r in told for f in r["findings"]],
                "logs": told,
            }
        write_json({**result, "provenance": record}, options.json)
    if options.report:
        from greybox.report.checks import check_page

        shown = progress("pictures of logs")
        check_page(reports, paths, vessel, options.report, record, progress=shown)
    if options.json != "-":
        shared = shared_findings(reports)
        for finding in shared:
            say(f"{len(finding.logs)} of {len(reports)} logs: {', '.join(finding.logs)}")
            say(indent(finding.summary(), "  "))
        if remarks := shared_remarks(reports):
            say("all logs:")
            say(indent("\n".join(remarks), "  "))
        for report, holds in zip(reports, contents, strict=True):
            say(report.summary_beside(shared, remarks))
            if holds.summary():
                say(indent(holds.summary(), "  "))
        if len(groups) > 1:
            say(
                f"\nnote: {len(reports)} logs take more than --memory, and were judged together in "
                f"{len(groups)} groups of up to {max(map(len, groups))}, in their order."
            )
        if options.report:
            say(f"\nwrote {options.report}")
        show_next(after_check(reports, vessel, record))
