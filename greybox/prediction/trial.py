"""The same manoeuvre in a trial: found, sailed under its conditions, and compared."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from greybox.errors import LogError
from greybox.model.model import ManoeuvringModel
from greybox.prediction.conditions import Conditions, Task
from greybox.prediction.helm import Helm
from greybox.prediction.measuring import LABELS, quantities
from greybox.prediction.monte_carlo import MonteCarloQuantity
from greybox.prediction.result import Agreement, Compared, Kind, PredictedManoeuvre, Side
from greybox.rotation import ned_to_body
from greybox.trial.log import TrialLog
from greybox.trial.manoeuvres import (
    Quantity,
    Stopping,
    TurningCircle,
    ZigZag,
    find_manoeuvres,
    steering_angle,
)
from greybox.trial.manoeuvres.finding import Manoeuvre
from greybox.trial.manoeuvres.stopping import measure_stopping
from greybox.trial.manoeuvres.track import make_track, without_antenna
from greybox.trial.raw_log import shortened

Array = NDArray[np.float64]

# how far angles may be from those asked for, to be the same manoeuvre [rad]
_NEAR = math.radians(2.5)
_POINTS = 1500
# largest moves of a helm that are left out, as the two of one wrong sample
_FAULTS = 2
# share of an order in one sample that is no motion of a helm but a logged command
_JUMP = 0.5
# logs that a sentence names: one with gaps comes as many
_MOST_NAMES = 4


def found_in_trial(
    kind: Kind, logs: Sequence[TrialLog], helm: Helm, asked: Conditions
) -> list[tuple[Task, Manoeuvre, TrialLog]]:
    """Return what to sail to predict each manoeuvre of a kind in the logs of a trial.

    Raises
    ------
    LogError
        There is none; what there is instead is named.
    """
    there = [(m, log) for log in logs for m in find_manoeuvres(log, scale=asked.scale)]
    made = [(_task(m, log, helm, asked), m, log) for m, log in there if _is(kind, m)]
    kept = [entry for entry in made if _wanted(entry[0], asked)]
    if not kept:
        names = shortened((f"'{log.name}'" for log in logs), _MOST_NAMES)
        labels = "; ".join(m.label for m, _ in there)
        found = f"but {labels}" if there else "nor any other"
        more = " of that side or angle" if made else ""
        raise LogError(
            f"there is no {kind} manoeuvre{more} in {names}, {found}: name another log, "
            f"or predict without --trial."
        )
    return kept


def _is(kind: Kind, found: Manoeuvre) -> bool:
    if isinstance(found, TurningCircle):
        return kind == "turning"
    if isinstance(found, ZigZag):
        return kind == "zigzag"
    return kind == ("crash" if found.reversed else "stopping")


def _wanted(task: Task, asked: Conditions) -> bool:
    if asked.side and task.side != asked.side:
        return False
    if not asked.angles or task.order is None:
        return True
    return any(
        abs(task.order - a) <= _NEAR
        and (task.heading is None or abs(task.heading - (a if h is None else h)) <= _NEAR)
        for a, h in asked.angles
    )


def _task(found: Manoeuvre, log: TrialLog, helm: Helm, asked: Conditions) -> Task:
    speed = asked.speed
    if speed is None and not asked.command:
        speed = found.approach_speed.value
    course = found.approach_heading.value
    if isinstance(found, Stopping):
        return Task("", None, None, speed, course)
    side: Side = "starboard" if found.direction > 0 else "port"
    heading = None
    if isinstance(found, ZigZag):
        heading = float(np.mean([q.value for q in found.switch_headings]))
    if helm.angular and found.rudder is not None:
        order = found.rudder / helm.angle_per_order
    else:
        order = _speeds(found, log, helm)
    return Task(side, order, heading, speed, course)


def _speeds(found: Manoeuvre, log: TrialLog, helm: Helm) -> float:
    """Return the steering order that the speeds of a log amount to, positive."""
    k = (log.t >= found.start) & (log.t <= found.stop)
    steering = [i for i, s in enumerate(helm.steer) if s != 0]
    speed = {i: float(np.median(log[helm.columns[i]][k])) for i in steering}
    if helm.kind == "difference":
        ahead = {i: math.copysign(1.0, helm.drive[i]) * n for i, n in speed.items()}
        common = float(np.mean(list(ahead.values())))
        return abs(float(np.mean([helm.steer[i] * n for i, n in ahead.items()])) / common)
    return abs(float(np.mean([helm.steer[i] * n for i, n in speed.items()])))


def with_rates(
    helm: Helm, found: Sequence[tuple[Task, Manoeuvre, TrialLog]]
) -> tuple[Helm, list[str]]:
    """Return a helm whose steering moves as fast as in the trial, where no rate is stated."""
    limits, told = list(helm.limits), []
    for i, name in enumerate(helm.columns):
        if helm.steer[i] == 0 or limits[i].rate is not None or found[0][0].order is None:
            continue
        steps = [
            np.abs(np.diff(log[name][(log.t >= m.start - log.sample_time) & (log.t <= m.stop)]))
            / log.sample_time
            for _, m, log in found
            if name in log
        ]
        moves = np.sort(np.concatenate([*steps, np.zeros(_FAULTS + 1)]))
        # single steps are faults of the sensor, small ones its noise
        fast = float(moves[-1 - _FAULTS])
        if fast <= 0:
            continue
        rate = float(np.median(moves[moves > fast / 2]))
        smallest = min(abs(task.order) for task, _, _ in found if task.order is not None)
        if rate * found[0][2].sample_time > _JUMP * smallest:
            limits[i] = replace(limits[i], rate=math.inf)
            told.append(
                f"the vessel file states no rate of {name}; it moves at once, as in the trial."
            )
            continue
        limits[i] = replace(limits[i], rate=rate)
        unit, factor = (" deg", 180 / math.pi) if helm.angular else ("", 1.0)
        told.append(
            f"the vessel file states no rate of {name}; it moves at {rate * factor:.3g}{unit} per "
            f"second here, as in the trial."
        )
    return replace(helm, limits=tuple(limits)), told


def end_again(found: Manoeuvre, log: TrialLog, share: float) -> Manoeuvre:
    """Measure a stop again until the share of the approach speed that was asked for."""
    if not isinstance(found, Stopping) or share == 0:
        return found
    x_n, y_n = _positions(log)
    return measure_stopping(
        log.t, x_n, y_n, log["psi"], log["u"], log["v"],
        start=found.start, length=found.length, stop=found.stop,
        reversed_thrust=found.reversed, end_speed=share * found.approach_speed.value,
        heading_std=log.vessel.std("psi"), position_std=log.vessel.std("position"),
    )  # fmt: skip


def compare(
    model: ManoeuvringModel,
    helm: Helm,
    found: Manoeuvre,
    log: TrialLog,
    predicted: PredictedManoeuvre,
) -> Agreement:
    """Put predicted and measured quantities side by side.

    A difference's interval is the root of the sum of squares of both intervals, side by side.
    """
    rows = []
    for name, value in quantities(found).items():
        beside = predicted.quantities.get(name)
        if value is None or beside is None or name == "approach_speed":
            continue
        low, high = value.interval
        gap = value.value - beside.value
        below = math.hypot(value.value - low, beside.high - beside.value)
        above = math.hypot(high - value.value, beside.value - beside.low)
        difference = MonteCarloQuantity(
            gap, (below + above) / 2 / 1.96, value.unit, math.inf, gap - below, gap + above
        )
        rows.append(Compared(name, beside, value, difference, -above <= gap <= below))
    # as long as the predicted one, from one ship length before the order
    run = found.length / max(found.approach_speed.value, 1e-9)
    last = min(found.stop, found.start + float(predicted.bundle.t[-1]))
    k = np.flatnonzero((log.t >= found.start - run) & (log.t <= last))
    k = k[:: max(1, len(k) // _POINTS)]
    return Agreement(
        log.name,
        found,
        tuple(rows),
        _sentence(model, log, rows, found.length),
        _track(found, log, k),
        _history(found, log, helm, k),
    )


def _sentence(model: ManoeuvringModel, log: TrialLog, rows: list[Compared], length: float) -> str:
    if not rows:
        return f"'{log.name}' holds nothing of this manoeuvre that could be compared."
    off = [r for r in rows if not r.agrees]
    known = [str(entry.get("sha256", "")) for entry in model.record.get("logs", ())]
    own = log.provenance.sha256
    told = ", on which the model was estimated," if own and own in known else ""
    if not off:
        return (
            f"prediction and '{log.name}'{told} agree: all {len(rows)} differences lie within "
            f"both intervals."
        )
    worst = max(off, key=lambda r: abs(r.difference.value) / max(r.difference.std, 1e-300))
    names = ", ".join(LABELS[r.name] for r in off)
    shown = (
        f"{LABELS[worst.name]}, measured {_short(worst.measured, length)} and predicted "
        f"{_short(worst.predicted, length)}"
    )
    return (
        f"prediction and '{log.name}'{told} agree in {len(rows) - len(off)} of {len(rows)} "
        f"quantities within both intervals; beyond: {names}. Clearest: {shown}."
    )


def _short(value: Quantity, length: float) -> str:
    return value.words(length)[0]


def _positions(log: TrialLog) -> tuple[Array | None, Array | None]:
    if "x_n" not in log or "y_n" not in log:
        return None, None
    antenna = log.vessel.sensors.get("antenna", (0.0, 0.0))
    return without_antenna(log["x_n"], log["y_n"], log["psi"], antenna)


def _track(found: Manoeuvre, log: TrialLog, k: NDArray[np.intp]) -> tuple[Array, Array]:
    x_n, y_n = _positions(log)
    track = make_track(log.t, x_n, y_n, log["psi"], log["u"], log["v"])
    north = track.x_n[k] - np.interp(found.start, log.t, track.x_n)
    east = track.y_n[k] - np.interp(found.start, log.t, track.y_n)
    return ned_to_body(north, east, found.approach_heading.value)


def _history(found: Manoeuvre, log: TrialLog, helm: Helm, k: NDArray[np.intp]) -> dict[str, Array]:
    made = {
        "t": log.t[k] - found.start,
        "heading": log["psi"][k] - found.approach_heading.value,
        "speed": np.hypot(log["u"][k], log["v"][k]),
    }
    if "r" in log:
        made["r"] = log["r"][k]
    steering = steering_angle(log) if helm.angular else None
    if steering is not None:
        made["steering"] = steering[0][k] / helm.angle_per_order
    return made
