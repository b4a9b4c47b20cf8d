"""`greybox simulate`: a free run of a model on the inputs of a log."""

from __future__ import annotations

import argparse
import logging
from typing import TYPE_CHECKING, Literal

from greybox.commands.common import add_seed, require_ending, say
from greybox.errors import so_many

if TYPE_CHECKING:
    from greybox.commands.time_left import Stage

_log = logging.getLogger(__name__)
HELP = "run a model freely on the inputs of a log"
EXAMPLES = """examples:
  greybox simulate model.json trial.csv --out run.csv
  greybox simulate model.json plan.csv --start 1.5,1.2,0,0 --heading simulated --out run.csv
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("model", metavar="MODEL", help="model file of greybox estimate")
    parser.add_argument("log", metavar="LOG", help="log with the vessel's thruster columns")
    parser.add_argument("--out", required=True, metavar="CSV", help="where to write the run")
    parser.add_argument(
        "--heading",
        choices=("measured", "simulated"),
        help="heading of the run; measured by default, where the log has it",
    )
    parser.add_argument(
        "--start",
        metavar="U,V,R,PSI",
        help="start of the run where the log holds commands only [m/s, m/s, rad/s, rad]; "
        "write --start=-1,0,0,0 where the first number is negative",
    )
    parser.add_argument(
        "--no-bands",
        action="store_true",
        help="leave out the band that holds the motion with 95 %% probability",
    )
    add_seed(parser)


def stages(options: argparse.Namespace) -> list[Stage]:
    """Return the shares of the time that each stage usually takes."""
    return [("", 10.0), *([] if options.no_bands else [("bands", 70.0)]), ("units", 45.0)]


def run(options: argparse.Namespace) -> None:
    """Read, simulate, write."""
    import numpy as np

    from greybox.errors import UsageError
    from greybox.files import check_targets, replacing
    from greybox.model.model import load_model
    from greybox.model.run.simulation import positions
    from greybox.trial.checks.check import misnamed_columns
    from greybox.trial.convert.read import read_log
    from greybox.trial.gaps import split_at_gaps
    from greybox.trial.log_files import find_logs
    from greybox.trial.segments import find_log_gaps
    from greybox.trial.validity import other_conditions
    from greybox.validation.bands import predict_bands
    from greybox.validation.fit import run_model

    require_ending(options.out, ".csv", "a run")
    check_targets(options.out)
    model = load_model(options.model)
    fill: dict[str, float] = {}
    if options.start is not None:
        try:
            values = [float(v) for v in options.start.split(",")]
        except ValueError:
            values = []
        if len(values) != 4 or not np.isfinite(values).all():
            raise UsageError(
                f"--start is '{options.start}', four finite numbers are needed: u,v,r,psi such as "
                f"1.5,1.2,0,0."
            )
        fill = dict(zip(("u", "v", "r", "psi"), values, strict=True))
    path, *more = [file.path for file in find_logs([options.log])]
    if more:
        raise UsageError(
            f"'{options.log}' holds {1 + len(more)} logs, and one run is of 1: name it, such as "
            f"'{path}'."
        )
    log = read_log(path, model.vessel, states=model.structure.states, fill=fill, gaps=True)
    if fill and all(np.any(log[channel] != value) for channel, value in fill.items()):
        raise UsageError(
            f"--start is '{options.start}', and '{path}' holds u, v, r and psi from which "
            f"its run starts: leave --start out, or name a log of commands only."
        )
    if fill and options.heading == "measured" and np.all(log["psi"] == fill["psi"]):
        raise UsageError(
            f"--heading is measured, and '{path}' holds no heading that changes: leave --heading "
            f"out, or name a log with psi."
        )
    heading: Literal["measured", "simulated"] = options.heading or (
        "simulated" if fill else "measured"
    )
    result = run_model(model, log, heading=heading)
    if result.diverged >= 0:
        from greybox.errors import DivergenceError

        raise DivergenceError(
            f"the free run left its bound at sample {result.diverged} of {len(result.log)}: "
            f"this model cannot be simulated on '{log.name}'. Estimate it with --reduce."
        )
    states = model.structure.states
    columns = {"t": result.log.t} | {s: result.x[:, i] for i, s in enumerate(states)}
    columns["psi"] = result.psi
    if "u" in states and "v" in states:
        track = []
        for a, b in split_at_gaps(result.log.t, model.sample_time):
            start = (
                np.array([result.log["x_n"][a], result.log["y_n"][a]])
                if "x_n" in result.log and "y_n" in result.log
                else np.zeros(2)
            )
            track.append(positions(result.x[a:b], result.psi[a:b], model.sample_time, start))
        columns |= dict(zip(("x_n", "y_n"), np.concatenate(track).T, strict=True))
    notes: tuple[str, ...] = ()
    if not options.no_bands:
        _log.info("bands about the free run")
        bands = predict_bands(model, result.log, heading=heading, seed=options.seed)
        notes = bands.notes
        for i, state in enumerate(states):
            low, high = bands.motion[:, :, i]
            columns |= {f"{state}_low": low, f"{state}_high": high}
    with replacing(options.out) as handle:
        handle.write(",".join(columns) + "\n")
        for row in zip(*columns.values(), strict=True):
            # a time may be seconds since 1970
            cells = [f"{row[0]:.15g}", *(f"{value:.9g}" for value in row[1:])]
            handle.write(",".join(cells) + "\n")
    shown = ", ".join(f"{k} {v:.1f} %" for k, v in result.fit.items())
    winds = [
        t.name for t in model.structure.terms if any(f.signal in ("uq", "vq") for f in t.factors)
    ]
    if winds and not result.log.has_wind:
        say(f"note: {', '.join(winds)} act as in still air, because the log has no wind")
    gaps = (g.sentence for g in find_log_gaps(result.log))
    others = (d.sentence for d in other_conditions(model.conditions, [log]))
    _log.info("units, frames and signs of the columns")
    for note in (*misnamed_columns([path], model.vessel), *gaps, *notes, *others):
        say(f"note: {note}")
    if not fill:
        began = "from the mean of the log's first 5 samples"
        say(f"free run of {so_many(len(result.log), 'sample')} {began}, fit {shown}")
    say(f"wrote {options.out}")
