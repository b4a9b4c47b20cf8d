"""`greybox check`: defects of a log, found by kinematics before any force model."""

from __future__ import annotations

import argparse

from greybox.commands.common import provenance, say

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
    parser.add_argument("--vessel", required=True, metavar="V", help="vessel file (TOML)")
    parser.add_argument("--json", metavar="F", help="write the findings as JSON; - is stdout")
    parser.add_argument("--report", metavar="HTML", help="write a page with a picture per finding")


def run(options: argparse.Namespace) -> None:
    """Run the command: read the logs, check them, show the findings."""
    from pathlib import Path
    from textwrap import indent

    from greybox.files import check_targets, write_json
    from greybox.trial.checks.check import check_files
    from greybox.trial.checks.finding import shared_findings
    from greybox.trial.log_files import find_logs
    from greybox.trial.repair import apply_repairs
    from greybox.trial.trial_summary import Contents, describe_recording
    from greybox.vessel.toml import load_vessel

    check_targets(options.json, options.report)
    vessel = load_vessel(options.vessel)
    paths = [Path(file.path) for file in find_logs(options.logs)]
    reports = check_files(paths, vessel)
    contents = [
        describe_recording(apply_repairs(r.recording, [f for f in r.findings if f.safe]), vessel)
        if r.recording is not None
        else Contents()
        for r in reports
    ]
    record = provenance(options)
    if options.json:
        found = [r.to_dict() | s.to_dict() for r, s in zip(reports, contents, strict=True)]
        if len(found) == 1:
            result = found[0]
        else:
            result = {
                "findings": [{**f, "log": r["log"]} for r in found for f in r["findings"]],
                "logs": found,
            }
        write_json({**result, "provenance": record}, options.json)
    if options.report:
        from greybox.report.checks import check_page

        check_page(reports, paths, vessel, options.report, record)
    if options.json != "-":
        shared = shared_findings(reports)
        for finding in shared:
            say(f"{len(finding.logs)} of {len(reports)} logs: {', '.join(finding.logs)}")
            say(indent(finding.summary(), "  "))
        for report, holds in zip(reports, contents, strict=True):
            say(report.summary_beside(shared))
            if holds.summary():
                say(indent(holds.summary(), "  "))
        if options.report:
            say(f"\nwrote {options.report}")
