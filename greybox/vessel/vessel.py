"""What is known of a vessel before any model: geometry, thrusters, sensors, columns."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations
from math import degrees, floor, inf, isfinite, radians
from typing import Any, Literal, get_args

from greybox.channels import CHANNELS
from greybox.errors import VesselError, so_many, suggestion
from greybox.notebook import DisplayMixin, number, table
from greybox.vessel.conditions import Conditions
from greybox.vessel.thrust import ThrustLaw

ThrusterType = Literal["azimuth", "fixed", "tunnel", "propeller_rudder"]
THRUSTER_TYPES: tuple[ThrusterType, ...] = get_args(ThrusterType)
Drive = Literal["feedback", "command"]
ActuatorKind = Literal["speed", "angle", "rudder"]


@dataclass(frozen=True)
class Limits:
    """Range and rate of one command; None where the file states none."""

    lower: float | None = None
    upper: float | None = None
    rate: float | None = None


@dataclass(frozen=True)
class Actuator:
    """One movement of a thruster of which both the command and the feedback are logged.

    Parameters
    ----------
    thruster : int
        Which of the vessel's thrusters, counted from 1; of those that share both
        columns, the first.
    kind : {"speed", "angle", "rudder"}
    command, feedback : str
        Log columns: what was asked for, and what was measured.
    limits : Limits
        In the unit of the column that drives the model.
    """

    thruster: int
    kind: ActuatorKind
    command: str
    feedback: str
    limits: Limits

    @property
    def angular(self) -> bool:
        """Whether both columns are angles [rad]; speeds may be in a unit each."""
        return self.kind != "speed"


@dataclass(frozen=True)
class Thruster:
    """One thruster: where it sits, what moves it, what force it gives.

    Parameters
    ----------
    type : {"azimuth", "fixed", "tunnel", "propeller_rudder"}
    x, y : float
        Position from the body origin, forward and starboard positive [m].
    speed : str
        Log column that holds the propeller speed.
    angle : str or float
        Column, or constant, with the direction of the force at positive speed,
        from bow to starboard [rad].
    rudder : str
        Column with the rudder angle, positive turns to starboard [rad].
    thrust : ThrustLaw
    speed_limits, angle_limits, rudder_limits : Limits
    gain : float
        Share of the thrust law that the thruster gives, 1 for all of it.
    angle_offset : float
        True minus logged direction of an azimuth, or angle of a rudder [rad].
    drive : {"feedback", "command"}
        What `speed`, `angle` and `rudder` hold: measured values or commands.
    speed_other, angle_other, rudder_other : str, optional
        The command's column where the feedback drives, else the feedback's.

    Raises
    ------
    VesselError
        Gain or offset is not finite, there is an offset but no logged angle, one column
        is named as command and as feedback, or a command drives without a feedback.
    """

    type: ThrusterType
    x: float
    y: float
    speed: str
    angle: str | float = 0.0
    rudder: str | None = None
    thrust: ThrustLaw = field(default_factory=ThrustLaw)
    speed_limits: Limits = field(default_factory=Limits)
    angle_limits: Limits = field(default_factory=Limits)
    rudder_limits: Limits = field(default_factory=Limits)
    gain: float = 1.0
    angle_offset: float = 0.0
    drive: Drive = "feedback"
    speed_other: str | None = None
    angle_other: str | None = None
    rudder_other: str | None = None

    def __post_init__(self) -> None:
        for name in ("gain", "angle_offset"):
            if not isfinite(getattr(self, name)):
                raise VesselError(
                    f"{name} of the thruster driven by '{self.speed}' is "
                    f"{getattr(self, name)}, a finite number is needed: correct it."
                )
        if self.angle_offset and not isinstance(self.angle, str) and self.rudder is None:
            raise VesselError(
                f"the thruster driven by '{self.speed}' has angle_offset = "
                f"{self.angle_offset:g}, but it is of type {self.type} and its angle is not "
                f"logged: correct 'angle' or 'type' instead."
            )
        for kind, column, other, _ in self.movements:
            if column == other:
                raise VesselError(
                    f"the thruster driven by '{self.speed}' has the column '{column}' both as "
                    f"'{kind}' and as '{kind}_command': name the other column, or leave "
                    f"'{kind}_command' out."
                )
            if self.drive == "command" and other is None:
                raise VesselError(
                    f"the thruster driven by '{self.speed}' is driven by its command but has no "
                    f'column of the measured {kind}: name it, or say drive = "feedback".'
                )

    @property
    def steered_by(self) -> str | None:
        """Log column that turns this thruster or its rudder; None where nothing does."""
        return self.angle if isinstance(self.angle, str) else self.rudder

    @property
    def columns(self) -> tuple[str, ...]:
        """Log columns that move this thruster."""
        return tuple(column for _, column, _, _ in self.movements)

    @property
    def movements(self) -> tuple[tuple[ActuatorKind, str, str | None, Limits], ...]:
        """What moves: kind, driving column, the other column if any, limits."""
        found: list[tuple[ActuatorKind, str, str | None, Limits]] = [
            ("speed", self.speed, self.speed_other, self.speed_limits)
        ]
        if isinstance(self.angle, str):
            found.append(("angle", self.angle, self.angle_other, self.angle_limits))
        if self.rudder is not None:
            found.append(("rudder", self.rudder, self.rudder_other, self.rudder_limits))
        return tuple(found)


# angles that turn faster [rad/s] are seldom meant
_QUICK = 1.0
# noise of a compass [rad] or gyro [rad/s] that is seldom meant
_NOISY = 0.1
# what follows slowly, beside one column by its name
LagOn = Literal["force", "speed", "angle", "command"]
DelayOn = Literal["speed", "angle", "command"]
LagHeld = Literal["start", "mean", "end"]
Between = Literal["held", "interpolated"]


# a delay this close to whole samples has no share of the next one
_WHOLE = 1e-9


@dataclass(frozen=True)
class Actuation:
    """How the force follows the logged commands: how late, and what they are between samples.

    A command is delayed, then moves no faster than its rate limit, then passes the lag.

    Parameters
    ----------
    lag : float
        Time constant of a first-order lag [s], 0 for none.
    lag_on : str
        What follows slowly: each generalised ``force``, the propellers' ``speed``, each
        ``angle`` of thrusters and rudders, each ``command``, or one command by the name of its
        column.
    delay : float
        Pure delay [s].
    lag_held : {"start", "mean", "end"}
        Which value of what follows slowly acts during a sample.
    between : {"held", "interpolated"}
        Whether a logged command stays as it is until the next one, as orders do, or moves on a
        straight line towards it, as measured angles and speeds do.
    delay_on : str
        What is delayed: each ``speed``, ``angle`` or ``command``, or one by the name of its column.
    rate_limit : float, optional
        Fastest movement of one command, in the unit of its column per second.
    rate_on : str, optional
        That column.

    Raises
    ------
    VesselError
        A time is negative or not finite, a rate is not positive, `lag_held` or `between` is
        none of those, or one of `rate_limit` and `rate_on` stands without the other.
    """

    lag: float = 0.0
    lag_on: LagOn = "force"
    delay: float = 0.0
    lag_held: LagHeld = "start"
    between: Between = "held"
    delay_on: str = "command"
    rate_limit: float | None = None
    rate_on: str | None = None

    def __post_init__(self) -> None:
        for name, value in (("lag", self.lag), ("delay", self.delay)):
            if not 0 <= value < inf:
                raise VesselError(
                    f"{name} of [actuation] is {value:g} s, it must be zero or positive: "
                    f"correct it."
                )
        if self.rate_limit is not None and not 0 < self.rate_limit < inf:
            raise VesselError(
                f"rate_limit of [actuation] is {self.rate_limit:g}, it must be positive: correct "
                f"it, or leave it out."
            )
        if (self.rate_limit is None) != (self.rate_on is None):
            has, lacks = ("rate_limit", "rate_on")[:: 1 if self.rate_on is None else -1]
            raise VesselError(
                f"[actuation] has {has} but no {lacks}: name the column that moves no faster "
                f"(rate_on) and how fast it moves (rate_limit, per second), or leave both out."
            )
        for key, chosen, known in (
            ("lag_held", self.lag_held, get_args(LagHeld)),
            ("between", self.between, get_args(Between)),
        ):
            if chosen not in known:
                raise VesselError(
                    f"{key} of [actuation] is '{chosen}'.{suggestion(str(chosen), known)} "
                    f"Use {', '.join(known)}."
                )

    def __bool__(self) -> bool:
        return self.lag > 0 or self.delay > 0 or self.rate_limit is not None

    def delay_samples(self, sample_time: float) -> tuple[int, float]:
        """Return the delay as whole samples and the share of a further one."""
        samples = self.delay / sample_time
        whole = floor(samples + _WHOLE)
        share = samples - whole
        return whole, share if share > _WHOLE else 0.0

    @property
    def sentence(self) -> str:
        """Lag, delay and rate limit in words."""
        of = {
            "force": "each force", "speed": "the propeller speeds", "angle": "all angles",
            "command": "all commands",
        }  # fmt: skip
        parts = []
        if self.lag:
            parts.append(f"a lag of {self.lag:.4g} s of {of.get(self.lag_on, self.lag_on)}")
        if self.delay:
            whose = (
                "" if self.delay_on == "command" else f" of {of.get(self.delay_on, self.delay_on)}"
            )
            parts.append(f"a delay of {self.delay:.4g} s{whose}")
        if self.rate_limit is not None:
            parts.append(f"a rate limit of {self.rate_limit:.4g} per second of {self.rate_on}")
        late = " and ".join(parts) or "no lag and no delay"
        return late if self.between == "held" else f"{late}, interpolated between samples"


@dataclass(frozen=True)
class ColumnMapping:
    """A log column under another name, unit or sign than the canonical one."""

    name: str
    unit: str | None
    sign: int = 1


@dataclass(frozen=True, repr=False)
class Vessel(DisplayMixin):
    """A vessel as its TOML file describes it.

    Parameters
    ----------
    name : str
    length : float
        [m]
    thrusters : tuple of Thruster
    columns : mapping of str to ColumnMapping
        Log column -> canonical name, with unit.
    sensors : mapping of str to float or tuple
        Standard deviations and positions of the sensors.
    closed_loop : pair, optional
        Log column and its values under which a controller moves the thrusters.
    mass : float, optional
        [kg]
    actuation : Actuation
    conditions : Conditions
        Those of a log that does not state its own.
    beam : float, optional
        [m]
    service_speed : float, optional
        With all propellers at their limit ahead [m/s].

    Raises
    ------
    VesselError
        `actuation` names a column that moves no thruster.
    """

    name: str
    length: float
    thrusters: tuple[Thruster, ...]
    columns: Mapping[str, ColumnMapping] = field(default_factory=dict)
    sensors: Mapping[str, Any] = field(default_factory=dict)
    closed_loop: tuple[str, tuple[str, ...]] | None = None
    mass: float | None = None
    actuation: Actuation = Actuation()
    conditions: Conditions = field(default_factory=Conditions)
    beam: float | None = None
    service_speed: float | None = None

    def __post_init__(self) -> None:
        for key, words in (
            ("lag_on", get_args(LagOn)), ("delay_on", get_args(DelayOn)), ("rate_on", ()),
        ):  # fmt: skip
            chosen = getattr(self.actuation, key)
            if chosen is not None and chosen not in (known := (*words, *self.commands)):
                raise VesselError(
                    f"{key} of [actuation] is '{chosen}'.{suggestion(str(chosen), known)} Use "
                    f"{', '.join(words)}{' or ' if words else ''}a column that moves a thruster: "
                    f"{', '.join(self.commands)}."
                )

    @cached_property
    def commands(self) -> tuple[str, ...]:
        """Log columns that move the thrusters, each once."""
        return tuple(dict.fromkeys(c for t in self.thrusters for c in t.columns))

    @property
    def delayed_commands(self) -> tuple[str, ...]:
        """Those of `commands` that act after the delay of `actuation`."""
        return self._meant(self.actuation.delay_on) if self.actuation.delay else ()

    @property
    def lagged_commands(self) -> tuple[str, ...]:
        """Those of `commands` that pass the lag of `actuation`; none where forces do."""
        lag, on = self.actuation.lag, self.actuation.lag_on
        return () if lag == 0 or on == "force" else self._meant(on)

    def _meant(self, on: str) -> tuple[str, ...]:
        """Return those of `commands` that a word or a column of `actuation` stands for."""
        # the words stand before a column of the same name
        of: dict[str, Collection[str]] = {
            "command": self.commands,
            "speed": {t.speed for t in self.thrusters},
            "angle": self.angle_commands,
        }
        return tuple(c for c in self.commands if c in of.get(on, {on}))

    @property
    def angle_commands(self) -> frozenset[str]:
        """Those of `commands` that are angles [rad]."""
        return frozenset(c for t in self.thrusters for k, c, _, _ in t.movements if k != "speed")

    @property
    def actuators(self) -> tuple[Actuator, ...]:
        """Each movement of which both command and feedback are logged, each pair once."""
        found: dict[tuple[str, str], Actuator] = {}
        for place, t in enumerate(self.thrusters, 1):
            for kind, column, other, limits in t.movements:
                if other is not None:
                    pair = (other, column) if t.drive == "feedback" else (column, other)
                    found.setdefault(pair, Actuator(place, kind, *pair, limits))
        return tuple(found.values())

    @property
    def recorded_columns(self) -> tuple[str, ...]:
        """Log columns of the thrusters: those that move them, then the others."""
        others = (c for a in self.actuators for c in (a.command, a.feedback))
        return tuple(dict.fromkeys([*self.commands, *others]))

    @property
    def recorded_angles(self) -> frozenset[str]:
        """Those of `recorded_columns` that are angles [rad]."""
        pairs = (c for a in self.actuators if a.angular for c in (a.command, a.feedback))
        return self.angle_commands | frozenset(pairs)

    @property
    def rudders(self) -> frozenset[str]:
        """Those of `recorded_angles` that are rudder angles, which no full turn can wrap."""
        moved = [m for t in self.thrusters for m in t.movements]
        return frozenset(c for kind, *both, _ in moved if kind == "rudder" for c in both if c)

    def unit(self, name: str) -> str | None:
        """Return the SI unit of a channel or thruster column, None where any unit is kept."""
        if name in self.recorded_angles:
            return "rad"
        return CHANNELS[name].unit if name in CHANNELS else None

    @property
    def doubts(self) -> tuple[str, ...]:
        """What the file states that is possible, and is seldom meant."""
        said = []
        for i, t in enumerate(self.thrusters, 1):
            if t.rudder is not None and t.x > 0:
                said.append(
                    f"the rudder of thruster {i} stands at x = {t.x:g} m, ahead of the "
                    f"origin: sign of x? Forward is positive."
                )
            for kind, _, _, limits in t.movements:
                if kind != "speed" and limits.rate is not None and limits.rate > _QUICK:
                    said.append(
                        f"{kind}_rate of thruster {i} is {limits.rate:g} rad/s, which only "
                        f"servos of small models reach: write radians, "
                        f"{radians(limits.rate):.4g} if {limits.rate:g} deg/s is meant."
                    )
        for i, j in combinations(range(len(self.thrusters)), 2):
            a, b = self.thrusters[i], self.thrusters[j]
            apart = not set(a.columns) & set(b.columns)
            if apart and a.type == b.type and (a.x, a.y) == (b.x, b.y) and a.y != 0:
                said.append(
                    f"thrusters {i + 1} and {j + 1} stand at one place, x = {a.x:g} m and "
                    f"y = {a.y:g} m: sign of y? Starboard is positive."
                )
        for key, unit in (("heading_std", ""), ("r_std", "/s")):
            value = self.sensors.get(key)
            if value is not None and value > _NOISY:
                said.append(
                    f"{key} is {value:g} rad{unit}, which is {degrees(value):.3g} deg{unit}: "
                    f"write radians, {radians(value):.4g} if {value:g} deg{unit} is meant."
                )
        return tuple(said)

    @property
    def limits(self) -> dict[str, Limits]:
        """Limits of each command; of those that share a column, the tightest."""
        found: dict[str, list[Limits]] = {}
        for t in self.thrusters:
            for _, column, _, limits in t.movements:
                found.setdefault(column, []).append(limits)
        return {name: _tightest(limits) for name, limits in found.items()}

    def trial_seconds(self, speed: float) -> float:
        """Return how long a trial to plan next may last at a speed [m/s]: 30 ship lengths [s].

        In a longer one the motions of models drawn from a prior spread so far that its limits are
        hardly kept.
        """
        return min(max(round(30 * self.length / max(speed, 1e-9) / 50), 2) * 50.0, 900.0)

    @property
    def force_unit(self) -> str:
        """Unit of the generalised force: N, or that of the propeller speed; else ``mixed``."""
        units = {t.thrust.unit for t in self.thrusters}
        return units.pop() if len(units) == 1 else "mixed"

    def summary(self) -> str:
        """Return thrusters, limits and sensors as text."""
        mass = "" if self.mass is None else f", {self.mass:g} kg"
        count = len(self.thrusters)
        lines = [f"{self.name}: {self.length:g} m{mass}, {so_many(count, 'thruster')}"]
        for t in self.thrusters:
            lines.append(
                f"  {t.type} at x {t.x:g} m, y {t.y:g} m, moved by {', '.join(t.columns)}; "
                f"thrust {t.thrust.kind}"
            )
        lines += [
            f"  {name}: {number(x.lower)} to {number(x.upper)}, rate {number(x.rate)} per second"
            for name, x in self.limits.items()
        ]
        lines += [
            f"  {a.kind} of thruster {a.thruster}: commanded by {a.command}, measured as "
            f"{a.feedback}"
            for a in self.actuators
        ]
        if self.actuation:
            lines.append(f"  thrusters with {self.actuation.sentence}")
        lines += [f"  {name} {value}" for name, value in self.sensors.items()]
        if self.conditions:
            lines.append(f"  conditions: {self.conditions.sentence}")
        return "\n".join(lines)

    def _parts(self) -> tuple[str, ...]:
        limits = self.limits
        return (
            table(
                ("thruster", "x [m]", "y [m]", "moved by", "thrust"),
                [
                    (t.type, number(t.x), number(t.y), ", ".join(t.columns), t.thrust.kind)
                    for t in self.thrusters
                ],
            ),
            table(
                ("command", "unit", "least", "most", "per second"),
                [
                    (n, "rad" if n in self.angle_commands else "as logged", number(x.lower),
                     number(x.upper), number(x.rate))
                    for n, x in limits.items()
                ],
            ),
        )  # fmt: skip

    def std(self, channel: str) -> float | None:
        """Return the measurement noise of a channel where the file states it."""
        key = {"psi": "heading_std"}.get(channel, f"{channel}_std")
        value = self.sensors.get(key)
        return None if value is None else float(value)


def _tightest(limits: list[Limits]) -> Limits:
    lower = [x.lower for x in limits if x.lower is not None]
    upper = [x.upper for x in limits if x.upper is not None]
    rate = [x.rate for x in limits if x.rate is not None]
    return Limits(
        max(lower) if lower else None, min(upper) if upper else None, min(rate) if rate else None
    )
