"""A plan as legs: settings that are held until the ship has done something, at most for a time.

A sequence by the clock asks of a ship that differs from the prior what it asks of the prior: each
difference adds up over the trial. A leg that ends when the heading has changed by what the plan is
about gives it back at its end. Which end serves a leg best is found by sailing it, in closed loop,
under models drawn from the prior's uncertainty, moved by the forces that its misfit leaves open.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from experiment_design.excitation.rollout import Motion, Rollout
from experiment_design.excitation.schedule import Schedule
from experiment_design.output.result import Design
from experiment_design.request.request import PreparedRequest

Array = NDArray[np.float64]
Samples = NDArray[np.intp]
End = Literal["time", "heading", "speed", "yaw_rate"]
Since = Literal["leg", "trial"]

# models that ends are chosen under, and that the limits are judged under
_CHOICE, _JUDGED = 40, 200
# relative standard error of each coefficient where the prior states none: an estimate of one
# trial predicts other trials about as well as this
_MISFIT = 0.15
# changes of heading that a helmsman would not wait for; samples of the shortest leg that waits
_LEAST_TURN, _LEAST_SAMPLES = np.deg2rad(10.0), 3
# and above which a compass shows the same heading twice on the way, or nearly
_MOST_TURN = np.deg2rad(270.0)
# what the scatter must fall by before a leg ends by anything but the clock
_GAIN = 0.1
# how much the end of the trial, sailed on by the clock, counts beside the end of the leg
_LATER = 0.25
# share of a leg by which its end under the prior may differ from the plan, and by which the noise
# of the sensor may move it
_SHIFT, _NOISY = 0.15, 0.1
# latest end over the expected one: least and most; share of the models that have ended by then
_LATEST = (1.2, 2.0)
_ENDED = 0.95
# scatter that no sensor or helmsman would see: heading [rad]; place [ship lengths]
_HEADING_SEEN, _PLACE_SEEN = np.deg2rad(1.0), 0.2


@dataclass(frozen=True)
class Leg:
    """Commands that are held until the ship has done something.

    Parameters
    ----------
    commands : mapping of str to float
        Each column: speeds in the log's unit, angles [rad].
    until : {"time", "heading", "speed", "yaw_rate"}
        What ends it.
    value : float
        Time since its start [s], change of heading [rad], speed over ground [m/s] or yaw
        rate [rad/s].
    at_most : float
        When it ends at the latest, since its start [s].
    expected : float
        When it ends under the prior model [s].
    at_least : float
        Before which only the clock may end it [s].
    rising : bool
        Whether what ends it is reached from below; else from above.
    since : {"leg", "trial"}
        Whose start a change of heading counts from.
    """

    commands: Mapping[str, float]
    until: End
    value: float
    at_most: float
    expected: float
    at_least: float = 0.0
    rising: bool = True
    since: Since = "leg"

    def until_dict(self) -> dict[str, Any]:
        """Return what ends it, for JSON."""
        if self.until == "time":
            return {"kind": "time", "after": self.value}
        crossing = {"crossing": "up" if self.rising else "down"}
        if self.until == "heading":
            return {"kind": "heading", "change": self.value, "since": self.since, **crossing}
        return {"kind": self.until, "value": self.value, **crossing}


@dataclass(frozen=True)
class SailedLegs:
    """Legs sailed by R models.

    Parameters
    ----------
    motion : Motion
        (R, N+1, ·); each model's states after the end of its last leg mean nothing.
    ends : ndarray of int
        (R, L) sample at which each leg ended.
    """

    motion: Motion
    ends: Samples

    def at_ends(self) -> Array:
        """Return the states (R, L, nx+3) at the end of each leg."""
        return np.asarray(np.take_along_axis(self.motion.state, self.ends[..., None], axis=1))


@dataclass(frozen=True)
class LegPlan:
    """A plan as legs, and how they stand to the sequence by the clock.

    Parameters
    ----------
    trials : tuple of tuple of Leg
    keeps_limits, by_clock : float
        Probability of keeping the path limits, as legs and by the clock.
    off, off_by_clock : dict of str to float
        Root mean squared distance from the plan at the ends of legs [m/s, rad/s, rad], as
        legs and by the clock; ``place`` [m] where there is a sea room.
    draws : int
        Models that these were sailed under.
    assumed : bool
        Whether their scatter was assumed, the prior stating none.
    misled : bool
        Whether forces that the prior's misfit leaves open moved them too.
    """

    trials: tuple[tuple[Leg, ...], ...]
    keeps_limits: float
    by_clock: float
    off: dict[str, float]
    off_by_clock: dict[str, float]
    draws: int
    assumed: bool
    misled: bool = False

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for the JSON of a design."""
        return {
            "keeps_limits": self.keeps_limits,
            "by_clock": self.by_clock,
            "off_plan": self.off,
            "off_plan_by_clock": self.off_by_clock,
            "draws": self.draws,
            "scatter_assumed": self.assumed,
        }

    def sentence(self) -> str:
        """Return one sentence for the summary."""
        count = Counter(leg.until.replace("_", " ") for legs in self.trials for leg in legs)
        kinds = ", ".join(f"{n} by {kind}" for kind, n in count.most_common())
        models = f"{self.draws} models " + (
            f"with coefficients {100 * _MISFIT:.0f} % off"
            if self.assumed
            else "drawn from the prior"
        )
        if self.misled:
            models += " and the prior's misfit" if self.assumed else " and its misfit"
        said = (
            f"as legs, of which {kinds} end, the limits are kept with probability "
            f"{self.keeps_limits:.2f}, by the clock {self.by_clock:.2f}, under {models}"
        )
        if "psi" in self.off:
            mine, other = (np.rad2deg(o["psi"]) for o in (self.off, self.off_by_clock))
            said += (
                f"; at the ends of legs the heading is off the plan by {mine:.0f}° (rms), by the "
                f"clock {other:.0f}°"
            )
        return said


def drawn_models(request: PreparedRequest, count: int, seed: int) -> Array:
    """Draw models (count, p) that a plan may meet, the prior itself first.

    From the prior's covariance; where it has none, each coefficient of an equation of motion is
    off by a normal share of itself, 15 % standard deviation, independently of the others.
    """
    theta = np.asarray(request.theta, float)
    if request.uncertain:
        drawn = request.draw_models(count - 1, seed)
    elif request.structure.increment:
        rng = np.random.default_rng([37, request.seed, seed])
        drawn = theta * (1 + _MISFIT * rng.standard_normal((count - 1, theta.size)))
    else:
        drawn = np.repeat(theta[None], count - 1, axis=0)
    return np.vstack([theta, drawn])


class _Way:
    """R models on their way through legs: what was commanded, and where each leg began."""

    def __init__(
        self,
        rollout: Rollout,
        thetas: Array,
        schedule: Schedule,
        samples: int,
        off: Array | None = None,
    ) -> None:
        self.rollout, self.thetas, self.schedule, self.off = rollout, thetas, schedule, off
        runs = len(thetas)
        self.commands = np.zeros((runs, samples, len(schedule.commands)))
        # the sample of the plan that each sample stands for
        self.place: Samples = np.zeros((runs, samples + 1), np.intp)
        self.start: Samples = np.zeros(runs, np.intp)
        self.before: Array | None = None

    @property
    def earliest(self) -> int:
        """Samples before which only the clock ends a leg.

        Where a command cannot cross its range in one hold, it has to arrive before it may be sent
        on: the step from where it is could be larger than its rate allows.
        """
        slow = self.schedule.ramp if self.schedule.limited else ()
        return max((_LEAST_SAMPLES, *slow))

    def hold(self, level: Array, samples: int, planned: tuple[int, int] = (0, 0)) -> Motion:
        """Run to `samples` after the last start with `level` held from each start on.

        The plan holds it from one of its samples to another, `planned`.
        """
        last = min(int(self.start.max()) + samples, self.commands.shape[1])
        k = np.arange(last) - self.start[:, None]
        before = level if self.before is None else self.before
        share = np.clip((k[..., None] + 1) / np.array(self.schedule.ramp), 0.0, 1.0)
        held = before + share * (level - before)
        self.commands[:, :last] = np.where(k[..., None] >= 0, held, self.commands[:, :last])
        since = np.arange(last + 1) - self.start[:, None]
        there = np.minimum(planned[0] + since, planned[1])
        self.place[:, : last + 1] = np.where(since >= 0, there, self.place[:, : last + 1])
        return self.run(self.commands[:, :last], self.place[:, : last + 1])

    def run(self, commands: Array, place: Samples) -> Motion:
        """Run on commands (R, N, nc), lag and delay included, at samples (R, N+1) of the plan."""
        motion = self.rollout.run_models(self.thetas, commands, late=True)
        if self.off is None:
            return motion
        return self.rollout.moved(motion, np.take_along_axis(self.off, place[..., None], axis=1))

    def turn_over(self, ends: Samples) -> None:
        """Begin the next leg where each model has ended this one."""
        self.before = self.commands[np.arange(len(ends)), ends - 1][:, None]
        self.start = ends


def _signal(leg: Leg, states: tuple[str, ...], state: Array, start: Samples) -> Array:
    """Return what ends a leg (R, N+1)."""
    if leg.until == "heading":
        psi = state[..., len(states)]
        base = psi[:, :1]
        if leg.since == "leg":
            base = np.take_along_axis(psi, start[:, None], axis=1)
        return np.asarray(psi - base)
    if leg.until == "speed":
        v = state[..., states.index("v")] if "v" in states else 0.0
        return np.asarray(np.hypot(state[..., states.index("u")], v))
    return np.asarray(state[..., states.index("r")])


def _ends(leg: Leg, states: tuple[str, ...], motion: Motion, start: Samples, dt: float) -> Samples:
    """Return the sample (R,) at which a leg that began at samples `start` ends."""
    latest = start + round(leg.at_most / dt)
    if leg.until == "time":
        return np.asarray(start + round(leg.value / dt), np.intp)
    sign = 1.0 if leg.rising else -1.0
    value = sign * _signal(leg, states, motion.state, start)
    k = np.arange(value.shape[1])
    after = k >= (start + round(leg.at_least / dt))[:, None]
    done = after & ((value >= sign * leg.value) | (k >= latest[:, None]))
    return np.asarray(np.minimum(done.argmax(axis=1), latest), np.intp)


def sail_legs(
    rollout: Rollout,
    thetas: Array,
    legs: Sequence[Leg],
    schedule: Schedule,
    off: Array | None = None,
    planned: Sequence[int] = (),
) -> SailedLegs:
    """Sail legs in closed loop under several models at once.

    Commands move to the setting of each leg as the schedule's rates allow; the vessel's lag and
    delay act behind them.

    Parameters
    ----------
    rollout : Rollout
        Where and how the trial starts.
    thetas : ndarray
        (R, p)
    legs : sequence of Leg
    schedule : Schedule
        Of the plan.
    off : ndarray, optional
        (R, N+1, nx) by how much a misfit moves the states of each model along the plan.
    planned : sequence of int
        The samples at which the plan ends each leg; needed with `off`.

    Returns
    -------
    SailedLegs
    """
    dt, states = rollout.sample_time, rollout.structure.states
    samples = sum(round(leg.at_most / dt) for leg in legs) + 1
    way = _Way(rollout, thetas, schedule, samples, off)
    ends = np.zeros((len(thetas), len(legs)), np.intp)
    until = [0, *(planned if off is not None else [0] * len(legs))]
    for i, leg in enumerate(legs):
        level = np.array([leg.commands[n] for n in schedule.commands])
        motion = way.hold(level, round(leg.at_most / dt), (until[i], until[i + 1]))
        ends[:, i] = _ends(leg, states, motion, way.start, dt)
        way.turn_over(ends[:, i])
    return SailedLegs(motion, ends)


def legs_of(design: Design) -> LegPlan:
    """Return a plan as legs, each ended by what keeps its purpose best.

    Holds with equal commands are one leg. For each leg in turn its possible ends are sailed under
    models drawn from the prior (see `drawn_models`) and its misfit, the legs before it as they
    were chosen and the rest of the trial by the clock. Taken is the end after which the states
    scatter least about the plan, relative to an end by the clock; the clock where nothing gains
    10 %.

    Parameters
    ----------
    design : Design

    Returns
    -------
    LegPlan

    Notes
    -----
    The scatter is the mean, over heading, surge, sway, yaw rate and (with a sea room) place, of
    each root mean square over that of the clock, at the end of the leg and, with a quarter of
    the weight, of the trial. What its sensor would not see is added to both.
    """
    design = design.from_first_command()
    r = design.request
    schedule, since = r.schedule, round(design.lead_in_s / r.sample_time)
    trials, off, off_clock, kept, kept_clock = [], [], [], [], []
    judged = drawn_models(r, _JUDGED, 4)
    for trial, commands in enumerate(design.commands):
        rollout = r.rollout(r.starts[trial])
        chosen_off = judged_off = None
        if r.misfit is not None:
            drawn = r.misfit(rollout.run(commands[None]), _CHOICE + _JUDGED)
            chosen_off, judged_off = drawn[:_CHOICE], drawn[_CHOICE:]
        legs = _chosen(design, trial, rollout, chosen_off)
        trials.append(legs)
        planned = planned_ends(design.levels[trial], schedule)[1]
        sailed = sail_legs(rollout, judged, legs, schedule, judged_off, planned.tolist())
        clock = rollout.run_models(judged, commands, late=True)
        if judged_off is not None:
            clock = rollout.moved(clock, judged_off)
        plan = design.motions[trial].state[0, planned]
        off.append(_scatter(r, sailed.at_ends()[sailed.motion.stable] - plan))
        off_clock.append(_scatter(r, clock.state[clock.stable][:, planned] - plan))
        last = sailed.ends[:, -1:, None]
        index = np.minimum(np.arange(sailed.motion.state.shape[1])[None, :, None], last)
        until_end = np.take_along_axis(sailed.motion.state, index, axis=1)
        led = sailed.ends[:, int(np.searchsorted(planned, since))] if since else 0
        kept.append(_keeps(r, rollout, trial, until_end, led) & sailed.motion.stable)
        kept_clock.append(_keeps(r, rollout, trial, clock.state, since) & clock.stable)
    names = _names(r)
    return LegPlan(
        tuple(trials),
        float(np.all(kept, axis=0).mean()),
        float(np.all(kept_clock, axis=0).mean()),
        dict(zip(names, np.sqrt(np.mean(np.square(off), axis=0)).tolist(), strict=True)),
        dict(zip(names, np.sqrt(np.mean(np.square(off_clock), axis=0)).tolist(), strict=True)),
        _JUDGED,
        not r.uncertain,
        r.misfit is not None,
    )


def planned_ends(levels: Array, schedule: Schedule) -> tuple[Samples, Samples]:
    """Return the first hold of each leg, and the sample at which it ends by the clock."""
    changed = np.any(np.abs(np.diff(levels, axis=0)) > 1e-9, axis=1)
    first = np.concatenate([[0], np.flatnonzero(changed) + 1])
    ends = np.append(first[1:] * schedule.hold, schedule.samples)
    return first, np.asarray(ends, np.intp)


def _chosen(design: Design, trial: int, rollout: Rollout, off: Array | None) -> tuple[Leg, ...]:
    """Return the legs of one trial, chosen first to last.

    A misfit moves the models along the plan by `off`, the first of them, the prior itself, not.
    """
    r = design.request
    schedule, states, dt = r.schedule, r.structure.states, r.sample_time
    levels, plan = design.levels[trial], design.motions[trial].state[0]
    holds, planned = planned_ends(levels, schedule)
    thetas = drawn_models(r, _CHOICE, 3)
    stable = rollout.run_models(thetas, design.commands[trial], late=True).stable
    if off is not None:
        off = np.concatenate([0 * off[:1], off[1:]])[stable]
    way = _Way(rollout, thetas[stable], schedule, 2 * schedule.samples + 2 * len(holds), off)
    begins = np.concatenate([[0], planned[:-1]])
    legs = []
    for hold, begin, end in zip(holds, begins, planned, strict=True):
        level = levels[hold]
        commands = dict(zip(schedule.commands, map(float, level), strict=True))
        seconds = float((end - begin) * dt)
        by_clock = Leg(commands, "time", seconds, seconds, seconds)
        most = int(np.floor(_LATEST[1] * (end - begin)))
        motion = way.hold(level, most, (begin, end))
        options: list[tuple[Leg, Samples]] = []
        for leg in _ends_to_try(r, by_clock, plan, begin, end, way.earliest * dt, most * dt):
            ends = _ends(leg, states, motion, way.start, dt)
            own = float(ends[0] - way.start[0]) * dt
            if abs(own - seconds) > max(_SHIFT * seconds, dt):
                continue
            late = float(np.quantile(ends - way.start, _ENDED)) * dt
            at_most = _whole(max(late, _LATEST[0] * seconds), dt)
            leg = replace(leg, at_most=float(min(at_most, most * dt)), expected=own)
            options.append((leg, _ends(leg, states, motion, way.start, dt)))
        clocked = (by_clock, _ends(by_clock, states, motion, way.start, dt))
        best = clocked
        if options:
            reference = _off(design, trial, way, motion, clocked[1], end)
            least = 1.0 - _GAIN
            weight = np.array([[1.0], [_LATER if end < schedule.samples else 0.0]])
            for option in options:
                ratio = _off(design, trial, way, motion, option[1], end) / reference
                value = float((weight * ratio).sum() / weight.sum() / ratio.shape[1])
                if value < least:
                    best, least = option, value
        legs.append(best[0])
        way.turn_over(best[1])
    return tuple(legs)


def _whole(seconds: float, dt: float) -> float:
    """Return a time [s] rounded up to samples, and to whole seconds where these are samples."""
    per_second = round(1 / dt)
    step = 1.0 if per_second and abs(per_second * dt - 1) < 1e-9 else dt
    return float(np.ceil(seconds / step - 1e-9) * step)


def _ends_to_try(
    r: PreparedRequest, by_clock: Leg, plan: Array, begin: int, end: int, least: float, most: float
) -> list[Leg]:
    """Return the ways in which a leg of the plan, from one sample to another, might end."""
    states, nx = r.structure.states, len(r.structure.states)
    seconds = by_clock.expected
    if end - begin < _LEAST_SAMPLES or seconds <= least or "u" not in states:
        return []
    at = np.array([begin, end])
    leg = replace(by_clock, at_least=least, at_most=most)
    noise = dict(zip(states, np.asarray(r.noise.measurement, float), strict=True))
    found = []
    if "r" in states:
        psi = plan[:, nx]
        turned = float(psi[end] - psi[begin])
        if abs(turned) >= _LEAST_TURN:
            changes: list[tuple[Since, float]] = [("leg", turned)]
            if abs(turned) <= _MOST_TURN:
                changes.insert(0, ("trial", float(psi[end] - psi[0])))
            for since, change in changes:
                value = float(np.deg2rad(round(float(np.rad2deg(change)))))
                found.append(
                    replace(leg, until="heading", value=value, rising=turned > 0, since=since)
                )
    signals: tuple[tuple[End, str], ...] = (("speed", "u"), ("yaw_rate", "r"))
    for until, name in signals:
        if name not in states:
            continue
        wanted = replace(leg, until=until)
        path = _signal(wanted, states, plan[None], at[:1])[0]
        change, slope = float(path[end] - path[begin]), float(path[end] - path[end - 1])
        # where it hardly changes any more, the noise of its sensor says when it is reached
        if slope * change <= 0 or abs(slope) * _NOISY * (end - begin) < noise[name]:
            continue
        unit = np.deg2rad(1.0) if until == "yaw_rate" else 1.0
        step = unit * 10.0 ** np.floor(np.log10(max(abs(change) / unit, 1e-6)) - 1)
        value = float(step * np.round(path[end] / step))
        found.append(replace(wanted, value=value, rising=change > 0))
    return found


def _off(design: Design, trial: int, way: _Way, motion: Motion, ends: Samples, end: int) -> Array:
    """Return the scatter (2, m) about the plan, at the end of a leg and of the trial."""
    r = design.request
    plan, commands = design.motions[trial].state[0], design.commands[trial]
    runs = np.arange(len(ends))
    here = _scatter(r, (motion.state[runs, ends] - plan[end])[:, None])
    seen = _seen(r)
    rest = len(commands) - end
    if not rest:
        return np.stack([here + seen, here + seen])
    last = ends + rest
    k = np.arange(int(last.max()))
    place = np.clip(end + k - ends[:, None], 0, len(commands) - 1)
    so_far = np.zeros((len(ends), len(k), commands.shape[1]))
    width = min(way.commands.shape[1], len(k))
    so_far[:, :width] = way.commands[:, :width]
    after = (k >= ends[:, None])[..., None]
    n = np.arange(len(k) + 1)
    planned = np.clip(end + n - ends[:, None], 0, len(commands))
    width = min(way.place.shape[1], len(n))
    planned[:, :width] = np.where(
        n[:width] >= ends[:, None], planned[:, :width], way.place[:, :width]
    )
    sailed = way.run(np.where(after, commands[place], so_far), planned)
    away = (sailed.state[runs, last] - plan[-1])[sailed.stable]
    return np.stack([here + seen, _scatter(r, away[:, None]) + seen])


def _names(r: PreparedRequest) -> tuple[str, ...]:
    states = tuple(n for n in r.structure.states if n in ("u", "v", "r"))
    heading = ("psi",) if "r" in states else ()
    return (*states, *heading, *(("place",) if r.limits.area is not None else ()))


def _scatter(r: PreparedRequest, away: Array) -> Array:
    """Return the root mean square (m,) of distances (R, L, nx+3) from the plan, by `_names`."""
    states = r.structure.states
    columns = {n: away[..., i] for i, n in enumerate((*states, "psi"))}
    columns["place"] = np.linalg.norm(away[..., -2:], axis=-1)
    return np.array([float(np.sqrt(np.mean(columns[n] ** 2))) for n in _names(r)])


def _seen(r: PreparedRequest) -> Array:
    """Return the scatter (m,) that its sensor or a helmsman would not see."""
    noise = dict(zip(r.structure.states, np.asarray(r.noise.measurement, float), strict=True))
    noise |= {"psi": _HEADING_SEEN, "place": _PLACE_SEEN * r.vessel.length}
    return np.array([noise[n] for n in _names(r)])


def _keeps(
    r: PreparedRequest, rollout: Rollout, trial: int, state: Array, since: int | Samples
) -> NDArray[np.bool_]:
    """Return which runs (R, N+1, nx+3) keep the path limits, margins from a sample on."""
    program = replace(r, backoff=()).limit_program(rollout, trial)
    return np.asarray((program.worst(state, since) <= 1e-3).all(axis=0))
