"""Thrusters that act otherwise than the model assumes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.causes.cause import Cause, Context
from greybox.diagnosis.causes.hull import listed, term_hypothesis
from greybox.diagnosis.causes.sensors import UNRESOLVED
from greybox.diagnosis.hypothesis import Hypothesis, Parameter
from greybox.diagnosis.ship import Ship
from greybox.notebook import with_error
from greybox.vessel.thrust import ThrustLaw
from greybox.vessel.vessel import Actuation, DelayOn, LagHeld, LagOn, Thruster

Array = NDArray[np.float64]

# slowest thruster and longest delay that are looked for, as shares of a log and in seconds
_SHARE, _LONGEST = 0.1, 120.0
# samples by which a lag or a delay is told beyond sampling: a command that moves between samples
# acts half of one earlier than one that is held, never later
_RESOLVED = UNRESOLVED - 0.5
# standard deviation of what lies anywhere within half a sample, in samples
_HALF = 0.5 / 3**0.5
# strongest thrusters beside the others'; shares of the fastest logged movement from which a
# limit of the rate is sought, and the least
_STRONGEST = 10.0
_RATES, _LEAST_RATE = (0.5, 0.2, 0.06), 0.01


def with_thrusters(
    ship: Ship, members: Sequence[int], changed: Callable[[Thruster], Thruster]
) -> Ship:
    """Return the ship with some of its thrusters changed."""
    thrusters = list(ship.vessel.thrusters)
    for i in members:
        thrusters[i] = changed(thrusters[i])
    return replace(ship, vessel=replace(ship.vessel, thrusters=tuple(thrusters)))


def with_actuation(ship: Ship, **changes: Any) -> Ship:
    """Return the ship with its commands followed otherwise."""
    late = replace(ship.vessel.actuation, **changes)
    return replace(ship, vessel=replace(ship.vessel, actuation=late))


def _single_commands(context: Context) -> tuple[str, ...]:
    """Return the columns that may be late by themselves; one that never moves is not."""
    commands = context.vessel.commands
    moving = tuple(c for c in commands if context.ranges.get(c, 1.0) > 0)
    return moving if len(commands) > 1 else ()


def _together(context: Context, words: Sequence[str], own: str = "command") -> tuple[str, ...]:
    """Return the words for what may be late together; a single angle has its column's name.

    Where nothing has an angle, one word does for the commands and the speeds: the vessel's own.
    """
    angles = len(context.vessel.angle_commands)
    skipped = {"angle"} if angles < 2 else set()
    if not angles:
        skipped.add("command" if own == "speed" else "speed")
    return tuple(w for w in words if w not in skipped)


def _may_be_measured(context: Context) -> bool:
    """Whether columns that the model holds from sample to sample may be measured between them."""
    vessel = context.vessel
    held = vessel.actuation.between == Actuation().between
    return held and any(t.drive != "command" for t in vessel.thrusters)


def _late(hypothesis: Hypothesis) -> str:
    """Return what is late with its verb, where not all commands are."""
    on = hypothesis.key.partition(":")[2]
    if hypothesis.place:
        return f"{hypothesis.place} alone acts"
    return {"speed": "the propeller speeds act", "angle": "the angles act"}.get(on, "")


def _groups(context: Context) -> list[list[int]]:
    """Return the thrusters of one type and distance from midship together."""
    found: dict[tuple[str, float], list[int]] = {}
    for i, t in enumerate(context.vessel.thrusters):
        found.setdefault((t.type, abs(t.x)), []).append(i)
    return list(found.values())


def _speeds(context: Context, group: Sequence[int]) -> str:
    """Return the speed columns of a group of thrusters, by which it is called."""
    return "+".join(dict.fromkeys(context.vessel.thrusters[i].speed for i in group))


class ThrusterGain(Cause):
    """One thruster, or a group of them, weaker or stronger than the others' model says."""

    id = "thruster_gain"
    kind = "thruster"
    title = "weak thruster"
    signature = "errors that follow the force of one thruster, as if it gave only a part of it"
    extension = "the thruster's gain in the vessel"
    reference = "Fossen (2011), section 12.3"

    def hypotheses(self, context: Context) -> Sequence[Hypothesis]:
        """Return one hypothesis per thruster, and per group where their strengths may differ."""
        thrusters = context.vessel.thrusters
        if len(thrusters) < 2:
            return ()
        groups = _groups(context)

        def gain(members: Sequence[int], key: str, most: float) -> Hypothesis:
            def apply(ship: Ship, value: Array) -> Ship:
                return with_thrusters(
                    ship, members, lambda t: replace(t, gain=t.gain * float(value[0]))
                )

            parameter = Parameter(f"gain_{thrusters[members[0]].speed}", "1", 0.85, 0.0, most, 1.0)
            driven = dict.fromkeys(c for i in members for c in thrusters[i].columns)
            return Hypothesis(
                self.id, f"{self.id}:{key}", (parameter,), (), apply, arguments=tuple(driven),
                parity=1,
            )  # fmt: skip

        out = []
        columns = [(t.speed, t.steered_by) for t in thrusters]
        for i, (speed, angle) in enumerate(columns):
            most = _STRONGEST if [i] in groups and len(groups) > 1 else 1.0
            # two thrusters may follow the same columns
            alone = angle if columns.count((speed, angle)) == 1 else None
            out.append(gain([i], f"{speed}:{alone or i}", most))
        several = [g for g in groups if len(g) > 1]
        if len(groups) < 3:
            # of two groups the strength of one says that of the other
            several = several[:1] if len(several) == 2 else []
        return out + [gain(g, _speeds(context, g), _STRONGEST) for g in several]

    def evidence(self, values: Mapping[str, tuple[float, float]]) -> str:
        """Say which and how weak."""
        name, (value, _) = next(iter(values.items()))
        return (
            f"the thruster driven by {name.removeprefix('gain_')} gives {100 * value:.0f} % of "
            f"the force that the model of the other thrusters predicts for it"
        )


def _times(own: float, first: float, multiples: Sequence[int]) -> tuple[float, ...]:
    """Return times at which the search for one begins: on both sides of the vessel's own."""
    return (own / 2, 2 * own, first) if own else (first, *(m * first for m in multiples))


class ThrusterLag(Cause):
    """A force that follows its command slowly."""

    id = "thruster_lag"
    kind = "thruster"
    title = "slow thrusters"
    signature = "errors after every change of a command that die out in seconds"
    extension = "a first-order lag between commands and forces"
    reference = "Fossen (2011), section 9.1"

    def hypotheses(self, context: Context) -> Sequence[Hypothesis]:
        """Return a lag of the forces, the speeds, the angles, all commands, or one of them."""
        longest = min(_LONGEST, _SHARE * context.duration)
        first = 2 * context.sample_time
        actuation = context.vessel.actuation
        words: tuple[str, ...] = get_args(LagOn)
        together = _together(context, words, actuation.lag_on)

        def lag(on: str, held: LagHeld, variants: tuple[Hypothesis, ...] = ()) -> Hypothesis:
            def apply(ship: Ship, value: Array) -> Ship:
                return with_actuation(ship, lag=float(value[0]), lag_on=on, lag_held=held)

            own = actuation.lag if on == actuation.lag_on else 0.0
            start, *others = _times(own, first, (4,))
            parameter = Parameter(
                "lag", "s", start, 1e-3, longest, own, step=1e-3,
                least=_RESOLVED * context.sample_time,
            )  # fmt: skip
            return Hypothesis(
                self.id, f"{self.id}:{on}", (parameter,), (), apply,
                tuple((t,) for t in others), variants,
                place="" if on in words else on, past=True,
            )  # fmt: skip

        speeds = {t.speed for t in context.vessel.thrusters}
        # a single propeller speed is all of them, and a ship has one lag
        own = [c for c in _single_commands(context) if {c} != speeds and c not in words]
        places = together if actuation.lag else (*together, *own)
        # a simulated trial may hold another value than the mean during a sample
        return [lag(on, "mean", (lag(on, "start"), lag(on, "end"))) for on in places]

    def evidence(self, values: Mapping[str, tuple[float, float]]) -> str:
        """Say how slow."""
        value, std = values["lag"]
        return f"forces follow their commands with a time constant of {with_error(value, std)} s"

    def evidence_of(self, hypothesis: Hypothesis, values: Mapping[str, tuple[float, float]]) -> str:
        """Say which commands are slow, where not all of them are."""
        value, std = values["lag"]
        what = _late(hypothesis)
        if not what:
            return self.evidence(values)
        they = "it is" if hypothesis.place else "they are"
        return f"{what} with a time constant of {with_error(value, std)} s after {they} logged"


class InputDelay(Cause):
    """Commands that act after a dead time."""

    id = "input_delay"
    kind = "thruster"
    title = "delayed commands"
    signature = "the whole motion comes late after every change of a command"
    extension = "a delay of all commands"
    reference = "Ljung (1999), section 14.3"

    def hypotheses(self, context: Context) -> Sequence[Hypothesis]:
        """Return a delay of all commands, the speeds, the angles, or one of them."""
        longest = min(_LONGEST, _SHARE * context.duration)
        first = 1.5 * context.sample_time
        # held or moving on between samples, the same commands act half a sample apart, and where
        # they may be measured nothing tells which: that half, evenly spread
        coarse = _HALF * context.sample_time if _may_be_measured(context) else 0.0
        actuation = context.vessel.actuation
        words: tuple[str, ...] = get_args(DelayOn)

        def delay(on: str) -> Hypothesis:
            def apply(ship: Ship, value: Array) -> Ship:
                return with_actuation(ship, delay=float(value[0]), delay_on=on)

            key = self.id if on == "command" else f"{self.id}:{on}"
            own = actuation.delay if on == actuation.delay_on else 0.0
            start, *others = _times(own, first, (3, 6))
            parameter = Parameter(
                "delay", "s", start, 0.0, longest, own, step=0.1 * context.sample_time,
                least=_RESOLVED * context.sample_time, coarse=coarse,
            )  # fmt: skip
            return Hypothesis(
                self.id, key, (parameter,), (), apply, starts=tuple((t,) for t in others),
                place="" if on in words else on, past=True,
            )  # fmt: skip

        # a ship has one delay; what steers may be late together, and what drives
        places = ["command"]
        if not context.vessel.actuation.delay:
            several = len({t.speed for t in context.vessel.thrusters}) > 1
            places += _together(context, ("speed", "angle") if several else ("angle",))
            places += [c for c in _single_commands(context) if c not in words]
        return [delay(on) for on in places]

    def evidence(self, values: Mapping[str, tuple[float, float]]) -> str:
        """Say how late."""
        value, std = values["delay"]
        return f"commands act {with_error(value, std)} s after they are logged"

    def evidence_of(self, hypothesis: Hypothesis, values: Mapping[str, tuple[float, float]]) -> str:
        """Say which commands are late, where not all of them are."""
        value, std = values["delay"]
        they = "it is" if hypothesis.place else "they are"
        what = _late(hypothesis) or "commands act"
        return f"{what} {with_error(value, std)} s after {they} logged"


class RateLimit(Cause):
    """An actuator that cannot move as fast as its column."""

    id = "rate_limit"
    kind = "thruster"
    title = "actuator of limited rate"
    signature = "errors after large changes of one command, and none after small ones"
    extension = "a limit of that command's rate"
    reference = "Fossen (2011), section 9.1"

    def hypotheses(self, context: Context) -> Sequence[Hypothesis]:
        """Return one per command that moves; a ship has one."""
        if context.vessel.actuation.rate_limit is not None:
            return ()
        out = []
        for column in context.vessel.commands:
            way, fastest = context.ranges.get(column, 0.0), context.fastest.get(column, 0.0)
            if way <= 0 or fastest <= 0:
                continue

            def apply(ship: Ship, value: Array, column: str = column, way: float = way) -> Ship:
                if value[0] <= 0:
                    return ship
                return with_actuation(ship, rate_limit=way / float(value[0]), rate_on=column)

            # the number is the time of the whole way, which is zero without a limit
            quick = way / fastest
            times = [quick / share for share in _RATES]
            # a movement is late by half the time that it takes: on average, so many samples
            late = 2 * UNRESOLVED * context.sample_time * way / context.moves.get(column, way)
            unit = f"{context.vessel.unit(column) or 'n'}/s"
            parameter = Parameter(
                f"rate_{column}", unit, times[0], 0.0,
                quick / _LEAST_RATE, step=1e-3 * quick, least=quick + late, over=way,
            )  # fmt: skip
            out.append(
                Hypothesis(
                    self.id, f"{self.id}:{column}", (parameter,), (), apply,
                    tuple((t,) for t in times[1:]), unit=unit, only=True, past=True,
                )
            )  # fmt: skip
        return out

    def evidence(self, values: Mapping[str, tuple[float, float]]) -> str:
        """Say which and how fast."""
        name, (value, std) = next(iter(values.items()))
        return (
            f"{name.removeprefix('rate_')} moves by at most {with_error(value, std)} per second, "
            f"slower than it is logged"
        )

    def evidence_of(self, hypothesis: Hypothesis, values: Mapping[str, tuple[float, float]]) -> str:
        """Say which and how fast, in its unit, angles in degrees."""
        unit = hypothesis.unit
        if unit == "rad/s":
            unit = "deg/s"
            values = {
                n: (float(np.rad2deg(v)), float(np.rad2deg(s))) for n, (v, s) in values.items()
            }
        return self.evidence(values).replace("per second", unit, 1)


class FeedbackSampling(Cause):
    """Measured commands that the model holds from sample to sample."""

    id = "feedback_sampling"
    kind = "thruster"
    title = "commands that move between their samples"
    signature = "the motion comes half a sample before what held commands make of it"
    extension = 'commands that move on straight lines between samples (between = "interpolated")'
    reference = "Ljung (1999), section 13.3"

    def hypotheses(self, context: Context) -> Sequence[Hypothesis]:
        """Return the one way, where columns may be measured and are taken to be held."""
        if not _may_be_measured(context):
            return ()

        def apply(ship: Ship, value: Array) -> Ship:
            return with_actuation(ship, between="interpolated")

        return (Hypothesis(self.id, f"{self.id}:interpolated", (), (), apply),)

    def evidence(self, values: Mapping[str, tuple[float, float]]) -> str:
        """Say what the log shows."""
        return (
            "the logged angles and speeds are measured at the samples and move between them: what "
            "acts is the mean of this sample and the next"
        )


class QuadraticThrust(Cause):
    """Thrust by n|n| where the model says n, of all thrusters or of a group."""

    id = "quadratic_thrust"
    kind = "thruster"
    title = "quadratic thrust"
    signature = "high propeller speeds push more, and low ones less, than simulated"
    extension = "a share of n|n| in the thrust law"
    reference = "Fossen (2011), section 9.1"

    def hypotheses(self, context: Context) -> Sequence[Hypothesis]:
        """Return one share for all thrusters with a linear law, and one for each group."""
        linear = [
            i for i, t in enumerate(context.vessel.thrusters)
            if t.thrust.kind == "linear" and t.thrust.quadratic_share == 0
            and context.speeds.get(t.speed, 0.0) > 0
        ]  # fmt: skip
        if not linear:
            return ()
        thrusters = context.vessel.thrusters

        def share(members: Sequence[int], place: str) -> Hypothesis:
            # one for all of them, so that they keep their proportions
            reference = float(np.mean([context.speeds[thrusters[i].speed] for i in members]))

            def apply(ship: Ship, value: Array) -> Ship:
                def of(law: ThrustLaw) -> ThrustLaw:
                    return replace(law, quadratic_share=float(value[0]), reference=reference)

                return with_thrusters(ship, members, lambda t: replace(t, thrust=of(t.thrust)))

            parameter = Parameter("quadratic_share", "1", 0.3, 0.0, 1.0)
            driven = dict.fromkeys(c for i in members for c in thrusters[i].columns)
            return Hypothesis(
                self.id, f"{self.id}:{place}" if place else self.id, (parameter,), (), apply,
                arguments=tuple(driven), place=place, parity=1,
            )  # fmt: skip

        groups = [g for all_ in _groups(context) if (g := [i for i in all_ if i in linear])]
        own = groups if len(groups) > 1 else []
        return [share(linear, ""), *(share(g, _speeds(context, g)) for g in own)]

    def evidence_of(self, hypothesis: Hypothesis, values: Mapping[str, tuple[float, float]]) -> str:
        """Say of which thrusters, where not of all."""
        said = self.evidence(values)
        return f"{said}, of those driven by {hypothesis.place}" if hypothesis.place else said

    def evidence(self, values: Mapping[str, tuple[float, float]]) -> str:
        """Say the share."""
        value, _ = values["quadratic_share"]
        return (
            f"thrust grows faster than the propeller speed: {100 * value:.0f} % of it at the "
            f"typical speed goes with n|n|"
        )


class AngleOffset(Cause):
    """One thruster's angle has an offset."""

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
            column = thruster.steered_by
            if column is None:
                continue

            def apply(ship: Ship, value: Array, i: int = i) -> Ship:
                more = float(value[0])
                return with_thrusters(
                    ship, [i], lambda t: replace(t, angle_offset=t.angle_offset + more)
                )

            parameter = Parameter(f"offset_{column}", "rad", 0.0, -0.8, 0.8)
            key = f"{self.id}:{column}:{i}"
            out.append(
                Hypothesis(
                    self.id, key, (parameter,), (), apply, arguments=thruster.columns,
                    parity=-1,
                )
            )  # fmt: skip
        return out

    def evidence(self, values: Mapping[str, tuple[float, float]]) -> str:
        """Say which and by how much."""
        name, (value, std) = next(iter(values.items()))
        return (
            f"{name.removeprefix('offset_')} is "
            f"{with_error(float(np.rad2deg(value)), float(np.rad2deg(std)))} deg more than logged"
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
