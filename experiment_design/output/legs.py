"""A plan as legs that end by time, change of heading, speed or yaw rate.

A plan by the clock takes the ship where its model says. Where the ship turns or slows down
otherwise, headings drift away from the plan with every hold. A crew, or an autopilot, that
ends a leg by what the ship does brings her back to the plan at its end.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from experiment_design.excitation.rollout import Rollout
from experiment_design.output.result import Design
from experiment_design.output.words import SIDES
from experiment_design.request.request import DesignRequest
from greybox.errors import LogError
from greybox.files import replacing, write_json
from greybox.model.run.simulation import simulate
from greybox.model.structure import Structure
from greybox.vessel.actuation import actuated_force

Array = NDArray[np.float64]
Kind = Literal["time", "heading", "speed", "yaw_rate"]

FORMAT, VERSION = "greybox-legs", 1
# models drawn to choose the triggers by, and the stream of their chance
DRAWS, _STREAM = 40, 23
# by which share, up or down, the damping of a drawn model is off beside the prior's covariance:
# what the structure lacks is in no covariance
MISFIT = 0.15
# holds with commands nearer than this share of their range are one leg
_ALIKE = 0.01
# latest end over the expected one; least change of heading [rad] and samples of a leg that
# ends otherwise than by time; by how much another trigger must be better than time
_LATEST, _LEAST_TURN, _LEAST_SAMPLES, _BETTER = 1.5, np.deg2rad(10.0), 3, 0.9
# share of the drawn models that may end a leg before this share of its expected time
_FEW, _SHORTEST = 0.05, 1 / 3
# share of its spread below which a state is as good as on the plan
_FINE = 0.1
# what a crew reads and sets: heading and yaw rate in deg and deg/s, speed in m/s
# deviations of its sensor by which a speed or yaw rate must change to be seen to
_SEEN = 5.0
_ROUND: dict[Kind, float] = {"heading": np.deg2rad(1), "speed": 0.01, "yaw_rate": np.deg2rad(0.01)}
# triggers that a trial may be restricted to, beside time; the last one is time alone
_CHOICES: tuple[Kind | None, ...] = (None, "heading", "yaw_rate", "time")
_STATE: dict[Kind, str] = {"heading": "psi", "speed": "u", "yaw_rate": "r"}
_FIELD: dict[Kind, str] = {
    "time": "after", "heading": "change", "speed": "value", "yaw_rate": "value",
}  # fmt: skip
# magnitude past which a state counts as run away [m/s, rad/s]
_BOUND = 100.0
# lags after which a command of before is forgotten
_FORGOTTEN = 10.0


@dataclass(frozen=True)
class Leg:
    """Commands that are held until something happens.

    Parameters
    ----------
    commands : dict of str to float
        Column -> value, in the log's unit, angles [rad].
    kind : {"time", "heading", "speed", "yaw_rate"}
        What ends the leg.
    value : float
        Time since the leg's start [s]; signed change of heading since then, positive to
        starboard [rad]; surge speed [m/s]; yaw rate [rad/s].
    at_most : float
        Time after which the leg ends whatever happens [s].
    expected : float
        Time that it takes by the plan [s].
    rising : bool
        Whether speed or yaw rate rise to the value, or fall to it.
    """

    commands: Mapping[str, float]
    kind: Kind
    value: float
    at_most: float
    expected: float
    rising: bool = True

    @property
    def words(self) -> str:
        """When the leg ends, as it is said to a crew."""
        if self.kind == "time":
            return f"for {_seconds(self.value)}"
        return f"until the {self._event()}, at the latest after {_seconds(self.at_most)}"

    @property
    def short(self) -> str:
        """The same for a narrow cell of a table."""
        if self.kind == "time":
            return f"for {_seconds(self.value)}"
        event = self._event().replace("yaw rate", "turn").replace(" has changed", "")
        event = event.replace(" has risen", "").replace(" has fallen", "")
        return f"until {event}, at most {_seconds(self.at_most)}"

    def _event(self) -> str:
        moved = "risen" if self.rising else "fallen"
        if self.kind == "heading":
            side = SIDES["r", 1 if self.value >= 0 else -1]
            return f"heading has changed {abs(np.rad2deg(self.value)):.0f}° {side}"
        if self.kind == "speed":
            ahead = f" {SIDES['u', -1]}" if self.value < 0 else ""
            if self.value < 0:
                moved = "fallen" if self.rising else "risen"
            return f"speed has {moved} to {abs(self.value):.2f} m/s{ahead}"
        rate = abs(np.rad2deg(self.value))
        if round(rate, 2) == 0:
            return "yaw rate is zero"
        side = SIDES["r", 1 if self.value > 0 else -1]
        if self.value < 0:
            moved = "fallen" if self.rising else "risen"
        return f"yaw rate has {moved} to {rate:.2f}°/s {side}"

    def first(self, path: Array, sample_time: float) -> NDArray[np.intp]:
        """Return after how many samples each run (R, ≥M+1, n) of signals ends the leg.

        Parameters
        ----------
        path : ndarray
            (R, M+1) the state that `kind` looks at, from the leg's start.
        sample_time : float
            [s]
        """
        most = min(max(1, round(self.at_most / sample_time)), path.shape[1] - 1)
        if self.kind == "time":
            return np.full(len(path), most, np.intp)
        seen = path[:, 1 : most + 1]
        if self.kind == "heading":
            there = np.sign(self.value) * (seen - path[:, :1]) >= abs(self.value) - 1e-9
        else:
            there = seen >= self.value if self.rising else seen <= self.value
        return np.asarray(np.where(there.any(axis=1), there.argmax(axis=1) + 1, most), np.intp)

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        until: dict[str, Any] = {"kind": self.kind, _FIELD[self.kind]: self.value}
        if self.kind in ("speed", "yaw_rate"):
            until["when"] = "rising" if self.rising else "falling"
        return {
            "commands": dict(self.commands),
            "until": until,
            "at_most": self.at_most,
            "expected": self.expected,
            "words": self.words,
        }


@dataclass(frozen=True)
class LegPlan:
    """The legs of a design, and how far headings are off the plan at their ends.

    Parameters
    ----------
    trials : tuple of tuple of Leg
    scatter, by_clock : float
        Root mean square of the heading about the plan at the legs' ends, over drawn models:
        of the legs, and of the same commands by the clock [rad].
    """

    trials: tuple[tuple[Leg, ...], ...]
    scatter: float
    by_clock: float

    def to_dict(self, file: str) -> dict[str, Any]:
        """Return what the design's JSON says of the legs."""
        return {"file": file, "scatter": {"legs": self.scatter, "clock": self.by_clock}}

    def sentence(self) -> str:
        """Return in one sentence what the legs are and what they gain."""
        legs = [leg for trial in self.trials for leg in trial]
        events = sum(leg.kind != "time" for leg in legs)
        return (
            f"as legs: {len(legs)}, of which {events} end by heading, speed or yaw rate; at their "
            f"ends the heading is expected to be off the plan by {_degrees(self.scatter)} (rms), "
            f"by the clock {_degrees(self.by_clock)}"
        )


@dataclass(frozen=True)
class Sailed:
    """Legs that many models sailed, each ended by its own motion.

    Parameters
    ----------
    ends : ndarray
        (R, L, nx+1) states and heading at the end of each leg [m/s, rad/s, rad].
    seconds : ndarray
        (R, L) how long each took [s].
    stable : ndarray of bool
        (R,) whether the run stayed within every plausible bound.
    """

    ends: Array
    seconds: Array
    stable: NDArray[np.bool_]


@dataclass
class _Fleet:
    """Models under way: where each stands, and what it was commanded before.

    Within a leg the commands depend on nothing but time, so a leg is a free run of all models;
    each is then left where the leg ended for it.
    """

    rollout: Rollout
    thetas: Array
    ramp: Array
    x: Array
    psi: Array
    before: Array
    alive: NDArray[np.bool_] = field(init=False)

    def __post_init__(self) -> None:
        self.alive = np.ones(len(self.thetas), bool)

    @classmethod
    def of(cls, rollout: Rollout, thetas: Array, commands: Array, ramp: Sequence[int]) -> _Fleet:
        """Return all models at the start, with the commands (nc,) of the first leg."""
        count, late = len(thetas), rollout.vessel.actuation
        past = 1 + int(np.ceil((late.delay + _FORGOTTEN * late.lag) / rollout.sample_time))
        if late.rate_on is not None and late.rate_limit:
            reach = rollout.vessel.limits[late.rate_on]
            if reach.lower is not None and reach.upper is not None:
                pace = late.rate_limit * rollout.sample_time
                past += int(np.ceil((reach.upper - reach.lower) / pace))
        return cls(
            rollout,
            thetas,
            np.asarray(ramp, float),
            np.repeat(rollout.start[None, :-1], count, axis=0),
            np.full(count, rollout.start[-1]),
            np.broadcast_to(commands, (count, past, len(commands))).copy(),
        )

    def ahead(self, commands: Array, samples: int) -> tuple[Array, Array]:
        """Return signals (R, M+1, nx+1) under held commands (nc,), and these (R, M, nc)."""
        r, structure = self.rollout, self.rollout.structure
        share = np.minimum(1.0, (np.arange(samples)[:, None] + 1) / self.ramp)
        last = self.before[:, -1:, :]
        given = last + share * (commands - last)
        whole = np.concatenate([self.before, given], axis=1)
        columns = {n: whole[..., i] for i, n in enumerate(r.vessel.commands)}
        made = actuated_force(r.vessel, columns, r.sample_time)
        none = np.zeros(whole.shape[:2])
        tau = np.stack([made.get(n, none) for n in structure.inputs], axis=-1)[:, -samples:]
        turns = "r" in structure.states
        free = simulate(
            structure, self.thetas, self.x, tau, r.sample_time,
            psi=None if turns else np.repeat(self.psi[:, None], samples + 1, axis=1),
            psi0=self.psi,
            d=np.broadcast_to(r.d, (samples, r.d.size)) if r.d.any() else None,
            integrator=r.integrator,
            bound=np.full(r.nx, _BOUND),
        )  # fmt: skip
        psi = np.asarray(free.psi)[..., None]
        path = np.concatenate([free.x, np.broadcast_to(psi, (*free.x.shape[:2], 1))], axis=-1)
        lost = (free.diverged >= 0) | ~np.isfinite(path).all(axis=(1, 2))
        self.alive &= ~lost
        path[~self.alive] = 0.0
        return path, given

    def leave(self, path: Array, given: Array, at: NDArray[np.intp]) -> Array:
        """Leave each model after `at` (R,) samples of what `ahead` gave, and return its signals."""
        rows = np.arange(len(path))
        end = np.asarray(path[rows, at])
        self.x, self.psi = end[:, :-1].copy(), end[:, -1].copy()
        whole = np.concatenate([self.before, given], axis=1)
        past = self.before.shape[1]
        self.before = whole[rows[:, None], at[:, None] + np.arange(past)]
        return end


def sail_legs(
    rollout: Rollout, thetas: Array, legs: Sequence[Leg], ramp: Sequence[int] | None = None
) -> Sailed:
    """Sail legs in closed loop: each model goes on to the next leg when its own motion says so.

    Parameters
    ----------
    rollout : Rollout
        The vessel and where she starts; its own parameters are not used.
    thetas : ndarray
        (R, p) models.
    legs : sequence of Leg
    ramp : sequence of int, optional
        Samples over which each command moves to a new value; by default at once.

    Returns
    -------
    Sailed
    """
    names = rollout.vessel.commands
    table = [np.array([leg.commands[n] for n in names]) for leg in legs]
    fleet = _Fleet.of(rollout, thetas, table[0], ramp or [1] * len(names))
    signals = (*rollout.structure.states, "psi")
    ends, seconds = [], []
    for leg, commands in zip(legs, table, strict=True):
        path, given = fleet.ahead(commands, max(1, round(leg.at_most / rollout.sample_time)))
        at = leg.first(path[..., _watched(leg.kind, signals)], rollout.sample_time)
        ends.append(fleet.leave(path, given, at))
        seconds.append(at * rollout.sample_time)
    return Sailed(np.stack(ends, axis=1), np.stack(seconds, axis=1), fleet.alive)


def drawn_models(request: DesignRequest, count: int = DRAWS) -> Array:
    """Draw models (count + 1, p) that the ship may turn out to be, the nominal one first.

    From the prior's covariance where there is one; beside it each damping parameter is off by
    `MISFIT`, up or down.

    Parameters
    ----------
    request : DesignRequest
    count : int
    """
    drawn = request.draw_models(count, _STREAM)
    rng = np.random.default_rng([_STREAM, request.seed])
    damps = _damping(request.structure)
    side = rng.choice([-1.0, 1.0], (-(-count // 2), len(damps)))
    side = np.stack([side, -side], axis=1).reshape(-1, len(damps))[:count]
    drawn[:, damps] *= 1 + MISFIT * side
    return np.vstack([np.asarray(request.theta, float), drawn])


def _damping(structure: Structure) -> list[int]:
    # the parameters of a map are no rates, and a share of them is no share of the damping
    if not structure.increment:
        return []
    return [structure.index(t.name) for t in structure.terms if t.dissipates]


def legs_of(design: Design) -> LegPlan:
    """Return a plan as legs, each ended by what keeps the motion nearest to the plan.

    Holds with nearly the same commands are one leg. Leg by leg, models drawn from the prior's
    uncertainty (`drawn_models`) sail on from where the legs before left them; the leg ends by
    time, unless another trigger leaves u, v, r and the heading at its end nearer to the plan by
    a tenth, each state measured in its spread over the plan.

    Parameters
    ----------
    design : Design

    Returns
    -------
    LegPlan
    """
    r = design.request
    models = drawn_models(r)
    trials, off, clock = [], [], []
    for trial in range(r.trials):
        rollout = Rollout(
            r.vessel, r.structure, r.theta, r.d, r.starts[trial], r.sample_time, r.integrator
        )
        motion = rollout.run_models(models, design.commands[trial], late=True)
        # a model that runs away on the plan by the clock tells nothing
        kept = models[motion.stable]
        plan = design.motions[trial].state[0, :, : rollout.nx + 1]
        merged = _merged(design, trial)
        spread = plan.std(axis=0)
        weight = np.divide(1.0, spread, out=np.zeros_like(spread), where=spread > 1e-9)
        ends = np.array([last for _, last, _ in merged])
        found = []
        for only in _CHOICES:
            legs = _triggered(design, rollout, kept, plan, weight, merged, only)
            sailed = sail_legs(rollout, kept, legs, r.schedule.ramp)
            away = (sailed.ends[sailed.stable][1:] - plan[ends]).reshape(-1, plan.shape[1])
            lost = int((~sailed.stable).sum())
            heading = float(_rms(away[:, -1]))
            found.append((lost, heading, _together(_rms(away * weight, axis=0)), legs, away[:, -1]))
        by_time = found[-1]
        legs, away = min((f for f in found if f[:2] <= by_time[:2]), key=lambda f: (f[0], f[2]))[3:]
        off.append(away)
        by = motion.state[motion.stable][1:, ends, rollout.nx]
        clock.append((by - plan[ends, -1]).ravel())
        trials.append(legs)
    return LegPlan(
        tuple(trials), float(_rms(np.concatenate(off))), float(_rms(np.concatenate(clock)))
    )


def _merged(design: Design, trial: int) -> list[tuple[int, int, Array]]:
    """Return first and last sample and the commands (nc,) of each leg."""
    schedule = design.request.schedule
    levels = design.levels[trial]
    near = _ALIKE * (schedule.upper - schedule.lower) + 1e-9
    groups: list[list[int]] = []
    for k, level in enumerate(levels):
        if groups and (np.abs(level - levels[groups[-1][0]]) <= near).all():
            groups[-1].append(k)
        else:
            groups.append([k])
    return [
        (g[0] * schedule.hold, min((g[-1] + 1) * schedule.hold, schedule.samples),
         levels[g].mean(axis=0))
        for g in groups
    ]  # fmt: skip


def _triggered(
    design: Design,
    rollout: Rollout,
    models: Array,
    plan: Array,
    weight: Array,
    merged: list[tuple[int, int, Array]],
    only: Kind | None,
) -> tuple[Leg, ...]:
    """Return the legs with the triggers that keep the models nearest to the plan (N+1, nx+1)."""
    names, dt = rollout.vessel.commands, rollout.sample_time
    signals = (*rollout.structure.states, "psi")
    fleet = _Fleet.of(rollout, models, merged[0][2], design.request.schedule.ramp)
    least = dict(zip(signals, _SEEN * design.request.noise.measurement, strict=False))
    legs = []
    for first, last, commands in merged:
        samples = last - first
        named = {n: float(c) for n, c in zip(names, commands, strict=True)}
        path, given = fleet.ahead(commands, _most(samples))
        best: tuple[float, Leg, NDArray[np.intp]] | None = None
        by_time = np.inf
        for leg in _candidates(named, plan[first : last + 1], signals, dt, least):
            if only is not None and leg.kind not in ("time", only):
                continue
            at = leg.first(path[..., _watched(leg.kind, signals)], dt)
            # under the prior itself it must end when the plan says, and under no model at once
            if abs(int(at[0]) - samples) > max(1, 0.1 * samples):
                continue
            if np.quantile(at, _FEW) < _SHORTEST * samples:
                continue
            end = path[np.arange(len(path)), at][fleet.alive]
            off = _rms((end - plan[last]) * weight, axis=0)
            if leg.kind == "time":
                by_time = off[-1]
            # speeds forget how the legs before ended, the heading does not
            if off[-1] > by_time:
                continue
            cost = _together(off)
            if best is None or cost < (_BETTER if best[1].kind == "time" else 1) * best[0]:
                best = cost, leg, at
        assert best is not None
        legs.append(best[1])
        fleet.leave(path, given, best[2])
    return tuple(legs)


def _candidates(
    commands: dict[str, float],
    plan: Array,
    signals: tuple[str, ...],
    dt: float,
    least: Mapping[str, float],
) -> list[Leg]:
    """Return what could end a leg whose planned signals are (M+1, nx+1), time first."""
    samples = len(plan) - 1
    expected = samples * dt
    found = [Leg(commands, "time", expected, expected, expected)]
    if samples < _LEAST_SAMPLES:
        return found
    for kind, step in _ROUND.items():
        if _STATE[kind] not in signals or (kind == "heading" and "r" not in signals):
            continue
        values = plan[:, signals.index(_STATE[kind])]
        change = float(values[-1] - values[0])
        value = step * round((change if kind == "heading" else float(values[-1])) / step)
        if kind == "heading" and abs(change) < _LEAST_TURN:
            continue
        if kind != "heading" and abs(change) < max(2 * step, least[_STATE[kind]]):
            continue
        at_most = _most(samples) * dt
        found.append(Leg(commands, kind, float(value), at_most, expected, change > 0))
    return found


def _most(samples: int) -> int:
    return int(np.ceil(_LATEST * samples - 1e-9))


def _watched(kind: Kind, signals: tuple[str, ...]) -> int:
    return signals.index(_STATE.get(kind, "psi"))


def _rms(values: Array, axis: int | None = None) -> Any:
    return np.sqrt(np.mean(np.square(values), axis=axis)) if values.size else np.float64(0.0)


def _together(off: Array) -> float:
    """Return one number for what the states (nx+1,) are off the plan, in their spreads.

    The geometric mean: a model that is too fast is too fast whatever ends a leg, which in a sum
    would hide what a trigger does to the other states.
    """
    return float(np.exp(np.log(np.hypot(off, _FINE)).mean()))


def _seconds(value: float) -> str:
    return f"{round(value, 1):g} s"


def _degrees(angle: float) -> str:
    return f"{np.rad2deg(angle):.1f}°"


def csv_twin(path: str | Path) -> Path:
    """Return where the CSV of the same legs is written: beside the JSON, ending in .csv."""
    return Path(path).with_suffix(".csv")


def write_legs(plan: LegPlan, design: Design, path: str | Path) -> None:
    """Write legs as JSON, and the same as a CSV of one row a leg beside it.

    Parameters
    ----------
    plan : LegPlan
    design : Design
        Whose legs they are.
    path : path
        Of the JSON.
    """
    r = design.request
    starts = [
        dict(zip((*r.structure.states, "psi"), (float(v) for v in s), strict=True))
        | dict(zip(("x_n", "y_n"), (float(v) for v in r.limits.position), strict=True))
        for s in r.starts
    ]
    write_json(
        {
            "format": FORMAT,
            "version": VERSION,
            "vessel": r.vessel.name,
            "start": starts[0],
            **({"starts": starts} if len(starts) > 1 else {}),
            "legs": [
                {"trial": k + 1} | leg.to_dict() for k, legs in enumerate(plan.trials)
                for leg in legs
            ],
        },
        path,
    )  # fmt: skip
    names = r.schedule.commands
    with replacing(csv_twin(path)) as handle:
        handle.write(",".join(["trial", *names, "until", "value", "when", "at_most", "expected"]))
        handle.write(",words\n")
        for k, legs in enumerate(plan.trials):
            for leg in legs:
                when = leg.to_dict()["until"].get("when", "")
                cells = [str(k + 1), *(f"{leg.commands[n]:.10g}" for n in names), leg.kind]
                cells += [f"{leg.value:.10g}", when, f"{leg.at_most:.10g}", f"{leg.expected:.10g}"]
                handle.write(",".join([*cells, f'"{leg.words}"']) + "\n")


def read_legs(path: str | Path) -> tuple[tuple[Leg, ...], ...]:
    """Read legs that `write_legs` wrote, a tuple for each trial.

    Raises
    ------
    LogError
        The file cannot be read, or holds no legs of this version.
    """
    path = Path(path)
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if (data["format"], data["version"]) != (FORMAT, VERSION):
            raise LogError(
                f"'{path.name}' holds no legs that this version reads: it says "
                f"{data['format']} {data['version']}, {FORMAT} {VERSION} is needed."
            )
        trials: dict[int, list[Leg]] = {}
        for item in data["legs"]:
            until = item["until"]
            if until["kind"] not in get_args(Kind):
                raise LogError(
                    f"'{path.name}' has a leg that ends by '{until['kind']}': it is one of "
                    f"{', '.join(get_args(Kind))}."
                )
            value = float(until[_FIELD[until["kind"]]])
            rising = until.get("when", "rising") == "rising"
            if until["kind"] == "heading":
                rising = value > 0
            leg = Leg(
                item["commands"], until["kind"], value, item["at_most"], item["expected"], rising
            )
            trials.setdefault(int(item["trial"]), []).append(leg)
    except LogError:
        raise
    except OSError as error:
        raise LogError(f"cannot read the legs '{path}': {error.strerror}.") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise LogError(
            f"'{path.name}' is no file of legs: write one by greybox design --legs."
        ) from error
    return tuple(tuple(trials[k]) for k in sorted(trials))
