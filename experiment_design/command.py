"""`greybox design`: thruster sequences for the next trial."""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from experiment_design.criteria.optimality import CRITERIA
from experiment_design.information.estimators import ESTIMATORS
from experiment_design.request.exclusions import COEFFICIENTS, require_compatible, spelt
from greybox.commands.common import (
    VESSEL_HELP,
    add_cluster,
    add_seed,
    at_least_one,
    by_name,
    count,
    drawn,
    positive,
    progress,
    provenance,
    require_ending,
    say,
    show_next,
    tell_drawing,
)
from greybox.commands.time_left import Stage
from greybox.model.predictor_kinds import PREDICTORS
from greybox.registry import Registry

# word of --prior that stands for no model of any trial
NO_PRIOR = "none"
HELP = "design the thruster sequences of the next trial"
EXAMPLES = """examples:
  greybox design --vessel ship.toml --model model.json --duration 600 --out plan.csv
  greybox design --vessel ship.toml --model model.json --duration 300 --regime u+v+ \\
      --margin-u 0.5 --margin-v 0.4 --start 1.5,1.2,0,0 --out plan.csv --json design.json
  greybox design --vessel ship.toml --model model.json --duration 900 --area room.csv \\
      --speed-cap 3 --yaw-cap 0.1 --sheet sheet.html --out plan.csv
  greybox design --vessel ship.toml --model model.json --duration 600 --trials 2 --out plan.csv
  greybox design --vessel ship.toml --between plain.json current.json --duration 600 \\
      --out plan.csv
  greybox design --vessel ship.toml --model model.json --for causes --diagnosis d.json \\
      --duration 600 --out plan.csv
  greybox design --vessel ship.toml --prior none --duration 900 --out plan.csv
  greybox design --vessel ship.toml --after part1.csv --remaining 900 --out part2.csv
"""


# times the greatest speed of the prior's logs from which on a highest speed limits nothing
_IDLE = 1.3
# bytes of a polygon of 500 corners, many times over
_LARGEST_ROOM = 1_000_000


@dataclass(frozen=True)
class Planned:
    """A plan, what its summary tells, notes, what its JSON says beside, and a headline."""

    design: Any
    found: Any
    notes: tuple[str, ...]
    more: dict[str, Any]
    headline: str = ""


@dataclass(frozen=True)
class Purpose:
    """What a trial may be designed for.

    Parameters
    ----------
    name : str
        As ``--for`` takes it.
    words : str
        What the trial is for; empty where only its own options ask for it.
    run : callable
        Takes the options, the model, the vessel, what has been sailed or None and sentences on it,
        and designs the trial.
    asked_by : tuple of str
        Options that ask for it where ``--for`` is not given.
    whole : bool
        Whether the ship moves by a force without a name too, and not by coefficients alone.
    """

    name: str
    words: str
    run: Callable[[argparse.Namespace, Any, Any, Any, tuple[str, ...]], Planned]
    asked_by: tuple[str, ...] = ()
    whole: bool = False


def _given(options: argparse.Namespace) -> set[str]:
    """Return what is asked, as the rules on options that exclude one another name it."""
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    given = {a.dest for a in parser._actions if getattr(options, a.dest, a.default) != a.default}
    if options.prior == NO_PRIOR:
        given = given - {"prior"} | {"prior none"}
    chosen = options.criterion
    if CRITERIA[chosen].combined if chosen else options.of:
        given.add("criterion c")
    return given


def _purpose(options: argparse.Namespace, given: set[str]) -> Purpose:
    """Return what the trial is for, by --for or by options that ask for it themselves."""
    # the more special one comes last
    asked = (p for p in reversed([*PURPOSES.values()]) if given.intersection(p.asked_by))
    return PURPOSES[options.purpose] if options.purpose else next(asked, PURPOSES["prediction"])


def _listed(registry: Registry[Any]) -> str:
    """Return the words of all entries, for a help text."""
    *others, last = (entry.words for entry in registry.values() if entry.words)
    return f"{', '.join(others)}, or {last}"


def _pair(text: str) -> tuple[float, float]:
    first, second = _floats(text)
    return first, second


def _not_negative(text: str) -> float:
    value = float(text)
    if not 0 <= value < float("inf"):
        raise ValueError(text)
    return value


def _share(text: str) -> float:
    value = float(text)
    if not 0 < value < 1:
        raise ValueError(text)
    return value


def _floats(text: str) -> list[float]:
    values = [float(v) for v in text.split(",")]
    if not all(abs(v) < float("inf") for v in values):
        raise ValueError(text)
    return values


for _type, _name in (
    (_pair, "two finite numbers A,B"),
    (_not_negative, "number of at least 0"),
    (_share, "number between 0 and 1"),
    (_floats, "finite numbers separated by commas"),
):
    _type.__name__ = _name


def _declare(
    group: argparse._ArgumentGroup, *rows: tuple[str, Callable[[str], Any], str, str]
) -> None:
    """Declare options of one value, None where it is not given: name, type, metavar and help."""
    for name, kind, metavar, said in rows:
        group.add_argument(name, type=kind, metavar=metavar, help=said)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("--vessel", required=True, metavar="V", help=f"{VESSEL_HELP}; with limits")
    add("--model", metavar="MODEL", help="prior model: a file of greybox estimate")
    add(
        "--duration",
        type=positive,
        metavar="S",
        help="length of each trial without its lead-in [s]",
    )
    add(
        "--after",
        nargs="+",
        default=[],
        metavar="LOG",
        help="logs that have been sailed, in this order: the model is estimated on them unless "
        "--model names one, and the plan adds the information that they lack",
    )
    add(
        "--remaining",
        type=positive,
        metavar="S",
        help="what --duration is without --after: how long the rest of the trial may last [s]",
    )
    add("--save-model", metavar="FILE", help="write the model that --after estimates (JSON)")
    add("--out", required=True, metavar="PLAN", help="where to write the commands (CSV)")
    add("--json", metavar="F", help="write the design as JSON; - is stdout")
    add("--sheet", metavar="FILE", help="write the sheet to take on board: .pdf, .html, .svg, .png")
    add("--report", metavar="HTML", help="write a page with pictures and the value of the plan")
    add(
        "--legs",
        nargs="?",
        const="",
        metavar="FILE",
        help="write the plan as legs too, each of which ends by time, heading, speed or yaw rate: "
        "as JSON, as CSV and in words on the sheet (PLAN with the ending .legs.json)",
    )
    goal = parser.add_argument_group("purpose")
    goal.add_argument(
        "--for",
        dest="purpose",
        choices=tuple(n for n, purpose in PURPOSES.items() if purpose.words),
        help=f"what the trial is for: {_listed(PURPOSES)} (prediction, unless one of "
        f"{', '.join(map(spelt, COEFFICIENTS))} is given)",
    )
    goal.add_argument(
        "--diagnosis",
        metavar="D",
        help="JSON of greybox diagnose whose open causes the trial must separate (that of MODEL)",
    )
    goal.add_argument(
        "--causes",
        nargs="+",
        default=[],
        metavar="ID",
        help="ids of the causes to tell apart, with their place where there are several, such as "
        "thruster_lag:n",
    )
    goal.add_argument(
        "--envelope",
        nargs="+",
        default=[],
        metavar="COLUMN=LOW:HIGH",
        help="commands that predictions are wanted for (those of the prior's trial, both sides)",
    )
    goal.add_argument(
        "--criterion",
        choices=tuple(CRITERIA),
        help=f"measure of the covariance of the wanted parameters: {_listed(CRITERIA)} (D)",
    )
    goal.add_argument(
        "--want", nargs="+", default=[], metavar="NAME", help="parameters to estimate well (all)"
    )
    goal.add_argument(
        "--of", metavar="EXPR", help="function of the parameters for criterion c, such as Xuu/Xmu"
    )
    goal.add_argument(
        "--target",
        nargs="+",
        metavar="NAME=STD",
        help="find the shortest trial that reaches these standard errors, --duration at most",
    )
    goal.add_argument(
        "--predictor",
        choices=tuple(PREDICTORS),
        help="predictor of the later estimate: current and wind left out (basic), unknown "
        "(augmented) or measured (wind) (augmented; basic for a model without yaw rate)",
    )
    goal.add_argument(
        "--estimator",
        choices=tuple(ESTIMATORS),
        help=f"estimator of the later estimate: {_listed(ESTIMATORS)} (iv)",
    )
    goal.add_argument(
        "--prior",
        metavar="MODEL",
        help="model of earlier trials, whose information counts as known; none: start from the "
        "vessel's main dimensions, without a trial and --model",
    )
    goal.add_argument(
        "--between", nargs=2, metavar=("A", "B"), help="two models for the trial to tell apart"
    )
    motion = parser.add_argument_group("limits")
    motion.add_argument("--regime", metavar="u+v+", help="signs of the velocities to keep (auto)")
    for name, word in (("u", "surge"), ("v", "sway")):
        said = f"keep {word} through the water at |{name}_r| of M or more [m/s]"
        _declare(motion, (f"--margin-{name}", _not_negative, "M", said))
    _declare(
        motion,
        ("--margin-air", _not_negative, "M",
         "keep the measured wind at |u_q| and |v_q| of M or more, of either sign [m/s]"),
        ("--hold", positive, "S", "commands change every S s (10; for prediction when the ship has "
         "sailed three quarters of her length)"),
        ("--start", _floats, "u,v,r,psi", "state at the start [m/s, m/s, rad/s, rad] (chosen; with "
         "--after the end of the last log)"),
    )  # fmt: skip
    motion.add_argument(
        "--trials", type=at_least_one, default=1, metavar="K", help="number of trials (1)"
    )
    motion.add_argument("--area", metavar="CSV", help="sea room: the corners x_n, y_n [m]")
    _declare(
        motion,
        ("--circle", _floats, "N,E,R",
         "round sea room: north and east of its centre, radius [m]"),
        ("--position", _pair, "N,E",
         "north and east of the start [m] (0,0; with --after the end of the last log)"),
    )  # fmt: skip
    motion.add_argument(
        "--clearance",
        type=_not_negative,
        default=0.0,
        metavar="M",
        help="distance to keep from the edge of the sea room [m] (0)",
    )
    _declare(
        motion,
        ("--speed-cap", positive, "M", "highest speed over ground [m/s]"),
        ("--yaw-cap", positive, "R", "highest yaw rate [rad/s]"),
    )
    motion.add_argument(
        "--end",
        nargs="+",
        default=[],
        metavar="NAME=VALUE:TOL",
        help="final u, v, r, psi, x_n or y_n, with its tolerance (0.05)",
    )
    _declare(
        motion,
        ("--energy", positive, "E", "highest mean of (n/n_max)^3, such as 0.5"),
        ("--headings", positive, "RAD", "range of headings to cover [rad]"),
    )
    belief = parser.add_argument_group("prior knowledge")
    _declare(
        belief,
        ("--current", _pair, "N,E", "expected current, north and east [m/s]"),
        ("--wind", _pair, "N,E", "expected wind, north and east [m/s]"),
        ("--gust", _not_negative, "M",
         "standard deviation of the wind about its mean [m/s] (15 %% of the mean)"),
        ("--process-noise", _floats, "U,V,R",
         "standard deviation of the process noise, per sample"),
    )  # fmt: skip
    belief.add_argument(
        "--robust",
        type=count,
        default=0,
        metavar="S",
        help="plan for the mean of the criterion over S models drawn from the prior's covariance "
        "(0)",
    )
    belief.add_argument(
        "--worst-case", action="store_true", help="plan for the worst of the models of --robust"
    )
    belief.add_argument(
        "--probability",
        type=_share,
        default=0.9,
        metavar="P",
        help="probability with which the limits must be kept under the prior's uncertainty (0.9)",
    )
    work = parser.add_argument_group("how")
    work.add_argument(
        "--best-effort",
        action="store_true",
        help="write the closest plan where the limits cannot all be kept",
    )
    work.add_argument(
        "--effort", type=positive, default=1.0, help="multiply the length of the search by this (1)"
    )
    work.add_argument(
        "--workers", type=at_least_one, metavar="N", help="number of processes (as needed)"
    )
    add_cluster(work)
    add_seed(work)  # type: ignore[arg-type]


def stages(options: argparse.Namespace) -> list[Stage]:
    """Return the shares of the time that each stage usually takes."""
    if _purpose(options, _given(options)).whole:
        search = [("read model", 12.0), ("settings are exchanged", 60.0 * options.effort)]
    else:
        shortest = [("duration", 150.0)] if options.target else []
        search = [("read model", 20.0), *shortest, ("design:", 36.0 * options.effort)]
        search = [*search, ("solved", 10.0)]
    return [("", 1.0), *search, *drawn(options, 8.0)]


def run(options: argparse.Namespace) -> None:
    """Read, design, write."""
    from greybox.errors import UsageError
    from greybox.files import check_targets
    from greybox.model.model import load_model
    from greybox.model.semi_empirical import semi_empirical_model
    from greybox.vessel.toml import load_vessel

    if options.legs is not None:
        from experiment_design.output.legs_file import legs_path

        options.legs = str(legs_path(options.legs, options.out))
    legs = _legs_files(options)
    require_ending(options.out, ".csv", "a plan")
    require_ending(options.save_model, ".json", "a model", "--save-model")
    check_targets(
        options.out, options.json, options.sheet, options.report, *legs, options.save_model
    )
    if options.sheet:
        from experiment_design.output.trial_sheet import sheet_kind

        sheet_kind(options.sheet)
    untried = options.prior == NO_PRIOR
    given = _given(options)
    purpose = _purpose(options, given)
    require_compatible(given if options.between else given | {f"for {purpose.name}"})
    if options.between is None and options.model is None and not untried and not options.after:
        raise UsageError(
            "--model is missing: name a prior model, two with --between A B, what has been sailed "
            "with --after LOG, or start without one by --prior none."
        )
    vessel = load_vessel(options.vessel)
    _duration(options)
    sailed: Any = None
    told: tuple[str, ...] = ()
    if options.after:
        model, sailed, told = _after(options, vessel)
    elif untried:
        model = semi_empirical_model(vessel)
    else:
        model = load_model(options.between[0] if options.between else options.model)
    if not (untried or purpose.whole):
        model = model.coefficient_model()
    planned = purpose.run(options, model, vessel, sailed, told)
    shorter = _shorter(
        options, planned, lambda halved: purpose.run(halved, model, vessel, sailed, told)
    )
    planned = replace(
        planned,
        design=replace(planned.design, shorter=shorter),
        notes=(*_idle_cap(options.speed_cap, model), *planned.notes),
    )
    _deliver(options, planned)


def _idle_cap(cap: float | None, model: Any) -> list[str]:
    """Return that a highest speed limits nothing, as no log of the prior comes near it."""
    from greybox.units import UNITS

    low, high = model.record.get("ranges", {}).get("u", (0.0, 0.0))
    fastest = max(abs(low), abs(high)) or model.vessel.service_speed
    if cap is None or not fastest or cap < _IDLE * fastest:
        return []
    knots = UNITS["kn"].factor * cap
    meant = f"; {cap:g} kn is {knots:.3g} m/s" if knots < _IDLE * fastest else ""
    return [f"--speed-cap {cap:g} m/s limits nothing, as the ship goes {fastest:.3g} m/s{meant}"]


def _shorter(
    options: argparse.Namespace, planned: Planned, again: Callable[[argparse.Namespace], Planned]
) -> str:
    """Return the command of half the duration, where that keeps limits that this plan may not."""
    from greybox.errors import GreyboxError

    design = planned.design
    if options.target or design.broken or not design.doubtful or design.request.stand_ins:
        return ""
    half = _duration(options) / 2
    times = [n for n in ("duration", "remaining") if getattr(options, n) is not None]
    halved = argparse.Namespace(**vars(options) | dict.fromkeys(times, half))
    try:
        if again(halved).design.remedy:
            return ""
    except GreyboxError:
        return ""
    typed = " ".join(shlex.quote(t) for t in getattr(options, "typed", ()))
    for name in times:
        typed = re.sub(rf"--{name}[ =]\S+", f"--{name} {half:g}", typed)
    return f"greybox {typed}"


def _run_for_coefficients(
    options: argparse.Namespace, model: Any, vessel: Any, sailed: Any, told: tuple[str, ...]
) -> Planned:
    """Design the trial that tells coefficients."""
    from experiment_design.design import design_trial
    from experiment_design.duration import least_duration

    asked = _asked(options, model, sailed)
    if sailed is not None:
        asked = replace(asked, prior=model)
    request, _ = _prepared(options, model, asked, vessel, sailed)
    notes = (*told, *request.notes)
    if options.target:
        request = least_duration(
            request,
            by_name("--target", map(_target, options.target)),
            best_effort=options.best_effort,
            progress=progress("duration"),
            workers=options.workers,
        )
    design = design_trial(
        request,
        best_effort=options.best_effort,
        progress=progress("design"),
        workers=options.workers,
    )
    return Planned(design, design, notes, _of_sailed(sailed))


def _deliver(options: argparse.Namespace, planned: Planned) -> None:
    """Write the plan and all that was asked for beside it, and tell what was found."""
    from experiment_design.output.next_steps import after_design
    from experiment_design.output.result import write_plan
    from greybox.files import write_json

    design, found, notes, headline = (
        planned.design, planned.found, planned.notes, planned.headline
    )  # fmt: skip
    write_plan(design, options.out)
    legs, said = _legs(options, design)
    if options.json:
        data: dict[str, Any] = found.to_dict() | said | planned.more
        data["notes"] = [*notes, *data["notes"]]
        write_json(data | {"provenance": provenance(options)}, options.json)
    _show(options, design, notes, legs, headline)
    if options.json == "-":
        return
    say(found.summary())
    if legs is not None:
        say(legs.sentence())
    for note in notes:
        say(f"Note: {note}")
    others = (options.sheet, options.report, options.save_model)
    for path in filter(None, (options.out, *_legs_files(options), *others)):
        say(f"wrote {path}")
    record = provenance(options)
    show_next(after_design(record, bool(headline), design.remedy, design.missed(), design.shorter))


def _duration(options: argparse.Namespace) -> float:
    """Return how long the trial may last [s], by either of its names.

    Raises
    ------
    UsageError
        Neither name is given, or both with different numbers.
    """
    from greybox.errors import UsageError

    first, second = options.duration, options.remaining
    if first is not None and second is not None and first != second:
        raise UsageError(
            f"--duration is {first:g} and --remaining {second:g}, two names of one time: give one."
        )
    found = second if first is None else first
    if found is None:
        raise UsageError(
            "--remaining is missing: say how long the rest of the trial may last, in seconds."
            if options.after
            else "--duration is missing: say how long the trial may last, in seconds."
        )
    return float(found)


def _after(options: argparse.Namespace, vessel: Any) -> tuple[Any, Any, tuple[str, ...]]:
    """Return the model of what has been sailed, that itself, and sentences on both."""
    from experiment_design.after import sailed_trial
    from greybox.commands.common import read_logs
    from greybox.model.catalogue import get_structure
    from greybox.model.model import load_model
    from greybox.selection.estimate import estimate_requested
    from greybox.selection.prediction import as_read, require_distinct
    from greybox.selection.request import Request
    from greybox.trial.kinematics import decimate_segments
    from greybox.validation.fit import at_model_rate

    count = len(options.after)
    if options.model:
        model = load_model(options.model)
        logs, told = read_logs(options.after, vessel, None, model.structure.states)
        require_distinct(logs)
        at_model_rate(logs[0], model)
        acting = [replace(log, vessel=model.vessel) for log in logs]
        logs, left_out = decimate_segments(acting, model.sample_time)
        sailed = sailed_trial(model, logs, count)
        said = f"{sailed.sentence()} count as known, moved as {Path(options.model).name} says"
        return model, sailed, (said, *told, *left_out)
    logs, told = read_logs(options.after, vessel, None, get_structure("thesis").states)
    estimate = estimate_requested(logs, Request(seed=options.seed))
    estimate = replace(estimate, notes=(*told, *estimate.notes))
    model = estimate.model()
    model = replace(model, record={**model.record, "provenance": provenance(options)})
    if options.save_model:
        model.save(options.save_model)
    sailed = sailed_trial(model, as_read(logs, estimate), count)
    level = estimate.prediction.level if estimate.prediction else "not judged"
    said = (
        f"estimated on {sailed.sentence()}: {estimate.method} of structure "
        f"'{model.structure.name}', its prediction is {level}"
    )
    return model, sailed, (said, *told)


def _of_sailed(sailed: Any) -> dict[str, Any]:
    """Return what the JSON says of what has been sailed."""
    return {} if sailed is None else {"after": sailed.to_dict()}


def _prepared(
    options: argparse.Namespace, model: Any, asked: Any, vessel: Any, sailed: Any
) -> tuple[Any, bool]:
    """Return the prepared request, and whether its first trial starts where the logs ended."""
    from experiment_design.after import lacking_margin
    from experiment_design.prepare import prepare_request
    from experiment_design.request.regimes import state_words
    from greybox.errors import InfeasibleError

    best_effort = options.best_effort
    if sailed is None or options.start is not None:
        return prepare_request(model, asked, vessel, best_effort=best_effort), False
    ended = state_words(model.structure.states, sailed.end)
    try:
        found = prepare_request(model, replace(asked, start=sailed.end), vessel)
        lacking = lacking_margin(found)
    except InfeasibleError:
        lacking = "some state"
    if not lacking:
        said = f"it starts where the last log ended: {ended} (--start to change)"
        return replace(found, notes=(said, *found.notes)), True
    found = prepare_request(model, asked, vessel, best_effort=best_effort)
    said = (
        f"the last log ended with {ended}, where {lacking} does not keep its margin: steady the "
        f"ship before this plan begins"
    )
    return replace(found, notes=(said, *found.notes)), False


def _run_for_prediction(
    options: argparse.Namespace, model: Any, vessel: Any, sailed: Any, told: tuple[str, ...]
) -> Planned:
    """Design the trial that serves predictions."""
    from experiment_design.for_prediction import design_for_prediction, planning_model
    from experiment_design.prepare import both_sides

    prior = model
    model, said = planning_model(prior, vessel)
    if said:
        told = (*told, said)
        sailed = None if sailed is None else sailed.as_inputs_of(model, prior)
    asked = both_sides(_asked(options, model, sailed), model)
    request, ended = _prepared(options, model, asked, vessel, sailed)
    notes = (*told, *request.of_both_sides)
    found = design_for_prediction(
        request,
        model,
        envelope=by_name("--envelope", (_range(text, vessel) for text in options.envelope)),
        kept_starts=options.trials if options.start is not None else int(ended),
        best_effort=options.best_effort,
        workers=options.workers,
        sailed=sailed.motions if sailed is not None else (),
    )
    return Planned(found.design, found, notes, _of_sailed(sailed), found.headline())


def _run_for_causes(
    options: argparse.Namespace, model: Any, vessel: Any, sailed: Any, told: tuple[str, ...]
) -> Planned:
    """Design the trial that tells causes apart."""
    from experiment_design.for_causes import (
        AskedCauses,
        causes_left_open,
        design_for_causes,
        read_diagnosis,
        without_open_causes,
    )
    from experiment_design.prepare import both_sides, prepare_request
    from greybox.errors import UsageError

    if options.causes:
        causes = AskedCauses({name: {} for name in options.causes}, named=True)
    elif options.diagnosis:
        causes = causes_left_open(read_diagnosis(options.diagnosis), options.diagnosis)
    elif "diagnosis" in model.record:
        causes = causes_left_open(model.record["diagnosis"], options.model)
    else:
        raise UsageError(
            f"--for causes needs to know which are open, and {options.model} is no model of "
            f"greybox diagnose: give --diagnosis D, the JSON of greybox diagnose --json D, or name "
            f"them, such as --causes current heading_bias."
        )
    model, held = without_open_causes(model, causes, vessel)
    request = prepare_request(
        model, both_sides(_asked(options, model), model), vessel, best_effort=options.best_effort
    )
    found = design_for_causes(
        request,
        model,
        causes,
        envelope=by_name("--envelope", (_range(text, vessel) for text in options.envelope)),
        kept_start=options.start is not None,
        best_effort=options.best_effort,
        workers=options.workers,
    )
    notes = (*held, *request.of_both_sides)
    return Planned(found.design, found, notes, {}, found.headline())


def _range(text: str, vessel: Any) -> tuple[str, tuple[float, float]]:
    from greybox.errors import UsageError, suggestion

    name, _, rest = text.partition("=")
    low, _, high = rest.partition(":")
    try:
        first, last = float(low), float(high)
    except ValueError as error:
        raise UsageError(
            f"--envelope '{text}' cannot be read: write COLUMN=LOW:HIGH, such as delta=-0.5:0.5."
        ) from error
    if name not in vessel.commands:
        raise UsageError(
            f"--envelope names '{name}', which is no command of {vessel.name}."
            f"{suggestion(name, vessel.commands)} It has {', '.join(vessel.commands)}."
        )
    if not first < last:
        raise UsageError(
            f"--envelope {name} runs from {first:g} to {last:g}: give the lower first."
        )
    return name, (first, last)


def _run_between(
    options: argparse.Namespace, model: Any, vessel: Any, sailed: Any, told: tuple[str, ...]
) -> Planned:
    """Design the trial between two models."""
    from experiment_design.discriminate import design_between
    from experiment_design.prepare import expected_disturbances, require_own_commands
    from experiment_design.request.request import CandidateModel, full_structure
    from greybox.errors import UsageError
    from greybox.model.model import load_model
    from greybox.vessel.actuation import with_actuators_of

    first, second = (Path(p).stem for p in options.between)
    if first == second:
        first, second = options.between
    asked = _asked(options, model)
    request, _ = _prepared(options, model, asked, vessel, sailed)
    notes = request.notes
    if options.model not in (None, *options.between):
        notes = (
            f"--between begins from its first model, {options.between[0]}, and {options.model} "
            f"takes no part",
            *notes,
        )
    other = load_model(options.between[1]).coefficient_model()
    require_own_commands(other, request.vessel)
    if other.sample_time != request.sample_time:
        raise UsageError(
            f"'{first}' has the sample time {request.sample_time:g} s and '{second}' "
            f"{other.sample_time:g} s: estimate both at one."
        )
    notes = (
        *notes,
        *[f"{second}: {c.sentence}, and it is taken as it is then" for c in other.changes],
    )
    other = other.at_final_parameters()
    structure, theta = full_structure(other)
    vessel = with_actuators_of(request.vessel, other.vessel)
    d = expected_disturbances(other, asked)
    found = design_between(
        request,
        CandidateModel(second, structure, theta, d, vessel, other.integrator),
        (first, second),
        best_effort=options.best_effort,
        progress=progress("design"),
        workers=options.workers,
    )
    lines = found.summary().splitlines()
    return Planned(found.design, found, notes, {}, f"{lines[0]}: {lines[3]}.")


def _legs_files(options: argparse.Namespace) -> tuple[Path, ...]:
    """Return the files that hold the plan as legs."""
    if options.legs is None:
        return ()
    from experiment_design.output.legs_file import csv_path

    return Path(options.legs), csv_path(Path(options.legs))


def _legs(options: argparse.Namespace, design: Any) -> tuple[Any, dict[str, Any]]:
    """Return the plan as legs, written where asked for, and what the JSON says of them."""
    if options.legs is None:
        return None, {}
    from experiment_design.output.legs import legs_of
    from experiment_design.output.legs_file import write_legs
    from greybox.numerics.threads import one_thread

    with one_thread():
        plan = legs_of(design)
    write_legs(design, plan, Path(options.legs))
    return plan, {"legs": {"file": options.legs, **plan.to_dict()}}


def _show(
    options: argparse.Namespace,
    design: Any,
    notes: tuple[str, ...],
    legs: Any = None,
    headline: str = "",
) -> None:
    """Write the sheet and the page that were asked for."""
    tell_drawing()
    if options.sheet:
        from experiment_design.output.trial_sheet import write_sheet

        write_sheet(design, options.sheet, legs)
    if options.report:
        from experiment_design.output.report import design_page
        from greybox.report.page import write_page

        page = design_page(design, notes, provenance(options), headline)
        write_page(page, options.report)


def _asked(options: argparse.Namespace, model: Any, sailed: Any = None) -> Any:
    import numpy as np

    from experiment_design.constraints.limits import Circle, TrialLimits
    from experiment_design.request.expressions import gradient_of
    from experiment_design.request.request import DesignRequest
    from greybox.errors import UsageError
    from greybox.model.model import load_model

    area: Any = None
    if options.area:
        area = read_area(options.area)
    if options.circle:
        if len(options.circle) != 3 or not options.circle[2] > 0:
            raise UsageError("--circle needs three numbers: north, east and a positive radius.")
        area = Circle(*options.circle)
    place = (0.0, 0.0) if options.position is None else options.position
    if options.position is None and area is not None and sailed is not None and sailed.place:
        place = sailed.place
    margins = {"u": options.margin_u, "v": options.margin_v}
    limits = TrialLimits(
        margins={n: m for n, m in margins.items() if m is not None},
        margin_air=options.margin_air,
        area=area,
        position=place,
        clearance=options.clearance,
        speed_cap=options.speed_cap,
        yaw_cap=options.yaw_cap,
        end=by_name("--end", map(_end, options.end)),
        energy=options.energy,
        headings=options.headings,
    )
    combination = {}
    if options.of:
        values = dict(zip(model.names, model.at_final_parameters().theta, strict=True))
        combination = gradient_of(options.of, values)
    process = None if options.process_noise is None else np.array(options.process_noise)
    return DesignRequest(
        duration=_duration(options),
        hold=options.hold,
        regime="auto" if options.regime is None else options.regime,
        start=options.start,
        trials=options.trials,
        predictor=options.predictor,
        estimator=options.estimator or "iv",
        criterion=options.criterion or ("c" if options.of else "D"),
        wanted=tuple(options.want),
        combination=combination,
        current=options.current,
        wind=options.wind,
        gust=options.gust,
        process_noise=process,
        limits=limits,
        prior=None
        if options.prior in (None, NO_PRIOR)
        else load_model(options.prior).coefficient_model(),
        robust=options.robust,
        worst_case=options.worst_case,
        probability=options.probability,
        seed=options.seed,
        effort=options.effort,
    )


def _end(text: str) -> tuple[str, tuple[float, float]]:
    from greybox.errors import UsageError

    name, _, rest = text.partition("=")
    value, _, tolerance = rest.partition(":")
    try:
        return name, (float(value), float(tolerance or 0.05))
    except ValueError as error:
        raise UsageError(
            f"--end '{text}' cannot be read: write NAME=VALUE:TOLERANCE, such as x_n=0:20."
        ) from error


def _target(text: str) -> tuple[str, float]:
    from greybox.errors import UsageError

    name, _, value = text.partition("=")
    try:
        return name, float(value)
    except ValueError as error:
        raise UsageError(
            f"--target '{text}' cannot be read: write NAME=STD, such as Yvv=0.01."
        ) from error


def read_area(path: str | Path) -> Any:
    """Read a sea room: a CSV polygon of ``x_n, y_n`` [m].

    Returns
    -------
    ndarray
        (m, 2) corners, north and east.

    Raises
    ------
    LogError
        The file cannot be read, or is no polygon.
    """
    import numpy as np

    from greybox.errors import LogError
    from greybox.files import read_csv_rows

    path = Path(path)
    header, rows = read_csv_rows(
        path, "the sea room", "Name a CSV file with columns x_n and y_n [m].", _LARGEST_ROOM
    )
    if "x_n" not in header or "y_n" not in header:
        raise LogError(
            f"the sea room '{path.name}' needs columns x_n and y_n [m] in its first line: it has "
            f"{', '.join(header) or 'none'}."
        )
    places = [header.index("x_n"), header.index("y_n")]
    try:
        corners = np.array([[float(r[p]) for p in places] for r in rows])
    except (ValueError, IndexError) as error:
        raise LogError(f"the sea room '{path.name}' holds a corner that is no number.") from error
    if len(corners) > 1 and np.allclose(corners[0], corners[-1]):
        corners = corners[:-1]
    if len(corners) < 3 or not np.isfinite(corners).all() or len(corners) > 500:
        raise LogError(
            f"the sea room '{path.name}' has {len(corners)} corners, 3 to 500 finite ones are "
            f"needed."
        )
    if _crosses_itself(corners):
        raise LogError(
            f"the edge of the sea room '{path.name}' crosses itself: name its {len(corners)} "
            f"corners in their order round it."
        )
    return corners


def _crosses_itself(corners: Any) -> bool:
    """Return whether two edges of a polygon (m, 2) cross."""
    import numpy as np

    begin, along = corners, np.roll(corners, -1, axis=0) - corners
    off = begin[None] - begin[:, None]
    # on which side of each edge each corner lies
    side = along[:, None, 0] * off[..., 1] - along[:, None, 1] * off[..., 0]
    parted = side * np.roll(side, -1, axis=1) < 0
    return bool((parted & parted.T).any())


PURPOSES: Registry[Purpose] = Registry(
    "purpose",
    Purpose(
        "coefficients",
        "the precision of coefficients in one regime",
        _run_for_coefficients,
        COEFFICIENTS,
    ),
    Purpose(
        "prediction",
        "predictions to both sides over the operating envelope, allowing for what the structure "
        "lacks",
        _run_for_prediction,
        whole=True,
    ),
    Purpose("causes", "telling causes apart", _run_for_causes, ("causes", "diagnosis")),
    # T-optimality
    Purpose("between", "", _run_between, ("between",)),
)
