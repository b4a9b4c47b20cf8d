"""The force that follows commands late: a pure delay, a rate limit and a first-order lag.

A command c held from sample to sample moves a first-order lag of time constant
T, ẋ = (c − x)/T, exactly by x[k+1] = a x[k] + (1 − a) c[k] with a = exp(−Ts/T).
One that moves no faster than a rate ρ is at x[k] = x[k−1] + d[k], d[k] = clip(c[k] − x[k−1],
±ρTs), at the end of the sample; under way for |d|/ρ of it, it acts by its mean
x[k] − d[k]|d[k]|/(2ρTs).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from greybox.numerics.recursion import recursive
from greybox.vessel.force import generalised_force
from greybox.vessel.vessel import Actuation, LagHeld, Vessel

Array = NDArray[np.float64]

# samples of a limited signal that are one function: less is spent between them
_UNROLLED = 25

__all__ = ["Actuation", "actuated_force", "delayed", "lagged", "limited", "with_actuators_of"]


def actuated_force(
    vessel: Vessel, commands: dict[str, Array], sample_time: float, logged: float | None = None
) -> dict[str, Array]:
    """Evaluate the generalised inputs on commands as they act over each sample.

    Parameters
    ----------
    vessel : Vessel
        Its `actuation` says how late, and what commands are between samples: of one that moves
        on a straight line the mean over a sample is its value half a sample later.
    commands : dict of str to ndarray
        (..., N) each column of `Vessel.commands`, time last. What was commanded
        before is taken as the first value.
    sample_time : float
        [s]
    logged : float, optional
        Sample time at which the commands were logged, before they were averaged over samples of
        `sample_time` [s]; by default the latter.

    Returns
    -------
    dict of str to ndarray
        (..., N) each input of `force_inputs`.
    """
    late = vessel.actuation
    early = (sample_time if logged is None else logged) / 2 if late.between != "held" else 0.0
    delays = dict.fromkeys(vessel.delayed_commands, late.delay)
    moved = {
        c: delayed(commands[c], (delays.get(c, 0.0) - early) / sample_time) for c in vessel.commands
    }
    if late.rate_on is not None and late.rate_limit is not None:
        moved[late.rate_on] = limited(moved[late.rate_on], late.rate_limit * sample_time)
    samples = late.lag / sample_time
    for c in vessel.lagged_commands:
        moved[c] = lagged(moved[c], samples, late.lag_held)
    made = generalised_force(vessel, moved)
    if late.lag == 0 or late.lag_on != "force":
        return made
    return {name: lagged(value, samples, late.lag_held) for name, value in made.items()}


def with_actuators_of(vessel: Vessel, known: Vessel) -> Vessel:
    """Return a vessel whose thrusters act as those of another description of it.

    Thrust laws, gains, angle offsets, lag, delay and rate limit are taken over: parameters
    that were estimated with them mean nothing without. Places, limits, columns
    and sensors stay, and commands are held, as those of a plan are.

    Parameters
    ----------
    vessel : Vessel
    known : Vessel
        Where its thrusters are not the same in number, type, place and columns,
        `vessel` is returned as it is.
    """

    def kept(v: Vessel) -> list[object]:
        return [(t.type, t.x, t.y, t.columns, t.angle) for t in v.thrusters]

    if kept(vessel) != kept(known):
        return vessel
    thrusters = tuple(
        replace(t, thrust=k.thrust, gain=k.gain, angle_offset=k.angle_offset)
        for t, k in zip(vessel.thrusters, known.thrusters, strict=True)
    )
    actuation = replace(known.actuation, between="held")
    return replace(vessel, thrusters=thrusters, actuation=actuation)


def delayed(value: Array, samples: float) -> Array:
    """Delay a signal (..., N) by a number of samples, interpolated linearly.

    The first value is held before the start, the last beyond the end of one that is
    advanced (negative `samples`).
    """
    value = np.asarray(value, float)
    if samples == 0:
        return value
    last = value.shape[-1] - 1
    place = np.clip(np.arange(last + 1) - samples, 0.0, last)
    before = place.astype(np.intp)
    share = place - before
    after = np.minimum(before + 1, last)
    return np.asarray((1 - share) * value[..., before] + share * value[..., after])


def lagged(value: Array, samples: float, held: LagHeld = "start") -> Array:
    """Pass a signal (..., N) through a lag of this many samples, at rest on its first value.

    Of each sample the value at its start, its mean over the sample, or that at its end.
    """
    value = np.asarray(value, float)
    if samples == 0:
        return value
    a = decay(samples)
    pushed = np.concatenate([value[..., :1], (1.0 - a) * value[..., :-1]], axis=-1)
    out = recursive(np.array([1.0, -a]), pushed)
    return np.asarray(value + (out - value) * held_share(samples, held))


def limited(value: Array, most: float) -> Array:
    """Return the mean over each sample of a signal (..., N) that follows by so much at most.

    It is at rest on the first value.
    """
    value = np.asarray(value, float)
    samples = value.shape[-1]
    blocks = -(-samples // _UNROLLED)
    buffer, follow = _following(blocks).buffer()
    take: Callable[..., None] = buffer.set_arg
    give: Callable[..., None] = buffer.set_res
    # the last block is filled with what follows nothing any more
    wanted, end = np.zeros((2, blocks * _UNROLLED))
    rates, last, rows = np.full(blocks, float(most)), np.empty(blocks), []
    for row in value.reshape(-1, samples):
        wanted[:samples] = row
        first = row[:1].copy()
        for i, array in enumerate((first, wanted, rates)):
            take(i, memoryview(array))
        for i, array in enumerate((last, end)):
            give(i, memoryview(array))
        follow()
        rows.append(end[:samples].copy())
    end = np.array(rows).reshape(value.shape)
    way = np.diff(end, axis=-1, prepend=end[..., :1])
    return np.asarray(end - way * np.abs(way) / (2 * most))


@lru_cache(maxsize=32)
def _following(blocks: int) -> ca.Function:
    """Return ``(x, wanted, most) -> last of each block, x of each sample`` of a limited signal."""
    first, most, wanted = ca.SX.sym("x"), ca.SX.sym("most"), ca.SX.sym("wanted", _UNROLLED)
    found = [first]
    for k in range(_UNROLLED):
        found.append(found[-1] + ca.fmin(ca.fmax(wanted[k] - found[-1], -most), most))
    block = ca.Function("block", [first, wanted, most], [found[-1], ca.vertcat(*found[1:])])
    return block.mapaccum("follow", blocks, [0], [0], {"base": max(2, math.isqrt(blocks))})


def decay(samples: float) -> float:
    """Return what is left of a difference after one sample of a lag of so many samples."""
    return float(np.exp(-1.0 / samples))


def held_share(samples: float, held: LagHeld) -> float:
    """Return what is left of a difference where it acts: at the start, in the mean, at the end."""
    a = decay(samples)
    return {"start": 1.0, "mean": (1 - a) * samples, "end": a}[held]
