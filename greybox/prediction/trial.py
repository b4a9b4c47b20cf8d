"""The same manoeuvre in a trial: found, sailed under its conditions, and compared."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from greybox.errors import LogError
from greybox.estimation.prediction_verdict import LIMITS
from greybox.model.model import ManoeuvringModel
from greybox.prediction.conditions import Conditions, Task
from greybox.prediction.helm import Helm
from greybox.prediction.measuring import LABELS, quantities
from greybox.prediction.monte_carlo import MonteCarloQuantity
from greybox.prediction.orders import EXECUTES, Legs, Ordered, ZigZagOrders, stop, turn
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
from greybox.trial.wind import true_wind
from greybox.vessel.vessel import Actuation

Array = NDArray[np.float64]

# how far angles may be from those asked for, to be the same manoeuvre [rad]
_NEAR = math.radians(2.5)
_POINTS = 1500
# of chi-squared with two degrees of freedom, at 5 %
_CURRENT = 5.99
# share of the greatest command that is a step, and of the way at which the helm has arrived
_STEP, _ARRIVED = 0.25, 0.9
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
    made = []
    for leg in _legs(found):
        speed = np.array([_level(log, n, leg) for n in helm.columns])
        steering = helm.steer != 0
        order = float(np.mean((helm.steer * speed)[steering]))
        if helm.kind == "difference":
            order /= float(np.mean((np.sign(helm.drive) * speed)[steering]))
        made.append(abs(order))
    return float(np.mean(made))


def as_in_trial(asked: Conditions) -> bool:
    """Whether a run starts from the state and the propellers that the trial had.

    What is asked for at another speed, or another thrust astern, starts from the steady run
    that it is found by.
    """
    return asked.speed is None and not asked.command and asked.astern is None


def _legs(found: Manoeuvre) -> list[tuple[float, float]]:
    """Return from when to when each order of a manoeuvre held [s]."""
    if isinstance(found, ZigZag):
        return list(pairwise([*found.executes, found.stop]))
    return [(found.start, found.stop)]


def _level(log: TrialLog, name: str, leg: tuple[float, float]) -> float:
    """Return the command of a leg, of its last half, when the helm has moved there."""
    begin, end = leg
    k = (log.t >= (begin + end) / 2) & (log.t < end)
    return float(np.median(log[name][k])) if k.any() else float(np.interp(end, log.t, log[name]))


def trial_orders(
    helm: Helm, task: Task, found: Manoeuvre, log: TrialLog, sample_time: float, until: float
) -> Ordered:
    """Return the orders of a trial: its commands to either side, its headings of reversal.

    What does not steer follows the log, and keeps its mean after the log's manoeuvre. In a
    stop, which ends at the surge velocity `until` [m/s], all commands follow the log, and keep
    what they were in the last half of it.
    """
    held = np.array(
        [[_level(log, n, leg) for n in helm.columns] for leg in _legs(found)[:EXECUTES]]
    )
    if len(held) == 1 and isinstance(found, ZigZag):
        held = np.vstack([held, held * np.where(helm.steer != 0, -1.0, 1.0)])
    times = np.arange(found.start, found.stop, sample_time)
    logged = np.stack([np.interp(times, log.t, log[n]) for n in helm.columns], axis=1)
    if isinstance(found, Stopping):
        logged = np.vstack([logged, held[0]])
    else:
        logged = np.vstack([logged, logged.mean(axis=0)])
        logged[:, helm.steer != 0] = np.nan

    def legs(runs: NDArray[np.intp]) -> Legs:
        return Legs(np.repeat(held[:, :, None], len(runs), axis=2), logged)

    if isinstance(found, Stopping):
        return lambda runs: stop(legs(runs), np.full(len(runs), until))
    if not isinstance(found, ZigZag):
        return lambda runs: turn(legs(runs))
    reversed_at = [q.value for q in found.switch_headings][: EXECUTES - 1]
    usual = float(np.mean(reversed_at))
    headings = np.array(reversed_at + [usual] * (EXECUTES - 1 - len(reversed_at)))
    return lambda runs: ZigZagOrders(task.sign, headings, legs(runs))


def within_trial(helm: Helm, log: TrialLog) -> Helm:
    """Return a helm whose ranges hold the commands of a trial: the ship did obey them."""
    limits = tuple(
        replace(
            x,
            lower=None if x.lower is None else min(x.lower, float(log[n].min())),
            upper=None if x.upper is None else max(x.upper, float(log[n].max())),
        )
        for n, x in zip(helm.columns, helm.limits, strict=True)
    )
    return replace(helm, limits=limits)


def wind_of(model: ManoeuvringModel, found: Manoeuvre, log: TrialLog) -> Array | None:
    """Return the wind of a trial at the model's samples from the order on (N, 2) [m/s].

    Averaged over the time of one ship length; the mean of the manoeuvre stands after it. None
    where none was measured, or the structure has no air.
    """
    if not (log.has_wind and model.structure.marine and model.structure.uses_air):
        return None
    wind = np.stack(true_wind(log["u_q"], log["v_q"], log["psi"], log["u"], log["v"]))
    half = found.length / max(found.approach_speed.value, 1e-9) / 2
    width = max(1, 2 * round(half / log.sample_time) + 1)
    smooth = uniform_filter1d(wind, width, axis=1, mode="nearest")
    times = np.arange(found.start, found.stop, model.sample_time)
    blown = np.stack([np.interp(times, log.t, part) for part in smooth], axis=1)
    return np.vstack([blown, blown.mean(axis=0)])


@dataclass(frozen=True)
class TrialCurrent:
    """The current of a trial: the set of its turning circles.

    Parameters
    ----------
    value, std : ndarray
        (2,) north and east, and standard errors [m/s].
    """

    value: Array
    std: Array

    @classmethod
    def of(
        cls, sets: Sequence[tuple[TurningCircle, Sequence[TurningCircle]]]
    ) -> TrialCurrent | None:
        """Return what the sets of circles are beyond those of runs in no current.

        Parameters
        ----------
        sets : sequence of (TurningCircle, sequence of TurningCircle)
            Each circle of the trial with its runs, that of the estimate first.

        Returns
        -------
        TrialCurrent or None
            The mean over the circles, weighted by their errors: an error of what wind does is
            taken to be as large as that itself. None where there is no circle, its errors alone
            may make it, at 5 %, or it is less than the share of the speed that counts as motion.
        """
        values, variances, speeds = [], [], []
        for found, runs in sets:
            known = np.array([_set_of(m) for m in runs])
            known = known[np.isfinite(known).all(axis=1)]
            measured = (found.set_north, found.set_east)
            if len(known) < 2 or None in measured:
                continue
            values.append([q.value for q in measured if q is not None] - known[0])
            error = np.array([q.std for q in measured if q is not None])
            speeds.append(found.approach_speed.value)
            variances.append(error**2 + known[0] ** 2 + known[1:].var(axis=0))
        if not values:
            return None
        value, weight = np.array(values), 1 / np.maximum(variances, 1e-12)
        mean = (weight * value).sum(axis=0) / weight.sum(axis=0)
        beyond = (weight * (value - mean) ** 2).sum() / max(1, 2 * (len(value) - 1))
        std = np.sqrt(max(1.0, float(beyond)) / weight.sum(axis=0))
        least = LIMITS.speed * float(np.mean(speeds))
        if ((mean / std) ** 2).sum() <= _CURRENT or math.hypot(*mean) < least:
            return None
        return cls(mean, std)

    def drawn(self, rng: np.random.Generator, runs: int) -> Array:
        """Return currents (2, R), the first without error [m/s]."""
        error = rng.standard_normal((2, runs))
        error[:, 0] = 0.0
        return np.asarray(self.value[:, None] + self.std[:, None] * error)

    @property
    def sentence(self) -> str:
        """What it is, in words."""
        speed = math.hypot(*self.value)
        error = math.sqrt(float(((self.value / speed) ** 2 * self.std**2).sum()))
        towards = math.degrees(math.atan2(self.value[1], self.value[0])) % 360
        return (
            f"sailed in the current of the trial, {speed:.2g} ± {error:.2g} m/s (± one "
            f"standard error) towards {towards:.0f} deg, by which its turning circle drifts."
        )


def _set_of(circle: TurningCircle) -> tuple[float, float]:
    if circle.set_north is None or circle.set_east is None:
        return math.nan, math.nan
    return circle.set_north.value, circle.set_east.value


def circles(
    logs: Sequence[TrialLog], helm: Helm, asked: Conditions
) -> list[tuple[Task, TurningCircle, TrialLog]]:
    """Return the turning circles of a trial that are long enough to tell their set."""
    return [
        (_task(m, log, helm, asked), m, log)
        for log in logs
        for m in find_manoeuvres(log, scale=asked.scale)
        if isinstance(m, TurningCircle) and m.set_north is not None
    ]


def with_rates(
    helm: Helm, late: Actuation, found: Sequence[tuple[Task, Manoeuvre, TrialLog]]
) -> tuple[Helm, list[str]]:
    """Return a helm whose steering moves as fast as in the trial, and as the vessel file allows.

    The rate is that from a tenth to nine tenths of the way between two orders. A way of one
    sample tells no rate: the helm moves at once.
    """
    limits, told = list(helm.limits), []
    for i, name in enumerate(helm.columns):
        if helm.steer[i] == 0:
            continue
        rates = [r for _, m, log in found if name in log for r in _rates(log, name, m)]
        if not rates:
            continue
        rate = float(np.median(rates))
        own = limits[i].rate, late.rate_limit if name == late.rate_on else None
        stated = min((r for r in own if r is not None), default=None)
        if stated is not None and rate >= stated:
            continue
        limits[i] = replace(limits[i], rate=rate)
        unit, factor = (" deg", 180 / math.pi) if helm.angular else ("", 1.0)
        how = f"at {rate * factor:.3g}{unit} per second here" if rate < math.inf else "at once"
        known = "no rate" if stated is None else f"a rate of {stated * factor:.3g}{unit} per second"
        told.append(f"the vessel file states {known} of {name}; it moves {how}, as in the trial.")
    return replace(helm, limits=tuple(limits)), told


def _rates(log: TrialLog, name: str, found: Manoeuvre) -> list[float]:
    """Return how fast a command moved to each order, infinite where within a sample [1/s]."""
    run = found.length / max(found.approach_speed.value, 1e-9)
    legs = _legs(found)
    levels = [_level(log, name, (found.start - run, found.start))]
    levels += [_level(log, name, leg) for leg in legs]
    made = []
    for (begin, end), (old, new) in zip(legs, pairwise(levels), strict=True):
        step = new - old
        if abs(step) < _STEP * max(map(abs, levels)):
            continue
        k = np.flatnonzero((log.t >= begin - 2 * log.sample_time) & (log.t <= end))
        share = (log[name][k] - old) / step
        there = int(np.argmax(share >= _ARRIVED))
        if share[there] < _ARRIVED or there == 0:
            continue
        left = np.flatnonzero(share[:there] <= 1 - _ARRIVED)
        if not len(left):
            continue
        a, b = int(left[-1]), there
        # crossings between samples
        gone = log.t[k[a]] + log.sample_time * (1 - _ARRIVED - share[a]) / (share[a + 1] - share[a])
        come = log.t[k[b]] - log.sample_time * (share[b] - _ARRIVED) / (share[b] - share[b - 1])
        quick = b - a <= 1
        made.append(math.inf if quick else (2 * _ARRIVED - 1) * abs(step) / (come - gone))
    return made


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
        return f"'{log.name}' holds no part of this manoeuvre that could be compared."
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
