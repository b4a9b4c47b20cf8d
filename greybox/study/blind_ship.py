"""The ship of a blind trial: many ships side by side, in continuous time.

The equations are those of (3.51) with the discrete parameters taken per second,
integrated by Runge-Kutta of fourth order at 0.1 s; nothing here is shared with
the engine that is judged on its trials.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.rotation import body_to_ned
from greybox.study.blind_inputs import RATES, Programme

Array = NDArray[np.float64]

NAMES = (
    "Xu", "Xvr", "Xuu", "Wuu", "Xmu", "Xkappa", "Yv", "Yur", "Yvv", "Yvr", "Wvv", "Ymu",
    "Nr", "Nuv", "Nvv", "Nvr", "Wuv", "Nmu",
)  # fmt: skip
EXTRA = (
    "X_uuu", "Y_vvv", "N_rrr", "N_|r|r", "Y_|r|r", "Y_|r|v", "N_|r|v", "Y_0", "N_0",
    "Y_r", "N_v", "Y_taux", "N_taux", "Y_|u|u", "N_|u|u",
)  # fmt: skip
STEP = 0.1
# seconds that a ship runs before its log begins: late sensors and commands have a past
LEAD = 10
# ships up to which each is computed by numbers of its own
_FEW = 8
# where the two azimuths stand ahead of the origin [m]
_X1, _X2 = 9.0, -9.0


@dataclass(frozen=True)
class Ship:
    """One ship on one trial, each effect at its null value unless drawn.

    Parameters
    ----------
    theta : ndarray
        (18,) parameters per second in the order of `NAMES`.
    programme : Programme
        Over N seconds.
    start : ndarray
        (4,) u, v [m/s], r [rad/s], ψ [rad].
    wind : ndarray
        (N, 2) velocity of the air, north and east [m/s].
    process : ndarray
        (N, 3) added to u, v, r at each second.
    current : (float, float)
        North and east [m/s].
    extra : tuple of float
        (15,) coefficients of `EXTRA`.
    gain : (float, float)
        Of each thruster.
    speed_lag, force_lag, delay : float
        First-order lag of the speeds, of the force, and delay of all commands [s].
    own_lag, own_delay, own_rate : tuple of float
        (4,) first-order lag and delay [s], and fastest movement per second, of n1, n2, alpha1,
        alpha2 each.
    moving : float
        1 where commands go on a straight line from one second to the next, else 0.
    quadratic, reference : float
        Share of the thrust that goes as n|n|/reference.
    advance : float
        Loss of side force and moment per m/s.
    change : (int, float, float)
        Parameter, its factor, and the second from which it holds.
    dead_band : float
        Speed below which the propellers give nothing.
    interaction : (float, float, float)
        Largest loss of thruster 2, centre and width of the angles of thruster 1 [rad].
    backlash : float
        Half the play of the azimuths [rad].
    unevenness : float
        Share by which sway damping is larger to starboard.
    shallow : (float, float)
        Coefficient of (|u| − u0)² and u0 [m/s].
    swell : (float, float, float, float)
        Amplitude [m/s²], period [s], direction and phase [rad] of a slow force.
    """

    theta: Array
    programme: Programme
    start: Array
    wind: Array
    process: Array
    current: tuple[float, float] = (0.0, 0.0)
    extra: tuple[float, ...] = field(default=(0.0,) * len(EXTRA))
    gain: tuple[float, float] = (1.0, 1.0)
    speed_lag: float = 0.0
    force_lag: float = 0.0
    delay: float = 0.0
    own_lag: tuple[float, ...] = (0.0,) * 4
    own_delay: tuple[float, ...] = (0.0,) * 4
    own_rate: tuple[float, ...] = (np.inf,) * 4
    moving: float = 0.0
    quadratic: float = 0.0
    reference: float = 1.0
    advance: float = 0.0
    change: tuple[int, float, float] = (0, 1.0, np.inf)
    dead_band: float = 0.0
    interaction: tuple[float, float, float] = (0.0, 0.0, 1.0)
    backlash: float = 0.0
    unevenness: float = 0.0
    shallow: tuple[float, float] = (0.0, 0.0)
    swell: tuple[float, float, float, float] = (0.0, 1.0, 0.0, 0.0)


@dataclass(frozen=True)
class History:
    """Motion of B ships.

    Parameters
    ----------
    t : ndarray
        (M,) time at every step [s].
    x : ndarray
        (M, 4, B) u, v [m/s], r [rad/s], ψ [rad].
    commands : ndarray
        (N, 4, B) n1, n2, alpha1, alpha2 [rad] at every second.
    """

    t: Array
    x: Array
    commands: Array

    def positions(self, ship: int) -> tuple[Array, Array, Array]:
        """Return times (K,), and positions north and east (K,) [m] from steps of 0.1 s."""
        t = np.arange(round(self.t[-1] / STEP) + 1) * STEP
        u, v, _, psi = (np.interp(t, self.t, self.x[:, i, ship]) for i in range(4))
        rate = np.array(body_to_ned(u, v, psi))
        way = np.cumsum(0.5 * STEP * (rate[:, 1:] + rate[:, :-1]), axis=1)
        north, east = np.concatenate([np.zeros((2, 1)), way], axis=1)
        return t, north, east


def _accelerations(
    theta: Any, advance: Any, north: Any, east: Any, blown_north: Any, blown_east: Any, u: Any,
    v: Any, r: Any, c: Any, s: Any, along: Any, across: Any, turning: Any,
) -> tuple[Any, ...]:  # fmt: skip
    """Return du/dt, dv/dt, dr/dt of (3.51), then u and v through the water.

    Of one ship by numbers, or of B by arrays (B,), in a current and a wind north and east, on a
    heading of a cosine and a sine, under a force ahead, to starboard and turning.
    """
    (Xu, Xvr, Xuu, Wuu, Xmu, Xkappa, Yv, Yur, Yvv, Yvr, Wvv, Ymu,
     Nr, Nuv, Nvv, Nvr, Wuv, Nmu) = theta  # fmt: skip
    ur, vr = u - (c * north + s * east), v - (c * east - s * north)
    uq, vq = u - (c * blown_north + s * blown_east), v - (c * blown_east - s * blown_north)
    size = abs(vr)
    loss = 1 - advance * ur
    du = (Xu + Xuu * abs(ur)) * ur + Xvr * vr * r + Wuu * abs(uq) * uq + (Xmu + Xkappa * ur) * along
    dv = (
        (Yv + Yvv * size) * vr + (Yur * ur + Yvr * size) * r + Wvv * abs(vq) * vq
        + Ymu * loss * across
    )  # fmt: skip
    dr = (
        (Nr + Nvr * size) * r + (Nuv * ur + Nvv * size) * vr + Wuv * uq * vq
        + Nmu * loss * turning
    )  # fmt: skip
    return du, dv, dr, ur, vr


class _Fleet:
    """The parameters of B ships as arrays, and their equations."""

    def __init__(self, ships: Sequence[Ship]) -> None:
        def stack(name: str) -> Array:
            return np.array([getattr(s, name) for s in ships], float).T

        self.theta = stack("theta")
        self.current, self.extra, self.gain = stack("current"), stack("extra"), stack("gain")
        self.speed_lag, self.force_lag = stack("speed_lag"), stack("force_lag")
        self.delay, self.quadratic = stack("delay") + stack("own_delay"), stack("quadratic")
        self.own_lag, self.own_rate = stack("own_lag"), stack("own_rate")
        self.own = bool(self.own_lag.any() or np.isfinite(self.own_rate).any())
        self.moving = stack("moving") > 0
        self.reference, self.advance = stack("reference"), stack("advance")
        self.change, self.dead_band = stack("change"), stack("dead_band")
        self.interaction, self.backlash = stack("interaction"), stack("backlash")
        self.unevenness, self.shallow, self.swell = (
            stack("unevenness"), stack("shallow"), stack("swell")
        )  # fmt: skip
        own = (self.extra, self.unevenness, self.shallow[0], self.swell[0])
        self.peculiar = any(part.any() for part in own)
        self.few = len(ships) <= _FEW
        self.each = self.theta.T.tolist()

    def alter(self, which: NDArray[np.bool_], factor: Array) -> None:
        """Multiply the parameter of each of some ships (B,) that changes, by its factor (B,)."""
        self.theta[self.change[0, which].astype(int), which] *= factor[which]
        self.each = self.theta.T.tolist()

    def decay(self, lag: Array, step: float) -> Array:
        """Return what remains of a lagged value at the start, middle and end of a step."""
        after = np.array([0.0, 0.5, 1.0]).reshape(3, *[1] * lag.ndim) * step
        return np.where(lag > 0, np.exp(-after / np.where(lag > 0, lag, 1.0)), 0.0)

    def thrust(self, n: Array, angle: Array) -> Array:
        """Return τx, τy, τψ (3, K, B) of speeds and angles (2, K, B) (3.46)."""
        size = np.abs(n)
        law = (1 - self.quadratic) * n + self.quadratic * n * size / self.reference
        force = np.where(size < self.dead_band, 0.0, law) * self.gain[:, None]
        loss, centre, width = self.interaction
        if loss.any():
            race = loss * np.exp(-(((angle[0] - centre) / width) ** 2))
            force[1] *= 1 - np.where(n[0] > 0, race, 0.0)
        along, across = force * np.cos(angle), force * np.sin(angle)
        return np.array([along[0] + along[1], across[0] + across[1],
                         _X1 * across[0] + _X2 * across[1]])  # fmt: skip

    def rates(self, x: Array, tau: Array, wind: Array, t: float) -> Array:
        """Return du/dt, dv/dt, dr/dt and dψ/dt (4, B) of (3.51)."""
        u, v, r, psi = x
        c, s = np.cos(psi), np.sin(psi)
        given = (self.advance, *self.current, *wind, u, v, r, c, s, *tau)
        if self.few:
            # the same sums one ship at a time: for few, arrays cost more than the sums do
            rows = zip(self.each, *[g.tolist() for g in given], strict=True)
            du, dv, dr, ur, vr = np.array([_accelerations(*row) for row in rows]).T
        else:
            du, dv, dr, ur, vr = _accelerations(self.theta, *given)
        if self.peculiar:
            turn = np.abs(r)
            e = self.extra
            beyond = np.maximum(np.abs(ur) - self.shallow[1], 0.0)
            push = self.swell[0] * np.cos(2 * np.pi * t / self.swell[1] + self.swell[3])
            du += e[0] * ur**3 + self.shallow[0] * beyond**2 * np.sign(ur)
            du += push * np.cos(self.swell[2] - psi)
            dv += e[1] * vr**3 + e[4] * turn * r + e[5] * turn * vr + e[7]
            dv += e[9] * r + e[11] * tau[0] + e[13] * np.abs(ur) * ur
            dv += self.unevenness * self.theta[6] * np.maximum(vr, 0.0) + push * np.sin(
                self.swell[2] - psi
            )
            dr += e[2] * r**3 + e[3] * turn * r + e[6] * turn * vr + e[8]
            dr += e[10] * vr + e[12] * tau[0] + e[14] * np.abs(ur) * ur
        return np.array([du, dv, dr, r])


def simulate_ships(
    ships: Sequence[Ship],
    *,
    euler: bool = False,
    linear: bool = False,
    step: float = STEP,
) -> History:
    """Run ships side by side over their programmes.

    Parameters
    ----------
    ships : sequence of Ship
        B, of equally long programmes.
    euler : bool
        Step by Euler at 1 s, exactly as (3.51), instead of Runge-Kutta.
    linear : bool
        Go from one command to the next within the second instead of holding it.
    step : float
        Of Runge-Kutta [s]; divides a second.

    Returns
    -------
    History
        A ship that runs away leaves numbers that are not finite.
    """
    fleet = _Fleet(ships)
    step = 1.0 if euler else step
    inner = round(1 / step)
    seconds, count = len(ships[0].wind), len(ships)
    wind = np.array([s.wind for s in ships]).transpose(1, 2, 0)
    process = np.array([s.process for s in ships]).transpose(1, 2, 0)
    x = np.array([s.start for s in ships]).T
    history = np.empty(((seconds - 1) * inner + 1, 4, count))
    history[0] = x
    commands = np.empty((seconds, 4, count))
    helm = _Helm([s.programme for s in ships])
    commands[0] = helm.targets[0]
    speed, play = commands[0, :2].copy(), commands[0, 2:].copy()
    force = fleet.thrust(speed[:, None], play[:, None])[:, 0]
    reached, moved = commands[0].copy(), commands[0].copy()
    keep_own = fleet.decay(fleet.own_lag, step).transpose(1, 0, 2)
    keep_speed, keep_force = fleet.decay(fleet.speed_lag, step), fleet.decay(fleet.force_lag, step)
    stages = np.array([0.0, 0.5, 1.0])[:, None] * step
    everyone, each = np.arange(count), np.arange(4)[:, None]
    straight = fleet.moving | linear
    any_straight = bool(straight.any())
    with np.errstate(all="ignore"):
        for k in range(seconds - 1):
            commands[k + 1] = helm.next(k, x[3], commands[k])
            now = fleet.change[2] == k
            if now.any():
                fleet.alter(now, fleet.change[1])
            for i in range(inner):
                t = k + i * step
                # the middle of the step tells which second it lies in
                at = np.minimum(np.maximum(t + step / 2 - fleet.delay, 0), seconds - 1)
                before = np.floor(at + 1e-9).astype(int)
                wanted = commands[before, each, everyone][:, None].repeat(3, axis=1)
                if any_straight:
                    share = np.maximum(t + stages - fleet.delay[:, None], 0) - before[:, None]
                    after = commands[np.minimum(before + 1, k + 1), each, everyone][:, None]
                    wanted = np.where(straight, wanted + share * (after - wanted), wanted)
                if fleet.own:
                    most = fleet.own_rate[:, None] * np.maximum(stages, 1e-12)
                    way = np.clip(wanted - reached[:, None], -most, most)
                    wanted = np.where(np.isinf(most), wanted, reached[:, None] + way)
                    reached = wanted[:, 2]
                    wanted = wanted + (moved[:, None] - wanted) * keep_own
                    moved = wanted[:, 2]
                n = wanted[:2] + (speed[:, None] - wanted[:2]) * keep_speed
                angle = np.maximum(play[:, None], wanted[2:] - fleet.backlash)
                angle = np.minimum(angle, wanted[2:] + fleet.backlash)
                raw = fleet.thrust(n, angle)
                tau = raw + (force[:, None] - raw) * keep_force
                speed, play, force = n[:, 2], angle[:, 2], tau[:, 2]
                air = [wind[k] + (i + a) * step * (wind[k + 1] - wind[k]) for a in (0, 0.5, 1)]
                a = fleet.rates(x, tau[:, 0], air[0], t)
                if euler:
                    x = x + a
                else:
                    b = fleet.rates(x + 0.5 * step * a, tau[:, 1], air[1], t + step / 2)
                    c = fleet.rates(x + 0.5 * step * b, tau[:, 1], air[1], t + step / 2)
                    d = fleet.rates(x + step * c, tau[:, 2], air[2], t + step)
                    x = x + step / 6 * (a + 2 * (b + c) + d)
                if i == inner - 1:
                    x[:3] += process[k]
                history[k * inner + i + 1] = x
    times = np.arange(len(history), dtype=float) * step
    return History(times, history, commands)


class _Helm:
    """Turns programmes into commands, second by second."""

    def __init__(self, programmes: Sequence[Programme]) -> None:
        self.targets = np.array([p.target for p in programmes]).transpose(1, 2, 0)
        self.threshold = np.array([p.threshold for p in programmes]).T
        self.side = np.array([p.side for p in programmes]).T
        self.begins = np.array([p.begins for p in programmes]).T
        self.reference = np.zeros(len(programmes))
        self.sign = np.ones(len(programmes))

    def next(self, k: int, psi: Array, command: Array) -> Array:
        """Return the commands (4, B) of second k + 1 from the heading at second k."""
        self.reference = np.where(self.begins[k], psi, self.reference)
        self.sign = np.where(self.begins[k], 1.0, self.sign)
        turned = self.sign * self.side[k] * (psi - self.reference)
        self.sign = np.where(turned > self.threshold[k], -self.sign, self.sign)
        target = self.targets[k + 1].copy()
        target[2:] *= np.where(np.isfinite(self.threshold[k + 1]), self.sign, 1.0)
        rate = RATES[:, None]
        return np.asarray(command + np.clip(target - command, -rate, rate))
