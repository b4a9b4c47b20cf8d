"""`greybox predict`: quantities of standard manoeuvres from an identified model."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from greybox.commands.common import (
    add_outputs,
    add_seed,
    by_name,
    count,
    drawn,
    positive,
    progress,
    provenance,
    publish,
    read_logs,
    require_log_ending,
)

if TYPE_CHECKING:
    from greybox.commands.time_left import Stage
    from greybox.prediction.result import ManoeuvrePrediction
    from greybox.report.page import Page
    from greybox.trial.log import TrialLog

# of the ships that MSC.137(76) is for [m]
_LEAST_LENGTH = 100.0
HELP = "predict standard manoeuvres, with intervals and the IMO limits"
EXAMPLES = """examples:
  greybox predict model.json turning --speed 7.5
  greybox predict model.json zigzag --angle 10 20/10 --side port --json zigzag.json
  greybox predict model.json crash --astern 80 --report crash.html
  greybox predict model.json zigzag --trial trial.csv --report beside.html

Angles on the command line are degrees, as manoeuvres are named; files hold radians.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("model", metavar="MODEL", help="model file of greybox estimate")
    parser.add_argument(
        "manoeuvre",
        choices=("turning", "zigzag", "stopping", "crash"),
        help="the manoeuvre to predict; stopping: thrust taken off; crash: full astern",
    )
    add_outputs(parser, "the quantities", "tracks and histories")
    parser.add_argument(
        "--out",
        metavar="CSV",
        help="write the run of the estimate itself as a log; of several runs each has a file, "
        "named by side and angle",
    )
    how = parser.add_argument_group("manoeuvre")
    how.add_argument(
        "--angle",
        nargs="+",
        default=[],
        metavar="DEG",
        help="steering angles [deg]; of a zig-zag also ANGLE/HEADING, such as 20/10 "
        "(35; 10/10 and 20/20)",
    )
    how.add_argument("--side", choices=("port", "starboard"), help="side of the first turn (both)")
    how.add_argument(
        "--share",
        type=float,
        metavar="S",
        help="for a ship steered by propeller speeds: share of the approach's speed by which the "
        "two sides differ from it (0.5), or share of a tunnel thruster's highest speed (1)",
    )
    how.add_argument(
        "--thrusters",
        nargs="+",
        default=[],
        metavar="COLUMN",
        help="columns of the thrusters that steer",
    )
    how.add_argument(
        "--astern", type=positive, metavar="N", help="propeller speed of a crash stop, positive"
    )
    how.add_argument(
        "--until",
        type=float,
        metavar="SHARE",
        help="share of the approach speed at which a stop ends (0.2; crash 0)",
    )
    approach = parser.add_argument_group("approach")
    approach.add_argument(
        "--speed",
        type=positive,
        metavar="V",
        help="approach speed over ground [m/s], for which the propeller speed is found",
    )
    approach.add_argument(
        "--command",
        dest="propellers",
        nargs="+",
        default=[],
        metavar="N",
        help="propeller speed of the approach in place of --speed, or NAME=N for each; by default "
        "the highest in the logs that the model was estimated on, or less where it would leave "
        "no room to steer",
    )
    approach.add_argument(
        "--course", type=float, default=0.0, metavar="DEG", help="heading of the approach [deg] (0)"
    )
    approach.add_argument(
        "--current",
        action="store_true",
        help="predict in the model's current; by default in still water, and with --trial in the "
        "current that the trial or the model tells",
    )
    approach.add_argument(
        "--still-water",
        action="store_true",
        help="predict in still water and air, also with --trial",
    )
    approach.add_argument(
        "--no-limits",
        action="store_true",
        help="ignore the vessel file's ranges of the commands, but keep its rates",
    )
    other = parser.add_argument_group("intervals and trial")
    other.add_argument("--trial", metavar="LOG", help="compare with the same manoeuvres in a log")
    other.add_argument(
        "--disturbed",
        action="store_true",
        help="add the model's process noise, so that the intervals cover a single trial",
    )
    other.add_argument(
        "--scale",
        type=positive,
        default=1.0,
        metavar="S",
        help="length of the full-scale ship divided by the vessel's, for the IMO limits (1)",
    )
    other.add_argument(
        "--draws", type=count, default=256, help="number of draws of the parameters (256)"
    )
    add_seed(parser)


def stages(options: argparse.Namespace) -> list[Stage]:
    """Return the shares of the time that each stage usually takes."""
    return [("", 1.0), ("manoeuvres", 75.0), *drawn(options, 20.0)]


def run(options: argparse.Namespace) -> None:
    """Predict, compare, report, write."""
    import math
    from dataclasses import replace

    from greybox.errors import UsageError
    from greybox.files import check_targets
    from greybox.model.model import load_model
    from greybox.prediction.predict import predict_manoeuvre
    from greybox.report.next_steps import after_prediction, fewer_terms, typed
    from greybox.trial.manoeuvres import Compliance

    if options.out:
        require_log_ending(options.out)
    check_targets(options.json, options.report, options.out)
    if not math.isfinite(options.course):
        raise UsageError(f"--course is {options.course:g}, a finite number of degrees is needed.")
    angles = [_angle(text) for text in options.angle]
    command = _command(options.propellers)
    model = load_model(options.model)
    trial: list[TrialLog] | None = None
    told: tuple[str, ...] = ()
    if options.trial is not None:
        trial, told = read_logs([options.trial], model.vessel, states=model.structure.states)
    made = predict_manoeuvre(
        model,
        options.manoeuvre,
        angles=angles,
        side=options.side or "",
        speed=options.speed,
        command=command,
        thrusters=options.thrusters,
        share=options.share,
        astern=options.astern,
        until=options.until,
        limited=not options.no_limits,
        current=_current(options),
        course=math.radians(options.course),
        disturbed=options.disturbed,
        scale=options.scale,
        draws=options.draws,
        seed=options.seed,
        trial=trial,
        progress=progress("manoeuvres"),
    )
    length = model.vessel.length * options.scale
    verdicts = {c.verdict for m in made.manoeuvres for c in m.criteria}
    if length < _LEAST_LENGTH and verdicts - {Compliance.NOT_APPLICABLE}:
        told = (
            *told,
            f"the limits of IMO MSC.137(76) are for ships of {_LEAST_LENGTH:g} m and more, and "
            f"this one is {length:g} m long: for the model of a longer ship give --scale.",
        )
    if any(q is None for m in made.manoeuvres for q in m.quantities.values()):
        told = (*told, *_radians(options.angle))
    made = replace(made, notes=(*told, *made.notes))
    record = provenance(options)
    written = _write_runs(made, options.out) if options.out else []

    next_to = typed(model.record.get("provenance", {}), "vessel", "V"), fewer_terms(model)

    def page() -> Page:
        from greybox.report.prediction import prediction_page

        return prediction_page(made, record, *next_to)

    result = made.to_dict() | {"provenance": record}
    steps = after_prediction(made, record, *next_to)
    publish(options, result, made.summary(), page, steps, written)


def _radians(texts: list[str]) -> list[str]:
    """Return what angles would be that may have been meant as radians."""
    import math

    small = [text for text in texts if "/" not in text and float(text) < math.pi / 2]
    return [
        f"--angle {text} is in degrees, and the ship hardly turns; {text} rad is "
        f"{math.degrees(float(text)):.1f} deg."
        for text in small
    ]


def _current(options: argparse.Namespace) -> bool | None:
    """Return whether the model's current acts; None leaves it to the trial."""
    from greybox.errors import UsageError

    if options.current and options.still_water:
        raise UsageError("--current and --still-water exclude one another: keep one of them.")
    return True if options.current else False if options.still_water else None


def _angle(text: str) -> float | tuple[float, float]:
    """Read DEG or DEG/DEG into radians."""
    import math

    from greybox.errors import UsageError

    try:
        values = [math.radians(float(part)) for part in text.split("/")]
    except ValueError:
        values = []
    if len(values) not in (1, 2) or not all(0 < v < math.pi for v in values):
        raise UsageError(
            f"--angle is '{text}': write degrees between 0 and 180, such as 35, or 20/10 for a "
            f"zig-zag of 20 degrees reversed at 10."
        )
    return values[0] if len(values) == 1 else (values[0], values[1])


def _command(texts: list[str]) -> float | dict[str, float] | None:
    """Read N, or NAME=N each."""
    from greybox.errors import UsageError

    if not texts:
        return None
    split = [text.rpartition("=") for text in texts]
    try:
        values = [(name.strip(), float(value)) for name, _, value in split]
    except ValueError:
        values = []
    if not values or (len(values) > 1 and any(not name for name, _ in values)):
        raise UsageError(
            f"--command is '{' '.join(texts)}': write one number for all propellers, or NAME=N "
            f"each, such as n1=300 n2=300."
        )
    named = by_name("--command", values)
    return named.get("", named)


def _write_runs(made: ManoeuvrePrediction, path: str) -> list[str]:
    """Write each run as a log; return the names of the files."""
    import math
    from pathlib import Path

    from greybox.trial.store import write_log

    target = Path(path)
    names = []
    for i, manoeuvre in enumerate(made.manoeuvres):
        name = target
        if len(made.manoeuvres) > 1:
            parts: list[str] = [manoeuvre.side]
            if manoeuvre.order is not None and abs(manoeuvre.order) < math.pi:
                parts.append(f"{math.degrees(abs(manoeuvre.order)):.0f}")
            name = target.with_stem("_".join([target.stem, *parts]))
            if str(name) in names:
                name = target.with_stem(f"{name.stem}_{i + 1}")
        write_log([manoeuvre.log], name)
        names.append(str(name))
    return names
