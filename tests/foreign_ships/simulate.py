"""Run a foreign ship through a manoeuvre and write what its instruments log."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from foreign_ships.environment import (
    AIR,
    Current,
    WaveForce,
    Waves,
    Wind,
    current_series,
    wind_series,
)
from foreign_ships.ship import Faults, Noise, Ship

Array = NDArray[np.float64]


class Motion(NamedTuple):
    """What an autopilot sees: true position, heading and velocities over ground."""

    t: float
    x_n: float
    y_n: float
    psi: float
    u: float
    v: float
    r: float


Helm = Callable[[Motion], Sequence[float]]
Manoeuvre = Callable[[Ship, np.random.Generator], Helm]


@dataclass(frozen=True)
class Trial:
    """A run: truth and log at the same times, all SI and rad.

    Attributes
    ----------
    ship : Ship
    t : ndarray
        (N,) [s].
    true : dict of str to ndarray
        x_n, y_n, psi, u, v, r over ground, u_r, v_r through the water, phi and p of ships that
        roll, u_q, v_q through the air, the current and wind in north and east, every actuator,
        and its command under ``<column>_command``.
    measured : dict of str to ndarray
        x_n, y_n, psi, u, v, r, u_q, v_q and the feedback of every actuator.
    """

    ship: Ship
    t: Array
    true: dict[str, Array]
    measured: dict[str, Array]

    def columns(
        self, every: int = 1, *, velocities: bool = True, wind: bool = False, commands: bool = False
    ) -> dict[str, Array]:
        """Return the log's columns, every `every`-th sample."""
        names = ["x_n", "y_n", "psi"]
        names += ["u", "v", "r"] if velocities else []
        names += ["u_q", "v_q"] if wind else []
        out = {"t": self.t} | {n: self.measured[n] for n in names}
        for a in self.ship.actuators:
            out[a.column] = self.measured[a.column]
            if commands:
                out[f"{a.column}_command"] = self.true[f"{a.column}_command"]
        return {n: x[::every] for n, x in out.items()}

    def write_csv(self, path: str | Path, every: int = 1, **what: bool) -> Path:
        """Write the log; `what` is that of `columns`."""
        columns = self.columns(every, **what)
        table = np.column_stack(list(columns.values()))
        np.savetxt(path, table, delimiter=",", header=",".join(columns), comments="", fmt="%.9g")
        return Path(path)

    def measured_again(
        self, seed: int, noise: Noise | None = None, faults: Faults | None = None
    ) -> Trial:
        """Return the same run with other sensor noise, or with faults of the instruments."""
        noise = self.ship.noise if noise is None else noise
        return replace(self, measured=_measure(self.ship, self.t, self.true, noise, faults, seed))


def simulate(
    ship: Ship,
    commands: Manoeuvre,
    duration: float,
    dt: float = 0.1,
    *,
    wind: Wind | None = None,
    current: Current | None = None,
    waves: Waves | None = None,
    noise: Noise | None = None,
    faults: Faults | None = None,
    seed: int = 0,
    start_speed: float | None = None,
    start_heading: float | None = None,
    step: float = 0.1,
) -> Trial:
    """Sail a manoeuvre by Runge-Kutta steps of fourth order.

    The water carries the ship along, also where it speeds up: the slope of the surface that
    drives the current pushes a floating ship as it pushes the water, so the motion through the
    water does not feel it.

    Parameters
    ----------
    ship : Ship
    commands : Manoeuvre
    duration, dt : float
        Of the trial and between its samples [s].
    wind, current, waves : optional
    noise : Noise, optional
        Of the sensors; that of the ship where not given.
    faults : Faults, optional
        Of the sensors; none where not given.
    seed : int
        Of the environment, of what chance the manoeuvre takes, and of the noise.
    start_speed : float, optional
        Through the water [m/s], service speed where not given; propellers turn accordingly.
    start_heading : float, optional
        [rad], drawn where not given.
    step : float
        Longest step of the integration [s]; the true one divides `dt`.

    Returns
    -------
    Trial
    """
    sea, pilot = (np.random.default_rng([seed, k]) for k in (1, 2))
    inner = max(1, math.ceil(dt / step - 1e-9))
    h = dt / inner
    samples = round(duration / dt) + 1
    steps = (samples - 1) * inner + 1
    currents = current_series(current, sea, steps, h)
    winds = wind_series(wind, sea, steps, h)
    flows, airs = currents.tolist(), winds.tolist()  # faster than arrays
    swell = None if waves is None else WaveForce(waves, sea, ship.length, ship.beam)
    speed = ship.service_speed if start_speed is None else start_speed
    heading = pilot.uniform(-math.pi, math.pi) if start_heading is None else start_heading
    helm = commands(ship, pilot)
    actuators = ship.actuators
    moving = 5 if ship.rolls else 3
    at_once = ship.follows_at_once

    state = [0.0, 0.0, heading, speed] + [0.0] * (moving - 1)
    state += ship.helm(speed / ship.service_speed, 0.0)
    first = 3 + moving
    limits = [a.limits for a in actuators]
    followers = [(1 / a.lag, a.rate) for a in actuators]
    mass, _, inertia = ship.inertia
    windage = ship.windage
    drag_x, drag_y = AIR / 2 * windage.frontal * windage.cx, AIR / 2 * windage.lateral * windage.cy

    out = np.empty((samples, len(state)))
    orders = np.empty((samples, len(actuators)))
    for k in range(steps):
        flow_n, flow_e = flows[k]
        air_n, air_e = airs[k]
        c, s = math.cos(state[2]), math.sin(state[2])
        ground_n = c * state[3] - s * state[4] + flow_n
        ground_e = s * state[3] + c * state[4] + flow_e
        order = helm(
            Motion(
                k * h,
                state[0],
                state[1],
                state[2],
                c * ground_n + s * ground_e,
                c * ground_e - s * ground_n,
                state[5],
            )
        )
        order = [min(max(o, lo), hi) for o, (lo, hi) in zip(order, limits, strict=True)]
        if at_once:
            state[first:] = order
        if k % inner == 0:
            out[k // inner] = state
            orders[k // inner] = order
        if k == steps - 1:
            break
        push_x = push_y = push_n = 0.0
        if swell is not None:
            surge, sway, yaw = swell(k * h, state[0], state[1], state[2])
            push_x = mass * surge
            push_y = mass * sway
            push_n = inertia * yaw

        def rate(y: list[float]) -> list[float]:
            c, s = math.cos(y[2]), math.sin(y[2])
            u, v = y[3], y[4]
            north, east = c * u - s * v + flow_n, s * u + c * v + flow_e  # noqa: B023
            x, across, n = push_x, push_y, push_n  # noqa: B023
            if wind is not None:
                u_q = c * (north - air_n) + s * (east - air_e)  # noqa: B023
                v_q = c * (east - air_e) - s * (north - air_n)  # noqa: B023
                v_air = math.sqrt(u_q * u_q + v_q * v_q)
                x -= drag_x * u_q * v_air
                force = drag_y * v_q * v_air
                across -= force
                n -= windage.arm * force
            values = y[first:]
            out = [north, east, y[5]]
            out += ship.accelerations(y[3:first], values, (x, across, n))
            if at_once:
                out += [0.0] * len(values)
            else:
                for o, a, (quick, most) in zip(order, values, followers, strict=True):  # noqa: B023
                    out.append(min(max((o - a) * quick, -most), most))
            return out

        k1 = rate(state)
        k2 = rate([a + h / 2 * b for a, b in zip(state, k1, strict=True)])
        k3 = rate([a + h / 2 * b for a, b in zip(state, k2, strict=True)])
        k4 = rate([a + h * b for a, b in zip(state, k3, strict=True)])
        state = [
            a + h / 6 * (p + 2 * (q + r) + w)
            for a, p, q, r, w in zip(state, k1, k2, k3, k4, strict=True)
        ]
        if not abs(state[3]) < 1e3:
            raise FloatingPointError(f"{ship.name} diverged after {k * h:.1f} s")

    true = _truth(ship, out, orders, currents[::inner], winds[::inner])
    trial = Trial(ship, np.asarray(dt * np.arange(samples), np.float64), true, {})
    return trial.measured_again(seed, noise, faults)


def _truth(
    ship: Ship, states: Array, orders: Array, current: Array, wind: Array
) -> dict[str, Array]:
    """Name the columns of the states and add velocities over ground and through the air."""
    north, east, psi, u_r, v_r, r = states[:, :6].T
    c, s = np.cos(psi), np.sin(psi)
    u = u_r + c * current[:, 0] + s * current[:, 1]
    v = v_r + c * current[:, 1] - s * current[:, 0]
    true = {"x_n": north, "y_n": east, "psi": psi, "u": u, "v": v, "r": r, "u_r": u_r, "v_r": v_r}
    first = 6
    if ship.rolls:
        true |= {"phi": states[:, 6], "p": states[:, 7]}
        first = 8
    true["u_q"] = u - c * wind[:, 0] - s * wind[:, 1]
    true["v_q"] = v - c * wind[:, 1] + s * wind[:, 0]
    true |= {"current_north": current[:, 0], "current_east": current[:, 1]}
    true |= {"wind_north": wind[:, 0], "wind_east": wind[:, 1]}
    for i, a in enumerate(ship.actuators):
        true[a.column] = states[:, first + i]
        true[f"{a.column}_command"] = orders[:, i]
    return true


def _measure(
    ship: Ship,
    t: Array,
    true: dict[str, Array],
    noise: Noise,
    faults: Faults | None,
    seed: int,
) -> dict[str, Array]:
    rng = np.random.default_rng([seed, 3])
    faults = faults or Faults()
    stds = {
        "x_n": noise.position,
        "y_n": noise.position,
        "psi": noise.heading,
        "u": noise.u,
        "v": noise.v,
        "r": noise.r,
        "u_q": noise.wind,
        "v_q": noise.wind,
    }
    stds |= {a.column: noise.angle if a.angle else noise.speed for a in ship.actuators}
    c, s = np.cos(true["psi"]), np.sin(true["psi"])
    forward, starboard = faults.antenna
    shown = true | {
        "x_n": true["x_n"] + c * forward - s * starboard,
        "y_n": true["y_n"] + s * forward + c * starboard,
        "psi": true["psi"] + faults.heading_bias,
    }
    out = {}
    for name, std in stds.items():
        value = shown[name]
        if name in faults.late:
            value = np.interp(t - faults.late[name], t, value)
        out[name] = value + faults.offset.get(name, 0.0) + std * rng.standard_normal(len(t))
    return out
