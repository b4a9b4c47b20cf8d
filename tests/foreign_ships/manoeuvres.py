"""Standard manoeuvres and everyday driving, for any ship that has a helm.

Each function returns a manoeuvre: called with a ship and a source of chance it returns a helm,
which takes the motion and gives the ship's commands. Times are counted in lengths sailed at
service speed (`Ship.time_scale`), so that one description fits all sizes. `turn` 1 is 35 degrees
of rudder, or what stands for it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from foreign_ships.ship import Ship
from foreign_ships.simulate import Helm, Manoeuvre, Motion


def _wrapped(angle: float) -> float:
    return math.remainder(angle, 2 * math.pi)


def _steer(ship: Ship, motion: Motion, heading: float) -> float:
    """Return the turn that holds a heading, by its error and the rate of turn."""
    error = _wrapped(heading - motion.psi)
    turn = 1.5 * error - 1.5 * ship.time_scale * motion.r
    return max(-1.0, min(1.0, turn))


def steady(ahead: float = 1.0, turn: float = 0.0, side: float = 0.0) -> Manoeuvre:
    """Hold one setting."""
    return lambda ship, rng: lambda motion: ship.helm(ahead, turn, side)


def turning_circle(
    turn: float = 1.0, ahead: float = 1.0, approach: float = 2.0, lengths: float = math.inf
) -> Manoeuvre:
    """Turn (positive to starboard) after a straight approach; straight again after `lengths`."""

    def manoeuvre(ship: Ship, rng: np.random.Generator) -> Helm:
        start, end = approach * ship.time_scale, (approach + lengths) * ship.time_scale
        course: list[float] = []

        def helm(motion: Motion) -> Sequence[float]:
            if start <= motion.t <= end:
                course.clear()
                return ship.helm(ahead, turn)
            course[:] = course or [motion.psi]
            return ship.helm(ahead, _steer(ship, motion, course[0]))

        return helm

    return manoeuvre


def zigzag(
    rudder: float = 10.0, heading: float = 10.0, ahead: float = 1.0, approach: float = 2.0
) -> Manoeuvre:
    """Zig-zag of `rudder` and `heading` [deg]; a negative rudder begins to port."""

    def manoeuvre(ship: Ship, rng: np.random.Generator) -> Helm:
        turn = rudder / 35
        limit = math.radians(abs(heading))
        start = approach * ship.time_scale
        base: list[float] = []
        way = [turn]

        def helm(motion: Motion) -> Sequence[float]:
            if not base:
                base.append(motion.psi)
            if motion.t < start:
                return ship.helm(ahead, _steer(ship, motion, base[0]))
            deviation = _wrapped(motion.psi - base[0])
            if math.copysign(1, way[0]) * deviation > limit:
                way[0] = -way[0]
            return ship.helm(ahead, way[0])

        return helm

    return manoeuvre


def _stepped(
    draw: Callable[[np.random.Generator, int], tuple[tuple[float, ...], float]],
) -> Manoeuvre:
    """Hold one drawn setting after the other; `draw` gives it and how many lengths it lasts."""

    def manoeuvre(ship: Ship, rng: np.random.Generator) -> Helm:
        setting: tuple[float, ...] = ()
        until, count = -1.0, 0

        def helm(motion: Motion) -> Sequence[float]:
            nonlocal setting, until, count
            while motion.t >= until:
                setting, lengths = draw(rng, count)
                until = max(until, 0.0) + lengths * ship.time_scale
                count += 1
            return ship.helm(*setting)

        return helm

    return manoeuvre


def random_steps(
    ahead: tuple[float, float] = (0.4, 1.0),
    turn: float = 0.8,
    side: float = 0.0,
    hold: tuple[float, float] = (1.0, 6.0),
) -> Manoeuvre:
    """Draw power, turn and side push afresh every `hold` lengths."""

    def draw(rng: np.random.Generator, _: int) -> tuple[tuple[float, ...], float]:
        setting = rng.uniform(*ahead), rng.uniform(-turn, turn), rng.uniform(-side, side)
        return setting, rng.uniform(*hold)

    return _stepped(draw)


def spiral(
    largest: float = 0.7, steps: int = 5, hold: float = 6.0, ahead: float = 1.0
) -> Manoeuvre:
    """Step the turn from starboard to port and back, waiting at each (Dieudonne's spiral)."""
    down = np.linspace(largest, -largest, 2 * steps + 1)
    course = np.concatenate([down, down[-2:0:-1]])
    return _stepped(lambda _, k: ((ahead, float(course[k % len(course)])), hold))


def speed_steps(
    levels: Sequence[float] = (0.4, 1.0, 0.6, 0.9, 0.3, 0.7), hold: float = 8.0
) -> Manoeuvre:
    """Step the power on a straight course that an autopilot holds."""

    def manoeuvre(ship: Ship, rng: np.random.Generator) -> Helm:
        course: list[float] = []

        def helm(motion: Motion) -> Sequence[float]:
            if not course:
                course.append(motion.psi)
            level = levels[int(motion.t / (hold * ship.time_scale)) % len(levels)]
            return ship.helm(level, _steer(ship, motion, course[0]))

        return helm

    return manoeuvre


def acceleration_and_stopping(
    power: float = 1.0, astern: float = 0.6, hold: float = 15.0
) -> Manoeuvre:
    """Accelerate with a helmsman for `hold` lengths, run astern until stopped, and again."""

    def manoeuvre(ship: Ship, rng: np.random.Generator) -> Helm:
        course: list[float] = []
        since, stopping = 0.0, False

        def helm(motion: Motion) -> Sequence[float]:
            nonlocal since, stopping
            if not course:
                course.append(motion.psi)
            if not stopping and motion.t - since > hold * ship.time_scale:
                stopping = True
            elif stopping and motion.u < 0.02 * ship.service_speed:
                stopping, since = False, motion.t
                course[0] = motion.psi
            if stopping:
                return ship.helm(-astern, 0.0)
            return ship.helm(power, _steer(ship, motion, course[0]))

        return helm

    return manoeuvre


def everyday(reach: float = 1.0, side: float = 0.5) -> Manoeuvre:
    """Drive as a day goes: transits on a held course, hand-steered turns, slow harbour work."""

    def manoeuvre(ship: Ship, rng: np.random.Generator) -> Helm:
        until = 0.0
        mode = "transit"
        course = 0.0
        target = (0.0, 0.0, 0.0)
        levers = [0.7, 0.0, 0.0]
        last = 0.0

        def helm(motion: Motion) -> Sequence[float]:
            nonlocal until, mode, course, target, last
            if motion.t >= until:
                mode = str(rng.choice(["transit", "turn", "harbour"], p=[0.35, 0.4, 0.25]))
                until = motion.t + ship.time_scale * rng.uniform(2, 8)
                course = motion.psi + rng.uniform(-1, 1)
                if mode == "transit":
                    target = (rng.uniform(0.6, 1.0) * reach, 0.0, 0.0)
                elif mode == "turn":
                    target = (rng.uniform(0.3, 0.9) * reach, rng.uniform(-0.9, 0.9), 0.0)
                else:
                    target = (
                        rng.uniform(-0.4, 0.5) * reach,
                        rng.uniform(-0.8, 0.8),
                        rng.uniform(-side, side),
                    )
            # a hand moves the levers within about a third of a length
            share = 1 - math.exp(-3 * (motion.t - last) / ship.time_scale)
            last = motion.t
            levers[:] = [a + share * (b - a) for a, b in zip(levers, target, strict=True)]
            turn = _steer(ship, motion, course) if mode == "transit" else levers[1]
            return ship.helm(levers[0], turn, levers[2])

        return helm

    return manoeuvre


def in_turn(*parts: tuple[Manoeuvre, float]) -> Manoeuvre:
    """Sail several manoeuvres one after the other, each for a number of lengths, then again."""

    def manoeuvre(ship: Ship, rng: np.random.Generator) -> Helm:
        k, since = 0, 0.0
        helm = parts[0][0](ship, rng)

        def joined(motion: Motion) -> Sequence[float]:
            nonlocal k, since, helm
            if motion.t - since >= parts[k][1] * ship.time_scale:
                k, since = (k + 1) % len(parts), motion.t
                helm = parts[k][0](ship, rng)
            return helm(motion._replace(t=motion.t - since))

        return joined

    return manoeuvre


def table(times: Sequence[float], rows: Sequence[Sequence[float]]) -> Manoeuvre:
    """Give commands from a table, each row held until the next time [s]."""
    held = np.asarray(times, float)

    def manoeuvre(ship: Ship, rng: np.random.Generator) -> Helm:
        return lambda motion: rows[
            max(0, int(np.searchsorted(held, motion.t + 1e-9, side="right")) - 1)
        ]

    return manoeuvre


def kinds() -> dict[str, Manoeuvre]:
    """Return the manoeuvres of a sea trial by name, to both sides where they have one."""
    return {
        "turn-starboard": turning_circle(1.0),
        "turn-port": turning_circle(-1.0),
        "turn-starboard-15": turning_circle(15 / 35, 0.8),
        "turn-port-15": turning_circle(-15 / 35, 0.8),
        "zigzag-10": zigzag(10, 10),
        "zigzag-10-port": zigzag(-10, 10),
        "zigzag-20": zigzag(20, 20),
        "zigzag-20-port": zigzag(-20, 20),
        "spiral": spiral(),
        "speed-steps": speed_steps(),
        "stopping": acceleration_and_stopping(),
        "random": random_steps(),
        "random-with-side": random_steps(side=0.6),
        "everyday": everyday(),
    }
