"""A ship under a hypothesis, and what its sensors would show on a log.

Whatever a cause changes is one of: a coefficient, the current, how thrusters follow
their commands, a coefficient from some moment on, or how a sensor sees the motion.
"""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.linear import Linear, sensitivities
from greybox.diagnosis.simulator import VaryingSimulator
from greybox.model.run.step import Integrator, Rule, StepModel, held, integrated
from greybox.model.structure import Structure
from greybox.rotation import body_to_ned, ned_to_body
from greybox.trial.log import TrialLog
from greybox.vessel.actuation import actuated_force, delayed
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]

# a command, the column that holds it, and its sign there
Wire = tuple[str, str, float]
CURRENTS = ("current_north", "current_east")
# vessels whose forces are kept: the ship of a run, and both ends of a step in a number of hers
_VESSELS = 8
# runs that are kept: a fit comes back to where a step began that led nowhere
_RUNS = 4


@dataclass(frozen=True)
class Change:
    """A coefficient is `factor` times its value from `time` on [s after the log's start]."""

    index: int
    factor: float
    time: float


@dataclass(frozen=True)
class Sensors:
    """How sensors see the motion.

    Parameters
    ----------
    lever : tuple of float
        Where u and v are measured, forward and starboard of the origin [m].
    turned : float
        Measured less true direction of the axes of u and v [rad].
    late : tuple of (str, float)
        Channels that show an older time, by so many seconds.
    reversed : tuple of str
        Channels of the wrong sign.
    """

    lever: tuple[float, float] = (0.0, 0.0)
    turned: float = 0.0
    late: tuple[tuple[str, float], ...] = ()
    reversed: tuple[str, ...] = ()


@dataclass(frozen=True)
class Ship:
    """Everything that a run depends on beside the log.

    Parameters
    ----------
    theta : ndarray
        (p,) coefficients of the universe's structure.
    current : ndarray
        (2,) north and east [m/s].
    vessel : Vessel
        With its thrusters as they act.
    changes : tuple of Change
    sensors : Sensors
    wires : tuple of Wire
        Thruster columns that stand for another, or for its negative.
    """

    theta: Array
    current: Array
    vessel: Vessel
    changes: tuple[Change, ...] = ()
    sensors: Sensors = field(default_factory=Sensors)
    wires: tuple[Wire, ...] = ()

    def with_value(self, place: int, value: float) -> Ship:
        """Return the ship with one coefficient, or current past the coefficients, set."""
        p = len(self.theta)
        if place < p:
            theta = self.theta.copy()
            theta[place] = value
            return replace(self, theta=theta)
        current = self.current.copy()
        current[place - p] = value
        return replace(self, current=current)


@dataclass(frozen=True)
class Shown:
    """A run as the sensors show it.

    Parameters
    ----------
    x : ndarray
        (N, nx) states.
    y : ndarray
        (N, ny) outputs, the heading last where it is one.
    start : ndarray
        (nx [+ 1],) that it was made from.
    """

    x: Array
    y: Array
    start: Array


def derived_motions(log: TrialLog) -> frozenset[str]:
    """Return the velocities and yaw rate of a log that were made of other channels."""
    return frozenset(n for s in log.provenance.steps if s.derives_motion for n in s.channels)


class LogRun:
    """One log ready to be run under hypotheses.

    Parameters
    ----------
    structure : Structure
        With every term that any hypothesis may use.
    log : TrialLog
    integrator : {"euler", "rk4"}
    origin : float, optional
        Time that changes count from [s]; by default the log's first sample.
    duration : float, optional
        From there to the end of the log that this one is a part of [s]; by default to its own.
    """

    def __init__(
        self,
        structure: Structure,
        log: TrialLog,
        integrator: Integrator,
        origin: float | None = None,
        duration: float | None = None,
    ) -> None:
        self.structure, self.log, self.integrator = structure, log, integrator
        self.samples, self.sample_time = len(log), log.sample_time
        self._logged_time = log.logged_time
        self.time = log.t - (log.t[0] if origin is None else origin)
        self.duration = float(self.time[-1]) if duration is None else duration
        self.states = structure.states
        self._turns = "r" in self.states and "psi" in log
        self.outputs = (*self.states, "psi") if self._turns else self.states
        # where each output was measured, (N, ny)
        self.known = np.column_stack([log.known((n,)) for n in self.outputs])
        self._gaps = [i for i, measured in enumerate(self.known.T) if not measured.all()]
        self.y = self._across_gaps(np.column_stack([log[n] for n in self.outputs]))
        self.heading = log["psi"] if "psi" in log else np.zeros(len(log))
        # u and v were turned out of earth axes by the heading of their sample
        made = {"u", "v"} <= derived_motions(log) and {"u", "v"} <= set(self.states)
        self._over_ground = made and "psi" in log
        self._psi = held(self.heading, integrator)
        air = log.air
        self.air_measured = air is not None and structure.uses_air
        self._air = held(air if air is not None else np.zeros((len(log), 2)), integrator)
        self._commands = {c: log[c] for c in log.vessel.commands}
        step = StepModel(structure, integrator, air_measured=self.air_measured)
        self._simulator = VaryingSimulator(step, len(log))
        self._forces: deque[tuple[Vessel, tuple[Wire, ...], Array]] = deque(maxlen=_VESSELS)
        self._last: deque[tuple[Ship, Array, Array]] = deque(maxlen=_RUNS)

    def measuring(self, y: Array) -> LogRun:
        """Return the log with other outputs (N, ny)."""
        other = copy.copy(self)
        other.y, other._last = y, deque(maxlen=_RUNS)
        channels = dict(zip(self.outputs, y.T, strict=True))
        other.log = replace(self.log, channels={**self.log.channels, **channels})
        return other

    def in_wind_turned(self, angle: float) -> LogRun:
        """Return the log as if the measured wind had blown from further clockwise by an angle."""
        other, air = copy.copy(self), self.log.air
        if air is not None:
            motion = np.column_stack([self.log["u"], self.log["v"]])
            wind = motion - air
            turned = np.column_stack(body_to_ned(wind[:, 0], wind[:, 1], angle))
            other._air, other._last = held(motion - turned, self.integrator), deque(maxlen=_RUNS)
        return other

    def forces(self, vessel: Vessel, wires: tuple[Wire, ...] = ()) -> Array:
        """Return the generalised inputs (N, nu) as the vessel's thrusters give them."""
        for before, same, tau in reversed(self._forces):
            if same == wires and (before is vessel or before == vessel):
                return tau
        commands = wired(self._commands, wires)
        made = actuated_force(vessel, commands, self.sample_time, self._logged_time)
        zero = np.zeros(self.samples)
        tau = np.column_stack([made.get(n, zero) for n in self.structure.inputs])
        self._forces.append((vessel, wires, tau))
        return tau

    def weights(self, change: Change) -> Array:
        """Return the share of each step that lies after a change, (N,)."""
        return np.asarray(
            np.clip((self.time + self.sample_time - change.time) / self.sample_time, 0.0, 1.0)
        )

    def parameters(self, ship: Ship) -> Array:
        """Return the coefficients (p,), or (N, p) where they change."""
        if not ship.changes:
            return ship.theta
        theta = np.tile(ship.theta, (self.samples, 1))
        for change in ship.changes:
            theta[:, change.index] *= 1 + (change.factor - 1) * self.weights(change)
        return theta

    def start(self) -> Array:
        """Return the mean of the first samples, of outputs (ny,)."""
        return np.asarray(self.y[:5].mean(axis=0))

    def run(self, ship: Ship, start: Array) -> Shown:
        """Run freely from a start (nx [+ 1],), the initial heading last."""
        # sensors do not move a ship, nor does the heading that she begins with
        begun = start[: len(self.states)]
        same = (x for s, first, x in reversed(self._last) if _as_before(s, first, ship, begun))
        x = next(same, None)
        if x is None:
            x = self._simulator(begun, self._drivers(ship), self.parameters(ship))
            self._last.append((ship, begun, x))
        return self._as_shown(ship, x, start)

    def _drivers(self, ship: Ship) -> Array:
        """Return what the simulator reads of a ship, (N, nu + 5)."""
        current = np.broadcast_to(ship.current, (self.samples, 2))
        tau = self.forces(ship.vessel, ship.wires)
        return np.column_stack([tau, self._psi, self._air, current])

    def _as_shown(self, ship: Ship, x: Array, start: Array) -> Shown:
        if not np.isfinite(x).all():
            return Shown(x, np.full((self.samples, len(self.outputs)), np.inf), start)
        return Shown(x, self._show(ship.sensors, x, start), start)

    def _show(self, sensors: Sensors, x: Array, start: Array) -> Array:
        """Return the outputs (N, ny) of states (N, nx)."""
        nx = len(self.states)
        full = x
        if self._turns:
            full = np.column_stack([x, start[nx] + self._heading(x[:, self.states.index("r")])])
        y = self._across_gaps(self.sense(sensors, full[..., None])[..., 0])
        # a run tells nothing of what was before its first sample
        return self.y + self.within(sensors) * (y - self.y) if sensors.late else y

    def _moved(self, one: Ship, two: Ship) -> tuple[NDArray[np.int_], Array]:
        """Return the coefficients, currents and inputs in which ships differ, and how, (N, m)."""
        tau = np.zeros(len(self.structure.inputs))
        if one.vessel != two.vessel or one.wires != two.wires:
            tau = self.forces(two.vessel, two.wires) - self.forces(one.vessel, one.wires)
        theta = self.parameters(two) - self.parameters(one)
        places, values, first = [], [], 0
        for part in (theta, two.current - one.current, tau):
            used = np.flatnonzero(part.any(axis=0) if part.ndim == 2 else part)
            places.append(first + used)
            values.append(np.broadcast_to(part[..., used], (self.samples, len(used))))
            first += part.shape[-1]
        return np.concatenate(places), np.hstack(values)

    def _across_gaps(self, y: Array) -> Array:
        """Return outputs (N, ny, ...) straight between the ends of gaps, level at the log's ends.

        So the error there is what lies between those beside it, and surprises no filter.
        """
        for i in self._gaps:
            known = self.known[:, i]
            k, rows = np.flatnonzero(known), np.flatnonzero(~known)
            if not len(k):
                y[:, i] = 0.0
                continue
            right = np.searchsorted(k, rows)
            # a part of a log may begin or end within a gap
            left, right = k[np.maximum(right - 1, 0)], k[np.minimum(right, len(k) - 1)]
            share = (rows - left) / np.maximum(right - left, 1)
            share = share.reshape(-1, *[1] * (y.ndim - 2))
            y[rows, i] = (1 - share) * y[left, i] + share * y[right, i]
        return y

    def within(self, sensors: Sensors) -> Array:
        """Return the share of each measurement that shows a time within the log, (N, ny).

        A late channel begins with the motion before the log, an early one ends with that
        after it.
        """
        out = np.ones((self.samples, len(self.outputs)))
        index = np.arange(self.samples)
        for name, seconds in sensors.late:
            shows = index - seconds / self.sample_time
            beyond = np.maximum(-shows, shows - (self.samples - 1))
            out[:, self.outputs.index(name)] = 1.0 - np.clip(beyond, 0.0, 1.0)
        return out

    def _heading(self, r: Array, axis: int = 0) -> Array:
        """Integrate a yaw rate from zero along an axis of N."""
        # the mean of both ends is that of an RK4 step to second order
        rule: Rule = "trapezoid" if self.integrator == "rk4" else "euler"
        return integrated(r, self.sample_time, rule, axis)

    def sense(self, sensors: Sensors, x: Array) -> Array:
        """Return what sensors show of motions (N, ny, m); linear in the motion."""
        names = self.outputs
        if sensors == Sensors():
            return x.copy()
        y = x.copy(order="K")
        if "u" in names and "v" in names:
            iu, iv = names.index("u"), names.index("v")
            if "r" in names:
                rate = x[:, names.index("r")]
                y[:, iu] = y[:, iu] - sensors.lever[1] * rate
                y[:, iv] = y[:, iv] + sensors.lever[0] * rate
            if sensors.turned:
                y[:, iu], y[:, iv] = ned_to_body(y[:, iu], y[:, iv], sensors.turned)
        late = dict(sensors.late)
        turns = self._over_ground and bool({"u", "v", "psi"} & late.keys())
        if turns:
            # they were late over ground: the ship heads elsewhere by then
            heading = self.heading.reshape(-1, *[1] * (y.ndim - 2))
            true = shifted(heading, -late.get("psi", 0.0) / self.sample_time)
            y[:, iu], y[:, iv] = body_to_ned(y[:, iu], y[:, iv], true)
        for name, seconds in sensors.late:
            i = names.index(name)
            y[:, i] = shifted(y[:, i], seconds / self.sample_time)
        if turns:
            y[:, iu], y[:, iv] = ned_to_body(y[:, iu], y[:, iv], heading)
        for name in sensors.reversed:
            i = names.index(name)
            y[:, i] = -y[:, i]
        return y

    def linearise(self, ship: Ship, shown: Shown, places: NDArray[np.int_]) -> Linear:
        """Return the derivatives along a run.

        Parameters
        ----------
        ship : Ship
        shown : Shown
            Its run.
        places : ndarray of int
            (m,) coefficients, and past them the current north and east.
        """
        linear = self._linear(ship, shown, places)
        return Linear(linear.a, self._changed(ship, linear.driven, places))

    def _linear(self, ship: Ship, shown: Shown, places: NDArray[np.int_]) -> Linear:
        return self._simulator.linearise(
            shown.x, self._drivers(ship), self.parameters(ship), places
        )

    def _changed(self, ship: Ship, driven: Array, places: NDArray[np.int_]) -> Array:
        """Return derivatives in coefficients as they are before they change along the log."""
        for change in ship.changes:
            here = places == change.index
            if here.any():
                factor = 1 + (change.factor - 1) * self.weights(change)[:-1]
                driven[:, :, here] *= factor[:, None, None]
        return driven

    def columns(
        self,
        ship: Ship,
        shown: Shown,
        places: NDArray[np.int_],
        ways: Sequence[tuple[Ship, Ship]] = (),
    ) -> Array:
        """Return ∂y of coefficients and currents at `places`, then on ways, then of the start.

        Parameters
        ----------
        ship : Ship
        shown : Shown
            Its run.
        places : ndarray of int
            (m,)
        ways : sequence of (Ship, Ship)
            From one ship near `ship` to another one near it: how outputs change to first order.

        Returns
        -------
        ndarray
            (N, ny, m + ways + nx [+ 1])
        """
        moved = [self._moved(*way) for way in ways]
        m = len(places)
        needed = np.unique(np.concatenate([places, *(at for at, _ in moved)])).astype(int)
        linear = self._linear(ship, shown, needed)
        driven = np.empty((*linear.driven.shape[:2], m + len(ways)))
        own = linear.driven[:, :, np.searchsorted(needed, places)]
        driven[:, :, :m] = self._changed(ship, own, places)
        for k, (at, change) in enumerate(moved, m):
            along = linear.driven[:, :, np.searchsorted(needed, at)]
            driven[:, :, k] = np.einsum("nim,nm->ni", along, change[:-1])
        out = self.seen(ship, sensitivities(Linear(linear.a, driven)))
        for k, (one, two) in enumerate(ways, m):
            if one.sensors != two.sensors:
                shows = [self._show(s.sensors, shown.x, shown.start) for s in (one, two)]
                out[:, :, k] += shows[1] - shows[0]
        return out

    def seen(self, ship: Ship, slope: Array) -> Array:
        """Return ∂y (N, ny, m [+ 1]) of motions' derivatives ∂x (N, nx, m)."""
        nx, m = slope.shape[1:]
        extra = int(self._turns)
        # time is last in memory: what follows runs along it
        full = np.empty((nx + extra, m + extra, self.samples))
        full[:nx, :m] = slope.transpose(1, 2, 0)
        if self._turns:
            full[:nx, m], full[nx, m] = 0.0, 1.0
            full[nx, :m] = self._heading(full[self.states.index("r"), :m], axis=-1)
        y = full.transpose(2, 0, 1)
        if ship.sensors != Sensors():
            y = self.sense(ship.sensors, y)
        y = self._across_gaps(y)
        return y * self.within(ship.sensors)[:, :, None] if ship.sensors.late else y


def _as_before(before: Ship, begun: Array, ship: Ship, start: Array) -> bool:
    """Whether a ship moves as in the run before, whatever its sensors show."""
    return (
        np.array_equal(begun, start)
        and np.array_equal(before.theta, ship.theta)
        and np.array_equal(before.current, ship.current)
        and (before.vessel is ship.vessel or before.vessel == ship.vessel)
        and before.changes == ship.changes
        and before.wires == ship.wires
    )


def wired(commands: Mapping[str, Array], wires: Sequence[Wire]) -> dict[str, Array]:
    """Return the commands as they act, where columns stand for others."""
    out = dict(commands)
    for command, column, sign in wires:
        out[command] = sign * commands[column]
    return out


def shifted(value: Array, samples: float) -> Array:
    """Return value (N, ...) as of `samples` earlier, held at the ends."""
    return np.moveaxis(delayed(np.moveaxis(value, 0, -1), samples), -1, 0)
