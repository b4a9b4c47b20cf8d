"""`greybox compare`: measured against simulated, for models and logs."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from greybox.commands.common import (
    add_memory,
    add_outputs,
    add_seed,
    counted,
    drawn,
    provenance,
    publish,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from greybox.commands.time_left import Stage
    from greybox.model.model import ManoeuvringModel
    from greybox.report.page import Page
    from greybox.trial.log import TrialLog
    from greybox.trial.log_files import LogFile
    from greybox.trial.validity import Excursions

HELP = "compare free runs of models with logs: fit, errors, bands, plots"
EXAMPLES = """examples:
  greybox compare model.json --log trial.csv --report compare.html
  greybox compare ls.json iv.json --log day2_a.csv day2_b.csv --json result.json
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("models", nargs="+", metavar="MODEL", help="model files")
    parser.add_argument(
        "--log",
        nargs="+",
        required=True,
        metavar="LOG",
        help="logs to compare on; folders and patterns stand for the logs in them",
    )
    parser.add_argument(
        "--heading",
        choices=("measured", "simulated"),
        default="measured",
        help="heading of the run: the log's, or a simulated one (measured)",
    )
    add_outputs(parser, "the result", "plots")
    parser.add_argument(
        "--no-bands",
        action="store_true",
        help="leave out the bands in which 95 %% of the measurements should lie",
    )
    add_memory(
        parser,
        "memory limit [GiB]; larger sets of logs are read one file at a time, and only what the "
        "tables show is kept of each, with --report the samples of those that are drawn",
    )
    add_seed(parser)


def _read_each(
    files: Sequence[LogFile], models: Sequence[ManoeuvringModel], read: list[str], told: list[str]
) -> Iterator[list[TrialLog]]:
    """Yield each log as every model reads it, and tell what a folder or a pattern holds beside."""
    from greybox.errors import LogError
    from greybox.trial.convert.read import read_log

    refused: LogError | None = None
    for file in counted("reading logs", files):
        try:
            logs = [
                read_log(file.path, m.vessel, states=m.structure.states, gaps=True) for m in models
            ]
        except LogError as error:
            if not file.found:
                raise
            refused = refused or error
            told.append(f"'{file.name}' was left out: {error}")
        else:
            read.append(file.path)
            yield logs
    if refused is not None and not read:
        raise refused


def _followed(
    columns: Iterable[list[TrialLog]], excursions: Sequence[Excursions]
) -> Iterator[list[TrialLog]]:
    """Yield each log, after telling of it for each model."""
    for logs in columns:
        for found, log in zip(excursions, logs, strict=True):
            found.add(log)
        yield logs


def _beyond(names: Sequence[str], excursions: Sequence[Excursions]) -> list[str]:
    """Say which models the logs take beyond what they were estimated on, each sentence once."""
    said: dict[str, list[str]] = {}
    for name, found in zip(names, excursions, strict=True):
        said.setdefault(found.sentence, []).append(f"'{name}'")
    return [f"{', '.join(of)}: {sentence}" for sentence, of in said.items() if sentence]


def stages(options: argparse.Namespace) -> list[Stage]:
    """Return the shares of the time that each stage usually takes."""
    return [("reading", 15.0), ("comparing", 25.0), *drawn(options, 60.0)]


def run(options: argparse.Namespace) -> None:
    """Read, run, report."""
    from dataclasses import replace
    from pathlib import Path

    from greybox.files import check_targets
    from greybox.model.model import load_model
    from greybox.report.next_steps import after_comparison
    from greybox.selection.prediction import require_distinct
    from greybox.trial.checks.check import misnamed_columns, require_each_once
    from greybox.trial.log_files import find_logs
    from greybox.trial.stream import estimated_rows
    from greybox.trial.validity import Excursions
    from greybox.validation.comparison import BYTES, compare_each

    check_targets(options.json, options.report)
    models = [load_model(path) for path in options.models]
    names = [Path(path).stem for path in options.models]
    if len(set(names)) < len(names):
        names = list(options.models)
    # one file may be compared with itself
    names = [n if n not in names[:i] else f"{n} ({i + 1})" for i, n in enumerate(names)]
    named = dict(zip(names, models, strict=True))
    files = find_logs(options.log)
    require_each_once([file.path for file in files])
    read: list[str] = []
    told: list[str] = []
    excursions = [Excursions(m.record.get("ranges") or {}) for m in models]
    columns: Iterable[list[TrialLog]] = _followed(_read_each(files, models, read, told), excursions)
    whole = None
    if estimated_rows(files) * len(models) * BYTES > options.memory * 2**30:
        from greybox.report.comparison import MOST_LOGS

        whole = MOST_LOGS if options.report else 0
    else:
        # a log that cannot be read is told before the others are compared
        held = list(columns)
        require_distinct([logs[0] for logs in held])
        columns = counted("comparing logs", held)
    comparison = compare_each(
        named, columns, heading=options.heading, bands=not options.no_bands, seed=options.seed,
        whole=whole,
    )  # fmt: skip
    misnamed = (n for m in models for n in misnamed_columns(read, m.vessel))
    of = [run.log.provenance for run in comparison.runs[0]]
    beyond = _beyond(names, excursions)
    notes = dict.fromkeys((*comparison.notes, *beyond, *told, *misnamed))
    comparison = replace(comparison, notes=tuple(notes))
    record = provenance(options) | {"logs": [f"{p.source} {p.sha256[:12]}" for p in of]}

    def page() -> Page:
        from greybox.report.comparison import comparison_page

        return comparison_page(comparison, models, record)

    result = comparison.to_dict() | {"provenance": record}
    steps = after_comparison(comparison, models, record)
    publish(options, result, comparison.summary(), page, steps)
