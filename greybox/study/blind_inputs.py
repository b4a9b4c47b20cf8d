"""What the helmsman of a blind trial does: pulses, manoeuvres of both signs, zig-zags."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.study.inputs import smoothed_pulses

Array = NDArray[np.float64]

# largest moment over Δx that keeps the ship below about 0.1 rad/s [unit of the speed]
_TURN = 3.0
# what the actuators can do in a second: speeds and angles
RATES = np.array([1.5, 1.5, 0.1, 0.1])


@dataclass(frozen=True)
class Programme:
    """Commands wanted at each second, and where a zig-zag turns back by heading.

    Parameters
    ----------
    target : ndarray
        (N, 4) n1, n2 and alpha1, alpha2 [rad], before the actuators' rates.
    threshold : ndarray
        (N,) change of heading at which the angles change sign [rad]; infinite
        where they do not follow the heading.
    side : ndarray
        (N,) sign of the turn that the target makes.
    begins : ndarray of bool
        (N,) where the heading is taken as the reference of what follows.
    """

    target: Array
    threshold: Array
    side: Array
    begins: NDArray[np.bool_]


def steer(target: Array) -> Programme:
    """Return the programme of commands that do not depend on the heading, (N, 4)."""
    n = len(target)
    return Programme(target, np.full(n, np.inf), np.ones(n), np.zeros(n, bool))


def pulses(rng: np.random.Generator, samples: int, single: bool) -> Programme:
    """Draw offset pulses: speeds 10-20, angles 0.6-1.1 rad, no sign ever changes.

    Parameters
    ----------
    rng : numpy.random.Generator
    samples : int
        N
    single : bool
        Both propellers run at one speed.

    References
    ----------
    Ljungberg (2020), section 6.1.
    """

    def draw(lower: float, upper: float) -> Array:
        return smoothed_pulses(rng, samples, lower, upper, widths=(20, 80), smoothing=10)

    # speeds of their own, but near each other: their difference turns the ship
    speed = draw(11.0, 19.0)
    apart = 0.0 if single else draw(-1.0, 1.0)
    angles = [np.clip(draw(0.65, 1.05) * 0.5 + draw(0.6, 1.1) * 0.5, 0.6, 1.1) for _ in range(2)]
    return steer(np.column_stack([speed + apart, speed - apart, *angles]))


def manoeuvres(rng: np.random.Generator, samples: int, single: bool) -> Programme:
    """Draw straight runs, turns to both sides, changes of speed and some going astern.

    Parameters
    ----------
    As `pulses`.
    """
    parts, left = [], samples
    while left > 0:
        length = int(rng.integers(30, 100))
        base = rng.uniform(5, 18) if rng.uniform() > 0.15 else rng.uniform(-10, -5)
        n1, n2 = base * (np.ones(2) if single else rng.uniform(0.8, 1.2, 2))
        if rng.uniform() < 0.2:
            a1, a2 = rng.uniform(-0.05, 0.05, 2)
        else:
            a1, a2 = _turn(rng, n1, n2)
        parts.append(np.tile([n1, n2, a1, a2], (min(length, left), 1)))
        left -= length
    return steer(np.vstack(parts))


def _turn(rng: np.random.Generator, n1: float, n2: float) -> tuple[float, float]:
    """Return angles of 0.1-0.8 rad whose moments nearly balance."""
    moment = rng.uniform(-_TURN, _TURN)
    a1 = rng.choice([-1, 1]) * rng.uniform(0.1, 0.8)
    most = np.sin(0.8)
    s2 = np.clip((n1 * np.sin(a1) - moment) / n2, -most, most)
    s1 = np.clip((moment + n2 * s2) / n1, -most, most)
    return float(np.arcsin(s1)), float(np.arcsin(s2))


def zigzag(rng: np.random.Generator, samples: int, single: bool) -> Programme:
    """Draw zig-zags of ±10-35°, one azimuth steering, turned back by heading or by the clock.

    Parameters
    ----------
    As `pulses`.
    """
    target = np.zeros((samples, 4))
    threshold, side = np.full(samples, np.inf), np.ones(samples)
    begins = np.zeros(samples, bool)
    first = 0
    while first < samples:
        length = int(rng.integers(120, 240))
        part = slice(first, min(first + length, samples))
        steer = int(rng.integers(2))
        amplitude = np.radians(rng.uniform(10, 35))
        steering = rng.uniform(0.6, 1.0) * min(16.0, _TURN / np.sin(amplitude))
        speeds = np.full(2, steering) if single else np.full(2, rng.uniform(4, 18))
        speeds[steer] = steering
        target[part, :2] = speeds
        wave = np.full(part.stop - part.start, amplitude) * rng.choice([-1, 1])
        if rng.uniform() < 0.5:
            threshold[part] = np.radians(rng.uniform(10, 30))
            # a thruster ahead of the origin turns to the side it pushes to, one behind away
            side[part] = np.sign(wave[0]) * (1 if steer == 0 else -1)
        else:
            half = int(rng.integers(15, 45))
            wave = wave * np.where((np.arange(len(wave)) // half) % 2 == 0, 1.0, -1.0)
        target[part, 2 + steer] = wave
        begins[first] = True
        first += length
    return Programme(target, threshold, side, begins)


KINDS: dict[str, Callable[[np.random.Generator, int, bool], Programme]] = {
    "pulses": pulses,
    "manoeuvres": manoeuvres,
    "zigzag": zigzag,
}
