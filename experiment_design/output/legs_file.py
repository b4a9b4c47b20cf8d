"""Legs as files: JSON and CSV for autopilots, with a seaman's words beside the numbers."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

from experiment_design.output.legs import LegPlan
from experiment_design.output.result import Design
from experiment_design.output.sheet_contents import leg_words
from greybox.errors import UsageError
from greybox.files import replacing, write_json

FORMAT, VERSION = "greybox-legs", 1
ENDING = ".legs.json"


def legs_path(given: str, plan: str | Path) -> Path:
    """Return where legs are written.

    Parameters
    ----------
    given : str
        File that was asked for, empty for one beside the plan.
    plan : path

    Raises
    ------
    UsageError
        The file has another ending than .json.
    """
    path = Path(given) if given else Path(plan).with_suffix(ENDING)
    if path.suffix.lower() != ".json":
        raise UsageError(
            f"the legs '{path.name}' are written as JSON with a CSV beside it: use a name that "
            f"ends in .json, such as {path.stem}{ENDING}."
        )
    return path


def csv_path(path: Path) -> Path:
    """Return the CSV beside a JSON of legs; never the plan of the same name."""
    bare = path.with_suffix("")
    return bare.with_suffix(".legs.csv") if bare.suffix != ".legs" else path.with_suffix(".csv")


def legs_to_dict(design: Design, plan: LegPlan) -> dict[str, Any]:
    """Return legs as the JSON that autopilots read: SI units and rad, speeds as logged."""
    r = design.request
    position = dict(zip(("x_n", "y_n"), map(float, r.limits.position), strict=True))
    start = [
        dict(zip((*r.structure.states, "psi"), map(float, s), strict=True)) | position
        for s in r.starts
    ]
    return {
        "format": FORMAT,
        "version": VERSION,
        "vessel": r.vessel.name,
        "sample_time": r.sample_time,
        "start": start[0] if len(start) == 1 else start,
        "legs": [
            {
                "trial": trial + 1,
                "commands": dict(leg.commands),
                "until": leg.until_dict(),
                "at_least": leg.at_least,
                "at_most": leg.at_most,
                "expected": leg.expected,
                "words": leg_words(leg, design, trial),
            }
            for trial, legs in enumerate(plan.trials)
            for leg in legs
        ],
    }


def write_legs(design: Design, plan: LegPlan, path: Path) -> None:
    """Write legs as JSON, and as CSV of one row a leg beside it.

    Parameters
    ----------
    design : Design
    plan : LegPlan
        Of `legs_of`.
    path : Path
        Ends in .json.
    """
    design = design.from_first_command()
    data = legs_to_dict(design, plan)
    write_json(data, path)
    names = design.request.schedule.commands
    with replacing(csv_path(path)) as handle:
        writer = csv.writer(handle, lineterminator="\n")
        writer.writerow(
            ["trial", "leg", *names, "until", "value", "since", "crossing", "at_least", "at_most",
             "expected", "words"]
        )  # fmt: skip
        number, last = 0, 0
        for leg in data["legs"]:
            number, last = (number + 1 if leg["trial"] == last else 1), leg["trial"]
            end = leg["until"]
            value = next(end[k] for k in ("after", "change", "value") if k in end)
            numbers = (value, leg["at_least"], leg["at_most"], leg["expected"])
            value, least, most, expected = (f"{x:.10g}" for x in numbers)
            writer.writerow(
                [leg["trial"], number, *(f"{leg['commands'][n]:.10g}" for n in names),
                 end["kind"], value, end.get("since", ""), end.get("crossing", ""), least, most,
                 expected, leg["words"]]
            )  # fmt: skip
