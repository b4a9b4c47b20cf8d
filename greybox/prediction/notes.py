"""Notes on a prediction, one sentence each."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.errors import so_many
from greybox.estimation.prediction_verdict import PredictionLevel
from greybox.estimation.verdict import TrustLevel
from greybox.model.model import ManoeuvringModel
from greybox.prediction.conditions import Conditions, Task
from greybox.prediction.extrapolation import Extrapolation, extrapolation_notes
from greybox.prediction.helm import Helm
from greybox.prediction.misfit import held_out_errors
from greybox.prediction.monte_carlo import MonteCarloQuantity
from greybox.prediction.result import Kind, PredictedManoeuvre
from greybox.prediction.running import DrawnRuns
from greybox.prediction.start import Start
from greybox.prediction.trial import TrialCurrent
from greybox.trial.log import TrialLog
from greybox.trial.manoeuvres import Stopping, TurningCircle, ZigZag
from greybox.trial.manoeuvres.finding import Manoeuvre
from greybox.trial.wind import true_wind

Array = NDArray[np.float64]


def instant_orders(kind: Kind, model: ManoeuvringModel, helm: Helm) -> list[str]:
    """Return the commands whose orders act at once, as neither rate nor lag of them is known."""
    moved = helm.steer if kind in ("turning", "zigzag") else helm.drive
    names = [n for n, share in zip(helm.columns, moved, strict=True) if share != 0]
    rates = dict(zip(helm.columns, (x.rate for x in helm.limits), strict=True))
    late = model.vessel.actuation
    slow = (late.rate_on, *model.vessel.lagged_commands)
    forces = late.lag > 0 and late.lag_on == "force"
    return [n for n in names if rates[n] is None and n not in slow and not forces]


def run_notes(
    kind: Kind,
    task: Task,
    model: ManoeuvringModel,
    own: Manoeuvre,
    runs: DrawnRuns,
    unheld: int,
    values: Mapping[str, MonteCarloQuantity | None],
    log: TrialLog,
    helm: Helm,
    start: Start,
    longest: float,
    beyond: Sequence[Extrapolation] | None,
) -> tuple[str, ...]:
    """Say what limits one prediction: draws that were lost, rates, trim, extrapolation."""
    told = []
    total = len(runs.diverged) - 1
    if unheld:
        told.append(
            f"{unheld} of {total + unheld} draws do not hold the approach speed within the limits "
            f"of the commands and were left out, so the intervals are too narrow."
        )
    diverged = int(runs.diverged[1:].sum())
    if diverged:
        told.append(
            f"{diverged} of {so_many(total, 'draw')} "
            f"{'diverges' if diverged == 1 else 'diverge'}, which is a defect of the model and "
            f"nothing that "
            f"the ship does; they count in no interval."
        )
    short = int(((runs.complete[1:] < 0) & ~runs.diverged[1:]).sum())
    if runs.complete[0] < 0:
        told.append(
            f"the estimate itself does not complete the manoeuvre within {longest:.3g} s: "
            f"quantities that it does not reach are marked."
        )
    if short:
        worst = min((v for v in values.values() if v is not None), key=lambda v: v.reached)
        told.append(
            f"{short} of {so_many(total, 'draw')} {'does' if short == 1 else 'do'} not complete "
            f"the manoeuvre within {longest:.3g} s; "
            f"intervals are of the draws that reach the quantity, {worst.reached} at least."
        )
    if instant := instant_orders(kind, model, helm):
        moved = ((k, c) for t in model.vessel.thrusters for k, c, _, _ in t.movements)
        keys = dict.fromkeys(f"{kind}_rate" for kind, column in moved if column in instant)
        told.append(
            f"{', '.join(instant)} {'follow' if len(instant) > 1 else 'follows'} orders at once, "
            f"because the vessel file states no {' or '.join(keys)}: state it "
            f"and estimate again, or a ship whose helm takes time is predicted to answer too early."
        )
    if isinstance(own, TurningCircle | ZigZag) and own.direction * task.sign < 0:
        told.append(
            f"the estimate turns against the order to {task.side}: the sign of its steering is "
            f"wrong, in the vessel file or in the log."
        )
    if abs(start.trim) > 1e-6:
        trim = abs(math.degrees(start.trim) if helm.angular else start.trim)
        unit = " deg" if helm.angular else ""
        side = "starboard" if start.trim > 0 else "port"
        told.append(f"the straight approach needs a steering order of {trim:.3g}{unit} to {side}.")
    if isinstance(own, TurningCircle) and own.unsteady:
        told.append(own.unsteady)
    if isinstance(own, Stopping) and own.unfinished:
        told.append(own.unfinished)
    return (*told, *extrapolation_notes(beyond))


def trust_level(model: ManoeuvringModel) -> TrustLevel:
    """Return the level of the verdict on the coefficients that the model's record holds."""
    level = _verdict(model, "coefficients").get("level")
    known = set(map(str, TrustLevel))
    return TrustLevel(level) if level in known else TrustLevel.NOT_JUDGED


def prediction_level(model: ManoeuvringModel) -> PredictionLevel:
    """Return the level of the verdict on the predictions that the model's record holds."""
    level = _verdict(model, "prediction").get("level")
    known = set(map(str, PredictionLevel))
    return PredictionLevel(level) if level in known else PredictionLevel.NOT_JUDGED


def _verdict(model: ManoeuvringModel, part: str) -> Mapping[str, Any]:
    verdict = model.record.get("verdict")
    found = verdict.get(part) if isinstance(verdict, Mapping) else None
    return found if isinstance(found, Mapping) else {}


def model_notes(model: ManoeuvringModel, helm: Helm, asked: Conditions) -> tuple[str, ...]:
    """Say what holds for all manoeuvres of a prediction."""
    told = []
    if trust_level(model) in (TrustLevel.DO_NOT_TRUST, TrustLevel.TRUST_EXCEPT):
        said = _verdict(model, "coefficients")["text"]
        told.append(f"the estimate's own verdict on its coefficients is '{said}'.")
    if prediction_level(model) in (PredictionLevel.LIMITED, PredictionLevel.POOR):
        said = _verdict(model, "prediction")["text"]
        told.append(f"the estimate's own verdict on its predictions is '{said}'.")
    if not model.covariance.any():
        told.append("the model has no covariance, so its parameters were taken as exact.")
    if asked.disturbed and model.noise is None:
        told.append(
            "the model has no noise levels, so --disturbed adds nothing: estimate it with "
            "--method iv or oe."
        )
    elif not asked.disturbed:
        told.append(
            "intervals hold the uncertainty of the parameters"
            + (" and of the current" if asked.current and model.disturbances else "")
            + (
                ". They leave out the errors of the model's free runs on held-out logs, which "
                "MODEL does not hold (one that greybox estimate wrote does), and what waves"
                if held_out_errors(model) is None
                else " and the forces that the model lacks, by how far its free runs were off on "
                "held-out logs. They leave out what waves"
            )
            + " and gusts do to a single trial (--disturbed adds it)."
        )
    if asked.current and not model.disturbances:
        told.append("the model has no current, so --current adds nothing.")
    if not asked.limited:
        told.append("the ranges of the commands in the vessel file were not kept.")
    return tuple(told)


def trial_notes(
    helm: Helm,
    predicted: PredictedManoeuvre,
    found: Manoeuvre,
    log: TrialLog,
    asked: Conditions,
    *,
    own_start: bool,
    windy: bool,
    current: TrialCurrent | None,
    usual: Array | None = None,
) -> list[str]:
    """Say what the run took from the trial, and where its commands are others.

    `usual` is the model's current, north and east [m/s], where the run is sailed in it unless the
    trial tells its own.
    """
    run = found.length / max(found.approach_speed.value, 1e-9)
    k = (log.t >= found.start - run) & (log.t < found.start)
    told = []
    if log.has_wind:
        north, east = true_wind(log["u_q"], log["v_q"], log["psi"], log["u"], log["v"])
        during = (log.t >= found.start) & (log.t <= found.stop)
        wind = math.hypot(float(north[during].mean()), float(east[during].mean()))
        told.append(
            f"sailed in the wind of the trial, {wind:.2g} m/s in the mean."
            if windy
            else f"the trial had {wind:.2g} m/s of mean wind, which the model does not include."
        )
    if current is not None:
        told.append(current.sentence)
    elif usual is not None and usual.any():
        towards = math.degrees(math.atan2(usual[1], usual[0])) % 360
        told.append(
            f"sailed in the model's current, {math.hypot(*usual):.2g} m/s towards {towards:.0f} "
            f"deg, as the trial does not tell its own (--still-water leaves it out)."
        )
    if isinstance(found, TurningCircle) and found.slowed:
        told.append(found.slowed)
    if own_start:
        told.append(
            f"the run starts from the trial's own state at the order, "
            f"{found.approach_speed.value:.3g} m/s over the ship length before it, at the trial's "
            f"own commands."
        )
        return told
    if not k.any() or asked.command:
        return told
    for name, drive in zip(helm.columns, helm.drive, strict=True):
        if drive == 0 or name not in log:
            continue
        real, own = float(np.median(log[name][k])), predicted.commands[name]
        if not min(own.low, own.value * 0.99) <= real <= max(own.high, own.value * 1.01):
            told.append(
                f"the model needs {name} = {own.value:.4g} to hold the trial's approach speed of "
                f"{found.approach_speed.value:.3g} m/s, the trial ran at {real:.4g}: try --command."
            )
    return told
