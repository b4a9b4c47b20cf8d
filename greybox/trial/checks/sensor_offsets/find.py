"""Clock offsets, lever arm and heading bias of one ship's instruments, from all its logs together.

Each log gives a quadratic likelihood of all offsets at once; they are pooled, by campaign where
logs differ; then every way to share clocks, with and without lever arm and heading bias, is
compared, so that a late compass is not called a lever arm unless the motion cannot tell them apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greybox.numerics.parallel import map_forked
from greybox.trial.checks.finding import Finding, Outcome
from greybox.trial.checks.motion import Motion
from greybox.trial.checks.sensor_offsets.evidence import (
    Evidence,
    Likelihood,
    coarse_tie,
    expand,
    level,
    search,
)
from greybox.trial.checks.sensor_offsets.findings import IDS, Campaign, campaign_findings
from greybox.trial.checks.sensor_offsets.model import ARM, KinematicModel
from greybox.trial.checks.sensor_offsets.pool import pool
from greybox.trial.checks.sensor_offsets.select import Judged, score_hypotheses
from greybox.trial.checks.sensor_offsets.thresholds import SIGMAS, expected, least
from greybox.trial.raw_log import Recording
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]

# means over blocks of at most this time [s]: ties are slower than samples, and what a receiver's
# filter does to its noise within a block is no motion
_STEP = 0.7


@dataclass(frozen=True)
class Tied:
    """What `find_offsets` needs of a log.

    Parameters
    ----------
    name : str
    recording : Recording
        Mended so far.
    motion : Motion or None
        Its columns read as they are meant (see `find_readings`).
    """

    name: str
    recording: Recording
    motion: Motion | None


def find_offsets(logs: Sequence[Tied], vessel: Vessel) -> list[tuple[list[Finding], list[Outcome]]]:
    """Find clock offsets, lever arm and heading bias that logs of one ship share.

    Parameters
    ----------
    logs : sequence of Tied
    vessel : Vessel
        Its antenna is where the positions are taken to be measured.

    Returns
    -------
    list of (findings, outcomes)
        One per log: what was found, and what was compared or why nothing can show it.
    """
    why = "needs heading and yaw rate, or positions, heading and velocities of their own sensor"
    out: list[tuple[list[Finding], list[Outcome]]] = [
        ([], [Outcome(i, "cannot tell", why) for i in IDS]) for _ in logs
    ]
    rows, ties = [], []
    for i, log in enumerate(logs):
        if log.motion is not None and (log.motion.positioned or log.motion.turned):
            rows.append(i)
            ties.append(KinematicModel(log.motion.coarser(_STEP)))
    # a clock of heading against yaw rate alone is another question
    for positioned in (True, False):
        of_kind = [k for k, tie in enumerate(ties) if tie.positioned == positioned]
        if not of_kind:
            continue
        for campaign in _campaigns(
            [logs[rows[k]] for k in of_kind], [ties[k] for k in of_kind], vessel
        ):
            found, said = campaign_findings(campaign, vessel)
            for k in campaign.members:
                out[rows[of_kind[k]]] = (found, said)
    return out


def _campaigns(
    logs: Sequence[Tied], ties: Sequence[KinematicModel], vessel: Vessel
) -> list[Campaign]:
    prior, material = expected(vessel), least(vessel)
    first = map_forked(lambda tie: expand(tie, search(tie, coarse_tie(tie), prior)), ties)
    pooled, splits = pool(first, prior, material)
    evidence: list[Evidence] = list(first)
    for campaign in pooled:
        for i in campaign.logs:
            if len(ties) > 1:
                evidence[i] = expand(ties[i], campaign.offsets)
    pooled, _ = pool(evidence, prior, material, splits)
    found = []
    for campaign in pooled:
        members = [ties[i] for i in campaign.logs]
        turned = any(t.turned for t in members)
        channels = members[0].motion.values if members[0].positioned else {"psi": 0, "r": 0}
        judged = score_hypotheses(
            tuple(channels), turned=turned, offsets=campaign.offsets,
            covariance=campaign.covariance, vessel=vessel,
            scatter=np.hypot(campaign.scatter, material / SIGMAS),
            antenna=prior[0][ARM],
        )  # fmt: skip
        found.append(
            Campaign(
                members=campaign.logs,
                names=tuple(logs[i].name for i in campaign.logs),
                recordings=tuple(logs[i].recording for i in campaign.logs),
                evidence=tuple(evidence[i] for i in campaign.logs),
                pooled=campaign,
                judged=_upheld(judged, members, prior),
                others=len(ties) - len(campaign.logs),
                turned_over=max(float(np.ptp(t.motion["psi"])) for t in members),
                step=max(m.step for i in campaign.logs if (m := logs[i].motion) is not None),
            )
        )
    return found


def _upheld(judged: list[Judged], ties: Sequence[KinematicModel], prior: Array) -> list[Judged]:
    """Leave out the hypotheses at the head that the logs do not bear out.

    They are ranked by the quadratic likelihood around one place. The likelihood itself, at what a
    hypothesis says, must gain what it costs: along a valley of rival mends it may not.
    """

    def loss(offsets: Array) -> float:
        return sum(level(Likelihood(tie), offsets, prior) for tie in ties)

    nothing = loss(prior[0])
    for k, h in enumerate(judged):
        if not h.defects or nothing - loss(h.offsets) >= h.cost:
            return judged[k:]
    return judged
