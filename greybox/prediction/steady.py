"""The approach: thruster commands and motion of a ship that goes straight ahead at one speed."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from greybox.errors import InfeasibleError, UsageError
from greybox.model.model import ManoeuvringModel
from greybox.prediction.helm import Helm, bounds
from greybox.prediction.ship import ShipDraws
from greybox.units import UNITS

Array = NDArray[np.float64]

# points on which a first solution is looked for
_POINTS = 400
_SPEEDS = np.geomspace(1e-3, 100.0, _POINTS)
# throttles tried where no limits are stated: in the unit of the log, whatever it is
_THROTTLES = np.geomspace(1e-4, 1e6, _POINTS)
_STEPS = 40
# a step of Newton's method is halved until it leaves less over
_HALVINGS = 30
_TOLERANCE = 1e-13
# times that the throttle is eased, and how far draws lower it below what the estimate needs
_EASINGS, _LEAST_OF_OWN = 5, 0.9


@dataclass(frozen=True)
class Steady:
    """Straight runs of R ships.

    Parameters
    ----------
    x : ndarray
        (nx, R) states [m/s, rad/s].
    throttle : ndarray
        (R,)
    trim : ndarray
        (R,) steering order that keeps the heading.
    commands : ndarray
        (nc, R)
    speed : ndarray
        (R,) over ground [m/s].
    found : ndarray of bool
        (R,) whether there is such a run within the limits.
    """

    x: Array
    throttle: Array
    trim: Array
    commands: Array
    speed: Array
    found: NDArray[np.bool_]

    def kept(self, which: NDArray[np.intp]) -> Steady:
        """Return some of the ships."""
        return Steady(*(getattr(self, f.name)[..., which] for f in fields(self)))


def straight_run(
    model: ManoeuvringModel,
    helm: Helm,
    theta: Array,
    d: Array,
    heading: float,
    speed: float | None,
) -> Steady:
    """Solve for the straight run at a speed, or at throttle 1 where none is given.

    Parameters
    ----------
    model : ManoeuvringModel
    helm : Helm
        Its `drive` holds the propeller speeds at throttle 1.
    theta : ndarray
        (R, p) the model's own parameters first, draws of them after.
    d : ndarray
        (R, nd) [m/s]
    heading : float
        [rad]
    speed : float or None
        Over ground [m/s].

    Raises
    ------
    UsageError
        Nothing pushes ahead.
    InfeasibleError
        The model does not hold the speed, or none at all.
    """
    states = model.structure.states
    problem = _Problem(model, helm, theta, d, heading, speed)
    start = _first(model, helm, theta[:1], d[:1], heading, speed)
    first = np.full(len(theta), start)
    others = problem.residual(first[None])[1:, :1]
    scale = max(abs(start) if speed is None else speed, 1e-6)
    lopsided = bool(np.any(np.abs(others) > 1e-9 * scale))
    size = 1 + (lopsided and "v" in states) + (lopsided and helm.kind != "none" and "r" in states)
    unknown = np.zeros((size, len(theta)))
    unknown[0] = start
    steps = np.array([max(abs(start), 1e-3), scale, 0.1][:size])
    with np.errstate(all="ignore"):
        here = problem.residual(unknown)[:size]
        for _ in range(_STEPS):
            if np.all((_largest(here) < _TOLERANCE * scale) | ~np.isfinite(_largest(here))):
                break
            slope = np.empty((len(theta), size, size))
            for j in range(size):
                moved = unknown.copy()
                moved[j] += 1e-6 * steps[j]
                slope[:, :, j] = ((problem.residual(moved)[:size] - here) / (1e-6 * steps[j])).T
            unknown, here = _nearer(problem, unknown, here, _solved(slope, here.T).T)
        error = _largest(here)
    x, throttle, trim = problem.unpack(unknown)
    commands = helm.commands(throttle, trim)
    ahead = x[states.index("u")]
    found = (error < 1e-6 * scale) & (ahead > 0) & ~helm.outside(commands).any(axis=0)
    if not found[0]:
        reach = "" if speed is None else f" at {speed:g} m/s"
        if not error[0] < 1e-6 * scale:
            raise InfeasibleError(
                f"no commands balance the model's forces on a straight course{reach}, so there is "
                f"no approach: give another --speed, or --command."
            )
        raise InfeasibleError(
            f"the model finds no steady straight run{reach} within the commands' limits "
            f"(it needs {_named(helm, commands[:, 0])}): give another --speed, or --command."
        )
    way = np.hypot(ahead, x[states.index("v")] if "v" in states else 0.0)
    return Steady(x, throttle, trim, commands, way, found)


def eased(model: ManoeuvringModel, helm: Helm, theta: Array, d: Array, heading: float) -> Helm:
    """Return the helm with so much less throttle that the trim of the approach keeps the limits.

    Two propellers that are not alike hold a course at two speeds, and the higher of them is
    beyond its limit where the throttle is at its own. Parameters and errors are those of
    `straight_run`.
    """
    driven = helm.drive != 0
    for _ in range(_EASINGS):
        steady = straight_run(model, helm.free(), theta, d, heading, None)
        room = helm.room(steady.commands[:, steady.found])[driven].min(axis=0)
        share = float(max(room.min(), _LEAST_OF_OWN * room[0]))
        if share >= 1:
            break
        helm = replace(helm, drive=helm.drive * share * (1 - 1e-6))
    return helm


class _Problem:
    """What a straight run leaves over: change of each state in one sample."""

    def __init__(
        self,
        model: ManoeuvringModel,
        helm: Helm,
        theta: Array,
        d: Array,
        heading: float,
        speed: float | None,
    ) -> None:
        self.states, self.length = model.structure.states, model.vessel.length
        self.helm, self.heading, self.speed = helm, heading, speed
        self.order = [self.states.index(n) for n in ("u", "v", "r") if n in self.states]
        self.ship = ShipDraws(
            model.structure,
            model.vessel,
            model.sample_time,
            model.integrator,
            theta,
            d,
            lagged=False,
        )

    def unpack(self, unknown: Array) -> tuple[Array, Array, Array]:
        """Return states (nx, R), throttles (R,) and trims (R,)."""
        runs = unknown.shape[1]
        sway = unknown[1] if len(unknown) > 1 else np.zeros(runs)
        trim = unknown[2] if len(unknown) > 2 else np.zeros(runs)
        x = np.zeros((len(self.states), runs))
        throttle = np.ones(runs) if self.speed is None else unknown[0]
        way = unknown[0] if self.speed is None else np.full(runs, self.speed)
        x[self.states.index("u")] = np.sqrt(np.maximum(way**2 - sway**2, 0.0))
        if "v" in self.states:
            x[self.states.index("v")] = sway
        return x, throttle, trim

    def residual(self, unknown: Array) -> Array:
        """Return the change of u, v and r (≤ 3, R)."""
        x, throttle, trim = self.unpack(unknown)
        commands = self.helm.commands(throttle, trim)
        after = self.ship(self.ship.start(x, self.heading, commands), commands)
        return np.asarray((after[: len(x)] - x)[self.order])


def _largest(residual: Array) -> Array:
    return np.asarray(np.abs(residual).max(axis=0))


def _nearer(problem: _Problem, unknown: Array, here: Array, step: Array) -> tuple[Array, Array]:
    """Take Newton's steps, each halved until it leaves less over.

    Damping that is quadratic alone has no slope at rest, so that a whole step goes anywhere.
    Where rounding lets no step leave less, the last one is taken: it is next to nothing.
    """
    size = len(unknown)
    # a yaw rate counts by the velocity that it makes at one ship length
    weight = np.array([[1.0], [1.0], [problem.length]])[:size]
    before = np.linalg.norm(weight * here, axis=0)
    share = np.ones(unknown.shape[1])
    for halving in range(_HALVINGS):
        there = unknown - share * step
        left = problem.residual(there)[:size]
        longer = ~(np.linalg.norm(weight * left, axis=0) < before)
        if halving == _HALVINGS - 1 or not longer.any():
            break
        share = np.where(longer, 0.5 * share, share)
    return there, left


def _solved(slope: Array, value: Array) -> Array:
    """Solve the small systems; singular ones give nan."""
    good = np.abs(np.linalg.det(slope)) > 0
    out = np.full(value.shape, np.nan)
    if good.any():
        out[good] = np.linalg.solve(slope[good], value[good][..., None])[..., 0]
    return out


def _first(
    model: ManoeuvringModel, helm: Helm, theta: Array, d: Array, heading: float, speed: float | None
) -> float:
    """Return throttle or speed of the estimate itself, from a scan."""

    def scan(throttles: Array, speeds: Array) -> Array:
        many = _Problem(
            model,
            helm,
            np.repeat(theta, _POINTS, axis=0),
            np.repeat(d, _POINTS, axis=0),
            heading,
            None,
        )
        x, _, _ = many.unpack(speeds[None])
        commands = helm.commands(throttles, 0.0)
        after = many.ship(many.ship.start(x, heading, commands), commands)
        return np.asarray((after[: len(x)] - x)[many.order[0]])

    def steady(throttle: float) -> float | None:
        return _crossing(_SPEEDS, -scan(np.full(_POINTS, throttle), _SPEEDS))

    if not helm.drive.any():
        raise UsageError(
            f"no thruster of {model.vessel.name} pushes ahead, so there is no approach: "
            f"give --command."
        )
    if speed is None:
        found = steady(1.0)
        if found is None:
            raise InfeasibleError(
                f"the model reaches no steady speed ahead at {_named(helm, helm.drive)}: "
                f"give another --command."
            )
        return found
    low, high = throttles(helm)
    grid = _THROTTLES if math.isinf(high) else np.linspace(low, high, _POINTS)
    grid = grid[grid >= low]
    grid = np.concatenate([grid, np.full(_POINTS - len(grid), grid[-1])])
    needed = _crossing(grid, scan(grid, np.full(_POINTS, speed)))
    if needed is None:
        ends = [steady(float(g)) or 0.0 for g in (grid[0], grid[-1])]
        values = [_named(helm, helm.drive * g) for g in (grid[0], grid[-1])]
        knots = UNITS["kn"].factor * speed
        meant = f"{speed:g} kn is {knots:.3g} m/s. " if ends[0] <= knots <= ends[1] else ""
        raise InfeasibleError(
            f"the model does not hold {speed:g} m/s: from {values[0]} to {values[1]} it reaches "
            f"{ends[0]:.3g} to {ends[1]:.3g} m/s. {meant}Give --speed between these, or --command."
        )
    return needed


def throttles(helm: Helm) -> tuple[float, float]:
    """Return least and greatest throttle ahead that the limits allow."""
    low, high = bounds(helm.limits)
    moved = helm.drive != 0
    if not moved.any():
        return 0.0, math.inf
    ends = np.sort([low[moved] / helm.drive[moved], high[moved] / helm.drive[moved]], axis=0)
    return max(0.0, float(ends[0].max())), float(ends[1].min())


def _crossing(x: Array, y: Array) -> float | None:
    """Return where y first rises through zero, linear between points."""
    up = np.flatnonzero((y[:-1] <= 0) & (y[1:] > 0))
    if len(up) == 0:
        # the greatest command may be just enough
        return float(x[-1]) if y[-1] == 0 else None
    k = int(up[0])
    return float(x[k] - y[k] * (x[k + 1] - x[k]) / (y[k + 1] - y[k]))


def kept_from_straight(helm: Helm) -> list[int]:
    """Return which commands have limits that forbid to steer straight ahead."""
    outside = helm.outside(np.zeros(len(helm.columns))) & (helm.drive == 0)
    return [int(i) for i in np.flatnonzero(outside)]


def require_straight(helm: Helm) -> None:
    """Refuse limits that forbid to steer straight ahead.

    Raises
    ------
    UsageError
        The command and its limits are named.
    """
    for i in kept_from_straight(helm):
        limit = helm.limits[i]
        raise UsageError(
            f"the approach needs {helm.columns[i]} at 0, and the vessel file keeps it from "
            f"{_side(limit.lower)} to {_side(limit.upper)}: correct the limits, or give "
            f"--no-limits to predict as though it stated none."
        )


def _side(value: float | None) -> str:
    return "no limit" if value is None else f"{value:g}"


def _named(helm: Helm, commands: Array) -> str:
    return ", ".join(
        f"{n} = {v:.4g}"
        for n, v, d in zip(helm.columns, commands, helm.drive, strict=True)
        if d != 0
    )
