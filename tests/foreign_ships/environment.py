"""Current, wind and waves of a virtual sea, each reproducible from a seed."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

Array = NDArray[np.float64]
GRAVITY = 9.81
AIR = 1.225  # kg/m3


@dataclass(frozen=True)
class Current:
    """A current that varies slowly about a mean.

    `towards` is the direction it sets to, clockwise from north [rad]; `spread` the standard
    deviation of each component [m/s] and `time` its time constant [s].
    """

    speed: float
    towards: float = 0.0
    spread: float = 0.0
    time: float = 300.0


@dataclass(frozen=True)
class Wind:
    """A wind with gusts.

    `origin` is the direction it comes from, clockwise from north [rad]; `gusts` the standard
    deviation of each component [m/s] and `time` its time constant [s].
    """

    speed: float
    origin: float = 0.0
    gusts: float = 0.0
    time: float = 15.0


@dataclass(frozen=True)
class Waves:
    """Irregular long-crested waves: significant height [m], peak period [s], origin [rad]."""

    height: float
    period: float
    origin: float = 0.0
    components: int = 12


@dataclass(frozen=True)
class Windage:
    """Areas against the wind [m2], their force coefficients and the arm of the side force [m]."""

    frontal: float
    lateral: float
    cx: float = 0.7
    cy: float = 0.9
    arm: float = 0.0


def filtered(rng: np.random.Generator, steps: int, dt: float, time: float) -> Array:
    """Return a first-order Gauss-Markov process of unit variance, stationary from its start."""
    keep = math.exp(-dt / time)
    drive = math.sqrt(1 - keep**2) * rng.standard_normal(steps)
    drive[0] = rng.standard_normal()
    return np.asarray(lfilter([1.0], [1.0, -keep], drive))


def current_series(
    current: Current | None, rng: np.random.Generator, steps: int, dt: float
) -> Array:
    """Return the current (steps, 2) north and east [m/s], filtered twice to vary smoothly."""
    if current is None:
        return np.zeros((steps, 2))
    mean = current.speed * np.array([math.cos(current.towards), math.sin(current.towards)])
    value = np.tile(mean, (steps, 1))
    if current.spread:
        lead = round(3 * current.time / dt)
        keep = math.exp(-dt / current.time)
        for axis in range(2):
            raw = filtered(rng, steps + lead, dt, current.time)
            # a second filter of the same time constant halves the variance
            twice = lfilter([1 - keep], [1, -keep], raw)[lead:]
            value[:, axis] += math.sqrt(2) * current.spread * twice
    return value


def wind_series(wind: Wind | None, rng: np.random.Generator, steps: int, dt: float) -> Array:
    """Return the velocity of the air (steps, 2) north and east [m/s]."""
    if wind is None:
        return np.zeros((steps, 2))
    mean = -wind.speed * np.array([math.cos(wind.origin), math.sin(wind.origin)])
    value = np.tile(mean, (steps, 1))
    if wind.gusts:
        value = value + wind.gusts * np.column_stack(
            [filtered(rng, steps, dt, wind.time) for _ in range(2)]
        )
    return value


class WaveForce:
    """Linear wave accelerations of a ship: the slope of the water under it, averaged over it."""

    def __init__(self, waves: Waves, rng: np.random.Generator, length: float, beam: float) -> None:
        peak = 2 * math.pi / waves.period
        omega = peak * np.linspace(0.7, 1.6, waves.components)
        # Pierson-Moskowitz about the peak, scaled to the significant height
        spectrum = omega**-5.0 * np.exp(-1.25 * (peak / omega) ** 4)
        amplitude = np.sqrt(spectrum / spectrum.sum()) * waves.height / 4 * math.sqrt(2)
        number = omega**2 / GRAVITY
        self._omega = omega
        self._number = number
        self._slope = GRAVITY * number * amplitude
        self._phase = rng.uniform(0, 2 * math.pi, waves.components)
        self._to = waves.origin + math.pi
        self._length, self._beam = length, beam

    def __call__(
        self, t: float, north: float, east: float, psi: float
    ) -> tuple[float, float, float]:
        """Return the accelerations of surge and sway [m/s2] and of yaw [rad/s2]."""
        relative = self._to - psi
        c, s = math.cos(relative), math.sin(relative)
        along = north * math.cos(self._to) + east * math.sin(self._to)
        angle = self._omega * t - self._number * along + self._phase
        half = self._number * self._length / 2 * c
        wide = np.sinc(self._number * self._beam / 2 * s / math.pi)
        mean = np.sinc(half / math.pi) * wide
        # first moment of the slope along the hull over the square of the radius L/4
        moment = _odd(half) * wide * 8 / self._length
        push = self._slope * np.sin(angle)
        lean = self._slope * np.cos(angle)
        return (
            float(push @ mean) * c,
            float(push @ mean) * s,
            -float(lean @ moment) * s,
        )


def _odd(a: Array) -> Array:
    """Return the integral of x sin(a x) over x from 0 to 1 ((sin a - a cos a) / a^2)."""
    small = np.abs(a) < 1e-3
    safe = np.where(small, 1.0, a)
    return np.where(small, a / 3, (np.sin(safe) - safe * np.cos(safe)) / safe**2)
