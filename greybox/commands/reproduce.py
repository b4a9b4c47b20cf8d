"""`greybox reproduce`: the studies of the thesis, with tables, figures and a page."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from greybox.commands.common import (
    add_cluster,
    add_seed,
    at_least_one,
    configured,
    is_named,
    leave_to_others,
    positive,
    progress,
    provenance,
    say,
)

if TYPE_CHECKING:
    from greybox.study.chapter7 import Chapter7

_log = logging.getLogger(__name__)
HELP = "repeat the studies of the thesis, of the estimators' efficiency and of the diagnosis' power"
EXAMPLES = """examples:
  greybox reproduce chapter4 --out chapter4
  greybox reproduce chapter6 --runs 500 --out chapter6
  greybox reproduce chapter7 --out chapter7
  greybox reproduce efficiency --runs 200 --out efficiency
  greybox reproduce power --runs 5 --out power
  greybox reproduce chapter7 --vessel ship.toml --estimate windy*.csv --validate calm*.csv
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "study",
        choices=("chapter4", "chapter6", "chapter7", "efficiency", "power"),
        help="tables and figures of a chapter; efficiency: how near the estimators come to the "
        "Cramér-Rao bound; power: how often the diagnosis is right",
    )
    parser.add_argument(
        "--runs", type=int, metavar="N",
        help="Monte Carlo runs (500); power: trials of each effect, size and kind of input (3)",
    )  # fmt: skip
    parser.add_argument("--out", metavar="DIR", help="folder for tables.csv, figures and the page")
    parser.add_argument("--estimate", nargs="+", metavar="LOG", help="chapter 7: estimation logs")
    parser.add_argument("--validate", nargs="+", metavar="LOG", help="chapter 7: validation logs")
    parser.add_argument("--vessel", metavar="V", help="chapter 7: vessel file of those logs")
    parser.add_argument(
        "--sample-time",
        type=positive,
        metavar="S",
        help="chapter 7: decimate to this sample time [s]",
    )
    parser.add_argument("--structure", metavar="NAME", help="chapter 7: structure (thesis)")
    parser.add_argument(
        "--workers", type=at_least_one, metavar="N", help="number of processes (one per core)"
    )
    add_cluster(parser)
    add_seed(parser)


# what only the logs of chapter 7 need
_OF_LOGS = ("estimate", "validate", "vessel", "sample_time", "structure")


@contextmanager
def _folder(path: str | None) -> Iterator[None]:
    """Make the folder before the study runs, and take it away where nothing came of it."""
    from greybox.files import make_folder

    new: list[Path] = []
    if path is not None:
        new = [p for p in (Path(path), *Path(path).parents) if not p.exists()]
        make_folder(path)
    try:
        yield
    except BaseException:
        with suppress(OSError):
            for folder in new:
                folder.rmdir()
        raise


def run(options: argparse.Namespace) -> None:
    """Run a study and write what it found."""
    from greybox.errors import UsageError

    if options.runs is None:
        options.runs = 3 if options.study == "power" else 500
    if options.study == "power" and options.runs < 1:
        raise UsageError(f"--runs is {options.runs}, each effect needs at least 1 trial.")
    if options.study != "power" and options.runs < 2:
        raise UsageError(f"--runs is {options.runs}, a standard deviation needs at least 2 runs.")
    others = options.study != "chapter7"
    unheeded = _OF_LOGS if others else ("vessel", "sample_time")
    for name in unheeded if others or not (options.estimate or options.validate) else ():
        leave_to_others(options, name, None)
    given = [n.replace("_", "-") for n in _OF_LOGS if getattr(options, n) is not None]
    if others and given:
        raise UsageError(
            f"{options.study} takes no {', '.join(f'--{n}' for n in given)}: logs and what is read "
            f"with them belong to chapter7. Leave that out."
        )
    with _folder(options.out):
        _run(options)


def _run(options: argparse.Namespace) -> None:
    from greybox.errors import UsageError
    from greybox.report import studies

    record, study = provenance(options), options.study
    title = study.replace("chapter", "chapter ")
    # the first runs may take long, and are counted when they are done
    _log.info("%s: first runs", title)
    seen = progress(title)
    if study == "chapter4":
        from greybox.study.chapter4 import reproduce_chapter4

        four = reproduce_chapter4(
            options.runs, options.seed, workers=options.workers, progress=seen
        )
        output = studies.chapter4_output(four, record)
    elif study == "chapter6":
        from greybox.study.chapter6 import reproduce_chapter6

        six = reproduce_chapter6(
            options.runs,
            options.seed,
            fit_runs=min(100, options.runs) if options.out else 0,
            workers=options.workers,
            progress=seen,
        )
        output = studies.chapter6_output(six, record)
    elif study == "efficiency":
        from greybox.report.efficiency import efficiency_output
        from greybox.study.efficiency import LEAST_RUNS, reproduce_efficiency

        if options.runs < LEAST_RUNS:
            raise UsageError(
                f"--runs is {options.runs}, the covariance of the estimates needs at least "
                f"{LEAST_RUNS} runs."
            )
        efficiency = reproduce_efficiency(
            options.runs, options.seed, workers=options.workers, progress=seen
        )
        output = efficiency_output(efficiency, record)
    elif study == "power":
        from greybox.report.power import power_output
        from greybox.study.power import judge_by_diagnosis, oracle_by_fit, run_power

        power = run_power(
            judge_by_diagnosis, oracle=oracle_by_fit, runs=options.runs,
            none_runs=5 * options.runs, seed=options.seed, workers=options.workers, progress=seen,
        )  # fmt: skip
        output = power_output(power, record)
    else:
        output = studies.chapter7_output(_chapter7(options, seen), record)
        idle = ["runs", "workers", *(["seed"] if options.estimate else [])]
        for name in (n for n in idle if is_named(options, n) and n not in configured(options)):
            say(f"note: --{name} changed nothing, as chapter 7 draws nothing of what it was given")
    say(output.text)
    if options.out:
        studies.write_output(output, options.out)
        say(f"wrote {options.out}/tables.csv, {options.out}/report.html and the figures")


def _chapter7(options: argparse.Namespace, seen: Callable[[int, int], None]) -> Chapter7:
    from greybox.commands.common import read_logs
    from greybox.errors import UsageError
    from greybox.model.catalogue import structure_for
    from greybox.selection.prediction import require_distinct, require_others
    from greybox.study.chapter7 import reproduce_chapter7, virtual_day
    from greybox.vessel.force import force_inputs
    from greybox.vessel.toml import load_vessel

    given = (options.estimate, options.validate, options.vessel)
    if any(given) and not all(given):
        raise UsageError("chapter7 on logs needs --vessel, --estimate and --validate together.")
    if options.sample_time is not None and not any(given):
        raise UsageError(
            "--sample-time decimates logs, and none is named: add --vessel, --estimate and "
            "--validate, or leave it out."
        )
    if all(given):
        vessel = load_vessel(options.vessel)
        estimation, left_out = read_logs(options.estimate, vessel, options.sample_time)
        validation, also = read_logs(options.validate, vessel, options.sample_time)
        require_distinct(estimation)
        require_distinct(validation)
        require_others(estimation, validation)
        for note in (*left_out, *also):
            say(f"note: {note}")
    else:
        estimation = virtual_day(options.seed, 10.0, "windy")
        validation = virtual_day(options.seed + 1000, 2.0, "calm")
    structure = None
    if options.structure is not None:
        structure = structure_for(options.structure, force_inputs(estimation[0].vessel))
    return reproduce_chapter7(estimation, validation, structure=structure, progress=seen)
