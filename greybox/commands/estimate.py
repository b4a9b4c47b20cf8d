"""`greybox estimate`: parameters with standard errors, and whether to trust them."""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

from greybox.commands.common import (
    add_cluster,
    add_logs,
    add_memory,
    add_outputs,
    add_seed,
    by_name,
    configured,
    drawn,
    is_named,
    leave_to_others,
    positive,
    progress,
    provenance,
    publish,
    read_logs,
    require_ending,
)
from greybox.estimation.registry import ESTIMATORS
from greybox.model.predictor_kinds import PREDICTORS
from greybox.numerics.effort import EFFORT
from greybox.numerics.threads import one_thread

if TYPE_CHECKING:
    from greybox.commands.time_left import Stage
    from greybox.estimation.result import Estimate
    from greybox.report.page import Page
    from greybox.selection.estimate_stream import StreamEstimate
    from greybox.selection.request import Request
    from greybox.selection.stretches import Drawn
    from greybox.selection.structures import StructureChoice
    from greybox.trial.log import TrialLog
    from greybox.trial.plan_parts import SailedPlan

HELP = "estimate a model from logs, with standard errors and whether to trust them"
EXAMPLES = """examples:
  greybox estimate trial.csv --vessel ship.toml --out model.json --report model.html
  greybox estimate a.csv b.csv --vessel ship.toml --method iv --predictor augmented --out m.json
  greybox estimate trial.csv --vessel ship.toml --method oe --bound Xu=-0.2:0 --out m.json
  greybox estimate trial.csv --vessel ship.toml --structure 'thesis+N_|r|r-Xkappa' --out m.json
  greybox estimate trial.csv --vessel ship.toml --reduce --out m.json
  greybox estimate a.csv b.csv --vessel ship.toml --validate c.csv --out m.json
  greybox estimate trial.csv --vessel ship.toml --plan plan.csv --out m.json
  greybox estimate a.csv b.csv --vessel ship.toml --compare-structures thesis linear modulus
  greybox estimate campaign/ --vessel ship.toml --method iv --predictor augmented --out m.json
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_logs(parser)
    parser.add_argument("--out", metavar="MODEL", help="write the model to this JSON file")
    add_outputs(parser, "the result", "plots and all tests")
    add_seed(parser)
    add_cluster(parser)
    _add_model(parser)
    _add_data(parser)
    _add_instruments(parser)
    _add_output_error(parser)


def _add_model(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("model and method")
    group.add_argument(
        "--method",
        choices=tuple(ESTIMATORS),
        help=f"{', '.join(e.words for e in ESTIMATORS.values())}; chosen by default, with a "
        "note that says why",
    )
    group.add_argument(
        "--predictor",
        choices=tuple(PREDICTORS),
        help="current and wind left out (basic), unknown (augmented) or measured (wind); chosen by "
        "default",
    )
    group.add_argument(
        "--structure",
        metavar="NAME",
        help="thesis, surge, linear, blanke, modulus, abkowitz; +TERM and -TERM change it, in "
        "quotes where a TERM holds |; chosen by default",
    )
    group.add_argument(
        "--effort",
        type=positive,
        default=EFFORT,
        metavar="SECONDS",
        help="time limit for choosing what you leave open [s]; notes name what was not tried "
        f"within it, and the first estimate is always completed ({EFFORT:g})",
    )
    chosen = group.add_mutually_exclusive_group()
    chosen.add_argument(
        "--reduce",
        action="store_true",
        help="leave out terms one by one, as long as held-out free runs get no worse",
    )
    chosen.add_argument(
        "--compare-structures",
        nargs="+",
        metavar="NAME",
        help="compare structures by held-out free runs and estimate the one that is chosen",
    )
    group.add_argument(
        "--covariance",
        choices=("cluster", "ma", "hac", "white", "bootstrap"),
        help="how standard errors are computed: by the spread between segments where that is "
        "larger (cluster, the default), for residuals that are a moving average (ma), coloured "
        "(hac) or white, or by a block bootstrap",
    )
    group.add_argument(
        "--mass", type=positive, metavar="KG", help="mass [kg], for physical coefficients"
    )


def _add_data(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("data")
    group.add_argument(
        "--sample-time",
        type=positive,
        metavar="S",
        help="decimate the logs to this sample time [s]; by default that of the logs",
    )
    add_memory(
        group,
        "memory limit [GiB]; larger logs are read in passes, and the tests use their most "
        "informative stretches",
    )
    group.add_argument(
        "--validate",
        nargs="+",
        default=[],
        metavar="LOG",
        help="logs that the prediction is judged on and the estimate does not use; by default the "
        "logs, or parts of them, are left out in turn",
    )
    group.add_argument(
        "--plan",
        metavar="PLAN",
        help="plan of greybox design that the ship followed: its lead-in is left out, and an "
        "estimate of the rest is judged on its validation part; the model then rests on both",
    )
    group.add_argument(
        "--margin-u",
        type=positive,
        metavar="M",
        help="cut out samples with |u| below M [m/s]; by default none",
    )
    group.add_argument(
        "--margin-v",
        type=positive,
        metavar="M",
        help="cut out samples with |v| below M [m/s]; by default none",
    )
    group.add_argument(
        "--loop",
        choices=("auto", "open", "closed"),
        default="auto",
        help="whether a controller moved the thrusters (auto: as [closed_loop] of the vessel file "
        "says)",
    )
    group.add_argument(
        "--heading",
        choices=("measured", "simulated"),
        help="heading that the instruments are computed with (measured); with oe: whether the "
        "measured heading drives the run, or a simulated one is compared with it (chosen)",
    )
    group.add_argument(
        "--nominal",
        metavar="MODEL",
        help="model that the first instruments are simulated with, or that oe starts from (the "
        "least-squares estimate by default)",
    )


def _add_instruments(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("instrumental variables (--method iv)")
    group.add_argument(
        "--instruments",
        choices=("zero-mean", "mean-kept"),
        default="zero-mean",
        help="instruments without their mean (IV2, IV3) or with it (IV1) (zero-mean)",
    )
    group.add_argument(
        "--prefilter",
        choices=("auto", "noise", "none"),
        default="auto",
        help="noise: filter all equations together by their noise model; auto: where the tests "
        "allow it (auto)",
    )


def _add_output_error(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("output error (--method oe)")
    group.add_argument(
        "--process-noise",
        action="store_true",
        help="estimate the process noise too, by the likelihood of the innovations",
    )
    group.add_argument(
        "--wind",
        choices=("measured", "simulated"),
        default="measured",
        help="take the measured wind as an input of the run, or simulate a constant wind and "
        "compare it with the measured one (measured)",
    )
    group.add_argument(
        "--loss",
        choices=("gaussian", "huber"),
        default="gaussian",
        help="weight of large errors; huber gives outliers less (gaussian)",
    )
    group.add_argument(
        "--weights",
        choices=("noise", "deviation"),
        default="noise",
        help="scale of the errors: the noise of the outputs, or the standard deviation of the "
        "errors, for a model that fits worse than that (noise)",
    )
    group.add_argument(
        "--shooting",
        choices=("auto", "single", "multiple"),
        default="auto",
        help="one run over each log, or for long or unstable ones segments that must join (auto)",
    )
    group.add_argument(
        "--bound",
        nargs="+",
        default=[],
        metavar="NAME=LOW:HIGH",
        help="range that a parameter is kept in, such as Xu=-0.2:0",
    )
    group.add_argument(
        "--prior",
        nargs="+",
        default=[],
        metavar="NAME=VALUE:STD",
        help="value and standard error of a parameter known beforehand, such as Nr=-0.1:0.02",
    )
    group.add_argument(
        "--damping",
        choices=("warn", "enforce"),
        default="warn",
        help="warn of damping terms with a sign that would drive the ship, or enforce the other "
        "sign (warn)",
    )


def _pairs(texts: list[str], what: str) -> dict[str, tuple[float, float]]:
    """Read NAME=A:B."""
    from greybox.errors import UsageError

    found = []
    for text in texts:
        name, _, values = text.partition("=")
        try:
            first, second = (float(v) for v in values.split(":"))
        except ValueError:
            raise UsageError(
                f"--{what} '{text}' cannot be read: write NAME={_FORMS[what]}, such as "
                f"{_EXAMPLES[what]}."
            ) from None
        found.append((name, (first, second)))
    return by_name(f"--{what}", found)


# what other methods do not heed, by those that do
_ONLY = {
    ("iv", "oe"): ("heading", "nominal"),
    ("iv",): ("instruments", "prefilter"),
    ("oe",): ("process_noise", "wind", "loss", "weights", "shooting", "bound", "prior", "damping"),
}


def _require_heeded(options: argparse.Namespace) -> None:
    """Raise where an option is given that the method may not heed, named or chosen."""
    from greybox.errors import UsageError

    parser = argparse.ArgumentParser()
    add_arguments(parser)
    for methods, names in _ONLY.items():
        for name in names if options.method not in methods else ():
            # a measured heading is what a method without a choice takes
            if not is_named(options, name) or (name, options.heading) == ("heading", "measured"):
                continue
            option = f"--{name.replace('_', '-')}"
            only = f"{option} applies to --method {' and '.join(methods)} only"
            if options.method is None:
                raise UsageError(
                    f"{only}, and without --method the data may choose another one: add --method "
                    f"{' or '.join(methods)}, or leave {option} out."
                )
            # a method that is typed wins over a file, one that the file names contradicts it
            if "method" in configured(options) or not leave_to_others(
                options, name, parser.get_default(name)
            ):
                raise UsageError(
                    f"{only}, but --method is {options.method}: leave one of them out."
                )


_FORMS = {"bound": "LOW:HIGH", "prior": "VALUE:STD"}
_EXAMPLES = {"bound": "Xu=-0.2:0", "prior": "Nr=-0.1:0.02"}
_ROLES: dict[str | None, Literal["auto", "input", "output"]] = {
    None: "auto",
    "measured": "input",
    "simulated": "output",
}


def _choose(
    logs: list[TrialLog], request: Request, options: argparse.Namespace
) -> StructureChoice | None:
    """Choose a structure where the options ask for it."""
    from greybox.errors import UsageError
    from greybox.selection.reduction import reduce_structure
    from greybox.selection.structures import compare_structures

    if options.reduce:
        return reduce_structure(logs, request, progress("coefficients left out"))
    if not options.compare_structures:
        return None
    if options.structure is not None:
        raise UsageError(
            f"--structure names '{options.structure}' and --compare-structures "
            f"{len(options.compare_structures)} more: name all structures to compare there."
        )
    return compare_structures(
        logs, options.compare_structures, request, progress("structures compared")
    )


def _with_verdict_of(estimate: Estimate, judged: Estimate) -> Estimate:
    """Return an estimate with the verdict on one of fewer samples, unless its own runs diverge."""
    from greybox.estimation.prediction_verdict import HeldCommandsDiverge
    from greybox.estimation.verdict import Divergence

    own = estimate.prediction.because if estimate.prediction else ()
    if any(isinstance(r, Divergence | HeldCommandsDiverge) for r in own):
        return estimate
    return replace(estimate, prediction=judged.prediction)


def stages(options: argparse.Namespace) -> list[Stage]:
    """Return the shares of the time that each stage usually takes."""
    # what is named is taken as it is
    searches = (
        ("coefficients left out", options.reduce),
        ("structures compared", options.compare_structures),
        ("selection of terms", not (options.method or options.predictor or options.structure)),
    )
    return [
        ("", 5.0), ("ways to estimate", 25.0),
        *((words, 50.0) for words, made in searches if made),
        ("verdict on predictions", 6.0), *drawn(options, 25.0),
    ]  # fmt: skip


@one_thread()
def run(options: argparse.Namespace) -> None:
    """Read, estimate, report, write."""
    from greybox.errors import UsageError
    from greybox.estimation.output_error import OutputErrorOptions
    from greybox.files import check_targets
    from greybox.model.catalogue import get_structure, structure_for
    from greybox.model.model import load_model
    from greybox.report.next_steps import after_estimate
    from greybox.report.physical import physical_summary
    from greybox.selection.estimate import estimate_requested
    from greybox.selection.estimate_stream import BYTES, estimate_stream, require_adding
    from greybox.selection.request import Request
    from greybox.selection.stretches import draw
    from greybox.trial.log_files import find_logs
    from greybox.trial.plan_parts import by_parts, read_plan
    from greybox.trial.stream import estimated_rows, open_stream
    from greybox.vessel.force import force_inputs
    from greybox.vessel.toml import load_vessel

    _require_heeded(options)
    require_ending(options.out, ".json", "a model")
    check_targets(options.out, options.json, options.report)
    vessel = load_vessel(options.vessel)
    # the vessel's own terms may be changed too: here only the states matter
    named = options.structure or (options.compare_structures or ["thesis"])[0]
    states = get_structure(named.split("+")[0].split("-")[0]).states
    for name in ("u", "v"):
        given, needless = getattr(options, f"margin_{name}"), name not in states
        if needless and given is not None and not leave_to_others(options, f"margin_{name}", None):
            raise UsageError(
                f"--margin-{name} cuts out samples by {name}, which structure '{named}' has not: "
                f"leave it out."
            )
    files = find_logs(options.logs)
    rows = estimated_rows(files)
    streams = rows * BYTES > options.memory * 2**30
    logs: list[TrialLog] = []
    left_out: tuple[str, ...] = ()
    if not streams:
        logs, left_out = read_logs(options.logs, vessel, options.sample_time, states)
    elif options.plan:
        raise UsageError(
            f"--plan needs the logs in memory, and {rows} rows take about "
            f"{rows * BYTES / 2**30:.3g} GiB where --memory gives {options.memory:g}: give it "
            f"more, or fewer logs."
        )
    validate, no_part = read_logs(options.validate, vessel, options.sample_time, states)
    parts: tuple[SailedPlan, ...] = ()
    rest: list[TrialLog] = []
    judges: list[TrialLog] = []
    if options.plan:
        plan = read_plan(options.plan, vessel)
        rest, judges, parts = by_parts(logs, plan)
        logs, _, _ = by_parts(logs, [p.with_validation_estimated() for p in plan])
        left_out = (*left_out, *(p.sentence for p in parts))
    margins = {k: v for k, v in (("u", options.margin_u), ("v", options.margin_v)) if v is not None}
    request = Request(
        method=options.method,
        predictor=options.predictor,
        structure=options.structure,
        margins=margins or None,
        covariance=options.covariance,
        heading=options.heading or "measured",
        output_error=OutputErrorOptions(
            process_noise=options.process_noise,
            heading=_ROLES[options.heading],
            wind="output" if options.wind == "simulated" else "input",
            loss=options.loss,
            shooting=options.shooting,
            bounds=_pairs(options.bound, "bound"),
            priors=_pairs(options.prior, "prior"),
            damping=options.damping,
            weights=options.weights,
        ),
        loop=options.loop,
        zero_mean=options.instruments == "zero-mean",
        prefilter=options.prefilter,
        nominal=load_model(options.nominal) if options.nominal else None,
        seed=options.seed,
        validate=tuple(validate),
        effort=options.effort,
    )
    drawn: Drawn | None = None
    if streams:
        require_adding(request)
        stream = open_stream(files, vessel, states=states, sample_time=options.sample_time)
        drawn = draw(stream, structure_for(named, force_inputs(vessel)))
        logs = list(drawn.logs)
    choice = _choose(logs, request, options)
    found: StreamEstimate | None = None
    if drawn is not None:
        found = estimate_stream(drawn, request, choice.estimate if choice else None)
        estimate = found.estimate
    else:
        estimate = choice.estimate if choice else estimate_requested(logs, request)
    if judges:
        before = replace(request, validate=(*validate, *judges))
        chosen = _choose(rest, before, options)
        judged = chosen.estimate if chosen else estimate_requested(rest, before)
        estimate = _with_verdict_of(estimate, judged)
    estimate = replace(estimate, notes=(*left_out, *no_part, *estimate.notes))
    model = estimate.model()
    told: dict[str, Any] = {"structure_choice": choice.to_list()} if choice else {}
    if found is not None:
        told["stream"] = found.to_dict()
    made = provenance(options)
    if parts:
        made["plan"] = [p.to_dict() for p in parts]
    model = replace(model, record={**model.record, **told, "provenance": made})
    mass = options.mass if options.mass is not None else vessel.mass
    if options.out:
        model.save(options.out)
    summaries = [estimate.summary()]
    summaries += [choice.summary()] if choice else []
    summaries += [physical_summary(model, mass)] if mass is not None else []

    def page() -> Page:
        from greybox.report.estimation import estimation_page
        from greybox.selection.prediction import as_read
        from greybox.trial.segments import as_segments

        kept = as_read(as_segments(validate), estimate) if validate else ()
        return estimation_page(
            estimate, as_read(logs, estimate), made, choice=choice, mass=mass, validate=kept
        )

    steps = after_estimate(estimate, made)
    publish(options, model.to_dict(), "\n\n".join(summaries), page, steps, [options.out])
