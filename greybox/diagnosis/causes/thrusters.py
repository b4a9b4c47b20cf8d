"""Thrusters that do not act as the model says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.causes.cause import Cause, Context
from greybox.diagnosis.causes.hull import listed, term_hypothesis
from greybox.diagnosis.causes.sensors import UNRESOLVED
from greybox.diagnosis.hypothesis import Hypothesis, Parameter
from greybox.diagnosis.ship import Ship
from greybox.vessel.vessel import LagHeld, LagOn, Thruster

Array = NDArray[np.float64]

# slowest thruster and longest delay that are looked for, as shares of a log and in seconds
_SHARE, _LONGEST = 0.1, 120.0


def with_thruster(ship: Ship, index: int, **changes: object) -> Ship:
    """Return the ship with one thruster changed."""
    thrusters = list(ship.vessel.thrusters)
    thrusters[index] = replace(thrusters[index], **changes)  # type: ignore[arg-type]
    return replace(ship, vessel=replace(ship.vessel, thrusters=tuple(thrusters)))


def _steered_by(thruster: Thruster) -> str | None:
    """Return the column that turns a thruster or its rudder."""
    return thruster.angle if isinstance(thruster.angle, str) else thruster.rudder


def _driven_by(thruster: Thruster) -> tuple[str, ...]:
    """Return the columns that a thruster's force is a function of."""
    angle = _steered_by(thruster)
    return (thruster.speed,) if angle is None else (thruster.speed, angle)


class ThrusterGain(Cause):
    """One thruster weaker than the others' model says."""

    id = "thruster_gain"
    kind = "thruster"
    title = "weak thruster"
    signature = "errors that follow the force of one thruster, as if it gave a part only"
    extension = "the thruster's gain in the vessel"
    reference = "Fossen (2011), section 12.3"

    def hypotheses(self, context: Context) -> Sequence[Hypothesis]:
        """Return one a thruster, where there are several to compare with."""
        if len(context.vessel.thrusters) < 2:
            return ()
        out = []
        for i, thruster in enumerate(context.vessel.thrusters):

            def apply(ship: Ship, value: Array, i: int = i) -> Ship:
                own = ship.vessel.thrusters[i].gain
                return with_thruster(ship, i, gain=own * float(value[0]))

            name = f"gain_{thruster.speed}"
            key = f"{self.id}:{thruster.speed}:{_steered_by(thruster) or i}"
            out.append(
                Hypothesis(
                    self.id, key, (Parameter(name, "1", 0.85, 0.0, 1.0, 1.0),), (), apply,
                    arguments=_driven_by(thruster),
                )
            )  # fmt: skip
        return out

    def evidence(self, values: Mapping[str, tuple[float, float]]) -> str:
        """Say which and how weak."""
        name, (value, _) = next(iter(values.items()))
        return (
            f"the thruster driven by {name.removeprefix('gain_')} gives {100 * value:.0f} % of the "
            f"force that the other thrusters' model expects of it"
        )


class ThrusterLag(Cause):
    """A force that follows its command slowly."""

    id = "thruster_lag"
    kind = "thruster"
    title = "slow thrusters"
    signature = "errors after every change of a command that die out in seconds"
    extension = "a first-order lag between commands and forces"
    reference = "Fossen (2011), section 9.1"

    def hypotheses(self, context: Context) -> Sequence[Hypothesis]:
        """Return a lag of the forces, the propeller speeds, or all commands."""
        longest = min(_LONGEST, _SHARE * context.duration)
        first = 2 * context.sample_time
        parameter = Parameter(
            "lag", "s", first, 1e-3, longest, step=1e-3, least=UNRESOLVED * context.sample_time
        )

        def lag(on: LagOn, held: LagHeld, variants: tuple[Hypothesis, ...] = ()) -> Hypothesis:
            def apply(ship: Ship, value: Array) -> Ship:
                late = replace(ship.vessel.actuation, lag=float(value[0]), lag_on=on, lag_held=held)
                return replace(ship, vessel=replace(ship.vessel, actuation=late))

            return Hypothesis(
                self.id, f"{self.id}:{on}", (parameter,), (), apply, ((4 * first,),), variants
            )

        # a simulated trial may hold another value than the mean during a sample
        out = [lag(on, "mean", (lag(on, "start"), lag(on, "end"))) for on in get_args(LagOn)]
        return out

    def evidence(self, values: Mapping[str, tuple[float, float]]) -> str:
        """Say how slow."""
        value, std = values["lag"]
        return f"forces follow their commands with a time constant of {value:.1f} ± {std:.1g} s"


class InputDelay(Cause):
    """Commands that act after a dead time."""

    id = "input_delay"
    kind = "thruster"
    title = "delayed commands"
    signature = "the whole motion comes late after every change of a command"
    extension = "a delay of all commands"
    reference = "Ljung (1999), section 14.3"

    def hypotheses(self, context: Context) -> Sequence[Hypothesis]:
        """Return one delay of all commands."""
        longest = min(_LONGEST, _SHARE * context.duration)

        def apply(ship: Ship, value: Array) -> Ship:
            late = replace(ship.vessel.actuation, delay=float(value[0]))
            return replace(ship, vessel=replace(ship.vessel, actuation=late))

        first = 1.5 * context.sample_time
        parameter = Parameter("delay", "s", first, 0.0, longest, step=0.1 * context.sample_time,
                              least=UNRESOLVED * context.sample_time)  # fmt: skip
        return (
            Hypothesis(
                self.id, self.id, (parameter,), (), apply, starts=((3 * first,), (6 * first,))
            ),
        )

    def evidence(self, values: Mapping[str, tuple[float, float]]) -> str:
        """Say how late."""
        value, std = values["delay"]
        return f"commands act {value:.1f} ± {std:.1g} s after they are logged"


class QuadraticThrust(Cause):
    """Thrust by n|n| where the model says n."""

    id = "quadratic_thrust"
    kind = "thruster"
    title = "quadratic thrust"
    signature = "high propeller speeds push more, and low ones less, than simulated"
    extension = "a share of n|n| in the thrust law"
    reference = "Fossen (2011), section 9.1"

    def hypotheses(self, context: Context) -> Sequence[Hypothesis]:
        """Return one share for all thrusters with a linear law."""
        linear = [
            i for i, t in enumerate(context.vessel.thrusters)
            if t.thrust.kind == "linear" and t.thrust.quadratic_share == 0
            and context.speeds.get(t.speed, 0.0) > 0
        ]  # fmt: skip
        if not linear:
            return ()

        # one for all, so that the thrusters keep their proportions
        columns = [context.vessel.thrusters[i].speed for i in linear]
        reference = float(np.mean([context.speeds[c] for c in columns]))

        def apply(ship: Ship, value: Array) -> Ship:
            for i in linear:
                thruster = ship.vessel.thrusters[i]
                law = replace(thruster.thrust, quadratic_share=float(value[0]), reference=reference)
                ship = with_thruster(ship, i, thrust=law)
            return ship

        parameter = Parameter("quadratic_share", "1", 0.3, 0.0, 1.0)
        driven = dict.fromkeys(c for i in linear for c in _driven_by(context.vessel.thrusters[i]))
        return (Hypothesis(self.id, self.id, (parameter,), (), apply, arguments=tuple(driven)),)

    def evidence(self, values: Mapping[str, tuple[float, float]]) -> str:
        """Say the share."""
        value, _ = values["quadratic_share"]
        return (
            f"thrust grows faster than the propeller speed: {100 * value:.0f} % of it at the "
            f"typical speed goes with n|n|"
        )


class AngleOffset(Cause):
    """The zero of one thruster's angle is off."""

    id = "angle_offset"
    kind = "thruster"
    title = "angle zero of one thruster"
    signature = "a side force that follows the thrust of one thruster at any angle"
    extension = "the offset of the thruster's angle in the vessel"
    reference = "Ljungberg (2020), eq. 3.46"

    def hypotheses(self, context: Context) -> Sequence[Hypothesis]:
        """Return one a steered thruster."""
        out = []
        for i, thruster in enumerate(context.vessel.thrusters):
            column = _steered_by(thruster)
            if column is None:
                continue

            def apply(ship: Ship, value: Array, i: int = i) -> Ship:
                own = ship.vessel.thrusters[i].angle_offset
                return with_thruster(ship, i, angle_offset=own + float(value[0]))

            parameter = Parameter(f"offset_{column}", "rad", 0.0, -0.8, 0.8)
            key = f"{self.id}:{column}:{i}"
            out.append(
                Hypothesis(self.id, key, (parameter,), (), apply, arguments=_driven_by(thruster))
            )
        return out

    def evidence(self, values: Mapping[str, tuple[float, float]]) -> str:
        """Say which and by how much."""
        name, (value, std) = next(iter(values.items()))
        return (
            f"{name.removeprefix('offset_')} is {np.rad2deg(value):.1f} ± {np.rad2deg(std):.1g} "
            f"deg more than logged"
        )


class AdvanceSpeed(Cause):
    """Thrust that is lost with speed."""

    id = "advance_speed"
    kind = "thruster"
    title = "thrust loss with speed"
    signature = "thrusters push less the faster the ship goes"
    extension = "products of the surge velocity with the thrust"
    reference = "Blanke (1981); Fossen (2011), section 9.1"

    def hypotheses(self, context: Context) -> Sequence[Hypothesis]:
        """Return the lacking products, one by one and together."""
        names = context.lacking("X_u*taux", "Y_u*tauy", "N_u*taun")
        singles = [term_hypothesis(self.id, (n,), context) for n in names]
        return singles + ([term_hypothesis(self.id, names, context)] if len(names) > 1 else [])

    def evidence(self, values: Mapping[str, tuple[float, float]]) -> str:
        """Say the coefficients."""
        return f"thrust changes with the speed through the water ({listed(values)})"
