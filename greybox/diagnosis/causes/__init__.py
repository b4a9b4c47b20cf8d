"""The catalogue of causes, ours and those that other packages register."""

from __future__ import annotations

from greybox.diagnosis.causes.cause import Cause, Context
from greybox.diagnosis.causes.change import ParameterChange
from greybox.diagnosis.causes.flow import Current, Waves, Wind
from greybox.diagnosis.causes.hull import (
    Asymmetry,
    Crossflow,
    CubicDamping,
    InertiaCoupling,
    QuadraticYawDamping,
    SideForce,
)
from greybox.diagnosis.causes.sensors import (
    ClockOffset,
    HeadingBias,
    LeverArm,
    Sign,
)
from greybox.diagnosis.causes.thrusters import (
    AdvanceSpeed,
    AngleOffset,
    FeedbackSampling,
    InputDelay,
    QuadraticThrust,
    RateLimit,
    ThrusterGain,
    ThrusterLag,
)
from greybox.errors import UsageError
from greybox.registry import entry_points

__all__ = ["Cause", "Context", "known_causes"]

_OWN: tuple[type[Cause], ...] = (
    Current, Wind, ThrusterGain, ThrusterLag, InputDelay, RateLimit, FeedbackSampling,
    QuadraticThrust, AdvanceSpeed,
    CubicDamping, QuadraticYawDamping, Crossflow, InertiaCoupling, SideForce, Asymmetry,
    HeadingBias, LeverArm, AngleOffset, ClockOffset, Sign, ParameterChange, Waves,
)  # fmt: skip
GROUP = "greybox.causes"


def known_causes() -> dict[str, Cause]:
    """Return every cause by its id, ours first.

    Returns
    -------
    dict of str to Cause

    Raises
    ------
    UsageError
        A registered object is no cause, or takes an id that is in use.
    """
    found = {cause.id: cause() for cause in _OWN}
    for entry in entry_points(group=GROUP):
        made = entry.load()
        cause = made() if isinstance(made, type) else made
        if not isinstance(cause, Cause):
            raise UsageError(
                f"entry point '{entry.name}' of {GROUP} gives a {type(cause).__name__}, no Cause: "
                f"uninstall or repair the package that registers it."
            )
        if cause.id in found:
            raise UsageError(
                f"entry point '{entry.name}' of {GROUP} takes the id '{cause.id}', which is in "
                f"use: give the cause another."
            )
        found[cause.id] = cause
    return found
