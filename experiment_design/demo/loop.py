"""The loop itself: each step reads what the one before it wrote, as a user's commands would."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from experiment_design.constraints.limits import TrialLimits
from experiment_design.demo.steps import Demo, Files, Step
from experiment_design.design import STOPPED, design_trial
from experiment_design.output.result import Design, write_plan
from experiment_design.prepare import prepare_request
from experiment_design.request.request import DesignRequest
from greybox.channels import MOTION_WORDS
from greybox.diagnosis.diagnose import DiagnosisOptions, diagnose
from greybox.diagnosis.result import Diagnosis, Found
from greybox.errors import UsageError, suggestion
from greybox.estimation.result import Estimate
from greybox.files import make_folder
from greybox.model.catalogue import get_structure
from greybox.model.model import ManoeuvringModel, load_model
from greybox.selection.estimate import estimate_model
from greybox.study.blind import Trial, sail
from greybox.study.blind_causes import Effect
from greybox.study.blind_inputs import pulses
from greybox.study.chapter6 import TRUE
from greybox.trial.checks.check import check_files
from greybox.trial.checks.finding import CheckReport
from greybox.trial.convert.read import read_log
from greybox.trial.store import write_log
from greybox.validation.comparison import Comparison, compare
from greybox.validation.fit import LEFT
from greybox.validation.gain import Gain, gains
from greybox.vessel.toml import load_vessel

Array = NDArray[np.float64]
Tell = Callable[[Step], None]

VESSEL = "thesis"
# what may be hidden: each shows on a plan that keeps its regime
EFFECTS = (
    "current",
    "thruster_lag",
    "input_delay",
    "quadratic_thrust",
    "cubic_damping",
    "lever_arm",
    "heading_bias",
    "waves",
)
# what the designer's model may be off by, and how far the virtual ship lies from it
DOUBT = 0.1
_SECONDS, _NEXT_SECONDS = 600.0, 600.0
_REGIME, _MARGIN_U, _MARGIN_V = "u+v+", 0.5, 0.4
# share of the usual search: enough to beat random sequences clearly
_EFFORT = 0.3


def run_demo(
    folder: str | Path,
    *,
    effect: str = "thruster_lag",
    seed: int = 0,
    tell: Tell = lambda step: None,
    progress: Callable[[str], None] = lambda text: None,
) -> Demo:
    """Go once round the loop on a virtual ship, and leave each step's file in a folder.

    Parameters
    ----------
    folder : str or Path
    effect : str
        What is wrong with the ship that its model lacks: one of `EFFECTS`.
    seed : int
        The ship, the noises and the size of the effect follow from it.
    tell : callable
        Called with each step when it is done.
    progress : callable
        Called with what is being done.

    Raises
    ------
    UsageError
        The effect does not exist, or the ship runs away with it.
    LogError
        The folder cannot be made.
    """
    if effect not in EFFECTS:
        raise UsageError(
            f"there is no effect '{effect}' to hide.{suggestion(effect, EFFECTS)} "
            f"Known: {', '.join(EFFECTS)}."
        )
    files = Files(make_folder(folder))
    steps: list[Step] = []

    def done(step: Step) -> None:
        steps.append(step)
        tell(step)

    prior = prior_model()
    prior.save(files.prior)
    progress("designing the first trial")
    design = _design(prior, _asked(_SECONDS, seed))
    write_plan(design, files.plan)
    done(_designed(design))

    progress("sailing")
    sailed = virtual_sea(design, effect, seed)
    write_log([sailed.estimation], files.trial)
    write_log([sailed.validation], files.other)
    done(_sailed(sailed))

    progress("checking the log")
    ship = load_vessel(VESSEL)
    check = check_files([files.trial], ship)[0]
    done(_checked(check))

    trial, other = read_log(files.trial, ship), read_log(files.other, ship)
    progress("estimating")
    estimate = estimate_model(trial, method="oe", predictor="basic")
    estimate.model().save(files.model)
    done(_estimated(estimate))

    model = load_model(files.model)
    before = _run_on(files.other, {"model": model})
    done(_compared(before))

    diagnosis = diagnose(
        [trial], validate=[other], options=DiagnosisOptions(seed=seed, progress=progress)
    )
    diagnosis.model.save(files.better)
    done(_diagnosed(diagnosis, sailed.truth))

    better = load_model(files.better)
    after = _run_on(files.other, {"model": model, "better": better})
    run, mended = after.runs
    gain = {
        s: g for s, g in gains(run, mended, better.sample_time, seed).items() if s in MOTION_WORDS
    }
    done(_gained(gain))

    progress("designing the next trial")
    asked = _asked(_NEXT_SECONDS, seed, prior=better)
    next_design = _design(better, asked)
    write_plan(next_design, files.next_plan)
    done(_designed_next(next_design, better))
    return Demo(
        files, tuple(steps), design, next_design, trial, other, sailed.truth, check, estimate,
        before, after, gain, diagnosis,
    )  # fmt: skip


def _design(model: ManoeuvringModel, asked: DesignRequest) -> Design:
    """Design a trial; Ctrl-C, which ends a search with the best so far, ends the loop."""
    design = design_trial(prepare_request(model, asked), alternatives=False)
    if design.status == STOPPED:
        raise KeyboardInterrupt
    return design


def _run_on(path: Path, models: Mapping[str, ManoeuvringModel]) -> Comparison:
    # each model reads the log by its own vessel, whose thrusters may be slow or turned
    return compare(models, {name: read_log(path, model.vessel) for name, model in models.items()})


def prior_model() -> ManoeuvringModel:
    """Return the model that the first trial is designed with: Table 6.1, believed to 10 %."""
    structure = get_structure(VESSEL)
    theta = np.array([TRUE[name] for name in structure.parameters])
    covariance = np.diag((DOUBT * theta) ** 2)
    return ManoeuvringModel(structure, theta, covariance, 1.0, load_vessel(VESSEL))


def _asked(seconds: float, seed: int, prior: ManoeuvringModel | None = None) -> DesignRequest:
    return DesignRequest(
        seconds, TrialLimits(margins={"u": _MARGIN_U, "v": _MARGIN_V}), regime=_REGIME,
        effort=_EFFORT, estimator="oe", predictor="basic", seed=seed, prior=prior,
    )  # fmt: skip


def virtual_sea(design: Design, effect: str, seed: int) -> Trial:
    """Sail the plan, and pulses as they are usual, with a ship that has the effect."""
    columns = design.request.schedule.commands
    n, alpha1, alpha2 = (design.commands[0][:, columns.index(c)] for c in ("n", "alpha1", "alpha2"))
    plan = np.column_stack([n, n, alpha1, alpha2])
    start = np.asarray(design.request.starts[0], float)
    rng = np.random.default_rng([seed, 1])
    usual = pulses(rng, len(plan), single=True).target
    return sail(rng, (effect,), (plan, usual), (start, start), spread=DOUBT, single=True)


def _options() -> str:
    return (
        f"--regime {_REGIME} --margin-u {_MARGIN_U:g} --margin-v {_MARGIN_V:g} --estimator oe "
        f"--predictor basic --effort {_EFFORT:g}"
    )


def _designed(design: Design) -> Step:
    gain = design.efficiency_vs_random
    told = (
        f"A plan of {_SECONDS:.0f} s that keeps surge and sway away from zero"
        + ("." if gain is None else f": it gives {gain:.2f} times the information of the "
           f"best of {design.random_kept} random sequences.")
    )  # fmt: skip
    return Step(
        "Design the trial",
        f"greybox design --vessel {VESSEL} --model prior.json --duration {_SECONDS:.0f} "
        f"{_options()} --out plan.csv",
        (told,),
    )


def _sailed(trial: Trial) -> Step:
    return Step(
        "Sail it",
        "",
        (
            f"A virtual ship sails the plan and {len(trial.validation)} s of usual pulses, in "
            f"continuous time, with noisy sensors. It has an effect that its model lacks.",
        ),
    )


def _checked(check: CheckReport) -> Step:
    found = [f"{f.id} ({f.channel}): {f.evidence}" for f in check.findings]
    return Step(
        "Read and check the log",
        f"greybox check trial.csv --vessel {VESSEL}",
        tuple(found) or ("Units, frames, signs, clocks and antenna agree with one another.",),
    )


def _estimated(estimate: Estimate) -> Step:
    return Step(
        "Estimate",
        f"greybox estimate trial.csv --vessel {VESSEL} --method oe --predictor basic "
        f"--out model.json",
        (
            *(
                [f"Prediction: {estimate.prediction.text}"]
                if estimate.prediction is not None
                else []
            ),
            f"Coefficients: {estimate.verdict.text}",
        ),
    )


def _fits(comparison: Comparison, row: int) -> str:
    return ", ".join(
        f"{MOTION_WORDS[s]} {v:.1f} %" if v > LEFT else f"{MOTION_WORDS[s]} diverged"
        for s, v in comparison.fits()[row].items()
    )


def _compared(comparison: Comparison) -> Step:
    return Step(
        "Show what the simulation gets wrong",
        "greybox compare model.json --log other.csv --report compare.html",
        (f"Free run on the other log, 100 % is perfect: {_fits(comparison, 0)}.",),
    )


def _spelled(cause: Found) -> str:
    return ", ".join(
        f"{name} = {q.value:.3g} ± {q.std:.2g}" + (f" {q.unit}" if q.unit != "1" else "")
        for name, q in cause.parameters.items()
    )


def truth_sentence(hidden: Sequence[Effect]) -> str:
    """Return what was wrong with the ship."""
    told = [
        f"{e.id} ("
        + ", ".join(f"{k} = {v if isinstance(v, str) else f'{v:.3g}'}"
                    for k, v in e.parameters.items())
        + ")"
        for e in hidden
    ]  # fmt: skip
    return f"The hidden effect was: {'; '.join(told)}."


def _diagnosed(diagnosis: Diagnosis, hidden: Sequence[Effect]) -> Step:
    said = [f"Verdict: {diagnosis.verdict}; {diagnosis.headline}"]
    said += [f"{c.id}: {_spelled(c)}." for c in diagnosis.causes]
    return Step(
        "Name the cause and extend the model",
        f"greybox diagnose trial.csv --vessel {VESSEL} --validate other.csv --out better.json "
        f"--report diagnosis.html",
        (*said, truth_sentence(hidden)),
    )


def _gained(gain: Mapping[str, Gain]) -> Step:
    told = [
        f"{MOTION_WORDS[s]} from {g.before:.1f} to {g.after:.1f} % (95 % interval of the gain "
        f"{g.ci[0]:.1f} to {g.ci[1]:.1f})"
        for s, g in gain.items()
    ]
    return Step(
        "Measure the gain",
        "greybox compare model.json better.json --log other.csv --report gain.html",
        (f"Fit of the free run on the other log: {'; '.join(told)}.",),
    )


def _designed_next(design: Design, model: ManoeuvringModel) -> Step:
    known = dict(zip(model.names, model.std, strict=True))
    relative = {
        n: (known[n] / abs(v), std / abs(v))
        for n, v, std in zip(design.names, design.values, design.std, strict=True)
        if n in known and v
    }
    name = max(relative, key=lambda n: relative[n])
    now, then = relative[name]
    return Step(
        "Design the next trial",
        f"greybox design --vessel {VESSEL} --model better.json --prior better.json --duration "
        f"{_NEXT_SECONDS:.0f} {_options()} --out next_plan.csv",
        (
            f"{_NEXT_SECONDS:.0f} s more, and {name}, now the least certain coefficient, is "
            f"predicted to be known to {100 * then:.1f} % instead of {100 * now:.1f} % (one "
            f"standard error).",
        ),
    )  # fmt: skip
