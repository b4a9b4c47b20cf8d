"""Clock offsets, lever arm and heading bias, estimated together and named one by one.

Each candidate is one or two parameters of the tie between position, heading,
velocity and yaw rate; the one that explains most is taken first, the others
are then judged beside it, so that a late compass is not called a lever arm
unless the motion cannot tell them apart.
"""

from __future__ import annotations

from greybox.trial.checks.finding import Finding, Outcome
from greybox.trial.checks.motion import Motion
from greybox.trial.checks.sensor_offsets.findings import IDS, offset_findings, offset_outcomes
from greybox.trial.checks.sensor_offsets.model import State, Tie
from greybox.trial.checks.sensor_offsets.select import select_candidates, usable_candidates
from greybox.vessel.vessel import Vessel


def find_offsets(motion: Motion, vessel: Vessel) -> tuple[list[Finding], list[Outcome]]:
    """Find clock offsets, lever arm and heading bias.

    Parameters
    ----------
    motion : Motion
        Columns read as they are meant (see `find_reading`).
    vessel : Vessel
        Its antenna is where the positions are taken to be measured.

    Returns
    -------
    findings : list of Finding
    outcomes : list of Outcome
        What was compared, or why nothing in the log can show it.
    """
    x, y = vessel.sensors.get("antenna", (0.0, 0.0))[:2]
    antenna = (float(x), float(y))
    if not (motion.positioned or motion.turned):
        why = "needs heading and yaw rate, or positions, heading and velocities of their own sensor"
        return [], [Outcome(i, "cannot tell", why) for i in IDS]
    tie = Tie(motion, State(arm=antenna))
    usable = usable_candidates(motion)
    found, first = select_candidates(tie, usable, vessel, antenna)
    return (
        offset_findings(found, first, motion, vessel, antenna),
        offset_outcomes(tie, found, usable),
    )
