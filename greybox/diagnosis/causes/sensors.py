"""Sensors that do not show the present motion of the origin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.causes.cause import Cause, Context
from greybox.diagnosis.hypothesis import Hypothesis, Parameter
from greybox.diagnosis.ship import Ship, Wire
from greybox.diagnosis.thresholds import PHASE
from greybox.notebook import with_error

Array = NDArray[np.float64]

# clocks that are looked for differ by less [s]
_LATEST = 60.0
# places of an antenna, in ship lengths ahead, at which other coefficients are looked for
_PLACES = (-0.5, -0.375, -0.25, -0.125, 0.125, 0.25, 0.375, 0.5)
# samples by which a hold between samples may pass for a clock
UNRESOLVED = 0.75


def _has_velocities(context: Context) -> bool:
    return {"u", "v", "r"} <= set(context.outputs)


def _moving(context: Context) -> tuple[str, ...]:
    """Return what forces that imitate a turned or displaced sensor are functions of."""
    return (*context.structure.states, *context.vessel.commands)


class HeadingBias(Cause):
    """A biased compass, by which the velocities were turned into body axes."""

    id = "heading_bias"
    kind = "sensor"
    title = "compass bias"
    signature = "sway in proportion to surge, at every heading and thrust"
    extension = "the bias of the compass in the vessel; logs are turned back when read"
    reference = "Fossen (2011), section 2.2"

    def hypotheses(self, context: Context) -> Sequence[Hypothesis]:
        """Return the turn of u and v."""
        if not _has_velocities(context):
            return ()

        def apply(ship: Ship, value: Array) -> Ship:
            return replace(ship, sensors=replace(ship.sensors, turned=float(value[0])))

        parameter = Parameter("heading_bias", "rad", 0.0, -np.pi / 2, np.pi / 2)
        # forces that look alike are not the same to port and to starboard
        return (
            Hypothesis(
                self.id, self.id, (parameter,), (), apply, arguments=_moving(context), parity=-1
            ),
        )

    def evidence(self, values: Mapping[str, tuple[float, float]]) -> str:
        """Say by how much."""
        value, std = map(float, np.rad2deg(values["heading_bias"]))
        return (
            f"surge and sway are turned against the ship's axes, as by a compass that reads "
            f"{with_error(abs(value), std)} deg too {'high' if value > 0 else 'low'}"
        )


class LeverArm(Cause):
    """Velocities or positions of an antenna that is away from the origin."""

    id = "lever_arm"
    kind = "sensor"
    title = "lever arm of the antenna"
    signature = "errors of surge and sway in proportion to the yaw rate, without delay"
    extension = "the place of the antenna in the vessel"
    reference = "Fossen (2011), section 2.2"

    def hypotheses(self, context: Context) -> Sequence[Hypothesis]:
        """Return both coordinates together."""
        if not _has_velocities(context):
            return ()
        length = context.vessel.length

        def apply(ship: Ship, value: Array) -> Ship:
            lever = (float(value[0]), float(value[1]))
            return replace(ship, sensors=replace(ship.sensors, lever=lever))

        # on the hull, wherever the origin lies on it
        reach = {"lever_arm_x": length, "lever_arm_y": 0.5 * length}
        parameters = tuple(Parameter(n, "m", 0.0, -m, m, step=1e-3) for n, m in reach.items())
        far = tuple((share * length, 0.0) for share in _PLACES)
        return (
            Hypothesis(
                self.id, self.id, parameters, (), apply, arguments=_moving(context), far=far
            ),
        )  # fmt: skip

    def evidence(self, values: Mapping[str, tuple[float, float]]) -> str:
        """Say where the antenna is."""
        sides = {"lever_arm_x": ("ahead", "abaft"), "lever_arm_y": ("to starboard", "to port")}
        told = [
            f"{with_error(abs(value), std)} m {sides[name][value < 0]}"
            for name, (value, std) in values.items()
        ]
        return f"the velocities are those of a point {' and '.join(told)} of the origin"


def abeam(arm: Hypothesis) -> Hypothesis:
    """Return a lever arm of which only the place abeam is free.

    An antenna ahead of the origin moves as a ship with other coupled inertia does: beside that,
    forces tell no more of it.
    """

    def apply(ship: Ship, value: Array) -> Ship:
        lever = (ship.sensors.lever[0], float(value[0]))
        return replace(ship, sensors=replace(ship.sensors, lever=lever))

    return replace(arm, parameters=arm.parameters[1:], apply=apply, far=())


def alike_to_forces(one: Hypothesis, two: Hypothesis) -> bool:
    """Whether two hypotheses are an antenna ahead of the origin and coupled inertia."""
    return any(
        any(p.name == "lever_arm_x" for p in arm.parameters) and other.cause == "inertia_coupling"
        for arm, other in ((one, two), (two, one))
    )


def turned_alike(one: Hypothesis, two: Hypothesis) -> bool:
    """Whether one turns surge into sway as the other's force does, a compass bias or a force."""
    return any(
        turned.cause == "heading_bias" and other.cause in ("asymmetry", "side_force")
        for turned, other in ((one, two), (two, one))
    )


class ClockOffset(Cause):
    """One sensor shows an older time than the others."""

    id = "clock_offset"
    kind = "sensor"
    title = "clock of one sensor"
    signature = "the error of one channel follows that channel's own rate of change"
    extension = "the latency of the channel in the vessel; logs are shifted back when read"
    reference = "Ljung (1999), section 14.3"

    def hypotheses(self, context: Context) -> Sequence[Hypothesis]:
        """Return one per clock: channels that were made of one sensor share it."""
        most = min(_LATEST, 0.1 * context.duration)
        out = []
        for names in _clocks(context):
            name = names[0]
            parameter = Parameter(
                f"clock_{name}", "s", 0.5 * context.sample_time, -most, most,
                step=0.1 * context.sample_time, least=UNRESOLVED * context.sample_time,
                coarse=PHASE * context.passage,
            )  # fmt: skip
            out.append(
                Hypothesis(
                    self.id, f"{self.id}:{name}", (parameter,), (), _Late(names),
                    starts=((3 * context.sample_time,), (-2 * context.sample_time,)),
                )
            )  # fmt: skip
        return out

    def evidence_of(self, hypothesis: Hypothesis, values: Mapping[str, tuple[float, float]]) -> str:
        """Say which, or which two, and how late."""
        said = self.evidence(values)
        names = hypothesis.apply.channels if isinstance(hypothesis.apply, _Late) else ()
        if len(names) < 2:
            return said
        return said.replace(f"{names[0]} comes", f"{' and '.join(names)}, of one clock, come", 1)

    def evidence(self, values: Mapping[str, tuple[float, float]]) -> str:
        """Say which and how late."""
        name, (value, std) = next(iter(values.items()))
        return (
            f"{name.removeprefix('clock_')} comes {with_error(abs(value), std)} s too "
            f"{'late' if value > 0 else 'early'} against the other channels"
        )


@dataclass(frozen=True)
class _Late:
    """Makes the channels of one clock late by one number."""

    channels: tuple[str, ...]

    def __call__(self, ship: Ship, value: Array) -> Ship:
        late = (*ship.sensors.late, *((name, float(value[0])) for name in self.channels))
        return replace(ship, sensors=replace(ship.sensors, late=late))


def _clocks(context: Context) -> list[tuple[str, ...]]:
    """Return the channels of each clock: u and v from positions, r from the heading."""
    shared = [
        pair for pair, made in ((("u", "v"), {"u", "v"}), (("r", "psi"), {"r"}))
        if made <= context.derived and set(pair) <= set(context.outputs)
    ]  # fmt: skip
    found = {name: pair for pair in shared for name in pair}
    return list(dict.fromkeys(found.get(name, (name,)) for name in context.outputs))


class Sign(Cause):
    """A channel of the wrong sign, or two that were exchanged."""

    id = "sign"
    kind = "sensor"
    title = "reversed or exchanged channel"
    signature = "a motion opposite to what its forces and the other motions say"
    extension = "the channel with its sign turned"
    reference = "Fossen (2011), table 2.1"

    def hypotheses(self, context: Context) -> Sequence[Hypothesis]:
        """Return each channel reversed, and commands of one kind exchanged."""
        out = [_reversed(self.id, n) for n in context.outputs]
        commands = context.vessel.commands
        angles = context.vessel.angle_commands
        out += [_wired(self.id, f"sign_{n}", ((n, n, -1.0),)) for n in commands]
        speeds = [c for c in commands if c not in angles]
        for kind in (speeds, [c for c in commands if c in angles]):
            for i, one in enumerate(kind):
                for two in kind[i + 1 :]:
                    swap = ((one, two, 1.0), (two, one, 1.0))
                    out.append(_wired(self.id, f"swapped_{one}_{two}", swap))
        return out

    def evidence_of(self, hypothesis: Hypothesis, values: Mapping[str, tuple[float, float]]) -> str:
        """Say which, or which two."""
        if isinstance(hypothesis.apply, _Wires) and len(hypothesis.apply.wires) > 1:
            # names of columns may hold what joins them in that of the parameter
            pair = " and ".join(command for command, _, _ in hypothesis.apply.wires)
            return f"{pair} stand in each other's place"
        return self.evidence(values)

    def evidence(self, values: Mapping[str, tuple[float, float]]) -> str:
        """Say which."""
        name = next(iter(values))
        return f"{name.removeprefix('sign_')} has the opposite sign of what the motion shows"


def _reversed(cause: str, name: str) -> Hypothesis:
    def apply(ship: Ship, value: Array) -> Ship:
        turned = (*ship.sensors.reversed, name)
        return replace(ship, sensors=replace(ship.sensors, reversed=turned))

    return Hypothesis(cause, f"{cause}:sign_{name}", (), (), apply, refit_from_scratch=True)


@dataclass(frozen=True)
class _Wires:
    """Makes columns stand for others on a ship."""

    wires: tuple[Wire, ...]

    def __call__(self, ship: Ship, value: Array) -> Ship:
        return replace(ship, wires=(*ship.wires, *self.wires))


def _wired(cause: str, key: str, wires: tuple[Wire, ...]) -> Hypothesis:
    return Hypothesis(cause, f"{cause}:{key}", (), (), _Wires(wires), refit_from_scratch=True)
