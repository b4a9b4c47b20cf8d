"""`greybox diagnose`: what the simulation gets wrong, why, and what it gains to mend it."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from greybox.commands.common import (
    add_cluster,
    add_logs,
    add_memory,
    add_outputs,
    add_seed,
    drawn,
    positive,
    provenance,
    publish,
    read_logs,
    require_ending,
)
from greybox.numerics.threads import one_thread

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from greybox.commands.time_left import Stage
    from greybox.diagnosis.result import Diagnosis
    from greybox.report.page import Page
    from greybox.selection.stretches import Drawn
    from greybox.trial.log import TrialLog
    from greybox.vessel.vessel import Vessel

HELP = "show what the simulation gets wrong, name the cause, extend the model"
EXAMPLES = """examples:
  greybox diagnose trial.csv --vessel ship.toml --validate other.csv --report diagnosis.html
  greybox diagnose trial.csv --vessel ship.toml --model model.json --out better.json --json -
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_logs(parser)
    base = parser.add_mutually_exclusive_group()
    base.add_argument(
        "--model",
        metavar="MODEL",
        help="model to diagnose as it is; by default (3.51) in still water and air with the terms "
        "that the data choose, estimated on the logs",
    )
    parser.add_argument(
        "--validate",
        nargs="+",
        default=[],
        metavar="LOG",
        help="logs that take no part in the fit; by default parts of the logs are held out in turn",
    )
    add_outputs(parser, "the diagnosis", "plots")
    parser.add_argument(
        "--out",
        metavar="MODEL",
        help="write the extended model; where causes cannot be told apart, MODEL.<id>.json for "
        "each",
    )
    base.add_argument(
        "--structure",
        default="thesis",
        metavar="NAME",
        help="structure to begin from without --model; its wind terms are left out (thesis)",
    )
    parser.add_argument(
        "--causes",
        nargs="+",
        metavar="ID",
        help="look for these causes only (by default all known ones)",
    )
    parser.add_argument(
        "--remainder",
        action="store_true",
        help="add a smooth generic force to the extended model where that improves held-out free "
        "runs; it is zero outside the range of the logs",
    )
    parser.add_argument(
        "--sample-time",
        type=positive,
        metavar="S",
        help="decimate the logs to this sample time; by default that of MODEL, or one that suits "
        "the ship's speed",
    )
    add_memory(
        parser,
        "memory limit [GiB]; of larger logs the most informative stretches are diagnosed",
    )
    add_seed(parser)
    add_cluster(parser)


def stages(options: argparse.Namespace) -> list[Stage]:
    """Return the shares of the time that each stage usually takes."""
    of_terms = [] if options.model else [("terms that the data choose", 15.0)]
    return [
        ("", 8.0), ("samples of", 5.0), ("axes", 30.0), ("model without causes", 28.0),
        ("step 1", 6.0), ("a generic force", 6.0), *of_terms, ("what is left", 1.0),
        ("gain", 10.0), *drawn(options, 30.0),
    ]  # fmt: skip


@one_thread()
def run(options: argparse.Namespace) -> None:
    """Read, diagnose, report, write."""
    from dataclasses import replace
    from functools import partial

    from greybox.diagnosis.diagnose import DiagnosisOptions, diagnose
    from greybox.diagnosis.result import DiagnosisVerdict
    from greybox.files import check_targets
    from greybox.model.catalogue import get_structure, structure_for
    from greybox.model.model import load_model
    from greybox.numerics.parallel import ahead
    from greybox.selection.estimate_stream import BYTES
    from greybox.selection.stretches import draw
    from greybox.trial.log_files import find_logs
    from greybox.trial.stream import estimated_rows, open_stream
    from greybox.vessel.force import force_inputs
    from greybox.vessel.toml import load_vessel

    require_ending(options.out, ".json", "a model")
    check_targets(options.out, options.json, options.report)
    vessel = load_vessel(options.vessel)
    model = load_model(options.model).coefficient_model() if options.model else None
    structure = get_structure(options.structure) if model is None else model.structure
    sample_time = options.sample_time or (model.sample_time if model else None)
    told: dict[str, Any] = {}
    given = (vessel, sample_time, structure.states)
    with ahead(partial(read_logs, options.validate, *given)) as held_out:
        files = find_logs(options.logs)
        if estimated_rows(files) * BYTES <= options.memory * 2**30:
            logs, left_out = read_logs(options.logs, *given)
        else:
            stream = open_stream(files, vessel, states=structure.states, sample_time=sample_time)
            if model is None:
                structure = structure_for(options.structure, force_inputs(vessel))
            drawn = draw(stream, structure)
            drawn.require_others(held_out()[0])
            logs, left_out = list(drawn.logs), (*drawn.stream.left_out, _drawn_from(drawn))
            told["stream"] = {
                "files": len(drawn.stream.parts),
                "rows": drawn.stream.rows,
                "left_out": list(drawn.stream.left_out),
                "drawn": drawn.to_dict(["diagnosis"]),
            }
        validate, also = held_out()
    diagnosis = diagnose(
        logs,
        model=model,
        validate=validate,
        options=DiagnosisOptions(
            structure=options.structure,
            causes=options.causes,
            seed=options.seed,
            remainder=options.remainder,
            own_pace=options.sample_time is None,
        ),
    )
    record = provenance(options) | {"logs": _read(logs), "validate": _read(validate)}
    steps = [*_where_antenna(diagnosis, vessel), *_with_files(diagnosis.next_steps, record)]
    used = _with_model(diagnosis, record)
    # what needs nothing is for use first
    steps = [*used, *steps] if diagnosis.verdict == DiagnosisVerdict.NONE else [*steps, *used]
    diagnosis = replace(
        diagnosis, next_steps=tuple(steps), notes=(*left_out, *also, *diagnosis.notes)
    )
    written = _save(diagnosis, options.out, record) if options.out else []

    def page() -> Page:
        from greybox.report.diagnosis import diagnosis_page

        return diagnosis_page(diagnosis, record)

    told = diagnosis.to_dict() | told | {"provenance": record}
    # its summary tells them
    publish(options, told, diagnosis.summary(), page, [], written)


def _with_files(steps: Sequence[str], record: Mapping[str, Any]) -> list[str]:
    """Return next steps with the user's own files, first the one that writes the models."""
    from pathlib import Path
    from shlex import quote

    from greybox.report.next_steps import typed

    out = record["command"].get("out")
    model = Path(out or "mended.json")
    filled = [
        step.replace("--vessel V", f"--vessel {typed(record, 'vessel', 'V')}")
        .replace(" LOGS ", f" {typed(record, 'logs', 'LOGS')} ")
        .replace("--model MODEL", f"--model {quote(str(model))}")
        .replace("MODEL.", f"{quote(str(model.with_suffix('')))}.")
        for step in steps
    ]
    if not out and any("MODEL" in step for step in steps):
        filled.insert(
            0, f"write the models to files: the same command with: --out {quote(str(model))}"
        )
    return filled


def _where_antenna(diagnosis: Diagnosis, vessel: Vessel) -> list[str]:
    """Return what tells an antenna from what looks like one, where nothing says where it stands."""
    found = [c.id for c in (*diagnosis.causes, *diagnosis.candidates) if "antenna" in c.evidence]
    if not found or "antenna" in vessel.sensors:
        return []
    return [
        "measure where the antenna of the positions stands, as these logs tell it badly from "
        "coupled inertia: state antenna = [x, y] in [sensors] of the vessel file, and repeat"
    ]


def _with_model(diagnosis: Diagnosis, record: Mapping[str, Any]) -> list[str]:
    """Return what to do with a model that lacks nothing, or is extended and was written."""
    from shlex import quote

    from greybox.diagnosis.result import DiagnosisVerdict
    from greybox.report.next_steps import predict_step, typed
    from greybox.validation.comparison_verdict import weak_channels

    out = record["command"].get("out")
    vessel, turns = diagnosis.model.vessel, "r" in diagnosis.model.structure.states
    if diagnosis.verdict == DiagnosisVerdict.NONE:
        if weak_channels(diagnosis.held_out_fit, diagnosis.noise_bounds()):
            return []
        model = typed(record, "model", quote(out or "MODEL"))
        return [s.line().removeprefix("next: ") for s in predict_step(model, vessel, turns)]
    if not out or not diagnosis.causes:
        return []
    held, other = typed(record, "validate", "LOG"), typed(record, "model", "model.json")
    whose = "that diagnosed" if record["command"].get("model") else "that of greybox estimate"
    return [
        f"of two models, {whose} and the extended one, predict with the one that follows better "
        f"what neither was estimated on: greybox compare {other} {quote(out)} --log {held}",
        *(s.line().removeprefix("next: ") for s in predict_step(quote(out), vessel, turns)),
    ]


def _drawn_from(drawn: Drawn) -> str:
    return (
        f"the logs hold {drawn.data.samples} samples, more than fit into --memory, and the "
        f"diagnosis rests on {drawn.part}."
    )


def _read(logs: list[TrialLog]) -> list[str]:
    return [f"{log.provenance.source or log.name} {log.provenance.sha256[:12]}" for log in logs]


def _save(diagnosis: Diagnosis, path: str, record: dict[str, Any]) -> list[str]:
    """Write the extended model, and one for each of the causes that cannot be told apart.

    Returns
    -------
    list of str
        The files as the terminal tells them, the model last.
    """
    from dataclasses import replace
    from pathlib import Path

    from greybox.diagnosis.result import file_word

    target = Path(path)
    told = {"diagnosis": diagnosis.to_dict(), "provenance": record}
    written = []
    for name, model in diagnosis.alternatives.items():
        other = target.with_name(f"{target.stem}.{file_word(name)}{target.suffix or '.json'}")
        replace(model, record={**model.record, **told}).save(other)
        written.append(str(other))
    replace(diagnosis.model, record={**diagnosis.model.record, **told}).save(target)
    if diagnosis.causes:
        return [*written, path]
    held = ", ".join(diagnosis.model.record.get("causes", ()))
    said = "the model without a cause, as none stands"
    if held:
        said = f"the model with {held}, one of those that cannot be told apart"
    return [*written, f"{path}: {said}"]
