"""Runs a manoeuvre with all draws at once: orders, rates and limits, delay, lag, motion."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.model.model import ManoeuvringModel
from greybox.model.run.step import integrated
from greybox.prediction.helm import Helm, bounds
from greybox.prediction.orders import Orders
from greybox.prediction.ship import WHERE_WIND, ShipDraws
from greybox.prediction.start import Start
from greybox.rotation import body_to_ned, ned_to_body

Array = NDArray[np.float64]
Push = Callable[[int, Array, Array], Array]

# how many times the approach speed, and the rate of turn in one ship length, count as diverged
_DIVERGED = 10.0
_MOST = 10**7


@dataclass(frozen=True)
class DrawnRuns:
    """Manoeuvres as they were sailed.

    Parameters
    ----------
    t : ndarray
        (N,) [s]; the order is at ``t[order]``.
    states : ndarray
        (N, 3, R) u, v [m/s], r [rad/s]; zero where the structure has none.
    psi : ndarray
        (N, R) [rad]
    commands : ndarray
        (N, nc, R) in the unit of the log, angles [rad].
    order : int
        First sample of the manoeuvre.
    complete : ndarray of int
        (R,) last sample of each, −1 where it was not completed.
    diverged : ndarray of bool
        (R,)
    """

    t: Array
    states: Array
    psi: Array
    commands: Array
    order: int
    complete: NDArray[np.int64]
    diverged: NDArray[np.bool_]

    def track(self, run: int, stop: int) -> tuple[Array, Array]:
        """Return positions north and east (stop,) [m] by the trapezoidal rule."""
        u, v, _ = self.states[:stop, :, run].T
        rate = np.stack(body_to_ned(u, v, self.psi[:stop, run]))
        north, east = integrated(rate, np.diff(self.t[:stop]), "trapezoid", axis=1)
        return north, east


def sail(
    model: ManoeuvringModel,
    helm: Helm,
    start: Start,
    theta: Array,
    d: Array,
    heading: float,
    orders: Orders,
    longest: float,
    pushes: Sequence[Push] = (),
    wind: Array | None = None,
) -> DrawnRuns:
    """Sail on from a start until all manoeuvres are complete.

    Parameters
    ----------
    model : ManoeuvringModel
    helm : Helm
    start : Start
        Of the same R draws.
    theta, d : ndarray
        (R, p), (R, nd)
    heading : float
        Of the approach [rad].
    orders : Orders
    longest : float
        Time from the order after which what is not complete stays so [s].
    pushes : sequence of callable
        Each gives what is added to the next states (nx, R) from the sample since the order,
        the states and the commands (nc, R).
    wind : ndarray, optional
        (N, 2) wind north and east at each sample from the order on, the last stands [m/s];
        that of `d` by default.

    Notes
    -----
    In water that flows (``start.current``) the equations hold for velocities through it, in
    which a constant current is no force (Fossen, 2011, property 8.1).
    """
    step, length = model.sample_time, model.vessel.length
    flow = np.zeros((2, len(theta))) if start.current is None else start.current
    if start.current is not None and d.shape[1]:
        d = d.copy()
        d[:, WHERE_WIND] -= flow.T
    ship = ShipDraws(model.structure, model.vessel, step, model.integrator, theta, d)
    names = model.structure.states
    where = [names.index(n) if n in names else None for n in ("u", "v", "r")]
    nx = len(names)
    speed = float(start.speed[0])
    before = len(start.motion)
    most = before + max(1, math.ceil(min(longest / step, _MOST)))
    delay = model.vessel.actuation.delay_samples(step)
    late = np.isin(model.vessel.commands, model.vessel.delayed_commands)

    def carried(psi: Array) -> Array:
        """Return what the flow adds to u, v, r (3, R)."""
        return np.stack([*ned_to_body(flow[0], flow[1], psi), np.zeros(len(psi))])

    begin = start.x - carried(start.psi)[[("u", "v", "r").index(n) for n in names]]
    state = ship.start(begin, start.psi, start.commands[-1])
    low, high = (b[:, None] for b in bounds(helm.limits))
    rates = np.array([[math.inf if x.rate is None else x.rate] for x in helm.limits]) * step
    limit = _DIVERGED * np.array([speed, speed, speed / length])[:, None]
    runs = theta.shape[0]
    diverged = np.zeros(runs, bool)
    psi, states, commands = list(start.heading), list(start.motion), list(start.commands)
    at = start.commands[-1]
    with np.errstate(all="ignore"):
        for k in range(before, most):
            now = np.stack([np.zeros(runs) if i is None else state[i] for i in where])
            now += carried(state[nx])
            diverged |= ~(np.abs(now) <= limit).all(axis=0)
            since = k - before
            own = state[nx] - heading
            wanted = np.clip(orders.targets(since, own, now[0]), low, high)
            if wind is not None:
                ship.blow(wind[min(since, len(wind) - 1)][:, None] - flow)
            after_order, moved = _moved(at, wanted, rates, 1.0)
            states.append(now)
            psi.append(state[nx].copy())
            commands.append(moved)
            if np.all((orders.complete >= 0) | diverged):
                break
            after = ship(state, _earlier(commands, k, delay, late))
            share = orders.react(since, own, after[nx] - heading)
            if share is not None:
                # the sample is sailed again with the mean of both orders over it
                new = np.clip(orders.targets(since, own, now[0]), low, high)
                reached, first = _moved(at, wanted, rates, share)
                after_order, second = _moved(reached, new, rates, 1 - share)
                commands[k] = share * first + (1 - share) * second
                after = ship(state, _earlier(commands, k, delay, late))
            at = after_order
            for push in pushes:
                after[:nx] += push(since, state, commands[k])
            state = after
    complete = np.where((orders.complete >= 0) & ~diverged, orders.complete + before, -1)
    return DrawnRuns(
        np.asarray(np.arange(len(psi)) * step, float),
        np.stack(states),
        np.stack(psi),
        np.stack(commands),
        before,
        complete,
        diverged,
    )


def _moved(at: Array, wanted: Array, rates: Array, share: Array | float) -> tuple[Array, Array]:
    """Move commands at their rates for a share of a sample; return where to, and their mean."""
    way = np.clip(wanted - at, -rates * share, rates * share)
    end = at + np.where(np.isfinite(rates), way, wanted - at)
    under_way = np.where(np.isfinite(rates), np.abs(way) / rates, 0.0)
    mean = end - (end - at) * under_way / 2 / np.maximum(share, 1e-12)
    return end, mean


def _earlier(
    commands: list[Array], k: int, delay: tuple[int, float], late: NDArray[np.bool_]
) -> Array:
    """Return the commands that act at sample `k`, linear between samples; the first were held."""
    whole, share = delay
    here, before = (commands[max(k - n, 0)] for n in (whole, whole + 1))
    acting = (1 - share) * here + share * before if share else here
    return np.where(late[:, None], acting, commands[k])
